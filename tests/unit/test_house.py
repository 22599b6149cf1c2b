"""The house: packages follow the stages of the loop, imports run one way, and nothing heavy is loaded at the door."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OPEN_TO_PLUGINS = (
    "optics",
    "optics.plugin",
    "optics.scene",
    "optics.skin",
    "optics.polarization",
    "optics.words",
    "optics.errors",
    "optics.lookup",
)


def test_imports_run_one_way():
    """The contract stands in pyproject.toml: [tool.importlinter]."""
    importlinter = pytest.importorskip(
        "importlinter.cli", reason="import-linter is not installed (make setup installs it)"
    )
    assert importlinter.lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0


def test_no_modules_need_one_another_to_load():
    """Neither directly nor along a chain. A result may import the text that describes it when it is asked for it."""
    grimp = pytest.importorskip("grimp", reason="import-linter, which brings grimp, is not installed (make setup does)")
    import networkx

    packages = grimp.build_graph("optics", exclude_type_checking_imports=True, cache_dir=None)
    graph = networkx.DiGraph()
    for module in packages.modules:
        for other in packages.find_modules_directly_imported_by(module):
            details = packages.get_import_details(importer=module, imported=other)
            if not all(is_deferred(module, detail["line_number"]) for detail in details):
                graph.add_edge(module, other)
    assert [sorted(circle) for circle in networkx.strongly_connected_components(graph) if len(circle) > 1] == []


def is_deferred(module, line):
    """Whether an import stands inside a function."""
    path = ROOT.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return path.read_text(encoding="utf-8").split("\n")[line - 1][:1] == " "


@pytest.mark.parametrize("file", sorted((ROOT / "plugins").rglob("*.py")), ids=lambda file: file.stem)
def test_plugins_load_with_what_is_below_them(file):
    """To load a plugin takes the scene, the skin and polarization; what follows light is imported where it is used."""
    loaded = {
        node.module
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "optics"
    }
    assert not [m for m in loaded if m not in OPEN_TO_PLUGINS and m.rsplit(".", 1)[0] not in OPEN_TO_PLUGINS[1:]]


def test_the_front_door_loads_nothing_heavy():
    """`import optics` takes an instant, imports neither Mitsuba nor numpy, and sets no variant."""
    code = "import sys, optics; print(sorted({'mitsuba', 'drjit', 'numpy', 'scipy', 'matplotlib'} & set(sys.modules)))"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


def test_both_statements_of_the_version_agree():
    import optics

    stated = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    assert stated[1] == optics.__version__
