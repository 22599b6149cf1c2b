"""The loop on the polarizer bench: readings by coherency matrices (optics.proof.makers.bench), one effect hidden at a
time, two together, none.

The base model is ideal: two polarizers without a leak, a clear slot, a lamp of unknown power. Data and model share no
line; noise is that of a photodiode read with 12 bits."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.fit.model import value_of
from optics.proof.makers import bench as jones
from optics.proof.makers.bench import Photodiode, Polarizer, Sample, Source, Truth
from optics.study import loop

NOISE = Noise(system_gain=0.05, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)
READINGS = 1000


@dataclass
class Case:
    """What is hidden, how the bench was set, and what an honest verdict may be.

    effects    the hidden ones, the strongest first
    alike      what nobody can tell from it with these settings: named together with it, or in its place
    strengths  {variable: true value}
    settings   further settings, each a list that the readings cycle through
    polarizers angles of the first polarizer, deg
    """

    truth: Truth
    effects: tuple[str, ...]
    alike: tuple[str, ...] = ()
    strengths: dict[str, float] = field(default_factory=dict)
    settings: dict[str, list[float]] = field(default_factory=dict)
    noise: Noise = NOISE
    polarizers: tuple[float, ...] = (0.0, 60.0, 100.0, 190.0, 250.0)


def lamp(**more):
    return dict(photodiode=Photodiode(gain=2.2), **more)


def colours(**more):
    return dict(photodiode=Photodiode(gain=2.2, channels=3), **more)


LEAKY = Polarizer(leak=0.004)
SHINY = Polarizer(transmittance=0.8 / 0.9**2, face_reflectance=0.1)  # 0.8 with the faces' losses, as the model's
CASES = {
    "leak": Case(
        Truth(**lamp(p1=LEAKY, p2=LEAKY)),
        ("extinction leak",),
        ("depolarization", "retardance"),
        {"polarizer_film.leak": 0.004},
    ),
    "coloured leak": Case(
        Truth(**colours(p1=Polarizer(leak=0.004, leak_slope=0.3), p2=Polarizer(leak=0.004, leak_slope=0.3))),
        ("coloured leak",),
        ("extinction leak", "depolarization"),
    ),  # an exponential in the data, a straight line in the model
    # what turns the polarization between two films is no other thing to readings than a film that is off its dial
    "misalignment": Case(
        Truth(**lamp(p2=Polarizer(offset=1.0))), ("polarizer misalignment",), ("optical rotation", "retardance")
    ),
    "scale": Case(Truth(**lamp(p2=Polarizer(scale=1.01))), ("servo scale",)),
    "backlash": Case(
        Truth(**lamp(p2=Polarizer(backlash=1.0))), ("servo backlash",), (), {"polarizer_film.backlash": 1.0}
    ),
    "wobble": Case(Truth(**lamp(p2=Polarizer(wobble_c=0.01, wobble_s=-0.005))), ("analyzer wobble",)),
    "retardance": Case(
        Truth(**lamp(sample=Sample(retardance=12.0, axis=20.0))), ("retardance",), (), {}, {"sample.angle": [0.0, 45.0]}
    ),
    # light comes nearly along the sheet's 0 degrees: one component shows by its product with the other, which no chord
    # knows
    "retardance along a polarizer": Case(
        Truth(**lamp(sample=Sample(retardance=15.0, axis=-20.0))), ("retardance",), polarizers=(0.0, 8.0)
    ),
    "dispersive retardance": Case(
        Truth(**colours(sample=Sample(retardance=40.0, axis=20.0, dispersion=0.1))),
        ("retardance", "dispersive retardance"),
        (),
        {"sample.retard_dispersion": 0.1},
        {"sample.angle": [0.0, 45.0]},
    ),
    "stress": Case(
        Truth(**colours(sample=Sample(stress_retardance=12.0))),
        ("stress birefringence",),
        ("retardance",),
        {},
        {"sample.angle": [0.0, 45.0, 20.0]},
    ),
    "depolarization": Case(
        Truth(**lamp(sample=Sample(depolarization=0.01))),
        ("depolarization",),
        ("extinction leak", "retardance"),
        {"sample.depolarization": 0.01},
    ),
    "stray light": Case(Truth(**lamp(stray=0.004)), ("stray light",), ("dark offset",)),
    "dark offset": Case(
        Truth(photodiode=Photodiode(gain=2.2, offset=10.0)), ("dark offset",), ("stray light",), {"camera.offset": 10.0}
    ),
    "gamma": Case(Truth(photodiode=Photodiode(gain=2.2, gamma=1.03)), ("camera gamma",), (), {"camera.gamma": 0.03}),
    "drift": Case(
        Truth(**lamp(source=Source(drift=0.001))), ("source drift",), ("polarized source",), {"source.drift": 0.001}
    ),
    "polarized source": Case(
        Truth(**lamp(source=Source(dop=0.02, dop_angle=30.0))),
        ("polarized source",),
        (),
        {"source.dop_q": 0.02 * np.cos(np.pi / 3), "source.dop_u": 0.02 * np.sin(np.pi / 3)},
    ),
    # the reflections change the curve by r^2: seen at a tenth of the noise, and with films of high index
    "film reflections": Case(
        Truth(**lamp(p1=SHINY, p2=SHINY)),
        ("film reflections",),
        (),
        {"polarizer_film.face": 0.1},
        noise=Noise(0.0005, 0.2, 64.0, 4095.0, 0.0),
    ),
    "misalignment and leak": Case(
        Truth(**lamp(p1=LEAKY, p2=Polarizer(leak=0.004, offset=1.0))),
        ("polarizer misalignment", "extinction leak"),
        ("depolarization", "retardance", "optical rotation", "dark offset", "stray light"),
    ),
    "depolarization and drift": Case(
        Truth(**lamp(source=Source(drift=0.002), sample=Sample(depolarization=0.01))),
        ("depolarization", "source drift"),
        ("extinction leak", "retardance", "coloured leak"),
    ),
}


def study_of(case: Case, folder, seed: int = 7):
    settings = jones.malus_sweep(READINGS, polarizer_angles=case.polarizers)
    for i, own in enumerate(settings):
        own["source.power"] = (1.0, 0.5)[i % 2]
        own.update({key: values[i % len(values)] for key, values in case.settings.items()})
    jones.write(folder / "captures", case.truth, settings, case.noise, seed)
    bands = {"bands": "620, 540, 460"} if case.truth.photodiode.channels == 3 else {}
    setup = loop.Setup(captures=str(folder / "captures"), defines=bands)
    return (setup, *loop.begin(setup, folder / "study"))


def at_the_noise(chi2_per_dof: float, count: int) -> bool:
    """Within five standard deviations of the mean, 1."""
    return abs(chi2_per_dof - 1) < 5 * np.sqrt(2 / count)


# Whose readings have three bands, or whose refits are dear: among the slow tests.
DEAR = (
    *("leak", "stray light", "film reflections", "dispersive retardance", "gamma", "coloured leak", "scale", "stress"),
    *("drift", "misalignment", "misalignment and leak", "retardance", "depolarization", "depolarization and drift"),
    *("dark offset", "retardance along a polarizer", "backlash", "wobble", "polarized source"),
)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in DEAR else n for n in CASES])
def test_a_hidden_effect_is_found(name, tmp_path):
    case = CASES[name]
    setup, study, model, fit = study_of(case, tmp_path)
    diagnosis = loop.examine(study, model, setup, fit)
    known = {*case.effects, *case.alike}
    if diagnosis.word == "CLAIM":
        assert diagnosis.missing in case.effects, diagnosis.sentence
        assert any(set(e.effects) <= known for e in diagnosis.survivors), diagnosis.sentence
    elif diagnosis.word == "AMBIGUOUS":
        assert {*case.effects} <= {*diagnosis.ambiguous} <= known, diagnosis.sentence
        assert case.alike, diagnosis.sentence
        needs = model.scene.registry.find_effect(case.effects[0]).needs
        assert any(needs in hint for hint in diagnosis.hints), (
            "no word about the measurement that would tell them apart"
        )
    else:
        raise AssertionError(f"{diagnosis.word}: {diagnosis.sentence}")
    for effect in case.effects:
        start = diagnosis.fits[effect].values if effect in diagnosis.fits else None
        fit, comparison = loop.extend(study, model, setup, fit, model.scene.registry.find_effect(effect), start)
    # the error falls to the noise floor, on readings that were not fitted as well
    held = study.steps[-1]["held_out"]
    assert at_the_noise(fit.chi2 / fit.dof, fit.dof), fit.chi2 / fit.dof
    assert np.isfinite(fit.sd).all()  # what no reading shows, such as where all angles count from, rests where it is
    assert at_the_noise(held["chi2_per_dof"], READINGS / 4), held
    for variable, sd in zip(fit.variables, fit.sd):
        if variable.name in case.strengths:  # within four standard deviations
            found = value_of(model, fit.values, variable)
            assert abs(found - case.strengths[variable.name]) < 4 * sd, f"{variable.name}: {found} +- {sd}"
    assert loop.examine(study, model, setup, fit).word == "NOTHING"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_perfect_bench_lacks_nothing(seed, tmp_path):
    setup, study, model, fit = study_of(Case(Truth(**lamp()), ()), tmp_path, seed)
    assert loop.examine(study, model, setup, fit).word == "NOTHING"
    power = next(v for v in fit.variables if v.name == "source.power")
    assert abs(value_of(model, fit.values, power) - 2.2) < 4 * fit.sd[0]  # four standard deviations: the diode's gain


@pytest.mark.slow
def test_what_goes_with_a_setting_is_drafted_then_claimed_as_a_formula(tmp_path):
    """A lamp whose supply swings as sin(t/3 min), which no effect has: the curve along its clock, as a table, then as a
    formula."""
    from optics.proof.rigs.bench import Bench, sweep
    from optics.study import draft

    rig = Bench()
    capture_files.write(sweep(rig.light({}), rig.settings(), 5, {"swinging supply": 0.1}), tmp_path / "captures")
    setup = rig.setup(tmp_path / "captures", 5)
    study, model, fit = loop.begin(setup, tmp_path / "study")
    diagnosis = loop.examine(study, model, setup, fit, advised=False)
    assert diagnosis.word == "UNKNOWN" and diagnosis.families[0].coordinate == "source.time", diagnosis.sentence
    text, plugins = draft.from_study(study.folder, None, "swinging supply")
    file = draft.write(text, plugins, "swinging supply")
    study, model, setup = loop.take_up(study.folder)
    table, _ = loop.extend(
        study, model, setup, loop.restore(study, model), model.scene.registry.find_effect("swinging-supply")
    )
    assert table.chi2 - table.dof < 0.4 * (
        fit.chi2 - fit.dof
    )  # straight lines between few points, where the lamp turns

    file.write_text(
        "import numpy as np\n"
        + text.replace("lookup(x, AT, CURVE)", "np.sin(np.asarray(x) / 3.0)").replace("checks=(meets_its_table,),", "")
    )
    # the edited file is taken up; the readings that it was drafted from would claim it whatever it says
    capture_files.write(sweep(rig.light({}), rig.settings(), 6, {"swinging supply": 0.1}), tmp_path / "another")
    setup = rig.setup(tmp_path / "another", 6)
    setup.plugins = str(plugins)
    study, model, fit = loop.begin(setup, tmp_path / "formula")
    diagnosis = loop.examine(study, model, setup, fit, advised=False)
    assert diagnosis.missing == "swinging supply"
    found = diagnosis.row("swinging supply").refit
    assert abs(found.strength[0] - 0.1) < 4 * found.sd[0]
    formula = model.scene.registry.find_effect("swinging-supply")
    fit, _ = loop.extend(study, model, setup, fit, formula, diagnosis.fits["swinging supply"].values)
    assert at_the_noise(study.steps[-1]["held_out"]["chi2_per_dof"], 150)
    assert loop.examine(study, model, setup, fit, advised=False).word == "NOTHING"
