"""The site builds without a warning, its links lead somewhere, and nothing of it is loaded from another site."""

import subprocess
import sys
from pathlib import Path

import links
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_its_links_resolve(tmp_path):
    pytest.importorskip("sphinx", reason="the docs extra is not installed: pip install -e .[docs]")
    built = subprocess.run(
        [
            sys.executable,
            "-m",
            "sphinx",
            "-q",
            "-W",
            "--keep-going",
            "-d",
            tmp_path / "trees",
            ROOT / "docs",
            tmp_path / "site",
        ],
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    assert links.broken_in_site(tmp_path / "site") == []
    assert (tmp_path / "site" / "searchindex.js").is_file()
