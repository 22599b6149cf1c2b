"""The refits of a diagnosis: chord steps on the base's derivative images where these will do, else a calibration; each
is kept in the study as soon as it is there, so that a diagnosis that was stopped goes on where it was.

A calibration of images with one more effect takes many times as long as chord steps (`optics.fit.calibrate.extended`).
Chord steps of all effects come first; those that come near the best are calibrated."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from optics.diagnosis.refit import COARSE, FAILURES, ROUGH, Cooled, further
from optics.diagnosis.thresholds import CLEAR, MISSTATED
from optics.files.output import write_text
from optics.fit import calibrate
from optics.fit.descent import normal_equations, prior_terms, with_priors
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.fit.tempering import tempered
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable
from optics.study.places import own_plugins
from optics.study.setup import Setup, effect_variables
from optics.study.stages import COOLER, SAME, TOGETHER, cooled, fit_base, off_neutral
from optics.version import __version__

PROMISING = 0.7  # of the best fall of chi2: an unconverged refit that falls by more is worth a calibration
AS_PROMISED = 0.7  # of the promised fall: a calibration that falls by more has not ended in another minimum
REACH = 3 * CLEAR  # of the best: a refit that stays farther behind, however priors count, is no rival


class Refits:
    """Refits of one base.

    tested   the effects of the diagnosis;   folder: where refits are kept; None: nowhere
    """

    def __init__(
        self, model: SceneModel, setup: Setup, base: Fit, tested: Sequence[Effect], folder: Path | None = None
    ):
        self.model, self.setup, self.base, self.folder = model, setup, base, folder
        self.tested = tested
        self.known = {v.name for v in base.variables}
        curved = [v for e in tested if e.onset != "tangent" for v in effect_variables(model, e, base.variables)]
        self.steps = {v.name: v.parameter.plausible for v in curved}  # of variables without a slope at neutral
        self.chords: dict[tuple[str, ...], Fit] = {}
        self.results: dict[tuple[str, ...], Fit] = {}
        # of refits with priors that counted more, which kept them from wherever a wrong base goes
        self.starts: dict[tuple[str, ...], Fit] = {}

    @cached_property
    def coarse(self) -> float:
        """COARSE of what neighbouring pixels share of the base's excess, as a share of all of it: noise that is stated
        too small is nothing that a refit could miss."""
        shared = count = 0.0
        for index, prediction in zip(self.base.frames, self.model.predict(self.base.values, self.base.frames)):
            use = np.broadcast_to(self.model.usable(index), prediction.shape)
            sd = np.sqrt(self.model.variance(self.base.values, index, prediction))
            r = np.where(use, (self.model.frames[index].image - prediction) / sd, 0.0)
            count += float(use.sum())
            both = [(r[:, 1:] * r[:, :-1], use[:, 1:] & use[:, :-1]), (r[1:] * r[:-1], use[1:] & use[:-1])]
            pairs = sum(float(known.sum()) for _, known in both)
            shared += use.sum() * sum(float(product.sum()) for product, _ in both) / max(pairs, 1.0)
        excess = max(self.base.chi2 - count, 1.0)
        return COARSE * float(np.clip(shared / excess, 0.0, 1.0))

    def foresee(self, sets: Sequence[Sequence[Variable]], say: Callable[[str, int, int], None]) -> None:
        """Chord steps of each set of variables, and the calibrations that these call for. All are held against the best
        of the chord steps that they compete with (`leader`), and of what an earlier diagnosis has left, so that what
        is followed does not depend on how many processes make them."""
        if not self.by_chords():
            return
        wanted = [extra for extra in sets if self.curved(extra) < 2 and not self._begun(extra)]
        say("chord steps", len(sets) - len(wanted), len(sets))
        jobs = [partial(_tried, make=partial(calibrate.extended, **self._chord_of(extra))) for extra in wanted]
        made = self.model.each(self.base.frames, jobs)
        for n, (k, quick) in enumerate(made, len(sets) - len(wanted) + 1):
            if quick is not None:
                self.chords[_names(wanted[k])] = self._as_ours(quick, wanted[k])
            say("chord steps", n, len(sets))
        self._calibrate_ahead([extra for extra in wanted if _names(extra) in self.chords], say)

    def _calibrate_ahead(self, sets: Sequence[Sequence[Variable]], say: Callable[[str, int, int], None]) -> None:
        """The calibrations that chord steps call for, several at once where processes share them."""
        leaders = {own: self.leader(own) for own in set(map(_per_frame, sets))}
        open_ = [extra for extra in sets if self.unfinished(self.chord(extra), leaders[_per_frame(extra)])]
        made_of = [self._calibrated_of(extra, leaders[_per_frame(extra)]) for extra in open_]
        jobs = [partial(_tried, make=partial(_calibrated, **own)) for own in made_of]
        if jobs:
            say("calibrations", 0, len(jobs))
        for n, (k, found) in enumerate(self.model.each(self.base.frames, jobs), 1):
            if found is not None:
                self.results[_names(open_[k])] = found = self._as_ours(found, open_[k])
                self.keep(found, open_[k])
            say("calibrations", n, len(open_))

    def _as_ours(self, found: Fit, extra: Sequence[Variable]) -> Fit:
        """A fit that another process may have made, with this one's variables."""
        return replace(found, variables=[*self.base.variables, *extra])

    def _begun(self, extra: Sequence[Variable]) -> bool:
        names = _names(extra)
        return names in self.starts or names in self.chords or self.taken_up(extra) is not None

    def of(self, model: SceneModel, variables: Sequence[Variable], start: Values, frames: Sequence[int]) -> Fit:
        """The fit of these variables from this start."""
        extra = [v for v in variables if v.name not in self.known]
        over = [v.name for v in extra]  # of the base the best start is known
        if not self.by_chords() or not extra or list(frames) != list(self.base.frames):
            return calibrate.fit_over_starts(model, variables, start, frames, over=over)
        names = tuple(over)
        found = self.taken_up(extra)  # a diagnosis asks again from another start, which chord steps do not use
        if found is None:
            found = self.resumed(variables, names, frames)
            if found is None and self.curved(extra) < 2:
                found = self.calibrated(extra)
            elif found is None:  # a chord per parameter misses their products
                found = calibrate.fit_over_starts(
                    model, variables, start, frames, tolerance=ROUGH, over=over, negligible=self.coarse
                )
            self.results[names] = found
            self.keep(found, extra)
        return found

    def resumed(self, variables: Sequence[Variable], names: tuple[str, ...], frames: Sequence[int]) -> Fit | None:
        """The fit from where one with priors that counted more had come; None where there is none, or it fails."""
        if names not in self.starts:
            return None
        found = calibrate.fit(
            self.model, variables, self.starts[names].values, frames, tolerance=ROUGH, negligible=self.coarse
        )
        return found if self.fall(found) > 0 else None

    def by_chords(self) -> bool:
        """Whether chord steps are worth it: readings of a table are predicted in milliseconds."""
        return self.model.captures.table is None and self.base.normal is not None

    def curved(self, extra: Sequence[Variable]) -> int:
        """How many of these have no slope at neutral."""
        return sum(v.name in self.steps for v in extra)

    def chord(self, extra: Sequence[Variable]) -> Fit:
        """The fit by chord steps."""
        names = _names(extra)
        if names not in self.chords:
            self.chords[names] = calibrate.extended(self.model, **self._chord_of(extra))
        return self.chords[names]

    def _chord_of(self, extra: Sequence[Variable]) -> dict[str, Any]:
        """What chord steps need beside the model."""
        steps = {v.name: self.steps[v.name] for v in extra if v.name in self.steps}
        return {"base": self.base, "extra": extra, "secant": steps, "seed": self.setup.seed, "negligible": self.coarse}

    def leader(self, per_frame: bool) -> float:
        """The best fall so far; without strengths per frame, the best of the laws that all frames share.

        A strength per frame takes up whatever wanders from frame to frame, which is no reason to leave laws of all
        frames unfinished: those are held against each other."""
        fits = (*self.chords.values(), *self.results.values())
        return max(self.fall(fit) for fit in fits if per_frame or not _per_frame(self._extra_of(fit)))

    def unfinished(self, quick: Fit, leader: float) -> bool:
        """Whether chord steps have no end but come near the best, or were promised to."""
        ended = quick.converged and self.fall(quick) > AS_PROMISED * quick.promised
        return not ended and max(self.fall(quick), quick.promised) > PROMISING * leader

    def calibrated(self, extra: Sequence[Variable]) -> Fit:
        """The fit by chord steps, or the calibration that these call for."""
        quick, leader = self.chord(extra), self.leader(_per_frame(extra))
        return (
            _calibrated(self.model, **self._calibrated_of(extra, leader)) if self.unfinished(quick, leader) else quick
        )

    def _calibrated_of(self, extra: Sequence[Variable], leader: float) -> dict[str, Any]:
        """What `_calibrated` needs beside the model."""
        quick, before, near = self.chord(extra), self.minimised(self.base), PROMISING * leader
        return {
            "quick": quick,
            "enough": before - AS_PROMISED * quick.promised,
            "asked": math.inf if quick.promised > near else before - near,
            "extra": extra,
            "start": Values(dict(self.setup.values)),
            "negligible": self.coarse,
        }

    def cooler(self, refits: Sequence[Fit]) -> Cooled | None:
        """What a diagnosis begins again from, given its refits, the best first: the base with priors that count as the
        best one asks, where that leaves little more than noise; None where it does not, where they count no less then,
        and where it makes no difference.

        A base that misses images by ten times their noise lets priors count a thousand times (optics.fit.tempering).
        So does each refit: a dial that stood half a degree off what is written down, as dials do, is held there beside
        the right effect as beside a wrong one, and what is left then is called misfit."""
        now = self.base.tempering
        if not self.by_chords() or now == 1.0 or not refits:
            return None
        leader = refits[0]
        (least, gain), *others = map(self._least, refits)
        if least > MISSTATED * leader.dof or (gain < CLEAR and all(other > least + REACH for other, _ in others)):
            return None
        found = cooled(self.model, leader)
        if found.tempering > now / COOLER or found.chi2 > MISSTATED * found.dof:
            return None
        variables = tempered(self.base.variables, found.tempering)
        base = calibrate.fit(
            self.model, variables, self.base.values, self.base.frames, tolerance=TOGETHER, negligible=SAME
        )
        again = Refits(self.model, self.setup, base, self.tested, self.folder)
        again.results[self._extra(leader)] = found
        near = PROMISING * self.fall(leader)
        again.starts = {self._extra(fit): fit for fit in refits[1:] if self.fall(fit) > near}
        often = "once" if found.tempering == 1.0 else f"{found.tempering:.3g} times"
        remark = (
            f"what is known counted {now:.3g} times in the base, which misses the images by much; the best explanation "
            f"misses them by so little that it counts {often}. The base was calibrated again with that weight, and the "
            "figures of this diagnosis are those of that calibration"
        )
        return Cooled(base, again.of, again.foresee, remark)

    def _extra(self, found: Fit) -> tuple[str, ...]:
        """Names of a refit's variables that the base has not."""
        return _names(self._extra_of(found))

    def _extra_of(self, found: Fit) -> list[Variable]:
        return [v for v in found.variables if v.name not in self.known]

    def _least(self, found: Fit) -> tuple[float, float]:
        """(chi2 and priors, each counted once, at the minimum that a fit's last linearisation expects; by how much that
        is below where the fit stands)."""
        once = tempered(found.variables, 1.0)
        here = found.chi2 + prior_terms(self.model, once, found.values)[2]
        if found.normal is None:  # kept by a diagnosis that was stopped
            normal = normal_equations(self.model, once, found.values, found.frames)
        else:
            normal = with_priors(found.normal, self.model, found.values, found.variables, once)
        step = np.linalg.lstsq(normal.a, normal.b, rcond=None)[0]  # gauges have no curvature
        return here - float(normal.b @ step), float(normal.b @ step)

    def fall(self, found: Fit) -> float:
        """Of what is minimised, chi2 and priors: where each frame has its own angle, these may hold most of it."""
        return self.minimised(self.base) - self.minimised(found)

    def minimised(self, found: Fit) -> float:
        return _minimised(self.model, found)

    # -- kept in the study --------------------------------------------------------------------------------------------
    def taken_up(self, extra: Sequence[Variable]) -> Fit | None:
        """A refit that was made before, now or by a diagnosis that was stopped; None where there is none."""
        names = tuple(v.name for v in extra)
        if names not in self.results and self.folder is not None:
            file = self.file_of(names)
            if file.is_file():
                found = self.read(file, extra)
                if found is not None:
                    self.results[names] = found
        return self.results.get(names)

    def file_of(self, names: Sequence[str]) -> Path:
        """Where a refit of these variables is kept: it belongs to the base's values, to how often its priors count, to
        the user's own plugins and to the program's version."""
        assert self.folder is not None
        own = own_plugins(self.model.scene.registry)
        estimate, tempering = [float(e) for e in self.base.estimate], self.base.tempering
        whole = json.dumps([names, estimate, tempering, self.base.frames, own, __version__])
        return self.folder / f"{hashlib.sha256(whole.encode()).hexdigest()[:16]}.json"

    def keep(self, found: Fit, extra: Sequence[Variable]) -> None:
        """Write a refit."""
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        record = {
            "variables": [v.name for v in found.variables],
            "estimate": [float(e) for e in found.estimate],
            "covariance": [[float(c) for c in row] for row in found.covariance],
            **found.values.record(),
            **{k: getattr(found, k) for k in ("chi2", "dof", "frame_chi2", "frame_n", "converged", "reason")},
        }
        write_text(self.file_of([v.name for v in extra]), json.dumps(record))

    def read(self, file: Path, extra: Sequence[Variable]) -> Fit | None:
        """A refit as it was kept, without derivative images; None where the file is cut off."""
        variables = {v.name: v for v in (*self.base.variables, *extra)}
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            return Fit(
                Values.of_record(record),
                [variables[name] for name in record["variables"]],
                np.array(record["estimate"], float),
                np.array(record["covariance"], float),
                record["chi2"],
                record["dof"],
                list(self.base.frames),
                record["frame_chi2"],
                record["frame_n"],
                record["converged"],
                record["reason"],
            )
        except (ValueError, KeyError, TypeError):
            return None


# -- which any process may make ----------------------------------------------------------------------------------------
def _names(extra: Sequence[Variable]) -> tuple[str, ...]:
    return tuple(v.name for v in extra)


def _per_frame(extra: Sequence[Variable]) -> bool:
    return any(v.frames is not None for v in extra)


def _tried(model: SceneModel, make: Callable[[SceneModel], Fit]) -> Fit | None:
    """None where a refit has no result: whoever asks for it later learns why."""
    try:
        return make(model)
    except FAILURES:
        return None


def _minimised(model: SceneModel, found: Fit) -> float:
    return found.chi2 + prior_terms(model, found.variables, found.values)[2]


def _calibrated(
    model: SceneModel,
    quick: Fit,
    enough: float,
    asked: float,
    extra: Sequence[Variable],
    start: Values,
    negligible: float,
) -> Fit:
    """A calibration that continues chord steps; where that falls short of what was promised, one from the study's start
    values: a strong effect may have bent the base's values far from the truth. What was promised as much as the best is
    followed to its end, since where chord steps have stuck nothing more is promised.

    enough   what is minimised where as much as was promised is reached;   asked: at a rival of the best, at most
    """
    variables, frames = quick.variables, quick.frames
    longer = further(model, variables, quick.values, frames, asked=asked, negligible=negligible)
    best = min((longer, quick), key=partial(_minimised, model))
    if _minimised(model, best) < enough or _minimised(model, best) > asked:
        return best
    begun = off_neutral(model, start, extra)
    afresh = fit_base(model, variables, frames, begun, tolerance=ROUGH, negligible=negligible)
    return min((best, afresh), key=partial(_minimised, model))
