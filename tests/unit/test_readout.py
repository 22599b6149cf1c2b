"""`optics read`: drawn images whose markers, areas and likeness are known, written and read as files."""

import csv
import json

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import structural_similarity

from optics.cli import main

SHAPE = (90, 120)


def disc(x, y, radius, inside, outside):
    """(H, W) DN: a disc whose rim is mixed in an 8 x 8 raster per pixel."""
    v, u = (np.mgrid[: 8 * SHAPE[0], : 8 * SHAPE[1]] + 0.5) / 8
    cover = (np.hypot(u - x, v - y) < radius).reshape(SHAPE[0], 8, SHAPE[1], 8).mean((1, 3))
    return outside + (inside - outside) * cover


def noisy(image, seed):
    """8 bit, 1 DN rms."""
    return np.clip(np.round(image + np.random.default_rng(seed).normal(0, 1.0, image.shape)), 0, 255).astype(np.uint8)


def save(file, image):
    Image.fromarray(image).save(file)
    return str(file)


def rows(capsys, *words):
    assert main(["read", *words, "--json", "-q"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def places():
    x, y = np.meshgrid([20.0, 45.0, 70.0, 95.0], [20.0, 45.0, 70.0])
    return np.stack([x.ravel(), y.ravel()], -1)


def test_markers_and_their_motion(tmp_path, capsys, places):
    moved = places + np.random.default_rng(3).uniform(-3, 3, places.shape)
    files = [
        save(tmp_path / f"{name}.png", noisy(sum(disc(x, y, 4.0, 150, 0) for x, y in at) + 20, seed))
        for seed, (name, at) in enumerate((("rest", places), ("now", moved)))
    ]
    found = rows(capsys, "markers", files[1], "--reference", files[0], "--matrix", "4x3", "-o", str(tmp_path / "t.csv"))
    assert [row["marker"] for row in found] == list(range(12))
    # 0.1 px: 0.4 noise/excess of a pixel, and quantisation
    np.testing.assert_allclose([[r["dx"], r["dy"]] for r in found], moved - places, atol=0.1)
    np.testing.assert_allclose([[r["x"], r["y"]] for r in found], moved, atol=0.1)
    with open(tmp_path / "t.csv", newline="") as lines:
        table = list(csv.DictReader(lines))
    assert [float(r["dx"]) for r in table] == [r["dx"] for r in found]
    assert main(["read", "markers", files[1], "-o", str(tmp_path / "t.csv")]) == 2  # nothing is replaced
    capsys.readouterr()
    still = rows(capsys, "markers", files[0], "--matrix", "4x3")
    np.testing.assert_allclose([[r["x"], r["y"]] for r in still], places, atol=0.1)
    np.testing.assert_allclose([r["area"] for r in still], np.pi * 16, rtol=0.08)  # half a pixel of the rim


def test_proximity_of_a_folder(tmp_path, capsys):
    """Flat discs before a pinhole: r falls as d^-2, and the curve of one gives the distance of another."""
    background = save(tmp_path / "empty.png", noisy(np.full(SHAPE, 60.0), 0))
    (tmp_path / "near").mkdir()
    distances = [10.0, 8.0, 6.0, 5.0, 4.0]
    for i, d in enumerate(distances):
        save(tmp_path / "near" / f"{i}.png", noisy(disc(60, 45, 120 / d, 160, 60), i + 1))
    found = rows(capsys, "proximity", str(tmp_path / "near"), "--reference", background)
    np.testing.assert_allclose([r["area"] for r in found], [np.pi * (120 / d) ** 2 for d in distances], rtol=0.02)
    curve = tmp_path / "curve.csv"
    curve.write_text("r,distance\n" + "".join(f"{r['r']},{d}\n" for r, d in zip(found, distances)))
    one = save(tmp_path / "one.png", noisy(disc(60, 45, 120 / 7, 160, 60), 9))
    words = ("proximity", str(tmp_path / "near" / "0.png"), one, "--reference", background, "--curve", str(curve))
    assert rows(capsys, *words)[1]["distance"] == pytest.approx(7.0, abs=0.1)  # 1.5 % of the area


def test_a_grid_that_shifts_is_touched(tmp_path, capsys):
    lines = np.where((np.indices(SHAPE).sum(0) // 6) % 2, 120.0, 15.0)

    def frame(shift, seed):
        return noisy(np.stack([np.roll(lines, shift, 1) * gain for gain in (1.0, 0.9, 0.8)], -1), seed)

    still = [save(tmp_path / f"s{i}.png", frame(0, i)) for i in range(6)]
    now = [save(tmp_path / "a.png", frame(0, 10)), save(tmp_path / "b.png", frame(5, 11))]
    found = rows(capsys, "grid", *now, *(w for s in still for w in ("--reference", s)))
    assert [r["contact"] for r in found] == ["Untouched", "Touched"]
    assert found[0]["similarity"] > 0.98 > 0.6 > found[1]["similarity"]


def test_likeness_is_scikit_images(tmp_path, capsys):
    image = noisy(disc(60, 45, 20, 160, 60), 0)
    other = noisy(disc(62, 45, 20, 160, 60), 1)
    files = [save(tmp_path / "a.png", image), save(tmp_path / "b.png", other)]
    found = rows(capsys, "ssim", *files, "--reference", files[0])
    assert found[0]["ssim"] == 1 and found[0]["psnr"] is None
    wanted = structural_similarity(image / 255, other / 255, data_range=1.0)
    assert found[1]["ssim"] == pytest.approx(wanted, abs=1e-6)
    assert found[1]["l1"] == pytest.approx(np.abs(image / 255 - other / 255).mean(), rel=1e-6)


@pytest.mark.parametrize(
    "words, message",
    [
        ("ssim a.png", "no --reference; give the image to compare with"),
        ("markers a.png --curve a.csv", "--curve: without effect on 'markers'"),
        ("markers missing.png", "no such file or folder"),
        ("markers empty", "no images in it"),
        ("markers a.png a.png", "is named twice"),
        ("markers a.png --matrix 5", "allowed: COLUMNSxROWS"),
        ("markers a.png -o table.txt", "allowed: a name ending in .csv"),
        ("ssim a.png --reference small.png", "allowed: (10, 10, 1), 8 bit, as small.png"),
        ("grid a.png --reference a.png", "1 channels; allowed: R, G, B"),
        ("proximity a.png --reference b.png --curve bad.csv", "columns x; allowed: r and distance"),
        ("proximity a.png --reference b.png --curve turns.csv", "turns.csv: reference curve: r = 1 at 2 mm and 1"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for name in ("a.png", "b.png"):
        save(tmp_path / name, noisy(disc(60, 45, 20, 160, 60), 0))
    save(tmp_path / "small.png", np.zeros((10, 10), np.uint8))
    (tmp_path / "turns.csv").write_text("r,distance\n1,2\n1,3\n")
    (tmp_path / "bad.csv").write_text("x\n1\n")
    assert main(["read", *words.split()]) == 2
    assert message in capsys.readouterr().err
