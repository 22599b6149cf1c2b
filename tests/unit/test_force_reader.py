"""The force from the motion of beads: exact without noise, its error as forecast, and the published thresholds."""

import json

import numpy as np
import pytest

from optics.readers.flow import bin_means, bin_vectors, feature_vector
from optics.readers.force import condition, image_motion, reconstruct, sensitivity
from optics.skin import bead_layouts
from optics.skin.forces import unit_displacements


def beads(count=300):
    points = bead_layouts.draw("1-6 mm", 3, count)
    return points, bead_layouts.CONSTANTS.unit(points)


def test_the_force_is_exact_without_noise():
    points, unit = beads()
    for force in ([0.1, -0.2, 0.7], [0.0, 0.0, 1.0], [0.3, 0.0, 0.0]):
        motion = image_motion(points, unit @ force, 286.0, 20.0)
        np.testing.assert_allclose(reconstruct(points, motion, unit, 286.0, 20.0), force, atol=1e-12)


def test_the_sensitivity_is_the_derivative():
    """Against central differences of the reconstruction by the motion of single beads, at their noise-free motion."""
    points, unit = beads(40)
    force = np.array([0.2, 0.1, 0.5])
    motion = image_motion(points, unit @ force, 286.0, 20.0)
    found = sensitivity(points, force, unit, 286.0, 20.0)
    for j in (0, 7, 33):
        step = np.zeros(motion.size)
        step[j] = 1e-4
        sides = [reconstruct(points, motion + s * step.reshape(-1, 2), unit, 286.0, 20.0) for s in (1, -1)]
        np.testing.assert_allclose((sides[0] - sides[1]) / 2e-4, found[:, j], atol=1e-7 * np.abs(found).max() + 1e-9)
    assert condition(points, force, unit, 286.0, 20.0) == pytest.approx(np.linalg.norm(found))


def test_published_thresholds_and_the_order_of_the_condition_numbers(optics):
    code, out, _ = optics("force-tables", "--draws", "8", "--json")
    found = json.loads(out)
    assert code == 0 and found["agrees"]
    for layout, printed in bead_layouts.PRINTED.items():
        for kind, value in printed.items():
            # 12 %: the printed numbers have two digits, and the constants behind them are lost
            assert found["thresholds"][layout][kind] == pytest.approx(value, rel=0.12), (layout, kind)
    for kind in bead_layouts.FORCES:
        kappa, error = ({la: found[name][la][kind] for la in bead_layouts.LAYOUTS} for name in ("kappas", "errors"))
        assert kappa["1 mm"] > kappa["2 mm"] > kappa["1-6 mm"] > kappa["6 mm"]
        # at a noise of 0.5 px the error is what kappa says; 24 draws of 3 components: 8 % of spread, three times
        assert error["6 mm"] == pytest.approx(0.5 * kappa["6 mm"], rel=0.25)
    assert found["exact"] < 1e-12  # (8) without noise, relative
    # twice the optical centre's distance is another sensor
    code, out, said = optics("force-tables", "--draws", "1", "--distance", "9900", "--beads", "10")
    assert code == 1 and "d - 10 %" in out and "error" not in said  # which would name what nobody gave
    code, out, _ = optics("force-tables", "--draws", "1", "--distance", "40")
    assert code == 1 and "+" in out


def test_thresholds_depend_on_f_over_e_alone():
    """The exact quotient: a threshold falls as 1/(f/E), and is the closed form of one bead below the force."""
    other = bead_layouts.Constants(f_by_e=5200.0)
    one, half = (bead_layouts.threshold("6 mm", "shear", c, draws=2) for c in (bead_layouts.CONSTANTS, other))
    assert half == pytest.approx(one / 2, rel=1e-4)  # half a pixel of motion: the second order is below that
    # Cerruti at nu = 1/2 and the projection, for the bead of a dense layer that moves most along x
    h, d = 6.0, 20.0
    x = np.linspace(0, 15, 3001)
    r = np.hypot(x, h)
    per_newton = 3 * 2600 / (4 * np.pi) * ((1 + x**2 / r**2) / r / (d - h) + x * (x * h / r**3) / (d - h) ** 2)
    # 3000 beads lie 0.5 mm apart, on a peak that is 10 mm wide
    assert one == pytest.approx(0.5 / per_newton.max(), rel=5e-3)


def test_only_f_over_e_is_identified():
    """The same motions from twice the focal length and twice the modulus."""
    points, _ = beads()
    motions = [
        image_motion(points, unit_displacements(points, e, 0.5) @ [0.0, 0.1, 0.4], f, 20.0)
        for f, e in ((286, 0.11), (572, 0.22))
    ]
    # the displacement halves, and its second order in the projection with it: a per cent at these forces
    np.testing.assert_allclose(motions[0], motions[1], atol=0.05 * np.abs(motions[0]).max())


def test_bins():
    places = np.array([[1.0, 1.0], [2.0, 3.0], [9.0, 1.0], [3.0, 9.0], [11.0, 1.0], [1.0, 2.0]])
    motion = np.array([[0.0, 2.0], [0.0, 4.0], [-1.0, 1e-3], [1.0, 0.0], [5.0, 5.0], [np.nan, 0.0]])
    size, angle, count = bin_means(places, motion, (10, 10), 2)
    np.testing.assert_array_equal(count, [[2, 1], [1, 0]])
    np.testing.assert_allclose(size, [[3.0, np.hypot(1, 1e-3)], [1.0, 0.0]])
    np.testing.assert_allclose(angle, [[np.pi / 2, np.pi - 1e-3], [0.0, 0.0]], atol=1e-6)
    # a circular mean: two directions beside -x give -x, and not 0 as their plain mean would
    _, angle, _ = bin_means([[1.0, 1.0], [1.0, 1.0]], [[-1.0, 0.1], [-1.0, -0.1]], (10, 10), 1)
    assert abs(angle[0, 0]) == pytest.approx(np.pi)
    assert feature_vector(size, np.zeros((2, 2))).shape == (8,)
    vectors = bin_vectors(places, motion, (10, 10), 2)
    np.testing.assert_allclose(vectors, [[[0.0, 3.0], [-1.0, 1e-3]], [[1.0, 0.0], [0.0, 0.0]]])


def test_bad_input_is_refused():
    points, unit = beads(5)
    with pytest.raises(ValueError, match="in front of the camera"):
        image_motion(points, unit @ [0, 0, 1.0], 286.0, 5.0)
    with pytest.raises(ValueError, match="allowed: both"):
        bin_means(np.zeros((3, 2)), np.zeros((2, 2)), (10, 10), 2)
    with pytest.raises(ValueError, match="bins"):
        bin_means(np.zeros((3, 2)), np.zeros((3, 2)), (10, 10), 20)
