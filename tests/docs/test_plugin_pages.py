"""The pages of parts and effects say all that a scene's author can write, and every effect has its figure."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path

import plugin_pages
import pytest

from optics.scene.registry import known

PARTS = sorted(known().parts)
EFFECTS = sorted(known().effects)
BY_THE_BASE = {"rr_depth"}  # read by a base class of Mitsuba, not by the part's own file
READERS = ("get", "get_texture", "__getitem__", "__contains__")  # of mi.Properties


@pytest.fixture(scope="module")
def record():
    return json.loads((plugin_pages.FIGURES / "figures.json").read_text(encoding="utf-8"))


# -- figures ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("key", EFFECTS)
def test_every_effect_has_a_fingerprint_figure_of_its_own_parameters(key, record):
    from PIL import Image

    effect = known().effects[key]
    assert key in record, f"python docs/tools/fingerprints.py {key} draws it"
    own = record[key]
    with Image.open(plugin_pages.FIGURES / f"{key}.webp") as image:
        assert image.width >= 400 and image.height >= 100
    names = {k.rsplit(".", 1)[1] for k in own["strength"]}
    assert names == set(effect.parameter_names)
    for name, value in ((k.rsplit(".", 1)[1], v) for k, v in own["strength"].items()):
        p = known().parameter(effect.part, name)
        assert p.bounds[0] <= value <= p.bounds[1] and value != p.neutral
    assert own["rms"] > 0 and own["scale"] > 0
    now = plugin_pages.formula_of(effect)
    assert own["formula"] == now, f"the formula has changed: python docs/tools/fingerprints.py {key}, and look at it"


def test_no_figure_is_left_of_an_effect_that_is_gone(record):
    assert sorted(record) == EFFECTS
    assert sorted(f.stem for f in plugin_pages.FIGURES.glob("*.webp")) == EFFECTS


# -- pages -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", PARTS)
def test_a_parts_page_lists_every_xml_parameter_and_attribute(kind, generated):
    page = (generated / "parts" / f"{kind}.md").read_text(encoding="utf-8")
    for p in known().parameters_of(kind):
        row = next((line for line in page.splitlines() if line.startswith(f"| `{p.name}` |")), None)
        assert row is not None, f"{kind}: no row for {p.name}"
        if p.is_number:
            assert f"| {p.default:g} |" in row and (p.unit in ("1", "-") or f"| {p.unit} |" in row)
        else:
            assert all(f"`{choice}`" in row for choice in p.choices)
    for a in plugin_pages.attributes(known().parts[kind].doc):
        assert f"| `{a.name}` |" in page and a.meaning


@pytest.mark.parametrize("key", EFFECTS)
def test_an_effects_page_shows_formula_figure_and_parameters(key, generated):
    effect = known().effects[key]
    page = (generated / "effects" / f"{key}.md").read_text(encoding="utf-8")
    for section in ("## Definition", "## Fingerprint", "## Validity", "## References", "## Parameters"):
        assert page.count(section) == 1, section
    assert f"fingerprints/{key}.webp" in page
    for name in effect.parameter_names:
        assert f"| `{name}` |" in page
    for p in effect.shape:
        assert f"| `{p.name}` |" in page


def test_a_docstrings_sections_are_found_wherever_their_headings_stand():
    doc = "Name: what it is.\n\nDefinition\n    a = b\nwith b. Fingerprint\n    dark.\nValidity\n    none.\n"
    found = plugin_pages.sections(doc)
    assert found["Definition"] == ["    a = b", "with b."] and found["Fingerprint"] == ["    dark."]
    assert plugin_pages.definition(found["Definition"]) == "```text\na = b\n```\n\nwith b."


# -- XML attributes that are no parameters ---------------------------------------------------------------------------
def read_by_the_file(kind: str) -> set[str]:
    """Names that a part's file asks `props` for, by its source: also those that no shipped scene makes it ask for."""
    tree = ast.parse(Path(known().parts[kind].file).read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in READERS
            and getattr(node.func.value, "id", "") == "props"
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            names.add(node.args[0].value)
    return names


@pytest.fixture(scope="module")
def asked(mitsuba):
    """{kind: {name: default}} of what parts ask their XML for, while every shipped scene is loaded."""
    from optics.scene import loader

    seen: dict[str, dict] = {}
    real = {name: getattr(mitsuba.Properties, name) for name in READERS}

    def spy(name):
        def read(props, key, *rest):
            frame = sys._getframe(1)
            declares = False
            while frame is not None:
                declares |= frame.f_code.co_name == "declare"
                owner = frame.f_locals.get("self")
                if getattr(owner, "kind", None) in PARTS:
                    if not declares:
                        known = seen.setdefault(owner.kind, {})
                        known[key] = rest[0] if rest else known.get(key)
                    break
                frame = frame.f_back
            return real[name](props, key, *rest)

        return read

    for name in READERS:
        setattr(mitsuba.Properties, name, spy(name))
    try:
        for scene in loader.shipped_scenes():
            loader.load(scene)
    finally:
        for name, function in real.items():
            setattr(mitsuba.Properties, name, function)
    return seen


@pytest.mark.parametrize("kind", PARTS)
def test_every_attribute_that_a_part_reads_is_on_its_page(kind, asked):
    """A part that asks its XML for something that is neither a parameter nor listed under `XML` has a secret."""
    parameters = {p.name for p in known().parameters_of(kind)}
    listed = {a.name: a for a in plugin_pages.attributes(known().parts[kind].doc)}
    read = (set(asked.get(kind, {})) | read_by_the_file(kind)) - parameters
    assert read == set(listed), f"{kind}: read {sorted(read)}, listed under XML {sorted(listed)}"
    for name, default in asked.get(kind, {}).items():
        if name not in listed or name in BY_THE_BASE or not isinstance(default, (bool, int, float, str)):
            continue
        shown = listed[name].default or ""
        assert shown == str(default), f"{kind}.{name}: the page says {shown!r}, the part takes {default!r}"


def test_the_spy_sees_what_scenes_make_parts_read(asked):
    assert asked["cells"]["columns"] == 20 and "position" in asked["led"] and len(asked) > 8
