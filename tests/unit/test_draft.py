"""Fingerprints by family, and effects drafted from curves: the right family is named, a draft carries its curve, errors name what can be done."""

import json
import sys
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics import draft
from optics.effect import Registry, declared, shipped
from optics.errors import OutputExists, UnknownKey
from optics.evidence import measure
from optics.fingerprints import families, family_of, fingerprints, goes_with, places, unexplained
from optics.lookup import lookup
from optics.verdict import Basis, Family, Fingerprint

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import MockModel, mock_fit, simulate  # noqa: E402

FITTED = (0, 1, 2, 3)
DRIFT = [0.02, -0.04, 0.03, 0.0]


@cache
def case(name, strength):
    """Model, fit, evidence and curves of a mock sensor with an effect that no library holds."""
    model = MockModel(len(FITTED), 24)
    start = simulate(model, np.random.default_rng(3), {name: DRIFT if name == "red_drift" else strength})
    fit = mock_fit(model, model.base_variables(FITTED), start, FITTED)
    evidence = measure(model, fit.values, fit.variables, [], FITTED, 400_000, 0, lambda *a: None)
    return model, fit, evidence, fingerprints(model, evidence, places(model, fit.values, evidence), 1.0, lambda *a: None)


@pytest.mark.parametrize("name, strength, family, coordinates", [
    ("stain", 0.06, "camera", {"place", "row", "column", "radius"}), ("banding", 0.03, "camera", {"row"}),
    ("height_gain", 0.05, "geometry", {"height", "contact_distance", "contact"}),
    ("slope_gain", 0.4, "geometry", {"slope", "contact_distance", "contact"}), ("red_drift", 0.0, "time", {"frame"})])
def test_an_unknown_effect_is_put_into_its_family(name, strength, family, coordinates):
    found = case(name, strength)[3]
    first = families(found)[0]
    assert first.family == family and first.coordinate in coordinates
    assert first.of_best == 1 and all(f.of_best <= 1 / 0.8 for f in families(found))
    assert goes_with(families(found)).startswith(f"It goes with {'the ' if family == 'camera' else ''}{family} ({first.coordinate}")


def test_what_curve_effect_and_neither_explain_adds_up():
    found = case("banding", 0.03)[3]
    row = next(f for f in found if f.coordinate == "row")
    assert 0.5 < row.share < 1.1 and row.unit == "px"
    assert "best effect explains 10%, so 90% is unexplained" in unexplained([replace(row, net=900.0)], 100.0, 1000.0)
    assert "along 'row', explains 90%; 10% neither" in unexplained([replace(row, net=900.0)], 100.0, 1000.0)
    assert unexplained(found, 100.0, 0.0) == ""  # within noise nothing has a share


def test_families_that_explain_alike_are_not_told_apart():
    one, other = Family("camera", "row", 100.0, 0.9, 1.0), Family("geometry", "height", 95.0, 0.85, 0.95)
    assert "or geometry (height 85%), which these captures do not separate" in goes_with([one, other])
    assert "rather than with geometry (height 85%)" in goes_with([one, replace(other, of_best=0.5)])
    assert goes_with([replace(one, net=-1.0)]) == goes_with([]) == ""


def test_a_setting_has_the_family_of_its_part():
    assert [family_of(*a) for a in (("camera.exposure", "camera"), ("source.time", "source"), ("analyzer.angle", "polarizer_film"),
                                    ("led_3.distance", "led"), ("skin.press_depth", "gel"))] == [
        "camera", "time", "setting", "light", "geometry"]


def diagnosis(*found, named=None):
    """As much of a diagnosis as a draft reads."""
    return SimpleNamespace(fingerprints=list(found), families=[named] if named else [], basis=SimpleNamespace(signal=50.0))


def load(text, folder, name):
    """The effect that a text declares; its checks are run."""
    effect = next(declared(draft.write(text, folder, name)))
    for check in effect.checks:
        check()
    return effect


def test_a_draft_carries_its_curve_and_lowers_chi2_by_it(tmp_path):
    model, fit, evidence, found = case("banding", 0.03)
    row = next(f for f in found if f.coordinate == "row")
    assert row.kind == "gain"
    text = draft.draft_effect(diagnosis(*found), "row", name="bands", black_level=model.noise.black_level, saturation=model.noise.saturation)
    act = load(text, tmp_path, "bands").stages["lens"]
    side, black = model.shape[0], model.noise.black_level
    v, u = np.mgrid[:side, :side] + 0.5
    camera = SimpleNamespace(v=v, u=u, bands=1.0)
    flat = act(np.ones((side, side, 3)), camera)
    assert flat[:, 0, 0] - 1 == pytest.approx(row.curve, abs=2e-4 * np.abs(row.curve).max())  # a bin per row, written with 4 digits
    assert (act(np.ones((side, side, 3)), SimpleNamespace(v=v, u=u, bands=0.0)) == 1).all()
    before = after = 0.0
    for frame, sigma, use in zip(evidence.frames, evidence.sigma, evidence.use):
        image, prediction = model.frames[frame].image, model.predict(fit.values, [frame])[0]
        before += float(np.sum((((image - prediction) / sigma)[use]) ** 2))
        after += float(np.sum((((image - black - act(prediction - black, camera)) / sigma)[use]) ** 2))
    # the rest of the fall comes when the base is calibrated again with it
    assert before - after > 0.6 * row.net > 100


def test_the_best_coordinate_is_drafted_unless_one_is_named(tmp_path):
    found = case("height_gain", 0.05)[3]
    height = next(f for f in found if f.coordinate == "height")
    named = Family("geometry", "height", height.net, height.share, 1.0)
    text = draft.draft_effect(diagnosis(*found, named=named), name="falls off", black_level=64.0, saturation=1023.0)
    effect = load(text, tmp_path, "falls off")
    assert (effect.part, list(effect.stages), effect.acts, effect.name) == ("gel", ["segment"], ("height",), "falls off")
    assert "lowered chi2" in effect.doc


def test_an_offset_becomes_what_its_stage_can_do(tmp_path):
    curve = Fingerprint("row", 100.0, 4, 0.0, 96.0, 2.0, "offset", [0.0, 10.0, 20.0], [1.0, -2.0, 1.0], [0.1] * 3, [], "camera")
    options = dict(black_level=5.0, saturation=205.0)
    effect = load(draft.draft_effect(diagnosis(curve), "row", name="amp glow", **options), tmp_path, "amp glow")
    v, u = np.mgrid[:30, :2] + 0.5
    out = effect.stages["sensor"](np.zeros((30, 2, 3)), SimpleNamespace(v=v, u=u, amp_glow=1.0))
    assert out[[0, 5, 10, 20, 29], 0, 0] * 200 == pytest.approx([1.0, -0.5, -2.0, 1.0, 1.0])  # DN
    assert "dark" in effect.acts
    text = draft.draft_effect(diagnosis(replace(curve, coordinate="height", family="geometry")), "height", name="step", **options)
    assert "relative to the mean signal of 50 DN" in text and "0.02, -0.04, 0.02" in text


def test_signal_and_cells_are_read_where_they_are(tmp_path):
    options = dict(black_level=5.0, saturation=205.0)
    curve = Fingerprint("signal", 100.0, 4, 0.0, 96.0, 2.0, "gain", [5.0, 105.0, 205.0], [0.0, 0.1, 0.0], [0.01] * 3, [], "camera")
    bend = load(draft.draft_effect(diagnosis(curve), "signal", name="bend", **options), tmp_path, "bend").stages["response"]
    image = np.array([0.0, 0.25, 0.5, 0.9])
    assert bend(image, SimpleNamespace(bend=1.0)) == pytest.approx(image * (1 + np.array([0.0, 0.05, 0.1, 0.02])))
    slope = bend(image + 1e-30j, SimpleNamespace(bend=1.0)).imag / 1e-30
    step = (bend(image + 1e-6, SimpleNamespace(bend=1.0)) - bend(image - 1e-6, SimpleNamespace(bend=1.0))) / 2e-6
    assert slope[[1, 3]] == pytest.approx(step[[1, 3]], rel=1e-6)  # 0 and 0.5 are corners of the polygon
    cells = replace(curve, coordinate="place", centres=list(range(16)), curve=[0.01 * k for k in range(16)], sd=[0.001] * 16)
    stain = load(draft.draft_effect(diagnosis(cells), "place", name="stain", **options), tmp_path, "stain").stages["lens"]
    v, u = np.mgrid[:10, :14] + 0.5  # sides that four does not divide, as `places` cuts them
    out = stain(np.ones((10, 14, 3)), SimpleNamespace(v=v, u=u, width=14, height=10, stain=1.0))
    row, column = np.mgrid[:10, :14]
    assert out[..., 0] == pytest.approx(1 + 0.01 * (row * 4 // 10 * 4 + column * 4 // 14))


def test_lookup():
    at, values = [0.0, 1.0, 3.0], [1.0, 2.0, -2.0]
    assert lookup(np.array([-5.0, 0.0, 0.5, 1.0, 2.0, 3.0, 9.0]), at, values) == pytest.approx([1.0, 1.0, 1.5, 2.0, 0.0, -2.0, -2.0])
    assert np.imag(lookup(np.array([0.5, 2.0, 9.0]) + 1e-30j, at, values)) / 1e-30 == pytest.approx([1.0, -2.0, 0.0])
    for wrong in ([0.0, 0.0, 1.0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="places rising"):
            lookup(0.5, wrong, values)


# -- what cannot be -----------------------------------------------------------------------------------------------------


def test_what_no_draft_can_carry_is_said_with_what_can():
    known = [Fingerprint(c, 9.0, 1, 0.0, 8.0, 2.0, "gain", [0.0, 1.0], [0.0, 0.1], [0.01] * 2, [], "camera")
             for c in ("laplacian", "row", "contact_distance")]
    options = dict(name="x", black_level=0.0, saturation=1.0)
    with pytest.raises(ValueError, match="no draft along 'laplacian': .* mixes pixels.*; a draft can follow row"):
        draft.draft_effect(diagnosis(*known), "laplacian", **options)
    with pytest.raises(ValueError, match="no stage of a model sees it; a draft can follow row"):
        draft.draft_effect(diagnosis(*known), "contact_distance", **options)
    with pytest.raises(UnknownKey, match="did you mean 'row'"):
        draft.draft_effect(diagnosis(*known), "rows", **options)
    with pytest.raises(ValueError, match="diagnose the study again"):
        draft.draft_effect(diagnosis(), "row", **options)


@pytest.fixture
def study(tmp_path):
    """The record of a study with a diagnosis, as much of it as a draft reads."""
    known = [Fingerprint(c, 9.0, 1, 0.0, 8.0, 2.0, "gain", [0.0, 1.0], [0.0, 0.1], [0.01] * 2, [], "camera") for c in ("row", "height")]
    record = {"format": 1, "scene": "gelsight", "noise": {"black_level": 8.0, "saturation": 255.0}, "inputs": {}, "shown": [],
              "facts": {"setup": {"captures": str(tmp_path / "captures"), "plugins": None}},
              "steps": []}
    told = {"word": "UNKNOWN", "sentence": "", "conditions": [], "rows": [], "ambiguous": [], "compared": [], "gaps": [], "correct": [],
            "splits": [], "levels": [], "shifts": [], "hints": [], "not_tested": {}, "warnings": [],
            "basis": {f.name: [] if f.name.startswith("frame_") else 0 for f in fields(Basis)},
            # as written before coordinates had families
            "fingerprints": [{k: getattr(f, k) for k in ("coordinate", "fall", "dof", "p", "net", "ratio", "kind", "centres", "curve", "sd",
                                                         "labels")} for f in known]}
    folder = tmp_path / "study"
    (folder / "steps" / "00-base").mkdir(parents=True)
    (folder / "ladder.json").write_text(json.dumps(record))
    (folder / "steps" / "00-base" / "step.json").write_text(json.dumps(
        {"index": 0, "name": "base", "folder": "00-base", "effect": None, "frames": [], "fingerprints": []}))
    (folder / "steps" / "00-base" / "diagnosis.json").write_text(json.dumps(told))
    return folder


@pytest.fixture
def own_registry(monkeypatch):
    import optics.effect as declarations

    fresh = Registry()
    fresh.scan(shipped("plugins"))
    monkeypatch.setattr(declarations, "_registry", fresh)
    return fresh


def test_effects_new_writes_a_draft_beside_the_captures_and_never_twice(study, own_registry, optics):
    code, said, noted = optics("effects", "new", "Row bands", "--from", study)
    file = study.parent / "captures" / "plugins" / "row_bands.py"
    assert code == 0 and said.strip() == str(file) and f"optics add {study}" in noted
    text = file.read_text()
    code, _, error = optics("effects", "new", "row bands", "--from", study)
    assert code == 2 and "an effect 'row bands' exists already" in error and file.read_text() == text
    with pytest.raises(OutputExists, match="row_bands.py exists"):
        draft.write("", file.parent, "row bands")
    code, page, _ = optics("effects", "row-bands")
    assert code == 0 and "REPLACE the table" in page and "row_bands.py" in page


def test_effects_new_writes_a_stub(tmp_path, own_registry, optics):
    code, said, _ = optics("effects", "new", "soft edge", "--part", "led", "-o", tmp_path / "mine")
    assert code == 0 and Path(said.strip()) == tmp_path / "mine" / "soft_edge.py"
    code, page, _ = optics("effects", "soft edge", "--plugins", tmp_path / "mine")
    assert code == 0 and "emission" in page


@pytest.mark.parametrize("words, error", [
    (("new",), "no name"), (("new", "2 fast"), "the first a letter"), (("new", "new"), "not 'new'"), (("new", "class"), "not a word of Python"),
    (("new", "lens vignetting"), "exists already"), (("new", "gain"), "has a parameter 'gain'"), (("new", "a", "--stage", "layer"), "copy a file"),
    (("new", "a", "--stage", "lense"), "did you mean 'lens'"), (("new", "a", "--part", "sheet"), "unknown part"),
    (("new", "a", "--part", "gel", "--stage", "lens"), "belongs to the part 'camera'"), (("new", "a", "--along", "row"), "Add --from STUDY"),
    (("vignetting", "--stage", "lens"), "only with `optics effects new NAME`"), (("halo", "bright"), "only with"),
    (("new", "a", "--from", "STUDY", "--along", "rows"), "did you mean 'row'"),
    (("new", "a", "--from", "STUDY", "--stage", "lens"), "leave them out"),
])
def test_errors_of_effects_new(words, error, study, tmp_path, own_registry, optics, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, said, noted = optics("effects", *(study if w == "STUDY" else w for w in words))
    assert code == 2 and error in noted and not said
    assert not (tmp_path / "plugins").exists()


def test_a_study_without_a_diagnosis_or_without_a_gel(study, own_registry, optics):
    record = json.loads((study / "ladder.json").read_text())
    (study / "ladder.json").write_text(json.dumps({**record, "scene": "polarizer_bench"}))
    code, _, error = optics("effects", "new", "a", "--from", study, "--along", "height")
    assert code == 2 and "passes no gel; a draft can follow row" in error
    (study / "steps" / "00-base" / "diagnosis.json").unlink()
    code, _, error = optics("effects", "new", "a", "--from", study)
    assert code == 2 and "optics diagnose" in error


def test_no_effect_is_called_new(tmp_path, own_registry):
    from optics.errors import BadPlugin

    (tmp_path / "new.py").write_text(draft.new_effect("old").replace('name="old"', 'name="new"'))
    with pytest.raises(BadPlugin, match="cannot be called 'new'"):
        own_registry.scan(tmp_path)


# -- residuals in a report ----------------------------------------------------------------------------------------------


def test_components_find_what_frames_have_in_common():
    from optics.ladder import Shown
    from optics.residual_maps import components

    rng = np.random.default_rng(0)
    one, pattern = np.ones((20, 30, 1)), np.sin(np.arange(30) / 3)[None, :, None] * np.ones((20, 1, 1))
    weights = (2.0, -2.0, 1.0, 0.0, 0.0, 0.0)
    frames = [Shown(f"f{i}", w * pattern + rng.standard_normal((20, 30, 1)), 0 * one, one, one > 0) for i, w in enumerate(weights)]
    found = components(frames)
    scores = np.array([float(s["score"].replace("−", "-")) for s in found["components"][0]["scores"]])
    assert scores[0] * scores[1] < 0 and np.abs(scores[:2]).min() > 1 and np.abs(scores[3:]).max() < 0.6
    # 9 w^2/2 sums to 4.5 of the pattern beside 6 of the noise, of which the first component has a sixth
    assert float(found["components"][0]["share"].split("\u202f")[0]) == pytest.approx(100 * (4.5 + 1) / 10.5, abs=8)
    assert components(frames[:2])["components"] == []


def test_regions_tell_a_wrong_mean_from_a_wide_spread():
    from optics.compare import compare
    from optics.residual_maps import regions

    rng = np.random.default_rng(1)
    images = rng.standard_normal((12, 32, 48, 1))
    images[:, :16] += 0.5
    images[:, 16:, 24:] *= 1.6
    c = compare(list(images), [np.zeros((32, 48, 1))] * 12, [np.ones((32, 48, 1))] * 12, [np.ones((32, 48, 1), bool)] * 12)
    found = regions(c)
    assert (found["columns"], found["rows"], found["cell"]) == (16, 11, 3)
    assert 0.4 < float(found["mean_top"]) < 0.95 and 1.4 < float(found["worst"]) < 2.1
