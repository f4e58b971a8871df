"""The observations in the order in which the C library passes over them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import LANES, Bundle, function
from epigauge.bundle.linearizer import LEAST_WEIGHT
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.skyline import Skyline, narrow
from epigauge.two_view.losses import LOSSES, Loss

__all__ = ["FULL", "LaneLayout", "Range"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Range = tuple[int, int]

#: Cameras of which a full matrix is factored in no time.
FULL = 10

#: What the passes over an observation cost, in pairs of observations, and what a point costs in a
#: pass, in observations.
_PASSES, _POINT = 20, 3

#: Least work of a thread, in pairs of observations: with less, to hand it over costs more than it
#: saves.
_SHARE = 1e5


class LaneLayout:
    """The observations in the order of the chunks (bundle.h), and the skyline of pairs they give.

    Parameters
    ----------
    graph : ObservationGraph
        Which observation belongs to what.
    q, weights : ndarray, shape (2, N), (N,)
        Measurements and their weights.
    model : int
        Row of the camera model in the C library's table, or `FACTORED`.
    columns : ndarray of int32, shape (k,)
        Entries of a camera's tangent that are computed with.
    heaviest : float, optional
        Largest weight of all observations, where these are a part of them.
    beside : sequence of ObservationGraph
        Those of features of other kinds, whose pairs of cameras the skyline has, too.

    Attributes
    ----------
    lanes, rows : ndarray of int
        Where the lanes and the observations of each chunk begin.
    points : ndarray of int, shape (m,)
        The points lane by lane; lanes that fill up repeat the last.
    order : ndarray of int, shape (n,), or None
        Numbers of the cameras in the order of the skyline; None where it is their own.
    """

    def __init__(
        self,
        graph: ObservationGraph,
        q: Array,
        weights: Array,
        model: int,
        columns: NDArray[np.int32],
        heaviest: float | None = None,
        beside: Sequence[ObservationGraph] = (),
    ) -> None:
        self._beside = beside
        self._graph, self._q, self._weights, self.columns = graph, q, weights, columns
        self._first, view = np.ascontiguousarray(graph.first), np.ascontiguousarray(graph.view)
        n, m = graph.n_views, graph.n_points
        self.points = np.empty(m, np.intp)
        lanes, rows = np.empty((2, m // LANES + 2), np.intp)
        self._point, self._count = np.empty((2, m + LANES), np.int32)
        order = (self._first, view, self.points, lanes, rows, self._point, self._count)
        chunks = function("bundle_chunks")(n, m, *map(address, order))
        if chunks < 0:
            raise MemoryError(f"no memory for {m} points")
        self.lanes, self.rows = lanes[: chunks + 1], rows[: chunks + 1]
        last = int(self.rows[-1])
        self._observed = np.empty(last, np.int32), np.empty(2 * last), np.empty(last)
        self.order: Indices | None = None
        self._skyline: Skyline | None = None
        arrays = (self.lanes, self.rows, self._point, self._count, *self._observed)
        self._bundle = Bundle(
            n,
            m,
            chunks,
            *map(address, arrays),
            least=LEAST_WEIGHT * float(weights.max() if heaviest is None else heaviest),
            model=model,
            width=len(columns),
            columns=address(columns),
        )
        self._pack(view, q, weights)

    def bundle(self, loss: Loss) -> Bundle:
        """Return the C structure."""
        made = Bundle.from_buffer_copy(self._bundle)
        made.scale2, made.loss = loss.scale**2, LOSSES.index(loss.name)
        return made

    @property
    def lane_by_lane(self) -> NDArray[np.int32]:
        """Return the point of each lane where the points themselves are in the order of lanes."""
        return np.minimum(np.arange(self.lanes[-1]), len(self.points) - 1).astype(np.int32)

    def shares(self, count: int) -> tuple[list[Range], list[Range]]:
        """Split the chunks into at most so many ranges of about equal work.

        Once for passes over the observations, once for those over pairs of observations of a
        point; little work makes fewer ranges.
        """
        if count == 1:
            whole = [(0, len(self.lanes) - 1)]
            return whole, whole
        rows, lanes = np.diff(self.rows), np.diff(self.lanes)
        pairs = rows * (rows // lanes + _PASSES)
        count = max(1, min(count, int(pairs.sum() / _SHARE)))
        return _ranges(rows + _POINT * lanes, count), _ranges(pairs, count)

    def settle(self, skyline: Skyline) -> None:
        """Take a skyline, and leave the cameras in the order that they have."""
        self._skyline = skyline

    @property
    def skyline(self) -> Skyline:
        """Return the skyline of pairs; the cameras get the order that narrows it when first asked.

        Until then it is not known to any array of cameras.
        """
        if self._skyline is None:
            graph, n = self._graph, self._graph.n_views
            lowest = (own.lowest for own in (graph, *self._beside))
            full = n <= FULL
            self._skyline = Skyline.full(n) if full else Skyline.of(np.min([*lowest], axis=0))
            if self._skyline.wide:
                together = np.zeros((n, n), np.bool_)
                function("bundle_neighbours")(ctypes.byref(self._bundle), address(together))
                for own in self._beside:
                    together |= own.together
                self._skyline, self.order = narrow(together)
            if self.order is not None:
                number = self.number[graph.view]
                rows = np.lexsort((number, graph.point))
                self._pack(number[rows], self._q[:, rows], self._weights[rows])
        return self._skyline

    @property
    def number(self) -> Indices:
        """Return the number of each camera in the order of the skyline, (n,)."""
        return np.arange(self._graph.n_views) if self.order is None else np.argsort(self.order)

    def inward(self, cameras: Any) -> Any:
        """Return rows of cameras in the order of the skyline, contiguous; None stays None."""
        if cameras is None:
            return None
        return np.ascontiguousarray(cameras if self.order is None else cameras[self.order])

    def outward(self, cameras: Array) -> Array:
        """Return rows of cameras from the order of the skyline in their own."""
        if self.order is None:
            return cameras
        result = np.empty_like(cameras)
        result[self.order] = cameras
        return result

    def _pack(self, view: Indices, q: Array, weights: Array) -> None:
        """Copy the observations, sorted by point, then view."""
        arrays = self._first, *map(np.ascontiguousarray, (view, q, weights))
        reference = ctypes.byref(self._bundle)
        function("bundle_pack")(reference, *map(address, (*arrays, *self._observed)))


def _ranges(work: Indices, count: int) -> list[Range]:
    """Return ranges of about equal work; a chunk belongs to that which its middle falls into."""
    middles = np.cumsum(work) - work / 2.0
    cuts = np.searchsorted(middles, work.sum() * np.arange(1, count) / count)
    edges = [0, *cuts.tolist(), len(work)]
    return [(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b > a]
