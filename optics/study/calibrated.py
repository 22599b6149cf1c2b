"""A calibrated sensor: the scene that a fit belongs to, with the values that were found, to render and to compare.

fit.toml carries all that it takes. Besides the values it has

    [fit]     captures, held_out, parameters, held_out_parameters     what the misfit was counted with
    [sensor]  scene, scene_hash, plugins, flat_field, region, defines, noise  what the values belong to
              plugin_files                                            plugins that do not ship: name -> hash
              settings, frames.NAME                                   what the captures set, in all frames and in each
              drive                                                   the level that frames drove each light with; the
                                                                      calibrated power multiplies it
              uncertainty                                             errors of settings that were found, as nobody
                                                                      states them (optics.diagnosis.dials)
              levels                                                  lights whose values in [frames] are such levels:
                                                                      they were set with an uncertainty
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures import identity
from optics.captures.noise import Noise
from optics.errors import BadScene, UnknownKey
from optics.files.output import file_hash
from optics.fit.compare import Comparison
from optics.fit.scene_model import SceneModel
from optics.scene import loader as scenes
from optics.scene import trust
from optics.scene.loader import Scene
from optics.scene.mitsuba_parts import DEFAULT_VARIANT
from optics.scene.parameter import Values
from optics.scene.trust import Named
from optics.study import places
from optics.study.fit_files import Posterior, fit_file, read_fit
from optics.study.stages import comparison_of


# -- what a step writes ----------------------------------------------------------------------------------------------
def origin_of(
    model: SceneModel, held: Sequence[int] = (), parameters: int = 0, held_parameters: int = 0
) -> dict[str, dict[str, Any]]:
    """What fit.toml says of where its values come from: the entries of [fit] and [sensor] above.

    parameters   numbers that were fitted to the frames that are not held out; held_parameters: to the held-out ones
    """
    captures, noise = model.captures, model.noise
    held_groups = [name for name, own in capture_files.groups(captures).items() if own[0] in set(held)]
    scene: dict[str, Any] = {"scene": str(captures.scene), "scene_hash": file_hash(model.scene.path)}
    own = model.scene.registry.own_files
    if own:
        scene["plugins"] = list(dict.fromkeys(str(file.parent) for file in own))
        scene["plugin_files"] = {
            n.removeprefix(places.OWN): h for n, h in places.own_plugins(model.scene.registry).items()
        }
    flat = any(model.flat_of(index) is not None for index in range(len(model.frames)))
    scene["flat_field"] = str(model.flat_field) if flat else "none"
    scene["region"] = model.region
    scene["defines"] = {name: str(value) for name, value in model.scene.defines.items()}
    scene["settings"] = dict(captures.parameters)
    scene["drive"] = _drives(model)
    if model.drives:
        scene["levels"] = sorted(model.drives)
    scene["noise"] = asdict(noise)
    if model.assumed_errors:
        scene["uncertainty"] = dict(model.assumed_errors)
    if captures.table is None:
        scene["frames"] = {f.name: dict(f.parameters) for f in model.frames if f.parameters}
    counted = {
        "captures": identity.digest_of(captures),
        "held_out": held_groups,
        "parameters": parameters,
        "held_out_parameters": held_parameters,
    }
    return {"fit": counted, "sensor": scene}


COUNTED = ("captures", "held_out", "parameters", "held_out_parameters")  # of [fit], what the misfit was counted with


def origin_toml(data: Mapping[str, Mapping]) -> str:
    """What another file of values, changed by hand, takes over of a fit's tables: TOML, or nothing where it has none.

    data   optics.study.fit_files.read_fit
    """
    import tomlkit

    counted = {key: data["fit"][key] for key in COUNTED if key in data["fit"]}
    tables = {"fit": counted, "sensor": dict(data["sensor"])}
    return "".join("\n" + tomlkit.dumps({name: table}) for name, table in tables.items() if table)


def _drives(model: SceneModel) -> dict[str, float]:
    """The level of each light that frames set: that of all frames that have it on, 1 where these differ, 0 where it
    never is."""
    found = {}
    for key in sorted(model.driven):
        own = [{**f.parameters, **f.readings}.get(key, 0.0) for f in model.frames]
        levels = np.unique(np.concatenate([np.ravel(level) for level in own]))
        levels = levels[levels > 0]
        found[key] = 0.0 if not len(levels) else float(levels[0]) if len(levels) == 1 else 1.0
    return found


# -- the sensor ------------------------------------------------------------------------------------------------------
@dataclass
class Calibrated:
    """A scene and the values that a fit found for it.

    scene    loaded, with the definitions and plugins of the fit
    values   key -> value: what the captures set in every frame, what was fitted, and, of a chosen frame, what it set
             and what was fitted in it
    noise    of the camera that took the captures; None: the file does not say
    notes    what an image of it leaves out
    posterior  what the fit knows of its values; None: the file does not say
    levels   key -> what a calibrated power is multiplied by in `values`
    """

    scene: Scene
    values: dict[str, Any]
    noise: Noise | None = None
    notes: list[str] = field(default_factory=list)
    posterior: Posterior | None = None
    levels: dict[str, float] = field(default_factory=dict)

    @property
    def black(self) -> float:
        """DN without light; 0 where the file does not say."""
        return 0.0 if self.noise is None else self.noise.black_level

    @property
    def saturation(self) -> float:
        """DN, the end of the range; 255 where the file does not say."""
        return 255.0 if self.noise is None else self.noise.saturation


def calibrated(
    fit: str | Path,
    *,
    frame: str | None = None,
    scene: str | Path | None = None,
    defines: Mapping[str, str] | None = None,
    variant: str = DEFAULT_VARIANT,
    plugins: Named = None,
    driven: bool = True,
) -> Calibrated:
    """The sensor that a fit describes.

    fit       a fit.toml, or the folder of a study: that of its last step
    frame     a frame of its captures: what was set in it, and what was fitted in it alone. None: the values that all
              frames share; a light has the power that was found, times the level that frames drove it with
    scene     where the file is elsewhere, or names none: the same scene. Another one is refused
    defines   replace those of the fit, such as {"width": "640"}
    driven    False: lights at drive level 1, for what multiplies their power itself

    Raises FileNotFoundError, BadScene for another scene or one that is gone, UnknownKey for an unknown frame or for a
    value that the scene has no parameter for, OutOfBounds.
    """
    file = fit_file(fit)
    data = read_fit(file)
    sensor = data["sensor"]
    path, notes = scene_of(file, sensor, scene)
    loaded = scenes.load(
        path,
        {**sensor.get("defines", {}), **(defines or {})},
        variant,
        plugins_of_fit(file, sensor, path) if plugins is None else plugins,
    )
    values = _values(file, data, frame, driven)
    noise = noise_of(file, sensor["noise"]) if sensor.get("noise") else None
    if sensor.get("flat_field", "none") != "none":
        notes.append("the study's model holds a measured background, which is no part of the scene: this is without it")
    posterior = Posterior.from_table(data["posterior"], str(file)) if data["posterior"] else None
    for key in () if posterior is None else [key for keys in posterior.keys for key in keys]:
        if key not in loaded.parameters:
            raise UnknownKey(key, loaded.parameters, "parameter", f"{file}: [posterior] keys")
        if not loaded.parameters[key].is_number:
            raise ValueError(f"{file}: [posterior] keys: {key} is a word and no number; calibrate again")
    levels = {
        key: values[key] / data["parameters"][key] for key in sensor.get("drive", {}) if data["parameters"].get(key)
    }
    return Calibrated(loaded, dict(loaded.check(values, str(file))), noise, notes, posterior, levels)


def scene_of(file: Path, sensor: Mapping, given: str | Path | None = None) -> tuple[Path, list[str]]:
    """(XML file, notes) of a fit's scene. Raises BadScene where `given` is another one, or the file is gone."""
    named = str(sensor.get("scene", ""))
    if given is None and not named:
        raise BadScene(f"{file}: it does not name its scene ([sensor] scene); give it: SCENE --fit {file}")
    path = scenes.find(given) if given is not None else _scene_now(file, named, sensor.get("scene_hash"))
    if path is None:
        raise BadScene(f"{file}: its scene {named} is gone; give the file where it is now: SCENE.xml --fit {file}")
    if not named:
        return path, []
    same_content = file_hash(path) == sensor.get("scene_hash")
    if not same_content and not (given is None or (_exists(named) and scenes.find(named) == path)):
        raise BadScene(
            f"{file}: its values belong to the scene {named}, not to {given}; leave the scene out, or take a fit of "
            f"{given}"
        )
    return path, [] if same_content else [f"{path} has changed since it was calibrated"]


def _scene_now(file: Path, named: str, digest: str | None) -> Path | None:
    """A fit's scene: the file of its name, or, where that is gone, one of the same content and name near the study."""
    if _exists(named):
        return scenes.find(named)
    study = places.study_of(file)
    near = [study, study.parent, *study.parent.glob("*/"), *study.glob("*/")]
    if (study / "ladder.json").is_file():
        ladder = json.loads((study / "ladder.json").read_text(encoding="utf-8"))
        near.insert(0, study / ladder.get("near", {}).get("captures", "."))
    files = [folder / Path(named).name for folder in near]
    return next((scenes.find(f) for f in files if f.is_file() and file_hash(f) == digest), None)


def noise_of(file: Path, given: Mapping[str, float]) -> Noise:
    """The noise of [sensor.noise]; raises ValueError where a number is missing, unknown, or not allowed."""
    known = [f.name for f in fields(Noise)]
    required = [f.name for f in fields(Noise) if f.default is MISSING]
    odd = sorted({key for key in given if key not in known} | {key for key in required if key not in given})
    if odd:
        raise ValueError(f"{file}: [sensor.noise]: {', '.join(odd)}; allowed: all of {', '.join(required)}")
    return Noise(**given)  # type: ignore[arg-type]  # two of the fields are true or false


def _exists(name: str) -> bool:
    return Path(name).is_file() if name.endswith(".xml") else name in scenes.shipped_scenes()


def plugins_of_fit(file: Path, sensor: Mapping, scene: Path | None = None) -> list[Path] | None:
    """The plugin files of a fit, by their content, where they were or near the study; None where it has none of its
    own, so that what lies beside the scene is looked at. Raises FileNotFoundError where one is gone, Untrusted."""
    folders = sensor.get("plugins")
    if folders is None:
        return None
    folders = [folders] if isinstance(folders, str) else list(folders)
    study, wanted = places.study_of(file), sensor.get("plugin_files")
    near = [place for folder in folders for place in places.candidates(study, folder)]
    near += [f for place in (study, *([scene.parent] if scene is not None else [])) for f in trust.beside(place)]
    found = {file_hash(f): f for place in near if place.exists() for f in trust.plugin_files(place)}
    if wanted is None:  # as earlier versions wrote it: all that the folder holds
        if not Path(folders[0]).exists():
            raise FileNotFoundError(_gone(file, folders[0]))
        chosen = trust.plugin_files(folders[0])
    else:
        lost = next((name for name, digest in wanted.items() if digest not in found), None)
        if lost is not None:
            there = next((f for f in folders if Path(f).exists()), None)
            raise FileNotFoundError(
                _gone(file, folders[0])
                if there is None
                else f"{file}: its plugin {lost} is gone, or has another content than when the fit was made; give the "
                "folder that holds it by --plugins DIR"
            )
        chosen = [found[digest] for digest in wanted.values()]
    trust.admit_files(chosen, f"that {file} names")
    return chosen


def _gone(file: Path, folder: str) -> str:
    return f"{file}: its plugins were in {folder}, which is gone; give the folder by --plugins DIR"


def _values(file: Path, data: Mapping[str, Mapping], frame: str | None, driven: bool) -> dict[str, Any]:
    """A fit's values by key, as `SceneModel.at` puts them together."""
    sensor = data["sensor"]
    drive = sensor.get("drive", {})
    values = {**sensor.get("settings", {}), **dict.fromkeys(drive, 1.0), **data["parameters"]}
    if frame is None:
        return {**values, **{key: level * values[key] for key, level in drive.items() if driven}}
    known = dict.fromkeys([*sensor.get("frames", {}), *data["frames"]])
    if frame not in known:
        if not known:
            raise ValueError(
                f"{file}: frame '{frame}': the fit has no values of single frames; set what you want by key"
            )
        raise UnknownKey(frame, known, "frame", str(file))
    found, powers = data["frames"].get(frame, {}), {key: values[key] for key in drive}
    for key, value in sensor.get("frames", {}).get(frame, {}).items():
        values[key] = value * powers[key] if key in drive else value
    levels = set(sensor.get("levels", ())) & powers.keys()
    return {**values, **{key: value * powers[key] if key in levels else value for key, value in found.items()}}


# -- its misfit ------------------------------------------------------------------------------------------------------
def tested(
    model: SceneModel, values: Values, fit: str | Path | None = None, held_out: Sequence[str] | None = None
) -> tuple[Comparison, list[str]]:
    """(a model's comparison with its captures, notes): on the captures of the fit, the numbers of the study itself.

    Values of held-out frames are those that the study found, and the fitted numbers count as they did there. Other
    captures are new to the fit: nothing was fitted to them.

    held_out   groups; None: those that the fit held out
    """
    counted = read_fit(fit)["fit"] if fit is not None else {}
    groups = capture_files.groups(model.captures)
    own = "captures" in counted and counted["captures"] == identity.digest_of(model.captures)
    left_out = counted["held_out"] if own else []
    names = left_out if held_out is None else list(held_out)
    for name in names:
        if name not in groups:
            raise UnknownKey(name, groups, "group of frames", str(model.captures.folder))
    held = sorted(i for name in names for i in groups[name])
    notes = []
    if "captures" in counted and not own:
        notes.append("these are not the captures that the fit was made of: none of the frames was fitted")
    if own and set(names) == set(left_out):
        return comparison_of(model, values, held, counted["parameters"], counted["held_out_parameters"]), notes
    return comparison_of(model, values, held), notes
