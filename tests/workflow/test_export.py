"""Exports hold what the master files hold, as the libraries that learners use read them."""

import hashlib
import io
import json
import math
import os
import shutil
import subprocess
import sys
import tarfile

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from optics.cli import main
from optics.errors import OutputExists
from optics.study import batch, export

h5py = pytest.importorskip("h5py")
zarr = pytest.importorskip("zarr")
parquet = pytest.importorskip("pyarrow.parquet")

JOB = """
scene = "gelsight"
out = "out"
seed = 3
outputs = ["exr", "png", "dn"]
[defines]
width = 20
height = 16
[parameters]
"gel.indenter_size" = 2.0
[sample]
"gel.press_x" = { uniform = [-4, 4] }
"gel.indenter" = { choice = ["sphere", "cube"] }
"led_1.power" = { grid = [0.5, 1.0] }
"gel.press_depth" = { grid = [0.2, 0.4, 0.6] }
[noise]
system_gain = 0.05
dark_noise = 1.0
black_level = 8.0
saturation = 255.0
prnu = 0.01
"""
TOTAL = 6


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    (folder / "job.toml").write_text(JOB)
    assert batch.run(folder / "job.toml", workers=1).complete
    return folder / "out"


def png(made, index, end=""):
    with Image.open(made / "images" / f"{index:06d}{end}.png") as image:
        return np.asarray(image)


def channel(made, index, name):
    """Read by OpenEXR alone."""
    with OpenEXR.File(str(made / "images" / f"{index:06d}.exr"), separate_channels=True) as file:
        return np.array(file.channels()[name].pixels)


def records(made):
    return [json.loads(line) for line in (made / "manifest.jsonl").read_text().splitlines()]


def content(folder):
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def test_hdf5(made, tmp_path):
    card = export.export(made, tmp_path / "x", "hdf5", images="float", per_file=4)
    seen = []
    for name in sorted(p.name for p in (tmp_path / "x").glob("*.h5")):
        with h5py.File(tmp_path / "x" / name) as file:
            for row, index in enumerate(file["index"][:]):
                seen.append(index)
                np.testing.assert_array_equal(file["depth"][row], channel(made, index, "depth.Z"))
                np.testing.assert_array_equal(file["normal"][row, ..., 1], channel(made, index, "normal.Y"))
                np.testing.assert_array_equal(file["led_2"][row, ..., 0], channel(made, index, "led_2.R"))
                for nm in (610, 540, 460):
                    stored = file["radiance"][row, ..., card["bands_nm"].index(nm)]
                    np.testing.assert_array_equal(stored, channel(made, index, f"S0.{nm},000000nm"))
                drawn = records(made)[index]["sample"]
                assert file["values/gel.press_x"][row] == drawn["gel.press_x"]
                assert file["values/gel.indenter"].asstr()[row] == drawn["gel.indenter"]
            assert file["values/gel.press_x"].attrs["unit"] == "mm"
    assert seen == list(range(TOTAL))


def test_zarr(made, tmp_path):
    export.export(made, tmp_path / "x", "zarr", per_file=4)
    root = zarr.open_group(str(tmp_path / "x" / "samples.zarr"), mode="r")
    words = root["values/gel.indenter"].attrs["words"]
    for index, record in enumerate(records(made)):
        np.testing.assert_array_equal(root["camera_noisy"][index], png(made, index, "-dn"))
        np.testing.assert_array_equal(root["camera"][index], png(made, index))
        assert root["values/gel.press_x"][index] == record["sample"]["gel.press_x"] and root["index"][index] == index
        assert words[int(root["values/gel.indenter"][index])] == record["sample"]["gel.indenter"]


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_webdataset(made, tmp_path):
    """The warnings are of webdataset, which leaves its files to the garbage collector."""
    webdataset = pytest.importorskip("webdataset")
    card = export.export(made, tmp_path / "x", "webdataset", per_file=4)
    assert card["files"] == "samples-{000000..000001}.tar"
    reader = webdataset.WebDataset(str(tmp_path / "x" / card["files"]), shardshuffle=False, empty_check=False)
    items = list(reader.decode("rgb8"))
    assert [item["json"]["index"] for item in items] == list(range(TOTAL))
    for index, (item, record) in enumerate(zip(items, records(made))):
        np.testing.assert_array_equal(item["camera_noisy.png"], png(made, index, "-dn"))
        assert item["json"]["gel.press_x"] == record["sample"]["gel.press_x"]


def test_arrays_of_a_tar_are_npy(made, tmp_path):
    export.export(made, tmp_path / "x", "webdataset", images="float", arrays=["depth", "led_1"])
    with tarfile.open(tmp_path / "x" / "samples-000000.tar") as tar:
        assert len(tar.getnames()) == 3 * TOTAL
        stored = np.load(io.BytesIO(tar.extractfile("00000004.depth.npy").read()))
    np.testing.assert_array_equal(stored, channel(made, 4, "depth.Z"))


def test_lerobot(made, tmp_path):
    """Read by pyarrow; the library itself, which brings torch, in the next test."""
    export.export(made, tmp_path / "x", "lerobot", per_file=4)
    info = json.loads((tmp_path / "x/meta/info.json").read_text())
    episodes = parquet.read_table(tmp_path / "x/meta/episodes").to_pylist()
    assert info["total_episodes"] == 2 and [e["length"] for e in episodes] == [3, 3]
    state = info["features"]["observation.state"]["names"]
    rows = [
        row
        for n in range(1 + max(e["data/file_index"] for e in episodes))
        for row in parquet.read_table(
            tmp_path / "x" / info["data_path"].format(chunk_index=0, file_index=n)
        ).to_pylist()
    ]
    assert [(r["episode_index"], r["frame_index"]) for r in rows] == [(e, f) for e in range(2) for f in range(3)]
    for index, (row, record) in enumerate(zip(rows, records(made))):
        with Image.open(io.BytesIO(row["observation.images.camera"]["bytes"])) as image:
            np.testing.assert_array_equal(np.asarray(image), png(made, index))
        found = dict(zip(state, row["observation.state"]))
        assert found["gel.press_x"] == pytest.approx(record["sample"]["gel.press_x"], rel=1e-6)  # float32
        assert row["observation.gel.indenter"] == record["sample"]["gel.indenter"]
        assert found["gel.press_depth"] == pytest.approx((0.2, 0.4, 0.6)[row["frame_index"]])
    stats = json.loads((tmp_path / "x/meta/stats.json").read_text())["observation.images.camera"]
    pixels = np.stack([png(made, i) for i in range(TOTAL)]) / 255.0
    np.testing.assert_allclose(np.ravel(stats["mean"]), pixels.mean((0, 1, 2)), rtol=1e-12)
    np.testing.assert_allclose(np.ravel(stats["std"]), pixels.std((0, 1, 2)), rtol=1e-9)


READ_BY_LEROBOT = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

data = LeRobotDataset("local/made", root=sys.argv[1])
for i, sample in enumerate(data):
    image = np.round(np.asarray(sample["observation.images.camera"]).transpose(1, 2, 0) * 255)
    assert (image == np.asarray(Image.open(f"{sys.argv[2]}/images/{i:06d}.png"))).all(), i
    assert (int(sample["episode_index"]), int(sample["frame_index"])) == (i // 3, i % 3)
print(len(data), data.num_episodes)
"""


@pytest.mark.skipif("OPTICS_LEROBOT" not in os.environ, reason="OPTICS_LEROBOT names no Python that has lerobot")
def test_lerobot_itself_reads_what_was_written(made, tmp_path):
    """In a Python of its own: its packages and ours do not go together."""
    export.export(made, tmp_path / "x", "lerobot", per_file=4)
    words = [os.environ["OPTICS_LEROBOT"], "-c", READ_BY_LEROBOT, str(tmp_path / "x"), str(made)]
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, env=own)
    assert done.stdout.split() == [str(TOTAL), "2"], done.stderr


def test_a_single_number_of_lerobot_is_no_list(tmp_path):
    """Of a feature of the shape (1,) LeRobot's library reads numbers, and refuses a file with lists."""
    (tmp_path / "job.toml").write_text(
        'scene = "gelsight"\nout = "out"\noutputs = ["png"]\n[defines]\nwidth = 20\nheight = 16\n[sample]\n'
        '"gel.press_depth" = { grid = [0.2, 0.4] }\n'
    )
    export.export(batch.run(tmp_path / "job.toml", workers=1).folder, tmp_path / "x", "lerobot")
    info = json.loads((tmp_path / "x/meta/info.json").read_text())
    table = parquet.read_table(tmp_path / "x" / info["data_path"].format(chunk_index=0, file_index=0))
    assert info["features"]["observation.state"]["shape"] == [1]
    assert table.column("observation.state").to_pylist() == [pytest.approx(0.2), pytest.approx(0.4)]


def test_12_bits_stay_12_bits(tmp_path):
    """DN beyond 8 bits are kept as they are; the 8-bit preview is not passed for the camera's DN."""
    (tmp_path / "job.toml").write_text(JOB.replace("saturation = 255.0", "saturation = 4095.0"))
    folder = batch.run(tmp_path / "job.toml", workers=1).folder
    card = export.export(folder, tmp_path / "x", "hdf5")
    assert list(card["arrays"]) == ["camera_noisy"] and card["arrays"]["camera_noisy"]["dtype"] == "uint16"
    with h5py.File(tmp_path / "x/samples-000000.h5") as file:
        stored = file["camera_noisy"][:]
    assert 255 < stored.max() <= 4095
    with pytest.raises(ValueError, match="camera_noisy has 16 bits, and images of LeRobot have 8; allowed: --images"):
        export.export(folder, tmp_path / "y", "lerobot")
    assert export.export(folder, tmp_path / "y", "hdf5")["samples"] == TOTAL, "what was refused left nothing"


def labelled(made, folder, **labels):
    """A copy of the batch whose records have labels: name -> one a sample."""
    shutil.copytree(made, folder)
    lines = [
        {**record, "labels": {name: values[record["index"]] for name, values in labels.items()}}
        for record in records(made)
    ]
    (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


@pytest.mark.parametrize("to", export.FORMATS)
def test_labels_without_a_number_and_words_keep_their_place(made, tmp_path, to):
    """A marker leaves the image in samples 0 and 3: NaN there, and every other sample has its own number and word."""
    u, words = [None, 1.0, 2.0, None, 4.0, 5.0], ["cube", "sphere", "cone", "cube", "sphere", "ring"]
    batch = labelled(made, tmp_path / "batch", markers=[[[v, None]] for v in u], pose=[{"indenter": w} for w in words])
    card = export.export(batch, tmp_path / "x", to, per_file=2)
    keys, found = ("labels.markers.0.0", "labels.markers.0.1", "labels.pose.indenter"), []
    if to == "webdataset":
        for file in sorted((tmp_path / "x").glob("*.tar")):
            with tarfile.open(file) as tar:
                texts = [tar.extractfile(n).read().decode() for n in tar.getnames() if n.endswith(".json")]
            assert not any("NaN" in text for text in texts), "no JSON"
            found += [[json.loads(text)[key] for key in keys] for text in texts]
    elif to == "hdf5":
        for name in sorted((tmp_path / "x").glob("*.h5")):
            with h5py.File(name) as file:
                words_of = file[f"values/{keys[2]}"].asstr()[:]
                found += zip(*(file[f"values/{key}"][:] for key in keys[:2]), words_of)
    elif to == "zarr":
        root = zarr.open_group(str(tmp_path / "x" / "samples.zarr"), mode="r")
        columns = [root[f"values/{key}"][:] for key in keys]
        known = root[f"values/{keys[2]}"].attrs["words"]
        found = [(a, b, known[int(w)]) for a, b, w in zip(*columns)]
    else:
        names = json.loads((tmp_path / "x/meta/info.json").read_text())["features"]["observation.state"]["names"]
        for file in sorted((tmp_path / "x/data").rglob("*.parquet")):
            for row in parquet.read_table(file).to_pylist():
                state = dict(zip(names, row["observation.state"]))
                found.append((state[keys[0]], state[keys[1]], row[f"observation.{keys[2]}"]))
    nan = [math.nan if v is None else v for v in u]
    np.testing.assert_array_equal([math.nan if a is None else a for a, _, _ in found], nan)
    assert all(b is None or math.isnan(b) for _, b, _ in found) and [w for _, _, w in found] == words
    value = card["values"][keys[0]]
    assert (value["count"], value["min"], value["max"], value["mean"]) == (4, [1.0], [5.0], [3.0])
    assert card["values"][keys[1]]["mean"] == [None] and "no number" in (tmp_path / "x/card.md").read_text()


def test_samples_with_other_values_are_refused(made, tmp_path):
    batch = labelled(made, tmp_path / "batch", torque=[1.0, 2.0, "strong", 4.0, 5.0, 6.0])
    with pytest.raises(ValueError, match="sample 2: the value labels.torque is missing, new, or of another kind"):
        export.export(batch, tmp_path / "x", "zarr")


@pytest.mark.parametrize("to", export.FORMATS)
def test_an_export_that_was_cut_off_goes_on(made, tmp_path, monkeypatch, to):
    whole = export.export(made, tmp_path / "whole", to, per_file=3)
    write = export.FORMATS[to].write

    def cut(self, number, items):
        if number == 1:
            next(iter(items))
            raise KeyboardInterrupt
        write(self, number, items)

    monkeypatch.setattr(export.FORMATS[to], "write", cut)
    with pytest.raises(KeyboardInterrupt):
        export.export(made, tmp_path / "cut", to, per_file=3)
    monkeypatch.undo()
    assert not (tmp_path / "cut" / "card.json").exists()
    assert export.export(made, tmp_path / "cut", to, per_file=3) == whole
    apart = {k for k in content(tmp_path / "whole") if to == "hdf5" and k.endswith(".h5")}  # HDF5 keeps times
    one, two = content(tmp_path / "whole"), content(tmp_path / "cut")
    assert one.keys() == two.keys() and all(one[k] == two[k] for k in one.keys() - apart)
    before = content(tmp_path / "cut")
    export.export(made, tmp_path / "cut", to, per_file=3)
    assert content(tmp_path / "cut") == before, "a finished export is left alone"
    with pytest.raises(OutputExists, match="holds another export: changed per_file"):
        export.export(made, tmp_path / "cut", to, per_file=6)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of file sizes end processes elsewhere")
@pytest.mark.parametrize("to", ["hdf5", "zarr"])
def test_a_full_disk_is_said_and_the_export_goes_on(made, tmp_path, to):
    """A limit on the size of files stands for the disk. The HDF5 library ends the process where writing fails."""
    limited = (
        "import resource, sys\nfrom optics.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))\nsys.exit(main(sys.argv[1:]))\n"
    )
    words = ["export", str(made), "-o", str(tmp_path / "x"), "--to", to, "--images", "float"]
    done = subprocess.run([sys.executable, "-c", limited, *words], capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert str(tmp_path / "x") in done.stderr and "File too large" in done.stderr
    assert not list((tmp_path / "x").rglob("*.h5"))
    assert main(words) == 0
    whole = export.export(made, tmp_path / "whole", to, images="float")
    assert whole["samples"] == TOTAL and content(tmp_path / "x") == content(tmp_path / "whole")


def test_the_card_says_where_the_data_come_from(made, tmp_path):
    card = export.export(made, tmp_path / "x", "webdataset", licence="CC-BY-4.0")
    drawn = [r["sample"]["gel.press_x"] for r in records(made)]
    value = card["values"]["gel.press_x"]
    assert value["unit"] == "mm" and value["drawn"] == {"uniform": [-4.0, 4.0]}
    assert (value["min"], value["max"]) == ([min(drawn)], [max(drawn)])
    assert card["seed"] == 3 and card["licence"] == "CC-BY-4.0" and card["versions"]["mitsuba"]
    page = (tmp_path / "x/card.md").read_text()
    again = export.export(made, tmp_path / "x", "webdataset", licence="CC0-1.0")
    assert again["licence"] == "CC0-1.0" and "- licence: CC0-1.0" in (tmp_path / "x/card.md").read_text()
    assert export.export(made, tmp_path / "x", "webdataset") == again, "a licence that was stated stays"
    assert "CC-BY-4.0" in page and "| gel.press_x | mm | uniform [-4.0, 4.0] |" in page and "sphere (" in page


def test_a_series_of_sensors_is_told_in_table_and_card(tmp_path):
    """Who splits a set by sensors needs their numbers; what an effect draws is not 'fixed'."""
    (tmp_path / "job.toml").write_text(
        'scene = "gelsight"\nout = "out"\ncount = 4\nper_unit = 2\noutputs = ["png"]\n'
        '[defines]\nwidth = 20\nheight = 16\n[unit]\n"lens vignetting" = { plausible = 1 }\n'
    )
    made = batch.run(tmp_path / "job.toml", workers=1).folder
    rows = [line.split(",") for line in (made / "manifest.csv").read_text().splitlines()]
    assert rows[0][:3] == ["index", "unit", "camera.vignetting"]
    assert [row[1] for row in rows[1:]] == ["0", "0", "1", "1"] and rows[1][2] == rows[2][2] != rows[3][2]
    export.export(made, tmp_path / "x", "hdf5")
    card = (tmp_path / "x" / "card.md").read_text()
    assert "| camera.vignetting | 1 | with the effect lens vignetting |" in card, card
    assert "| unit |  | fixed, or a label | 0 to 1, mean 0.5 | number of the sensor in the series |" in card


def test_an_image_of_another_sample_is_refused(made, tmp_path):
    """Of the same size in pixels, so that nothing but the hash tells it: its labels would be wrong."""
    own = shutil.copytree(made, tmp_path / "batch")
    shutil.copy(own / "images" / "000001.png", own / "images" / "000000.png")
    with pytest.raises(ValueError, match=r"000000\.png: not the file that was recorded.*--check-files"):
        export.export(own, tmp_path / "out", "hdf5")
    (own / "images" / "000000.png").unlink()
    with pytest.raises(ValueError, match=r"000000\.png: no such file; run `optics batch` again"):
        export.export(own, tmp_path / "out2", "hdf5")


def test_what_cannot_be_exported_is_said(made, tmp_path, capsys):
    def said(*words):
        assert main(["export", *map(str, words)]) != 0
        return capsys.readouterr().err

    out = tmp_path / "x"
    assert "unknown format 'hdf6'; did you mean 'hdf5'" in said(made, "-o", out, "--to", "hdf6")
    assert "unknown kind of images 'floats'; did you mean 'float'" in said(
        made, "-o", out, "--to", "hdf5", "--images", "floats"
    )
    assert "unknown array 'deph'; did you mean 'depth'" in said(
        made, "-o", out, "--to", "hdf5", "--images", "float", "--array", "deph"
    )
    assert "no batch: job.json is missing" in said(tmp_path, "-o", out, "--to", "hdf5")
    assert not out.exists()
    out.mkdir()
    (out / "mine").write_text("")
    assert "exists and holds no export" in said(made, "-o", out, "--to", "hdf5")
