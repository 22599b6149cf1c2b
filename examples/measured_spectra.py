"""What the spectra of LEDs and pigment do to an image: DIGIT and Vi2TaP with round numbers and with sourced ones.

    python examples/measured_spectra.py [image.png]

Renders each scene twice, with channels as integrals over the wavelength: with Gaussians of the round widths that a
drawing would assume, and with what the scene's sources say (digit.xml, vi2tap.xml name them). Prints, per channel, the
change of the mean and the rms difference that is left when every LED, or the pigment, takes the power that fits best,
as a calibration would: what only spectra can explain. Draws both images and ten times their difference."""

import sys
from pathlib import Path

import numpy as np

from optics.light.rendering import RenderJob
from optics.scene import loader as scenes

NIKON = "Nikon 5100 (NPL)"
CASES = {  # scene: (what is common, round numbers, what takes up a change of power)
    "digit": (
        {"bands": "auto", "depth": "0.8"},
        {
            **{f"line_{colour}": "" for colour in ("red", "green", "blue")},
            **{"fwhm_red": "20", "fwhm_green": "35", "fwhm_blue": "25"},
        },
        ("led_red", "led_green", "led_blue"),
    ),
    "vi2tap": (
        {"bands": "auto", "sensitivity": NIKON, "analyzer": "90", "depth": "2"},
        {"emission": "525", "emission_width": "70"},
        ("uv_left", "uv_right"),
    ),
}


def image(job, off=()) -> np.ndarray:
    """(H, W, 3) linear channels, 1 = full scale, with some lights switched off."""
    return job.take({job.scene.powers[name]: 0.0 for name in off}).camera / 255


def compared(name: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The images with round and with sourced numbers, and a line per channel."""
    common, rounded, lights = CASES[name]
    before, after = (RenderJob(scenes.load(name, {**common, **more}), black=0.0) for more in (rounded, {}))
    old, new = image(before), image(after)
    everything = list(after.scene.lights)
    parts = [image(after, [n for n in everything if n != own]) for own in lights]
    rest = image(after, lights) if len(everything) > len(lights) else 0.0 * new
    columns = np.stack([p.ravel() for p in parts], -1)
    powers = np.linalg.lstsq(columns, (old - rest).ravel(), rcond=None)[0]
    left = (columns @ powers).reshape(old.shape) + rest - old
    lines = []
    for c, channel in enumerate("RGB"):
        change = new[..., c].mean() / old[..., c].mean() - 1
        rms = np.sqrt((left[..., c] ** 2).mean() / (old[..., c] ** 2).mean())
        lines.append(
            f"{name:8} {channel}   mean {100 * change:+6.1f} %   left by powers {100 * rms:5.2f} % of the image's rms"
        )
    lines.append(f"{name:8} powers that fit best: {', '.join(f'{n} {p:.3f}' for n, p in zip(lights, powers))}")
    return old, new, lines


def shown(linear: np.ndarray, full: float) -> np.ndarray:
    return np.clip(linear / full, 0, 1) ** (1 / 2.2)


def main(file: Path | None) -> None:
    from optics.files.charts import Chart

    figure = Chart(figsize=(9.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3, height_ratios=(3, 2))
    for row, name in zip(axes, CASES):
        old, new, lines = compared(name)
        print("\n".join(lines))
        full = np.percentile(new, 99.5)
        panels = ("round numbers", shown(old, full)), ("sourced", shown(new, full))
        difference = np.clip(0.5 + 10 * (new - old) / full / 2, 0, 1)
        for axis, (title, picture) in zip(row, (*panels, ("10 x (sourced - round)", difference))):
            axis.imshow(picture)
            axis.set_title(f"{name}: {title}", fontsize=9)
            axis.set_axis_off()
    if file is not None:
        figure.savefig(file, dpi=110)
        print(file)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
