"""Numbers and errors as a terminal shows them."""

import pytest

from optics.errors import UnknownKey
from optics.pages.report import measure
from optics.words import with_sd


@pytest.mark.parametrize(
    "x, sd, text",
    [
        (0.3142, 0.0123, "0.314 +- 0.012"),
        (-0.01, 3.4, "0.0 +- 3.4"),
        (-0.06, 3.4, "-0.1 +- 3.4"),
        (-12.3, 34.0, "-12 +- 34"),
        (-0.2, 34.0, "0 +- 34"),
    ],
)
def test_a_value_that_rounds_to_zero_has_no_sign(x, sd, text):
    assert with_sd(x, sd) == text
    assert measure(x, sd) == text.replace("+-", "±").replace("-", "−")


@pytest.mark.parametrize(
    "key, hint, text",
    [
        ("lamp", "see there", "unknown parameter 'lamp'; see there"),
        ("led_1.z", "see there", "did you mean 'led_1.x'? see there"),
        ("lamp", "(* matches)", "unknown parameter 'lamp' (* matches)"),
    ],
)
def test_a_hint_is_set_off(key, hint, text):
    assert str(UnknownKey(key, [f"led_{i}.x" for i in range(1, 20)], hint=hint)).endswith(text)
