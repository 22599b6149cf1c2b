"""Scene XML in and out; the only file that knows Mitsuba's parameter paths.

A scene is a Mitsuba XML file. Every part of ours in it (LED, membrane, camera, gel, interface, integrator) has an id,
and its parameters have the keys `id.name`. Parameters of stock Mitsuba plugins are reachable under Mitsuba's own keys.
"""

from __future__ import annotations

import difflib
import fnmatch
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from optics.errors import BadScene, OutOfBounds, UnknownKey
from optics.files.output import shipped
from optics.scene import showing, trust
from optics.scene.boards import on_board
from optics.scene.crowd import Traced
from optics.scene.declare import LED_BY_LED, Effect, Part
from optics.scene.integral import FEW, Integral, refuse_unseen
from optics.scene.mitsuba_parts import DEFAULT_VARIANT, Declared, is_part, loading, move, use_variant
from optics.scene.parameter import Parameter, Variable, keys_with
from optics.scene.registry import Registry, known
from optics.scene.trust import Named
from optics.scene.wiring import wire
from optics.spectra.curve import Curve

NAME = r"[^/\\\x00-\x1f\x7f]{1,100}"  # of a part
PIXELS_MOST = 50_000_000  # of a camera: a render keeps some hundred bytes for each
# what Mitsuba says before words of a mesh or curve file, which a stranger's scene may have named: /etc/passwd has some
QUOTING = "unknown token|unknown version number|unknown format type|[Cc]ould not parse line|value for field"
ROBUST = "embree_use_robust_intersections"  # of a Mitsuba scene: no ray slips between two triangles
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


def told(name: str | Path) -> tuple[str, str]:
    """What a scene is, and a command worth a first look: the first line of its file's comment, and its line `Look:`;
    empty where it has none."""
    comment = re.search(r"<!--(.*?)-->", find(name).read_text(encoding="utf-8"), re.DOTALL)
    lines = [line.strip() for line in (comment[1] if comment else "").splitlines() if line.strip()]
    look = next((line.removeprefix("Look:").strip() for line in lines if line.startswith("Look:")), "")
    return (lines[0] if lines else ""), look


def load(
    name: str | Path,
    defines: Mapping[str, str] | None = None,
    variant: str = DEFAULT_VARIANT,
    plugins: Named = None,
    found: Sequence[Path] = (),
) -> Scene:
    """Load a scene by its name or path; `defines` replace the XML's <default>s.

    plugins   folders of plugins, or files, beside the shipped ones; "none": no others. None: those that lie in a folder
              `plugins` beside the user's scene, which must be trusted (optics.scene.trust)
    found     further plugin files that may run, whatever `plugins` says
    """
    path, given = find(name), trust.named(plugins)
    more = trust.admit(trust.beside(path.parent), f"beside the scene {path.name}") if given is None else given
    code = trust.compiled(path, dict(defines or {}))
    if given is not None:
        code = [file for file in code if not any(file.resolve().is_relative_to(p.resolve()) for p in given)]
    trust.admit_files(code, "that Mitsuba would load")
    return Scene(path, dict(defines or {}), variant, known(*trust.once(more, found)))


class Scene:
    """A loaded scene: its parts by id, its parameters by key, their values.

    parts        id -> Mitsuba plugin object of ours
    parameters   key -> Parameter, in the order of the file
    camera, integrator, gel, block, leds, membranes    the parts by role (None or empty where the scene has none)
    boards       carriers of LEDs, by id
    powers, power_gains, band_powers    the key of each light's power, of its gain in single frames, and of its powers
                                        in single bands
    """

    def __init__(
        self, path: Path, defines: Mapping[str, str], variant: str = DEFAULT_VARIANT, registry: Registry | None = None
    ):
        self.path, self.defines, self.variant = Path(path), dict(defines), variant
        self.registry = registry or known()
        try:
            text = self.path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise BadScene(f"{self.path}: no text in UTF-8 ({error}); save it as UTF-8") from error
        named = re.findall(r'<default\s+name="([^"]+)"', text)
        for key in self.defines:
            if key not in named:
                raise UnknownKey(key, named, "definition", str(self.path), "-D sets what the XML names in <default>")
        try:
            str(self.path).encode()
        except UnicodeEncodeError as error:
            raise BadScene(
                f"{self.path}: Mitsuba reads no path that is not UTF-8; rename the file or folder"
            ) from error
        use_variant(variant, self.registry)
        with loading(self.registry):
            try:
                # one by one: in parallel the parts are made, and then listed, in an order that changes from run to run
                self._whole = _whole(self.path, self.defines)
            except (RuntimeError, ValueError, TypeError, KeyError) as error:
                raise BadScene(f"{self.path}: {_reason(error, self.path, self.registry)}") from error
        with self._named():
            self.neighbours = wire(self._whole)
        self.parts: dict[str, Declared] = {}
        for part in self.neighbours.parts:
            if part.name in self.parts:
                raise BadScene(f"{self.path}: two parts have the id '{part.name}'; give every part its own id=\"...\"")
            if not re.fullmatch(NAME, part.name):
                raise BadScene(
                    f"{self.path}: id = {part.name[:60]!r}; allowed: 1 to 100 characters without /, \\ and line ends, "
                    "as files are named by it"
                )
            self.parts[part.name] = part
        with self._named():
            self.camera, self.gel, self.block = (self.neighbours.one(role) for role in ("camera", "gel", "block"))
        integrator = self.neighbours.integrator
        self.integrator = integrator if is_part(integrator) else None
        self._crowds = [part for part in self.parts.values() if hasattr(part, "balls")]
        self._behind, self._placed, self._traced_crowds = False, [0], None
        declared = {n: self.registry.parts[p.kind] for n, p in self.parts.items()}
        self.boards = {n: p for n, p in self.parts.items() if declared[n].role == "board"}
        lights = {n: p for n, p in self.parts.items() if declared[n].category == "emitter" and n not in self.boards}
        self.leds = {n: p for n, p in lights.items() if declared[n].stokes is None}
        self.sources = {n: p for n, p in lights.items() if n not in self.leds}
        self.lights = {**self.leds, **self.sources}
        self.membranes = {n: p for n, p in self.parts.items() if hasattr(p, "ambient_radiance")}
        for sensor in self.mitsuba.sensors():
            width, height = (int(n) for n in sensor.film().size())
            if not 0 < width * height <= PIXELS_MOST:
                raise BadScene(
                    f"{self.path}: a camera of {width} x {height} pixels; allowed: 1 to {PIXELS_MOST:,}; change width "
                    "and height"
                )
        self.monte_carlo = any(p.role == "clear" for p in self.parts.values())
        self.parameters: dict[str, Parameter] = {}
        for name, part in self.parts.items():
            for p in self.registry.parameters_of(part.kind):
                self.parameters[f"{name}.{p.name}"] = p
        self.powers, self.power_gains, self.band_powers = self._light_powers()
        with self._named():
            refuse_unseen(self)
        self._stock = self._stock_parameters()
        self.parameters.update({k: p for k, (p, _) in self._stock.items() if k not in self.parameters})
        self._warn_of_depolarizers()
        self.integral: Integral | None = None
        if getattr(self.integrator, "integrates", False):
            self._integrate()

    @property
    def mitsuba(self):
        """The Mitsuba scene, whose meshes are brought up to date first where `set` left them."""
        if self._behind:
            self._behind = False
            with self._named():
                for part in self._crowds:
                    part.place()
                self._whole.parameters_changed([])
        return self._whole

    @property
    def traced(self):
        """What images LED by LED trace (optics.scene.crowd.Traced); None where that is the Mitsuba scene itself."""
        if not self._crowds:
            return None
        if self._traced_crowds is None:
            self._traced_crowds = Traced(self._whole, self._crowds)
            self.integrator.fronts = self._traced_crowds
        elif self._placed != [part.times for part in self._crowds]:
            self._traced_crowds.place()
        self._placed = [part.times for part in self._crowds]
        return self._traced_crowds

    def _integrate(self) -> None:
        """Have channels be integrals over the wavelength (optics.scene.integral)."""
        if self.camera is None or not self.lights:
            raise BadScene(
                f"{self.path}: bands of integrals need a part of the type 'camera' and a light of this program"
            )
        if self.monte_carlo:
            raise BadScene(
                f"{self.path}: light through dielectric bodies is followed in up to {FEW} bands; allowed: bands such "
                "as 620, 540, 460"
            )
        self.integral = Integral(self, self.integrator.bands, self.integrator.nodes or 0)
        self.integrator.bands = tuple(float(nm) for nm in self.integral.nm)
        for part in self.parts.values():
            part.integral = self.integral
        if self.integral.auto:  # what a spectrum depends on acts in the matrix from bands to channels alone
            for group in self.integral.groups:
                for key in group.keys:
                    self.parameters[key] = replace(self.parameters[key], how="image")

    @property
    def curves(self) -> dict[str, Curve]:
        """The spectra that parts were given, by `part.attribute`."""
        return {f"{n}.{name}": curve for n, part in self.parts.items() for name, curve in part.curves.items()}

    @contextmanager
    def _named(self):
        """What is wrong with the scene is said with its file."""
        try:
            yield
        except BadScene as error:
            raise BadScene(f"{self.path}: {error}") from error

    def _light_powers(self) -> tuple[dict[str, str], dict[str, str], dict[str, list[str]]]:
        """The key of each light's power; of its gain in single frames, of lights that have one; the keys of its powers
        in single bands, in the order of the bands."""
        own = {n: {k: p for k, p in self.parameters.items() if k.rpartition(".")[0] == n} for n in self.lights}
        bands = {n: sorted(keys_with(p, "band power"), key=lambda k: p[k].band or 0) for n, p in own.items()}
        gains = {n: keys[0] for n, p in own.items() if (keys := keys_with(p, "power gain"))}
        return {n: keys_with(p, "power")[0] for n, p in own.items()}, gains, bands

    def power_keys(self, *lights: str) -> list[str]:
        """The keys of all factors on the power of some lights: of each light as a whole, in single frames, then in
        single bands."""
        return [
            key
            for n in lights
            for key in (self.powers[n], *filter(None, [self.power_gains.get(n)]), *self.band_powers[n])
        ]

    def key(self, part: str, role: str) -> str | None:
        """The key of a part's parameter that has a role; None where it has none."""
        name = self.parts[part].named(role)
        return None if name is None else f"{part}.{name}"

    def places_of(self, values: Mapping, leds: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Where LEDs (None: all) stand at these values, (3,) mm each; a light without a place is left out."""
        keys = {n: [self.key(n, f"light {axis}") for axis in "xyz"] for n in (self.leds if leds is None else leds)}
        keys = {n: own for n, own in keys.items() if None not in own}
        found = {n: np.array([float(values[key]) for key in own]) for n, own in keys.items()}
        for n, own in found.items():
            board = getattr(self.leds[n], "board", None)
            if board is not None:
                pose = {p: float(values[f"{board.name}.{p}"]) for p in board.numbers}
                found[n] = on_board(own, float(values[turn]) if (turn := self.key(n, "light turn")) else 0.0, pose)
        return found

    def declaration(self, name: str) -> Part:
        """What the plugin file says of a part of the scene."""
        return self.registry.parts[self.parts[name].kind]

    def _warn_of_depolarizers(self) -> None:
        """Say which stock materials lose all polarization, and nobody says so, in a scene with polarizers."""
        shapes = self.mitsuba.shapes()
        if not any(self.declaration(n).polarizes for n in self.parts) and not any(
            "LinearPolarizer[" in str(s.bsdf()) for s in shapes
        ):
            return
        for shape in shapes:
            for name, advice in DEPOLARIZERS.items():
                if re.search(rf"\b{name}(\[| BSDF)", str(shape.bsdf())):
                    warnings.warn(
                        f"{self.path}: the material '{name}' of the shape '{shape.id()}' takes all polarization out of "
                        "the "
                        f"light that it lets through or reflects, whatever the physics; {advice}",
                        stacklevel=2,
                    )

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

    # -- values -------------------------------------------------------------------------------------------------------
    def records(self) -> list[dict]:
        """One record per parameter (optics.scene.showing.records)."""
        return showing.records(self)

    def _repr_html_(self) -> str:
        return showing.html(self)

    def values(self) -> dict[str, float | str]:
        """The present value of every parameter, whoever set it: this scene, or `mi.traverse` and an update."""
        now: dict[str, float | str] = {}
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

    def spread(self, values: Mapping[str, float | str], where: str = "") -> dict[str, float | str]:
        """The values with patterns such as `led_*.mu` replaced by the keys that they match; keys by name come last, and
        so hold against a pattern. Raises UnknownKey for a pattern that matches none."""
        found: dict[str, float | str] = {}
        for pattern, value in values.items():
            if not set(pattern) & set("*?["):
                continue
            matching = fnmatch.filter(self.parameters, pattern)
            if not matching:
                raise UnknownKey(pattern, self.parameters, "parameter", where, "`optics params SCENE` lists them")
            found.update(dict.fromkeys(matching, value))
        return {**found, **{key: value for key, value in values.items() if not set(key) & set("*?[")}}

    def set(self, values: Mapping[str, float | str], where: str = "", meshes: bool = True) -> None:
        """Set parameters by key; geometry is rebuilt once, and only if it changed.

        meshes = False leaves the meshes of crowds for when `mitsuba` is asked for: enough for `traced`."""
        import mitsuba as mi

        now = self.values()
        # what a parameter has already needs no check: most of what a calibration sets is of this kind
        new = {k: v for k, v in values.items() if k not in now or type(v) is not type(now[k]) or now[k] != v}
        changed = {k: v for k, v in self.check(new, where).items() if now[k] != v}
        moved, stock = set(), False
        for key, value in changed.items():
            if key in self._stock:
                self._traversed[self._stock[key][1]] = mi.Float(value)
                stock = True
                continue
            name, parameter = key.rsplit(".", 1)
            part = self.parts[name]
            if parameter in part.words:
                setattr(part, parameter, value)
            else:
                part.hold(parameter, value)
            if part.placed_by([parameter]):
                moved.add(name)
        if stock:
            self._traversed.update()
        for part in self._crowds:
            part.aside = not meshes
        try:
            with self._named():
                if move([self.parts[n] for n in moved]):
                    if meshes or not self._crowds:
                        self._behind = False
                        self._whole.parameters_changed([])
                    else:
                        self._behind = True
        finally:
            for part in self._crowds:
                part.aside = False

    def put(self, name: str, points, diameters=None) -> None:
        """Give the bodies of a crowd (N, 3) places at rest, mm, and (N,) diameters; meshes follow when they are asked
        for."""
        part = self.parts[name]
        part.put(points, diameters)
        part.aside = True
        try:
            move([part])
        finally:
            part.aside = False
        self._behind = True

    def check_press(self, values: Mapping[str, float | str], where: str) -> None:
        """Raises OutOfBounds for a press that is deeper than its gel is thick, of values that someone states.

        values   by key, above those of the scene"""
        if self.gel is None:
            return
        depth, thickness = (self.key(self.gel.name, role) for role in ("press depth", "thickness"))
        if depth is None or thickness is None or depth not in values:
            return
        stated = self.parameters[depth].check(values[depth], depth, where)
        thick = float({**self.values(), **values}[thickness])
        if not isinstance(stated, str) and stated > thick:
            raise OutOfBounds(depth, stated, "mm", (0.0, thick), f"{where}: the gel is {thick:g} mm thick")

    def moves(self, key: str) -> bool:
        """Whether a parameter moves geometry, or camera rays: then the places that they meet are found anew."""
        name, _, parameter = key.rpartition(".")
        if name not in self.parts:
            return True  # a stock plugin's may do anything
        declared = self.declaration(name)
        if declared.category == "sensor" or declared.refracts or self.parameters[key].role == "regions":
            return True
        return parameter in self.registry.shaping(declared.kind)

    def keys_of(self, effect: Effect) -> dict[str, list[str]]:
        """The effect's parameter names, each with the keys it has in this scene (empty where the scene lacks the
        part)."""
        kinds = self.registry.carriers(effect)
        holders = {n: p for n, p in self.parts.items() if p.kind in kinds}
        return {
            name: [f"{n}.{name}" for n, p in holders.items() if f"{n}.{name}" in self.parameters and p.takes(name)]
            for name in effect.parameter_names
        }

    def can_express(self, effect: Effect) -> bool:
        present = {name for p in self.parts.values() for name in (p.kind, p.role)}
        layered = any(p.how == "layer" for p in self.registry.effect_parameters(effect))
        scales_light = any(self.registry.parts[k].category == "integrator" for k in self.registry.kinds(effect.part))
        if self.monte_carlo and (set(effect.stages) & LED_BY_LED or scales_light or layered):
            return False
        return all(self.keys_of(effect).values()) and present.issuperset(effect.requires)

    def variables_of(self, effect: Effect, frames: int = 0) -> list[Variable]:
        """What a calibration frees to add the effect: shared or per part, for all frames or for each."""
        variables = []
        for name, keys in self.keys_of(effect).items():
            parameter = self.registry.parameter(effect.part, name)
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


def _reason(error: Exception, path: Path, registry: Registry) -> str:
    """Mitsuba's message in one line: what a part raised without its traceback, and the nearest name that exists."""
    text = str(error)
    if "Traceback (most recent call last)" in text:
        before, _, trace = text.partition("Traceback (most recent call last)")
        raised = re.findall(r"^[A-Za-z_][\w.]*: (.*(?:\n(?!\n|At:| ).+)*)", trace, flags=re.M)
        text = before + (raised[-1] if raised else trace)
    text = re.sub(r"(^|[:;] )(\[[^\]]*\]\s*)+", r"\1", " ".join(text.split()))
    text = re.sub(rf'(At|(?:Error w|W)hile loading) "?{re.escape(str(path))}"? \((line[^)]*)\)', r"\2", text)
    text = re.sub(rf"({QUOTING}) .*", r"\1; words of the file are not shown", text)
    parts = registry.parts
    if (unknown := re.search(r'Plugin "([^"]+)" not found', text)) is not None:
        near = difflib.get_close_matches(unknown[1], parts, n=1)
        text += (
            f" Did you mean '{near[0]}'?"
            if near
            else f" Own types are {', '.join(sorted(parts))}; others are Mitsuba's."
        )
        if (beside := trust.beside(path.parent)) and not set(trust.plugin_files(beside[0])) & set(registry.files):
            text += f" The plugins beside the scene are not used; add --plugins {beside[0]}"
    unused = re.search(r'unreferenced propert.* plugin of type "([^"]+)": - \w+ "([^"]+)"', text)
    if unused is not None and unused[1] in parts:
        near = difflib.get_close_matches(unused[2], [p.name for p in registry.parameters_of(unused[1])], n=1)
        text += f"; did you mean '{near[0]}'?" if near else "; `optics params SCENE` lists what it has"
    return text


def _whole(path: Path, defines: Mapping[str, str]):
    """The Mitsuba scene of a file, as `mi.load_file` makes it, whose meshes no ray slips through. Embree's fast test
    misses the common edge of two triangles now and then, and one sample of a pixel is black."""
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    before = mi.file_resolver()
    beside = mi.FileResolver(before)
    beside.append(str(path.parent))  # files that a scene names are beside it
    mi.set_file_resolver(beside)
    try:
        state = mi.parser.parse_file(config, str(path), **{k: str(v) for k, v in defines.items()})
        if ROBUST not in state.root.props:
            state.root.props[ROBUST] = True
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)
    finally:
        mi.set_file_resolver(before)
