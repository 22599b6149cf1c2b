"""Draws the fingerprint figure of every effect: what it changes in the image of a scene that can express it.

    python docs/tools/fingerprints.py [EFFECT ...] [--missing]

A scene is rendered with the effect at rest and with it in force; the figure shows both and their difference. The
strength is the plausible one, multiplied by the first of 1, 2, 5, 10, 20 ... that changes the image visibly. Effects of
polarizers and sheets are shown as the readings of a photodiode against an angle. Every effect that a scan finds gets a
figure without an entry anywhere; `SHOWN` only chooses a better view for those whose first view says little.

Writes docs/fingerprints/KEY.webp and, with strengths and captions, docs/fingerprints/figures.json. All of them take
about ten minutes on two cores; `make docs` uses the files as they are."""

from __future__ import annotations

import argparse
import io
import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from plugin_pages import formula_of

FOLDER = Path(__file__).resolve().parent.parent / "fingerprints"
RECORD = FOLDER / "figures.json"
VISIBLE = 0.03  # rms change over the mean signal: a contrast of a few per cent is seen at a glance
LOCAL = 0.1  # change over the mean signal in two values of a thousand: seen as well, where an effect is local
VISIBLE_CURVE = 0.04  # largest change of a reading over the largest reading, for the same reason
FAINT = 50.0  # DN: what is dimmer, as behind crossed polarizers, is held against this
STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # of the plausible strength
GAP = 6  # px of white between the panels
PANEL = 240  # px: smallest width of a panel; smaller images are enlarged by whole factors
QUALITY = 80  # of the WEBP files: about 15 kB each


@dataclass(frozen=True)
class View:
    """A scene in a state in which effects are shown.

    defines  of the scene's XML;  values  of its parameters
    along    key of the setting that a reading is shown against (None: the view is an image);  span  its ends
    """

    scene: str
    defines: dict[str, str] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)
    along: str | None = None
    span: tuple[float, float] = (0.0, 180.0)

    def words(self) -> str:
        """What it takes to see the same, as the command line takes it."""
        values = {} if self.values is SIDES else self.values
        options = [f"-D {k}={v}" for k, v in self.defines.items()] + [f"--set {k}={v:g}" for k, v in values.items()]
        options += ["with two LEDs of each colour"] if self.values is SIDES else []
        return " ".join([self.scene, *options])


# Two LEDs of each colour: every channel is lit from a side of its own, so that a slope shows as a colour.
SIDES = {f"led_{i}.power_{c}": 0.0 for i in range(1, 7) for c in "rgb" if c != "rgb"[(i - 1) // 2]}
PRESSED = View("gelsight", {"width": "240", "height": "180", "depth": "0.7", "radius": "2.5"}, SIDES)
ONE_SIDE = View(
    "gelsight", {"width": "240", "height": "180", "depth": "0.7"}, {f"led_{i}.power": 0.0 for i in (2, 3, 4, 5, 6)}
)
COLOURED = View("digit", {"width": "240", "height": "240", "x_fov": "40", "depth": "1.0"})
SPECTRAL = View("digit", {**COLOURED.defines, "bands": "auto"})
WHITE = View("gelsight", {**PRESSED.defines, "bands": "auto", "sensitivity": "Nikon 5100 (NPL)"}, SIDES)
BENCH = View("polarizer_bench", along="analyzer.angle")
FULL_TURN = View("polarizer_bench", along="analyzer.angle", span=(0.0, 360.0))
CROSSED = View("polarizer_bench", {"analyzer": "90"}, along="sample.angle")
FINGER = View("vi2tap", {"width": "240", "height": "180", "analyzer": "90", "depth": "2"})
GRID = View("magictac", {"width": "120", "height": "90", "columns": "10", "rows": "10", "block_width": "8.4",
                         "block_length": "8.4", "led_x": "5.2", "led_y": "5.2", "x_fov": "21", "distance": "-0.3",
                         "packets": "400000", "rays": "128"})  # fmt: skip
MOSAIC = View(
    "polarization_camera",
    {"width": "24", "height": "18"},  # few pixels, so that those of one cell are told apart
    {"panel.dop_q": 0.6, "panel.dop_u_1": 0.6, "panel.dop_q_2": -0.6, "panel.dop_u_3": -0.6, "panel.power": 1.2},
)
MIRROR = View(
    "reflection_bench", {}, {"polarizer.angle": 0.0, "analyzer.inserted": 0.0, "source.power": 4.0}, "plate.incidence",
    (5.0, 80.0),
)  # fmt: skip
BEADS = View("particle_gel", {"width": "240", "height": "240", "x_fov": "50", "depth": "1.5"}, {"dye.time": 3.0})
VIEWS = (PRESSED, COLOURED, BENCH, FINGER, MOSAIC, MIRROR, GRID, BEADS)  # the first that can express an effect shows it

# effect -> (view, holders of the effect; None: every part of its kind)
SHOWN: dict[str, tuple[View, tuple[str, ...] | None]] = {
    **dict.fromkeys(("lateral-colour", "chromatic-focus", "gel-yellowing"), (COLOURED, None)),
    "colour-crosstalk": (COLOURED, None),  # white light on a grey skin has no colour to mix
    "bleaching": (BEADS, None),  # a setting of time
    "inner-filter": (BEADS, None),  # light that comes back in another colour
    "excitation-leak": (BEADS, None),
    **dict.fromkeys(
        ("led-centre-shift", "led-width", "sensitivity-tail", "filter-edge-shift", "metameric-paint"), (SPECTRAL, None)
    ),
    "phosphor-leak": (WHITE, None),
    "dark-offset": (ONE_SIDE, None),
    "veiling-glare": (ONE_SIDE, None),
    # a shallow dent, whose long skirt ends within the fine part of the mesh
    "exponential-skirt": (
        View("gelsight", {"width": "240", "height": "180", "depth": "0.5", "radius": "1.5"}, SIDES),
        None,
    ),
    "led-drift": (COLOURED, ("led_red",)),  # one light of three
    "led-size": (ONE_SIDE, None),  # one light: rims of shadows
    "height-fall-off": (ONE_SIDE, None),
    "specular-lobe": (ONE_SIDE, None),
    "analyzer-wobble": (FULL_TURN, ("analyzer",)),  # one cycle per turn
    "eccentric-dial": (FULL_TURN, ("analyzer",)),
    "polarized-detector": (FULL_TURN, None),  # two cycles per turn
    "polarizer-misalignment": (BENCH, ("analyzer",)),
    "servo-scale": (FULL_TURN, ("analyzer",)),  # an error that grows with the angle
    "servo-backlash": (View("polarizer_bench", {}, {"analyzer.approach": 1.0}, "analyzer.angle"), None),
    "source-drift": (View("polarizer_bench", {}, {}, "source.time", (0.0, 30.0)), None),
    "dark-drift": (View("polarizer_bench", {}, {}, "source.time", (0.0, 30.0)), None),
    "polarized-source": (View("polarizer_bench", {}, {"analyzer.inserted": 0.0}, "polarizer.angle"), None),
    "retardance": (CROSSED, None),
    "dichroism": (CROSSED, None),
    "optical-rotation": (BENCH, None),
    "twisted-plate": (View("polarizer_bench", {"analyzer": "90"}, {"sample.retard_0": 180.0}, "sample.angle"), None),
    "sample-absorption": (View("polariscope", {"width": "180", "height": "135", "analyzer": "45"}), ("sample",)),
    "plate-behind-the-coating": (View("gelsight_bench"), None),  # a plate of balls
    "stretched-coating": (
        View("gelsight_bench", {}, {"gel.stretch": 0.04, "gel.stretch_xx": 0.003, "gel.stretch_yy": 0.002}),
        None,
    ),
    "soft-saturation": (View("polarizer_bench", {}, {"source.power": 2.8}, "analyzer.angle"), None),
    "stress-birefringence": (
        View("polarizer_bench", {"width": "180", "height": "180", "x_fov": "8", "pattern": "disc", "analyzer": "90"}),
        None,
    ),
    "dispersive-retardance": (
        View(
            "polarizer_bench", {"bands": "620, 540, 460", "analyzer": "90"}, {"sample.retard_0": 180.0}, "sample.angle"
        ),
        None,
    ),
    "coloured-leak": (View("polarizer_bench", {"bands": "620, 540, 460"}, {}, "analyzer.angle"), None),
    "oblique-leak": (
        View("polarizer_bench", {"width": "180", "height": "180", "x_fov": "11", "analyzer": "90"}),
        None,
    ),  # crossed, and seen obliquely, as far as the films reach
    "unfilled-cell": (
        View(GRID.scene, GRID.defines, {"grid.unfilled_column": 3.0, "grid.unfilled_row": 4.0}),
        None,
    ),  # a cell in view, beside the touched ones
    "coloured-absorption": (
        View(GRID.scene, GRID.defines, {"walls.absorption": 0.05, "filling.absorption": 0.05}),
        None,
    ),  # nothing without absorption
}

FACTOR = {
    "exponential-skirt": 1,  # beyond, the skirt reaches past the fine part of the mesh, whose end shows
    "dark-drift": 1,  # beyond, it settles at once
    "stress-birefringence": 10,  # below, the two points of load outshine the fringes
}  # effect -> multiple of the plausible strength


@cache
def opened(scene: str, defines: tuple) -> object:
    """A scene and what renders it; kept, as the same view shows many effects."""
    from optics.light.rendering import RenderJob
    from optics.scene import loader

    loaded = loader.load(scene, dict(defines))
    return loaded, RenderJob(loaded, layers=())


@dataclass
class Shot:
    """One view of an effect: the readings or the image for values by key."""

    view: View

    def __post_init__(self):
        self.scene, self.job = opened(self.view.scene, tuple(self.view.defines.items()))

    def take(self, values: dict[str, float]) -> np.ndarray:
        """(H, W, C) or (N, C), DN."""
        now = {**self.view.values, **values}
        if self.view.along is None:
            return np.asarray(self.job.take(now).camera, float)
        from optics.light.polarimetry import sweep

        x = np.linspace(*self.view.span, 73)
        # all values, as a sweep leaves those of its own in the scene
        now = {k: v for k, v in {**self.job.base, **now}.items() if k != self.view.along}
        return np.asarray(sweep(self.scene, self.view.along, x, (0, 0), now).curves[0].y, float)


def view_of(effect) -> tuple[View, tuple[str, ...] | None]:
    """Where an effect is shown: its entry of `SHOWN`, or the first view that can express it."""
    if effect.key in SHOWN:
        return SHOWN[effect.key]
    for view in VIEWS:
        if Shot(view).scene.can_express(effect):
            return view, None
    raise LookupError(f"{effect.name}: no view of docs/tools/fingerprints.py has its parts; add one to VIEWS or SHOWN")


def strengths(effect, reg, scene, holders, factor: float) -> dict[str, float]:
    """{key: value} of an effect at `factor` plausible strengths, in the direction that the bounds leave."""
    values = {}
    for name, keys in scene.keys_of(effect).items():
        p = reg.parameter(effect.part, name)
        step = factor * p.plausible
        value = p.neutral + step if p.neutral + step <= p.bounds[1] else p.neutral - step
        if not p.bounds[0] <= value <= p.bounds[1]:
            value = p.bounds[1]
        values.update({k: value for k in keys if holders is None or k.rsplit(".", 1)[0] in holders})
    return values


def reached(effect, reg, values: dict[str, float]) -> float:
    """How many plausible strengths these values are: less than was asked for where a bound is nearer."""
    own = [reg.parameter(effect.part, key.rsplit(".", 1)[1]) for key in values]
    return float(f"{max(abs(v - p.neutral) / p.plausible for v, p in zip(values.values(), own)):.3g}")


def draw(effect, reg) -> dict:
    """Write an effect's figure; returns its record."""
    view, holders = view_of(effect)
    shot = Shot(view)
    without = shot.take({})
    for factor in (FACTOR[effect.key],) if effect.key in FACTOR else STEPS:
        values = strengths(effect, reg, shot.scene, holders, factor)
        image = shot.take(values)
        if not np.isfinite(image).all():
            raise FloatingPointError(f"{effect.name}: the image is not finite at {values}")
        change = image - without
        if view.along is None:
            level = max(without.mean(), FAINT / 5)
            seen = np.sqrt((change**2).mean()) >= VISIBLE * level or np.quantile(np.abs(change), 0.998) >= LOCAL * level
        else:
            seen = np.abs(change).max() / max(without.max(), FAINT) >= VISIBLE_CURVE
        if seen or strengths(effect, reg, shot.scene, holders, 2 * factor) == values:
            break
    if not np.any(change):
        raise ValueError(f"{effect.name}: changes nothing in the view '{view.words()}'; choose another one in SHOWN")
    scale = panels(effect.key, without, image) if view.along is None else curves(effect.key, view, shot, without, image)
    signal = max(without.mean(), image.mean())
    return {
        "view": view.words(),
        "along": view.along,
        "factor": reached(effect, reg, values),
        "strength": {k: float(f"{v:.6g}") for k, v in values.items()},
        "rms": float(f"{np.sqrt((change**2).mean()) / signal:.3g}"),
        "scale": float(f"{scale:.3g}"),
        "formula": formula_of(effect),
    }


def panels(key: str, without: np.ndarray, image: np.ndarray) -> float:
    """without | with | change; returns the change in DN that is drawn nearly black or white."""
    from PIL import Image

    change = image - without
    scale = max(float(np.quantile(np.abs(change), 0.998)), 1e-9)
    white = max(float(np.quantile(without, 0.999)), float(np.quantile(image, 0.999)), 1e-9)
    shown = [without / white, image / white, 0.5 + 0.4 * change / scale]  # an even change stays off pure white
    if shown[0].shape[2] == 1:
        shown = [np.repeat(s, 3, axis=2) for s in shown]
    enlarge = max(PANEL // shown[0].shape[1], 1)
    shown = [np.kron(np.clip(s, 0, 1), np.ones((enlarge, enlarge, 1))) for s in shown]
    gap = np.ones((shown[0].shape[0], GAP, 3))
    strip = np.concatenate([shown[0], gap, shown[1], gap, shown[2]], axis=1)
    Image.fromarray((255 * strip + 0.5).astype(np.uint8)).save(FOLDER / f"{key}.webp", quality=QUALITY, method=6)
    return scale


def curves(key: str, view: View, shot: Shot, without: np.ndarray, image: np.ndarray) -> float:
    """Readings without and with the effect, and below their difference; returns its largest size in DN."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    x = np.linspace(*view.span, len(without))
    colours = ["#c0392b", "#27864b", "#2c5aa0"] if without.shape[1] == 3 else ["#2c5aa0"]
    figure, (upper, lower) = plt.subplots(
        2, 1, figsize=(7.2, 3.6), sharex=True, height_ratios=(3, 2), layout="constrained"
    )
    for channel, colour in enumerate(colours):
        upper.plot(x, without[:, channel], color=colour, linewidth=1, linestyle="--", label="without" * (channel == 0))
        upper.plot(x, image[:, channel], color=colour, linewidth=1.6, label="with" * (channel == 0))
        lower.plot(x, (image - without)[:, channel], color=colour, linewidth=1.6)
    unit = shot.scene.parameters[view.along].unit
    upper.set_ylabel("reading, DN")
    lower.set_ylabel("change, DN")
    lower.axhline(0, color="#999", linewidth=0.8)
    lower.set_xlabel(f"{view.along}{f', {unit}' if unit != '1' else ''}")
    upper.legend(frameon=False, fontsize=9, ncols=2, loc="upper right")
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=100, format="png")
    plt.close(figure)
    Image.open(buffer).convert("RGB").save(FOLDER / f"{key}.webp", quality=QUALITY, method=6)
    return float(np.abs(image - without).max())


def main() -> None:
    from optics.scene.registry import known

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("effects", nargs="*", metavar="EFFECT", help="only these; without any: all")
    parser.add_argument("--missing", action="store_true", help="only those that have no figure yet")
    options = parser.parse_args()
    reg = known()
    record = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.is_file() else {}
    chosen = [reg.find_effect(name).key for name in options.effects] or sorted(reg.effects)
    for key in chosen:
        if options.missing and key in record and (FOLDER / f"{key}.webp").is_file():
            continue
        record[key] = draw(reg.effects[key], reg)
        print(key, record[key]["strength"], f"rms {record[key]['rms']:.3g}", flush=True)
        kept = {k: record[k] for k in sorted(record) if k in reg.effects}
        RECORD.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
