"""Large images are diagnosed in cells: their noise, the same scene in cells, and refits that are taken up again."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from optics import facade
from optics.captures import capture_set
from optics.captures.capture_set import Captures, Frame
from optics.captures.cells import in_cells
from optics.captures.noise import Noise
from optics.fit import calibrate
from optics.fit.result import Fit
from optics.proof import demo
from optics.proof.makers import touch
from optics.scene import loader
from optics.scene.parameter import Parameter, Values, Variable
from optics.study import cells as cells_of_studies
from optics.study import loop
from optics.study import refits as refits_of_studies
from optics.study.cells import Cells
from optics.study.refits import Refits
from optics.study.setup import Setup


def test_cells_have_the_noise_of_means(tmp_path):
    """Counted over 20,000 cells: the variance of a mean is known to 1 %, so 4 % is four standard deviations."""
    noise = Noise(system_gain=0.2, dark_noise=3.0, black_level=20.0, saturation=4095.0, prnu=0.01)
    rng = np.random.default_rng(1)
    signal = np.full((300, 600, 1), 500.0)
    image = np.round(signal + rng.normal(0, 1, signal.shape) * noise.sd(signal)).astype(np.float32)
    mask = np.ones(image.shape[:2], bool)
    mask[10, 10] = False
    image[100, 301] = 4095.0
    captures = Captures(tmp_path, "gelsight", [Frame("f", image, mask=mask)], noise=noise)
    found = in_cells(captures, noise, 3)
    cells = found.frames[0]
    assert cells.image.shape == (100, 200, 1) and np.argwhere(~cells.mask).tolist() == [[3, 3], [33, 100]]
    spread = float(np.var(cells.image[cells.mask]))
    assert spread == pytest.approx(float(noise.in_cells(3).variance(np.array(500.0))), rel=0.04)
    with pytest.raises(ValueError, match="raw mosaics have no cells"):
        in_cells(replace(captures, cfa="RGGB"), noise, 2)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_means_of_neighbours_that_share_their_noise_scatter_more(k):
    """Noise that falls off by .8 and .5 per pixel, in two directions alike, from a recursive filter. At .8, 540 x 540
    pixels are some 14,000 independent areas, which tell a variance to 1.2 %."""
    from scipy.signal import lfilter

    rho = np.array([0.8, 0.5, 0.0])
    rng = np.random.default_rng(2)
    image = rng.standard_normal((600, 600, 3))
    for c, r in enumerate(rho):
        for axis in (0, 1):
            image[..., c] = lfilter([np.sqrt(1 - r**2)], [1, -r], image[..., c], axis)
    image = 100.0 + 3.0 * image[60:, 60:]
    noise = Noise(1e-9, 3.0, 0.0, 255.0, 0.0, 0.0, correlation=tuple(rho))
    means = image.reshape(540 // k, k, 540 // k, k, 3).mean((1, 3))
    assert means.var((0, 1)) == pytest.approx(noise.in_cells(k).variance(np.full(3, 100.0)), rel=0.05)
    one = Noise(1e-9, 3.0, 0.0, 255.0, 0.0, 0.0, correlation=0.5)
    assert means[..., 1].var() == pytest.approx(float(one.in_cells(k).variance(np.array(100.0))), rel=0.05)


@pytest.mark.parametrize("size", [(84, 60), (85, 61)])
def test_a_scene_in_cells_looks_the_same(mitsuba, size):
    """The untouched face, away from rims: the mean of 4 pixels against the middle of a cell, whose second derivatives
    are below a grey level. A field of view that ignored the cut column would be 1 % off, and a principal point half a
    pixel."""
    from optics.light.renderer import Renderer

    width, height = size
    scene = loader.load("gelsight", {"width": str(width), "height": str(height)})
    values = {**scene.values(), "camera.principal_x": 3.0, "camera.principal_y": -2.0, "led_1.power": 1.0}
    whole = SimpleNamespace(scene=scene, parameters=scene.parameters)
    cells = Cells(whole, 2)
    coarse = loader.load("gelsight", {"width": str(cells.columns), "height": str(cells.rows)})
    moved = {k: cells.into(k, v) if cells.turns(k) else v for k, v in values.items() if k in coarse.parameters}
    fine, rough = Renderer(scene).radiance(values), Renderer(coarse).radiance(moved)
    means = fine[: cells.rows * 2, : cells.columns * 2].reshape(cells.rows, 2, cells.columns, 2, -1).mean((1, 3))
    inner = (slice(3, -3), slice(3, -3))
    assert np.abs(rough[inner] / means[inner] - 1).max() < 2e-3
    back = cells.values_back(cells.values_into(Values({k: v for k, v in values.items() if cells.turns(k)})))
    for key, value in back.common.items():
        assert value == pytest.approx(values[key], abs=1e-9)


@pytest.mark.parametrize("frames, unfinished", [(None, False), ((0,), True)])
def test_a_strength_per_frame_leaves_no_law_of_all_frames_unfinished(frames, unfinished):
    """Chord steps brought 60 of the 270 that they promised. Beside a law that brought 580 that is no matter; a gain of
    each frame, which may be a lamp that wanders, is no such law."""
    p = Parameter("a", "1", 0.0, (-1.0, 1.0), "a number", plausible=1.0)
    known, best, bent = Variable("a", ("m.a",), p), Variable("g", ("m.g",), p, frames), Variable("b", ("m.b",), p)

    def fit(variables, chi2, converged=True, promised=math.nan):
        numbers = [0.0] * len(variables), np.eye(len(variables)), chi2, 90, [0], [chi2], [99], converged, ""
        return Fit(Values({v.keys[0]: 0.0 for v in variables}), variables, *numbers, promised=promised)

    base = fit([known], 1000.0)
    base.normal = object()
    refits = Refits(SimpleNamespace(captures=SimpleNamespace(table=None)), Setup("captures"), base, [])
    refits.chords = {("g",): fit([known, best], 420.0, promised=580.0), ("b",): fit([known, bent], 940.0, False, 270.0)}
    assert refits.unfinished(refits.chord([bent]), refits.leader(per_frame=False)) is unfinished
    assert not refits.unfinished(refits.chord([best]), refits.leader(per_frame=frames is not None))


def test_a_refit_is_taken_up_again(tmp_path, monkeypatch):
    """What was refitted before a diagnosis was stopped is read, and belongs to its base alone."""
    p = Parameter("a", "1", 0.0, (-1.0, 1.0), "a number", plausible=1.0)
    known, extra = Variable("a", ("m.a",), p), Variable("b", ("m.b",), p)
    base = Fit(Values({"m.a": 0.5}), [known], np.array([0.5]), np.eye(1), 9.0, 8, [0], [9.0], [9], True, "")
    base.normal = object()  # chord steps are possible
    plugin = tmp_path / "mine.py"
    plugin.write_text("one law")
    registry = SimpleNamespace(files=[plugin], own_files=[plugin], name_of=lambda file: file.name)
    model = SimpleNamespace(captures=SimpleNamespace(table=None), scene=SimpleNamespace(registry=registry))
    first = Refits(model, Setup("captures"), base, [], tmp_path / "refits")
    made = Fit(
        Values({"m.a": 0.25, "m.b": 0.125}, {3: {"m.c": 1.5}}),
        [known, extra],
        np.array([0.25, 0.125]),
        np.array([[1.0, 0.5], [0.5, np.inf]]),
        4.0,
        7,
        [0],
        [4.0],
        [9],
        True,
        "as it was",
    )
    first.keep(made, [extra])
    monkeypatch.setattr(Refits, "calibrated", lambda *_: pytest.fail("calibrated again"))
    again = Refits(model, Setup("captures"), base, [], tmp_path / "refits")
    found = again.of(model, [known, extra], Values(), [0])
    assert found.values == made.values and found.reason == "as it was" and found.chi2 == 4.0
    np.testing.assert_array_equal(found.covariance, made.covariance)
    other = replace(base, estimate=np.array([0.6]))
    assert Refits(model, Setup("captures"), other, [], tmp_path / "refits").taken_up([extra]) is None
    plugin.write_text("another law")
    assert Refits(model, Setup("captures"), base, [], tmp_path / "refits").taken_up([extra]) is None
    plugin.write_text("one law")
    assert Refits(model, Setup("captures"), base, [], tmp_path / "refits").taken_up([extra]) is not None
    file = next((tmp_path / "refits").iterdir())
    file.write_text(file.read_text()[:40])
    assert Refits(model, Setup("captures"), base, [], tmp_path / "refits").taken_up([extra]) is None


@pytest.mark.parametrize("promised, calibrated", [(55.0, True), (30.0, False)])
def test_chord_steps_that_stopped_short_of_a_promise_are_calibrated(monkeypatch, promised, calibrated):
    """Images of dials bend: chord steps reached 16 of 55 where a rival's reached 58. What was promised as much as the
    rival has is calibrated before they are compared; what was promised half of it is not."""
    p = Parameter("a", "1", 0.0, (-1.0, 1.0), "a number", plausible=1.0)
    known, extra, other = (Variable(name, (f"m.{name}",), p) for name in "abc")

    def fit(variable, chi2, **told):
        own = [known] if variable is None else [known, variable]
        return Fit(Values(), own, np.zeros(len(own)), np.eye(len(own)), chi2, 8, [0], [chi2], [9], **told)

    base = fit(None, 100.0, converged=True, reason="")
    base.normal = object()  # chord steps are possible
    model = SimpleNamespace(captures=SimpleNamespace(table=None), parameters={"m.a": p, "m.b": p, "m.c": p})
    refits = Refits(model, Setup("captures"), base, [])
    refits.coarse = 0.01
    refits.chords[("c",)] = fit(other, 42.0, converged=True, reason="chord steps", promised=60.0)
    refits.chords[("b",)] = fit(extra, 84.0, converged=False, reason="chord steps", promised=promised)
    whole = fit(extra, 40.0, converged=True, reason="converged")
    monkeypatch.setattr(calibrate, "fit", lambda *_, **__: whole)
    found = refits.of(model, [known, extra], Values(), [0])
    assert (found.reason == "converged") == calibrated and found.chi2 == (40.0 if calibrated else 84.0)


def test_how_far_refits_are_followed_does_not_depend_on_what_was_made_first(monkeypatch):
    """A calibration brings the best from 60 to 90. A rival that chord steps brought to 50, near 60 but not near 90, is
    calibrated too, as where another process makes it meanwhile."""
    p = Parameter("a", "1", 0.0, (-1.0, 1.0), "a number", plausible=1.0)
    known, best, rival = (Variable(name, (f"m.{name}",), p) for name in "abc")
    base = Fit(Values(), [known], np.zeros(1), np.eye(1), 100.0, 8, [0], [100.0], [9], True, "")
    base.normal = object()  # chord steps are possible
    after = {"b": 40.0, "c": 50.0}

    def extended(model, extra, **_):
        chi2 = after[extra[0].name]
        return replace(base, variables=[known, *extra], chi2=chi2, promised=100.0 - chi2, converged=False)

    def in_turn(frames, jobs):
        return ((n, job(model)) for n, job in enumerate(jobs))

    model = SimpleNamespace(captures=SimpleNamespace(table=None), parameters={"m.a": p, "m.b": p, "m.c": p})
    model.each = in_turn
    asked = []

    def calibrated(model, quick, **_):
        asked.append(quick.variables[1].name)
        return replace(quick, chi2=10.0 if asked[-1] == "b" else quick.chi2, converged=True)

    monkeypatch.setattr(calibrate, "extended", extended)
    monkeypatch.setattr(refits_of_studies, "_calibrated", calibrated)
    refits = Refits(model, Setup("captures"), base, [])
    refits.coarse = 0.01
    refits.foresee([[best], [rival]], lambda *_: None)
    assert asked == ["b", "c"]
    for extra in (best, rival):
        refits.of(model, [known, extra], Values(), [0])
    assert asked == ["b", "c"]  # and not again


def touched(folder, hidden, strength):
    """Captures of three presses under two LEDs by stock Mitsuba, with one effect, and the values that are known."""
    scene = loader.load("gelsight", {"width": "65", "height": "49"})
    built = {**demo.truth(scene, 4), "camera.exposure": demo.SENSORS["gelsight"][1]}
    maker = touch.Maker(scene, built, {hidden: strength}, demo.CAMERA, 1004, spp=32, frames=demo.FRAMES)
    drives = [{led: 1.0} for led in list(scene.leds)[:2]]
    shot = maker.captures(touch.presses(3, 4), drives, scene_name="gelsight")
    shot.parameters["camera.exposure"] = built["camera.exposure"]
    capture_set.write(shot, folder, bits=16)
    return built


@pytest.mark.slow
def test_a_calibration_that_begins_in_cells_ends_where_one_in_pixels_does(mitsuba, tmp_path, monkeypatch):
    """Of images that the model misses, as an effect is hidden: with the same chi2, and at most half as many
    linearisations in pixels. A principal point is in pixels."""
    built = touched(tmp_path / "captures", "lens vignetting", 0.1 * demo.SECRETS["lens vignetting"])
    started = {**built, "led_1.x": built["led_1.x"] + 0.5}
    setup = Setup(
        str(tmp_path / "captures"),
        values=started,
        free=["led_1.[xyz]", "led_*.power", "membrane.sigma", "camera.principal_x"],
        held_out=["press-02"],
    )
    counted, of_model = [], calibrate.fit

    def fit(model, variables, values, frames, **options):
        found = of_model(model, variables, values, frames, **options)
        counted.append((model.shape[:2], len(found.history)))
        return found

    ends, in_pixels = [], []
    monkeypatch.setattr(cells_of_studies, "SMALLEST", 16)
    for large in (10**6, 1500):
        monkeypatch.setattr(cells_of_studies, "LARGE", large)
        counted.clear()
        with monkeypatch.context() as patched:
            patched.setattr(calibrate, "fit", fit)
            _, model, found = loop.begin(setup, tmp_path / f"study-{large}")
        ends.append(found)
        in_pixels.append(sum(n for shape, n in counted if shape == model.shape[:2]))
        assert any(shape != model.shape[:2] for shape, _ in counted) == (large == 1500)
    direct, begun = ends
    assert direct.chi2 / direct.dof > 1.2  # it does miss
    # each ends where a step promises less than 2e-4 of the excess, along valleys with a few such steps ahead
    assert begun.chi2 == pytest.approx(direct.chi2, rel=0, abs=3e-3 * (direct.chi2 - direct.dof))
    assert in_pixels[1] <= in_pixels[0] / 2
    assert begun.values.common["camera.principal_x"] == pytest.approx(
        direct.values.common["camera.principal_x"], abs=0.01
    )


@pytest.mark.slow
def test_a_verdict_in_cells(mitsuba, tmp_path, monkeypatch):
    """Images by stock Mitsuba with one effect and a principal point off the middle, whose sides are no multiple of a
    cell: the effect is claimed in cells, and values are in pixels again."""
    hidden, strength = "lens vignetting", demo.SECRETS["lens vignetting"]
    built = touched(tmp_path / "captures", hidden, strength)
    free = ["led_1.power", "led_2.power", "membrane.sigma", "camera.principal_x"]
    study = facade.calibrate(tmp_path / "captures", tmp_path / "study", free=free, values=built, held_out=["press-02"])
    monkeypatch.setattr(cells_of_studies, "LARGE", 10_000)
    diagnosis = study.diagnose(advised=False)
    assert any("cells of 2 x 2 px" in warning for warning in diagnosis.warnings)
    assert diagnosis.missing == hidden, diagnosis.text()
    found = diagnosis.fits[hidden]
    at = [v.name for v in found.variables].index("camera.vignetting")
    # a cell is a mean of four pixels: its rims are not those of a pixel in its middle, 2 % at most
    assert found.estimate[at] == pytest.approx(strength, rel=0.02)
    shift = next(s for s in diagnosis.shifts if s.variable == "camera.principal_x")
    assert shift.unit == "cell" and found.values.common["camera.principal_x"] == pytest.approx(0, abs=0.05)
