"""Sphinx configuration of the site: the Markdown files of the checkout, and reference pages from the code.

`uv run --group docs sphinx-build -W -c docs . site` builds the site; -W makes broken
links errors. The site loads no external resources: the theme uses system fonts, and
formulas are MathML in a font that is part of the site (OFL).
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "docs/_ext"), str(ROOT)]

from srs_twin import __version__  # noqa: E402
from srs_twin.comparison.metrics import VALIDATION  # noqa: E402

project = "srs_twin"
release = __version__
copyright = "the srs_twin authors"  # noqa: A001

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "generated",
    "docstrings",
    "sphinx_copybutton",
]

# The root of the checkout is the root of the site, so that relative links between
# Markdown files also work on a forge and in an editor.
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "*.md",
    "models/README.md",
    "calibration/README.md",
    "examples/README.md",
    "examples/firmware/README.md",
]
# Folders that Sphinx does not search; links to their files still work.
exclude_patterns = [
    ".*",
    "runs",
    "dist",
    "build",
    "site",
    "srs_twin",
    "tests",
    "benchmarks",
    "tools",
]
templates_path = ["_templates"]

# Keep quotes and dashes, because readers copy commands from pages.
smartquotes = False
myst_enable_extensions = ["dollarmath", "attrs_inline", "html_image"]
myst_dmath_double_inline = True
myst_heading_anchors = 4

default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
autoclass_content = "both"
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = "srs_twin"
html_additional_pages = {"index": "home.html"}
html_context = {"validated": VALIDATION}  # in the footer of each page
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_last_updated_fmt = None
html_theme_options = {"footer_icons": []}
