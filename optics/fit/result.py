"""What a calibration found: `Fit`, its table, and warnings about what the captures do not determine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from optics.fit import showing
from optics.fit.descent import Normal, scaled_eigen
from optics.fit.gauges import STILL, Gauges, gauges_of, sparse_basis
from optics.fit.tempering import weight_of
from optics.scene.parameter import Values, Variable
from optics.words import NOT_DETERMINED, some

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALIKE = 0.995  # correlation beyond which two variables are reported as not told apart: 1/sqrt(1 - r^2) = 10 times the
# error that either would have alone
DEGENERATE = (
    1e-7  # eigenvalue of the scaled normal matrix, over the largest, of a degenerate mode: 3000 times the error
)
HUGE = (
    3.0  # plausible sizes: a standard deviation beyond, of a variable in a gauge, is that of its prior or of rounding
)
MEMBER = 0.15  # component in a degenerate mode above which a variable is named with it: 2 % of the mode's square


@dataclass
class Fit:
    """What a calibration found.

    values       the start values with the estimates put in
    estimate     (p,) in the order of `variables`; covariance (p, p) from the noise model and the priors
    chi2, dof    of the data, without priors; per frame in frame_chi2, frame_n
    converged    whether the fall of chi2 that is still predicted is below 1 per variable, or below a thousandth of the
                 chi2 that noise does not explain; `reason` says why the fit stopped
    warnings     sentences: degenerate modes, variables without effect, variables at a bound
    normal       the last linearisation, for `optics.fit.calibrate.extended`
    promised     of `extended`: the fall of what is minimised that the base's derivative images promised; else NaN
    """

    values: Values
    variables: list[Variable]
    estimate: np.ndarray
    covariance: np.ndarray
    chi2: float
    dof: int
    frames: list[int]
    frame_chi2: list[float]
    frame_n: list[int]
    converged: bool
    reason: str
    history: list[float] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    start: np.ndarray | None = None
    at_bound: list[str] = field(default_factory=list)
    normal: Normal | None = None
    promised: float = float("nan")

    @property
    def sd(self) -> np.ndarray:
        """(p,) standard deviation of each estimate, in the variable's unit; infinite where undetermined."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))

    @property
    def tempering(self) -> float:
        """T by which the model's own misfit exceeds noise (optics.fit.tempering); 1: by nothing."""
        return weight_of(self.variables)

    @property
    def error(self) -> np.ndarray:
        """(p,) standard deviation of each estimate where the misfit counts as noise, sqrt(T) sd."""
        return math.sqrt(self.tempering) * self.sd

    @property
    def posterior(self) -> np.ndarray | None:
        """(p, p) covariance (A/T + diag(1/plausible^2))^-1 to draw sensors from; None without a linearisation.

        A is the normal matrix of data and priors, T the tempering. The second term says that no value differs from what
        was found by more than a real sensor shows: what the captures leave open stays within that, and the change is
        below a hundredth of the variance where the standard deviation is a tenth of the plausible size.
        """
        if self.normal is None:
            return None
        sizes = np.array([v.parameter.plausible for v in self.variables])
        scaled = self.normal.a * np.outer(sizes, sizes) / self.tempering + np.eye(len(sizes))
        unit = np.sqrt(np.diag(scaled))
        eigen, vectors = np.linalg.eigh(scaled / np.outer(unit, unit))
        # a product of a matrix with its transpose has no eigenvalue below 0, however ill-conditioned the fit
        root = vectors / np.sqrt(np.maximum(eigen, len(sizes) * np.finfo(float).eps)) * (sizes / unit)[:, None]
        return root @ root.T

    @property
    def correlation(self) -> np.ndarray:
        """(p, p), -1..1."""
        sd = np.where((self.sd > 0) & np.isfinite(self.sd), self.sd, 1)
        return self.covariance / np.outer(sd, sd)

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / max(self.dof, 1)

    @property
    def total(self) -> float:
        """What was minimised: chi2 of the data plus that of the priors; NaN without a linearisation."""
        return np.nan if self.normal is None else self.normal.total

    def seen(self, places: Sequence[int]) -> bool:
        """Whether a change of each of these variables by its plausible size changes the frames, to first order."""
        if self.normal is None:
            return True
        sizes = np.array([self.variables[i].parameter.plausible for i in places])
        return bool(np.all(np.diag(self.normal.a)[list(places)] * sizes**2 > STILL))

    @property
    def gauges(self) -> Gauges:
        """What no frame shows, and the combinations that are known beside it (optics.fit.gauges)."""
        return gauges_of(self)

    def blurred(self, gauges: Gauges) -> set[int]:
        """Places of variables whose own standard deviation is that of their priors, or of nothing: gauges leave them
        open, or no frame depends on them."""
        sd = self.sd
        return {i for i in (*gauges.members, *gauges.silent) if sd[i] > HUGE * self.variables[i].parameter.plausible}

    @property
    def ended(self) -> list[str]:
        """The variables of `at_bound` that stand at a bound, or are known to be off: of what is not determined, none
        has come to its bound."""
        if not self.at_bound:
            return []
        blurred, found = self.blurred(self.gauges), []
        for i, v in enumerate(self.variables):
            low, high = v.parameter.bounds
            known = i not in blurred and v.parameter.reach.holds(self.estimate[i], self.sd[i])
            if v.name in self.at_bound and (known or not low < self.estimate[i] < high):
                found.append(v.name)
        return found

    def table(self) -> str:
        """One line per variable: estimate, standard deviation, unit, start, and the strongest correlation. Of variables
        that only a combination of is determined, the combinations follow."""
        lines = [f"{'variable':<28}{'estimate':>12}{'+- sd':>11}  {'unit':<6}{'start':>11}   strongest correlation"]
        correlation = np.abs(self.correlation - np.eye(len(self.variables)))
        gauges = self.gauges
        blurred, ended = self.blurred(gauges), self.ended
        for i, variable in enumerate(self.variables):
            j = int(np.argmax(correlation[i])) if len(self.variables) > 1 else i
            other = f"{self.correlation[i, j]:+.2f} {self.variables[j].name}" if j != i else ""
            start = "" if self.start is None else f"{self.start[i]:11.5g}"
            bound = "  at its bound" if variable.name in ended else ""
            number = f"{self.estimate[i]:12.5g}{self.error[i]:11.2g}"
            if i in blurred:
                number = f"{self.estimate[i]:12.5g}{'unseen' if i in gauges.silent else 'gauge':>11}"
            elif not variable.parameter.reach.holds(self.estimate[i], self.sd[i]):
                number = f"{NOT_DETERMINED:>23}"
            elif np.isnan(self.sd[i]):
                number = f"{self.estimate[i]:12.5g}{'?':>11}"
            lines.append(f"{variable.name:<28}{number}  {variable.parameter.unit:<6}{start}   {other}{bound}")
        lines += gauges.lines()
        lines.append(
            f"chi2 per degree of freedom {self.chi2_per_dof:.4f} ({self.dof} degrees of freedom); {self.reason}"
        )
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])

    def records(self) -> list[dict[str, Any]]:
        """One record per variable (optics.fit.showing.records)."""
        return showing.records(self)

    def plot(self) -> Figure:
        """A chart of changes, pulls and misfit by frame (optics.fit.showing.plot)."""
        return showing.plot(self)

    def _repr_html_(self) -> str:
        return showing.html(self)


def warnings_of(result: Fit, a: np.ndarray) -> list[str]:
    """Sentences about variables that cannot be told apart, that do nothing, or that stand at a bound.

    a   (p, p) normal matrix at the estimate
    """
    names = [v.name for v in result.variables]
    silent = [n for n, d in zip(names, np.diag(a)) if d == 0]
    still = [v.name for v, d in zip(result.variables, np.diag(a)) if d == 0 and v.parameter.starts]
    unseen = [n for n in silent if n not in still]
    texts = [f"nothing in the frames depends on {some(unseen, 8)}"] if unseen else []
    if still:
        texts.append(f"to first order nothing in the frames depends on {some(still, 8)} at the values found")
    modes = _degenerate_modes(names, a, silent)
    held = [{names[i] for i in g.members} for g in result.gauges.gauges]  # by priors: the table lists them
    for mode in modes:
        texts.append(
            f"the captures cannot tell apart {some(mode, 8)}: only a combination is determined; hold one of "
            "them, or give it a prior"
        )
    texts += _correlated(result, names, [set(), *map(set, modes), *held])
    together = {n for mode in modes for n in mode}
    texts += [f"{n} ended at its bound" for n in result.ended if n not in together]
    if not result.converged:
        texts.append(result.reason)
    return texts


def _degenerate_modes(names: list[str], a: np.ndarray, silent: list[str]) -> list[list[str]]:
    """The variables of each direction that data and priors do not determine, in as few variables as there may be."""
    if not len(a):
        return []
    _, eigen, vectors = scaled_eigen(a)
    live = np.array([n not in silent for n in names])
    basis, _ = sparse_basis(vectors[:, (eigen < DEGENERATE * eigen.max()) & vectors[live].any(0)])
    modes = [
        [n for n, c in zip(names, vector) if abs(c) > MEMBER * np.linalg.norm(vector) and n not in silent]
        for vector in basis.T
    ]
    return [mode for mode in modes if len(mode) > 1]


def _correlated(result: Fit, names: list[str], told: list[set[str]]) -> list[str]:
    """One sentence for each set of variables that are correlated beyond ALIKE, directly or through others; sets within
    one of `told` are left out."""
    if not names:
        return []
    texts = []
    correlation = np.nan_to_num(result.correlation, posinf=0.0, neginf=0.0) * (1 - np.eye(len(names)))
    count, member = connected_components(np.abs(correlation) > ALIKE)
    for one in (np.flatnonzero(member == k) for k in range(count)):
        if len(one) < 2 or any({names[i] for i in one} <= part for part in told):
            continue
        if len(one) == 2:
            texts.append(f"{names[one[0]]} and {names[one[1]]} are correlated to {correlation[one[0], one[1]]:+.4f}")
        else:
            most = np.abs(correlation[np.ix_(one, one)]).max()
            texts.append(
                f"{some([names[i] for i in one])} are correlated among each other, to {most:.4f} at most: the captures "
                "determine little more than one combination of them; hold one of them, or give it a prior"
            )
    return texts
