"""The comparison against closed forms, scikit-image and itself: masks, NaN, marginals, round trips."""

import csv
import io
import json

import numpy as np
import pytest

from optics.errors import Underdetermined
from optics.fit.compare import Comparison, compare, led_label

H, W, C = 24, 32, 3


def frames(count=3, seed=0, sd=2.0, offset=0.0):
    rng = np.random.default_rng(seed)
    predicted = [100 + 40 * rng.random((H, W, C)) for _ in range(count)]
    measured = [p + offset + rng.normal(0, sd, p.shape) for p in predicted]
    return measured, predicted, [np.full(p.shape, sd) for p in predicted], [np.ones((H, W), bool)] * count


def test_noise_alone_gives_chi2_per_dof_of_one():
    found = compare(*frames())
    n = 3 * H * W * C
    assert found.total.n == n and found.total.share == 1
    assert abs(found.total.chi2_per_dof - 1) < 4 * np.sqrt(2 / n)  # 4 sd of a chi2 with n degrees
    assert abs(found.total.bias) < 4 * 2.0 / np.sqrt(n)
    assert found.total.rms == pytest.approx(found.total.noise, rel=0.05)


def test_constant_offset_has_closed_forms():
    p = [np.full((H, W), 100.0)]
    found = compare([p[0] + 2.55], p, [np.full((H, W), 0.85)], [np.ones((H, W), bool)], black_level=8.0)
    assert found.total.signal == pytest.approx(92.0) and found.total.noise == pytest.approx(0.85)
    assert found.total.bias == pytest.approx(2.55) and found.total.rms == pytest.approx(2.55)
    assert found.total.l1 == pytest.approx(0.01) and found.total.psnr == pytest.approx(40.0)
    assert found.total.chi2_per_dof == pytest.approx(9.0)
    assert found.mean_map == pytest.approx(3.0) and found.rms_map == pytest.approx(3.0)


def test_similarity_is_that_of_scikit_image():
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    y, f, sd, use = frames(2)
    found = compare(y, f, sd, use, names=["a", "b"])
    for i, name in enumerate("ab"):
        x, p = y[i] / 255, f[i] / 255
        assert found.row(frame=name).psnr == pytest.approx(peak_signal_noise_ratio(x, p, data_range=1.0), abs=1e-9)
        assert found.row(frame=name).ssim == pytest.approx(
            structural_similarity(x, p, data_range=1.0, channel_axis=2), abs=1e-9
        )
    values = [found.row(frame=n).ssim for n in "ab"]
    assert found.similarity["ssim"] == pytest.approx((np.mean(values), np.std(values, ddof=1)))


def test_masked_saturated_and_not_finite_values_change_nothing():
    y, f, sd, use = frames(1)
    use = [use[0].copy()]
    use[0][:, :8] = False
    clean = compare(y, f, sd, use)
    y[0][:, :8] = 1e9
    f[0][:, :4] = np.nan
    sd[0][:, 2:6] = 0
    dirty = compare(y, f, sd, use)
    assert dirty.total.share == pytest.approx(0.75)
    for key in ("chi2", "bias", "rms", "l1", "psnr"):
        assert getattr(dirty.total, key) == pytest.approx(getattr(clean.total, key), rel=1e-12)
    assert np.isfinite(dirty.total.ssim) and dirty.total.ssim == pytest.approx(clean.total.ssim, abs=0.02)
    assert np.isnan(dirty.rms_map[:, :8]).all() and np.isfinite(dirty.rms_map[:, 8:]).all()


def test_a_frame_without_usable_values_is_reported_and_last():
    y, f, sd, use = frames(2)
    found = compare(y, f, sd, [use[0], np.zeros((H, W), bool)], names=["seen", "blind"])
    assert found.row(frame="blind").n == 0 and np.isnan(found.row(frame="blind").chi2_per_dof)
    assert found.worst() == [0, 1]
    with pytest.raises(Underdetermined, match="no usable value"):
        compare(y, f, sd, [np.zeros((H, W), bool)] * 2)


def test_marginals_add_up_and_regions_partition():
    y, f, sd, use = frames(4)
    contact = np.zeros((H, W), bool)
    contact[5:12, 5:12] = True
    rim = np.zeros((H, W), bool)
    rim[12:15, 5:12] = True
    found = compare(
        y,
        f,
        sd,
        use,
        [{"contact": contact, "rim": rim}] * 4,
        parameters=10,
        held_out=[3],
        held_out_parameters=3,
        groups={"p0": [0, 1], "p1": [2, 3]},
        leds=["red", "red", "green", "green"],
    )
    for scope in ("frame", "led", "group", "channel", "role", "region"):
        assert sum(r.chi2 for r in found.by(scope)) == pytest.approx(found.total.chi2)
        assert sum(r.dof for r in found.by(scope)) == pytest.approx(found.total.dof)
    assert found.fitted.dof == pytest.approx(3 * H * W * C - 10)
    assert found.held_out.dof == pytest.approx(H * W * C - 3)
    assert {r.scope["region"] for r in found.by("region")} == {"contact", "rim", "far field"}
    assert len(found.by("led", "channel")) == 6 and len(found.by("frame", "region")) == 12


def test_worst_frame_comes_first_and_leds_are_named_by_power():
    y, f, sd, use = frames(3)
    y[1] = y[1] + 5
    settings = [
        {"led_red.power": 1.0, "led_green.power": g, "analyzer.angle": a} for g, a in ((0, 10), (0, 20), (0.5, 20))
    ]
    found = compare(y, f, sd, use, settings=settings)
    assert found.worst()[0] == 1
    assert found.frames[2]["settings"] == {"analyzer.angle": 20.0}  # one power never varied, the other is only switched
    assert [c.centre.tolist() for c in found.curves if c.coordinate == "analyzer.angle"][0] == [10.0, 20.0]
    assert [i["led"] for i in found.frames] == ["led_red", "led_red", "led_red + led_green"]
    assert led_label({}) == "all" and led_label({"a.power": 0.0}) == "none"
    assert led_label({f"{n}.power": 1.0 for n in "abc"}) == "all"


def test_curve_finds_the_coordinate_with_its_error():
    y, f, sd, use = frames(2, sd=1.0)
    radius = np.hypot(*np.mgrid[-H / 2 : H / 2, -W / 2 : W / 2])
    depth = np.where(radius < 8, radius, np.nan)  # NaN: no depth outside the contact
    y = [v + 0.2 * radius[..., None] for v in y]
    found = compare(y, f, sd, use, [{"radius": radius, "depth": depth}] * 2, bins=8)
    curve = next(c for c in found.curves if c.coordinate == "radius" and c.channel == "all")
    assert curve.unit == "px" and len(curve.mean) == 8
    pull = (curve.mean - 0.2 * curve.centre) / curve.se
    assert np.abs(pull).max() < 4
    assert curve.n.sum() == found.total.n
    inner = next(c for c in found.curves if c.coordinate == "depth" and c.channel == "G")
    assert inner.n.sum() == 2 * np.isfinite(depth).sum()
    names = {c.coordinate for c in found.curves}
    assert names == {"radius", "depth", "intensity", "channel", "frame"}
    assert next(c for c in found.curves if c.coordinate == "channel").labels == ("R", "G", "B")


def test_json_and_csv_round_trip():
    y, f, sd, use = frames(2)
    found = compare(y, f, sd, [use[0], np.zeros((H, W), bool)], [{"contact": np.eye(H, W, dtype=bool)}] * 2)
    text = found.to_json()
    json.loads(text, parse_constant=lambda s: pytest.fail(f"{s} is not JSON"))
    again = Comparison.from_json(text)
    assert again.to_json() == text
    assert again.total == found.total
    assert np.array_equal(again.curves[0].mean, found.curves[0].mean, equal_nan=True)
    rows = list(csv.DictReader(io.StringIO(found.to_csv())))
    assert len(rows) == len(found.rows) and float(rows[0]["chi2"]) == found.total.chi2


def test_perfect_prediction_survives_the_round_trip():
    y, f, sd, use = frames(1)
    found = compare(f, f, sd, use)
    assert found.total.psnr == np.inf and found.total.ssim == pytest.approx(1)
    assert Comparison.from_json(found.to_json()).total.psnr == np.inf


def test_text_shows_every_part_in_aligned_columns():
    y, f, sd, use = frames(2)
    text = compare(y, f, sd, use, names=["flat", "press-01"]).text()
    assert "press-01" in text and "chi2/dof" in text and "over frames, mean and sd: L1" in text
    block = text.split("\n\n")[0].splitlines()
    assert len({len(line) for line in block}) == 1


@pytest.mark.parametrize(
    "change, words",
    [
        ({"names": ["one"]}, "names has 1 entries for 2"),
        ({"coordinates": [{"radius": np.zeros((3, 3))}] * 2}, "coordinate 'radius' has shape"),
        ({"full_scale": 0}, "full_scale = 0 DN"),
    ],
)
def test_what_disagrees_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        compare(*frames(2), **change)


def test_shapes_that_disagree_are_refused():
    y, f, sd, use = frames(1)
    with pytest.raises(ValueError, match="frame 0: predicted has shape"):
        compare(y, [f[0][:5]], sd, use)
    with pytest.raises(ValueError, match="no frames"):
        compare([], [], [], [])


def test_small_planes_have_no_similarity_but_all_else():
    one = [np.full((2, 2), 10.0)]
    found = compare([one[0] + 1], one, [np.ones((2, 2))], [np.ones((2, 2), bool)])
    assert np.isnan(found.total.ssim) and found.total.chi2 == pytest.approx(4)
