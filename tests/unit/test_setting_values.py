"""What a scene refuses as a value, also where it equals the value that a parameter has."""

import numpy as np
import pytest

from optics.errors import OutOfBounds, UnknownKey
from optics.scene import loader


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        ("led_1.power", True, ValueError),  # which equals 1, the power that it has
        ("led_1.power", "1.0", ValueError),
        ("led_1.power", np.array([1.0, 2.0]), ValueError),
        ("led_1.power", float("nan"), ValueError),
        ("led_1.power", -3.0, OutOfBounds),
        ("led_1.pow", 1.0, UnknownKey),
    ],
)
def test_what_is_no_value_is_refused_by_its_key(mitsuba, key, value, error):
    scene = loader.load("gelsight", {"width": "8", "height": "6"})
    assert scene.values()["led_1.power"] == 1.0
    with pytest.raises(error, match=key.replace(".", r"\.")):
        scene.set({key: value})
