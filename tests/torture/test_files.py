"""Files that a scene or a command names: scenes, meshes, spectra, maps of regions, curves, labels, tables of settings,
features. Damaged, they are read as what they hold or refused in one line that names them."""

import io
import re
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

# fmt: off
VALUES = [
    "", " ", "nan", "inf", "-1", "0", "1e300", "1e-300", "9" * 400, "x", "1,2", "1, 2, 3, 4", "\u0661", "\u202e", "$x",
    "../../../../etc/passwd", "/etc/passwd", "/dev/zero", ".", "true", "auto", "540, 540", "-540", "x" * 20_000,
]
CELLS = [
    "", "nan", "inf", "-inf", "1e400", "1e300", "1e9", "-1", "0", "x", '"', "9" * 400, "1,5", "\0", "=1+1", "\u00e9",
    "#", "x" * 9000,
]
# fmt: on


def damaged(draw, raw: bytes, most: int = 4) -> bytes:
    """Bytes changed, lost or doubled, cut off."""
    raw = bytearray(raw)
    for _ in range(draw(st.integers(1, most))):
        at = draw(st.integers(0, max(len(raw) - 1, 0)))
        kind = draw(st.sampled_from(("byte", "byte", "drop", "double", "cut")))
        if kind == "byte" and raw:
            raw[at] = draw(st.integers(0, 255))
        elif kind == "drop":
            del raw[at : at + draw(st.integers(1, 40))]
        elif kind == "double":
            raw[at:at] = raw[at : at + 40]
        elif kind == "cut" and draw(st.integers(0, 3)) == 0:
            del raw[at:]
    return bytes(raw)


@st.composite
def tables(draw, text, separator=","):
    """A table whose cells are replaced by hostile ones, whose lines are lost, doubled or cut."""
    for _ in range(draw(st.integers(1, 3))):
        lines = text.split("\n")
        n = draw(st.integers(0, len(lines) - 1))
        kind = draw(st.sampled_from(("cell", "cell", "cell", "drop", "double", "more", "bom")))
        row = lines[n].split(separator)
        if kind == "cell":
            row[draw(st.integers(0, len(row) - 1))] = draw(st.sampled_from(CELLS))
        elif kind == "more":
            row.append("1")
        lines[n] = separator.join(row)
        if kind == "drop":
            del lines[n]
        elif kind == "double":
            lines.insert(n, lines[n])
        text = "\n".join(lines)
        if kind == "bom":
            text = "\ufeff" + text.replace("\n", "\r\n")
    return text[: draw(st.sampled_from([len(text)] * 4 + [len(text) // 2, 3, 0]))]


def write(file, text):
    file.write_bytes(text.encode("utf-8", errors="surrogatepass"))
    return file


# -- scenes ----------------------------------------------------------------------------------------------------------
@st.composite
def scenes(draw, text):
    """XML with values, names, types and ids of its own mixed up or hostile, and with elements lost or doubled."""
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(("value", "value", "value", "name", "type", "id", "drop", "double", "cut", "junk")))
        if kind in ("value", "name", "type", "id"):
            found = list(re.finditer(rf'\b{kind}="([^"]*)"', text))
            if not found:
                continue
            m = found[draw(st.integers(0, len(found) - 1))]
            own = [other[1] for other in found]
            text = text[: m.start(1)] + draw(st.sampled_from(VALUES + own)).replace('"', "") + text[m.end(1) :]
        elif kind in ("drop", "double"):
            found = list(re.finditer(r"<(\w+)[^<>]*/>|<(shape|emitter|bsdf|sensor)\b.*?</\2>", text, re.DOTALL))
            if not found:
                continue
            m = found[draw(st.integers(0, len(found) - 1))]
            text = text[: m.start()] + (m[0] * 2 if kind == "double" else "") + text[m.end() :]
        elif kind == "cut" and draw(st.integers(0, 3)) == 0:
            text = text[: draw(st.integers(0, len(text)))]
        elif kind == "junk":
            at = draw(st.integers(0, len(text)))
            text = text[:at] + draw(st.text(max_size=8)) + text[at:]
    return text


SIZES = {"width": "16", "height": "12", "spp": "2"}


def small(name):
    """A shipped scene, with images of few pixels."""
    from optics.scene import loader

    text = loader.find(name).read_text(encoding="utf-8")
    for key, value in SIZES.items():
        text = re.sub(rf'(<default name="{key}" value=)"[^"]*"', rf'\1"{value}"', text)
    return text


@given(data=st.data())
@pytest.mark.parametrize("name", ["gelsight", "digit", "polarizer_bench", "polarization_camera", "polariscope"])
def test_a_scene(mitsuba, met, tmp_path_factory, name, data):
    folder = tmp_path_factory.mktemp("scene")
    file = write(folder / "s.xml", data.draw(scenes(small(name))))
    if met("params", file)[0] == 0:
        met("render", file, "-o", folder / "o.exr", "--png")


# -- meshes ----------------------------------------------------------------------------------------------------------
def meshes():
    """A pyramid in every format that an indenter may have."""
    corners = np.array([(0, 0, 0), (1, 0, 1), (-1, 1, 1), (-1, -1, 1)], float)
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)]
    xyz = "\n".join(" ".join(f"{v:g}" for v in c) for c in corners)
    ply = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    ply += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    ply += f"{xyz}\n" + "\n".join("3 " + " ".join(map(str, f)) for f in faces) + "\n"
    obj = "\n".join(f"v {line}" for line in xyz.split("\n")) + "\n"
    obj += "\n".join("f " + " ".join(str(i + 1) for i in f) for f in faces) + "\n"
    triangle = np.zeros(4, np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]))
    triangle["c"] = corners[np.array(faces)]
    stl = b"\0" * 80 + np.uint32(4).tobytes() + triangle.tobytes()
    return {".ply": ply.encode(), ".obj": obj.encode(), ".stl": stl}


MESHES = meshes()


@given(data=st.data())
@pytest.mark.parametrize("suffix", MESHES)
def test_a_mesh_that_presses(mitsuba, met, tmp_path_factory, suffix, data):
    folder = tmp_path_factory.mktemp("mesh")
    file = folder / f"tip{suffix}"
    if suffix != ".stl" and data.draw(st.booleans()):
        write(file, data.draw(tables(MESHES[suffix].decode(), " ")))
    else:
        file.write_bytes(damaged(data.draw, MESHES[suffix]))
    scene = write(folder / "s.xml", small("gelsight"))
    code, said = met("render", scene, "-D", f"indenter={file}", "-D", "depth=0.3", "-o", folder / "o.exr")
    assert code == 0 or "tip" in said or "press" in said, said


# -- spectra and maps ------------------------------------------------------------------------------------------------
SPECTRUM = "wavelength,value\n" + "\n".join(f"{nm},{0.2 + nm / 2000:g}" for nm in range(400, 701, 20)) + "\n"


@given(data=st.data())
def test_a_spectrum(mitsuba, met, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("spectrum")
    file = write(folder / "led.csv", data.draw(tables(SPECTRUM)))
    met("plot-spectra", "digit", "-D", "bands=auto", "-D", f"sensitivity={file}", "-o", folder / "s.png")


@given(data=st.data())
@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_a_map_of_regions(mitsuba, met, tmp_path_factory, suffix, data):
    folder = tmp_path_factory.mktemp("map")
    labels = np.zeros((6, 8), np.uint8)
    labels[:, 4:] = 1
    stream = io.BytesIO()
    Image.fromarray(labels).save(stream, "PNG") if suffix == ".png" else np.save(stream, labels)
    file = folder / f"map{suffix}"
    file.write_bytes(damaged(data.draw, stream.getvalue()))
    scene = write(folder / "s.xml", small("polarization_camera"))
    met("render", scene, "-D", f"regions={file}", "-o", folder / "o.exr")


# -- tables of commands ----------------------------------------------------------------------------------------------
@given(data=st.data())
def test_a_curve_of_proximity(mitsuba, met, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("curve")
    rng = np.random.default_rng(0)
    for name in ("empty", "near"):
        Image.fromarray(rng.integers(0, 255, (24, 32)).astype(np.uint8)).save(folder / f"{name}.png")
    curve = "r,distance\n0.02,40\n0.1,20\n0.3,10\n0.5,5\n"
    file = write(folder / "curve.csv", data.draw(tables(curve)))
    words = (folder / "near.png", "--reference", folder / "empty.png", "--curve", file)
    met("read", "proximity", *words, "-o", folder / "o.csv")


@given(data=st.data())
def test_circles_of_presses(mitsuba, met, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("circles")
    rng = np.random.default_rng(0)
    for name in ("a", "b", "c", "d", "e"):
        Image.fromarray(rng.integers(90, 110, (24, 32, 3)).astype(np.uint8)).save(folder / f"{name}.png")
    rows = "file,center_x_px,center_y_px,contact_radius_px\n"
    rows += "".join(f"{name}.png,{8 + 4 * i},12,{3 + i % 2}\n" for i, name in enumerate("abcde"))
    file = write(folder / "circles.csv", data.draw(tables(rows)))
    sizes = ("--mm-per-pixel", "0.1", "--ball-radius", "2")
    if met("import", folder, "--circles", file, *sizes, "-o", folder / "set")[0] == 0:
        met("compare", folder / "set")


@given(data=st.data())
def test_settings_of_raw_frames(mitsuba, met, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("settings")
    rng = np.random.default_rng(0)
    for k in range(4):
        Image.fromarray(rng.integers(900, 1100, (12, 16)).astype(np.uint16)).save(folder / f"f{k}.png")
    rows = "file,polarizer.angle\n" + "".join(f"f{k}.png,{45 * k}\n" for k in range(4))
    file = write(folder / "settings.csv", data.draw(tables(rows)))
    noise = ("--system-gain", "0.3", "--dark-noise", "2", "--saturation", "4095", "--black-level", "64")
    code, _ = met("import", folder, "--mosaic", "90 45 135 0", "--settings", file, *noise, "-o", folder / "set")
    if code == 0:
        met("compare", folder / "set")


@pytest.mark.slow
@given(data=st.data())
@pytest.mark.parametrize("name", ["features.npz", "map.npz"])
def test_what_was_learnt_of_forces(material, met, tmp_path_factory, name, data):
    folder = tmp_path_factory.mktemp("forces")
    for file in ("features.npz", "map.npz"):
        shutil.copy(material / file, folder)
    (folder / name).write_bytes(damaged(data.draw, (material / name).read_bytes()))
    met("force-test", folder / "map.npz", folder / "features.npz")


@pytest.mark.parametrize("name", ["features.npz", "map.npz", "maps.npz"])
def test_arrays_far_larger_than_their_file(place, met, monkeypatch, name):
    """Zeros packed to a thousandth are not unpacked."""
    from optics.files import archives

    monkeypatch.setattr(archives, "SIZE_MOST", 1e6)
    file = place / name if name != "maps.npz" else place / "study" / "steps" / "00-base" / "images" / name
    with np.load(file) as arrays:
        held = dict(arrays)
    held[next(key for key in held if key != "note")] = np.zeros((2000, 2000))
    np.savez_compressed(file, **held)
    words = f"force-test {place}/map.npz {place}/features.npz"
    code, said = met(*(words if name != "maps.npz" else f"report {place}/study -o {place}/page.html").split())
    assert code == 2 and name in said and "GB of arrays in a file of" in said, said
    assert not (place / "page.html").exists()


@given(data=st.data())
def test_arrays_of_a_study(material, met, tmp_path_factory, data):
    """Frames and maps that a step keeps beside its record."""
    study = shutil.copytree(material / "study", tmp_path_factory.mktemp("arrays") / "study")
    files = sorted(study.rglob("*.npz"))
    file = files[data.draw(st.integers(0, len(files) - 1))]
    file.write_bytes(damaged(data.draw, file.read_bytes()))
    met("report", study, "-o", study / "page.html")
