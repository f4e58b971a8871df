"""Image coordinates that the many-view part computes in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import checked, function
from epigauge.errors import ArgumentError
from epigauge.kernels import backend
from epigauge.multi_view.tracks import Tracks

__all__ = ["Frame", "counted"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Frame:
    """Image coordinates to compute in: each view's centroid, one scale for all.

    Attributes
    ----------
    origins : ndarray, shape (n, 2)
        Centroids of the views, in pixels.
    scale : float
        Pixels a unit; coordinates then have an RMS of one.
    """

    origins: Array
    scale: float

    @staticmethod
    def of(tracks: Tracks) -> Frame:
        """Choose the coordinates for some tracks, without observations of weight zero."""
        tracks = counted(tracks)
        n, view, xy = tracks.n_views, tracks.view, tracks.xy
        if backend() == "c":
            origins = np.empty((n, 2))
            scale = function("image_frame")(n, len(view), *map(address, (view, xy, origins)))
            checked(scale < 0.0)
        else:
            counts = np.bincount(view, minlength=n)
            sums = [np.bincount(view, xy[:, k]) / counts for k in (0, 1)]
            origins = np.stack(sums, axis=1)
            centred = xy - origins.take(view, axis=0)
            scale = float(np.sqrt(np.vdot(centred, centred) / centred.size))
        if not scale > 0.0:
            raise ArgumentError("tracks", "have all points of a view at one place", "other points")
        return Frame(origins, scale)

    def conditioned(self, tracks: Tracks) -> Array:
        """Return the conditioned observations, shape (2, N)."""
        return self.points_in(tracks.xy, tracks.view)

    def points_in(self, xy: Array, view: Indices) -> Array:
        """Return conditioned image points, shape (2, N), from pixels (N, 2)."""
        return np.ascontiguousarray(((xy - self.origins.take(view, axis=0)) / self.scale).T)

    def cameras_in(self, P: Array) -> Array:
        """Return cameras to conditioned coordinates from cameras to pixels."""
        moved = P.copy()
        moved[:, :2] = (P[:, :2] - self.origins[:, :, None] * P[:, 2:]) / self.scale
        return moved

    def cameras_out(self, P: Array) -> Array:
        """Return cameras to pixels from cameras to conditioned coordinates."""
        moved = P.copy()
        moved[:, :2] = self.scale * P[:, :2] + self.origins[:, :, None] * P[:, 2:]
        return moved


def counted(tracks: Tracks) -> Tracks:
    """Return the tracks without observations of weight zero; with them where too few are left."""
    counts = tracks.weights > 0.0
    if counts.all():
        return tracks
    try:
        some, views, points = tracks.subset(counts)
    except ArgumentError:
        return tracks
    whole = len(views) == tracks.n_views and len(points) == tracks.n_points
    return some if whole else tracks
