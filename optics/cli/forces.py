"""Commands about forces from the motion of beads: what a layout of beads can feel, and maps that are learnt."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optics.cli.shared import AsJson, Force, Plugins, command, show, terminal
from optics.words import table, wrapped

if TYPE_CHECKING:
    from optics.readers.force_learning import FeatureSet, ForceModel

FLOWS = ("dense", "sparse")
Bins = Annotated[int, typer.Option("--bins", min=1, max=100, help="Bins of the face each way, n = bins x bins.")]


@command
def force_tables(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE.png", help="Plot Figures 5 and 6.")
    ] = None,
    distance: Annotated[
        float | None, typer.Option("--distance", help="Optical centre to the face, mm.", show_default="20")
    ] = None,
    f_by_e: Annotated[
        float | None,
        typer.Option("--f-by-e", help="Focal length over Young's modulus, px mm^2/N.", show_default="2600"),
    ] = None,
    poisson: Annotated[float | None, typer.Option("--poisson", help="Poisson's ratio.", show_default="0.5")] = None,
    beads: Annotated[
        int | None, typer.Option("--beads", help="Number of beads, up to 100,000.", show_default="3000")
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=1, max=1000, help="Random layouts to average over.")] = 20,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Reproduce tables and figures of the particle sensor.

    Prints Tables 1 and 2 and the numbers of Figures 5 and 6, beside the published numbers.

    The smallest force that moves a bead of a layout by half a pixel, the condition number of the reconstruction of a
    force, and its error where the motions have noise (Sensors 19 (2019) 928, section 3). Exit code 1 where a threshold
    departs from the printed one by more than 12 %, or an order is another."""
    from dataclasses import replace

    from optics.files.output import claim
    from optics.skin import bead_layouts

    if output is not None:
        if output.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise ValueError(
                f"-o {output}: '{output.suffix}' is no format of a plot; allowed: a name ending in .png, .pdf or .svg"
            )
        claim([output], force)
    given: dict[str, Any] = {"distance": distance, "f_by_e": f_by_e, "poisson": poisson, "beads": beads}
    constants = replace(bead_layouts.CONSTANTS, **{k: v for k, v in given.items() if v is not None})
    with terminal.progress() as progress:
        found = bead_layouts.tables(constants, draws, progress)
        if output is not None:
            bead_layouts.plot(output, constants, draws, progress)
    if as_json:
        show({**found.record(), "files": [str(output)] if output else []})
    else:
        print(wrapped(found.text()))
        if output is not None:
            print(output)
    if not found.agrees:
        raise typer.Exit(1)


@command
def force_features(
    job: Annotated[Path, typer.Argument(metavar="JOB.toml", help="The job of `optics batch`, of a scene with beads.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder for dense-40.npz and so on.")
    ],
    project: Annotated[
        bool,
        typer.Option(
            "--project",
            help="Take the motion that the scene gives its beads, without images. Else: optical flow in images.",
        ),
    ] = False,
    flow: Annotated[
        list[str] | None,
        typer.Option("--flow", metavar="KIND", help="dense or sparse. Repeatable.", show_default="both"),
    ] = None,
    bins: Annotated[
        list[int] | None,
        typer.Option("--bins", help="Bins of the image each way, m = bins x bins. Repeatable.", show_default="40"),
    ] = None,
    bead_seeds: Annotated[
        int | None,
        typer.Option(
            "--bead-seeds",
            min=1,
            max=1000,
            help="With --project: draw this many layouts of beads; each press takes one of them.",
            show_default="the job's own layout",
        ),
    ] = None,
    plugins: Plugins = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write the motion of beads in bins of the image.

    Forces are learnt from it. It is taken for each press of a job, from the images that `optics batch` has made so far,
    or with --project from the job alone."""
    from optics.files.output import claim
    from optics.study import force_data

    wanted = [(kind, size) for kind in flow or FLOWS for size in bins or [40]]
    for kind, size in wanted:
        if kind not in FLOWS or not 1 <= size <= 200:
            raise ValueError(f"--flow {kind} --bins {size}: allowed: {' or '.join(FLOWS)}, 1 to 200 bins each way")
    if bead_seeds is not None and not project:
        raise ValueError("--bead-seeds without --project: images show the layout that they were made with")
    files = {readout: output / f"{readout[0]}-{readout[1]}.npz" for readout in wanted}
    claim(list(files.values()), force)
    with terminal.progress() as progress:
        if project:
            seeds = None if bead_seeds is None else range(bead_seeds)
            found = force_data.project(job, wanted, seeds, plugins, progress)
        else:
            found = force_data.measure(job, wanted, plugins, progress)
    for readout, one in found.items():
        one.write(files[readout])
    if as_json:
        return show({str(files[r]): {"presses": len(one), **one.source} for r, one in found.items()})
    for readout, one in found.items():
        per_frame = f", {1e3 * one.source['seconds']:.1f} ms an image" if "seconds" in one.source else ""
        print(f"{files[readout]}: {len(one)} presses, {one.bins[0]} x {one.bins[1]} bins{per_frame}")


@command
def force_train(
    features: Annotated[Path, typer.Argument(metavar="FEATURES.npz", help="Made by `optics force-features`.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL.npz", help="Where the map goes.")],
    kind: Annotated[
        str,
        typer.Option("--kind", help="scaled (ours), published (the source's network) or linear (pseudo-inverse)."),
    ] = "scaled",
    bins: Bins = 9,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**31, help="Seed of all random numbers.")] = 0,
    epochs: Annotated[int, typer.Option("--epochs", min=1, help="Largest number of epochs.")] = 1000,
    patience: Annotated[
        int, typer.Option("--patience", min=1, help="Stop after this many epochs without improvement.")
    ] = 50,
    noise: Annotated[
        float,
        typer.Option("--noise", min=0, help="Noise added to the motion of each bin in training, px rms; for scaled."),
    ] = 0.02,
    width: Annotated[
        int | None,
        typer.Option(
            "--width",
            min=1,
            max=10_000,
            help="Units of each hidden layer.",
            show_default="1600 for published, 512 for scaled",
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option("--start", metavar="MODEL.npz", help="Train this map further, such as for another sensor."),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Learn a map from bead motion to forces.

    May be stopped at any moment; the same command goes on, from MODEL.npz.part. Networks need PyTorch: `pip install
    tactile-optics[learn]`."""
    from optics.files.output import claim
    from optics.readers import force_learning as learning

    if kind not in learning.KINDS:
        raise ValueError(f"--kind {kind}: allowed: {', '.join(learning.KINDS)}")
    if kind == "linear" and start is not None:
        raise ValueError("--start with --kind linear: a linear map has no first weights; leave out one of them")
    claim([output], force)
    one = learning.FeatureSet.read(features)
    with terminal.progress() as progress:
        if kind == "linear":
            model = learning.linear(one, bins, seed, progress)
        else:
            from optics.readers.force_training import Plan, train

            plan = Plan(kind, bins, seed, epochs, patience, noise, width or 0)
            first = None if start is None else learning.ForceModel.read(start)
            model = train(one, plan, output.with_name(output.name + ".part"), first, progress)
    model.write(output)
    held = one.chosen(learning.split(len(one), seed)[2])
    _told(model, {f"{features} (held out)": held}, as_json, output)


@command
def force_test(
    model: Annotated[Path, typer.Argument(metavar="MODEL.npz", help="Made by `optics force-train`.")],
    features: Annotated[list[Path], typer.Argument(metavar="FEATURES.npz...", help="Made by `optics force-features`.")],
    as_json: AsJson = False,
) -> None:
    """Test a learnt map on presses of known forces.

    Prints aRMSE, d_loc and RMSE_mc, which are (13), (16) and (17) of Sensors 19, 928 (2019), and its time."""
    from optics.readers.force_learning import FeatureSet, ForceModel

    _told(ForceModel.read(model), {str(file): FeatureSet.read(file) for file in features}, as_json)


def _told(model: "ForceModel", sets: "dict[str, FeatureSet]", as_json: bool, file: Path | None = None) -> None:
    """Print the metrics of a map on sets of features."""
    import time

    from optics.readers.force_learning import labels, scores

    rows: list[dict[str, Any]] = []
    for name, one in sets.items():
        if one.flow != model.flow:
            terminal.note(f"{name} are of {one.flow} flow, the map was trained with {model.flow} flow")
        began = time.perf_counter()
        for k in range(min(len(one), 50)):  # one at a time, as frames come
            model(one.chosen(slice(k, k + 1)))
        seconds = (time.perf_counter() - began) / min(len(one), 50)
        found = scores(labels(one.place, one.force, model.bins, one.face), model(one), model.bins, one.face)
        frame = one.source.get("seconds")
        rows.append({"features": name, "presses": len(one), **found, "map_seconds": seconds, "features_seconds": frame})
    if as_json:
        return show({"model": model.record, "kind": model.kind, "bins": model.bins, "file": file, "results": rows})
    print(
        f"{model.kind}, {model.flow} flow in {model.features[0]} x {model.features[1]} bins, "
        f"{model.bins} x {model.bins} bins of the face"
    )
    lines = [("", "presses", "aRMSE, N", "d_loc, mm", "RMSE_mc, N", "ms: features", "map")]
    for r in rows:
        times = ("-" if r["features_seconds"] is None else f"{1e3 * r['features_seconds']:.1f}",)
        numbers = (f"{r['aRMSE']:.4f}", f"{r['d_loc']:.2f}", f"{r['RMSE_mc']:.3f}")
        lines.append((r["features"], str(r["presses"]), *numbers, *times, f"{1e3 * r['map_seconds']:.1f}"))
    print(table(lines))
    if file is not None:
        print(file)
