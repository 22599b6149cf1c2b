"""A residual that nothing in the library explains, from the puzzle to the noise floor, with every image.

    python examples/unknown_effect.py [OUTPUT]          (default renders/unknown_effect; four minutes on two cores)

A GelSight-type sensor with a rolling shutter: its rows are read one after another, and the current of its LEDs ripples
with the supply, locked to the camera's trigger. So rows are lit unevenly, by a few per cent and in every frame alike.
No effect of the library does that. The captures are made by stock Mitsuba (`optics.proof.makers.touch`), with the
ripple integrated over the time for which each row is exposed, then photons, read noise and 8 bits. Everything after
that is what you would type with captures of your own:

    optics calibrate captures -o study ...                       the base model
    optics diagnose study                                        UNKNOWN: it goes with the camera, along 'row'; the
    curve
    optics effects new 'row curve' --from study                  the curve as an effect, in a file
    optics add study 'row curve'                                 held-out error falls: the coordinate is right
    optics effects new 'shutter ripple' --stage lens -o my_plugins  the cause is found: a stub, and its formula
    optics calibrate captures -o answer --plugins my_plugins ...    a fresh study, in which the new effect takes part
    optics diagnose answer; optics add answer 'shutter ripple'; optics diagnose answer

OUTPUT gets the captures, both studies with a report each, the images, and `index.html`, which tells the story.
"""

import html
import subprocess
import sys
from pathlib import Path

import numpy as np

from optics import Study
from optics.captures import capture_set as capture_files
from optics.diagnosis.result import Diagnosis
from optics.proof import demo
from optics.proof.makers.touch import Maker, presses
from optics.scene import loader as scenes

WIDTH, HEIGHT = 64, 48  # px
EXPOSURE = 200.0  # one LED at a time is near full scale
LEDS = 3  # of the six that take part: one per frame
RIPPLE, HERTZ = 0.035, 600.0  # of the LEDs' current, about its mean
LINE, OPEN = 1e-4, 4e-4  # s: from one row to the next; for which a row is exposed
PHASE = 0.9  # rad, of the ripple when the first row opens
FREE = [
    "--per-group",
    "none",
    *(w for n in ("[xyz]", "pan", "tilt", "mu", "power") for w in ("--free", f"led_[1-{LEDS}].{n}")),
    "--free",
    "membrane.rho_g",
    "--free",
    "membrane.rho_b",
    "--free",
    "membrane.sigma",
]

FORMULA = '''PERIOD = 1 / ({hertz:g} * {line:g})  # rows: the supply's ripple, Hz, and the line time, s
PHASE = {phase:.3f}  # rad, at the first row: read off the curve


def formula(image, camera):
    """sin(2 pi row/period + phase)"""
    return np.sin(2 * np.pi * (camera.v - 0.5) / PERIOD + PHASE)
'''


class RollingShutter(Maker):
    """Captures whose rows see the LEDs one after another."""

    def photograph(self, radiance, rng, frame):
        t = (
            LINE * np.arange(self.size[1])[:, None] + OPEN * (np.arange(400) + 0.5) / 400
        )  # of each row, while it is exposed
        lit = (1 + RIPPLE * np.sin(2 * np.pi * HERTZ * t + PHASE)).mean(1)
        return super().photograph(radiance * lit[:, None, None], rng, frame)


def make(folder: Path) -> None:
    """Four presses under three LEDs, one at a time; a press is held out."""
    scene = scenes.load("gelsight", {"width": str(WIDTH), "height": str(HEIGHT)})
    built = {**demo.truth(scene, 3), "camera.exposure": EXPOSURE}
    maker = RollingShutter(scene, built, seed=1003)
    found = maker.captures(presses(4, 3), [{led: 1.0} for led in list(scene.leds)[:LEDS]])
    found.parameters["camera.exposure"] = EXPOSURE
    capture_files.write(found, folder, bits=8)


def optics(*words: str, ends: tuple[int, ...] = (0,)) -> str:
    """Run a command as a user does; returns what it prints."""
    line = " ".join(f"'{w}'" if " " in w or "[" in w else w for w in words)
    print(f"\n$ optics {line}", flush=True)
    done = subprocess.run([sys.executable, "-m", "optics.cli", *words, "--quiet"], capture_output=True, text=True)
    if done.returncode not in ends:
        raise RuntimeError(f"optics {line}: {done.stderr.strip()}")
    return done.stdout


def told(study: Path) -> Diagnosis:
    """The diagnosis of a study's last step, printed in short."""
    optics("diagnose", str(study), ends=(0, 1))
    found = Study.open(study).diagnosis
    print(f"{found.word}: {found.sentence}")
    return found


def held_out(study: Path) -> list[float]:
    """chi2 per degree of freedom on the held-out press, step by step."""
    return [step["held_out_chi2_per_dof"] for step in Study.open(study).records()]


def phase_of(rows: np.ndarray, curve: np.ndarray, period: float) -> tuple[float, float]:
    """(phase, amplitude) of the sine of a known period that fits a curve best, with the level and slopes that
    calibration absorbs."""
    turn = 2 * np.pi * rows / period
    a, b, *_ = np.linalg.lstsq(
        np.stack([np.sin(turn), np.cos(turn), *(rows**k for k in range(4))], 1), curve, rcond=None
    )[0]
    return float(np.arctan2(b, a)), float(np.hypot(a, b))


def filled_in(stub: str, phase: float) -> str:
    """The stub of 'shutter ripple' with its formula and what it says of itself: what a user types."""
    begin, end = stub.index("def formula("), stub.index("\n\ndef act(")
    text = stub[:begin] + FORMULA.format(hertz=HERTZ, line=LINE, phase=phase) + stub[end:]
    for stood, stands in (
        ("what it is, in one sentence.", "rows of a rolling shutter see LEDs whose current ripples."),
        ("f = tan(theta)^2, theta the field angle", "f = sin(2 pi row/period + phase)"),
        ('acts=("radius",)', 'acts=("row",)'),
        ("what captures must vary for it to be seen", "any frames"),
    ):
        if stood not in text:
            raise ValueError(f"the stub has no '{stood}'")
        text = text.replace(stood, stands)
    return text


# -- images ----------------------------------------------------------------------------------------------------------
def show_frame(file: Path, study: Path, title: str) -> None:
    """The worst frame at the first and the last step of a study: measured, predicted, residual in sigmas."""
    from matplotlib.figure import Figure

    record = Study.open(study)
    rungs = record.records()
    steps = [0] if len(rungs) == 1 else [0, len(rungs) - 1]
    figure = Figure(figsize=(10, 2.6 * len(steps)), layout="constrained")
    axes = figure.subplots(len(steps), 3, squeeze=False)
    for line, step in zip(axes, steps):
        frame = record.frames(step)[0]
        white = np.nanpercentile(frame.measured, 99.5)
        for axis, image, words in zip(
            line,
            (frame.measured / white, frame.predicted / white, frame.residual.mean(2)),
            (
                f"measured, {frame.name}",
                f"predicted: {rungs[step]['name']}",
                "measured - predicted, in sigmas, mean of channels",
            ),
        ):
            shown = axis.imshow(
                np.clip(image, 0, 1) if image.ndim == 3 else image,
                **({} if image.ndim == 3 else {"cmap": "RdBu_r", "vmin": -2, "vmax": 2}),
            )
            axis.set_title(words, fontsize=9)
            axis.set_axis_off()
        figure.colorbar(shown, ax=line[2], shrink=0.8)
    figure.suptitle(title)
    figure.savefig(file, dpi=110)


def show_curves(file: Path, found: Diagnosis) -> None:
    """The best curve with its standard errors, and how much of the excess each coordinate explains."""
    from matplotlib.figure import Figure

    colours = {"camera": "#1d5fa6", "light": "#d9962f", "geometry": "#4c8b57", "time": "#8a5fa8", "setting": "#777777"}
    best = found.fingerprints[0]
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    scale, unit = (100, "%") if best.kind == "gain" else (1, "DN")
    left.errorbar(
        best.centres,
        scale * np.array(best.curve),
        scale * np.array(best.sd),
        fmt="o-",
        ms=3,
        lw=1,
        color=colours[best.family],
    )
    left.axhline(0, color="#999999", lw=0.8)
    left.set(
        xlabel=f"{best.coordinate}, {best.unit}", ylabel=f"{best.kind}, {unit}", title=f"along '{best.coordinate}'"
    )
    shown = [f for f in found.fingerprints if f.net > 0][:14][::-1]
    right.barh([f.coordinate for f in shown], [100 * f.share for f in shown], color=[colours[f.family] for f in shown])
    right.set(xlabel="of the excess misfit, %", title="what a curve along a coordinate explains")
    for family in dict.fromkeys(f.family for f in shown):
        right.bar(0, 0, color=colours[family], label=family)
    right.legend(fontsize=8)
    figure.savefig(file, dpi=110)


def show_formula(file: Path, found: Diagnosis, phase: float, strength: tuple[float, float]) -> None:
    """The formula, at the strength that the calibration found, over the curve that led to it."""
    from matplotlib.figure import Figure

    best = found.fingerprints[0]
    rows, curve = np.array(best.centres), 100 * np.array(best.curve)
    formula = 100 * strength[0] * np.sin(2 * np.pi * HERTZ * LINE * rows + phase)
    figure = Figure(figsize=(7, 3.4), layout="constrained")
    axis = figure.subplots()
    axis.errorbar(rows, curve, 100 * np.array(best.sd), fmt="o", ms=3, label="curve of the first diagnosis")
    absorbed = np.polyval(
        np.polyfit(rows, curve - formula, 3), rows
    )  # a level and slopes, which calibration keeps from a curve
    axis.plot(
        rows,
        formula + absorbed,
        label=f"{100 * strength[0]:.2f} +- {100 * strength[1]:.2f} % sin(2 pi row/period + phase),\n"
        "and the slopes that calibration absorbs",
    )
    axis.set(xlabel="row, px", ylabel="gain, %")
    axis.legend(fontsize=8)
    figure.savefig(file, dpi=110)


def show_ladder(file: Path, levels: dict[str, float]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3), layout="constrained")
    axis = figure.subplots()
    axis.plot(list(levels), list(levels.values()), "o-", color="#1d5fa6")
    axis.axhline(1, color="#b22f33", lw=1, label="noise floor")
    for name, value in levels.items():
        axis.annotate(f"{value:.3f}", (name, value), xytext=(4, 6), textcoords="offset points")
    axis.set(ylabel="chi2/dof, held out", ylim=(0.95, None))
    axis.margins(x=0.15, y=0.2)
    axis.legend()
    figure.savefig(file, dpi=110)


# -- the story -------------------------------------------------------------------------------------------------------
def main(output: Path) -> dict:
    """Tell the story; returns its numbers."""
    captures, study, answer = (str(output / n) for n in ("captures", "study", "answer"))
    output.mkdir(parents=True, exist_ok=True)
    if any(output.iterdir()):
        raise FileExistsError(f"{output} is not empty; name another folder for the story")
    page: list[tuple[str, str, str]] = []  # heading, text, image

    print("Captures of a sensor whose rows are lit unevenly, which the library does not know.")
    make(Path(captures))
    optics("calibrate", captures, "-o", study, *FREE)
    base = held_out(Path(study))[0]
    print(f"the base model leaves chi2/dof {base:.3f} on the held-out press; noise alone would leave 1")
    show_frame(output / "1-residual.png", Path(study), "What the calibrated base model leaves")
    page.append(
        (
            "A puzzling residual",
            f"Everything is calibrated, and chi2/dof on the press that was held out is {base:.3f}: noise alone "
            "leaves 1. Stripes, which no LED and no dent makes.",
            "1-residual.png",
        )
    )

    first = told(Path(study))
    best = first.fingerprints[0]
    show_curves(output / "2-curves.png", first)
    page.append((f"{first.word}: along '{best.coordinate}'", first.sentence, "2-curves.png"))

    drafted = optics("effects", "new", "row curve", "--from", study).strip()
    optics("add", study, "row curve")
    with_draft = held_out(Path(study))[-1]
    print(f"with the curve as an effect ({drafted}): {with_draft:.3f}")
    optics("report", study)
    show_frame(output / "3-draft.png", Path(study), "Before, and with the curve as an effect")
    page.append(
        (
            "The curve as an effect",
            f"optics effects new 'row curve' --from study wrote the curve into {Path(drafted).name} as a "
            f"table; added, the held-out chi2/dof falls from {base:.3f} to {with_draft:.3f}. The coordinate is "
            "right. A table of "
            f"{len(best.curve)} numbers is no cause.",
            "3-draft.png",
        )
    )

    period = 1 / (HERTZ * LINE)
    phase, size = phase_of(np.array(best.centres), np.array(best.curve), period)
    print(
        f"a gain by rows, alike in all frames, channels and LEDs; a supply that ripples at {HERTZ:g} Hz and rows "
        f"{1e6 * LINE:g} us apart give "
        f"a period of {period:.2f} rows; the curve then has a phase of {phase:.2f} rad and an amplitude of {size:.2%}"
    )
    own = f"{output}/plugins"
    stub = Path(optics("effects", "new", "shutter ripple", "--stage", "lens", "-o", own).strip())
    stub.write_text(filled_in(stub.read_text(encoding="utf-8"), phase), encoding="utf-8")

    optics("calibrate", captures, "-o", answer, "--plugins", own, *FREE)
    second = told(Path(answer))
    optics("add", answer, "shutter ripple")
    with_formula = held_out(Path(answer))[-1]
    last = Study.open(answer).record.steps[-1]
    strength = next((v["value"], v["sd"]) for v in last["variables"] if v["keys"] == ["camera.shutter_ripple"])
    expected = RIPPLE * np.sinc(HERTZ * OPEN)
    print(
        f"with the formula: chi2/dof {with_formula:.3f} on the held-out press; ripple {strength[0]:.2%} +- "
        f"{strength[1]:.2%}, "
        f"made with {expected:.2%}"
    )
    show_formula(output / "4-formula.png", first, phase, strength)
    page.append(
        (
            f"The cause, and its formula: {second.word}",
            f"The data sheets say that rows open {1e3 * LINE:g} ms apart and "
            f"that the supply ripples at {HERTZ:g} Hz: {period:.2f} rows, as the curve has it. In a fresh "
            f"study the diagnosis says: {second.sentence}",
            "4-formula.png",
        )
    )

    final = told(Path(answer))
    optics("report", answer)
    levels = {"base": base, "+ curve (table)": with_draft, "+ shutter ripple (formula)": with_formula}
    show_frame(output / "5-answer.png", Path(answer), "Before, and with the formula")
    show_ladder(output / "6-ladder.png", levels)
    page += [
        (
            "The noise floor",
            f"chi2/dof {with_formula:.3f}, and the last diagnosis: {final.word}. {final.sentence}",
            "5-answer.png",
        ),
        ("The ladder", "On the press that no calibration saw.", "6-ladder.png"),
    ]
    write_page(output / "index.html", page)
    print(f"\n{output / 'index.html'}")
    return {
        "levels": levels,
        "words": [first.word, second.word, final.word],
        "coordinate": best.coordinate,
        "strength": strength,
        "expected": float(expected),
        "family": first.families[0].family,
    }


def write_page(file: Path, page: list[tuple[str, str, str]]) -> None:
    parts = [
        f"<h2>{html.escape(h)}</h2><p>{html.escape(t)}</p><img src='{p}' alt='{html.escape(h)}'>" for h, t, p in page
    ]
    file.write_text(
        "<!doctype html><meta charset='utf-8'><meta name='viewport' content='width=device-width'><title>An unknown "
        "effect</title>"
        "<style>body{max-width:900px;margin:2em auto;padding:0 1em;font:16px/1.5 sans-serif}img{max-width:100%}</style>"
        "<h1>An effect that the library lacks</h1>"
        + "".join(parts)
        + "<p>Reports: <a href='study/report.html'>with the table</a>, "
        "<a href='answer/report.html'>with the formula</a>.</p>\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "renders/unknown_effect"))
