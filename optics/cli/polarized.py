"""Commands about polarized light: what the layers on a ray do, and a reading against an angle."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optics.cli.shared import (
    AsJson,
    At,
    Defines,
    FitFile,
    Force,
    FrameName,
    Outside,
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
from optics.words import fits, number, spaced, table, wrapped

if TYPE_CHECKING:
    from optics.light.polarimetry import Sweep

DEFAULT_BAND = 540.0  # nm, for a scene without bands: the middle of the visible range


@command
def mueller(
    scene: SceneOrFit = None,
    at: At = None,
    fit: FitFile = None,
    frame: FrameName = None,
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
    to y. Layers are listed from the camera on: the last one is the first that light meets."""
    from optics.light import paths, polarimetry

    sensor = load_sensor(scene, fit, frame, define, plugins, variant)
    loaded = sensor.scene
    values = {**loaded.values(), **sensor.values, **loaded.check(loaded.spread(settings(sets), "--set"), "--set")}
    u, v = polarimetry.pixel(loaded, at)
    own = loaded.integrator.bands if loaded.integrator is not None else ()
    bands = wavelength or list(own) or [DEFAULT_BAND]
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

        def record(own: Any) -> dict[str, Any]:
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
    end = f"it ends on {ray.end}" if ray.end else "it meets nothing"
    print(wrapped(f"the ray through {u:g},{v:g} passes, from the camera on: {', '.join(ray.names)}; {end}"))
    for name, own in shown:
        title = name if name != "product" else f"product: {' '.join(names)}"
        print(f"\n{title}\n" + _matrices(own, bands))
    print("\n" + _meanings(shown, bands))
    if any(loaded.parts[n].role == "interface" for n in names):
        terminal.note(
            "the transmittance of an interface is of radiance, which grows with n^2; at the way out it falls again"
        )
    if ray.lost:
        terminal.note("this ray is reflected totally on its way: nothing of what stands here arrives at the camera")


def _alike(own: Any, bands: Sequence[float]) -> list[tuple[str, Any]]:
    """(band, matrix) of matrices (B, 4, 4); one for all bands where they are the same."""
    import numpy as np

    if len(bands) > 1 and np.ptp(own, 0).max() < 5e-7:
        return [("all bands", own[0])]
    return [(f"{band:g} nm", matrix) for band, matrix in zip(bands, own)]


def _matrices(own: Any, bands: Sequence[float]) -> str:
    """Matrices (B, 4, 4) side by side, with their bands above."""

    def entry(value: float) -> str:
        return f"{value:9.5f}" if abs(value) >= 5e-7 else f"{'0':>9}"

    found = _alike(own, bands)
    return "\n".join(
        [
            "    ".join(f"{band:<38}" for band, _ in found).rstrip(),
            *("    ".join(f"[{''.join(map(entry, m[i]))}]" for _, m in found) for i in range(4)),
        ]
    )


def _meanings(shown: Sequence[tuple[str, Any]], bands: Sequence[float]) -> str:
    """The decompositions of layers and of their product as a table."""
    from optics.light.polarimetry import decompose

    def cell(value: float, digits: int = 4, small: float = 5e-7) -> str:
        return "-" if math.isnan(value) else f"{0 if abs(value) < small else value:.{digits}g}"

    def axis(angle: float, ellipticity: float) -> str:
        return cell(angle, 4, 1e-4) + (
            "" if math.isnan(ellipticity) or abs(ellipticity) < 0.05 else f" ({ellipticity:+.1f})"
        )

    lines = []
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
    rows = [MEANINGS, *lines] if fits([MEANINGS, *lines]) else [SHORT_MEANINGS, *lines]
    return (
        table(rows)
        + "\n"
        + wrapped(
            "T: transmittance of unpolarized light. D: diattenuation. R: retardance. Axes and retardance in deg, an "
            "ellipticity (+-45: circular) in brackets. Depolarization: 0 none; index: 1 none. '-': no meaning here, "
            "such as the retardance of a perfect polarizer."
        )
    )


TRANSMITTANCES = ("T", "T max", "T min")
MEANINGS = (
    *("", "", *TRANSMITTANCES, "diattenuation", "axis", "retardance", "fast axis"),
    *("depolarization", "index", "physical"),
)
SHORT_MEANINGS = ("", "", *TRANSMITTANCES, "D", "axis", "R", "fast", "depol", "index", "phys")


@command
def sweep(
    scene: SceneOrFit = None,
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
            "--captures", metavar="CAPTURES", help="Measured readings to compare with: a folder with captures.toml."
        ),
    ] = None,
    fit: FitFile = None,
    frame: FrameName = None,
    radiance: Annotated[bool, typer.Option("--radiance", help="Radiance per band instead of the camera's DN.")] = False,
    define: Defines = None,
    sets: Settings = None,
    plugins: Plugins = None,
    outside: Outside = False,
    variant: Variant = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Predict a reading against an angle or other parameter.

    Prints what a pixel or a photodiode reads, the extinction ratio, and the departure from Malus' cos^2; -o draws the
    curves.
    """
    import numpy as np

    from optics.captures import capture_set as capture_files
    from optics.files.output import claim, write_text
    from optics.light import polarimetry, rendering
    from optics.scene.loader import find

    if output is not None and output.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ValueError(
            f"-o {output}: '{output.suffix}' is no format of a plot; allowed: a name ending in .png, .pdf or .svg"
        )
    claim([f for f in (output, csv) if f is not None], force)
    if radiance and captures is not None:
        raise ValueError("--radiance and --captures: readings are DN; leave out one of them")
    if frame is not None and captures is not None:
        raise ValueError("--frame and --captures: the readings have their own settings; leave out one of them")
    readings = capture_files.load(captures, outside) if captures is not None else None
    if readings is not None:
        own = capture_files.definitions(readings, pairs(define, "-D"), find(scene or readings.scene))
        define = [f"{name}={text}" for name, text in own.items()]
    sensor = load_sensor(scene, fit, frame, define, plugins, variant, driven=captures is None)
    loaded = sensor.scene
    if readings is not None:
        effects = {k: e.name for k, e in loaded.registry.effects.items()}
        capture_files.check(readings, loaded.parameters)
        readings = capture_files.state(readings, loaded.parts, effects)
        readings.noise = sensor.noise if readings.noise is None else readings.noise.in_scale_of(sensor.noise)
    place = polarimetry.pixel(loaded, at)
    if reason := rendering.obstacle(loaded):
        raise ValueError(f"{loaded.path}: no prediction light by light: {reason}; `optics render` goes through Mitsuba")
    chosen = loaded.check(loaded.spread(settings(sets), "--set"), "--set")
    first, last = polarimetry.span(loaded, key, first, last)
    with terminal.progress() as progress:
        found = polarimetry.sweep(
            loaded,
            key,
            list(np.linspace(first, last, steps)),
            place,
            {**sensor.values, **chosen},
            radiance=radiance,
            noise=sensor.noise,
            captures=readings,
            only=chosen,
            progress=progress,
        )
    if csv is not None:
        write_text(csv, found.to_csv())
    if output is not None:
        found.plot(output)
    for text in found.notes:
        terminal.note(text)
    if as_json:
        place_of = {"scene": str(loaded.path), "key": key, "unit": found.unit, "at": list(place)}
        return show({**place_of, **_sweep_record(found, radiance), "files": [str(f) for f in (output, csv) if f]})
    print(
        f"{key} from {first:g} to {last:g} {found.unit}, {'radiance per band' if radiance else 'DN'} at pixel "
        f"{place[0]:g},{place[1]:g}" + (f", black {found.black:g}" if found.black else "")
    )
    print("\n".join([_readings(found, found.summary()), *(str(f) for f in (output, csv) if f)]))


def _sweep_record(found: "Sweep", radiance: bool) -> dict[str, Any]:
    """What a sweep found, as `optics sweep --json` gives it."""
    return {
        "black": found.black,
        "quantity": "radiance" if radiance else "DN",
        "channels": found.channels,
        "summary": found.summary(),
        "curves": [{"settings": c.settings, "values": c.x.tolist(), "readings": c.y.tolist()} for c in found.curves],
    }


def _readings(found: "Sweep", rows: Sequence[Mapping[str, Any]]) -> str:
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
        own = ", ".join(f"{k} = {number(v, 6)}" for k, v in r.get("settings", {}).items())
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
