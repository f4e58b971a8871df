"""Configuration of the documentation: ``make docs``, or ``tox -e docs``. Warnings are errors."""

import importlib
import inspect
import pkgutil
import sys
from pathlib import Path

import epigauge

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "epigauge"
author = "The epigauge authors"
copyright = author  # noqa: A001
version = release = epigauge.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
    "sphinx_design",
    "anchors",
    "cameras",
    "formulas",
    "listings",
    "names",
]
exclude_patterns = ["_build"]
# A name in backticks is a link where it is the name of something documented.
default_role = "py:name"

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
smartquotes = False  # -- and " are often code

autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say it in words
numpydoc_show_class_members = False
numpydoc_use_plots = False
# What every public docstring must hold; the names are those of numpydoc.validation.
numpydoc_validation_checks = {
    *("GL03", "GL06", "GL07", "GL08"),
    *("SS02", "SS04", "SS05"),
    *("PR01", "PR02", "PR03", "PR04", "PR05", "PR06", "PR07", "PR10"),
    *("RT01", "RT03", "YD01"),
}


def _classes_of_results():
    """Yield patterns of classes whose fields are listed as attributes: nobody calls them."""
    for module in pkgutil.walk_packages(epigauge.__path__, "epigauge."):
        if not module.name.startswith(("epigauge.cli", "epigauge.__main__")):
            for name, found in inspect.getmembers(importlib.import_module(module.name)):
                if inspect.isclass(found) and "\n    Attributes\n" in (found.__doc__ or ""):
                    yield rf"\.{name}$"


numpydoc_validation_exclude = {
    *_classes_of_results(),
    r"\.Gauge$",
    r"\.ImageMatches$",
    r"\.NoTracks$",
}

html_theme = "pydata_sphinx_theme"
html_title = f"epigauge {release}"
html_static_path = ["_static"]
html_css_files = ["epigauge.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "navigation_with_keys": False,
    "show_prev_next": False,
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["sphinx-version"],
}
# No empty column where a section has no pages below it.
html_sidebars = {
    page: []
    for page in (
        *("index", "quickstart", "gallery", "results", "interoperability", "casadi", "data"),
        *("contributing", "changelog"),
    )
}
