"""What verdicts ask the observations, asked of all partitions: none of them comes here whole."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.distributed.linearizer import DistributedLinearizer
from epigauge.distributed.questions import DISTANCE, X_AXIS, Y_AXIS, values_of
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.verdicts.network import loose_parts

__all__ = ["PartsEvidence", "PartsTail"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class PartsTail:
    """The lengths of all residuals, weighted, of which partitions tell counts and some values.

    Parameters
    ----------
    linearizer : DistributedLinearizer
        The partitions.
    cameras, points : ndarray
        The estimate.
    weighted : bool
        Whether lengths are times the roots of their weights.
    """

    def __init__(
        self, linearizer: DistributedLinearizer, cameras: Array, points: Array, weighted: bool
    ) -> None:
        self._linearizer, self._at, self._weighted = linearizer, (cameras, points), weighted

    @cached_property
    def facts(self) -> Any:
        """Return numbers of observations, those behind; sum of squares; largest; of raw ones."""
        parts = np.array(self._asked("facts", self._weighted))
        return *parts[:, :3].sum(axis=0), parts[:, 3].max(), parts[:, 4].sum()

    @property
    def count(self) -> int:
        """Return how many there are."""
        return int(self.facts[0])

    @property
    def largest(self) -> float:
        """Return the largest."""
        return float(self.facts[3])

    @property
    def sum_of_squares(self) -> float:
        """Return the sum of their squares."""
        return float(self.facts[2])

    @cached_property
    def median(self) -> float:
        """Return their median."""
        low, high = self.selected(DISTANCE, [(self.count - 1) // 2, self.count // 2])
        return float(0.5 * (low + high))

    def above(self, limit: float) -> int:
        """Return how many are above a limit."""
        return int(sum(self._asked("above", self._weighted, limit)))

    def far_of_views(self, n: int, limit: float) -> Indices:
        """Return how many of each of n views are above a limit, (n,)."""
        return np.asarray(sum(self._asked("far_of_views", self._weighted, n, limit)), np.intp)

    def ranked(self, axis: int, ranks: Sequence[int]) -> Array:
        """Return measured coordinates of rising rank, from 0, in one direction of the image."""
        return self.selected((X_AXIS, Y_AXIS)[axis], ranks)

    def selected(self, what: str, ranks: Sequence[int]) -> Array:
        """Return the values of some ranks, exactly.

        By two passes: all values are counted in bins of a sixteenth of an octave; then the values
        of the few bins that the ranks fall into come here.
        """
        parts = self._asked("histogram", self._weighted, what)
        found = np.concatenate([bins for bins, _ in parts])
        bins, place = np.unique(found, return_inverse=True)
        counts = np.bincount(place, np.concatenate([own for _, own in parts])).astype(np.intp)
        ends = np.cumsum(counts)
        wanted = np.searchsorted(ends, list(ranks), side="right")
        chosen = np.unique(wanted)
        parts = self._asked("within", self._weighted, what, bins[chosen])
        rising = np.sort(np.concatenate(parts))
        # Where the values of each chosen bin begin among those that came.
        first = np.cumsum(counts[chosen]) - counts[chosen]
        own = np.searchsorted(chosen, wanted)
        before = ends[wanted] - counts[wanted]
        return values_of(rising[first[own] + np.asarray(ranks) - before])

    def _asked(self, question: str, *arguments: Any) -> list[Any]:
        own, (cameras, points) = self._linearizer, self._at
        return own.run.each("asked", (question, cameras, arguments), own.own(points))[1]


class PartsEvidence:
    """The evidence of a folder of parts; see `epigauge.multi_view.verdicts.evidence.Evidence`.

    Parameters
    ----------
    linearizer : DistributedLinearizer
        The partitions.
    found : MetricReconstruction
        Cameras and points.
    scale : float
        RMS of the image coordinates about the centroids of the views.
    """

    def __init__(
        self, linearizer: DistributedLinearizer, found: MetricReconstruction, scale: float
    ) -> None:
        self._linearizer, self._found, self.scale = linearizer, found, scale
        self.tail = PartsTail(linearizer, found.vectors, found.X, weighted=True)

    @property
    def count(self) -> int:
        """Return the number of observations."""
        return self.tail.count

    @property
    def n_behind(self) -> int:
        """Return how many are of points that are not in front of their camera."""
        return int(self.tail.facts[1])

    @property
    def rms(self) -> float:
        """Return the RMS of the coordinates of the residuals as they are, in pixels."""
        return float(np.sqrt(self.tail.facts[4] / (2 * self.count)))

    def misses(self, limit: float) -> bool:
        """Tell whether half of the observations are farther from their images."""
        # Then their RMS, which is known already, is above half of the limit.
        if not self.rms > 0.5 * limit:
            return False
        found = self._found
        lengths = PartsTail(self._linearizer, found.vectors, found.X, weighted=False)
        return lengths.median > limit

    @cached_property
    def of_views(self) -> Indices:
        """Return the number of observations of each view, (n,)."""
        n = self._found.n_views
        return np.asarray(sum(self._ask("views", n)), np.intp)

    def far_of_views(self, limit: float) -> Indices:
        """Return how many of the weighted lengths of each view are above a limit, (n,)."""
        return self.tail.far_of_views(self._found.n_views, limit)

    def open(self) -> tuple[str, ...]:
        """Return what the network lacks: names of flags."""
        n, ties, most = self._found.n_views, np.zeros(0, np.intp), 0
        for own, longest in self._ask("ties", n):
            ties, most = np.union1d(ties, own), max(most, longest)
        ends = np.stack([ties // n, ties % n], axis=1).ravel()
        found = []
        if loose_parts(ends, np.repeat(np.arange(len(ties)), 2), n):
            found.append("not tied")
        if n > 2 and most <= 2:
            found.append("two-view tracks")
        return tuple(found)

    def around(self, i: int) -> Seen:
        """Return all observations of the points that a view sees."""
        view, point = self._joined("around", i)
        points, own = np.unique(point, return_inverse=True)
        order = np.argsort(own, kind="stable")
        n, m, N = self._found.n_views, len(points), len(order)
        blank = np.zeros((N, 2)), np.ones(N), np.zeros((n, 3, 4)), np.zeros((m, 4))
        return Seen(view[order], own[order], *blank, np.arange(n), points)

    def images(self, i: int) -> tuple[Indices, Array]:
        """Return the points (k,) that a view sees, and where it projects them to, (k, 2)."""
        view, point = self._joined("around", i)
        seen, found = point[view == i], self._found
        camera = np.repeat(found.vectors[i][:, None], len(seen), axis=1)
        at = camera, np.ascontiguousarray(found.X[seen].T)
        pixels, _ = camera_model(found.cameras.model).seen(*at)
        return seen, np.ascontiguousarray(pixels.T)

    def moved(self, limit: float) -> float:
        """Return the share of the observations farther than that from the mean of their point."""
        return float(sum(self._ask("moved", limit))) / self.count

    def _joined(self, question: str, argument: Any) -> tuple[Indices, Indices]:
        parts = self._ask(question, argument)
        pieces = self._linearizer.pieces
        view = np.concatenate([view for view, _ in parts])
        numbers = [piece.points[point] for piece, (_, point) in zip(pieces, parts, strict=True)]
        return view, np.concatenate(numbers)

    def _ask(self, question: str, *arguments: Any) -> list[Any]:
        return self._linearizer.run.each("network", (question, arguments))[1]
