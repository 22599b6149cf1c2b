"""What a surface has of its own in each contact is told from laws of the sensor."""

from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis.patterns import by_surface, surface_text
from optics.diagnosis.statistics import Sweeps

SIDE, PITCH, RADIUS, LIGHTS = 96, 16, 5.0, 6
SIGMA = 4.0
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE] + 0.5
DOWN, RIGHT = ((a % PITCH - PITCH / 2) / RADIUS for a in (ROWS, COLUMNS))  # radii from the middle of the nearest ball
CONTACT = np.hypot(DOWN, RIGHT) < 1


def light(number):
    """DN without black level: balls under one lamp of a ring, darker across the field."""
    turn = 2 * np.pi * number / LIGHTS
    slope = np.where(CONTACT, 0.4 * (np.cos(turn) * RIGHT + np.sin(turn) * DOWN), 0.0)
    return (800 * (1 + slope) * (1 - 0.002 * ROWS))[..., None]


def session(change, seed=0, lights=LIGHTS):
    """(model, evidence, residuals over noise) of a plate of 36 balls: `change(number of the light)`, a share of it."""
    rng = np.random.default_rng(seed)
    frames = [
        SimpleNamespace(name=f"led_{k}", group="plate", parameters={f"led_{n}.power": float(n == k) for n in range(6)})
        for k in range(lights)
    ]
    shape = (SIDE, SIDE, 1)
    left = [change(k)[..., None] * light(k) / SIGMA + rng.standard_normal(shape) for k in range(lights)]
    for k, frame in enumerate(frames):
        frame.image = 8.0 + light(k) + SIGMA * left[k]
    model = SimpleNamespace(
        frames=frames,
        noise=SimpleNamespace(black_level=8.0),
        coordinates=lambda values, i: {"contact": CONTACT},
    )
    evidence = SimpleNamespace(
        spectrum=None,
        frames=range(lights),
        use=[np.ones(shape, bool)] * lights,
        sigma=[np.full(shape, SIGMA)] * lights,
    )
    return model, evidence, left


def texture(seed):
    return 0.02 * np.random.default_rng([seed, 7]).standard_normal((SIDE, SIDE))


def test_a_brightness_of_each_pixel_is_the_surface():
    model, evidence, left = session(lambda k: texture(0))
    found = by_surface(model, None, evidence, left)
    # 36 contacts of 80 pixels: 2 % to 2 %, less what 36 cells take of 2900 pixels
    assert found.contacts == 36 and found.share == pytest.approx(1.0, abs=0.04)
    assert found.rms == pytest.approx(0.02, rel=0.04)
    assert "one brightness of each pixel, the same under every light (2.0% rms)" in surface_text(found)
    assert abs(found.whole) < 0.05 and "of each contact" not in surface_text(found)


def test_a_brightness_of_each_contact_is_that_of_bodies_that_differ():
    """Balls differ by 1 % and pixels by 1 %: of what is left, balls have half. The rms of 36 balls is known to 12 %."""
    rows, columns = (np.floor(a / PITCH).astype(int) for a in (ROWS, COLUMNS))
    own = 0.01 * np.random.default_rng(3).standard_normal((6, 6))[rows, columns]
    found = by_surface(*(case := session(lambda k: own + texture(0) / 2))[:1], None, *case[1:])
    drawn = np.std(own[::PITCH, ::PITCH])
    assert found.whole_rms == pytest.approx(drawn, rel=0.15)
    assert found.whole == pytest.approx(drawn**2 / (drawn**2 + 0.01**2), abs=0.12)
    assert "one brightness of each contact" in surface_text(found)


@pytest.mark.parametrize(
    "law",
    {
        "vignetting": lambda k: -0.1 * ((ROWS / SIDE - 0.5) ** 2 + (COLUMNS / SIDE - 0.5) ** 2),
        "light from ball to ball": lambda k: 0.04 * DOWN**2 + 0.04 * RIGHT**2,
        "one lamp": lambda k: np.full((SIDE, SIDE), 0.04 * (k == 2)),
        "glitter, which each light finds elsewhere": texture,
    }.items(),
    ids=lambda law: law[0],
)
def test_laws_of_the_sensor_are_not_the_surface(law):
    model, evidence, left = session(law[1])
    found = by_surface(model, None, evidence, left)
    # of what each light finds elsewhere, the mean over six has a sixth
    assert found.share < 0.2 and not surface_text(found)


def test_noise_few_lights_few_contacts_and_tables_have_no_surface():
    nothing, few = session(lambda k: np.zeros((SIDE, SIDE))), session(lambda k: texture(0), lights=2)
    model, evidence, left = session(lambda k: texture(0))
    corner = SimpleNamespace(**{**vars(model), "coordinates": lambda *_: {"contact": CONTACT & (ROWS < PITCH)}})
    table = SimpleNamespace(**{**vars(evidence), "spectrum": Sweeps()})
    for case in (nothing, few, (corner, evidence, left), (model, table, left)):
        found = by_surface(case[0], None, case[1], case[2])
        assert np.isnan(found.share) and not surface_text(found)
