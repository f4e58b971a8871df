"""The part of the tracks that a verdict is about."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import MIN_VIEWS, Tracks

__all__ = ["Seen"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Seen:
    """The observations that count, with views and points renumbered.

    Attributes
    ----------
    view, point : ndarray of int, shape (N,)
        New numbers; sorted by point, then view.
    xy, weights : ndarray, shape (N, 2), (N,)
        Pixels, and positive factors.
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        Their cameras and points.
    views, points : ndarray of int, shape (n,), (m,)
        Old numbers of the views and points.
    """

    view: Indices
    point: Indices
    xy: Array
    weights: Array
    P: Array
    Q: Array
    views: Indices
    points: Indices

    @property
    def n(self) -> int:
        """Return the number of views."""
        return len(self.P)

    @property
    def m(self) -> int:
        """Return the number of points."""
        return len(self.Q)

    @cached_property
    def begin(self) -> Indices:
        """Return the first observation of each point, and N."""
        return np.searchsorted(self.point, np.arange(self.m + 1))

    @cached_property
    def partners(self) -> dict[int, Indices]:
        """Return the partners of views that were asked for (`parallax.partners`)."""
        return {}

    @staticmethod
    def of_network(tracks: Tracks) -> Seen:
        """Return what counts of tracks alone, numbers kept, with zeros for cameras and points."""
        n, m = tracks.n_views, tracks.n_points
        P, Q = np.zeros((n, 3, 4)), np.zeros((m, 4))
        counts: Any = tracks.weights > 0.0
        if counts.all():
            counts = slice(None)  # no copies
        measured = tracks.xy[counts], tracks.weights[counts]
        return Seen(
            tracks.view[counts], tracks.point[counts], *measured, P, Q, np.arange(n), np.arange(m)
        )

    @staticmethod
    def of(tracks: Tracks, found: Reconstruction, rejected: Mask) -> tuple[Seen, int]:
        """Return what counts, and how many views have nothing of it."""
        counts = ~rejected & (tracks.weights > 0.0)
        # A point needs two observations to be a part of what is judged.
        lengths = np.bincount(tracks.point[counts], minlength=tracks.n_points)
        counts &= lengths[tracks.point] >= MIN_VIEWS
        if counts.all():
            every = np.arange(tracks.n_views), np.arange(tracks.n_points)
            observed = tracks.xy, tracks.weights
            return Seen(tracks.view, tracks.point, *observed, found.P, found.Q, *every), 0
        views, view = np.unique(tracks.view[counts], return_inverse=True)
        points, point = np.unique(tracks.point[counts], return_inverse=True)
        arrays = tracks.xy[counts], tracks.weights[counts], found.P[views], found.Q[points]
        return Seen(view, point, *arrays, views, points), tracks.n_views - len(views)
