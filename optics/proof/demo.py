"""The demonstration: a sensor with a hidden effect, and the loop that finds it.

An independent path makes the captures of a shipped sensor (`optics.proof.makers.touch`: stock Mitsuba, a denser mesh,
photons, read noise, 12 bits), with one effect that the base model lacks, chosen by the seed. They are taken with care:
raw, near full scale, four frames summed, and the noise of the sum written down. Then the loop runs blind: calibrate,
compare, name the missing effect, add it, and see the error on held-out presses fall to the noise. A report shows every
step."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.errors import OutputExists, UnknownKey
from optics.proof.makers import touch as synthetic
from optics.scene import loader as scenes
from optics.scene.registry import known
from optics.study import loop

# Hidden strengths, in the units of the effects' own parameters: of a size that real sensors have. Calibration absorbs
# most of what they change. Interreflection is left out: 0.2 % of the light under a dent so shallow. White LEDs cannot
# show colour crosstalk: ask for it with the coloured LEDs of digit.
SECRETS = {
    "lens vignetting": 2.0,  # of 1, the natural fall-off cos^4: corners as dark as cheap wide lenses leave them
    "veiling glare": 0.03,
    "ambient light": 1e-4,
    "lens blur": 0.6,
    "radial distortion": 0.03,
    "gel absorption": 0.02,
    "gel haze": 0.005,
    "gel wedge": 0.4,
    "gel bulge": 0.5,
    "specular lobe": 0.06,
    "LED size": 1.5,
    "residual response curve": 0.12,
    "gain drift": 0.02,
}
SENSORS = {
    "gelsight": ((120, 90), 200.0),
    "digit": ((90, 120), 700.0),
}  # px; exposure at which one LED alone comes near full scale
# 1000 readings of a photodiode, made by coherency matrices (optics.proof.makers.bench); effects that can be told apart
BENCH = "polarizer_bench"
BENCH_SECRETS = {
    "polarizer misalignment": 1.0,
    "servo scale": 1.01,
    "servo backlash": 1.0,
    "analyzer wobble": 0.01,
    "retardance": 12.0,
    "camera gamma": 0.03,
    "polarized source": 0.02,
    "extinction leak": 0.004,
}
# One frame: 12 bits raw, 20 000 electrons at full scale, as machine-vision cameras have them. No fixed pattern: a flat
# field has divided it out.
CAMERA = Noise(system_gain=0.2, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)
FRAMES = 4  # summed to one image
MOSAIC = "RGGB"  # raw: every pixel holds one channel
PHOTODIODE = Noise(system_gain=0.01, dark_noise=1.0, black_level=64.0, saturation=4095.0, prnu=0.0)
PRESSES = 4
STEPS = 3  # effects that the loop may add before it must stop


def truth(scene, seed: int) -> dict[str, float]:
    """Values of a sensor as built: its LEDs are up to half a millimetre and some degrees off the drawing, their powers
    up to a tenth."""
    rng = np.random.default_rng([seed, 1])
    drawn, built = scene.values(), {}
    for led in scene.leds:
        for axis in "xyz":
            built[f"{led}.{axis}"] = drawn[f"{led}.{axis}"] + 0.5 * rng.uniform(-1, 1)
        built[f"{led}.pan"], built[f"{led}.tilt"] = (4 * rng.uniform(-1, 1) for _ in range(2))
        built[f"{led}.power"] = drawn[f"{led}.power"] * (1 + 0.1 * rng.uniform(-1, 1))
        built[f"{led}.mu"] = drawn[f"{led}.mu"] + 0.25 * rng.uniform(-1, 1)
    built.update({"membrane.rho_r": 0.66, "membrane.rho_g": 0.52, "membrane.rho_b": 0.40, "membrane.sigma": 0.25})
    return built


def secret(seed: int, name: str | None = None, sensor: str = "gelsight") -> tuple[str, float]:
    """(name, strength) of the hidden effect: the one of that name, or the seed's choice."""
    choices = BENCH_SECRETS if sensor == BENCH else SECRETS
    names = sorted(choices)
    name = name or names[int(np.random.default_rng([seed, 2]).integers(len(names)))]
    secrets = choices if sensor == BENCH else {**SECRETS, "colour crosstalk": 0.03}
    effect = known().find_effect(name).name
    if effect not in secrets:
        raise UnknownKey(effect, secrets, "secret", hint="there is no independent way to make any other")
    return effect, secrets[effect]


def make(
    folder: Path, seed: int, name: str | None = None, progress: Callable | None = None, sensor: str = "gelsight"
) -> tuple[str, float]:
    """Write the captures of a demonstration; returns (name, strength) of the hidden effect, which they do not hold."""
    effect, strength = secret(seed, name, sensor)
    if sensor == BENCH:
        make_bench(folder, seed, effect, strength)
        return effect, strength
    (width, height), exposure = SENSORS[sensor]
    scene = scenes.load(sensor, {"width": str(width), "height": str(height)})
    built = {**truth(scene, seed), "camera.exposure": exposure}
    maker = synthetic.Maker(scene, built, {effect: strength}, CAMERA, seed + 1000, spp=128, frames=FRAMES)
    # Each LED alone, and none: the dark frame separates ambient light from light that the camera scatters.
    drives = [*({led: 1.0} for led in scene.leds), {}]
    found = maker.captures(synthetic.presses(PRESSES, seed), drives, progress=progress, scene_name=sensor, cfa=MOSAIC)
    found.parameters["camera.exposure"] = exposure
    capture_files.write(found, folder, bits=16)
    return effect, strength


def make_bench(folder: Path, seed: int, effect: str, strength: float) -> None:
    """Write readings of the polarizer bench with one effect: P1 at five angles, the analyser a full turn and back, the
    lamp at two powers."""
    from optics.proof.makers.bench import malus_sweep, with_effects, write

    settings = malus_sweep(1000, polarizer_angles=(0.0, 60.0, 100.0, 190.0, 250.0))
    for i, own in enumerate(settings):
        own.update({"source.power": (1.0, 0.5)[i % 2], "sample.angle": (0.0, 45.0)[i // 2 % 2]})
    truth = with_effects(
        {effect: strength - (effect == "servo scale")}, gain=2.2
    )  # a scale is known by its value, 1 is none
    write(folder, truth, settings, PHOTODIODE, seed + 1000)


def _opening(sensor: str) -> str:
    """What the captures are, before anything is found."""
    if sensor == BENCH:
        return (
            "1000 readings of a photodiode behind two polarizers. They were computed from coherency matrices, not by "
            "the model, and hold one effect that the base model lacks."
        )
    (width, height), _ = SENSORS[sensor]
    return (
        f"{PRESSES} presses on {sensor}, each under one LED at a time and in the dark. Every image has "
        f"{width} x {height} pixels and sums {FRAMES} raw frames of 12 bits. Stock Mitsuba made them, not the model, "
        "and they hold one effect that the base model lacks."
    )


def run(
    folder: str | Path,
    seed: int = 1,
    effect: str | None = None,
    sensor: str = "gelsight",
    progress: Callable | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> dict:
    """Make captures, run the loop, write the report; returns what was hidden, what was claimed, and the errors.

    folder   receives `captures/`, `study/` and `report.html`; a run that was cut off is resumed from there
    say      is called with the text of each stage
    Raises OutputExists where the folder holds another demonstration.
    """
    from optics.pages.report import report

    folder = Path(folder)
    note = folder / "secret.json"
    if not (folder / "captures" / "captures.toml").is_file():
        name, strength = make(folder / "captures", seed, effect, progress, sensor)
        note.write_text(json.dumps({"effect": name, "strength": strength, "seed": seed, "sensor": sensor}))
    hidden = json.loads(note.read_text())
    asked = (seed, sensor, known().find_effect(effect).name if effect else hidden["effect"])
    if asked != (hidden["seed"], hidden["sensor"], hidden["effect"]):
        raise OutputExists(
            f"{folder} holds another demonstration, of {hidden['sensor']} with seed {hidden['seed']}; "
            "choose another folder for this one (-o)"
        )
    say(_opening(sensor))
    # Press positions are taken as known: to solve for them too takes three times as long and leads to the same verdict.
    setup = loop.Setup(captures=str(folder / "captures"), per_group=[], seed=seed)
    study, model, fit = loop.begin(setup, folder / "study", title="Demonstration", resume=True, progress=progress)
    say(study.table())
    claimed = [e.name for e in loop.effects_of(study, model.scene.registry)]
    diagnosis = None
    for _ in range(STEPS + 1):
        diagnosis = loop.examine(study, model, setup, fit, progress)
        say(diagnosis.text())
        if diagnosis.word != "CLAIM" or len(claimed) >= STEPS:
            break
        name = diagnosis.missing
        start = diagnosis.fits[name].values if name in diagnosis.fits else None
        fit, _ = loop.extend(study, model, setup, fit, model.scene.registry.find_effect(name), start, progress)
        claimed.append(name)
        say(study.table())
    page = report(study.folder, folder / "report.html", overwrite=True)
    last = study.steps[-1]["held_out"]
    keys = {
        key for name in claimed for key in sum(model.scene.keys_of(model.scene.registry.find_effect(name)).values(), [])
    }
    strengths = {v["name"]: (v["value"], v["sd"]) for v in study.steps[-1]["variables"] if keys & set(v["keys"])}
    return {
        "hidden": hidden,
        "claimed": claimed,
        "strengths": strengths,
        "verdict": diagnosis.word,
        "held_out": last["chi2_per_dof"],
        "first": study.steps[0]["held_out"]["chi2_per_dof"],
        "report": str(page),
        "right": claimed[:1] == [hidden["effect"]] and last["chi2_per_dof"] <= 1.1,
    }
