"""Commands that make images: one, or many from a job file."""

import shlex
import sys
import time
from collections.abc import Sequence
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from optics.cli.shared import (
    AsJson,
    Defines,
    FitFile,
    Force,
    FrameName,
    Plugins,
    SceneOrFit,
    Settings,
    Variant,
    command,
    load_sensor,
    pairs,
    settings,
    show,
    terminal,
)

if TYPE_CHECKING:
    from optics.study.engines import Status


@command
def render(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.exr", help="Where the image goes.")],
    scene: SceneOrFit = None,
    fit: FitFile = None,
    frame: FrameName = None,
    define: Defines = None,
    sets: Settings = None,
    png: Annotated[
        bool, typer.Option("--png", help="Also write FILE.png: the camera's digital numbers, without noise.")
    ] = False,
    stokes: Annotated[
        bool,
        typer.Option(
            "--stokes",
            help="Also write FILE.dolp.png and FILE.aolp.png (degree and angle of linear polarization per band), and "
            "S0 to S3 into the EXR. Scenes with layers always have S0 to S3.",
        ),
    ] = False,
    spp: Annotated[
        int | None,
        typer.Option(
            "--spp",
            help="Render by Monte Carlo with this many samples per pixel, with variances. "
            "Without it a sensor is rendered LED by LED, without noise.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all random numbers.")] = 0,
    look: Annotated[
        bool | None,
        typer.Option(
            "--look/--no-look",
            help="--look: begin from the scene's first look (`optics scenes`: a press, lights by colour) and apply "
            "your settings to it. --no-look: begin from the scene file alone.",
            show_default="--look where a shipped scene is named and nothing is set",
        ),
    ] = None,
    labels: Annotated[
        str | None,
        typer.Option(
            "--labels",
            metavar="NAMES",
            help="Labels for learning, separated by commas: force, pressure, displacement, height, pose, markers; or "
            "all (that the scene has). They are channels of the EXR, numbers in FILE.json, arrays in FILE.npz.",
        ),
    ] = None,
    plugins: Plugins = None,
    variant: Variant = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Render one image to an EXR file, with its provenance.

    The EXR has radiance per band (with layers: Stokes vectors), depth, normals, contact, one image per LED, and
    variances; optics.light.rendering lists its channels."""
    from optics.files.output import claim, together, write_json
    from optics.light import labels as labelling
    from optics.light.rendering import RenderJob

    if output.suffix.lower() != ".exr":
        raise ValueError(
            f"-o {output}: '{output.suffix}' is no image format of this command; allowed: a name ending in .exr"
        )
    record, preview = output.with_suffix(".json"), output.with_suffix(".png")
    maps = (output.with_suffix(".dolp.png"), output.with_suffix(".aolp.png"))
    arrays = output.with_suffix(".npz")
    files = [output, record, *([preview] if png else []), *(maps if stokes else ()), *([arrays] if labels else [])]
    claim(files, force)
    first = _first_look(scene, fit, look, unset=not (define or sets or fit))
    sensor = load_sensor(scene, fit, frame, [*first.defines, *(define or ())], plugins, variant)
    named = labelling.named(sensor.scene, labels)
    spread = [sensor.scene.spread(settings(given), "--set") for given in (first.sets, sets)]
    chosen = sensor.scene.check({**spread[0], **spread[1]}, "--set")
    values = {**sensor.values, **chosen}
    if chosen or fit is None:  # of a fit alone nobody stated a depth
        sensor.scene.check_press({**sensor.scene.values(), **values}, "--set" if chosen else str(sensor.scene.path))
    clock = time.perf_counter()
    images = RenderJob(
        sensor.scene, spp=spp, stokes=stokes, black=sensor.black, saturation=sensor.saturation, labels=named
    )
    with terminal.progress() as progress:
        image = images.take(values, seed, progress=progress)
    seconds = time.perf_counter() - clock
    with together(files):
        if png:
            image.write_png(preview, sensor.saturation)
        if stokes:
            from optics.light.polarimetry import write_maps

            bands, vectors = image.stokes()
            write_maps(maps, list(bands), vectors)
        provenance: Any = image.header["provenance"]
        write_json(record, {**provenance, "command": ["optics", *sys.argv[1:]]})
        if labels:
            labelling.write(arrays, image.labels.arrays)
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
    if first.note:
        terminal.note(first.note)


@command
def batch(
    job: Annotated[
        Path, typer.Argument(metavar="JOB.toml", help="What to make; optics.study.batch describes the file.")
    ],
    on: Annotated[
        str,
        typer.Option(
            "--on", metavar="ENGINE", help="Where it runs: local, slurm (submitit) or ray. The images are the same."
        ),
    ] = "local",
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            help="Number of processes, of one thread each.",
            show_default="one per core; 16 tasks on Slurm; all CPUs of a Ray cluster",
        ),
    ] = None,
    recycle: Annotated[
        int, typer.Option("--recycle", metavar="N", help="Samples that a worker makes before a new one replaces it.")
    ] = 1000,
    engine: Annotated[
        list[str] | None,
        typer.Option(
            "--engine",
            metavar="KEY=VALUE",
            help="Option of submitit.AutoExecutor (slurm_partition=cpu, timeout_min=240) or ray.init (address=auto). "
            "Repeatable.",
        ),
    ] = None,
    shard: Annotated[
        str,
        typer.Option("--shard", metavar="K/N", help="Make only every N-th block of samples, beginning with the K-th."),
    ] = "1/1",
    check_files: Annotated[
        bool,
        typer.Option(
            "--check-files",
            help="Read every existing image and compare its hash, even if the file was not changed since.",
        ),
    ] = False,
    fit: FitFile = None,
    frame: FrameName = None,
    plugins: Plugins = None,
    as_json: AsJson = False,
) -> None:
    """Make many images from a job file. You may stop it at any moment; the same command continues.

    Ctrl-C ends the workers of this machine and of Ray, and cancels running and queued tasks of Slurm. If the command is
    killed, its own processes end too. Slurm's tasks continue without it, and the next command counts their images.
    """
    from optics.study import batch as work

    part = work.parse_shard(shard)
    try:
        with terminal.live() as live:
            result = work.run(
                job,
                part,
                workers,
                plugins,
                (lambda what, done, total: live({what: f"{done:,} of {total:,}"})) if live else None,
                fit=fit,
                frame=frame,
                on=on,
                options=pairs(engine, "--engine"),
                recycle=recycle,
                watch=(lambda status: live(_state(status))) if live else None,
                check_files=check_files,
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what was made is kept, the same command goes on") from None
    for text in result.notes:
        terminal.note(text)
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
        + (
            ", all complete: manifest.csv"
            if result.complete
            else ", others are not made yet, or are being made elsewhere"
        )
    )


@command
def export(
    folder: Annotated[Path, typer.Argument(metavar="BATCH", help="Folder of a finished batch.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the data set.")],
    to: Annotated[
        str, typer.Option("--to", metavar="FORMAT", help="webdataset, hdf5, zarr or lerobot.", show_default=False)
    ],
    images: Annotated[
        str,
        typer.Option(
            "--images",
            metavar="KIND",
            help="camera: the camera's 8- or 12-bit digital numbers; float: radiance, depth, normals, LEDs.",
        ),
    ] = "camera",
    array: Annotated[
        list[str] | None,
        typer.Option("--array", metavar="NAME", help="Export only this array. Repeatable.", show_default="all"),
    ] = None,
    per_file: Annotated[int, typer.Option("--per-file", metavar="N", help="Samples per file.")] = 1000,
    licence: Annotated[str, typer.Option("--licence", help="Licence of the data, for the data card.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write a finished batch as a data set for learning.

    Adds a data card. You may stop it; the same command continues."""
    from optics.study.export import export as write

    with terminal.progress() as progress:
        card = write(
            folder,
            output,
            to,
            images=images,
            arrays=array or (),
            per_file=per_file,
            licence=licence,
            progress=progress,
        )
    if as_json:
        return show(card)
    print(f"{output}: {card['samples']} samples, {card['files']}; arrays {', '.join(card['arrays'])}; card.md")


class FirstLook(NamedTuple):
    """The options -D and --set of a scene's first look, and what to say of it."""

    defines: Sequence[str] = ()
    sets: Sequence[str] = ()
    note: str = ""


def _first_look(scene: str | None, fit: Path | None, look: bool | None, unset: bool) -> FirstLook:
    """What an image begins with: `look` as asked for; None: the first look where a shipped scene is named and nothing
    is set. A file of your own is rendered as it stands."""
    from optics.scene.loader import shipped_scenes, told

    if look and fit is not None:
        raise ValueError(f"--look: {fit} is a calibrated sensor, which has no first look; leave one of the two out")
    if scene is None or not (unset and scene in shipped_scenes() if look is None else look):
        return FirstLook()
    text = told(scene)[1]
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise ValueError(f"{scene}: its line `Look: {text}`: {error}") from None
    if words[:2] != ["optics", "render"]:
        if look:
            has = f"it has: {text}" if text else "its file has no line `Look: optics render ...`"
            raise ValueError(f"--look: {scene} has no first look that is an image; {has}")
        return FirstLook(note=f"worth a look: {text}" if text else "")
    taken = [(option, word) for option, word in pairwise(words) if option in ("-D", "--set")]
    shown = " ".join(f"{option} {shlex.quote(word)}" for option, word in taken)
    return FirstLook(
        [word for option, word in taken if option == "-D"],
        [word for option, word in taken if option == "--set"],
        ""
        if look or not taken
        else f"nothing was set, so this is the first look: {shown}. For the scene as its file says: --no-look",
    )


def _state(status: "Status") -> dict[str, str]:
    """A batch's state, title -> text."""
    return {
        "made": f"{status.done:,} of {status.total:,}",
        "per second": f"{status.rate:.3g}",
        "time left": "?" if status.left is None else str(timedelta(seconds=round(status.left))),
        "workers": str(status.workers),
        "died": str(status.died),
        "samples given up": str(status.given_up),
    }
