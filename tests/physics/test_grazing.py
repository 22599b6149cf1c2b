"""Second directions near the horizon: their density is theirs, and what a level skin shows its flanks is right."""

from __future__ import annotations

import numpy as np
import pytest

DRAWN = 2**14
TILTS = (0.0, 0.5, 12.0, 40.0, 80.0)  # deg


def directions(mi, tilt, up, seed=0):
    """(normal, directions, 1/density with 0 for those that do not count) of a surface tilted from the level."""
    import drjit as dr
    from scipy.stats import qmc

    from optics.light import grazing

    u = qmc.Sobol(6, rng=np.random.default_rng(seed)).random(DRAWN).astype("f").T
    a = np.radians(tilt)
    components = (np.sin(a) * 0.6, np.sin(a) * 0.8, up * np.cos(a))
    n = mi.Vector3f(*(mi.Float(np.full(DRAWN, c, "f")) for c in components))
    own = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[0], u[1])))
    w, counts = grazing.drawn(n, mi.Float(u[2]), mi.Point2f(u[3], u[4]), own)
    law = dr.maximum(dr.dot(n, w), 0) / dr.pi
    p = grazing.density(n, w, law)
    weight = np.array(dr.select(counts & (p > 0), 1 / p, 0.0))
    return np.array(n).T[0], np.array(w).T, weight


@pytest.mark.parametrize("up", (1, -1))
@pytest.mark.parametrize("tilt", TILTS)
def test_means_are_those_of_the_hemisphere(mitsuba, tilt, up):
    """Integrals over the hemisphere of 1, and of what a level face fills of it: form factor (1 - cos(theta))/2. Errors
    of 2^14 points of a Sobol sequence at jumps of the density are 1e-3."""
    n, w, weight = directions(mitsuba, tilt, up)
    cosine = np.maximum(w @ n, 0.0) / np.pi
    assert np.allclose(np.linalg.norm(w, axis=1), 1.0, atol=1e-5)
    assert np.mean(cosine * weight) == pytest.approx(1.0, abs=4e-3)
    level = (1 - np.cos(np.radians(tilt))) / 2
    assert np.mean(cosine * weight * (w[:, 2] * up < 0)) == pytest.approx(level, abs=2e-3 * level + 1e-4)
    first = np.mean(cosine * (w @ n) * weight)  # of the cosine: 2/3
    assert first == pytest.approx(2 / 3, abs=3e-3)


@pytest.mark.parametrize("tilt", TILTS[2:])
def test_level_face_is_seen_with_little_noise(mitsuba, tilt):
    """What a flank sees of a level face of one radiance varies less than with directions by the cosine, of which
    (1 - cos(theta))/2 meet it: the share that is drawn in the lune is known, and only that varies."""
    n, w, weight = directions(mitsuba, tilt, -1, seed=1)
    value = np.maximum(w @ n, 0.0) / np.pi * weight * (w[:, 2] > 0)
    share = (1 - np.cos(np.radians(tilt))) / 2
    assert value.std() / value.mean() < 0.75 * np.sqrt((1 - share) / share)
