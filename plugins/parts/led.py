"""LED: a point (or small disc) source with an axially symmetric lobe.

Definition
    kappa = eta cos(a)^mu / d^2,  cos(a) = -s.p                  1/mm^2; 0 where cos(a) <= 0                     (S2)
    kappa_b = kappa w_b power_b prod(`emission` effects)         in the band b: irradiance across the beam, relative
    L_b = V T f_b(wi, s) cos(theta) kappa_b                      radiance that the lit point x sends to the camera (S5)
with the distance d = |S - x| (mm) of the LED's position S from x, the unit vector s = (S - x)/d towards the LED, the
axis p (so that a is the angle between axis and beam), the power eta = `power` times `gain` (of single frames) and the
lobe exponent mu (1 for a Lambertian chip, larger for a lens). V is 1 where the straight line to the LED is free and
else 0, T what the gel's effects let pass, f the membrane's reflection, theta the angle between s and the skin's normal.
w is the relative spectrum: a line of the given peak wavelength and full width at half maximum, or 1 in every band when
`wavelength` is 0 (a white LED). power_b is `power_r`, `power_g`, `power_b` in the first three bands, 1 in a fourth:
what an LED of unknown spectrum is calibrated by. They share a scale with `power` and, over all LEDs of a band, with the
membrane's rho: hold one of them. With an emitting area A > 0 the source is a disc across the axis, of radius
sqrt(A/pi): shadows get a penumbra.
Fingerprint
    position and power shape the field of every frame in which the LED is lit; mu shows far from the axis.
Validity
    distances much larger than the die; no colour change over the lobe.
References
    F-TAC Hand supplementary information, S1.3, eq. (S2).
XML
    position point: where it stands, mm, in place of `x`, `y`, `z`
    target point, (0, 0, 0): what the axis looks at, mm: its nominal direction is from the position to here
    board string: id of the part `board` that it stands on; position, target and axis are then in the board's frame
    placed string: FILE:DESIGNATOR of a pick-and-place file, for x and y on the board, mm
    spectrum string: measured power over the wavelength, in place of the Gaussian: a file, a name, a law, or a spectrum
        of Mitsuba's (see "Spectra" in the guide); relative to its peak, of channels as integrals to its area
    line_shape string: shape of the line, in place of a Gaussian: a measured spectrum as of `spectrum`, which is moved
        to `wavelength` and stretched to `fwhm`; these are its own where they are not given
"""

import math
from dataclasses import replace

from optics.errors import BadScene
from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.line import LINE, changed, of_part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter
from optics.scene.pick_and_place import placed

PARAMETERS = (
    Parameter(
        "x",
        "mm",
        0.0,
        doc="position S, to the right in the image",
        plausible=0.5,
        how="ad",
        step=0.2,
        role="light x",
        free="all",
    ),
    Parameter(
        "y",
        "mm",
        0.0,
        doc="position S, down in the image",
        plausible=0.5,
        how="ad",
        step=0.2,
        role="light y",
        free="all",
    ),
    Parameter(
        "z",
        "mm",
        -5.0,
        doc="position S, from the camera towards the skin",
        plausible=0.5,
        how="ad",
        step=0.2,
        role="light z",
        free="all",
    ),
    Parameter(
        "pan",
        "deg",
        0.0,
        (-89.0, 89.0),
        "turn of the axis p from its nominal direction, about the local up axis",
        plausible=5.0,
        role="light pan",
        free="all",
    ),
    Parameter(
        "tilt",
        "deg",
        0.0,
        (-89.0, 89.0),
        "turn of the axis p from its nominal direction, about the local side axis",
        plausible=5.0,
        role="light tilt",
        free="all",
    ),
    Parameter(
        "turn",
        "deg",
        0.0,
        (-360.0, 360.0),
        "turn t about the axis of the board that it stands on; of no effect without one",
        plausible=2.0,
        step=0.2,
        role="light turn",
    ),
    Parameter("mu", "1", 1.2, (0.0, 200.0), "lobe exponent mu of (S2)", plausible=0.3, free="all"),
    Parameter(
        "power",
        "1",
        1.0,
        (0.0, 1e6),
        "power eta of (S2), relative; 0 switches the LED off",
        plausible=0.1,
        linear=True,
        role="power",
        free="all",
        prior_sd=0.3,  # the lambda term of S4: powers and reflectances are determined only as a product
    ),
    Parameter(
        "gain",
        "1",
        1.0,
        (0.0, 100.0),
        "power of a frame relative to the others",
        neutral=1.0,
        plausible=0.02,
        linear=True,
        role="power gain",
    ),
    *(
        Parameter(
            f"power_{c}",
            "1",
            1.0,
            (0.0, 1e6),
            f"share of the power in the {word} band ({colour})",
            plausible=0.1,
            linear=True,
            role="band power",
            band=band,
        )
        for band, (c, word, colour) in enumerate(
            (("r", "first", "red"), ("g", "second", "green"), ("b", "third", "blue"))
        )
    ),
    Parameter(
        "area",
        "mm^2",
        0.0,
        (0.0, 25.0),
        "emitting area A of the disc",
        neutral=0.0,
        plausible=1.0,
        how="difference",
        role="light area",
    ),
    *LINE,
)


# points of the emitting area each way: no more in all than `optics.light.renderer.SOFT`, above which rims of shadows
# take too few samples for a small area
SIDE = 5


def _spread() -> list[float]:
    """Coordinates in the unit square of the points of a disc. The concentric map brings (a, b) of [-1, 1]^2 to the
    radius max(|a|, |b|)."""
    middles = [(2 * i + 1) / SIDE - 1 for i in range(SIDE)]
    square = sum(max(abs(a), abs(b)) ** 2 for a in middles for b in middles) / SIDE**2
    return [0.5 + a * math.sqrt(0.5 / square) / 2 for a in middles]


SPREAD = _spread()


def build():
    import drjit as dr
    import mitsuba as mi

    class LED(Declared.on(mi.Emitter)):
        kind = "led"

        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            position = props.get("position", None)
            target = props.get("target", mi.ScalarPoint3f(0, 0, 0))
            if position is not None:
                for name, value in zip("xyz", position):
                    props[name] = float(value)
            self.board, self.board_name = None, str(props.get("board", ""))
            named = str(props.get("placed", ""))
            if named:
                if not self.board_name:
                    raise ValueError(f"led '{props.id()}': placed = {named!r} is a place on a board; name its board")
                for name, value in zip("xy", placed(named, tuple(str(f) for f in mi.file_resolver()))):
                    props[name] = value
            self.declare(props)
            self.read_spectrum(props, "spectrum", "power")
            form = self.read_spectrum(props, "line_shape", "power")
            if form is not None and "spectrum" in self.curves:
                raise BadScene(
                    f"led '{self.name}': 'spectrum' and 'line_shape' are both given; allowed: a spectrum as it is, or "
                    "the shape of a line, which 'wavelength' and 'fwhm' place"
                )
            if form is not None:
                self.curves["line_shape"] = form = replace(form, cubic=True)
                for number, found in (("wavelength", form.peak), ("fwhm", form.fwhm)):
                    if number not in props:
                        self.hold(number, found)
            nominal = [float(t) - self.number(n) for t, n in zip(target, "xyz")]
            if not any(nominal):
                raise ValueError(
                    f"led '{self.name}': position and target are the same point; the axis has no direction"
                )
            self.own_frame = [dr.opaque(mi.Vector3f, v) for v in frame_along(nominal)]
            self.m_flags = +mi.EmitterFlags.DeltaPosition
            self.m_needs_sample_3 = False

        def wire(self, scene):
            self.board = scene.named(self.board_name) if self.board_name else None
            if self.board_name and getattr(self.board, "role", "") != "board":
                raise BadScene(
                    f"led '{self.name}': its board '{self.board_name}' is no part of the type 'board' of this scene"
                )

        @property
        def frame(self):
            """Side, up and forward of the axis; they turn with the board."""
            if self.board is None:
                return self.own_frame
            return [self.board.turned(self.board.about_axis(v, self.turned_by())) for v in self.own_frame]

        def position(self):
            own = mi.Point3f(self.x, self.y, self.z)
            if self.board is None and self.board_name:
                raise BadScene(
                    f"led '{self.name}' stands on the board '{self.board_name}', and the parts of this scene are not "
                    "connected yet; call optics.wire(scene) before you render with another integrator"
                )
            return own if self.board is None else self.board.place(own, self.turned_by())

        def turned_by(self):
            """Its turn about the board's axis, deg; of lights that have none, 0."""
            return self.turn if "turn" in self.numbers else 0.0

        def stands(self):
            """The position as three floats, mm."""
            at = tuple(self.number(n) for n in "xyz")
            if self.board is None:
                return at
            if not hasattr(self.board, "stands"):  # of a board of one's own
                return tuple(float(c[0]) for c in self.position())
            return self.board.stands(at, self.number("turn") if "turn" in self.numbers else 0.0)

        def axis(self):
            side, up, forward = self.frame
            return dr.normalize(forward + dr.tan(dr.deg2rad(self.pan)) * side + dr.tan(dr.deg2rad(self.tilt)) * up)

        def spectrum(self, wavelengths):
            """Relative spectrum w at the given wavelengths (nm); 1 for white LEDs, and in a mono variant that
            names no single band."""
            if dr.size_v(mi.UnpolarizedSpectrum) == 1:
                if self.band is None:
                    return mi.UnpolarizedSpectrum(1.0)
                wavelengths = self.band
            if self.lane is not None:
                return self.lane
            functions = self.functions("spectrum")
            if functions or self.curves or self.integral is not None:
                nm = mi.UnpolarizedSpectrum(wavelengths)
                power = changed(of_part(self, self), functions, self)(nm)
                return power if self.integral is None else power / of_part(self, self).area
            u = (mi.UnpolarizedSpectrum(wavelengths) - self.wavelength) / self.fwhm
            return dr.select(self.wavelength > 0, dr.exp(-4 * math.log(2) * dr.square(u)), 1.0)

        def colour(self, wavelengths=None):
            """Share of the power in each band."""
            return self.by_colour(self.power_r, self.power_g, self.power_b, wavelengths)

        def point(self, sample):
            """A point of the emitting disc for a sample of the unit square; the centre when the area is 0."""
            radius = dr.sqrt(dr.maximum(self.area, 1e-12) / dr.pi)
            disc = mi.warp.square_to_uniform_disk_concentric(sample) * radius
            side, up, _ = self.frame
            return self.position() + side * disc.x + up * disc.y

        def places(self):
            """Points of the unit square that stand for the emitting area, each for an equal share; none for a point.

            The middles of SIDE x SIDE cells, drawn apart so that their mean square radius is that of the disc: far from
            edges, light depends on the area by this alone. In 14 frames of dents, of 12 bits, a disc of 4.2 mm^2 comes
            out off by 0.3 of the standard deviation of its area; 16 points left 5.
            """
            if self.reach() == 0:
                return []
            return [(a, b) for a in SPREAD for b in SPREAD]

        def reach(self):
            """From the position to the farthest point of the emitting area, mm."""
            return math.sqrt(self.numbered("light area") / math.pi)

        def kappa(self, it, to_led, distance):
            """kappa of (S2), for a unit vector from the lit point to the LED and their distance in mm; a Float."""
            cos = dr.dot(-to_led, self.axis())
            lobe = dr.select(cos > 1e-4, dr.power(dr.maximum(cos, 1e-4), self.mu), 0.0)
            gain = self.gain if "gain" in self.numbers else 1.0  # which a light of one's own may lack
            return self.power * gain * lobe / dr.square(distance)

        def radiance(self, it, to_led, distance):
            """kappa of (S2) per band, with all that effects do to it."""
            cos = dr.dot(-to_led, self.axis())
            kappa = (
                mi.UnpolarizedSpectrum(self.kappa(it, to_led, distance))
                * self.spectrum(it.wavelengths)
                * self.colour(it.wavelengths)
            )
            for function in self.functions("emission"):
                kappa *= function(Beam(cos, distance, to_led, it.p, it.wavelengths), self)
            return kappa

        # -- Mitsuba --------------------------------------------------------------------------------------------------
        def sample_direction(self, it, sample, active=True):
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = self.point(sample)
            ds.n = mi.Normal3f(self.axis())
            ds.time = it.time
            ds.pdf = mi.Float(1.0)
            ds.delta = mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            to_led = ds.p - it.p
            ds.dist = dr.norm(to_led)
            ds.d = to_led / ds.dist
            kappa = self.radiance(it, ds.d, ds.dist)
            return ds, mi.mueller.depolarizer(kappa) if mi.is_polarized else mi.Spectrum(kappa)

        def eval_direction(self, it, ds, active=True):
            to_led = ds.p - it.p
            distance = dr.norm(to_led)
            kappa = self.radiance(it, to_led / distance, distance)
            return mi.mueller.depolarizer(kappa) if mi.is_polarized else mi.Spectrum(kappa)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0.0)

        def eval(self, si, active=True):
            return mi.Spectrum(0.0)

        def bbox(self):
            waits = self.board is None and self.board_name
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(*([0.0] * 3 if waits else self.stands())))

        def sample_wavelengths(self, si, sample, active=True):
            wavelengths, weight = (
                mi.sample_rgb_spectrum(mi.sample_shifted(sample))
                if mi.is_spectral
                else (mi.Color0f(), mi.UnpolarizedSpectrum(1.0))
            )
            return wavelengths, weight * self.spectrum(wavelengths) * self.colour(wavelengths)

        def to_string(self):
            return f"LED[{self.name}]"

    return LED


def frame_along(direction):
    """Unit vectors (side, up, forward) of a frame that looks along a direction, each three numbers."""
    length = math.sqrt(sum(c * c for c in direction))
    axis = [c / length for c in direction]
    # a side axis that does not degenerate for the usual LEDs, which shine along +-z or towards the middle
    helper = [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0]
    side = cross(helper, axis)
    norm = math.sqrt(sum(c * c for c in side))
    side = [c / norm for c in side]
    return side, cross(axis, side), axis


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


class Beam:
    """What an `emission` function sees: cosine to the LED's axis, distance (mm), unit vector to the LED, point, nm."""

    def __init__(self, cos, distance, to_led, point, wavelengths):
        self.cos, self.distance, self.to_led, self.point, self.wavelengths = cos, distance, to_led, point, wavelengths


def check_inverse_square():
    """power/d^2 on the axis, times cos(60 deg)^mu off it, nothing behind; half of the peak at half the width of the
    spectrum."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    led = made("led", position=[0.0, 0.0, -5.0], power=3.0, mu=2.0, wavelength=540.0, fwhm=40.0, power_g=0.5)
    # on the axis, 60 degrees off it at twice the distance, behind
    it = dr.zeros(mi.Interaction3f, 3)
    it.p = mi.Point3f([0, 10 * math.sin(math.pi / 3), 0], 0, [0, 0, -10])
    it.wavelengths = type(it.wavelengths)(560.0, 540.0, 520.0, 540.0)
    to = led.position() - it.p
    found = np.array(led.radiance(it, to / dr.norm(to), dr.norm(to)))
    agree(found[:3], np.outer([0.5, 0.5, 0.5], [3 / 25, 3 / 100 / 4, 0.0]), 1e-5)


def random(rng):
    """A coloured LED of the visible."""
    return {"wavelength": rng.uniform(450, 640), "fwhm": rng.uniform(20, 150), "mu": rng.uniform(0.8, 6)}


part = Part("led", "emitter", PARAMETERS, build, checks=(check_inverse_square,), random=random)
