"""`python -m optics.cli`: the command line without the installed script."""

import sys

from optics.cli import main

sys.exit(main())
