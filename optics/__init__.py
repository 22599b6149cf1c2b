"""Optical models of camera-based touch sensors that can be held against a measurement.

A scene (Mitsuba XML) and captures (images with their settings) go in; a model that explains the captures comes out,
with the record of which physical effects it took. Importing this package sets no Mitsuba variant and loads nothing
heavy: each verb imports what it needs."""

__version__ = "0.1.0"


def register(plugins=None) -> None:
    """Make the parts known to plain Mitsuba, see `optics.scene.mitsuba_parts.register`."""
    from optics.scene.mitsuba_parts import register

    register(plugins)
