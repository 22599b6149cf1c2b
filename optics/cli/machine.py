"""Commands about this installation: what the machine can run, and the demonstration."""

import time
from pathlib import Path
from typing import Annotated

import typer

from optics.cli.shared import AsJson, command, terminal
from optics.words import with_sd


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
    """Simulate a sensor with a hidden effect, and find it.

    The simulation takes another path than the model."""
    from optics.errors import UnknownKey
    from optics.proof import demo as story

    clock = time.monotonic()
    with terminal.progress() as progress:
        if sensor not in (*story.SENSORS, story.BENCH):
            raise UnknownKey(sensor, (*story.SENSORS, story.BENCH), "sensor")
        found = story.run(output, seed, effect, sensor, progress, lambda text: print(text + "\n", flush=True))
    hidden = found["hidden"]
    strengths = [f"{name} = {with_sd(value, sd)}" for name, (value, sd) in found["strengths"].items()]
    print(
        f"hidden: {hidden['effect']}, strength {hidden['strength']:g}; "
        f"named: {', '.join(found['claimed']) or 'nothing'}"
        f"{' (' + ', '.join(strengths[:3]) + (' ...' if len(strengths) > 3 else '') + ')' if strengths else ''}; "
        f"last verdict: {found['verdict']}"
    )
    print(
        f"held-out chi2 per degree of freedom: {found['first']:.3f} before, {found['held_out']:.3f} after; "
        f"{time.monotonic() - clock:.0f} s; {found['report']}"
    )
    if not found["right"]:
        raise typer.Exit(1)


@command
def doctor(as_json: AsJson = False) -> None:
    """Report what this machine can run, and how to fix the rest."""
    from optics import doctor as machine

    rows = machine.report()
    print(machine.report_json(rows) if as_json else machine.report_table(rows))
    if not machine.is_sound(rows):
        raise typer.Exit(1)
