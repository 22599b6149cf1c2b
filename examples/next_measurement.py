"""Two causes that look alike, the measurement that tells them apart, and the verdict after it was taken.

    python examples/next_measurement.py [leak|depolarization|stray|offset] [FOLDER]

A polarizer bench (made by coherency matrices, optics.proof.makers.bench, which share no line with the model) hides one
of four faint causes of light where there should be none. A Malus sweep cannot say which: a leak of the films looks like
a hazy sample, stray light like an offset of the camera's zero. The diagnosis is AMBIGUOUS and says what to measure; the
example does as it says, with 125 further readings of each kind, and diagnoses again."""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import optics
from optics.captures import capture_set as captures
from optics.captures.noise import Noise
from optics.errors import UnknownKey
from optics.proof.makers import bench as jones
from optics.proof.makers.bench import Photodiode, Polarizer, Sample, Truth

NOISE = Noise(system_gain=0.05, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)
GAIN = 2.2
DIODE, LEAKY = Photodiode(gain=GAIN), Polarizer(leak=0.004)
HIDDEN = {
    "leak": ("extinction leak", Truth(p1=LEAKY, p2=LEAKY, photodiode=DIODE)),
    "depolarization": ("depolarization", Truth(sample=Sample(depolarization=0.01), photodiode=DIODE)),
    "stray": ("stray light", Truth(stray=0.004, photodiode=DIODE)),
    "offset": ("dark offset", Truth(photodiode=Photodiode(gain=GAIN, offset=10.0))),
}
BASE = {
    "camera.exposure": 1.0,
    "middle.inserted": 0.0,
    "middle.angle": 0.0,
    "analyzer.inserted": 1.0,
    "polarizer.inserted": 1.0,
}


def sweep(count, **more):
    """Settings of a Malus sweep at five angles of the first polarizer and two powers of the lamp."""
    settings = jones.malus_sweep(count, polarizer_angles=(0.0, 60.0, 100.0, 190.0, 250.0))
    return [{**BASE, **own, "source.power": (1.0, 0.5)[i % 2], **more} for i, own in enumerate(settings)]


def measured(truth, settings, seed):
    """What the photodiode reads at each setting; all of them have the same films in and the same exposure."""
    first = settings[0]
    film = Polarizer(leak=truth.p1.leak) if first["middle.inserted"] else None  # of the same roll as the others
    bench = replace(
        truth,
        pm=film,
        p1=truth.p1 if first["polarizer.inserted"] else None,
        p2=truth.p2 if first["analyzer.inserted"] else None,
        photodiode=replace(truth.photodiode, gain=truth.photodiode.gain * first["camera.exposure"]),
    )
    out = tuple(
        f"{part}."
        for part, there in (("polarizer", bench.p1), ("middle", film), ("analyzer", bench.p2))
        if there is None
    )
    dials = [{k: v for k, v in own.items() if k in jones.DEFAULTS and not k.startswith(out)} for own in settings]
    readings = jones.readings(bench, dials, NOISE, seed)
    return [
        captures.Frame(f"row {seed}-{i}", reading.astype(np.float32).reshape(1, 1, -1), parameters=own)
        for i, (own, reading) in enumerate(zip(settings, readings))
    ]


def diagnosed(folder, frames):
    """Captures of these readings, calibrated and diagnosed."""
    table = captures.Table("readings.csv", ["reading"])
    captures.write(captures.Captures(folder, "polarizer_bench", frames, noise=NOISE, table=table), folder / "captures")
    return optics.calibrate(folder / "captures", folder / "study").diagnose()


def main(hidden="leak", folder=None):
    """(the effect hidden, the first diagnosis, the second one)."""
    if hidden not in HIDDEN:
        raise UnknownKey(hidden, HIDDEN, "cause")
    effect, truth = HIDDEN[hidden]
    folder = Path(folder or tempfile.mkdtemp())
    frames = measured(truth, sweep(1000), seed=1)
    before = diagnosed(folder / "before", frames)
    print(f"{before.word}: {before.sentence}")
    plan = next(a for a in before.advice if a.family == "together")
    print(f"It says to measure: {plan.shot}, and expects D = {plan.hardest.before:.3g} -> {plan.hardest.after:.3g}")
    for n, settings in enumerate(plan.settings):
        frames = frames + measured(truth, sweep(125, **settings), seed=2 + n)
    after = diagnosed(folder / "after", frames)
    print(f"{after.word}: {after.sentence}")
    return effect, before, after


if __name__ == "__main__":
    main(*sys.argv[1:])
