"""Scene XML in and out; the only file that knows Mitsuba's parameter paths.

A scene is a Mitsuba XML file. Every part of ours in it (LED, membrane, camera, gel, interface, integrator) has an id,
and its parameters have the keys `id.name`. Parameters of stock Mitsuba plugins are reachable under Mitsuba's own keys.
"""

from __future__ import annotations

import difflib
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

from optics.errors import BadScene, UnknownKey
from optics.files.output import shipped
from optics.scene import showing
from optics.scene.declare import Effect
from optics.scene.layer import PatternImage
from optics.scene.mitsuba_parts import DEFAULT_VARIANT, Declared, collecting, is_part, use_variant
from optics.scene.parameter import Parameter, Variable
from optics.scene.registry import registry

LED_BY_LED = {
    "emission",
    "segment",
    "volume",
    "reflection",
    "ambient",
}  # stages that light followed by Monte Carlo does not pass
KEEPS = "use 'interface', 'rough_interface' or 'sheet', which keep it"
DEPOLARIZERS = {  # stock materials without a Mueller matrix, by the name that Mitsuba prints
    "ThinDielectric": KEEPS,
    "RoughDielectric": KEEPS,
    "SmoothPlastic": "use 'pplastic'",
    "RoughPlastic": "use 'pplastic'",
    "Principled": KEEPS,
    "The Thin Principled": KEEPS,
    "Hair": "leave it out",
}


def find(name: str | Path) -> Path:
    """The XML file of a shipped scene's name or of a path."""
    path = Path(name)
    if path.suffix == ".xml":
        if not path.is_file():
            raise BadScene(f"{path}: no such scene file; shipped scenes: {', '.join(shipped_scenes())}")
        return path.resolve()
    if str(name) not in shipped_scenes():
        raise UnknownKey(
            str(name), shipped_scenes(), "scene", hint="give a shipped scene's name or a path ending in .xml"
        )
    return shipped("scenes") / f"{name}.xml"


def shipped_scenes() -> list[str]:
    return sorted(p.stem for p in shipped("scenes").glob("*.xml"))


def load(
    name: str | Path,
    defines: Mapping[str, str] | None = None,
    variant: str = DEFAULT_VARIANT,
    plugins: Path | None = None,
) -> Scene:
    """Load a scene by its name or path; `defines` replace the XML's <default>s; `plugins` is a further folder of
    plugins.

    A folder `plugins` beside the user's scene is scanned as well.
    """
    path = find(name)
    for folder in (plugins, path.parent / "plugins"):
        if folder is not None and (folder == plugins or folder.is_dir()):
            registry().scan(Path(folder))
    return Scene(path, dict(defines or {}), variant)


class Scene:
    """A loaded scene: its parts by id, its parameters by key, their values.

    parts        id -> Mitsuba plugin object of ours
    parameters   key -> Parameter, in the order of the file
    camera, integrator, gel, block, leds, membranes    the parts by role (None or empty where the scene has none)
    """

    MOVED = (
        "carried",
        "markers",
        "target",
        "block",
        "cells",
    )  # kinds of shapes besides the gel whose parameters move geometry

    def __init__(self, path: Path, defines: Mapping[str, str], variant: str = DEFAULT_VARIANT):
        self.path, self.defines, self.variant = Path(path), dict(defines), variant
        text = self.path.read_text(encoding="utf-8")
        known = re.findall(r'<default\s+name="([^"]+)"', text)
        for key in self.defines:
            if key not in known:
                raise UnknownKey(key, known, "definition", str(self.path), "-D sets what the XML names in <default>")
        use_variant(variant)
        import mitsuba as mi

        with collecting() as created:
            try:
                # one by one: in parallel the parts are made, and then listed, in an order that changes from run to run
                self.mitsuba = mi.load_file(
                    str(self.path), parallel=False, optimize=False, **{k: str(v) for k, v in self.defines.items()}
                )
            except (RuntimeError, ValueError, TypeError, KeyError) as error:
                raise BadScene(f"{self.path}: {_reason(error, self.path)}") from error
        self.parts: dict[str, Declared] = {}
        for part in created:
            name = part.name
            if not name or re.fullmatch(r"object_\d+|_.*|plugin", name):
                name = part.kind
            if name in self.parts:
                raise BadScene(f"{self.path}: two parts have the id '{name}'; give every part its own id=\"...\"")
            part.name = name
            self.parts[name] = part
        self.camera = self._one("camera")
        self.integrator = self._one("tactile")
        self._nest()
        self.gel, self.block = self._one("gel"), self._one("block")
        if self.block is not None:
            self.block.target = self._one("target")
        if self.integrator is not None and self.integrator.lanes == 1 and len(self.integrator.bands) == 1:
            for part in self.parts.values():
                part.band = self.integrator.bands[0]
        self.leds = {n: p for n, p in self.parts.items() if p.kind == "led"}
        self.sources = {n: p for n, p in self.parts.items() if p.kind in ("source", "room")}
        self.lights = {**self.leds, **self.sources}
        self.membranes = {n: p for n, p in self.parts.items() if p.kind == "membrane"}
        self.parameters: dict[str, Parameter] = {}
        for name, part in self.parts.items():
            for p in registry().parameters_of(part.kind):
                self.parameters[f"{name}.{p.name}"] = p
        self._strain()
        if carried := [p for p in self.parts.values() if hasattr(p, "carry") or p is self.block]:
            self._place(carried)
            self.mitsuba.parameters_changed([])
        self._stock = self._stock_parameters()
        self.parameters.update({k: p for k, (p, _) in self._stock.items() if k not in self.parameters})
        self._now = self._read()
        self._warn_of_depolarizers()

    def _warn_of_depolarizers(self) -> None:
        """Say which stock materials lose all polarization, and nobody says so, in a scene with polarizers."""
        shapes = self.mitsuba.shapes()
        if not any(p.kind == "polarizer_film" for p in self.parts.values()) and not any(
            "LinearPolarizer[" in str(s.bsdf()) for s in shapes
        ):
            return
        for shape in shapes:
            for name, advice in DEPOLARIZERS.items():
                if re.search(rf"\b{name}(\[| BSDF)", str(shape.bsdf())):
                    warnings.warn(
                        f"{self.path}: the material '{name}' of the shape '{shape.id()}' takes all polarization out of the "
                        f"light that it lets through or reflects, whatever the physics; {advice}",
                        stacklevel=2,
                    )

    def _nest(self) -> None:
        """Tell each dielectric body which clear material is around it."""
        clear = {n: p for n, p in self.parts.items() if p.kind == "clear"}
        self.monte_carlo = bool(clear)
        for shape in self.mitsuba.shapes():
            if getattr(shape, "kind", "") == "cells" and getattr(shape.bsdf(), "kind", "") == "clear":
                shape.bsdf().fills_cells = True
        for name, part in clear.items():
            if part.outside and part.outside not in clear:
                raise BadScene(
                    f"{self.path}: '{name}': outside = '{part.outside}'; allowed: the id of a clear material ("
                    f"{', '.join(n for n in clear if n != name) or 'there is no other'}), or nothing for air"
                )
            part.around = clear.get(part.outside)
            part.bands = len(self.integrator.bands) if self.integrator is not None else part.bands

    def _one(self, kind: str):
        found = [p for p in self.parts.values() if p.kind == kind]
        if len(found) > 1:
            raise BadScene(f"{self.path}: {len(found)} parts of the kind '{kind}'; one is allowed")
        return found[0] if found else None

    def _stock_parameters(self) -> dict[str, tuple[Parameter, str]]:
        """Scalar parameters of stock plugins, under Mitsuba's own keys."""
        import mitsuba as mi

        found = {}
        self._traversed = mi.traverse(self.mitsuba)
        for key, (_, _, node, _) in self._traversed.properties.items():
            if is_part(node) or re.match(r"object_\d+\.", key):  # without an id the key is an address of this run
                continue
            value = self._traversed[key]
            if type(value) is mi.Float and len(value) == 1 and not key.endswith("silhouette_sampling_weight"):
                found[key] = (
                    Parameter(
                        key.rsplit(".", 1)[-1],
                        "",
                        float(value[0]),
                        doc="parameter of a stock Mitsuba plugin",
                        plausible=max(abs(float(value[0])) * 0.05, 1e-3),
                        how="difference",
                    ),
                    key,
                )
        return found

    # -- values ---------------------------------------------------------------------------------------------------------

    def values(self) -> dict[str, float | str]:
        """The present value of every parameter."""
        return dict(self._now)

    def records(self) -> list[dict]:
        """One record per parameter (optics.scene.showing.records)."""
        return showing.records(self)

    def _repr_html_(self) -> str:
        return showing.html(self)

    def _read(self) -> dict[str, float | str]:
        now = {}
        for name, part in self.parts.items():
            now.update({f"{name}.{n}": part.number(n) for n in part.numbers})
            now.update({f"{name}.{n}": getattr(part, n) for n in part.words})
        now.update({k: float(self._traversed[m][0]) for k, (_, m) in self._stock.items()})
        return now

    def check(self, values: Mapping[str, float | str], where: str = "") -> dict[str, float | str]:
        """Checked copies of values by key; raises UnknownKey, OutOfBounds or ValueError."""
        checked = {}
        for key, value in values.items():
            if key not in self.parameters:
                raise UnknownKey(key, self.parameters, "parameter", where, "`optics params SCENE` lists them")
            checked[key] = self.parameters[key].check(value, key, where)
        return checked

    def set(self, values: Mapping[str, float | str], where: str = "") -> None:
        """Set parameters by key; geometry is rebuilt once, and only if it changed."""
        import mitsuba as mi

        changed = {k: v for k, v in self.check(values, where).items() if self._now[k] != v}
        rebuild, strained, moved, stock = False, False, set(), False
        for key, value in changed.items():
            if key in self._stock:
                self._traversed[self._stock[key][1]] = mi.Float(value)
                stock = True
                continue
            name, parameter = key.rsplit(".", 1)
            part = self.parts[name]
            if parameter in part.words:
                setattr(part, parameter, value)
                strained |= parameter == "stress_pattern"
            else:
                part.hold(parameter, value)
            rebuild |= part.kind == "gel" and parameter in self.shaping
            if part.kind in self.MOVED:
                moved.add(name)
        self._now.update(changed)
        if stock:
            self._traversed.update()
        if rebuild:
            self.gel.rebuild(mi.traverse(self.gel))
            moved.update(n for n, p in self.parts.items() if hasattr(p, "carry"))
        if self.block is not None and any(self.parts[n] in (self.block, self.block.target) for n in moved):
            moved.update(n for n, p in self.parts.items() if p.kind in ("block", "cells"))
        if rebuild or strained:
            self._strain()
        self._place([self.parts[n] for n in moved])
        if rebuild or moved:
            self.mitsuba.parameters_changed([])

    def _place(self, shapes: list) -> None:
        """Rebuild shapes besides the gel; those in a body that gives way where its present dent carries them."""
        import mitsuba as mi

        for part in sorted(shapes, key=lambda p: self.MOVED.index(p.kind)):
            carrier = getattr(self, getattr(part, "rides", ""), None)
            if carrier is not None:
                part.carry(carrier)
            else:
                part.rebuild(mi.traverse(part))

    def _strain(self) -> None:
        """Hand the sheets their stress patterns: from a file, or the present press's stress in the skin, from their
        depth on both sides alike up to the skin's inner face."""
        from optics.skin.halfspace import SkinStress

        for shape in self.mitsuba.shapes():
            sheet = shape.bsdf()
            if hasattr(shape, "carry") and hasattr(sheet, "carrier"):
                sheet.carrier = shape
            pattern = getattr(sheet, "stress_pattern", "")
            if pattern.endswith((".npy", ".exr")):
                sheet.field = PatternImage(self.path.parent / pattern)
            if pattern == "gel":
                if self.gel is None or not hasattr(shape, "carry"):
                    raise BadScene(
                        f"{self.path}: '{sheet.name}': stress_pattern = 'gel' needs a sheet in the skin, a shape of the "
                        "type 'carried'"
                    )
                thickness = self.gel.number("thickness")
                near = max(2 * shape.number("depth") - thickness, 0.0)
                sheet.field = SkinStress(self.gel, near, thickness)

    @property
    def shaping(self) -> set[str]:
        """Names of gel parameters that move its surface."""
        effects = registry().effects.values()
        return {p.name for p in registry().parts["gel"].parameters} | {
            n for e in effects if "surface" in e.stages for n in (*e.parameter_names, *(p.name for p in e.shape))
        }

    def keys_of(self, effect: Effect) -> dict[str, list[str]]:
        """The effect's parameter names, each with the keys it has in this scene (empty where the scene lacks the
        part)."""
        holders = {n: p for n, p in self.parts.items() if p.kind == effect.part}
        return {name: [f"{n}.{name}" for n, p in holders.items() if p.takes(name)] for name in effect.parameter_names}

    def can_express(self, effect: Effect) -> bool:
        kinds = {p.kind for p in self.parts.values()}
        layered = any(p.how == "layer" for p in registry().effect_parameters(effect))
        if self.monte_carlo and (set(effect.stages) & LED_BY_LED or effect.part == "tactile" or layered):
            return False
        return all(self.keys_of(effect).values()) and kinds.issuperset(effect.requires)

    def variables_of(self, effect: Effect, frames: int = 0) -> list[Variable]:
        """What a calibration frees to add the effect: shared or per part, for all frames or for each."""
        variables = []
        for name, keys in self.keys_of(effect).items():
            parameter = registry().parameter(effect.part, name)
            groups = (
                [(f"{effect.part}.{name}" if len(keys) > 1 else keys[0], tuple(keys))]
                if effect.per == "kind"
                else [(key, (key,)) for key in keys]
            )
            for label, group in groups:
                if effect.scope == "frame":
                    variables += [Variable(f"{label}[{i}]", group, parameter, (i,)) for i in range(frames)]
                else:
                    variables.append(Variable(label, group, parameter))
        return variables


def _reason(error: Exception, path: Path) -> str:
    """Mitsuba's message in one line: what a part raised without its traceback, and the nearest name that exists."""
    text = str(error)
    if "Traceback (most recent call last)" in text:
        before, _, trace = text.partition("Traceback (most recent call last)")
        raised = re.findall(r"^[A-Za-z_][\w.]*: (.*(?:\n(?!\n|At:| ).+)*)", trace, flags=re.M)
        text = before + (raised[-1] if raised else trace)
    text = re.sub(r"(^|[:;] )(\[[^\]]*\]\s*)+", r"\1", " ".join(text.split()))
    text = re.sub(rf'(At|(?:Error w|W)hile loading) "?{re.escape(str(path))}"? \((line[^)]*)\)', r"\2", text)
    parts = registry().parts
    if (unknown := re.search(r'Plugin "([^"]+)" not found', text)) is not None:
        near = difflib.get_close_matches(unknown[1], parts, n=1)
        text += (
            f" Did you mean '{near[0]}'?"
            if near
            else f" Own types are {', '.join(sorted(parts))}; others are Mitsuba's."
        )
    unused = re.search(r'unreferenced propert.* plugin of type "([^"]+)": - \w+ "([^"]+)"', text)
    if unused is not None and unused[1] in parts:
        near = difflib.get_close_matches(unused[2], [p.name for p in registry().parameters_of(unused[1])], n=1)
        text += f"; did you mean '{near[0]}'?" if near else "; `optics params SCENE` lists what it has"
    return text
