"""Light that a window returns: the hemispherical reflectance of its outer face against stock Mitsuba's `path`."""

import numpy as np
import pytest

RHO, THICK, WIDE = 0.6, 1.0, 4000.0  # the face's reflectance; mm; 2000 thicknesses to the side are lit


def reflectance(index):
    """R = 2 int r(c) c dc of unpolarized light inside, by Fresnel."""
    c = (np.arange(200_000) + 0.5) / 200_000
    sin = index * np.sqrt(1 - c * c)
    t = np.sqrt(np.maximum(1 - sin * sin, 0.0))
    rs, rp = ((index * c - t) / (index * c + t)) ** 2, ((c - index * t) / (c + index * t)) ** 2
    return float(2 * np.mean(np.where(sin >= 1, 1.0, (rs + rp) / 2) * c))


def test_reflectances_that_the_page_gives():
    assert reflectance(1.41) == pytest.approx(0.536, abs=5e-4) and reflectance(1.5) == pytest.approx(0.596, abs=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
@pytest.mark.parametrize("index, slope, limit", [(1.41, 0, 0.0), (1.5, 0, 0.0), (1.41, 45, 0.02), (1.5, 45, 0.05)])
def test_a_wide_face_under_a_window(variant, index, slope, limit):
    """A face of reflectance rho that sends out 1/pi itself, under a window: g = rho R/(1 - rho R) more comes from it.
    A small facet that slopes gets the same within the limit that the page gives, besides what it sees of the
    face. By `path`, with its own error."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f
    face = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": RHO}}
    glow = {"type": "area", "radiance": {"type": "spectrum", "value": 1 / np.pi}}
    camera = {
        "type": "perspective",
        "fov": 1.0,
        "near_clip": 1e-4,
        "to_world": transform().look_at(origin=[0, 0, 0.5], target=[0, 0, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 4096},
    }
    parts = {
        "face": {"type": "rectangle", "to_world": transform().scale(WIDE), "bsdf": face, "emitter": glow},
        "window": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, THICK]).scale(WIDE),
            "bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0},
        },
    }
    cos = np.cos(np.radians(slope))
    if slope:  # dark itself, just above the face
        tilt = transform().translate([0, 0, 0.05]).rotate([0, 1, 0], slope).scale(0.02)
        parts["facet"] = {"type": "rectangle", "to_world": tilt, "bsdf": face}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 24}, "camera": camera, **parts})
    image = np.array(mi.render(scene, seed=5))[..., 0]
    found, error = image.mean(), image.std() / np.sqrt(image.size)
    total = 1 / np.pi / (1 - RHO * reflectance(index))  # radiance of the face, all returns together
    if not slope:
        assert abs(found - total) < 4 * error and error < 2e-3 * total
        return
    returned = RHO * reflectance(index) * total  # what a flat facet would send on from the window
    beside = RHO * (1 - cos) / 2 * total  # and from the face that a slope sees
    assert abs((found - beside) / returned - 1) < limit + 4 * error / returned
