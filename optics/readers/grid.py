"""A printed grid in a clear skin: is something near, does it touch, or did only the light change? MagicTac's Algorithms
1-3.

    still = references(frames)                     M backgrounds and the grid's mask, of about 30 frames with nothing
                                                   near
    near = proximity(image, still)                 Normal, Approaching or Noise; entropy and channel correlation
    touch = contact(image, still)                  Touched or Untouched; grid similarity
    table = read_sequence(images, still)           a row per image: the three numbers, both states, and what they say
                                                   together

Images are (H, W, 3), R, G, B, DN of any depth. The thresholds are the published ones, in DN of an 8 bit camera, and
every image is mapped there first: 255 (DN - black level) / (saturation - black level), cut to 0 ... 255, not rounded.
For 8 bit images without a pedestal, the default, that changes nothing.

Source: Fan, Li, Cong, Zhang, "MagicGripper: A Mini-MagicTac Integrated Gripper ...", III.D, Algorithms 1-3, eqs.
(1)-(3); the two states together: IV.E.1, Fig. 28. What the paper leaves open is decided where it arises and marked
"Decided"."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import ndimage

BINARY = 35.0  # tau_B, 8 bit DN
ENTROPY = 0.5  # tau_E, bit
CORRELATION = 0.2  # tau_C
SIMILARITY = 0.6  # tau_G
LIGHT_SIMILARITY = 0.5  # IV.E.1: what light alone takes the similarity below
BACKGROUNDS = 3  # M; of N = 30 frames
BLUR = 1.1  # px, sd
KERNEL = 2.0  # sd, at which the Gaussian is cut: 5 x 5 px at BLUR
TOP = 255.0  # of 8 bit
GREY = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601 luma of R, G, B, as OpenCV
PAIRS = ((0, 1), (0, 2), (1, 2))  # R and G, R and B, G and B
CONSTANT = 1e-3  # 8 bit DN; a channel of less spread is rounding and no image


# -- The quantities --------------------------------------------------------------------------------------------------
def eight_bit(image: np.ndarray, black_level: float = 0.0, saturation: float = TOP) -> np.ndarray:
    """255 (DN - black level) / (saturation - black level), cut to 0 ... 255: (H, W, 3) float64, not rounded.

    Raises ValueError for another shape, for values that are not finite, and for a saturation not above the black level.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape or image.dtype.kind not in "uif":
        raise ValueError(
            f"image of shape {image.shape} and type {image.dtype}; allowed: real (H, W, 3), R, G, B last; demosaic "
            "a raw frame first, and give one image, not a stack"
        )
    if not np.isfinite(image).all():
        raise ValueError(
            f"image: {np.sum(~np.isfinite(image))} values are NaN or infinite; allowed: finite DN; fill bad pixels "
            "from their neighbours"
        )
    _check_levels(black_level, saturation)
    return np.clip((image.astype(float) - black_level) * (TOP / (saturation - black_level)), 0.0, TOP)


def entropy(image: np.ndarray) -> float:
    """E = - sum_i P(i) log2 P(i), bit: of the 256 levels of the grey image of (H, W, 3), 8 bit DN, or of a grey (H, W).

    Grey is 0.299 R + 0.587 G + 0.114 B, rounded to whole DN, halves up, as OpenCV makes it. 0 of an even image, 8 at
    most. Raises ValueError for values outside 0 ... 255. Source: eq. (1)."""
    image = np.asarray(image, float)
    levels = np.floor((image @ GREY if image.ndim == 3 else image) + 0.5).astype(np.int64)
    if levels.min() < 0 or levels.max() > TOP:
        raise ValueError(
            f"grey levels {levels.min()} to {levels.max()} DN; allowed: 0 to 255; map them by `eight_bit` first"
        )
    share = np.bincount(levels.ravel(), minlength=256) / levels.size
    share = share[share > 0]
    return float(max(0.0, -(share * np.log2(share)).sum()))  # and not -0


def correlations(image: np.ndarray) -> np.ndarray:
    """C_xy = cov(F_x, F_y) / (sd F_x sd F_y) over all pixels: (3,) of R and G, R and B, G and B; (H, W, 3), 8 bit DN.

    NaN where one of the two is constant (spread below 0.001 DN) and eq. (2) is 0 / 0. Source: eq. (2).
    """
    planes = np.ascontiguousarray(np.asarray(image, float).reshape(-1, 3).T)  # as planes ten times as fast
    constant = np.ptp(planes, axis=1) < CONSTANT
    planes = planes - planes.mean(axis=1, keepdims=True)
    moments = planes @ planes.T
    power = np.where(constant, np.nan, np.diag(moments))
    return np.clip([moments[x, y] / math.sqrt(power[x] * power[y]) for x, y in PAIRS], -1.0, 1.0)


def similarity(grid: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """S = A(grid and reference) / A(reference): (3,) by channel, of masks (H, W, 3); NaN where the reference is empty.

    Areas are counts of pixels. Source: eq. (3).
    """
    kept, area = (
        np.array([np.count_nonzero(mask[..., c]) for c in range(3)]) for mask in (grid & reference, reference)
    )
    return np.divide(kept, area, out=np.full(3, np.nan), where=area > 0)


def _mask(image: np.ndarray, binary: float, blur: float, dark: bool) -> np.ndarray:
    """(H, W, 3) bool: above the threshold after the blur; `dark`: not above."""
    if blur:
        image = ndimage.gaussian_filter(image, (blur, blur, 0.0), mode="mirror", truncate=KERNEL)  # OpenCV's border too
    return (image > binary) != dark


# -- Algorithm 1 -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class References:
    """The sensor with nothing near, as `references` makes it, and the settings that later images must share.

    background   (M, H, W, 3) 8 bit DN, each the mean of frames in a row
    grid         (H, W, 3) bool
    binary       8 bit DN; `blur` px, sd; `dark`: of `grid`, see `references`
    black_level  DN of no light; `saturation` DN: of the frames, and of the images to come
    """

    background: np.ndarray
    grid: np.ndarray
    binary: float = BINARY
    blur: float = BLUR
    dark: bool = False
    black_level: float = 0.0
    saturation: float = TOP

    def __post_init__(self):
        background, grid = np.asarray(self.background), np.asarray(self.grid)
        if (
            background.ndim != 4
            or background.shape[3:] != (3,)
            or 0 in background.shape
            or grid.shape != background.shape[1:]
        ):
            raise ValueError(
                f"references: background {background.shape}, grid {grid.shape}; allowed: (M, H, W, 3) and (H, W, 3)"
                "; make them by `references`"
            )
        if grid.dtype != bool:
            raise ValueError(f"references: grid of type {grid.dtype}; allowed: bool; make it by `references`")
        _check_levels(self.black_level, self.saturation)
        _check("binary", self.binary, 0, TOP, "8 bit DN")
        _check("blur", self.blur, 0, min(grid.shape[:2]), "px")

    @cached_property
    def ceiling(self) -> np.ndarray:
        """(H, W, 3) 8 bit DN: the brightest of the M backgrounds, pixel by pixel."""
        return np.asarray(self.background).max(axis=0)

    @property
    def share(self) -> np.ndarray:
        """(3,) share a of the image that the grid's mask covers, by channel: near 0 or 1 it shows no grid.

        It is also the similarity that an unrelated mask of the same share has by chance; no mask of that share comes
        below 2 - 1/a."""
        return np.asarray(self.grid).mean(axis=(0, 1))

    def map(self, image: np.ndarray) -> np.ndarray:
        """`eight_bit` of an image of the same camera; raises ValueError for another size."""
        image = eight_bit(image, self.black_level, self.saturation)
        if image.shape != self.grid.shape:
            raise ValueError(
                f"image {image.shape}, references {self.grid.shape}; allowed: the same (H, W, 3); take both with "
                "the same settings"
            )
        return image


def references(
    frames: Iterable[np.ndarray],
    count: int = BACKGROUNDS,
    binary: float = BINARY,
    blur: float = BLUR,
    *,
    majority: float = 0.5,
    dark: bool = False,
    black_level: float = 0.0,
    saturation: float = TOP,
) -> References:
    """B_j = mean of the j-th of M groups of frames; G = what is above tau_B in more than `majority` of the frames.

    frames       N images (H, W, 3), DN, of the sensor with nothing near, in order of time; the paper takes 30
    count        M, of backgrounds; N at most
    binary       tau_B, 8 bit DN
    blur         px, sd of the Gaussian before tau_B; 0: none
    majority     share of the frames, 0 to below 1; 0: what was above in any frame
    dark         the grid is what is not above tau_B
    black_level  DN of no light, and saturation, DN: of the camera

    Decided:
      blur       1.1 px cut to 5 x 5 px, which is OpenCV's Gaussian for that kernel; the paper gives no width
      grid       the mean of N binary masks is a share of frames. It becomes a mask again by majority, a share of
                 exactly one half counting as not set. With 0, the union, a still grid loses what flickers about tau_B
      remainder  where N is no multiple of M all frames are used, the first groups being longer by one (7 = 3 + 2 + 2)
      rounding   backgrounds stay fractions; cut to whole DN, as by a cast to 8 bit, they would be 0.5 DN too dark, and
                 0.1 DN of noise enough for the entropy of a still image to pass tau_E
      sign       "binary threshold" is taken as printed: above is grid. Then added light and the sharp brightening of
                 touched cells (III.B.2) can only add pixels, and S of eq. (3) cannot fall by them: it falls where cells
                 shift out of their mask or darken. The sharp drop below 0.5 by light alone (IV.E.1) follows with
                 `dark`: walls that stand below tau_B, and that light lifts above. As printed only a camera that cuts
                 its own exposure does it
    Raises ValueError for fewer frames than M, frames of different size, settings out of range, and frames brighter than
    the saturation: those are of another depth. Source: Algorithm 1."""
    frames = [np.asarray(frame) for frame in frames]
    if not (isinstance(count, (int, np.integer)) and 1 <= count <= len(frames)):
        raise ValueError(
            f"count = {count} backgrounds of {len(frames)} frames; allowed: a whole number, 1 to the number of "
            "frames; the paper takes 3 of 30"
        )
    _check("majority", majority, 0, 1, "(share of the frames)", open_top=True)
    _check("binary", binary, 0, TOP, "8 bit DN")
    images = []
    for index, frame in enumerate(frames):
        images.append(eight_bit(frame, black_level, saturation))
        if frame.shape != frames[0].shape:
            raise ValueError(
                f"frame {index}: shape {frame.shape}; allowed: {frames[0].shape}, as the first; take all with the "
                "same settings"
            )
        if frame.max() > saturation:
            raise ValueError(
                f"frame {index}: up to {frame.max():g} DN; allowed: <= {saturation:g} DN, the saturation; give that "
                "of the camera (65535 for 16 bit), or cut a rendered image there"
            )
    _check("blur", blur, 0, min(images[0].shape[:2]), "px")
    edges = np.cumsum([0] + [len(group) for group in np.array_split(np.arange(len(images)), count)])
    background = np.stack([np.mean(images[a:b], axis=0) for a, b in zip(edges, edges[1:])])
    votes = sum(_mask(image, binary, blur, dark).astype(np.int64) for image in images)
    return References(background, votes > majority * len(images), binary, blur, bool(dark), black_level, saturation)


# -- Algorithm 2 -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Proximity:
    """What `proximity` found.

    state        'Normal': nothing near; 'Approaching'; 'Noise': light that reaches all channels alike
    entropy      E_total, bit
    correlation  C_total, mean of the three pairs, undefined ones counting as 0
    pairs        (3,) R and G, R and B, G and B; NaN where undefined
    filtered     (H, W, 3) 8 bit DN: what is brighter than all backgrounds, and by how much
    """

    state: str
    entropy: float
    correlation: float
    pairs: np.ndarray
    filtered: np.ndarray


def proximity(
    image: np.ndarray,
    references: References,
    *,
    entropy_threshold: float = ENTROPY,
    correlation_threshold: float = CORRELATION,
    dead_band: float = 0.0,
) -> Proximity:
    """F = intersection over j of threshold(image - B_j, 0); 'Normal' if E(F) < tau_E, else 'Approaching' if C(F) <
    tau_C, else 'Noise'.

    image                  (H, W, 3) DN, depth and size as of the references
    entropy_threshold      tau_E, bit
    correlation_threshold  tau_C
    dead_band              8 bit DN: a channel's difference up to this is set to 0, larger ones are kept whole. 0 as
                           published

    Decided:
      intersection  of grey images: the minimum, F_0 being white. So F = max(image - max_j B_j, 0), which is what is
                    computed
      threshold     to zero: what is below becomes 0, the rest keeps its value, or the entropy would have no levels to
                    count
      pixels        all enter the correlation, zeros too: light from one side that brightens one half in every channel
                    correlates
      undefined     a channel that does not change has no correlation. Its pairs count as 0 in C_total: that is what
                    they tend to as the least noise comes in, so that a render without noise reads as a capture. Where
                    two channels or all three do not change, C_total is 0, and what passes tau_E is 'Approaching', on
                    which a robot slows down
    Validity:
      noise         makes up to two values of five of a still F differ from 0. Noise of s DN rms, apart in each pixel
                    and channel, in whole DN of 8 bit, with 3 backgrounds of 10 frames each, gives
                        s  0.1   0.2   0.3   0.4   0.5   0.6   0.7   1     2     5     DN rms, 8 bit
                        E  0.05  0.12  0.19  0.29  0.39  0.50  0.59  0.83  1.41  2.37  bit
                    and a correlation of 0.00: above 0.6 DN a still noisy image is 'Approaching'. (The paper's own
                    indoor baseline is 0.48 bit.) A dead band of 3 s takes E below 0.12 for s up to 8 DN, and hides what
                    brightens less. Without one, as many backgrounds as frames (count = 30) keep E below 0.5 up to 8 DN:
                    one of 30 is brighter by chance. Noise that the channels share, as of a lamp that flickers,
                    correlates and is 'Noise'
      drift         lamps 0.3 % brighter than when the references were taken, at 100 DN and 0.3 DN of noise, pass tau_E
                    as well: take new references, or a dead band
      darkening     what darkens the image is cut to 0 and not seen: a black thing, a shadow
      colour        an object lit alike in all channels is 'Noise': the method lives on lamps of different colour at
                    different sides. Coloured light that reaches one channel alone is 'Approaching'
      even light    that adds the same everywhere has entropy 0 and is 'Normal'
    Raises ValueError for another size, values that are not finite, thresholds out of range. Source: Algorithm 2, eqs.
    (1), (2)."""
    _check("entropy_threshold", entropy_threshold, 0, 8, "bit")
    _check("correlation_threshold", correlation_threshold, -1, 1, "")
    _check("dead_band", dead_band, 0, TOP, "8 bit DN")
    excess = references.map(image) - references.ceiling
    filtered = np.where(excess > dead_band, excess, 0.0)
    total, pairs = entropy(filtered), correlations(filtered)
    mean = float(np.nan_to_num(pairs).mean())
    state = "Normal" if total < entropy_threshold else "Approaching" if mean < correlation_threshold else "Noise"
    return Proximity(state, total, mean, pairs, filtered)


# -- Algorithm 3 -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Contact:
    """What `contact` found.

    state       'Touched' or 'Untouched'
    similarity  S_total, mean over the channels that have a grid
    channels    (3,) S of R, G, B; NaN where the reference shows no grid
    grid        (H, W, 3) bool: the grid of this image
    """

    state: str
    similarity: float
    channels: np.ndarray
    grid: np.ndarray


def contact(image: np.ndarray, references: References, *, similarity_threshold: float = SIMILARITY) -> Contact:
    """S = A(G and G_ref) / A(G_ref), mean over channels; 'Touched' if S < tau_G, else 'Untouched'.

    image                 (H, W, 3) DN, depth and size as of the references
    similarity_threshold  tau_G. Algorithm 3 has 0.6; the contacts of Fig. 28 fall from 0.85 to "below 0.8", and Fig. 29
                          uses 0.7

    Decided: a channel whose reference is empty has no area to lose and is left out of the mean.
    Validity:
      share   cells that shift and keep their area find others' places: S tends to the share a of the image that the
              mask covers (`References.share`) and is never below 2 - 1/a. Where a is above 1 / (2 - tau_G), 0.71, no
              shift is a touch; most of an image of a mean of 100 to 115 DN, as the paper's, stands above 35 DN. Look at
              `share` before trusting S
      still   an image whose light has not changed has S near 1, above 0.98 in drawn scenes: only levels within the
              noise of tau_B flicker. The 0.85 of the paper's untouched sensor must have another cause
      light   a change of the lamps or of the exposure changes S as well: see `combine`
    Raises ValueError for another size, values that are not finite, a threshold out of range, and references without any
    grid. Source: Algorithm 3, eq. (3)."""
    _check("similarity_threshold", similarity_threshold, 0, 1, "")
    if not references.grid.any():
        side = "at or below" if references.dark else "above"
        raise ValueError(
            f"references: no pixel is {side} binary = {references.binary:g} 8 bit DN in any channel; allowed: a "
            "grid in one at least; change binary, or correct saturation and black_level"
        )
    grid = _mask(references.map(image), references.binary, references.blur, references.dark)
    channels = similarity(grid, references.grid)
    mean = float(np.nanmean(channels))
    return Contact("Touched" if mean < similarity_threshold else "Untouched", mean, channels, grid)


# -- Both together ---------------------------------------------------------------------------------------------------
class Reading(NamedTuple):
    """A row of `read_sequence`; zip(*rows) gives columns. `state` is of `combine`, the others as in Proximity and
    Contact."""

    frame: int
    entropy: float
    correlation: float
    similarity: float
    proximity: str
    contact: str
    state: str


def combine(near: Proximity, touch: Contact, light_similarity: float = LIGHT_SIMILARITY) -> str:
    """'Touched', 'Noise', 'Approaching' or 'Normal': what Algorithms 2 and 3 say together.

        near          touch        similarity    together
        Noise         Touched      < 0.5         Noise         light drops the similarity further than contacts do
        any           Touched      otherwise     Touched
        any           Untouched    any           as near

    light_similarity  below which a drop together with 'Noise' is light

    Decided: the paper says that contacts take the similarity "below 0.8" and light "below 0.5", and that the two states
    must be combined, and leaves the rule open. Falls short: where walls shift, the places that they leave brighten in
    all channels at once. Grids drawn with even lamps and with lamps at three sides have a correlation of 0.8 to 0.98
    then, so that Algorithm 2 calls a touch 'Noise', and one that takes the similarity below 0.5 stays 'Noise' here:
    between tau_G = 0.6 and 0.5 there is little room. With 0.8, as in Fig. 28, a press is 'Touched' before it is that
    deep. Raises ValueError for a value out of range. Source: IV.E.1, Fig. 28."""
    _check("light_similarity", light_similarity, 0, 1, "")
    if touch.state == "Touched" and not (near.state == "Noise" and touch.similarity < light_similarity):
        return "Touched"
    return near.state


def read_sequence(
    images: Iterable[np.ndarray],
    references: References,
    *,
    entropy_threshold: float = ENTROPY,
    correlation_threshold: float = CORRELATION,
    similarity_threshold: float = SIMILARITY,
    dead_band: float = 0.0,
    light_similarity: float = LIGHT_SIMILARITY,
) -> list[Reading]:
    """A row per image, in order: frame counted from 0, entropy, correlation, similarity, and the states, each and
    together.

    images   (H, W, 3) DN each; a generator will do, one image is held at a time
    options  as of `proximity`, `contact` and `combine`

    Each image is read by itself: nothing is averaged over time. Raises ValueError as those three do, with the frame's
    number. Source: Algorithms 2 and 3; IV.E.1, Fig. 28."""
    rows = []
    for index, image in enumerate(images):
        try:
            near = proximity(
                image,
                references,
                entropy_threshold=entropy_threshold,
                correlation_threshold=correlation_threshold,
                dead_band=dead_band,
            )
            touch = contact(image, references, similarity_threshold=similarity_threshold)
            state = combine(near, touch, light_similarity)
        except ValueError as error:
            raise ValueError(f"frame {index}: {error}") from error
        rows.append(Reading(index, near.entropy, near.correlation, touch.similarity, near.state, touch.state, state))
    return rows


# -- Checks ----------------------------------------------------------------------------------------------------------
def _check(name: str, value: float, low: float, high: float, unit: str, open_top: bool = False) -> None:
    if not low <= value <= high or (open_top and value == high):
        raise ValueError(
            f"{name} = {value:g}{unit and ' '}{unit}; allowed: {low:g} to {'below ' * open_top}{high:g}; see the "
            "published values in optics.readers.grid"
        )


def _check_levels(black_level: float, saturation: float) -> None:
    if not (math.isfinite(black_level) and math.isfinite(saturation) and saturation > black_level):
        raise ValueError(
            f"black_level = {black_level:g} DN, saturation = {saturation:g} DN; allowed: finite, saturation above "
            "the black level; both are in the camera's EMVA 1288 sheet"
        )
