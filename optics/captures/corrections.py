"""What an import changes in measured values, and what it finds in them: clipped values and drift.

Every change is said twice: in a remark, and under `corrections` of import.json as {what, how_much, where}."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

CLIPPED = 20  # values at the lowest level, from which a pile is more than an accident
PILE = 2.0  # times as many values at the lowest level as one step above it: the tail of noise falls downwards
DRIFTED = 0.01  # relative change of a frame's brightness that is worth a sentence


def correction(what: str, how_much: str, where: str) -> dict[str, str]:
    """An entry of `corrections`."""
    return {"what": what, "how_much": how_much, "where": where}


def sentences(corrections: Iterable[dict[str, str]]) -> list[str]:
    """One sentence for each correction, for a README."""
    return [f"- {c['what']}: {c['how_much']}; {c['where']}" for c in corrections]


def black_levels(images: np.ndarray | Sequence[np.ndarray]) -> list[float | None]:
    """Per channel the level (DN) at which values are cut off below, None where none are.

    Noise makes fewer values at the lowest level than one step above it. A pile of PILE times as many, and CLIPPED
    values or more, has been cut off there. images (N, H, W, C): whole numbers."""
    found: list[float | None] = []
    for c in range(images[0].shape[-1]):
        planes = [np.asarray(image)[..., c] for image in images]
        low = float(min(plane.min() for plane in planes))
        at = sum(int((plane <= low).sum()) for plane in planes)
        above = sum(int(((plane > low) & (plane <= low + 1)).sum()) for plane in planes)
        varied = any(plane.max() > low for plane in planes)
        found.append(low if varied and at >= CLIPPED and at > PILE * above else None)
    return found


def at_black(image: np.ndarray, levels: Sequence[float | None]) -> np.ndarray:
    """(H, W, C) bool: values at the level where they are cut off."""
    return np.asarray(image) <= np.array([-np.inf if level is None else level for level in levels])


def black_text(levels: Sequence[float | None], shares: Sequence[float]) -> tuple[str, dict[str, str]]:
    """(remark, correction) of values that are cut off below; shares: of all values, per channel."""
    names = "RGB" if len(levels) == 3 else [str(c) for c in range(len(levels))]
    cut = [(name, b, s) for name, b, s in zip(names, levels, shares) if b is not None]
    text = ", ".join(f"{100 * share:.2g} % of channel {name} at {level:g} DN" for name, level, share in cut)
    return (
        f"values clipped at the black level carry no data and are masked: {text}",
        correction("values clipped at the black level are masked", text, "all frames"),
    )


def drift_text(gains: np.ndarray, names: Sequence[str]) -> str | None:
    """A sentence on the brightness of frames far from the contact, None below DRIFTED.

    gains (N, C) relative to the background, in the order of the frames."""
    if np.abs(gains - 1).max() <= DRIFTED:
        return None
    worst = int(np.abs(gains - 1).max(1).argmax())
    text = f"brightness far from the contact drifts: {_percent(gains[worst] - 1)} in {names[worst]}"
    if len(gains) > 2:
        step = int(np.abs(np.diff(gains, axis=0)).max(1).argmax())
        time = np.arange(len(gains)) - (len(gains) - 1) / 2
        trend = time @ (gains - gains.mean(0)) / (time @ time) * (len(gains) - 1)
        text += (
            f"; largest step {_percent(gains[step + 1] - gains[step])} from {names[step]} to {names[step + 1]}; trend "
            f"over all frames {_percent(trend)}"
        )
    return text


def _percent(values: np.ndarray) -> str:
    return " / ".join(f"{100 * v:+.2g}" for v in values) + " %"
