"""Benches of other laboratories (optics.proof.makers.laboratory): captures that share nothing with the library's idea
of a bench, each with everyday imperfections.

A cell hides none, one or two causes, by their usual law or by another, or a kind that no library has, at a signal to
noise per value of 0.3 to 30: the rms change of a reading that the owner's bench cannot take up, over the noise of a
reading by instrument and dials.

What counts as the same cause: SAME, by its physics. Nothing else does: of causes that a session cannot tell apart by
any reading, a claim of the wrong one is wrong, and a set that holds the right one is right."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from optics.proof.cells import Cell
from optics.proof.makers.laboratory import (
    causes,
    design,
    folder,
    laser,
    mosaic,
    motor,
    phone,
    photographs,
    polarimeter,
    runs,
    student,
)
from optics.proof.makers.laboratory.session import Session
from optics.proof.rigs.base import Rig
from optics.study import loop

TRIES = 30  # sessions that are drawn until one shows a cause as strongly as is asked
LIKE = 0.01  # of chi2: a tenth in amplitude
SEEN = 1.0  # the same, of both of two causes
SURE = 3.0  # sd of a frame's mean by which a lamp wanders that is seen

ONE_ANGLE = (
    "only the angle between the film's scale and the camera's analysers counts: turn both back together with the "
    "panel, whose polarizations are solved for, and every pixel reads the same"
)
# hidden -> names that say the same, and why
SAME: Mapping[str, Mapping[str, str]] = {
    "stress birefringence": {
        "retardance": "an evenly stressed plate is a linear retarder along its stress: the same Mueller matrix in a "
        "session with any bands, as both go with 1/wavelength"
    },
    "film misalignment": {
        "polarizer misalignment": "the maker's name for the film before a camera: the same number",
        "site misalignment": ONE_ANGLE,
    },
    "site misalignment": {"polarizer misalignment": ONE_ANGLE},
    "film leak": {"extinction leak": "the maker's name for the film before a camera: the same number"},
    "coloured leak": {
        "extinction leak": "the leak at 540 nm is the first of its two numbers: a coloured leak is a leak, and its "
        "slope is named by the next step or not"
    },
}
# the same of causes by the maker's other law
SAME_BY_OTHER_LAW: Mapping[str, Mapping[str, str]] = {
    "residual response curve": {
        "soft saturation": "the other law is a straight line that levels off beyond a knee: what the library calls so"
    },
    "dark offset": {"dark drift": "the other law grows with the clock and settles: what the library calls so"},
}
IN_SAMPLE = {"retardance", "stress birefringence", "depolarization", "dichroism"}


class Laboratory(Rig):
    """A kind of session; `draw` makes one of a generator. Zeros of the dials that it does not know are declared
    free."""

    outside = True
    draw: Callable[[np.random.Generator], Session]
    effects: tuple[str, ...] = ()
    unknown: Mapping[str, tuple[str, ...]] = {}
    others: tuple[str, ...] = ()
    weakest, strongest = 0.3, 30.0  # signal to noise per value
    nulls = 4  # of a round
    pair_cells = 3
    frame_by_frame = False  # each frame is recorded at once: a lamp that wanders is a gain of each
    usual = False  # solves for what the scene declares free, no list of his own

    def __init__(self):
        super().__init__()
        self._made: dict[str, tuple[Session, dict[str, float], dict]] = {}
        self.pairs = [(a, b) for i, a in enumerate(self.effects) for b in self.effects[i + 1 :]]

    # -- the plan -----------------------------------------------------------------------------------------------------
    def rounds(self, count: int, first: int = 0) -> Iterator[list[Cell]]:
        """Each round: every cause once at a random strength, one in four by another law where it has one; sets with
        nothing hidden, with two causes, with kinds that no library has."""
        for number in range(first, first + count):
            rng = np.random.default_rng([number, zlib.crc32(self.name.encode())])
            drawn = [
                ("library", (e,), "other" if e in self.others and (number + i) % 4 == 0 else "same", 0)
                for i, e in enumerate(self.effects)
            ]
            drawn += [("none", (), "same", k) for k in range(self.nulls)]
            order = rng.permutation(len(self.pairs))
            drawn += [("pair", self.pairs[k], "same", 0) for k in order[: self.pair_cells]]
            kinds = list(self.unknown)
            few = min(2, len(kinds))
            drawn += [("unknown", (kinds[(few * number + k) % len(kinds)],), "same", 0) for k in range(few)]
            snrs = np.exp(rng.uniform(math.log(self.weakest), math.log(self.strongest), len(drawn)))
            cells = [
                Cell(self.name, kind, hidden, 0.0, 0.0, law, "", number, round(float(s), 2) if hidden else 0.0, salt)
                for (kind, hidden, law, salt), s in zip(drawn, snrs)
            ]
            yield [cells[i] for i in rng.permutation(len(cells))]

    # -- one cell -----------------------------------------------------------------------------------------------------
    def plan(self, cell: Cell) -> tuple[Session, dict[str, float], dict]:
        """The session of a cell, the numbers of its bench, and what is recorded of both; no numbers where no session
        shows what is to be hidden."""
        if cell.name not in self._made:
            self._made.clear()
            self._made[cell.name] = self._plan(cell)
        return self._made[cell.name]

    def _plan(self, cell: Cell) -> tuple[Session, dict[str, float], dict]:
        rng = np.random.default_rng(zlib.crc32(cell.name.encode()))
        for _ in range(TRIES):
            session = type(self).draw(rng)
            named = cell.hidden if cell.kind in ("library", "pair") else ()
            session = student.known(session, cell.hidden, rng)
            if not session.plate_in and not IN_SAMPLE & {*named}:
                continue  # nobody turns an empty sample holder
            if any(name not in design.rivals(session) for name in named):
                continue  # a cause whose setting is not written down cannot be named
            parts = {}
            for name in cell.hidden:
                part, most = self.part(cell, name, session, rng)
                size = design.size_of(session, part, most, max(cell.snr, SEEN if cell.kind == "pair" else 0))
                if not 0 < size < math.inf:
                    break
                parts[name] = self.finished(part(size), session, rng)
            else:
                hidden = causes.both(*parts.values())
                if cell.kind == "unknown" and self.imitated(session, hidden):
                    continue
                snrs = {name: design.snr(session, part) for name, part in parts.items()}
                return session, hidden, self.record(cell, session, hidden, snrs)
        return session, {}, {}

    def part(self, cell: Cell, name: str, session: Session, rng) -> tuple[Callable[[float], causes.Direction], float]:
        """What a cause of some size does to the numbers of the bench, and the largest size."""
        turned = session.turned or ("polarizer",)
        if cell.kind == "unknown":
            draw, most, _ = causes.UNKNOWN[name]
            return partial(causes.at, draw(rng, turned)), most
        own = causes.CAUSES[name]
        direction = own.draw(rng, turned)
        if cell.law == "other" and own.other is not None:
            return partial(own.other, direction), own.most
        return partial(causes.at, direction), own.most

    @staticmethod
    def imitated(session: Session, hidden) -> bool:
        """Whether one cause of the library leaves less than LIKE of what is hidden: then these are readings of that
        cause, and no test of an unknown one."""
        whole = design.fit(session, hidden)
        return any(gap < LIKE * whole for gap in design.gaps(session, hidden, ()).values())

    def finished(self, part: causes.Direction, session: Session, rng) -> causes.Direction:
        return part

    def record(self, cell: Cell, session: Session, hidden, snrs: dict[str, float]) -> dict:
        found = {
            "session": session.note,
            "readings": session.count,
            "snr": snrs,
            "snr_all": design.snr(session, hidden) if hidden else 0.0,
            "dial_sd": math.hypot(session.dial_sd, session.encoder / math.sqrt(12)),
            "dials_said": session.dials_said,
            "wander_to_noise": session.wander
            * float(session.mean({}).mean())
            / max(float(np.sqrt(np.mean(session.sd({}) ** 2))), 1e-9),
            "misread": session.misread is not None,
            "absent": list(session.absent),
            "exclude": list(session.exclude),
            "numbers": dict(hidden),
        }
        if self.frame_by_frame and "gain drift" not in cell.hidden and session.lamp_seen() > SURE:
            found["besides"] = ["gain drift"]
        found["same"] = {name: list(same) for name in cell.hidden if (same := _same(cell, name))}
        if cell.kind == "library":
            gaps = design.gaps(session, hidden, cell.hidden)
            if "coloured leak" in cell.hidden:  # a freedom of colour is no evidence against what has none
                grey = {name: value for name, value in hidden.items() if not name.endswith("_slope")}
                plain = design.gaps(session, grey, (*cell.hidden, "extinction leak"))
                gaps = {c: min(gap, plain.get(c, math.inf)) for c, gap in gaps.items()}
            nearest = sorted(gaps, key=lambda c: gaps[c])[:4]
            found["gaps"] = {c: gaps[c] for c in nearest}
            found["correct"] = design.correct(min(gaps.values(), default=math.inf))
            found["twins"] = [
                c for c in gaps if gaps[c] < design.TWIN * found["snr_all"] ** 2 * session.count * len(session.bands)
            ]
        if cell.kind == "pair":
            found["alone"] = {name: design.fit(session, hidden, [name]) for name in cell.hidden}
        return found

    # -- what the proof asks of a rig ---------------------------------------------------------------------------------
    def make(self, path: Path, cell: Cell) -> dict[str, float]:
        session, hidden, facts = self.plan(cell)
        if cell.hidden and not hidden:
            return {}
        rng = np.random.default_rng([zlib.crc32(cell.name.encode()), 1])
        self.write(path, session, session.take(hidden, rng))
        return facts["snr"]

    write = staticmethod(folder.write)

    def says_the_same(self, cell: Cell) -> tuple[str, ...]:
        return tuple(name for hidden in cell.hidden for name in _same(cell, hidden))

    def facts(self, cell: Cell) -> dict:
        return self.plan(cell)[2]

    def setup(self, path: Path, seed: int) -> loop.Setup:
        session = next(iter(self._made.values()))[0]
        if self.usual:
            return loop.Setup(captures=str(path), per_group=[], seed=seed)
        free = [f"source.power_{c}" for c in "rgb"] if len(session.bands) > 1 else ["source.power"]
        free += [f"{name.removesuffix('_zero')}.offset" for name in session.free if name.endswith("_zero")]
        return loop.Setup(captures=str(path), free=free, per_group=[], seed=seed)

    def parameters(self, effect: str):
        return None


def _same(cell: Cell, hidden: str) -> Mapping[str, str]:
    """Names that say the same as a hidden cause, and why."""
    return {**SAME.get(hidden, {}), **(SAME_BY_OTHER_LAW.get(hidden, {}) if cell.law == "other" else {})}


def _known(names) -> tuple[str, ...]:
    return tuple(name for name in names if causes.CAUSES[name].other)


def _odd(*names: str) -> dict[str, tuple[str, ...]]:
    """Kinds that no library has, with the coordinates that a curve of each runs along."""
    return {name: causes.UNKNOWN[name][2] for name in names}


class Student(Laboratory):
    """Films on hand-turned mounts with scales, a photodiode or a lux meter: 19 to 75 readings."""

    name = "student"
    draw = staticmethod(student.session)
    effects = (
        "polarizer misalignment",
        "servo scale",
        "servo backlash",
        "analyzer wobble",
        "eccentric dial",
        "extinction leak",
        "depolarization",
        "retardance",
        "polarized source",
        "polarized detector",
        "source drift",
        "camera gamma",
        "residual response curve",
        "dark offset",
        "stray light",
    )
    others = _known(effects)
    unknown = _odd("striped film", "eccentric pinion", "fatigue", "range step", "lamp step")


class Motor(Student):
    """A film on a motor with an encoder: hundreds of readings, several at each place."""

    name = "motor"
    draw = staticmethod(motor.session)
    unknown = _odd("striped film", "eccentric pinion", "range step", "lamp step")


class Polarimeter(Laboratory):
    """A plate turned between films, in one band or three."""

    name = "polarimeter"
    draw = staticmethod(polarimeter.session)

    def finished(self, part: causes.Direction, session: Session, rng) -> causes.Direction:
        """A plate of a higher order, one time in three: whole waves more at 540 nm along the same axis."""
        retardance = math.hypot(part.get("plate_0", 0.0), part.get("plate_45", 0.0))
        if not retardance or session.base or rng.random() > 1 / 3:
            return part
        longer = 1 + 360.0 * rng.integers(1, 4) / retardance
        return {k: v * longer if k in ("plate_0", "plate_45") else v for k, v in part.items()}

    effects = (
        "polarizer misalignment",
        "servo scale",
        "extinction leak",
        "coloured leak",
        "depolarization",
        "retardance",
        "dichroism",
        "stress birefringence",
        "polarized detector",
        "source drift",
        "camera gamma",
        "dark offset",
        "stray light",
    )
    others = _known(effects)
    unknown = _odd("range step", "lamp step")


class Laser(Polarimeter):
    """A polarimeter by light of one wavelength."""

    name = "laser"
    draw = staticmethod(laser.session)


class Runs(Student):
    """A film turned up and down, in runs that have names, before a lamp that wanders."""

    name = "runs"
    draw = staticmethod(runs.session)


class Phone(Laboratory):
    """A phone's camera through films: the mean of a region in red, green and blue."""

    name = "phone"
    draw = staticmethod(phone.session)
    effects = (
        "polarizer misalignment",
        "servo scale",
        "analyzer wobble",
        "extinction leak",
        "coloured leak",
        "depolarization",
        "retardance",
        "dichroism",
        "polarized source",
        "polarized detector",
        "camera gamma",
        "residual response curve",
        "dark offset",
        "stray light",
        "colour crosstalk",
    )
    others = _known(effects)
    unknown = _odd("striped film", "range step")


class Photographs(Laboratory):
    """A phone's photographs between films, of a sheet beside bare light."""

    name = "photographs"
    draw = staticmethod(photographs.session)
    write = staticmethod(photographs.write)
    effects = (
        "polarizer misalignment",
        "extinction leak",
        "depolarization",
        "retardance",
        "dichroism",
        "polarized detector",
        "camera gamma",
        "residual response curve",
        "dark offset",
        "stray light",
        "lens vignetting",
        "gain drift",
    )
    others = _known(effects)
    unknown = _odd("range step")
    weakest, strongest = 0.05, 5.0  # a set has some ten thousand values
    nulls, pair_cells, frame_by_frame = 2, 2, True


class PolarizationCamera(Laboratory):
    """A camera with analysers on its pixels before a panel of four unknown polarizations, bare and behind a film."""

    name = "polarization_camera"
    draw = staticmethod(mosaic.session)
    write = staticmethod(mosaic.write)
    effects = (
        "site gain",
        "site extinction",
        "site misalignment",
        "film misalignment",
        "film leak",
        "camera gamma",
        "dark offset",
        "stray light",
        "gain drift",
    )
    others = _known(effects)
    unknown = _odd("range step")
    weakest, strongest = 0.05, 5.0  # a set has some thousand values
    nulls, pair_cells, frame_by_frame, usual = 2, 2, True, True
