"""Camera rays, and finer samples, only where a fit looks: a mask that leaves a part of the image changes no value that
is used."""

from dataclasses import replace

import numpy as np
import pytest

from optics.light.samples import Traced
from optics.scene.parameter import Variable

BLUR = 0.4  # px


@pytest.mark.parametrize(("blur", "second"), ((0.0, 0.0), (BLUR, 0.0), (0.0, 0.5)))
def test_values_that_are_used_stay(bench, blur, second):
    """With light that is reflected twice, too, of which the rest of the image gathers little."""
    model = bench.model
    mask = np.zeros(model.shape[:2], bool)
    mask[20:40, 10:30] = True  # across the rim of the dent, where shadows and bends are
    frame = model.frames[0]
    keys = ("led_1.x", "gel.press_x", "membrane.sigma")
    variables = [Variable(key, (key,), bench.scene.parameters[key]) for key in keys]
    twice = model.renderer.bounce_key
    variables += [Variable(twice, (twice,), bench.scene.parameters[twice])]
    values = bench.at({bench.scene.key("camera", "blur") or "camera.blur": blur**2, twice: second})
    image = np.clip(model.predict(values)[0], 1, 0.9 * model.noise.saturation)  # nothing is clipped
    model.frames[0] = replace(frame, mask=mask, image=image)
    try:
        whole, slopes = next(iter(model.derivatives(values, variables)))
        model.renderer.forget_hits()
        with model.where_used():
            sparing, own = next(iter(model.derivatives(values, variables)))
            needed = model._needed(0).mask
            assert needed[mask].all() and not needed.all()
            followed = [hits.size for key, hits in model.renderer._hits.items() if key[0] is model._needed(0)]
            assert followed and max(followed) < 0.5 * mask.size
        again = model.predict(values)[0]
        far = ~model._needed(0).mask
    finally:
        model.frames[0] = frame
        model._needed_kept.clear()
    scale = np.abs(whole).max()
    # without a lens single precision is left; with one, a hundredth of the camera's dark noise of 1 DN
    assert np.abs(sparing - whole)[mask].max() < (0.01 if blur else 1e-6 * scale)
    for key in (*keys, twice):
        left = np.abs(own[key] - slopes[key])[mask].max() / np.abs(slopes[key]).max()
        # a blur far below a pixel rings: of the slope three pixels beside it brings 2 V/9 of V = .16 px^2, a few per
        # cent, of which finer samples change a part
        # the slope of the press is a difference of two images that hardly differ: it shows their single precision
        assert left < (5e-3 if blur else 1e-5 if key == "gel.press_x" else 1e-6), key
    assert np.array_equal(again, whole)  # outside of the context, all is as before
    assert np.abs(sparing - whole)[far].max() > 1e-4 * scale  # and within it something was left out


@pytest.mark.parametrize("shape", [(1, 1), (40, 1), (2, 40), (7, 9)])
def test_some_pixel_is_followed_of_every_image(shape):
    """Also where none is wanted; each pixel has one that stands for it, and those that are followed stand for
    themselves."""
    wanted = np.zeros(shape, bool)
    traced = Traced(wanted)
    assert len(traced.index) and traced.nearest.shape == (wanted.size,)
    assert np.array_equal(traced.nearest[traced.index], np.arange(len(traced.index)))
    wanted[0, 0] = True
    assert 0 in Traced(wanted).index
