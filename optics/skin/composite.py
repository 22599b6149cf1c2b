"""A clear silicone skin with a polarizer film in it, held at its rim: finite elements, and springs in the film's place.

    skin = Skin()                                              48 x 43 x 5 mm, E 0.04 N/mm^2, nu 0.49
    pushed = skin.push((0.0, 0.0), 3.0, radius=6.0, c=0.02)    forces per node and every node's place, mm and N
    c = fit_springs(skin, places, depth, forces, radius)       (5): from four measured forces

The skin's rim is held, its inner face is free. The film is not meshed: as the source has it, springs hold the nodes of
its plane where they were, with a stiffness per node that is a spheroid over the face,

    x^2/a^2 + y^2/b^2 + z^2/c^2 = 1 (3),    z = -c sqrt(1 - x^2/a^2 - y^2/b^2) (4),    k_i of z_i,
    c = argmin over c of the mean square of lambda_sim(c) - lambda_real (5)

with a and b such that the spheroid just covers the face: its corners lie on the rim, a = width/sqrt 2 of the half
widths. Decided where the source leaves it open:
  form      "bowl": k = c + z, nothing in the middle and c at the corners, which is the lower half's height above its
            lowest point, and what the text says ("a descending tendency toward the center"). "printed": k = |z|, as (4)
            has it, largest in the middle. The restriction -c/2 < z < 0 that stands beside (3) would leave k in the
            corners alone, and is left out
  unit      N/mm per mm^2 of the film's plane, so that c keeps its value on another mesh; a node's spring is k times
            its share of the plane
  contact   a rigid ball without friction on the nodes of the outer face (Signorini): gap >= 0, force >= 0, and one of
            the two is 0

Elements are bricks with eight nodes and the volume change of each element in common (B-bar), so that a ratio of 0.49
does not lock: from 24 x 22 x 4 to 32 x 30 x 6 of them the skin under a soft load gives way by 0.1 % more. Validity:
small strains, where the source turns them with the element; the rim of the real skin is glued.
Source: Vi2TaP (RA-L 2025), III.A.1, eqs. (2)-(5); Hughes, The Finite Element Method (1987), 4.5, for B-bar.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from optics.errors import UnknownKey

FORMS = ("bowl", "printed")
NEAR = 1.3  # of the contact radius of a geometric cap: nodes that may come to touch the ball
STEPS = 60  # of the active set; it ends after some ten
FITTED = 1e-4  # of c, relative, where the search for it ends
WIDEST = 1e4  # of the skin's own stiffness: the largest c that is sought


@dataclass(frozen=True, eq=False)
class Pushed:
    """A skin under a ball: `positions` (N, 3) mm of its nodes now, `force` (N, 3) N of the ball on each, `displacement`
    (N, 3) mm, and the total `load` (3,) N; z runs from the camera to the outer face at z = 0."""

    positions: np.ndarray
    displacement: np.ndarray
    force: np.ndarray

    @property
    def load(self) -> np.ndarray:
        return self.force.sum(0)


@dataclass(frozen=True)
class Skin:
    """size mm along x, y, z; elements along each; E N/mm^2; nu; the film's plane in nodes below the outer face."""

    size: tuple[float, float, float] = (48.0, 43.0, 5.0)
    elements: tuple[int, int, int] = (24, 22, 4)
    young: float = 0.04
    poisson: float = 0.49
    film: int = 2

    def __post_init__(self):
        if not (
            min(self.size) > 0
            and min(self.elements) >= 1
            and self.young > 0
            and 0 <= self.poisson < 0.5
            and 0 <= self.film <= self.elements[2]
        ):
            raise ValueError(
                f"skin of {self.size} mm, {self.elements} elements, E = {self.young:g} N/mm^2, ratio {self.poisson:g}, "
                f"film {self.film} nodes deep; allowed: sizes, elements and E above 0, a ratio from 0 to below 0.5, a "
                "film within"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along x, y, z."""
        return tuple(n + 1 for n in self.elements)  # type: ignore[return-value]

    @cached_property
    def nodes(self) -> np.ndarray:
        """(N, 3) mm at rest, z fastest, from -thickness to 0."""
        x, y = (np.linspace(-s / 2, s / 2, n) for s, n in zip(self.size[:2], self.shape))
        z = np.linspace(-self.size[2], 0.0, self.shape[2])
        return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)

    def layer(self, below: int) -> np.ndarray:
        """Numbers of the nodes of a plane, counted from the outer face."""
        return np.arange(self.shape[2] - 1 - below, math.prod(self.shape), self.shape[2])

    @cached_property
    def held(self) -> np.ndarray:
        """(N,) bool: nodes of the rim."""
        outer = np.abs(self.nodes[:, :2]) > np.array(self.size[:2]) / 2 - 1e-9
        return outer.any(1)

    @cached_property
    def stiffness(self):
        """(3 N, 3 N) sparse, N/mm: of the silicone alone."""
        from scipy.sparse import coo_matrix

        edges = np.array(self.size) / self.elements
        one = brick(tuple(map(float, edges)), self.young, self.poisson)
        i, j, k = np.indices(self.elements).reshape(3, -1)
        first = (i * self.shape[1] + j) * self.shape[2] + k
        corner = np.array([(a * self.shape[1] + b) * self.shape[2] + c for a in (0, 1) for b in (0, 1) for c in (0, 1)])
        freedom = (3 * (first[:, None] + corner)[..., None] + np.arange(3)).reshape(len(first), 24)
        rows, columns = np.repeat(freedom, 24, 1).ravel(), np.tile(freedom, (1, 24)).ravel()
        n = 3 * len(self.nodes)
        return coo_matrix((np.tile(one.ravel(), len(first)), (rows, columns)), (n, n)).tocsc()

    def springs(self, c: float, form: str = "bowl") -> np.ndarray:
        """(n,) N/mm of the springs at the nodes of the film's plane; c in N/mm^3."""
        if form not in FORMS:
            raise UnknownKey(form, FORMS, "form", "spheroid springs")
        if not (c >= 0 and math.isfinite(c)):
            raise ValueError(f"c = {c:g} N/mm^3; allowed: 0 and more")
        at = self.nodes[self.layer(self.film)]
        half = np.array(self.size[:2]) / 2 * math.sqrt(2)
        z = -c * np.sqrt(np.maximum(1 - ((at[:, :2] / half) ** 2).sum(1), 0.0))
        dx, dy = (s / e for s, e in zip(self.size[:2], self.elements))
        return (c + z if form == "bowl" else -z) * dx * dy

    def push(
        self, place: tuple[float, float], depth: float, radius: float, c: float = 0.0, form: str = "bowl"
    ) -> Pushed:
        """The skin under a ball of a radius whose lowest point is `depth` below the outer face at `place`, mm."""
        if not (radius > 0 and 0 <= depth < self.size[2] and all(abs(p) <= s / 2 for p, s in zip(place, self.size))):
            raise ValueError(
                f"ball of radius {radius:g} mm at {place}, {depth:g} mm deep; allowed: a radius above 0, a place on "
                f"the skin of {self.size[0]:g} x {self.size[1]:g} mm, a depth below its {self.size[2]:g} mm"
            )
        solve = _factor(self, float(c), form)
        face = self.layer(0)
        r = np.hypot(*(self.nodes[face, :2] - place).T)
        height = np.where(r < radius, radius - np.sqrt(np.maximum(radius**2 - r**2, 0)), math.inf)
        overlap = depth - height
        reach = NEAR * math.sqrt(max(2 * radius * depth - depth**2, 0.0)) + self.size[0] / self.elements[0]
        able = (r < min(reach, radius)) & np.isfinite(overlap) & ~self.held[face]
        candidates, wanted = face[able], overlap[able]
        displacement, force = np.zeros((len(self.nodes), 3)), np.zeros((len(self.nodes), 3))
        if not len(candidates) or wanted.max(initial=-1.0) <= 0:
            return Pushed(self.nodes.copy(), displacement, force)
        loads = np.zeros((3 * len(self.nodes), len(candidates)))
        loads[3 * candidates + 2, np.arange(len(candidates))] = -1.0
        moved = solve(loads)  # columns: of a unit force inwards at each candidate
        compliance = -moved[3 * candidates + 2]
        pressed = complementary(compliance, wanted)
        displacement = (moved @ pressed).reshape(-1, 3)
        force[candidates, 2] = -pressed
        return Pushed(self.nodes + displacement, displacement, force)


@lru_cache(maxsize=8)
def _factor(skin: Skin, c: float, form: str):
    return solver(skin, c, form, skin.held)


def solver(skin: Skin, c: float, form: str, held: np.ndarray):
    """Solver of a skin with its springs whose nodes `held` (N,) bool do not move: loads (3 N, m) -> displacements
    (3 N, m), N and mm."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    free = np.flatnonzero(np.repeat(~held, 3))
    extra = np.zeros(3 * len(skin.nodes))
    for axis in range(3):
        extra[3 * skin.layer(skin.film) + axis] = skin.springs(c, form)
    matrix = (skin.stiffness + diags(extra)).tocsc()[free][:, free]
    factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def solve(loads: np.ndarray) -> np.ndarray:
        out = np.zeros_like(loads)
        out[free] = factors.solve(np.ascontiguousarray(loads[free]))
        return out

    return solve


def complementary(compliance: np.ndarray, wanted: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """f >= 0 with A f >= wanted and f (A f - wanted) = 0, for a positive definite A: an active set (Signorini).

    start   (N,) bool: the set to begin with; None: where something is wanted"""
    from scipy.linalg import solve

    active = wanted > 0 if start is None else start
    for _ in range(STEPS):
        force = np.zeros(len(wanted))
        if active.any():
            own = compliance[np.ix_(active, active)]
            force[active] = solve(own, wanted[active], assume_a="pos", check_finite=False)
        short = wanted - compliance @ force
        changed = np.where(active, force > 0, short > 1e-9 * np.abs(wanted).max())
        if (changed == active).all():
            return force
        active = changed
    raise RuntimeError(f"the contact did not settle in {STEPS} steps; press less deep or take larger elements")


def brick(edges: tuple[float, float, float], young: float, poisson: float) -> np.ndarray:
    """(24, 24) N/mm: stiffness of a brick with eight nodes (x slowest, z fastest; x, y, z of each), B-bar."""
    lame = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    shear = young / (2 * (1 + poisson))
    moduli = np.zeros((6, 6))
    moduli[:3, :3] = lame
    moduli[np.arange(6), np.arange(6)] += [2 * shear] * 3 + [shear] * 3
    corners = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], float)
    points = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3)
    volume = math.prod(edges)
    slopes = []
    for p in points:
        one = 1 + corners * p
        slope = np.stack([corners[:, i] * one[:, (i + 1) % 3] * one[:, (i + 2) % 3] / 8 for i in range(3)], -1)
        slopes.append(slope * 2 / np.array(edges))
    common = np.mean(slopes, axis=0).reshape(-1)  # change of volume per displacement, of the whole brick
    stiffness = np.zeros((24, 24))
    for slope in slopes:
        strain = np.zeros((6, 24))
        for axis in range(3):
            strain[axis, axis::3] = slope[:, axis]
        for row, (a, b) in enumerate(((1, 2), (2, 0), (0, 1)), 3):
            strain[row, a::3], strain[row, b::3] = slope[:, b], slope[:, a]
        strain[:3] += (common - strain[:3].sum(0)) / 3
        stiffness += strain.T @ moduli @ strain * volume / 8
    return stiffness


def fit_springs(
    skin: Skin,
    places: Sequence[tuple[float, float]],
    depth: float,
    forces: Sequence[float],
    radius: float,
    form: str = "bowl",
) -> float:
    """c (N/mm^3) of (5): the least mean square of simulated less measured normal forces, N, at places, mm.

    The source takes four places, one in each quadrant. Raises ValueError for fewer than one place, for forces that are
    not above 0, and where even the bare skin is stiffer than what was measured."""
    from scipy.optimize import minimize_scalar

    forces = np.asarray(forces, float)
    if not len(places) or forces.shape != (len(places),) or not (forces > 0).all():
        raise ValueError(f"{len(places)} places and forces {forces}; allowed: a force above 0 (N) for each place")

    def misfit(c: float) -> float:
        found = [-skin.push(place, depth, radius, c, form).load[2] for place in places]
        return float(np.mean((np.array(found) - forces) ** 2))

    scale = skin.young / skin.size[2] ** 2  # N/mm^3: a spring as stiff as a column of the skin
    lowest = math.log(scale / WIDEST)
    found = minimize_scalar(
        lambda log: misfit(math.exp(log)),
        bounds=(lowest, math.log(scale * WIDEST)),
        method="bounded",
        options={"xatol": FITTED},
    )
    if misfit(0.0) <= found.fun:
        raise ValueError(
            f"the bare skin fits as well as any springs: forces of {forces} N at {depth:g} mm need none; allowed: "
            "forces above the bare skin's; check E, the radius and the depth"
        )
    return math.exp(found.x)
