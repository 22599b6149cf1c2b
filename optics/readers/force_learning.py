"""Forces on a skin from the motion of the beads in it, learnt: features, labels, metrics, and maps between them.

    one = FeatureSet.read("features/dense-40.npz")     motion in 40 x 40 bins and the presses that made it
    y = labels(one.place, one.force, 9, one.face)      (N, 81) N: the force of each press in its bin of the face
    model = linear(one, 9)                             or ForceModel.read(...) of one that `optics force-train` made
    scores(y, model(one), 9, one.face)                 aRMSE (13), d_loc (16), RMSE_mc (17)

A map is one of

    published  y = W4 s(W3 s(W2 s(W1 x + b1) + b2) + b3) + b4          x: size and angle of the motion, (11) and (12)
    linear     y = A d,  A = Y D^T (D D^T + lambda 1)^-1               d: mean motion of the bins, as vectors
    scaled     y = |d| f(d/|d|, log |d|) softmax(g(d/|d|, log |d|))    f and g: outputs of one network

The first is the network of the source. The second is the pseudo-inverse (8) for all places of the face at once,
regularised, found from presses in place of a formula. The third has what elasticity says built in: the motion is
proportional to the force, so that its pattern d/|d| tells the place and its size the force; a contact pushes and never
pulls, so that no bin is negative. f > 0 is the total force per size of motion, the softmax its shares in the bins; any
distribution of pressure can be written so.

All maps are plain numpy once trained. Source: Sensors 19 (2019) 928, sections 4.2, 5 and 6."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optics.files.archives import opened
from optics.files.output import replacing

FORMAT = 1  # of the files
KINDS = ("published", "linear", "scaled")
PENALTIES = 10.0 ** np.arange(-8, 1)  # lambda of the linear map, of the largest eigenvalue: chosen on validation data


class BadFeatures(ValueError):
    """A file of features or a trained map that contradicts its format or what it is used with."""


# -- features ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class FeatureSet:
    """Motion in the image, averaged in bins, and the presses behind it.

    motion  (N, rows, columns, 2) px: the mean motion of each bin as a vector
    size, angle  (N, rows, columns) px and rad: (11) and (12)
    place   (N, 2) mm: where the contact's centre is on the face;   force  (N,) N, into the skin
    face    (2,) mm: width and length of the face, whose middle is the origin of `place`
    flow    "dense" or "sparse";   source  what it was made from, for the record"""

    motion: np.ndarray
    size: np.ndarray
    angle: np.ndarray
    place: np.ndarray
    force: np.ndarray
    face: tuple[float, float]
    flow: str
    source: Mapping[str, Any] = field(default_factory=dict)

    ARRAYS = ("motion", "size", "angle", "place", "force")

    def __post_init__(self) -> None:
        n, *bins = self.size.shape if self.size.ndim == 3 else (0, 0, 0)
        wanted = {"motion": (n, *bins, 2), "size": (n, *bins), "angle": (n, *bins), "place": (n, 2), "force": (n,)}
        for name, shape in wanted.items():
            found = getattr(self, name)
            if found.shape != shape or not n:
                raise BadFeatures(f"{name} of shape {found.shape}; allowed: {shape} for {n} presses, at least one")
            if not np.isfinite(found).all():
                raise BadFeatures(f"{name} has values that are not finite; allowed: finite ones")
        if self.flow not in ("dense", "sparse") or len(self.face) != 2 or not min(self.face) > 0:
            raise BadFeatures(
                f"flow '{self.flow}' on a face of {self.face} mm; allowed: 'dense' or 'sparse', two sizes above 0"
            )

    def __len__(self) -> int:
        return len(self.force)

    @property
    def bins(self) -> tuple[int, int]:
        """Rows and columns of the bins of the image."""
        return self.size.shape[1], self.size.shape[2]

    def chosen(self, rows: np.ndarray | slice) -> FeatureSet:
        """Those presses alone, by number, mask or range."""
        arrays = {name: getattr(self, name)[rows] for name in self.ARRAYS}
        return FeatureSet(**arrays, face=self.face, flow=self.flow, source=self.source)

    def vectors(self, kind: str) -> np.ndarray:
        """(N, 2 m) float32 what a map of a kind reads: all sizes and all angles, or all x and all y of the motion."""
        n = len(self)
        pair = (self.size, self.angle) if kind == "published" else (self.motion[..., 0], self.motion[..., 1])
        return np.concatenate([a.reshape(n, -1) for a in pair], 1).astype(np.float32)

    def write(self, file: str | Path) -> Path:
        """An .npz file, whole or not at all."""
        note = {"format": FORMAT, "face": list(self.face), "flow": self.flow, "source": dict(self.source)}
        arrays = {name: getattr(self, name).astype(np.float32) for name in self.ARRAYS}
        return _write(file, note, arrays)

    @classmethod
    def read(cls, file: str | Path) -> FeatureSet:
        """Raises BadFeatures for a file that is none, or is damaged."""
        note, arrays = _read(file, cls.ARRAYS, "optics force-features")
        try:
            return cls(**arrays, face=tuple(note["face"]), flow=note["flow"], source=note["source"])
        except (KeyError, TypeError, AttributeError, BadFeatures) as error:
            raise BadFeatures(f"{file}: {error}; make it again with optics force-features") from error


# -- labels and metrics ------------------------------------------------------------------------------------------------
def bin_of(place: np.ndarray, bins: int, face: tuple[float, float]) -> np.ndarray:
    """(N,) number of the bin of the face, row by row, in which each place (N, 2), mm, lies; there are bins x bins.

    Raises ValueError for a place beyond the face."""
    place = np.asarray(place, float)
    if bins < 1:
        raise ValueError(f"{bins} x {bins} bins of the face; allowed: 1 and more each way")
    beyond = np.abs(place) > np.asarray(face) / 2
    if beyond.any():
        x, y = place[beyond.any(1)][0]
        raise ValueError(f"a press at {x:g}, {y:g} mm; allowed: within the face of {face[0]:g} x {face[1]:g} mm")
    column, row = np.minimum((place / face + 0.5) * bins, bins - 1).astype(int).T
    return row * bins + column


def bin_centres(bins: int, face: tuple[float, float]) -> np.ndarray:
    """(bins^2, 2) x, y in mm: c(k) of (16)."""
    row, column = np.indices((bins, bins))
    return (np.stack([column.ravel(), row.ravel()], -1) + 0.5) / bins * face - np.asarray(face) / 2


def labels(place: np.ndarray, force: np.ndarray, bins: int, face: tuple[float, float]) -> np.ndarray:
    """(N, bins^2) N: the force of each press in the bin of its centre, 0 in all others (Figure 8)."""
    y = np.zeros((len(force), bins * bins), np.float32)
    y[np.arange(len(force)), bin_of(place, bins, face)] = force
    return y


def scores(true: np.ndarray, found: np.ndarray, bins: int, face: tuple[float, float]) -> dict[str, float]:
    """The metrics of the source, of label vectors (N, bins^2) in N.

    aRMSE    (13), N: root mean square error of each bin, averaged over bins
    d_loc    (16), mm: from the centre of the bin with the largest force to that of the bin where it was found, on
             average
    RMSE_mc  (17), N: root mean square error of the largest force, wherever it was found"""
    true, found = np.asarray(true, float), np.asarray(found, float)
    if true.shape != found.shape or true.ndim != 2 or true.shape[1] != bins * bins or not len(true):
        raise ValueError(f"labels of shape {true.shape}, found {found.shape}; allowed: both (N, {bins * bins}), N > 0")
    rows, k, at = np.arange(len(true)), np.abs(true).argmax(1), np.abs(found).argmax(1)
    centres = bin_centres(bins, face)
    return {
        "aRMSE": float(np.sqrt(((true - found) ** 2).mean(0)).mean()),
        "d_loc": float(np.linalg.norm(centres[k] - centres[at], axis=1).mean()),
        "RMSE_mc": float(np.sqrt(((true[rows, k] - found[rows, at]) ** 2).mean())),
    }


def split(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the presses to train, to validate and to test with: 20 % for the test, 10 % of the rest for
    validation, at random."""
    if n < 10:
        raise ValueError(f"{n} presses; allowed: at least 10, of which 2 are for the test and 1 for validation")
    order = np.random.default_rng(seed).permutation(n)
    test, rest = order[: n // 5], order[n // 5 :]
    held = max(1, len(rest) // 10)
    return np.sort(rest[held:]), np.sort(rest[:held]), np.sort(test)


# -- maps --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ForceModel:
    """A trained map from features to the forces in bins x bins bins of the face, (N, bins^2) in N.

    layers   ((outputs, inputs), (outputs,)) weights and biases of each, of float32
    mean, scale   (2 m,) of the inputs of `published`: what is subtracted and divided by
    record   how it was made: kind, flow, bins, features, face, seed, ..."""

    kind: str
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    mean: np.ndarray
    scale: np.ndarray
    bins: int
    features: tuple[int, int]
    face: tuple[float, float]
    flow: str
    record: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        inputs, outputs = 2 * self.features[0] * self.features[1], self.bins**2
        if self.kind not in KINDS:
            raise BadFeatures(f"a map of the kind '{self.kind}'; allowed: {', '.join(KINDS)}")
        scaled = self.kind == "scaled"
        width = inputs + scaled
        for w, b in self.layers:
            if w.ndim != 2 or w.shape[1] != width or b.shape != (len(w),) or not np.isfinite(w).all():
                raise BadFeatures(f"a layer of shape {w.shape} on {width} inputs; allowed: finite (outputs, {width})")
            width = len(w)
        if width != outputs + scaled or self.mean.shape != (inputs,) or self.scale.shape != (inputs,):
            raise BadFeatures(f"{width} outputs for {self.bins} x {self.bins} bins of the face")

    def __call__(self, one: FeatureSet) -> np.ndarray:
        """Raises BadFeatures for features of another kind than those that it was trained with."""
        if one.bins != self.features or not np.allclose(one.face, self.face):
            raise BadFeatures(
                f"features in {one.bins[0]} x {one.bins[1]} bins of a face of {one.face} mm; the map was trained with "
                f"{self.features[0]} x {self.features[1]} bins and {self.face} mm"
            )
        return self.forces(one.vectors(self.kind))

    def forces(self, x: np.ndarray) -> np.ndarray:
        """(N, bins^2) N of features (N, 2 m)."""
        *hidden, (w, b) = self.layers
        if self.kind == "scaled":
            return _shared(self._scaled(x, hidden, w, b))
        x = (x - self.mean) / self.scale
        for weight, bias in hidden:
            x = 1 / (1 + np.exp(-np.clip(x @ weight.T + bias, -80, 80)))
        return x @ w.T + b

    @staticmethod
    def _scaled(x: np.ndarray, hidden, w: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size, inputs = pattern(x)
        for weight, bias in hidden:
            inputs = np.maximum(inputs @ weight.T + bias, 0)
        return size, inputs @ w.T + b

    def write(self, file: str | Path) -> Path:
        """An .npz file, whole or not at all."""
        note = {
            "format": FORMAT,
            "kind": self.kind,
            "bins": self.bins,
            "features": list(self.features),
            "face": list(self.face),
            "flow": self.flow,
            "layers": len(self.layers),
            "record": dict(self.record),
        }
        arrays = {"mean": self.mean, "scale": self.scale}
        for i, (w, b) in enumerate(self.layers):
            arrays |= {f"w{i}": w, f"b{i}": b}
        return _write(file, note, {k: np.asarray(a, np.float32) for k, a in arrays.items()})

    @classmethod
    def read(cls, file: str | Path) -> ForceModel:
        """Raises BadFeatures for a file that is none, or is damaged."""
        note, arrays = _read(file, ("mean", "scale"), "optics force-train", more=True)
        try:
            layers = tuple((arrays[f"w{i}"], arrays[f"b{i}"]) for i in range(int(note["layers"])))
            return cls(
                note["kind"],
                layers,
                arrays["mean"],
                arrays["scale"],
                int(note["bins"]),
                (int(note["features"][0]), int(note["features"][1])),
                (float(note["face"][0]), float(note["face"][1])),
                note["flow"],
                note["record"],
            )
        except (KeyError, TypeError, IndexError, AttributeError, BadFeatures) as error:
            raise BadFeatures(f"{file}: {error}; make it again with optics force-train") from error


def pattern(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|d| (N, 1), px, and the inputs (N, 2 m + 1) of the map `scaled`: d/|d| times the root of the number of bins, so
    that they are of the order of 1, and log |d|.

    |d| is the root mean square over the bins."""
    size = np.sqrt((x * x).sum(1, keepdims=True) / (x.shape[1] // 2)) + np.float32(1e-6)
    return size, np.concatenate([x / size, np.log(size)], 1)


def _shared(outputs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """|d| softplus(f) softmax(g)."""
    size, out = outputs
    shares = np.exp(out[:, 1:] - out[:, 1:].max(1, keepdims=True))
    return size * np.logaddexp(0, out[:, :1]) * shares / shares.sum(1, keepdims=True)


def linear(one: FeatureSet, bins: int, seed: int = 0, say: Callable[[str, int, int], None] | None = None) -> ForceModel:
    """The regularised pseudo-inverse: the map that is best in the sense of least squares on the training part of
    `split`, with the penalty that has the smallest mean square error on its validation part."""
    train, held, _ = split(len(one), seed)
    x, y = one.vectors("linear").astype(float), labels(one.place, one.force, bins, one.face).astype(float)
    values, vectors = np.linalg.eigh(x[train].T @ x[train])
    if not values[-1] > 0:
        raise BadFeatures(
            f"none of the {len(train)} presses to train with moves anything; allowed: presses with motion; make the "
            "features again with optics force-features"
        )
    right = vectors.T @ (x[train].T @ y[train])
    best: tuple[float, float, np.ndarray] = (np.inf, 0.0, right)
    for k, penalty in enumerate(PENALTIES):
        a = vectors @ (right / (np.maximum(values, 0) + penalty * values[-1])[:, None])
        error = float(((x[held] @ a - y[held]) ** 2).mean())
        if error < best[0]:
            best = error, float(penalty), a
        if say:
            say("linear map", k + 1, len(PENALTIES))
    a, n = best[2], x.shape[1]
    record = {"seed": seed, "penalty": best[1], "presses": len(train), "trained_on": dict(one.source)}
    layer = (np.ascontiguousarray(a.T, np.float32), np.zeros(bins * bins, np.float32))
    ones = np.ones(n, np.float32)
    return ForceModel("linear", (layer,), 0 * ones, ones, bins, one.bins, one.face, one.flow, record)


# -- files -------------------------------------------------------------------------------------------------------------
def _write(file: str | Path, note: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Path:
    with replacing(file) as temporary, open(temporary, "wb") as out:
        np.savez(out, note=np.array(json.dumps(note, sort_keys=True)), **arrays)  # type: ignore[arg-type]
    return Path(file)


def _read(file: str | Path, wanted: tuple[str, ...], maker: str, more: bool = False) -> tuple[dict, dict]:
    """The note and the arrays of an .npz file; nothing in it is run."""
    if not Path(file).is_file():
        raise FileNotFoundError(f"{file}: no such file; make it with {maker}")
    try:
        with opened(file) as data:
            note = json.loads(str(data["note"]))
            arrays = {name: data[name] for name in (data.files if more else wanted) if name != "note"}
        if note["format"] != FORMAT or any(arrays[name].dtype.kind != "f" for name in arrays):
            raise ValueError(f"format {note['format']}")
    except Exception as error:  # a damaged archive fails in many ways
        raise BadFeatures(f"{file}: not a file of {maker} ({type(error).__name__}: {error})") from error
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise BadFeatures(f"{file}: {missing[0]} is missing; make it again with {maker}")
    return note, arrays
