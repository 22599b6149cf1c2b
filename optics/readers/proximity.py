"""How near a thing is, from the area of its image: the metric r of Vi2TaP, and the distance that it stands for.

    now = area(image, background=empty)                           px; or area(depth_map, threshold=60.0)
    r = metric(now, first, reference_first, pixels=640 * 480)     dimensionless
    mm = distance(r, curve_r, curve_mm)                           off the curve of a reference object

Source: Vi2TaP (RA-L 2025), III.B.2, eq. (9), and IV.A.3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import ndimage
from scipy.interpolate import PchipInterpolator

from optics.errors import UnknownKey
from optics.readers.markers import noise_sd

FORMS = ("consistent", "printed")
SIGMAS = 1.5  # of a pixel's noise: 5 of what the smoothing leaves of it
SMOOTHING = 1.0  # px, sd of the Gaussian over a difference of images
FLOOR = 1e-3  # of the largest difference: sd of images without noise
RIM = 3  # px within and without the thresholded outline in which a pixel may be covered in part
BRIDGING = 5  # medians over 7 x 7 px: after as many the outline through a marker of 6 px radius rests
LEVEL = 6.0  # px, sd of the Gaussian over which an object's level is averaged


# -- Area ------------------------------------------------------------------------------------------------------------
def area(
    image: np.ndarray,
    background: np.ndarray | None = None,
    threshold: float | None = None,
    *,
    noise: float | None = None,
    hidden: np.ndarray | None = None,
) -> float:
    """Area of the nearest object's image, px: the largest connected piece, its holes filled, its rim counted in parts.

    Largest is the piece with the largest sum of difference or nearness over its pixels, so that no faint wide shadow
    wins.

    of a depth map          image (H, W), mm; `threshold` mm: what is nearer is the object. Not finite: nothing there
    of a pair of images   image and `background`, the same view without the object, (H, W) or (H, W, C), DN or radiance;
                            `threshold` in sd of a pixel's noise: what differs by more, either way, is the object. 1.5
                            by default, which is 5 sd of the difference after a Gaussian of 1 px
    noise                   sd of a pixel of the difference, DN or radiance; None: estimated from its second
                            differences, which stays true where the object fills the image. 1: the threshold is in DN,
                            to keep shadows and reflections off, and for images without noise
    hidden                  (H, W) bool: pixels that show a marker or the sensor's body, through which outlines run on
                            straight; `Markers.mask` makes it

    The threshold decides which pixels are looked at, not where the rim is. A pixel of the rim counts by (s - s_out) /
    (s_in - s_out): s is its depth, in and out are the nearest and the farthest within 3 px; or its difference, in is
    the object's mean nearby and out is 0. The area therefore grows smoothly with the object, and blur keeps it. Returns
    0 where there is no object. Before textures, objects of 10 px radius and more are true to 1.5 %, and to 2.5 % behind
    markers; smaller ones come out too large, of 2 px radius by 20 %, and of 4 px radius by as much where the images are
    blurred by 2 px.

    Falls short: parts of an object that look like the background, at its rim; wide shadows and reflections of the
    object that touch its outline, unless the threshold is above them; lamps that drift between the two images. Raises
    ValueError for images that do not belong together and a depth map without a threshold. Source: Vi2TaP (RA-L 2025),
    III.B.2, where a network makes the depth map and the threshold is on its brightness."""
    image = np.asarray(image, float)
    if threshold is not None and not threshold > 0:
        raise ValueError(f"threshold = {threshold:g}; allowed: above 0, mm of a depth map or sd of a pixel's noise")
    if hidden is not None:
        hidden = np.asarray(hidden, bool)
        if hidden.shape != image.shape[:2] or hidden.all():
            raise ValueError(
                f"hidden: shape {hidden.shape}, {hidden.sum()} pixels; allowed: {image.shape[:2]}, as the image, and "
                "not all of it; see Markers.mask"
            )
    if background is None:
        if image.ndim != 2 or threshold is None:
            raise ValueError(
                f"depth map of shape {image.shape}, threshold = {threshold}; allowed: (H, W) with a threshold in mm; "
                "for an image give the background, the same view without the object"
            )
        return _depth_area(_shown(np.where(np.isfinite(image), image, np.inf), hidden), threshold)
    background = np.asarray(background, float)
    if image.ndim not in (2, 3) or image.shape != background.shape:
        raise ValueError(
            f"image {image.shape} and background {background.shape}; allowed: the same shape, (H, W) or (H, W, C); "
            "take both with the same settings"
        )
    difference = np.atleast_3d(_shown(image - background, hidden))
    if not np.isfinite(difference).all():
        raise ValueError(
            f"difference of the images: {np.sum(~np.isfinite(difference))} values are NaN or infinite; allowed: "
            "finite values; fill bad pixels from their neighbours"
        )
    return _difference_area(difference, SIGMAS if threshold is None else threshold, noise)


def _shown(image: np.ndarray, hidden: np.ndarray | None) -> np.ndarray:
    """The image with hidden pixels taken from the nearest that are not, then by medians, which draw outlines
    straight."""
    if hidden is None:
        return image
    rows, columns = ndimage.distance_transform_edt(hidden, return_distances=False, return_indices=True)
    image = image[rows, columns]
    for _ in range(BRIDGING):
        padded = np.pad(image, [(3, 3), (3, 3)] + [(0, 0)] * (image.ndim - 2), mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, (7, 7), axis=(0, 1))
        image = image.copy()
        image[hidden] = np.median(around[hidden], axis=(-2, -1))
    return image


def _difference_area(difference: np.ndarray, sigmas: float, noise: float | None) -> float:
    size, planes = float(np.abs(difference).max()), np.moveaxis(difference, 2, 0)
    if size == 0:
        return 0.0
    sd = [max(noise_sd(p) if noise is None else noise, FLOOR * size) for p in planes]
    power = sum((ndimage.gaussian_filter(p, SMOOTHING, mode="nearest") / s) ** 2 for p, s in zip(planes, sd))
    signal = np.sqrt(power / len(sd))
    piece, others = _largest(signal > sigmas, signal)
    if not piece.any():
        return 0.0
    top = signal[piece].max()  # for what is too small or thin to have a core
    level = _level(signal, piece)
    for _ in range(2):  # to where blur leaves half; the first level counts the skirt of the blur in
        solid = piece & (signal > level / 2)
        level = _level(signal, ndimage.binary_erosion(solid, iterations=RIM, border_value=1))
        level = np.where(np.isfinite(level), level, top)
    core, rim = _core_and_rim(solid, others)
    return float(core.sum() + np.clip(signal[rim] / level[rim], 0.0, 1.0).sum())


def _depth_area(depth: np.ndarray, threshold: float) -> float:
    piece, others = _largest(depth < threshold, threshold - depth)
    core, rim = _core_and_rim(piece, others)
    beside = np.isfinite(depth) & ~piece
    near = ndimage.minimum_filter(np.where(piece, depth, np.inf), 2 * RIM + 1)[rim]
    far = ndimage.maximum_filter(np.where(beside, depth, -np.inf), 2 * RIM + 1)[rim]
    mixed = np.isfinite(far)  # elsewhere there is nothing to mix with
    part = np.where(mixed, (far - depth[rim]) / np.where(mixed, far - near, 1.0), piece[rim])
    return float(core.sum() + np.clip(part, 0.0, 1.0).sum())


def _core_and_rim(solid: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(what is RIM px and more within the outline, holes filled; what is less than that within or without)."""
    outline = ndimage.binary_fill_holes(solid)
    core = ndimage.binary_erosion(outline, iterations=RIM, border_value=1)
    return core, ndimage.binary_dilation(outline, iterations=RIM) & ~core & ~others


def _largest(mask: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(the connected piece with the largest sum of weights, all the others)."""
    label, n = ndimage.label(mask)
    if not n:
        return mask, mask
    piece = label == 1 + np.argmax(np.bincount(label[mask], weight[mask])[1:])
    return piece, mask & ~piece


def _level(signal: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Mean of the signal over pixels of `where` nearby, NaN where there are none within four times LEVEL."""
    weight = ndimage.gaussian_filter(where.astype(float), LEVEL)
    total = ndimage.gaussian_filter(np.where(where, signal, 0.0), LEVEL)
    return np.divide(total, weight, out=np.full(signal.shape, np.nan), where=weight > 1e-12)


# -- Metric ----------------------------------------------------------------------------------------------------------
def metric(
    areas: np.ndarray | float, initial: float, reference_initial: float, pixels: int, form: str = "consistent"
) -> np.ndarray | float:
    """r = A A0' / (A0 pixels), form "consistent"; r = A A0 / (A0' pixels), form "printed". Dimensionless.

    areas              A, px, any shape, from `area`
    initial            A0, px: of this object where it was first detected
    reference_initial  A0', px: of the reference object at the same distance
    pixels             of the image, H W: the paper calls r dimensionless and gives values such as 0.238, but its eq.
                       (9) is in px; as a share of the image r keeps its value when the resolution changes

    Eq. (9) as printed, and the sentence below it, multiply A by A0 / A0'. That makes a large object's r larger still:
    of two discs of diameters D and D' at one distance, r is in the ratio (D/D')^4 instead of 1. The purpose that the
    paper states, to calibrate objects of different size against the reference, and the claim of its Fig. 5b, that
    cylinders of 20, 30 and 40 mm share one curve of r over distance, need the ratio the other way round: A A0' / A0.
    Then r is the area that the reference would have in the object's place, exactly so for flat ends before a pinhole,
    wherever A0 is taken; for cylinders that lie across the view, A0 at 30 mm, within 4 % from 60 to 10 mm (camera 25 mm
    behind the skin). The printed form gives the 40 mm cylinder 16 and 3 times the r of the 20 mm one: a hand that stops
    at the reference's r of 10 mm would stop at 54 mm before the standing 30 mm cylinder, where the paper reports 11.5
    mm. What the form does not cure: an object wider than the view has an area that hardly grows, and r falls below the
    curve.

    Raises UnknownKey for another form, ValueError for areas that are negative or initial ones that are not above 0.
    Source: Vi2TaP (RA-L 2025), III.B.2, eq. (9); IV.A.3, Fig. 5b."""
    if form not in FORMS:
        raise UnknownKey(form, FORMS, "form", "proximity metric")
    for name, value in (
        ("initial area", initial),
        ("initial area of the reference", reference_initial),
        ("pixels", pixels),
    ):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value:g} px; allowed: above 0; take it where the object is first detected")
    values = np.asarray(areas, float)
    if np.any(values < 0):
        raise ValueError(f"areas: smallest {np.nanmin(values):g} px; allowed: 0 and above; see `area`")
    ratio = reference_initial / initial if form == "consistent" else initial / reference_initial
    r = values * ratio / pixels
    return float(r) if r.ndim == 0 else r


def distance(r: np.ndarray | float, curve_r: np.ndarray, curve_d: np.ndarray) -> np.ndarray | float:
    """Distance at which the reference has the metric r, mm, of any shape; NaN outside the curve and for r that is not
    finite.

    curve_r, curve_d  (n >= 2,) metric and distance (mm) of the reference, in any order; r falls as the distance grows

    Monotone cubic (PCHIP) in r^-1/2, of which the distance is a linear function for a flat object before a pinhole: a
    few nodes do. Raises ValueError where the curve is not strictly falling, which would give one r two distances.
    Source: Vi2TaP (RA-L 2025), IV.A.3."""
    curve_r, curve_d = np.asarray(curve_r, float), np.asarray(curve_d, float)
    if curve_r.ndim != 1 or curve_r.shape != curve_d.shape or len(curve_r) < 2:
        raise ValueError(f"reference curve: r {curve_r.shape}, distance {curve_d.shape}; allowed: both (n,), n >= 2")
    if not (np.isfinite(curve_r).all() and np.isfinite(curve_d).all() and (curve_r > 0).all()):
        raise ValueError(
            "reference curve: values that are not finite, or r <= 0; allowed: finite, r above 0; leave out distances "
            "at which the object was not detected"
        )
    order = np.argsort(curve_d, kind="stable")
    curve_r, curve_d = curve_r[order], curve_d[order]
    wrong = np.flatnonzero((np.diff(curve_r) >= 0) | (np.diff(curve_d) <= 0))
    if len(wrong):
        k = wrong[0]
        raise ValueError(
            f"reference curve: r = {curve_r[k]:g} at {curve_d[k]:g} mm and {curve_r[k + 1]:g} at {curve_d[k + 1]:g} "
            "mm; "
            "allowed: r falls strictly as the distance grows; average repeats, or end the curve where it turns"
        )
    r = np.asarray(r, float)
    nodes, at = curve_r**-0.5, np.where(r > 0, r, np.nan) ** -0.5
    for end in nodes[[0, -1]]:  # an end that rounding has moved is still on the curve
        at = np.where(np.abs(at - end) < 1e-9 * end, end, at)
    d = PchipInterpolator(nodes, curve_d, extrapolate=False)(at)
    return float(d) if r.ndim == 0 else d


def reliable_range(d: np.ndarray, r_by_object: Mapping[str, np.ndarray], tolerance: float = 0.1) -> float:
    """Largest distance, mm, up to which all objects' curves agree: (max r - min r) / mean r <= tolerance from the
    nearest on.

    d            (n,) mm, in any order
    r_by_object  name -> (n,) metric at these distances; two objects at least
    tolerance    relative

    Between two distances the disagreement is taken as linear. NaN where the curves already disagree at the nearest.
    Raises ValueError for fewer than two objects, shapes that differ and a tolerance that is not above 0.
    Source: Vi2TaP (RA-L 2025), IV.A.3: about 30 to 35 mm for cylinders of 20, 30 and 40 mm.
    """
    d, curves = np.asarray(d, float), {name: np.asarray(r, float) for name, r in r_by_object.items()}
    odd = [name for name, r in curves.items() if r.shape != d.shape or not np.isfinite(r).all()]
    if d.ndim != 1 or not len(d) or len(curves) < 2 or odd or not tolerance > 0:
        raise ValueError(
            f"d {d.shape}, {len(curves)} objects, not finite or not of that shape: {', '.join(odd) or 'none'}, "
            "tolerance "
            f"= {tolerance:g}; allowed: (n,) for all, two objects or more, tolerance above 0"
        )
    order = np.argsort(d, kind="stable")
    d, r = d[order], np.stack(list(curves.values()))[:, order]
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.nan_to_num((r.max(0) - r.min(0)) / r.mean(0), nan=np.inf)
    beyond = np.flatnonzero(apart > tolerance)
    if not len(beyond):
        return float(d[-1])
    k = beyond[0]
    if k == 0:
        return float("nan")
    if not np.isfinite(apart[k]):
        return float(d[k - 1])
    return float(d[k - 1] + (d[k] - d[k - 1]) * (tolerance - apart[k - 1]) / (apart[k] - apart[k - 1]))
