"""Makers of captures: independent renderers that share no code path with the model that is fitted to them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def in_variant(variant: str) -> Iterator[None]:
    """Mitsuba in a variant, and afterwards in that of before: each change imports Mitsuba's Python integrators anew,
    for a third of a second, so that a maker changes once for all its images."""
    import mitsuba as mi

    from optics.scene.mitsuba_parts import DEFAULT_VARIANT, use_variant  # makers of plain numpy load no model

    before = mi.variant() or DEFAULT_VARIANT
    use_variant(variant)
    try:
        yield
    finally:
        use_variant(before)
