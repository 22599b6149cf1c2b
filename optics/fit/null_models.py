"""Null models: what a physical model of a pressed gel must beat before it has said anything.

    background           I = B
    directional          I = B + l . (n - n0)   or   I = B max(0, n . l)/(n0 . l)      one light at infinity per
                         channel; the table shows the form with the smaller error on the held-out frames
    linear in the normal I = B + sum over (n_x, n_y, n_z - 1) x (1, x, y, x^2, xy, y^2), 18 coefficients per channel

with the background B (the flat field times the frame's gain), the normal n of the pressed face towards the camera, n0
the same at rest, and x, y the position on the face in units of half the image's width. All use the frames, masks,
gains, split and geometry of the physical model. Poses are those of the physical model, or refined for the null by
Gauss-Newton on fitted and held-out frames; whichever gives the null the smaller held-out error counts.

Errors are differences to the images in DN on usable pixels, predictions clipped to the camera's range: rms and L1,
within `NEAR` labelled radii of the contact and in the whole image.

A scoreboard (optics.study.scoreboard) holds models against the tables of `tables()`, whose level is free:

    I = K + (B - K) f(n, x, y)    or    I = K + (B - K) + level (f(n, x, y) - 1)

with the black level K, the mean level of B - K, and f of one of these kinds, of so many numbers per light and channel:

    mean                           c                                                   1
    directional Lambert            max(0, l . n) + 1 - l_z, 1 where the face is level  3
    linear, quadratic, cubic       harmonics of the normal up to order 1, 2, 3         4, 9, 16
    ... with position              the same times (1, x, y)                            12, 27
    ... with position squared      linear, times (1, x, y, x^2, xy, y^2)               24
    polynomial table               a quadratic of the place in each bin of normals     6 a bin"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from optics.captures.importing import POSE, PRIORS
from optics.errors import Underdetermined
from optics.light.renderer import everywhere
from optics.scene.parameter import Values

if TYPE_CHECKING:
    from optics.fit.scene_model import SceneModel

NEAR = 2.0  # labelled radii
SEEN = 1e-6  # of a normal's components, which are of order 1: below is rounding
STEPS = (0.02, 0.02, 0.02)  # mm, of the central differences of normals by the pose


@dataclass
class Score:
    """Errors of one model on one split, per channel, DN."""

    model: str
    split: str  # 'fitted' or 'held out'
    poses: str
    rms_near: list[float]
    rms_whole: list[float]
    l1_near: list[float]
    l1_whole: list[float]


@dataclass
class NullTable:
    """Scores of the physical model and of the nulls on the same frames; noise: the camera's sd at the background,
    DN."""

    scores: list[Score]
    noise: list[float]
    fitted: list[str] = field(default_factory=list)
    held_out: list[str] = field(default_factory=list)

    def of(self, model: str, split: str = "held out") -> Score:
        return next(s for s in self.scores if s.model == model and s.split == split)

    @property
    def nulls(self) -> list[str]:
        return [s.model for s in self.scores if s.split == "held out" and s.model != PHYSICAL]

    def wins(self, measure: str = "rms_near") -> list[bool]:
        """Per channel: whether the physical model beats every null on the held-out frames."""
        own = np.array(getattr(self.of(PHYSICAL), measure))
        return [bool(w) for w in own < np.min([getattr(self.of(n), measure) for n in self.nulls], axis=0)]

    def text(self) -> str:
        """A table of the errors per channel, held-out frames first."""
        titles = [f"{what}, {where}" for what in ("rms", "L1") for where in (f"r < {NEAR:g} radii", "whole")]
        lines = [f"{'':<30}{'poses':<10}" + "".join(f"{title:>24}" for title in titles)]
        for split in ("held out", "fitted"):
            names = self.held_out if split == "held out" else self.fitted
            lines.append(f"{split}{f' ({len(names)} frames)' if names else ''}, DN, R / G / B")
            for s in self.scores:
                if s.split == split:
                    cells = [" / ".join(f"{v:.2f}" for v in getattr(s, m)) for m in MEASURES]
                    lines.append(f"  {s.model:<28}{s.poses:<10}" + "".join(f"{c:>24}" for c in cells))
        lines.append(f"{'noise of the camera':<40}{' / '.join(f'{v:.2f}' for v in self.noise):>24}")
        lines.append(
            f"the physical model beats every null on held-out frames in {self.won or 'no channel'} "
            "(rms near the contact)"
        )
        return "\n".join(lines)

    @property
    def channels(self) -> list[str]:
        return list("RGB") if len(self.noise) == 3 else [str(c) for c in range(len(self.noise))]

    @property
    def won(self) -> str:
        """The channels in which the physical model beats every null near the contact; '' for none."""
        return ", ".join(c for c, w in zip(self.channels, self.wins()) if w)

    @classmethod
    def from_json(cls, data: dict) -> NullTable:
        return cls([Score(**score) for score in data["scores"]], data["noise"], data["fitted"], data["held_out"])

    def json(self) -> dict:
        return {
            "scores": [asdict(s) for s in self.scores],
            "noise": self.noise,
            "fitted": self.fitted,
            "held_out": self.held_out,
            "wins": self.wins(),
        }


PHYSICAL = "physical"
MEASURES = ("rms_near", "rms_whole", "l1_near", "l1_whole")


def _mean(measure: str, values: Sequence[Sequence[float]], weights: Sequence[int]) -> list[float]:
    """Weighted mean over folds, per channel: of squares for an rms."""
    power = 2 if measure.startswith("rms") else 1
    return (np.average(np.array(values) ** power, axis=0, weights=weights) ** (1 / power)).tolist()


def pooled(tables: Sequence[NullTable]) -> NullTable:
    """One table of several folds: squares and sizes of errors averaged, each fold by its number of frames."""
    scores = []
    for first in tables[0].scores:
        parts = [t.of(first.model, first.split) for t in tables]
        weights = [len(t.held_out if first.split == "held out" else t.fitted) for t in tables]
        mean = {m: _mean(m, [getattr(p, m) for p in parts], weights) for m in MEASURES}
        poses = parts[0].poses if len({p.poses for p in parts}) == 1 else "either"
        scores.append(Score(first.model, first.split, poses, **mean))
    return NullTable(
        scores,
        np.mean([t.noise for t in tables], axis=0).tolist(),
        [n for t in tables for n in t.fitted],
        [n for t in tables for n in t.held_out],
    )


# -- the nulls -------------------------------------------------------------------------------------------------------
class Null(Protocol):
    """A model without physics: fitted to frames, it predicts others from their shapes."""

    name: str

    def fit(self, shapes: Sequence[Shape], rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> Null:
        """Fit to (image, weight) of frames with these shapes."""
        ...

    def predict(self, shape: Shape) -> np.ndarray:
        """(H, W, C) DN."""
        ...


class Background:
    """I = B."""

    name = "background"

    def fit(self, shapes: Sequence[Shape], rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> Null:
        return self

    def predict(self, shape: Shape) -> np.ndarray:
        return shape.background


class Additive:
    """I = B + l . (n - n0), per channel."""

    name = "directional, additive"

    def features(self, shape: Shape) -> np.ndarray:
        """(H W, F), without the background's factor."""
        return shape.tilt.reshape(-1, 3)

    def fit(self, shapes: Sequence[Shape], rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> Null:
        self.coefficients: list[np.ndarray] = []
        for c in range(rows[0][0].shape[-1]):
            a: Any = 0
            b: Any = 0
            for shape, (image, weight) in zip(shapes, rows):
                f, w = self.features(shape), weight[..., c].ravel()
                a = a + (f.T * w) @ f
                b = b + (f.T * w) @ (image - shape.background)[..., c].ravel()
            self.coefficients.append(np.linalg.solve(a + 1e-9 * np.trace(a) / len(a) * np.eye(len(a)), b))
        return self

    def predict(self, shape: Shape) -> np.ndarray:
        steps = self.features(shape) @ np.array(self.coefficients).T
        return shape.background + steps.reshape(shape.background.shape)


class Linear(Additive):
    """I = B + (n - n0) times a quadratic of the place, 18 coefficients per channel."""

    name = "linear in the normal"

    def features(self, shape: Shape) -> np.ndarray:
        x, y = shape.x, shape.y
        place = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
        return (shape.tilt[..., :, None] * place[..., None, :]).reshape(-1, 18)


class Multiplicative:
    """I = B max(0, n . l)/(n0 . l), per channel, with l = (a, b, 1) as n0 = (0, 0, 1); linear where it is lit."""

    name = "directional, multiplicative"

    def fit(self, shapes: Sequence[Shape], rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> Null:
        self.coefficients: list[np.ndarray] = [np.zeros(2) for _ in range(rows[0][0].shape[-1])]
        for c in range(rows[0][0].shape[-1]):
            for _ in range(4):
                a: Any = 0
                b: Any = 0
                for shape, (image, weight) in zip(shapes, rows):
                    n, flat = shape.tilt, shape.background[..., c]
                    lit = 1 + n[..., 2] + n[..., :2] @ self.coefficients[c] > 0
                    f = (n[..., :2] * flat[..., None] * lit[..., None]).reshape(-1, 2)
                    left = np.where(lit, image[..., c] - flat * (1 + n[..., 2]), 0).ravel()
                    w = weight[..., c].ravel()
                    a, b = a + (f.T * w) @ f, b + (f.T * w) @ left
                self.coefficients[c] = np.linalg.solve(a + 1e-9 * np.eye(2), b)
        return self

    def predict(self, shape: Shape) -> np.ndarray:
        n = shape.tilt
        return shape.background * np.maximum(1 + n[..., 2:] + n[..., :2] @ np.array(self.coefficients).T, 0)


@dataclass
class Shape:
    """What a null knows of a frame: background (H, W, C) DN, n - n0 (H, W, 3), place x, y (H, W), black level DN."""

    background: np.ndarray
    tilt: np.ndarray
    x: np.ndarray
    y: np.ndarray
    black: float = 0.0


# -- tables with a free level ----------------------------------------------------------------------------------------
class Table:
    """I = K + (B - K) f, or with `added` I = B + level (f - 1); a subclass says what f is.

    A weight of `fit` is that of a value of f, 0 where it is not to be used."""

    name = ""

    def __init__(self, added: bool = False):
        self.added = added

    def numbers(self) -> int:
        """How many numbers a fitted table has for each channel."""
        raise NotImplementedError

    def fit(self, shapes: Sequence[Shape], rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> Null:
        """Raises Underdetermined where no pixel has a weight."""
        light = [s.background - s.black for s in shapes]
        self.level = np.maximum(np.mean([b.mean((0, 1)) for b in light], 0), 1e-6)
        values, weights = [], []
        for s, b, (image, weight) in zip(shapes, light, rows):
            unit = self.level if self.added else np.maximum(b, 1e-6)
            values.append((1 + (image - s.background) / unit).reshape(-1, image.shape[2]))
            weights.append(np.broadcast_to(weight, image.shape).reshape(-1, image.shape[2]))
        tilt = np.concatenate([s.tilt.reshape(-1, 3) for s in shapes])
        place = np.concatenate([np.stack([s.x.ravel(), s.y.ravel()], -1) for s in shapes])
        w = np.concatenate(weights)
        use = (w > 0).any(1)
        if not use.any():
            raise Underdetermined(f"{self.name}: no usable pixel to fit to; check the masks and the region")
        self.learn(tilt[use], place[use], np.concatenate(values)[use], w[use])
        return self

    def learn(self, tilt: np.ndarray, place: np.ndarray, values: np.ndarray, weight: np.ndarray) -> None:
        """Fit f to values (N, C) with weights (N, C), tilts n - n0 (N, 3) and places (N, 2)."""
        raise NotImplementedError

    def evaluate(self, tilt: np.ndarray, place: np.ndarray) -> np.ndarray:
        """(N, C): f."""
        raise NotImplementedError

    def predict(self, shape: Shape) -> np.ndarray:
        f = self.evaluate(shape.tilt.reshape(-1, 3), np.stack([shape.x.ravel(), shape.y.ravel()], -1))
        f = f.reshape(shape.background.shape)
        if self.added:
            return shape.background + self.level * (f - 1)
        return shape.black + (shape.background - shape.black) * f


class Polynomial(Table):
    """f: harmonics of the normal up to order `normal`, times a polynomial of the place of degree `place`.

    On the sphere these are the polynomials in n_x, n_y of that order, and n_z times those of one order less."""

    def __init__(self, name: str, normal: int, place: int = 0, added: bool = False):
        super().__init__(added)
        self.name, self.normal, self.place = name, normal, place

    def features(self, tilt: np.ndarray, place: np.ndarray) -> np.ndarray:
        """(N, F)."""
        x, y, z = tilt.T
        of_normal = [*_monomials(x, y, self.normal), *(z * m for m in _monomials(x, y, self.normal - 1))]
        return np.stack([a * b for a in of_normal for b in _monomials(*place.T, self.place)], -1)

    def numbers(self) -> int:
        return len(self.coefficients)

    def learn(self, tilt: np.ndarray, place: np.ndarray, values: np.ndarray, weight: np.ndarray) -> None:
        f = self.features(tilt, place)
        self.coefficients = np.stack([_least_squares(f, v, w) for v, w in zip(values.T, weight.T)], -1)

    def evaluate(self, tilt: np.ndarray, place: np.ndarray) -> np.ndarray:
        return self.features(tilt, place) @ self.coefficients


class Lambert(Table):
    """f = max(0, l . n) + 1 - l_z: one light at infinity with its attached shadow, and light from everywhere."""

    name = "directional Lambert with shadow"
    ROUNDS = 30

    def numbers(self) -> int:
        return 3

    def learn(self, tilt: np.ndarray, place: np.ndarray, values: np.ndarray, weight: np.ndarray) -> None:
        # linear while the lit pixels stay the same: solved, and asked again which are lit; the best of all rounds
        self.light = np.zeros((values.shape[1], 3))
        for c, (v, w) in enumerate(zip(values.T, weight.T)):
            lit, best = np.ones(len(v), bool), np.inf
            for _ in range(self.ROUNDS):
                f = np.where(lit[:, None], tilt, (0.0, 0.0, -1.0))  # l.n - l_z = l.(n - n0), or -l_z in shadow
                light = _least_squares(f, v - 1, w)
                misfit = float((w * (self._of(tilt, light) - v) ** 2).sum())
                if misfit < best:
                    best, self.light[c] = misfit, light
                now = tilt @ light + light[2] > 0
                if (now == lit).all():
                    break
                lit = now

    @staticmethod
    def _of(tilt: np.ndarray, light: np.ndarray) -> np.ndarray:
        return np.maximum(tilt @ light + light[2], 0) + 1 - light[2]

    def evaluate(self, tilt: np.ndarray, place: np.ndarray) -> np.ndarray:
        return np.stack([self._of(tilt, light) for light in self.light], -1)


class Binned(Table):
    """f: in every bin of normals, by slope and azimuth, a quadratic of the place; a bin without pixels takes the
    nearest that has some.

    This is the table of an example-based simulator. Few pixels in a bin hold its quadratic near its mean, by RIDGE
    pixels. Source: Si & Yuan, Taxim, RA-L 7, 2361 (2022)."""

    name = "polynomial table"
    RIDGE = 1.0

    def __init__(self, slopes: int = 24, azimuths: int = 48, added: bool = False):
        super().__init__(added)
        self.slopes, self.azimuths = slopes, azimuths

    def numbers(self) -> int:
        return 6 * int(self.filled.sum())

    def bins(self, tilt: np.ndarray) -> np.ndarray:
        """(N,) number of the bin of each normal."""
        slope = np.arccos(np.clip(1 + tilt[:, 2], 0, 1)) / (np.pi / 2)
        turn = np.arctan2(tilt[:, 1], tilt[:, 0]) / (2 * np.pi) % 1
        row = np.minimum((slope * self.slopes).astype(int), self.slopes - 1)
        return row * self.azimuths + np.minimum((turn * self.azimuths).astype(int), self.azimuths - 1)

    def learn(self, tilt: np.ndarray, place: np.ndarray, values: np.ndarray, weight: np.ndarray) -> None:
        from scipy.ndimage import distance_transform_edt

        number, f = self.bins(tilt), np.stack(_monomials(*place.T, 2), -1)
        count, size = self.slopes * self.azimuths, f.shape[1]
        self.filled = np.bincount(number, weight.sum(1), count) > 0
        self.coefficients = np.zeros((count, values.shape[1], size))
        for c, (v, w) in enumerate(zip(values.T, weight.T)):
            gram, right = np.zeros((count, size, size)), np.zeros((count, size))
            mean = np.bincount(number, w * v, count) / np.maximum(np.bincount(number, w, count), 1e-300)
            for i in range(size):
                right[:, i] = np.bincount(number, w * f[:, i] * (v - mean[number]), count)
                for j in range(i, size):
                    gram[:, i, j] = gram[:, j, i] = np.bincount(number, w * f[:, i] * f[:, j], count)
            gram += self.RIDGE * np.mean(w[w > 0] if (w > 0).any() else 1) * np.eye(size)
            self.coefficients[:, c] = np.linalg.solve(gram, right[..., None])[..., 0]
            self.coefficients[:, c, 0] += mean
        grid = ~self.filled.reshape(self.slopes, self.azimuths)
        around = np.concatenate([grid, grid, grid], 1)  # azimuths close
        row, column = distance_transform_edt(around, return_distances=False, return_indices=True)
        middle = slice(self.azimuths, 2 * self.azimuths)
        self.coefficients = self.coefficients[(row * self.azimuths + column % self.azimuths)[:, middle].ravel()]

    def evaluate(self, tilt: np.ndarray, place: np.ndarray) -> np.ndarray:
        return np.einsum("ncf,nf->nc", self.coefficients[self.bins(tilt)], np.stack(_monomials(*place.T, 2), -1))


def _monomials(x: np.ndarray, y: np.ndarray, degree: int) -> list[np.ndarray]:
    """x^i y^j with i + j <= degree, the constant first; none below degree 0."""
    return [x**i * y ** (d - i) for d in range(degree + 1) for i in range(d, -1, -1)]


def _least_squares(features: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(F,) coefficients; of what the data do not tell, the smallest. Features of an rms below SEEN have none."""
    root = np.sqrt(weight)[:, None]
    a = features * root
    size = np.sqrt((a * a).sum(0))
    seen = size > SEEN * np.sqrt(weight.sum())
    triangle = np.linalg.qr(np.column_stack([a[:, seen] / size[seen], values * root[:, 0]]), mode="r")
    found = np.zeros(features.shape[1])
    found[seen] = np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=1e-9)[0] / size[seen]
    return found


def tables(added: bool = False) -> list[list[Table]]:
    """The tables that a model is held against, those of few numbers first; of each, its variants, of which the best
    counts."""
    return [
        [Polynomial("mean", 0, added=added)],
        [Lambert(added)],
        [Polynomial("linear in the normal", 1, added=added)],
        [Polynomial("linear in the normal, with position", 1, 1, added=added)],
        [Polynomial("cubic in the normal", 3, added=added)],
        [Polynomial("linear in the normal, with position squared", 1, 2, added=added)],
        [Polynomial("quadratic in the normal, with position", 2, 1, added=added)],
        [Binned(24, 48, added), Binned(12, 24, added)],
    ]


def tilt_of(model: SceneModel, now: dict[str, Any]) -> np.ndarray:
    """(H, W, 3): normal of the face towards the camera less (0, 0, 1), at all values of a frame; 0 beside the face."""
    with everywhere(model.renderer):
        hits = model.renderer.hits(now)
    normal = hits.normal * np.array([1, 1, -1])  # the camera stands at -z
    return np.where(hits.valid[..., None], normal - np.array([0, 0, 1]), 0)


def place_of(shape: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """(x, y), each (H, W): the place on the face in units of half the image's width."""
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    return (u - shape[1] / 2) / (shape[1] / 2), (v - shape[0] / 2) / (shape[1] / 2)


class Bench:
    """The frames of a model and their shapes for any pose. Shapes are kept: all nulls start from the same poses."""

    def __init__(self, model: SceneModel, values: Values, circles: np.ndarray):
        self.model, self.circles = model, circles
        self.base = values
        self.kept: dict[tuple, np.ndarray] = {}
        self.start: dict[int, tuple[float, ...]] = {}  # poses of the physical model, and means of the poses' priors
        height, width = model.shape[:2]
        v, u = np.mgrid[:height, :width] + 0.5
        self.near = {i: np.hypot(u - x, v - y) < NEAR * r for i, (x, y, r) in enumerate(circles)}
        self.x, self.y = place_of(model.shape)
        self.rows: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def pose(self, index: int) -> tuple[float, ...]:
        now = self.model.at(self.base, index)
        return tuple(float(now[key]) for key in POSE)

    def row(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """(image, weight 1/variance of usable pixels)."""
        if index not in self.rows:
            image = self.model.frames[index].image.astype(float)
            self.rows[index] = (image, self.model.usable(index) / self.model.noise.variance(image))
        return self.rows[index]

    def shape(self, index: int, pose: Sequence[float]) -> Shape:
        pose = (*pose[:2], max(float(pose[2]), 1e-3))
        if (index, pose) not in self.kept:
            now = {**self.model.at(self.base, index), **dict(zip(POSE, pose))}
            self.kept[index, pose] = tilt_of(self.model, now).astype(np.float32)
            self.model.renderer.forget_hits()
        now = self.model.at(self.base, index)
        flat = self.model.noise.black_level + self.model.flat_of(index) * self.model.gains(now)
        return Shape(flat, self.kept[index, pose].astype(float), self.x, self.y)

    def misfit(self, null: Null, index: int, pose: Sequence[float]) -> float:
        image, weight = self.row(index)
        gap = sum(((p - q) / s) ** 2 for p, q, s in zip(pose, self.start[index], PRIOR_SD))
        return float((weight * (self.clip(null.predict(self.shape(index, pose))) - image) ** 2).sum()) + gap

    def clip(self, image: np.ndarray) -> np.ndarray:
        return np.clip(image, 0, self.model.noise.saturation)

    def refined(self, null: Null, index: int, pose: Sequence[float]) -> tuple[float, ...]:
        """One Gauss-Newton step of the pose for a fitted null, shortened once if the misfit does not fall; else the
        same pose."""
        image, weight = self.row(index)
        sides = [
            [null.predict(self.shape(index, [p + sign * (k == j) * s for j, p in enumerate(pose)])) for sign in (1, -1)]
            for k, s in enumerate(STEPS)
        ]
        j = np.stack([((high - low) / (2 * s)).ravel() for (high, low), s in zip(sides, STEPS)])
        w, left = weight.ravel(), (image - null.predict(self.shape(index, pose))).ravel()
        sd = np.array(PRIOR_SD)
        a, b = (j * w) @ j.T + np.diag(1 / sd**2), (j * w) @ left + (np.array(self.start[index]) - pose) / sd**2
        step, before = np.clip(np.linalg.solve(a, b), -0.3, 0.3), self.misfit(null, index, pose)
        for share in (1.0, 0.4):
            moved = tuple(float(v) for v in np.array(pose) + share * step)
            if moved[2] > 0.01 and self.misfit(null, index, moved) < before:
                return moved
        return tuple(pose)

    def score(
        self, name: str, split: str, poses: str, indices: Sequence[int], predictions: Sequence[np.ndarray]
    ) -> Score:
        parts: dict[str, list[np.ndarray]] = {m: [] for m in MEASURES}
        for index, prediction in zip(indices, predictions):
            left = self.clip(prediction) - self.model.frames[index].image
            usable = self.model.usable(index)
            for place, mask in (("near", self.near[index][..., None] & usable), ("whole", usable)):
                count = np.maximum(mask.sum((0, 1)), 1)
                parts[f"rms_{place}"].append((mask * left**2).sum((0, 1)) / count)
                parts[f"l1_{place}"].append((mask * np.abs(left)).sum((0, 1)) / count)
        mean = {m: np.mean(v, 0) for m, v in parts.items()}
        return Score(
            name, split, poses, **{m: (np.sqrt(v) if m.startswith("rms") else v).tolist() for m, v in mean.items()}
        )


PRIOR_SD = (PRIORS["gel.press_[xy]"], PRIORS["gel.press_[xy]"], PRIORS["gel.press_depth"])


def compare(
    model: SceneModel,
    values: Values,
    fitted: Sequence[int],
    held_out: Sequence[int],
    circles: np.ndarray,
    *,
    rounds: int = 2,
    progress: Callable[[str, int, int], None] | None = None,
) -> NullTable:
    """Score a calibrated model against the nulls.

    values    of the physical model, with its poses on fitted and on held-out frames;   circles (N, 3) px, see
              `importing`
    rounds    Gauss-Newton steps by which a null's own poses are refined, on each split
    Needs a model with a flat field. Raises ValueError when a frame is on both sides of the split.
    """
    if any(model.flat_of(i) is None for i in (*fitted, *held_out)):
        raise ValueError("nulls are departures from a background: the model needs a flat field")
    if set(fitted) & set(held_out) or not fitted or not held_out:
        raise ValueError(
            f"fitted frames {list(fitted)} and held-out frames {list(held_out)}: both sides need frames, none in common"
        )
    bench = Bench(model, values, circles)
    splits = {"held out": list(held_out), "fitted": list(fitted)}
    everything = [*fitted, *held_out]
    same = bench.start = {i: bench.pose(i) for i in everything}
    scores = [
        bench.score(PHYSICAL, split, "own", indices, model.predict(values, indices))
        for split, indices in splits.items()
    ]
    rows = [bench.row(i) for i in fitted]
    found = {}
    kinds: tuple[type[Null], ...] = (Background, Additive, Multiplicative, Linear)
    for done, kind in enumerate(kinds):
        options = {"physical": (dict(same), kind().fit([bench.shape(i, same[i]) for i in fitted], rows))}
        if kind is not Background and rounds:
            null, poses = options["physical"][1], dict(same)
            for _ in range(rounds):
                poses.update({i: bench.refined(null, i, poses[i]) for i in fitted})
                null = kind().fit([bench.shape(i, poses[i]) for i in fitted], rows)
            for _ in range(rounds):
                poses.update({i: bench.refined(null, i, poses[i]) for i in held_out})
            options["own"] = (poses, null)
        tried = []
        for label, (poses, null) in options.items():
            tried.append(
                [
                    bench.score(
                        kind.name,
                        split,
                        label if kind is not Background else "-",
                        indices,
                        [null.predict(bench.shape(i, poses[i])) for i in indices],
                    )
                    for split, indices in splits.items()
                ]
            )
        found[kind] = min(tried, key=lambda s: np.square(s[0].rms_near).sum())
        if progress:
            progress("nulls", done + 1, 4)
    directional = min((found[Additive], found[Multiplicative]), key=lambda s: np.square(s[0].rms_near).sum())
    for pair in (found[Background], directional, found[Linear]):
        scores += pair
    flats = np.stack([model.flat_of(i) for i in fitted]) + model.noise.black_level
    noise = [float(np.sqrt(np.mean(model.noise.of_channel(c).variance(flats[..., c])))) for c in range(model.shape[2])]
    return NullTable(scores, noise, [model.frames[i].name for i in fitted], [model.frames[i].name for i in held_out])
