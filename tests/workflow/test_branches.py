"""Photographs between crossed films that are turned together by hand: on which side of the extinction is each?"""

import numpy as np
import pytest
from PIL import Image

from optics.errors import Underdetermined
from optics.study import loop

HEIGHT, WIDTH, FIELD = 24, 32, 4.0  # px, px, deg across
DIAL = np.arange(0.0, 180.0, 20.0)
BLACK, TOP, GAIN, POWER = 8.0, 255.0, 0.04, 3e4  # DN, DN, DN per electron, DN between parallel films
ERROR = 0.6  # deg

HEAD = f"""
scene = "polarizer_bench"
bands = [535]
absent = ["sample"]
[noise]
system_gain = {GAIN}
dark_noise = 0.5
black_level = {BLACK}
saturation = {TOP}
prnu = 0.0
[parameters]
"middle.inserted" = 0
"camera.x_fov" = {FIELD}
"""
STATED = f"""
[uncertainty]
"polarizer.angle" = {ERROR}
"analyzer.angle" = {ERROR}
"""


def crossing(first, second):
    """(H, W) cos^2 of the angle between the directions that two films let through, p = k x c with k the ray and c the
    direction in the film that absorbs."""
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    focal = WIDTH / 2 / np.tan(np.radians(FIELD / 2))
    ray = np.stack([(column - WIDTH / 2) / focal, (HEIGHT / 2 - row) / focal, np.ones((HEIGHT, WIDTH))], -1)
    through = [np.cross(ray, [-np.sin(a), np.cos(a), 0.0]) for a in np.radians([first, second])]
    p, q = (t / np.linalg.norm(t, axis=-1, keepdims=True) for t in through)
    return np.sum(p * q, -1) ** 2


def photographs(path, rng, power=POWER, black=BLACK, stated=STATED):
    (path / "frames").mkdir(parents=True)
    text = HEAD + stated
    for index, dial in enumerate(DIAL):
        share = crossing(dial + ERROR * rng.standard_normal(), dial + 90 + ERROR * rng.standard_normal())
        electrons = rng.poisson(power * share / GAIN)
        image = np.round(black + GAIN * electrons + 0.5 * rng.standard_normal((HEIGHT, WIDTH)))
        Image.fromarray(np.clip(image, 0, TOP).astype(np.uint8)).save(path / f"frames/{index:02d}.png")
        text += f'[[frames]]\nimage = "frames/{index:02d}.png"\n[frames.parameters]\n'
        text += f'"polarizer.angle" = {dial}\n"analyzer.angle" = {dial + 90}\n'
    (path / "captures.toml").write_text(text)
    return path


def begun(tmp_path, seed, **options):
    captures = photographs(tmp_path / "set", np.random.default_rng(seed), **options)
    setup = loop.Setup(captures=str(captures), free=["source.power"], per_group=[])
    return loop.begin(setup, tmp_path / "study")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_each_photograph_finds_its_side_of_the_extinction(mitsuba, tmp_path, seed):
    """The brightness of each is the same on both sides; left on the sides that they began on, the first set
    ends with a lamp of 87 +- 16 where 380 is right."""
    study, model, fit = begun(tmp_path, seed)
    assert fit.chi2 < fit.dof + 4 * np.sqrt(2 * fit.dof), fit.chi2 / fit.dof
    d = loop.examine(study, model, loop.recorded(study.ladder["facts"]["setup"]), fit, advised=False)
    assert d.word == "NOTHING", d.sentence


@pytest.mark.slow
def test_errors_that_nobody_states_are_found_where_all_is_dark_by_what_is_written_down(mitsuba, tmp_path):
    """Of seven settings of each of two dials, seven sums are known: their width to 1/sqrt(14)."""
    study, model, fit = begun(tmp_path, 3, stated="")
    setup = loop.recorded(study.ladder["facts"]["setup"])
    widths = set(setup.uncertainty.values())
    assert len(widths) == 1 and all(0.45 < w / ERROR < 1.6 for w in widths), widths
    assert fit.chi2 < fit.dof + 4 * np.sqrt(2 * fit.dof), fit.chi2 / fit.dof
    d = loop.examine(study, model, setup, fit, advised=False)
    assert d.word == "NOTHING", d.sentence


def test_photographs_without_light_are_an_error_that_says_so(mitsuba, tmp_path):
    study, model, fit = begun(tmp_path, 1, power=0.0, black=BLACK - 0.5)
    with pytest.raises(Underdetermined, match="predicts no light in any of 7 frames"):
        loop.examine(study, model, loop.recorded(study.ladder["facts"]["setup"]), fit, advised=False)
