"""Code that came with data does not run: beside captures, beside a scene, in a study, named by a file. It runs when it
is named, or when its content is trusted."""

import json
import shutil

import numpy as np
import pytest

import optics as package
from optics.errors import BadCapture, BadScene, Untrusted
from optics.scene import loader, trust

PLUGIN = """'''Marked: leaves a mark when it runs.'''
import pathlib
from optics import Effect, Parameter
pathlib.Path({mark!r}).write_text("ran")


def act(image, camera):
    return image * (1 + camera.marked)


effect = Effect(
    name="marked", part="camera", stages={{"sensor": act}},
    parameters=(Parameter("marked", "1", 0.0, (-1, 1), "strength", neutral=0.0, plausible=0.01, how="image"),),
)
"""
BENCH = 'scene = "polarizer_bench"\nabsent = ["sample", "middle"]\n[noise]\ndark_noise = 0.5\n'
BENCH += '[parameters]\n"polarizer.angle" = 0.0\n[uncertainty]\n"analyzer.angle" = 0.0\n"polarizer.angle" = 0.0\n'
TABLE = '[table]\nfile = "{}"\nvalues = ["reading"]\ngroup = "run"\n'


@pytest.fixture
def config(tmp_path, monkeypatch):
    """An empty list of trusted plugins."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(trust, "_agreed", set())
    monkeypatch.setattr(trust, "ask", None)
    return tmp_path / "config" / "tactile-optics" / "trusted-plugins.json"


@pytest.fixture
def mark(tmp_path):
    """The file that exists once the plugin has run."""
    return tmp_path / "mark"


def readings(folder, table="readings.csv"):
    """Readings of two crossed polarizers that a model of two numbers explains."""
    folder.mkdir(parents=True)
    angles = np.arange(0.0, 180.0, 7.5)
    rng = np.random.default_rng(3)
    rows = ["analyzer.angle,reading,run"]
    for run in range(4):
        rows += [f"{a},{100 * np.cos(np.radians(a)) ** 2 + rng.normal(0, 0.5):.3f},r{run}" for a in angles]
    (folder / "captures.toml").write_text(BENCH + TABLE.format(table))
    (folder / "readings.csv").write_text("\n".join(rows) + "\n")
    return folder


def plugin(folder, mark, name="marked"):
    (folder / "plugins").mkdir(parents=True)
    file = folder / "plugins" / f"{name}.py"
    file.write_text(PLUGIN.format(mark=str(mark)))
    return file


def scene_beside(folder):
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(loader.find("polarizer_bench"), folder / "mine.xml")
    return folder / "mine.xml"


COMMANDS = {
    "params": "params {tmp}/mine.xml",
    "render": "render {tmp}/mine.xml -o {tmp}/out.exr",
    "mueller": "mueller {tmp}/mine.xml",
    "design": "design {tmp}/mine.xml -n 4",
    "compare": "compare {tmp}/set",
    "calibrate": "calibrate {tmp}/set -o {tmp}/study",
    "batch": "batch {tmp}/job.toml",
    "fit": "render --fit {tmp}/fit.toml -o {tmp}/out.exr",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_runs_python_that_lies_beside_data(mitsuba, config, mark, tmp_path, optics, name):
    captures = readings(tmp_path / "set")
    scene = scene_beside(tmp_path)
    beside = captures if name in ("compare", "calibrate") else tmp_path
    file = plugin(beside, mark)
    (tmp_path / "job.toml").write_text('scene = "mine.xml"\nout = "out"\ncount = 1\n')
    (tmp_path / "fit.toml").write_text(f'[sensor]\nscene = "{scene}"\nplugins = "{file.parent}"\n')
    code, _, said = optics(*COMMANDS[name].format(tmp=tmp_path).split())
    assert code == 2 and str(file) in said and f"--plugins {file.parent}" in said, said
    assert not mark.exists() and not (tmp_path / "study").exists() and not config.exists()


def test_compiled_code_beside_a_scene_is_refused(mitsuba, config, tmp_path, optics):
    """Mitsuba looks for plugins/NAME.so beside a scene before it takes its own: the file is not opened."""
    scene = scene_beside(tmp_path / "sent")
    (tmp_path / "sent" / "plugins").mkdir()
    (tmp_path / "sent" / "plugins" / "diffuse.so").write_bytes(b"no library: loading it would say so")
    code, _, said = optics("params", scene, "--plugins", "none")
    assert code == 2 and "diffuse.so: compiled code" in said
    included = tmp_path / "other.xml"  # a scene that includes it, or has its folder in a <path>
    included.write_text(
        scene.read_text().replace("<scene", "<scene", 1).replace("</scene>", '<path value="sent"/></scene>')
    )
    code, _, said = optics("params", included)
    assert code == 2 and "diffuse.so: compiled code" in said


def test_named_plugins_run_and_none_means_none(mitsuba, config, mark, tmp_path, optics):
    captures = readings(tmp_path / "set")
    file = plugin(captures, mark)
    assert optics("compare", captures, "--plugins", "none")[0] == 0 and not mark.exists()
    assert optics("compare", captures, "--plugins", file)[0] == 0 and mark.exists()
    assert not config.exists()  # naming is for once
    assert "marked" in loader.load("polarizer_bench", plugins=[file.parent]).registry.effects
    assert "marked" not in loader.load("polarizer_bench").registry.effects


def test_what_is_agreed_to_is_remembered_by_content(mitsuba, config, mark, tmp_path, monkeypatch):
    scene, asked = scene_beside(tmp_path), []
    file = plugin(tmp_path, mark)
    monkeypatch.setattr(trust, "ask", lambda files, where: bool(asked.append((list(files), where))))
    with pytest.raises(Untrusted, match="marked.py"):
        loader.load(scene)
    assert asked == [([file], "beside the scene mine.xml")] and not mark.exists()
    monkeypatch.setattr(trust, "ask", lambda files, where: True)
    assert "marked" in loader.load(scene).registry.effects and len(json.loads(config.read_text())) == 1
    monkeypatch.setattr(trust, "ask", None)
    monkeypatch.setattr(trust, "_agreed", set())  # as another process
    shutil.move(tmp_path / "plugins", tmp_path / "elsewhere" / "plugins")
    loader.load(scene_beside(tmp_path / "elsewhere"))
    moved = tmp_path / "elsewhere" / "plugins" / "marked.py"
    moved.write_text(moved.read_text() + "\n# changed\n")
    with pytest.raises(Untrusted):
        loader.load(tmp_path / "elsewhere" / "mine.xml")
    config.write_text("torn [")
    with pytest.raises(Untrusted):
        loader.load(tmp_path / "elsewhere" / "mine.xml")


def test_import_json_names_no_code(mitsuba, config, mark, tmp_path, optics):
    captures, file = readings(tmp_path / "set"), plugin(tmp_path / "evil", mark)
    for setup, said in (
        ({"plugins": str(file.parent)}, "names no code"),
        ({"captures": "/"}, "unknown key 'captures'"),
        ({"priors": {"x": [None, -1]}}, "standard deviation"),
        ({"free": "led"}, "allowed: a list"),
        ([], "setup is no table"),
    ):
        (captures / "import.json").write_text(json.dumps({"setup": setup}))
        code, _, error = optics("compare", captures)
        assert code == 2 and said in error and "import.json" in error, error
    (captures / "import.json").write_text('{"setup": {')
    assert "import.json: not valid JSON" in optics("compare", captures)[2]
    assert not mark.exists()


def test_a_study_is_data_and_its_record_trusts_nothing(mitsuba, config, mark, tmp_path, optics):
    """A plugin in a study that came from elsewhere, with its hash in the record, does not run; its maker's does."""
    captures = readings(tmp_path / "set")
    study = package.calibrate(captures, tmp_path / "study")
    file = plugin(study.folder, mark)
    record = json.loads((study.folder / "ladder.json").read_text())
    record["drafts"] = {"plugins/marked.py": trust.file_hash(file)}
    record["inputs"]["own/marked.py"] = trust.file_hash(file)
    (study.folder / "ladder.json").write_text(json.dumps(record))
    for words in (
        "diagnose {}",
        "add {} marked",
        "rehearse {}",
        "imitate {} -o {}x",
        "view {} --no-browser",
        "design {} -n 4",
    ):
        code, _, said = optics(*(w.format(study.folder, study.folder) for w in words.split()))
        assert code == 2 and "marked.py" in said and "own draft" in said, said
    assert not mark.exists()
    assert optics("add", study.folder, "marked", "--plugins", file.parent)[0] == 0 and mark.exists()


def test_plugins_of_the_users_own_study_go_on_with_it(mitsuba, config, mark, tmp_path, optics):
    captures, file = readings(tmp_path / "set"), plugin(tmp_path / "own", mark)
    assert optics("calibrate", captures, "-o", tmp_path / "study", "--plugins", file.parent)[0] == 0
    code, said, error = optics("add", tmp_path / "study", "marked")
    assert code == 0, error
    assert optics("compare", captures, "--fit", tmp_path / "study")[0] == 0
    file.write_text(file.read_text() + "# changed\n")
    code, _, error = optics("diagnose", tmp_path / "study")
    assert code == 2 and "changed since the study began: own/marked.py" in error
    assert "marked.py" in optics("compare", captures, "--fit", tmp_path / "study")[2]


@pytest.mark.parametrize("how", ["absolute", "dots", "link"])
def test_files_outside_the_capture_folder_are_not_read(mitsuba, config, tmp_path, optics, how):
    """Not even the first line of a secret shows in an error."""
    captures, secret = readings(tmp_path / "set"), tmp_path / "secret.csv"
    secret.write_text("root:x:0:0\nmore,of,it\n")
    name = {"absolute": str(secret), "dots": "../secret.csv", "link": "linked.csv"}[how]
    if how == "link":
        (captures / name).symlink_to(secret)
    (captures / "captures.toml").write_text(BENCH + TABLE.format(name))
    code, _, said = optics("compare", captures)
    assert code == 2 and "lies outside" in said and "--allow-outside" in said and "root:x" not in said, said
    shutil.copy(captures / "readings.csv", secret)
    assert optics("compare", captures, "--allow-outside")[0] == 0
    study = package.calibrate(captures, tmp_path / "study", outside=True)
    assert package.Study.open(study.folder).model.captures.frames
    images = captures.with_name("images")
    images.mkdir()
    (images / "captures.toml").write_text('scene = "gelsight"\n[[frames]]\nimage = "../set/x.png"\n')
    with pytest.raises(BadCapture, match="lies outside"):
        package.compare(images)


def test_a_draft_takes_no_code_from_a_record(tmp_path):
    from optics.study import draft

    for word in ('row"]; import os; x = ["', "row\n", "a\\b"):
        with pytest.raises(ValueError, match="where a name is meant"):
            draft._check_words([word])
    text = draft._file(
        "x",
        "lens",
        "X.",
        "d",
        "f",
        "v",
        'study """\nimport os\n"""',
        body=["pass"],
        applied="return image",
        check=["def c():"],
        acts=["row"],
        needs="",
        plausible=1.0,
    )
    assert text.count('"""') == 4  # of the module's docstring and of `act`


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        ("ply", "SECRET\n"),
        ("ply", "ply\nformat ascii SECRET\n"),
        ("ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty SECRET x\nend_header\n"),
        ("ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float SECRET\nend_header\nx\n"),
        ("obj", "v SECRET 1 2\n"),
        ("linearcurve", 'SECRET "1" 2 3\n'),
        ("bsplinecurve", "SECRET 1 2 3\n"),
    ],
)
def test_errors_show_no_word_of_a_file_that_a_scene_names(tmp_path, shape, text):
    """A stranger's scene may name any file of whoever opens it, and an error may be sent back."""
    (tmp_path / "words").write_text(text)
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f'<scene version="3.0.0"><shape type="{shape}"><string name="filename" value="words"/></shape></scene>'
    )
    with pytest.raises(BadScene, match="words of the file are not shown") as raised:
        loader.load(scene)
    assert "SECRET" not in str(raised.value) and '"words"' in str(raised.value)
