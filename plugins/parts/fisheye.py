"""Fisheye: a camera whose image grows with the angle from its axis, as wide as a full turn.

Definition
    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)      theta: angle from the axis, rad
    r = f theta_d                                                equidistant; with k1 ... k4 Kannala and Brandt's model
    r = 2 f sin(theta_d/2)                                       equisolid: equal solid angles are equal areas
    r = 2 f tan(theta_d/2)                                       stereographic: circles stay circles
    (u, v) = (c_x + r cos(phi), c_y + aspect r sin(phi))         phi: azimuth from x (right) to y (down)
`law` names the second line; equidistant with k1 ... k4 is what OpenCV calibrates as cv2.fisheye. f comes from the field
of view of the law alone, at k = 0: half the image's width is the radius of x_fov/2. XML may give `fx`, `fy`, `cx`, `cy`
(px) and `distortion`, the four numbers of OpenCV's D, in place of these; OpenCV counts from the middle of the first
pixel, this library from its corner: add 0.5 to its cx and cy. Pose, gains, response and all that happens to the light
behind the lens are those of the part `camera`. Its pupil, as that of a real fisheye nearly, is turned towards whatever
it sees, and `focus` is the distance from it in every direction. Beyond the image circle, and
where a law ends, the image is black.
Fingerprint
    k1 and k2 shift contours with the third and fifth power of the angle; x_fov scales the image.
Validity
    one centre of projection; theta_d must rise with theta as far as the image goes: a polynomial that folds over within
    it is refused.
References
    Kannala & Brandt, IEEE TPAMI 28 (2006) 1335; OpenCV documentation, Fisheye camera model.
XML
    to_world transform, identity: nominal pose
    fx float: focal length in px, in place of `x_fov`
    fy float, fx: focal length in px along y, in place of `aspect`; read where `fx` is given, as are cx and cy
    cx float, half the width: principal point, px, in place of `principal_x`
    cy float, half the height: principal point, px, in place of `principal_y`
    distortion string: k1 k2 k3 k4, in place of the four parameters
    image_circle float, 0.0: radius of the image circle, px, about the principal point; 0: the whole image is lit
    mosaic string: as of the part `camera`
    filter string: as of the part `camera`
    sensitivity string, identity: as of the part `camera`
"""

import math
from pathlib import Path

import numpy as np

from optics.scene import fisheye
from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.registry import declared, known

PINHOLE = ("x_fov", "k1", "k2", "k3", "p1", "p2", "telecentricity")
PARAMETERS = (
    Parameter(
        "law",
        "-",
        "equidistant",
        choices=fisheye.LAWS,
        doc="how the radius in the image grows with the angle",
    ),
    Parameter(
        "x_fov",
        "deg",
        120.0,
        (1.0, 359.0),
        "horizontal field of view of the law at k1 ... k4 = 0",
        plausible=0.5,
        how="difference",
        step=0.8,
        free="crowd",
        prior_sd=0.5,
    ),
    *(
        Parameter(
            f"k{i}",
            "1",
            0.0,
            (-2.0, 2.0),
            f"of theta^{2 * i + 1}",
            neutral=0.0,
            plausible=size,
            how="difference",
            step=0.8,
        )
        for i, size in ((1, 0.02), (2, 0.02), (3, 0.02), (4, 0.02))
    ),
    *(p for p in declared(Path(__file__).with_name("camera.py"))[0].parameters if p.name not in PINHOLE),
)
HALVINGS, NEWTON = 12, 4  # of the angle: pi/2^12, then squared four times: far below float32
STEEP = 89.9  # deg: directions farther out count as this where a tangent is asked for


def build():
    import drjit as dr
    import mitsuba as mi

    class Fisheye(known().parts["camera"].build()):
        kind = "fisheye"

        def __init__(self, props):
            self.image_circle = float(props.get("image_circle", 0.0))
            numbers = str(props.get("distortion", "")).replace(",", " ").split()
            if numbers and len(numbers) != 4:
                raise ValueError(
                    f"fisheye: distortion has {len(numbers)} numbers; allowed: the four of OpenCV's fisheye model, "
                    "k1 k2 k3 k4"
                )
            given = {"fy": props.get("fy", None), "cx": props.get("cx", None), "cy": props.get("cy", None)}
            alone = [name for name, value in given.items() if value is not None]
            if alone and "fx" not in props:
                raise ValueError(
                    f"fisheye: {', '.join(alone)} without fx; allowed: fx beside them, in px, or x_fov in their place"
                )
            for i, number in enumerate(numbers, 1):
                props[f"k{i}"] = float(number)
            super().__init__(props)
            self.folds()

        def field_of(self, width, fx, props):
            law = str(props.get("law", "equidistant"))
            half = float(fisheye.angle(law, width / 2 / fx))
            if not half < math.pi:
                raise ValueError(
                    f"fisheye: fx = {fx:g} px is too short for half an image of {width / 2:g} px: the law '{law}' ends "
                    f"at {fisheye.radius(law, math.pi if law != 'stereographic' else 3.0) * fx:.4g} px; "
                    "allowed: a longer one, or a law that goes farther"
                )
            return math.degrees(2 * half)

        def polynomial(self):
            return [self.number(f"k{i}") for i in (1, 2, 3, 4)]

        def scales(self):
            """f_x, f_y in px as numbers."""
            fx = self.resolution[0] / 2 / float(fisheye.radius(self.law, math.radians(self.number("x_fov")) / 2))
            return fx, fx * self.number("aspect")

        def folds(self):
            """Refuse a polynomial that folds over within the image."""
            end = fisheye.fold(self.polynomial())
            if not math.isfinite(end):
                return
            fx, fy = self.scales()
            reach = (
                self.image_circle / fx
                if self.image_circle > 0
                else max(
                    math.hypot((u - self.middle()[0]) / fx, (v - self.middle()[1]) / fy)
                    for u in (0, self.resolution[0])
                    for v in (0, self.resolution[1])
                )
            )
            top = fisheye.bent(end, self.polynomial())
            if top < fisheye.angle(self.law, reach):
                k = " ".join(f"{value:g}" for value in self.polynomial())
                raise ValueError(
                    f"fisheye '{self.name}': with k1 ... k4 = {k} the lens folds over at {math.degrees(end):.4g} deg, "
                    f"{fisheye.radius(self.law, top) * fx:.4g} px from the principal point, and the image reaches "
                    f"{reach * fx:.4g} px; allowed: k that rise as far as the image, or an image_circle within the fold"
                )

        def focal(self):
            half = dr.deg2rad(self.x_fov) / 2
            if self.law == "equisolid":
                half = 2 * dr.sin(half / 2)
            elif self.law == "stereographic":
                half = 2 * dr.tan(half / 2)
            fx = self.resolution[0] / 2 / half
            return fx, fx * self.aspect

        def undistort(self, xd, yd):
            """x/z and y/z of the ray through normalised coordinates (x_d, y_d), for rays in front of the camera."""
            d, _ = self.looking(xd, yd)
            return d.x / d.z, d.y / d.z

        def looking(self, xd, yd):
            """Unit direction in the camera's frame of a place (x_d, y_d) in focal lengths; whether the lens has it."""
            square = xd * xd + yd * yd
            r = dr.sqrt(dr.maximum(square, 1e-12))
            seen = mi.Bool(True)
            if self.law == "equisolid":
                seen = r < 2
                theta_d = 2 * dr.asin(dr.minimum(r / 2, 1 - 1e-6))
            else:
                theta_d = 2 * dr.atan(r / 2) if self.law == "stereographic" else r
            k = (self.k1, self.k2, self.k3, self.k4)
            end = min(fisheye.fold(self.polynomial()), math.pi)
            low, high = mi.Float(0.0), mi.Float(end)
            seen &= theta_d <= fisheye.bent(mi.Float(end), k)
            with dr.suspend_grad():
                for _ in range(HALVINGS):
                    middle = (low + high) / 2
                    below = fisheye.bent(middle, k) < theta_d
                    low, high = dr.select(below, middle, low), dr.select(below, high, middle)
                theta = (low + high) / 2
                for _ in range(NEWTON - 1):
                    theta = theta - (fisheye.bent(theta, k) - theta_d) / dr.maximum(fisheye.slope(theta, k), 1e-6)
                theta = dr.clip(theta, 0, end)
            # the last step carries the derivatives: by the place and by k, at the solution
            theta = theta - (fisheye.bent(theta, k) - theta_d) / dr.maximum(fisheye.slope(theta, k), 1e-6)
            if self.image_circle > 0:
                seen &= r < self.image_circle / self.scales()[0]
            s, c = dr.sincos(theta)
            return mi.Vector3f(s * xd / r, s * yd / r, c), seen

        def ray(self, u, v):
            o, d, seen = self.ray_seen(u, v)
            # what the lens does not have starts behind the world and leaves it
            away = mi.Vector3f(self.to_world(mi.Vector3f(0, 0, -1)))
            return dr.select(seen, o, o + 1e7 * away), dr.select(seen, d, away)

        def ray_seen(self, u, v):
            self.folds()
            fx, fy = self.focal()
            width, height = self.resolution
            local, seen = self.looking(
                (u - width / 2 - self.principal_x) / fx, (v - height / 2 - self.principal_y) / fy
            )
            origin = self.columns[3] + self.to_world(mi.Vector3f(self.x, self.y, self.z))
            return mi.Point3f(origin) + dr.zeros(mi.Point3f, dr.width(u)), self.turned(local), seen

        def through(self, sample, o, d):
            if not self.m_needs_sample_3:
                return o, d
            side, down = mi.coordinate_system(d)
            return self.focused(sample, o, d, side, down, self.focus)

        def project(self, points):
            """(N, 2) u, v in px of points (N, 3) in the world, mm; NaN where the lens has them not; numpy."""
            axes = [np.array(self.turned(mi.Vector3f(*axis)), float).ravel() for axis in np.eye(3).tolist()]
            origin = self.columns[3] + self.to_world(mi.Vector3f(self.x, self.y, self.z))
            local = (np.asarray(points, float) - np.array(origin, float).ravel()) @ np.array(axes).T
            return fisheye.project(local, self.law, self.polynomial(), self.scales(), self.middle())

        def normalised(self, own, u, v):
            """tan(theta) cos(phi), tan(theta) sin(phi) of pixel positions, and the focal length in px."""
            width, height = self.resolution
            half = np.deg2rad(np.real(own.x_fov)) / 2
            focal = width / 2 / float(fisheye.radius(self.law, half))
            x = (u - width / 2 - np.real(own.principal_x)) / focal + 0 * np.asarray(v)
            y = (v - height / 2 - np.real(own.principal_y)) / (focal * np.real(own.aspect)) + 0 * np.asarray(u)
            r = np.maximum(np.hypot(x, y), 1e-12)
            k = [float(np.real(getattr(own, f"k{i}"))) for i in (1, 2, 3, 4)]
            table = np.linspace(0, min(fisheye.fold(k), math.pi), 20001)
            theta = np.minimum(
                np.interp(fisheye.angle(self.law, r), fisheye.bent(table, k), table), math.radians(STEEP)
            )
            return x / r * np.tan(theta), y / r * np.tan(theta), focal

        def astray(self, own, u, v, slant):
            """px in the image by which a ray misses the one through the pupil's middle, per mm between the two on the
            pupil, the geometric mean along the radius and across it; of what is `slant` mm away."""
            x, y, focal = self.normalised(own, u, v)
            theta = np.arctan(np.hypot(x, y))
            k = [float(np.real(getattr(own, f"k{i}"))) for i in (1, 2, 3, 4)]
            bent, slope = fisheye.bent(theta, k), fisheye.slope(theta, k)
            across = np.divide(fisheye.radius(self.law, bent), np.sin(theta), out=np.ones_like(theta), where=theta > 0)
            along = fisheye.growth(self.law, bent) * slope
            return focal * np.sqrt(np.real(own.aspect) * across * along) * (1 / own.focus - 1 / slant)

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            o, d, seen = self.ray_seen(sample2.x * self.resolution[0], sample2.y * self.resolution[1])
            o, d = self.through(sample3, o, d)
            return mi.Ray3f(o, d, time, wavelengths), mi.Spectrum(dr.select(seen, weight, 0.0))

        def to_string(self):
            return f"Fisheye[{self.name}, {self.law}]"

    return Fisheye


def check_laws():
    """At 60 deg from the axis the three laws have the radii pi/3, 1 and 2 tan(30 deg), in focal lengths; the rays
    through these places look there."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 400, "height": 400}
    for law, r in (("equidistant", math.pi / 3), ("equisolid", 1.0), ("stereographic", 2 * math.tan(math.pi / 6))):
        camera = made("fisheye", law=law, film=film, fx=150.0, cx=200.0, cy=200.0)
        _, d = camera.ray(mi.Float([200 + 150 * r, 200.0]), mi.Float([200.0, 200 - 150 * r]))
        # float32 of 360 px: 1e-7 of the angle
        agree(np.array(d), [[math.sqrt(0.75), 0.0], [0.0, -math.sqrt(0.75)], [0.5, 0.5]], 0, 2e-6)


def check_kannala_brandt():
    """The ray through 200 + 150 theta_d px looks along theta, for theta_d by the polynomial."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 400, "height": 400}
    k = (0.05, -0.02, 0.004, -0.0005)
    camera = made("fisheye", film=film, fx=150.0, fy=150.0, cx=200.0, cy=200.0, distortion="0.05 -0.02 0.004 -0.0005")
    theta = np.array([0.01, 0.4, 0.9, 1.2])
    _, d = camera.ray(mi.Float((200 + 150 * fisheye.bent(theta, k)).astype("f")), mi.Float(np.full(4, 200.0, "f")))
    agree(np.array(d)[[0, 2]], [np.sin(theta), np.cos(theta)], 0, 2e-6)


def random(rng):
    """A lens of 100 to 170 deg, a few per cent from its law."""
    return {"x_fov": rng.uniform(100, 170), **{f"k{i}": rng.uniform(-0.02, 0.02) for i in (1, 2)}}


part = Part(
    "fisheye",
    "sensor",
    PARAMETERS,
    build,
    checks=(check_laws, check_kannala_brandt),
    role="camera",
    random=random,
)
