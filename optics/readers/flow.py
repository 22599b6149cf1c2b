"""The motion between two images of a skin full of beads, and its features: by keypoints, by all pixels, and in bins.

    keypoints = find_beads(rest)                            (N, 2) px: threshold, watershed, contour centres
    motion = sparse_flow(rest, now, keypoints)              (N, 2) px: Lucas and Kanade; NaN where a bead is lost
    field = dense_flow(rest, now)                           (H, W, 2) px: dense inverse search (DIS)
    size, angle, count = bin_means(places, motion, (480, 480), 40)       (11), (12): 40 x 40 bins
    motion, size, angle = FlowReader(rest, "dense", 40)(now)             all of it at the rate of a camera

Images are (H, W) or (H, W, C), DN from 0 to 255 or one channel of light; of several channels the second, the green one,
is read. Points are (x, y) in px, the middle of the first pixel at (0.5, 0.5). Detection and flow are OpenCV's, from the
package opencv-python-headless (`pip install tactile-optics[flow]`).
Source: Sensors 19 (2019) 928, section 5, eqs. (11) and (12); Kroeger et al., ECCV 2016, for DIS."""

from __future__ import annotations

import numpy as np

WINDOW = 15  # px: of Lucas and Kanade's neighbourhood, about two beads
LEVELS = 3  # of its pyramid: motions up to half a window times 2^3
# Of DIS: px from patch to patch, steps of each, and smoothings at the end. Without these, motion that differs with
# depth is found better, but noise between the beads makes a published map miss the place by 5.2 mm in place of 3.0.
STRIDE, DESCENTS, SMOOTHINGS = 4, 8, 3
TINY = np.float32(1e-20)  # px: a motion that has no direction


def _opencv():
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "optical flow needs OpenCV, which is not installed; next step: pip install opencv-python-headless"
        ) from error
    return cv2


def green(image: np.ndarray, saturation: float = 255.0) -> np.ndarray:
    """(H, W) uint8 of the green channel, `saturation` DN as 255."""
    image = np.asarray(image)
    if image.ndim == 3:
        image = image[..., min(1, image.shape[2] - 1)]
    if image.ndim == 2 and image.dtype == np.uint8 and saturation == 255.0:  # as a camera gives it
        return np.ascontiguousarray(image)
    if image.ndim != 2 or not np.isfinite(image).all():
        raise ValueError(f"image of shape {image.shape}; allowed: (H, W) or (H, W, C) of finite values")
    return np.clip(np.rint(image * (255.0 / saturation)), 0, 255).astype(np.uint8)


def masked(image: np.ndarray, threshold: float | None = None, saturation: float = 255.0) -> np.ndarray:
    """(H, W) uint8 green channel, black where no bead is (Figure 10a).

    threshold   in 255ths of full scale; None: Otsu's"""
    grey = green(image, saturation)
    return np.where(grey > (_otsu(grey) if threshold is None else threshold), grey, np.uint8(0))


def find_beads(image: np.ndarray, threshold: float | None = None, saturation: float = 255.0) -> np.ndarray:
    """(N, 2) centres of beads, px: green above a threshold, cut at the valleys of the distance transform by a
    watershed, centroids of the pieces' contours (Figure 9).

    threshold   in 255ths of full scale; None: Otsu's"""
    cv2 = _opencv()
    solid = (masked(image, threshold, saturation) > 0).astype(np.uint8)
    depth = cv2.distanceTransform(solid, cv2.DIST_L2, 5)
    depth = cv2.GaussianBlur(depth, (0, 0), 0.7)  # a disc of pixels has one peak
    peak = (depth >= cv2.dilate(depth, np.ones((3, 3), np.uint8))) & (depth > 1.0)
    count, seeds = cv2.connectedComponents(peak.astype(np.uint8))
    marks = seeds.astype(np.int32) + 1
    marks[(solid > 0) & (seeds == 0)] = 0  # to be divided
    relief = np.clip(255 - depth * (255 / max(float(depth.max()), 1e-6)), 0, 255).astype(np.uint8)
    marks = cv2.watershed(np.repeat(relief[..., None], 3, -1), marks)
    inside = (marks > 1) & (solid > 0)
    v, u = np.nonzero(inside)
    sizes, *sums = (np.bincount(marks[inside], a, count + 1)[2:] for a in (np.ones(len(u)), u + 0.5, v + 0.5))
    return np.stack([total[sizes > 0] / sizes[sizes > 0] for total in sums], -1)


def sparse_flow(
    rest: np.ndarray, now: np.ndarray, keypoints: np.ndarray, threshold: float | None = None, saturation: float = 255.0
) -> np.ndarray:
    """(N, 2) px: how far each keypoint has moved, by Lucas and Kanade's iteration in a pyramid; NaN where it is lost.

    A keypoint is followed back as well: one that does not return to within half a pixel is lost."""
    return _followed(*_pair(*(masked(image, threshold, saturation) for image in (rest, now))), keypoints)


def _pair(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if first.shape != second.shape:
        raise ValueError(f"images of {first.shape} and {second.shape}; allowed: two of the same size")
    return first, second


def _followed(first: np.ndarray, second: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """`sparse_flow` between two masked images."""
    cv2 = _opencv()
    at = (np.asarray(keypoints, float) - 0.5).astype(np.float32).reshape(-1, 1, 2)
    if not len(at):
        return np.zeros((0, 2))
    how = {"winSize": (WINDOW, WINDOW), "maxLevel": LEVELS}
    moved, found, _ = cv2.calcOpticalFlowPyrLK(first, second, at, None, **how)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, None, **how)
    kept = (found[:, 0] > 0) & (returned[:, 0] > 0) & (np.linalg.norm(back - at, axis=-1)[:, 0] < 0.5)
    return np.where(kept[:, None], (moved - at)[:, 0].astype(float), np.nan)


def dense_flow(
    rest: np.ndarray, now: np.ndarray, threshold: float | None = None, saturation: float = 255.0
) -> np.ndarray:
    """(H, W, 2) px: how far what each pixel of the rest image shows has moved, by DIS; where no bead is, the flow is
    that of its surroundings.

    threshold   as in `masked`; both images take that of the one at rest, so that no bead flickers"""
    threshold = _otsu(green(rest, saturation)) if threshold is None else threshold
    first, second = _pair(*(masked(image, threshold, saturation) for image in (rest, now)))
    return _dis().calc(first, second, None)


def _dis():
    """DIS with fewer patches, descents and smoothings than its preset "medium": on 150 rendered presses the error of
    the motion is the same to 2 %, that of the forces to 4 %, in two thirds of the time."""
    cv2 = _opencv()
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setPatchStride(STRIDE)
    dis.setGradientDescentIterations(DESCENTS)
    dis.setVariationalRefinementIterations(SMOOTHINGS)
    return dis


def _otsu(grey: np.ndarray) -> float:
    cv2 = _opencv()
    return float(cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0])


class FlowReader:
    """Features of image after image of one sensor, from one image at rest: `flow` is "dense" or "sparse".

    What the image at rest takes, its mask and its beads, is done once."""

    def __init__(
        self,
        rest: np.ndarray,
        flow: str = "dense",
        bins: int | tuple[int, int] = 40,
        threshold: float | None = None,
        saturation: float = 255.0,
    ):
        if flow not in ("dense", "sparse"):
            raise ValueError(f"flow = '{flow}'; allowed: 'dense', 'sparse'")
        self.flow, self.bins, self.saturation = flow, bins, saturation
        if threshold is None and flow == "dense":
            threshold = _otsu(green(rest, saturation))
        self.threshold = threshold
        self.rest = masked(rest, threshold, saturation)
        self.dis = _dis() if flow == "dense" else None
        self.keypoints = find_beads(rest, threshold, saturation) if flow == "sparse" else np.zeros((0, 2))

    def __call__(self, now: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(rows, columns, 2) px mean motion, (rows, columns) px mean size (11) and rad mean angle (12) of the bins."""
        first, second = _pair(self.rest, masked(now, self.threshold, self.saturation))
        if self.dis is not None:
            return dense_features(self.dis.calc(first, second, None), self.bins)
        motion = _followed(first, second, self.keypoints)
        size, angle, _ = bin_means(self.keypoints, motion, first.shape, self.bins)
        return bin_vectors(self.keypoints, motion, first.shape, self.bins), size, angle


def dense_features(field: np.ndarray, bins: int | tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean motion, mean size and circular mean of the angle of all pixels (H, W, 2), as `bin_vectors` and `bin_means`
    have them; where bins are whole pixels wide, as the means of blocks, which take a tenth of the time."""
    height, width = field.shape[:2]
    rows, columns = (bins, bins) if np.isscalar(bins) else bins
    if height % rows or width % columns:
        size, angle, _ = dense_bins(field, bins)
        return bin_vectors(pixel_middles(field.shape[:2]), field.reshape(-1, 2), field.shape[:2], bins), size, angle

    cv2 = _opencv()

    def means(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA).astype(float)

    x, y = cv2.split(np.asarray(field, np.float32))
    size = cv2.magnitude(x, y)
    per = np.maximum(size, TINY)
    angle = np.arctan2(means(y / per), means(x / per + (size == 0)))  # no motion has the angle 0
    return np.stack([means(x), means(y)], -1), means(size), angle


def dense_bins(field: np.ndarray, bins: int | tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`bin_means` of the motion of all pixels, (H, W, 2)."""
    return bin_means(pixel_middles(field.shape[:2]), field.reshape(-1, 2), field.shape[:2], bins)


def pixel_middles(shape: tuple[int, int]) -> np.ndarray:
    """(H W, 2) x, y in px of the middles of all pixels, row by row."""
    v, u = np.indices(shape)
    return np.stack([u.ravel() + 0.5, v.ravel() + 0.5], -1)


def bin_means(
    places: np.ndarray, motion: np.ndarray, shape: tuple[int, int], bins: int | tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean size (11), px, circular mean of the angle (12), rad from x to y, and number of motions in each bin; each
    (rows, columns).

    places   (N, 2) x, y in px: in which bin a motion counts; those beyond the image count nowhere
    motion   (N, 2) px; rows that are not finite (a bead that was lost) count nowhere
    shape    (H, W) of the image;   bins  as many each way, or (rows, columns)

    A bin without a motion has size, angle and count 0. The circular mean is that of directions: every motion counts
    alike, large or small."""
    at, motion, rows, columns = _assigned(places, motion, shape, bins)
    size, angle = np.hypot(*motion.T), np.arctan2(motion[:, 1], motion[:, 0])

    def total(values):
        return np.bincount(at, values, rows * columns)

    count = np.bincount(at, minlength=rows * columns)
    mean = total(size) / np.maximum(count, 1)
    direction = np.arctan2(total(np.sin(angle)), total(np.cos(angle)))
    return tuple(a.reshape(rows, columns) for a in (mean, np.where(count > 0, direction, 0.0), count))


def bin_vectors(
    places: np.ndarray, motion: np.ndarray, shape: tuple[int, int], bins: int | tuple[int, int]
) -> np.ndarray:
    """(rows, columns, 2) px: the mean motion of each bin as a vector, 0 where there is none; arguments as of
    `bin_means`.

    Motions in opposite directions cancel, as they do not in (11); noise of mean 0 leaves it at 0."""
    at, motion, rows, columns = _assigned(places, motion, shape, bins)
    count = np.maximum(np.bincount(at, minlength=rows * columns), 1)
    return np.stack([np.bincount(at, m, rows * columns) / count for m in motion.T], -1).reshape(rows, columns, 2)


def _assigned(places, motion, shape, bins) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Number of the bin of each motion that counts, those motions, and the rows and columns of bins."""
    places, motion = np.asarray(places, float), np.asarray(motion, float)
    rows, columns = (bins, bins) if np.isscalar(bins) else bins
    if places.shape != motion.shape or places.ndim != 2 or places.shape[1] != 2:
        raise ValueError(f"places of shape {places.shape}, motions of {motion.shape}; allowed: both (N, 2)")
    if not (1 <= rows <= shape[0] and 1 <= columns <= shape[1]):
        raise ValueError(f"{rows} x {columns} bins; allowed: 1 to {shape[0]} rows and 1 to {shape[1]} columns")
    known = np.isfinite(motion).all(-1) & np.isfinite(places).all(-1)
    known &= (places >= 0).all(-1) & (places[:, 0] < shape[1]) & (places[:, 1] < shape[0])
    places, motion = places[known], motion[known]
    at = (places[:, 1] * rows / shape[0]).astype(int) * columns + (places[:, 0] * columns / shape[1]).astype(int)
    return at, motion, rows, columns


def feature_vector(size: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(2 m,) the sizes of all bins row by row, then the angles."""
    return np.concatenate([np.ravel(size), np.ravel(angle)])
