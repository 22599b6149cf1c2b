"""Commands that show what there is: scenes, their parameters, effects and parts; and the one that drafts an effect."""

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optics.cli.shared import (
    AsJson,
    Defines,
    Force,
    Plugins,
    SceneName,
    Variant,
    command,
    load_scene,
    scan,
    show,
    terminal,
)
from optics.words import annotated, key_of, number, reflowed, table, wrapped

if TYPE_CHECKING:
    from optics.scene.declare import Effect
    from optics.scene.loader import Scene
    from optics.scene.registry import Registry


@command
def scenes(as_json: AsJson = False) -> None:
    """List the shipped scenes, and a first command for each."""
    from optics.scene import loader as scene

    rows: list[dict[str, str]] = []
    for name in scene.shipped_scenes():
        title, look = scene.told(name)
        rows.append({"name": name, "title": title, "look": look, "file": str(scene.find(name))})
    if as_json:
        return show(rows)
    print(table([(r["name"], r["title"]) for r in rows]))
    print("\nworth a first look:\n" + "\n".join(f"  {r['look']}" for r in rows if r["look"]))


@command
def params(
    scene: SceneName,
    patterns: Annotated[
        list[str] | None, typer.Argument(metavar="[PATTERN]...", help="Keys to show: 'led_*', '*.x'.")
    ] = None,
    define: Defines = None,
    plugins: Plugins = None,
    variant: Variant = None,
    as_json: AsJson = False,
) -> None:
    """List the parameters of a scene.

    Prints key, value, unit, bounds, neutral value, derivative and meaning."""
    from optics.errors import UnknownKey
    from optics.light import spectra

    loaded = load_scene(scene, define, plugins, variant)
    keys = list(loaded.values())
    for pattern in patterns or ():
        if not any(fnmatchcase(key, pattern) for key in keys):
            raise UnknownKey(pattern, keys, "parameter", str(loaded.path), "(* and ? match)")
    chosen = [key for key in keys if not patterns or any(fnmatchcase(key, pattern) for pattern in patterns)]
    rows = _parameter_rows(loaded, chosen)
    if as_json:
        return show(rows)
    head = ("key", "value", "unit", "bounds", "neutral", "derivative", "meaning")
    lines = [_parameter_line(r) for r in rows]
    short, notes = zip(*map(_parameter_short, rows)) if rows else ((), ())
    print(annotated([head, *lines], [head[:5], *short], ["", *notes]))
    if not patterns and (loaded.curves or loaded.integral is not None):
        print(
            "\n" + table([("spectrum", "kind", "nm", "mean", "source"), *map(_spectrum_line, spectra.records(loaded))])
        )
    if not patterns and loaded.integral is not None:
        print("\n" + wrapped(loaded.integral.describe()))


def _spectrum_line(r: Mapping[str, Any]) -> tuple[str, ...]:
    span = "-" if r["span"] is None else f"{r['span'][0]:g} .. {r['span'][1]:g}"
    return (r["key"], r["kind"], span, "-" if r["centre"] is None else f"{r['centre']:.1f}", r["source"])


@command
def plot_spectra(
    scene: SceneName,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="FILE.png, .svg or .pdf.")],
    define: Defines = None,
    plugins: Plugins = None,
    variant: Variant = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Plot the spectra of a scene over the wavelength.

    Shows light, losses and the camera's sensitivities in one figure."""
    from optics.files.output import claim, replacing
    from optics.light import spectra

    if output.suffix.lower() not in PLOTS:
        raise ValueError(
            f"-o {output}: '{output.suffix}' is no format of a plot; allowed: a name ending in .png, .pdf or .svg"
        )
    claim([output], force)
    loaded = load_scene(scene, define, plugins, variant)
    figure = spectra.draw(loaded)
    with replacing(output) as file:
        figure.savefig(file, format=output.suffix[1:].lower(), dpi=130)
    bands = None if loaded.integral is None else loaded.integral.describe()
    if as_json:
        return show({"files": [str(output)], "spectra": spectra.records(loaded), "bands": bands})
    print(output)
    if bands is not None:
        terminal.note(bands)


PLOTS = (".png", ".svg", ".pdf")
# how a derivative image is made (`Parameter.how`), for the reader of a table
DERIVATIVES = {
    "ad": "forward mode",
    "difference": "differences",
    "image": "complex step",
    "layer": "complex step",
    "path": "path lengths",
    None: "-",
}


def _parameter_rows(scene: "Scene", keys: Sequence[str]) -> list[dict[str, Any]]:
    """What a scene knows of its parameters, as `optics params --json` gives it."""
    values = scene.values()
    brought = {(e.part, name): e.name for e in scene.registry.effects.values() for name in e.parameter_names}
    rows = []
    for key in keys:
        p = scene.parameters[key]
        part = scene.parts.get(key.rsplit(".", 1)[0])
        rows.append(
            {
                "key": key,
                "value": values[key],
                "unit": p.unit,
                "bounds": list(p.bounds) if p.is_number else None,
                "choices": list(p.choices) or None,
                "neutral": p.neutral,
                "plausible": p.plausible if p.is_number else None,
                "differentiable": p.differentiable,
                "derivative": p.how if p.differentiable else None,
                "linear": p.linear,
                "squared": p.squared,
                "effect": brought.get((part.kind, p.name)) if part is not None else None,
                "meaning": p.doc,
            }
        )
    return rows


def _parameter_line(r: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        r["key"],
        number(r["value"], 6),
        r["unit"],
        "|".join(r["choices"]) if r["choices"] else _span(r["bounds"]),
        "-" if r["neutral"] is None else f"{r['neutral']:g}",
        DERIVATIVES[r["derivative"]] + (", linear" if r["linear"] else ", of its square" if r["squared"] else ""),
        r["meaning"] + (f" [effect: {r['effect']}]" if r["effect"] else ""),
    )


def _parameter_short(r: Mapping[str, Any]) -> tuple[tuple[str, ...], str]:
    """For a narrow terminal: what fits one line, and what stands under it."""
    key, value, unit, span, neutral, derivative, meaning = _parameter_line(r)
    named = f"; {', '.join(r['choices'])}" if r["choices"] else ""
    return (
        (key, value, unit, "a word" if r["choices"] else span, neutral),
        meaning + named + (f"; derivative: {derivative}" if r["derivative"] else ""),
    )


def _span(bounds: Sequence[float]) -> str:
    return "any" if math.inf in bounds else " .. ".join(f"{b:g}" for b in bounds)


def _new_effect(name: str | None, plugins: Sequence[Path] | None, **given: Any) -> None:
    """Write a plugin file, print its path, and note what comes next."""
    from optics.files.output import shipped
    from optics.scene.declare import STAGES
    from optics.study import draft

    if not name:
        raise ValueError("optics effects new: no name; allowed: optics effects new NAME, such as 'row banding'")
    draft.identifier(name)
    registry = scan(plugins)
    if given["from"] is None:
        if given["along"] is not None:
            raise ValueError(f"--along {given['along']}: of which study? Add --from STUDY")
        stage = draft.stage_of(given["part"], given["stage"])
        draft.check_name(name, STAGES[stage], registry)
        text, folder = draft.new_effect(name, stage), plugins[0] if plugins else Path("plugins")
    else:
        if given["stage"] or given["part"]:
            raise ValueError(
                "--stage, --part: a draft acts where its coordinate is known; leave them out, or leave --from out"
            )
        text, folder = draft.from_study(given["from"], given["along"], name, plugins)
    folder = Path(given["o"] or folder)
    if folder.resolve().is_relative_to(shipped("plugins").resolve()):
        raise ValueError(
            f"optics effects new: {folder} belongs to the plugins that ship; name a folder of your own, such as "
            "-o my_plugins"
        )
    file = draft.write(text, folder, name)
    terminal.note(
        f"next: optics add {given['from']} '{name}', then put a formula in place of the table"
        if given["from"]
        else f"next: fill in the formula; commands run it with --plugins {file.parent}"
    )
    print(file)


@command
def effects(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]",
            help="Show the page of this effect or part (led, gel, camera ...); 'new': write an effect.",
        ),
    ] = None,
    new_name: Annotated[
        str | None, typer.Argument(metavar="[NEW]", help="With `effects new NAME`: the name of the new effect.")
    ] = None,
    stage: Annotated[
        str | None, typer.Option("--stage", help="new: where it acts (lens, sensor, response, emission, segment ...).")
    ] = None,
    part: Annotated[
        str | None, typer.Option("--part", help="new: the part it acts on: camera, led, gel or membrane.")
    ] = None,
    study: Annotated[
        Path | None, typer.Option("--from", metavar="STUDY", help="new: use a curve of this study's last diagnosis.")
    ] = None,
    along: Annotated[
        str | None, typer.Option("--along", metavar="COORDINATE", help="new: the coordinate of the curve.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="new: folder for the plugin.")
    ] = None,
    plugins: Plugins = None,
    as_json: AsJson = False,
) -> None:
    """List the effects, show the page of one, or write one.

    An effect can be added to a model. `optics effects NAME` shows its page; `optics effects new NAME` writes a new one.
    Parts have pages too: `optics effects led` shows the LED's law, its parameters, and the effects that act on it.
    """
    from optics.errors import UnknownKey

    options = {"--stage": stage, "--part": part, "--from": study, "--along": along, "-o": output}
    if name == "new":
        return _new_effect(new_name, plugins, **{k.strip("-"): v for k, v in options.items()})
    given = [k for k, v in options.items() if v is not None] + ([new_name] if new_name else [])
    if given:
        raise ValueError(f"{' '.join(given)}: only with `optics effects new NAME`, which writes a new effect")
    found = scan(plugins)
    key = key_of(name or "")
    if name and key not in found.effects:
        if (kind := key.replace("-", "_")) in found.parts:
            return _part_page(found, kind, as_json)
        raise UnknownKey(name, [*found.effects, *found.parts], "effect or part", hint="`optics effects` lists them")
    chosen = [found.find_effect(name)] if name else [found.effects[k] for k in sorted(found.effects)]
    if name:
        return _effect_page(found, chosen[0], as_json)
    records = [_effect_record(found, e) for e in chosen]
    if as_json:
        return show(records)
    head = ("effect", "part", "parameters", "onset", "needs")
    lines = [
        (r["key"], r["part"], ", ".join(p["name"] for p in r["parameters"]), r["onset"], r["needs"] or "-")
        for r in records
    ]
    notes = [f"needs: {line[-1]}" for line in lines]
    print(annotated([head, *lines], [head[:-1], *(line[:-1] for line in lines)], ["", *notes]))
    print("\n" + wrapped(f"parts, each with a page too: {', '.join(sorted(found.parts))}"))


def _effect_record(found: "Registry", e: "Effect") -> dict[str, Any]:
    """An effect's declaration, as `optics effects --json` gives it."""
    return {
        "key": e.key,
        "name": e.name,
        "part": e.part,
        "stages": list(e.stages),
        "onset": e.onset,
        "scope": e.scope,
        "per": e.per,
        "acts": list(e.acts),
        "needs": e.needs,
        "file": e.file,
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "neutral": p.neutral,
                "bounds": list(p.bounds),
                "plausible": p.plausible,
                "meaning": p.doc,
            }
            for p in found.effect_parameters(e)
        ],
    }


def _effect_page(found: "Registry", e: "Effect", as_json: bool) -> None:
    """Show an effect: its page, where it acts, and its parameters."""
    r = {**_effect_record(found, e), "page": e.doc}
    if as_json:
        return show(r)
    each = f"each {r['part']}" if r["per"] == "part" else "all of the kind"
    facts = [
        ("part", f"{r['part']}, one value for {each}{', in each frame' if r['scope'] == 'frame' else ''}"),
        ("enters at", ", ".join(r["stages"]) or "the part itself"),
        ("onset", r["onset"]),
        ("acts through", ", ".join(r["acts"]) or "-"),
        ("needs", r["needs"] or "-"),
    ]
    lines = [
        (p["name"], p["unit"], f"{p['neutral']:g}", f"{p['bounds'][0]:g} .. {p['bounds'][1]:g}", p["meaning"])
        for p in r["parameters"]
    ]
    print(reflowed(r["page"].strip()))
    print("\n" + wrapped(f"{r['name']}: `{r['key']}`, {r['file']}"))
    print(table(facts))
    print("\n" + table([("parameter", "unit", "neutral", "bounds", "meaning"), *lines]))


def _part_page(found: "Registry", kind: str, as_json: bool) -> None:
    """Show a part: its page, its own parameters, and the effects that act on it."""
    part = found.parts[kind]
    acting = sorted(k for k, e in found.effects.items() if e.part == kind)
    rows: list[dict[str, Any]] = [
        {
            "name": p.name,
            "unit": p.unit,
            "default": p.default,
            "neutral": p.neutral,
            "bounds": list(p.bounds) if p.is_number else None,
            "choices": list(p.choices) or None,
            "meaning": p.doc,
        }
        for p in part.parameters
    ]
    if as_json:
        return show(
            {
                "key": kind,
                "category": part.category,
                "file": part.file,
                "parameters": rows,
                "effects": acting,
                "page": part.doc,
            }
        )
    print(reflowed(part.doc.strip()))
    facts = f"{kind}: {part.category}, {part.file}\neffects that act on it: {', '.join(acting) or 'none'}"
    print("\n" + wrapped(facts) + "\n")
    print(
        table(
            [
                ("parameter", "unit", "default", "bounds", "neutral", "meaning"),
                *(
                    (
                        r["name"],
                        r["unit"],
                        number(r["default"], 6),
                        "|".join(r["choices"]) if r["choices"] else _span(r["bounds"]),
                        "-" if r["neutral"] is None else f"{r['neutral']:g}",
                        r["meaning"],
                    )
                    for r in rows
                ),
            ],
        )
    )
