"""python -m optics.proof: see `optics.proof`. What other processes run stands in a module that they can import."""

import typer

from optics.proof.command import main

typer.run(main)
