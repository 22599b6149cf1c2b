"""Fits of a bench from far off: readings by closed forms in numpy, of any scale, any zero and any order.

    I = p/2 [cos(a - b)^2 - sin 2(a - c) sin 2(b - c) sin(delta/2)^2]

of an analyser at a, a polarizer at b and a plate of the retardance delta with its fast axis at c between them."""

import numpy as np
import pytest

from optics.diagnosis.diagnose import diagnose
from optics.errors import Underdetermined
from optics.fit import calibrate
from optics.scene.parameter import Values
from optics.study import loop, stages
from optics.study import setup as studies
from optics.study.refits import Refits

NOISE = 0.002  # V, of readings of up to a few volts
BLACK = 0.5  # V: without light


def malus(a, b=0.0, delta=0.0, axis=0.0):
    """Transmittance of two ideal polarizers with a plate between them; degrees."""
    a, b, delta, axis = (np.radians(x) for x in (a, b, delta, axis))
    return (np.cos(a - b) ** 2 - np.sin(2 * (a - axis)) * np.sin(2 * (b - axis)) * np.sin(delta / 2) ** 2) / 2


def written(folder, settings, light, seed=0, saturation=10.0, volt=1.0):
    """A capture set of readings, volts by default, with the noise of the meter; `light` (N,) or (N, C)."""
    light = np.asarray(light, float).reshape(len(light), -1)
    read = volt * (BLACK + light + NOISE * np.random.default_rng(seed).normal(size=light.shape))
    names = [f"reading_{c}" for c in range(light.shape[1])]
    folder.mkdir(parents=True)
    (folder / "captures.toml").write_text(
        f'scene = "polarizer_bench"\n[noise]\nsystem_gain = {volt * 1e-9}\ndark_noise = {volt * NOISE}\n'
        f"black_level = {volt * BLACK}\nsaturation = {volt * saturation}\nprnu = 0.0\n"
        f'[table]\nfile = "readings.csv"\nvalues = {names}\n'.replace("'", '"')
    )
    columns = np.column_stack([*settings.values(), read])
    lines = [",".join([*settings, *names]), *(",".join(map(repr, map(float, row))) for row in columns)]
    (folder / "readings.csv").write_text("\n".join(lines) + "\n")
    return folder


def opened(folder, free, bands=None, values=None):
    """(model, variables, fitted frames, start) of a study of the set."""
    setup = studies.Setup(captures=str(folder), free=free, defines={"bands": bands} if bands else {})
    model = studies.open_model(setup)
    fitted, _ = studies.split(model, setup)
    return model, studies.variables_of_base(model, setup, fitted), fitted, Values(dict(values or {}))


ANGLES = np.arange(0.0, 360.0, 10.0)


@pytest.mark.parametrize("power", [0.0, 1.0])
@pytest.mark.parametrize("turned", [True, False])
def test_a_prediction_of_readings_has_one_value_for_each(mitsuba, tmp_path, power, turned):
    """Also where the lamp is off, or all settings are the same: then nothing that is predicted has their number."""
    angles = ANGLES if turned else 0.0 * ANGLES
    folder = written(tmp_path / "set", {"analyzer.angle": angles}, 3.0 * power * malus(angles))
    model, variables, frames, _ = opened(folder, ["source.power", "analyzer.offset"])
    values = Values({"source.power": power})
    shapes = [model.frames[i].image.shape for i in frames]
    assert [p.shape for p in model.predict(values, frames)] == shapes
    for shape, (prediction, images) in zip(shapes, model.derivatives(values, variables, frames)):
        assert prediction.shape == shape and all(image.shape == shape for image in images.values())
    assert stages.comparison_of(model, values).fitted.n == 36


@pytest.mark.parametrize(("saturation", "volt"), [(10.0, 1.0), (4095.0, 400.0)])
def test_the_scale_of_the_start_does_not_matter(mitsuba, tmp_path, saturation, volt):
    """Volts or 12 bits: a power that starts a thousand times off ends where one ends that starts near."""
    light = 3.0 * malus(ANGLES, 7.0) + 0.01
    folder = written(tmp_path / "set", {"analyzer.angle": ANGLES}, light, saturation=saturation / volt, volt=volt)
    model, variables, frames, _ = opened(folder, ["source.power", "analyzer.offset", "analyzer.leak"])
    fits = [calibrate.fit(model, variables, Values({"source.power": power}), frames) for power in (1e-3, 0.3, 1.0, 1e3)]
    for fit in fits:
        assert fit.converged and fit.dof > 20 and fit.chi2_per_dof < 1.0 + 5 * np.sqrt(2 / fit.dof)
        assert fit.chi2 == pytest.approx(fits[1].chi2, abs=0.2)  # the accuracy of a fit: 0.05 for each of 3 variables
        assert fit.estimate == pytest.approx(fits[1].estimate, abs=np.max(fit.sd * 0.3))


@pytest.mark.parametrize("power", [1e-3, 1.0, 1e3])
def test_a_lamp_does_not_go_out_on_the_way(mitsuba, tmp_path, power):
    """A dial that is 80 degrees off: at first less light and an offset explain more, and a lamp that is switched off
    shows no angle any more."""
    folder = written(tmp_path / "set", {"analyzer.angle": ANGLES}, 3.0 * malus(ANGLES, 80.0))
    model, variables, frames, _ = opened(folder, ["source.power", "analyzer.offset", "camera.offset"])
    fit = calibrate.fit(model, variables, Values({"source.power": power}), frames)
    assert fit.converged and fit.chi2_per_dof < 1.0 + 5 * np.sqrt(2 / fit.dof)
    assert fit.estimate[:2] == pytest.approx([3.0 / 9.5 / 0.64, -80.0], rel=0.01)


def test_a_lamp_that_is_nearly_off_is_found_off_and_does_not_end_the_fit(mitsuba, tmp_path):
    """Its power is nothing, within its error; an offset says what there is, and its angle stays where it was."""
    folder = written(tmp_path / "set", {"analyzer.angle": ANGLES}, 0.3 + 0.0 * ANGLES, seed=3)
    model, variables, frames, start = opened(folder, ["source.power", "analyzer.offset", "camera.offset"])
    fit = calibrate.fit_over_starts(model, variables, start, frames)
    power = model.at(fit.values, 0)["source.power"]
    # 0.002 V sqrt(2/36) of a cosine, of 9.5 V 0.64/4 for each unit of power: 3.1e-4 sd, of which noise makes four
    assert 0 < power < 1.3e-3 and fit.chi2_per_dof < 1.0 + 5 * np.sqrt(2 / fit.dof)
    assert model.at(fit.values, 0)["camera.offset"] == pytest.approx(0.3, abs=5 * NOISE)


@pytest.mark.parametrize("zero", [-75.0, 40.0, 90.0, 128.0])
def test_an_unknown_zero_of_a_dial_is_found_in_any_quadrant(mitsuba, tmp_path, zero):
    """Half of the readings are darker than a fit at 0 would have them: it would do with less light, and an offset."""
    folder = written(tmp_path / "set", {"analyzer.angle": ANGLES}, 3.0 * malus(ANGLES + zero))
    model, variables, frames, start = opened(folder, ["source.power", "analyzer.offset", "camera.offset"])
    fit = stages.fit_base(model, variables, frames, start)
    found = model.at(fit.values, 0)["analyzer.offset"]
    assert (found - zero + 90) % 180 - 90 == pytest.approx(0, abs=0.3) and fit.chi2_per_dof < 1.0 + 5 * np.sqrt(
        2 / fit.dof
    )


@pytest.mark.slow
@pytest.mark.parametrize(("delta", "axis"), [(30.0, 20.0), (200.0, -70.0), (420.0, 20.0), (640.0, 75.0)])
def test_a_plate_of_any_order_is_found(mitsuba, tmp_path, delta, axis):
    """In three colours, by its retardance at 540 nm; on linear light between polarizers its sign does not show."""
    a, b = np.tile(np.arange(0.0, 180.0, 10.0), 2), np.repeat([0.0, 45.0], 18)
    bands = (620.0, 540.0, 460.0)
    light = np.column_stack([3.0 * malus(a, b, delta * 540 / band, axis) for band in bands])
    folder = written(tmp_path / "set", {"analyzer.angle": a, "polarizer.angle": b}, light)
    model, variables, frames, start = opened(
        folder, ["source.power", "sample.retard_0", "sample.retard_45"], "620, 540, 460"
    )
    fit = stages.fit_base(model, variables, frames, start)
    x, y = fit.estimate[1:]
    assert fit.chi2_per_dof < 1.0 + 5 * np.sqrt(2 / fit.dof)
    assert np.hypot(x, y) == pytest.approx(delta, abs=1.0)
    assert (np.degrees(np.arctan2(y, x)) / 2 - axis + 45) % 90 - 45 == pytest.approx(0, abs=1.0)


def test_a_parameter_without_slope_at_its_start_is_not_called_unseen(mitsuba, tmp_path):
    """Crossed polarizers at 0 and 90 and a plate turned between them: at retardance 0 all is dark, with no slope."""
    turned = np.arange(0.0, 180.0, 5.0)
    settings = {"analyzer.angle": 90.0 + 0 * turned, "sample.angle": turned}
    folder = written(tmp_path / "set", settings, 3.0 * malus(90.0, 0.0, 60.0, turned))
    model, variables, frames, _ = opened(folder, ["sample.retard_0", "sample.retard_45"])
    start = Values({"source.power": 3.0 / 9.5 / 0.64})  # known
    fit = calibrate.fit_over_starts(model, variables, start, frames)
    assert np.hypot(*fit.estimate) == pytest.approx(60.0, abs=1.0)


@pytest.mark.slow
def test_a_refit_finds_the_order_of_an_effect(mitsuba, tmp_path):
    """420 deg, where the score knows a plate of 10: what a diagnosis asks for is the best refit."""
    a, b = np.tile(np.arange(0.0, 180.0, 10.0), 2), np.repeat([0.0, 45.0], 18)
    light = np.column_stack([3.0 * malus(a, b, 420.0 * 540 / band, 20.0) for band in (620.0, 540.0, 460.0)])
    folder = written(tmp_path / "set", {"analyzer.angle": a, "polarizer.angle": b}, light)
    model, variables, frames, start = opened(folder, ["source.power"], "620, 540, 460")
    base = stages.fit_base(model, variables, frames, start)
    assert base.chi2_per_dof > 1000
    effect = model.scene.registry.find_effect("retardance")
    extra = studies.effect_variables(model, effect, base.variables)
    refits = Refits(model, studies.Setup(captures=str(folder)), base, [effect])
    near = stages.off_neutral(model, base.values, extra)
    found = refits.of(model, [*base.variables, *extra], near, frames)
    assert found.chi2_per_dof < 1 + 5 * np.sqrt(2 / found.dof)
    assert np.hypot(*found.estimate[-2:]) == pytest.approx(420.0, abs=1.0)


def test_a_dichroic_sheet_between_crossed_films_is_not_called_a_plate(mitsuba, tmp_path):
    """There it has no first order and is the image of a retardance: it is named too."""
    angles = np.r_[ANGLES[:18], ANGLES[:2]]
    settings = {"sample.angle": angles, "analyzer.angle": np.r_[np.full(18, 90.0), 0.0, 0.0]}
    c = np.sqrt(1 - np.tanh(0.3) ** 2)
    a, b = np.radians(settings["analyzer.angle"]), np.radians(angles)
    along, across = np.cos(2 * b), np.sin(2 * b)  # ideal films, the first at 0 deg, and the Mueller matrix by hand
    d = np.tanh(0.3)
    q, u = d * along + along**2 + c * across**2, d * across + (1 - c) * along * across
    light = 3.0 * (1 + d * along + np.cos(2 * a) * q + np.sin(2 * a) * u) / 4
    folder = written(tmp_path / "set", settings, light)
    text = (folder / "captures.toml").read_text()
    (folder / "captures.toml").write_text(text + '[exclude]\n"stress birefringence" = "no load"\n')
    setup = studies.Setup(captures=str(folder), free=["source.power"])
    record, model, found = loop.begin(setup, tmp_path / "study")
    result = loop.examine(record, model, setup, found, advised=False)
    assert "dichroism" in result.ambiguous or result.missing == "dichroism", result.sentence


# -- what an effect frees --------------------------------------------------------------------------------------------
def names_of(model, effect, held=()):
    return [v.name for v in studies.effect_variables(model, model.scene.registry.find_effect(effect), held)]


def test_effects_free_what_the_captures_can_show(mitsuba, tmp_path):
    """One film turned, one at 20 deg all the time, one on the table: the scale of a dial that never turned would be an
    offset, its wobble a transmittance."""
    settings = {"analyzer.angle": ANGLES, "polarizer.angle": 20.0 + 0 * ANGLES}
    folder = written(tmp_path / "set", settings, 3.0 * malus(ANGLES, 20.0))
    model, variables, _, _ = opened(folder, ["source.power", "analyzer.offset"])
    assert names_of(model, "polarizer misalignment") == ["analyzer.offset", "polarizer.offset"]
    assert names_of(model, "polarizer misalignment", variables) == ["polarizer.offset"]
    assert names_of(model, "servo scale") == ["analyzer.scale"]
    assert names_of(model, "analyzer wobble") == ["analyzer.wobble_c", "analyzer.wobble_s"]
    assert names_of(model, "servo backlash") == [] == names_of(model, "source drift")
    shared = studies.effect_variables(model, model.scene.registry.find_effect("extinction leak"))
    assert [(v.name, v.keys) for v in shared] == [
        ("polarizer_film.leak", ("analyzer.leak", "polarizer.leak"))  # of films in the beam
    ]


@pytest.mark.slow
@pytest.mark.parametrize("free", ["polarizer.offset", "middle.offset", "analyzer.offset"])
def test_one_free_dial_does_not_remove_an_effect(mitsuba, tmp_path, free):
    """Three films, the middle one 1 deg off: with any one offset in the base, the others are tested and added."""
    a, m = np.tile(np.arange(0.0, 180.0, 10.0), 4), np.repeat([20.0, 50.0, 80.0, 130.0], 18)
    light = 6.0 * 2 * malus(a, m + 1.0) * malus(m + 1.0, 0.0)
    folder = written(tmp_path / "set", {"analyzer.angle": a, "middle.angle": m, "middle.inserted": 1 + 0 * a}, light)
    setup = studies.Setup(captures=str(folder), free=["source.power", free])
    record, model, fit = loop.begin(setup, tmp_path / "study")
    effect = model.scene.registry.find_effect("polarizer misalignment")
    result = diagnose(
        model, fit, [effect], lambda e: studies.effect_variables(model, e), refit=calibrate.fit, fitted=fit.frames
    )
    row = result.row(effect.name)
    left = {"analyzer.offset", "middle.offset", "polarizer.offset"} - {free}
    assert not result.not_tested and set(row.variables) == left
    if free == "middle.offset":  # which explains all of it by itself
        assert fit.chi2_per_dof < 1 + 5 * np.sqrt(2 / fit.dof)
        return
    assert row.fall > 1000
    fit, _ = loop.extend(record, model, setup, fit, effect)
    assert fit.chi2_per_dof < 1 + 5 * np.sqrt(2 / fit.dof) and len(fit.variables) == 4
    known = {k.text: k for k in fit.gauges.known}
    assert fit.gauges.count == 3 and len(known) == 2  # a power and two angles between three films
    text = next(t for t in known if "middle.offset" in t)
    sign = 1.0 if text.startswith("middle.offset") else -1.0
    assert known[text].value == pytest.approx(sign, abs=5 * known[text].sd) and known[text].sd < 0.05
    again = loop.restore(record, model)
    assert [v.name for v in again.variables] == [v.name for v in fit.variables]
    assert again.estimate == pytest.approx(fit.estimate, abs=1e-3)
    with pytest.raises(Underdetermined, match="servo backlash.*no frame can show it.*approach"):
        loop.extend(record, model, setup, fit, model.scene.registry.find_effect("servo backlash"))
