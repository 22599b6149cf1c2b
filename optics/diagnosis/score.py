"""Scores of all effects against a calibrated model: how far chi2 would fall, how surely, and which effects are alike.

Nothing is added to the model yet: derivative images, projection and ranking. The algebra is in
`optics.diagnosis.statistics`, the sums over pixels in `optics.diagnosis.evidence`."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence, Progress, at_bound, measure, silent
from optics.diagnosis.result import Row
from optics.diagnosis.thresholds import CLEAR, EXCESS, JUDGED, LEVEL
from optics.errors import Underdetermined
from optics.fit import gauges
from optics.fit.curvature import own_curvature
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.scene.declare import Effect
from optics.scene.parameter import Variable
from optics.words import some

REALISED = 0.5  # of the fall that a score promises: what its refit must have brought to count against another
RIVAL = 0.5  # of an effect's score: what another must have as well, for other weights to overturn the order of both
SETTLED = 0.01  # of the excess of chi2 per parameter: what a calibrated base may still absorb. Derivative images of
# moving edges are finite samples, which no calibration makes orthogonal to a residual with structure
MOVING = 0.15  # of the excess in all: what a tempered base may still absorb
KAPPA = 0.1  # noise per pixel of derivative images over their signal, above which strengths are biased
OWN_NOISE = 5.0  # standard deviations of the product of two independent noises, over the number of those that are apart
FAINT = 10  # the power of the test is stated for the plausible strength over this
INNER = 0.5  # of the values must be left where masks are one pixel wider, for these to be another choice of mask


@dataclass
class Scored:
    """Every effect scored against a calibrated model.

    dropped      names of base variables that stand at a bound, and are taken as known there
    not_tested   effect -> why
    unsettled    what a base that misses its images may still absorb, in a sentence; empty: nothing to speak of
    """

    evidence: Evidence
    table: Table
    dropped: list[str]
    not_tested: dict[str, str]
    unsettled: str = ""


def score(
    model: Model,
    fit: Fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    fitted: Sequence[int],
    *,
    rows_max: int = 400_000,
    seed: int = 0,
    progress: Progress | None = None,
) -> Scored:
    """Score and rank the effects; arguments and errors as of `optics.diagnosis.diagnose.diagnose`."""
    fitted = [int(i) for i in fitted]
    if not fitted:
        raise ValueError("diagnose: no fitted frames given; name the frames that the base was calibrated on")
    _require_noise(model)
    base, dropped = base_variables(model, fit, fitted)
    candidates, not_tested = candidates_of(model, fit, effects, variables_of, fitted)
    evidence = measure(model, fit.values, base, candidates, fitted, rows_max, seed, progress or silent)
    unsettled = _require_convergence(model, evidence, fit)
    return Scored(evidence, _rank(evidence, candidates, seed), dropped, not_tested, unsettled)


# -- what must hold before any score ---------------------------------------------------------------------------------
def _require_noise(model: Model) -> None:
    """Refuse images of unknown saturation or black level: both fake effects at any significance."""
    for name, cost in (
        ("saturation", "unmasked saturation makes the right effect lose in four of five cases"),
        ("black_level", "half a DN of black level looks like glare"),
    ):
        value = getattr(model.noise, name, None)
        if value is None or not math.isfinite(value):
            raise Underdetermined(
                f"diagnose: the camera's {name} is unknown, and {cost}; give it under [noise] in "
                "captures.toml, or estimate the noise from dark and repeated frames"
            )


def base_variables(model: Model, fit: Fit, fitted: Sequence[int]) -> tuple[list[Variable], list[str]]:
    """The variables that the base may move in the fitted frames, and names of those at a bound."""
    present = [v for v in fit.variables if v.frames is None or set(v.frames) & set(fitted)]
    bound = [v.name for v in present if v.name in fit.at_bound or at_bound(v, value_of(model, fit.values, v))]
    return [v for v in present if v.name not in bound], bound


def candidates_of(
    model: Model,
    fit: Fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    fitted: Sequence[int],
) -> tuple[list[Candidate], dict[str, str]]:
    """The effects that can be tested, at the values of the fit; {effect: why not} for the others."""
    taken = {key for v in fit.variables for key in v.keys}
    found: list[Candidate] = []
    not_tested = {}
    for effect in effects:
        variables = [v for v in variables_of(effect) if v.frames is None or set(v.frames) & set(fitted)]
        if not variables:
            not_tested[effect.name] = "the scene has no part that carries it"
            continue
        left = [v for v in variables if not any(key in taken for key in v.keys)]
        if not left:
            not_tested[effect.name] = "in the model already"
            continue
        if effect.scope == "frame" and _is_dealt_out(model, fitted):
            not_tested[effect.name] = "readings of one frame are spread over the session; name runs by [table] group"
            continue
        if effect.scope == "frame" and _fewest(model, left) < JUDGED:
            not_tested[effect.name] = (
                f"one strength per frame fits frames of fewer than {JUDGED} values, whatever they hold"
            )
            continue
        found.append(Candidate.at(model, fit.values, effect, left))
    return found, not_tested


def _is_dealt_out(model: Model, frames: Sequence[int]) -> bool:
    """Whether frames are sweeps of a table that no group keeps together."""
    return any(model.frames[f].readings and model.frames[f].group is None for f in frames)


def _fewest(model: Model, variables: Sequence[Variable]) -> float:
    """Usable values per strength, in the frames of the strength that has the fewest."""
    return min(sum(int(model.usable(f).sum()) for f in v.frames or ()) for v in variables)


def _require_convergence(model: Model, evidence: Evidence, fit: Fit) -> str:
    """Refuse a base that is not calibrated: |Q'r|^2 would be chi2 of a parameter, not of a missing effect.

    Allowed is 1 per parameter or, where the misfit exceeds noise, SETTLED of that excess. Of a tempered fit of images,
    whose misfit bends every step, MOVING of it passes with the sentence that is returned: scores are taken beside the
    base's parameters, at their optimum, so that only what is not linear in them is left to doubt."""
    rank = max(evidence.projected.rank, 1)
    excess = max(evidence.projected.chi2 - (evidence.normal.count - rank), 0.0)
    allowed = max(1.0, SETTLED * excess / rank)
    promised = evidence.projected.absorbed
    if promised >= allowed * rank:  # at a turning point of an angle the linearisation promises what no step brings
        promised = min(promised, _promised(model, evidence))
    gradient = promised / rank
    if allowed <= gradient < MOVING * excess / rank and fit.tempering > 1:
        return (
            f"the base may still absorb {promised / excess:.1%} of its misfit (chi2 by "
            f"{promised:.3g}, most of all {some(_off(evidence))}): what explains less than that may "
            "be the base's own"
        )
    if gradient >= allowed:
        how = "" if fit.converged else f" (it stopped: {fit.reason})"
        raise Underdetermined(
            f"diagnose: the base model is not calibrated to convergence{how}: moving its {rank} "
            f"parameters would lower chi2 by {promised:.3g}, {gradient:.3g} per parameter "
            f"(most of all {some(_off(evidence))}); allowed: below {allowed:.3g}; calibrate again from there, without "
            "robust weights, or hold parameters that the captures hardly tell apart: leave them out of --free, or "
            "give them a --prior"
        )
    return ""


def _promised(model: Model, evidence: Evidence) -> float:
    """The fall of chi2 that a step of the base's parameters would bring, with what the residual adds to its
    curvature."""
    base = evidence.base
    bend = own_curvature(model, [evidence.columns[c] for c in base], evidence.values, evidence.frames)
    u = evidence.normal.score[base] + evidence.pull
    return float(u @ evidence.inverse(base, bend) @ u)


def _off(evidence: Evidence) -> list[str]:
    """The variables of the base whose images change most in the step that would calibrate it."""
    step = evidence.inverse(evidence.base) @ (evidence.normal.score[evidence.base] + evidence.pull)
    change = np.abs(step) * np.sqrt(np.maximum(np.diag(evidence.normal.gram)[evidence.base], 0))
    return [evidence.columns[evidence.base[i]].name for i in np.argsort(-change)[:3] if change[i] > 0.3 * change.max()]


# -- ranking ---------------------------------------------------------------------------------------------------------
@dataclass
class Table:
    """All candidates, best first, and the family-wise test that they share.

    information   (k, k) V of all columns of candidates, zero where nothing is visible
    p_best        the smallest family-wise p
    uniform, dilated   effect -> net fall with uniform weights, and with masks one pixel wider
    """

    order: list[Candidate]
    information: np.ndarray
    family: st.Family
    p_best: float
    uniform: dict[str, float]
    dilated: dict[str, float]

    def leave_out(self, names: Collection[str]) -> None:
        """Without these effects from here on."""
        self.order = [c for c in self.order if c.effect.name not in names]
        self.uniform, self.dilated = (
            {name: net for name, net in nets.items() if name not in names} for nets in (self.uniform, self.dilated)
        )

    @property
    def preferred(self) -> dict[str, str]:
        """In words, other weights -> the best effect by them; '' for none."""
        return {
            how: max(net, key=lambda name: net[name], default="")
            for how, net in (("with uniform weights", self.uniform), ("with masks one pixel wider", self.dilated))
        }

    def fragile(self, effect: str, beside: Collection[str] = ()) -> str:
        """An effect that other weights or masks prefer clearly, and that is a RIVAL by the score itself, which does not
        prefer it clearly; '' for none. Equal weights count bright frames alone where a cause shows in dark ones: what
        explains a thirtieth of the misfit is no rival, whatever else it explains of bright frames.

        beside   effects that are missing as well
        """
        own = {c.effect.name: c for c in self.order}
        missing = {effect, *beside} & set(own)
        for net in (self.uniform, self.dilated):
            for name in sorted(net, key=lambda n: -net[n]):
                if name in missing or any(own[name].contains(own[m]) for m in missing) or effect not in net:
                    continue
                tried = own[name].row.refit
                if tried is not None and tried.fall < REALISED * own[name].row.fall:
                    continue  # a finite step that promises what no refit brings
                if own[name].row.net < RIVAL * own[effect].row.net:
                    continue
                if net[name] - net[effect] > CLEAR and own[name].row.net - own[effect].row.net < CLEAR:
                    return name
                break
        return ""


def solve(
    evidence: Evidence, candidates: Sequence[Candidate], seed: int = 0
) -> tuple[np.ndarray, list[tuple[np.ndarray, st.Cone]]]:
    """Score every candidate in its best form, and set that form, its columns, its cone and its row.

    Returns V of all columns of candidates (k, k), zero where nothing is visible, and (columns, cone) of every form.
    """
    projected, first = evidence.projected, len(evidence.base)
    visible = projected.survival > st.VISIBLE
    noise = st.noise_left(evidence.normal, evidence.base, evidence.rest, projected.response)
    size = np.diag(evidence.normal.gram)
    # what the noise of a derivative image makes of the products of two such images
    share = min(OWN_NOISE / math.sqrt(evidence.apart), 1.0)
    seen, spreads = np.zeros_like(projected.information), {}
    for c in candidates:
        for form, columns in c.forms.items():
            own = np.array(columns) - first
            # an image of rounding alone survives any projection
            visible[own] &= (size[columns] * c.plausible**2 > gauges.STILL) & (not c.broken)
            own = own[visible[own]]
            block = np.ix_(own, own)
            seen[block], spreads[c.effect.name, form] = st.certain(projected.information[block], noise[block], share)
    information, score = seen @ projected.information @ seen.T, seen @ projected.score
    shared: list[tuple[np.ndarray, st.Cone]] = []
    for c in candidates:
        forms = []
        for form, columns in c.forms.items():
            own = np.array(columns) - first
            cone = st.Cone(information[np.ix_(own, own)], c.sides, seed, spread=spreads[c.effect.name, form])
            shared.append((own, cone))
            forms.append((form, own, cone, *cone.solve(score[own])))
        c.form, own, c.cone, fall, c.linear = _best_form(c, forms)
        c.columns = [int(i) + first for i in own]
        c.row = _row(evidence, c, own, fall)
    return information, shared


def _best_form(c: Candidate, forms: Sequence[tuple]) -> tuple:
    """The form (name, places, cone, fall, coefficients) that explains most.

    A finite step that sees more directions than the slope must explain more by CLEAR: the steps of two offsets bend
    apart, which makes a common rotation look like something that readings show."""

    def net(form: tuple) -> float:
        return form[3] - form[2].expectation

    def rank(form: tuple) -> int:
        return st.inverse(form[2].information * np.outer(c.plausible, c.plausible), st.VISIBLE)[1]

    best = max(forms, key=net)
    slope = next((form for form in forms if form[0] == "tangent"), best)
    return slope if net(best) - net(slope) < CLEAR and 0 < rank(slope) < rank(best) else best


def _rank(evidence: Evidence, candidates: list[Candidate], seed: int) -> Table:
    """Score every candidate in its best form, and write its row."""
    information, shared = solve(evidence, candidates, seed)
    family = st.Family(information, shared, seed)
    uniform_gram = evidence.thinned(lambda block: block.sigma)
    for c in candidates:
        _write_row(evidence, c, candidates, information, family, uniform_gram)
    order = sorted(candidates, key=lambda c: (not len(c.cone.live), -c.row.net, c.effect.name))
    p_best = min((c.row.p_family for c in candidates), default=1.0)
    uniform = _net_by(evidence, uniform_gram, candidates)
    inner = np.concatenate([block.inner for block in evidence.blocks])
    dilated = {}
    if inner.mean() > INNER:  # of small islands little is left: other data, not another mask
        dilated = _net_by(evidence, evidence.thinned(lambda block: block.inner.astype(float)), candidates)
    return Table(order, information, family, p_best, uniform, dilated)


def _write_row(
    evidence: Evidence,
    c: Candidate,
    candidates: Sequence[Candidate],
    information: np.ndarray,
    family: st.Family,
    uniform: st.Normal,
) -> None:
    """Complete the row of a scored candidate: what needs the other candidates, or images in DN (`uniform`)."""
    row, chi2 = c.row, evidence.projected.chi2
    dof = max(evidence.normal.count - evidence.projected.rank, 1)
    row.p_family = family.p(row.p)
    row.power = c.cone.power(c.linear_of(c.usual / FAINT), c.cone.critical(family.critical(LEVEL)))
    raw = uniform.gram[np.ix_(c.columns, c.columns)]
    usual = c.linear_of(c.usual)
    c.raw = math.sqrt(max(usual @ raw @ usual, 0.0) / max(uniform.count, 1)) / evidence.signal
    row.image = math.sqrt(max(c.linear @ raw @ c.linear, 0.0) / max(uniform.count, 1)) / evidence.signal
    row.misfit_after = evidence.noise * math.sqrt(max(chi2 - row.fall, 0.0) / dof)
    excess = chi2 - dof
    row.share = row.net / excess if excess > EXCESS * math.sqrt(2 * dof) else math.nan
    row.confused_with, row.cos = _confused(information, c, candidates, len(evidence.base))
    if row.survival <= st.VISIBLE or not len(c.cone.live):
        row.flags.append("a derivative image is not finite" if c.broken else "nothing visible")
    if row.kappa > KAPPA:
        row.flags.append("noisy derivative")
    if any(
        v.parameter.neutral is not None and abs(value - v.parameter.neutral) > 1e-9 * abs(v.parameter.plausible)
        for v, value in zip(c.variables, c.start)
    ):
        row.flags.append("not at neutral: tests a change of the value assumed")


def _row(evidence: Evidence, c: Candidate, own: np.ndarray, fall: float) -> Row:
    """The row of a candidate by itself; own: places of its columns among those that were projected."""
    raw = np.diag(evidence.normal.gram)[c.columns] * c.plausible**2
    survival = float(evidence.projected.survival[own] @ raw / raw.sum()) if raw.sum() > 0 else 0.0
    kappa = evidence.normal.kappa()[c.columns]
    seen = c.cone.live
    change = c.change_of(c.linear)
    return Row(
        name=c.effect.name,
        variables=[v.name for v in c.variables],
        units=[v.parameter.unit for v in c.variables],
        form=c.form,
        fall=fall,
        expected=c.cone.expectation,
        p=float(c.cone.p(fall)),
        p_family=1.0,
        start=c.start.tolist(),
        change=change.tolist(),
        sd=c.sd_of(c.cone.sd).tolist(),
        of_plausible=float(np.max(np.abs(change) / c.plausible)),
        image=math.nan,
        misfit_after=math.nan,
        share=math.nan,
        survival=survival,
        power=0.0,
        kappa=float(kappa[seen].max(initial=0.0)),
        confused_with="",
        cos=0.0,
        upper=[math.nan] * len(c.variables),
        low=[v.parameter.bounds[0] for v in c.variables],
        high=[v.parameter.bounds[1] for v in c.variables],
        plausible=[v.parameter.plausible for v in c.variables],
    )


def _confused(information: np.ndarray, c: Candidate, candidates: Sequence[Candidate], first: int) -> tuple[str, float]:
    """The effect that mimics this one best, and |cos| of the angle between what survives of both."""
    own = np.array(c.columns) - first
    strength = c.direction
    full = float(strength @ information[np.ix_(own, own)] @ strength)
    best = ("", 0.0)
    for other in candidates:
        if other is c or not full > 0 or not other.columns or not len(other.cone.live):
            continue
        gap = st.gap(information, own, strength, np.array(other.columns) - first, other.cone)
        cos = math.sqrt(max(1 - gap / full, 0.0))
        if cos > best[1]:
            best = (other.effect.name, cos)
    return best


def _net_by(evidence: Evidence, normal: st.Normal, candidates: Sequence[Candidate]) -> dict[str, float]:
    """{effect: net fall} with other weights, scaled to a residual of one standard deviation."""
    if not candidates:
        return {}
    projected = evidence.project(normal, evidence.base, evidence.rest, evidence.thinning)
    first = len(evidence.base)
    scale = projected.chi2 / max(normal.count - projected.rank, 1)
    net: dict[str, float] = {}
    for c in candidates:
        if not len(c.cone.live):
            continue
        own = np.array(c.columns) - first
        seen = (projected.survival[own] > st.VISIBLE).astype(float)
        cone = st.Cone(projected.information[np.ix_(own, own)] * np.outer(seen, seen), c.sides, draws=1000)
        net[c.effect.name] = cone.solve(projected.score[own] * seen)[0] / scale - cone.expectation
    return net
