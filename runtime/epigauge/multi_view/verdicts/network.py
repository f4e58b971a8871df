"""How views hang together: parts without a common point, and tracks of two views only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.tracks import Tracks

__all__ = ["loose_parts", "only_pairs", "why_open"]

Indices = NDArray[np.intp]


def loose_parts(view: Indices, point: Indices, n_views: int) -> tuple[Indices, ...]:
    """Return the views of all parts but the largest that share no point with it.

    Parameters
    ----------
    view, point : ndarray of int, shape (N,)
        Observations that count.
    n_views : int
        Number of views; those without an observation are parts of their own.
    """
    label = np.arange(n_views)
    _, point = np.unique(point, return_inverse=True)
    while len(view):
        lowest = np.full(int(point.max()) + 1, n_views)
        np.minimum.at(lowest, point, label[view])
        spread = label.copy()
        np.minimum.at(spread, view, lowest[point])
        spread = spread[spread]
        if (spread == label).all():
            break
        label = spread
    counts = np.bincount(label, minlength=n_views)
    largest = int(np.argmax(counts))
    return tuple(np.flatnonzero(label == k) for k in np.flatnonzero(counts) if k != largest)


def only_pairs(point: Indices) -> bool:
    """Tell whether no point is seen by more than two views."""
    return bool(len(point) and np.bincount(point).max() <= 2)


def why_open(tracks: Tracks, rejected: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return what the network of an undetermined reconstruction lacks: names of flags."""
    counts = ~rejected & (tracks.weights > 0.0)
    view, point = tracks.view[counts], tracks.point[counts]
    # Several sightings in one view are one.
    once = (np.diff(view, prepend=-1) != 0) | (np.diff(point, prepend=-1) != 0)
    found = []
    if loose_parts(view, point, tracks.n_views):
        found.append("not tied")
    if tracks.n_views > 2 and only_pairs(point[once]):
        found.append("two-view tracks")
    return tuple(found)
