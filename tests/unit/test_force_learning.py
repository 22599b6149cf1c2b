"""Forces learnt from the motion of beads: labels and metrics by hand, maps on data of a known law, files, training that
resumes."""

import sys

import numpy as np
import pytest

from optics.readers import force_learning as learning
from optics.readers.force_learning import BadFeatures, FeatureSet, ForceModel

FACE = (30.0, 30.0)


def some(n=300, bins=6, seed=0, noise=0.0):
    """Presses at random places whose motion is that of a dent: away from the place, in proportion to the force."""
    rng = np.random.default_rng(seed)
    place, force = rng.uniform(-14, 14, (n, 2)), rng.uniform(0.1, 1.0, n)
    middles = learning.bin_centres(bins, FACE)
    away = middles - place[:, None]
    motion = force[:, None, None] * away / (9 + (away**2).sum(-1, keepdims=True)) + noise * rng.normal(size=away.shape)
    motion = motion.reshape(n, bins, bins, 2)
    size, angle = np.hypot(motion[..., 0], motion[..., 1]), np.arctan2(motion[..., 1], motion[..., 0])
    return FeatureSet(*(a.astype("f") for a in (motion, size, angle, place, force)), FACE, "dense", {"made": "here"})


def test_labels_and_metrics_by_hand():
    """Four bins of 15 mm, numbered row by row, y down."""
    place = np.array([[-1.0, -1.0], [1.0, -14.0], [-15.0, 15.0], [15.0, 15.0]])
    assert learning.bin_of(place, 2, FACE).tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(learning.bin_centres(2, FACE), [[-7.5, -7.5], [7.5, -7.5], [-7.5, 7.5], [7.5, 7.5]])
    y = learning.labels(place[:2], np.array([0.5, 1.0]), 2, FACE)
    np.testing.assert_allclose(y, [[0.5, 0, 0, 0], [0, 1.0, 0, 0]])
    found = np.array([[0.3, 0.1, 0.0, 0.0], [0.0, 0.2, 0.0, -0.6]])  # the second: largest in size in bin 3
    got = learning.scores(y, found, 2, FACE)
    bins = [np.sqrt(0.2**2 / 2), np.sqrt((0.1**2 + 0.8**2) / 2), 0.0, np.sqrt(0.6**2 / 2)]
    assert got["aRMSE"] == pytest.approx(np.mean(bins))
    assert got["d_loc"] == pytest.approx((0 + 15) / 2)
    assert got["RMSE_mc"] == pytest.approx(np.sqrt((0.2**2 + 1.6**2) / 2))
    with pytest.raises(ValueError, match="within the face of 30 x 30 mm"):
        learning.bin_of(np.array([[0.0, 16.0]]), 2, FACE)
    with pytest.raises(ValueError, match="allowed: both"):
        learning.scores(y, found[:1], 2, FACE)


def test_the_split_is_the_published_one():
    train, held, test = learning.split(10_952, 3)
    assert len(test) == 2190 and len(held) == 876 and len(train) == 7886
    assert sorted([*train, *held, *test]) == list(range(10_952))


def test_the_linear_map_is_the_regularised_pseudo_inverse():
    """On its own data: the solution of the normal equations, by another route (a singular value decomposition)."""
    one = some(400, 3)
    model = learning.linear(one, 2, seed=1)
    train, _, test = learning.split(400, 1)
    x, y = one.vectors("linear").astype(float), learning.labels(one.place, one.force, 2, FACE)
    u, s, vt = np.linalg.svd(x[train], full_matrices=False)
    penalty = model.record["penalty"] * s[0] ** 2
    a = vt.T @ np.diag(s / (s**2 + penalty)) @ u.T @ y[train]
    np.testing.assert_allclose(model(one.chosen(test)), x[test] @ a, atol=2e-4)  # N; float32 and a condition of 1e3
    assert learning.scores(y[test], model(one.chosen(test)), 2, FACE)["d_loc"] < 1.5  # mm, of bins of 15 mm


def test_a_force_twice_as_large_is_found_twice_as_large():
    """In the linear map exactly."""
    one = some(400, 3)
    model = learning.linear(one, 2)
    x = one.vectors("linear")
    np.testing.assert_allclose(model.forces(2 * x), 2 * model.forces(x), rtol=1e-4, atol=1e-6)


def test_files_come_back_and_damaged_ones_are_refused(tmp_path):
    one = some(20)
    one.write(tmp_path / "a.npz")
    again = FeatureSet.read(tmp_path / "a.npz")
    for name in FeatureSet.ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    assert again.source == {"made": "here"} and again.face == FACE
    model = learning.linear(some(60), 3)
    model.write(tmp_path / "m.npz")
    np.testing.assert_array_equal(ForceModel.read(tmp_path / "m.npz")(one), model(one))
    with pytest.raises(BadFeatures, match="size is missing|not a file of"):
        FeatureSet.read(tmp_path / "m.npz")
    with pytest.raises(BadFeatures, match="trained with 6 x 6 bins"):
        model(some(20, 5))
    (tmp_path / "half.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:500])
    with pytest.raises(BadFeatures, match=r"half.npz: not a file of optics force-features"):
        FeatureSet.read(tmp_path / "half.npz")
    np.savez(tmp_path / "code.npz", note=np.array([print], dtype=object))  # an object would be unpickled, and so run
    with pytest.raises(BadFeatures, match="not a file of"):
        ForceModel.read(tmp_path / "code.npz")
    with pytest.raises(FileNotFoundError, match="optics force-train"):
        ForceModel.read(tmp_path / "none.npz")
    bad = one.motion.copy()
    bad[3, 0, 0] = np.nan
    with pytest.raises(BadFeatures, match="motion has values that are not finite"):
        FeatureSet(bad, one.size, one.angle, one.place, one.force, FACE, "dense")


def test_without_torch_the_next_step_is_said(monkeypatch, tmp_path):
    from optics.readers.force_training import Plan, train

    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ModuleNotFoundError, match="pip install tactile-optics\\[learn\\]"):
        train(some(), Plan("scaled"), tmp_path / "state")
    with pytest.raises(ValueError, match="allowed: published, scaled"):
        Plan("deep")


# -- networks ----------------------------------------------------------------------------------------------------------
class Stopped(Exception):
    pass


@pytest.fixture
def torch():
    torch = pytest.importorskip("torch")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # layers of two dozen units: a second thread would only wait
    yield torch
    torch.set_num_threads(threads)


@pytest.mark.parametrize("kind", ("published", "scaled"))
def test_a_training_that_was_stopped_comes_to_the_same_map(kind, tmp_path, monkeypatch, torch):
    from optics.readers import force_training as training

    monkeypatch.setattr(training, "SAVED_EVERY", 0.0)
    one, plan = some(200, 4), training.Plan(kind, 3, epochs=6, width=24)
    whole = training.train(one, plan, tmp_path / "whole")
    assert not (tmp_path / "whole").exists()

    def stop(what, done, total):
        if done == 4:
            raise Stopped

    with pytest.raises(Stopped):
        training.train(one, plan, tmp_path / "part", say=stop)
    with pytest.raises(BadFeatures, match="another training"):
        training.train(one, training.Plan(kind, 3, epochs=6, width=24, seed=1), tmp_path / "part")
    again = training.train(one, plan, tmp_path / "part")
    for (w, b), (w2, b2) in zip(whole.layers, again.layers):
        np.testing.assert_array_equal(w, w2)
        np.testing.assert_array_equal(b, b2)
    other = training.train(one, training.Plan(kind, 3, epochs=6, width=24, seed=1), tmp_path / "other")
    assert np.abs(other.layers[0][0] - whole.layers[0][0]).max() > 0.01
    (tmp_path / "bad").write_bytes(b"no archive")
    with pytest.raises(BadFeatures, match="not the state of a training"):
        training.train(one, plan, tmp_path / "bad")


def test_a_trained_map_is_that_of_torch_without_torch(tmp_path, torch):
    """Validation loss of the training against the same number from the map in numpy."""
    from optics.readers import force_training as training

    one = some(200, 4)
    held = one.chosen(learning.split(200, 0)[1])
    y = learning.labels(held.place, held.force, 3, FACE)
    published, scaled = (
        training.train(one, training.Plan(kind, 3, epochs=8, width=24), tmp_path / kind)
        for kind in ("published", "scaled")
    )
    expected = np.sqrt(((published(held) - y) ** 2).mean(0)).mean()
    assert published.record["validation_loss"] == pytest.approx(expected, rel=1e-4)
    found = scaled(held)
    total, k = found.sum(1), y.argmax(1)
    assert found.min() >= 0
    entropy = -np.log(found[np.arange(len(y)), k] / total).mean()
    expected = entropy + (((total - y.sum(1)) / training.RESOLUTION) ** 2).mean()
    assert scaled.record["validation_loss"] == pytest.approx(expected, rel=1e-3)


def test_the_scaled_network_learns_a_law_that_it_has_not_seen_and_starts_from_another(tmp_path, torch):
    from optics.readers import force_training as training

    one, test = some(1500, 6, noise=0.005), some(200, 6, seed=9, noise=0.005)
    model = training.train(one, training.Plan("scaled", 3, epochs=25, width=64), tmp_path / "a")
    y = learning.labels(test.place, test.force, 3, FACE)
    got = learning.scores(y, model(test), 3, FACE)
    # the middle of the face, called for every press, would give 8 mm; a tenth of the presses lie within 0.5 mm of a
    # border, where a half of them is called the other way: 0.5 mm
    assert got["d_loc"] < 1.0
    # the total force: 1500 presses of 0.1 to 1 N; a mean called for every press would give 0.26 N
    assert np.sqrt(((model(test).sum(1) - test.force) ** 2).mean()) < 0.06
    # trained further on another law, the forces twice as large
    other = FeatureSet(one.motion, one.size, one.angle, one.place, 2 * one.force, FACE, "dense")
    further = training.train(other, training.Plan("scaled", 3, epochs=10, width=64), tmp_path / "b", model)
    np.testing.assert_allclose(further(test).sum(1).mean() / model(test).sum(1).mean(), 2.0, rtol=0.05)
    assert further.record["started_from"] == model.record and "started_from" not in model.record
    with pytest.raises(BadFeatures, match="to start from"):
        training.train(other, training.Plan("published", 3), tmp_path / "c", model)


def test_a_linear_map_refuses_presses_without_motion():
    from optics.readers.force_learning import BadFeatures, FeatureSet, linear

    n, still = 30, np.zeros((30, 2, 2))
    one = FeatureSet(np.zeros((n, 2, 2, 2)), still, still, np.zeros((n, 2)), np.ones(n), (20.0, 20.0), "dense")
    with pytest.raises(BadFeatures, match="none of the 22 presses .* moves anything"):
        linear(one, 2)
