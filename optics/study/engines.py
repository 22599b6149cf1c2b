"""Where the workers of a batch run: on this machine, on a Slurm cluster through submitit, or on Ray.

An engine starts workers, queues them and ends them. What a worker does is the same on each (`optics.study.batch.Life`):
it claims blocks of samples in the batch's folder (optics.study.blocks), makes up to a number of samples on one thread,
and ends, so that its memory goes back to the system; another one takes its place. A worker that dies costs the sample
that it was at. `work_through` starts workers until every sample is recorded or was begun too often."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

from optics.errors import UnknownKey
from optics.processes import ENVIRONMENT, cores, tied
from optics.study.blocks import TRIES, Blocks, DiskFull

GLANCE = 0.2  # seconds between two looks at the folder; ten times that on a cluster, whose file server others use too
Lives = Sequence[Callable[[], int]]


class EngineFailed(RuntimeError):
    """Workers that cannot be started, or that die before they begin a sample."""


class Work(Protocol):
    """A worker that was started: what concurrent.futures, submitit and Ray have in common."""

    def done(self) -> bool: ...
    def exception(self) -> BaseException | None: ...


class Engine(Protocol):
    """glance   seconds between two looks at the folder"""

    name: str
    workers: int
    glance: float

    def start(self, lives: Lives) -> Sequence[Work]: ...
    def stop(self) -> None:
        """End every worker that was started; what they recorded stands."""


# -- this machine ----------------------------------------------------------------------------------------------------
class Local:
    """Processes of this machine. Each life has a fresh one, which ends when this process ends, however it does."""

    name, glance = "local", GLANCE

    def __init__(self, workers: int | None, options: Mapping[str, str], folder: Path):
        if options:
            raise UnknownKey(next(iter(options)), (), "option of the engine 'local'", "--engine", "(it has none)")
        self.workers = workers or cores()
        self.context = get_context("spawn")
        self.reader, self.writer = self.context.Pipe(duplex=False)  # nothing is sent: its end is the message
        self.threads = ThreadPoolExecutor(self.workers)
        self.ready: list[ProcessPoolExecutor] = []  # processes that wait for their first life

    def warm(self, count: int, begin: Callable[..., None], *given: Any) -> None:
        """Start the processes of the first workers, up to `count`, and have them run `begin`: they load the program
        while the caller checks the job, and not after it."""
        self.ready = [self._process() for _ in range(min(self.workers, count))]
        for process in self.ready:
            process.submit(begin, *given)

    def _process(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self.context, initializer=tied, initargs=(self.reader,))

    def start(self, lives: Lives) -> list[Future]:
        return [self.threads.submit(self._live, life) for life in lives]

    def _live(self, life: Callable[[], int]) -> int:
        try:
            own = self.ready.pop()
        except IndexError:
            own = self._process()
        with own as process:
            return process.submit(life).result()

    def stop(self) -> None:
        self.writer.close()
        self.threads.shutdown(cancel_futures=True)
        for process in self.ready:
            process.shutdown(cancel_futures=True)
        self.reader.close()


# -- Slurm -----------------------------------------------------------------------------------------------------------
class Slurm:
    """Array tasks of a Slurm cluster, through submitit. The folder must lie on a file system that all nodes share.

    Slurm restarts a task whose node fails or is taken away; submitit submits a task again that ran out of time. A
    command that ends, by Ctrl-C as well, cancels its tasks, running or queued. One that is killed cannot: its tasks go
    on, record what they make, and share the rest with the next command.
    """

    name, glance = "slurm", 10 * GLANCE

    def __init__(self, workers: int | None, options: Mapping[str, str], folder: Path):
        submitit = library("submitit", "--on slurm", "slurm")
        self.workers = workers or 16
        try:
            self.executor = submitit.AutoExecutor(folder / ".parts" / "slurm", cluster=options.get("cluster", "slurm"))
            self.executor.update_parameters(
                name=folder.name,
                cpus_per_task=1,
                slurm_array_parallelism=self.workers,
                slurm_setup=[*(f"export {name}={value}" for name, value in ENVIRONMENT.items()), f"cd {os.sep}"],
                **_typed({key: value for key, value in options.items() if key != "cluster"}),
            )
        except (RuntimeError, ValueError, NameError, TypeError, AssertionError) as error:
            said = " ".join(str(error).split()).rstrip(".")
            raise ValueError(f"--on slurm: {said}; allowed: parameters of submitit.AutoExecutor") from error
        self.jobs: list[Any] = []

    def start(self, lives: Lives) -> list[Any]:
        try:
            with self.executor.batch():
                jobs = [self.executor.submit(life) for life in lives]
        except Exception as error:  # submitit's own, with what sbatch said
            raise EngineFailed(f"Slurm took no job: {error}") from error
        self.jobs += jobs
        return jobs

    def stop(self) -> None:
        for job in self.jobs:
            if not job.done():
                job.cancel(check=False)


# -- Ray -------------------------------------------------------------------------------------------------------------
class Ray:
    """Tasks of a Ray cluster, or of one that is started in this process. All nodes must share the folder.

    A task has a fresh process (max_calls), and Ray runs it again where its worker or node dies (max_retries).
    """

    name, glance = "ray", GLANCE

    def __init__(self, workers: int | None, options: Mapping[str, str], folder: Path):
        self.ray = library("ray", "--on ray", "ray")
        self.started = not self.ray.is_initialized()
        if self.started:
            given = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error", **_typed(options)}
            if "address" not in given and "RAY_ADDRESS" not in os.environ:
                given.setdefault("num_cpus", workers or cores())
            try:
                with _at_the_root():  # Ray's workers look for modules in the folder from which it was begun
                    self.ray.init(runtime_env={"env_vars": ENVIRONMENT}, **given)
            except (RuntimeError, ValueError, TypeError, ConnectionError) as error:
                raise ValueError(f"--on ray: {error}; allowed: parameters of ray.init") from error
        elif options:
            raise ValueError(f"--engine {next(iter(options))}: Ray is running already; allowed: no options")
        self.workers = workers or int(self.ray.cluster_resources().get("CPU", 1))
        self.references: list[Any] = []
        self.share = 1.0 if self.started else max(1.0, self.ray.cluster_resources().get("CPU", 1) / self.workers)

    def start(self, lives: Lives) -> list[Future]:
        task = self.ray.remote(num_cpus=self.share, max_calls=1, max_retries=TRIES)(_call)
        references = [task.remote(life) for life in lives]
        self.references += references
        return [reference.future() for reference in references]

    def stop(self) -> None:
        for reference in self.references:
            self.ray.cancel(reference, force=True)
        if self.started:
            self.ray.shutdown()


def _call(life: Callable[[], int]) -> int:
    return life()


@contextmanager
def _at_the_root() -> Iterator[None]:
    """The root is the current folder within; nobody who sends data writes there."""
    here = os.getcwd()
    os.chdir(os.sep)
    try:
        yield
    finally:
        os.chdir(here)


ENGINES: dict[str, Callable[[int | None, Mapping[str, str], Path], Engine]] = {
    "local": Local,
    "slurm": Slurm,
    "ray": Ray,
}


def library(module: str, option: str, extra: str) -> Any:
    """A package that only this option needs. Raises ModuleNotFoundError, which says how to get it."""
    if find_spec(module.partition(".")[0]) is None:
        raise ModuleNotFoundError(
            f"{option} needs the package '{module}', which is not installed: pip install 'tactile-optics[{extra}]'"
        )
    return import_module(module)


def _typed(options: Mapping[str, str]) -> dict[str, Any]:
    """Texts as numbers and truth values, where they are such."""

    def value(text: str) -> Any:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        for kind in (int, float):
            try:
                return kind(text)
            except ValueError:
                continue
        return text

    return {key: value(text) for key, text in options.items()}


# -- the work --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Status:
    """What a run has come to: samples recorded of the shard's total, made in this run, given up, workers that died or
    ended in an error, workers at work, seconds since the start."""

    done: int
    total: int
    made: int
    given_up: int
    died: int
    workers: int
    seconds: float

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.made / self.seconds if self.seconds > 0 else 0.0

    @property
    def left(self) -> float | None:
        """Seconds to the end; None before the first sample."""
        return (self.total - self.done) / self.rate if self.rate > 0 else None


def work_through(
    engine: Engine, life: Any, blocks: Blocks, recycle: int, watch: Callable[[Status], None] | None = None
) -> None:
    """Start workers until every sample of the shard is recorded, was begun too often, or is in another command's hands.

    life      a dataclass that an engine calls, with the fields `place` and `limit` (optics.study.batch.Life)
    recycle   samples that one worker makes at most

    Raises EngineFailed where workers die before they begin a sample, and DiskFull at once.
    """
    begin, before = time.monotonic(), blocks.counts().recorded
    died = 0
    try:
        while True:
            counts = blocks.counts()
            left = blocks.own - counts.recorded - counts.given_up
            if left <= 0:
                return
            # A few more than the samples ask for, for those that die; one without work ends at once.
            lives = max(-(-left // recycle), min(engine.workers, left)) + (engine.workers if left > recycle else 0)
            workers = engine.start([replace(life, place=(k, lives), limit=recycle) for k in range(lives)])
            failures: list[BaseException] = []
            while True:
                ended = [w for w in workers if w.done()]
                errors = [error for error in map(_error, ended) if error is not None]
                now = blocks.counts()
                if watch:
                    watch(
                        Status(
                            now.recorded,
                            blocks.own,
                            now.recorded - before,
                            now.given_up,
                            died + len(errors),
                            min(engine.workers, len(workers) - len(ended)),
                            time.monotonic() - begin,
                        )
                    )
                full = next((e for e in errors if isinstance(e, DiskFull)), None)
                if full is not None:
                    raise full
                failures = errors
                barren = now.tries == counts.tries and now.recorded == counts.recorded
                if barren and len(errors) >= min(len(workers), engine.workers + TRIES):
                    raise EngineFailed(f"{len(errors)} workers died before they began a sample: {errors[0]}")
                if len(ended) == len(workers) or blocks.complete() >= set(blocks.numbers):
                    break
                time.sleep(engine.glance)
            died += len(failures)
            if barren and not failures:
                return  # what is left is in the hands of another command's workers
    finally:
        engine.stop()


def _error(worker: Work) -> BaseException | None:
    try:
        return worker.exception()
    except Exception as error:  # submitit raises what it cannot read
        return error
