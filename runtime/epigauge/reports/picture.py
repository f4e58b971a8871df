"""A picture as a page, with what the result says in words beside it."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING, Any

from epigauge.io._common import PathLike, check_suffix
from epigauge.plots._style import write_figure
from epigauge.reports._page import save_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["save_picture_page"]


def save_picture_page(path: PathLike, figure: Figure, title: str, result: Any = None) -> None:
    """Write a picture as one HTML file that needs nothing else, with a table of the result.

    Parameters
    ----------
    path : str or path
        The file: ``.html``.
    figure : matplotlib.figure.Figure
        The picture.
    title : str
        Title of the page.
    result : object, optional
        A result of epigauge: its table for notebooks stands below the picture.

    Raises
    ------
    ArgumentError
        If the suffix is another.
    OSError
        If the file cannot be written.
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(seed=1)
    >>> result = eg.refine_fundamental(scene.x1, scene.x2)
    >>> figure = result.plot(scene.x1, scene.x2)  # doctest: +SKIP
    >>> save_picture_page("pair.html", figure, "A pair", result)  # doctest: +SKIP
    """
    check_suffix(path, ".html")
    drawn = io.BytesIO()
    write_figure(figure, drawn, "svg")
    parts = {
        "title": html.escape(title),
        "picture": "data:image/svg+xml;base64," + base64.b64encode(drawn.getvalue()).decode(),
        "table": "" if result is None else result._repr_html_(),
    }
    save_page(path, "picture", parts)
