"""The many-view half of ``epigauge demo``: Bartoli's simulated scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

import epigauge as eg
from epigauge._options import Method
from epigauge.cli._common import shown
from epigauge.cli.compare import exit_code, print_table

_FLATNESS = 0.1
_METHODS: tuple[Method, ...] = (
    "free",
    "levenberg",
    "hartley",
    "bartoli",
    "mclauchlan",
    "covariant",
)
_PICTURE = "epigauge-demo-many.png"


def compare_many_views(out: Console | None, directory: Path | None) -> tuple[int, dict[str, Any]]:
    """Compare some methods on five views of 100 points.

    Parameters
    ----------
    out : Console or None
        Where to show the table, if anywhere.
    directory : Path or None
        Where to put the picture, if anywhere.

    Returns
    -------
    code : int
        Exit code.
    found : dict
        Plain data; ``picture`` is its path or None.
    """
    scene = eg.multi_view_scene(_FLATNESS)
    comparison = eg.compare(scene.tracks, _METHODS)
    tracks = scene.tracks
    title = f"{tracks.n_views} views of {tracks.n_points} points {_FLATNESS:g} m off a plane"
    if out is not None:
        print_table(out, comparison, title)
    picture = None
    if directory is not None:
        from epigauge.plots import save_figure

        picture = directory / _PICTURE
        save_figure(comparison.plot(title), picture)
        if out is not None:
            out.print(f"picture: {escape(shown(picture))}", soft_wrap=True)
    found = {"flatness": _FLATNESS, "rows": comparison.rows, "picture": picture and str(picture)}
    return exit_code(comparison), found
