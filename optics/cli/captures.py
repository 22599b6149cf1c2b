"""Commands about captures: import a measured set, plan a session, hold a scene against captures."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optics.cli.shared import (
    AsJson,
    CaptureSet,
    Debug,
    Defines,
    FitFile,
    FlatField,
    Force,
    Outside,
    Plugins,
    Quiet,
    Region,
    Settings,
    app,
    check_finite,
    command,
    one_line,
    pairs,
    settings,
    show,
    terminal,
)
from optics.words import wrapped

if TYPE_CHECKING:
    from optics.study.shown import Shown


@app.command(
    "import",
    help="Import a measured data set into a capture folder.\n\nA data set is: ball presses, a calibration folder of "
    "9DTact, scans under one LED at a time, raw frames of a polarization camera, or hyperspectral images.",
)
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A calibration pack (.npz or its folder), a folder of images, of scans, or of 9DTact; an ENVI header "
            "(.hdr), a Spectral EXR, a folder of these, or of images named by their wavelength (skin_550nm.tif).",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CAPTURES", help="Folder of the new capture set.")],
    circles: Annotated[
        Path | None,
        typer.Option(
            "--circles",
            metavar="CSV",
            help="For a folder: a table with the columns file, center_x_px, center_y_px, contact_radius_px.",
        ),
    ] = None,
    ball_radius: Annotated[
        float | None, typer.Option("--ball-radius", help="Radius of the ball, mm [2 for a Taxim pack].")
    ] = None,
    mm_per_pixel: Annotated[
        float | None, typer.Option("--mm-per-pixel", help="Scale of the images before --bin.")
    ] = None,
    untouched: Annotated[
        Path | None,
        typer.Option(
            "--untouched",
            metavar="IMAGE",
            help="For a folder: an image of the sensor without contact. Without it: --background.",
        ),
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            "--background",
            help="What the untouched sensor shows: median (of all presses), near (of those before and after each), or "
            "given (--untouched, or the pack's).",
            show_default="given, or else near where that leaves clearly less than median",
        ),
    ] = None,
    leds: Annotated[
        int | None, typer.Option("--leds", help="LEDs of the scene to start from: 3 or 6.", show_default="3")
    ] = None,
    bin: Annotated[
        int | None,
        typer.Option(
            "--bin",
            min=1,
            help="Average blocks of this many pixels each way.",
            show_default="4 for scans, else 1",
        ),
    ] = None,
    every: Annotated[
        int | None, typer.Option("--every", min=1, help="Take every n-th press.", show_default="1")
    ] = None,
    heightmap: Annotated[
        list[str] | None,
        typer.Option(
            "--heightmap",
            metavar="SCAN",
            help="Of a folder of scans: also take this one, into which no balls are pressed, in the shape that its "
            "heightmap.tmd says. Repeatable.",
        ),
    ] = None,
    mosaic: Annotated[
        str | None,
        typer.Option(
            "--mosaic",
            metavar='"90 45 135 0"',
            help="SOURCE holds raw frames of a polarization camera with analysers at these angles, row by row.",
        ),
    ] = None,
    listed: Annotated[
        Path | None,
        typer.Option(
            "--settings",
            metavar="CSV",
            help="For raw frames and cubes: a table with the column file and one column per setting. Without it the "
            "settings are read from the file names, angle=30__2.tif.",
        ),
    ] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(
            "--rename",
            metavar="NAME=KEY",
            help="Key that a setting's name stands for: angle=polarizer.angle. Repeatable.",
        ),
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(
            "--scene",
            help="Scene for raw frames, or for cubes.",
            show_default="polarization_camera, or for cubes digit",
        ),
    ] = None,
    bands: Annotated[
        str | None,
        typer.Option("--bands", metavar="400:700:10", help="For cubes: join bands, nm.", show_default="as they are"),
    ] = None,
    bits: Annotated[int | None, typer.Option("--bits", help="For raw frames and cubes. Without it: derived.")] = None,
    black_level: Annotated[
        float | None, typer.Option("--black-level", help="DN without light: for scans, raw frames, cubes.")
    ] = None,
    system_gain: Annotated[
        float | None, typer.Option("--system-gain", help="For raw frames and cubes, DN per electron.")
    ] = None,
    dark_noise: Annotated[float | None, typer.Option("--dark-noise", help="For raw frames and cubes, DN, rms.")] = None,
    force: Force = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Read presses; write captures.toml, a scene, and a report of contradictions between labels, scale and images.

    A folder of scan folders (scan.yaml), of 9DTact (depth_calibration) or of a pack (dataPack.npz) is read as such.
    With --mosaic, read raw frames of a polarization camera. Of hyperspectral images each band becomes a channel, and
    sensitivities.csv says what it sees."""
    from optics.cli import sources

    terminal.quiet, terminal.debug = quiet, debug
    given = {
        "--circles": circles,
        "--ball-radius": ball_radius,
        "--mm-per-pixel": mm_per_pixel,
        "--untouched": untouched,
        "--background": background,
        "--leds": leds,
        "--bin": bin,
        "--every": every,
        "--heightmap": heightmap,
        "--mosaic": mosaic,
        "--settings": listed,
        "--rename": rename,
        "--scene": scene,
        "--bands": bands,
        "--bits": bits,
        "--black-level": black_level,
        "--system-gain": system_gain,
        "--dark-noise": dark_noise,
    }
    check_finite(import_, {flag[2:].replace("-", "_"): value for flag, value in given.items()})
    with terminal.progress() as progress:
        found = sources.read(source, output, given, force, progress)
    _tell(found.folder, found.warnings, getattr(found, "facts", {}).get("corrections", ()))


def _tell(folder: Path, warnings: list[str], corrections: Sequence[Mapping[str, str]] = ()) -> None:
    """What an import left: remarks and corrections on stderr, the folder on stdout."""
    for text in warnings:
        terminal.note(f"warning: {one_line(text)}")
    for c in corrections:
        terminal.note(f"corrected: {one_line(c['what'])}: {c['how_much']}; {c['where']}")
    print(folder)


@command
def design(
    subject: Annotated[
        str, typer.Argument(metavar="SCENE|STUDY", help="A scene, or a study whose values and noise are taken.")
    ],
    frames: Annotated[int, typer.Option("--frames", "-n", metavar="N", help="How many frames to take.")] = 12,
    effects: Annotated[
        str | None,
        typer.Option(
            "--effects",
            metavar="A,B,...",
            help="Effects that may be missing.",
            show_default="all that the scene can express",
        ),
    ] = None,
    strength: Annotated[
        float, typer.Option("--strength", metavar="X", help="Strength of every effect, in plausible sizes.")
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
    """Plan a capture session that separates effects.

    Lists the frames that separate the effects of a scene, and the effects that no frame separates."""
    from optics.files.output import check_new_folder
    from optics.study import design as planning

    given = {"system_gain": system_gain, "dark_noise": dark_noise, "black_level": black_level, "saturation": saturation}
    if output is not None:
        check_new_folder(output)
    named = [e.strip() for e in (effects or "").split(",") if e.strip()]
    if effects is not None and not named:
        raise ValueError("--effects names none; allowed: names with commas between them; leave it out for all")
    with terminal.progress() as progress:
        result = planning.session(
            subject,
            frames,
            named,
            pairs(defines, "-D"),
            plugins,
            {k: v for k, v in given.items() if v is not None},
            strength,
            fixed_exposure,
            progress,
        )
    if output is not None:
        terminal.note(f"to fill in: {planning.write(result, output) / 'captures.toml'}")
    show(result.json()) if as_json else print(wrapped(result.text()))


@command
def compare(
    captures: CaptureSet,
    fit: FitFile = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write numbers and images here.")
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            "--hold-out",
            metavar="GROUP",
            help="Groups of frames that the fit did not use, reported separately. Repeatable.",
            show_default="those that the fit held out",
        ),
    ] = None,
    define: Defines = None,
    sets: Settings = None,
    flat_field: FlatField = None,
    region: Region = "",
    plugins: Plugins = None,
    outside: Outside = False,
    as_json: AsJson = False,
) -> None:
    """Compare a scene with captures.

    Prints the misfit by frame, LED, region and channel."""
    from optics import facade
    from optics.files.output import check_new_folder, new_folder
    from optics.study.record import SHOWN_MAX

    if output is not None:
        check_new_folder(output)
    found = facade.compare(
        captures,
        fit,
        values=settings(sets),
        held_out=hold_out,
        defines=pairs(define, "-D"),
        plugins=plugins,
        flat_field=flat_field,
        region=region,
        outside=outside,
    )
    comparison = found.comparison
    for text in found.notes:
        terminal.note(text)
    if output is not None:
        with new_folder(output) as folder:
            (folder / "comparison.txt").write_text(comparison.text() + "\n", encoding="utf-8")
            (folder / "comparison.csv").write_text(comparison.to_csv(), encoding="utf-8")
            (folder / "comparison.json").write_text(comparison.to_json() + "\n", encoding="utf-8")
            for shown in found.frames(comparison.worst()[:SHOWN_MAX]):
                _write_frame(folder, shown, found.model.noise.saturation)
    print(comparison.to_json() if as_json else wrapped(comparison.text()))
    if output is not None:
        terminal.note(f"{output}: the same numbers as text, CSV and JSON, and the worst frames")


def _write_frame(folder: Path, shown: "Shown", saturation: float) -> None:
    """Write measured | predicted | residual of a frame side by side; gray: no residual, black and white: 5 sigmas."""
    import numpy as np

    from optics.files.exr import write_png

    residual = np.nan_to_num(shown.residual) / 10 + 0.5
    images = [shown.measured / saturation, shown.predicted / saturation, residual]
    name = re.sub(r"[^\w.+-]+", "_", shown.name)
    write_png(folder / "images" / f"{name}.png", np.concatenate(images, 1), tone="linear")
