"""Camera: pinhole with lens distortion, pose, channel sensitivities and a cubic response per channel.

Definition
    x_n = (u - c_x)/f_x,  y_n = (v - c_y)/f_y                    u, v: pixel position, centre of a pixel at +0.5
    distorted = undistorted (1 + k1 r^2 + k2 r^4 + k3 r^6) + tangential(p1, p2)      (OpenCV's order and signs)
    I_c = exposure gain gain_c sum_b M_cb L_b                    irradiance of channel c; 1 = full scale
    G_c(m) = m + a_c (m^2 - m) + b_c (m^3 - m),  m = G_c^-1(I)   response, inverse of a cubic (S1.1)
    DN = black_level + (saturation - black_level) m + offset
so that with the default gains, response and offset DN = black_level + (saturation - black_level) exposure radiance:
`exposure` is full scale per unit of radiance. black_level and saturation are those of [noise] in captures.toml (0 and
255 DN in `optics render`). Effects of the stage `lens` act on L_b, `sensor` on I_c, `response` on m. f_x comes from the
horizontal field of view, f_y = f_x aspect, the principal point (c_x, c_y) is given as an offset from the middle of the
image, L_b is the radiance in band b, and M the sensitivities of the channels in the bands (identity, or a measured
camera of the colour-science library by its name). XML may give `fx`, `fy`, `cx`, `cy` (px) in place of the field of
view. Frame: x right, y down, z forward (OpenCV); the transform `to_world` gives the nominal pose, `x` ... `roll` what
departs from it. Rays of plain Mitsuba start on the entrance pupil, a disc of the area `pupil_area` across the axis, and
meet where the ray through its middle is `focus` from the camera along the axis; so do those of images LED by LED in
scenes full of beads, and other images are blurred as the effect "defocus" says.
Over a gel, `telecentricity` t makes rays more nearly parallel to the axis. Each still meets the untouched face, z = 0,
where it did: what the pinhole at the distance Z sends along (x, y, 1) starts at (x, y, 0) t Z and runs along
((1 - t) x, (1 - t) y, 1), as if the camera stood at Z/(1 - t).
Fingerprint
    principal point and pose shift the image; distortion grows with the third power of the radius; exposure scales all.
Validity
    central projection but for `telecentricity`; a fisheye is the part `fisheye`. Monotone response: G' > 0 on [0, 1].
References
    F-TAC Hand supplementary information, S1.1, eq. (S1); Mitsunaga & Nayar, CVPR 1999.
XML
    to_world transform, identity: nominal pose
    fx float: focal length in px, in place of `x_fov`
    fy float, fx: focal length in px along y, in place of `aspect`; read where `fx` is given, as are cx and cy
    cx float, half the width: principal point, px, in place of `principal_x`
    cy float, half the height: principal point, px, in place of `principal_y`
    mosaic string: angles of the analysers on the pixels of a polarization camera, deg, row by row as the camera sees
        them: "90 45; 135 0"; none without it; `mosaic` in captures.toml replaces it
    sensitivity string, identity: sensitivities of the channels: a camera of the colour-science library by its name, a
        file (.csv) with the wavelength and a column for each channel, or one channel per band. Of a hyperspectral
        camera, channels after the third have the gain and the response of the third
    filter string: transmittance before the sensor over the wavelength: a file, a name or a law
"""

import math

from optics.polarization.mosaic import read_mosaic
from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

POSE = (  # name, unit, limit, what it is, plausible size, which is its prior as well, step
    ("x", "mm", 100.0, "shift from the nominal pose, right", 0.2, 0.2),
    ("y", "mm", 100.0, "shift from the nominal pose, down", 0.2, 0.2),
    ("z", "mm", 100.0, "shift from the nominal pose, forward", 0.2, 0.8),
    ("pan", "deg", 80.0, "turn about the y axis", 0.5, 0.2),
    ("tilt", "deg", 80.0, "turn about the x axis", 0.5, 0.2),
    ("roll", "deg", 180.0, "turn about the z axis", 0.5, 0.8),
)
PARAMETERS = (
    Parameter(
        "x_fov",
        "deg",
        40.0,
        (1.0, 170.0),
        "horizontal field of view",
        plausible=0.5,
        how="difference",
        step=0.8,
        free="crowd",
        prior_sd=0.5,
    ),
    Parameter("aspect", "1", 1.0, (0.5, 2.0), "f_y / f_x", plausible=0.01, how="difference", step=0.8),
    Parameter(
        "principal_x",
        "px",
        0.0,
        (-4000.0, 4000.0),
        "c_x minus half the width",
        plausible=2.0,
        how="difference",
        step=0.2,
    ),
    Parameter(
        "principal_y",
        "px",
        0.0,
        (-4000.0, 4000.0),
        "c_y minus half the height",
        plausible=2.0,
        how="difference",
        step=0.2,
    ),
    Parameter(
        "k1", "1", 0.0, (-2.0, 2.0), "radial distortion, r^2", neutral=0.0, plausible=0.02, how="difference", step=0.8
    ),
    Parameter(
        "k2", "1", 0.0, (-5.0, 5.0), "radial distortion, r^4", neutral=0.0, plausible=0.05, how="difference", step=0.8
    ),
    Parameter(
        "k3", "1", 0.0, (-20.0, 20.0), "radial distortion, r^6", neutral=0.0, plausible=0.2, how="difference", step=0.8
    ),
    Parameter(
        "p1", "1", 0.0, (-1.0, 1.0), "tangential distortion", neutral=0.0, plausible=0.005, how="difference", step=0.8
    ),
    Parameter(
        "p2", "1", 0.0, (-1.0, 1.0), "tangential distortion", neutral=0.0, plausible=0.005, how="difference", step=0.8
    ),
    *(
        Parameter(
            name,
            unit,
            0.0,
            (-limit, limit),
            doc,
            plausible=size,
            how="difference",
            step=step,
            free="crowd",
            prior_sd=size,
        )
        for name, unit, limit, doc, size, step in POSE
    ),
    Parameter(
        "telecentricity",
        "1",
        0.0,
        (-4.0, 2.0),
        "t: share of the perspective over a gel that the lens does not have; 1: telecentric",
        neutral=0.0,
        plausible=0.2,
        how="difference",
        step=0.8,
    ),
    Parameter(
        "pupil_area",
        "mm^2",
        0.0,
        (0.0, 1e4),
        "area of the entrance pupil; 0: a pinhole, all is sharp",
        neutral=0.0,
        plausible=0.5,
        how="image",
        role="pupil",
    ),
    Parameter(
        "focus",
        "mm",
        20.0,
        (0.01, 1e6),
        "distance of what is sharp, along the axis",
        plausible=1.0,
        how="image",
        role="focus",
    ),
    Parameter(
        "exposure", "1", 1.0, (0.0, 1e6), "full scale per unit of radiance", plausible=0.1, how="image", role="exposure"
    ),
    Parameter(
        "gain",
        "1",
        1.0,
        (0.0, 100.0),
        "gain of a frame relative to the others",
        neutral=1.0,
        plausible=0.02,
        multiplies=True,
        how="image",
    ),
    *(
        Parameter(
            f"gain_{c}",
            "1",
            1.0,
            (0.0, 100.0),
            f"gain of channel {c} in a frame, times `gain`",
            neutral=1.0,
            plausible=0.02,
            multiplies=True,
            how="image",
        )
        for c in "rgb"
    ),
    Parameter(
        "offset",
        "DN",
        0.0,
        (-1e4, 1e4),
        "added to every pixel after the response",
        neutral=0.0,
        plausible=1.0,
        how="image",
        linear=True,
    ),
    *(
        Parameter(
            f"response2_{c}",
            "1",
            0.0,
            (-0.9, 0.9),
            f"a_c: quadratic term of the inverse response, channel {c}",
            neutral=0.0,
            plausible=0.1,
            how="image",
        )
        for c in "rgb"
    ),
    *(
        Parameter(
            f"response3_{c}",
            "1",
            0.0,
            (-0.45, 0.45),
            f"b_c: cubic term of the inverse response, channel {c}",
            neutral=0.0,
            plausible=0.1,
            how="image",
        )
        for c in "rgb"
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    from optics.scene.response import inverse_cubic

    class Camera(Declared.on(mi.Sensor)):
        kind = "camera"
        sampled = False  # whether images LED by LED are made of rays that start all over the pupil
        bands = 3  # of the scene
        clock = ""  # key of the scene's clock
        away = 0.0  # mm along the axis from the nominal pose to the untouched face of a gel; 0 without one

        def __init__(self, props):
            nominal = props.get("to_world", mi.ScalarAffineTransform4f())
            mi.Sensor.__init__(self, props)
            width, height = (int(v) for v in self.film().size())
            if "fx" in props:
                fx = float(props.get("fx", 1.0))
                props["x_fov"] = self.field_of(width, fx, props)
                props["aspect"] = float(props.get("fy", fx)) / fx
                props["principal_x"] = float(props.get("cx", width / 2)) - width / 2
                props["principal_y"] = float(props.get("cy", height / 2)) - height / 2
            self.sensitivity = props.get("sensitivity", "identity")
            self.mosaic = read_mosaic(props.get("mosaic", ""))
            self.declare(props)
            self.channels = ()  # curves; none where each channel is a band
            if self.sensitivity != "identity":
                from optics.files.images import CHANNELS_MOST

                self.channels = self.read_sensitivities(self.sensitivity, "sensitivity")
                if len(self.channels) > CHANNELS_MOST:
                    raise ValueError(
                        f"{self.name}.sensitivity = '{self.sensitivity}' has {len(self.channels)} columns; allowed: 1 "
                        f"to {CHANNELS_MOST}"
                    )
                self.curves.update(zip(channel_names(len(self.channels)), self.channels))
            self.read_spectrum(props, "filter", "transmittance")
            self.resolution = (width, height)
            matrix = [[float(nominal.matrix[i, j]) for j in range(4)] for i in range(3)]
            self.columns = [dr.opaque(mi.Vector3f, [matrix[i][j] for i in range(3)]) for j in range(4)]

        def hold(self, name, value):
            super().hold(name, value)
            if name == "pupil_area":
                self.m_needs_sample_3 = self.number(name) > 0

        def wire(self, scene):
            self.bands = len(getattr(scene.integrator, "bands", ())) or 1
            clocks = [f"{p.name}.{n}" for p in scene.parts for n, q in p.numbers.items() if q.role == "clock"]
            self.clock = clocks[0] if clocks else ""
            forward = np.array(self.columns[2]).ravel()[2]
            if any(p.kind == "gel" for p in scene.parts) and forward > 0:
                self.away = max(float(-np.array(self.columns[3]).ravel()[2] / forward), 0.0)

        def takes(self, name):
            idle = ["detector" if self.mosaic else "site"]  # behind an analyser a pixel meets one polarization
            if self.bands == 1 and self.integral is None:  # of one band a sensitivity is a gain
                idle.append("sensitivity")
            if not self.clock and self.numbers[name].through == "clock":
                return False
            if not self.away and name == "telecentricity":
                return False
            return not any(
                name in effect.parameter_names for stage in idle for effect in self.registry.at_stage(self.kind, stage)
            )

        def traverse(self, cb):
            mi.Sensor.traverse(self, cb)
            self.put_parameters(cb)

        def parameters_changed(self, keys=()):
            self.reread(keys)
            self.m_needs_sample_3 = self.number("pupil_area") > 0

        def field_of(self, width, fx, props):
            """Horizontal field of view, deg, of an image so wide, px, with a focal length in px."""
            return math.degrees(2 * math.atan(width / 2 / fx))

        def focal(self):
            """f_x, f_y in px."""
            fx = self.resolution[0] / 2 / dr.tan(dr.deg2rad(self.x_fov) / 2)
            return fx, fx * self.aspect

        def undistort(self, xd, yd):
            """Undistorted normalised coordinates, by fixed-point iteration (10 steps: below 1e-7 for |k1| r^2 <
            0.1)."""
            x, y = xd, yd
            for _ in range(10):
                r2 = x * x + y * y
                radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
                dx = 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
                dy = self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
                x, y = (xd - dx) / radial, (yd - dy) / radial
            return x, y

        def to_world(self, v):
            return self.columns[0] * v.x + self.columns[1] * v.y + self.columns[2] * v.z

        def turned(self, d):
            """A direction of the camera's frame in the world: roll, then tilt, then pan, then the nominal pose."""
            for angle, (i, j) in ((self.roll, (0, 1)), (self.tilt, (1, 2)), (self.pan, (2, 0))):
                s, c = dr.sincos(dr.deg2rad(angle))
                d = mi.Vector3f(d)
                d[i], d[j] = c * d[i] - s * d[j], s * d[i] + c * d[j]
            return self.to_world(d)

        def ray(self, u, v):
            """Origin and unit direction in the world for a position in pixels."""
            fx, fy = self.focal()
            width, height = self.resolution
            x, y = self.undistort((u - width / 2 - self.principal_x) / fx, (v - height / 2 - self.principal_y) / fy)
            origin = self.columns[3] + self.to_world(mi.Vector3f(self.x, self.y, self.z))
            start = mi.Point3f(origin) + dr.zeros(mi.Point3f, dr.width(u))
            if not self.away:
                return start, self.turned(dr.normalize(mi.Vector3f(x, y, 1)))
            aside, less = self.away * self.telecentricity, 1 - self.telecentricity
            start += self.turned(mi.Vector3f(x * aside, y * aside, 0))
            return start, self.turned(dr.normalize(mi.Vector3f(x * less, y * less, 1)))

        # -- how images are developed: numpy; `own` has the parameters as numbers, complex ones for derivatives -----

        def seen(self, nm):
            """(C, N) sensitivities at wavelengths, behind the filter; of channels that are bands, the filter alone."""
            through = self.curves["filter"](nm) if "filter" in self.curves else np.ones(len(nm))
            return np.array([curve(nm) for curve in self.channels] or [np.ones(len(nm))]) * through

        def middle(self):
            """Where the optical axis meets the image, px."""
            width, height = self.resolution
            return width / 2 + self.number("principal_x"), height / 2 + self.number("principal_y")

        def normalised(self, own, u, v):
            """x, y of pixel positions over the focal length, without distortion, and the focal length in px."""
            width, height = self.resolution
            focal = width / 2 / np.tan(np.deg2rad(np.real(own.x_fov)) / 2)
            x = (u - width / 2 - np.real(own.principal_x)) / focal
            y = (v - height / 2 - np.real(own.principal_y)) / (focal * np.real(own.aspect))
            return x, y, focal

        def astray(self, own, u, v, slant):
            """px in the image by which a ray misses the one through the pupil's middle, per mm between the two on the
            pupil; of what is `slant` mm from the camera (infinite: nothing)."""
            x, y, focal = self.normalised(own, u, v)
            t = np.real(own.telecentricity) if self.away else 0.0
            inverse = np.sqrt(1 + (1 - t) ** 2 * (x**2 + y**2)) / slant  # of the depth along the axis
            scale = focal * math.sqrt(np.real(own.aspect)) / np.maximum(1 - t + t * self.away * inverse, 1e-6)
            return scale * (1 / own.focus - inverse)

        def gains(self, own, channels):
            """(channels,) gain of each channel in the frame."""
            return own.gain * np.array([getattr(own, f"gain_{'rgb'[min(c, 2)]}") for c in range(channels)])

        def respond(self, own, irradiance):
            """m (..., C) of the irradiance per channel, 1 = full scale: the inverse of G_c (S1.1)."""
            terms = [
                [getattr(own, f"response{k}_{'rgb'[min(c, 2)]}") for k in (2, 3)] for c in range(irradiance.shape[-1])
            ]
            m = np.empty(irradiance.shape, np.result_type(irradiance, *(t for pair in terms for t in pair)))
            for c, (a, b) in enumerate(terms):
                m[..., c] = inverse_cubic(irradiance[..., c], a, b)
            return m

        def added(self, own):
            """DN added to every pixel after the response."""
            return own.offset

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            o, d = self.through(sample3, *self.ray(sample2.x * self.resolution[0], sample2.y * self.resolution[1]))
            return mi.Ray3f(o, d, time, wavelengths), mi.Spectrum(weight)

        def through(self, sample, o, d):
            """Origin and direction of a ray through the pupil, of the one through its middle."""
            if not self.m_needs_sample_3:
                return o, d
            axis = self.turned(mi.Vector3f(0, 0, 1))
            return self.focused(
                sample,
                o,
                d,
                self.turned(mi.Vector3f(1, 0, 0)),
                self.turned(mi.Vector3f(0, 1, 0)),
                self.focus / dr.dot(d, axis),
            )

        def focused(self, sample, o, d, side, down, distance):
            """A ray from the pupil, a disc along `side` and `down`, that meets a ray at a distance from its origin."""
            disc = mi.warp.square_to_uniform_disk_concentric(sample) * dr.sqrt(self.pupil_area / dr.pi)
            start = o + disc.x * side + disc.y * down
            return start, dr.normalize(o + distance * d - start)

        def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            differential = mi.RayDifferential3f(ray)
            differential.has_differentials = False
            return differential, weight

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return f"Camera[{self.name}]"

    return Camera


def channel_names(count):
    """Names of the sensitivities of channels among a camera's curves."""
    if count == 3:
        return [f"sensitivity {c}" for c in "RGB"]
    return ["sensitivity"] if count == 1 else [f"sensitivity {c}" for c in range(count)]


def check_field_of_view():
    """The middle of the image looks along z, its edges by half of the field of view to either side; roll turns right to
    down."""
    import mitsuba as mi
    import numpy as np

    film = {"type": "hdrfilm", "width": 80, "height": 60}
    for roll in (0.0, 90.0):
        _, d = made("camera", x_fov=60.0, roll=roll, film=film).ray(mi.Float([0, 40, 80]), mi.Float(30.0))
        x = np.array([-0.5, 0.0, 0.5])
        z = np.sqrt(0.75) * np.array([1, 1 / np.sqrt(0.75), 1])
        agree(np.array(d), [x, 0 * x, z] if roll == 0 else [0 * x, x, z], 0, 1e-6)


part = Part("camera", "sensor", PARAMETERS, build, checks=(check_field_of_view,))
