"""How the documentation is built: `make docs`, or `sphinx-build -W docs build/docs`.

Everything that a page needs stands beside it: the theme uses the system's fonts, the search index is a file, formulas
are MathML. Pages of parts, effects and commands are written from the program before the build starts."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "tools")]

import command_pages  # noqa: E402
import docstrings  # noqa: E402
import front_door  # noqa: E402
import mathml  # noqa: E402
import plugin_pages  # noqa: E402

from optics import __version__  # noqa: E402

project = "tactile-optics"
author = "the tactile-optics authors"
copyright = author
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["tools", "_static", "fingerprints", "images", "generated/front_door.rst"]
smartquotes = False  # "--set" is an option
nitpicky = False  # signatures name types of numpy and Mitsuba, which have no pages here

html_theme = "furo"
html_title = "tactile-optics"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
maximum_signature_line_length = 80


def setup(app):
    mathml.setup(app)
    docstrings.setup(app)
    plugin_pages.write_pages(HERE / "generated")
    command_pages.write_page(HERE / "generated" / "commands.md")
    front_door.write_page(HERE / "generated" / "front_door.rst")
    return {"parallel_read_safe": True}
