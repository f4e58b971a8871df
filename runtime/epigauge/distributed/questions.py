"""What a partition tells of its observations: counts and few values, for the verdict on all."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.observations import whitened
from epigauge.multi_view.verdicts.evidence import share_moved

if TYPE_CHECKING:
    from epigauge.distributed.evaluation import Evaluation

__all__ = ["DISTANCE", "NETWORK", "OF_FIT", "X_AXIS", "Y_AXIS", "keys", "values_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Keys = NDArray[np.uint64]

#: What can be counted in bins: lengths of residuals, and measured coordinates.
DISTANCE, X_AXIS, Y_AXIS = "distance", "x", "y"

#: Bits of a key beside its bin: sign, exponent and four bits of the mantissa are left.
_SHIFT = np.uint64(48)
_SIGN = np.uint64(1 << 63)


def keys(values: Array) -> Keys:
    """Return unsigned integers in the order of the values; NaN comes last."""
    bits = np.ascontiguousarray(values).view(np.uint64)
    return np.asarray(np.where(bits & _SIGN, ~bits, bits | _SIGN))


def values_of(found: Keys) -> Array:
    """Return the values of `keys`."""
    bits = np.where(found & _SIGN, found ^ _SIGN, ~found)
    return np.asarray(bits, np.uint64).view(np.float64)


# ---------------------------------------------------------------- how an estimate fits


def facts(own: Evaluation, cameras: Array, points: Array, weighted: bool) -> tuple[float, ...]:
    """Return observations, those behind, sum and largest of lengths, sum of squares as they are."""
    residuals, depths = _residuals(own, cameras, points)
    distances = _distances(own, residuals, weighted)
    behind = int(np.count_nonzero(~(depths > 0.0)))
    squares = float(np.vdot(distances, distances)), float(np.max(distances))
    return len(depths), behind, *squares, float(np.vdot(residuals, residuals))


def above(own: Evaluation, cameras: Array, points: Array, weighted: bool, limit: float) -> int:
    """Return how many lengths are above a limit."""
    residuals, _ = _residuals(own, cameras, points)
    return int(np.count_nonzero(_distances(own, residuals, weighted) > limit))


def far_of_views(
    own: Evaluation, cameras: Array, points: Array, weighted: bool, n: int, limit: float
) -> Indices:
    """Return how many lengths of each view are above a limit, (n,)."""
    residuals, _ = _residuals(own, cameras, points)
    far = _distances(own, residuals, weighted) > limit
    return np.bincount(_views(own)[far], minlength=n)


def histogram(
    own: Evaluation, cameras: Array, points: Array, weighted: bool, what: str
) -> tuple[Keys, Indices]:
    """Return bins that are not empty, and how many values they have."""
    found = _values(own, cameras, points, weighted, what) >> _SHIFT
    return np.unique(found, return_counts=True)


def within(
    own: Evaluation, cameras: Array, points: Array, weighted: bool, what: str, bins: Keys
) -> Keys:
    """Return the keys of the values in some bins."""
    found = _values(own, cameras, points, weighted, what)
    return found[np.isin(found >> _SHIFT, bins)]


def _values(own: Evaluation, cameras: Array, points: Array, weighted: bool, what: str) -> Keys:
    if what == DISTANCE:
        residuals, _ = _residuals(own, cameras, points)
        return keys(_distances(own, residuals, weighted))
    return keys(own.q[(X_AXIS, Y_AXIS).index(what)])


def _residuals(own: Evaluation, cameras: Array, points: Array) -> tuple[Array, Array]:
    """Return the residuals (2, N), as they are, and the depths (N,)."""
    graph = own.graph
    seen_by = np.take(np.ascontiguousarray(cameras[own.views].T), graph.view, axis=1)
    at = seen_by, np.take(points.T, graph.point, axis=1)
    pixels, depths = own.model.seen(*at, own.setup.backend)
    return own.q - pixels, depths


def _distances(own: Evaluation, residuals: Array, weighted: bool) -> Array:
    r = whitened(own.whitening, residuals)
    with np.errstate(all="ignore"):
        squares = r[0] ** 2 + r[1] ** 2
        return np.asarray(np.sqrt(own.weights * squares if weighted else squares))


# ---------------------------------------------------------------- what sees what


def views(own: Evaluation, n: int) -> Indices:
    """Return the number of observations of each view, (n,)."""
    return np.bincount(_views(own), minlength=n)


def ties(own: Evaluation, n: int) -> tuple[Indices, int]:
    """Return pairs of views that share a point, as i n + k, enough to tie all; longest track."""
    view, graph = _views(own), own.graph
    first = view[graph.first[:-1]][graph.point]
    return np.unique(first * n + view), int(np.diff(graph.first).max())


def around(own: Evaluation, i: int) -> tuple[Indices, Indices]:
    """Return views and points of all observations of the points that a view sees."""
    view, point = _views(own), own.graph.point
    rows = np.isin(point, point[view == i])
    return view[rows], point[rows]


def moved(own: Evaluation, limit: float) -> int:
    """Return how many observations are farther than that from the mean of their point."""
    graph = own.graph
    return round(share_moved(graph.point, graph.n_points, own.q.T, limit) * len(graph.point))


def _views(own: Evaluation) -> Indices:
    return np.asarray(own.views[own.graph.view])


#: By the names that they are asked by.
OF_FIT: dict[str, Any] = {f.__name__: f for f in (facts, above, far_of_views, histogram, within)}
NETWORK: dict[str, Any] = {f.__name__: f for f in (views, ties, around, moved)}
