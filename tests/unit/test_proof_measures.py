"""Records of finished cells as the repository keeps them, and measures that others publish."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from optics.fit.result import Fit
from optics.proof import count, kept, measures
from optics.proof.cells import Cell
from optics.proof.rigs.base import SCREENS, screen
from optics.scene.parameter import Parameter, Values, Variable


def record(kind="library", hidden=("a",), claimed="a", change=0.02, seed=0, **more):
    cell = Cell("r", kind, tuple(hidden), change, 0.0, "same", "", seed)
    step = {
        "word": "CLAIM" if claimed else "UNKNOWN",
        "claimed": claimed,
        "ambiguous": [],
        "sentence": "said " * 100,
        "p_best": 1e-9,
        "score": ["a", "b"],
        "refit": ["a", "b"],
        "set": ["a"],
        "falls": {"a": [100.123456789, 99.0]},
        "conditions": {"lead": [1.0, True]},
        "failing": [],
        "held_out": [1.2, 1.0],
        "coordinates": [],
        "strength": {},
        "bias": [],
        "flagged": None,
        **more,
    }
    return {
        "cell": cell.json(),
        "truth": dict.fromkeys(hidden, 1.0),
        "steps": [step],
        "failed": "",
        "unreachable": False,
        "coordinates": [],
        "parts": [],
        "made": "abc, day",
        "cpu": 10.0,
    }


def named(records):
    return {Cell.of(r["cell"]).name: r for r in records}


def test_kept_cells_are_counted_as_they_were(tmp_path):
    records = named(record(seed=s, bias=[0.2, 0.05, 0.04]) for s in range(3))
    kept.add(tmp_path, records)
    kept.add(tmp_path, named([record(seed=3, claimed="b")]))
    found = kept.read(tmp_path)
    assert sorted(found) == sorted([*records, Cell.of(record(seed=3)["cell"]).name])
    before, after = count.count([*records.values(), record(seed=3, claimed="b")], 4), count.count(found.values(), 4)
    assert before.text() == after.text() and "10 s of a processor each" in after.text()
    lines = (tmp_path / "r.jsonl").read_text().splitlines()
    assert len(lines) == 4 and max(map(len, lines)) < 1200 and "conditions" not in lines[0]
    assert json.loads(lines[0])["steps"][0]["falls"] == {"a": [100.12, 99.0]}


def test_a_line_that_was_cut_off_costs_that_cell_alone(tmp_path):
    kept.add(tmp_path, named(record(seed=s) for s in range(2)))
    file = tmp_path / "r.jsonl"
    file.write_text(file.read_text()[:-40])
    assert len(kept.read(tmp_path)) == 1


def test_a_cell_that_is_run_again_takes_the_place_of_the_old_one(tmp_path):
    kept.add(tmp_path, named([record(claimed="b")]))
    kept.add(tmp_path, named([record(claimed="a")]))
    (only,) = kept.read(tmp_path).values()
    assert only["steps"][0]["claimed"] == "a"


def test_rates_of_sensors_are_not_pooled():
    other = record(claimed="b")
    other["cell"]["rig"] = "s"
    found = count.count([record(), other], 2)
    rates = {
        n: next(r for r in one.rates if r.name.startswith("right claims, 2 %, clutter 0"))
        for n, one in found.rigs.items()
    }
    assert [(r.k, r.n) for r in rates.values()] == [(1, 1), (0, 1)]
    assert not hasattr(found, "rates") and "\nall:" not in found.text()
    # a rate is judged by its near end: one of one is at least .025
    assert rates["r"].bound == pytest.approx(0.025) and rates["r"].verdict == "open"


def test_measures_of_others():
    pairs = [
        record("pair", ("a", "b"), "a", seed=1, added=["a", "c"]),  # one of two names is false
        record("pair", ("a", "b"), "a", seed=2, added=["a", "b"]),
    ]
    local = record("unknown", ("stain",), "", seed=3, flagged=[1, 2, 3])
    local["parts"] = [2, 3, 4]
    biased = record(seed=4, bias=[0.3, 0.1, 0.05])
    own = {m.name: m for m in count.count([*pairs, local, biased], 4).only.measures}
    assert own["false discovery rate, two hidden"].value == pytest.approx(0.25)
    assert own["localisation F1, kinds that act in a part"].value == pytest.approx(2 / 3)
    assert own["parameter bias in plausible sizes, without the missing effect"].value == pytest.approx(0.3)
    assert own["parameter bias in plausible sizes, with it"].value == pytest.approx(0.1)
    recovered = own["form recovery: the right effect named, alone, 2 %, no clutter"]
    assert (recovered.value, recovered.n) == (1.0, 1) and recovered.low == pytest.approx(0.025)


def test_bias_is_of_what_the_data_hold():
    """A parameter that the data leave open by more than half of its plausible size is neither right nor wrong."""
    plain = Parameter("x", "mm", 0.0, plausible=2.0)
    variables = [Variable(name, (name,), plain) for name in ("led.x", "led.y", "loose")]

    def fit(*values):
        covariance = np.diag([0.01, 0.04, 9.0])
        return Fit(Values(), variables, np.array(values), covariance, 0.0, 1, [0], [0.0], [1], True, "")

    built = {"led.x": 1.0, "led.y": 1.0, "loose": 1.0}
    found = measures.bias(built, fit(1.4, 0.8, 50.0), fit(1.0, 0.9, 50.0))
    assert found[:2] == pytest.approx([(0.2 + 0.1) / 2, (0.0 + 0.05) / 2])
    assert found[2] == pytest.approx(np.sqrt(2 / np.pi) * (0.05 + 0.1) / 2)  # mean |error| of Gaussian errors
    assert measures.bias({}, fit(1, 1, 1), fit(1, 1, 1)) == [] and measures.bias(built, fit(1, 1, 1), None) == []


def test_parts_in_which_a_kind_acts_and_parts_that_are_found():
    stain = measures.parts_of(SCREENS["stain"](*screen(40, 40)))  # at 0.7 across, 0.35 down: the second row of four
    assert set(stain) >= {6} and {4, 12, 15}.isdisjoint(stain)
    assert measures.parts_of(SCREENS["tap"](*screen(40, 40))) == [
        4 * row + column for row in range(4) for column in (0, 1)
    ]

    def told(curve, sd):
        place = SimpleNamespace(coordinate="place", centres=[float(i) for i in range(16)], curve=curve, sd=sd)
        return SimpleNamespace(fingerprints=[place])

    curve = np.zeros(16)
    curve[[5, 6]] = 8.0
    assert sorted(measures.flagged(told(curve, np.ones(16)))) == [5, 6]
    rng = np.random.default_rng(0)  # nothing there: one run in twenty flags any part
    false = [bool(measures.flagged(told(rng.standard_normal(16), np.ones(16)))) for _ in range(400)]
    assert np.mean(false) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 400)
    assert measures.flagged(SimpleNamespace(fingerprints=[])) is None


def lens_of_maker(row, effects, law):
    """(W,) of what the lens of the maker of touch sensors makes of a row, given as f(edges of parts of pixels)."""
    from optics.proof.makers import touch as maker
    from optics.proof.rigs.touch import Wild

    class Line(Wild):
        def __init__(self):
            self.effects, self.other = effects, law == "other"
            self.values, self.camera, self.size, self.spp = {"camera.x_fov": 50.0}, "camera", (41, 31), 256

        def light(self, press):
            width, height = self.size
            edges = np.linspace(-maker.AROUND, 41 + maker.AROUND, width + 1)
            return {"led": np.tile(row(edges) * maker.FINE, (height, 1))[..., None]}

    return Line().smeared(())["led"][15, :, 0]


@pytest.mark.parametrize("law", ["same", "other"])
@pytest.mark.parametrize("variance", [0.02, 0.1, 0.5])
def test_makers_blur_has_the_variance_that_is_hidden(variance, law):
    """The second moment of what a smooth spot becomes, of either law; a Gaussian sampled once a pixel made 0.013
    of 0.1."""
    from scipy.special import ndtr

    x = np.arange(41) + 0.5
    found = lens_of_maker(lambda edges: np.diff(ndtr((edges - 20.5) / 2)), {"lens blur": variance}, law)
    spot = np.diff(ndtr((np.arange(42) - 20.5) / 2))
    assert found.sum() == pytest.approx(spot.sum(), rel=1e-6)
    # a disc of parts of pixels is an eighth of a pixel wider, in variance 1/12 of its square
    widened = ((found - spot) * (x - 20.5) ** 2).sum()
    assert widened == pytest.approx(variance, rel=0.005, abs=0.002 if law == "other" else 0)


def test_makers_blur_acts_within_pixels():
    """Of a line in a pixel, its neighbours get what a Gaussian about the line has there; by blur of the pixel's mean
    they would get the same wherever the line is. 3e-3: the line is a part of a pixel wide, which adds 1/12 of its
    square, 0.0013, to the variance and takes 0.0024 out of its pixel."""
    from scipy.special import ndtr

    for at in (20.0625, 20.4375, 20.9375):
        found = lens_of_maker(lambda edges: 1.0 * np.histogram([at], edges)[0], {"lens blur": 0.1}, "same")
        expected = np.diff(ndtr((np.arange(42) - at) / np.sqrt(0.1)))
        assert found == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize("law", ["same", "other"])
def test_makers_distortion_moves_edges_and_softens_none(law):
    """An edge at 33.3 px, seen where the law moves it: the pixel there has the share that is lit, its neighbours all or
    nothing. A spline through parts of pixels leaves 2e-4; one through pixel means left 0.04 and 0.06."""
    focal, k1, at = 20.5 / np.tan(np.radians(25)), 0.2, 33.3
    r2, far = ((at - 20.5) / focal) ** 2, (20**2 + 15**2) / focal**2
    moved = 20.5 + (at - 20.5) * (1 + k1 * (r2 if law == "same" else (r2 + r2**2 / far) / 2))
    lit = lambda edges: np.clip((at - edges[:-1]) / np.diff(edges), 0, 1) / 8  # noqa: E731
    found = lens_of_maker(lit, {"radial distortion": k1}, law)
    assert found == pytest.approx(np.clip(moved - np.arange(41), 0, 1), abs=1e-3)


def test_makers_blur_of_beads_moves_each_ray_by_itself():
    """A ray in the corner of a pixel brings its neighbours what a Gaussian about its place has there, to rounding, and
    at the border what left comes back."""
    from scipy.special import ndtr

    from optics.proof.makers.particle import ParticleMaker

    class Ray(ParticleMaker):
        def __init__(self):
            self.effects, self.size = {"lens blur": 0.3}, (12, 9)
            self.places = np.full((9, 12, 2), 0.9), np.full((9, 12, 2), 0.2)

    light = np.zeros((9, 12, 2, 1))
    light[4, 5, 0] = 2.0  # the mean of two rays
    down, across = (np.diff(ndtr((np.arange(n + 1) - at) / np.sqrt(0.3))) for n, at in ((9, 4 + 0.2), (12, 5 + 0.9)))
    assert Ray().behind_lens(light)[..., 0] == pytest.approx(np.outer(down, across), abs=1e-9)
    light[4, 5], light[0, 0] = 0.0, 1.0
    assert Ray().behind_lens(light).sum() == pytest.approx(1.0, abs=1e-9)


def test_finished_cells_beyond_the_plan_are_counted():
    """Cells of a later round that are kept belong to the count; those of other sensors and kinds do not."""
    from optics.proof.command import counted

    def record(name, rig="student", kind="none"):
        return {"name": name, "cell": {"rig": rig, "kind": kind}}

    records = {name: record(name) for name in "dba"}
    records |= {"p": record("p", kind="pair"), "g": record("g", rig="gelsight")}
    assert [r["name"] for r in counted(["b", "c"], records, ["student"], ["none"])] == ["b", "a", "d"]
    assert [r["name"] for r in counted(["b"], records, ["student"], None)] == ["b", "a", "d", "p"]
