"""Commands about studies: calibrate, diagnose, add an effect, rehearse, and look at the result."""

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optics.cli.shared import (
    AsJson,
    CaptureSet,
    CapturesNow,
    Defines,
    FlatField,
    Force,
    Outside,
    Plugins,
    Region,
    Settings,
    StudyFolder,
    command,
    one_line,
    pairs,
    priors,
    settings,
    show,
    terminal,
)
from optics.words import wrapped

if TYPE_CHECKING:
    from optics.facade import Study


StartFit = Annotated[
    Path | None,
    typer.Option(
        "--fit",
        metavar="FIT",
        help="Start from a calibrated sensor: a study's folder (its last step), or a fit.toml of it. Its effects keep "
        "their strengths.",
    ),
]


@command
def locate(
    captures: CaptureSet,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.csv", help="Table of positions, mm.")],
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            metavar="PATTERN",
            help="Parameters to solve for with the positions. Repeatable. Without it: the powers of the lights.",
        ),
    ] = None,
    define: Defines = None,
    sets: Settings = None,
    plugins: Plugins = None,
    outside: Outside = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find beads whose positions are unknown.

    Fits all positions in all frames, with a few parameters of the scene. Depths follow from the size and brightness of
    each bead and from its motion under presses, so give frames at rest and under several presses. Use the table in a
    calibration with `-D places=FILE.csv`; FILE.json beside it has the errors."""
    from optics.files.output import claim
    from optics.study.located import locate as find
    from optics.study.setup import Setup

    if output.suffix.lower() != ".csv":
        raise ValueError(f"-o {output}: a table of positions; allowed: a name ending in .csv")
    claim([output, output.with_suffix(".json")], force)
    setup = Setup(
        captures=str(captures),
        defines=dict(pairs(define, "-D")),
        values=dict(settings(sets)),
        plugins=None if plugins is None else [str(path) for path in plugins],
        outside=outside,
    )
    with terminal.progress() as progress:
        found = find(setup, output, free or (), progress=progress)
    show(found.record()) if as_json else print(f"{wrapped(found.text())}\n{output}")


@command
def calibrate(
    captures: CaptureSet,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="STUDY", help="Folder of the new study.")],
    fit: StartFit = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            metavar="PATTERN",
            help="Parameters to solve for, such as 'led_*.x'. Repeatable. Without it: what the "
            "parts declare as free (an LED's position, axis, lobe and power, a source's power, a membrane's "
            "reflectance and roughness, before a crowd of beads the camera's pose, ...).",
        ),
    ] = None,
    per_group: Annotated[
        list[str] | None,
        typer.Option(
            "--per-group",
            metavar="PATTERN",
            help="Parameters with a value per group of frames. Repeatable. Without it: position and depth of each "
            "press. 'none': none.",
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            "--prior", metavar="PATTERN=MEAN+-SD", help="Prior knowledge: mean and standard deviation. Repeatable."
        ),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            "--hold-out",
            metavar="GROUP",
            help="Groups of frames to hold out for tests. Repeatable. Without it: one in four. 'none': none.",
        ),
    ] = None,
    define: Defines = None,
    sets: Settings = None,
    flat_field: FlatField = None,
    region: Region = "",
    plugins: Plugins = None,
    outside: Outside = False,
    robust: Annotated[
        bool, typer.Option("--robust", help="Give residuals beyond three sigmas less weight (Huber).")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all random numbers.")] = 0,
    title: Annotated[str, typer.Option("--title", help="Title of the study's report.")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Continue this study.")] = False,
    as_json: AsJson = False,
) -> None:
    """Start a study: calibrate the base model.

    Solves for the free parameters and tests the result on held-out frames."""
    from optics import facade

    with terminal.progress() as progress:
        study = facade.calibrate(
            captures,
            output,
            fit=fit,
            free=free or (),
            per_group=_unless_none(per_group),
            priors=priors(prior),
            held_out=_unless_none(hold_out),
            values=settings(sets),
            defines=pairs(define, "-D"),
            plugins=plugins,
            flat_field=flat_field,
            region=region,
            outside=outside,
            robust=robust,
            seed=seed,
            title=title,
            command=["optics", *sys.argv[1:]],
            resume=resume,
            progress=progress,
        )
    for text in study.warnings:
        terminal.note(f"warning: {one_line(text)}")
    show({"study": str(study.folder), **study.record.steps[0]}) if as_json else print(
        wrapped(f"{study.fit.table()}\n\n{study.table()}\n{null_text(study)}") + str(study.folder)
    )
    if not study.fit.converged:
        raise typer.Exit(1)


def _unless_none(names: list[str] | None) -> list[str] | None:
    """The names of a repeated option; the single word 'none' stands for an empty list."""
    return [] if names == ["none"] else names


def null_text(study: "Study") -> str:
    """The last step beside models without physics, and the share of the background that the scene explains; '' without
    either."""
    from optics.fit.null_models import NullTable

    metrics, text = study.record.metrics(len(study.record.steps) - 1), ""
    if metrics.get("nulls"):
        text += f"\n{NullTable.from_json(metrics['nulls']).text()}\n"
    if metrics.get("background"):
        shares = " / ".join(f"{max(c['share'], 0):.0%}" for c in metrics["background"]["channels"])
        text += (
            f"\nof the background's structure the scene explains {shares} by itself; the flat field is "
            f"{metrics['background']['mode']}\n"
        )
    return text


@command
def diagnose(
    study: StudyFolder,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", metavar="EFFECT", help="Do not test this effect (`optics effects`). Repeatable."),
    ] = None,
    plugins: Plugins = None,
    captures: CapturesNow = None,
    as_json: AsJson = False,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write the table of effects here.")] = None,
) -> None:
    """Find which effect the last step of a study lacks.

    Scores every effect, adds and refits the best ones, and gives one of six verdicts.

    The exit code is 1 where the verdict is UNKNOWN or CANNOT TELL, else 0.
    """
    from optics.diagnosis.text import ranking
    from optics.facade import Study
    from optics.files.output import check_folder, spare_records, write_text

    if csv is not None:
        spare_records(csv)
        check_folder(csv.parent)
    found = Study.open(study, plugins=plugins, captures=captures)
    with terminal.progress() as progress:
        result = found.diagnose(
            without=without or (), progress=progress, ranked=lambda rows: terminal.note(ranking(rows))
        )
    if csv is not None:
        write_text(csv, result.to_csv())
    print(result.to_json() if as_json else wrapped(result.text()))
    if result.word in ("UNKNOWN", "CANNOT_TELL"):
        raise typer.Exit(1)


@command
def add(
    study: StudyFolder,
    effect: Annotated[str, typer.Argument(metavar="EFFECT", help="Name of the effect (`optics effects`).")],
    drop: Annotated[
        list[str] | None,
        typer.Option("--drop", metavar="EFFECT", help="An added effect that this one replaces. Repeatable."),
    ] = None,
    plugins: Plugins = None,
    captures: CapturesNow = None,
    as_json: AsJson = False,
) -> None:
    """Add an effect to a study and calibrate again.

    Frees the effect, calibrates everything again, and records the result as the next step."""
    from optics.facade import Study

    found = Study.open(study, plugins=plugins, captures=captures)
    with terminal.progress() as progress:
        fit = found.add(effect, drop=drop or (), progress=progress)
    told = wrapped(f"{fit.table()}\n\n{found.table()}{null_text(found)}")
    show(found.record.steps[-1]) if as_json else print(told)


@command
def report(
    study: StudyFolder,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="PAGE.html", help="Default: STUDY/report.html.")
    ] = None,
    force: Force = False,
) -> None:
    """Write a study as one HTML page: images, ranking, steps."""
    from optics.facade import Study

    print(Study.open(study).report(output, overwrite=force))


@command
def values(
    study: StudyFolder,
    patterns: Annotated[
        list[str] | None, typer.Argument(metavar="[PATTERN]...", help="Parameters to list, such as 'led_*.x'.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the values that the last step of a study found.

    Prints value, standard deviation and unit of each parameter."""
    from fnmatch import fnmatch

    from optics.errors import UnknownKey
    from optics.facade import Study
    from optics.study.record import readable
    from optics.words import as_float, table

    def spread(sd: Any) -> str:
        """Records write an infinite standard deviation as a word."""
        return "undetermined" if as_float(sd) == math.inf else f"+- {as_float(sd):.2g}" if sd else ""

    with readable(study):
        found = Study.open(study).record.steps[-1]["variables"]
        chosen = [v for v in found if not patterns or any(fnmatch(v["name"], p) for p in patterns)]
        if patterns and not chosen:
            raise UnknownKey(patterns[0], [v["name"] for v in found], "parameter of this study")
        lines = [(v["name"], f"{v['value']:.6g}", spread(v["sd"]), v["unit"]) for v in chosen]
    show(chosen) if as_json else print(table([("parameter", "value", "1 sd", "unit"), *lines], left=(0, 3)))


@command
def scoreboard(
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FOLDER", help="Folder for scoreboard.html and scoreboard.json."),
    ],
    captures: Annotated[
        list[str] | None,
        typer.Argument(metavar="CAPTURES", help="Folders with captures.toml.", show_default="those of the studies"),
    ] = None,
    study: Annotated[
        list[Path] | None,
        typer.Option(
            "--study",
            metavar="STUDY",
            help="A study. All its steps are scored, on the frames that it holds out. Repeatable.",
        ),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            "--hold-out",
            metavar="GROUP",
            help="Groups to hold out, for captures without a study. Repeatable. Without it: one in four, the last of "
            "two or three.",
        ),
    ] = None,
    presses: Annotated[
        bool, typer.Option("--presses", help="Also calibrate each study's last step on fewer presses (minutes each).")
    ] = False,
    plugins: Plugins = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Compare studies with models without physics.

    Scores studies, tables without physics and other photographs on the same held-out images, as a table and a page.

    The exit code is 1 where a study is beaten by a model without physics in the contact, else 0.
    """
    from optics.files.output import claim, together, write_text
    from optics.pages.scoreboard import render
    from optics.study.board import text, to_json
    from optics.study.scoreboard import scoreboard

    files = [output / "scoreboard.html", output / "scoreboard.json"]
    claim(files, force)
    with terminal.progress() as progress:
        boards = scoreboard(
            captures or (), study or (), held_out=hold_out, presses=presses, plugins=plugins, progress=progress
        )
    record = to_json(boards)
    with together(files):
        for file, content in zip(files, (render(boards), record)):
            write_text(file, content)
    print(record if as_json else f"{wrapped(text(boards))}\n\n{files[0]}")
    if any(board.beaten for board in boards):
        raise typer.Exit(1)


@command
def view(
    study: StudyFolder,
    step: Annotated[
        int | None, typer.Option("--step", metavar="N", help="Begin from this step.", show_default="the last one")
    ] = None,
    port: Annotated[
        int,
        typer.Option("--port", min=0, max=65535, help="Port of the page, on this machine only.", show_default="any"),
    ] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    plugins: Plugins = None,
    captures: CapturesNow = None,
) -> None:
    """Open a live page: switch effects, move parameters.

    Prediction, residual and misfit follow. Ctrl-C ends it."""
    from optics.facade import Study

    def ready(url: str) -> None:
        print(url, flush=True)
        terminal.note("Ctrl-C ends it")
        if browser:
            import webbrowser

            webbrowser.open(url)

    Study.open(study, plugins=plugins, captures=captures).view(step, port=port, ready=ready)


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
    plugins: Plugins = None,
    captures: CapturesNow = None,
    as_json: AsJson = False,
) -> None:
    """Report which hidden effects would be found.

    Hides each effect in these captures in turn. Says whether it would be found, and which effect it would be mistaken
    for."""
    from optics.facade import Study

    found = Study.open(study, plugins=plugins, captures=captures)
    with terminal.progress() as progress:
        result = found.rehearse(change / 100, progress=progress)
    print(result.to_json() if as_json else wrapped(result.text()), end="")


@command
def imitate(
    study: StudyFolder,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="A new capture folder.")],
    sets: Settings = None,
    into_captures: Annotated[
        bool,
        typer.Option(
            "--into-captures",
            help="Write the measured images, changed by what --set changes; they keep all that the model lacks.",
        ),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the noise of simulated images.")] = 1,
    plugins: Plugins = None,
    captures: CapturesNow = None,
) -> None:
    """Simulate captures with the study's model.

    With --set camera.vignetting=0.3, for example, they show what this effect would look like."""
    from optics.facade import Study
    from optics.files.output import check_new_folder

    check_new_folder(output)
    found = Study.open(study, plugins=plugins, captures=captures)
    folder = found.imitate(output, settings(sets), seed=seed, into_captures=into_captures)
    start = f" --fit {study}" if into_captures else ""
    print(f"{folder}: optics calibrate {output}{start} -o ANOTHER_STUDY")
