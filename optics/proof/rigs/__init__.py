"""Sensors and benches of the proof, a file each: what can be hidden, by which independent path captures are made, how a
study begins.

base     what all of them are: strengths that make a change, the truth of a cell, captures with what is noted wrongly
touch    digit, gelsight: stock Mitsuba's `path` (optics.proof.makers.touch)
finger   vi2tap: stock films in the mono variant (optics.proof.makers.finger)
grid     grid_bench, in one and in three colours: stock `volpath` (optics.proof.makers.grid)
particle particle_gel: numpy alone (optics.proof.makers.particle)
bench    polarizer_bench: coherency matrices (optics.proof.makers.bench)
colour   colour_bench, and digit with channels as integrals: sums in steps of 1 nm (optics.proof.makers.colour)
laboratory   student, runs, motor, polarimeter, laser, phone, photographs, polarization_camera: benches of
         other laboratories, by plain formulas (optics.proof.makers.laboratory)
"""

from optics.proof.rigs.base import Rig
from optics.proof.rigs.bench import Bench
from optics.proof.rigs.colour import ColourBench, DigitColour
from optics.proof.rigs.finger import Finger
from optics.proof.rigs.grid import Grid, GridColour
from optics.proof.rigs.laboratory import (
    Laser,
    Motor,
    Phone,
    Photographs,
    Polarimeter,
    PolarizationCamera,
    Runs,
    Student,
)
from optics.proof.rigs.particle import ParticleGel
from optics.proof.rigs.touch import Digit, Gelsight

RIGS: dict[str, type[Rig]] = {
    rig.name: rig
    for rig in (
        Digit,
        Gelsight,
        Finger,
        Grid,
        GridColour,
        ParticleGel,
        Bench,
        ColourBench,
        DigitColour,
        Student,
        Runs,
        Motor,
        Polarimeter,
        Laser,
        Phone,
        Photographs,
        PolarizationCamera,
    )
}
