"""The command line. Each command reads its arguments, calls one verb of the library and shows the result.

Results go to stdout (`--json` for programs); progress and remarks to stderr, progress only on a terminal. Exit codes: 0
done, 1 done with a negative finding, 2 an error of the input, reported in one line. Heavy imports stand inside the
commands, so that `optics --help` answers at once. Commands are listed in the order of these imports."""

from optics.cli import scenes  # isort: skip
from optics.cli import images  # isort: skip
from optics.cli import polarized  # isort: skip
from optics.cli import captures  # isort: skip
from optics.cli import studies  # isort: skip
from optics.cli import machine  # isort: skip
from optics.cli.shared import app, main, terminal

__all__ = ["app", "captures", "images", "machine", "main", "polarized", "scenes", "studies", "terminal"]
