"""A small study written, read again and shown: a dome in a gel under three LEDs, two effects hidden and found.

The study is made with numpy alone: the scene is a shading formula, calibration is least squares on its brightness.
`python tests/workflow/test_report.py FOLDER` writes it with its page, to look at.
"""

import base64
import io
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics.errors import BadCapture, OutputExists
from optics.fit.compare import compare
from optics.fit.null_models import PHYSICAL, NullTable, Score
from optics.pages.report import ladder_chart, number, percent, report
from optics.scene.parameter import Parameter, Values, Variable
from optics.study.record import Fingerprint, Record, Shown, read_fit

LEDS = {"led_red": (0.95, -0.31), "led_green": (-0.2, 0.98), "led_blue": (-0.75, -0.66)}
TRUTH = {"camera.vignetting": 0.31, "gel.absorption": 0.06}
GAIN, READ, BLACK, FULL = 0.05, 1.2, 8.0, 255.0


def shading(h, w, place, depth, lit, powers, vignetting=0.0, absorption=0.0):
    """(H, W, 3) DN, and coordinate images: a dome pressed `depth` mm deep at `place` (mm), lit from the sides."""
    y, x = np.mgrid[0:h, 0:w] + 0.5
    x, y = (x - w / 2) * 16 / w, (y - h / 2) * 16 / w
    r = np.hypot(x - place[0], y - place[1])
    a = np.sqrt(2 * 4.0 * depth)
    height = (
        np.where(r < a, depth - r**2 / 8, 0.25 * depth * np.exp(-(r - a) / 0.8)) - 0.25 * depth * (r < a) * (r / a) ** 8
    )
    gy, gx = np.gradient(height, 16 / w)
    slope = np.hypot(gx, gy)
    image = np.zeros((h, w, 3))
    shadow = np.zeros((h, w), bool)
    for c, (name, (sx, sy)) in enumerate(LEDS.items()):
        if name in lit:
            side = 0.55 + 0.9 * (gx * sx + gy * sy)
            fall = 1 / (1 + 0.004 * ((x - 9 * sx) ** 2 + (y - 9 * sy) ** 2))
            cast = (r < 1.5 * a) & (r > a) & ((x - place[0]) * sx + (y - place[1]) * sy < -0.75 * r)
            shadow |= cast
            light = np.clip(side, 0.02, None) * fall * np.where(cast, 0.35, 1.0) * powers[name]
            image += light[..., None] * np.where(np.arange(3) == c, 1.0, 0.07)
    angle = np.arctan(np.hypot(x, y) / 14)
    image *= (1 - vignetting * (1 - np.cos(angle) ** 4) * 4)[..., None]
    path = (2.2 - height) * (1 / np.cos(angle) + 1.4)
    image *= np.exp(-absorption * path[..., None] * np.array([0.6, 1.0, 1.9]))
    known = {
        "radius": np.hypot(x, y) * w / 16,
        "height": height,
        "slope": np.degrees(np.arctan(slope)),
        "gel_path": path,
        "contact": r < 0.9 * a,
        "rim": (r >= 0.9 * a) & (r < 1.25 * a),
        "shadow": shadow,
    }
    return BLACK + 175 * image, known


def demo(folder: Path, height=72, width=96, presses=4, seed=3, steps=3) -> Record:
    """A study with the steps base, + lens vignetting, + gel absorption, six or more frames, the last press held out."""
    rng = np.random.default_rng(seed)
    combinations = [tuple(LEDS), ("led_red",), ("led_green",), ("led_blue",)]
    shots = []
    for press in range(presses):
        place, depth = rng.uniform(-3.2, 3.2, 2) * (1, 0.6), rng.uniform(0.35, 1.0)
        for lit in combinations[: 2 + press % 2]:
            shots.append((f"press-{press + 1:02d}", place, depth, lit))
    names = [f"{g} {'all' if len(lit) == 3 else lit[0][4:]}" for g, _, _, lit in shots]
    held_out = [i for i, s in enumerate(shots) if s[0] == f"press-{presses:02d}"]
    true_powers = {"led_red": 0.92, "led_green": 1.05, "led_blue": 0.98}

    def model(powers, strengths, i):
        _, place, depth, lit = shots[i]
        return shading(height, width, place, depth, lit, powers, *strengths)

    def sd(signal):
        return np.sqrt(GAIN * np.maximum(signal - BLACK, 0) + READ**2 + 1 / 12)

    clean = [model(true_powers, TRUTH.values(), i)[0] for i in range(len(shots))]
    measured = [np.clip(np.round(c + rng.normal(size=c.shape) * np.sqrt(sd(c) ** 2 - 1 / 12)), 0, FULL) for c in clean]
    usable = [m < 0.96 * FULL for m in measured]
    for u in usable:
        u[:3, :5] = False

    capture_file = folder.parent / "captures.toml"
    capture_file.parent.mkdir(parents=True, exist_ok=True)
    capture_file.write_text('scene = "gelsight"\n')
    study = Record.create(
        folder,
        scene="gelsight",
        captures=str(capture_file.parent),
        inputs=[capture_file],
        seed=7,
        command=["optics", "study", "captures", "--out", "study"],
        title="GelSight, dome presses",
        noise={"system_gain": GAIN, "dark_noise": READ, "black_level": BLACK, "saturation": FULL, "prnu": 0.0},
        warnings=["8 bit: quantisation is a sixth of the dark noise; deeper images decide more"],
        facts={
            "frames": len(shots),
            "held_out": len(held_out),
            "image": [height, width, 3],
            "setup": {"free": ["led*.power"], "seed": 7},
        },
    )

    def calibrated(strengths):
        """LED powers that fit best: the image is linear in them, so weighted least squares is exact in one step."""
        gram, right = np.zeros((3, 3)), np.zeros(3)
        for i in fitted:
            one = np.stack([model({k: float(k == led) for k in LEDS}, strengths, i)[0] - BLACK for led in LEDS], -1)
            weight = usable[i] / sd(clean[i]) ** 2
            gram += np.einsum("hwci,hwcj,hwc->ij", one, one, weight)
            right += np.einsum("hwci,hwc,hwc->i", one, measured[i] - BLACK, weight)
        return dict(zip(LEDS, np.linalg.solve(gram, right)))

    free = [f"{n}.power" for n in LEDS]
    ladder = [
        ("base", None, (0, 0)),
        ("lens vignetting", "lens-vignetting", (TRUTH["camera.vignetting"], 0)),
        ("gel absorption", "gel-absorption", tuple(TRUTH.values())),
    ][:steps]
    fitted = [i for i in range(len(shots)) if i not in held_out]
    effects = {"lens vignetting": (TRUTH["camera.vignetting"], 0.0), "gel absorption": (0.0, TRUTH["gel.absorption"])}
    for index, (name, effect, strengths) in enumerate(ladder):
        powers = calibrated(strengths)
        both = [model(powers, strengths, i) for i in range(len(shots))]
        predicted, known = [b[0] for b in both], [b[1] for b in both]
        spread = [sd(p) for p in predicted]
        found = compare(
            measured,
            predicted,
            spread,
            usable,
            known,
            [{f"{n}.power": float(n in s[3]) for n in LEDS} for s in shots],
            [s[0] for s in shots],
            names=names,
            held_out=held_out,
            parameters=3 + index,
            full_scale=FULL,
            black_level=BLACK,
        )
        sds = np.array([0.0011, 0.0010, 0.0012] + [0.004, 0.0009][:index])
        values = Values(
            {**{f"{n}.power": powers[n] for n in LEDS}, **dict(list(TRUTH.items())[:index])},
            {i: {"gel.press_x": shots[i][1][0]} for i in range(len(shots))},
        )
        power = Parameter("power", "1", 1.0, (0.0, 10.0), plausible=0.1)
        extra = [
            Parameter("vignetting", "1", 0.0, (0, 1), neutral=0.0, plausible=0.3),
            Parameter("absorption", "1/mm", 0.0, (0, 1), neutral=0.0, plausible=0.05),
        ][:index]
        variables = [Variable(k, (k,), power, prior=(1.0, 0.05)) for k in free]
        variables += [Variable(k, (k,), p) for k, p in zip(TRUTH, extra)]
        variables += [
            Variable(
                f"gel.press_x[{g}]",
                ("gel.press_x",),
                Parameter("press_x", "mm", 0.0),
                tuple(i for i, s in enumerate(shots) if s[0] == g),
            )
            for g in dict.fromkeys(s[0] for s in shots)
        ]
        estimate = np.array(
            [powers[n] for n in LEDS]
            + list(TRUTH.values())[:index]
            + [next(s[1][0] for s in shots if s[0] == v.name[12:-1]) for v in variables[3 + index :]]
        )
        sds = np.concatenate([sds, np.full(len(estimate) - len(sds), 0.0021)])
        correlation = np.eye(len(estimate))
        if index:
            correlation[0, 3] = correlation[3, 0] = 0.93
        fit = SimpleNamespace(
            values=values,
            variables=variables,
            estimate=estimate,
            sd=sds,
            error=sds,
            tempering=1.0,
            correlation=correlation,
            posterior=None,
            chi2=found.fitted.chi2,
            dof=found.fitted.dof,
            converged=True,
            reason="gradient small",
            warnings=[],
        )
        r = [np.where(u, (m - p) / s, np.nan) for m, p, s, u in zip(measured, predicted, spread, usable)]
        fingerprints, rows, worst = [], [], found.worst()[0]
        for title, step in effects.items():
            if max(np.add(strengths, step)) > 0.4:  # has it already
                continue
            added = np.maximum(strengths, step)
            again = calibrated(added)
            change = [(model(again, added, i)[0] - predicted[i]) / spread[i] for i in range(len(shots))]
            fall = sum(np.nansum(a**2) - np.nansum((a - b) ** 2) for a, b in zip(r, change))
            fingerprints.append(Fingerprint(title, names[worst], change[worst], r[worst], max(step)))
            rows.append((title, fall, max(step)))
        order = np.argsort([-r[1] for r in rows])
        diagnosis = demo_diagnosis([rows[i] for i in order], found, index, names)
        frames = [
            Shown(n, m, p, s, u, found.frames[i]["led"], shots[i][0], i in held_out)
            for i, (n, m, p, s, u) in enumerate(zip(names, measured, predicted, spread, usable))
        ]
        study.add_step(
            name,
            effect,
            fit,
            found,
            diagnosis,
            frames,
            [fingerprints[i] for i in order],
            nulls=null_models(),
            background={"mode": "additive", "channels": [{"structure": 12.0, "left": 6.0, "share": 0.75}] * 3},
            seconds=12.0,
        )
    return study


def null_models() -> dict:
    """Errors of a physical model that wins two channels, as optics.fit.null_models writes them."""
    scores = [
        Score(name, split, "own", [near, near, near + worse], [1.5] * 3, [near] * 3, [1.0] * 3)
        for split in ("held out", "fitted")
        for name, near, worse in ((PHYSICAL, 4.25, 9.0), ("background", 28.5, 0.0), ("linear in the normal", 5.5, 0.0))
    ]
    return NullTable(scores, [1.9] * 3, ["a", "b"], ["c"]).json()


def demo_diagnosis(rows, found, index, names) -> dict:
    """What optics.diagnosis.diagnose would say at this step of the ladder: vignetting, then absorption, then
    nothing."""
    claim = index < 2
    total, noise = found.total, found.total.noise / found.total.signal
    unit, plausible = (
        {"lens vignetting": "1", "gel absorption": "1/mm"},
        {"lens vignetting": 0.3, "gel absorption": 0.05},
    )
    table = []
    for k, (name, fall, strength) in enumerate(rows):
        sd = strength / np.sqrt(max(fall, 100.0))
        table.append(
            {
                "name": name,
                "units": [unit[name]],
                "fall": 0.96 * fall,
                "p_family": 0.0 if claim else 0.8,
                "start": [0.0],
                "change": [strength if claim else 0.0],
                "sd": [sd],
                "of_plausible": strength / plausible[name],
                "image": 0.021 + 0.03 * k,
                "share": fall / (total.chi2 - total.dof) if claim else None,
                "survival": 0.07 + 0.1 * k,
                "upper": [strength + 2 * sd],
                "confused_with": "LED lobe" if k == 0 else "",
                "cos": 0.79,
                "flags": [],
                "verdict": "claimed" if k == 0 and claim else "",
                "refit": {"fall": fall, "strength": [strength], "sd": [sd]} if claim else None,
            }
        )
    for name, upper in (("glare", 0.0007), ("LED lobe", 0.03), ("response gamma", 0.02)):
        table.append(
            {
                "name": name,
                "units": ["1"],
                "fall": 1.3,
                "p_family": 0.9,
                "start": [0.0],
                "change": [0.0],
                "sd": [upper / 2],
                "upper": [upper],
                "refit": None,
                "verdict": "no evidence",
            }
        )
    data = {
        "word": "NOTHING",
        "rows": table,
        "not_tested": {"retardance": "no polarizer in the scene"},
        "warnings": [],
        "sentence": f"none of {len(table)} effects is significant (family-wise p 0.8) and no structure "
        "is left (p 0.31).",
        "conditions": [
            {"name": "an effect stands out", "holds": claim, "text": "family-wise p <1e-9 against 0.01"},
            {"name": "structure is left", "holds": False, "text": "test of structure p 0.31 against 0.01"},
        ],
    }
    if not claim:
        return data
    best, rng = table[0], np.random.default_rng(5)
    parts = {
        "channel": ["R", "G", "B"],
        "frame": names,
        "LED": ["all", "led_red", "led_green"],
        "contact": ["no contact", "contact"],
        "quadrant": ["top left", "top right", "bottom left", "bottom right"],
    }
    splits = [
        {
            "effect": best["name"],
            "by": by,
            "labels": labels,
            "sd": [0.012] * len(labels),
            "h": 0.004,
            "p": 0.4,
            "strength": (1 + 0.012 * rng.normal(size=len(labels))).tolist(),
            "holds": True,
        }
        for by, labels in parts.items()
    ]
    level = {
        "fitted": total.rms / total.signal,
        "held_out": found.held_out.rms / found.held_out.signal,
        "frames": 2,
        "chi2_fitted": found.fitted.chi2_per_dof,
        "chi2_held_out": found.held_out.chi2_per_dof,
        "fall": None,
        "frames_better": 0,
    }
    radius = next(c for c in found.curves if c.coordinate == "radius" and c.channel == "all")
    return {
        **data,
        "word": "CLAIM",
        "claimed": best["name"],
        "splits": splits,
        "sentence": f"{best['name']} is missing, strength {best['change'][0]:.3f} +- {best['sd'][0]:.4f}. Its strength "
        "is the same in every part of the data. Not glare < 0.0007, not LED lobe < 0.03. Before, led_red.power "
        "stood 0.26 off.",
        "levels": [
            {"model": "base", **level},
            {
                "model": f"+ {best['name']}",
                **level,
                "fitted": 1.1 * noise,
                "held_out": 1.1 * noise,
                "chi2_fitted": 1.2,
                "chi2_held_out": 1.21,
                "fall": 0.2 * best["fall"],
                "frames_better": 2,
            },
        ],
        "shifts": [
            {"variable": "led_red.power", "unit": "1", "before": 0.5025, "after": 0.7641, "in_sd": 237.0, "warn": True}
        ],
        "fingerprints": [
            {
                "coordinate": "radius",
                "net": 0.6 * best["fall"],
                "dof": 30,
                "ratio": 0.61,
                "kind": "gain",
                "labels": [],
                "centres": radius.centre.tolist(),
                "curve": (radius.mean / 60).tolist(),
                "sd": (radius.se / 60).tolist(),
            },
            {
                "coordinate": "place",
                "net": 0.2 * best["fall"],
                "dof": 90,
                "ratio": 0.2,
                "kind": "offset",
                "labels": [],
                "centres": list(range(64)),
                "curve": rng.normal(size=64).tolist(),
                "sd": [0.3] * 64,
            },
        ],
        "hints": ["the same press at 0.4 of the exposure, and one deeper press, often tell more than repeats"],
    }


# -- tests -----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    study = demo(folder / "study")
    return study, report(folder / "study", folder / "report.html").read_text(encoding="utf-8")


def images_in(html: str) -> list:
    from PIL import Image

    found = re.findall(r"data:image/(?:png|webp);base64,([A-Za-z0-9+/=]+)", html)
    return [Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB") for text in found]


@pytest.mark.slow
def test_page_is_one_file_without_outside_resources(studied):
    _, html = studied
    assert len(html) < 6e6
    assert not re.search(r"(?:src|href|url|@import)\s*[=(]?\s*[\"']?(?:https?:)?//", html)
    assert not re.search(r"<link(?![^>]*href=\"data:)|<script[^>]*\ssrc", html)


def test_page_holds_every_step_frame_and_image(studied):
    study, html = studied
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.S)[1])
    assert [s["name"] for s in data["steps"]] == ["base", "lens vignetting", "gel absorption"]
    assert [f["name"] for f in data["frames"]] and all(len(s["frames"]) == len(data["frames"]) for s in data["steps"])
    assert any(f["heldOut"] for f in data["frames"])
    images = images_in(html)
    assert len(images) >= len(data["frames"]) * (1 + 2 * len(data["steps"])) + 3 * 2 + 4  # viewer, fingerprints, maps
    assert all(min(i.size) > 4 for i in images)
    for step in study.steps:
        assert step["name"] in html
    for word in (
        "CLAIM",
        "NOTHING",
        "upper limits",
        "the same everywhere",
        "noise floor",
        "Null models",
        "system gain",
        "sha256:",
    ):
        assert word in html


def test_residual_images_carry_the_residual(studied):
    """A quarter of a sigma per code, so a read value is within an eighth; masked pixels are 0."""
    study, html = studied
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.S)[1])
    shown = {f.name: f for f in study.frames(2)}[data["frames"][0]["name"]]
    code = np.asarray(images_in(data["steps"][2]["frames"][0]["residual"])[0]).astype(float)
    z = shown.residual
    assert np.array_equal(code == 0, np.isnan(z))
    inner = np.isfinite(z) & (np.abs(z) < 31)
    assert np.abs((code - 128) / 4 - z)[inner].max() <= 0.125 + 1e-6  # float32 on disk


def test_headline_says_what_was_won(studied):
    _, html = studied
    words = re.sub(r"\s+", " ", re.search(r"<h1>(.*?)</h1>", html, re.S)[1])
    assert words.startswith("Adding lens vignetting and gel absorption lowers the misfit on held-out frames from")
    assert words.endswith("What is left is noise.")


def test_ladder_falls_to_the_noise_floor(studied):
    study, _ = studied
    levels = [s["held_out"]["chi2_per_dof"] for s in study.steps]
    assert levels[0] > 5 > levels[1] > 1.1 > levels[2] > 0.9
    text = study.table()
    assert "02 + gel absorption" in text and "noise floor: chi2/dof 1.000" in text


def test_the_noise_band_of_few_readings_stays_within_its_chart():
    steps = [
        {
            "index": 0,
            "name": "base",
            "fitted": {"chi2_per_dof": 2.0, "dof": 20},
            "held_out": {"chi2_per_dof": 1.7, "dof": 6},
        }
    ]
    study = SimpleNamespace(steps=steps, ladder={"noise_floor": {"chi2_per_dof": 1.0}})
    top, height = map(
        float, re.search(r'floorband".*? y="([\d.]+)" height="([\d.]+)"', ladder_chart(study, 900, 340)).groups()
    )
    assert (
        top >= 34 and top + height <= 340 - 62 + 0.1
    )  # chi2/dof of 6 readings scatters by 58 %, twice that goes below the axis


def test_step_folder_can_be_read_without_this_program(studied):
    study, _ = studied
    step = study.folder / "steps" / "01-lens-vignetting"
    assert {p.name for p in step.iterdir()} == {"step.json", "fit.toml", "metrics.json", "diagnosis.json", "images"}
    fit = read_fit(step / "fit.toml")
    assert fit["parameters"]["camera.vignetting"] == TRUTH["camera.vignetting"]
    assert fit["uncertainty"]["camera.vignetting"] == 0.004
    assert set(fit["frames"]) == {f["frame"] for f in study.comparison(1).frames}
    assert fit["frames_uncertainty"]["press-01 all"] == {"gel.press_x": 0.0021}
    assert json.loads((step / "metrics.json").read_text())["nulls"]["wins"] == [True, True, False]
    with np.load(step / "images" / "frame-00.npz") as a:
        assert a["measured"].dtype == np.float32 and a["usable"].dtype == bool and a["sd"].shape == a["measured"].shape


def test_every_step_shows_the_same_frames_with_one_held_out(studied):
    study, _ = studied
    shown = [[f["name"] for f in s["frames"]] for s in study.steps]
    assert shown[0] == shown[1] == shown[2] and len(shown[0]) == 8
    assert any(f["held_out"] for f in study.steps[0]["frames"])


def test_nothing_is_overwritten(studied, tmp_path):
    study, _ = studied
    with pytest.raises(OutputExists, match="holds a study already"):
        Record.create(study.folder, scene="x", captures="y")
    with pytest.raises(OutputExists, match="has a step already"):
        study.add_step("base", None, {}, study.comparison(0))
    (tmp_path / "taken.html").write_text("mine")
    with pytest.raises(OutputExists, match="or --force to replace it"):
        report(study.folder, tmp_path / "taken.html")
    assert (tmp_path / "taken.html").read_text() == "mine"
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(OutputExists, match="holds no study"):
        Record.create(tmp_path / "notes", scene="x", captures="y")


def small(folder, channels=1, size=(16, 20), count=3, **more) -> Record:
    """A study of one step without held-out frames, diagnosis or nulls."""
    rng = np.random.default_rng(1)
    predicted = [50 + 40 * rng.random((*size, channels)) for _ in range(count)]
    measured = [p + rng.normal(size=p.shape) for p in predicted]
    sd, use = [np.ones_like(p) for p in predicted], [np.ones(size, bool)] * count
    settings = [{"analyzer.angle": 10.0 * i} for i in range(count)]
    found = compare(measured, predicted, sd, use, settings=settings)
    study = Record.create(folder, scene="bench", captures="captures")
    frames = [Shown(f["frame"], *four) for f, four in zip(found.frames, zip(measured, predicted, sd, use))]
    study.add_step("base", None, {"parameters": {"led.power": 1.0}}, found, frames=frames, **more)
    return study


def test_a_crash_leaves_the_study_whole_and_it_goes_on(tmp_path, monkeypatch):
    study = small(tmp_path / "study")
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", lambda *a, **k: (_ for _ in ()).throw(OSError("disk full")))
        with pytest.raises(OSError, match="disk full"):
            study.add_step("glare", "glare", {}, study.comparison(0), frames=study.frames(0))
    assert [p.name for p in (tmp_path / "study" / "steps").iterdir()] == ["00-base"]
    study.add_step("glare", "glare", {}, study.comparison(0), frames=study.frames(0))
    record = json.loads((tmp_path / "study" / "ladder.json").read_text())
    record["steps"] = record["steps"][:1]  # as if it had stopped between the two renames
    (tmp_path / "study" / "ladder.json").write_text(json.dumps(record))
    again = Record.open(tmp_path / "study")
    assert [s["name"] for s in again.steps] == ["base", "glare"] and again.added() == ["glare"]


def test_resuming_asks_for_the_same_inputs(tmp_path):
    file = tmp_path / "captures.toml"
    file.write_text("one")
    Record.create(tmp_path / "s", scene="x", captures="c", inputs=[tmp_path / "captures.toml"], seed=1)
    again = Record.create(tmp_path / "s", scene="x", captures="c", inputs=[file], seed=1, resume=True)
    assert again.changed_inputs() == []
    file.write_text("two")
    assert again.changed_inputs() == [str(file)]
    with pytest.raises(BadCapture, match="changed since the study began: .*captures.toml"):
        Record.create(tmp_path / "s", scene="x", captures="c", inputs=[file], seed=1, resume=True)
    with pytest.raises(FileNotFoundError, match="no such input"):
        Record.create(tmp_path / "t", scene="x", captures="c", inputs=[tmp_path / "missing"])


def test_a_damaged_or_missing_study_is_refused_in_words(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no ladder.json"):
        Record.open(tmp_path)
    empty = Record.create(tmp_path / "empty", scene="x", captures="c")
    with pytest.raises(ValueError, match="no step yet"):
        report(empty.folder, tmp_path / "r.html")
    small(tmp_path / "study")
    (tmp_path / "study" / "ladder.json").write_text("{")
    with pytest.raises(ValueError, match="not a readable study"):
        Record.open(tmp_path / "study")


@pytest.mark.parametrize("channels, shown", [(1, ["L"]), (2, ["all"]), (3, ["R", "G", "B"]), (4, ["all"])])
def test_any_number_of_channels_is_shown(tmp_path, channels, shown):
    html = report(small(tmp_path / "study", channels).folder, tmp_path / "r.html").read_text(encoding="utf-8")
    assert json.loads(re.search(r'id="data">(.*?)</script>', html, re.S)[1])["channels"] == shown
    assert "What was missing" not in html and "The base model misses the measurement by" in html


def test_point_readings_are_drawn_against_their_setting(tmp_path):
    html = report(small(tmp_path / "study", size=(1, 1), count=12).folder, tmp_path / "r.html").read_text(
        encoding="utf-8"
    )
    assert "Readings and predictions against analyzer.angle" in html and 'id="data"' not in html


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A study of 96 readings of a leaky polarizer bench, the leak found in a second step; and its page."""
    from optics.captures.noise import Noise
    from optics.proof.makers import bench as jones
    from optics.scene.registry import known
    from optics.study import loop

    folder = tmp_path_factory.mktemp("swept")
    truth = jones.Truth(
        photodiode=jones.Photodiode(gain=2.2), p1=jones.Polarizer(leak=0.02), p2=jones.Polarizer(leak=0.02)
    )
    settings = [
        {"polarizer.angle": a, "analyzer.angle": 11.25 * i, "source.power": p, "source.time": i / 9}
        for a in (0.0, 60.0, 100.0)
        for p in (0.5, 1.0)
        for i in range(16)
    ]
    jones.write(folder / "captures", truth, settings, Noise(0.05, 2.0, 64.0, 4095.0, 0.0), 3)
    setup = loop.Setup(captures=str(folder / "captures"))
    study, model, fit = loop.begin(setup, folder / "study")
    loop.extend(study, model, setup, fit, known().find_effect("extinction leak"), None)
    return study, model, report(study.folder, folder / "report.html").read_text(encoding="utf-8")


def panels_in(html: str) -> list[list[str]]:
    """Per step the charts of readings."""
    found = re.findall(r'<div class="sweep".*?</div>\n  </div>', html, re.S)
    return [
        [svg for svg in re.findall(r"<svg.*?</svg>", block, re.S) if "Readings and predictions" in svg]
        for block in found
    ]


def test_a_sweep_keeps_the_settings_of_its_readings(swept):
    study, model, _ = swept
    frames = Record.open(study.folder).frames(1)
    assert len(frames) == len(model.frames) and any(f.held_out for f in frames)
    for f, g in zip(frames, model.frames):
        assert f.name == g.name and f.units["analyzer.angle"] == "deg"
        assert np.array_equal(f.settings["analyzer.angle"], g.readings["analyzer.angle"].ravel())
        assert set(f.settings) == {*g.readings, *g.parameters}


def test_sweeps_are_drawn_as_curves_with_residuals(swept):
    """Along the analyzer; colours tell the polarizer's angles, panels the powers; every reading once above and once
    below."""
    study, _, html = swept
    steps = panels_in(html)
    assert [len(p) for p in steps] == [2, 2] and 'id="data"' not in html and "<img" not in html
    assert "source.power 0.5" in steps[0][0] and "source.power 1" in steps[0][1] and "polarizer.angle 60 deg" in html
    for panels in steps:
        for svg in panels:
            marks = re.findall(r'<path class="mark (k\d)( held)?" d="([^"]*)"', svg)
            assert sum(d.count("h0") for _, _, d in marks) == 2 * 48 and {k for k, _, _ in marks} == {"k0", "k1", "k2"}
            assert "analyzer.angle, deg" in svg and svg.count('class="sigmas"') == 2
            assert re.search(r'class="curve k0" d="M[^"]*C', svg), (
                "predictions are smooth, so a curve goes through them"
            )
        held = re.findall(r'class="mark k\d held" d="([^"]*)"', "".join(panels))
        assert sum(d.count("h0") for d in held) == 2 * sum(len(f.measured) for f in study.frames(0) if f.held_out)
    rms = [[float(re.search(r"rms residual ([\d.]+)", svg)[1]) for svg in panels] for panels in steps]
    assert min(rms[0]) > 3 > 1.5 > max(rms[1])  # 96 residuals of noise: 1 within 0.07 a standard deviation
    for step in study.steps:
        assert f'id="step-{step["index"]}"' in html


def test_the_page_speaks_of_readings(swept):
    _, _, html = swept
    page = re.sub(r"<style>.*?</style>", "", html, flags=re.S).replace("scikit-image", "")  # a package's name
    assert "on held-out readings" in page and "96 readings in 8 sweeps" in page
    for word in ("frames", "pixel", "image"):
        assert word not in page, word


def test_sweeps_recorded_without_settings_still_show(swept, tmp_path):
    """Older studies hold no settings: their readings are drawn in the order of the sweep."""
    import shutil

    shutil.copytree(swept[0].folder, tmp_path / "study")
    for file in tmp_path.glob("study/steps/*/images/frame-*.npz"):
        with np.load(file) as a:
            kept = {k: a[k] for k in a.files if not k.startswith("setting ")}
        np.savez_compressed(file, **kept)
    for file in tmp_path.glob("study/steps/*/step.json"):
        step = json.loads(file.read_text())
        for f in step["frames"]:
            del f["units"]
        file.write_text(json.dumps(step))
    html = report(tmp_path / "study", tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Readings and predictions against place in the sweep" in html and 'id="data"' not in html


@pytest.mark.parametrize(
    "along, other, expected",
    [
        (
            "analyzer.angle",
            "source.power",
            ("analyzer.angle", ["source.power"], []),
        ),  # an angle before what has few values
        ("source.time", "source.power", ("source.time", ["source.power"], [])),  # time where nothing else takes many
        ("source.power", "source.time", ("source.power", [], [])),  # time last where both take many
    ],
)
def test_readings_are_drawn_along_the_setting_with_most_values(along, other, expected):
    from optics.pages.report import Readings

    count = np.arange(40.0)
    settings = {other: count if other.endswith("time") else count % 2, along: count % 20}
    none = np.zeros((40, 1))
    units = {"analyzer.angle": "deg", "source.time": "min", "source.power": "1"}
    assert Readings(settings, units, none[:, 0] > 0, none, [none], [none], 1).folds() == expected


def test_large_frames_are_made_to_fit(tmp_path, monkeypatch):
    import optics.pages.report

    monkeypatch.setattr(optics.pages.report, "BUDGET", 60_000)
    html = report(small(tmp_path / "study", 3, (96, 128), 6).folder, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "recorded frames are left out" in html or re.search(r"blocks of \d+×\d+ pixels", html)
    assert sum(len(p) for p in re.findall(r"data:image/webp;base64,[^\"]+", html)) <= 60_000


def test_names_cannot_break_out_of_the_page(tmp_path):
    diagnosis = {
        "word": "CANNOT_TELL",
        "sentence": "<img src=x> -> nothing +- holds",
        "rows": [{"name": "<b>x</b>", "p_family": 0.0, "fall": None, "refit": {"fall": "inf"}}],
    }
    study = small(tmp_path / "study", diagnosis=diagnosis)
    study.ladder["title"] = "</script><b>"
    study._save()
    html = report(study.folder, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "<img src=x>" not in html and "<b>x</b>" not in html and "</script><b>" not in html
    assert "CANNOT TELL" in html and "→ nothing ± holds" in html


def test_what_the_page_reads_is_what_a_diagnosis_writes():
    """The page reads dictionaries; this holds its keys against the declared ones."""
    import typing

    from optics.diagnosis.diagnose import Diagnosis

    def keys(kind):
        return set(typing.get_type_hints(kind))

    declared = typing.get_type_hints(Diagnosis)
    read = {
        "rows": "name units fall p_family start change sd of_plausible image share survival confused_with cos upper "
        "refit flags verdict",
        "splits": "effect by labels strength sd h p holds",
        "shifts": "variable unit before after in_sd warn",
        "fingerprints": "coordinate net dof ratio kind centres curve sd labels",
        "conditions": "name holds text",
        "levels": "model fitted held_out chi2_fitted chi2_held_out fall frames_better frames",
    }
    assert {*read, *["word", "sentence", "hints", "not_tested", "warnings", "compared", "correct", "ambiguous"]} <= set(
        declared
    )
    for name, wanted in read.items():
        assert set(wanted.split()) <= keys(typing.get_args(declared[name])[0]), name
    row = typing.get_args(declared["rows"])[0]
    refit = typing.get_args(typing.get_type_hints(row)["refit"])[0]
    assert {"fall", "strength", "sd"} <= keys(refit)


def test_images_of_a_model_become_frames_and_fingerprints():
    """A refit that adds 2 DN shows as 2 sigmas beside a residual of 2 sigmas."""
    from optics.study.shown import fingerprints_of, shown_frames

    class Model:
        captures = SimpleNamespace(table=None)
        frames = [SimpleNamespace(name="a", image=np.full((4, 5, 1), 12.0), group=None, parameters={"led.power": 1.0})]

        def predict(self, values, frames):
            return [np.full((4, 5, 1), 10.0 + values.common.get("glare", 0.0))]

        def variance(self, values, index, prediction):
            return np.ones_like(prediction)

        def usable(self, index):
            return np.ones((4, 5, 1), bool)

    row = SimpleNamespace(name="glare", refit=SimpleNamespace(strength=[2.0]))
    diagnosis = SimpleNamespace(rows=[row], fits={"glare": SimpleNamespace(values=Values({"glare": 2.0}))})
    found = fingerprints_of(Model(), SimpleNamespace(values=Values()), diagnosis, 0)
    assert found[0].image == pytest.approx(2.0) and found[0].residual == pytest.approx(2.0) and found[0].strength == 2.0
    frames = shown_frames(Model(), Values(), held_out=[0])
    assert frames[0].held_out and frames[0].residual == pytest.approx(2.0) and frames[0].led == "led"


@pytest.mark.parametrize(
    "value, text",
    [
        (None, "–"),
        (float("nan"), "–"),
        ("inf", "∞"),
        (0, "0"),
        (-0.0123, "−0.0123"),
        (12345.6, "12\u202f346"),
        (3.2e7, "3.2·10⁷"),
        (1.5e-6, "1.5·10⁻⁶"),
        (999.7, "1\u202f000"),
        (-99.96, "−100"),
    ],
)
def test_numbers_are_written_for_readers(value, text):
    assert number(value) == text


def test_what_rounds_to_a_further_digit_is_no_power_of_ten():
    assert percent(0.997, 2) == "100\u202f%" == percent(0.9998)


if __name__ == "__main__":
    where = Path(sys.argv[1])
    big = len(sys.argv) > 2
    study = demo(where / "study", *((240, 320) if big else (72, 96)), presses=5 if big else 4)
    print(study.table())
    print(report(where / "study", where / "report.html"))


def test_the_residuals_before_and_after_stand_side_by_side(studied, swept, tmp_path):
    from PIL import Image

    from optics.proof.before_after import before_after

    study, _ = studied
    page = np.asarray(Image.open(before_after(study.folder, tmp_path / "residual.png")), float)
    assert page.shape[1:] == (640, 3)
    body = page[20 : page.shape[0] - 40]
    first, last = body[:, :300].std(), body[:, 340:].std()
    assert first > last > 0  # structure in saturated colours on the left, noise on the right
    with pytest.raises(ValueError, match="point readings"):
        before_after(swept[0].folder, tmp_path / "readings.png")
