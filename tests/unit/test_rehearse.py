"""What a rehearsal predicts for hidden effects, against the closed form for two rivals and against a diagnosis of what
was
really hidden."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.diagnosis.rehearse import imitate, rehearse
from optics.diagnosis.score import score
from optics.errors import BadCapture

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import LIBRARY, MockModel, mock_fit, simulate

FITTED = (0, 1, 2, 3)


def calibrated(truth=None, seed=1, side=20):
    model = MockModel(4, side)
    start = simulate(model, np.random.default_rng(seed), truth)
    return model, mock_fit(model, model.base_variables(FITTED), start, FITTED)


@pytest.fixture(scope="module")
def model():
    return calibrated()


def rivals(*names):
    return [e for e in LIBRARY if e.name in names]


def test_strengths_make_the_change_that_is_hidden(model):
    mock, fit = model
    found = rehearse(*model, LIBRARY, mock.variables_of, FITTED, change=0.004, draws=200)
    plain = mock.predict(fit.values)
    usable = [mock.usable(f) for f in FITTED]
    for row in found.rows:
        effect = next(e for e in LIBRARY if e.name == row.effect)
        if len(effect.parameters) > 1 or effect.scope == "frame" or effect.onset != "tangent":
            continue
        values = fit.values.copy()
        values.common[f"sensor.{effect.parameter_names[0]}"] = row.strength
        change = np.concatenate([(a - b)[u] for a, b, u in zip(mock.predict(values), plain, usable)])
        signal = np.concatenate([a[u] for a, u in zip(plain, usable)]).mean() - mock.noise.black_level
        assert np.sqrt(np.mean(change**2)) / signal == pytest.approx(
            0.004, rel=0.03
        )  # effects bend by so much at this size


def test_what_every_frame_has_for_itself_is_not_hidden_as_one_scale(model):
    """Frames up and down in turn: the same for all would be a scale, which calibration takes up (2 % were noticed)."""
    row = next(
        r
        for r in rehearse(*model, LIBRARY, model[0].variables_of, FITTED, change=0.004, draws=200).rows
        if r.effect == "flicker"
    )
    assert (
        row.noticed > 0.9 and row.first > 0.9
    )  # 0.4 % in each of four frames of 1200 values with 1 % noise: 10 sd and more


@pytest.mark.parametrize("change", [0.0005, 0.001, 0.002, 0.004])
def test_who_comes_first_is_as_two_rivals_have_it(model, change):
    """Of two free strengths, scores over their sd are x ~ N(a, 1) and y ~ N(a c, 1) with the correlation c, and |x| >
    |y| where x - y and x + y, which are independent, have one sign. 4000 draws: 2.5 % are three sd."""
    from scipy.special import ndtr

    pair = rivals("gamma", "LED lobe")
    found = rehearse(*model, pair, model[0].variables_of, FITTED, change=change, draws=4000)
    table = score(*model, pair, model[0].variables_of, FITTED).table
    v = table.information
    c = v[0, 1] / np.sqrt(v[0, 0] * v[1, 1])
    for row in found.rows:
        k = [e.name for e in pair].index(row.effect)
        a = abs(row.strength) * np.sqrt(v[k, k])
        less, more = ndtr(a * np.sqrt((1 - c) / 2)), ndtr(a * np.sqrt((1 + c) / 2))
        assert row.first == pytest.approx(less * more + (1 - less) * (1 - more), abs=0.025)
        assert row.mistaken_for in ("", *(e.name for e in pair)) and row.first + row.mistaken == pytest.approx(1)


def test_what_it_promises_comes(model):
    """Vignetting at a change that is named in nearly every draw, and at one that is hardly noticed, really hidden."""
    effects = rivals("vignetting", "LED lobe", "glare", "crosstalk")
    large, small = (rehearse(*model, effects, model[0].variables_of, FITTED, change=c).rows for c in (0.02, 0.0001))
    large, small = (next(r for r in rows if r.effect == "vignetting") for rows in (large, small))
    assert large.first > 0.98 and small.noticed < 0.2
    for row, stands_out in ((large, True), (small, False)):
        hidden, fit = calibrated({"vignetting": row.strength}, seed=2)
        table = score(hidden, fit, effects, hidden.variables_of, FITTED).table
        assert (table.p_best < 0.01) == stands_out
        if stands_out:
            assert table.order[0].effect.name == "vignetting"


def test_what_is_asked_for_must_be_something(model):
    with pytest.raises(ValueError, match="change = 0 %; allowed: above 0 %"):
        rehearse(*model, LIBRARY, model[0].variables_of, FITTED, change=0.0)


def test_it_reads_as_a_table(model):
    found = rehearse(*model, LIBRARY, model[0].variables_of, FITTED, change=0.005, draws=200)
    text = found.text()
    assert all(r.effect in text for r in found.rows) and "0.5 %" in text and "never named" in text
    assert {r.effect for r in found.rows} | set(found.unseen) == {e.name for e in LIBRARY}


class Brighter:
    """A model whose image is what was measured, brighter by so many DN."""

    def __init__(self, captures, images):
        self.captures, self.noise, self.images = captures, captures.noise, images
        self.frames = [replace(f, image=image) for f, image in zip(captures.frames, images)]

    def predict(self, values):
        return [image + values.more for image in self.images]


@pytest.mark.parametrize("cfa", [None, "RGGB"])
def test_measured_images_change_by_what_a_model_says_and_keep_their_noise(tmp_path, cfa):
    """All but what is cut off at saturation and at black; a mosaic in its own channels."""
    rng = np.random.default_rng(0)
    noise = Noise(system_gain=0.1, dark_noise=0.8, black_level=0.0, saturation=255.0, prnu=0.0)
    image = np.round(rng.uniform(20, 200, (12, 16, 1 if cfa else 3)))
    image[2:4, 3:5], image[7, 7] = 255.0, 0.0
    frame = capture_files.Frame("one", image.astype(np.float32))
    captures = capture_files.Captures(tmp_path, "digit", [frame], noise=noise, cfa=cfa)
    model = Brighter(captures, [np.repeat(image, 3, axis=2) if cfa else image])
    before = SimpleNamespace(more=0.0)
    folder = imitate(model, SimpleNamespace(more=0.25), tmp_path / "out", measured_at=before)
    found = capture_files.load(folder)
    cut = (image == 0) | (image == 255)
    assert np.array_equal(found.frames[0].image, np.where(cut, image, image + 0.25))
    signal = np.array([[[5.0], [100.0]]])
    assert found.noise.variance(signal) == pytest.approx(noise.variance(signal))  # with what was rounded
    with pytest.raises(BadCapture, match="none of the images would change"):
        imitate(model, before, tmp_path / "same", measured_at=before)
