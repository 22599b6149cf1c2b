"""Priors count as much more as a model misses its images by more than noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from optics.fit.tempering import sides, temperature, tempered, weight_of
from optics.scene.parameter import Parameter, Values, Variable

SIZE = (64, 96, 1)


def model_of(image):
    """A model that predicts nothing, with noise of one."""
    return SimpleNamespace(
        frames=[SimpleNamespace(image=image)],
        predict=lambda values, frames: [np.zeros(SIZE) for _ in frames],
        variance=lambda values, frame, prediction: np.ones(SIZE),
        usable=lambda frame: np.ones(SIZE, bool),
    )


def noise(seed, sd=1.0):
    return np.random.default_rng(seed).normal(0, sd, SIZE)


def test_noise_is_no_misfit():
    """Of twenty images of noise none is called a misfit: five standard deviations."""
    assert [temperature(model_of(noise(seed)), Values(), [0], 6144) for seed in range(20)] == [1.0] * 20


def test_neighbours_that_miss_alike_count_once():
    """An excess of 8 per value: alone in each pixel T = 9, in squares of 4 x 4 px sixteen times the excess. The scatter
    of 6144 values of chi2, and of 384 squares, is 2 % and 7 %; squares of 16 px that happen to add up are 6."""
    alone = temperature(model_of(noise(1, 3.0)), Values(), [0], 6144)
    assert 8.5 < alone < 3 * 9
    squares = np.random.default_rng(2).normal(0, 8**0.5, (16, 24, 1))
    image = np.kron(squares, np.ones((4, 4, 1))) + noise(3)
    found = temperature(model_of(image), Values(), [0], 6144)
    assert 0.7 * 16 * 8 < found < 3 * 16 * 8


def test_images_smaller_than_four_squares():
    """Of 5 x 7 px the largest square is one pixel: neighbours are not asked."""
    image = 3.0 * np.ones((5, 7, 1))
    model = model_of(image)
    model.predict, model.variance = (lambda *_: [np.zeros((5, 7, 1))]), (lambda *_: np.ones((5, 7, 1)))
    model.usable = lambda frame: np.ones((5, 7, 1), bool)
    assert temperature(model, Values(), [0], 35) == pytest.approx(9)


def test_squares_are_shares_of_the_image():
    assert (sides(128), sides(256), sides(60)) == ([32, 16, 8, 4, 2, 1], [64, 32, 16, 8, 4, 2, 1], [15, 7, 3, 1])
    assert sides(1) == [1]


@pytest.mark.parametrize("k", [2, 4])
def test_an_image_that_is_binned_weighs_what_is_known_alike(k):
    """The same misfit, alike over an eighth of the image, seen by k^2 times as many pixels, each with k times the
    noise: if T fell with finer pixels, their fits would run from the priors. T is 1400, by noise 2 % more or less."""
    coarse = np.kron(np.random.default_rng(4).normal(0, 4, (8, 12, 1)), np.ones((8, 8, 1)))
    fine = np.kron(coarse / k, np.ones((k, k, 1)))
    found = []
    for image in (coarse, fine):
        shape = image.shape
        model = SimpleNamespace(
            frames=[SimpleNamespace(image=image + np.random.default_rng(5).normal(0, 1, shape))],
            predict=lambda *_, shape=shape: [np.zeros(shape)],
            variance=lambda *_, shape=shape: np.ones(shape),
            usable=lambda _, shape=shape: np.ones(shape, bool),
        )
        found.append(temperature(model, Values(), [0], image.size))
    assert found[1] == pytest.approx(found[0], rel=0.1)


def test_a_prior_weighs_more_and_says_the_same():
    p = Parameter("a", "mm", 0.0, (-1.0, 1.0), "a number", plausible=1.0)
    known, free = Variable("a", ("m.a",), p, prior=(0.5, 0.1)), Variable("b", ("m.b",), p)
    one, other = tempered([known, free], 4.0)
    assert (one.prior, one.precision, other.precision) == (known.prior, pytest.approx(400.0), 0.0)
    assert weight_of([one, free]) == 4.0 and weight_of([]) == 1.0
    assert replace(one, weight=1.0) == known
