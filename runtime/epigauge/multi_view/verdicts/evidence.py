"""What verdicts on calibrated and affine reconstructions ask the observations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.observations import whitened
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.gross import Tail, TailOfArrays
from epigauge.multi_view.verdicts.network import why_open

__all__ = ["Evidence", "EvidenceOfTracks", "share_moved"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class Evidence(Protocol):
    """Observations and how a reconstruction fits them, wherever they are."""

    @property
    def count(self) -> int:
        """Return the number of observations."""

    @property
    def n_behind(self) -> int:
        """Return how many are of points that are not in front of their camera."""

    @property
    def scale(self) -> float:
        """Return the RMS of the image coordinates about the centroids of the views, in pixels."""

    @property
    def tail(self) -> Tail:
        """Return the weighted lengths of the residuals that count."""

    @property
    def of_views(self) -> Indices:
        """Return the number of observations of each view that count, (n,)."""

    def far_of_views(self, limit: float) -> Indices:
        """Return how many of the weighted lengths of each view are above a limit, (n,)."""

    @property
    def rms(self) -> float:
        """Return the RMS of the coordinates of the residuals as they are, in pixels."""

    def misses(self, limit: float) -> bool:
        """Tell whether half of the observations that count are farther from their images."""

    def open(self) -> tuple[str, ...]:
        """Return what the network lacks: names of flags."""

    def around(self, i: int) -> Seen:
        """Return at least all observations of the points that a view sees."""

    def images(self, i: int) -> tuple[Indices, Array]:
        """Return the points (k,) that a view sees, and where it projects them to, (k, 2)."""

    def moved(self, limit: float) -> float:
        """Return the share of the observations farther than that from the mean of their point."""


@dataclass(frozen=True)
class EvidenceOfTracks:
    """The evidence of tracks that are here.

    Attributes
    ----------
    tracks : Tracks
        Observations.
    scale : float
        Of the frame of these.
    predicted : ndarray, shape (N, 2)
        Where the points are projected to.
    depths : ndarray, shape (N,), or None
        How far in front of its camera each observed point lies; None where cameras have no front.
    """

    tracks: Tracks
    scale: float
    predicted: Array
    depths: Array | None

    @property
    def count(self) -> int:
        """Return the number of observations."""
        return len(self.tracks)

    @property
    def n_behind(self) -> int:
        """Return how many are of points that are not in front of their camera."""
        return 0 if self.depths is None else int(np.count_nonzero(~(self.depths > 0.0)))

    @cached_property
    def tail(self) -> TailOfArrays:
        """Return the weighted lengths of the residuals that count."""
        tracks = self.tracks
        counts, xy = tracks.weights > 0.0, tracks.xy
        with np.errstate(invalid="ignore", over="ignore"):
            r = whitened(tracks.whitening, (xy - self.predicted).T)
            distances = np.sqrt(tracks.weights * (r[0] ** 2 + r[1] ** 2))
        if not counts.all():
            distances, xy = distances[counts], xy[counts]
        return TailOfArrays(distances, xy)

    @property
    def of_views(self) -> Indices:
        """Return the number of observations of each view that count, (n,)."""
        tracks = self.tracks
        return np.bincount(tracks.view[tracks.weights > 0.0], minlength=tracks.n_views)

    def far_of_views(self, limit: float) -> Indices:
        """Return how many of the weighted lengths of each view are above a limit, (n,)."""
        own = self.tracks.view[self.tracks.weights > 0.0]
        return np.bincount(own[self.tail.distances > limit], minlength=self.tracks.n_views)

    def misses(self, limit: float) -> bool:
        """Tell whether half of the observations that count are farther from their images."""
        return bool(np.median(self._distances) > limit)

    @property
    def rms(self) -> float:
        """Return the RMS of the coordinates of the residuals as they are, in pixels."""
        with np.errstate(over="ignore"):
            return float(np.sqrt(np.mean(self._distances**2) / 2.0))

    @cached_property
    def _distances(self) -> Array:
        """Return the distances of the observations that count from their images, in pixels."""
        counts = self.tracks.weights > 0.0
        with np.errstate(invalid="ignore", over="ignore"):
            distances = np.linalg.norm(self.tracks.xy - self.predicted, axis=1)
        return np.asarray(distances[counts])

    def open(self) -> tuple[str, ...]:
        """Return what the network lacks: names of flags."""
        return why_open(self.tracks, self.tracks.weights <= 0.0)

    @cached_property
    def _network(self) -> Seen:
        return Seen.of_network(self.tracks)

    def around(self, i: int) -> Seen:
        """Return all observations."""
        return self._network

    def images(self, i: int) -> tuple[Indices, Array]:
        """Return the points (k,) that a view sees, and where it projects them to, (k, 2)."""
        tracks = self.tracks
        rows = np.flatnonzero((tracks.view == i) & (tracks.weights > 0.0))
        return tracks.point[rows], self.predicted[rows]

    def moved(self, limit: float) -> float:
        """Return the share of the observations farther than that from the mean of their point."""
        return share_moved(self.tracks.point, self.tracks.n_points, self.tracks.xy, limit)


def share_moved(point: Indices, m: int, xy: Array, limit: float) -> float:
    """Return the share of observations farther than `limit` from the mean of their point."""
    counts = np.bincount(point, minlength=m)
    sums = [np.bincount(point, values, m) / counts for values in xy.T]
    away = np.linalg.norm(xy - np.stack(sums, axis=1)[point], axis=1)
    return float(np.mean(away > limit))
