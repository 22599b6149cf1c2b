"""Whether an explanation leaves something of an effect that was added before."""

from types import SimpleNamespace

import pytest

from optics.diagnosis.remarks import replaced
from optics.fit.model import Variable
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter, Values

HAZE = Effect(name="haze", part="gel", parameters=(Parameter("haze", "1", 0.0, (0.0, 9.0), "share", neutral=0.0),))
OWN = Variable("gel.haze", ("gel.haze",), HAZE.parameters[0], None, None)
LED = Variable("led.x", ("led.x",), Parameter("x", "mm", 0.0, (-9.0, 9.0), "place"), None, None)


def fit(haze, sd):
    return SimpleNamespace(
        variables=[LED, OWN], sd=[0.1, sd], values=Values({"led.x": 1.0, "gel.haze": haze}), frames=[0]
    )


@pytest.mark.parametrize(
    "before, sd_before, after, sd_after, gone",
    [
        (0.8, 0.02, 0.01, 0.02, True),  # within its error of nothing
        (0.8, 0.02, 0.07, 0.001, True),  # less than a tenth of it
        (0.8, 0.02, 0.3, 0.02, False),
        (0.8, 0.3, 0.01, 0.3, False),  # was never certain
        (0.8, 0.02, 0.3, 0.2, False),  # not told from nothing any more, and maybe there
        (0.8, 0.02, 0.15, 0.06, True),
    ],
)
def test_an_effect_is_replaced_where_nothing_is_left_of_it(before, sd_before, after, sd_after, gone):
    case = SimpleNamespace(
        model=SimpleNamespace(base={"gel.haze": 0.0}), fit=fit(before, sd_before), variables_of=lambda effect: [OWN]
    )
    glare = SimpleNamespace(effect=SimpleNamespace(name="glare"))
    best = SimpleNamespace(fit=fit(after, sd_after), members=[glare])
    said = replaced(case, best, [HAZE])
    assert bool(said) == gone
    if said:
        assert f"with glare nothing is left of haze, added before (gel.haze {before:.3g} -> {after:.2g})" in said[0]
        assert "(optics add STUDY 'glare' --drop 'haze')" in said[0]
    assert replaced(case, best, []) == []


def test_a_pair_that_replaces_something_is_added_one_by_one():
    case = SimpleNamespace(
        model=SimpleNamespace(base={"gel.haze": 0.0}), fit=fit(0.8, 0.02), variables_of=lambda effect: [OWN]
    )
    two = [SimpleNamespace(effect=SimpleNamespace(name=name)) for name in ("glare", "tilt")]
    (said,) = replaced(case, SimpleNamespace(fit=fit(0.0, 0.02), members=two), [HAZE])
    assert "(optics add STUDY 'glare'; optics add STUDY 'tilt' --drop 'haze')" in said
