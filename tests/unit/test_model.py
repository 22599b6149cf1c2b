"""What a fit and a diagnosis ask of a model is one interface: the scene's model and the mocks of the tests have it."""

import inspect
import sys
from pathlib import Path

import numpy as np
import pytest

from optics.captures.capture_set import Frame
from optics.fit.model import Model, value_of
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Parameter, Values, Variable

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import Exact, MockModel, PointModel
from test_flat_field import models  # noqa: F401  a fixture: gelsight at 24 x 18 px with a background

METHODS = [name for name, member in vars(Model).items() if inspect.isfunction(member) and not name.startswith("_")]


def arguments(method):
    """(name, default) of what a caller may pass."""
    return [(p.name, p.default) for p in inspect.signature(method).parameters.values() if p.name != "self"]


@pytest.mark.parametrize("kind", [SceneModel, MockModel, PointModel])
@pytest.mark.parametrize("name", METHODS)
def test_every_model_takes_the_same_arguments(kind, name):
    assert arguments(getattr(kind, name)) == arguments(getattr(Model, name))


def test_every_model_has_every_member(models):  # noqa: F811
    mocks = [MockModel(1, 4), PointModel([0.0], np.random.default_rng(0))]
    for model in [*mocks, *models.values()]:
        assert isinstance(model, Model)  # compares names, of attributes too
    del mocks[0].noise
    assert not isinstance(mocks[0], Model)


def test_the_present_value_is_the_most_special_one():
    """Fitted in the frame <- set in the frame <- fitted in all <- the scene's."""
    model = Exact()
    model.base = {"lamp.power": 1.0}
    model.frames = [Frame(f"f{i}", np.zeros((1, 1, 1)), parameters={"lamp.power": 3.0} if i else {}) for i in range(3)]
    everywhere, *own = (
        Variable("lamp.power", ("lamp.power",), Parameter("power", "1", 1.0), frames)
        for frames in (None, (0,), (1,), (2,))
    )
    values = Values()
    assert [value_of(model, values, v) for v in (everywhere, *own)] == [1, 1, 3, 3]
    values.put(everywhere, 2.0)
    assert [value_of(model, values, v) for v in (everywhere, *own)] == [2, 2, 3, 3]
    values.put(own[2], 4.0)
    assert [value_of(model, values, v) for v in (everywhere, *own)] == [2, 2, 3, 4]
