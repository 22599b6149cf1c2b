"""The command line: thin. Each command reads its arguments, calls one verb of the library and shows what came of it.

Results go to stdout (`--json` for programs); progress and remarks to stderr, progress only on a terminal. Exit codes: 0
done, 1 done with a negative finding, 2 an error of the input, said in one line. Heavy imports stand inside the
commands."""

import functools
import inspect
import json
import math
import os
import re
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from optics import __version__
from optics.words import key_of, spaced, table

INTERRUPTED = 130  # 128 and the number of SIGINT, as shells count

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    help="Optical models of camera-based touch sensors that can be held against a measurement.",
)


# -- what every command shares
# --------------------------------------------------------------------------------------------


class Terminal:
    """Where a command speaks: `note` for remarks, `progress` for long work. Results are printed."""

    quiet = False
    debug = False

    def note(self, text: str) -> None:
        if not self.quiet:
            print(text, file=sys.stderr)

    @contextmanager
    def progress(self) -> Iterator[Callable[[str, int, int], None] | None]:
        """A function (what, done, total) that draws a bar; None where nobody looks."""
        if self.quiet or not sys.stderr.isatty():
            yield None
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        tasks: dict[str, int] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done, total=total)

        with bars:
            yield show


terminal = Terminal()

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no remarks.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show where in the program an error came from.")]
AsJson = Annotated[bool, typer.Option("--json", help="The result for programs.")]
SceneName = Annotated[
    str, typer.Argument(metavar="SCENE", help="A shipped scene's name (`optics scenes`) or an XML file.")
]
CaptureSet = Annotated[str, typer.Argument(metavar="CAPTURES", help="Folder with captures.toml.")]
StudyFolder = Annotated[Path, typer.Argument(metavar="STUDY", help="Folder that `optics calibrate` made.")]
Defines = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="NAME=VALUE", help="Replace a <default> of the scene's XML. Repeatable."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a parameter (`optics params SCENE` lists them). Repeatable."),
]
Plugins = Annotated[Path | None, typer.Option("--plugins", metavar="DIR", help="A further folder of plugins.")]
Variant = Annotated[str | None, typer.Option("--variant", help="Mitsuba variant.", show_default=False)]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
At = Annotated[
    str | None,
    typer.Option(
        "--at",
        metavar="U,V",
        help="Pixel position, u right and v down from the top left.",
        show_default="the image's centre",
    ),
]
FlatField = Annotated[
    str | None,
    typer.Option(
        "--flat-field", metavar="MODE", help="How a background image enters: multiplicative, additive or none."
    ),
]


def command(function: Callable) -> Callable:
    """Register a command, and give it the options that every command has."""

    @functools.wraps(function)
    def run(*args, quiet: bool = False, debug: bool = False, **options):
        terminal.quiet, terminal.debug = quiet, debug
        try:
            function(*args, **options)
            sys.stdout.flush()
        except BrokenPipeError:  # whoever read our output has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except (Exception, KeyboardInterrupt) as error:
            stopped = _ctrl_c(error)  # in which typer would end without a word
            if stopped is None:
                raise
            print(": ".join(["interrupted", *map(str, stopped.args)]), file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None

    shared = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
        for name, kind in (("quiet", Quiet), ("debug", Debug))
    ]
    signature = inspect.signature(function)
    run.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *shared])
    run.__annotations__ = {**function.__annotations__, "quiet": Quiet, "debug": Debug}
    return app.command()(run)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    terminal.quiet, terminal.debug = False, "--debug" in arguments
    with warnings.catch_warnings():
        warnings.showwarning = lambda text, *_: terminal.note(f"warning: {_one_line(text)}")
        try:
            return int(app(args=arguments, prog_name="optics", standalone_mode=False) or 0)
        except Exception as error:
            return _report(error)


def _ctrl_c(error: BaseException | None) -> KeyboardInterrupt | None:
    """The Ctrl-C behind an error: within a render, Dr.Jit puts an error of its own around it."""
    return (
        error
        if error is None or isinstance(error, KeyboardInterrupt)
        else _ctrl_c(error.__cause__ or error.__context__)
    )


def _report(error: Exception) -> int:
    """Say an error in one line; a bug, which is no user's fault, with its traceback."""
    expected = isinstance(error, (ValueError, LookupError, OSError, RuntimeError)) or hasattr(error, "format_message")
    if terminal.debug or not expected:
        traceback.print_exception(error, file=sys.stderr)
    text = _usage(error) if hasattr(error, "format_message") else _text(error)
    print(
        f"error: {_one_line(text)}" + ("" if expected else " (a bug: please report it with the lines above)"),
        file=sys.stderr,
    )
    return 2


def _usage(error: Exception) -> str:
    """A wrong option or argument, as typer says it, and where the right ones are listed."""
    context = getattr(error, "ctx", None)
    return error.format_message().rstrip(".") + (f"; see `{context.command_path} --help`" if context else "")


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if type(error) is KeyError:
        return f"no entry {error}"
    return str(error) or type(error).__name__


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def show(result: object) -> None:
    """Print a result for programs."""

    def plain(value):
        if isinstance(value, Mapping):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    print(json.dumps(plain(result), indent=1, allow_nan=False, default=str))


def pairs(items: Sequence[str] | None, option: str) -> dict[str, str]:
    """{name: text} of NAME=TEXT arguments."""
    found = {}
    for item in items or ():
        name, equals, text = item.partition("=")
        if not equals or not name.strip():
            raise ValueError(f"{option} {item}: no '='; allowed: {option} NAME=VALUE")
        found[name.strip()] = text.strip()
    return found


def settings(items: Sequence[str] | None) -> dict[str, float | str]:
    """{key: number or word} of --set arguments."""

    def value(text):
        try:
            return float(text)
        except ValueError:
            return text

    return {key: value(text) for key, text in pairs(items, "--set").items()}


def priors(items: Sequence[str] | None) -> dict[str, tuple[float | None, float]]:
    """{pattern: (mean, sd)} of PATTERN=MEAN+-SD arguments; without a mean (PATTERN=+-SD) it is the present value."""
    found = {}
    for pattern, text in pairs(items, "--prior").items():
        number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
        match = re.fullmatch(rf"({number})?\s*(?:\+-|\+/-|±)\s*({number})", text)
        if match is None or not float(match[2]) > 0:
            raise ValueError(
                f"--prior {pattern}={text}: allowed: PATTERN=MEAN+-SD with SD above 0, such as "
                "'led_*.x=11+-0.5', or PATTERN=+-SD about the present value"
            )
        found[pattern] = (float(match[1]) if match[1] else None, float(match[2]))
    return found


def load_scene(name: str, defines: Sequence[str] | None, plugins: Path | None, variant: str | None = None):
    """The scene of a command line."""
    from optics.scene import loader as scene
    from optics.scene.mitsuba_parts import DEFAULT_VARIANT

    return scene.load(name, pairs(defines, "-D"), variant or DEFAULT_VARIANT, plugins)


def setup_of(captures: str, defines: Sequence[str] | None, plugins: Path | None, values: Sequence[str] | None, **more):
    """What a study starts from (optics.study.loop.Setup); places are absolute, so that any folder can go on with it."""
    from optics.study import loop

    return loop.setup_for(
        os.path.abspath(captures),
        defines=pairs(defines, "-D"),
        values=settings(values),
        plugins=os.path.abspath(plugins) if plugins else None,
        **more,
    )


def scan(plugins: Path | None):
    """The registry, with a further folder."""
    from optics.scene.registry import known

    return known(plugins)


@app.callback(invoke_without_command=True)
def optics(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        print(f"optics {__version__}")
        raise typer.Exit()


# -- looking around
# -------------------------------------------------------------------------------------------------------


@command
def scenes(as_json: AsJson = False) -> None:
    """List the scenes that ship with the program."""
    from optics.scene import loader as scene

    rows = []
    for name in scene.shipped_scenes():
        path = scene.find(name)
        comment = re.search(r"<!--(.*?)-->", path.read_text(encoding="utf-8"), re.DOTALL)
        title = next((line.strip() for line in (comment[1] if comment else "").splitlines() if line.strip()), "")
        rows.append({"name": name, "title": title, "file": str(path)})
    show(rows) if as_json else print(table([(r["name"], r["title"]) for r in rows]))


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
    """List the parameters of a scene: value, unit, bounds, neutral value, derivative, meaning."""
    from optics.errors import UnknownKey

    loaded = load_scene(scene, define, plugins, variant)
    values = loaded.values()
    keys = list(values)
    for pattern in patterns or ():
        if not any(fnmatchcase(key, pattern) for key in keys):
            raise UnknownKey(pattern, keys, "parameter", str(loaded.path), "(* and ? match)")
    brought = {(e.part, name): e.name for e in loaded.registry.effects.values() for name in e.parameter_names}
    rows = []
    for key in keys:
        if patterns and not any(fnmatchcase(key, pattern) for pattern in patterns):
            continue
        p = loaded.parameters[key]
        part = loaded.parts.get(key.rsplit(".", 1)[0])
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
    if as_json:
        return show(rows)
    how = {
        "ad": "forward mode",
        "difference": "differences",
        "image": "complex step",
        "layer": "complex step",
        "path": "lengths of ways",
        None: "-",
    }
    print(
        table(
            [
                ("key", "value", "unit", "bounds", "neutral", "derivative", "meaning"),
                *(
                    (
                        r["key"],
                        _number(r["value"]),
                        r["unit"],
                        "|".join(r["choices"]) if r["choices"] else _span(r["bounds"]),
                        "-" if r["neutral"] is None else f"{r['neutral']:g}",
                        how[r["derivative"]]
                        + (", linear" if r["linear"] else ", of its square" if r["squared"] else ""),
                        r["meaning"] + (f" [effect: {r['effect']}]" if r["effect"] else ""),
                    )
                    for r in rows
                ),
            ]
        )
    )


def _number(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _span(bounds: Sequence[float]) -> str:
    return "any" if math.inf in bounds else " .. ".join(f"{b:g}" for b in bounds)


def _new_effect(name: str | None, plugins: Path | None, **given) -> None:
    """Write a plugin file, and say where and what comes next."""
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
        text, folder = draft.new_effect(name, stage), plugins or Path("plugins")
    else:
        if given["stage"] or given["part"]:
            raise ValueError(
                "--stage, --part: a draft acts where its coordinate is known; leave them out, or leave --from out"
            )
        text, folder = draft.from_study(given["from"], given["along"], name, plugins)
    file = draft.write(text, given["o"] or folder, name)
    terminal.note(
        f"next: optics add {given['from']} '{name}', then put a formula in place of the table"
        if given["from"]
        else f"next: fill in the formula; a folder 'plugins' beside captures or scene is found, any other by --plugins {file.parent}"
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
        str | None, typer.Argument(metavar="[NEW]", help="Of `effects new NAME`: the new effect's name.")
    ] = None,
    stage: Annotated[
        str | None, typer.Option("--stage", help="new: where it acts (lens, sensor, response, emission, segment ...).")
    ] = None,
    part: Annotated[str | None, typer.Option("--part", help="new: on camera, led, gel or membrane.")] = None,
    study: Annotated[
        Path | None, typer.Option("--from", metavar="STUDY", help="new: with a curve of this study's last diagnosis.")
    ] = None,
    along: Annotated[
        str | None, typer.Option("--along", metavar="COORDINATE", help="new: the coordinate of the curve.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="new: folder of plugins.")
    ] = None,
    plugins: Plugins = None,
    as_json: AsJson = False,
) -> None:
    """List the physical effects that can be added to a model, show one's page, or write a new one (`optics effects new
    NAME`).

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
    records = [
        {
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
            **({"page": e.doc} if name else {}),
        }
        for e in chosen
    ]
    if as_json:
        return show(records[0] if name else records)
    if not name:
        return print(
            table(
                [
                    ("effect", "part", "parameters", "onset", "needs"),
                    *(
                        (
                            r["key"],
                            r["part"],
                            ", ".join(p["name"] for p in r["parameters"]),
                            r["onset"],
                            r["needs"] or "-",
                        )
                        for r in records
                    ),
                ]
            )
            + f"\n\nparts, each with a page too: {', '.join(sorted(found.parts))}"
        )
    r = records[0]
    print(f"{r['page'].strip()}\n\n{r['name']}: `{r['key']}`, {r['file']}")
    print(
        table(
            [
                (
                    "part",
                    f"{r['part']}, one value for {'each ' + r['part'] if r['per'] == 'part' else 'all of the kind'}"
                    f"{', in each frame' if r['scope'] == 'frame' else ''}",
                ),
                ("enters at", ", ".join(r["stages"]) or "the part itself"),
                ("onset", r["onset"]),
                ("acts through", ", ".join(r["acts"]) or "-"),
                ("needs", r["needs"] or "-"),
            ]
        )
    )
    print(
        "\n"
        + table(
            [
                ("parameter", "unit", "neutral", "bounds", "meaning"),
                *(
                    (
                        p["name"],
                        p["unit"],
                        f"{p['neutral']:g}",
                        f"{p['bounds'][0]:g} .. {p['bounds'][1]:g}",
                        p["meaning"],
                    )
                    for p in r["parameters"]
                ),
            ]
        )
    )


def _part_page(found, kind: str, as_json: bool) -> None:
    """Show a part: its page, its own parameters, and the effects that act on it."""
    part = found.parts[kind]
    acting = sorted(k for k, e in found.effects.items() if e.part == kind)
    rows = [
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
    print(
        f"{part.doc.strip()}\n\n{kind}: {part.category}, {part.file}\neffects that act on it: {', '.join(acting) or 'none'}\n"
    )
    print(
        table(
            [
                ("parameter", "unit", "default", "bounds", "neutral", "meaning"),
                *(
                    (
                        r["name"],
                        r["unit"],
                        _number(r["default"]),
                        "|".join(r["choices"]) if r["choices"] else _span(r["bounds"]),
                        "-" if r["neutral"] is None else f"{r['neutral']:g}",
                        r["meaning"],
                    )
                    for r in rows
                ),
            ]
        )
    )


@command
def doctor(as_json: AsJson = False) -> None:
    """Say what this machine can run, and what to do about the rest."""
    from optics import doctor as machine

    rows = machine.report()
    print(machine.report_json(rows) if as_json else machine.report_table(rows))
    if not machine.is_sound(rows):
        raise typer.Exit(1)


# -- images -------------------------------------------------------------------------------------------------------------


@command
def render(
    scene: SceneName,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.exr", help="Where the image goes.")],
    define: Defines = None,
    sets: Settings = None,
    png: Annotated[
        bool, typer.Option("--png", help="Also FILE.png: the camera's digital numbers, free of noise.")
    ] = False,
    stokes: Annotated[
        bool,
        typer.Option(
            "--stokes",
            help="Also FILE.dolp.png and FILE.aolp.png: degree and angle of linear polarization per band; S0 to S3 in "
            "the EXR, which scenes with layers have anyway.",
        ),
    ] = False,
    spp: Annotated[
        int | None,
        typer.Option(
            "--spp",
            help="Monte Carlo with so many samples per pixel, and variances; "
            "without it a sensor is rendered LED by LED, free of noise.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of everything random.")] = 0,
    plugins: Plugins = None,
    variant: Variant = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Render one image: an EXR with all that is known of it, and its provenance.

    The channels are radiance (with layers: Stokes vectors) per band, depth, normals, contact, one image per LED,
    variances; optics.light.rendering lists them."""
    from optics.files.output import claim, write_json
    from optics.light.rendering import RenderJob

    if output.suffix.lower() != ".exr":
        raise ValueError(
            f"-o {output}: '{output.suffix}' is no image format of this command; allowed: a name ending in .exr"
        )
    record, preview = output.with_suffix(".json"), output.with_suffix(".png")
    maps = tuple(output.with_suffix(f".{name}.png") for name in ("dolp", "aolp"))
    files = [output, record, *([preview] if png else []), *(maps if stokes else ())]
    claim(files, force)
    loaded = load_scene(scene, define, plugins, variant)
    values = loaded.check(settings(sets), "--set")
    clock = time.perf_counter()
    images = RenderJob(loaded, spp=spp, stokes=stokes)
    with terminal.progress() as progress:
        image = images.take(values, seed, progress=progress)
    seconds = time.perf_counter() - clock
    if png:
        image.write_png(preview)
    if stokes:
        from optics.light.polarimetry import write_maps

        write_maps(maps, *image.stokes())
    write_json(record, {**image.header["provenance"], "command": ["optics", *sys.argv[1:]]})
    image.write_exr(output)
    if as_json:
        return show(
            {
                "files": [str(f) for f in files],
                "method": images.method,
                "seconds": seconds,
                "channels": list(image.channels),
            }
        )
    for file in files:
        print(file)
    terminal.note(f"{images.method}, {seconds:.1f} s")


@command
def batch(
    job: Annotated[
        Path, typer.Argument(metavar="JOB.toml", help="What to make; optics.study.batch describes the file.")
    ],
    shard: Annotated[
        str, typer.Option("--shard", metavar="K/N", help="Make only every N-th sample, from the K-th on.")
    ] = "1/1",
    workers: Annotated[int | None, typer.Option("--workers", help="Processes.", show_default="one per core")] = None,
    plugins: Plugins = None,
    as_json: AsJson = False,
) -> None:
    """Make many images from a job file. May be stopped at any moment; the same command goes on."""
    from optics.study import batch as work

    part = work.parse_shard(shard)
    try:
        with terminal.progress() as progress:
            result = work.run(job, part, workers, plugins, progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what was made is kept, the same command goes on") from None
    if as_json:
        return show(
            {
                "folder": str(result.folder),
                "total": result.total,
                "own": result.own,
                "made": result.made,
                "complete": result.complete,
            }
        )
    print(
        f"{result.folder}: {result.own} of {result.total} samples, {result.made} of them made now"
        + (", all complete: manifest.csv" if result.complete else ", other shards are still to come")
    )


# -- polarized light
# -------------------------------------------------------------------------------------------------------


@command
def mueller(
    scene: SceneName,
    at: At = None,
    sets: Settings = None,
    wavelength: Annotated[
        list[float] | None,
        typer.Option("--wavelength", metavar="NM", help="Repeatable.", show_default="the scene's bands"),
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option("--part", metavar="NAME", help="Only these layers, and their product. Repeatable."),
    ] = None,
    define: Defines = None,
    plugins: Plugins = None,
    variant: Variant = None,
    as_json: AsJson = False,
) -> None:
    """Show what the layers on a camera ray do to polarization.

    The Mueller matrix of each layer, their product, and what it means. Axes: x right, y up in the image, angles from x
    to y. Layers are named from the camera on: the last one is the first that light meets."""
    from optics.light import paths, polarimetry

    loaded = load_scene(scene, define, plugins, variant)
    values = {**loaded.values(), **loaded.check(settings(sets), "--set")}
    u, v = polarimetry.pixel(loaded, at)
    bands = wavelength or list(loaded.integrator.bands) or [540.0]
    if not all(100 <= b <= 10000 for b in bands):
        raise ValueError(f"--wavelength {' '.join(f'{b:g}' for b in bands)}: allowed: 100 to 10000 nm")
    ray = polarimetry.follow(loaded, values, u, v)
    if not ray.names:
        there = paths.passable(loaded)
        raise ValueError(
            f"{loaded.path}: the ray through {u:g},{v:g} passes no layer; "
            + (f"the scene has {', '.join(there)}: give another place with --at U,V" if there else "the scene has none")
        )
    names, matrices, whole = polarimetry.stack(loaded, values, u, v, bands, part, ray)
    shown = [*zip(names, matrices), *([("product", whole)] if len(names) > 1 else [])]
    if as_json:

        def record(own):
            return {"matrix": own.tolist(), "bands": [polarimetry.decompose(m).numbers() for m in own]}

        layers = [{"name": n, "kind": loaded.parts[n].kind, **record(own)} for n, own in zip(names, matrices)]
        return show(
            {
                "scene": str(loaded.path),
                "at": [u, v],
                "wavelengths": bands,
                "ends_on": ray.end,
                "lost": ray.lost,
                "layers": layers,
                "product": record(whole),
            }
        )
    print(
        f"the ray through {u:g},{v:g} passes, from the camera on: {', '.join(ray.names)}; "
        + (f"it ends on {ray.end}" if ray.end else "it meets nothing")
    )
    for name, own in shown:
        title = name if name != "product" else f"product: {' '.join(names)}"
        print(f"\n{title}\n" + _matrices(own, bands))
    print("\n" + _meanings(shown, bands))
    if any(loaded.parts[n].kind == "interface" for n in names):
        terminal.note(
            "the transmittance of an interface is of radiance, which grows with n^2; at the way out it falls again"
        )
    if ray.lost:
        terminal.note("this ray is reflected totally on its way: nothing of what stands here arrives at the camera")


def _alike(own, bands) -> list[tuple[str, object]]:
    """(band, matrix) of matrices (B, 4, 4); one for all bands where they are the same."""
    import numpy as np

    if len(bands) > 1 and np.ptp(own, 0).max() < 5e-7:
        return [("all bands", own[0])]
    return [(f"{band:g} nm", matrix) for band, matrix in zip(bands, own)]


def _matrices(own, bands) -> str:
    """Matrices (B, 4, 4) side by side, with their bands above."""

    def entry(value):
        return f"{value:9.5f}" if abs(value) >= 5e-7 else f"{'0':>9}"

    found = _alike(own, bands)
    return "\n".join(
        [
            "    ".join(f"{band:<38}" for band, _ in found).rstrip(),
            *("    ".join(f"[{''.join(map(entry, m[i]))}]" for _, m in found) for i in range(4)),
        ]
    )


def _meanings(shown, bands) -> str:
    """The decompositions of layers and of their product as a table."""
    from optics.light.polarimetry import decompose

    def cell(value, digits=4, small=5e-7):
        return "-" if math.isnan(value) else f"{0 if abs(value) < small else value:.{digits}g}"

    def axis(angle, ellipticity):
        return cell(angle, 4, 1e-4) + (
            "" if math.isnan(ellipticity) or abs(ellipticity) < 0.05 else f" ({ellipticity:+.1f})"
        )

    lines = [
        (
            "",
            "",
            "T",
            "T max",
            "T min",
            "diattenuation",
            "axis",
            "retardance",
            "fast axis",
            "depolarization",
            "index",
            "physical",
        )
    ]
    for name, own in shown:
        for band, matrix in _alike(own, bands):
            d = decompose(matrix)
            lines.append(
                (
                    name,
                    band,
                    cell(d.transmittance),
                    cell(d.largest),
                    cell(d.smallest),
                    cell(d.diattenuation, 5),
                    axis(d.axis, d.axis_ellipticity),
                    cell(d.retardance, 4, 1e-4),
                    axis(d.fast_axis, d.fast_ellipticity),
                    cell(d.depolarization),
                    cell(d.depolarization_index, 5),
                    "no" if d.realisable < -1e-9 else "yes",
                )
            )
    return (
        table(lines)
        + "\nT: transmittance of unpolarized light. Axes and retardance in deg, an ellipticity (+-45: circular) in "
        "brackets. Depolarization: 0 none;\nindex: 1 none. '-': no meaning here, such as the retardance of a perfect polarizer."
    )


@command
def sweep(
    scene: SceneName,
    key: Annotated[str, typer.Option("--key", metavar="KEY", help="What is turned or changed.")] = "analyzer.angle",
    first: Annotated[
        float | None, typer.Option("--from", metavar="VALUE", help="First value.", show_default="0 of an angle")
    ] = None,
    last: Annotated[
        float | None, typer.Option("--to", metavar="VALUE", help="Last value.", show_default="180 of an angle")
    ] = None,
    steps: Annotated[int, typer.Option("--steps", min=2, max=10000, help="Values, both ends included.")] = 37,
    at: At = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE.png", help="Plot the curve.")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write the curve as a table.")] = None,
    captures: Annotated[
        Path | None,
        typer.Option(
            "--captures", metavar="CAPTURES", help="Measured readings to hold beside it: a folder with captures.toml."
        ),
    ] = None,
    fit: Annotated[
        Path | None, typer.Option("--fit", metavar="FIT.toml", help="Calibrated values, from a study.")
    ] = None,
    radiance: Annotated[
        bool, typer.Option("--radiance", help="Radiance per band in place of the camera's DN.")
    ] = False,
    define: Defines = None,
    sets: Settings = None,
    plugins: Plugins = None,
    variant: Variant = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Predict a reading against an angle, or any parameter.

    What a pixel or a photodiode reads, its extinction ratio, how far it is from Malus' cos^2; -o draws the curves.
    """
    import numpy as np

    from optics.captures import capture_set as capture_files
    from optics.files.output import claim, replacing
    from optics.light import polarimetry, rendering
    from optics.study import record as ladder

    if output is not None and output.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ValueError(
            f"-o {output}: '{output.suffix}' is no format of a plot; allowed: a name ending in .png, .pdf or .svg"
        )
    claim([f for f in (output, csv) if f is not None], force)
    if radiance and captures is not None:
        raise ValueError("--radiance and --captures: readings are DN; leave out one of them")
    loaded = load_scene(scene, define, plugins, variant)
    place = polarimetry.pixel(loaded, at)
    if reason := rendering.obstacle(loaded):
        raise ValueError(f"{loaded.path}: no prediction light by light: {reason}; `optics render` goes through Mitsuba")
    values = {}
    if fit is not None:
        if not fit.is_file():
            raise FileNotFoundError(f"{fit}: no such file; a study writes one to STUDY/steps/NN-name/fit.toml")
        values = loaded.check(ladder.read_fit(fit)["parameters"], f"{fit}: [parameters]")
    chosen = loaded.check(settings(sets), "--set")
    first, last = polarimetry.span(loaded, key, first, last)
    readings = capture_files.load(captures) if captures is not None else None
    with terminal.progress() as progress:
        found = polarimetry.sweep(
            loaded,
            key,
            np.linspace(first, last, steps),
            place,
            {**values, **chosen},
            radiance=radiance,
            captures=readings,
            only=chosen,
            progress=progress,
        )
    if csv is not None:
        with replacing(csv) as temporary:
            temporary.write_text(found.to_csv(), encoding="utf-8")
    if output is not None:
        found.plot(output)
    for text in found.notes:
        terminal.note(text)
    rows = found.summary()
    if as_json:
        curves = [{"settings": c.settings, "values": c.x.tolist(), "readings": c.y.tolist()} for c in found.curves]
        return show(
            {
                "scene": str(loaded.path),
                "key": key,
                "unit": found.unit,
                "at": list(place),
                "black": found.black,
                "quantity": "radiance" if radiance else "DN",
                "channels": found.channels,
                "summary": rows,
                "curves": curves,
                "files": [str(f) for f in (output, csv) if f],
            }
        )
    print(
        f"{key} from {first:g} to {last:g} {found.unit}, {'radiance per band' if radiance else 'DN'} at pixel "
        f"{place[0]:g},{place[1]:g}" + (f", black {found.black:g}" if found.black else "")
    )
    print(_readings(found, rows))
    for file in (output, csv):
        if file is not None:
            print(file)


def _readings(found, rows) -> str:
    """The summary of a sweep as a table."""
    several, ideal, measured = (
        any(r.get(k) is not None for r in rows) for k in ("settings", "from_ideal", "from_measured")
    )
    at_unit = f"at{spaced(found.unit)}"
    lines = [
        (
            *(["settings"] if several else []),
            "channel",
            "largest",
            at_unit,
            "smallest",
            at_unit,
            "extinction ratio" if found.turns else "ratio",
            "contrast",
            *(["from cos^2"] if ideal else []),
            *(["measured - predicted, rms"] if measured else []),
        )
    ]
    for r in rows:
        own = ", ".join(f"{k} = {_number(v)}" for k, v in r.get("settings", {}).items())
        numbers = [f"{r[k]:.5g}" for k in ("largest", "at", "smallest", "dark_at", "extinction_ratio", "contrast")]
        departure = "-" if r["from_ideal"] is None else f"{r['from_ideal']:.2%}"
        lines.append(
            (
                *([own] if several else []),
                r["channel"],
                *numbers,
                *([departure] if ideal else []),
                *([f"{r['from_measured']:.4g}"] if measured else []),
            )
        )
    return table(lines)


# -- models and measurements
# ----------------------------------------------------------------------------------------------


@command
def compare(
    captures: CaptureSet,
    fit: Annotated[
        Path | None, typer.Option("--fit", metavar="FIT.toml", help="Calibrated values, from a study.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write numbers and images here.")
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            "--hold-out",
            metavar="GROUP",
            help="Groups of frames that the fit has not seen, to be told apart. Repeatable.",
        ),
    ] = None,
    define: Defines = None,
    sets: Settings = None,
    flat_field: FlatField = None,
    plugins: Plugins = None,
    as_json: AsJson = False,
) -> None:
    """Hold a scene against captures: misfit by frame, LED, region and channel."""
    from optics.study import loop
    from optics.study import record as ladder

    if output is not None:
        _check_new_folder(output)
    setup = setup_of(captures, define, plugins, sets, flat_field=flat_field, held_out=hold_out or [])
    if fit is not None and not fit.is_file():
        raise FileNotFoundError(f"{fit}: no such file; a study writes one to STUDY/steps/NN-name/fit.toml")
    model = loop.open_model(setup)
    values = values_of(model, fit, setup.values)
    comparison = loop.comparison_of(model, values, loop.split(model, setup)[1], 0, 0)
    if output is not None:
        worst = comparison.worst()[: ladder.SHOWN_MAX]
        with _new_folder(output) as folder:
            (folder / "comparison.txt").write_text(comparison.text() + "\n", encoding="utf-8")
            (folder / "comparison.csv").write_text(comparison.to_csv(), encoding="utf-8")
            (folder / "comparison.json").write_text(comparison.to_json() + "\n", encoding="utf-8")
            for shown in ladder.shown_frames(model, values, frames=worst):
                _write_frame(folder, shown, model.noise.saturation)
    print(comparison.to_json() if as_json else comparison.text())
    if output is not None:
        terminal.note(f"{output}: the same numbers as text, CSV and JSON, and the worst frames")


def values_of(model, fit: Path | None, sets: Mapping[str, float | str]):
    """The values of a fit.toml, and above them those of --set."""
    from optics.errors import UnknownKey
    from optics.scene.parameter import Values
    from optics.study import record as ladder

    data = {"parameters": {}, "frames": {}}
    if fit is not None:
        try:
            data = ladder.read_fit(fit)
        except ValueError as error:
            raise ValueError(f"{fit}: not valid TOML: {error}") from error
    common = model.scene.check({**data["parameters"]}, f"{fit}: [parameters]")
    names = {f.name: i for i, f in enumerate(model.frames)}
    own = {}
    for name, values in data["frames"].items():
        if name not in names:
            raise UnknownKey(name, names, "frame", str(fit), "the fit belongs to another set of captures")
        own[names[name]] = model.scene.check(values, f"{fit}: [frames.{name}]")
    return Values({**common, **model.scene.check(sets, "--set")}, own)


@command
def calibrate(
    captures: CaptureSet,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="STUDY", help="Folder of the new study.")],
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            metavar="PATTERN",
            help="Parameters to solve for, such as 'led_*.x'. Repeatable. Without it: every "
            "LED's position, axis, lobe and power, every membrane's reflectance and roughness.",
        ),
    ] = None,
    per_group: Annotated[
        list[str] | None,
        typer.Option(
            "--per-group",
            metavar="PATTERN",
            help="Parameters with a value per group of frames. Without it: where and how "
            "deep each press is. 'none': none.",
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option("--prior", metavar="PATTERN=MEAN+-SD", help="What is known beforehand. Repeatable."),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            "--hold-out",
            metavar="GROUP",
            help="Groups of frames to test on and not to fit. Repeatable. Without it: one in four. 'none': none.",
        ),
    ] = None,
    define: Defines = None,
    sets: Settings = None,
    flat_field: FlatField = None,
    plugins: Plugins = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Let residuals beyond three sigmas count less (Huber).")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of everything random.")] = 0,
    title: Annotated[str, typer.Option("--title", help="Of the study's report.")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with this study.")] = False,
    as_json: AsJson = False,
) -> None:
    """Start a study: solve for the free parameters of the base model, and test it on frames that were held out."""
    from optics.files.output import check_folder
    from optics.study import loop

    check_folder(output)
    none = lambda names: [] if names == ["none"] else names  # noqa: E731
    setup = setup_of(
        captures,
        define,
        plugins,
        sets,
        free=free or [],
        per_group=none(per_group),
        priors=priors(prior),
        held_out=none(hold_out),
        flat_field=flat_field,
        robust=robust,
        seed=seed,
    )
    with terminal.progress() as progress:
        study, model, fit = loop.begin(
            setup, output, title=title, command=["optics", *sys.argv[1:]], resume=resume, progress=progress
        )
    for text in study.record["warnings"]:
        terminal.note(f"warning: {_one_line(text)}")
    show({"study": str(study.folder), **study.steps[0]}) if as_json else print(
        f"{fit.table()}\n\n{study.table()}\n{null_text(study)}{study.folder}"
    )
    if not fit.converged:
        raise typer.Exit(1)


def null_text(study) -> str:
    """The last step beside models without physics, and the share of the background that the scene explains; '' without
    either."""
    from optics.fit.null_models import NullTable

    metrics, text = study.metrics(len(study.steps) - 1), ""
    if metrics.get("nulls"):
        text += f"\n{NullTable.from_json(metrics['nulls']).text()}\n"
    if metrics.get("background"):
        shares = " / ".join(f"{max(c['share'], 0):.0%}" for c in metrics["background"]["channels"])
        text += f"\nof the background's structure the scene explains {shares} by itself; the flat field is {metrics['background']['mode']}\n"
    return text


@app.command(
    "import", help="Read a measured data set of ball presses into a capture folder, with a scene to start from."
)
def import_(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="An .npz calibration pack, or a folder of images.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CAPTURES", help="Folder of the new capture set.")],
    circles: Annotated[
        Path | None,
        typer.Option(
            "--circles", metavar="CSV", help="For a folder: file, center_x_px, center_y_px, contact_radius_px."
        ),
    ] = None,
    ball_radius: Annotated[float | None, typer.Option("--ball-radius", help="mm")] = None,
    mm_per_pixel: Annotated[
        float | None, typer.Option("--mm-per-pixel", help="Scale of the images as they are.")
    ] = None,
    untouched: Annotated[
        Path | None,
        typer.Option(
            "--untouched",
            metavar="IMAGE",
            help="For a folder: the sensor without contact; without it the median of the presses.",
        ),
    ] = None,
    leds: Annotated[int, typer.Option("--leds", help="LEDs of the scene to start from: 3 or 6.")] = 3,
    bin: Annotated[int, typer.Option("--bin", min=1, help="Average this many pixels each way.")] = 1,
    every: Annotated[int, typer.Option("--every", min=1, help="Take every n-th press.")] = 1,
    force: Force = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Read presses, check labels and scale against each other, write captures.toml, a scene and what contradicts
    itself."""
    from optics.captures import importing

    terminal.quiet, terminal.debug = quiet, debug
    options = {"leds": leds, "bin": bin, "every": every, "overwrite": force}
    if ball_radius is not None:
        options["ball_radius"] = ball_radius
    if mm_per_pixel is not None:
        options["mm_per_pixel"] = mm_per_pixel
    if source.suffix == ".npz":
        found = importing.import_taxim(source, output, **options)
    else:
        if circles is None:
            raise ValueError(
                f"{source}: a folder of images needs --circles CSV with the columns file, center_x_px, center_y_px, "
                "contact_radius_px"
            )
        missing = [n for n, v in (("--ball-radius", ball_radius), ("--mm-per-pixel", mm_per_pixel)) if v is None]
        if missing:
            raise ValueError(
                f"{source}: {' and '.join(missing)} missing: the size of the ball and of a pixel cannot be read off circles"
            )
        found = importing.import_circles(source, circles, output, untouched=untouched, **options)
    for text in found.warnings:
        terminal.note(f"warning: {_one_line(text)}")
    print(found.folder)


@command
def diagnose(
    study: StudyFolder,
    as_json: AsJson = False,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write the table of effects here.")] = None,
) -> None:
    """Ask what the last step of a study lacks: every effect scored, the best ones added and refitted, one of six
    verdicts.

    The exit code is 1 where the verdict is UNKNOWN or CANNOT TELL, else 0.
    """
    from optics.files.output import replacing
    from optics.study import loop

    found, model, setup = loop.take_up(study)
    fit = loop.restore(found, model)
    with terminal.progress() as progress:
        result = loop.examine(found, model, setup, fit, progress)
    if csv is not None:
        with replacing(csv) as temporary:
            Path(temporary).write_text(result.to_csv(), encoding="utf-8")
    print(result.to_json() if as_json else result.text())
    if result.word in ("UNKNOWN", "CANNOT_TELL"):
        raise typer.Exit(1)


@command
def rehearse(
    study: StudyFolder,
    change: Annotated[
        float,
        typer.Option(
            metavar="PERCENT",
            help="How much each hidden effect changes the images: rms over the mean signal, before any calibration.",
        ),
    ] = 0.5,
    as_json: AsJson = False,
) -> None:
    """Say which effects would be found in these captures, were they hidden in them, and what each would be taken
    for."""
    from optics.diagnosis.rehearse import rehearse as rehearsed
    from optics.study import loop

    found, model, setup = loop.take_up(study)
    fit = loop.restore(found, model)
    fitted, _ = loop.split(model, setup)
    with terminal.progress() as progress:
        result = rehearsed(
            model,
            fit,
            loop.candidates(model, found),
            lambda e: loop.effect_variables(model, e),
            fitted,
            change=change / 100,
            seed=setup.seed,
            progress=progress,
        )
    print(result.to_json() if as_json else result.text(), end="")


@command
def imitate(
    study: StudyFolder,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="A new capture folder.")],
    sets: Settings = None,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 1,
) -> None:
    """Write captures as the study's model would take them, with an effect put in: --set camera.vignetting=0.3 shows
    what that would look like."""
    from optics.diagnosis.rehearse import imitate as imitated
    from optics.study import loop

    _check_new_folder(output)
    found, model, setup = loop.take_up(study)
    fit = loop.restore(found, model)
    _, held = loop.split(model, setup)
    values, _ = loop.held_out_values(model, fit, held)
    values.common.update(model.scene.check(settings(sets), "--set"))
    print(f"{imitated(model, values, output, seed)}: optics calibrate {output} -o ANOTHER_STUDY")


@command
def design(
    subject: Annotated[
        str, typer.Argument(metavar="SCENE|STUDY", help="A scene, or a study whose values and noise are taken.")
    ],
    frames: Annotated[int, typer.Option("--frames", "-n", metavar="N", help="How many frames to take.")] = 12,
    effects: Annotated[
        str | None,
        typer.Option(
            "--effects", metavar="A,B,...", help="Which may be missing.", show_default="all that the scene can express"
        ),
    ] = None,
    strength: Annotated[
        float, typer.Option("--strength", metavar="X", help="Of every effect, in plausible sizes.")
    ] = 0.1,
    fixed_exposure: Annotated[
        bool, typer.Option("--fixed-exposure", help="Leave the exposure as the scene has it.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write a captures.toml to fill in.")
    ] = None,
    defines: Defines = None,
    plugins: Plugins = None,
    system_gain: Annotated[float | None, typer.Option(help="DN per electron.", show_default="0.04")] = None,
    dark_noise: Annotated[float | None, typer.Option(help="DN, rms.", show_default="0.8")] = None,
    black_level: Annotated[float | None, typer.Option(help="DN.", show_default="8")] = None,
    saturation: Annotated[float | None, typer.Option(help="DN.", show_default="255")] = None,
    as_json: AsJson = False,
) -> None:
    """Plan a capture session: the frames that keep a scene's effects apart, and the effects that no frames will."""
    from optics.study import design as planning

    given = {"system_gain": system_gain, "dark_noise": dark_noise, "black_level": black_level, "saturation": saturation}
    if output is not None:
        _check_new_folder(output)
    with terminal.progress() as progress:
        result = planning.session(
            subject,
            frames,
            [e.strip() for e in (effects or "").split(",") if e.strip()],
            pairs(defines, "-D"),
            plugins,
            {k: v for k, v in given.items() if v is not None},
            strength,
            fixed_exposure,
            progress,
        )
    if output is not None:
        terminal.note(f"to fill in: {planning.write(result, output) / 'captures.toml'}")
    show(result.json()) if as_json else print(result.text())


@command
def add(
    study: StudyFolder,
    effect: Annotated[str, typer.Argument(metavar="EFFECT", help="Its name (`optics effects`).")],
    as_json: AsJson = False,
) -> None:
    """Free an effect, calibrate everything again, and record it as the next step of the study."""
    from optics.study import loop

    found, model, setup = loop.take_up(study)
    chosen = model.scene.registry.find_effect(effect)
    if found.has(chosen.key):
        raise ValueError(
            f"{study}: '{chosen.name}' is part of the study already; `optics diagnose {study}` asks what else is missing"
        )
    fit = loop.restore(found, model)
    with terminal.progress() as progress:
        fit, _ = loop.extend(found, model, setup, fit, chosen, progress=progress)
    show(found.steps[-1]) if as_json else print(f"{fit.table()}\n\n{found.table()}{null_text(found)}")


@command
def report(
    study: StudyFolder,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="PAGE.html", help="Default: STUDY/report.html.")
    ] = None,
    force: Force = False,
) -> None:
    """Write a study as one HTML page: images, ranking, ladder."""
    from optics.pages.report import report as write

    print(write(study, output or study / "report.html", overwrite=force))


@command
def view(
    study: StudyFolder,
    step: Annotated[
        int | None, typer.Option("--step", metavar="N", help="Begin from this step.", show_default="the last one")
    ] = None,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Of the page, on this machine alone.", show_default="any")
    ] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Open a page to switch effects and slide parameters, while prediction, residual and misfit follow. Ctrl-C ends
    it."""
    from optics.pages import view as page

    def ready(url: str) -> None:
        print(url, flush=True)
        terminal.note("Ctrl-C ends it")
        if browser:
            import webbrowser

            webbrowser.open(url)

    page.serve(study, port, step, ready)


@command
def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Where captures, study and report go.")
    ] = Path("renders/demo"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Chooses the sensor and its hidden effect.")] = 1,
    effect: Annotated[str | None, typer.Option("--effect", help="Hide this effect instead.")] = None,
    sensor: Annotated[
        str, typer.Option("--sensor", help="gelsight (six white LEDs), digit (red, green, blue) or polarizer_bench.")
    ] = "gelsight",
) -> None:
    """Make a sensor with a secret, by another path than the model, and find what is missing."""
    from optics.errors import UnknownKey
    from optics.proof import demo as story

    clock = time.monotonic()
    with terminal.progress() as progress:
        if sensor not in (*story.SENSORS, story.BENCH):
            raise UnknownKey(sensor, (*story.SENSORS, story.BENCH), "sensor")
        found = story.run(output, seed, effect, sensor, progress, lambda text: print(text + "\n", flush=True))
    hidden = found["hidden"]
    strengths = [f"{name} = {value:.4g} +- {sd:.2g}" for name, (value, sd) in found["strengths"].items()]
    print(
        f"hidden: {hidden['effect']}, strength {hidden['strength']:g}; named: {', '.join(found['claimed']) or 'nothing'}"
        f"{' (' + ', '.join(strengths[:3]) + (' ...' if len(strengths) > 3 else '') + ')' if strengths else ''}; "
        f"last verdict: {found['verdict']}"
    )
    print(
        f"held-out chi2 per degree of freedom: {found['first']:.3f} before, {found['held_out']:.3f} after; "
        f"{time.monotonic() - clock:.0f} s; {found['report']}"
    )
    if not found["right"]:
        raise typer.Exit(1)


# -- folders
# --------------------------------------------------------------------------------------------------------------


def _check_new_folder(folder: Path) -> None:
    from optics.errors import OutputExists
    from optics.files.output import check_folder

    check_folder(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputExists(f"{folder} exists and is not empty; choose another folder")


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder that appears whole or not at all."""
    import shutil

    temporary = folder.absolute().parent / f".{folder.name}.{os.getpid()}"
    temporary.mkdir(parents=True)
    try:
        yield temporary
        if folder.exists():
            folder.rmdir()  # empty: `_check_new_folder`
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_frame(folder: Path, shown, saturation: float) -> None:
    """measured | predicted | residual of a frame side by side; gray: no residual, black and white: 5 sigmas."""
    import numpy as np

    from optics.files.exr import write_png

    residual = np.nan_to_num(shown.residual) / 10 + 0.5
    images = [shown.measured / saturation, shown.predicted / saturation, residual]
    name = re.sub(r"[^\w.+-]+", "_", shown.name)
    write_png(folder / "images" / f"{name}.png", np.concatenate(images, 1), tone="linear")


if __name__ == "__main__":
    sys.exit(main())
