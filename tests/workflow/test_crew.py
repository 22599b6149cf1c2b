"""Several processes make the images of a model: who makes which frame; the numbers are those of one process."""

import os
import signal
import subprocess
import sys
import time
from operator import methodcaller
from types import SimpleNamespace

import numpy as np
import pytest

from optics.captures import capture_set
from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.fit import crew as crews
from optics.fit.crew import Crew
from optics.fit.descent import normal_equations
from optics.scene.parameter import Values
from optics.study import cells as cells_of_studies
from optics.study.setup import Setup, open_model, variables_of_base

DEADLINE = 120  # s for processes to begin, which take five by themselves


@pytest.fixture
def shared_out():
    """f(presses, count) -> a crew that begins no process."""

    def make(presses, count):
        found = Crew.__new__(Crew)
        found.presses, found.count, found.charge = list(presses), count, {}
        return found

    return make


def test_presses_stay_whole_and_held_out_ones_do_not_unbalance(shared_out):
    """Of 14 presses every fourth is held out, the second first: dealt in turn, one process would have seven of the
    fitted and the other three."""
    crew = shared_out([i // 2 for i in range(28)], 2)
    held = [i for i in range(28) if i // 2 % 4 == 1]
    fitted = [i for i in range(28) if i not in held]
    crew.share(fitted)
    assert sorted(crew.charge) == fitted
    assert sum(crew.charge[f] for f in fitted) == len(fitted) / 2
    assert all(crew.charge[f] == crew.charge[f ^ 1] for f in fitted)  # both frames of a press
    before = dict(crew.charge)
    crew.share(held)
    assert sum(crew.charge[f] for f in held) == len(held) / 2
    assert all(crew.charge[f] == k for f, k in before.items())


def test_frames_of_one_press_are_shared_where_there_are_too_few_presses(shared_out):
    crew = shared_out([0] * 6 + [1], 2)
    crew.share(range(6))
    assert sum(crew.charge.values()) == 3
    crew.share(range(7))
    assert len(crew.charge) == 7


def test_no_frames_are_nobodys_work(monkeypatch):
    """Also where one process keeps all cores busy, which then asks whether presses would be shared: there are none."""
    model, hands = SimpleNamespace(presses=[0, 0], recipe=None, renderer=SimpleNamespace(at_once=True)), crews.Hands()
    monkeypatch.setattr(crews, "_shares", lambda model: False)
    hands.spent, hands.worked = 1.0, 1.0 + crews.cores()
    assert list(hands.work(model, [], None)) == []


def test_the_environment_says_how_many(monkeypatch):
    monkeypatch.setattr(crews, "_allowed", 1)
    monkeypatch.setattr(crews, "free_memory", lambda: 2.5 * crews.MEMORY)
    monkeypatch.setenv(crews.VARIABLE, "2")
    crews.use_processes()
    assert crews.allowed() == 2
    crews.use_processes(8)
    assert crews.allowed() == 3  # there is memory for this process and two more
    for bad in ("many", "0", "-1", "1.5"):
        monkeypatch.setenv(crews.VARIABLE, bad)
        with pytest.raises(ValueError, match="OPTICS_PROCESSES"):
            crews.use_processes()
    with pytest.raises(ValueError, match="count = 0"):
        crews.use_processes(0)


def test_a_graphics_processor_has_one_process(mitsuba, monkeypatch):
    monkeypatch.setattr(crews, "_allowed", 3)
    monkeypatch.setattr(crews, "free_memory", lambda: 9 * crews.MEMORY)
    assert crews.allowed() == 3
    monkeypatch.setattr(mitsuba, "variant", lambda: "cuda_ad_spectral_polarized")
    assert crews.allowed() == 1


@pytest.mark.parametrize(
    ("presses", "processes", "shared"),
    [([0] * 6, 2, True), ([0, 1], 2, False), ([0, 0, 1, 1, 2, 2], 2, True), ([0, 0, 1, 1, 2, 2], 3, False)],
)
def test_processes_share_frames_of_a_press_where_presses_do_not_go_round(presses, processes, shared):
    assert crews._shared(presses, range(len(presses)), processes) is shared


@pytest.mark.parametrize(
    ("busy", "presses", "begins"), [(1.9, [0, 0], False), (1.0, [0, 0], True), (1.9, [0, 1], True)]
)
def test_who_keeps_all_cores_busy_alone_shares_no_press(monkeypatch, busy, presses, begins):
    """Two processes would both move the geometry of a press, which takes as long in each."""
    begun = []
    monkeypatch.setattr(crews, "allowed", lambda: 2)
    monkeypatch.setattr(crews, "cores", lambda: 2)
    monkeypatch.setattr(crews, "_shares", lambda model: True)
    monkeypatch.setattr(crews, "Crew", lambda *given: begun.append(given) or SimpleNamespace(ready=lambda model: False))

    def hands():
        found = crews.Hands()
        found.spent, found.worked = 2 * crews.START, busy * 2 * crews.START
        return found

    model = SimpleNamespace(recipe=lambda: None, presses=presses, renderer=SimpleNamespace(at_once=False))
    assert hands()._crew(model, [0, 1]) is None
    assert bool(begun) is begins
    begun.clear()
    model.renderer.at_once = True  # then one makes all frames of a press at once
    assert hands()._crew(model, [0, 1]) is None
    assert bool(begun) is (presses == [0, 1])


@pytest.fixture(scope="module")
def setup(tmp_path_factory, mitsuba):
    """Three presses of one to three frames, each frame under two of the six LEDs."""
    rng = np.random.default_rng(5)
    frames = []
    for press, count in ((0, 2), (1, 3), (2, 1)):
        for k in range(count):
            lit = {f"led_{n}.power": float(n % 3 == k) for n in range(1, 7)}
            where = {"gel.press_x": press - 1.0, "gel.press_depth": 0.3}
            image = np.round(rng.uniform(40, 200, (24, 32, 3))).astype(np.float32)
            frames.append(Frame(f"f{press}{k}", image, None, f"p{press}", {**lit, **where}))
    noise = Noise(system_gain=0.2, dark_noise=2.0, black_level=10.0, saturation=4095.0, prnu=0.0)
    folder = tmp_path_factory.mktemp("crew") / "captures"
    capture_set.write(Captures(folder, "gelsight", frames, noise=noise), folder, bits=16)
    return Setup(str(folder), free=["led_*.mu", "membrane.reflectance.value"], per_group=["gel.press_x"])


@pytest.fixture
def at_work(monkeypatch):
    """f(model): the model with another process at work."""
    began = []

    def begin(model):
        monkeypatch.setattr(crews, "START", -1.0)
        monkeypatch.setattr(crews, "_allowed", 2)
        end = time.monotonic() + DEADLINE
        while model.hands._crew(model, range(len(model.frames))) is None:
            assert not model.hands.alone and time.monotonic() < end
            time.sleep(0.05)
        began.append(model)
        return model

    yield begin
    for model in began:
        model.hands.give_up(model)


@pytest.mark.slow
def test_the_numbers_are_those_of_one_process(setup, at_work):
    """Normal equations, secants, predictions; a process that dies leaves its frames to the other. Tolerances are of
    single precision: threads of another number sum in another order, and a secant divides a difference."""
    one, two = open_model(setup), at_work(open_model(setup))
    one.hands.alone = True  # whatever `at_work` allows
    frames = list(range(len(one.frames)))
    variables = variables_of_base(one, setup, frames)
    values = Values({"led_2.mu": 1.7}, {0: {"gel.press_x": -0.9}, 1: {"gel.press_x": -0.9}})
    whole, shared = (normal_equations(model, variables, values, frames) for model in (one, two))
    assert set(two.hands.crew.charge.values()) == {0, 1}
    assert shared.chi2 == pytest.approx(whole.chi2, rel=1e-9)
    assert shared.a == pytest.approx(whole.a, rel=1e-6, abs=1e-9 * np.abs(whole.a).max())
    for (own, _, _), (other, _, _) in zip(whole.rows, shared.rows):
        assert own.tolist() == other.tolist()
    step = {v.name: 0.1 for v in variables[:2]}
    secants = [list(m.derivatives(values, variables[:2], frames[2:5], secant=step)) for m in (one, two)]
    for (image, own), (other, beside) in zip(*secants):
        assert np.allclose(image, other, rtol=1e-6) and own.keys() == beside.keys()
        assert all(np.allclose(own[name], beside[name], rtol=1e-4, atol=1e-4) for name in own)
    with two.where_used():
        assert all(np.allclose(a, b, rtol=1e-6) for a, b in zip(one.predict(values), two.predict(values)))

    os.kill(two.hands.crew.others[0].process.pid, signal.SIGKILL)
    assert all(np.allclose(a, b, rtol=1e-6) for a, b in zip(one.predict(values), two.predict(values)))
    assert two.hands.alone and two.hands.crew is None
    assert two.companions == one.companions


@pytest.mark.slow
def test_jobs_of_one_press_are_shared(setup, at_work, monkeypatch):
    """Whichever process takes them; what one leaves behind that dies is done by the other. A mistake is raised."""
    model, press = at_work(open_model(setup)), [0, 1]
    made = []
    make = crews.Helper.make
    monkeypatch.setattr(crews.Helper, "make", lambda *given: made.append(given) or make(*given))
    values = [Values({"led_2.mu": 1.2 + 0.1 * k}) for k in range(8)]
    alone = [model.predict(own, press) for own in values]
    assert not made and model.hands.shares_jobs(model, press) and not model.hands.shares_jobs(model, range(6))

    def check(found):
        assert sorted(found) == list(range(8))
        for k, images in found.items():
            assert all(np.allclose(a, b, rtol=1e-6) for a, b in zip(images, alone[k]))

    jobs = [methodcaller("predict", own, press) for own in values]
    check(dict(model.each(press, jobs)))
    assert 0 < len(made) < 8
    with pytest.raises(ValueError, match="gel.press_depth = 'deep' is not a number"):
        dict(model.each(press, [methodcaller("predict", Values({}, {0: {"gel.press_depth": "deep"}}), press)] * 2))
    assert model.hands.crew is not None and not model.hands.alone
    found, crew = {}, model.hands.crew
    for k, images in model.each(press, jobs):
        if not found:
            os.kill(crew.others[0].process.pid, signal.SIGKILL)
        found[k] = images
    check(found)
    assert model.hands.alone and model.hands.crew is None


@pytest.mark.slow
def test_a_model_in_cells_is_opened_again(setup, at_work):
    whole = open_model(setup)
    coarse, _ = cells_of_studies.open_in_cells(setup, cells_of_studies.Cells(whole, 2))
    alone = coarse.predict(Values())
    shared = at_work(coarse).predict(Values())
    assert shared[0].shape == (12, 16, 3) and all(np.allclose(a, b, rtol=1e-6) for a, b in zip(alone, shared))


@pytest.mark.slow
def test_a_mistake_in_another_process_is_raised_here(setup, at_work):
    model = at_work(open_model(setup))
    model.predict(Values())
    other = next(frame for frame, process in model.hands.crew.charge.items() if process == 1)
    with pytest.raises(ValueError, match="gel.press_depth = 'deep' is not a number"):
        model.predict(Values({}, {other: {"gel.press_depth": "deep"}}))


@pytest.mark.slow
def test_a_script_without_a_guard_stays_alone(setup, tmp_path):
    """Nothing begins a process unless it is asked for: a script would run again in it."""
    script = tmp_path / "script.py"
    script.write_text(
        "from optics.fit import crew\n"
        "from optics.study.setup import Setup, open_model\n"
        "from optics.scene.parameter import Values\n"
        "crew.START = -1.0\n"
        f"model = open_model(Setup({setup.captures!r}))\n"
        "model.predict(Values()); model.predict(Values())\n"
        "print('made', model.hands.crew)\n"
    )
    found = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300)
    assert found.stdout == "made None\n", found.stderr
