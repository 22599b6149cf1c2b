"""Wiring: each part of a scene finds the parts that it depends on.

A film in the skin moves with the skin's dent, the cells of a grid with the block around them, the block gives way to
the
target that presses it, a filling borders on the material that it is nested in. Mitsuba makes each part by itself, so a
part looks for its neighbours when the scene is complete: `wire(scene)`. The integrator `tactile` calls it at its first
image and the loader of this library at once; for Mitsuba's own integrators it is `optics.wire(scene)`. From then on
`params.update()` moves what follows a changed part as well."""

from __future__ import annotations

import re

from optics.errors import BadScene
from optics.scene.mitsuba_parts import is_part, move


class Neighbours:
    """The parts of one scene, as they look for one another.

    parts       in the order in which they were made; each has its `name`, `kind` and `role`
    integrator  the one that renders, of any make
    """

    def __init__(self, scene, integrator=None):
        import mitsuba as mi

        self.scene = scene
        self.integrator = integrator if integrator is not None else scene.integrator()
        found = [*scene.sensors(), *scene.emitters(), *scene.shapes(), *(s.bsdf() for s in scene.shapes())]
        found += [self.integrator, *(node for _, _, node, _ in mi.traverse(scene).properties.values())]
        self.parts: list = []
        for part in found:
            if is_part(part) and part not in self.parts:
                self.parts.append(part)
        self.parts.sort(key=lambda part: part._order)
        if not is_part(self.integrator):  # one of ours may do the work inside one of Mitsuba's
            ours = (p for p in self.parts if p.registry.parts[p.kind].category == "integrator")
            self.integrator = next(ours, self.integrator)
        for part in self.parts:
            if not part.name or re.fullmatch(r"object_\d+|_.*|plugin", part.name):
                part.name = part.kind

    def one(self, role: str):
        """The part that plays a role, or None; raises BadScene where there are several."""
        found = [part for part in self.parts if part.role == role]
        if len(found) > 1:
            kinds = ", ".join(dict.fromkeys(part.kind for part in found))
            raise BadScene(f"{len(found)} parts of the kind '{kinds}'; one is allowed")
        return found[0] if found else None

    def named(self, name: str):
        return next((part for part in self.parts if part.name == name), None)

    def shapes_of(self, material) -> list:
        """The shapes that have a material."""
        return [shape for shape in self.scene.shapes() if shape.bsdf() is material]


def wire(scene, integrator=None) -> Neighbours:
    """Have every part of a Mitsuba scene find its neighbours, and place what they move; returns the parts.

    Raises TypeError for anything but a scene that Mitsuba loaded."""
    import mitsuba as mi

    if mi.variant() is None or not isinstance(scene, mi.Scene):
        raise TypeError(
            f"optics.wire takes a scene of mi.load_file or mi.load_dict in the present variant, not a "
            f"'{type(scene).__name__}'; scenes of optics.load are wired already"
        )
    around = Neighbours(scene, integrator)
    bands = getattr(around.integrator, "bands", ())
    single = bands[0] if getattr(around.integrator, "lanes", 0) == 1 and len(bands) == 1 else None
    for part in around.parts:
        part.band = single
        part._followers = ()
    for part in around.parts:
        part.wire(around)
        part._wired, part._waits = True, ""
    for shape in scene.shapes():
        if is_part(shape.bsdf()):
            shape.bsdf()._waits = ""
    if move([part for part in around.parts if part._leaders]):
        scene.parameters_changed([])
    return around


def traverse_paths(scene) -> dict[str, str]:
    """{key: path}: where `mi.traverse(scene)` has each number of our parts, whose key is `id.name` in this library.

    A part that stands inside another object is under that object's path: `film.angle` is `film_sheet.bsdf.angle`."""
    import mitsuba as mi

    Neighbours(scene)  # names parts without an id
    found: dict[str, str] = {}
    for path, (_, _, node, _) in mi.traverse(scene).properties.items():
        name = path.rsplit(".", 1)[-1]
        if is_part(node) and name in node.numbers:
            found.setdefault(f"{node.name}.{name}", path)
    return found


def ensure_wired(scene, integrator) -> None:
    """`wire` a scene that an integrator is about to render, unless it is wired."""
    parts = [integrator, *scene.sensors(), *scene.emitters()]
    for shape in scene.shapes():
        parts += [shape, shape.bsdf()]
    if any(is_part(part) and not part._wired for part in parts):
        wire(scene, integrator)
