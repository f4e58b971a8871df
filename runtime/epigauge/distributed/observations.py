"""What partitions are made from: their observations, and what is the same for all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.skyline import Skyline
from epigauge.distributed.sums import Rows, Terms
from epigauge.two_view.losses import Loss

__all__ = ["Observations", "Order", "Setup", "Source"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Observations:
    """Observations of the points of a partition, sorted by point.

    Attributes
    ----------
    view, point : ndarray of int, shape (N,)
        Numbers of the views; of the points within the partition, each used.
    q : ndarray, shape (2, N)
        Measurements, in the unit that is computed in.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    whitening : ndarray, shape (2, 2, N), or None
        What residuals are multiplied by.
    """

    view: Indices
    point: Indices
    q: Array
    weights: Array
    whitening: Array | None = None

    def __len__(self) -> int:
        return len(self.view)

    @property
    def whitened(self) -> bool:
        """Tell whether they have covariances."""
        return self.whitening is not None

    def survey(self, question: str, argument: Any) -> tuple[Terms, Any]:
        """Return what another method says."""
        return (), getattr(self, question)(argument)

    def lowest(self, number: Indices) -> Rows:
        """Return the lowest view, of numbers (n,), that shares a point with each that is there."""
        views, graph = self.graph(number)
        return Rows(views, views[graph.lowest].astype(np.float64))

    def together(self, n: int) -> NDArray[np.uint8]:
        """Return which pairs of views share a point, (n, n) as bits row by row."""
        _, graph = self.graph(np.arange(n))
        found, counts = np.zeros((n, n), np.bool_), np.diff(graph.first)
        left = counts[graph.point] - (np.arange(len(graph.point)) - graph.first[graph.point]) - 1
        views = self.view[self.rows(np.arange(n))]
        for apart in range(1, int(counts.max(initial=1))):
            rows = np.flatnonzero(left >= apart)
            found[views[rows], views[rows + apart]] = True
        return np.packbits(found | found.T)

    def rows(self, number: Indices) -> Indices:
        """Return the observations sorted by point, then by the number of the view."""
        return np.lexsort((number[self.view], self.point))

    def graph(self, number: Indices) -> tuple[Indices, ObservationGraph]:
        """Return the numbers of the views that are there, rising, and the graph of these."""
        rows = self.rows(number)
        views, own = np.unique(number[self.view[rows]], return_inverse=True)
        point = self.point[rows]
        return views, ObservationGraph(own.astype(np.intp), point, len(views), int(point[-1]) + 1)


class Source(Protocol):
    """Where a partition's observations come from."""

    @property
    def whitened(self) -> bool:
        """Tell whether they have covariances."""

    def load(self) -> Observations:
        """Return them."""


@dataclass(frozen=True)
class Order:
    """The order of the cameras in the reduced system, and where its blocks are.

    Attributes
    ----------
    number : ndarray of int, shape (n,)
        Number of each camera in that order.
    skyline : Skyline
        Of the blocks of all partitions together.
    """

    number: Indices
    skyline: Skyline


@dataclass(frozen=True)
class Setup:
    """What is the same for all partitions.

    Attributes
    ----------
    model, backend : str
        Names of the camera and of the back end.
    loss : Loss
        Applied to each squared residual.
    used : ndarray of int, or None
        Entries of a camera's tangent that are computed with; None for all.
    heaviest : float
        Largest weight of all observations.
    order : Order
        Of the cameras.
    """

    model: str
    backend: str
    loss: Loss
    used: Indices | None
    heaviest: float
    order: Order
