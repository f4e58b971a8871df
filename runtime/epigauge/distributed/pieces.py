"""Partitions as the client knows them: where they are cut, and which cameras they tie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.lanes import FULL
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.skyline import Skyline, narrow
from epigauge.distributed.dispatch import Dispatch, Run
from epigauge.distributed.observations import Observations, Order, Source
from epigauge.distributed.worker import Recipe

__all__ = ["Piece", "cut", "order_of_cameras"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Observations of a partition, about, and least number of partitions where points suffice.
_SIZE, _LEAST = 250_000, 8


@dataclass(frozen=True)
class Piece:
    """A partition as the client knows it.

    Attributes
    ----------
    points : ndarray of int, shape (m_k,)
        Numbers of its points among all.
    source : Observations or Source
        Its observations.
    rows : ndarray of int, shape (N_k,), or None
        Numbers of its observations among all, where the client has them.
    """

    points: Indices
    source: Observations | Source
    rows: Indices | None = None


def cut(
    graph: ObservationGraph, q: Array, weights: Array, whitening: Array | None, count: int | None
) -> list[Piece]:
    """Cut observations into partitions of about equal size, neighbouring points together.

    How many depends on the observations alone: so do the sums, to the last bit.
    """
    N, m = len(graph.point), graph.n_points
    wanted = count if count is not None else max(_LEAST, -(-N // _SIZE))
    first, view = graph.first, graph.view
    order = np.lexsort((view[first[1:] - 1], view[first[:-1]]))
    sizes = np.diff(first)[order]
    ends = np.searchsorted(np.cumsum(sizes), N * np.arange(1, wanted + 1) / wanted - 0.5) + 1
    ends = np.unique(np.minimum(ends, m))
    pieces = []
    for begin, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        points, counts = order[begin:end], sizes[begin:end]
        starts = np.concatenate([[0], np.cumsum(counts)])
        own = np.repeat(np.arange(end - begin), counts)
        rows = first[points][own] + np.arange(starts[-1]) - starts[own]
        white = None if whitening is None else np.ascontiguousarray(whitening[..., rows])
        parts = view[rows], own, np.ascontiguousarray(q[:, rows]), weights[rows], white
        pieces.append(Piece(points, Observations(*parts), rows))
    return pieces


def order_of_cameras(dispatch: Dispatch, pieces: list[Piece], n: int) -> Order:
    """Return an order of n cameras in which the skyline of their reduced system is narrow."""
    survey, skyline, order = Survey(dispatch, pieces), Skyline.full(n), None
    if n > FULL:
        skyline = Skyline.of(survey.lowest(n))
    if skyline.wide:
        skyline, order = narrow(survey.together(n))
    return Order(np.arange(n) if order is None else np.argsort(order), skyline)


class Survey:
    """Questions to the partitions before there is an order of the cameras."""

    def __init__(self, dispatch: Dispatch, pieces: list[Piece]) -> None:
        self._dispatch, self._pieces = dispatch, pieces

    def lowest(self, n: int) -> Indices:
        """Return the lowest view that shares a point with each, (n,)."""
        found = np.arange(n)
        for rows in self._asked("lowest", np.arange(n)):
            found[rows.index] = np.minimum(found[rows.index], rows.values.astype(np.intp))
        return found

    def together(self, n: int) -> NDArray[np.bool_]:
        """Return which pairs of views share a point, (n, n)."""
        bits = np.zeros(-(-n * n // 8), np.uint8)
        for own in self._asked("together", n):
            bits |= own
        return np.unpackbits(bits, count=n * n).reshape(n, n).astype(np.bool_)

    def _asked(self, question: str, argument: Any) -> list[Any]:
        here = [piece.source for piece in self._pieces]
        if all(isinstance(source, Observations) for source in here):
            return [getattr(source, question)(argument) for source in here]
        run = Run(self._dispatch, len(here), lambda k: Recipe(None, here[k]))
        try:
            return run.each("survey", (question, argument))[1]
        finally:
            run.release()
