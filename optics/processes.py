"""Processes of this machine that work for this one: how many, and how they begin and end."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

# Libraries of arrays use one thread, and no module is taken from the folder in which the command was given, where
# captures may lie (from Python 3.11 on; 3.10 has no such switch, and its local workers look there first).
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}


_library = ctypes.CDLL(None)  # what this process is linked with, the C library among it


def cores() -> int:
    """The processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory() -> float:
    """Bytes of memory that nothing uses, files in its cache not counted; infinite where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            found = {name: size for name, size, *_ in (line.replace(":", " ").split() for line in lines)}
        return 1024.0 * int(found["MemAvailable"])
    except (OSError, KeyError, ValueError):
        return float("inf")


def return_memory() -> None:
    """Give the system back what this process has released: the C library of Linux keeps pages between what is in use,
    a gigabyte after arrays of many sizes have come and gone."""
    trim = getattr(_library, "malloc_trim", None)
    if trim is not None:
        trim(0)


@contextmanager
def for_workers() -> Iterator[None]:
    """Processes that are started within have ENVIRONMENT; what the user set stays."""
    added = {name: value for name, value in ENVIRONMENT.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextmanager
def without_ctrl_c() -> Iterator[None]:
    """Processes that are started within ignore Ctrl-C from their first moment on, in which Python would answer it with
    a traceback: whoever started them ends them. In the main thread; elsewhere nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)


def tied(reader: Connection) -> None:
    """End this process as soon as the one that started it closes the other end of the pipe, or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the one that started it decides

    def wait() -> None:
        reader.poll(None)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
