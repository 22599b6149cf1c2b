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
        (0.8, 0.02, 0.3, 0.2, True),  # not told from nothing any more
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
        assert (
            f"glare takes the place of haze, which was added before (gel.haze {before:.3g} -> {after:.2g})" in said[0]
        )
        assert "optics add STUDY 'glare' --drop 'haze'" in said[0]
    assert replaced(case, best, []) == []
