"""Polarimetry: what the layers on a ray do to polarization, in the words of a laboratory, and how it looks.

`stack` gives the Mueller matrices of what a camera ray passes, `decompose` the transmittances, diattenuation,
retardance and depolarization of a matrix, `sweep` a reading against any parameter, `write_maps` images of degree and
angle of polarization.

Axes: x right and y up in the image, for light that travels towards the camera; angles count from x to y, deg. A product
M1 M2 M3 names the layers from the camera on: the light meets the last one first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from optics.captures.capture_set import Captures, check
from optics.captures.noise import Noise
from optics.errors import BadCapture, BadScene, UnknownKey
from optics.files import exr
from optics.files.output import replacing
from optics.light import paths
from optics.light.development import Developer
from optics.light.renderer import Renderer
from optics.polarization import mueller
from optics.polarization.mueller import Mueller
from optics.scene.loader import Scene


# -- what a ray passes ------------------------------------------------------------------------------------------------
def pixel(scene: Scene, text: str | None) -> tuple[float, float]:
    """Position (u, v) in px of "U,V", u to the right and v down, centre of the first pixel at 0.5; the image's centre
    for None."""
    if scene.camera is None or scene.integrator is None:
        raise BadScene(
            f"{scene.path}: no camera ray to follow; a scene needs a part of the type 'camera' and the integrator "
            "'tactile'"
        )
    width, height = scene.camera.resolution
    if text is None:
        return width / 2, height / 2
    allowed = f"allowed: U,V in px within the image, 0,0 (top left) to {width},{height}"
    try:
        u, v = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--at {text}: no pair of numbers; {allowed}") from None
    if not (0 <= u <= width and 0 <= v <= height):
        raise ValueError(f"--at {text}: outside the image; {allowed}")
    return u, v


@dataclass
class Ray:
    """A camera ray: the layers and clear boundaries that it passes, from the camera on, and the shape that it ends
    on."""

    path: paths.Path
    names: list[str]
    steps: list[paths.Step]
    end: str  # "" where it meets nothing
    lost: bool  # reflected totally on its way


def follow(scene: Scene, values: Mapping, u: float, v: float) -> Ray:
    """The ray through a pixel position, for values that are set in the scene."""
    scene.set(values)
    path = paths.trace(scene, np.array([u]), np.array([v]))
    steps = [step for step in path.steps if step.part[0] >= 0]
    shapes = scene.mitsuba.shapes()
    end = shapes[path.shape[0]].id() if path.shape[0] >= 0 else ""
    return Ray(path, [path.names[step.part[0]] for step in steps], steps, end, bool(path.lost[0]))


def stack(
    scene: Scene,
    values: Mapping,
    u: float,
    v: float,
    wavelengths: Sequence[float],
    parts: Sequence[str] | None = None,
    ray: Ray | None = None,
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of what the ray through (u, v) passes, from the camera on, the matrix of each (L, B, 4, 4), and the whole
    (B, 4, 4).

    parts   only these of them;   ray   as `follow` found it
    A layer's own matrix holds the reflections between its own faces; the whole adds those between layers.
    """
    ray = ray or follow(scene, values, u, v)
    bands = np.asarray(wavelengths, float)
    for name in parts or ():
        if name not in ray.names:
            passed = ", ".join(ray.names) or "none"
            raise UnknownKey(name, ray.names, "layer", "", f"the ray through {u:g},{v:g} passes {passed}")
    met = [(n, step) for n, step in zip(ray.names, ray.steps) if not parts or n in parts]
    chosen = [
        (n, paths.layer_matrix(scene, n, paths.crossing_at(step, [0], bands), values, ray.path.fields))
        for n, step in met
    ]
    names = [n for n, _ in chosen]

    def numbers(matrix: Mueller) -> np.ndarray:
        return np.broadcast_to(matrix.numpy(), (1, len(bands), 4, 4))[0]

    slabs = [(m, paths.reflected(scene, n, values)) for n, m in chosen]
    own = [numbers(paths.slab(m, share).t) for m, share in slabs]
    return names, np.array(own).reshape(-1, len(bands), 4, 4), numbers(_combined(slabs))


def _combined(layers: Sequence[tuple[Mueller, float]]) -> Mueller:
    """The product of matrices, from the camera on; where faces reflect a share, with the light that goes to and fro
    between them."""
    if not layers:
        return mueller.identity()
    if any(share != 0 for _, share in layers):
        whole = paths.slab(*layers[-1])
        for matrix, share in layers[-2::-1]:
            whole = paths.slab(matrix, share).after(whole)
        return whole.t
    whole = layers[0][0]
    for matrix, _ in layers[1:]:
        whole = whole @ matrix
    return whole


# -- what a matrix says ----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Decomposition:
    """A Mueller matrix M = m00 M_depolarizer M_retarder M_diattenuator in numbers; NaN for what has no meaning.

    transmittance                of unpolarized light, m00
    largest, smallest            transmittance over all states of polarization, m00 (1 +- D)
    diattenuation, axis, axis_ellipticity      D = 0 ... 1 (a polarizer) and the state that passes best; deg, +-45 is
                                               circular
    polarizance, polarizance_axis              degree and angle of polarization of unpolarized light behind it
    retardance, fast_axis, fast_ellipticity    deg: 0 ... 180, the state that runs ahead; of a half wave fast and slow
                                               are one. No retardance for D = 1: no second polarization is left to be
                                               late
    depolarization               power of depolarization 1 - |tr(m)|/3 of the depolarizer: 0 none, 1 all
    depolarization_index         sqrt((sum m_ij^2 - m00^2)/(3 m00^2)): 1 none, 0 all (Gil & Bernabeu)
    realisable                   `mueller.physical`: < 0 where no layer can do this
    depolarizer, retarder, diattenuator        the factors (4, 4), each with m00 = 1
    """

    transmittance: float
    largest: float
    smallest: float
    diattenuation: float
    axis: float
    axis_ellipticity: float
    polarizance: float
    polarizance_axis: float
    retardance: float
    fast_axis: float
    fast_ellipticity: float
    depolarization: float
    depolarization_index: float
    realisable: float
    depolarizer: np.ndarray = field(repr=False)
    retarder: np.ndarray = field(repr=False)
    diattenuator: np.ndarray = field(repr=False)

    def numbers(self) -> dict[str, float]:
        """Everything but the factors, by name."""
        return {name: value for name, value in vars(self).items() if not isinstance(value, np.ndarray)}


SINGULAR = 1e-9  # of 1 - D: beyond it a second polarization is lost in rounding


def decompose(matrix: np.ndarray) -> Decomposition:
    """Polar decomposition of M (4, 4); Lu & Chipman, J. Opt. Soc. Am. A 13, 1106 (1996), sec. 6.

    Of a perfect polarizer (D = 1) the retarder is the one that turns least (ibid., sec. 4), and so wherever
    depolarization leaves one axis only."""
    m = np.asarray(matrix, float)
    if m.shape != (4, 4) or not np.isfinite(m).all():
        what = f"of shape {m.shape}" if m.shape != (4, 4) else "that is not finite"
        raise ValueError(f"a matrix {what}; allowed: (4, 4), finite")
    t = m[0, 0]
    if t <= 0:
        nan, factor = float("nan"), np.full((4, 4), np.nan)
        return Decomposition(0.0, 0.0, 0.0, *(nan,) * 11, factor, factor, factor)
    m = m / t
    d, p = m[0, 1:], m[1:, 0]
    dichroism = min(float(np.linalg.norm(d)), 1.0)
    first = _diattenuator(d)
    small = np.zeros((3, 3))
    if 1 - dichroism > SINGULAR:
        left = np.linalg.solve(first.T, m.T).T  # M M_D^-1
        out, sizes, back = np.linalg.svd(left[1:, 1:])
        if sizes[1] > 1e-9:
            if sizes[2] <= 1e-9:  # the third axis is gone: it turns along
                out = out * [1, 1, np.sign(np.linalg.det(out @ back))]
            sign = np.sign(np.linalg.det(out @ back))
            turn = sign * out @ back
            small = sign * (out * sizes) @ out.T
        else:
            turn = _turn(back[0], out[:, 0])
            small = sizes[0] * np.outer(out[:, 0], out[:, 0])
        polarizance = left[1:, 0]
    else:
        strength = min(float(np.linalg.norm(p)), 1.0)
        turn = _turn(d, p) if strength > 1e-12 else np.eye(3)
        small = strength * np.eye(3)
        polarizance = np.zeros(3)
    delay, fast = _rotation(turn) if 1 - dichroism > SINGULAR else (float("nan"), None)
    depolarizer, retarder = np.eye(4), np.eye(4)
    depolarizer[1:, 0], depolarizer[1:, 1:], retarder[1:, 1:] = polarizance, small, turn
    return Decomposition(
        float(t),
        float(t * (1 + dichroism)),
        float(t * (1 - dichroism)),
        dichroism,
        *_state(d),
        float(np.linalg.norm(p)),
        _state(p)[0],
        delay,
        *_state(fast),
        float(1 - abs(np.trace(small)) / 3),
        float(np.sqrt(max((m**2).sum() - 1, 0) / 3)),
        float(mueller.physical(m)),
        depolarizer,
        retarder,
        first,
    )


def _diattenuator(d: np.ndarray) -> np.ndarray:
    """The symmetric matrix of a diattenuation vector, m00 = 1."""
    square = float(d @ d)
    if square > 1:
        d, square = d / np.sqrt(square), 1.0
    root = np.sqrt(1 - square)
    matrix = np.eye(4)
    matrix[0, 1:] = matrix[1:, 0] = d
    matrix[1:, 1:] = root * np.eye(3) + np.outer(d, d) / (1 + root)
    return matrix


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The least rotation of the Poincare sphere that takes the direction a to b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    c = float(a @ b)
    if c < -1 + 1e-12:  # half a turn about any axis across a
        across = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    k = np.cross(a, b)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + c)


def _rotation(turn: np.ndarray) -> tuple[float, np.ndarray | None]:
    """Retardance (deg) of a rotation of the Poincare sphere, and the vector of its fast axis; None without
    retardance."""
    odd = np.array([turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2], turn[0, 1] - turn[1, 0]]) / 2
    sine, cosine = float(np.linalg.norm(odd)), (float(np.trace(turn)) - 1) / 2
    angle = float(np.degrees(np.arctan2(sine, cosine)))
    if angle < 1e-6:
        return 0.0, None
    if sine > 1e-6:
        return angle, odd / sine
    even = (turn + turn.T + 2 * np.eye(3)) / 4  # a a^T of a half wave
    index = int(np.argmax(np.diag(even)))
    return angle, even[index] / np.sqrt(even[index, index])


def _state(vector: np.ndarray | None) -> tuple[float, float]:
    """Angle in [0, 180) and ellipticity in [-45, 45] of a polarization (S1, S2, S3), deg; NaN for none, no angle of a
    circle."""
    length = 0.0 if vector is None else float(np.linalg.norm(vector))
    if length < 1e-9:
        return float("nan"), float("nan")
    linear = float(np.hypot(vector[0], vector[1]))
    angle = float(np.degrees(np.arctan2(vector[1], vector[0]))) / 2 % 180
    angle = 0.0 if 180 - angle < 1e-9 else angle
    return angle if linear > 1e-9 * length else float("nan"), float(np.degrees(np.arctan2(vector[2], linear))) / 2


# -- images ----------------------------------------------------------------------------------------------------------
GREY = 0.55  # of maps where nothing is said
DARK, BRIGHT = 2e-3, 1e-2  # of the brightest: nothing is said of pixels below the first, all of those above the second


def wheel(angle: np.ndarray) -> np.ndarray:
    """(..., 3) sRGB colours of angles of polarization (deg): a circle of one lightness, closed after 180 deg; 0 is red,
    45 olive, 90 turquoise, 135 violet.

    Hue in OKLCh at lightness 0.75, chroma 0.12 (Ottosson, 2020).
    """
    hue = np.radians(2 * np.asarray(angle, float) + 20)
    a, b = 0.12 * np.cos(hue), 0.12 * np.sin(hue)
    lms = (
        np.stack(
            [
                0.75 + 0.3963377774 * a + 0.2158037573 * b,
                0.75 - 0.1055613458 * a - 0.0638541728 * b,
                0.75 - 0.0894841775 * a - 1.2914855480 * b,
            ],
            -1,
        )
        ** 3
    )
    return exr.srgb(
        lms
        @ np.array(
            [
                [4.0767416621, -3.3077115913, 0.2309699292],
                [-1.2684380046, 2.6097574011, -0.3413193965],
                [-0.0041960863, -0.7034186147, 1.7076147010],
            ]
        ).T
    )


def map_colours(stokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """sRGB (H, W, B, 3) of the degree (viridis, 0 to 1) and of the angle (`wheel`) of linear polarization; stokes (H,
    W, B, 4).

    GREY where a band is dark, and fading into it from BRIGHT to DARK; angles also below a degree of 5 %, where they
    mean little. What is polarized and what is not then lies on one ground: black would look like holes in it.
    """
    from matplotlib import colormaps

    level = stokes[..., 0] / np.maximum(stokes[..., 0].max((0, 1), keepdims=True), 1e-300)
    seen = np.clip((level - DARK) / (BRIGHT - DARK), 0, 1)[..., None]
    degree = np.where(seen[..., 0] > 0, np.nan_to_num(mueller.degree_of_polarization(stokes)), 0.0)
    angle = wheel(mueller.angle_of_polarization(stokes))
    certain = np.clip(degree / 0.05, 0, 1)[..., None] * seen
    degrees = colormaps["viridis"](degree)[..., :3]
    return GREY + (degrees - GREY) * seen, GREY + (angle - GREY) * certain


def write_maps(files: tuple[Path, Path], bands: Sequence[float], stokes: np.ndarray) -> None:
    """Write degree and angle of linear polarization of (H, W, B, 4) as two PNG, a panel per band, each with its colour
    bar."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure

    height, width, count, _ = stokes.shape
    columns = count if count <= 3 else int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    circle = ListedColormap(wheel(np.linspace(0, 180, 256)))
    legends = (
        ("degree of linear polarization (grey: dark)", "viridis", 1, np.linspace(0, 1, 6)),
        (
            "angle of linear polarization, deg: 0 right, 90 up\n(grey: dark or unpolarized)",
            circle,
            180,
            np.arange(0, 181, 45),
        ),
    )
    for file, images, (label, colours, top, ticks) in zip(files, map_colours(stokes), legends):
        size = 4.2 * columns + 1.2, max((4.2 * height / width + 0.35) * rows, 3.6)  # inches
        figure = Figure(figsize=size, layout="constrained", dpi=110)
        axes = figure.subplots(rows, columns, squeeze=False)
        for index, ax in enumerate(axes.ravel()):
            ax.set_axis_off()
            if index < count:
                ax.imshow(images[:, :, index], interpolation="nearest")
                ax.set_title(f"{bands[index]:g} nm", fontsize=10)
        bar = figure.colorbar(ScalarMappable(Normalize(0, top), colours), ax=axes, ticks=ticks, shrink=0.9)
        bar.set_label(label, fontsize=9)
        save(figure, file)


def save(figure, file: Path) -> None:
    with replacing(Path(file)) as temporary:
        figure.savefig(temporary, metadata={"Software": None} if Path(file).suffix == ".png" else None)


# -- a reading against a parameter -----------------------------------------------------------------------------------
BESIDE = 2  # pixels about a spot, each way


class Spot(Renderer):
    """One pixel of a scene's image, by its own light: the pixels about it, two each way, say whether it lies at a rim
    and how its mean differs from its middle."""

    def __init__(self, scene: Scene, column: int, row: int, whole: bool = False):
        super().__init__(scene, remember=4)
        self.whole, full = whole, (self.width, self.height)
        self.corner = (0, 0) if whole else (max(column - BESIDE, 0), max(row - BESIDE, 0))
        self.at = (row - self.corner[1], column - self.corner[0])
        if not whole:
            self.width, self.height = (
                min(place + BESIDE + 1, size) - start for place, size, start in zip((column, row), full, self.corner)
            )

    def _trace(self, u: np.ndarray, v: np.ndarray, lens: np.ndarray | None = None):
        return super()._trace(u + self.corner[0], v + self.corner[1], lens)


@dataclass
class Curve:
    """Readings (N, C) against a parameter (N,); what else captures set, their own readings (M, C), and what these
    should be."""

    x: np.ndarray
    y: np.ndarray
    settings: dict[str, float | str] = field(default_factory=dict)
    measured_x: np.ndarray | None = None
    measured: np.ndarray | None = None
    predicted: np.ndarray | None = None


@dataclass
class Sweep:
    """What a pixel reads against a parameter; `black`: the reading without light; `turns`: the parameter turns a
    layer."""

    key: str
    unit: str
    quantity: str
    channels: list[str]
    colours: list
    curves: list[Curve]
    black: float
    turns: bool
    title: str
    notes: list[str]

    def ideal(self, curve: Curve, x: np.ndarray | None = None) -> np.ndarray | None:
        """Malus' cos^2 (N, C) at the curve's values or at others: of the same maximum, about the angle of the readings'
        own second harmonic. None where nothing turns, or by less than 90 deg."""
        if not self.turns or len(curve.x) < 4 or np.ptp(curve.x) < 90:
            return None
        turn = np.radians(2 * curve.x)
        signal = curve.y - self.black
        _, c, s = np.linalg.lstsq(np.stack([np.ones_like(turn), np.cos(turn), np.sin(turn)], -1), signal, rcond=None)[0]
        return (
            self.black
            + signal.max(0) * np.cos(np.radians(curve.x if x is None else x)[:, None] - np.arctan2(s, c) / 2) ** 2
        )

    def apart(self, curve: Curve) -> dict[str, float | str]:
        """The settings of a curve in which the curves differ."""
        return {k: v for k, v in curve.settings.items() if any(c.settings.get(k) != v for c in self.curves)}

    def summary(self) -> list[dict]:
        """Per curve and channel: largest and smallest reading and where, their ratio and contrast above black, the
        departure from cos^2 (rms, of the maximum), and of measured readings from the predicted ones (rms)."""
        rows = []
        for curve in self.curves:
            ideal = self.ideal(curve)
            for c, name in enumerate(self.channels):
                y = curve.y[:, c] - self.black
                top, low = float(y.max()), float(y.min())
                low = 0.0 if abs(low) < 1e-12 * top else low  # rounding of an exact zero
                off = None if ideal is None or top <= 0 else float(np.sqrt(np.mean((curve.y - ideal)[:, c] ** 2)) / top)
                rows.append(
                    {
                        **({"settings": self.apart(curve)} if len(self.curves) > 1 else {}),
                        "channel": name,
                        "largest": float(curve.y[:, c].max()),
                        "at": float(curve.x[y.argmax()]),
                        "smallest": float(curve.y[:, c].min()),
                        "dark_at": float(curve.x[y.argmin()]),
                        "extinction_ratio": top / low if low > 0 else float("inf") if top > 0 else float("nan"),
                        "contrast": (top - low) / (top + low) if top + low > 0 else float("nan"),
                        "from_ideal": off,
                        "from_measured": None
                        if curve.measured is None
                        else float(np.sqrt(np.mean((curve.measured - curve.predicted)[:, c] ** 2))),
                    }
                )
        return rows

    def to_csv(self) -> str:
        """One row per value and curve: the settings, the parameter, the channels."""
        import csv
        import io

        out, keys = io.StringIO(), list(self.curves[0].settings)
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([*keys, self.key, *self.channels])
        for curve in self.curves:
            writer.writerows(
                [*curve.settings.values(), f"{x:.10g}", *(f"{v:.10g}" for v in y)] for x, y in zip(curve.x, curve.y)
            )
        return out.getvalue()

    def plot(self, file: Path) -> None:
        """Write the curves as an image, below once more with a logarithmic axis, which shows the dark end."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(max(6.4, 3.6 * len(self.curves)), 6.4), layout="constrained", dpi=110)
        figure.suptitle(self.title, fontsize=10)
        axes = figure.subplots(2, len(self.curves), squeeze=False, sharex=True, sharey="row", height_ratios=(3, 2))
        for curve, column in zip(self.curves, axes.T):
            fine = np.linspace(curve.x.min(), curve.x.max(), 721)
            ideal = self.ideal(curve, fine)
            for ax, black in zip(column, (0.0, self.black)):
                for c, (name, colour) in enumerate(zip(self.channels, self.colours)):
                    ax.plot(curve.x, curve.y[:, c] - black, color=colour, label=name, lw=1.6)
                    if ideal is not None:
                        ax.plot(fine, ideal[:, c] - black, color=colour, lw=1, ls=":", label="_")
                    if curve.measured is not None:
                        ax.plot(
                            curve.measured_x,
                            curve.measured[:, c] - black,
                            ".",
                            color=colour,
                            ms=5,
                            alpha=0.7,
                            label="_",
                        )
                ax.grid(alpha=0.3)
            column[0].set_title(
                "\n".join(
                    f"{k} = {v:g}" if not isinstance(v, str) else f"{k} = {v}" for k, v in self.apart(curve).items()
                ),
                fontsize=9,
            )
            column[0].set_ylim(bottom=min(0.0, float(curve.y.min())))
            column[1].set_yscale("log")
            column[1].set_xlabel(f"{self.key} ({self.unit})")
            if self.turns:
                column[1].xaxis.set_major_locator(_of_degrees(np.ptp(curve.x), 12 if len(self.curves) == 1 else 6))
        axes[0, 0].set_ylabel(self.quantity)
        axes[1, 0].set_ylabel(self.quantity + (" above black" if self.black else ""))
        floor = min(float((c.y - self.black)[c.y > self.black].min(initial=np.inf)) for c in self.curves)
        top = max(float((c.y - self.black).max()) for c in self.curves)
        if np.isfinite(floor) and top > 0:  # a curve that is exactly dark ends the axis four decades down
            axes[1, 0].set_ylim(max(floor, 1e-4 * top) / 2, 2 * top)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        from matplotlib.lines import Line2D

        if any(self.ideal(c) is not None for c in self.curves):
            handles, labels = (
                [*handles, Line2D([], [], color="0.4", lw=1, ls=":")],
                [*labels, "cos\u00b2, same maximum"],
            )
        if any(c.measured is not None for c in self.curves):
            handles, labels = [*handles, Line2D([], [], color="0.4", marker=".", ls="")], [*labels, "measured"]
        axes[0, 0].legend(handles, labels, fontsize=9)
        save(figure, file)


def _of_degrees(span: float, most: int):
    """Ticks at parts of a turn, up to `most` over a span in deg; matplotlib's own of a small or a very long one."""
    from matplotlib.ticker import AutoLocator, MultipleLocator

    step = next((step for step in (15, 30, 45, 90, 180, 360) if span / step <= most), None)
    return MultipleLocator(step) if step is not None and span >= 45 else AutoLocator()


def span(scene: Scene, key: str, first: float | None, last: float | None) -> tuple[float, float]:
    """The ends of a sweep: as given; of an angle 0 and 180 deg unless given."""
    parameter = _number(scene, key)
    if parameter.unit == "deg":
        first, last = 0.0 if first is None else first, 180.0 if last is None else last
    if first is None or last is None:
        low, high = parameter.bounds
        missing = "--from" if first is None else "--to"
        raise ValueError(f"{key}: {missing} is missing; allowed: {low:g} to {high:g} {parameter.unit}")
    if first == last:
        raise ValueError(f"{key}: --from and --to are both {first:g} {parameter.unit}; allowed: two values")
    return first, last


def _number(scene: Scene, key: str):
    if key not in scene.parameters:
        raise UnknownKey(key, scene.parameters, "parameter", "", "`optics params SCENE` lists them")
    parameter = scene.parameters[key]
    if not parameter.is_number:
        raise ValueError(f"{key} is a word ({', '.join(parameter.choices)}); allowed: a parameter that is a number")
    return parameter


CURVES = 6  # settings of captures that are told apart


def sweep(
    scene: Scene,
    key: str,
    x: Sequence[float],
    at: tuple[float, float],
    values: Mapping | None = None,
    *,
    radiance: bool = False,
    captures: Captures | None = None,
    noise: Noise | None = None,
    only: Mapping = MappingProxyType({}),
    progress: Callable[[str, int, int], None] | None = None,
) -> Sweep:
    """What the pixel that holds the position `at` reads as a parameter takes the values x.

    values     replace the scene's
    radiance   per band; without it DN per channel, by black level and saturation of the captures, or else of `noise`
               (0 and 255 without either)
    captures   readings to hold beside it, of a table or of the pixel: a curve for each combination of their other
               settings
    only       of the captures those with these settings; of a light's power, which captures set as a drive level, it is
               the unit
    """
    parameter = _number(scene, key)
    x = np.array([parameter.check(float(v), key) for v in x])
    width, height = scene.camera.resolution
    column, row = (min(int(p), size - 1) for p, size in zip(at, (width, height)))
    base = {**scene.values(), **scene.check(values or {})}
    noise = captures.noise if captures is not None else noise
    black, top = (noise.black_level, noise.saturation) if noise is not None else (0.0, 255.0)
    bands = scene.integrator.bands or (540.0,)
    developer = Developer(scene.camera, bands, black, top)
    groups, notes = [({}, [], None)], []
    if captures is not None:
        groups, notes = _groups(captures, scene, key, base, values or {}, only, row, column)
    whole = developer.site is not None or _needs_all_pixels(
        scene, developer, base, {k for settings, *_ in groups for k in settings} | {key}
    )
    spot = Spot(scene, column, row, whole)
    if whole:
        developer.distances = spot.distances
    total, done = sum(len(x) + len(own) for _, own, _ in groups), 0
    drives = set(scene.powers.values()) if captures is not None else set()

    def read(settings: Sequence[Mapping]) -> np.ndarray:
        nonlocal done
        rows = []
        for own in settings:
            now = {**base, **{k: v * base[k] if k in drives else v for k, v in own.items()}}
            rows.append(_reading(spot, now, None if radiance else developer))
            done += 1
            if progress is not None:
                progress("readings", done, total)
        return np.array(rows)

    channels = len(bands) if radiance else len(developer.matrix)
    curves = []
    for settings, own, measured in groups:
        if measured is not None and measured.shape[1] != channels:
            raise BadCapture(
                f"{captures.folder}: readings of {measured.shape[1]} channels, the scene's camera has {channels}; "
                "load the scene with other bands (-D bands=...)"
            )
        curve = Curve(x, read([{**settings, key: float(v)} for v in x]), settings)
        if measured is not None:
            curve.measured_x, curve.measured, curve.predicted = np.array([s[key] for s in own]), measured, read(own)
        curves.append(curve)
    scene.set(base)
    names = [f"{b:g} nm" for b in bands] if radiance else ["reading"] if channels == 1 else ["R", "G", "B"]
    quantity = "radiance (W mm$^{-2}$ sr$^{-1}$)" if radiance else "DN"
    turns = parameter.unit == "deg" and parameter.how == "layer"
    return Sweep(
        key,
        parameter.unit,
        quantity,
        names,
        _colours(bands, channels, radiance),
        curves,
        0.0 if radiance else black,
        turns,
        f"{scene.path.stem}, pixel {column}, {row}",
        notes,
    )


def _needs_all_pixels(scene: Scene, developer: Developer, base: Mapping, turned: set[str]) -> bool:
    """Whether an effect of the camera, which may mix pixels, is turned or off neutral: then one pixel takes the whole
    image."""
    camera = {
        f"{developer.name}.{n}" for effects in developer.effects.values() for e in effects for n in e.parameter_names
    }
    return bool(camera & turned) or any(base[k] != scene.parameters[k].neutral for k in camera)


def _reading(spot: Spot, now: Mapping, developer: Developer | None) -> np.ndarray:
    """(C,) what the spot's pixel reads in DN, or without a developer its radiance per band."""
    if developer is not None and developer.site is not None:
        return developer.develop(np.stack([spot.radiance(now, component=j) for j in range(3)]), now)[spot.at]
    image = spot.radiance(now)
    if developer is None:
        return image[spot.at]
    if spot.whole:
        return developer.develop(image, now)[spot.at]
    return developer.develop(image[spot.at][None, None], now)[0, 0]


def _colours(bands: Sequence[float], channels: int, radiance: bool) -> list:
    if channels == 1:
        return ["#1f5fa8"]
    if not radiance:
        return ["#c8321e", "#2d8a34", "#2456c4"]
    rgb = exr.preview_channels(bands, np.eye(len(bands))[None])  # each band alone
    colours = np.stack([rgb[c][0] for c in "RGB"], -1)
    colours = colours / np.maximum(colours.max(-1, keepdims=True), 1e-9)
    colours = 0.5 * colours / np.maximum(colours @ [0.6, 1.0, 0.5], 0.5)[:, None]  # green as dark as red: all on white
    return [tuple(c) for c in exr.srgb(colours + 0.02)]


def _groups(
    captures: Captures, scene: Scene, key: str, base: dict, values: Mapping, only: Mapping, row: int, column: int
) -> tuple[list, list[str]]:
    """[(other settings, settings of each reading, readings (M, C))] of captures that agree with `only`, and remarks.

    `base` becomes what holds in all of them. A curve has settings with more values than can be told apart, such as a
    clock, at their mean."""
    where = str(captures.folder)
    check(captures, scene.parameters)
    powers = set(scene.powers.values())
    base.update({k: v for k, v in captures.parameters.items() if k not in values})
    base.update({k: values.get(k, 1.0) for f in captures.frames for k in f.parameters if k in powers})  # drive levels
    rows = [f for f in captures.frames if key in f.parameters]
    if not rows:
        known = sorted({k for f in captures.frames for k in f.parameters})
        raise BadCapture(
            f"{where}: no reading sets '{key}'; they set {', '.join(known) or 'nothing'}: choose one with --key"
        )

    def agrees(frame) -> bool:
        return all(
            k in powers or v == only[k] or not isinstance(v, str) and np.isclose(v, only[k])
            for k, v in frame.parameters.items()
            if k in only and k != key
        )

    rows, count = [f for f in rows if agrees(f)], len(rows)
    if not rows:
        raise BadCapture(
            f"{where}: none of {count} readings agrees with --set {', '.join(only)}; leave out what they set"
        )
    settings = [{k: v for k, v in f.parameters.items() if k != key} for f in rows]
    notes = []
    for name in sorted({k for s in settings for k in s}):
        found = {s[name] for s in settings if name in s}
        if len(found) > CURVES and not any(isinstance(v, str) for v in found):
            mean = float(np.mean([s[name] for s in settings if name in s]))
            notes.append(
                f"{name} takes {len(found)} values, {min(found):g} to {max(found):g}; the curve is for their mean, "
                f"{mean:g}"
            )
            settings = [{**s, name: mean} if name in s else s for s in settings]
    groups: dict[tuple, list[int]] = {}
    for index, own in enumerate(settings):
        groups.setdefault(tuple(sorted(own.items())), []).append(index)
    if len(groups) > CURVES:
        vary = sorted({k for s in settings for k in s if len({t.get(k) for t in settings}) > 1})
        raise BadCapture(
            f"{where}: {len(groups)} combinations of {', '.join(vary)}; allowed: up to {CURVES}; choose some, such as "
            f"with --set {vary[0]}={settings[0].get(vary[0])}"
        )
    found = []
    for own, members in groups.items():
        images = [rows[i].image for i in members]
        if captures.table is None and images[0].shape[:2] != scene.camera.resolution[::-1]:
            height, width = images[0].shape[:2]
            raise BadCapture(
                f"{where}: images of {width} x {height} px, the scene's camera has {scene.camera.resolution[0]} x "
                f"{scene.camera.resolution[1]} px; load the scene with -D width={width} -D height={height}"
            )
        place = (0, 0) if captures.table is not None else (row, column)
        found.append(
            (dict(own), [rows[i].parameters for i in members], np.array([image[place] for image in images], float))
        )
    return found, notes
