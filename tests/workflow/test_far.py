"""Input that is wrong but can be rendered: a calibration reports it where no effect can explain it."""

import csv
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof.makers import bench as jones
from optics.scene.parameter import Parameter, Values, Variable
from optics.study import checks, loop

NOISE = Noise(system_gain=0.05, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)


@pytest.mark.parametrize("wrong", [False, True])
def test_angles_in_radians_are_reported_and_no_effect_is_claimed(wrong, tmp_path):
    folder = jones.write(
        tmp_path / "captures",
        jones.Truth(photodiode=jones.Photodiode(gain=2.2)),
        jones.malus_sweep(120, (0.0, 60.0)),
        NOISE,
        3,
    )
    if wrong:
        file = next(folder.glob("*.csv"))
        head, *rows = csv.reader(file.read_text().splitlines())
        turned = [
            [f"{np.radians(float(x)):.6f}" if k.endswith(".angle") else x for k, x in zip(head, row)] for row in rows
        ]
        file.write_text("\n".join(",".join(row) for row in [head, *turned]) + "\n")
    _, _, fit = loop.begin(loop.Setup(captures=str(folder)), tmp_path / "study")
    assert any("too far for a missing effect: check units" in w for w in fit.warnings) == wrong


def test_a_value_far_from_its_prior_is_named():
    depth = Parameter("press_depth", "mm", 0.2, (0.0, 1.0), plausible=0.1)
    variables = [Variable(f"gel.press_depth[{i}]", ("gel.press_depth",), depth, (i,), (0.2, 0.05)) for i in range(3)]
    model = SimpleNamespace(at=lambda values, i: {"gel.press_depth": 0.2, **values.frame.get(i, {})}, drives=())
    near = SimpleNamespace(rms=1.0, signal=100.0)

    def told(*depths):
        values = Values(frame={i: {"gel.press_depth": d} for i, d in enumerate(depths)})
        fit = SimpleNamespace(variables=variables, values=values, estimate=depths, sd=[0.01] * len(depths))
        return checks.after_calibration(model, fit, near)

    assert told(0.2, 0.34, 0.06) == []
    assert (
        "gel.press_depth[1]: calibrated to more than 3 sd" in told(0.2, 0.36, 0.2)[0]
        and "0.36 mm for 0.2 +- 0.05" in told(0.2, 0.36, 0.2)[0]
    )


@pytest.mark.parametrize(
    "power, sd, refused", [(1.0, 0.3, True), (1.0, 10.0, False), (1.0, None, False), (20.0, 0.3, False)]
)
def test_light_that_no_power_may_make_up_for_is_refused_at_once(power, sd, refused):
    """Frames note powers of 1 where the scene means 40: a calibration would run for minutes to say so."""
    lamp = Parameter("power", "1", 1.0, (0.0, 1e6), plausible=0.1, role="power", linear=True)
    prior = None if sd is None else (1.0, sd)
    variables = [Variable("lamp.power", ("lamp.power",), lamp, None, prior)]
    light = np.linspace(1, 20, 12).reshape(3, 4, 1)
    model = SimpleNamespace(
        captures=SimpleNamespace(table=None, folder="captures"),
        scene=SimpleNamespace(values=lambda: {"lamp.power": 40.0}),
        noise=NOISE,
        frames=[SimpleNamespace(image=64 + 40 * light, name=f"f{i}") for i in range(4)],
        linear_in=lambda v: True,
        family=lambda key: "light",
        usable=lambda i: np.ones((3, 4, 1), bool),
        predict=lambda values, frames: [64 + values.common["lamp.power"] * light for _ in frames],
        drives=(),
        at=lambda values, i: values.common,
        base={"lamp.power": 1.0},
    )
    values = Values({"lamp.power": power})
    if not refused:
        checks.require_light(model, values, variables, range(4))
        return
    with pytest.raises(ValueError) as raised:
        checks.require_light(model, values, variables, range(4))
    told = str(raised.value)
    assert "sends 0.025 times the light" in told and "1 for 1 +- 0.3 (the scene has 40)" in told
    assert "--prior 'lamp.power=40+-12'" in told


def test_a_light_that_ran_away_is_named_for_what_it_is():
    """A face of 10 mm: from 12 mm to 45 mm a light acts as a collimated one; to 20 mm, or where nobody said where it
    stood, it does not, or nobody knows."""
    z = Parameter("z", "mm", -12.0, (-500.0, 0.0), plausible=1.0)

    def told(place, prior):
        keys = {
            "light x": "led.x",
            "light y": "led.y",
            "light z": "led.z",
            "width": "gel.width",
            "length": "gel.length",
        }
        scene = SimpleNamespace(
            leds={"led": None},
            gel=SimpleNamespace(name="gel"),
            key=lambda part, role: keys[role],
            places_of=lambda now: {"led": [now[f"led.{axis}"] for axis in "xyz"]},
        )
        start = {"led.x": 0.0, "led.y": 0.0, "led.z": -12.0, "gel.width": 10.0, "gel.length": 8.0}
        model = SimpleNamespace(scene=scene, at=lambda values, i: {**start, **values.common}, base=start)
        fit = SimpleNamespace(
            variables=[Variable("led.z", ("led.z",), z, None, prior)], values=Values({"led.z": place})
        )
        return checks._far_lights(model, fit)

    (text,) = told(-45.0, (-12.0, 2.0))
    assert text.startswith(
        "led moved from 12 mm to 45 mm, where its light is practically collimated over the 10 mm of the face"
    )
    assert told(-20.0, (-12.0, 2.0)) == told(-45.0, None) == told(-45.0, (-12.0, 20.0)) == []


@pytest.mark.parametrize(
    "frames, key",
    [
        ([{"led_1.power": 1.0}, {"led_2.power": 1.0}], "led_1.power, led_2.power"),
        ([{"led_1.power": 1.0, "led_2.power": 0.0}, {"led_2.power": 1.0}], "led_1.power"),
        ([{"led_1.power": 1.0}, {"led_1.power": 0.5}], None),
        ([{}, {}], None),
    ],
)
def test_lights_named_in_some_frames_only(frames, key):
    model = SimpleNamespace(
        frames=[SimpleNamespace(name=f"f{i}", parameters=p, readings={}) for i, p in enumerate(frames)],
        scene=SimpleNamespace(powers={f"led_{k}": f"led_{k}.power" for k in (1, 2, 3)}),
        base={f"led_{k}.power": 1.0 for k in (1, 2, 3)},
    )
    texts = checks._unnamed(model)
    assert (key is None) == (texts == [])
    assert key is None or texts[0].startswith(f"{key}: set in some frames and not in others") and "write 0" in texts[0]


@pytest.mark.parametrize("x, warned", [(9.3, False), (35.0, True), (-9.5, True)])
def test_a_press_beyond_the_gel_is_named(x, warned):
    gel = SimpleNamespace(name="gel")
    model = SimpleNamespace(
        scene=SimpleNamespace(gel=gel, key=lambda part, role: f"{part}.{role.replace(' ', '_')}"),
        base={"gel.width": 18.8, "gel.length": 14.0},
        frames=[SimpleNamespace(name="a", parameters={}), SimpleNamespace(name="b", parameters={"gel.press_x": x})],
    )
    texts = checks._astray(model)
    assert bool(texts) == warned
    assert not warned or f"frame 'b': gel.press_x = {x:g} mm lies beyond the gel, which is 18.8 mm wide" in texts[0]


@pytest.mark.parametrize(
    "groups, held, asked, warned",
    [(3, [], None, True), (1, [], None, False), (4, [1], None, False), (3, [], [], False)],
)
def test_a_set_without_held_out_frames_is_reported(groups, held, asked, warned):
    frames = [SimpleNamespace(name=f"f{i}", group=f"g{i}") for i in range(groups)]
    model = SimpleNamespace(captures=SimpleNamespace(frames=frames))
    texts = checks._unverified(model, loop.Setup(captures="c", held_out=asked), held)
    assert bool(texts) == warned and (not warned or texts[0].startswith("3 groups of frames: none is held out"))


def test_an_effect_that_does_not_predict_is_reported_as_no_cause(monkeypatch):
    """Held-out frames get worse with the effect, although the fitted ones get better."""
    steps = [{"held_out": {"chi2_per_dof": 1.5}}]
    study = SimpleNamespace(steps=steps, note_inputs=lambda hashes: None, alone=nullcontext)

    def record(*_):
        study.steps.append({"held_out": {"chi2_per_dof": 1.6}})

    monkeypatch.setattr(loop, "split", lambda model, setup: ([0], [1]))
    row = Variable("row", ("camera.row",), Parameter("row", "1", 0.0, (-1.0, 1.0), plausible=0.1))
    monkeypatch.setattr(loop, "effect_variables", lambda model, effect, held=(): [row])
    monkeypatch.setattr(loop, "write_step", record)
    monkeypatch.setattr(loop.calibrate, "fit_over_starts", lambda *_, **__: SimpleNamespace(warnings=[]))
    captures = SimpleNamespace(absent=[], exclude={}, folder="captures", table=object())
    scene = SimpleNamespace(can_express=lambda effect: True, keys_of=lambda effect: {})
    model = SimpleNamespace(scene=scene, captures=captures, dialled=False, frames=[], where_used=nullcontext)
    effect = SimpleNamespace(name="row curve", file="", requires=(), part="camera")
    before = SimpleNamespace(variables=[], values=Values())
    found, _ = loop.extend(study, model, SimpleNamespace(robust=False), before, effect, Values())
    assert found.warnings == [
        "held-out chi2/dof rises from 1.5 to 1.6 with row curve: it does not predict the "
        "held-out frames, so it is not the cause, or not the only one"
    ]


@pytest.mark.parametrize("size, warned", [((30, 48), True), ((36, 48), False), ((48, 36), True)])
def test_cut_and_turned_images_are_noticed(size, warned, tmp_path):
    image = np.random.default_rng(1).uniform(50, 60, (*size, 3)).astype(np.float32)
    frames = [capture_files.Frame("a", image, file="frames/a.png", parameters={"led_1.power": 1.0})]
    folder = capture_files.write(
        capture_files.Captures(tmp_path, "gelsight", frames, noise=Noise(0.05, 1.0, 8.0, 255.0, 0.0)), tmp_path / "set"
    )
    model = loop.open_model(loop.Setup(captures=str(folder)))
    assert any("the scene's own are 320 x 240" in w for w in checks.of_captures(model)) == warned


def test_a_gel_that_nothing_presses_has_no_press_to_solve_for(tmp_path):
    image = np.random.default_rng(1).uniform(50, 60, (240, 320, 3)).astype(np.float32)
    frames = [
        capture_files.Frame(
            n, image, file=f"frames/{n}.png", group=n, parameters={"led_1.power": 1.0, "gel.press_depth": depth}
        )
        for n, depth in (("rest", 0.0), ("pressed", 0.4))
    ]
    folder = capture_files.write(
        capture_files.Captures(tmp_path, "gelsight", frames, noise=Noise(0.05, 1.0, 8.0, 255.0, 0.0)), tmp_path / "set"
    )
    setup = loop.Setup(captures=str(folder))
    names = [v.name for v in loop.variables_of_base(loop.open_model(setup), setup, [0, 1])]
    assert "gel.press_depth[pressed]" in names and not any("[rest]" in n for n in names)
