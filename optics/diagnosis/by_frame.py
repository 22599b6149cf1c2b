"""Effects that act in some frames and not in others: a lamp that somebody switched on, a door that stood open.

With one strength for all frames such an effect explains a part, or nothing: what the other frames lack of it, the
powers of the lights take up. Here each frame has a strength s_f of its own,

    residual  =  base  +  sum over frames of s_f 1{frame f} d prediction / d s

and the effect is named where this explains nearly as much as anything else, and each frame has either none of it or
much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence
from optics.diagnosis.thresholds import TOLD
from optics.fit.model import Model
from optics.words import share_text, some

HALF = 0.5  # of the excess, from which such an effect is named; of the largest strength, which bare frames surely lack
NEARLY = 0.95  # of what the best curve along a coordinate explains: it has a gain and an offset for each frame
LESS = 0.01  # of the best one's fall, by which another effect must explain less, and by TOLD, or it is named beside it
SHOWN = 0.25  # of the largest strength: what a frame shows surely, if it shows the effect
SURELY = 3.0  # standard deviations
BARE = 2  # frames without it, or more: one may be a mistake of its own
NAMES = 12  # frames that are named


@dataclass(frozen=True)
class InSomeFrames:
    """An effect that acts in some frames.

    effects      by name, the best first; keys: of the best one's parameters, each with the value that switches it off
    share        of the excess misfit that it explains with a strength for each frame
    shown, bare  names of the frames that show it, and of those that do not; others may do either
    """

    effects: list[str]
    keys: list[str]
    share: float
    shown: list[str]
    bare: list[str]

    def text(self) -> str:
        """In a sentence."""
        first, *others = self.effects
        also = f" (or {', or '.join(others)})" if others else ""
        return (
            f"What is left looks like {first}{also} in some frames only: in {some(self.shown, NAMES)}, and not in "
            f"{some(self.bare, NAMES)}. With a strength for each frame it explains {share_text(self.share)} of the "
            "excess misfit."
        )

    def advice(self) -> str:
        """What to do."""
        return (
            f"if what causes {self.effects[0]} was off in {some(self.bare, NAMES)}, say so in captures.toml "
            f"({some(self.keys)} under [frames.parameters] of each), calibrate again, and diagnose"
        )


def in_some_frames(
    model: Model, evidence: Evidence, candidates: Sequence[Candidate], least: float, excess: float
) -> InSomeFrames | None:
    """The effect with a strength for each frame that explains most, if each frame has either none of it or much. Of
    effects with one strength, whose images are linear in it.

    least   fall of chi2 that it must reach: what other explanations bring, curves among them
    excess  chi2 less its degrees of freedom
    """
    if evidence.is_table or not excess > 0:
        return None
    found = []
    for c in candidates:
        if c.broken or c.form != "tangent" or len(c.columns) != 1 or c.effect.scope == "frame":
            continue
        fall, strength, sd = _with_a_strength_per_frame(evidence, c.columns[0])
        if fall > max(NEARLY * least, HALF * excess) and (sides := _shown(c, strength, sd)):
            found.append((fall, c, sides))
    found.sort(key=lambda f: -f[0])
    if not found:
        return None
    fall, c, (shown, bare) = found[0]
    names = [model.frames[f].name for f in evidence.frames]
    return InSomeFrames(
        [other.effect.name for f, other, _ in found if f > fall - max(TOLD, LESS * fall)],
        [f'"{key}" = {v.parameter.neutral or 0:g}' for v in c.variables for key in v.keys],
        fall / excess,
        [names[i] for i in shown],
        [names[i] for i in bare],
    )


def _with_a_strength_per_frame(evidence: Evidence, column: int) -> tuple[float, np.ndarray, np.ndarray]:
    """(fall of chi2 less its expectation, (frames,) strengths, their standard deviations) of the image in a column."""
    frames = evidence.frames
    images = (block.columns([column]) * (np.array(frames) == block.frame) for block in evidence.blocks)
    projected, lengths = evidence.off_base(images, len(frames))
    fall, dof, strength, sd = st.joint(projected, lengths)
    return (fall - dof) * evidence.thinning, strength, sd


def _shown(c: Candidate, strength: np.ndarray, sd: np.ndarray) -> tuple[list[int], list[int]] | None:
    """(frames that show an effect, frames that do not); None where a frame has a little of it, or less than nothing of
    what is never less."""
    known = np.isfinite(sd) & (sd > 0)
    if not known.any():
        return None
    side = c.sides[0] or np.sign(strength[known][np.argmax(np.abs(strength[known]))])
    strength = strength * side
    largest = strength[known].max()
    surely = known & (np.abs(strength) > SURELY * sd)
    shown = surely & (strength > SHOWN * largest)
    bare = known & ~surely & (HALF * largest - strength > SURELY * sd)
    if (surely & ~shown).any() or not shown.any() or bare.sum() < BARE:
        return None
    return list(np.flatnonzero(shown)), list(np.flatnonzero(bare))
