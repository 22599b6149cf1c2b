"""A polarization camera: analysers on the pixels, from the capture file to the fit, against plain numpy."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures import capture_set
from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.errors import BadCapture
from optics.files.images import write_image
from optics.fit.scene_model import SceneModel
from optics.polarization.mosaic import read_mosaic
from optics.scene import loader
from optics.scene.parameter import Values, Variable
from optics.study.shown import mosaic_of

MOSAIC = ((90.0, 45.0), (135.0, 0.0))
NOISE = Noise(0.1, 1.5, 64.0, 4095.0, 0.0)
SIZE = (16, 20)
LIGHT = ((1.0, 0.3, 0.1), (1.4, -0.2, 0.25), (0.6, 0.1, -0.4), (0.9, 0.0, 0.0))  # level, q, u of the four quarters
PANEL = {
    "panel.power": 0.5,
    **{f"panel.level_{k}": LIGHT[k][0] for k in (1, 2, 3)},
    **{f"panel.dop_{c}{f'_{k}' if k else ''}": LIGHT[k][j] for k in range(4) for j, c in ((1, "q"), (2, "u"))},
}


def plain(film=None, gains=(1.0, 1.0, 1.0, 1.0), e=0.0, turn=0.0, sample=0.0):
    """(H, W) DN by numpy: gain_k/2 [(1 + e) S0 + (1 - e)(S1 cos 2a + S2 sin 2a)], k the site at 0, 45, 90, 135 deg.

    film  angle of an ideal film (T1 = 1) before the camera, deg;   sample  share of the polarization that is lost"""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    quarter = 2 * (rows >= SIZE[0] // 2) + (columns >= SIZE[1] // 2)
    level, q, u = (np.array(LIGHT)[quarter, j] for j in range(3))
    s0, s1, s2 = 0.5 * level, 0.5 * level * q * (1 - sample), 0.5 * level * u * (1 - sample)
    if film is not None:
        c, s = np.cos(2 * np.radians(film)), np.sin(2 * np.radians(film))
        s0 = (s0 + s1 * c + s2 * s) / 2
        s1, s2 = s0 * c, s0 * s
    angle = np.array(MOSAIC)[rows % 2, columns % 2]
    a = 2 * np.radians(angle + turn)
    gain = np.array(gains)[(angle / 45).astype(int)]
    signal = gain / 2 * ((1 + e) * s0 + (1 - e) * (s1 * np.cos(a) + s2 * np.sin(a)))
    return 64 + (4095 - 64) * signal


def model_of(frames, scene=None, **more):
    scene = scene or loader.load("polarization_camera", {"width": SIZE[1], "height": SIZE[0], "mosaic": ""})
    return SceneModel(scene, Captures(Path("."), "polarization_camera", frames, noise=NOISE, mosaic=MOSAIC, **more))


def frame(name, image=None, **settings):
    image = np.zeros(SIZE) if image is None else image
    return Frame(
        name, image[..., None].astype(np.float32), parameters={f"polarizer.{k}": v for k, v in settings.items()}
    )


FILM = {"inserted": 1.0, "transmittance": 1.0}
TOLERANCE = 3.0  # DN of 4095: rays are up to 4.4 deg aslant, where S1 and S2 turn by sin(4.4 deg)^2/2 = 0.003 rad


@pytest.fixture(scope="module")
def model(mitsuba):
    return model_of([frame("bare"), frame("film", angle=30.0, **FILM)])


def test_a_study_notes_the_mosaic_for_its_pages(model):
    assert mosaic_of(model) == {"mosaic": [list(row) for row in MOSAIC]}


def test_a_prediction_is_what_its_analysers_let_through(model):
    site = {"camera.site_extinction": 0.02, "camera.site_turn": 5.0}
    site.update({"camera.site_gain_q": 0.015, "camera.site_gain_u": 0.005, "camera.site_gain_d": -0.025})
    told = {"gains": (0.99, 1.03, 0.96, 1.02), "e": 0.02, "turn": 5.0}
    for values, options in ((PANEL, {}), ({**PANEL, **site}, told)):
        for found, film in zip(model.predict(Values(values)), (None, 30.0)):
            assert np.abs(found[..., 0] - plain(film, **options)).max() < TOLERANCE


@pytest.mark.parametrize(
    "key", ["camera.site_gain_u", "camera.site_extinction", "camera.site_turn", "camera.exposure", "camera.vignetting",
            "panel.power", "panel.dop_u_1", "panel.level_2", "polarizer.offset", "sample.depolarization", "camera.blur"]
)  # fmt: skip
def test_derivatives_of_what_the_sites_see(model, key):
    """By the model's own means against central differences of its predictions, at light of all polarizations."""
    p = model.parameters[key]
    start = {**PANEL, "camera.site_extinction": 0.02, key: PANEL.get(key, p.default)}
    h = 2.5e-4 * p.plausible
    low = max(start[key] - h, p.bounds[0])
    for index in (0, 1):
        _, images = next(iter(model.derivatives(Values(start), [Variable(key, (key,), p)], [index])))
        up, down = (model.predict(Values({**start, key: value}), [index])[0] for value in (start[key] + h, low))
        slope = (up - down) / (start[key] + h - low)
        # 2e-3: curvature over a 4000th of plausible, one-sided at 0; a blur of halves of pixels leaves 8e-4
        found = images.get(key, 0 * slope)
        assert np.linalg.norm(found - slope) <= 2e-3 * np.linalg.norm(slope) + 1e-6


def test_a_lens_blurs_light_before_the_analysers_and_not_the_mosaic(model):
    """In the middle of an evenly lit quarter a blur changes nothing, while it would wipe out a mosaic."""
    sharp, blurred = (model.predict(Values({**PANEL, "camera.blur": v}), [0])[0][..., 0] for v in (0.0, 1.0))
    assert np.abs(blurred - sharp)[2:5, 2:6].max() < 0.5 and np.ptp(sharp[2:5, 2:6]) > 100
    assert np.abs(blurred - sharp)[7:9].max() > 20  # where regions meet it does change something


def test_a_fit_finds_the_stokes_vectors_and_the_camera(mitsuba):
    """Bare light and a film at four angles: light of every region, gains, extinction, turn; pulls of 4 sd."""
    from optics.fit import calibrate

    rng = np.random.default_rng(5)
    told = {"gains": (0.99, 1.03, 0.96, 1.02), "e": 0.02, "turn": 0.7}
    films = [None, 0.0, 40.0, 90.0, 130.0]
    frames = []
    for i, film in enumerate(films):
        image = NOISE.expose(plain(film, **told)[..., None], rng)[..., 0]
        frames.append(frame(str(i), image, **({} if film is None else {"angle": film, **FILM})))
    model = model_of(frames)
    truth = {**PANEL, "camera.site_extinction": 0.02, "camera.site_turn": 0.7}
    truth.update({"camera.site_gain_q": 0.015, "camera.site_gain_u": 0.005, "camera.site_gain_d": -0.025})
    free = [Variable(k, (k,), model.parameters[k]) for k in truth]
    start = {k: 1.0 if "level" in k or "power" in k else 0.0 for k in truth}
    found = calibrate.fit(model, free, Values(start))
    pulls = (found.estimate - np.array([truth[v.name] for v in free])) / found.sd
    assert found.converged and np.abs(pulls).max() < 4, dict(zip(truth, pulls))
    assert abs(found.chi2 / found.dof - 1) < 5 * np.sqrt(2 / found.dof)


def test_effects_of_sites_are_those_of_cameras_with_a_mosaic(mitsuba, model):
    known = model.scene.registry.effects
    bench = loader.load("polarizer_bench")
    for key in ("site-gain", "site-extinction", "site-misalignment"):
        assert model.scene.can_express(known[key]) and not bench.can_express(known[key])


# -- the file --------------------------------------------------------------------------------------------------------
def write_set(folder, first_lines, channels=1):
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / "raw", np.full((4, 6, channels), 900.0), 16)
    (folder / "captures.toml").write_text(
        f'scene = "polarization_camera"\n{first_lines}\n[[frames]]\nimage = "raw.png"\n', encoding="utf-8"
    )
    return folder


def test_a_mosaic_is_read_and_written_back(tmp_path):
    captures = capture_set.load(write_set(tmp_path / "in", "mosaic = [[90, 45], [135, 0]]"))
    assert captures.mosaic == MOSAIC
    again = capture_set.load(capture_set.write(captures, tmp_path / "out", bits=16))
    assert again.mosaic == MOSAIC and np.array_equal(again.frames[0].image, captures.frames[0].image)


@pytest.mark.parametrize(
    "lines, channels, said",
    [
        ("mosaic = [[90, 45], [135]]", 1, "rows of 2, 1 angles"),
        ("mosaic = []", 1, "no table of angles"),
        ('mosaic = "90 45 135 0"', 1, "no table of angles"),
        ("mosaic = [[90, 450], [135, 0]]", 1, "450 is no angle"),
        ('cfa = "RGGB"\nmosaic = [[90, 45], [135, 0]]', 1, "both cfa and mosaic"),
        ("mosaic = [[90, 45], [135, 0]]", 3, "has 3 channels"),
    ],
)
def test_a_wrong_mosaic_is_refused(tmp_path, lines, channels, said):
    with pytest.raises(BadCapture, match=said) as error:
        capture_set.load(write_set(tmp_path, lines, channels))
    assert "captures.toml" in str(error.value) and "allowed" in str(error.value)


def test_a_mosaic_in_words():
    assert read_mosaic("90 45 135 0") == read_mosaic("90 45; 135 0") == MOSAIC and read_mosaic(" ") == ()
    with pytest.raises(ValueError, match="no number"):
        read_mosaic("90 x 135 0")
