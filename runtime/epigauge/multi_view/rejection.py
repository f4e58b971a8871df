"""Adjustment of tracks with gross errors: robust steps, then least squares without what is wrong.

A robust loss finds the geometry that most observations agree on; what is far from it is set aside,
and the rest is adjusted as if it had been clean. What is set aside is asked again after each
adjustment, until the verdict stays the same. A view that much is set aside of may have
a camera that strayed: it is found anew from the points that the others hold, or told by a flag.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.observations import ObservationGraph
from epigauge.cameras import MetricReconstruction
from epigauge.kernels import Table
from epigauge.multi_view.agreement import agreed_points, agreed_positions
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import normalized
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.result import told
from epigauge.multi_view.strayed import found_anew, strayed
from epigauge.multi_view.tracks import MIN_VIEWS, Tracks
from epigauge.multi_view.verdicts.gross import GROSS
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.two_view.losses import EFFICIENT, median
from epigauge.verdicts import ordered

if TYPE_CHECKING:
    from epigauge.multi_view.adjust import BundleResult

__all__ = ["Adjust", "GrossErrors", "with_set_aside", "without_gross_errors"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

#: Median distance of two normal coordinates of standard deviation one.
_MEDIAN = 1.1774

#: Robust adjustments at most, the decrease of the median distance that asks for another, and
#: rounds of setting aside.
_ROBUST_ROUNDS, _LOWER, _ROUNDS = 8, 0.99, 12

#: Rounds of finding views anew at most, and how many that strayed are named.
_ANEW, _LISTED = 3, 5

#: The set aside is settled when less than this share of the observations changes sides.
_SETTLED = 1e-3

#: No points.
_NONE = np.zeros(0, np.intp)

#: A point is at the centre of a camera where its image, both of unit norm in the normalised basis,
#: is this small.
_AT_CENTRE = 1e-3


class Adjust(Protocol):
    """Adjusts tracks from a start, with a loss; what else is asked for is settled."""

    def __call__(
        self, tracks: Tracks, start: Any, *, loss: str, loss_scale_px: float | str
    ) -> BundleResult:
        """Return the result."""


def without_gross_errors(
    adjust: Adjust,
    tracks: Tracks,
    start: Any,
    kernels: Table,
    loss: tuple[str, float | str],
    fixed: tuple[Indices, Indices],
) -> BundleResult:
    """Adjust tracks some of which are wrong.

    Parameters
    ----------
    adjust : callable
        An adjustment with the options asked for.
    tracks : Tracks
        Observations.
    start : Reconstruction or MetricReconstruction
        Where to begin.
    kernels : Table
        Backend.
    loss : tuple
        Name and scale of the loss of the last adjustments, of the observations that are kept.
    fixed : tuple of ndarray of int
        Views and points that stay where they are.

    Returns
    -------
    BundleResult
        The last adjustment, with what was set aside in `rejected`.
    """
    search = GrossErrors(tracks, kernels, fixed[1])
    found = search.settled(lambda start: _agreed(adjust, search, start), start, fixed[0])
    if found.status == -2:
        return found
    start, rejected = found.reconstruction, search.gross(found.reconstruction)
    for _ in range(_ROUNDS):
        kept = search.without(rejected)
        begun = search.out_of_the_way(start, rejected)
        found = adjust(kept, begun, loss=loss[0], loss_scale_px=loss[1])
        start, aside = search.restored(found.reconstruction, start, rejected), rejected
        rejected = search.gross(start)
        if found.status == -2 or np.mean(rejected != aside) < _SETTLED:
            break
    moved = start is not found.reconstruction
    fun = tracks.xy - start.project(tracks) if moved else found.fun
    # The last one alone: a copy is judged, which those before need not be.
    found = replace(found, reconstruction=start, fun=fun)
    return with_set_aside(found, tracks, aside, found.flags)


def with_set_aside(
    found: BundleResult, tracks: Tracks, rejected: Mask, flags: Iterable[str]
) -> BundleResult:
    """Return a result that tells what was set aside, and whether that is most of a view.

    Parameters
    ----------
    found : BundleResult
        The last adjustment.
    tracks : Tracks
        All observations.
    rejected : ndarray of bool, shape (N,)
        What was set aside of them.
    flags : iterable of str
        What can be said against the rest.
    """
    left = strayed(tracks, rejected)
    flags = ordered((*flags, "strayed views") if len(left) else flags)
    verdict = Verdict(flags, found.rank, found.n_behind, found.condition, found.weakest)
    fields = told(verdict, found.status)
    fields["message"] = _told(fields["message"], rejected, left)
    return replace(found, rejected=rejected, **fields)


def _agreed(adjust: Adjust, search: GrossErrors, start: Any) -> BundleResult:
    """Adjust with a robust loss until the median distance stays the same."""
    start, typical = min(start, search.agreed(start), key=search.typical), np.inf
    for _ in range(_ROBUST_ROUNDS):
        found = adjust(search.tracks, start, loss="cauchy", loss_scale_px="auto")
        if found.status == -2:
            break
        start = search.agreed(found.reconstruction)
        before, typical = typical, search.typical(start)
        if not typical < _LOWER * before:
            break
    return found


def _told(message: str, rejected: Mask, left: Indices) -> str:
    """Return a message that tells of what was set aside, and of most of which views."""
    count = int(np.count_nonzero(rejected))
    share = f"{count} of {len(rejected)} observations set aside as gross errors"
    views = ", ".join(map(str, left[:_LISTED])) + ", ..." * (len(left) > _LISTED)
    share += f", most of those of view{'s' * (len(left) > 1)} {views}" if len(left) else ""
    return f"{message}; {share if count else 'nothing set aside'}"


class GrossErrors:
    """Tracks, and which of their observations are gross errors of a reconstruction.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    kernels : Table
        Backend.
    fixed_points : ndarray of int
        Points that stay where they are.
    """

    def __init__(self, tracks: Tracks, kernels: Table, fixed_points: Indices = _NONE) -> None:
        self.tracks, self.frame, self.fixed_points = tracks, Frame.of(tracks), fixed_points
        self.counts = tracks.weights > 0.0
        graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
        q, weights = self.frame.conditioned(tracks), np.asarray(tracks.weights)
        self.parts = kernels, graph, q, weights

    def distances(self, found: Any, fun: Array | None = None) -> Array:
        """Return the distance of each observation, (N,), times the root of its weight."""
        with np.errstate(invalid="ignore", over="ignore"):
            fun = self.tracks.xy - found.project(self.tracks) if fun is None else fun
            d = np.sqrt(fun[:, 0] ** 2 + fun[:, 1] ** 2)
        return np.asarray(np.nan_to_num(np.sqrt(self.tracks.weights) * d, nan=np.inf))

    def typical(self, found: Any) -> float:
        """Return the median distance of what counts."""
        return median(self.distances(found)[self.counts])

    def agreed(self, found: Any) -> Any:
        """Return the reconstruction with points where most of their observations want them."""
        usual = max(self.typical(found) / _MEDIAN, 1e-12 * self.frame.scale)
        scale, stays = EFFICIENT["cauchy"] * usual, self.fixed_points
        if isinstance(found, MetricReconstruction):
            kernels, graph = self.parts[:2]
            X = agreed_positions(kernels, self.tracks, graph, found, scale)
            X[stays] = found.X[stays]
            return replace(found, X=X)
        if not isinstance(found, Reconstruction):
            return found
        P = self.frame.cameras_in(found.P)
        Q = agreed_points(*self.parts, P, found.Q, scale / self.frame.scale)
        Q[stays] = found.Q[stays]
        return Reconstruction(found.P, Q)

    def gross(self, found: Any, fun: Array | None = None) -> Mask:
        """Return which observations are gross errors, or all that is left of a point to one.

        Parameters
        ----------
        found : Reconstruction or MetricReconstruction
            Cameras and points.
        fun : ndarray, shape (N, 2), optional
            Its residuals, where they are known.

        Returns
        -------
        ndarray of bool, shape (N,)
            Those beyond six standard deviations of the noise.
        """
        distances = self.distances(found, fun)
        gross = self.counts & ((distances > self._limit(distances)) | self._at_centre(found))
        kept = self.counts & ~gross
        lengths = np.bincount(self.tracks.point[kept], minlength=self.tracks.n_points)
        return np.asarray(gross | (self.counts & (lengths < MIN_VIEWS)[self.tracks.point]))

    def _limit(self, distances: Array) -> float:
        """Return the distance beyond which an observation is a gross error."""
        noise = median(distances[self.counts]) / _MEDIAN
        return GROSS * max(noise, 1e-12 * self.frame.scale)

    def settled(
        self, adjusted: Callable[[Any], BundleResult], start: Any, fixed_views: Indices
    ) -> BundleResult:
        """Adjust robustly, and again where doubtful cameras are found anew."""
        found = adjusted(start)
        for _ in range(_ANEW):
            stopped = found.status == -2
            begun = None if stopped else self.found_anew(found.reconstruction, fixed_views)
            if begun is None:
                break
            found = adjusted(begun)
        return found

    def found_anew(self, found: Any, fixed_views: Indices) -> Any | None:
        """Return the reconstruction with doubtful cameras where the points of others want them.

        None where no camera is, or none is better elsewhere.
        """
        rejected = self.gross(found)
        limit = self._limit(self.distances(found))
        return found_anew(self.parts[0], self.tracks, found, rejected, fixed_views, limit)

    def _at_centre(self, found: Any) -> Mask:
        """Return which observations are of points that have moved into the camera's centre.

        Such a point fits any observation: what two views say of it has nothing in common.
        """
        if not isinstance(found, Reconstruction):
            return np.zeros(len(self.counts), dtype=np.bool_)
        P = self.frame.cameras_in(found.P)
        P, Q = normalized().transformation(P, found.Q).apply(P, found.Q)
        P /= np.linalg.norm(P, axis=(1, 2), keepdims=True)
        Q /= np.linalg.norm(Q, axis=1, keepdims=True)
        h = np.einsum("nij,nj->ni", P[self.tracks.view], Q[self.tracks.point])
        return np.asarray(np.linalg.norm(h, axis=1) < _AT_CENTRE)

    def lost(self, rejected: Mask) -> Mask:
        """Return which points have nothing left."""
        kept = np.bincount(self.tracks.point[~rejected], minlength=self.tracks.n_points)
        return np.asarray(kept == 0)

    def out_of_the_way(self, found: Any, rejected: Mask) -> Any:
        """Return the reconstruction with points that nothing is left of where the best seen one is.

        They have no weight, but near a focal plane they would stop every step.
        """
        if not isinstance(found, Reconstruction):
            return found
        kept = np.bincount(self.tracks.point[~rejected], minlength=self.tracks.n_points)
        lost = self.lost(rejected)[:, None]
        return Reconstruction(found.P, np.where(lost, found.Q[np.argmax(kept)], found.Q))

    def restored(self, after: Any, before: Any, rejected: Mask) -> Any:
        """Return the reconstruction with such points where they were before."""
        if not (isinstance(before, Reconstruction) and isinstance(after, Reconstruction)):
            return after
        Q = np.where(self.lost(rejected)[:, None], before.Q, after.Q)
        return Reconstruction(after.P, Q)

    def without(self, rejected: Mask) -> Tracks:
        """Return the tracks with weight zero for what is set aside."""
        tracks = self.tracks
        return tracks.weighted(np.where(rejected, 0.0, tracks.weights))
