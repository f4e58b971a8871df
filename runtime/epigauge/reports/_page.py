"""Pages in HTML that need nothing else: a template, a script and data beside each other."""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Mapping
from string import Template
from typing import Any

from epigauge.io import writing
from epigauge.io._common import PathLike


def save_page(path: PathLike, name: str, parts: Mapping[str, str], data: Any) -> None:
    """Write a page: the template ``name.html`` with the script ``name.js`` and data in it.

    Parameters
    ----------
    path : str or path
        The file.
    name : str
        Name of template and script in this package.
    parts : mapping of str
        What to put in the places ``$part`` of the template, escaped where it has to be.
    data : object
        For the script, as JSON: the place ``$data``.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    # Nothing in a script element is unescaped but its end.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    here = importlib.resources.files(__package__)
    page, script = ((here / f"{name}{end}").read_text(encoding="utf-8") for end in (".html", ".js"))
    with writing(path) as file:
        file.write(Template(page).substitute(parts, data=text, script=script).encode())
