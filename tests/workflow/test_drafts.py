"""A draft is not tested on the captures that it was drawn from, wherever draft and captures lie; on others it is."""

import shutil

import numpy as np
import pytest

import optics as package
from optics.captures import capture_set as capture_files
from optics.captures import identity
from optics.captures.noise import Noise
from optics.proof.makers import bench as jones

DIODE = Noise(system_gain=0.05, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)
WHY = "drafted from these captures: it fits them by construction; test it on others"
RIPPLE = 0.03  # of the light, once up and down by the lamp's clock, which no effect of the library does


def bench(folder, seed):
    """Readings of two polarizers before a lamp that ripples with time."""
    settings = [
        {"polarizer.angle": a, "analyzer.angle": 11.25 * ((5 * i) % 32), "source.time": 10.0 * i / 32}
        for a in (0.0, 60.0, 100.0, 190.0)
        for i in range(32)
    ]
    plain = folder.with_name(folder.name + "-plain")
    jones.write(plain, jones.Truth(photodiode=jones.Photodiode(gain=2.2)), settings, DIODE, seed)
    found = capture_files.load(plain)
    for f in found.frames:
        f.image = 64 + (f.image - 64) * np.float32(1 + RIPPLE * np.cos(0.2 * np.pi * f.parameters["source.time"]))
    return capture_files.write(found, folder)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, mitsuba):
    """(folder of a study whose last diagnosis became a draft, the draft)."""
    from optics.study import draft

    folder = tmp_path_factory.mktemp("drafts")
    study = package.calibrate(bench(folder / "captures", 1), folder / "study")
    study.diagnose(advised=False)
    text, plugins = draft.from_study(study.folder, "source.time", "lamp ripple")
    return study.folder, draft.write(text, plugins, "lamp ripple")


@pytest.mark.slow
def test_the_same_data_do_not_test_a_draft(drawn, tmp_path):
    study, file = drawn
    again = package.Study.open(study).diagnose(advised=False)
    assert again.not_tested["lamp ripple"] == WHY and again.claimed != "lamp ripple"
    assert f"lamp ripple ({WHY})" in again.text()
    # another folder, another description of the same table: the same data still
    shutil.copytree(study.parent / "captures", tmp_path / "set")
    (tmp_path / "set" / "captures.toml").write_text(
        (tmp_path / "set" / "captures.toml").read_text(encoding="utf-8").replace("readings.csv", "moved.csv")
    )
    (tmp_path / "set" / "readings.csv").rename(tmp_path / "set" / "moved.csv")
    copied = package.calibrate(tmp_path / "set", tmp_path / "study", plugins=file)
    assert "lamp-ripple" in copied.model.scene.registry.effects
    assert "lamp-ripple" not in {e.key for e in copied.candidates()}
    # one half of it
    rows = (tmp_path / "set" / "moved.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "set" / "moved.csv").write_text("\n".join(rows[:65]) + "\n")
    part = package.calibrate(tmp_path / "set", tmp_path / "part", plugins=file)
    assert "lamp-ripple" not in {e.key for e in part.candidates()}


@pytest.mark.slow
def test_other_data_test_it_and_adding_stays_allowed(drawn, tmp_path):
    study, file = drawn
    others = package.calibrate(bench(tmp_path / "others", 2), tmp_path / "study", plugins=file.parent)
    verdict = others.diagnose(advised=False)
    assert "lamp ripple" not in verdict.not_tested
    assert max(verdict.rows, key=lambda r: r.fall).name == "lamp ripple"  # the curve holds for new readings too
    same = package.Study.open(study)
    before = same.records()[-1]["held_out_chi2_per_dof"]
    same.add("lamp ripple")
    assert same.records()[-1]["held_out_chi2_per_dof"] < 0.3 * before  # lines between few points are not the cosine


def test_an_image_is_known_again_without_its_name(tmp_path):
    rng = np.random.default_rng(0)
    images = [rng.normal(100, 5, (6, 8, 3)).astype(np.float32) for _ in range(100)]

    def of(some, names="a"):
        frames = [capture_files.Frame(f"{names}{i}", image) for i, image in enumerate(some)]
        return capture_files.Captures(tmp_path, "gelsight", frames)

    ours = identity.sketch_of(of(images[:3]))
    assert identity.shared(ours, identity.prints_of(of([images[50], images[2]], "b")), False)
    assert not identity.shared(ours, identity.prints_of(of(images[3:])), False)
    whole = identity.sketch_of(of(images))
    assert len(whole) == identity.SKETCH  # smaller than the set, and known again by a tenth of it all the same
    assert identity.shared(whole, identity.prints_of(of(images[::10])), False)
    dark = of([np.zeros((6, 8, 3), np.float32)])
    assert not identity.prints_of(dark)  # two frames without light are alike and say nothing
    assert identity.digest_of(of(images)) == identity.digest_of(of(images[::-1]))


def test_few_equal_lines_are_no_common_table(tmp_path):
    """Readings of few digits repeat by accident between two sessions."""
    captures = capture_files.Captures(tmp_path, "polarizer_bench", [], table=capture_files.Table("t.csv", ["v"]))
    (tmp_path / "t.csv").write_text("angle,v\n" + "".join(f"{i},{i % 7}\n" for i in range(40)))
    first = identity.sketch_of(captures)
    (tmp_path / "t.csv").write_text("angle,v\n" + "".join(f"{i},{i % 7 + (i % 3 > 0)}\n" for i in range(40)))
    assert not identity.shared(first, identity.prints_of(captures), True)
    (tmp_path / "t.csv").write_text("angle , v\n" + "".join(f"{i},{i % 7 + (i % 3 > 1)}\n" for i in range(40)))
    assert identity.shared(first, identity.prints_of(captures), True)
