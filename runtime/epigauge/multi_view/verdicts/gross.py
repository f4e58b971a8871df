"""Whether gross errors are left in what was adjusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.losses import median

__all__ = ["GROSS", "STRAYED", "Tail", "TailOfArrays", "gross_flags", "strayed_flags"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: An observation is a gross error beyond this many standard deviations: none in ten million of
#: normal ones, but measured ones have heavier tails. A view has strayed where more than such a
#: share of its observations is one.
GROSS, STRAYED = 6.0, 0.5

#: Root mean square over the noise that the median tells, above which few observations carry the
#: cost: up to five in raw tracks that still lead to their optimum.
_HEAVY = 8.0

#: Noise below this share of the extent of the coordinates is rounding.
_EXACT = 1e-8

#: Least squares bends everything to observations whose residuals, as shares of the extent of the
#: coordinates, are larger than the first: below a fifth in most raw tracks, above with two wrong in
#: a thousand. So few as the second cannot: one of 35000 measured ones is off by a third of the
#: extent, and they lead to the published optimum all the same.
_BEYOND, _TOO_FEW = 0.2, 1e-4

#: Residuals near the noise and far from it, in standard deviations. Measured sets have tails: most
#: of what is beyond the first is within the second, where gross errors stand apart. Shares of both
#: that are told whatever the other is, and least number and share of those apart.
_NEAR, _FAR = 4.0, 12.0
_MANY_NEAR, _MANY_FAR, _APART, _FEW, _FEW_SHARE = 0.08, 0.02, 1.5, 3, 0.002


class Tail(Protocol):
    """Lengths of residuals, of which few numbers are asked, and where they were measured."""

    @property
    def count(self) -> int:
        """Return how many there are."""

    @property
    def largest(self) -> float:
        """Return the largest."""

    @property
    def sum_of_squares(self) -> float:
        """Return the sum of their squares."""

    @property
    def median(self) -> float:
        """Return their median."""

    def above(self, limit: float) -> int:
        """Return how many are above a limit."""

    def ranked(self, axis: int, ranks: Sequence[int]) -> Array:
        """Return measured coordinates of rising rank, from 0, in one direction of the image."""


@dataclass(frozen=True)
class TailOfArrays:
    """Lengths (N,) and measurements (N, 2) that are here."""

    distances: Array
    xy: Array

    @property
    def count(self) -> int:
        """Return how many there are."""
        return len(self.distances)

    @property
    def largest(self) -> float:
        """Return the largest."""
        return float(self.distances.max())

    @property
    def sum_of_squares(self) -> float:
        """Return the sum of their squares."""
        return float(np.sum(self.distances**2))

    @property
    def median(self) -> float:
        """Return their median."""
        return median(self.distances)

    def above(self, limit: float) -> int:
        """Return how many are above a limit."""
        return int(np.count_nonzero(self.distances > limit))

    def ranked(self, axis: int, ranks: Sequence[int]) -> Array:
        """Return measured coordinates of rising rank, from 0, in one direction of the image."""
        return np.partition(self.xy[:, axis], ranks)[list(ranks)]


def gross_flags(tail: Tail, noise_px: float) -> tuple[str, ...]:
    """Return "gross errors" where they spoil least squares, "outliers" where some are left.

    Parameters
    ----------
    tail : Tail
        Lengths of the residuals that count, times the roots of their weights.
    noise_px : float
        Standard deviation of a coordinate, as their median tells it.
    """
    if tail.largest <= _NEAR * noise_px:  # the extent can only raise the bounds
        return ()
    extent, N = _extent(tail), tail.count
    if _spoiled(tail, noise_px, extent):
        return ("gross errors",)
    usual = max(noise_px, _EXACT * extent)
    near, far = (tail.above(k * usual) for k in (_NEAR, _FAR))
    # Of normal errors exp(-8) are beyond four standard deviations.
    chance = N * float(np.exp(-0.5 * _NEAR**2))
    if near <= chance + 5.0 * max(chance, 1.0) ** 0.5:
        return ()
    apart = far >= max(_FEW, _FEW_SHARE * N) and near <= _APART * far
    left = apart or near > _MANY_NEAR * N or far > _MANY_FAR * N
    return ("outliers",) if left else ()


def strayed_flags(
    far_of_views: Callable[[float], Indices], every: Indices, noise_px: float, scale: float
) -> tuple[str, ...]:
    """Return "strayed views" where a robust loss has given up most of what a view observes.

    Parameters
    ----------
    far_of_views : callable
        Returns how many residuals of each view are longer than a limit, (n,).
    every : ndarray of int, shape (n,)
        Observations of each view that count.
    noise_px : float
        Standard deviation of a coordinate, as the median of the residuals tells it.
    scale : float
        RMS of the image coordinates about the centroids of the views, in pixels.
    """
    far = far_of_views(GROSS * max(noise_px, _EXACT * scale))
    return ("strayed views",) if (far > STRAYED * every).any() else ()


def _spoiled(tail: Tail, noise_px: float, extent: float) -> bool:
    """Tell whether few residuals carry the cost, or more than a very few are very large."""
    usual = _HEAVY * max(noise_px, _EXACT * extent)
    heavy = float(np.sqrt(tail.sum_of_squares / tail.count / 2.0)) > usual
    beyond = tail.above(max(_BEYOND * extent, usual))
    return bool(heavy or beyond > _TOO_FEW * tail.count)


def _extent(tail: Tail) -> float:
    """Return the range of the coordinates, to which a few wild ones add little."""
    last = tail.count - 1
    places = [share * last for share in (0.005, 0.995)]
    kept = sorted(
        {0, last, *(k for place in places for k in (math.floor(place), math.ceil(place)))}
    )
    extents = []
    for axis in (0, 1):  # several times as fast as a quantile of rows
        rising = tail.ranked(axis, kept)
        low, high = np.interp(places, kept, rising)
        extents.append(min(rising[-1] - rising[0], 1.3 * (high - low)))
    return float(max(extents))
