"""A scoreboard: calibrated ladders and models without physics on the same held-out images.

    boards = scoreboard(["captures"], ["study"])       one `Board` for each capture set and choice of held-out groups

Every model of a board is tested on the same frames, pixels and regions:

    background           the untouched image (flat field times the frame's gain), as if nothing were pressed
    tables               of the normal and the place, optics.fit.null_models.tables; fitted to the fitted groups,
                         each group of lights by itself
    another photograph   the photograph of another press under the same lights that is most like the held-out one
    NAME: step           every step of a study, with the poses that it found in the held-out frames

Rivals get the benefit of the doubt. A table is fitted once to the pixels of the contact, to be scored there, and once
to all usable pixels, to be scored on the whole image. It is tried as a factor and as an addition to the flat field, and
on each geometry at hand: the poses that the captures state, on a plate of balls the balls' own normals there, and the
poses of each study. What gives it the smaller held-out error counts, and is said. Where a study finds a gain of its own
in each held-out frame, a table gets the one that suits it best.

The contact is what the captures state (optics.fit.known_shape), so that it is the same for all, wherever a study was
fitted. Errors:

    rms, L1      of measured minus predicted, DN and in units of full scale;   predictions clipped to the camera's range
    ratio        rms of (measured - predicted)/(flat field times gain), where there is a flat field
    SSIM, PSNR   of values normalised to full scale, 0 ... 1 (the data range is 1); mean over frames, and sd
    chi2/dof     residuals over the noise of the set at the prediction; of a study, poses found in held-out frames count
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures import capture_set as capture_files
from optics.errors import BadCapture, Underdetermined
from optics.fit import calibrate
from optics.fit.compare import Comparison, compare, led_label
from optics.fit.known_shape import ALL, contact, contact_in_words, is_plate, on_balls
from optics.fit.null_models import Lambert, Shape, Table, place_of, tables, tilt_of
from optics.fit.scene_model import SceneModel
from optics.scene import trust
from optics.scene.parameter import Values
from optics.scene.trust import Named
from optics.study import loop
from optics.study.board import RIVAL, STEP, Board, Entry, Images, Level, Ring
from optics.study.fit_files import read_fit
from optics.study.record import Record
from optics.study.setup import Setup, open_model, setup_for, split
from optics.study.shown import mosaic_of
from optics.study.stages import held_out_values

Progress = Callable[[str, int, int], None]

PHOTOGRAPH, BACKGROUND = "another photograph", "background"
SUBSETS = 4  # choices of presses of which the error against their number is the mean
NUMBERS_OF_PRESSES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)


# -- what is compared ------------------------------------------------------------------------------------------------
@dataclass
class Ladder:
    """A study of the board's captures: its model, its values at each step, and the numbers that it fitted."""

    name: str
    model: SceneModel
    setup: Setup
    record: Record
    values: list[Values]
    common: list[int]
    poses: list[int]

    @classmethod
    def open(cls, folder: Path, name: str, plugins: Named = None) -> Ladder:
        record, model, setup = loop.take_up(folder, plugins)
        values, common, poses = [], [], []
        for index in range(len(record.steps)):
            values.append(loop.kept(record, model, index)[1])
            common.append(sum(v["frames"] is None for v in record.steps[index]["variables"]))
            poses.append(int(read_fit(record.path(index) / "fit.toml")["fit"].get("held_out_parameters", 0)))
        return cls(name, model, setup, record, values, common, poses)

    def label(self, index: int) -> str:
        step = self.record.steps[index]
        return f"{self.name}: {'+ ' if index else ''}{step['name']}"


def scoreboard(
    captures: Sequence[str | Path] = (),
    studies: Sequence[str | Path] = (),
    *,
    held_out: Sequence[str] | None = None,
    presses: bool = False,
    plugins: Named = None,
    progress: Progress | None = None,
) -> list[Board]:
    """Score studies and rivals on held-out frames, a board for each capture set and choice of held-out groups.

    captures   capture folders; those of the studies need not be named
    studies    folders of studies: all their steps are scored; they say which groups are held out
    held_out   groups of captures that no study is of; None: every fourth of four or more, else the last one
    presses    also calibrate the last step of each study on fewer presses: minutes each
    plugins    as `optics.facade.calibrate` takes them

    Raises BadCapture for captures that cannot be scored, ValueError where nothing is given.
    """
    if not captures and not studies:
        raise ValueError("nothing to score; allowed: capture folders, studies (--study STUDY), or both")
    jobs = _jobs(captures, studies, plugins)
    boards = []
    for done, (folder, ladders) in enumerate(jobs):
        if progress:
            progress("scoreboard", done, len(jobs))
        boards.append(_Bench(folder, ladders, held_out, progress, plugins).board(presses))
    if progress:
        progress("scoreboard", len(jobs), len(jobs))
    return boards


def _jobs(
    captures: Sequence[str | Path], studies: Sequence[str | Path], plugins: Named
) -> list[tuple[Path, list[Ladder]]]:
    """Each capture folder with its studies; twice, where studies of it hold out different groups."""
    studies = list({os.path.realpath(s): s for s in reversed(studies)}.values())[::-1]  # one that is named twice, once
    names = [Path(os.path.abspath(s)).name for s in studies]
    found: dict[tuple[Path, tuple[int, ...]], list[Ladder]] = {}
    for folder, name in zip(map(Path, studies), names):
        own = name if names.count(name) == 1 else f"{Path(os.path.abspath(folder)).parent.name}/{name}"
        ladder = Ladder.open(folder, own, plugins)
        of = Path(ladder.setup.captures).resolve()
        held = split(ladder.model, ladder.setup)[1]
        if not held:
            raise BadCapture(
                f"{folder}: nothing is held out, so there is nothing to test on; calibrate with --hold-out GROUP"
            )
        found.setdefault((of, tuple(held)), []).append(ladder)
    order = dict.fromkeys(Path(c).resolve() for c in captures)
    jobs = []
    for folder in dict.fromkeys([*order, *(of for of, _ in found)]):
        own_ladders = [ladders for (of, _), ladders in found.items() if of == folder]
        jobs += [(folder, ladders) for ladders in own_ladders or [[]]]
    return jobs


@dataclass
class _Score:
    """A rival's choice in a region: its error, what it was fitted as, and its predictions of the held-out frames."""

    error: float
    kind: int
    variant: int
    added: bool
    geometry: str
    predictions: list[np.ndarray]
    numbers: int


class _Bench:
    """Frames, regions and geometries of one board."""

    def __init__(
        self,
        folder: Path,
        ladders: list[Ladder],
        held_out: Sequence[str] | None,
        progress: Progress | None,
        plugins: Named = None,
    ):
        self.folder, self.ladders, self.progress = folder, ladders, progress or (lambda *_: None)
        if ladders:
            self.model, setup = ladders[0].model, ladders[0].setup
            self.fitted, self.held = split(self.model, setup)
        else:
            named = trust.named(plugins)
            setup = setup_for(
                folder,
                held_out=list(held_out) if held_out is not None else None,
                plugins=None if named is None else [str(p) for p in named],
            )
            self.model = open_model(setup)
            self.fitted, self.held = _split(self.model, setup)
        model = self.model
        if model.captures.table is not None or model.scene.gel is None:
            raise BadCapture(
                f"{folder}: {'readings in a table' if model.captures.table is not None else 'a scene without a gel'}; "
                "allowed: images of a pressed gel"
            )
        self.notes: list[str] = []
        self.frames = range(len(model.frames))
        self.groups = capture_files.groups(model.captures)
        self.group_of = {i: name for name, own in self.groups.items() for i in own}
        self.lights = {i: self._lights(i) for i in self.frames}
        self._leave_out()
        self.leds = {i: led_label(model.frames[i].parameters) for i in self.frames}
        self.black, self.saturation = model.noise.black_level, model.noise.saturation
        self.full_scale = self.saturation - self.black
        self.usable = {i: model.usable_in(i, ALL) for i in self.frames}  # wherever a study was fitted
        self.flats = self._flats()
        self.tilts: dict[str, dict[int, np.ndarray]] = {}
        self.gained = any(self._finds_gains(ladder) for ladder in ladders)
        if self.gained:
            self.notes.append(
                "a study finds a gain of its own in each held-out frame (gain drift): tables get one there as well"
            )
        self.region, self.inner = self._contact()
        self.x, self.y = place_of(model.shape)
        self._geometries()

    # -- frames ------------------------------------------------------------------------------------------------------
    def _finds_gains(self, ladder: Ladder) -> bool:
        """Whether a step of a study has gains of single held-out frames, which its fit found in these themselves."""
        camera, stated = self.model.scene.camera.name, [f.parameters for f in self.model.frames]
        found = {(i, key) for values in ladder.values for i, own in values.frame.items() for key in own}
        return any(i in self.held and key.startswith(f"{camera}.gain") and key not in stated[i] for i, key in found)

    def _lights(self, index: int) -> tuple:
        """What frames of one table share: settings of lights and of what is in the way, but neither press nor
        camera."""
        model = self.model
        kept = {}
        for key, value in model.frames[index].parameters.items():
            part = key.rpartition(".")[0]
            if part not in (model.scene.gel.name, model.scene.camera.name):
                kept[key] = value
        return tuple(sorted(kept.items()))

    def _leave_out(self) -> None:
        """Held-out frames whose lights no fitted frame has are not scored: no table can say anything of them."""
        known = {self.lights[i] for i in self.fitted}
        left = [i for i in self.held if self.lights[i] not in known]
        self.held = [i for i in self.held if i not in left]
        if left:
            self.notes.append(
                f"{len(left)} held-out frames are not scored: no fitted frame has their lights "
                f"({self.model.frames[left[0]].name}, ...)"
            )
        if not self.held:
            raise Underdetermined(
                f"{self.folder}: no held-out frame has the lights of a fitted one; hold out whole presses"
            )

    def _flats(self) -> dict[int, np.ndarray]:
        """(H, W, C) DN, with the black level, of each frame: its flat field times its gain; without one, the mean of
        the fitted frames of the same lights."""
        model = self.model
        found: dict[int, np.ndarray] = {}
        self.has_flat = all(model.flat_of(i) is not None for i in self.frames)
        for i in self.frames:
            flat = model.flat_of(i)
            if flat is not None and self.has_flat:
                found[i] = self.black + flat * model.gains(model.at(Values(), i))
        if not self.has_flat:
            self.notes.append(
                "no flat field: tables start from a level face, the mean of the fitted frames of the same lights; no "
                "ratio is given"
            )
            means: dict[tuple, np.ndarray] = {}
            for lights in dict.fromkeys(self.lights.values()):
                own = [i for i in self.fitted if self.lights[i] == lights]
                if own:
                    level = np.mean([model.frames[i].image.mean((0, 1)) for i in own], 0)
                    means[lights] = np.broadcast_to(level, model.shape).astype(float)
            found = {i: means[self.lights[i]] for i in self.frames if self.lights[i] in means}
        return found

    # -- geometry ----------------------------------------------------------------------------------------------------
    def _contact(self) -> tuple[str, dict[int, np.ndarray]]:
        """(words, (H, W) bool of each frame): the contact as the captures state it."""
        model = self.model
        plate = {i: is_plate(model, i) for i in self.frames}
        self.balls: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # offset over radius (H, W, 2), length
        for i in self.frames:
            if plate[i]:
                offset = on_balls(model, i)[0]
                self.balls[i] = (offset, np.linalg.norm(offset, axis=-1))
        kept: dict[tuple, np.ndarray] = {}  # frames of one press share theirs
        found: dict[int, np.ndarray] = {}
        for i in self.frames:
            key = model.renderer.geometry(model.at(Values(), i))
            if key not in kept:
                kept[key] = contact(model, i)
            found[i] = kept[key]
        empty = [i for i in (*self.held, *self.fitted) if not (found[i][..., None] & self.usable[i]).any()]
        if empty:
            raise BadCapture(
                f"{self.folder}: frame {model.frames[empty[0]].name}: no usable pixel in the contact that its "
                "settings state; check its press, its mask and the scene's scale"
            )
        return contact_in_words(all(plate.values())), found

    def _geometries(self) -> None:
        """Normals of each frame by name: as stated, of the balls themselves, by each study."""
        self.tilts["the stated poses"] = self._tilts(self.model, Values())
        if len(self.balls) == len(self.frames):
            self.tilts["the balls' own normals"] = {i: _ball_tilt(*self.balls[i]) for i in self.frames}
        for ladder in self.ladders:
            self.tilts[f"poses of {ladder.name}"] = self._tilts(ladder.model, ladder.values[-1])

    def _tilts(self, model: SceneModel, values: Values) -> dict[int, np.ndarray]:
        kept: dict[tuple, np.ndarray] = {}
        found = {}
        for i in self.frames:
            now = model.at(values, i)
            key = model.renderer.geometry(now)
            if key not in kept:
                kept[key] = tilt_of(model, now)
            found[i] = kept[key]
        model.renderer.forget_hits()
        return found

    def shape(self, index: int, geometry: str) -> Shape:
        return Shape(self.flats[index], self.tilts[geometry][index], self.x, self.y, self.black)

    def clip(self, image: np.ndarray) -> np.ndarray:
        return np.clip(image, 0, self.saturation)

    # -- errors ------------------------------------------------------------------------------------------------------
    def mask(self, index: int, inner: bool) -> np.ndarray:
        """(H, W, C) bool: usable values of a region."""
        return self.usable[index] & self.inner[index][..., None] if inner else self.usable[index]

    def squares(self, index: int, prediction: np.ndarray, inner: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per channel: sum of squares in DN^2, of the ratio, and how many."""
        mask = self.mask(index, inner)
        left = self.clip(prediction) - self.model.frames[index].image
        light = np.maximum(self.flats[index] - self.black, 1e-6)
        return (mask * left**2).sum((0, 1)), (mask * (left / light) ** 2).sum((0, 1)), mask.sum((0, 1))

    def error(self, predictions: Sequence[np.ndarray], inner: bool) -> float:
        """What choices are made by: rms of the ratio where there is a flat field, else in DN."""
        parts = [self.squares(i, p, inner) for i, p in zip(self.held, predictions)]
        which = 1 if self.has_flat else 0
        return math.sqrt(sum(p[which].sum() for p in parts) / max(sum(p[2].sum() for p in parts), 1))

    def level(
        self,
        predictions: Sequence[np.ndarray],
        inner: bool,
        sd: Sequence[np.ndarray] | None = None,
        poses: int = 0,
    ) -> Level:
        """The errors of predictions (H, W, C) of the held-out frames."""
        clipped = [self.clip(p) for p in predictions]
        model = self.model
        found = compare(
            [model.frames[i].image for i in self.held],
            clipped,
            [np.sqrt(model.noise.variance(p)) for p in clipped] if sd is None else sd,
            [self.mask(i, inner) for i in self.held],
            names=[str(i) for i in self.held],
            leds=[self.leds[i] for i in self.held],
            held_out=range(len(self.held)),
            held_out_parameters=poses,
            full_scale=self.full_scale,
            black_level=self.black,
            bins=2,
        )
        parts = {i: self.squares(i, p, inner) for i, p in zip(self.held, predictions)}
        cells = self._cells(found, parts)
        total, count = sum(p[1].sum() for p in parts.values()), sum(p[2].sum() for p in parts.values())
        row, over = found.total, found.similarity
        return Level(
            row.n,
            row.rms,
            row.noise,
            math.sqrt(total / count) if self.has_flat else None,
            row.chi2_per_dof,
            over["l1"][0],
            over["ssim"][0],
            over["psnr"][0],
            {key: value[1] for key, value in over.items()},
            cells,
        )

    def _cells(self, found: Comparison, parts: Mapping[int, tuple]) -> list[dict[str, Any]]:
        """One row per lamp and channel."""
        cells = []
        for row in found.by("led", "channel") or found.by("led"):
            led = row.scope.get("led", self.leds[self.held[0]])
            channel = row.scope.get("channel", found.channels[0])
            c = found.channels.index(channel)
            own = [parts[i] for i in self.held if self.leds[i] == led]
            ratio = math.sqrt(sum(p[1][c] for p in own) / max(sum(p[2][c] for p in own), 1))
            cells.append(
                {
                    "led": led,
                    "channel": channel,
                    "rms": row.rms,
                    "ratio": ratio if self.has_flat else None,
                    "l1": row.l1,
                    "ssim": row.ssim,
                    "psnr": row.psnr,
                    "chi2_per_dof": row.chi2_per_dof,
                    "n": row.n,
                }
            )
        return cells

    # -- rivals ------------------------------------------------------------------------------------------------------
    def fitted_tables(
        self, unfitted: Callable[[], Table], geometry: str, frames: Sequence[int], inner: bool
    ) -> dict[tuple, Table]:
        """A table for each group of lights, fitted to frames: least squares of the ratio, or of DN where it is an
        addition.

        unfitted   makes a table"""
        found = {}
        for lights in dict.fromkeys(self.lights[i] for i in self.held):
            own = [i for i in frames if self.lights[i] == lights]
            rows = [(self.model.frames[i].image.astype(float), self.mask(i, inner).astype(float)) for i in own]
            found[lights] = unfitted()
            found[lights].fit([self.shape(i, geometry) for i in own], rows)
        return found

    def again(self, score: _Score, frames: Sequence[int]) -> dict[tuple, Table]:
        """The tables of a choice in the contact, fitted to these frames."""
        return self.fitted_tables(lambda: tables(score.added)[score.kind][score.variant], score.geometry, frames, True)

    def predictions(self, fitted: Mapping[tuple, Table], geometry: str) -> list[np.ndarray]:
        return [fitted[self.lights[i]].predict(self.shape(i, geometry)) for i in self.held]

    def choose(self, kind: int, inner: bool) -> _Score:
        """The variant, the form and the geometry with which a table has the smallest held-out error."""
        best = None
        for geometry, added, variant in product(self.tilts, (False, True), range(len(tables()[kind]))):
            fitted = self.fitted_tables(
                lambda added=added, variant=variant: tables(added)[kind][variant],  # type: ignore[misc]
                geometry,
                self.fitted,
                inner,
            )
            guess = self.predictions(fitted, geometry)
            error = self.error(guess, inner)
            if best is None or error < best.error:
                numbers = sum(t.numbers() for t in fitted.values()) * self.model.shape[2]
                best = _Score(error, kind, variant, added, geometry, guess, numbers)
        assert best is not None  # there is always a geometry
        return best

    def with_gain(self, index: int, prediction: np.ndarray, inner: bool) -> np.ndarray:
        """A prediction with the gain of each channel that suits the held-out frame itself best, by least squares."""
        mask, light = self.mask(index, inner), prediction - self.black
        measured = self.model.frames[index].image - self.black
        gain = (mask * light * measured).sum((0, 1)) / np.maximum((mask * light**2).sum((0, 1)), 1e-12)
        return self.black + gain * light

    def photographs(self, inner: bool) -> tuple[list[np.ndarray], list[str]] | None:
        """For each held-out frame the most similar photograph of another press under the same lights, and its name."""
        images, names = [], []
        for i in self.held:
            others = [
                j for j in self.frames if self.lights[j] == self.lights[i] and self.group_of[j] != self.group_of[i]
            ]
            if not others:
                return None
            mask, own = self.mask(i, inner), self.model.frames[i].image
            errors = [float((mask * (self.model.frames[j].image - own) ** 2).sum()) for j in others]
            best = others[int(np.argmin(errors))]
            images.append(self.model.frames[best].image.astype(float))
            names.append(self.model.frames[best].name)
        return images, names

    # -- the board ---------------------------------------------------------------------------------------------------
    def board(self, presses: bool) -> Board:
        entries, shown = [], {}
        chosen: dict[int, tuple[_Score, _Score]] = {}
        kinds = tables()
        total = len(kinds) + sum(len(ladder.values) for ladder in self.ladders)
        if self.has_flat:
            flat = [self.flats[i] for i in self.held]
            entries.append(Entry(BACKGROUND, RIVAL, 0, 0, self.level(flat, True), self.level(flat, False)))
            shown[BACKGROUND] = flat
        for kind, (model, *_) in enumerate(kinds):
            inner, whole = chosen[kind] = (self.choose(kind, True), self.choose(kind, False))
            contact, image = self.level(inner.predictions, True), self.level(whole.predictions, False)
            how = {"contact": _said(inner), "whole": _said(whole)}
            entries.append(Entry(model.name, RIVAL, max(inner.numbers, whole.numbers), 0, contact, image, how))
            shown[model.name] = _composed(inner.predictions, whole.predictions, [self.inner[i] for i in self.held])
            self.progress("models", kind + 1, total)
        near, anywhere = self.photographs(True), self.photographs(False)
        if near is not None and anywhere is not None:
            names = {"contact": ", ".join(near[1][:3]), "whole": ", ".join(anywhere[1][:3])}
            entries.append(
                Entry(PHOTOGRAPH, RIVAL, None, 0, self.level(near[0], True), self.level(anywhere[0], False), names)
            )
            shown[PHOTOGRAPH] = anywhere[0]
        else:
            self.notes.append("another photograph: left out, a held-out frame has no other press under its lights")
        done = len(kinds)
        for ladder in self.ladders:
            for index, values in enumerate(ladder.values):
                guess = ladder.model.predict(values, self.held)
                sd = [np.sqrt(ladder.model.variance(values, i, p)) for i, p in zip(self.held, guess)]
                contact, image = (self.level(guess, inner, sd, ladder.poses[index]) for inner in (True, False))
                label = ladder.label(index)
                entries.append(Entry(label, STEP, ladder.common[index], ladder.poses[index], contact, image))
                shown[label] = guess
                done += 1
                self.progress("models", done, total)
        if not self.ladders:
            self.notes.append("no study of these captures is given: rivals alone")
        self.notes.append(_package())
        result = Board(
            captures=str(self.folder),
            studies=[str(ladder.record.folder) for ladder in self.ladders],
            fitted=list(dict.fromkeys(self.group_of[i] for i in self.fitted)),
            held_out=list(dict.fromkeys(self.group_of[i] for i in self.held)),
            frames=len(self.held),
            size=(self.model.shape[0], self.model.shape[1]),
            channels={1: ["L"], 3: ["R", "G", "B"]}.get(
                self.model.shape[2], [f"c{k}" for k in range(self.model.shape[2])]
            ),
            region=self.region,
            full_scale=self.full_scale,
            entries=entries,
            by_presses=self.by_presses(chosen, presses),
            rings=[ring for ladder in self.ladders if (ring := ring_of(ladder)) is not None],
            rivals_azimuths=self.azimuths(chosen),
            notes=self.notes,
        )
        result.images = self.images(result, shown)
        return result

    def images(self, board: Board, shown: Mapping[str, Sequence[np.ndarray]]) -> Images:
        """The first held-out frame, by the best step, the best rival and two that are easy to understand."""
        names = [e.name for e in (board.best(STEP), board.best(RIVAL)) if e is not None]
        names += [n for n in (PHOTOGRAPH, BACKGROUND) if n in shown]
        first = self.held[0]
        return Images(
            self.model.frames[first].name,
            self.model.frames[first].image,
            {name: self.clip(shown[name][0]) for name in dict.fromkeys(names)},
            self.usable[first],
            self.inner[first],
            mosaic_of(self.model),
        )

    def azimuths(self, chosen: Mapping[int, tuple[_Score, _Score]]) -> dict[str, float]:
        """LED -> deg, of the directional table in the contact; of frames that one LED lights."""
        kind = next(k for k, (t, *_) in enumerate(tables()) if isinstance(t, Lambert))
        found = {}
        for lights, model in self.again(chosen[kind][0], self.fitted).items():
            led = next(self.leds[i] for i in self.held if self.lights[i] == lights)
            if led in self.model.scene.leds and isinstance(model, Lambert):
                x, y, _ = np.mean(model.light, axis=0)
                found[led] = math.degrees(math.atan2(y, x))
        return found

    # -- fewer presses -----------------------------------------------------------------------------------------------
    def by_presses(self, chosen: Mapping[int, tuple[_Score, _Score]], presses: bool) -> dict[str, list[dict[str, Any]]]:
        """Held-out error in the contact against the number of fitted groups, averaged over SUBSETS choices."""
        names = [name for name, own in self.groups.items() if own[0] in set(self.fitted)]
        counts = [k for k in NUMBERS_OF_PRESSES if k < len(names)] + [len(names)]
        found: dict[str, list[dict[str, Any]]] = {}
        for count in counts:
            subsets = self._subsets(names, count)
            for kind, (model, *_) in enumerate(tables()):
                score = chosen[kind][0]
                errors = [self.predictions(self.again(score, frames), score.geometry) for frames in subsets]
                if errors:
                    found.setdefault(model.name, []).append(self._mean_error(count, errors))
            if presses:
                for ladder in self.ladders:
                    if subsets:
                        guess = self._recalibrated(ladder, subsets[0])
                        found.setdefault(ladder.label(len(ladder.values) - 1), []).append(
                            self._mean_error(count, [guess])
                        )
        return found

    def _subsets(self, names: Sequence[str], count: int) -> list[list[int]]:
        """Frames of `count` groups in turn, of SUBSETS choices spread over all; those that have all lights."""
        starts = (
            [0] if count == len(names) else np.unique(np.linspace(0, len(names), SUBSETS, endpoint=False).astype(int))
        )
        found = []
        for start in starts:
            frames = [i for k in range(count) for i in self.groups[names[(start + k) % len(names)]]]
            if {self.lights[i] for i in self.held} <= {self.lights[i] for i in frames}:
                found.append(frames)
        return found

    def _mean_error(self, count: int, several: Sequence[Sequence[np.ndarray]]) -> dict[str, Any]:
        """rms over choices of presses, in DN and of the ratio."""
        squares, ratios, n = 0.0, 0.0, 0.0
        for predictions in several:
            for i, p in zip(self.held, predictions):
                a, b, c = self.squares(i, p, True)
                squares, ratios, n = squares + a.sum(), ratios + b.sum(), n + c.sum()
        ratio = math.sqrt(ratios / n) if self.has_flat else None
        return {"presses": count, "rms": math.sqrt(squares / n), "ratio": ratio}

    def _recalibrated(self, ladder: Ladder, frames: Sequence[int]) -> list[np.ndarray]:
        """Predictions of the held-out frames by the last step's variables, fitted to these frames from its values."""
        variables, values, _ = loop.kept(ladder.record, ladder.model)
        own = [v for v in variables if v.frames is None or set(v.frames) <= set(frames)]
        found = calibrate.fit(ladder.model, own, values, frames, robust=ladder.setup.robust, progress=self.progress)
        return ladder.model.predict(held_out_values(ladder.model, found, self.held)[0], self.held)


def _split(model: SceneModel, setup: Setup) -> tuple[list[int], list[int]]:
    """Fitted and held-out frames; of two or three groups the last one is held out."""
    fitted, held = split(model, setup)
    groups = list(capture_files.groups(model.captures).values())
    if held or setup.held_out is not None:
        if not held:
            raise BadCapture(f"{setup.captures}: nothing is held out, so there is nothing to test on")
        return fitted, held
    if len(groups) < 2:
        raise BadCapture(f"{setup.captures}: one group of frames; needed: two or more, to fit one and test on another")
    return [i for own in groups[:-1] for i in own], list(groups[-1])


def _ball_tilt(offset: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(H, W, 3): n - n0 of balls, level beside them."""
    ball = length < 0.95  # steeper flanks are not touched
    z = np.sqrt(np.maximum(1 - np.minimum(length, 1) ** 2, 0))
    return np.where(ball[..., None], np.concatenate([offset, z[..., None] - 1], -1), 0.0)


def _said(score: _Score) -> str:
    return f"{'added to' if score.added else 'times'} the flat field, {score.geometry}"


def _composed(
    inner: Sequence[np.ndarray], whole: Sequence[np.ndarray], regions: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """What a page shows of a table: its fit to the contact there, and its fit to all pixels elsewhere."""
    return [np.where(r[..., None], a, b) for a, b, r in zip(inner, whole, regions)]


def _package() -> str:
    """Whether the package of the polynomial table's authors' method is at hand."""
    if importlib.util.find_spec("taxim") is None:
        return "the package `taxim` is not installed and is left out; a polynomial table of its kind is fitted here"
    return (
        "the package `taxim` is installed, but brings tables of other sensors; a polynomial table of its kind is "
        "fitted to these captures in its place"
    )


# -- the ring of LEDs ------------------------------------------------------------------------------------------------
def ring_of(ladder: Ladder) -> Ring | None:
    """The circle through a study's calibrated LEDs; None for fewer than three, or LEDs on one line."""
    scene, values = ladder.model.scene, ladder.values[-1]
    now = {**ladder.model.base, **values.common}
    places = scene.places_of(now)
    if len(places) < 3:
        return None
    at = np.array(list(places.values()))[:, :2]
    fitted = circle(at)
    if fitted is None:
        return None
    middle, radius, off = fitted
    azimuths = np.degrees(np.arctan2(*(at - middle).T[::-1]))
    order = np.argsort(azimuths)
    steps = np.diff(np.append(azimuths[order], azimuths[order[0]] + 360.0))
    names = list(places)
    leds = [
        {
            "led": names[k],
            "x": float(at[k, 0]),
            "y": float(at[k, 1]),
            "azimuth": float(azimuths[k]),
            "step": float(step),
        }
        for k, step in zip(order, steps)
    ]
    return Ring(ladder.name, (float(middle[0]), float(middle[1])), radius, off, leds)


def circle(points: np.ndarray) -> tuple[np.ndarray, float, float] | None:
    """(middle, radius, rms distance of the points from it) of the circle with the least rms distance to points (N, 2);
    None where they lie on a line."""
    from scipy.optimize import least_squares

    spread = points - points.mean(0)
    if len(points) < 3 or np.linalg.matrix_rank(spread, tol=1e-6 * max(np.abs(spread).max(), 1e-12)) < 2:
        return None
    # x^2 + y^2 = 2 a x + 2 b y + c: linear, and near the answer
    a = np.column_stack([2 * points, np.ones(len(points))])
    first = np.linalg.lstsq(a, (points**2).sum(1), rcond=None)[0]
    start = [first[0], first[1], math.sqrt(max(first[2] + first[0] ** 2 + first[1] ** 2, 1e-12))]
    found = least_squares(lambda p: np.hypot(*(points - p[:2]).T) - p[2], start)
    return found.x[:2], float(found.x[2]), float(np.sqrt(np.mean(found.fun**2)))
