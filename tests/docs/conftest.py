"""The tools that build the documentation, as modules."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "docs" / "tools"
sys.path.insert(0, str(TOOLS))


@pytest.fixture(scope="session")
def generated(tmp_path_factory):
    """The pages that the build writes, in a folder of their own."""
    import command_pages
    import plugin_pages

    folder = tmp_path_factory.mktemp("generated")
    plugin_pages.write_pages(folder)
    command_pages.write_page(folder / "commands.md")
    return folder
