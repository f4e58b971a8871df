"""Pages in HTML that need nothing else: a template, a script and data beside each other."""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Mapping
from string import Template
from typing import Any

from epigauge.io import writing
from epigauge.io._common import PathLike


def save_page(path: PathLike, name: str, parts: Mapping[str, str], data: Any = None) -> None:
    """Write a page: the template ``name.html``, with the script ``name.js`` where it has data.

    Parameters
    ----------
    path : str or path
        The file.
    name : str
        Name of template and script in this package.
    parts : mapping of str
        What to put in the places ``$part`` of the template, escaped where it has to be.
    data : object, optional
        For the script, as JSON: the place ``$data``.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    own = {"style": _part("page.css")}
    if data is not None:
        # Nothing in a script element is unescaped but its end.
        text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        own |= {"data": text, "script": _part(f"{name}.js")}
    page = Template(_part(f"{name}.html"))
    with writing(path) as file:
        file.write(page.substitute(own | dict(parts)).encode())


def _part(name: str) -> str:
    return (importlib.resources.files(__package__) / name).read_text(encoding="utf-8")
