"""Every relative link, image and anchor of README and the documentation leads somewhere."""

from pathlib import Path

import links
import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.relative_to(ROOT).as_posix())
def test_links_images_and_anchors_resolve(file, generated):
    prefix = "generated/" if file.parent.name == "docs" else "docs/generated/"
    assert links.broken_in_markdown(file, {prefix: generated}) == []


def test_links_of_the_generated_pages_resolve(generated):
    figures = ROOT / "docs" / "fingerprints"
    for file in generated.rglob("*.md"):
        assert links.broken_in_markdown(file, {"../../fingerprints/": figures}) == []


def test_every_page_is_in_the_navigation():
    """Pages that no table of contents names are pages that nobody finds."""
    home = (ROOT / "docs" / "index.md").read_text(encoding="utf-8").splitlines()
    for file in (ROOT / "docs").glob("*.md"):
        assert file.stem == "index" or file.stem in home, f"docs/{file.name} is in no toctree of docs/index.md"


def test_a_broken_link_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    (tmp_path / "other.md").write_text("# One heading: `code`\n")
    page.write_text(
        "[a](other.md#one-heading-code) [b](gone.md) [c](other.md#two) ![d](no.png) [e](https://x.org) [f](#none)\n"
        '`[not](a-link.md)`\n```text\n[nor](this.md)\n```\n<img src="gone.webp">\n:::{figure} missing.webp\n:::\n'
    )
    told = " ".join(links.broken_in_markdown(page))
    assert [
        name for name in ("gone.md", "#two", "no.png", "#none", "gone.webp", "missing.webp") if name not in told
    ] == []
    assert not any(name in told for name in ("one-heading", "x.org", "a-link.md", "this.md"))


def test_a_broken_site_is_noticed(tmp_path):
    (tmp_path / "a.html").write_text(
        '<a href="b.html#here">x</a><a href="b.html#gone">x</a><a href="c.html">x</a><img src="https://x.org/i.png">'
    )
    (tmp_path / "b.html").write_text('<p id="here"></p>')
    told = links.broken_in_site(tmp_path)
    assert len(told) == 3 and all(any(w in t for t in told) for w in ("#gone", "c.html", "from another site"))
