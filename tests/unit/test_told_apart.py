"""What tells explanations apart: the form of an image, what is known of dials, predictions of blocks left out."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis import (
    competition,
    diagnose,
    dials_as_rival,
    explanations,
    findings,
    held_out,
    laws,
    refit,
    remarks,
    score,
    search,
    shared_noise,
)
from optics.diagnosis import statistics as st
from optics.diagnosis.correlation import NOTICED, Correlation, Readings
from optics.diagnosis.result import Law
from optics.diagnosis.session import Frames
from optics.diagnosis.thresholds import TOLD
from optics.fit.scene_model import SceneModel
from optics.scene import registry
from optics.scene.parameter import Parameter, Values, Variable


def form(name, information, fall):
    cone = st.Cone(100 * np.array(information), [0, 0])
    return name, np.arange(2), cone, fall, np.zeros(2)


@pytest.mark.parametrize("fall, expected", [(566.9, "tangent"), (600.0, "secant")])
def test_steps_of_two_offsets_that_bend_apart_show_no_common_rotation(fall, expected):
    """564.6 by the slopes of the analyser's offset and the polarizer's, of which only the difference shows."""
    both = [
        form("tangent", [[1, -1], [-1, 1]], 564.6),
        form("secant", [[1, -0.98], [-0.98, 1]], fall),
    ]
    assert score._best_form(SimpleNamespace(plausible=np.ones(2)), both)[0] == expected


def test_where_slopes_show_nothing_a_finite_step_decides():
    both = [form("tangent", [[0, 0], [0, 0]], 0.0), form("secant", [[1, 0], [0, 1]], 5.0)]
    assert score._best_form(SimpleNamespace(plausible=np.ones(2)), both)[0] == "secant"


@pytest.mark.parametrize("weight", [1.0, 50.0])
def test_what_is_known_of_dials_counts_whole_in_a_fall_and_once(monkeypatch, weight):
    """22 of chi2, 20 of them by which dials need not be off: noise that images share divides the other 2 alone. Where a
    fit that misses images had what is known count many times, it counts once all the same."""
    monkeypatch.setattr(competition, "design_effect", lambda *a: 10.0)
    best, without = (SimpleNamespace(fit=SimpleNamespace(values=v)) for v in (1.0, 21.0))
    outcome = SimpleNamespace(best=best, without=lambda *a: without, own_fall=lambda *a: 2.0 + 20.0 * weight)
    case = SimpleNamespace(
        lamp=None, evidence=SimpleNamespace(is_table=False), prior_chi2=lambda v: weight * v, known_chi2=lambda v: v
    )
    assert competition.fall_over_noise(case, outcome, "a") == pytest.approx(20.2)


@pytest.mark.parametrize("ahead, told", [(-5.0, True), (5.0, True), (15.0, False)])
def test_a_prediction_counts_against_a_lead_and_is_no_veto(ahead, told):
    """A lead of 22.5, of which 10.8 are needed, over one that predicts blocks left out better by `ahead`."""
    best = SimpleNamespace(keys={1}, ahead=0.0)
    other = SimpleNamespace(keys={2}, ahead=-ahead, names=frozenset("b"), members=["b"])
    outcome = SimpleNamespace(leader=best, leads={other.names: (22.5, 10.8)})
    assert competition._ruled_out(None, outcome, best, other) is told


@pytest.mark.parametrize(
    "gain, cost, adds", [(0.0, 4.4, False), (6.0, 9.0, False), (7.0, 9.0, True), (9.0, 30.0, False)]
)
def test_what_adds_no_more_than_chance_to_shared_noise_is_that_noise(gain, cost, adds):
    """One strength: chance brings 6.6 once in a hundred times. A misalignment of 0 explains a lamp that wanders."""
    members = [SimpleNamespace(cone=SimpleNamespace(live=[0]))]
    trial = SimpleNamespace(deviance=100.0 - gain, cost=cost, members=members)
    assert competition._adds_to_noise(trial, SimpleNamespace(deviance=100.0)) is adds


@pytest.mark.parametrize(
    "fit, cost, needed",
    [
        (0.0, 13.7, competition.NO_TIE),  # the same readings, by a less plausible pair: no claim
        (0.0, 25.0, competition.NO_TIE),  # 180 degrees against 1: a claim
        (12.0, 1.0, competition.SURE),  # the data tell
    ],
)
def test_plausibility_alone_must_lead_by_more(monkeypatch, fit, cost, needed):
    """An eccentric dial, and a misalignment with a wrong scale, that read the same at the two places of a dial."""
    variable = SimpleNamespace(keys=("eccentric",), frames=None)
    subject = SimpleNamespace(variables=[variable])
    best = SimpleNamespace(keys={("eccentric", None)}, deviance=100.0, cost=20.0, gain=0.0, members=["eccentric"])
    pair = SimpleNamespace(keys={("a", None)}, deviance=100.0 + fit, cost=20.0 + cost, gain=0.0, members=["a", "b"])
    lead = pair.deviance + pair.cost - best.deviance - best.cost
    monkeypatch.setattr(competition, "_lead", lambda *a: (lead, competition.TOLD))
    outcome = SimpleNamespace(best=best, trials=[best, pair])
    assert competition._without(None, outcome, subject) == (pair, lead, needed)


@pytest.mark.parametrize("strength, cost", [(0.84, 20.3), (0.02, 1.2)])
def test_what_it_costs_to_be_far_from_plausible(monkeypatch, strength, cost):
    """A glare of 42 plausible sizes, 3 ln(1 + 42^2/2), or of one."""
    effect = SimpleNamespace(name="glare", scope="scene")
    glare = SimpleNamespace(effect=effect, variables=["glare"], start=np.zeros(1), plausible=np.array([0.02]))
    fit, case = SimpleNamespace(values=None), SimpleNamespace(model=None)
    monkeypatch.setattr(explanations, "value_of", lambda *a: strength)
    assert explanations.farness(case, [glare], fit) == pytest.approx(cost, abs=0.05)


@pytest.mark.parametrize(
    "deviance, lead, larger",
    [
        (88.0, 0.0, ["a", "b"]),  # 12 for 9.1: below what is significant among many effects, and yet likelier
        (92.0, 0.0, []),  # 8 for 9.1
        (88.0, 8.0, []),  # ruled out by another
    ],
)
def test_a_set_names_what_is_likelier_than_its_simplest_member(deviance, lead, larger):
    """An effect, and the same with a second one whose fall is not significant: both may be the truth."""

    def trial(names, deviance, cost):
        keys = {(name, None) for name in names}
        own = {"names": frozenset(names), "keys": keys, "members": list(names), "ahead": 0.0}
        return SimpleNamespace(deviance=deviance, cost=cost, after=150.0, **own)

    base, one, both, other = (
        trial("", 150.0, 0.0),
        trial("a", 100.0, 9.9),
        trial("ab", deviance, 19.0),
        trial("c", 99, 9),
    )
    leads = {one.names: (0.0, 5.9), both.names: (lead, 5.9)}
    outcome = explanations.Outcome(other, one, [one, other], [other, both, one, base], 1.0, None, leads)
    assert [c for t in competition._larger(None, outcome) for c in t.members] == larger


def test_all_sets_are_weighed_by_one_noise(monkeypatch):
    """Where noise that neighbours share explains what seemed to be noise of twice the size, sets too many to be asked
    for shared noise of their own are weighed by that size too: they came out ahead, at half of their chi2."""

    def trial(n):
        names, after = frozenset(f"{n}ab" if n else ""), 100.0 + n
        return SimpleNamespace(
            names=names,
            members=[*names],
            keys={(name, None) for name in names},
            fall=200.0 - after,
            after=after,
            cost=1.0,
            gain=0.0,
            readings=None,
        )

    trials = [trial(n) for n in range(competition.CONTENDERS + 20)]
    readings = {
        "correlation": lambda: SimpleNamespace(scale=1.0),
        "noise": lambda scale: SimpleNamespace(gain=20.0),
    }
    monkeypatch.setattr(competition, "scale_of", lambda *_: 2.0)
    monkeypatch.setattr(competition, "bound_wander", lambda *_: None)

    def readings_of(_, t):
        return SimpleNamespace(reached=t.after, standing=lambda scale: t.after / scale - 20.0, **readings)

    monkeypatch.setattr(competition, "readings_about", readings_of)
    monkeypatch.setattr(competition, "wander_of", lambda *_: 0.0)
    monkeypatch.setattr(competition, "_lead", lambda *_: (0.0, 0.0))
    monkeypatch.setattr(competition, "_with_survivors", lambda _, outcome: outcome)
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=True), session=SimpleNamespace(most=np.inf))
    outcome = competition.compete(case, trials)
    assert outcome.leader.after == 101.0
    assert {t.deviance - t.after for t in outcome.trials} == {0.0, -20.0}


@pytest.mark.parametrize(
    "scale, fall, cost, ruled_out",
    [
        (10.0, 3.05e6, 37.0, False),  # leaves less by itself, at less cost
        (10.0, 3.05e6, 97.0, True),  # the same at a higher cost
        (10.0, 2.90e6, 37.0, True),  # leaves more
        (1.0, 3.05e6, 37.0, True),  # where noise alone is left, what a lamp did is known
    ],
)
def test_a_lamp_rules_out_nothing_that_leaves_less_where_misfit_is_left(monkeypatch, scale, fall, cost, ruled_out):
    """Beside the best, whose misfit a wander of the lamp takes up, another is behind by 1000 in deviance."""

    def trial(name, deviance, gain, fall, cost):
        fit = SimpleNamespace(values=0.0)
        return SimpleNamespace(
            keys={name},
            deviance=deviance,
            gain=gain,
            price=0.0,
            fall=fall,
            cost=cost,
            fit=fit,
            by_frame=False,
            complete=False,
            bare=False,
            left=lambda dof: 0.0,
        )

    best, other = trial("a", 1e4, 9e3, 2.97e6, 47.0), trial("b", 1.1e4, 2e3, fall, cost)
    evidence = SimpleNamespace(is_table=False, normal=SimpleNamespace(count=20000), projected=SimpleNamespace(rank=20))
    case = SimpleNamespace(lamp=None, evidence=evidence, prior_chi2=lambda values: 0.0, known_chi2=lambda values: 0.0)
    monkeypatch.setattr(competition, "design_effect", lambda *a: 1.0)
    lead, needed = competition._lead(case, SimpleNamespace(scale=scale), best, other)
    assert (lead > needed) is ruled_out


def test_what_a_lamp_costs_is_judged_by_frames_and_not_by_pixels(monkeypatch):
    """Without effects a lamp would have to swing by 18 %, which costs 200; beside a polarized detector by 2 %, which
    costs 10. Pixels that miss alike, as 18 times the noise, make no less of that."""

    def trial(deviance, price, cost):
        own = {"deviance": deviance, "price": price, "cost": cost, "fall": 0.0, "by_frame": False, "complete": True}
        return SimpleNamespace(**own, keys={price}, gain=1e5, fit=SimpleNamespace(values=0.0))

    best, other = trial(1010.0, 10.0, 32.0), trial(1218.0, 200.0, 0.0)
    case = SimpleNamespace(lamp=None, evidence=SimpleNamespace(is_table=False))
    case.prior_chi2 = case.known_chi2 = lambda values: 0.0
    monkeypatch.setattr(competition, "design_effect", lambda *a: 18.0)
    other.gain = 2e5
    lead, needed = competition._lead(case, SimpleNamespace(scale=1.0), best, other)
    assert lead == pytest.approx(190.0 + 18.0 / 18.0 - 32.0) and lead > needed


@pytest.mark.parametrize("bare, brings, ruled_out", [(True, 400.0, False), (False, 400.0, True), (True, 0.001, True)])
def test_what_leaves_an_unnoticed_lamp_is_a_rival_of_gains_of_each_frame(monkeypatch, bare, brings, ruled_out):
    """A gain of each frame leads a polarized detector by 3 in score; without the lamp that wanders beside the detector,
    by 1000. A lamp that nobody notices is noise, one that swings is the same as those gains. If the detector explains
    nothing beside that lamp, it is no rival, whatever the lamp does."""

    def trial(name, deviance, gain, by_frame):
        values = {"keys": {name}, "deviance": deviance, "gain": gain, "by_frame": by_frame, "fall": 5000.0 - deviance}
        values["members"] = [SimpleNamespace(cone=SimpleNamespace(live=[0]))]
        fit = SimpleNamespace(values=0.0)
        return SimpleNamespace(**values, price=0.0, cost=20.0, complete=True, bare=bare, fit=fit)

    best, other = trial("gains", 1000.0, 0.0, True), trial("detector", 1003.0, 997.0, False)
    evidence = SimpleNamespace(is_table=False)
    case = SimpleNamespace(lamp=None, evidence=evidence, prior_chi2=lambda values: 0.0, known_chi2=lambda values: 0.0)
    monkeypatch.setattr(competition, "design_effect", lambda *a: 1.0)
    outcome = SimpleNamespace(scale=1.0, base=SimpleNamespace(deviance=1003.0 + brings))
    lead, needed = competition._lead(case, outcome, best, other)
    assert (lead > needed) is ruled_out


@pytest.mark.parametrize("cost, values, found", [(22.0, 0.0, True), (40.0, 0.0, False), (22.0, 3.0, False)])
def test_names_of_one_law_are_not_chosen_by_what_their_strengths_are_counted_in(cost, values, found):
    """A leak and light past the films predict the same readings. Of a meter that reads a thousandth of its full scale
    the second looks far from plausible, by 12 in score: it stays. One that predicts other values does not, nor one that
    is 36 times its plausible size."""

    def trial(name, cost, image):
        own = {"members": [name], "keys": frozenset({name}), "names": frozenset({name}), "fall": 1523.0, "cost": cost}
        return SimpleNamespace(**own, images=[np.full(4, image)])

    leak, stray = trial("leak", 10.0, 1.0), trial("stray", cost, 1.0 + values)
    colours = SimpleNamespace(**{**vars(leak), "keys": frozenset({"leak", "tilt"})})  # contains the leak
    leads = {stray.names: (cost - 10.0, 10.8)}
    outcome = SimpleNamespace(trials=[leak, stray, colours], survivors=[leak], refuted=[], leads=leads, shared=False)
    assert competition._under_other_names(outcome) == ([stray] if found else [])


@pytest.mark.parametrize("brings, instead", [(2.0, True), (400.0, False)])
def test_gains_of_each_frame_lead_in_place_of_what_explains_nothing_beside_a_lamp(monkeypatch, brings, instead):
    """Where a lamp that wanders explains all, what leads beside it is the cheapest effect, a tone curve that brings 2
    of chi2: the gains, which cost more than that lamp, are the same and lead in its place. A tone curve that is there
    leads as it did."""

    def trial(name, deviance, gain, by_frame):
        own = {"members": [SimpleNamespace(cone=SimpleNamespace(live=[0]))], "keys": {name}, "by_frame": by_frame}
        own |= {"deviance": deviance, "gain": gain, "fall": 3e5, "price": 0.0, "complete": True, "bare": True}
        return SimpleNamespace(**own, cost=150.0 if by_frame else 13.0, fit=SimpleNamespace(values=0.0))

    gains, curve = trial("gains", 1000.0, 0.0, True), trial("curve", 1110.0, 3e5, False)
    evidence = SimpleNamespace(is_table=False)
    case = SimpleNamespace(lamp=None, evidence=evidence, prior_chi2=lambda values: 0.0, known_chi2=lambda values: 0.0)
    monkeypatch.setattr(competition, "design_effect", lambda *a: 1.0)
    base = SimpleNamespace(deviance=1110.0 + brings, members=[], by_frame=False)
    outcome = SimpleNamespace(scale=1.0, base=base, leader=curve, trials=[base, curve, gains])
    found = competition._lamp_or_gains(case, outcome)
    assert found is (gains if instead else None)


@pytest.mark.parametrize("off, named", [(100.0, True), (4.0, False), (0.0, False)])
def test_a_reading_that_holds_the_excess_alone_is_named(off, named):
    rng = np.random.default_rng(1)
    images, rows = [rng.standard_normal((30, 1, 1)) for _ in range(2)], np.arange(60).reshape(2, 30, 1, 1)
    images[1][7] += off
    turned = {"analyzer.angle": np.linspace(0, 174, 30).reshape(-1, 1, 1)}
    frames = [SimpleNamespace(rows=r, readings=turned) for r in rows]
    evidence = SimpleNamespace(is_table=True, frames=[0, 1], use=[np.ones((30, 1, 1), bool)] * 2)
    case = SimpleNamespace(evidence=evidence, model=SimpleNamespace(frames=frames))
    text = remarks.of_one_reading(case, SimpleNamespace(images=images))
    assert text.startswith("reading 37 (from 0; analyzer.angle = 42) is off by 98 sd and holds 100%") is named
    assert bool(text) is named


def test_misfit_that_is_left_beside_gains_of_each_frame_is_counted_without_a_lamp(monkeypatch):
    """Gains of each frame bring 2900 and leave 320, as of noise that is stated too small. Without them a lamp that
    swings makes up for all but 70: that lamp is those gains, and the 70 are no measure of what they bring."""

    def trial(deviance, gain, fall, by_frame, keys):
        own = {"deviance": deviance, "gain": gain, "fall": fall, "by_frame": by_frame, "keys": keys, "bare": False}
        fit, own["price"] = SimpleNamespace(values=0.0), 0.0
        return SimpleNamespace(**own, cost=40.0 * by_frame, complete=False, fit=fit, left=lambda dof: 320.0)

    best = trial(1130.0, 0.0, 2900.0, True, {"gains", "offset"})
    other = trial(1180.0, 2070.0, 0.0, False, {"offset"})
    evidence = SimpleNamespace(is_table=False, normal=SimpleNamespace(count=1000), projected=SimpleNamespace(rank=20))
    case = SimpleNamespace(lamp=None, evidence=evidence, prior_chi2=lambda values: 0.0, known_chi2=lambda values: 0.0)
    monkeypatch.setattr(competition, "design_effect", lambda *a: 1.0)
    monkeypatch.setattr(competition, "_significant", lambda *a: 20.0)
    lead, needed = competition._lead(case, SimpleNamespace(scale=1.37), best, other)
    assert lead > needed


def test_beside_a_lamp_settings_move_as_least_squares_with_its_covariance_does():
    """Three frames of one dial each; V = 1 + p g g' of each, with g its signal of length 1."""
    rng = np.random.default_rng(5)
    lamp = Frames.__new__(Frames)
    sizes, loads = (6, 5, 7), np.array([40.0, 10.0, 25.0])
    lamp.signal = [g / np.linalg.norm(g) for g in (1 + rng.random(n) for n in sizes)]
    lamp.thinning, lamp.loads = 1.0, {"lamp": loads}
    ends = np.cumsum([0, *sizes])
    images = np.zeros((ends[-1], 3))
    for k, (start, end) in enumerate(zip(ends, ends[1:])):
        images[start:end, k] = 30 * lamp.signal[k] + rng.standard_normal(end - start)
    residual = rng.standard_normal(len(images)) * 5
    precision, pull = np.array([4.0, 0.0, 9.0]), np.array([-12.0, 0.0, 27.0])
    noise = Correlation(1.0, 50.0, 1.0, "lamp", 10.0)
    inverse = np.eye(len(images))
    for start, end, g, load in zip(ends, ends[1:], lamp.signal, loads):
        power = noise.power * load**2 / np.mean(loads**2)
        inverse[start:end, start:end] = np.linalg.inv(np.eye(end - start) + power * np.outer(g, g))
    expected = np.linalg.solve(images.T @ inverse @ images + np.diag(precision), images.T @ inverse @ residual + pull)
    assert lamp.settled(residual, images, (precision, pull), noise) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("gain, chi2", [(900.0, 4.0), (0.0, 64.0)])
def test_a_dial_that_a_lamp_sent_far_off_counts_where_it_would_stand_beside_it(monkeypatch, gain, chi2):
    """A dial that is known to .5 deg stands 4 deg off, and would stand 1 deg off beside a lamp that swings."""
    dial = SimpleNamespace(prior=(0.0, 0.5))
    values = Values({"dial": 4.0})
    monkeypatch.setattr(Values, "put", lambda self, v, value: self.common.update(dial=value))
    monkeypatch.setattr(competition, "value_of", lambda model, values, v: values.common["dial"])
    monkeypatch.setattr(shared_noise, "priors", lambda *a: None)
    monkeypatch.setattr(shared_noise, "kept_values", lambda *a: [np.zeros(1)])
    monkeypatch.setattr(competition, "frames_about", lambda *a: SimpleNamespace(noise=lambda scale: None))

    def known(values):
        return (values.common["dial"] / 0.5) ** 2

    evidence = SimpleNamespace(columns=[dial], base=[0], dense=lambda columns: np.zeros((1, 1)))
    lamp = SimpleNamespace(most=math.inf, settled=lambda *a: np.array([-3.0]))
    own = {"lamp": lamp, "evidence": evidence, "model": None}
    case = SimpleNamespace(**own, known_chi2=known, prior_chi2=lambda values: 10 * known(values))
    fit = SimpleNamespace(values=values)
    trial = SimpleNamespace(fit=fit, by_frame=False, gain=gain, settled={}, members=[], images=[])
    assert competition._from_priors(case, SimpleNamespace(scale=1.0), trial) == (10 * chi2, chi2)
    assert values.common["dial"] == 4.0


@pytest.mark.parametrize("lead, survives", [(5.0, True), (30.0, False), (-math.inf, False)])
def test_effects_beside_errors_of_dials_are_rivals_of_gains_of_each_frame(monkeypatch, lead, survives):
    """By itself a polarized detector is ruled out; with errors of dials that nobody states it is behind by `lead`.
    Where these could not be fitted it stays ruled out, and so does what has a strength per frame itself."""

    def trial(name, by_frame):
        return SimpleNamespace(members=[name], by_frame=by_frame, dials="", fit=SimpleNamespace(values=Values({})))

    gains, detector, steps = trial("gains", True), trial("detector", False), trial("steps", True)
    outcome = SimpleNamespace(best=gains, trials=[gains, detector, steps], survivors=[gains])
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=False), model=SceneModel.__new__(SceneModel))
    monkeypatch.setattr(dials_as_rival, "unstated", lambda model: ["analyzer.angle"])
    monkeypatch.setattr(dials_as_rival, "_lead_over_errors", lambda *a: lead)
    found = dials_as_rival.with_rivals(case, outcome)
    assert found.survivors == ([gains, detector] if survives else [gains])
    assert detector.dials == ("analyzer.angle" if survives else "")


@pytest.mark.parametrize("known, fall, better", [(None, 5.0, True), (None, -2e6, False), (9.0, 5.0, False)])
def test_a_refit_from_the_end_of_another_must_explain_more_than_was_known(monkeypatch, known, fall, better):
    """More than nothing, where nothing was known: from a base that another effect had moved, a film that was turned by
    8 deg explained -2 million, and a lamp made up for it."""
    film = SimpleNamespace(effect=SimpleNamespace(name="film"), row=SimpleNamespace(net=1.0))
    names, made = frozenset(["film"]), SimpleNamespace(fall=fall, fit="fit")
    trials = {} if known is None else {names: SimpleNamespace(fall=known)}
    monkeypatch.setattr(search, "from_there", lambda case, members, start: "fit")
    monkeypatch.setattr(search, "trial_of", lambda case, members, found: made)
    monkeypatch.setattr(search, "weighed", lambda case, found: None)
    monkeypatch.setattr(search, "write", lambda *a: None)
    fits = {}
    assert search._improved(None, trials, fits, [film], None) == better
    assert (trials.get(names) is made) == better and fits == ({"film": "fit"} if better else {})


@pytest.mark.parametrize(
    "scopes, complete, most", [(["common"], False, NOTICED), (["frame"], False, math.inf), (["frame"], True, NOTICED)]
)
def test_a_lamp_may_swing_where_a_gain_of_each_frame_may_be_missing(scopes, complete, most):
    """Where captures state one exposure for all frames, or effects leave nothing, a swing that anybody notices is no
    noise."""
    order = [SimpleNamespace(effect=SimpleNamespace(scope=scope, per="kind")) for scope in scopes]
    case = SimpleNamespace(
        evidence=SimpleNamespace(is_table=False), table=SimpleNamespace(order=order), lamp=SimpleNamespace(most=0.0)
    )
    shared_noise.bound_wander(case, [SimpleNamespace(members=["a"], complete=complete)])
    assert case.lamp.most == most


@pytest.mark.parametrize("known, share", [(0.0, 1.4), (1000.0, 0.007)])
def test_a_fall_of_what_is_known_lies_in_no_channel(monkeypatch, known, share):
    """Dials took the gains up: images fall by 5, 7 of it in one channel, and what is known of the dials by 1000."""
    before, after = np.zeros((2, 1, 3)), np.zeros((2, 1, 3))
    before[0, 0] = np.sqrt([7.0, 0.0, 0.0])
    after[1, 0] = np.sqrt([0.0, 1.0, 1.0])
    trials = [
        SimpleNamespace(images=[images], fit=SimpleNamespace(values=values))
        for images, values in ((before, known), (after, 0.0))
    ]
    outcome = SimpleNamespace(best=trials[1], without=lambda *a: trials[0])
    frame = SimpleNamespace(name="one", parameters={})
    model, evidence = SimpleNamespace(frames=[frame]), SimpleNamespace(frames=[0])
    case = SimpleNamespace(model=model, evidence=evidence, known_chi2=lambda values: values)
    monkeypatch.setattr(findings.prints, "channel_names", lambda evidence: ["R", "G", "B"])
    subject = SimpleNamespace(effect=SimpleNamespace(name="gain drift", scope="frame", per="kind"))
    found, part = findings._carried(case, outcome, subject)
    assert found == pytest.approx(share, rel=0.01) and part == "channel R"


@pytest.mark.parametrize("others, kept", [(["gamma"], ["gamma"]), ([], ["gains"])])
def test_gains_that_follow_a_setting_give_way_to_what_explains_them(monkeypatch, others, kept):
    """A gain of each frame is no drift where it follows what was set, if any effect of all frames survives beside it;
    else it stays, for the verdict that no effect has this shape."""
    trials = {
        n: SimpleNamespace(members=[n], by_frame="gains" in n, names=n) for n in ("gains", "gains, leak", "gamma")
    }
    outcome = SimpleNamespace(survivors=[trials[n] for n in ("gains", *others)], trials=list(trials.values()))

    def beside(case, outcome, gone, why):
        assert [t.names for t in gone] == ["gains", "gains, leak"] and "analyzer.angle" in why
        return SimpleNamespace(survivors=[t for t in outcome.survivors if t not in gone])

    monkeypatch.setattr(competition, "beside_refuted", beside)
    monkeypatch.setattr(held_out, "judge", lambda case, outcome: (outcome, ["levels"]))
    found, levels = diagnose._without_followers(None, outcome, [], "analyzer.angle")
    assert [t.names for t in found.survivors] == kept and levels == ["levels"] * bool(others)


@pytest.mark.parametrize("unset, subject", [("", "gains"), ("analyzer.angle", "vignetting")])
def test_what_errors_of_dials_stand_against_waits_for_the_others(monkeypatch, unset, subject):
    """Gains of each frame bring most, and vignetting is missing beside them, whatever unknown errors of a dial did."""
    gains, vignetting = (SimpleNamespace(effect=SimpleNamespace(name=name)) for name in ("gains", "vignetting"))
    outcome = SimpleNamespace(
        best=SimpleNamespace(members=[gains, vignetting]),
        core=["gains", "vignetting"],
        own_fall=lambda trial, name: {"gains": 1000.0, "vignetting": 500.0}[name],
    )
    monkeypatch.setattr(findings, "_unset", lambda case, outcome, c: unset if c is gains else "")
    assert findings.subject_of(None, outcome).effect.name == subject


@pytest.mark.parametrize("by_frame, lead", [(True, 700.0), (False, -19300.0)])
def test_another_law_falls_from_where_the_best_explanation_does(monkeypatch, by_frame, lead):
    """A law whose score is 1300, and an explanation of 2000 in score, that has 20000 less beside a lamp. A law beside
    gains of each frame is judged without that lamp, as these are."""
    best = SimpleNamespace(by_frame=by_frame)
    scores = {id(best): 2000.0, "base": 20000.0}
    outcome = SimpleNamespace(best=best, base="base", score=lambda t: scores.get(id(t), scores["base"]))
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=False))
    assert findings.law_lead(case, outcome, 1300.0) == lead


@pytest.mark.parametrize(
    "angles, is_table, held",
    [
        ([0.0, 40.0, 80.0], False, {"analyzer.angle"}),
        ([0.0, 40.0, 40.0], False, set()),
        ([0.0, 40.0, 80.0], True, set()),
    ],
)
def test_a_law_along_a_dial_of_unknown_errors_is_a_strength_of_each_frame(monkeypatch, angles, is_table, held):
    """No law runs along it, unless several frames stand at one of its settings, or readings of a table do."""
    monkeypatch.setattr(laws, "unstated", lambda model: ["analyzer.angle"])
    monkeypatch.setattr(laws, "SceneModel", SimpleNamespace)
    turned = {"analyzer.angle": angles, "sample.angle": [1.0, 2.0, 3.0]}
    evidence = SimpleNamespace(is_table=is_table, frames=[0, 2, 3])
    assert laws._frame_by_frame(SimpleNamespace(), evidence, turned) == held


def test_a_freer_law_runs_along_the_clock_of_a_session(monkeypatch):
    """A polarizer that was bumped in mid-session is off by another angle from then on. Along the power no law runs:
    light past the films with a strength that changes with it is a leak, of which the library has the name."""
    monkeypatch.setattr(laws.prints, "settings", lambda model, evidence: {})  # of frames: a sweep has one value of none
    monkeypatch.setattr(laws, "_strengths", lambda evidence, own, x: iter([[x[:, None]]]))
    monkeypatch.setattr(laws, "_fall_of_images", lambda evidence: lambda images: (50.0, 2, 50.0))
    coordinates = ("analyzer.angle", "source.time", "source.power", "intensity", "reading")
    places = [dict.fromkeys(coordinates, np.arange(9.0))]
    frames = [SimpleNamespace(readings=dict.fromkeys(coordinates[:3], np.zeros((9, 1, 1))))]
    evidence = SimpleNamespace(
        is_table=True, frames=[0], base=[0], columns=[SimpleNamespace(keys=("polarizer.offset",))]
    )
    variable = SimpleNamespace(keys=("polarizer.offset",))
    effect = SimpleNamespace(name="polarizer misalignment", acts=("analyzer.angle",))
    roles = {"analyzer.angle": "angle", "source.time": "clock", "source.power": "power"}
    parameters = {key: SimpleNamespace(role=role) for key, role in roles.items()}
    model = SimpleNamespace(frames=frames, parameters=parameters)
    found = laws.other_laws(model, evidence, places, [effect], lambda e: [variable], 1.0, None)
    assert {law.coordinate for law in found} == {"analyzer.angle", "source.time", "intensity"}


def test_a_law_falls_from_where_effects_fall():
    """By what readings share they have other weights than the fit had, so that a base stands off its optimum. An effect
    falls from there, and another law of the same image falls as far."""
    rng, count = np.random.default_rng(1), 60
    base, image = np.ones((count, 1)), np.cos(np.linspace(0, 6, count))[:, None]
    r = (base + 5 * image)[:, 0] + rng.standard_normal(count)  # off its optimum by 1 along the base

    def about(residual, fitted):
        return Readings(residual, fitted, np.arange(count), {"lamp": np.full(count, 100.0)})

    blocks = [SimpleNamespace(r=r)]
    evidence = SimpleNamespace(dense=lambda columns: base, base=[0], blocks=blocks)
    fall, dof, plain = laws._fall_of_readings(evidence, SimpleNamespace(about=about), 1.0)([image])
    whole = np.hstack([base, image])
    left = r - whole @ np.linalg.lstsq(whole, r, rcond=None)[0]
    effect = about(r, base).standing(1.0) - about(left, whole).standing(1.0)
    assert about(r, base).standing(1.0) - about(r, base).deviance(1.0) == pytest.approx(count, rel=0.5)
    assert (fall, dof) == (pytest.approx(effect, rel=1e-9), 1)
    assert plain == pytest.approx(about(r, base).white - about(left, whole).white, rel=1e-9)


def test_numbers_that_take_the_place_of_a_wander_cost_what_they_could_have_fitted():
    """Of a bench: a tone curve of one strength lowers chi2 by 10190, and deviance by 129.5, as a lamp that wanders
    without bound would explain most of it. Eight cosines lower them by 10222 and 149.5. Where cosines are the cause no
    lamp wanders, and each is known to a hundredth of its size: they cost 57, not 24, and the curve (19.4) is ahead."""
    law = Law("extinction leak", "analyzer.angle", 149.5, 8, 0.0, 10222.0)
    assert law.cost == pytest.approx(57.2, abs=0.1) and law.score < 129.5 - 19.4 - TOLD
    assert replace(law, plain=0.0).score > 129.5 - 19.4 + TOLD


@pytest.mark.parametrize(("there", "wins"), [(100.0, True), (895.0, False)])
def test_a_refit_begins_where_an_earlier_diagnosis_had_the_effect(monkeypatch, there, wins):
    """From the base's own images a refit comes to chi2 = 900. It is tried where the effect had been if that is clearly
    better already."""
    asked = []
    case = SimpleNamespace(expected=[refit.Expected(frozenset(["b"]), "earlier")], before=1000.0)
    c = SimpleNamespace(effect=SimpleNamespace(name="b"), form="tangent", row=SimpleNamespace(flags=[]), variables=[])
    monkeypatch.setattr(refit, "with_effects", lambda *_: "from the base")
    monkeypatch.setattr(refit, "from_there", lambda *_: asked.append(1) or "from there")
    monkeypatch.setattr(refit, "after_at", lambda case, values: there)
    after = {"from the base": 900.0, "from there": 50.0}
    monkeypatch.setattr(refit, "weighed", lambda case, fit: refit.Attempt(fit, 1000 - after[fit], after[fit], 50.0, []))
    best = refit._best_attempt(case, c, 100.0, np.array([1.0]))
    assert (best.fit == "from there") is wins and len(asked) == wins


def candidate(name):
    row = SimpleNamespace(p_family=0.0, refit=None)
    cone = SimpleNamespace(live=[0])
    return SimpleNamespace(effect=SimpleNamespace(name=name), row=row, cone=cone, broken=False, columns=[0])


def trial(members, fall, excess):
    names = frozenset(c.effect.name for c in members)
    return SimpleNamespace(
        members=members,
        names=names,
        fall=fall,
        cost=10.0 * len(members),
        after=1e4 - fall,
        excess_sd=excess,
        keys=names,
        complete=False,
    )


@pytest.fixture
def search_of_pairs(monkeypatch):
    """Refits pairs of effects that are ranked so, and reach so much; returns (names that were tried, those untried)."""

    def pairs_of(trials, ranked, reached, lamp=0.0):
        case = SimpleNamespace(
            evidence=SimpleNamespace(
                is_table=False, normal=SimpleNamespace(count=10000), projected=SimpleNamespace(rank=9)
            ),
            lamp=SimpleNamespace(most=0.0),
            table=SimpleNamespace(order=[]),
            say=lambda *_: None,
        )
        tried = []

        def made(case, members, found):
            tried.append(names := {c.effect.name for c in members})
            return trial(members, reached(names), 10.0)

        monkeypatch.setattr(search.pairs, "ranked", lambda *_: ranked)
        monkeypatch.setattr(search, "gain_of", lambda case, t, scale: lamp if len(t.members) == 1 else 0.0)
        monkeypatch.setattr(search, "expected_gain", lambda *_: 0.0)
        monkeypatch.setattr(search, "expected_cost", lambda c: 10.0)
        monkeypatch.setattr(search, "with_effects", lambda *_: None)
        monkeypatch.setattr(search, "trial_of", made)
        untried = search._joined(case, {t.names: t for t in trials})
        return tried, [set(names) for names in untried]

    return pairs_of


@pytest.mark.parametrize("lamp", [0.0, 9000.0])
def test_a_lamp_that_swings_keeps_no_pair_from_a_refit(search_of_pairs, lamp):
    """Of two causes that make 10,000 of chi2, one alone leaves 4000, and a lamp that swings makes up for those."""
    a, b = candidate("a"), candidate("b")
    trials = [trial([], 0.0, 70.0), trial([a], 6000.0, 30.0), trial([b], 5000.0, 35.0)]
    assert search_of_pairs(trials, [(9900.0, a, b, np.zeros(2))], lambda names: 9900.0, lamp) == ([{"a", "b"}], [])


def test_pairs_are_refitted_until_none_may_win_or_nobody_can_wait(search_of_pairs, monkeypatch):
    """What a refit reaches is asked of the next pairs: one that keeps its promise ends the search, and where none does,
    those that are left are told."""
    names = "abcdef"
    effects = [candidate(n) for n in names]
    trials = [trial([], 0.0, 70.0), *(trial([c], 5000.0, 35.0) for c in effects)]
    ranked = [(9900.0 - 20 * i, effects[0], c, np.zeros(2)) for i, c in enumerate(effects[1:])]
    ranked.append((7000.0, effects[1], effects[2], np.zeros(2)))
    monkeypatch.setattr(search.pairs, "REFITTED", 3)
    # within CLEAR of what was reached, the second might still be better
    tried, untried = search_of_pairs(trials, ranked, lambda names: 9900.0)
    assert tried == [{"a", "b"}] and not untried
    tried, untried = search_of_pairs(trials, ranked, lambda names: 6000.0)
    assert tried == [{"a", "b"}, {"a", "c"}, {"a", "d"}]
    assert untried == [{"a", "e"}, {"a", "f"}, {"b", "c"}]


def test_what_seems_to_leave_nothing_is_tried_beside_what_may_lower_it(search_of_pairs):
    """Where noise is stated too large, one of two causes leaves less than noise; the other is expected to lower that by
    1000 all the same. Beside a lamp that wanders, it is not asked what it takes up of that lamp."""
    a, b = candidate("a"), candidate("b")
    trials = [trial([], 0.0, 20.0), trial([a], 8500.0, -1.0), trial([b], 8000.0, 1.0)]
    trials[1].complete = trials[2].complete = True
    pair = [(9500.0, a, b, np.zeros(2))]
    assert search_of_pairs(trials, pair, lambda names: 9600.0) == ([{"a", "b"}], [])
    assert search_of_pairs(trials, pair, lambda names: 9600.0, lamp=1400.0) == ([], [])


def test_what_was_promised_is_held_against_what_was_promised(search_of_pairs):
    """Images promised 200 too little of a pair; of others that they promise 5 and 150 less, they may as well; of one
    with 300 less they would have to be more wrong."""
    a, b, c = (candidate(n) for n in "abc")
    trials = [trial([], 0.0, 70.0), *(trial([e], 6000.0, 30.0) for e in (a, b, c))]
    ranked = [(9000.0, a, b, np.zeros(2)), (8995.0, a, c, np.zeros(2)), (8850.0, b, c, np.zeros(2))]
    tried, untried = search_of_pairs(trials, ranked, lambda names: 9200.0 if "b" in names else 9210.0)
    assert tried == [{"a", "b"}, {"a", "c"}, {"b", "c"}] and not untried
    ranked[2] = (8700.0, *ranked[2][1:])
    tried, untried = search_of_pairs(trials, ranked, lambda names: 9200.0 if "b" in names else 9210.0)
    assert tried == [{"a", "b"}, {"a", "c"}] and not untried


@pytest.mark.parametrize(
    "swing, pattern, noise, measured, bare",
    [
        (0.01, 0.0, 1.0, False, True),  # a lamp that wanders by 1 %
        (0.05, 0.0, 1.0, False, False),  # no lamp does that unnoticed
        (0.01, 0.5, 1.0, False, False),  # a slope over the image
        (0.0, 0.0, 1.2, False, True),  # noise that is stated too small
        (0.0, 0.0, 1.2, True, False),  # of noise that repeats have measured, an excess is misfit
    ],
)
def test_what_leaves_a_lamp_that_wanders_leaves_nothing(swing, pattern, noise, measured, bare):
    """Eight frames of 24 x 32 px, 50 DN with noise of 1 DN: 1 % of one frame is 14 sd of its mean."""
    rng, shape = np.random.default_rng(3), (24, 32, 3)
    lamp = swing * np.array([1, -1, 0.5, 1, -1, -0.5, 1, -1])
    slope = pattern * np.linspace(-1, 1, 32)[None, :, None]
    left = [noise * rng.standard_normal(shape) + 50 * g + slope for g in lamp]
    spectrum = st.Spectrum(1)
    for _ in left:
        spectrum.add(np.ones(shape, bool), [0], np.zeros((*shape, 1)), np.full(shape, 50.0))
    evidence = SimpleNamespace(
        frames=range(8),
        sigma=[np.ones(shape)] * 8,
        use=[np.ones(shape, bool)] * 8,
        normal=SimpleNamespace(count=8 * 2304),
        structure=lambda images, columns: spectrum.test(images, [0], np.zeros((1, 1))),
    )
    frames = [SimpleNamespace(image=60.0 + image) for image in left]
    model = SimpleNamespace(noise=SimpleNamespace(black_level=10.0), frames=frames)
    case = SimpleNamespace(evidence=evidence, model=model, measured=measured)
    after = sum(float(np.sum(image**2)) for image in left)
    assert explanations._is_bare(case, left, after, 8 * 2304.0, []) is bare


def test_a_narrow_field_may_fall_off_by_a_tenth():
    """cos^(4 v) at 2.5 degrees off the axis."""
    (vignetting,) = registry.default().find_effect("lens vignetting").parameters
    assert np.cos(np.radians(2.5)) ** (4 * vignetting.bounds[1]) < 0.9


def test_effects_that_predict_the_same_are_not_told_apart_whatever_their_slopes_say(monkeypatch):
    """By slopes 400 of chi2 tell a from b; but b, as it was found, predicts what a does but for 1.5, and needs a dial
    that stands off by 2 more of chi2. Of c, which was not refitted, only slopes are known."""
    monkeypatch.setattr(st, "gap", lambda *of: 400.0)

    def effect(name):
        return SimpleNamespace(effect=SimpleNamespace(name=name), columns=[0], direction=np.ones(1), cone=None)

    def trial(c, images, known):
        return SimpleNamespace(members=[c], images=[images], fit=SimpleNamespace(values=known))

    a, b, c = map(effect, "abc")
    outcome = SimpleNamespace(
        trials=[trial(a, np.zeros(6), 0.0), trial(b, np.full(6, 0.5), 2.0), SimpleNamespace(members=[])]
    )
    evidence = SimpleNamespace(base=[], projected=SimpleNamespace(information=np.eye(1)))
    case = SimpleNamespace(evidence=evidence, known_chi2=lambda known: known)
    gaps, correct = diagnose._gaps(case, outcome, [a, b, c])
    assert gaps == [[0.0, pytest.approx(3.5), 400.0], [0.0, 0.0, 400.0], [400.0, 400.0, 0.0]]
    assert correct[0][1] == pytest.approx(st.probability_correct(3.5)) and correct[1][0] == 0.5


@pytest.mark.parametrize(
    "share, excess_sd, detail",
    [
        (1.0002, 792.0, True),
        (0.995, 500.0, True),
        (1.2, 5.2, False),
        (0.98, 2400.0, False),
        (1.47, 6.8, False),
        (1.02, 2400.0, True),
    ],
)
def test_what_is_surely_a_hundredth_of_the_excess_is_a_detail(share, excess_sd, detail):
    """Light past the films, partly polarized, of which plain stray light leaves .0 +- .1 % of an excess of 792 sd: no
    curve is a rival. Of an excess of 5 sd, what is left is not known to a fifth; and where effects explain half as much
    again, that is no better."""
    own = SimpleNamespace(share=share, excess_sd=excess_sd, weighed=True)
    assert findings._is_detail(own) is detail
    assert not findings._is_detail(SimpleNamespace(share=math.nan, excess_sd=792.0, weighed=True))
    assert not findings._is_detail(SimpleNamespace(share=share, excess_sd=excess_sd, weighed=False))


@pytest.mark.parametrize(
    "gain, by_frame, excess_sd, told",
    [
        (800.0, False, 44.7, True),
        (60.0, False, 44.7, False),  # a twentieth of the excess
        (800.0, True, 44.7, False),  # each frame has a gain
        (800.0, False, 1.0, False),  # noise, of which there is no share
    ],
)
def test_a_lamp_that_takes_much_of_the_misfit_is_mentioned(monkeypatch, gain, by_frame, excess_sd, told):
    """In images of a real sensor whose gains had been made to scatter, brightness of whole frames was most of the
    misfit, and the verdict spoke of another effect alone."""
    monkeypatch.setattr(remarks, "wander_of", lambda case, outcome, trial: 0.0104)
    scopes = {"gain drift": "frame", "gel bulge": "common"}
    order = [SimpleNamespace(effect=SimpleNamespace(name=n, scope=s, per="kind")) for n, s in scopes.items()]
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=False), lamp=object(), table=SimpleNamespace(order=order))
    best = SimpleNamespace(by_frame=by_frame, members=[order[1]], gain=gain)
    text = remarks.lamp_text(
        case,
        SimpleNamespace(best=best, scale=1.5),
        SimpleNamespace(chi2=3000.0, dof=1000.0, excess_sd=excess_sd),
    )
    assert bool(text) is told
    if told:
        assert "by 1.04 % (rms), which is 60 % of the excess" in text and "add gain drift" in text


@pytest.mark.parametrize("change, survives", [(0.0, False), (0.9, False), (40.0, True)])
def test_a_refit_that_ended_where_the_base_is_survives_nothing(monkeypatch, change, survives):
    """Of a DIGIT's presses, an edge of a filter was promised 298, and its refit brought 2e-6. Parts of the images that
    scatter made it no worse than the best by its low cost, and it was listed beside that as an explanation."""

    def trial(name, fall, image):
        own = {"names": frozenset(name), "keys": {(n, None) for n in name}, "members": list(name), "fall": fall}
        return SimpleNamespace(**own, images=[np.full(4, image)], deviance=1e4 - fall, cost=5.0 * len(name), after=1e4)

    base, best, other = trial("", 0.0, 0.0), trial("a", 840.0, 5.0), trial("b", change, math.sqrt(change) / 2)
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=False), lamp=None)
    monkeypatch.setattr(competition, "_lead", lambda *a: (30.0, 18.0))
    monkeypatch.setattr(competition, "_ruled_out", lambda case, outcome, judge, t: t is base)
    monkeypatch.setattr(explanations.Outcome, "core", [])
    outcome = explanations.Outcome(best, best, [best], [best, other, base], 1.0, None)
    assert competition._survived(case, outcome).survivors == ([best, other] if survives else [best])


@pytest.mark.parametrize(
    "falls, core, found",
    [
        ({"ab": 3579.0, "a": 3397.0, "b": 2810.0}, "b", "a"),
        ({"ab": 3579.0, "a": 3397.0, "b": 2810.0}, "ab", ""),  # both are decided
        ({"ab": 3579.0, "a": 2810.0, "b": 2700.0}, "b", ""),  # no detail: a fifth of the fall
        ({"ab": 1000.0, "a": 910.0, "b": 990.0}, "b", ""),  # b explains more, and a mimics it
        ({"abc": 1000.0, "ac": 945.0, "a": 300.0, "c": 900.0, "b": 500.0}, "bc", ""),  # c, which is decided
    ],
)
def test_a_detail_of_what_is_not_decided_is_no_claim(falls, core, found):
    """A dial whose scale is bent: a wrong scale (a), or a misalignment, with an eccentric dial (b) explain 3579 of
    chi2, and the wrong scale alone 95 % of it."""
    trials = [SimpleNamespace(names=frozenset(names), fall=fall) for names, fall in [*falls.items(), ("", 0.0)]]
    outcome = SimpleNamespace(best=trials[0], core=list(core), trials=trials)
    assert findings._detail_of(outcome, "b") == found


@pytest.mark.parametrize("change, left", [(0.03, ["LED drift", "gamma"]), (0.2, ["gamma"])])
def test_lights_that_would_change_more_than_lights_do_explain_nothing(change, left):
    """Gains of each light in each frame follow whatever is wrong with how lights light the skin: not by a fifth."""
    gain = Parameter("gain", "1", 1.0, (0.0, 100.0), neutral=1.0, plausible=0.02)
    lights = {"a": [1 + change, 1 - change, 1 + change], "b": [1.0, 1.001, 0.999]}
    variables = [Variable(f"{n}.gain[{i}]", (f"{n}.gain",), gain, (i,)) for n in lights for i in range(3)]
    drift = SimpleNamespace(
        effect=SimpleNamespace(name="LED drift", scope="frame", per="part"),
        variables=variables,
        plausible=np.full(6, 0.02),
        contains=lambda other: False,
        row=SimpleNamespace(refit=None, net=3.0),
    )
    gamma = SimpleNamespace(
        effect=SimpleNamespace(name="gamma", scope="common", per="kind"),
        variables=[],
        contains=lambda other: False,
        row=SimpleNamespace(refit=None, net=1.0),
    )
    found = SimpleNamespace(variables=variables, estimate=[x for own in lights.values() for x in own])
    gains = np.array(found.estimate)
    found.covariance = np.diag([0.0005**2] * 6) + 0.2**2 * np.outer(gains, gains)  # a scale that nobody knows
    nets = {"LED drift": 3.0, "gamma": 1.0}
    table = score.Table([drift, gamma], np.eye(7), None, 0.0, nets, nets)
    case, not_tested = SimpleNamespace(table=table), {}
    chosen, fits = diagnose._without_wild_lights(case, [drift, gamma], {"LED drift": found, "gamma": None}, not_tested)
    assert [c.effect.name for c in chosen] == list(fits) == [c.effect.name for c in case.table.order] == left
    assert list(not_tested) == [n for n in ("LED drift", "gamma") if n not in left]
    assert list(table.uniform) == list(table.dilated) == left and table.fragile("gamma") == ""
    told = refit.known_of(found, drift)
    assert told == f"a {100 * np.std(np.log(lights['a'])):.2g} %, b 0.071 % (rms from frame to frame)"
    found.covariance = np.diag([0.001**2] * 3 + [0.1**2] * 3)  # a dim light, whose gains scatter by their errors
    found.estimate = [*lights["a"], 1.08, 0.96, 0.93]
    assert refit.known_of(found, drift).endswith("b 0 % (rms from frame to frame)")
