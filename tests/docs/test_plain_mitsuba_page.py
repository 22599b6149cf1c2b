"""The page on plain Mitsuba: its code runs, and its table of paths is that of the shipped scenes."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "plain-mitsuba.md"


def code():
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow
def test_the_code_of_the_page_runs():
    """All blocks in order, in a fresh process; the press shows, and so does the turned film."""
    *before, last = code()
    checks = (
        "import numpy as np\n"
        "assert np.isfinite(np.array(image)).all() and np.array(image).max() > 0\n"
        "a, b = np.array(pressed), np.array(released)\n"
        "assert np.abs(a - b).max() > 0.05 * a.max()\n"
        "assert float(params['film_sheet.bsdf.angle'][0]) == 30.0\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*before, last, checks])], text=True, capture_output=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def prefixes(mitsuba):
    """{scene: {part: where its numbers stand}} of every shipped scene."""
    from optics.scene import loader, registry
    from optics.scene.mitsuba_parts import register
    from optics.scene.wiring import traverse_paths

    register()
    assert registry.default().parts
    found = {}
    for name in loader.shipped_scenes():
        scene = mitsuba.load_file(str(loader.find(name)), optimize=False)
        found[name] = {k.rsplit(".", 1)[0]: p.rsplit(".", 1)[0] for k, p in traverse_paths(scene).items()}
        for key, path in traverse_paths(scene).items():  # the rule: only what stands before the name differs
            assert key.rsplit(".", 1)[1] == path.rsplit(".", 1)[1]
    return found


@pytest.mark.slow
def test_the_table_of_paths_is_that_of_the_shipped_scenes(prefixes):
    told = re.findall(r"^\| (\w+) \| `(\w+)` \| `([\w.]+)` \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    expected = [(s, part, path) for s, own in prefixes.items() for part, path in own.items() if part != path]
    assert told == expected


@pytest.mark.slow
def test_the_rule_of_paths_holds(prefixes):
    for own in prefixes.values():
        for part, path in own.items():
            assert path == part or re.fullmatch(r"\w+\.(bsdf|emitter)", path), (part, path)
