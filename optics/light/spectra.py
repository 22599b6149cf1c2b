"""The spectra of a scene, as numbers and as a drawing: light, losses and sensitivities over each other."""

from __future__ import annotations

from typing import Any

import numpy as np

from optics.scene.integral import numbers_of, spectrum_of
from optics.scene.loader import Scene
from optics.spectra.colours import linear_srgb, matching
from optics.spectra.curve import KINDS

STEP = 1.0  # nm, of drawn curves
AROUND = 40.0  # nm shown beyond what is seen


def records(scene: Scene) -> list[dict[str, Any]]:
    """One record per spectrum: key, kind, source, span and mean wavelength in nm; lights with a line or white too."""
    found = []
    values = scene.values()
    for name, part in scene.lights.items():
        if "spectrum" in part.curves:
            continue
        peak = values.get(f"{name}.wavelength", 0.0)
        law = f"gaussian({peak:g}, {values[f'{name}.fwhm']:g})" if peak else "white"
        if peak and (form := part.curves.get("line_shape")) is not None:
            law = f"peak {peak:g}, fwhm {values[f'{name}.fwhm']:.3g}; its shape: {form.source}"
        found.append({"key": f"{name}.spectrum", "kind": "power", "source": law, "span": None, "centre": peak or None})
    for key, curve in scene.curves.items():
        if key.endswith(".line_shape"):
            continue
        found.append(
            {
                "key": key.replace(" ", "."),
                "kind": curve.kind,
                "source": curve.source,
                "span": list(curve.span),
                "centre": curve.centre if KINDS[curve.kind][2] else None,
            }
        )
    return found


def draw(scene: Scene) -> Any:
    """A chart (optics.files.charts.Chart): lights as areas, sensitivities as lines, losses dashed, bands as ticks."""
    from optics.files.charts import GREY, chart

    spans = [c.span for c in scene.camera.channels] if scene.camera is not None else []
    spans += [scene.parts[n].curves["spectrum"].span for n in scene.lights if "spectrum" in scene.parts[n].curves]
    peaks = [p for n in scene.lights if (p := scene.values().get(f"{n}.wavelength", 0.0))]
    bands = list(scene.integrator.bands) if scene.integrator is not None else []
    low = min([380.0, *(p - AROUND for p in peaks), *(b - AROUND for b in bands)])
    high = max([730.0, *(p + AROUND for p in peaks), *(b + AROUND for b in bands)])
    if spans:
        low = max(low, min([s[0] for s in spans] + peaks) - AROUND)
        high = min(high, max([s[1] for s in spans] + peaks) + AROUND)
    nm = np.arange(low, high + STEP / 2, STEP)
    figure, axis = chart(9.0, 4.6)
    drawn: dict[str, list[str]] = {}
    shapes: dict[str, np.ndarray] = {}
    for name in scene.lights:
        power = spectrum_of(scene, name, scene.values(), nm)
        key = np.round(power / max(power.max(), 1e-30), 6).tobytes()
        drawn.setdefault(key, []).append(name)
        shapes[key] = power / max(power.max(), 1e-30)
    for key, names in drawn.items():
        label = names[0] if len(names) == 1 else f"{names[0]} ... {names[-1]}"
        colour = _colour(nm, shapes[key])
        axis.fill_between(nm, shapes[key], color=colour, alpha=0.35, lw=0, label=f"{label}: light")
        axis.plot(nm, shapes[key], color=colour, lw=0.8)
    sent = [spectrum_of(scene, n, scene.values(), nm) for n in scene.lights]
    for name, part in scene.parts.items():
        if hasattr(part, "fluorescence"):
            glow = part.emission(numbers_of(scene, name, scene.values()), nm)
            sent.append(glow / (glow.sum() * STEP))  # of power 1, as lights
            colour = _colour(nm, glow)
            axis.fill_between(nm, glow / glow.max(), color=colour, alpha=0.35, lw=0, label=f"{name}: emission")
    channels = scene.camera.seen(nm) if scene.camera is not None and scene.camera.channels else np.zeros((0, len(nm)))
    colours = ("#c03030", "#2a8a2a", "#2850c0") if len(channels) == 3 else ("#222222",)
    for row, colour, name in zip(channels, colours, "RGB"):
        title = f"{name}: sensitivity" if len(channels) == 3 else "sensitivity"
        axis.plot(nm, row / channels.max(), color=colour, lw=1.6, label=title)
    if scene.integral is not None and scene.integral.auto:
        for q, colour in zip(scene.integral.quantum, colours):
            total = np.interp(nm, scene.integral.grid, q, 0, 0) * sum(sent)
            title = "light times sensitivity" if colour == colours[0] else None
            axis.plot(nm, total / max(total.max(), 1e-30), color=colour, lw=0.8, ls=":", label=title)
    styles = iter(("--", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1))))
    other = None
    for key, curve in scene.curves.items():
        if curve.kind in ("power", "sensitivity"):
            continue
        style = next(styles, "--")
        if curve.kind in ("index", "absorption"):
            other = other or axis.twinx()
            other.plot(nm, curve(nm), color=GREY, ls=style, lw=1.2, label=f"{key} (right)")
        else:
            axis.plot(nm, curve(nm), color="#555555", ls=style, lw=1.2, label=f"{key}: {curve.kind}")
    for band in bands:
        axis.plot([band, band], [-0.035, 0], color="black", lw=1.0, clip_on=False)
    axis.set_xlim(low, high)
    axis.set_ylim(0, 1.06)
    axis.set_xlabel("wavelength, nm (below the axis: the bands that are rendered)")
    axis.set_ylabel("relative to the peak; shares of light")
    handles, labels = axis.get_legend_handles_labels()
    if other is not None:
        other.spines["top"].set_visible(False)
        own = other.get_legend_handles_labels()
        handles, labels = handles + own[0], labels + own[1]
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncol=4, frameon=False)
    return figure


def _colour(nm: np.ndarray, power: np.ndarray) -> tuple[float, ...]:
    """What a light looks like, as strong as a screen shows it; grey where nobody sees it."""
    rgb = np.maximum(linear_srgb(matching(nm) @ power), 0.0)
    if rgb.max() < 1e-3:
        return (0.45, 0.35, 0.6)
    shown = 0.85 * (rgb / rgb.max()) ** (1 / 2.2)
    return tuple(float(c) for c in shown)


__all__ = ["draw", "records"]
