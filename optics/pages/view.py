"""A local page on which effects and parameters are switched and slid while prediction, residual and misfit follow.

The browser has the images as numbers and computes the linear prediction itself, in the coordinate u of every parameter
in which the image is nearly linear (`Parameter.coordinate`):

    prediction(values) = prediction(there) + sum_j [u_j(value_j) - u_j(there_j)] d prediction / d u_j

`there` are the study's values, or later ones that the user chose. Derivative images are made when a slider is first
touched; when it is let go, the true render takes the linear prediction's place. Everything asked of the model goes
through one thread, as neither Mitsuba nor Dr.Jit may be used by several; the page asks one thing at a time, so that of
all that a slider passed only the last is rendered. The page is served on 127.0.0.1 alone and asks nothing of any other
machine."""

from __future__ import annotations

import hmac
import json
import math
import secrets
import shlex
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.errors import UnknownKey
from optics.files.output import write_text
from optics.fit import calibrate, descent
from optics.fit.compare import led_label
from optics.fit.model import value_of
from optics.pages.drawing import DIVERGING, MASKED, SIGMA_RANGE, colour_bar, ramp
from optics.pages.mosaics import Eye, filled, unwoven
from optics.scene.parameter import Values, Variable
from optics.scene.trust import Named
from optics.study import loop
from optics.study.calibrated import origin_toml
from optics.study.fit_files import END, WHOLE
from optics.study.setup import effect_variables
from optics.study.shown import cell_of, mosaic_of
from optics.words import spaced

HOST = "127.0.0.1"
PAGE = Path(__file__).with_name("view.html")
KEEP = 1 << 30  # bytes of images that are kept
BODY_MAX = 1 << 20  # bytes of a question
NEAR = 4.0  # plausible sizes to either side that a slider spans; its number may be anything within bounds


class Kept:
    """Images by what they show; of more than `size` bytes the ones longest unused are forgotten."""

    def __init__(self, size: int = KEEP):
        self.size, self._items, self._lock = size, OrderedDict(), threading.Lock()

    def get(self, key):
        with self._lock:
            if key in self._items:
                self._items.move_to_end(key)
            return self._items.get(key)

    def put(self, key, arrays: tuple) -> tuple:
        with self._lock:
            self._items[key] = arrays
            held = sum(a.nbytes for item in self._items.values() for a in item if isinstance(a, np.ndarray))
            while held > self.size and len(self._items) > 1:
                _, old = self._items.popitem(last=False)
                held -= sum(a.nbytes for a in old if isinstance(a, np.ndarray))
        return arrays


@dataclass(frozen=True)
class Slider:
    """A variable with what the study says of it: its value, its standard deviation (NaN: not calibrated, infinite:
    undetermined), its effect's key."""

    variable: Variable
    value: float
    sd: float = math.nan
    effect: str = ""

    def range(self) -> tuple[float, float]:
        """What the slider spans: the value, or for an effect its neutral value too, and some plausible sizes about it,
        in bounds."""
        p = self.variable.parameter
        centres = [self.value, *([p.neutral] if self.effect and p.neutral is not None else [])]
        return (
            float(max(p.bounds[0], min(centres) - NEAR * p.plausible)),
            float(min(p.bounds[1], max(centres) + NEAR * p.plausible)),
        )


class View:
    """A step of a study with its model, as a page asks for it.

    worker    the one thread that may use the model
    sliders   by the name of their variable: what the step calibrated, the same for frames that were held out, and what
              every effect would free that the scene can express
    """

    def __init__(
        self,
        folder: str | Path,
        step: int | None = None,
        plugins: Named = None,
        captures: str | Path | None = None,
    ):
        self.worker, self.kept = ThreadPoolExecutor(1, "model"), Kept()
        try:
            self._do(lambda: self._open(folder, step, plugins, captures))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let the present job end, and do no other."""
        self.worker.shutdown(cancel_futures=True)

    def _do(self, job: Callable):
        """What `job()` returns or raises in the model's thread; CancelledError where the view is closed before it
        begins."""
        return self.worker.submit(job).result()

    def _open(
        self, folder: str | Path, step: int | None, plugins: Named = None, captures: str | Path | None = None
    ) -> None:
        self.study, self.model, self.setup = loop.take_up(folder, plugins, captures)
        count = len(self.study.steps)
        if step is not None and not 0 <= step < count:
            steps = ", ".join(f"{s['index']} ({s['name']})" for s in self.study.steps)
            raise ValueError(f"--step {step}: no such step; {folder} has {steps}")
        self.step = self.study.steps[count - 1 if step is None else step]
        variables, self.values, self.fitted = loop.kept(self.study, self.model, self.step["index"])
        self.held = sorted(set(range(len(self.model.frames))) - set(self.fitted))
        sd = {v["name"]: v["sd"] for v in self.step["variables"]}
        added = self.study.added(self.step["index"])
        registry = self.model.scene.registry
        known = (*loop.candidates(self.model, self.study), *loop.effects_of(self.study, registry))
        known += tuple(registry.find_effect(key) for key in added)  # dropped since, and maybe excluded
        self.effects = {e.key: e for e in sorted(known, key=lambda e: e.key)}
        own = {
            key: {k for keys in self.model.scene.keys_of(e).values() for k in keys} for key, e in self.effects.items()
        }
        self.sliders: dict[str, Slider] = {}
        for v in (*variables, *calibrate.for_frames(self.model, variables, self.held)):
            effect = next((key for key in added if set(v.keys) <= own[key]), "")
            self._slide(v, sd.get(v.name), effect)
        taken = {k for s in self.sliders.values() for k in s.variable.keys}
        self.clashes = {key: sorted(keys & taken) for key, keys in own.items() if key not in added and keys & taken}
        for key, e in self.effects.items():
            if key not in added and key not in self.clashes:
                for v in effect_variables(self.model, e):
                    self._slide(v, None, key)
        self.added, self._sought = added, set(added)
        self.comparison = self.study.comparison(self.step["index"])

    def _slide(self, variable: Variable, sd: float | None, effect: str) -> None:
        self.sliders[variable.name] = Slider(
            variable,
            value_of(self.model, self.values, variable),
            math.nan if sd is None else float(sd),
            effect,
        )

    # -- what a page needs to know first ------------------------------------------------------------------------------
    def record(self) -> dict:
        """Everything but images: frames, sliders, effects, and how the study's own numbers stand."""
        rows = {row.scope["frame"]: row for row in self.comparison.by("frame")}
        return {
            "title": self.study.ladder["title"] or Path(self.study.folder).resolve().name,
            "folder": str(self.study.folder),
            "scene": Path(self.study.ladder["scene"]).stem,
            "step": self.step["index"],
            "steps": [s["name"] for s in self.study.steps],
            "shape": list(self.model.shape) if self.images else None,
            "shown": list(self.places().shape) if self.images else None,
            "mosaic": self.mosaic.get("mosaic"),
            "mosaic_note": Eye(self.mosaic).note if "mosaic" in self.mosaic else "",
            "channels": self.comparison.channels,
            "black": self.model.noise.black_level,
            "ramp": ramp(DIVERGING, 256),
            "bar": colour_bar(),
            "masked": ramp((MASKED,), 1)[0],
            "range": SIGMA_RANGE,
            "frames": [
                {
                    "name": f.name,
                    "led": led_label(f.parameters),
                    "held_out": i in self.held,
                    **{k: getattr(rows[f.name], k) for k in ("n", "dof", "chi2", "rms", "noise")},
                }
                for i, f in enumerate(self.model.frames)
            ],
            "sliders": [self._slider(name, s) for name, s in self.sliders.items()],
            "effects": [
                {
                    "key": e.key,
                    "name": e.name,
                    "part": e.part,
                    "onset": e.onset,
                    "doc": e.doc.strip(),
                    "needs": e.needs,
                    "added": e.key in self.added,
                    "clash": self.clashes.get(e.key, []),
                }
                for e in self.effects.values()
            ],
        }

    def _slider(self, name: str, s: Slider) -> dict:
        v, p = s.variable, s.variable.parameter
        low, high = s.range()
        return {
            "name": name,
            "part": (v.keys[0] if len(v.keys) == 1 else v.name).rpartition(".")[0],
            "keys": list(v.keys),
            "unit": "" if p.unit == "1" else p.unit,
            "doc": p.doc,
            "low": low,
            "high": high,
            "bounds": list(p.bounds),
            "value": s.value,
            "sd": s.sd,
            "calibrated": not math.isnan(s.sd),
            "neutral": p.neutral,
            "squared": p.squared,
            "saturates": p.saturates,
            "frames": v.frames,
            "effect": s.effect,
        }

    @property
    def images(self) -> bool:
        """Whether frames are images, and not readings of points."""
        return self.model.captures.table is None

    @property
    def mosaic(self) -> dict:
        """What raw frames are behind (optics.study.shown.mosaic_of)."""
        return mosaic_of(self.model)

    def places(self) -> np.ndarray:
        """(H, W) for each pixel that the page shows the number of the frame's pixel, counted along rows; -1 for none.
        Those behind one analyser of a mosaic lie together."""
        numbers = np.arange(math.prod(self.model.shape[:2])).reshape(self.model.shape[:2])
        cell = cell_of(self.model) if "mosaic" in self.mosaic else (1, 1)
        return unwoven(numbers + 1, cell) - 1

    # -- questions ----------------------------------------------------------------------------------------------------
    def frame(self, index) -> int:
        """A frame's index, or ValueError."""
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(self.model.frames):
            raise ValueError(f"no frame {index!r}; allowed: 0 to {len(self.model.frames) - 1}")
        return index

    def changes(self, given: Mapping) -> dict[str, float]:
        """The checked values of sliders that differ from the study's. Raises UnknownKey, OutOfBounds or ValueError."""
        if not isinstance(given, Mapping):
            raise ValueError("values: not a table of names and numbers")
        checked = {}
        for name, value in given.items():
            slider = self._slider_of(name)
            number = slider.variable.parameter.check(value, name)
            if number != slider.value:
                checked[name] = number
        return dict(sorted(checked.items()))

    def _slider_of(self, name) -> Slider:
        if not isinstance(name, str) or name not in self.sliders:
            raise UnknownKey(str(name), self.sliders, "parameter of this page")
        return self.sliders[name]

    def moved(self, changes: Mapping[str, float]) -> Values:
        """The study's values with changes put in."""
        values = self.values.copy()
        for name, value in changes.items():
            values.put(self.sliders[name].variable, value)
        return values

    def _here(self, index: int, changes: Mapping[str, float]) -> tuple:
        """What of the changes holds in a frame: the key of its images."""
        return (index, *((n, v) for n, v in changes.items() if self.sliders[n].variable.holds_in(index)))

    def capture(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, C) DN measured, and what is usable of it; pixels behind a filter of one colour have the others of
        their cell, for the eye alone."""
        image, use = self.kept.get(("capture", index)) or self._do(lambda: self._capture(index))
        pattern = self.model.captures.cfa
        return (image if pattern is None else filled(image, pattern)), use

    def _capture(self, index: int) -> tuple:
        return self.kept.get(("capture", index)) or self.kept.put(
            ("capture", index), (np.asarray(self.model.frames[index].image, np.float32), self.model.usable(index))
        )

    def predict(self, index: int, changes: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, C) DN, the true render and the standard deviation that the noise has about it."""
        return self.kept.get(("predict", *self._here(index, changes))) or self._do(
            lambda: self._predict(index, changes)
        )

    def _predict(self, index: int, changes: Mapping[str, float]) -> tuple:
        key = ("predict", *self._here(index, changes))
        if (found := self.kept.get(key)) is not None:
            return found
        self._seek(changes)
        values = self.moved(changes)
        prediction = self.model.predict(values, [index])[0]
        sd = np.sqrt(self.model.variance(values, index, prediction))
        return self.kept.put(
            key, (prediction.astype(np.float32), np.broadcast_to(sd, prediction.shape).astype(np.float32))
        )

    def secant(self, name: str, changes: Mapping[str, float]) -> float | None:
        """The finite step that a derivative image is taken with, where the tangent at the present value says nothing:
        at the neutral value of an effect with such an onset, and at 0 of what acts by its square. It turns round at a
        bound. None: the tangent."""
        slider = self.sliders[name]
        p, value = slider.variable.parameter, changes.get(name, slider.value)
        effect = self.effects.get(slider.effect)
        dull = effect is not None and effect.onset != "tangent" and value == p.neutral
        if not dull and not (p.squared and value == 0):
            return None
        return p.plausible if value + p.plausible <= p.bounds[1] else -p.plausible

    def _seek(self, names: Iterable[str]) -> None:
        """Find where effects with a place would be, before they leave neutral for the first time: till then it does
        nothing."""
        for key in {self.sliders[n].effect for n in names} - {"", *self._sought}:
            loop.seek(self.model, self.values, [self.effects[key]], self.fitted)
            self._sought.add(key)

    def derivative(self, index: int, name: str, changes: Mapping[str, float]) -> tuple:
        """(image or None where it does nothing, step or None): d prediction / d u of a slider's coordinate u, (H, W,
        C), at the values with the changes."""
        slider = self._slider_of(name)
        if not slider.variable.holds_in(index):
            return None, None
        key = ("derivative", name, *self._here(index, changes))
        return self.kept.get(key) or self._do(lambda: self._derivatives(index, [name], changes)[name])

    def _derivatives(self, index: int, names: Sequence[str], changes: Mapping[str, float]) -> dict[str, tuple]:
        here = self._here(index, changes)
        found = {n: self.kept.get(("derivative", n, *here)) for n in names}
        missing = [n for n, item in found.items() if item is None]
        if not missing:
            return found
        self._seek([*missing, *changes])
        values = self.moved(changes)
        steps = {n: self.secant(n, changes) for n in missing}
        _, images = next(
            self.model.derivatives(
                values,
                [self.sliders[n].variable for n in missing],
                [index],
                secant={n: s for n, s in steps.items() if s is not None},
            )
        )
        for n in missing:
            image, p, value = images.get(n), self.sliders[n].variable.parameter, changes.get(n, self.sliders[n].value)
            if image is not None:  # per value -> per coordinate
                image = image * np.float32(
                    steps[n] / (p.coordinate(value + steps[n]) - p.coordinate(value))
                    if steps[n] is not None
                    else p.per_coordinate(value)
                )
            found[n] = self.kept.put(("derivative", n, *here), (image, steps[n]))
        return found

    def rows(self, index: int, names: Sequence[str], changes: Mapping[str, float]) -> dict:
        """A frame's misfit as a quadratic form in the coordinates of sliders, about the values with the changes:
        c - 2 b.x + x.A x, for chi2 (weights held) and for the sum of squares in DN^2; n values, noise: sum of
        variances."""
        for name in names:
            self._slider_of(name)
        return self._do(lambda: self._rows(index, names, changes))

    def _rows(self, index: int, names: Sequence[str], changes: Mapping[str, float]) -> dict:
        measured, use = self._capture(index)
        prediction, sd = self._predict(index, changes)
        holding = [n for n in names if self.sliders[n].variable.holds_in(index)]
        images = {n: image for n, (image, _) in self._derivatives(index, holding, changes).items() if image is not None}
        use = np.broadcast_to(use, measured.shape)
        residual = (measured - prediction)[use]
        stack = np.stack([i[use] for i in images.values()]) if images else np.zeros((0, residual.size), np.float32)
        found = {"names": list(images), "n": int(use.sum()), "noise": float(np.sum(sd[use].astype(float) ** 2))}
        for what, j, r in (("chi2", stack / sd[use], residual / sd[use]), ("square", stack, residual)):
            found[what] = {
                "a": (j @ j.T).astype(float).tolist(),
                "b": (j @ r).astype(float).tolist(),
                "c": float(np.sum(r.astype(float) ** 2)),
            }
        return found

    def best(self, names: Sequence[str], values: Mapping[str, float], there: Mapping[str, float]) -> dict:
        """Least squares of some sliders, within bounds and in one linear step about `there`, all others as they are;
        over the fitted frames, with the priors of those that have one. Weights are held.

        Returns values and standard deviations by name, and chi2 (with the priors' share) before and after, as the
        linear model has it."""
        for name in names:
            self._slider_of(name)
        if not names:
            raise ValueError("no effect is switched on: nothing to solve for; switch one on")
        return self._do(lambda: self._best(list(dict.fromkeys(names)), values, there))

    def _best(self, names: list[str], values: Mapping[str, float], there: Mapping[str, float]) -> dict:
        sliders = [self.sliders[n] for n in names]
        names += [n for n in dict.fromkeys((*values, *there)) if n not in names]  # what is held, but was moved
        parameters = [self.sliders[n].variable.parameter for n in names]
        start = np.array([self.sliders[n].value for n in names])
        at, now = (
            np.array([p.coordinate(c.get(n, v)) for n, p, v in zip(names, parameters, start)]) for c in (there, values)
        )
        a, b, c, n = np.zeros((len(names), len(names))), np.zeros(len(names)), 0.0, 0
        for index in self.fitted:
            row = self._rows(index, names, there)
            where = [names.index(name) for name in row["names"]]
            a[np.ix_(where, where)] += row["chi2"]["a"]
            b[where] += row["chi2"]["b"]
            c, n = c + row["chi2"]["c"], n + row["n"]

        def slopes(of):
            """d value / d u of the sliders; infinite where the image goes by the square of a value that is 0."""
            return np.array([p.per_coordinate(v) if v or not p.squared else math.inf for p, v in zip(parameters, of)])

        k = len(sliders)  # a prior is one more measured value, linear in u like the images
        pull, curvature, prior = descent.prior_terms(self.model, [s.variable for s in sliders], self.moved(there))
        slope = np.nan_to_num(slopes([there.get(name, s.value) for name, s in zip(names, sliders)]), posinf=0.0)
        a[:k, :k] += np.diag(slope**2 * curvature)
        b[:k] += slope * pull
        c += prior

        def chi2(x):
            return float(c - 2 * b @ x + x @ a @ x)

        x = now - at
        low, high = (np.array([p.coordinate(p.bounds[side]) for p in parameters[:k]]) for side in (0, 1))
        held = x.copy()
        held[:k] = 0
        free = descent.solve(a[:k, :k], (b - a @ held)[:k], low - at[:k], high - at[:k])
        found = held.copy()
        found[:k] = free
        estimate = [float(np.clip(p.at_coordinate(u), *p.bounds)) for p, u in zip(parameters, (at + found)[:k])]
        with np.errstate(invalid="ignore"):
            sd = np.sqrt(np.maximum(np.diag(descent.covariance_of(a[:k, :k])), 0)) * slopes(estimate)
        return {
            "values": dict(zip(names[:k], estimate)),
            "sd": dict(zip(names[:k], sd.tolist())),
            "before": chi2(x),
            "after": chi2(found),
            "n": n,
            "frames": len(self.fitted),
        }

    # -- values to keep -----------------------------------------------------------------------------------------------
    def _toml(self, changes: Mapping[str, float]) -> str:
        """Values as `optics compare --fit` reads them: [parameters] and [frames.NAME], key = value."""
        self._seek(changes)
        values = self.moved(changes)
        begun = f"the step '{self.step['name']}' of {self.study.folder}"
        lines = [
            f"# Values chosen on the page of `optics view`, beginning from {begun}. Not calibrated; changed by hand:",
            *(
                f"#   {n}: {self.sliders[n].value:.6g} -> {v:.6g}{spaced(self.sliders[n].variable.parameter.unit)}"
                for n, v in changes.items()
            ),
        ]
        if not changes:
            lines[0] = f"# Values of {begun}, unchanged."

        def entry(key, value):
            unit = spaced(self.model.parameters[key].unit) if key in self.model.parameters else ""
            return f"{quoted(key)} = {quoted(value)}" + (f"  #{unit}" if unit else "")

        lines += [f"# {WHOLE}", "", "[parameters]", *(entry(k, v) for k, v in values.common.items())]
        for index, own in sorted(values.frame.items()):
            if own:
                lines += [
                    "",
                    f"[frames.{quoted(self.model.frames[index].name)}]",
                    *(entry(k, v) for k, v in own.items()),
                ]
        return "\n".join(lines) + "\n" + origin_toml(self.study.fit(self.step["index"])) + f"\n{END}\n"

    def write(self, changes: Mapping[str, float]) -> dict:
        """Write values into a new file of the study's folder; the file, its text, and the command that uses it."""
        text, number = self._do(lambda: self._toml(changes)), 1
        while True:
            file = Path(self.study.folder) / f"view-{number:02d}.toml"
            if not file.exists():
                write_text(file, text)
                break
            number += 1
        s, groups = (
            self.setup,
            [name for name, own in capture_files.groups(self.model.captures).items() if own[0] in self.held],
        )
        words = [
            "optics",
            "compare",
            s.captures,
            "--fit",
            str(file),
            *(w for k, v in s.defines.items() for w in ("-D", f"{k}={v}")),
            *(w for g in groups for w in ("--hold-out", g)),
            *(["--flat-field", s.flat_field] if s.flat_field else []),
            *(["--region", s.region] if s.region else []),
            *(w for p in s.plugins or () for w in ("--plugins", p)),
        ]
        return {"file": str(file), "text": text, "command": shlex.join(words)}


def quoted(value) -> str:
    """A number or a string as TOML has it, which JSON's are, but for its pairs of escapes beyond 16 bits."""
    return json.dumps(value, ensure_ascii=False)


# -- the server ------------------------------------------------------------------------------------------------------
def floats(*arrays: np.ndarray) -> bytes:
    """Arrays one after the other, little-endian float32."""
    return b"".join(np.ascontiguousarray(a, "<f4").tobytes() for a in arrays)


def plain(value):
    """JSON has no infinity and no NaN: null."""
    if isinstance(value, Mapping):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Server(ThreadingHTTPServer):
    """Serves one view on 127.0.0.1."""

    daemon_threads = True

    view: View

    def __init__(self, port: int = 0):
        try:
            super().__init__((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise OSError(
                f"--port {port}: {getattr(error, 'strerror', None) or error}; give another one, or none to take "
                "any that is "
                "free"
            ) from error
        self.hosts = {f"{name}:{self.server_address[1]}" for name in (HOST, "localhost")}
        self.token = secrets.token_urlsafe(16)  # other users of this machine reach the port, and do not know it

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_address[1]}/{self.token}/"


class Handler(BaseHTTPRequestHandler):
    """GET /, /study and /places; POST questions as JSON, answered by float32 or JSON; all behind the server's token.
    There are no other places, and no files are served."""

    protocol_version = "HTTP/1.1"
    server: Server

    def do_GET(self) -> None:
        view = self.server.view

        def places() -> None:
            self._send(HTTPStatus.OK, np.ascontiguousarray(view.places(), "<i4").tobytes())

        self._answer({"/": self._page, "/study": lambda: self._json(view.record()), "/places": places})

    def do_POST(self) -> None:
        view = self.server.view
        body: dict = {}

        def index() -> int:
            return view.frame(body.get("frame"))

        def changes(of: str = "values") -> dict:
            return view.changes(body.get(of) or {})

        def names() -> list[str]:
            found = body.get("names")
            if not isinstance(found, list):
                raise ValueError("names: not a list of parameters")
            return found

        def derivative() -> None:
            image, step = view.derivative(index(), body.get("name"), changes())
            if image is None:
                return self._send(HTTPStatus.NO_CONTENT, b"")
            self._send(HTTPStatus.OK, floats(image), **({} if step is None else {"X-Step": repr(step)}))

        def capture() -> None:
            image, use = view.capture(index())
            self._send(HTTPStatus.OK, floats(image, np.broadcast_to(use, image.shape)))

        routes = {
            "/capture": capture,
            "/derivative": derivative,
            "/predict": lambda: self._send(HTTPStatus.OK, floats(*view.predict(index(), changes()))),
            "/rows": lambda: self._json(view.rows(index(), names(), changes())),
            "/best": lambda: self._json(view.best(names(), changes(), changes("there"))),
            "/write": lambda: self._json(view.write(changes())),
        }
        self._answer(routes, body)

    def _answer(self, routes: Mapping[str, Callable], body: dict | None = None) -> None:
        """Run a route, and turn what is wrong with the question into a status and a sentence."""
        try:
            size = int(self.headers.get("Content-Length") or 0)
            if not 0 <= size <= BODY_MAX:
                return self._error(
                    HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a question of {size} bytes; allowed: {BODY_MAX}"
                )
            text = self.rfile.read(size)
            # A page of another site may send its visitor's browser here under a name of its own, or post what needs no
            # leave.
            if self.headers.get("Host") not in self.server.hosts:
                return self._error(HTTPStatus.FORBIDDEN, f"this page is only at {HOST}")
            begin = f"/{self.server.token}"
            if not hmac.compare_digest(self.path[: len(begin)].encode(), begin.encode()):
                return self._error(
                    HTTPStatus.FORBIDDEN, "the address lacks its token; `optics view` printed the complete address"
                )
            place = self.path.removeprefix(begin)
            if place not in routes:
                return self._error(HTTPStatus.NOT_FOUND, f"nothing is at this place; the page is at {self.server.url}")
            if body is not None:
                origin = self.headers.get("Origin")
                if (
                    self.headers.get_content_type() != "application/json"
                    or origin
                    and origin.removeprefix("http://") not in self.server.hosts
                ):
                    return self._error(HTTPStatus.FORBIDDEN, "questions come as application/json, from this page alone")
                given = json.loads(text or b"{}")
                if not isinstance(given, dict):
                    raise ValueError("the question is not a JSON object")
                body.update(given)
            routes[place]()
        except (ConnectionError, CancelledError):  # the page is gone, or the server ends
            self.close_connection = True
        except Exception as error:  # whoever asked is told, of a plugin's mistakes as well
            self._error(HTTPStatus.BAD_REQUEST, " ".join(str(error).split()) or type(error).__name__)

    def _page(self) -> None:
        self._send(HTTPStatus.OK, PAGE.read_bytes(), "text/html; charset=utf-8")

    def _json(self, value) -> None:
        self._send(HTTPStatus.OK, json.dumps(plain(value), allow_nan=False).encode(), "application/json")

    def _error(self, status: HTTPStatus, text: str) -> None:
        """Refuse, and end the connection, with what was not read of the question."""
        self._send(status, json.dumps({"error": text}).encode(), "application/json", Connection="close")

    def _send(self, status: HTTPStatus, data: bytes, kind: str = "application/octet-stream", **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header(
            "Content-Security-Policy",
            "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
            "connect-src 'self'; img-src data:; base-uri 'none'; frame-ancestors 'none'",
        )
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_) -> None:
        """Say nothing: the terminal belongs to the command."""


def serve(
    folder: str | Path,
    port: int = 0,
    step: int | None = None,
    ready: Callable[[str], None] = lambda url: None,
    *,
    plugins: Named = None,
    captures: str | Path | None = None,
) -> None:
    """Serve the page of a study until Ctrl-C; `ready` is told its address.

    plugins, captures   as `optics.study.loop.take_up` takes them

    Raises what `optics.study.loop.take_up` raises, ValueError for a study or a step that is not there, OSError for a
    port in use."""
    if not PAGE.is_file():
        raise FileNotFoundError(f"{PAGE}: the page is missing from this installation; install the package again")
    server = Server(port)
    try:
        server.view = View(folder, step, plugins, captures)
        try:
            ready(server.url)
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            pass
        finally:
            server.view.close()
    finally:
        server.server_close()
