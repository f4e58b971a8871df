"""Whether gross errors are left in what was adjusted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["gross_flags"]

Array = NDArray[np.float64]

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


def gross_flags(distances: Array, noise_px: float, xy: Array) -> tuple[str, ...]:
    """Return "gross errors" where they spoil least squares, "outliers" where some are left.

    Parameters
    ----------
    distances : ndarray, shape (N,)
        Lengths of the residuals that count, times the roots of their weights.
    noise_px : float
        Standard deviation of a coordinate, as their median tells it.
    xy : ndarray, shape (N, 2)
        Where they were measured.
    """
    largest = distances.max()
    if largest <= _NEAR * noise_px:  # the extent can only raise the bounds
        return ()
    extent, N = _extent(xy), len(distances)
    if _spoiled(distances, noise_px, extent):
        return ("gross errors",)
    usual = max(noise_px, _EXACT * extent)
    near, far = (int(np.count_nonzero(distances > k * usual)) for k in (_NEAR, _FAR))
    # Of normal errors exp(-8) are beyond four standard deviations.
    chance = N * float(np.exp(-0.5 * _NEAR**2))
    if near <= chance + 5.0 * max(chance, 1.0) ** 0.5:
        return ()
    apart = far >= max(_FEW, _FEW_SHARE * N) and near <= _APART * far
    left = apart or near > _MANY_NEAR * N or far > _MANY_FAR * N
    return ("outliers",) if left else ()


def _spoiled(distances: Array, noise_px: float, extent: float) -> bool:
    """Tell whether few residuals carry the cost, or more than a very few are very large."""
    usual = _HEAVY * max(noise_px, _EXACT * extent)
    heavy = float(np.sqrt(np.mean(distances**2) / 2.0)) > usual
    beyond = np.count_nonzero(distances > max(_BEYOND * extent, usual))
    return bool(heavy or beyond > _TOO_FEW * len(distances))


def _extent(xy: Array) -> float:
    """Return the range of the coordinates, to which a few wild ones add little."""
    last = len(xy) - 1
    places = [share * last for share in (0.005, 0.995)]
    kept = sorted(
        {0, last, *(k for place in places for k in (math.floor(place), math.ceil(place)))}
    )
    extents = []
    for values in xy.T:  # several times as fast as a quantile of rows
        rising = np.partition(values, kept)
        low, high = np.interp(places, kept, rising[kept])
        extents.append(min(rising[last] - rising[0], 1.3 * (high - low)))
    return float(max(extents))
