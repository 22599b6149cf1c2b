"""The command line. Each command reads its arguments, calls one verb of the library and shows the result.

Results go to stdout (`--json` for programs); progress and remarks to stderr, progress only on a terminal. Exit codes: 0
done, 1 done with a negative finding, 2 an error of the input, reported in one line. Heavy imports stand inside the
commands, so that `optics --help` answers at once. Commands are listed in the order of these imports."""

import os
import signal
import threading
from types import FrameType


def _leave(number: int, frame: FrameType | None) -> None:
    """Ctrl-C while commands are still being imported: nothing has begun."""
    os.write(2, b"interrupted\n")
    os._exit(128 + number)


# in the process of a command; in one that it starts, Ctrl-C is ignored, as behind nohup
_first = (
    threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
)
_before = signal.signal(signal.SIGINT, _leave) if _first else None

from optics.cli import scenes  # noqa: E402  # isort: skip
from optics.cli import images  # noqa: E402  # isort: skip
from optics.cli import polarized  # noqa: E402  # isort: skip
from optics.cli import readers  # noqa: E402  # isort: skip
from optics.cli import forces  # noqa: E402  # isort: skip
from optics.cli import captures  # noqa: E402  # isort: skip
from optics.cli import studies  # noqa: E402  # isort: skip
from optics.cli import machine  # noqa: E402  # isort: skip
from optics.cli.shared import app, main, terminal  # noqa: E402

if _first:
    signal.signal(signal.SIGINT, _before)

__all__ = [
    "app",
    "captures",
    "forces",
    "images",
    "machine",
    "main",
    "polarized",
    "readers",
    "scenes",
    "studies",
    "terminal",
]
