"""The command: make proof. Cells in processes of their own, records taken up again."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from optics.proof import blind, kept
from optics.proof import cells as plan

QUICK = {"polarizer_bench": 1}


def main(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="DIR", help="Folder of records, table and page; a run is resumed from there."
        ),
    ] = Path("renders/proof"),
    rig: Annotated[list[str] | None, typer.Option(help="Only this sensor or bench; may be repeated.")] = None,
    rounds: Annotated[int, typer.Option(help="Rounds of the plan, some thirty cells each.")] = 40,
    kind: Annotated[
        list[str] | None, typer.Option(help="Only cells of this kind: library, none, pair, unknown, mistake.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one per core.")] = 0,
    minutes: Annotated[float, typer.Option(help="Start no cell after this many minutes; 0: no limit.")] = 0.0,
    quick: Annotated[bool, typer.Option("--quick", help="One round of the fastest bench, in a minute.")] = False,
    count_only: Annotated[bool, typer.Option("--count", help="Run nothing; count the records that exist.")] = False,
    cells: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Finished cells, a file per sensor: they are counted, and not run again."),
    ] = kept.FOLDER,
    keep: Annotated[bool, typer.Option("--keep", help="Put the cells of this run into these files.")] = False,
    afresh: Annotated[bool, typer.Option("--afresh", help="Count none of these files' cells, and run them.")] = False,
) -> None:
    """Hide effects in captures that an independent renderer makes, run the loop blind on each, and count its
    verdicts."""
    from optics.proof import count, page
    from optics.proof.rigs import RIGS

    names = list(QUICK) if quick else rig or list(RIGS)
    if unknown := set(names) - set(RIGS):
        raise typer.BadParameter(
            f"no rig {', '.join(sorted(unknown))}; there are {', '.join(RIGS)}", param_hint="--rig"
        )
    folder = output / "records"
    folder.mkdir(parents=True, exist_ok=True)
    wanted = []
    for name in names:
        batches = list(plan.rounds(RIGS[name](), QUICK[name] if quick else rounds))
        wanted.append([[c for c in batch if not kind or c.kind in kind] for batch in batches])
    # round by round over all rigs, so that what is done when time is up is balanced
    tasks = [(name, batch) for turn in zip(*wanted) for name, batch in zip(names, turn)]
    known = {} if afresh else kept.read(cells)

    def left(batch):
        return [c for c in batch if c.name not in known and blind.take_up(folder / f"{c.name}.json") is None]

    todo = [(name, rest) for name, batch in tasks if (rest := left(batch))]
    if not count_only:
        _run(todo, folder, jobs or os.cpu_count() or 1, minutes)
    made = {c.name: r for _, batch in tasks for c in batch if (r := blind.take_up(folder / f"{c.name}.json"))}
    if keep:
        kept.add(cells, made)
    of_plan = [c.name for _, batch in tasks for c in batch]
    if quick:
        known = {name: known[name] for name in of_plan if name in known}
    records = counted(of_plan, {**known, **made}, names, kind)
    planned = max(len(of_plan), len(records))
    if not records:
        raise typer.BadParameter(
            f"{folder} holds no record of this plan, nor does {cells}; run without --count", param_hint="--count"
        )
    found = count.count(records, planned)
    print(found.text())
    print(f"page: {page.write(found, records, output / 'proof.html')}")


def counted(
    planned: Sequence[str], records: Mapping[str, dict], rigs: Sequence[str], kinds: Sequence[str] | None
) -> list[dict]:
    """The records {name of a cell: record} of a plan, then those of these rigs and kinds beyond its rounds."""
    cells = {name: record["cell"] for name, record in records.items()}
    beyond = sorted(name for name, c in cells.items() if c["rig"] in rigs and (not kinds or c["kind"] in kinds))
    return [records[name] for name in dict.fromkeys([*planned, *beyond]) if name in records]


def _run(todo, folder: Path, jobs: int, minutes: float) -> None:
    total = sum(len(batch) for _, batch in todo)
    if not total:
        return
    until = time.time() + 60 * minutes if minutes else float("inf")
    with Progress(
        TextColumn("cells"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        disable=not sys.stdout.isatty(),
    ) as bar:
        shown = bar.add_task("", total=total)
        if jobs == 1:
            for name, batch in todo:
                for file in _batch(name, batch, folder, until):
                    bar.update(shown, advance=1, description=file)
            return
        # a process per worker, each with one thread: cells are small
        os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
        with multiprocessing.get_context("spawn").Pool(jobs, initializer=_worker, maxtasksperchild=4) as pool:
            tasks = [(name, batch, folder, until) for name, batch in todo]
            for done in pool.imap_unordered(_whole, tasks):
                bar.update(shown, advance=len(done), description=done[-1] if done else "")


def _worker() -> None:
    import drjit as dr

    dr.set_thread_count(1)


def _whole(task) -> list[str]:
    return list(_batch(*task))


def _batch(name: str, batch, folder: Path, until: float):
    """Cells of one round, whose images share their geometry."""
    from optics.proof.rigs import RIGS

    rig = _RIGS.setdefault(name, RIGS[name]())
    for cell in batch:
        if time.time() > until:
            return
        blind.keep(folder / f"{cell.name}.json", blind.run(rig, cell))
        yield cell.name


_RIGS: dict = {}
