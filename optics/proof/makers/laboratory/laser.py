"""A polarimeter with a laser, or a lamp behind a narrow filter: one wavelength, which is none of those at which films
and plates are catalogued.

The plans and plates are those of `polarimeter`; retardances stand in captures as the catalogue has them, at 540 nm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optics.proof.makers.laboratory import polarimeter
from optics.proof.makers.laboratory.session import Session

LINES = (405.0, 450.0, 532.0, 589.3, 632.8, 650.0)  # nm: diodes, doubled Nd:YAG, sodium, helium-neon


def session(rng: np.random.Generator) -> Session:
    line = float(rng.choice(LINES))
    found = polarimeter.session(rng)
    return replace(found, bands=(line,), note=f"{found.note.rpartition(',')[0]}, {line:g} nm")
