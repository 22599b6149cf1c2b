"""The proof of the verdicts, itself put to the proof: what it counts, that it is taken up again, and that it fails
where it must."""

import json
import math

import numpy as np
import pytest

from optics.diagnosis import statistics
from optics.proof import blind, cells, command, count, page
from optics.proof.rigs import RIGS, Bench
from optics.proof.rigs import bench as readings

FOUND = ("servo backlash", "camera gamma", "polarized source", "analyzer wobble", "polarizer misalignment")


@pytest.fixture(scope="module")
def bench():
    return Bench()


def strong(effect, kind="library", change=0.005, seed=0):
    return cells.Cell("polarizer_bench", kind, (effect,) if effect else (), change, 0.0, "same", "", seed)


def judged(bench, effects=FOUND, seeds=(0,)):
    records = [blind.run(bench, strong(effect, seed=seed)) for effect in effects for seed in seeds]
    return count.count(records, len(records))


# -- the plan --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rig", [rig for rig in RIGS.values() if not rig.outside])
def test_every_round_hides_every_effect_once_and_nothing_too(rig):
    rig = rig()
    batches = list(cells.rounds(rig, 40))
    for batch in batches:
        assert sorted(c.hidden[0] for c in batch if c.kind == "library") == sorted(rig.effects)
        made = {
            kind for kind, some in (("unknown", rig.unknown), ("pair", rig.pairs), ("mistake", rig.mistakes)) if some
        }
        assert {c.kind for c in batch} == {"none", "library", *made}
        assert all(c.hidden[0] in rig.others for c in batch if c.law == "other")
    everything = [c for batch in batches for c in batch]
    assert len({c.name for c in everything}) == len(everything)
    assert {c.hidden[0] for c in everything if c.kind == "unknown"} == set(rig.unknown)
    per = {(c.change, c.clutter, c.law) for c in everything if c.kind == "library"}
    assert per >= {c for c in cells.LIBRARY if (rig.others or c[2] == "same") and (rig.cluttered or not c[1])}
    assert all(cells.Cell.of(json.loads(json.dumps(c.json()))) == c for c in everything[:50])


def test_strengths_make_the_change_that_is_asked_for(bench):
    plain = bench.mean({})
    for effect in bench.effects:
        image = bench.mean({effect: bench.strength(effect, 0.005)})
        assert np.sqrt(np.mean((image - plain) ** 2)) / plain.mean() == pytest.approx(
            0.005, rel=0.03
        )  # the search stops at 2 %
    assert bench.truth(strong("source drift", change=10.0)) == {}  # no lamp drifts so much


def test_another_law_has_the_cause_and_size_of_the_librarys_but_not_its_shape(bench):
    settings, plain = bench.settings(), bench.mean({})
    assert set(bench.others) == set(readings.OTHER) <= set(bench.effects)
    for effect in bench.others:
        strength = bench.strength(effect, 0.005)
        own, other = bench.mean({effect: strength}) - plain, readings.other_light(effect, strength, settings) - plain
        assert np.abs(readings.other_light(effect, 0.0, settings) - plain).max() < 1e-9
        assert 0.5 < np.linalg.norm(other) / np.linalg.norm(own) < 2
        assert (
            0.8 < np.vdot(own, other) / np.linalg.norm(own) / np.linalg.norm(other) < 0.998
        )  # alike, not the same: .87 to .994
    with pytest.raises(ValueError, match="one law only"):
        readings.other_light("polarizer misalignment", 1.0, settings)


# -- counting --------------------------------------------------------------------------------------------------------
def test_a_target_is_reached_by_the_end_of_the_interval_and_not_by_the_rate():
    def rate(k, n, low=False):
        return count.Rate("", k, n, *((0.03, 0.01) if low else (0.95, 0.99)), low).verdict

    assert [rate(8, 8), rate(400, 400), rate(100, 100), rate(50, 100), rate(0, 0)] == [
        "open",
        "ambitious",
        "first release",
        "MISSED",
        "no cells",
    ]
    assert [rate(0, 20, True), rate(0, 400, True), rate(1, 200, True), rate(30, 100, True)] == [
        "open",
        "ambitious",
        "first release",
        "MISSED",
    ]
    assert count.Rate("", 0, 400, 0, 0).interval[1] == pytest.approx(1 - 0.025 ** (1 / 400))  # Clopper & Pearson


def test_the_set_and_its_size_are_counted_whether_or_not_something_stands_out():
    def weak(p, *close):
        step = {
            "word": "AMBIGUOUS",
            "claimed": "",
            "ambiguous": list(close),
            "p_best": p,
            "score": ["a", "b", "c"],
            "refit": list(close),
            "set": list(close),
            "falls": {},
            "strength": {},
            "held_out": [None],
        }
        cell = {
            "rig": "r",
            "kind": "library",
            "hidden": ["a"],
            "change": 0.002,
            "clutter": 0.0,
            "law": "same",
            "mistake": "",
            "seed": 0,
        }
        return {
            "cell": cell,
            "truth": {"a": 1.0},
            "steps": [step],
            "failed": "",
            "unreachable": False,
            "coordinates": [],
        }

    found = count.count([weak(1e-4, "a"), weak(1e-4, "b", "a", "c"), weak(0.3, "c", "b")], 3)
    assert found.only.set_size == 2 and "2.00 (target: at most 2)" in found.text()
    rates = [found.rate(f"in the set, 0.2 %, no clutter{where}") for where in ("", ", where one stands out")]
    assert [(r.k, r.n) for r in rates] == [(2, 3), (2, 2)]


# -- the loop, blind -------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_bench_finds_what_is_hidden_and_predicts_what_comes(bench):
    effects = (*FOUND, "extinction leak", "retardance")  # these two have other images when weak than when strong
    found = judged(bench, effects)
    assert found.rate("top-1 after refit, 0.5 %, no clutter").k == len(effects) and found.holds
    assert found.rate("fall of chi2 within 20 % of its prediction, to 0.5 %").k == len(effects)
    assert all(abs(p) < 5 for p in found.only.pulls["no clutter"])


@pytest.mark.slow
def test_where_nothing_stands_out_the_set_is_that_of_the_scores(bench):
    """A drift of 0.2 % by which noise hides it: the set is what explains more than chance would, the drift among it,
    and not the library."""
    step = blind.run(bench, strong("source drift", change=0.002, seed=48))["steps"][-1]
    assert step["word"] == "NOTHING" and not step["refit"] and "source drift" in step["set"]
    assert 1 < len(step["set"]) < 12 and set(step["set"]) & set(step["score"]) >= {"source drift"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, pytest.param(41, marks=pytest.mark.slow)])
def test_a_film_that_is_smeared_at_one_angle_is_no_polarized_source(bench, seed):
    """Five angles of the polarizer, a lamp that wanders: a polarized source, whose light goes with that angle too,
    explains nearly all of it, and with wobbles all: as many strengths as the five angles tell apart."""
    cell = cells.Cell("polarizer_bench", "unknown", ("smeared film",), 0.01, 0.5, "same", "", seed)
    step = blind.run(bench, cell)["steps"][-1]
    assert step["word"] in ("PARTIAL", "UNKNOWN") and step["refit"][0] == "polarized source"
    # a curve along the angle explains it better, or the strength differs from angle to angle
    held = step["conditions"]
    assert not (held["no better curve"][1] and held["even"][1]) and "polarizer.angle" in step["sentence"]


@pytest.mark.slow
def test_ranked_by_monte_carlo_it_fails(bench, monkeypatch):
    """Each candidate's scores stand under the name of another."""
    rng, solve = np.random.default_rng(1), statistics.Cone.solve
    monkeypatch.setattr(
        statistics.Cone,
        "solve",
        lambda cone, u: solve(
            cone, rng.standard_normal(len(u)) * 3 * np.sqrt(np.maximum(np.diag(cone.information), 0))
        ),
    )
    top = judged(bench).rate("top-3 by score, 0.5 %, no clutter")  # refits find the best of what they are given
    assert top.verdict == "MISSED" and top.k < len(FOUND) - 1


@pytest.mark.slow
def test_without_the_projection_it_fails(bench, monkeypatch):
    """The lamp's power takes 70 % of a gamma; where the score does not know that, it promises what no refit brings."""
    name = "fall of chi2 within 20 % of its prediction, to 0.5 %"
    assert judged(bench, ["camera gamma"], range(3)).rate(name).k == 3
    project = statistics.project

    def blunt(normal, base, rest, *args, **kwargs):
        found = project(normal, base, rest, *args, **kwargs)
        rest = np.asarray(rest, int)
        raw = normal.gram[np.ix_(rest, rest)]
        return type(found)(
            raw, normal.score[rest], np.ones(len(rest)), 0 * found.response, found.rank, found.absorbed, found.chi2
        )

    monkeypatch.setattr(statistics, "project", blunt)
    assert judged(bench, ["camera gamma"], range(3)).rate(name).k == 0


@pytest.mark.slow
def test_a_run_is_taken_up_again_and_becomes_a_page(tmp_path, monkeypatch, capsys):
    """Few cells, in this process; a record that was cut off is made again, one that is whole is not."""
    monkeypatch.setattr(
        command.plan, "rounds", lambda rig, n: iter([[strong("", "none"), strong("third harmonic", "unknown", 0.01)]])
    )
    arguments = {
        "output": tmp_path,
        "rig": ["polarizer_bench"],
        "rounds": 1,
        "kind": None,
        "jobs": 1,
        "minutes": 0.0,
        "quick": False,
        "count_only": False,
        "cells": tmp_path / "kept",
        "keep": False,
        "afresh": False,
    }
    command.main(**arguments)
    files = sorted((tmp_path / "records").glob("*.json"))
    assert len(files) == 2
    kept, cut = files
    kept.write_text(kept.read_text().replace('"seed": 0', '"seed": 0, "mark": 1'))
    cut.write_text(cut.read_text()[:100])
    before = kept.read_text()
    monkeypatch.setattr(blind.Cell, "of", None, raising=False)
    command.main(**arguments)
    assert kept.read_text() == before and blind.take_up(cut) is not None
    text = (tmp_path / "proof.html").read_text()
    told = capsys.readouterr().out
    assert "unknown kinds falsely claimed" in text and "2 of 2 cells" in told and text.count("<svg") == 5
    records = [blind.take_up(f) for f in files]
    unknown = next(r for r in records if r["cell"]["kind"] == "unknown")
    assert unknown["steps"][-1]["word"] == "UNKNOWN" and "analyzer.angle" in unknown["steps"][-1]["coordinates"][:2]
    assert not count.named(next(r for r in records if r["cell"]["kind"] == "none"))
    assert page.confusion(count.count(records, 2).only).startswith("<svg")
    assert math.isfinite(records[0]["seconds"])
