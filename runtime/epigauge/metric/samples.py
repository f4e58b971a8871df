"""A few of the tracks, enough to find the cameras from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Tracks

__all__ = ["Sample", "sampled"]

Indices = NDArray[np.intp]

#: Observations wanted in all, and of each view at least and at most.
_TOTAL, _LEAST, _MOST = 10000, 100, 300


@dataclass(frozen=True)
class Sample:
    """Some points with all their observations.

    Attributes
    ----------
    tracks : Tracks
        Their observations, points renumbered.
    points : ndarray of int, shape (k,)
        Their old numbers.
    whole : bool
        Whether these are all points.
    """

    tracks: Tracks
    points: Indices
    whole: bool


def sampled(tracks: Tracks) -> Sample:
    """Choose points seen in many views, so many that each view sees enough of them.

    Long tracks tie the views together, and few of them are gross errors. Points of one length are
    taken in a random order of their own, spread over the images as all are.

    Parameters
    ----------
    tracks : Tracks
        Observations.

    Returns
    -------
    Sample
        All of them, where that is not many more, or where a part does not hang together.
    """
    count = int(np.clip(_TOTAL // tracks.n_views, _LEAST, _MOST))
    counts = tracks.weights > 0.0
    lengths = np.bincount(tracks.point[counts], minlength=tracks.n_points)
    order = np.lexsort((np.random.default_rng(0).random(tracks.n_points), -lengths))
    rank = np.empty(tracks.n_points, dtype=np.intp)
    rank[order] = np.arange(tracks.n_points)
    # The first `count` points of each view, by rank.
    rows = np.flatnonzero(counts)
    rows = rows[np.lexsort((rank[tracks.point[rows]], tracks.view[rows]))]
    views = tracks.view[rows]
    first = np.searchsorted(views, np.arange(tracks.n_views))
    chosen = np.zeros(tracks.n_points, dtype=np.bool_)
    chosen[tracks.point[rows[np.arange(len(rows)) - first[views] < count]]] = True
    chosen &= lengths >= 2
    if np.count_nonzero(chosen) > 0.7 * tracks.n_points:
        return Sample(tracks, np.arange(tracks.n_points), True)
    try:
        part, views, points = tracks.subset(chosen[tracks.point] & counts)
    except ArgumentError:
        return Sample(tracks, np.arange(tracks.n_points), True)
    if len(views) < tracks.n_views:
        return Sample(tracks, np.arange(tracks.n_points), True)
    return Sample(part, points, False)
