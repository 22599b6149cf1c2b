"""One cell: captures made, the loop run blind on them, and the record of what it said.

The loop sees the captures alone. It is what a user does: calibrate, diagnose; add what a CLAIM names, and
diagnose again, while more than one effect may be hidden."""

from __future__ import annotations

import json
import math
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from optics.diagnosis.result import Diagnosis, Row
from optics.diagnosis.thresholds import CLEAR, close
from optics.files.output import write_text
from optics.fit.compare import plain
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.proof import kept, measures
from optics.proof.cells import Cell
from optics.study import loop

STEPS = 3  # effects that the loop may add where two are hidden, or nobody says how many


def run(rig, cell: Cell) -> dict:
    """The record of a cell: the truth, every diagnosis in short, and the time. Errors that the program means to raise
    are records too."""
    clock, busy = time.perf_counter(), time.process_time()
    record = {
        "cell": cell.json(),
        "truth": {},
        "steps": [],
        "failed": "",
        "unreachable": False,
        "coordinates": list(rig.unknown.get(cell.hidden[0], ())) if cell.kind == "unknown" else [],
        "parts": rig.parts(cell),
        "made": kept.made(),
    }
    if rig.outside:
        record["facts"] = rig.facts(cell)
    with tempfile.TemporaryDirectory() as folder:
        captures, study_folder = Path(folder) / "captures", Path(folder) / "study"
        record["truth"] = rig.make(captures, cell)
        if cell.hidden and not record["truth"]:
            return {**record, "unreachable": True}
        record["making"] = time.perf_counter() - clock
        several = rig.outside or cell.kind == "pair"
        # Readings of a stranger may break the program anywhere: whatever is raised on them is a crash to be counted.
        errors = Exception if rig.outside else (ValueError, KeyError, ArithmeticError, np.linalg.LinAlgError)
        try:
            setup = rig.setup(captures, cell.seed)
            study, model, fit = loop.begin(setup, study_folder)
            for _ in range(STEPS if several else 1):
                diagnosis = loop.examine(study, model, setup, fit, advised=False)
                record["steps"].append(_step(rig, model, cell, fit, diagnosis))
                if not several or diagnosis.word != "CLAIM":
                    break
                name = diagnosis.missing
                record["steps"][-1]["added"] = [name]
                start = diagnosis.fits[name].values if name in diagnosis.fits else None
                fit, _ = loop.extend(study, model, setup, fit, model.scene.registry.find_effect(name), start)
        except errors as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            record["failed"] = f"{type(error).__name__}: {error}"
            record["where"] = f"{Path(last.filename).name}:{last.lineno}"
    record["seconds"], record["cpu"] = time.perf_counter() - clock, time.process_time() - busy
    return plain(record)


def _step(rig, model, cell: Cell, base: Fit, d: Diagnosis) -> dict:
    refitted = sorted((r for r in d.rows if r.refit is not None), key=lambda r: -r.net_refit)
    best = refitted[0].net_refit if refitted else 0.0
    # what frees less and does as well goes first, as in a diagnosis
    first = next(
        (r for r in refitted[1:] if set(r.variables) < set(refitted[0].variables) and best - r.net_refit < CLEAR), None
    )
    refitted.sort(key=lambda r: r is not first)
    return {
        "word": d.word,
        "claimed": d.claimed,
        "ambiguous": d.ambiguous,
        "kinds": d.kinds,
        "sentence": d.sentence,
        "p_best": min((r.p_family for r in d.rows), default=1.0),
        "score": [r.name for r in d.rows[:5]],
        "refit": [r.name for r in refitted[:5]],
        "set": _close(refitted, lambda r: r.net_refit) or _close(d.rows, lambda r: r.net),
        "falls": {r.name: [r.refit.predicted, r.refit.fall] for r in refitted},
        "noise": d.basis.noise,
        "excess_sd": d.basis.excess_sd,
        "phi": d.basis.phi,
        "conditions": {c.name: [c.value, c.holds] for c in d.conditions},
        "failing": [c.name for c in d.conditions if not c.holds],
        "held_out": [level.chi2_held_out for level in d.levels],
        "coordinates": [f.coordinate for f in d.fingerprints[:4]],
        "correct": _correct(d, cell, rig.says_the_same(cell)),
        "strength": _strengths(rig, model, cell, d),
        "bias": measures.bias(rig.known(model.scene, cell.seed), base, measures.first_fit(d, cell)),
        "flagged": measures.flagged(d) if cell.kind == "unknown" else None,
    }


def _correct(d: Diagnosis, cell: Cell, same: Sequence[str]) -> float | None:
    """P(correct) of the hidden effect against the rival that is hardest to tell from it, as printed; None where it was
    not among the refitted."""
    names = [name for name in (*cell.hidden, *same) if name in d.compared]
    if len(cell.hidden) != 1 or not names:
        return None
    own = d.compared.index(names[0])
    return min((p for k, p in enumerate(d.correct[own]) if k != own), default=1.0)


def _close(rows: Sequence[Row], fall: Callable[[Row], float]) -> list[str]:
    """What explains more than chance does and is not told from the best, of effects that were added and refitted; where
    none stands out enough for that, by score."""
    best = max(map(fall, rows), default=0.0)
    return [r.name for r in rows if fall(r) > 0 and close(best, fall(r))]


def _strengths(rig, model, cell: Cell, d: Diagnosis) -> dict[str, list[float]]:
    """{claimed effect, where it is a hidden one: [strength found, from neutral; sd]}."""
    if d.claimed not in cell.hidden or rig.parameters(d.claimed) is None or d.claimed not in d.fits:
        return {}
    weights, neutral = rig.parameters(d.claimed)
    fit = d.fits[d.claimed]
    names = [v.keys[0] for v in fit.variables]
    if set(weights) - set(names):
        return {}
    w = np.array([weights.get(name, 0.0) for name in names])
    value = sum(
        weight * value_of(model, fit.values, fit.variables[names.index(key)]) for key, weight in weights.items()
    )
    own = np.flatnonzero(w)
    variance = max(float(w[own] @ np.asarray(fit.covariance)[np.ix_(own, own)] @ w[own]), 0.0)
    row = d.row(d.claimed)
    if row.refit.clutter:
        key = {v.name: v.keys[0] for v in fit.variables}
        w = np.array([weights.get(key[name], 0.0) for name in row.variables])
        variance += max(float(w @ np.array(row.refit.clutter) @ w), 0.0)
    return {d.claimed: [value - neutral, math.sqrt(variance)]}


def take_up(file: Path) -> dict | None:
    """The record in a file; None where there is none, or it was cut off."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return None


def keep(file: Path, record: dict) -> None:
    """Write a record whole or not at all."""
    write_text(file, json.dumps(_finite(record), indent=1, allow_nan=False))


def _finite(value):
    """JSON knows no infinity."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
