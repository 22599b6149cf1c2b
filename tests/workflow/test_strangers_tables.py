"""Tables of strangers' benches, by formulas of this file: what made verdicts fail on them that the library's own idea
of a bench did not show."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from test_explanations import diagnosed, judged, malus, noisy, write

from optics.fit import calibrate
from optics.study import loop
from optics.study.setup import setup_for

COLOURS = np.array([610.0, 540.0, 465.0])  # nm
TURN = np.arange(0.0, 181.0, 10.0)  # deg


# exposure and the means of red, green and blue at TURN: a phone behind two films, one 4 deg off, with a plate of 36 deg
# at 75 deg between them, a dial that is set to 0.74 deg, by Mueller matrices that are not the library's
PHONE = (
    (1, 180.9, 180.7, 180.4),
    (1, 187, 186.8, 184.8),
    (0.5, 91.2, 90.5, 89.3),
    (1, 166.5, 164.6, 162.1),
    (0.5, 70.2, 69.3, 67.9),
    (0.5, 56.1, 55, 53.5),
    (1, 82.6, 81.3, 78.9),
    (0.5, 26.5, 26, 25),
    (1, 19.7, 19.3, 18.8),
    (0.5, 3.9, 3.9, 4),
    (1, 3.2, 4, 5.3),
    (1, 9, 10.3, 12.3),
    (1, 26, 27.8, 30.4),
    (0.5, 23, 24, 25.4),
    (1, 81.2, 83.6, 85.6),
    (0.5, 54.3, 55.2, 56.4),
    (1, 146.5, 147.6, 149.1),
    (1, 166.7, 166.8, 168.4),
    (0.5, 91.9, 91.9, 91.3),
)


@pytest.fixture(scope="module")
def cycling(tmp_path_factory):
    """A detector that is far better than the dial, and a plate that nobody mentions: of a base without it, weights
    follow the zero from one side of the extinction to the other and back."""
    folder, (exposure, *values) = tmp_path_factory.mktemp("cycling") / "captures", np.array(PHONE).T
    head = f'bands = {COLOURS.tolist()}\n[parameters]\n"polarizer.angle" = 0.0\n[uncertainty]\n"analyzer.angle" = 1.1'
    write(folder, {"analyzer.angle": TURN, "camera.exposure": exposure}, np.transpose(values), head, noise=0.055)
    file = folder / "captures.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("[noise]\n", "[noise]\nsaturation = 255\nprnu = 0.003\n"), encoding="utf-8")
    return folder


@pytest.mark.slow
def test_weights_of_a_base_that_cannot_settle_are_those_of_its_values(cycling, tmp_path):
    """The study is taken up with the fit that it kept, and the plate is found."""
    free = ["source.power_r", "source.power_g", "source.power_b", "analyzer.offset"]
    setup = setup_for(cycling, free=free)
    record, model, fit = loop.begin(setup, tmp_path / "study")
    taken, again, same = loop.take_up(tmp_path / "study")
    kept = loop.restore(taken, again)
    assert kept.converged and kept.chi2 == pytest.approx(fit.chi2, rel=0.1)
    # by its own weights the fit is at its optimum: half of a standard deviation is nothing that misfit could show
    model.weighed_at = fit.values.copy()
    moved = calibrate.fit(model, fit.variables, fit.values, fit.frames)
    assert np.all(np.abs(moved.estimate - fit.estimate) < 0.5 * np.array(fit.sd))
    found = loop.examine(taken, again, same, kept, advised=False)
    assert "retardance" in {*found.ambiguous, found.claimed}, found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_channels_that_share_the_error_of_a_dial_are_no_structure(seed, tmp_path):
    """Three colours move together where a film stops off its scale. Of structure that is not there, p is below 0.001 in
    one of three sets of a thousand; it was 1e-4 to 1e-9 here."""
    rng = np.random.default_rng(seed)
    values = malus(TURN + rng.normal(0, 0.8, len(TURN)))[:, None] * np.ones(3)
    head = f'bands = {COLOURS.tolist()}\nabsent = ["sample", "middle"]\n[uncertainty]\n"analyzer.angle" = 0.8'
    found = judged(tmp_path, noisy(values, seed), {"analyzer.angle": TURN}, head)
    assert found.basis.structure_p > 1e-3


def runs(rng, lag=0.0, scale=1.0, wander=0.0):
    """(columns, values, group) of four runs up, down, up, down, with a lamp that wanders."""
    up = np.arange(0.0, 360.1, 10.0)
    dial = np.concatenate([up, up[::-1]] * 2)
    way = np.repeat([1.0, -1.0, 1.0, -1.0], len(up))
    lamp, slow = np.empty(len(dial)), 0.0
    for i, kick in enumerate(rng.standard_normal(len(dial))):
        slow = np.exp(-0.1) * slow + np.sqrt(1 - np.exp(-0.2)) * kick
        lamp[i] = 1 + wander * slow
    values = malus(scale * dial + lag * way / 2 + rng.normal(0, 0.1, len(dial))) * lamp
    return {"analyzer.angle": dial, "analyzer.approach": way}, values, np.repeat(list("abcd"), len(up))


def put(folder, columns, values, group, noise):
    names = [*columns, "run", "volts"]
    lines = [",".join(names)]
    for *own, run, value in zip(*columns.values(), group, values):
        lines.append(",".join([*(f"{x:g}" for x in own), run, f"{value:.5f}"]))
    folder.mkdir()
    (folder / "readings.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "captures.toml").write_text(
        f'scene = "polarizer_bench"\nabsent = ["sample", "middle"]\n[noise]\ndark_noise = {noise}\n'
        '[parameters]\n"camera.gain" = 1.0\n[uncertainty]\n"analyzer.angle" = 0.1\n'
        '[table]\nfile = "readings.csv"\nvalues = ["volts"]\ngroup = "run"\n',
        encoding="utf-8",
    )


@pytest.mark.slow
def test_a_run_that_alone_knows_a_direction_is_not_predicted_along_it(tmp_path):
    """One run in four is held out, one of the three left is the only one downwards: others do not know its lag."""
    put(tmp_path / "captures", *runs(np.random.default_rng(2), lag=4.0, scale=0.99, wander=0.008), 0.002)
    free = ["source.power", "analyzer.offset"]
    found = diagnosed(tmp_path / "captures", tmp_path / "study", free=free)
    assert found.word == "CLAIM" and found.claimed in ("servo backlash", "servo scale"), found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_lamp_that_wanders_and_nothing_else_is_nothing(seed, tmp_path):
    """Structure along the session, and no effect that explains it as well as a lamp that wanders by half a percent."""
    put(tmp_path / "captures", *runs(np.random.default_rng(seed), wander=0.005), 0.002)
    found = diagnosed(tmp_path / "captures", tmp_path / "study", free=["source.power", "analyzer.offset"])
    assert found.word == "NOTHING", found.sentence


@pytest.mark.slow
def test_a_zero_is_found_by_the_short_way(tmp_path):
    """A film that stands crossed or parallel only shows a misalignment by its square: no slope tells how far. Half
    a turn more is the same film, and no reason to call 6 degrees implausible."""
    dial = np.tile(np.repeat([90.0, 0.0], 9), 2)
    found = judged(tmp_path, noisy(malus(dial, offset=6.0)), {"analyzer.angle": dial}, 'absent = ["sample", "middle"]')
    own = next(e for e in found.explanations if e.effects == ["polarizer misalignment"])
    assert max(map(abs, own.strength)) < 7.0 and own.survives, found.sentence


@pytest.mark.slow
def test_names_of_one_law_are_told_as_one(tmp_path):
    """One exposure of one lamp: light past the films and an offset of the meter are the same readings."""
    found = judged(tmp_path, noisy(malus(TURN, stray=0.03)), {"analyzer.angle": TURN}, 'absent = ["sample"]')
    assert any({"stray light", "dark offset"} <= {*kind} for kind in found.kinds), found.sentence
    assert "the same values under" in found.sentence and len(found.kinds) < len(found.survivors)
    assert {name for kind in found.kinds for name in kind} == {e.name for e in found.survivors}


def test_other_series_of_a_table_are_passed_over(tmp_path):
    write(tmp_path / "captures", {"analyzer.angle": TURN, "other": TURN}, noisy(malus(TURN)))
    file = tmp_path / "captures" / "captures.toml"
    text = file.read_text(encoding="utf-8")
    with pytest.raises(KeyError, match='ignore = \\["other"\\] ignores it'):
        loop.begin(setup_for(tmp_path / "captures"), tmp_path / "study")
    file.write_text(text + 'ignore = ["other"]\n', encoding="utf-8")
    _, model, fit = loop.begin(setup_for(tmp_path / "captures"), tmp_path / "study")
    assert fit.converged and "other" not in model.frames[0].readings


@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_a_dark_signal_that_grows_by_the_clock_is_dark_drift(rate, tmp_path):
    """Three half turns: 5 % of the largest reading more in the end, in the dark as in the light.
    A detector that warms does so by a straight line or towards a balance."""
    dial, time = np.tile(TURN, 3), np.arange(3 * len(TURN)) / 3.0
    dark = 0.05 * (time / time[-1] if rate == 0 else 1 - np.exp(-rate * time))
    columns = {"analyzer.angle": dial, "source.time": time}
    found = judged(tmp_path, noisy(malus(dial) + dark), columns, 'absent = ["sample", "middle"]')
    assert (found.word, found.claimed) == ("CLAIM", "dark drift"), found.sentence
    own = next(e for e in found.explanations if e.effects == ["dark drift"])
    slope = 0.05 / time[-1] if rate == 0 else 0.05 * rate
    assert abs(own.strength[0] - slope) < 4 * own.sd[0] and own.sd[0] < 0.1 * slope
