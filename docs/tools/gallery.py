"""Renders shipped sensors for the pages: renders/gallery/*.png, and four of them side by side, sensors.webp.

    python docs/tools/gallery.py [SENSOR ...]

The images are those of the commands below, uncut; all of them take some minutes. With names, only these are made."""

from __future__ import annotations

import shlex
import sys
import tempfile
from pathlib import Path

from PIL import Image

FOLDER = Path(__file__).resolve().parent.parent.parent / "renders" / "gallery"
HEIGHT, GAP = 240, 8  # px of the strip

# GelSight with three of its six LEDs, one a colour, as slopes then show as colours; the others as they ship.
COMMANDS = {
    "gelsight": "optics render gelsight -D depth=0.8 -D radius=2"
    " --set led_2.power=0 --set led_4.power=0 --set led_6.power=0"
    " --set led_1.power_g=0 --set led_1.power_b=0 --set led_3.power_r=0 --set led_3.power_b=0"
    " --set led_5.power_r=0 --set led_5.power_g=0 --set camera.exposure=280 --png -o",
    "digit": "optics render digit -D depth=0.6 --png -o",
    "magictac": "optics render magictac -D distance=-0.4 -D width=320 -D height=240 -D packets=1000000"
    " --set camera.exposure=1100 --png -o",
    "vi2tap": "optics render vi2tap -D x_fov=86 -D depth=2 --png -o",
}
BESIDE = {name: f"optics render {name} --png -o" for name in ("gelsight_mini", "gelsight_bench", "9dtact")}


def render(name: str) -> None:
    """Run a sensor's command and keep its PNG."""
    from optics.cli import main as optics

    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch, f"{name}.exr")
        if code := optics([*shlex.split({**COMMANDS, **BESIDE}[name])[1:], str(file), "--quiet"]):
            raise SystemExit(code)
        Image.open(file.with_suffix(".png")).convert("RGB").save(FOLDER / f"{name}.png", optimize=True)


def main(names: list[str]) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names or (*COMMANDS, *BESIDE):
        render(name)
    images = [Image.open(FOLDER / f"{name}.png") for name in COMMANDS]
    images = [i.resize((round(i.width * HEIGHT / i.height), HEIGHT), Image.Resampling.LANCZOS) for i in images]
    strip = Image.new("RGB", (sum(i.width for i in images) + GAP * (len(images) - 1), HEIGHT), "white")
    x = 0
    for image in images:
        strip.paste(image, (x, 0))
        x += image.width + GAP
    strip.save(FOLDER / "sensors.webp", quality=88, method=6)


if __name__ == "__main__":
    main(sys.argv[1:])
