"""What tells explanations apart: the form of an image, what is known of dials, predictions of blocks left out."""

from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis import explanations, score
from optics.diagnosis import statistics as st


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


def test_what_is_known_of_dials_counts_whole_in_a_fall(monkeypatch):
    """22 of chi2, 20 of them by which dials need not be off: noise that images share divides the other 2 alone."""
    monkeypatch.setattr(explanations, "_design_effect", lambda *a: 10.0)
    best, without = (SimpleNamespace(fit=SimpleNamespace(values=v)) for v in (1.0, 21.0))
    outcome = SimpleNamespace(best=best, without=lambda *a: without, own_fall=lambda *a: 22.0)
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=False), prior_chi2=lambda values: values)
    assert explanations.fall_over_noise(case, outcome, "a") == pytest.approx(20.2)


@pytest.mark.parametrize("ahead, told", [(-5.0, True), (5.0, True), (15.0, False)])
def test_a_prediction_counts_against_a_lead_and_is_no_veto(ahead, told):
    """A lead of 22.5, of which 10.8 are needed, over one that predicts blocks left out better by `ahead`."""
    best = SimpleNamespace(keys={1}, ahead=0.0)
    other = SimpleNamespace(keys={2}, ahead=-ahead, names=frozenset("b"), members=["b"])
    outcome = SimpleNamespace(leader=best, leads={other.names: (22.5, 10.8)})
    assert explanations._told(None, outcome, best, other) is told


@pytest.mark.parametrize(
    "gain, cost, adds", [(0.0, 4.4, False), (6.0, 9.0, False), (7.0, 9.0, True), (9.0, 30.0, False)]
)
def test_what_adds_no_more_than_chance_to_shared_noise_is_that_noise(gain, cost, adds):
    """One strength: chance brings 6.6 once in a hundred times. A misalignment of 0 explains a lamp that wanders."""
    members = [SimpleNamespace(cone=SimpleNamespace(live=[0]))]
    trial = SimpleNamespace(deviance=100.0 - gain, cost=cost, members=members)
    assert explanations._adds_to_noise(trial, SimpleNamespace(deviance=100.0)) is adds


@pytest.mark.parametrize(
    "fit, cost, needed",
    [
        (0.0, 13.7, explanations.NO_TIE),  # the same readings, by a less plausible pair: no claim
        (0.0, 25.0, explanations.NO_TIE),  # 180 degrees against 1: a claim
        (12.0, 1.0, explanations.SURE),  # the data tell
    ],
)
def test_plausibility_alone_must_lead_by_more(monkeypatch, fit, cost, needed):
    """An eccentric dial, and a misalignment with a wrong scale, that read the same at the two places of a dial."""
    variable = SimpleNamespace(keys=("eccentric",), frames=None)
    subject = SimpleNamespace(variables=[variable])
    best = SimpleNamespace(keys={("eccentric", None)}, deviance=100.0, cost=20.0, gain=0.0, members=["eccentric"])
    pair = SimpleNamespace(keys={("a", None)}, deviance=100.0 + fit, cost=20.0 + cost, gain=0.0, members=["a", "b"])
    lead = pair.deviance + pair.cost - best.deviance - best.cost
    monkeypatch.setattr(explanations, "_lead", lambda *a: (lead, explanations.TOLD))
    outcome = SimpleNamespace(best=best, trials=[best, pair])
    assert explanations._without(None, outcome, subject) == (pair, lead, needed)


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
    assert [c for t in explanations._larger(None, outcome) for c in t.members] == larger


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

    trials = [trial(n) for n in range(explanations.CONTENDERS + 20)]
    readings = {
        "correlation": lambda: SimpleNamespace(scale=1.0),
        "noise": lambda scale: SimpleNamespace(gain=20.0),
    }
    monkeypatch.setattr(explanations, "_scale", lambda *_: 2.0)
    monkeypatch.setattr(explanations, "_bound_wander", lambda *_: None)
    monkeypatch.setattr(explanations, "_readings", lambda _, t: SimpleNamespace(reached=t.after, **readings))
    monkeypatch.setattr(explanations, "wander_of", lambda *_: 0.0)
    monkeypatch.setattr(explanations, "_lead", lambda *_: (0.0, 0.0))
    monkeypatch.setattr(explanations, "_with_survivors", lambda _, outcome: outcome)
    case = SimpleNamespace(evidence=SimpleNamespace(is_table=True), session=SimpleNamespace(most=np.inf))
    outcome = explanations.compete(case, trials)
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
            fall=fall,
            cost=cost,
            fit=fit,
            by_frame=False,
            complete=False,
            left=lambda dof: 0.0,
        )

    best, other = trial("a", 1e4, 9e3, 2.97e6, 47.0), trial("b", 1.1e4, 2e3, fall, cost)
    evidence = SimpleNamespace(is_table=False, normal=SimpleNamespace(count=20000), projected=SimpleNamespace(rank=20))
    case = SimpleNamespace(evidence=evidence, prior_chi2=lambda values: 0.0)
    monkeypatch.setattr(explanations, "_design_effect", lambda *a: 1.0)
    lead, needed = explanations._lead(case, SimpleNamespace(scale=scale), best, other)
    assert (lead > needed) is ruled_out
