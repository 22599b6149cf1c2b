"""A new effect as a file: a stub with everything in place, or a draft that carries the curve of a diagnosis as a table.

    optics effects new NAME --stage lens                 a formula to fill in, runnable as it stands
    optics effects new NAME --from STUDY --along row     the curve of the study's last diagnosis along 'row'

A draft has one strength: 0 is no effect, 1 the curve as it was found. `optics add STUDY NAME` frees it, and the error
falls by about as much as the diagnosis said; then the table is replaced by a formula, which is smooth, has fewer
numbers and says what the cause is.

A draft records which captures it was drawn from. It fits them by construction, so a diagnosis of the same data does not
test it, wherever the files lie; `optics add` takes it, and the held-out frames judge.

A curve along a coordinate of the camera acts on its image (stages `lens`, `sensor`, `response`). One along a coordinate
of light or geometry is a factor on the light along its path in the gel (stage `segment`), which knows the lit point,
its normal, the lamp and the camera at every value of every parameter: both its derivatives,
in forward mode and by differences, are right. A coordinate that neither sees, such as the distance in pixels to a
contact, cannot be drafted."""

from __future__ import annotations

import json
import keyword
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.diagnosis.fingerprints import NO_DRAFT, SIDE, family_of
from optics.diagnosis.result import Diagnosis, Fingerprint
from optics.errors import OutputExists, UnknownKey
from optics.files.output import write_text
from optics.scene import loader as scenes
from optics.scene import trust
from optics.scene.declare import STAGES
from optics.scene.mitsuba_parts import is_taken
from optics.scene.registry import Registry, known
from optics.scene.trust import Named
from optics.study import places
from optics.study.record import Record
from optics.study.setup import recorded

BENT = 0.5  # the largest relative change that a strength of 1 is called plausible for
CELLS = ("place", "channel")  # coordinates of cells, each with a value of its own: none lies between two of them
VIEW = (
    "astray",
    "u",
    "v",
    "px",
    "py",
    "tan",
    "focal",
    "site",
    "width",
    "height",
    "side",
    "bands",
    "white",
    "settings",
    "time",
)  # what functions see as `camera` beside its parameters


@dataclass(frozen=True)
class Carrier:
    """Where a curve along a coordinate can act: the stage, and the coordinate as the stage's function computes it
    (lines of code)."""

    stage: str
    lines: tuple[str, ...]
    words: str


def _surface(*lines: str, words: str) -> Carrier:
    return Carrier("segment", lines, words)


TO_LED = "to_led = path.lamp - path.p"
TO_LED_UNIT = "to_led = to_led / dr.maximum(dr.norm(to_led), 1e-6)"
TO_CAMERA = "to_camera = dr.normalize(path.camera - path.p)"
NORMAL = "normal = path.si.sh_frame.n"
ANGLE = "x = dr.rad2deg(dr.safe_acos({}))"

CARRIERS = {
    "row": Carrier("lens", ("x = camera.v - 0.5",), "row of the image, px from the top"),
    "column": Carrier("lens", ("x = camera.u - 0.5",), "column of the image, px from the left"),
    "radius": Carrier("lens", ("x = camera.tan * camera.focal",), "distance to the principal point, px"),
    "place": Carrier(
        "lens",
        (f"x = (camera.v - 0.5) * {SIDE} // camera.height * {SIDE} + (camera.u - 0.5) * {SIDE} // camera.width",),
        f"cell of a map of {SIDE} x {SIDE}, row by row",
    ),
    "channel": Carrier("sensor", ("x = np.arange(image.shape[-1])",), "channel"),
    "signal": Carrier("response", ("x = image",), "signal, 1 = full scale"),
    "height": _surface("x = -path.p.z", words="height of the lit point over the untouched face, mm"),
    "slope": _surface(NORMAL, ANGLE.format("-normal.z"), words="slope of the lit point, deg"),
    "emission": _surface(
        NORMAL, TO_CAMERA, ANGLE.format("dr.dot(normal, to_camera)"), words="angle between normal and camera, deg"
    ),
    "gel_path": _surface(
        NORMAL,
        TO_CAMERA,
        "x = (gel.thickness + path.p.z) / dr.maximum(dr.dot(normal, to_camera), 1e-3)",
        words="thickness of the gel over the cosine to the camera, mm",
    ),
    "press_distance": _surface(
        "x = dr.hypot(path.p.x - gel.press_x, path.p.y - gel.press_y)",
        words="distance to the middle of the press along the skin, mm",
    ),
    "incidence": _surface(
        NORMAL, TO_LED, TO_LED_UNIT, ANGLE.format("dr.dot(normal, to_led)"), words="angle between normal and LED, deg"
    ),
    "led_distance": _surface("x = dr.norm(path.lamp - path.p)", words="distance to the LED, mm"),
    "half_angle": _surface(
        NORMAL,
        TO_CAMERA,
        TO_LED,
        TO_LED_UNIT,
        "x = dr.rad2deg(dr.safe_acos(dr.dot(normal, dr.normalize(to_led + to_camera))))",
        words="angle between the normal and the bisector of the ways to LED and camera, deg",
    ),
    "led_angle": Carrier("emission", (ANGLE.format("beam.cos"),), "angle to the LED's axis, deg"),
}

VIEWS = {  # stage: (the function's arguments, the line that applies a curve, of the variable `curve`)
    "lens": ("image, camera", "return image * (1 + camera.{name} * {curve})[..., None]"),
    "sensor": ("image, camera", "return image * (1 + camera.{name} * {curve})"),
    "response": ("image, camera", "return image * (1 + camera.{name} * {curve})"),
    "segment": ("path, gel", "return 1 + gel.{name} * {curve}"),
    "emission": ("beam, led", "return 1 + led.{name} * {curve}"),
    "reflection": ("geometry, membrane", "return geometry.albedo * (membrane.{name} * {curve} / dr.pi)"),
    "volume": ("path, gel", "return gel.{name} * {curve}"),
    "ambient": ("geometry, membrane", "return geometry.albedo * (membrane.{name} * {curve} / dr.pi)"),
    "surface": ("x, y, gel", 'return gel.number("{name}") * {curve}'),
}
STUBS = {  # stage: the formula, what stands in Definition, coordinates, plausible, how
    "lens": ("camera.tan**2", "I' = I (1 + s f),   f = tan(theta)^2, theta the field angle", "radius", 0.1, "image"),
    "sensor": (
        "(camera.v / camera.height)[..., None]",
        "I' = I (1 + s f),   f = v / height, v the row",
        "row",
        0.05,
        "image",
    ),
    "response": (
        "(1 - image)",
        "m' = m (1 + s f),   f = 1 - m, m the response in units of full scale",
        "signal",
        0.05,
        "image",
    ),
    "segment": (
        "path.view + path.light",
        "L' = L (1 + s f),   f = the way of the light in the gel, mm",
        "gel_path",
        0.01,
        "ad",
    ),
    "emission": (
        "(1 - beam.cos * beam.cos)",
        "kappa' = kappa (1 + s f),   f = sin^2 of the angle to the LED's axis",
        "led_angle",
        0.2,
        "ad",
    ),
    "reflection": (
        "geometry.cos_light * geometry.cos_view",
        "fr' = fr + rho/pi s f,   f = cos_i cos_o",
        "incidence, emission",
        0.1,
        "ad",
    ),
    "volume": (
        "path.view / dr.square(dr.maximum(dr.norm(path.lamp - path.p), 1.0))",
        "L' = L + s f,   f = way to the camera / distance to the LED squared, 1/mm",
        "gel_path, led_distance",
        2e-4,
        "ad",
    ),
    "ambient": (
        "geometry.cos_view",
        "L' = L + rho/pi s f,   f = cos_o; light that no LED made, in the unit of an LED's irradiance",
        "emission",
        2e-4,
        "ad",
    ),
    "surface": (
        "0.05 * np.cos(2 * np.pi * x / 10.0)",
        "z' = z + s f(x, y),   f = 0.05 mm cos(2 pi x / 10 mm)",
        "height, slope",
        1.0,
        "difference",
    ),
}
DEFAULT_STAGE = {"camera": "lens", "led": "emission", "gel": "segment", "membrane": "reflection"}


# -- what a name may be, and where a file goes -----------------------------------------------------------------------
def identifier(name: str) -> str:
    """'Row banding' -> 'row_banding': the name of file and parameter. Raises ValueError for any other."""
    word = re.sub(r"[\s-]+", "_", name.strip().lower())
    if not re.fullmatch(r"[a-z][a-z0-9_]*", word) or keyword.iskeyword(word) or word == "new":
        raise ValueError(
            f"effect name '{name}': allowed: words of letters and digits, the first a letter, such as 'row "
            "banding'; not a "
            "word of Python, and not 'new'"
        )
    return word


def check_name(name: str, part: str, registry: Registry) -> str:
    """The name as an identifier, unless an effect, a parameter of the part, or what its functions see beside parameters
    has it already."""
    word = identifier(name)
    key = word.replace("_", "-")
    if key in registry.effects:
        raise ValueError(
            f"an effect '{registry.effects[key].name}' exists already ({registry.effects[key].file}); choose "
            "another name"
        )
    if any(p.name == word for p in registry.parameters_of(part)):
        raise ValueError(f"the part '{part}' has a parameter '{word}' already; choose another name")
    if is_taken(word) or (part == "camera" and word in VIEW):
        raise ValueError(f"'{word}' means something else to functions of the part '{part}'; choose another name")
    return word


def write(text: str, folder: Path, name: str) -> Path:
    """Write a plugin file; an existing one is kept. Raises OutputExists, or what keeps the folder from being made."""
    from optics.files.output import check_folder

    file = Path(folder) / f"{identifier(name)}.py"
    check_folder(file.parent)
    study = file.absolute().parent.parent
    if file.parent.name != trust.BESIDE or not (study / "ladder.json").is_file():
        return _written(file, text)
    record = Record.open(study, empty=True)
    with record.alone():  # the study's own: it runs from there
        _written(file, text)
        record.note_draft(file)
    trust.remember([file])
    return file


def _written(file: Path, text: str) -> Path:
    if file.exists():
        raise OutputExists(f"{file} exists; choose another name, or change that file")
    write_text(file, text)
    return file


def stage_of(part: str | None, stage: str | None) -> str:
    """The stage that a part, a stage or both name. Raises UnknownKey or ValueError."""
    if part is not None and part not in DEFAULT_STAGE:
        raise UnknownKey(
            part,
            DEFAULT_STAGE,
            "part for a stub",
            hint="effects of other parts: see optics/scene/registry.py, and copy a file of "
            "plugins/effects that acts on the part",
        )
    stage = stage or DEFAULT_STAGE[part or "camera"]
    if stage not in STUBS:
        raise UnknownKey(
            stage,
            STUBS,
            "stage for a stub",
            hint=""
            if stage not in STAGES
            else f"allowed: {', '.join(STUBS)}; for '{stage}' copy a file of plugins/effects that acts there",
        )
    if part is not None and STAGES[stage] != part:
        raise ValueError(
            f"stage '{stage}' belongs to the part '{STAGES[stage]}', not to '{part}'; allowed for '{part}': "
            f"{', '.join(s for s in STUBS if STAGES[s] == part)}"
        )
    return stage


# -- a stub ----------------------------------------------------------------------------------------------------------
def new_effect(name: str, stage: str = "lens") -> str:
    """The text of a plugin file with a formula to fill in; runnable as it stands."""
    word = identifier(name)
    formula, definition, acts, plausible, _ = STUBS[stage]
    call = f"formula({VIEWS[stage][0]})"
    return _file(
        word,
        stage,
        f"{_title(word)}: what it is, in one sentence.",
        definition + "\nwith the strength s; 0 is no effect. REPLACE f by the physics, symbol by symbol.",
        "where it shows in an image, what it looks like, and what tells it from effects that look alike.",
        "what must hold for the formula to be right.",
        "author, title, equation; or where it was measured.",
        body=[
            f"def {call}:",
            '    """f of the definition: what a strength of 1 does."""',
            *_imports(formula),
            f"    return {formula}",
        ],
        applied=VIEWS[stage][1].format(name=word, curve=call),
        check=_rests_at_0(word, stage),
        acts=acts.split(", "),
        needs="what captures must vary for it to be seen",
        plausible=plausible,
    )


def _rests_at_0(word: str, stage: str) -> list[str]:
    """A check that the file must pass; the user replaces it by one of the formula."""
    if STAGES[stage] != "camera":
        return [
            "def rests_at_0():",
            '    """REPLACE by a value of the formula that is known by other means."""',
            f'    assert effect.parameters[0].neutral == 0 and effect.parameters[0].name == "{word}"',
        ]
    return [
        "def rests_at_0():",
        '    """No effect at a strength of 0. Add a value of the formula that is known by other means."""',
        "    from types import SimpleNamespace",
        "",
        "    v, u = np.mgrid[:3, :4] + 0.5",
        f"    camera = SimpleNamespace(u=u, v=v, tan=0.1 * u, focal=10.0, width=4, height=3, {word}=0.0)",
        "    image = np.full((3, 4, 3), 0.5)",
        "    assert (act(image, camera) == image).all()",
    ]


def _imports(code: str) -> list[str]:
    return ["    import drjit as dr", ""] if re.search(r"\bdr\.", code) else []


def _title(word: str) -> str:
    return word.replace("_", " ").capitalize()


# -- a draft ---------------------------------------------------------------------------------------------------------
def drafted(diagnosis: Diagnosis) -> list[str]:
    """Coordinates of a diagnosis that a draft can carry, best first."""
    return [f.coordinate for f in diagnosis.fingerprints if _carrier(f)]


def fingerprint_of(diagnosis: Diagnosis, along: str | None) -> Fingerprint:
    """The curve along a coordinate, or along the one that explains the residual best. Raises ValueError, which names
    those that can be drafted."""
    known = {f.coordinate: f for f in diagnosis.fingerprints}
    if not known:
        raise ValueError("the diagnosis has no curves along coordinates; diagnose the study again")
    can = drafted(diagnosis)
    offer = f"a draft can follow {', '.join(can) or 'none of these curves'}"
    along = along or (diagnosis.families[0].coordinate if diagnosis.families else diagnosis.fingerprints[0].coordinate)
    if along not in known:
        raise UnknownKey(along, known, "coordinate", hint=f"(of this diagnosis; {offer})")
    if along not in can:
        why = NO_DRAFT.get(along, "no stage of a model sees it")
        raise ValueError(f"no draft along '{along}': {why}; {offer}")
    return known[along]


def _carrier(f: Fingerprint) -> Carrier | None:
    """Where a curve can act: along a setting, as a gain of what the camera reads, or along a coordinate of CARRIERS."""
    if _is_setting(f.coordinate):
        return Carrier("sensor", (f'x = camera.settings["{f.coordinate}"]',), f.coordinate)
    return CARRIERS.get(f.coordinate)


def _carried(f: Fingerprint) -> Carrier:
    """Where a curve acts, of one that `fingerprint_of` let through."""
    carrier = _carrier(f)
    if carrier is None:
        raise ValueError(f"no draft along '{f.coordinate}': nothing of the model acts along it")
    return carrier


def _is_setting(coordinate: str) -> bool:
    return "." in coordinate and not coordinate.endswith(".distance")


def draft_effect(
    diagnosis: Diagnosis,
    along: str | None = None,
    *,
    name: str,
    black_level: float,
    saturation: float,
    source: str = "",
    prints: Sequence[str] = (),
) -> str:
    """The text of a plugin file that carries the curve of a diagnosis as a table.

    along                    a coordinate of the diagnosis's fingerprints; None: the one that explains the residual
                             best
    black_level, saturation  DN, of the captures
    source                   where the diagnosis is, for the file's References
    prints                   of the captures that were diagnosed (optics.captures.identity)

    Raises ValueError or UnknownKey for a coordinate that no draft can carry.
    """
    f = fingerprint_of(diagnosis, along)
    _check_words([f.coordinate, f.kind, f.family or "", *prints])
    word, carrier, family = identifier(name), _carried(f), f.family or family_of(f.coordinate)
    stage, part = carrier.stage, STAGES[carrier.stage]
    dark, exact = f.kind == "offset" and part == "camera", f.coordinate in CELLS
    full = saturation - black_level
    at, values, sd = _points(f)
    what, remark, applied = "relative change of the light", "", VIEWS[stage][1]
    if dark:
        stage, what = "response" if stage == "response" else "sensor", "change of the image, 1 = full scale"
        values, sd, applied = values / full, sd / full, "return image + camera.{name} * {curve}"
    elif f.kind == "offset":
        level = diagnosis.basis.signal
        values, sd = values / level, sd / level
        remark = (
            "\nThe curve was found as an offset in DN; here it is a gain, relative to the mean signal of "
            f"{level:.4g} DN. Light that "
            "does not follow the LED is not this."
        )
    if f.coordinate == "signal":
        at = (at - black_level) / full
    if np.abs(values).max() == 0:
        raise ValueError(f"the curve along '{f.coordinate}' is 0 everywhere; there is nothing to draft")
    if part != "camera" and family == "light":
        remark = "\nThe curve was found along the brightest LED of a frame; here every LED has it." + remark
    spread = "[..., None]" if stage == "sensor" and f.coordinate != "channel" and not _is_setting(f.coordinate) else ""
    return _file(
        word,
        stage,
        f"{_title(word)}: drafted from a curve along '{f.coordinate}', cause not known.",
        "\n".join(
            (
                f"I' = {'I + s g(x)' if dark else 'I (1 + s g(x))'}",
                f"x   {carrier.words}",
                f"g   {what}: the table below, of a diagnosis, "
                + ("a value per cell" if exact else "with straight lines between its points"),
                "s   the strength: 0 is no effect, 1 the curve as it was found",
                "REPLACE the table by a formula g(x): it has fewer numbers, is smooth, and says what the cause is.",
            )
        ),
        f"goes with {'the camera' if family == 'camera' else family}: a gain and an offset along '{f.coordinate}' "
        "together lowered "
        f"chi2 by {f.net:.4g}, {f.ratio:.3g} times as much as the best effect of the library; here is the "
        f"{f.kind}, which did more.",
        "for the sensor, and within the range of the coordinate, that the captures had; beyond it the end of the "
        "table holds." + remark,
        f"the diagnosis of {source or 'a study'}.",
        head=[
            *([] if exact else [_table("AT", list(at))]),
            _table("CURVE", [float(f"{v:.4g}") for v in values], f"+- {np.median(sd):.2g}, the median"),
            *([_prints(prints)] if prints else []),
        ],
        drawn=bool(prints),
        body=[
            "def curve(x):",
            f'    """g of the definition: {what}, of the {carrier.words}."""',
            "    return np.asarray(CURVE)[np.asarray(x, int)]" if exact else "    return lookup(x, AT, CURVE)",
        ],
        lines=carrier.lines,
        applied=applied.format(name=word, curve=f"curve(x){spread}"),
        check=[
            "def meets_its_table():",
            *(
                [
                    '    """Every cell has its value. With a formula: a value known by other means."""',
                    "    assert list(curve(range(len(CURVE)))) == CURVE",
                ]
                if exact
                else [
                    '    """The curve meets its ends, and is constant beyond. With a formula: a known value."""',
                    "    assert abs(curve(AT[0]) - CURVE[0]) < 1e-9",
                    "    assert abs(curve(AT[-1] + 1e6) - CURVE[-1]) < 1e-9",
                ]
            ),
        ],
        acts=[f.coordinate, "dark"] if dark else [f.coordinate],
        needs=f"frames that cover the range of {f.coordinate}",
        plausible=float(f"{min(1.0, BENT / np.abs(values).max()):.2g}"),
    )


def _check_words(words: Sequence[str]) -> None:
    """Words that a draft takes over from a study's record, which is data, must not be able to be code."""
    for word in words:
        if not re.fullmatch(r"[\w .,\[\]()/+-]*", word):
            raise ValueError(f"the diagnosis holds {word!r} where a name is meant; diagnose the study again")


def from_study(folder: str | Path, along: str | None, name: str, further: Named = None) -> tuple[str, Path]:
    """The text of a draft from the last diagnosis of a study, and the study's own folder of plugins.

    further   plugins that the name must not clash with, besides those that are found with the study

    Raises ValueError where there is no diagnosis, or where the scene cannot carry the draft.
    """
    study = Record.open(folder)
    index = next((i for i in reversed(range(len(study.steps))) if study.diagnosis(i)), None)
    if index is None:
        raise ValueError(f"{folder}: no diagnosis to draft from; run `optics diagnose {folder}` first")
    diagnosis = Diagnosis.from_json(json.dumps(study.diagnosis(index)))
    f = fingerprint_of(diagnosis, along)
    part = STAGES[_carried(f).stage]
    setup = recorded(study.ladder["facts"]["setup"])
    captures = next((p for p in places.candidates(study.folder, setup.captures) if p.exists()), Path(setup.captures))
    named = study.ladder["scene"]
    scene = (places.scene_named(captures) if captures.exists() else None) or scenes.find(named)
    around = places.plugin_places(study.folder, setup, captures, scene)
    registry = known(*places.code_of(study.folder, study.ladder, setup, around, further))
    text = scene.read_text(encoding="utf-8")

    def holds(role: str) -> bool:
        """Whether the scene's file has a part that plays a role."""
        return any(f'type="{kind}"' in text for kind in registry.kinds(role))

    if part != "camera" and (not holds(part) or holds("clear")):
        carriers = {g.coordinate: _carrier(g) for g in diagnosis.fingerprints}
        can = [name for name, c in carriers.items() if c is not None and STAGES[c.stage] == "camera"]
        raise ValueError(
            f"no draft along '{f.coordinate}': light in the scene {study.ladder['scene']} "
            + (
                "is followed by Monte Carlo, where effects do not act on its path"
                if holds("clear")
                else f"passes no {part}"
            )
            + f"; a draft can follow {', '.join(can) or 'none of these curves'}"
        )
    check_name(name, part, registry)
    noise = study.ladder["noise"]
    return draft_effect(
        diagnosis,
        f.coordinate,
        name=name,
        black_level=noise["black_level"],
        saturation=noise["saturation"],
        source=f"{folder}, step '{study.steps[index]['name']}'",
        prints=[str(p) for p in study.ladder.get("prints") or _sketch(study)],
    ), study.folder / trust.BESIDE


def _sketch(study: Record) -> list[str]:
    """What identifies the captures of a study that did not record it."""
    from optics.captures import capture_set as capture_files
    from optics.captures import identity

    setup = recorded(study.ladder["facts"]["setup"])
    return identity.sketch_of(capture_files.load(places.captures_of(study.folder, study.ladder, setup), setup.outside))


def _points(f: Fingerprint) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(at, values, sd) of the bins that hold data, in rising order, each place once."""
    at, values, sd = (np.array(v, float) for v in (f.centres, f.curve, f.sd))
    if f.coordinate in CELLS:
        return np.arange(len(values), dtype=float), np.nan_to_num(values), np.nan_to_num(sd)
    good = np.isfinite(at) & np.isfinite(values)
    order = np.argsort(at[good], kind="stable")
    at, values, sd = (v[good][order] for v in (at, values, sd))
    once = np.concatenate([[True], np.diff(at) > 0])
    at, values, sd = at[once], values[once], sd[once]
    if len(at) < 2:
        raise ValueError(f"the curve along '{f.coordinate}' has {len(at)} points; a table needs two")
    return at, values, sd


def _table(name: str, values: Sequence[float], remark: str = "") -> str:
    numbers = [f"{v:.7g}," for v in values]
    rows = ["    " + " ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    return "\n".join([f"{name} = [{'  # ' + remark if remark else ''}", *rows, "]"])


def _prints(prints: Sequence[str]) -> str:
    rows = ["    " + " ".join(prints[i : i + 8]) for i in range(0, len(prints), 8)]
    remark = (
        "# the captures that the curve was drawn from: it fits them by construction, so no diagnosis of them tests it"
    )
    return "\n".join([remark, 'DRAWN_FROM = """', *rows, '"""'])


# -- the file --------------------------------------------------------------------------------------------------------
def _file(
    word: str,
    stage: str,
    title: str,
    definition: str,
    fingerprint: str,
    validity: str,
    references: str,
    *,
    body: Sequence[str],
    applied: str,
    check: Sequence[str],
    acts: Sequence[str],
    needs: str,
    plausible: float,
    head: Sequence[str] = (),
    lines: Sequence[str] = (),
    drawn: bool = False,
) -> str:
    """The text: docstring, imports, tables, the curve or formula, the stage's function with its last line `applied`,
    check, declaration."""
    function = [
        f"def act({VIEWS[stage][0]}):",
        '    """The stage\'s function: what the definition says, at the strength that the part has."""',
        *_imports(" ".join([*lines, applied])),
        *(f"    {line}" for line in [*lines, applied]),
    ]
    code = "\n".join([*body, *function, *check])
    imports = [
        *(["import numpy as np", ""] if re.search(r"\bnp\.", code) else []),
        "from optics import Effect, Parameter",
        *(["from optics.lookup import lookup"] if "lookup(" in code else []),
    ]
    sections = {"Definition": definition, "Fingerprint": fingerprint, "Validity": validity, "References": references}
    doc = [f'"""{title}', ""]
    for name, text in sections.items():
        text = text.replace("\\", "/").replace('"', "'")  # folders and steps may be called anything
        doc += [name, *(f"    {line}" for piece in text.split("\n") for line in textwrap.wrap(piece, 125))]
    declaration = [
        "effect = Effect(",
        f'    name="{word.replace("_", " ")}", part="{STAGES[stage]}", stages={{"{stage}": act}},',
        f'    parameters=(Parameter("{word}", "1", 0.0, (-10.0, 10.0), "strength s", neutral=0.0, '
        f'plausible={plausible:g}, how="{STUBS[stage][4]}"),),',
        "    acts=(" + ", ".join(f'"{a}"' for a in acts) + ("," if len(acts) == 1 else "") + "),",
        f'    needs="{needs}", checks=({check[0][4:-3]},){", drafted_from=DRAWN_FROM" if drawn else ""})',
    ]
    blocks = ["\n".join([*doc, '"""']), "\n".join(imports), *(["\n".join(head)] if head else [])]
    functions = ["\n".join(block) for block in (body, function, check, declaration)]
    return "\n\n".join(blocks) + "\n\n\n" + "\n\n\n".join(functions) + "\n"
