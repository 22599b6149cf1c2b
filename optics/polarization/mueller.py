"""Mueller calculus: how a layer changes the polarization of light, for numpy arrays and for Dr.Jit alike.

Stokes vectors S = (S0, S1, S2, S3) refer to two axes x, y across the direction k in which the light travels, k = x
cross y: an observer whom the light reaches sees x to the right and y up. S1 > 0 is light polarized along x, S2 > 0
along x + y, an angle is counted from x to y. An axis that lies at the angle phi enters a matrix as q = cos(2 phi), u =
sin(2 phi).

A `Mueller` holds 4 x 4 entries; each is a plain 0 (nothing there, never multiplied), a number, or an array of any shape
that broadcasts. All formulas are analytic in their arguments, so that numpy's complex numbers carry derivatives
(optics.light.development).

Sources: Goldstein, Polarized Light, 3rd ed. (2011), chs. 5, 6, 9; Born & Wolf, Principles of Optics, 1.5; for what a
matrix must meet to be physical, Cloude, Proc. SPIE 1166, 177 (1989)."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import numpy as np


# -- functions for both kinds of arrays ------------------------------------------------------------------------------
def _library(*values):
    drjit = sys.modules.get("drjit")
    return drjit if drjit is not None and any(drjit.is_array_v(v) for v in values) else np


def _apply(name: str, x):
    value = getattr(_library(x), name)(x)
    return (
        float(value) if isinstance(x, (int, float)) else value
    )  # a numpy scalar would swallow a Dr.Jit array beside it


def cos(x):
    return _apply("cos", x)


def sin(x):
    return _apply("sin", x)


def sqrt(x):
    return _apply("sqrt", x)


def exp(x):
    return _apply("exp", x)


def real(x):
    """What a comparison may look at: the real part, of a complex step the value itself."""
    return np.real(x) if _library(x) is np else x


def where(condition, yes, no):
    """yes where the condition holds, else no; both are evaluated."""
    library = _library(condition, yes, no)
    return np.where(condition, yes, no) if library is np else library.select(condition, yes, no)


def sinc(x2):
    """sin(x)/x for x^2, analytic at 0."""
    small = real(x2) < 1e-4
    x = sqrt(where(small, 1.0, x2))
    return where(small, 1 - x2 / 6 * (1 - x2 / 20 * (1 - x2 / 42)), sin(x) / x)


def cosc(x2):
    """(1 - cos(x))/x^2 for x^2, analytic at 0."""
    half = sinc(x2 / 4)
    return half * half / 2


def tanhc(x2):
    """tanh(x)/x for x^2, analytic at 0."""
    small = real(x2) < 1e-2  # below, exp(-2 x) near 1 costs float32 the derivative; there the series is right to 1e-14
    x = sqrt(where(small, 1.0, x2))
    fall = exp(-2 * x)
    series = 1 - x2 / 3 * (1 - 2 * x2 / 5 * (1 - 17 * x2 / 42 * (1 - 62 * x2 / 153 * (1 - 1382 * x2 / 3410))))
    return where(small, series, (1 - fall) / ((1 + fall) * x))


def sech(x2):
    """1/cosh(x) for x^2, analytic at 0."""
    small = real(x2) < 1e-4
    fall = exp(-sqrt(where(small, 1.0, x2)))
    return where(small, 1 - x2 / 2 * (1 - 5 * x2 / 12), 2 * fall / (1 + fall * fall))


# -- matrices --------------------------------------------------------------------------------------------------------
def _nothing(x) -> bool:
    return isinstance(x, int) and x == 0


def _dot(a: Sequence, b: Sequence):
    total = 0
    for x, y in zip(a, b):
        if not _nothing(x) and not _nothing(y):
            term = x * y
            total = term if _nothing(total) else total + term
    return total


class Mueller:
    """A 4 x 4 matrix acting on Stokes vectors; `a @ b` is light through b first, then through a."""

    __slots__ = ("rows",)

    def __init__(self, rows: Sequence[Sequence]):
        self.rows = tuple(tuple(row) for row in rows)

    def __matmul__(self, other):
        if isinstance(other, Mueller):
            columns = tuple(zip(*other.rows))
            return Mueller([[_dot(row, column) for column in columns] for row in self.rows])
        return tuple(_dot(row, other) for row in self.rows)  # a Stokes vector

    def after(self, row: Sequence) -> tuple:
        """row times the matrix: what a detector (a row vector) is sensitive to before the layer."""
        return tuple(_dot(row, column) for column in zip(*self.rows))

    def __mul__(self, factor) -> Mueller:
        return Mueller([[0 if _nothing(e) else e * factor for e in row] for row in self.rows])

    __rmul__ = __mul__

    def __add__(self, other: Mueller) -> Mueller:
        return Mueller(
            [
                [b if _nothing(a) else a if _nothing(b) else a + b for a, b in zip(*rows)]
                for rows in zip(self.rows, other.rows)
            ]
        )

    @property
    def reversed(self) -> Mueller:
        """The same layer met from behind, in axes (-x, y) that look back: O M^T O, O = diag(1, 1, -1, 1)
        (reciprocity)."""
        sign = (1, 1, -1, 1)
        return Mueller(
            [
                [0 if _nothing(self.rows[j][i]) else self.rows[j][i] * (sign[i] * sign[j]) for j in range(4)]
                for i in range(4)
            ]
        )

    def numpy(self) -> np.ndarray:
        """(..., 4, 4) of numpy entries."""
        shape = np.broadcast_shapes(*(np.shape(e) for row in self.rows for e in row))
        return np.stack(
            [np.stack([np.broadcast_to(np.asarray(e) * 1.0, shape) for e in row], -1) for row in self.rows], -2
        )

    def mitsuba(self):
        """As Mitsuba's Spectrum of the polarized variants."""
        import mitsuba as mi

        return mi.Spectrum(*[mi.UnpolarizedSpectrum(e) for row in self.rows for e in row])

    @classmethod
    def of(cls, array: np.ndarray) -> Mueller:
        """From an array (..., 4, 4)."""
        return cls([[array[..., i, j] for j in range(4)] for i in range(4)])


def identity() -> Mueller:
    return absorber(1.0)


def absorber(t) -> Mueller:
    """t I: every polarization is weakened alike."""
    return Mueller([[t if i == j else 0 for j in range(4)] for i in range(4)])


def rotation(q, u) -> Mueller:
    """Stokes vector in axes turned by phi (from x to y): S1' = q S1 + u S2, S2' = q S2 - u S1."""
    return Mueller([[1.0, 0, 0, 0], [0, q, u, 0], [0, -u, q, 0], [0, 0, 0, 1.0]])


def turned(a, b, angle) -> tuple:
    """(a, b) = size (cos 2 phi, sin 2 phi) of something with an axis at phi, such as a retardance, after a turn of the
    axis by `angle` (deg)."""
    double = 2 * angle * (math.pi / 180)
    return a * cos(double) - b * sin(double), a * sin(double) + b * cos(double)


def diattenuator(q, u, t1, t2) -> Mueller:
    """Transmittance t1 along the axis (q, u) and t2 across it, without retardance: a polarizer, or a Fresnel boundary.

    With a = (t1 + t2)/2, b = (t1 - t2)/2, c = sqrt(t1 t2):
        M = [[a, b q, b u, 0], [b q, a q^2 + c u^2, (a - c) q u, 0], [b u, (a - c) q u, a u^2 + c q^2, 0], [0, 0, 0, c]]
    Where t2 is 0, c is 0 and stays so to first order (its slope there is infinite). Goldstein (2011), sec. 5.2 and 5.5.
    """
    a, b, product = (t1 + t2) / 2, (t1 - t2) / 2, t1 * t2
    dark = real(product) <= 1e-14
    c = where(dark, 0.0 * product, sqrt(where(dark, 1.0, product)))
    cross = (a - c) * (q * u)
    return Mueller(
        [
            [a, b * q, b * u, 0],
            [b * q, a * (q * q) + c * (u * u), cross, 0],
            [b * u, cross, a * (u * u) + c * (q * q), 0],
            [0, 0, 0, c],
        ]
    )


def dichroic(a, b) -> Mueller:
    """Diattenuator whose mean transmittance is 1 and whose transmittances along its axis and across it have the ratio
    exp(2 x), x = sqrt(a^2 + b^2): a = x cos(2 phi), b = x sin(2 phi); analytic through x = 0, where phi has no meaning.

        M = [[1, t a, t b, 0], [t a, c + g a^2, g a b, 0], [t b, g a b, c + g b^2, 0], [0, 0, 0, c]]
    with t = tanh(x)/x, c = 1/cosh(x) and g = (1 - c)/x^2; the diattenuation is t x. Lu & Chipman, J. Opt. Soc. Am. A
    13, 1106 (1996), eq. (18)."""
    square = a * a + b * b
    t, c = tanhc(square), sech(square)
    g = t * t / (1 + c)
    return Mueller(
        [
            [1.0, t * a, t * b, 0],
            [t * a, c + g * (a * a), g * (a * b), 0],
            [t * b, g * (a * b), c + g * (b * b), 0],
            [0, 0, 0, c],
        ]
    )


def retarder(a, b) -> Mueller:
    """Linear retarder of the retardance delta = sqrt(a^2 + b^2) (rad) with the fast axis at phi: a = delta cos(2 phi),
    b = delta sin(2 phi); analytic through delta = 0, where phi has no meaning.

        M = [[1, 0, 0, 0], [0, 1 - g b^2, g a b, -s b], [0, g a b, 1 - g a^2, s a], [0, s b, -s a, cos(delta)]]
    with s = sin(delta)/delta and g = (1 - cos(delta))/delta^2. Light at 0 degrees becomes S3 > 0 in a quarter-wave
    plate with its fast axis at +45 degrees, as by Mitsuba's `retarder`. Goldstein (2011), sec. 5.3."""
    square = a * a + b * b
    s, g = sinc(square), cosc(square)
    sa, sb = s * a, s * b
    return Mueller(
        [
            [1.0, 0, 0, 0],
            [0, 1 - g * (b * b), g * (a * b), -sb],
            [0, g * (a * b), 1 - g * (a * a), sa],
            [0, sb, -sa, 1 - g * square],
        ]
    )


def elliptical_retarder(a, b, c) -> Mueller:
    """Retarder of the linear components a, b (as in `retarder`) and the circular component c, rad, which act together.

    A turn of the Poincare sphere by delta = sqrt(a^2 + b^2 + c^2) about w = (a, b, c)/delta: S' = cos(delta) S +
    sin(delta) S x w + (1 - cos(delta)) (w.S) w. c alone turns the axis of linear polarization by -c/2, counted from x
    to y. Goldstein (2011), sec. 9.5; Azzam & Bashara, Ellipsometry and Polarized Light (1987), 2.5."""
    square = a * a + b * b + c * c
    s, g = sinc(square), cosc(square)
    return Mueller(
        [
            [1.0, 0, 0, 0],
            [0, 1 - g * (b * b + c * c), g * (a * b) + s * c, g * (a * c) - s * b],
            [0, g * (a * b) - s * c, 1 - g * (a * a + c * c), g * (b * c) + s * a],
            [0, g * (a * c) + s * b, g * (b * c) - s * a, 1 - g * (a * a + b * b)],
        ]
    )


def twisted_retarder(a, b, twist, c=0.0) -> Mueller:
    """Retarder whose axis turns evenly by `twist` (rad, from x to y) from where light enters to where it leaves; (a, b)
    are its linear components with the axis that it has in its middle, c a circular one.

    In axes that turn along with it the plate is uniform and has the circular component 2 twist on top:
        M = rotation(-twist) elliptical_retarder(a', b', c + 2 twist),  a' + i b' = (a + i b) exp(-i twist)
    Yeh & Gu, Optics of Liquid Crystal Displays, 2nd ed., 4.3."""
    half_q, half_u = cos(twist), sin(twist)  # of the axis, which stands at half the twist in the middle
    entry = elliptical_retarder(a * half_q + b * half_u, b * half_q - a * half_u, c + 2 * twist)
    return rotation(cos(2 * twist), -sin(2 * twist)) @ entry


def depolarizer(keep_linear, keep_circular=None) -> Mueller:
    """diag(1, l, l, c): the share of linear and of circular polarization that a layer leaves (c = l unless given)."""
    c = keep_linear if keep_circular is None else keep_circular
    return Mueller([[1.0, 0, 0, 0], [0, keep_linear, 0, 0], [0, 0, keep_linear, 0], [0, 0, 0, c]])


def mirrored(r) -> Mueller:
    """Reflection at normal incidence with reflectance r, seen in the axes (-x, y) that look back: r diag(1, 1, -1,
    -1)."""
    return Mueller([[r, 0, 0, 0], [0, r, 0, 0], [0, 0, -r, 0], [0, 0, 0, -r]])


# -- surfaces --------------------------------------------------------------------------------------------------------
def fresnel(cos1, n) -> tuple:
    """Power reflectances R_s, R_p of a boundary with relative index n = n2/n1, and cos of the refracted angle.

    cos1 > 0 on the side of medium 1; beyond the critical angle both are 1. Transmittances are 1 - R (power over the
    projected area; a radiance changes by a further 1/n^2). Born & Wolf, 1.5.2."""
    square = 1 - (1 - cos1 * cos1) / (n * n)
    total = real(square) <= 0
    cos2 = where(total, 0.0 * square, sqrt(where(total, 1.0, square)))
    r_s, r_p = (cos1 - n * cos2) / (cos1 + n * cos2), (n * cos1 - cos2) / (n * cos1 + cos2)
    return where(total, 1.0, r_s * r_s), where(total, 1.0, r_p * r_p), cos2


def total_reflection_phase(cos1, n):
    """Retardance (rad) between p and s after total reflection, 0 below the critical angle.

    tan(delta/2) = cos(theta) sqrt(sin(theta)^2 - n^2)/sin(theta)^2, n = n2/n1 < 1. Born & Wolf, 1.5.4, eq. (61).
    """
    sin2 = 1 - cos1 * cos1
    over = sin2 - n * n
    below = real(over) <= 0
    t = cos1 * sqrt(where(below, 1.0, over)) / where(below, 1.0, sin2)
    library = _library(t)
    angle = np.arctan(t) if library is np else library.atan(t)
    return where(below, 0.0, 2 * angle)


def fresnel_reflection(cos1, n) -> Mueller:
    """Reflection in axes (s, p) before and (s, p) after; beyond the critical angle with the phase of total reflection.

    Axes: s = k cross (surface normal), p = k cross s for the incident as for the reflected k. Below Brewster's angle
    r_s and r_p have opposite signs in these axes."""
    square = 1 - (1 - cos1 * cos1) / (n * n)
    total = real(square) <= 0
    cos2 = where(total, 0.0, sqrt(where(total, 1.0, square)))
    r_s, r_p = (cos1 - n * cos2) / (cos1 + n * cos2), (n * cos1 - cos2) / (n * cos1 + cos2)
    phase = total_reflection_phase(cos1, n)
    a = where(total, 1.0, (r_s * r_s + r_p * r_p) / 2)
    b = where(total, 0.0, (r_s * r_s - r_p * r_p) / 2)
    c = where(total, cos(phase), r_s * r_p)
    s = where(total, sin(phase), 0.0)
    return Mueller([[a, b, 0, 0], [b, a, 0, 0], [0, 0, c, -s], [0, 0, s, c]])


# -- stacks of layers with reflecting faces --------------------------------------------------------------------------
class Slab:
    """A layer that transmits and reflects: matrices for light from the front (r, t) and from behind (r_back, t_back).

    `a.before(b)`: light from the front meets b first and a last, all reflections between them summed (adding method,
    van de Hulst 1980; matrices from behind refer to axes that look back)."""

    def __init__(
        self, t: Mueller, r: Mueller | None = None, t_back: Mueller | None = None, r_back: Mueller | None = None
    ):
        zero = Mueller([[0] * 4] * 4)
        self.t, self.t_back = t, t.reversed if t_back is None else t_back
        self.r, self.r_back = zero if r is None else r, zero if r_back is None else r_back

    def after(self, first: Slab, orders: int = 4) -> Slab:
        """This layer behind `first`: the light meets `first` before this one. The series ends after `orders` round
        trips."""
        loop = first.r_back @ self.r  # one round trip between the two, starting towards this layer
        back = self.r @ first.r_back
        series, series_back, power, power_back = identity(), identity(), identity(), identity()
        for _ in range(orders):
            power, power_back = loop @ power, back @ power_back
            series, series_back = series + power, series_back + power_back
        return Slab(
            self.t @ series @ first.t,
            first.r + first.t_back @ self.r @ series @ first.t,
            first.t_back @ series_back @ self.t_back,
            self.r_back + self.t @ first.r_back @ series_back @ self.t_back,
        )


def face(r) -> Slab:
    """A clear face of the reflectance r, at normal incidence."""
    return Slab(absorber(1 - r), mirrored(r), absorber(1 - r), mirrored(r))


# -- what a matrix or a vector says ----------------------------------------------------------------------------------
def physical(matrix: np.ndarray) -> np.ndarray:
    """Smallest eigenvalue of the coherency matrix of M (..., 4, 4), over its trace: >= 0 where M is physically
    realisable.

    H = 1/4 sum_ij M_ij (sigma_i x conj(sigma_j)); Cloude (1989).
    """
    sigma = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
    basis = np.einsum("iab,jcd->ijacbd", sigma, sigma.conj()).reshape(4, 4, 4, 4)
    coherency = np.einsum("...ij,ijab->...ab", np.asarray(matrix, float), basis) / 4
    trace = np.real(np.trace(coherency, axis1=-2, axis2=-1))
    return np.linalg.eigvalsh(coherency)[..., 0] / np.maximum(trace, 1e-300)


def gain(matrix: np.ndarray) -> np.ndarray:
    """Largest transmittance of M (..., 4, 4) over all states of polarization: m00 + |(m01, m02, m03)|; at most 1."""
    m = np.asarray(matrix, float)
    return m[..., 0, 0] + np.linalg.norm(m[..., 0, 1:], axis=-1)


def degree_of_polarization(stokes: np.ndarray, linear: bool = True) -> np.ndarray:
    """sqrt(S1^2 + S2^2 (+ S3^2))/S0 of (..., 4); NaN in the dark."""
    s = np.asarray(stokes, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(s[..., 0] > 0, np.linalg.norm(s[..., 1 : 3 if linear else 4], axis=-1) / s[..., 0], np.nan)


def angle_of_polarization(stokes: np.ndarray) -> np.ndarray:
    """Angle of the axis of linear polarization of (..., 4), deg in [0, 180), from x to y."""
    s = np.asarray(stokes, float)
    return np.degrees(np.arctan2(s[..., 2], s[..., 1])) / 2 % 180
