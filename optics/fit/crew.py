"""`Crew`: further processes that make images of a model, frame by frame.

A fit of images keeps little more than one core busy, as Python records what Dr.Jit then runs. A model that can be
opened again (`SceneModel.recipe`) is opened in further processes once a fit has taken START seconds, and each of
them then makes the images of frames of its own: all frames of a press where there are presses enough, as they share
what was traced. Where there is but one, whole refits are shared instead (`Hands.each`): the frames of a press whose
LEDs are rendered at once take no longer than one of them. The numbers are those of one process, to rounding.

Off until `use_processes` is called, as the command line does: Python starts a process by importing the caller's script
again, and a script must be written for that (`if __name__ == "__main__":`)."""

from __future__ import annotations

import os
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Lock
from typing import TYPE_CHECKING, Any

from optics.processes import cores, for_workers, free_memory, without_ctrl_c

if TYPE_CHECKING:
    from optics.fit.scene_model import SceneModel

START = 10.0  # seconds of images before further processes are worth their own start of about five
MEMORY = 4e9  # bytes that a process may come to need: what a renderer keeps, twice
AHEAD = 2  # frames that may wait until they are asked for, of each process
BUSY = 0.7  # of the cores: one process that keeps so many busy by itself is not worth helping where presses are shared
UNEVEN = 1.25  # of the longest share of presses over the mean, beyond which the frames of a press are shared as well
VARIABLE = "OPTICS_PROCESSES"  # of the environment: how many processes at most

Task = Callable[["SceneModel", int], Any]
Job = Callable[["SceneModel"], Any]

_allowed = 1


def use_processes(count: int | None = None) -> None:
    """Let fits and diagnoses of images make these in up to so many processes, this one among them.

    None: as many as the environment variable OPTICS_PROCESSES says, or else one for each core. A script that calls this
    keeps its work under `if __name__ == "__main__":`, as each process imports it. Raises ValueError."""
    global _allowed
    if count is None:
        given = os.environ.get(VARIABLE, "").strip()
        if given and not (given.isascii() and given.isdecimal() and int(given) > 0):
            raise ValueError(f"{VARIABLE} = {given!r}; allowed: a whole number from 1 on, of processes")
        count = int(given) if given else cores()
    if count < 1:
        raise ValueError(f"count = {count}; allowed: whole numbers from 1 on")
    _allowed = count


def allowed() -> int:
    """How many processes a model may use now, this one among them: what was allowed, and what memory there is for. One
    where a graphics processor makes the images: it is not cores that are short there."""
    import mitsuba as mi

    if (mi.variant() or "").startswith("cuda"):
        return 1
    return min(_allowed, 1 + int(min(free_memory(), 1e15) // MEMORY))


class Gone(RuntimeError):
    """Another process has died, as for lack of memory."""


class Failed(RuntimeError):
    """Another process met an error, which this one will meet as well."""


class Helper:
    """Another process that has opened the model, and a thread that waits for its answers.

    Each end of their pipe is open in one process alone, so that one sees at once when the other is gone, whatever it
    was doing."""

    def __init__(self, recipe: Callable[[], SceneModel], count: int):
        context = get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other, recipe, count), daemon=True)
        self.process.start()
        other.close()
        self.thread = ThreadPoolExecutor(1)
        self.begun = self.thread.submit(self._answer)

    def make(self, task: Task, frame: int, charge: frozenset[int]) -> Future:
        return self.thread.submit(self._ask, task, frame, charge)

    def _ask(self, *job: Any) -> Any:
        try:
            self.pipe.send(job)
        except OSError as error:
            raise Gone from error
        return self._answer()

    def _answer(self) -> Any:
        try:
            made, failed = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise Gone from error
        if failed:
            raise Failed
        return made

    def end(self) -> None:
        self.process.kill()
        self.thread.shutdown(wait=False, cancel_futures=True)


class Crew:
    """The processes that share the frames of a model with this one.

    recipe   opens the model; it is sent to the other processes
    presses  of each frame, the number of its press
    count    of processes, this one among them
    charge   frame -> the process that makes it, 0: this one
    """

    def __init__(self, recipe: Callable[[], SceneModel], presses: Sequence[int], count: int):
        self.presses, self.count = list(presses), count
        self.charge: dict[int, int] = {}
        with for_workers(), without_ctrl_c():
            self.others = [Helper(recipe, count) for _ in range(count - 1)]
        self.end = weakref.finalize(self, _end, self.others)
        self.working = False

    def ready(self, model: SceneModel) -> bool:
        """Whether all processes have opened the model. Raises Gone or Failed where one could not."""
        if not self.working and all(other.begun.done() for other in self.others):
            for other in self.others:
                other.begun.result()
            self.working = True
            self.take_part(model)
        return self.working

    def take_part(self, model: SceneModel) -> None:
        """Leave to the others their share of cores and memory."""
        _take_part(model, self.count)

    def share(self, frames: Sequence[int]) -> None:
        """Put somebody in charge of frames of which nobody is, so that all have about as many of these frames. A frame
        stays where it is: there is what its images share."""
        load = [sum(self.charge.get(f) == k for f in frames) for k in range(self.count)]
        new = [f for f in frames if f not in self.charge]
        presses: dict[int, list[int]] = {}
        for f in new:
            presses.setdefault(self.presses[f], []).append(f)
        own = sorted(presses.values(), key=len, reverse=True)
        if _uneven(load, own, len(frames)):
            own = [[f] for f in new]
        for together in own:
            k = min(range(self.count), key=load.__getitem__)
            load[k] += len(together)
            self.charge.update(dict.fromkeys(together, k))

    def run(self, model: SceneModel, frames: Sequence[int], task: Task) -> Iterator[Any]:
        """What a task makes of each frame, in their order. Raises Gone."""
        self.take_part(model)
        self.share(frames)
        charges = [frozenset(f for f, own in self.charge.items() if own == k) for k in range(self.count)]
        model.take_charge(charges[0])
        waiting = [deque(f for f in frames if self.charge[f] == k) for k in range(self.count)]
        sent: dict[int, Future] = {}
        made: dict[int, Any] = {}

        def send(k: int) -> None:
            if waiting[k]:
                f = waiting[k].popleft()
                sent[f] = self.others[k - 1].make(task, f, charges[k])

        for k in range(1, self.count):
            for _ in range(AHEAD):
                send(k)
        for f in frames:
            k = self.charge[f]
            while f not in made and waiting[0] and (k == 0 or len(made) < AHEAD and not sent[f].done()):
                own = waiting[0].popleft()
                made[own] = task(model, own)
            if k:
                try:
                    made[f] = sent.pop(f).result()
                except Failed:
                    made[f] = task(model, f)
                send(k)
            yield made.pop(f)

    def each(self, model: SceneModel, jobs: deque[tuple[int, Job]]) -> Iterator[tuple[int, Any]]:
        """(number, what it makes) of each job, as they are done; every process takes the next one that waits. Raises
        Gone, and then puts back what was not done."""
        everything = frozenset(range(len(model.frames)))
        sent: dict[Future, tuple[int, Job]] = {}
        lock, going = Lock(), True  # a job waits, was sent, or is being made here; never in between

        def send(other: Helper, last: Future | None = None) -> None:
            with lock:
                if not (going and jobs) or last is not None and isinstance(last.exception(), Gone):
                    return
                n, job = jobs.popleft()
                made = other.make(partial(_done, job=job), n, everything)
                sent[made] = n, job
            made.add_done_callback(partial(send, other))

        model.take_charge(everything)
        self.take_part(model)
        try:
            for other in self.others:
                send(other)
            while True:
                with lock:
                    own = jobs.popleft() if jobs else None
                    others = list(sent)
                if own is not None:
                    yield own[0], own[1](model)
                elif others:
                    wait(others, return_when=FIRST_COMPLETED)
                else:
                    break
                for made in [made for made in others if made.done()]:
                    n, job = sent[made]
                    try:
                        found = made.result()
                    except Failed:
                        found = job(model)
                    with lock:
                        del sent[made]
                    yield n, found
        finally:
            with lock:
                going = False
                jobs.extend(sent.values())


def _done(model: SceneModel, number: int, job: Job) -> Any:
    return job(model)


def _uneven(load: Sequence[int], presses: Sequence[Sequence[int]], count: int) -> bool:
    """Whether, of so many frames, somebody would have many more than others if presses, the largest first, went whole
    to whoever has least."""
    found = list(load)
    for own in presses:
        found[found.index(min(found))] += len(own)
    return max(found) > UNEVEN * count / len(found)


def _shared(presses: Sequence[int], frames: Sequence[int], processes: int) -> bool:
    """Whether so many processes would share the frames of a press."""
    sizes = sorted(Counter(presses[f] for f in frames).values(), reverse=True)
    return _uneven([0] * processes, [range(size) for size in sizes], len(frames))


# -- in the other processes ------------------------------------------------------------------------------------------
def _serve(pipe: Connection, recipe: Callable[[], SceneModel], count: int) -> None:
    """Answer (what was made, whether that failed) until nobody asks any more. Not every error can be sent as it is."""
    with suppress(EOFError, OSError):  # the other end is gone
        try:
            model = recipe()
            _take_part(model, count)
        except Exception:
            pipe.send((None, True))
            return
        pipe.send((None, False))
        while True:
            task, frame, charge = pipe.recv()
            made, failed = None, False
            try:
                model.take_charge(charge)
                made = task(model, frame)
            except Exception:
                failed = True
            pipe.send((made, failed))


def _take_part(model: SceneModel, count: int) -> None:
    """Use as many threads, and as much memory, as one of so many processes may."""
    _use_cores(count)
    model.renderer.share_memory(count)


def _use_cores(count: int) -> None:
    import drjit as dr

    threads = max(cores() // count, 1)
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)


def _end(others: Sequence[Helper]) -> None:
    for other in others:
        other.end()


# -- when --------------------------------------------------------------------------------------------------------
class Hands:
    """Who makes the images of a model: this process, and others as soon as that is worth while."""

    def __init__(self) -> None:
        self.spent, self.alone = 0.0, False  # seconds of images so far; whether no other process is to be asked again
        self.worked = 0.0  # seconds of processor time that these took
        self.crew: Crew | None = None

    def work(self, model: SceneModel, frames: Sequence[int], task: Task) -> Iterator[Any]:
        """What a task makes of each frame of a model, in their order."""
        done = 0
        crew = self._crew(model, frames)
        if crew is not None:
            try:
                for made in crew.run(model, frames, task):
                    yield made
                    done += 1
            except Gone:
                self.give_up(model)
        elif self.crew is not None and self.crew.working:  # which has nothing to share
            model.take_charge(frozenset(range(len(model.frames))))
            _use_cores(1)
        for frame in frames[done:]:
            began, before = time.perf_counter(), time.process_time()
            made = task(model, frame)
            self.spent += time.perf_counter() - began
            self.worked += time.process_time() - before
            yield made

    def each(self, model: SceneModel, frames: Sequence[int], jobs: Sequence[Job]) -> Iterator[tuple[int, Any]]:
        """(number, what it makes) of each job, as they are done: in several processes where these would not share the
        frames that jobs ask for. Each makes all images of its jobs by itself."""
        waiting = deque(enumerate(jobs))
        while waiting:
            crew = self._crew_of(model, waiting) if self.shares_jobs(model, frames) else None
            if crew is None:
                n, job = waiting.popleft()
                yield n, job(model)
                continue
            self.crew, self.alone = None, True  # images of this process's jobs are its own
            try:
                yield from crew.each(model, waiting)
            except Gone:
                crew.end()
                _take_part(model, 1)
                continue
            except BaseException:
                self.crew, self.alone = crew, False
                raise
            self.crew, self.alone = crew, False

    def shares_jobs(self, model: SceneModel, frames: Sequence[int]) -> bool:
        """Whether processes share jobs that ask for these frames: where they would have to share a press, which one
        renders as quickly."""
        most = allowed() if self.crew is None else self.crew.count
        if self.alone or most < 2 or not _shares(model) or not model.renderer.at_once:
            return False
        return _shared(model.presses, frames, most)

    def _crew(self, model: SceneModel, frames: Sequence[int]) -> Crew | None:
        """The crew where frames are shared.

        Processes that share the frames of a press each move its geometry: where Dr.Jit keeps the cores busy, they take
        half as long again as one process (six LEDs of one press on two cores)."""
        if not frames:
            return None
        if len(frames) == 1:  # is made where its images are kept
            if self.crew is None or frames[0] not in self.crew.charge:
                return None
        elif self.shares_jobs(model, frames):
            return None
        busy = self.crew is None and self.worked > BUSY * cores() * self.spent
        if busy and _shared(model.presses, frames, min(allowed(), len(frames))):
            return None
        return self._crew_of(model, frames)

    def _crew_of(self, model: SceneModel, parts: Sequence) -> Crew | None:
        """The crew where it is at work; begun where it is time to, and where there are several parts to share."""
        if self.crew is None and len(parts) > 1 and self.spent > START and not self.alone:
            processes, recipe = min(allowed(), len(parts)), model.recipe
            if processes < 2 or recipe is None or not _shares(model):
                return None
            self.crew = Crew(recipe, model.presses, processes)
        try:
            if self.crew is None or not self.crew.ready(model):
                return None
        except (Gone, Failed):
            self.give_up(model)
        return self.crew

    def give_up(self, model: SceneModel) -> None:
        """Go on alone."""
        self.alone = True
        if self.crew is not None:
            self.crew.end()
            self.crew = None
        _take_part(model, 1)
        model.take_charge(frozenset(range(len(model.frames))))


def _shares(model: SceneModel) -> bool:
    """Whether other processes can make a model's images: not readings, which are quick, nor estimates by many rays,
    which keep all cores busy, nor images of bodies that may have been put elsewhere."""
    return model.captures.table is None and not model.monte_carlo and not model.renderer.crowded
