"""Commands that make images: one, or many from a job file."""

import sys
import time
from pathlib import Path
from typing import Annotated, Any

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
    settings,
    show,
    terminal,
)


@command
def render(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.exr", help="Where the image goes.")],
    scene: SceneOrFit = None,
    fit: FitFile = None,
    frame: FrameName = None,
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
    labels: Annotated[
        str | None,
        typer.Option(
            "--labels",
            metavar="NAMES",
            help="Labels for learners, by commas: force, pressure, displacement, height, pose, markers; or all that "
            "the scene has. Channels in the EXR, numbers in FILE.json, arrays in FILE.npz.",
        ),
    ] = None,
    plugins: Plugins = None,
    variant: Variant = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Render one image: an EXR with all that is known of it, and its provenance.

    The channels are radiance (with layers: Stokes vectors) per band, depth, normals, contact, one image per LED,
    variances; optics.light.rendering lists them."""
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
    sensor = load_sensor(scene, fit, frame, define, plugins, variant)
    named = labelling.named(sensor.scene, labels)
    chosen = sensor.scene.check(sensor.scene.spread(settings(sets), "--set"), "--set")
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


@command
def batch(
    job: Annotated[
        Path, typer.Argument(metavar="JOB.toml", help="What to make; optics.study.batch describes the file.")
    ],
    shard: Annotated[
        str, typer.Option("--shard", metavar="K/N", help="Make only every N-th sample, from the K-th on.")
    ] = "1/1",
    workers: Annotated[int | None, typer.Option("--workers", help="Processes.", show_default="one per core")] = None,
    fit: FitFile = None,
    frame: FrameName = None,
    plugins: Plugins = None,
    as_json: AsJson = False,
) -> None:
    """Make many images from a job file. May be stopped at any moment; the same command goes on."""
    from optics.study import batch as work

    part = work.parse_shard(shard)
    try:
        with terminal.progress() as progress:
            result = work.run(job, part, workers, plugins, progress, fit=fit, frame=frame)
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
        + (", all complete: manifest.csv" if result.complete else ", other shards are still to come")
    )
