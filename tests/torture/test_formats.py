"""Every file format, mutated: values replaced by hostile ones, keys misspelt, lines lost or doubled, texts cut off,
bytes flipped. Nothing raises what is not ours, hangs, or is taken for something else without a word."""

import copy
import io
import json
import re
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from optics.captures import capture_set, readings
from optics.errors import BadCapture
from optics.files import exr
from optics.files.images import read_image, read_mask
from optics.study.fit_files import Posterior, read_fit
from optics.study.setup import ADVICE

# fmt: off
VALUES = [
    "nan", "inf", "-inf", "1e400", "-1", "0", "1", "-0.0", "1e-300", "1e300", "9223372036854775808", "9" * 5000, "true",
    "false", "[]", "{}", "[[]]", "[nan]", '[1,"x"]', '["a.png"]', "{a=1}", "1979-05-27", "12:00:00", "0x10", "1_0",
    '""', '"x"', '"."', r'"\u0000"', '"../../../etc/passwd"', '"/etc/passwd"', '"/dev/zero"', '"/dev/stdin"',
    '"' + "long" * 5000 + '"', "[" * 50 + "]" * 50, "[" * 3000,
]
# fmt: on


@st.composite
def mutations(draw, text):
    """A text with one to three mutations of a file's own lines and values."""
    for _ in range(draw(st.integers(1, 3))):
        lines = text.split("\n")
        n = draw(st.integers(0, max(len(lines) - 1, 0)))
        kind = draw(st.sampled_from(("value", "value", "value", "drop", "double", "key", "cut", "junk", "swap", "bom")))
        if kind == "value" and "=" in lines[n]:
            lines[n] = lines[n].split("=")[0] + "= " + draw(st.sampled_from(VALUES))
        elif kind == "drop":
            del lines[n]
        elif kind == "double":
            lines.insert(n, lines[n])
        elif kind == "key" and len(lines[n]) > 2:
            at = draw(st.integers(0, len(lines[n]) - 2))
            lines[n] = lines[n][:at] + lines[n][at + 1] + lines[n][at] + lines[n][at + 2 :]
        elif kind == "swap" and lines:
            m = draw(st.integers(0, len(lines) - 1))
            lines[n], lines[m] = lines[m], lines[n]
        elif kind == "junk":
            lines.insert(n, draw(st.text(max_size=20)))
        text = "\n".join(lines)
        if kind == "cut":
            text = text[: draw(st.integers(0, len(text)))]
        if kind == "bom":
            text = "\ufeff" + text.replace("\n", "\r\n")
    return text


def write(file, text):
    file.write_bytes(text.encode("utf-8", errors="surrogatepass"))


@pytest.mark.slow
@given(data=st.data())
@pytest.mark.parametrize("kind", ["images", "readings"])
def test_captures_toml(material, met, tmp_path_factory, kind, data):
    folder = shutil.copytree(material / kind, tmp_path_factory.mktemp("set") / kind)
    write(folder / "captures.toml", data.draw(mutations((folder / "captures.toml").read_text())))
    met("compare", folder)


@given(data=st.data())
def test_a_table_of_readings(material, met, tmp_path_factory, data):
    folder = shutil.copytree(material / "readings", tmp_path_factory.mktemp("set") / "readings")
    text = (folder / "readings.csv").read_text()
    cells = ["", "nan", "inf", "1e400", "x", '"', "-1", "9" * 400, "1,5", "1.5", "\0", "=1+1", "é", "0x1"]
    for _ in range(data.draw(st.integers(1, 4))):
        lines = text.split("\n")
        n = data.draw(st.integers(0, len(lines) - 1))
        row = lines[n].split(";")
        row[data.draw(st.integers(0, len(row) - 1))] = data.draw(st.sampled_from(cells))
        lines[n] = ";".join(row)
        text = "\n".join(lines)
    write(folder / "readings.csv", text[: data.draw(st.sampled_from([len(text), len(text) // 2, 3, 0]))])
    met("compare", folder)


@given(data=st.data())
def test_a_job(material, met, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("job")
    shutil.copy(material / "small.xml", folder)
    write(folder / "job.toml", data.draw(mutations((material / "job.toml").read_text())))
    met("batch", folder / "job.toml", "--workers", "1")


@given(data=st.data())
def test_advice_of_an_import(material, met, tmp_path_factory, data):
    folder = shutil.copytree(material / "images", tmp_path_factory.mktemp("set") / "images")
    known = st.sampled_from([*ADVICE, "plugins", "seed", "x"])
    value = st.recursive(
        st.one_of(
            st.none(), st.booleans(), st.integers(), st.floats(), st.sampled_from(["led_1.power", "*", "", "none"])
        ),
        lambda inner: st.one_of(st.lists(inner, max_size=2), st.dictionaries(known, inner, max_size=2)),
        max_leaves=4,
    )
    advice = data.draw(st.one_of(value, st.dictionaries(known, value, max_size=3)))
    (folder / "import.json").write_text(json.dumps({"setup": advice}))
    met("compare", folder)


@given(data=st.data())
def test_a_fit(material, met, tmp_path_factory, data):
    file = tmp_path_factory.mktemp("fit") / "fit.toml"
    write(file, data.draw(mutations((material / "study" / "steps" / "00-base" / "fit.toml").read_text())))
    met("mueller", "--fit", file)
    met("compare", material / "readings", "--fit", file)


@given(data=st.data())
@pytest.mark.parametrize("name", ["ladder.json", "step.json", "metrics.json", "diagnosis.json"])
def test_a_study(material, met, tmp_path_factory, name, data):
    study = shutil.copytree(material / "study", tmp_path_factory.mktemp("study") / "study")
    file = study / name if name == "ladder.json" else study / "steps" / "00-base" / name
    record = json.loads(file.read_text())
    value = st.sampled_from([None, -1, 0, 1e300, True, "", "x", "../..", [], {}, [1], {"a": 1}, ["x"], [[]]])
    for _ in range(data.draw(st.integers(1, 2))):
        at = record
        while isinstance(at, (dict, list)) and at:
            key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            if not isinstance(at[key], (dict, list)) or not at[key] or data.draw(st.booleans()):
                if isinstance(at, dict) and data.draw(st.booleans()):
                    del at[key]
                else:
                    at[key] = copy.deepcopy(data.draw(value))
                break
            at = at[key]
    text = json.dumps(record)
    file.write_text(text[: data.draw(st.sampled_from([len(text), len(text), len(text), len(text) // 2, 0]))])
    met("report", study, "-o", study / "page.html")
    met("values", study)


@pytest.mark.slow
@given(data=st.data())
@pytest.mark.parametrize("name", ["manifest.jsonl", "job.json", "parameters.json", ".parts"])
def test_a_batch(material, met, tmp_path_factory, name, data):
    """Records of a batch, damaged: the next run ends with the images of the first or with an error, and an export gives
    what the batch's own folder holds, or an error."""
    folder = tmp_path_factory.mktemp("batch")
    for file in ("small.xml", "made.toml"):
        shutil.copy(material / file, folder)
    made = shutil.copytree(material / "made", folder / "made")
    images = {f.name: f.read_bytes() for f in (made / "images").iterdir()}
    file = made / name
    if name == ".parts":  # as a run leaves them that was killed
        file.mkdir()
        for index, line in enumerate((made / "manifest.jsonl").read_text().splitlines()):
            (file / f"{index:05d}.{data.draw(st.sampled_from(['part', 'jsonl']))}").write_text(line + "\n")
        (made / "manifest.jsonl").unlink()
        file = file / data.draw(st.sampled_from(sorted(f.name for f in file.iterdir())))
    lines = file.read_text().splitlines() if name in ("manifest.jsonl", ".parts") else [file.read_text()]
    records = [json.loads(line) for line in lines]
    value = st.sampled_from(
        [None, True, -1, 1.5, 10**30, "x", "\0", "/etc/passwd", "../../../../etc/passwd", [], {}, [1], {"a": 1}, [[]]]
    )
    for _ in range(data.draw(st.integers(1, 2))):
        at = records
        while isinstance(at, (dict, list)) and at:
            key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            if not isinstance(at[key], (dict, list)) or not at[key] or data.draw(st.booleans()):
                if data.draw(st.booleans()):
                    del at[key]
                else:
                    at[key] = copy.deepcopy(data.draw(value))
                break
            at = at[key]
    text = "\n".join(json.dumps(record) for record in records) + "\n"
    more = data.draw(st.sampled_from(["", "", "", "null\n", "[" * 9000, '{"try": [], "run": 1}\n', "\xff\x00"]))
    raw = (text + more).encode("latin-1")
    file.write_bytes(raw[: data.draw(st.sampled_from([len(raw), len(raw), len(raw), len(raw) // 2, 0]))])
    if data.draw(st.booleans()):
        code, _ = met("export", made, "-o", folder / "data", "--to", data.draw(st.sampled_from(["webdataset", "hdf5"])))
        assert code == 0 or not (folder / "data" / "card.json").exists()
        assert not any(b"root:" in f.read_bytes() for f in folder.rglob("*.tar"))
    if met("batch", folder / "made.toml", "--workers", "1")[0] == 0:
        assert {f.name: f.read_bytes() for f in (made / "images").iterdir()} == images
        assert len((made / "manifest.jsonl").read_text().splitlines()) == 3


# -- boards, scans, posteriors ---------------------------------------------------------------------------------------
CELLS = [
    "", "nan", "inf", "1e300", "1e30", "-1", "9" * 400, "1,5", "1.234,5", "1.5mm", "1 in", "3 ft", "D1", "Ref", "PosX",
    "\0", "=1+1", "\u0661", '"', "x" * 200_000, "#", "Unit = furlong", "mm", "(mil)", "[ft]",
]  # fmt: skip


@given(data=st.data())
@pytest.mark.parametrize("kind", ["kicad", "ascii", "altium", "easyeda"])
def test_a_pick_and_place_file(material, met, tmp_path_factory, kind, data):
    """Up to three mutations of cells, rows and heads: a place that comes out is that of a board's size."""
    from optics.scene.pick_and_place import LARGEST, placed

    folder = tmp_path_factory.mktemp("board")
    for name in ("board.xml", f"{kind}.csv"):
        shutil.copy(material / name, folder)
    text = (folder / f"{kind}.csv").read_text()
    for _ in range(data.draw(st.integers(1, 3))):
        lines = text.split("\n")
        n = data.draw(st.integers(0, len(lines) - 1))
        if data.draw(st.booleans()):
            cut = re.split(r"([,;\t]| +)", lines[n])
            cut[2 * data.draw(st.integers(0, len(cut) // 2))] = data.draw(st.sampled_from(CELLS))
            lines[n] = "".join(cut)
        else:
            lines.insert(data.draw(st.integers(0, len(lines))), lines[n])
        text = "\n".join(lines)
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"]))
    raw = text.encode(encoding, errors="replace")
    (folder / f"{kind}.csv").write_bytes(raw[: data.draw(st.sampled_from([len(raw), len(raw), len(raw) // 2, 3, 0]))])
    name = data.draw(
        st.sampled_from([f"{kind}.csv:D1"] * 6 + ["/etc/passwd:root", "../x.csv:D1", f"{kind}.csv:", ".:D"])
    )
    file = folder / "board.xml"
    file.write_text(file.read_text().replace("FILE:D1", name))
    code, _ = met("params", file)
    if code == 0:
        assert all(abs(value) <= LARGEST for value in placed(name, [folder]))


def test_the_pick_and_place_files_are_good(material, met):
    for kind in ("kicad", "ascii", "altium", "easyeda"):
        text = (material / "board.xml").read_text().replace("FILE", f"{kind}.csv")
        (material / f"{kind}.xml").write_text(text)
        assert met("params", material / f"{kind}.xml") == (0, "")


@given(data=st.data())
def test_a_scan(material, met, tmp_path_factory, data):
    """scan.yaml with entries of other kinds, lost, or mutated as text; images lost, of other sizes, or none."""
    import yaml

    folder = tmp_path_factory.mktemp("scan")
    source = shutil.copytree(material / "scans", folder / "scans")
    file = source / data.draw(st.sampled_from(["one", "one", "flat"])) / "scan.yaml"
    record = yaml.safe_load(file.read_text())
    value = st.sampled_from(
        [None, True, -1, 0, 1, 1e-300, 1e300, 10**400, float("nan"), "", "x", "GridCircle", "../one/image08.png"]
        + ["/etc/passwd", "image07.png", "a\0.png", "x" * 3000, [], {}, [[]], ["image07.png"], {"type": "GridCircle"}]
    )
    for _ in range(data.draw(st.integers(0, 2))):
        at = record
        while isinstance(at, (dict, list)) and at:
            key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            if not isinstance(at[key], (dict, list)) or not at[key] or data.draw(st.booleans()):
                at[key] = copy.deepcopy(data.draw(value))
                break
            at = at[key]
    text = yaml.safe_dump(record)
    if data.draw(st.booleans()):
        text = data.draw(mutations(text.replace(": ", "= "))).replace("= ", ": ")  # which knows values behind =
    write(file, text)
    image = file.parent / "image08.png"
    spoil = data.draw(st.sampled_from(["", "", "", "absent", "text", "size", "black", "colour"]))
    if spoil == "absent":
        image.unlink()
    elif spoil == "text":
        image.write_bytes(b"no image")
    elif spoil:
        shape = {"size": (5, 7), "black": (96, 128), "colour": (96, 128, 3)}[spoil]
        pixels = np.arange(np.prod(shape)).reshape(shape) % 200 * (spoil != "black")
        Image.fromarray(pixels.astype(np.uint8)).save(image)
    code, _ = met("import", source, "-o", folder / "out")
    if code == 0:
        assert met("params", folder / "out" / "scene.xml")[0] == 0
    else:
        assert not (folder / "out").exists()


def test_the_scans_are_good(material, met, tmp_path):
    assert met("import", material / "scans", "-o", tmp_path / "out") == (0, "")


@given(data=st.data())
def test_a_posterior(material, met, tmp_path_factory, data):
    """What is read can be drawn from: a covariance without negative eigenvalues, of finite numbers."""
    folder = tmp_path_factory.mktemp("posterior")
    text = (material / "study" / "steps" / "00-base" / "fit.toml").read_text()
    begin, end = text.index("[posterior]"), text.index("[sensor]")
    numbers = st.one_of(st.floats(), st.integers(-2, 2), st.sampled_from([True, "x", [], [1.0]]))
    keys = st.sampled_from([["source.power"], ["no.such"], ["sample.region_map"], [], "source.power", [1]])
    table = {
        "variables": data.draw(st.lists(st.sampled_from(["a", "b", "c", "source.power", 3]), max_size=3)),
        "keys": data.draw(st.lists(keys, max_size=3)),
        "value": data.draw(st.lists(numbers, max_size=3)),
        "sd": data.draw(st.lists(st.one_of(numbers, st.just(0.1)), max_size=3)),
        "correlation": data.draw(st.lists(st.lists(st.one_of(numbers, st.just(1.0)), max_size=3), max_size=3)),
        "more": 1,
    }
    good = {
        "variables": ["source.power", "b"],
        "keys": [["source.power"], ["analyzer.transmittance"]],
        "value": [3.0, 0.8],
        "sd": [0.1, 0.01],
        "correlation": [[1.0], [data.draw(st.sampled_from([0.5, -1.0, 1.2, 1.0])), 1.0]],
    }
    for name in data.draw(st.lists(st.sampled_from(sorted(table)), max_size=2, unique=True)):
        good[name] = table[name]
    good.pop(data.draw(st.sampled_from(["none", "none", "none", "sd", "keys"])), None)
    fit = text[:begin] + "[posterior]\n" + "".join(f"{k} = {_toml(v)}\n" for k, v in good.items()) + "\n" + text[end:]
    write(folder / "fit.toml", data.draw(st.sampled_from([fit, fit, fit, fit, data.draw(mutations(fit))])))
    job = 'fit = "fit.toml"\nout = "out"\ncount = 2\noutputs = ["exr"]\nposterior = '
    (folder / "job.toml").write_text(job + data.draw(st.sampled_from(["true"] * 4 + ['["*"]', '["x*"]', "[]", "3"])))
    code, _ = met("batch", folder / "job.toml", "--workers", "1")
    assert code == 0 or not (folder / "out").exists()
    if code == 0:
        read = Posterior.from_table(read_fit(folder / "fit.toml")["posterior"], "")
        assert np.linalg.eigvalsh(read.covariance / np.outer(*2 * [np.sqrt(np.diag(read.covariance))]))[0] > -1e-5


def _toml(value):
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return (
        {True: "true", False: "false"}[value]
        if isinstance(value, bool)
        else json.dumps(value).replace("NaN", "nan").replace("Infinity", "inf")
    )


# -- images ----------------------------------------------------------------------------------------------------------
def encoded():
    """A small image in every format that is read."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (9, 11, 3)).astype(np.uint8)
    found = {}
    for name, kind in ((".png", "PNG"), (".tif", "TIFF")):
        stream = io.BytesIO()
        Image.fromarray(image).save(stream, kind)
        found[name] = stream.getvalue()
    stream = io.BytesIO()
    np.save(stream, image.astype(np.float32))
    return {**found, ".npy": stream.getvalue()}


ENCODED = encoded()


@given(data=st.data())
@pytest.mark.parametrize("suffix", [*ENCODED, ".exr"])
def test_an_image(mitsuba, tmp_path_factory, suffix, data):
    file = tmp_path_factory.mktemp("image") / f"a{suffix}"
    if suffix == ".exr":
        exr.write(file, {n: np.ones((9, 11), np.float32) for n in "RGB"}, {})
    raw = bytearray(ENCODED[suffix] if suffix in ENCODED else file.read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(0, min(len(raw) - 1, 300)))] = data.draw(st.integers(0, 255))
    file.write_bytes(bytes(raw[: data.draw(st.sampled_from([len(raw), len(raw), len(raw) // 2, 20, 1, 0]))]))
    for read in (lambda: read_image(file, "here"), lambda: read_mask(file, (9, 11), "here")):
        try:
            read()
        except BadCapture as error:
            assert "here" in str(error)


@given(st.binary(max_size=200))
def test_bytes_that_are_nothing(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("bytes")
    for name in ("captures.toml", "fit.toml", "a.csv", "a.png", "a.tif", "a.exr", "a.npy"):
        (folder / name).write_bytes(data)
    with pytest.raises(BadCapture):
        capture_set.load(folder)
    try:
        read_fit(folder / "fit.toml")
    except (ValueError, KeyError) as error:
        assert "fit.toml" in str(error)
    try:
        readings.read(folder / "a.csv", readings.Table("a.csv", ["v"]), "here")
    except (BadCapture, KeyError) as error:
        assert "a.csv" in str(error)
    for suffix in (".png", ".tif", ".exr", ".npy"):
        with pytest.raises(BadCapture):
            read_image(folder / f"a{suffix}", "here")
