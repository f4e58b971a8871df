"""Which observation belongs to which camera and point, and what whitens its coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

__all__ = ["ObservationGraph", "whitened"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class ObservationGraph:
    """Which observation belongs to which camera and point; sorted by point, then view.

    A point may be observed more than once in a view.

    Attributes
    ----------
    view, point : ndarray of int, shape (N,)
        Indices.
    n_views, n_points : int
        Numbers of cameras and points; every index is used.
    """

    view: Indices
    point: Indices
    n_views: int
    n_points: int

    @cached_property
    def first(self) -> Indices:
        """Return the first observation of each point, and N."""
        return np.searchsorted(self.point, np.arange(self.n_points + 1))

    @cached_property
    def by_view(self) -> Indices:
        """Return the observations sorted by view."""
        return np.argsort(self.view, kind="stable")

    @cached_property
    def first_in_view(self) -> Indices:
        """Return where each view starts in `by_view`, and N."""
        return np.searchsorted(self.view[self.by_view], np.arange(self.n_views + 1))

    @cached_property
    def lowest(self) -> Indices:
        """Return the lowest view that shares a point with each, (n,)."""
        found = np.arange(self.n_views)
        np.minimum.at(found, self.view, self.view[self.first[:-1]][self.point])
        return found

    @cached_property
    def together(self) -> NDArray[np.bool_]:
        """Return which pairs of views share a point, (n, n)."""
        seen = np.zeros((self.n_points, self.n_views), np.float32)
        seen[self.point, self.view] = 1.0
        return np.asarray(seen.T @ seen > 0.0)

    @cached_property
    def simple(self) -> ObservationGraph:
        """Return the graph without repetitions: one edge a pair of view and point."""
        if self.first_of_edge is None:
            return self
        rows = self.first_of_edge
        return ObservationGraph(self.view[rows], self.point[rows], self.n_views, self.n_points)

    @cached_property
    def first_of_edge(self) -> Indices | None:
        """Return the first observation of each edge; None where each observation is one."""
        new = np.ones(len(self.view), np.bool_)
        new[1:] = (np.diff(self.view) != 0) | (np.diff(self.point) != 0)
        return None if new.all() else np.flatnonzero(new)

    def sum_points(self, values: Array) -> Array:
        """Add up values (N, ...) over the observations of each point."""
        return np.add.reduceat(values, self.first[:-1], axis=0)

    def sum_views(self, values: Array) -> Array:
        """Add up values (N, ...) over the observations of each view."""
        return np.add.reduceat(values[self.by_view], self.first_in_view[:-1], axis=0)

    def sum_edges(self, values: Array) -> Array:
        """Add up values (N, ...) over the observations of each edge of `simple`."""
        if self.first_of_edge is None:
            return values
        return np.add.reduceat(values, self.first_of_edge, axis=0)

    def of_edges(self, values: Array) -> Array:
        """Return the values (e, ...) of the edges of `simple` for each observation, (N, ...)."""
        if self.first_of_edge is None:
            return values
        edge = np.zeros(len(self.view), np.intp)
        edge[self.first_of_edge[1:]] = 1
        return values[np.cumsum(edge)]


def whitened(whitening: Array | None, values: Array) -> Array:
    """Return W times vectors (2, N) or rows of matrices (2, k, N); the same where W is None."""
    if whitening is None:
        return values
    W = whitening if values.ndim == 2 else whitening[:, :, None]
    with np.errstate(invalid="ignore"):
        found = np.stack([np.sum(row * values, axis=0) for row in W])
    if values.ndim == 2:  # what is infinitely far stays so, with parts of both signs
        found[:, np.isinf(values).any(axis=0)] = np.inf
    return np.asarray(found)
