"""Tables of observations as CSV."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

import epigauge as eg
from epigauge.io.output import writing


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
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("view", "point", "x", "y", "residual_x", "residual_y", "rejected"))
    table.writerows(zip(*columns, strict=True))
    with writing(path) as stream:
        stream.write(text.getvalue().encode())
