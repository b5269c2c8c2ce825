"""Sphinx: docs/ as a site. ``python -m sphinx -W docs site``; what the code says itself is written by
``writers/`` first."""

import gc
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from docs.writers import write_reference
from uuvtai import __version__

project = "uuvtai"
copyright = "the uuvtai authors, MIT license"
release = __version__
gc.set_threshold(50_000, 50, 1000)  # a site is millions of nodes, few of them garbage: an eighth of the time
extensions = ["myst_parser", "sphinx.ext.autodoc"]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80
"""longer signatures have a line per parameter"""
myst_heading_anchors = 3
"""links to headings are checked too"""
exclude_patterns = ["writers", "static"]
smartquotes = False
"""an option begins with two hyphens, not with a dash"""
html_theme = "furo"
html_title = f"uuvtai {release}"
html_static_path = ["static"]
html_css_files = ["custom.css"]
html_copy_source = False


def setup(app) -> None:
    """Write the generated pages before Sphinx looks for sources."""
    app.connect("builder-inited", lambda app: write_reference(Path(app.srcdir) / "reference"))
