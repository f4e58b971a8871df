"""Tables of observations as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

import epigauge as eg
from epigauge.io.output import writing


def save_line_residuals(
    path: Path, result: eg.BundleResult, lines: eg.LineTracks, tracks: eg.Tracks
) -> None:
    """Write each segment and the signed distances of its end points from its line, as CSV.

    Parameters
    ----------
    path : Path
        The file.
    result : BundleResult
        Of the lines.
    lines : LineTracks
        Segments.
    tracks : Tracks
        What was adjusted with them, which names the views.
    """
    assert result.line_fun is not None
    names = tracks.names or tuple(map(str, range(tracks.n_views)))
    known = lines.names or tuple(map(str, range(lines.n_lines)))
    columns = (
        [names[k] for k in lines.view.tolist()],
        [known[k] for k in lines.line.tolist()],
        *lines.segments.T.tolist(),
        *result.line_fun.T.tolist(),
    )
    header = ("view", "line", "x1", "y1", "x2", "y2", "distance_1", "distance_2")
    _save_table(path, header, columns)


def save_residuals(
    path: Path,
    result: eg.BundleResult,
    tracks: eg.Tracks,
    views: ArrayLike | None = None,
    points: ArrayLike | None = None,
) -> None:
    """Write each observation, its residual and whether it was set aside, as CSV.

    Parameters
    ----------
    path : Path
        The file.
    result : BundleResult
        Of the tracks.
    tracks : Tracks
        Observations.
    views, points : array_like of int, optional
        Their numbers in the file that they come from, where views have no names.
    """
    numbers: list[NDArray[np.intp]] = [
        np.arange(count) if own is None else np.asarray(own)
        for own, count in ((views, tracks.n_views), (points, tracks.n_points))
    ]
    names = tracks.names or tuple(map(str, numbers[0].tolist()))
    columns = (
        [names[k] for k in tracks.view.tolist()],
        numbers[1][tracks.point].tolist(),
        *tracks.xy.T.tolist(),
        *result.fun.T.tolist(),
        result.rejected.astype(int).tolist(),
    )
    header = ("view", "point", "x", "y", "residual_x", "residual_y", "rejected")
    _save_table(path, header, columns)


def _save_table(path: Path, header: Sequence[str], columns: Sequence[Sequence[object]]) -> None:
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(header)
    table.writerows(zip(*columns, strict=True))
    with writing(path) as stream:
        stream.write(text.getvalue().encode())
