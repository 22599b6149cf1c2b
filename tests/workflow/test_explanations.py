"""Sets of effects compete: readings that a formula of this file makes, judged through the whole loop.

    V = P (cos(t)^2 + leak sin(t)^2 + stray) (1 + w_c cos(psi) + w_s sin(psi)) gain       t = psi + offset

psi the dial of one of two films, P the reading of parallel films. The noise is white unless a test says otherwise."""

import numpy as np
import pytest

from optics.diagnosis.evidence import Candidate
from optics.diagnosis.explanations import implausible
from optics.diagnosis.thresholds import CLEAR, EACH
from optics.fit.model import value_of
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter, Variable
from optics.study import loop
from optics.study.setup import effect_variables, setup_for

MALUS = np.arange(-90.0, 91.0, 5.0)
NOISE = 0.004  # of a reading between parallel films


def malus(psi, offset=0.0, leak=0.0, stray=0.0, wobble=(0.0, 0.0)):
    """Readings over that of parallel ideal films."""
    t, dial = np.radians(psi + offset), np.radians(psi)
    light = np.cos(t) ** 2 + leak * np.sin(t) ** 2 + stray
    return light * (1 + wobble[0] * np.cos(dial) + wobble[1] * np.sin(dial))


def write(folder, columns, values, head="", noise=NOISE):
    """A capture set of readings: columns {key: (n,)}, values (n,) or (n, C)."""
    values = np.asarray(values, float).reshape(len(next(iter(columns.values()))), -1)
    names = [f"v{i}" for i in range(values.shape[1])]
    rows = [[*own, *v] for *own, v in zip(*columns.values(), values)]
    text = "\n".join([",".join([*columns, *names]), *(",".join(f"{x:.9g}" for x in row) for row in rows)])
    folder.mkdir()
    (folder / "readings.csv").write_text(text + "\n", encoding="utf-8")
    (folder / "captures.toml").write_text(
        f'scene = "polarizer_bench"\n{head}\n[noise]\ndark_noise = {noise}\n[table]\nfile = "readings.csv"\n'
        f"values = {names}\n",
        encoding="utf-8",
    )


def diagnosed(folder, study, **options):
    setup = setup_for(folder, **options)
    record, model, fit = loop.begin(setup, study)
    return loop.examine(record, model, setup, fit, advised=False)


def judged(tmp_path, values, columns=None, head="", **options):
    write(tmp_path / "captures", columns or {"analyzer.angle": MALUS}, values, head)
    return diagnosed(tmp_path / "captures", tmp_path / "study", **options)


def noisy(values, seed=1, sd=NOISE):
    return values + sd * np.random.default_rng(seed).standard_normal(np.shape(values))


@pytest.mark.slow
def test_two_simple_effects_tie_with_one_of_two_strengths(tmp_path):
    """A film that is 2 degrees off and a leak of 1 % are, between two films, exactly a plate in between: cos(2t) and
    sin(2t) with a constant. No claim of the plate, although it is one effect with as many strengths."""
    d = judged(tmp_path, noisy(malus(MALUS, offset=2.0, leak=0.02)))
    assert d.word == "AMBIGUOUS", d.sentence
    alive = [set(e.effects) for e in d.survivors]
    assert {"retardance"} in alive and {"polarizer misalignment", "extinction leak"} in alive
    falls = [e.fall for e in d.survivors]
    assert np.ptp(falls) < 0.01 * max(falls)  # as large: it is the number of effects and their sizes that differ


@pytest.mark.slow
def test_what_every_explanation_holds_is_claimed(tmp_path):
    """Without a sample the plate is ruled out: each explanation that is left has the misalignment, with one of four
    that the session cannot tell apart."""
    d = judged(tmp_path, noisy(malus(MALUS, offset=2.0, leak=0.02)), head='absent = ["sample"]')
    assert d.missing == "polarizer misalignment", d.sentence
    assert all("polarizer misalignment" in e.effects for e in d.survivors) and len(d.survivors) > 1
    assert "retardance" in d.not_tested and "does not show" in d.sentence
    told = d.survivors[0].told["polarizer misalignment"]
    assert "analyzer.offset - polarizer.offset = 2.0" in told or "analyzer.offset - polarizer.offset = 1.9" in told


@pytest.mark.slow
def test_what_was_found_beside_an_effect_is_looked_for_again_once_that_is_added(tmp_path):
    """With the leak alone in the model, its base stands elsewhere; the study knows where the misalignment had been."""
    write(tmp_path / "captures", {"analyzer.angle": MALUS}, noisy(malus(MALUS, offset=2.0, leak=0.02)))
    setup = setup_for(tmp_path / "captures")
    record, model, fit = loop.begin(setup, tmp_path / "study")
    first = loop.examine(record, model, setup, fit, advised=False)
    pairs = [e for e in first.survivors if "extinction leak" in e.effects]
    assert pairs and all(len(e.effects) == 2 and e.values["common"] for e in pairs)
    assert not loop._expected(record, model, None)  # nothing was added yet
    leak = model.scene.registry.find_effect("extinction leak")
    fit, _ = loop.extend(record, model, setup, fit, leak)
    record, model, setup = loop.take_up(tmp_path / "study")  # by another command
    expected = loop._expected(record, model, None)
    assert [e.names for e in expected] == [frozenset(e.effects) - {"extinction leak"} for e in pairs]
    variables = {v.name: v for pair in pairs for e in pair.effects for v in _freed(model, e)}
    for e, pair in zip(expected, pairs):
        assert [value_of(model, e.values, variables[n]) for n in pair.variables] == pytest.approx(pair.strength)
    second = loop.examine(record, model, setup, loop.restore(record, model), advised=False)
    assert {"polarizer misalignment"} in [set(e.effects) for e in second.survivors], second.sentence


def _freed(model, effect):
    return effect_variables(model, model.scene.registry.find_effect(effect))


@pytest.mark.slow
def test_less_than_dark_is_no_stray_light(tmp_path):
    """A meter whose zero is too low: light past the films can only add."""
    d = judged(tmp_path, noisy(malus(MALUS, stray=-0.02)))
    assert d.survivors and all("stray light" not in e.effects for e in d.survivors), d.sentence
    assert any("dark offset" in e.effects for e in d.survivors)


def test_far_from_plausible_is_no_tie():
    """Half a wave, 18 plausible sizes, or 36 of them, against 1: the odds are beyond 19 to 1."""
    angle = Parameter("angle", "deg", 0.0, neutral=0.0, plausible=10.0)
    own = [Variable("plate.angle", ("plate.angle",), angle)]
    plate = Candidate(Effect("plate", "sheet", ("angle",)), own, np.zeros(1), [0], np.array([10.0]))
    costs = [implausible(plate, np.array([size])) for size in (0.0, 10.0, 180.0, 360.0)]
    assert costs[0] == EACH and costs[1] < costs[0] + 2 and costs[2] > costs[1] + CLEAR and costs[3] > costs[2] + 4


@pytest.mark.slow
def test_a_lamp_that_wanders_is_no_effect(tmp_path):
    """Noise shared by some 12 neighbours, twice that of a reading: counted as white it would show effects."""
    claims, stood_out, psi = 0, 0, np.arange(-180.0, 181.0, 4.0)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        wander = np.zeros(len(psi))
        for i in range(1, len(psi)):
            wander[i] = 0.92 * wander[i - 1] + np.sqrt(1 - 0.92**2) * rng.standard_normal()
        own = tmp_path / str(seed)
        own.mkdir()
        d = judged(own, noisy(malus(psi) * (1 + 2 * NOISE * wander), seed + 100), {"analyzer.angle": psi})
        claims += d.word == "CLAIM"
        stood_out += any(r.p_family < 0.01 for r in d.rows)
    assert claims == 0 and stood_out >= 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_one_thing_swept_is_enough_for_a_claim(seed, tmp_path):
    """Along the only setting a free curve explains as much as any effect: its bins cost what they could have fitted.
    A wobble of 1 % would be no more than a lamp may wander by."""
    psi = np.arange(-180.0, 180.0, 6.0)
    d = judged(tmp_path, noisy(malus(psi, wobble=(0.024, 0.016)), seed), {"analyzer.angle": psi})
    assert d.missing == "analyzer wobble", d.sentence
    curve = next(f for f in d.fingerprints if f.coordinate == "analyzer.angle")
    assert curve.ratio > 0.9


@pytest.mark.slow
def test_freedom_of_colour_breaks_no_tie(tmp_path):
    """A haze whose strength has a colour: `coloured leak` fits it, `depolarization` has no slope to offer. The leak
    within the coloured one is not told from a haze, so neither is the coloured one."""
    t = np.radians(MALUS)
    values = np.stack([np.cos(t) ** 2 * (1 - d) + d / 2 for d in (0.036, 0.03, 0.024)], 1)
    free = ["source.power_r", "source.power_g", "source.power_b"]
    d = judged(tmp_path, noisy(values), head="bands = [640, 540, 440]", free=free, per_group=[])
    assert d.word != "CLAIM" or d.claimed not in ("coloured leak", "extinction leak"), d.sentence
    assert any("depolarization" in e.effects for e in d.survivors), [e.effects for e in d.survivors]


@pytest.mark.slow
def test_a_tone_along_the_session_is_not_nothing(tmp_path):
    """31.5 cycles of a flickering lamp: beyond the eight lowest cosines, and no effect of the library."""
    psi = np.arange(-180.0, 180.0, 2.0)
    values = malus(psi) * (1 + 0.012 * np.sin(2 * np.pi * 31.5 * np.arange(len(psi)) / len(psi)))
    plain = judged(tmp_path, noisy(malus(psi), 3), {"analyzer.angle": psi})
    (tmp_path / "other").mkdir()
    d = judged(tmp_path / "other", noisy(values, 3), {"analyzer.angle": psi})
    assert plain.word == "NOTHING" and d.word not in ("NOTHING", "CLAIM"), d.sentence


@pytest.mark.slow
def test_a_contained_effect_does_not_come_back_by_its_score(tmp_path):
    """`coloured leak` holds the leak and does no better: it is no rival by the fall that its score promised."""
    d = judged(tmp_path, noisy(malus(MALUS, leak=0.03)), head='absent = ["sample"]')
    assert not any("coloured leak" in e.effects for e in d.survivors)
    assert "at least one that was not added" not in d.sentence
    assert {"extinction leak"} in [set(e.effects) for e in d.survivors]


@pytest.mark.slow
def test_what_shows_only_beside_another_effect_is_found_with_it(tmp_path):
    """A plate of 40 degrees at 540 nm whose birefringence falls with the wavelength, at two angles between films:
    without the plate its dispersion changes nothing, so that no score of the base can rank it.

    I = cos(a)^2 + sin(2 b) sin(2 (a - b)) sin(d/2)^2, with the analyser at a and the plate's axis at b"""
    bands = np.array([620.0, 540.0, 460.0])
    a, turned = np.repeat(MALUS, 2), np.tile([0.0, 45.0], len(MALUS))
    wave = 540 / bands
    half = np.radians(40.0 / 2) * wave * (1 + 0.1 * (wave**2 - 1))
    axis = np.radians(20 + turned)[:, None]
    angle = np.radians(a)[:, None]
    light = np.cos(angle) ** 2 + np.sin(2 * axis) * np.sin(2 * (angle - axis)) * np.sin(half) ** 2
    columns = {"analyzer.angle": a, "sample.angle": turned}
    d = judged(tmp_path, noisy(light), columns, "bands = [620, 540, 460]")
    assert d.row("dispersive retardance").image == pytest.approx(0, abs=1e-6)
    assert d.missing == "retardance", d.sentence
    assert {"retardance", "dispersive retardance"} in [set(e.effects) for e in d.survivors], d.sentence


def turned_by_hand(sd, seed=3):
    """Every setting of a dial stops a little off what is written."""
    return MALUS + sd * np.random.default_rng(seed).standard_normal(len(MALUS))


@pytest.mark.slow
def test_errors_of_dials_that_nobody_states_are_found_and_kept(tmp_path):
    """Half a degree is more than the meter's noise nearly everywhere; by stated noise alone anything would stand out.
    What the study takes is in its setup, its warnings and its values, and a comparison finds the same numbers."""
    import optics

    light = malus(turned_by_hand(0.5))
    write(tmp_path / "captures", {"analyzer.angle": MALUS}, noisy(light))
    study = optics.calibrate(tmp_path / "captures", folder=tmp_path / "study")
    found = study.record.ladder["facts"]["setup"]["uncertainty"]["analyzer.angle"]
    assert found == pytest.approx(0.5, abs=0.2)  # three standard deviations of a width of 37 settings
    assert any(f'"analyzer.angle" = {found:g}' in warning for warning in study.record.ladder["warnings"])
    assert study.diagnose().word == "NOTHING"
    again = optics.compare(tmp_path / "captures", fit=tmp_path / "study")
    step = study.record.steps[-1]
    assert again.comparison.held_out.chi2_per_dof == pytest.approx(step["held_out"]["chi2_per_dof"], rel=1e-6)


@pytest.mark.slow
def test_an_effect_is_found_behind_errors_of_dials(tmp_path):
    """A wobble of 15 % along a whole turn, where unstated errors make three times the meter's noise."""
    dial = np.arange(-180.0, 180.0, 5.0)
    turned = dial + 0.7 * np.random.default_rng(3).standard_normal(len(dial))
    light = malus(turned) * (1 + 0.15 * np.cos(np.radians(dial)))
    d = judged(tmp_path, noisy(light), {"analyzer.angle": dial}, 'absent = ["sample"]')
    assert d.missing == "analyzer wobble", d.sentence


def test_exact_dials_are_exact_where_that_is_stated(tmp_path):
    light = malus(turned_by_hand(0.5))
    write(tmp_path / "captures", {"analyzer.angle": MALUS}, noisy(light), '[uncertainty]\n"analyzer.angle" = 0')
    record, _, _ = loop.begin(setup_for(tmp_path / "captures"), tmp_path / "study")
    assert record.ladder["facts"]["setup"]["uncertainty"] is None
