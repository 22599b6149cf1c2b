"""Writes a page for every part and every effect that a scan finds, from what its file declares.

    python docs/tools/plugin_pages.py FOLDER

The page of a plugin is its docstring, its parameters (name, type, unit, default, bounds, neutral value, plausible size,
derivative, meaning), for a part the further XML attributes that its docstring lists under `XML`, and for an effect its
fingerprint figure. `make docs` calls `write_pages` before it builds the site; nothing that it writes is kept in git."""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import math
import re
import sys
import textwrap
import tokenize
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
FIGURES = ROOT / "docs" / "fingerprints"
SECTIONS = ("Definition", "Fingerprint", "Validity", "References", "XML")
HEADING = re.compile(rf"^(?P<before>\S.*\s)?(?P<name>{'|'.join(SECTIONS)})$")
ATTRIBUTE = re.compile(r"^    (?P<name>\w+) +(?P<type>[a-z ]+?)(?:, (?P<default>[^:]+))?: (?P<meaning>.+)$")
SYMBOLS = {"mu", "rho", "sigma", "theta", "alpha", "kappa", "n", "s", "g"}  # that a text may begin with
DERIVATIVE = {
    "ad": "forward mode through the render",
    "difference": "central differences",
    "image": "complex step on the images",
    "layer": "complex step through the Mueller matrices",
    "path": "lengths of the paths in dielectric bodies",
}
CODE = (tokenize.NAME, tokenize.NUMBER, tokenize.OP)  # docstrings and messages are no part of a formula
ELEMENT = {"bsdf": "bsdf", "emitter": "emitter", "sensor": "sensor", "shape": "shape", "integrator": "integrator"}


@dataclass(frozen=True)
class Attribute:
    """An XML attribute that shapes a part's structure and is no parameter: it cannot be varied after loading."""

    name: str
    type: str
    default: str
    meaning: str


def sections(doc: str) -> dict[str, list[str]]:
    """{'': title and summary, 'Definition': lines, ...} of a plugin's docstring."""
    found: dict[str, list[str]] = {"": []}
    name = ""
    for line in doc.strip().splitlines():
        heading = HEADING.match(line.rstrip())
        if heading is None:
            found[name].append(line.rstrip())
            continue
        if heading["before"]:
            found[name].append(heading["before"].rstrip())
        name = heading["name"]
        found[name] = []
    return found


def attributes(doc: str) -> list[Attribute]:
    """What the docstring lists under `XML`, one `name type, default: meaning` a line; deeper lines go on."""
    found: list[Attribute] = []
    for line in sections(doc).get("XML", []):
        if match := ATTRIBUTE.match(line):
            found.append(Attribute(match["name"], match["type"], match["default"] or "", match["meaning"]))
        elif line.strip() and found and line.startswith(" " * 8):
            last = found[-1]
            found[-1] = Attribute(last.name, last.type, last.default, f"{last.meaning} {line.strip()}")
        elif line.strip():
            raise ValueError(f"section XML: {line!r}; allowed: '    name type, default: meaning', or a deeper line")
    return found


def escaped(text: str) -> str:
    """Plain text as markdown that shows it unchanged; `code` stays code."""
    pieces = re.split(r"(`[^`]+`)", text)
    return "".join(
        p if p.startswith("`") and len(p) > 1 else re.sub(r"([\\*_<>\[\]|$#~{}])", r"\\\1", p) for p in pieces
    )


def prose(lines: list[str]) -> str:
    """Paragraphs of a section whose text is indented."""
    paragraphs = "\n".join(line.strip() for line in lines).split("\n\n")
    return "\n\n".join(escaped(sentence_case(" ".join(p.split()))) for p in paragraphs if p.strip())


def sentence_case(text: str) -> str:
    """A text with a capital first letter, unless it begins with the name of a symbol."""
    first = re.match(r"[a-z]+\b", text)
    return text if first is None or first[0] in SYMBOLS else text[:1].upper() + text[1:]


def definition(lines: list[str]) -> str:
    """Formulas are indented, the text between them is not."""
    blocks: list[tuple[bool, list[str]]] = []
    for line in lines:
        if not line.strip():
            continue
        formula = line.startswith("    ")
        if not blocks or blocks[-1][0] != formula:
            blocks.append((formula, []))
        blocks[-1][1].append(line[4:] if formula else line)
    return "\n\n".join(
        "```text\n" + "\n".join(own) + "\n```" if formula else escaped(" ".join(" ".join(own).split()))
        for formula, own in blocks
    )


def summary(doc: str) -> tuple[str, str]:
    """(title, what it is in a sentence) of a plugin's docstring."""
    first = " ".join(" ".join(sections(doc)[""]).split())
    title, _, rest = first.partition(": ")
    return title, rest[:1].upper() + rest[1:]


def number(value: float) -> str:
    return f"{value:g}"


def span(p) -> str:
    if not p.is_number:
        return " \\| ".join([*(f"`{c}`" for c in p.choices), *(f"a file ({s})" for s in p.files)])
    low, high = p.bounds
    if math.isinf(low) and math.isinf(high):
        return "any"
    return f"{number(low)} … {number(high)}"


def formula_of(effect) -> str:
    """A fingerprint of the code of an effect's functions, comments and layout aside: a figure is of this formula."""
    words = []
    for stage in sorted(effect.stages):
        source = textwrap.dedent(inspect.getsource(effect.stages[stage]))
        words += [t.string for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type in CODE]
    return hashlib.sha256(" ".join(words).encode()).hexdigest()[:12]


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *("| " + " | ".join(r) + " |" for r in rows)]
    return ":::{container} wide\n" + "\n".join(lines) + "\n:::"


def parameter_table(rows: list[tuple]) -> str:
    """Rows of (parameter, where it comes from or '')."""
    cells = []
    for p, source in rows:
        derivative = DERIVATIVE[p.how] if p.is_number else "none"
        derivative += ", exactly linear" if p.linear else ", in its square" if p.squared else ""
        cells.append(
            [
                f"`{p.name}`",
                escaped(p.doc) + (f" ({source})" if source else ""),
                "float" if p.is_number else "string",
                "" if p.unit in ("1", "-") else p.unit,
                number(p.default) if p.is_number else f"`{p.default}`",
                span(p),
                "" if p.neutral is None else number(p.neutral),
                number(p.plausible) if p.is_number else "",
                derivative,
            ]
        )
    head = ["name", "meaning", "type", "unit", "default", "bounds", "neutral", "plausible change", "derivative"]
    return table(head, cells)


def place(file: str) -> str:
    """A plugin's file, relative to the project."""
    path = Path(file).resolve()
    for folder in ("plugins",):
        if folder in path.parts:
            return "/".join(path.parts[len(path.parts) - path.parts[::-1].index(folder) - 1 :])
    return path.name


def body(doc: str, figure: str = "") -> str:
    found = sections(doc)
    pieces = []
    for name in ("Definition", "Fingerprint", "Validity", "References"):
        if name not in found:
            continue
        text = definition(found[name]) if name == "Definition" else prose(found[name])
        pieces.append(f"## {name}\n\n{text}" + (f"\n\n{figure}" if name == "Fingerprint" and figure else ""))
    return "\n\n".join(pieces)


def figure_of(effect, record: dict) -> str:
    """The fingerprint figure and its caption."""
    own = record[effect.key]
    values = ", ".join(f"`{k} = {number(v)}`" for k, v in list(own["strength"].items())[:3])
    more = f" and {len(own['strength']) - 3} more alike" if len(own["strength"]) > 3 else ""
    times = "the plausible strength" if own["factor"] == 1 else f"{own['factor']:g} times the plausible strength"
    if own["along"] is None:
        seen = (
            f"Without, with, and the difference (gray: none; near white and black: ±{own['scale']:g} DN), at {times}: "
            f"{values}{more}. "
            f"The image changes by {own['rms']:.1%} rms of its mean."
        )
    else:
        seen = (
            f"Readings against `{own['along']}` without and with the effect, and the difference (at most "
            f"{own['scale']:g} DN), at {times}: {values}{more}."
        )
    return (
        f":::{{figure}} ../../fingerprints/{effect.key}.webp\n:alt: What {escaped(effect.name)} changes in an image\n"
        f":figclass: fingerprint\n\n{seen} Scene: `{own['view']}`.\n:::"
    )


def effect_page(effect, reg, record: dict) -> str:
    title, sentence = effect.name[:1].upper() + effect.name[1:], summary(effect.doc)[1]
    brought = [p for p in (*effect.parameters, *effect.shape) if not isinstance(p, str)]
    rows = [(p, "freed by the effect") for p in reg.effect_parameters(effect)]
    rows += [(p, "stays as it is") for p in brought if p.name not in effect.parameter_names]
    facts = [
        ["part", " or ".join(f"[{kind}](../parts/{kind}.md)" for kind in reg.carriers(effect))],
        ["enters at", ", ".join(f"`{s}`" for s in effect.stages) or "the part itself"],
        [
            "one value for",
            ("each " + effect.part if effect.per == "part" else f"every {effect.part} together")
            + (", in each frame" if effect.scope == "frame" else ", in all frames"),
        ],
        ["onset", {"tangent": "linear at neutral", "secant": "not linear: a finite step is ranked"}.get(
            effect.onset, "tangent and finite step are both ranked")],
        ["acts through", ", ".join(effect.acts) or "—"],
        ["seen in", escaped(effect.needs) or "—"],
        ["file", f"`{place(effect.file)}`"],
    ]  # fmt: skip
    if effect.requires:
        facts.insert(1, ["needs also", ", ".join(f"[{k}](../parts/{k}.md)" for k in effect.requires)])
    key = f"{effect.part}.{effect.parameter_names[0]}"
    return (
        f"# {escaped(title)}\n\n{escaped(sentence)}\n\n"
        + table(["effect", f"`{effect.key}`"], facts)
        + f"\n\n```sh\noptics effects {effect.key}                 # this page on the terminal\n"
        + f"optics add STUDY '{effect.name}'   # free {key} and refit everything\n```\n\n"
        + body(effect.doc, figure_of(effect, record))
        + f'\n\n## Parameters\n\nAs XML: `<float name="{effect.parameter_names[0]}" value="..."/>` within the element '
        + f"of the type `{effect.part}`.\n\n"
        + parameter_table(rows)
        + "\n"
    )


def part_page(part, reg) -> str:
    title, sentence = summary(part.doc)
    if sum(p.file == part.file for p in reg.parts.values()) > 1:  # parts of one file share its text
        title = part.kind.replace("_", " ").capitalize()
    own = {p.name for p in part.parameters}
    source = {
        p.name: f"[{e.name}](../effects/{e.key}.md)"
        for e in reg.effects.values()
        if part.kind in reg.carriers(e)
        for p in (*e.parameters, *e.shape)
        if not isinstance(p, str)
    }
    freed = {n: f"[{e.name}](../effects/{e.key}.md)" for e in reg.effects.values() if part.kind in reg.carriers(e)
             for n in e.parameter_names}  # fmt: skip
    rows = [
        (p, f"effect {source[p.name]}" if p.name not in own else f"effect {freed[p.name]}" if p.name in freed else "")
        for p in reg.parameters_of(part.kind)
    ]
    acting = sorted((e for e in reg.effects.values() if part.kind in reg.carriers(e)), key=lambda e: e.key)
    known = attributes(part.doc)
    text = (
        f"# {escaped(title)}\n\n{escaped(sentence)}\n\n"
        + f'In a scene: `<{ELEMENT[part.category]} type="{part.kind}" id="...">`. File: `{place(part.file)}`. '
        + f"On the terminal: `optics effects {part.kind}`.\n\n"
        + body(part.doc)
        + '\n\n## Parameters\n\nEach is written in XML as `<float name="..." value="..."/>` (or `<string>`), and set '
        + "by its key `ID.NAME` from the command line, a capture file or Python.\n\n"
        + parameter_table(rows)
    )
    if known:
        text += (
            "\n\n## Further XML attributes\n\nThey are read once, when the scene is loaded, and are not parameters.\n\n"
            + table(
                ["name", "meaning", "type", "default"],
                [[f"`{a.name}`", escaped(a.meaning), a.type, escaped(a.default) or "none"] for a in known],
            )
        )
    if acting:
        text += "\n\n## Effects that act on it\n\n" + "\n".join(
            f"- [{escaped(e.name)}](../effects/{e.key}.md): {escaped(summary(e.doc)[1])}" for e in acting
        )
    return text + "\n"


def effect_index(reg, record: dict) -> str:
    """All effects by the part that they act on."""
    pieces = [
        "# Effects",
        f"{len(reg.effects)} physical effects ship with the program; each is one file in `plugins/effects`. Every "
        "figure is measured: a scene is rendered with the effect and without it (`python docs/tools/fingerprints.py`).",
    ]
    for kind in sorted({e.part for e in reg.effects.values()}, key=lambda k: (k != "camera", k)):
        parts = " or ".join(f"[{k}](../parts/{k}.md)" for k in reg.kinds(kind))
        pieces.append(f"## {kind}\n\nOf the part {parts}.")
        own = sorted((e for e in reg.effects.values() if e.part == kind), key=lambda e: e.name)
        pieces.append("\n".join(f"- [{escaped(e.name)}]({e.key}.md): {escaped(summary(e.doc)[1])}" for e in own))
    tree = "\n".join(sorted(reg.effects))
    return "\n\n".join(pieces) + f"\n\n:::{{toctree}}\n:hidden:\n:maxdepth: 1\n\n{tree}\n:::\n"


def part_index(reg) -> str:
    pieces = ["# Parts", "A sensor's scene is put together from these, beside everything that stock Mitsuba has."]
    for category in sorted({p.category for p in reg.parts.values()}):
        pieces.append(f"## {category}")
        own = sorted((p for p in reg.parts.values() if p.category == category), key=lambda p: p.kind)
        pieces.append("\n".join(f"- [`{p.kind}`]({p.kind}.md): {escaped(summary(p.doc)[1])}" for p in own))
    tree = "\n".join(sorted(reg.parts))
    return "\n\n".join(pieces) + f"\n\n:::{{toctree}}\n:hidden:\n:maxdepth: 1\n\n{tree}\n:::\n"


def put(file: Path, text: str) -> None:
    """Write a file only where it differs: Sphinx rebuilds what is newer."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.is_file() or file.read_text(encoding="utf-8") != text:
        file.write_text(text, encoding="utf-8")


def write_pages(folder: Path) -> int:
    """Write all pages below a folder (`parts/`, `effects/`) and the files that they are made of (`sources/`), and
    remove those of plugins that are gone; their number."""
    from optics.scene.registry import known

    reg = known()
    record = json.loads((FIGURES / "figures.json").read_text(encoding="utf-8"))
    if lacking := sorted(set(reg.effects) - set(record)):
        raise LookupError(
            f"no fingerprint figure of {', '.join(lacking)}; run python docs/tools/fingerprints.py {' '.join(lacking)}"
        )
    pages = {"effects/index.md": effect_index(reg, record), "parts/index.md": part_index(reg)}
    pages.update({f"effects/{key}.md": effect_page(e, reg, record) for key, e in reg.effects.items()})
    pages.update({f"parts/{kind}.md": part_page(p, reg) for kind, p in reg.parts.items()})
    # pages show whole files by the key of what they declare, wherever the files are
    pages.update(
        {
            f"sources/{k}.py": Path(i.file).read_text(encoding="utf-8")
            for k, i in (*reg.effects.items(), *reg.parts.items())
        }
    )
    for name, text in pages.items():
        put(folder / name, text)
    for file in [*folder.glob("*/*.md"), *folder.glob("sources/*.py")]:
        if file.relative_to(folder).as_posix() not in pages:
            file.unlink()
    return len(pages)


if __name__ == "__main__":
    print(write_pages(Path(sys.argv[1])))
