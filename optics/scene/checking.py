"""What plugin files use to check themselves, and the sampler of plausible values.

A check is a function without arguments that raises AssertionError. It compares the plugin with a closed form: a number
or a formula that a textbook gives. Checks are part of the plugin file (`checks=` of Part and Effect). `tests/contract`
runs those of every plugin that a scan finds, with a Mitsuba variant set."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from optics.polarization.layers import Crossing, evaluate
from optics.scene.declare import Effect, Part
from optics.scene.parameter import Parameter
from optics.scene.registry import known


def agree(found, expected, relative: float = 1e-12, absolute: float = 0.0) -> None:
    """|found - expected| <= absolute + relative |expected|, entry by entry; the defaults are for double precision.

    Mitsuba and Dr.Jit compute in single precision: state `relative=1e-5` for a chain of about ten operations.
    """
    np.testing.assert_allclose(np.asarray(found, float), np.asarray(expected, float), rtol=relative, atol=absolute)


# -- parts without a scene -------------------------------------------------------------------------------------------
def numbers(kind: str, **changed) -> SimpleNamespace:
    """A part's parameters at their defaults, some of them changed, as the functions of effects read them."""
    declared = {p.name: p.default for p in known().parameters_of(kind)}
    unknown = changed.keys() - declared.keys() - {"cover", "regions"}
    assert not unknown, f"{kind} has no parameter {', '.join(sorted(unknown))}"
    return SimpleNamespace(name=kind, field=None, **{**declared, **changed})


def made(kind: str, **values):
    """The Mitsuba object of a part, made from its XML parameters; a Mitsuba variant must be set."""
    import mitsuba as mi

    return mi.load_dict({"type": kind, **values})


def scene_of(*elements: str, bands: str = "620, 540, 460", width: int = 4, x_fov: float = 1.0):
    """A small scene of these XML elements; its camera is at z = -20 and looks along z (an image of width x width)."""
    from optics.scene import loader

    xml = f"""<scene version="3.0.0">
        <integrator type="tactile" id="integrator"><string name="bands" value="{bands}"/></integrator>
        <sensor type="camera" id="camera">
            <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{width}"/></film>
            <float name="x_fov" value="{x_fov}"/>
            <transform name="to_world"><translate x="0.013" y="0.007" z="-20"/></transform>
        </sensor>
        {" ".join(elements)}
    </scene>"""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "check.xml"
        file.write_text(xml, encoding="utf-8")
        return loader.load(file)


# -- layers and sources ----------------------------------------------------------------------------------------------
def ray(theta: float = 0.0, phi: float = 0.0, wavelengths=(540.0,), u: float = 0.0, v: float = 0.0) -> Crossing:
    """Light that crosses a layer towards the viewer, theta degrees off the normal in the azimuth phi, at (u, v) mm.

    Its Stokes vectors refer to the layer's x axis, carried along by the turn from the normal to the ray.
    """
    t, p = np.radians([theta, phi])
    meridian = np.array([np.cos(t) * np.cos(p), np.cos(t) * np.sin(p), -np.sin(t)])
    azimuth = np.array([-np.sin(p), np.cos(p), 0.0])
    k = np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])
    x = np.cos(p) * meridian - np.sin(p) * azimuth
    k, x = (tuple(np.full((1, 1), c) for c in axis) for axis in (k, x))
    return Crossing(k, x, np.full((1, 1), u), np.full((1, 1), v), np.array(wavelengths, float))


def mueller(kind: str, crossing: Crossing | None = None, **changed) -> np.ndarray:
    """(B, 4, 4) Mueller matrix of a layer with its effects, at the parameters' defaults but for those changed."""
    crossing, layer = crossing or ray(), numbers(kind, **changed)
    effects = known().at_stage(kind, "layer")
    neutral = {p.name: p.neutral for p in known().parameters_of(kind)}
    active = [e for e in effects if any(getattr(layer, n) != neutral[n] for n in e.at_rest)]
    matrix = evaluate(known().parts[kind].mueller, crossing, layer, active).numpy()
    return np.broadcast_to(matrix, (1, len(crossing.wavelengths), 4, 4))[0]


def stokes(kind: str, crossing: Crossing | None = None, **changed) -> np.ndarray:
    """(B, 4) Stokes vector that a source sends at power 1."""
    crossing = crossing or ray()
    vector = known().parts[kind].stokes(crossing, numbers(kind, **changed))
    shape = (1, len(crossing.wavelengths))
    return np.stack([np.broadcast_to(np.asarray(c, float), shape)[0] for c in vector], -1)


def transmission_axis(matrix: np.ndarray) -> np.ndarray:
    """Angle of a polarizer's transmission axis, deg in (-90, 90], from the first row of its matrix (..., 4, 4)."""
    return np.degrees(np.arctan2(matrix[..., 0, 2], matrix[..., 0, 1])) / 2


def principal_transmittances(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T1 along and T2 across the axis of a polarizer of the matrix (..., 4, 4): M00 +- |(M01, M02)|."""
    swing = np.hypot(matrix[..., 0, 1], matrix[..., 0, 2])
    return matrix[..., 0, 0] + swing, matrix[..., 0, 0] - swing


# -- plausible values ------------------------------------------------------------------------------------------------
def draw(
    item: Part | Effect,
    parameters: Iterable[Parameter],
    rng: np.random.Generator,
    around: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Plausible values of a part's or an effect's numbers, by name.

    Each number is drawn evenly within one plausible change of `around` (its default where that holds none) and kept to
    its bounds. `item.random(rng)` replaces those that it names: values that belong together, or far from the default.
    """
    found = {}
    for p in parameters:
        if p.is_number:
            middle = (around or {}).get(p.name, p.default)
            found[p.name] = float(np.clip(middle + rng.uniform(-1, 1) * p.plausible, *p.bounds))
    if item.random is not None:
        found.update((name, float(value)) for name, value in item.random(rng).items() if name in found)
    return found
