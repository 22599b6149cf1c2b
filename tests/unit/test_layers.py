"""Layers in a scene: stress patterns from files, changes of a pattern, layers on shapes that cannot carry them."""

import shutil

import numpy as np
import pytest

from optics.errors import BadScene, UnknownKey
from optics.light.renderer import Renderer
from optics.scene import loader as scenes
from optics.scene.layer import PatternImage
from optics.scene.registry import known

CAMERA = {"width": "24", "height": "24", "x_fov": "6", "analyzer": "90"}


def bench(folder, **defines):
    shutil.copy(scenes.find("polarizer_bench"), folder / "bench.xml")
    return scenes.load(folder / "bench.xml", {**CAMERA, **defines})


def rendered(scene, **values):
    renderer = Renderer(scene)
    now = {**scene.values(), "sample.angle": 20.0, "sample.stress": 3.0, "sample.stress_size": 24.0, **values}
    return renderer, renderer.image(now, "source")


def test_a_pattern_from_a_file_is_the_formula_that_it_was_made_from(tmp_path):
    disc = (
        next(e for e in known().effects.values() if e.name == "stress birefringence")
        .stages["layer"]
        .__wrapped__.__globals__["disc"]
    )
    n = 480
    x, y = np.meshgrid((np.arange(n) + 0.5) / n * 24 - 12, 12 - (np.arange(n) + 0.5) / n * 24)  # row 0 at +y
    np.save(tmp_path / "disc.npy", np.stack(disc(x, y, 12.0), -1).clip(-40, 40))  # the loads' points are infinite
    _, want = rendered(bench(tmp_path, pattern="disc"))
    _, got = rendered(bench(tmp_path, pattern="disc.npy"))
    assert want.max() > 0.1  # fringes
    # linear between pixels of 0.05 mm, a fiftieth of the narrowest fringe away from the loads
    assert np.median(np.abs(got - want)) < 1e-4 and np.abs(got - want)[6:18].max() < 5e-3


def test_a_pattern_from_a_file_is_one_function_in_both_arithmetics(mitsuba, tmp_path):
    rng = np.random.default_rng(3)
    np.save(tmp_path / "p.npy", rng.normal(size=(7, 5, 2)))
    pattern = PatternImage(tmp_path / "p.npy")
    x, y = rng.uniform(-6, 6, (2, 4000, 1))
    exact = pattern(x, y, 10.0)
    found = pattern(mitsuba.Float(x.ravel().astype(np.float32)), mitsuba.Float(y.ravel().astype(np.float32)), 10.0)
    clear = (np.abs(np.abs(x) - 5) > 1e-4) & (np.abs(np.abs(y) - 5) > 1e-4)  # not on the border, where rounding decides
    for e, f in zip(exact, found):
        np.testing.assert_allclose(
            np.array(f)[clear.ravel()], e[clear], rtol=0, atol=2e-5
        )  # float32 of coordinates up to 7
        assert (e[(np.abs(x) > 5) | (np.abs(y) > 5)] == 0).all() and np.ptp(e) > 2


def test_a_pattern_from_a_file_has_its_derivatives(tmp_path):
    n = 40
    x, y = np.meshgrid((np.arange(n) + 0.5) / n * 24 - 12, 12 - (np.arange(n) + 0.5) / n * 24)
    np.save(tmp_path / "p.npy", np.stack([np.cos(0.3 * x + 0.2 * y), np.sin(0.4 * y - 0.1 * x)], -1))
    scene = bench(tmp_path, pattern="p.npy")
    renderer, _ = rendered(scene)
    base = {**scene.values(), "sample.angle": 20.0, "sample.stress": 3.0, "sample.stress_size": 24.0}
    for key, step in (("sample.angle", 1e-5), ("sample.stress_size", 1e-5)):  # so small that no ray changes its cell
        found = renderer.image({**base, key: base[key] + 1e-30j}, "source").imag / 1e-30
        high, low = (renderer.image({**base, key: base[key] + d}, "source") for d in (step, -step))
        np.testing.assert_allclose(found, (high - low) / (2 * step), rtol=0, atol=1e-6 * np.abs(found).max())
        assert np.abs(found).max() > 1e-3


def test_a_pattern_that_is_changed_changes_the_image(tmp_path):
    scene = bench(tmp_path, pattern="even")
    renderer, even = rendered(scene)
    now = {
        **scene.values(),
        "sample.angle": 20.0,
        "sample.stress": 3.0,
        "sample.stress_size": 24.0,
        "sample.stress_pattern": "disc",
    }
    assert np.abs(renderer.image(now, "source") - even).max() > 0.1


@pytest.mark.parametrize(
    "name, array, text",
    [
        ("flat.npy", np.zeros((4, 4)), r"flat.npy: shape \(4, 4\), type float64; allowed: \(H, W, 2 or more\)"),
        ("hole.npy", np.full((4, 4, 2), np.nan), "all finite"),
        ("none.npy", None, "no such file"),
    ],
)
def test_a_bad_pattern_is_refused(name, array, text, tmp_path):
    if array is not None:
        np.save(tmp_path / name, array)
    with pytest.raises(BadScene, match=text):
        bench(tmp_path, pattern=name)


def test_an_unknown_pattern_names_the_known_ones(tmp_path):
    with pytest.raises((BadScene, UnknownKey), match="disk.*disc"):
        bench(tmp_path, pattern="disk")


def test_the_skin_s_stress_needs_a_sheet_in_the_skin(tmp_path):
    with pytest.raises(BadScene, match="a shape of the type 'carried'"):
        bench(tmp_path, pattern="gel")


def test_a_film_on_a_disk_is_refused(tmp_path):
    text = scenes.find("polarizer_bench").read_text(encoding="utf-8")
    (tmp_path / "disk.xml").write_text(
        text.replace('type="rectangle" id="analyzer_plate"', 'type="disk" id="analyzer_plate"')
    )
    with pytest.raises(BadScene, match="'analyzer' stands on a disk"):
        Renderer(scenes.load(tmp_path / "disk.xml"))
