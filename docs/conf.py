"""The documentation as a site: ``sphinx-build -W docs out/docs``."""

import re
from importlib.metadata import version as installed

project, author, copyright = "geomtact", "geomtact contributors", "geomtact contributors"
version = release = installed("geomtact")
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "geomtact"
autodoc_typehints = "none"  # docstrings state shape, frame and unit, which a type does not
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
suppress_warnings = ["myst.header"]


def setup(app):
    """Docstrings give "name : what it is, over as many lines as it takes"; numpydoc would take the first line for a type."""
    app.connect("autodoc-process-docstring", _described, priority=0)


def _described(app, what, name, obj, options, lines):
    split = [re.fullmatch(r"(\w[\w, ]*) : (.+)", line) for line in lines]
    lines[:] = [
        part
        for line, named in zip(lines, split, strict=True)
        for part in ([named[1], f"    {named[2]}"] if named else [line])
    ]
