"""Numbers and errors as a terminal shows them."""

import math
from dataclasses import MISSING, fields
from types import SimpleNamespace

import numpy as np
import pytest

from optics import words
from optics.diagnosis.result import Row
from optics.diagnosis.text import _claim, limit_text, strength_text
from optics.errors import UnknownKey
from optics.fit.compare import Row as Scored
from optics.fit.compare import compare
from optics.fit.result import Fit
from optics.pages.report import _candidate, estimated, measure, scatter
from optics.scene.parameter import Parameter, Values, Variable
from optics.study.checks import after_calibration
from optics.words import NO_LIMIT, NOT_DETERMINED, Reach, below, share_text, times_sd, with_sd


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


RETARD = Parameter("retard", "deg", 0.0, (-720.0, 720.0), plausible=10.0)
ANGLE = Reach(-720.0, 720.0, 10.0)  # deg
SHARE = Reach(0.0, 1.0, 0.1)
FREE = Reach(plausible=0.2)


@pytest.mark.parametrize(
    "x, sd, reach, text",
    [
        (-723291688102217.0, 2e16, ANGLE, NOT_DETERMINED),  # a linear forecast along what nothing determines
        (900.0, 1.0, ANGLE, NOT_DETERMINED),
        (3.0, 1440.0, ANGLE, NOT_DETERMINED),
        (3.0, 14.0, ANGLE, "3 +- 14 deg"),
        (720.0, 2.0, ANGLE, "720.0 +- 2.0 deg"),  # at its bound
        (1.0 + 1e-9, 0.1, SHARE, "1.00 +- 0.10 deg"),  # of rounding
        (0.2, 1.2, SHARE, NOT_DETERMINED),
        (0.2, 199.0, FREE, "0 +- 199 deg"),
        (0.2, 201.0, FREE, NOT_DETERMINED),
        (math.nan, 1.0, Reach(), NOT_DETERMINED),
        (math.inf, 1.0, Reach(), NOT_DETERMINED),
        (0.31, math.inf, Reach(), NOT_DETERMINED),
        (0.31, math.nan, Reach(), "0.31 deg (error unknown)"),
        (0.31, None, SHARE, "0.31 deg (error unknown)"),
        (0.31, 0.0, SHARE, "0.31 deg"),
    ],
)
def test_a_number_that_means_nothing_is_not_written_as_a_number(x, sd, reach, text):
    assert with_sd(x, sd, unit="deg", reach=reach) == text
    assert with_sd(x, sd, True, "deg", reach) == text.replace("+-", "±")


@pytest.mark.parametrize(
    "limit, start, reach, text",
    [
        (0.55, 0.0, SHARE, "< 0.55"),
        (1.0, 0.0, SHARE, NO_LIMIT),  # every value that it can have is below
        (0.9, 0.5, Reach(0.0, 1.0, 1.0), NO_LIMIT),  # of a change from 0.5 either way
        (0.4, 0.5, Reach(0.0, 1.0, 1.0), "< 0.4"),
        (99.0, 0.0, ANGLE, "< 99"),
        (101.0, 0.0, ANGLE, NO_LIMIT),  # ten times its plausible size
        (math.inf, 0.0, ANGLE, NO_LIMIT),
        (math.nan, 0.0, ANGLE, NO_LIMIT),
    ],
)
def test_a_limit_that_excludes_nothing_is_none(limit, start, reach, text):
    assert below(limit, reach=reach, start=start) == text


def test_a_shift_without_an_error_has_no_count_of_sd():
    assert [times_sd(x) for x in (3.14, -0.2, math.inf, math.nan)] == ["+3.1 sd", "-0.2 sd"] + ["error unknown"] * 2


def row(**given):
    """A row of a diagnosis: an effect with one strength or several."""
    count = len(given.get("upper", [0.0]))
    known = {
        "name": "retardance",
        "variables": [f"sample.retard_{i}" for i in range(count)],
        "units": ["deg"] * count,
        "form": "tangent",
        "start": [0.0] * count,
        "change": [5.0] * count,
        "sd": [1.0] * count,
        "confused_with": "",
        "upper": [9.0] * count,
        "low": [-720.0] * count,
        "high": [720.0] * count,
        "plausible": [10.0] * count,
    }
    rest = {f.name: 0.001 for f in fields(Row) if f.default is MISSING and f.default_factory is MISSING}
    return Row(**{**rest, **known, **given})


def test_strengths_and_limits_of_a_diagnosis_say_where_they_mean_nothing():
    silly = [-723291688102217.0, 3.0]
    assert strength_text(silly, [1e16, 1.0], ["deg", "deg"], [ANGLE, ANGLE]) == "not determined, 3.0 +- 1.0 deg"
    assert strength_text(silly[:1], [1e16], ["deg"], [ANGLE]) == NOT_DETERMINED
    assert strength_text(silly * 2, [1e16, 1.0] * 2, ["deg"] * 4, [ANGLE] * 4) == "4 values up to 3.0 +- 1.0 deg"
    assert strength_text(silly[:1] * 4, [1e16] * 4, ["deg"] * 4, [ANGLE] * 4) == "4 values, not determined"
    assert strength_text([0.0], [math.nan], ["deg"], [ANGLE]) == NOT_DETERMINED  # the projection left nothing of it
    assert limit_text(row()) == "retardance < 9 deg"
    assert limit_text(row(upper=[9.0, 1e5])) == "retardance: no limit"  # one of its strengths may be anything
    assert limit_text(row(upper=[math.nan, math.nan])) == "retardance: nothing visible"


def test_a_fit_says_what_the_captures_do_not_determine():
    variables = [Variable(f"sample.retard_{i}", (f"sample.retard_{i}",), RETARD) for i in range(3)]
    covariance = np.diag([4.0, np.inf, np.nan])
    found = Fit(Values(), variables, np.array([12.0, 3.0, 5.0]), covariance, 10.0, 10, [0], [10.0], [12], True, "done")
    first, second, third = found.table().splitlines()[1:4]
    assert first.split()[1:3] == ["12", "2"] and "not determined" in second and "inf" not in second
    assert third.split()[1:3] == ["5", "?"] and "nan" not in third
    page = found._repr_html_()
    assert "12.0 ± 2.0" in page and "not determined" in page and "error unknown" in page


def test_tables_fit_the_terminal():
    rows = [("parameter of a part", "value", "unit", "bounds of it", "neutral", "a derivative's way", "what it means")]
    rows.append(("led_1.power_of_one", "1.23456", "W/sr", "0 .. 1000", "-", "central differences", "words " * 20))
    wide = words.table(rows)
    assert len(wide) > 200
    for width in (80, 100):
        with words.fitting(width):
            narrow = words.table(rows)
        assert max(map(len, narrow.split("\n"))) <= width
        assert "".join(narrow.split()).count("words") == 20
    assert words.table(rows) == wide  # to a file or a program


def test_prose_stands_under_its_row_where_the_line_is_narrow():
    rows = [("key", "value", "unit", "bounds", "meaning"), ("camera.principal_x", "12", "px", "0 .. 1", "word " * 20)]
    short, notes = [row[:2] for row in rows], ["", rows[1][-1]]
    assert words.annotated(rows, short, notes) == words.table(rows)
    with words.fitting(60):
        head, row, *below = words.annotated(rows, short, notes).splitlines()
    assert head.split() == ["key", "value"] and row.split() == ["camera.principal_x", "12"]
    assert below and all(len(line) <= 60 and line.startswith("    word") for line in below)
    with words.fitting(200):
        assert words.annotated(rows, short, notes) == words.table(rows)


def test_what_would_break_a_row_is_no_part_of_it():
    lines = words.table([("file", "ssim"), ("a\nb\x1b[31m.png", "1")]).split("\n")
    assert lines == ["file          ssim", "a?b?[31m.png  1"]


def test_rows_with_notes_fit_the_line():
    """83 columns with two spaces between them: one space is enough. 40: the long cells go over several lines."""
    row = ("a_part_of_a_scene.a_parameter", "-0.000123456", "1/mm^2", "-1000 .. 1000", "0.123456789", "word " * 20)
    rows = [("key", "value", "unit", "bounds", "neutral", "meaning"), row]
    short, notes = [r[:5] for r in rows], ["", row[-1]]
    for width, lines in ((80, 2), (60, 3)):
        with words.fitting(width):
            text = words.annotated(rows, short, notes).splitlines()
        assert max(map(len, text)) <= width
        assert len([line for line in text if not line.startswith("    word")]) >= lines
        for cell in row[:5]:
            assert cell.replace(" ", "") in "".join("".join(text).split()) or width < 80


PAGE = """A gel.

Definition
    D0 = clip(press_depth + z0 - m - h, 0, thickness)          h(x, y): height of the indenter over its lowest point
and the skin that lies beside the contact falls off as an exponential of the distance, before it is smoothed by a
Gaussian.
This is a line that its writer filled to the end of the line of the file, and below it there stands a heading
Validity
    pitch: mm, of the mesh
    extent: mm, of the map"""


def test_a_page_is_filled_anew_for_the_terminal():
    assert words.reflowed(PAGE) == PAGE and words.wrapped(PAGE) == PAGE  # to a file or a program
    with words.fitting(60):
        lines = words.reflowed(PAGE).split("\n")
    assert max(map(len, lines)) <= 60 and "".join("".join(lines).split()) == "".join(PAGE.split())
    start = lines.index("    D0 = clip(press_depth + z0 - m - h, 0, thickness)")
    assert lines[start + 1].startswith("        h(x, y)")  # goes on to the right of where it began
    assert "it is smoothed by a Gaussian." in " ".join(lines) and len(lines[start + 3]) > 45  # one paragraph, filled
    assert {"Definition", "Validity", "    pitch: mm, of the mesh", "    extent: mm, of the map"} <= set(lines)


def test_words_and_numbers_of_a_table_stay_whole():
    head = ("by frame", "values", "used", "chi2/dof", "bias DN", "rms DN", "noise DN", "L1", "PSNR dB", "SSIM")
    row = ("reading 3", "1152", "100.0 %", "42.612", "-10.260", "14.093", "2.104", "0.0487", "24.87", "0.5209")
    with words.fitting(80):
        lines = words.table([head, row], left=(0,)).splitlines()
    assert len(lines) == 2 and max(map(len, lines)) <= 80 and "chi2/dof" in lines[0] and "100.0 %" in lines[1]
    with words.fitting(20):  # no room for them
        assert words.table([head, row]).count("\n") > 1


def test_a_pages_table_says_what_a_step_does_not_determine():
    known = {"value": 12.0, "sd": 2.0, "plausible": 10.0, "bounds": [-720.0, 720.0]}
    assert estimated(known) == "12.0 ± 2.0"
    assert estimated({**known, "sd": "inf"}) == estimated({**known, "value": 1e9}) == NOT_DETERMINED
    assert estimated({"value": 12.0, "sd": None, "plausible": 10.0}) == "12 (error unknown)"  # of an older study
    assert scatter((0.98, math.nan)) == "0.98" and scatter((0.9, 0.01)) == "0.900 ± 0.010"


def test_a_page_shows_no_strength_or_limit_that_means_nothing():
    plain = {"name": "retardance", "units": ["deg"], "low": [-720.0], "high": [720.0], "plausible": [10.0]}
    silly = {**plain, "start": [0.0], "change": [-7.2e14], "sd": [1e16], "upper": [1e16], "of_plausible": 7e13}
    shown = _candidate({**silly, "image": 5e9, "p_family": 0.5})
    assert shown["cells"]["strength"] == NOT_DETERMINED and shown["limit"] == NO_LIMIT
    assert shown["cells"]["plausible"] == shown["cells"]["image"] == "–"
    good = _candidate({**plain, "start": [0.0], "change": [5.0], "sd": [1.0], "upper": [7.0], "p_family": 0.5})
    assert good["cells"]["strength"] == "5.0 ± 1.0 deg" and good["limit"] == "< 7 deg"


@pytest.mark.parametrize("x, text", [(-0.009, "0%"), (0.043, "4%"), (1.03, "100%"), (math.nan, "-"), (None, "-")])
def test_a_share_is_a_part_of_a_whole(x, text):
    assert share_text(x) == text and share_text(x, typeset=True) == text.replace("%", "\u202f%").replace("-", "–")


def test_a_model_without_light_misses_no_share_of_it():
    """Its mean may lie below black by rounding: a share of it says nothing."""
    level = {f.name: 0.0 for f in fields(Scored)} | {"scope": {}, "rms": 50.0, "noise": 2.0}
    said = [
        after_calibration(None, SimpleNamespace(variables=[], estimate=[], sd=[]), Scored(**level | {"signal": s}))
        for s in (-1e-9, 100.0, 150.0)
    ]
    assert "sends no light, and misses the images by 50 DN" in said[0][0]
    assert "by 50% of its own mean" in said[1][0] and len(said[2]) == 1


def test_a_comparison_without_freedom_or_scatter_has_dashes():
    """One reading, to which one number was fitted: no degree of freedom, no window, no scatter over frames."""
    one = np.full((1, 1, 1), 100.0)
    text = compare([one], [one], [one / 50], [one > 0], parameters=1).text()
    assert "nan" not in text and "inf" not in text and "over frames, one of them: L1 0.0000, SSIM -, PSNR - dB" in text
    two = compare([one] * 2, [one * 1.1] * 2, [one / 50] * 2, [one > 0] * 2).text()
    assert two.endswith("over frames, mean and sd: L1 0.0392 +- 0.0000, SSIM -, PSNR 28.13 +- 0.00 dB")


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


@pytest.mark.parametrize("left, told", [(1.0, True), (1.9, True), (2.2, False)])
def test_a_claim_beside_much_misfit_rules_nothing_out(left, told):
    """Limits of effects are those of a model from which one of them may be missing still."""

    basis = SimpleNamespace(dof=1000, noise=0.01)
    claimed, other = row(name="retardance"), row(name="leak")
    best = SimpleNamespace(
        effects=["retardance"],
        survives=True,
        complete=False,
        excess_sd=(left - 1) * math.sqrt(1000 / 2),
        structure_p=1e-9,
        name="retardance",
        told={},
        variables=[],
        strength=[],
        sd=[],
        units=[],
    )
    levels = [SimpleNamespace(held_out=0.05), SimpleNamespace(held_out=0.02)]
    f = SimpleNamespace(lead=100.0, against="leak", uneven=0.001, uneven_certain=False)
    text = _claim(f, claimed, [claimed, other], [best], levels, [], basis)
    assert ("Upper limits of other effects: leak" in text) is told
