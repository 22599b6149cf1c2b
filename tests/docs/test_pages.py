"""Pages that are written by hand say what the program does: keys, stages, fields, words and limits."""

import dataclasses
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


def page(name):
    return (DOCS / f"{name}.md").read_text(encoding="utf-8")


def rows(text):
    """First cells of the rows of all tables, without markup."""
    return [re.sub(r"[`*]", "", line.split("|")[1]).strip() for line in text.splitlines() if line.startswith("|")]


def test_every_key_of_captures_toml_has_its_row():
    from optics.captures import capture_set as captures

    known = rows(page("captures"))
    every = {
        *captures.KEYS,
        *captures.FRAME_KEYS,
        *captures.NOISE_KEYS,
        *captures.OPTIONAL_NOISE_KEYS,
        *captures.TABLE_KEYS,
    }
    assert [key for key in every if key not in known] == []
    headings = {"key", "---"}
    assert [row for row in known if row not in every | headings] == [], "a row of a key that is not read"


def test_the_example_of_captures_toml_is_read(tmp_path):
    """The first example of the page, with an image beside it, is a capture set."""
    import numpy as np

    from optics.captures import capture_set as captures
    from optics.files.images import write_image

    text = re.search(r"```toml\n(scene = \"gelsight\".*?)```", page("captures"), re.DOTALL)[1]
    (tmp_path / "frames").mkdir()
    write_image(tmp_path / "frames" / "000", np.full((6, 8, 3), 100.0, np.float32), 8)
    (tmp_path / "captures.toml").write_text(text, encoding="utf-8")
    found = captures.load(tmp_path)
    assert found.scene == "gelsight" and found.frames[0].parameters["gel.press_depth"] == 0.5


def test_the_example_of_a_job_is_read(mitsuba, tmp_path):
    """It names all that its outputs need, and draws from all that the scene has."""
    from optics.study import batch

    file = tmp_path / "job.toml"
    file.write_text(
        re.search(r"```toml\n(scene   = \"gelsight\".*?)```", page("batches"), re.DOTALL)[1], encoding="utf-8"
    )
    job = batch.read(file)
    maker = batch.Maker(job, file, None)
    assert job.count == 1000 and maker.noise is not None


def test_the_examples_of_tables_are_read(tmp_path):
    """Volts with semicolons and decimal commas, whole lux with a column of uncertainties; what is known besides."""
    from optics.captures import capture_set as captures

    text = page("captures")
    (tmp_path / "readings.txt").write_text(re.search(r"```text\n(.*?)```", text, re.DOTALL)[1], encoding="utf-8")
    (tmp_path / "lux.csv").write_text("analyzer.angle,sd,lux\n0,1,705\n10,2,699\n", encoding="utf-8")
    known, volts, lux = re.findall(r"```toml\n(scene = \"polarizer_bench\".*?)```", text, re.DOTALL)
    read = {}
    for name, content in (
        ("known", known + '[table]\nfile = "lux.csv"\nvalues = ["sd"]\nrename = {"lux" = "source.time"}\n'),
        ("volts", volts),
        ("lux", lux),
    ):
        (tmp_path / "captures.toml").write_text(content, encoding="utf-8")
        read[name] = captures.load(tmp_path)
    assert read["known"].bands == [470, 530, 625] and read["known"].uncertainty["polarizer.angle"] == 1.0
    assert [f.group for f in read["volts"].frames] == ["up", "up", "down"]
    assert float(read["volts"].frames[2].image.item()) == pytest.approx(1000 * -0.00102 + 2.5)
    assert read["volts"].frames[1].parameters["analyzer.angle"] == pytest.approx(0.2498, abs=1e-4)  # deg
    assert [f.uncertainty for f in read["lux"].frames] == [{"analyzer.angle": 1.0}, {"analyzer.angle": 2.0}]


def test_every_stage_has_its_row():
    from optics.scene.declare import STAGES

    assert [s for s in STAGES if s not in rows(page("write-an-effect"))] == []


def test_every_field_of_a_declaration_has_its_row():
    from optics.scene.declare import Part
    from optics.scene.parameter import Parameter

    told = " ".join(rows(page("write-a-part")))
    set_by_the_scan = {"doc", "file"}
    for kind in (Parameter, Part):
        names = {f.name for f in dataclasses.fields(kind)} - (set_by_the_scan if kind is Part else set())
        assert [name for name in names if not re.search(rf"\b{name}\b", told)] == []


def test_every_role_has_its_row():
    from optics.scene.declare import ROLES as of_parts
    from optics.scene.parameter import ROLES as of_parameters

    text = page("write-a-part")
    for role, meaning in (*of_parts.items(), *of_parameters.items()):
        assert f"| `{role}` | {meaning} |" in text, role


def test_the_example_effect_is_an_effect(tmp_path):
    """The file that the page shows is found by a scan and leaves an image alone at neutral."""
    import numpy as np

    from optics.scene import registry

    text = re.search(r"```python\n(\"\"\"Lens ghost.*?)```", page("write-an-effect"), re.DOTALL)[1]
    file = tmp_path / "lens_ghost.py"
    file.write_text(text, encoding="utf-8")
    (found,) = registry.declared(file)
    assert found.key == "lens-ghost" and found.parameter_names == ("ghost",)
    image = np.random.default_rng(0).random((20, 30, 3))
    (parameter,) = found.parameters
    at_rest = type("Camera", (), {"ghost": parameter.neutral})
    assert np.array_equal(found.stages["lens"](image, at_rest), image)


@pytest.mark.parametrize("name", ["verdicts", "method"])
def test_the_words_are_the_programs(name):
    text = page(name)
    words = ("NOTHING", "CLAIM", "AMBIGUOUS", "PARTIAL", "UNKNOWN", "CANNOT TELL")
    for word in words if name == "verdicts" else ("CLAIM",):
        assert word in text


def test_the_limits_of_the_method_page_are_the_programs():
    from optics.diagnosis import thresholds as v

    text = " ".join(page("method").split())
    for sentence in (
        f"p below {v.LEVEL:g}",
        f"{v.TOLD:.1f} in score",
        f"half of what it leaves, or {v.MARGIN:.0%} of its fall".replace("%", " %"),
        f"explains {v.RIVAL_CURVE:g} times as much ({v.RIVAL:g} times for a map of the sensor)",
        f"carries {v.CARRIED:.0%} of the fall".replace("%", " %"),
        f"more than {v.SHARE:.0%} of the excess".replace("%", " %"),
        f"below {v.FAR:.0%} of the mean signal".replace("%", " %"),
    ):
        assert sentence in text, f"the method page does not say: {sentence}"
    assert v.HALF == 0.5 and v.STRENGTH == 2 and "two standard deviations from none" in text


def test_readme_says_what_the_front_door_offers():
    """The names of the Python snippet exist."""
    import optics

    snippet = re.search(r"```python\n(.*?)```", (DOCS.parent / "README.md").read_text(encoding="utf-8"), re.DOTALL)[1]
    compile(snippet, "README.md", "exec")
    assert callable(optics.calibrate)
    for name in re.findall(r"(?:study|verdict)\.(\w+)\(", snippet):
        owner = optics.Diagnosis if f"verdict.{name}(" in snippet else optics.Study
        assert callable(getattr(owner, name)), f"{owner.__name__} has no {name}"


BESIDE = ("gelsight_mini.png", "gelsight_bench.png", "9dtact.png")  # not in the strip of sensors


def test_the_shipped_sensors_of_the_gallery_are_there():
    from PIL import Image

    gallery = DOCS.parent / "renders" / "gallery"
    for name in ("gelsight.png", "digit.png", "magictac.png", "vi2tap.png", "sensors.webp", *BESIDE):
        with Image.open(gallery / name) as image:
            assert image.width >= 200
