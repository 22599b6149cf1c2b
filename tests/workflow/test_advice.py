"""Advice on a bench that two causes explain alike, followed with readings of another maker; and a session planned
before any reading."""

import csv
import importlib.util
import json
from pathlib import Path

import pytest
import tomllib

from optics.captures import capture_set as captures
from optics.captures.noise import Noise
from optics.cli import main
from optics.errors import BadScene, OutputExists, Underdetermined
from optics.scene import loader as scenes
from optics.scene.registry import known
from optics.study import design, loop

EXAMPLE = Path(__file__).parents[2] / "examples" / "next_measurement.py"
SMALL = {"width": "32", "height": "24"}
NOISE = Noise(0.05, 2.0, 64.0, 4095.0, 0.0)


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("next_measurement", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "hidden, family",
    [
        pytest.param("depolarization", "film put in", marks=pytest.mark.slow),
        pytest.param("offset", "exposure", marks=pytest.mark.slow),
    ],
)
def test_a_tie_is_resolved_by_what_is_advised(example, hidden, family, tmp_path, capsys):
    """The readings are those of optics.proof.makers.bench, which knows nothing of the model: AMBIGUOUS, the advice, and
    a claim of the right one."""
    effect, before, after = example.main(hidden, tmp_path)
    assert before.word == "AMBIGUOUS" and effect in before.ambiguous
    singles = [a for a in before.advice if a.family not in ("together", "more of the same")]
    assert singles[0].family == family and len(singles) >= 6
    assert all(a.hardest.before < 1e-6 < 10 < a.hardest.after for a in before.advice[:1])
    more = next(a for a in before.advice if a.family == "more of the same")
    assert more.least < 1e-6  # no number of such readings will do
    assert after.missing == effect
    page = tmp_path / "before" / "study" / "report.html"
    from optics.pages.report import report

    text = Path(report(tmp_path / "before" / "study", page)).read_text(encoding="utf-8")
    assert "best together" in text and "more of the same, to compare" in text
    # a session planned with the study's values and noise keeps the two apart; what the study has added is solved for in
    # it
    capsys.readouterr()
    study = str(tmp_path / "before" / "study")
    command = ["design", study, "--frames", "6", "--strength", "1", "--quiet"]
    assert main([*command, "--effects", ",".join(before.ambiguous), "--json", "-o", str(tmp_path / "session")]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert {e["effect"] for e in planned["effects"]} == set(before.ambiguous) and max(
        e["gap"] for e in planned["effects"]
    ) > 10.8
    assert (
        tomllib.loads((tmp_path / "session" / "captures.toml").read_text())["noise"]["saturation"]
        == example.NOISE.saturation
    )
    assert main(["add", study, effect, "--quiet"]) == 0
    assert main([*command, "--effects", effect]) == 2 and "solves for them already" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("hidden", ["leak", "stray"])
def test_the_other_cause_is_named_where_it_is_the_true_one(example, hidden, tmp_path):
    effect, before, after = example.main(hidden, tmp_path)
    assert before.word == "AMBIGUOUS" and after.missing == effect


# -- a session -------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def bench():
    """A plan for three effects of the bench, two of which only an exposure tells apart."""
    effects = [known().find_effect(n) for n in ("stray light", "dark offset", "extinction leak")]
    return design.plan(scenes.load("polarizer_bench"), 6, effects, noise=NOISE, share=1.0)


def test_a_planned_session_keeps_effects_apart(bench):
    assert len(bench.frames) == len(bench.worth) == 6
    assert all(b >= a - 1e-9 for a, b in zip(bench.worth, bench.worth[1:]))  # more frames never tell less
    assert len({f.settings["camera.exposure"] for f in bench.frames}) > 1  # else stray light and an offset are the same
    own = {e.effect: e for e in bench.effects}
    assert own["stray light"].gap > 10.8 and own["stray light"].power > 0.99
    assert {c["effect"] for c in bench.confused} == {e.effect for e in bench.effects if e.gap < 10.8}
    assert "mean P(correct)" in bench.text() and bench.json()["effects"][0]["correct"] <= 1
    assert not bench.warnings


def test_what_a_single_exposure_cannot_separate_is_reported():
    """At one exposure nothing separates stray light from an offset, and the plan says so."""
    effects = [known().find_effect(n) for n in ("stray light", "dark offset")]
    found = design.plan(scenes.load("polarizer_bench"), 4, effects, noise=NOISE, share=1.0, fixed_exposure=True)
    assert not any("camera.exposure" in f.settings for f in found.frames)
    assert {(c["effect"], c["rival"]) for c in found.confused} == {
        ("stray light", "dark offset"),
        ("dark offset", "stray light"),
    }
    assert all(c["d"] < 1e-6 for c in found.confused)


def test_a_session_is_a_capture_set_to_fill_in(bench, tmp_path):
    folder = design.write(bench, tmp_path / "set")
    told = tomllib.loads((folder / "captures.toml").read_text())
    assert (
        told["scene"] == "polarizer_bench"
        and told["noise"]["saturation"] == 4095.0
        and told["table"]["values"] == ["reading"]
    )
    rows = list(csv.DictReader((folder / "readings.csv").read_text().splitlines()))
    assert len(rows) == 6 * 12 and all(row["reading"] == "" for row in rows)
    known = scenes.load("polarizer_bench").parameters
    assert set(rows[0]) - {"reading"} <= set(known)
    with pytest.raises(OutputExists):
        design.write(bench, folder)
    # filled in, it is one that the program reads
    lines = (folder / "readings.csv").read_text().splitlines()
    (folder / "readings.csv").write_text(
        "\n".join([lines[0], *(f"{line}{100 + i % 7}" for i, line in enumerate(lines[1:]))])
    )
    assert len(loop.open_model(loop.Setup(captures=str(folder))).captures.frames) > 0
    with pytest.raises(OutputExists):  # it is a measured set now
        captures.write(captures.load(folder), folder, overwrite=True)


def test_a_session_for_a_users_own_scene(tmp_path):
    """A folder that is called `scenes` is not ours; an effect named twice is one; few sweeps are enough to hold some
    out."""
    path = tmp_path / "scenes" / "polarizer_bench.xml"
    path.parent.mkdir()
    path.write_text(scenes.find("polarizer_bench").read_text(encoding="utf-8"), encoding="utf-8")
    found = design.plan(scenes.load(path), 2, [known().find_effect("stray light")] * 2, noise=NOISE)
    assert found.scene == str(path) and [e.effect for e in found.effects] == ["stray light"] and not found.confused
    folder = design.write(found, tmp_path / "set")
    table = folder / "readings.csv"
    table.write_text(table.read_text().replace(",\n", ",100\n"))
    setup = loop.Setup(captures=str(folder))
    assert not found.warnings and loop.split(loop.open_model(setup), setup)[1]


@pytest.mark.slow
def test_a_session_of_images(tmp_path, capsys):
    """The command line on a sensor with a gel: presses, lights and exposures, four presses at least, images named one
    by one."""
    code = main(
        [
            "design",
            "gelsight",
            "--frames",
            "6",
            "--effects",
            "lens vignetting,camera gamma,veiling glare",
            "-o",
            str(tmp_path / "set"),
            "-D",
            "width=32",
            "-D",
            "height=24",
            "--quiet",
        ]
    )
    out = capsys.readouterr().out
    assert code == 0 and "6 of" in out and "lens vignetting" in out
    told = tomllib.loads((tmp_path / "set" / "captures.toml").read_text())
    assert len(told["frames"]) == 6 and len({f["group"] for f in told["frames"]}) >= 4
    keys = scenes.load("gelsight", SMALL).parameters
    for frame in told["frames"]:
        assert frame["image"].startswith("frames/") and {f"led_{i}.power" for i in range(1, 7)} <= set(
            frame["parameters"]
        )
        assert all(keys[k].bounds[0] <= v <= keys[k].bounds[1] for k, v in frame["parameters"].items())


# -- bad input -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "arguments, says",
    [
        (["design", "gelsight", "--frames", "1"], "1 frames; allowed: 2 or more"),
        (
            ["design", "gelsight", "--effects", "lens vigneting"],
            "unknown effect 'lens vigneting'; did you mean 'lens-vignetting'",
        ),
        (["design", "gelsigt"], "unknown scene 'gelsigt'; did you mean 'gelsight'"),
        (["design", "gelsight", "--effects", "unfilled cell"], "cannot express the effect 'unfilled cell'"),
        (["design", "gelsight", "--strength", "0"], "strength of 0 plausible sizes; allowed: > 0"),
        (["design", "gelsight", "--strength", "inf"], "--strength inf: not finite; allowed: a finite number"),
        (["design", "gelsight", "--saturation", "5"], "saturation = 5 DN; allowed: > black_level = 8 DN"),
    ],
)
def test_a_session_that_cannot_be_planned_is_refused_in_one_line(arguments, says, capsys):
    code = main(arguments)
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and says in err and err.count("\n") == 1


@pytest.mark.parametrize("tag, kind", [("sensor", "camera"), ("integrator", "tactile")])
def test_a_scene_without_a_camera_is_refused(tag, kind, tmp_path, capsys):
    text = scenes.find("gelsight").read_text(encoding="utf-8")
    start, end = text.index(f"<{tag}"), text.index(f"</{tag}>") + len(f"</{tag}>")
    (tmp_path / "blind.xml").write_text(text[:start] + text[end:], encoding="utf-8")
    code = main(["design", str(tmp_path / "blind.xml")])
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and f"no part of the type '{kind}'" in err and err.count("\n") == 1


@pytest.mark.slow
def test_nothing_is_planned_for_effects_that_are_solved_for_already(tmp_path):
    with pytest.raises(Underdetermined, match="solves for them already"):
        design.plan(
            scenes.load("gelsight", SMALL),
            4,
            [known().find_effect("gain drift")],
            setup=loop.Setup(captures="", free=["camera.gain"]),
        )
    with pytest.raises(BadScene, match="cannot express"):
        design.plan(scenes.load("gelsight", SMALL), 4, [known().find_effect("extinction leak")])
