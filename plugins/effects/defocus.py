"""Defocus: what is nearer or farther than the focal plane is blurred by the lens's pupil.

Definition
    I' = sum_p I(p) G(V(p))              the light of each pixel p spreads as a Gaussian of variance V along each axis
    V = pupil_area/(4 pi) a^2            that of the even disc which a round pupil makes
    a = m (1/focus - 1/z)                px by which a ray misses the chief ray, per mm off the pupil's middle
with the distance z of what p sees and the image's scale m, px per rad: of the part `camera`, z is the depth along the
axis and m its focal length; of a `fisheye`, z is the way from the lens and m the local scale, the geometric mean along
the radius and across it. A thin lens gives the same V (Potmesil & Chakravarty). The strength is the pupil's area, in
which the variance is linear. The spread is exact for each V; between distances it is interpolated by polynomials in V
(Chebyshev nodes), to 1e-3 of the finest detail. In scenes full of beads no image is blurred: the rays of each pixel
start all over the pupil, an even disc of that area, and meet at the focus, so that what hides what is as seen from each
point of it.
Fingerprint
    rims of beads are soft near the lens and at the base, and sharp between; lens blur is the same at every depth. Where
    all that is seen has one distance, the two are the same.
Validity
    lenses without other aberrations. Where images are blurred, blur that is small against what is seen: what a body
    hides of another is not seen past its rim, a Gaussian has tails that a disc has not, and a pixel spreads as far as
    the distance at its middle says.
References
    Potmesil & Chakravarty, ACM TOG 1 (1982) 85; Born & Wolf, Principles of Optics, 8.8 (beyond geometry).
"""

import math
from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect

NARROW = 1e-6  # px^2/mm^2: a range of variances below which nodes would fall together


def defocused(image, camera):
    from scipy.fft import dctn, idctn

    spread = camera.astray() ** 2 / (4 * math.pi)  # px^2 per mm^2
    rows, columns = image.shape[:2]
    omega2 = (math.pi * np.arange(rows) / rows)[:, None] ** 2 + (math.pi * np.arange(columns) / columns) ** 2
    nodes, weights = interpolation(spread, float(np.real(camera.pupil_area)))
    total = 0.0
    for node, weight in zip(nodes, weights):
        total = total + np.exp(-camera.pupil_area * node * omega2 / 2)[..., None] * dctn(
            weight[..., None] * image, axes=(0, 1)
        )
    return idctn(total, axes=(0, 1))


def interpolation(spread, area):
    """Nodes (n,) over the range of `spread` and the weights (n, ...) of each in every element, polynomials of it."""
    low, high = float(np.real(spread).min()), float(np.real(spread).max())
    half = max((high - low) / 2, NARROW)
    # of exp(-s t) over 0 < t < 1, with s at the highest frequency of the image: measured, 6e-4 at most
    count = 4 + math.ceil(2.2 * math.sqrt(area * 2 * half * math.pi**2))
    nodes = (low + high) / 2 - half * np.cos(math.pi * (np.arange(count) + 0.5) / count)
    weights = []
    for k, node in enumerate(nodes):
        others = np.delete(nodes, k)
        weights.append(math.prod(((spread - other) / (node - other) for other in others), start=1.0))
    return nodes, weights


def check_each_distance_by_itself():
    """Points at 10, 16 and 30 mm before a pinhole of 300 px with a pupil of 1 mm across that is sharp at 16 mm: second
    moments c^2/16 of the circle of confusion c = 300 px |1/16 - 1/z| 1 mm, and no light is lost."""
    z = np.full((60, 180), 16.0)
    z[:, :60], z[:, 120:] = 10.0, 30.0
    image = np.zeros((60, 180, 1))
    image[30, [30, 90, 150]] = 1.0
    camera = SimpleNamespace(pupil_area=math.pi / 4, astray=lambda: 300 * (1 / 16 - 1 / z))
    found = defocused(image, camera)[..., 0]
    agree(found.sum(), 3.0)
    v, u = np.mgrid[:60, :60]
    for part, far in ((0, 10.0), (1, 16.0), (2, 30.0)):
        own = found[:, 60 * part : 60 * part + 60]
        for axis in (u, v):
            agree(((axis - 30) ** 2 * own).sum(), (300 * (1 / 16 - 1 / far)) ** 2 / 16, 2e-3, 2e-3)


def check_interpolation():
    """Of exp(-s t), at any s: 1e-3 at most, as promised; to first order in s exact."""
    t = np.linspace(0, 1, 300)
    for s in (0.1, 1.0, 10.0, 100.0):
        nodes, weights = interpolation(t, s / math.pi**2)
        agree(sum(np.exp(-s * n) * w for n, w in zip(nodes, weights)), np.exp(-s * t), 0, 1e-3)


effect = Effect(
    name="defocus",
    part="camera",
    stages={"lens": defocused},
    parameters=("pupil_area",),
    requires=("beads",),
    mixes_pixels=True,
    onset="both",
    acts=("rim", "curvature"),
    needs="sharp edges at several distances from the lens",
    checks=(check_each_distance_by_itself, check_interpolation),
)
