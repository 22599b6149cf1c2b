"""Optical models of camera-based touch sensors that can be held against a measurement.

A scene (Mitsuba XML) and captures (images with their settings) go in; a model that explains the captures comes out,
with the record of which physical effects it took:

    study = optics.calibrate("captures", "study")
    verdict = study.diagnose()
    study.add("lens vignetting")
    study.report()

Importing this package sets no Mitsuba variant and loads nothing heavy: each name is imported when it is first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from optics.version import __version__

if TYPE_CHECKING:
    from optics.diagnosis.result import Diagnosis
    from optics.facade import Study, calibrate, compare, load
    from optics.fit.crew import use_processes
    from optics.fit.result import Fit
    from optics.scene.declare import Effect, Part
    from optics.scene.loader import Scene
    from optics.scene.mitsuba_parts import register
    from optics.scene.parameter import Parameter
    from optics.scene.wiring import wire

_HOME = {
    "calibrate": "optics.facade",
    "compare": "optics.facade",
    "load": "optics.facade",
    "use_processes": "optics.fit.crew",
    "register": "optics.scene.mitsuba_parts",
    "Diagnosis": "optics.diagnosis.result",
    "Effect": "optics.scene.declare",
    "Fit": "optics.fit.result",
    "Parameter": "optics.scene.parameter",
    "Part": "optics.scene.declare",
    "Scene": "optics.scene.loader",
    "Study": "optics.facade",
    "wire": "optics.scene.wiring",
}  # name -> module that holds it

__all__ = [
    "Diagnosis",
    "Effect",
    "Fit",
    "Parameter",
    "Part",
    "Scene",
    "Study",
    "__version__",
    "calibrate",
    "compare",
    "load",
    "register",
    "use_processes",
    "wire",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'optics' has no attribute '{name}'; it has {', '.join(__all__)}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
