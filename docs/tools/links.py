"""Checks the links of the built site and of the project's Markdown files: files, images and anchors.

    python docs/tools/links.py build/docs

Links to other sites are not followed. A page that loads a style, a script, a font or an image from another site is an
error: the site is read without a network."""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LINK = re.compile(r"(?<!\\)!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
DIRECTIVE = re.compile(r"^[:`]{3,}\{(?:figure|image|literalinclude|include)\}\s+(\S+)", re.MULTILINE)
TAG = re.compile(r"<(?:img|a|source)\b[^>]*?\b(?:src|href|srcset)=\"([^\"]+)\"")
FENCE = re.compile(r"^(`{3,}|~{3,})(?!\{).*?^\1\s*$", re.MULTILINE | re.DOTALL)


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and the site make it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def prose(text: str) -> str:
    """Markdown without its code."""
    return re.sub(r"`[^`\n]*`", "", FENCE.sub("", text))


def anchors(file: Path) -> set[str]:
    return {
        slug(h) for h in re.findall(r"^#{1,6}\s+(.+?)\s*#*$", FENCE.sub("", file.read_text(encoding="utf-8")), re.M)
    }


def targets(file: Path) -> list[str]:
    """Everything that a Markdown file links to, shows or includes."""
    text = file.read_text(encoding="utf-8")
    plain = prose(text)
    return [*LINK.findall(plain), *TAG.findall(plain), *DIRECTIVE.findall(text)]


def broken_in_markdown(file: Path, elsewhere: dict[str, Path] | None = None) -> list[str]:
    """Sentences about links of a Markdown file that lead nowhere.

    elsewhere   folders that a build writes, by the prefix of links to them
    """
    found = []
    for target in targets(file):
        parts = urlsplit(target)
        if parts.scheme or target.startswith("//"):
            continue
        path = (file.parent / unquote(parts.path)).resolve() if parts.path else file
        for prefix, folder in (elsewhere or {}).items():
            if parts.path.startswith(prefix):
                path = folder / parts.path[len(prefix) :]
        if not path.exists():
            found.append(f"{file}: '{target}': no such file")
        elif parts.fragment and path.suffix == ".md" and parts.fragment not in anchors(path):
            found.append(f"{file}: '{target}': no such heading")
    return found


class Page(HTMLParser):
    """What a page links to, what it loads, and its anchors."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        own = dict(attributes)
        self.ids.update(v for k, v in attributes if k in ("id", "name") and v)
        if tag == "a" and own.get("href"):
            self.links.append(own["href"])
        if tag in ("img", "script", "source", "iframe", "video") and own.get("src"):
            self.loads.append(own["src"])
        if tag == "link" and own.get("href") and own.get("rel") in ("stylesheet", "icon", "preload", "search"):
            self.loads.append(own["href"])


def broken_in_site(folder: Path) -> list[str]:
    """Sentences about links of built pages that lead nowhere, and about what they load from other sites."""
    pages = {f.resolve(): Page(f.read_text(encoding="utf-8")) for f in sorted(folder.rglob("*.html"))}
    found = [] if pages else [f"{folder}: no pages"]
    for file, page in pages.items():
        for target in [*page.links, *page.loads]:
            parts = urlsplit(target)
            if parts.scheme == "data":
                continue
            if parts.scheme or target.startswith("//"):
                if target in page.loads:
                    found.append(f"{file}: loads '{target}' from another site")
                continue
            path = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            path = path / "index.html" if path.is_dir() else path
            if not path.is_file():
                found.append(f"{file}: '{target}': no such file")
            elif parts.fragment and path in pages and unquote(parts.fragment) not in pages[path].ids:
                found.append(f"{file}: '{target}': no such anchor")
    for style in folder.rglob("*.css"):
        for url in re.findall(r"url\(['\"]?(?:https?:)?//[^)]*\)", style.read_text(encoding="utf-8")):
            found.append(f"{style}: loads {url} from another site")
    return found


def main(folder: Path) -> None:
    found = broken_in_site(folder)
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    raise SystemExit(1 if found else 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
