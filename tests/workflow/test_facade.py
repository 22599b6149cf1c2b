"""What script authors hold: a study from captures to report in six lines, tables, charts and notebook views of it."""

import json
import math
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

import optics
from optics.errors import OutputExists, UnknownKey
from optics.proof.makers import bench as jones

LEAK = 0.02  # of both films: the light that a crossed polarizer lets through
NOISE = {"system_gain": 0.05, "dark_noise": 2.0, "black_level": 64.0, "saturation": 4095.0, "prnu": 0.0}


def in_a_new_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(study after the leak was added, the diagnosis before, the fits before and after, captures): 96 readings."""
    from optics.captures.noise import Noise

    folder = tmp_path_factory.mktemp("facade")
    film = jones.Polarizer(leak=LEAK)
    truth = jones.Truth(photodiode=jones.Photodiode(gain=2.2), p1=film, p2=film)
    settings = [
        {"polarizer.angle": a, "analyzer.angle": 11.25 * i, "source.power": p, "source.time": i / 9}
        for a in (0.0, 60.0, 100.0)
        for p in (0.5, 1.0)
        for i in range(16)
    ]
    captures = folder / "captures"
    jones.write(captures, truth, settings, Noise(**NOISE), 3)
    study = optics.calibrate(captures, folder / "study", title="A <leaky> bench")
    before, verdict = study.fit, study.diagnose(advised=False)
    after = study.add("extinction leak")
    return study, verdict, before, after, captures


# -- import ----------------------------------------------------------------------------------------------------------
def test_importing_is_quick_and_sets_no_variant():
    names = "mitsuba drjit numpy scipy matplotlib colour pydantic typer"
    loaded = in_a_new_process(f"import sys, optics; print([m for m in {names.split()} if m in sys.modules])")
    assert loaded.strip() == "[]"
    variant = in_a_new_process("import optics; optics.Study, optics.Scene; import mitsuba; print(mitsuba.variant())")
    assert variant.strip() == "None"


def test_the_environment_names_the_variant(monkeypatch):
    monkeypatch.setenv("OPTICS_VARIANT", "llvm_ad_mono_polarized")
    code = 'import optics; optics.load("polarizer_bench", {"width": 1, "height": 1}); import mitsuba; '
    code += "print(mitsuba.variant())"
    assert in_a_new_process(code).strip() == "llvm_ad_mono_polarized"


def test_every_public_name_resolves_and_is_listed():
    names = set(optics.__all__) - {"register"}
    assert names <= set(dir(optics)) and all(getattr(optics, name) is not None for name in names)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'; it has .*calibrate"):
        optics.calibrat  # noqa: B018


def test_a_scene_by_name():
    scene = optics.load("polarizer_bench", {"width": 1, "height": 1})
    rows = {r["key"]: r for r in scene.records()}
    assert isinstance(scene, optics.Scene) and rows.keys() == scene.values().keys()
    assert rows["analyzer.angle"]["unit"] == "deg" and rows["analyzer.angle"]["kind"] == "polarizer_film"
    assert "analyzer.angle" in scene._repr_html_()
    with pytest.raises(UnknownKey, match="gelsigt"):
        optics.load("gelsigt")


# -- a study ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_error_falls_to_the_noise_on_frames_that_were_held_out(made):
    study, verdict, before, after, _ = made
    first, last = study.records()
    assert (first["name"], last["effect"], study.effects) == ("base", "extinction-leak", ["extinction leak"])
    assert first["held_out_n"] > 0 and first["held_out_chi2_per_dof"] > 100
    assert last["held_out_chi2_per_dof"] == pytest.approx(1, abs=4 * math.sqrt(2 / last["held_out_n"]))  # 4 sd of chi2
    strength = {r["name"]: r for r in after.records()}["polarizer_film.leak"]
    assert abs(strength["value"] - LEAK) < 4 * strength["sd"]
    assert verdict.word == "AMBIGUOUS" and "extinction leak" in verdict.ambiguous  # a Malus sweep cannot tell a haze
    assert before.chi2 > 100 * after.chi2


@pytest.mark.slow
def test_an_opened_study_is_the_one_that_was_made(made):
    study, verdict, _, after, _ = made
    again = optics.Study.open(study.folder)
    assert again.records() == study.records() and again.table() == study.table() and repr(again) == repr(study)
    np.testing.assert_allclose(again.fit.estimate, after.estimate, rtol=1e-9)  # the optimum, written with all digits
    assert again.diagnosis is None  # the last step has none yet
    recorded = json.loads((study.folder / "steps" / "00-base" / "diagnosis.json").read_text())
    assert recorded == json.loads(verdict.to_json())
    assert len(again.frames()) == len(again.model.frames) and np.nanstd(again.frames(0)[0].residual) > 2
    assert {e.key for e in again.candidates()} == {e.key for e in study.candidates()} and again.candidates()
    with pytest.raises(IndexError, match="no step 2; there are 0 .base., 1 .extinction leak."):
        again.comparison(2)
    with pytest.raises(ValueError, match="is part of the study already"):
        again.add("extinction leak")


def test_a_study_is_not_overwritten_and_its_setup_is_checked(made, tmp_path):
    study, *_, captures = made
    with pytest.raises(OutputExists, match="holds a study already"):
        optics.calibrate(captures, study.folder)
    assert optics.calibrate(captures, study.folder, resume=True).records() == study.records()
    with pytest.raises(UnknownKey, match="unknown group of frames"):
        optics.calibrate(captures, tmp_path / "s", held_out="sweep 99")
    with pytest.raises(UnknownKey, match="free parameter for a prior"):
        optics.calibrate(captures, tmp_path / "s", priors={"led_1.x": (0.0, 1.0)})
    assert not (tmp_path / "s").exists()


@pytest.mark.slow
def test_options_are_those_of_the_command_line(made, request, tmp_path):
    """The same study from Python and from the command line, with the same choices."""
    captures, run = made[-1], request.getfixturevalue("optics")
    given = {"free": "source.power", "per_group": [], "held_out": [], "priors": {"source.power": (2.0, 0.5)}}
    ours = optics.calibrate(captures, tmp_path / "a", **given)
    words = ["--free", "source.power", "--per-group", "none", "--hold-out", "none", "--prior", "source.power=2+-0.5"]
    assert run("calibrate", captures, "-o", tmp_path / "b", *words)[0] == 0
    theirs = optics.Study.open(tmp_path / "b")
    a, b = ours.fit.records()[0], theirs.fit.records()[0]
    assert theirs.setup == ours.setup and {**a, "start": 0} == {**b, "start": 0}  # a restored fit starts at its end
    assert ours.records()[0]["held_out_n"] is None and a["prior_sd"] == 0.5


def test_captures_against_a_fit(made):
    study, *_, captures = made
    found = optics.compare(captures, study.folder / "steps" / "01-extinction-leak" / "fit.toml")
    n = found.comparison.total.n
    assert found.comparison.total.chi2 / n == pytest.approx(1, abs=4 * math.sqrt(2 / n))
    assert len(found.frames()) == len(found.model.frames)


# -- tables, charts, notebook ----------------------------------------------------------------------------------------
def test_records_are_plain(made):
    study, verdict, _, after, _ = made
    for rows in (study.records(), after.records(), verdict.records(), study.model.scene.records()):
        assert rows and len({tuple(r) for r in rows}) == 1  # the same columns in every row
        json.dumps(rows)  # numbers, words, lists and None; no arrays
    best = verdict.records()[0]
    assert best["net"] == best["fall"] - best["expected"] and best["refit_fall"] > 0
    row = next(r for r in verdict.records() if r["name"] == "extinction leak")
    assert isinstance(row["change"], float)  # one strength is a number, not a list of one


@pytest.mark.slow
def test_charts_are_figures_that_no_window_knows(made):
    from matplotlib import pyplot
    from matplotlib.figure import Figure

    study, verdict, before, after, _ = made
    known = pyplot.get_fignums()
    for thing in (study, verdict, before, after):
        figure = thing.plot()
        assert isinstance(figure, Figure) and figure._repr_png_().startswith(b"\x89PNG")
    assert pyplot.get_fignums() == known
    ladder = study.plot().axes[0]
    drawn = {line.get_label(): list(line.get_ydata()) for line in ladder.lines}
    assert drawn["held out"] == [r["held_out_chi2_per_dof"] for r in study.records()]


class Tags(HTMLParser):
    """Whether every tag is closed, and which attributes reach outside."""

    def __init__(self):
        super().__init__()
        self.open, self.outside = [], []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        self.outside += [v for k, v in attributes if k in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_notebook_views_are_closed_escaped_and_self_contained(made):
    study, verdict, _, after, _ = made
    for thing in (study, verdict, after, study.model.scene):
        html, tags = thing._repr_html_(), Tags()
        tags.feed(html)
        assert tags.open == [] and tags.outside == [] and "<script" not in html
    assert "A &lt;leaky&gt; bench" in study._repr_html_() and "extinction leak" in study._repr_html_()
    assert "AMBIGUOUS" in verdict._repr_html_() and "polarizer_film.leak" in after._repr_html_()


def test_the_report_is_written_once(made):
    study = made[0]
    page = study.report()
    assert page == study.folder / "report.html" and "extinction leak" in page.read_text(encoding="utf-8")
    with pytest.raises(OutputExists, match="--force to replace it"):
        study.report()
    assert study.report(overwrite=True) == page
