"""How well each observation is measured: its weight, and what whitens its two coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import MAX_PX, MIN_PX, as_real
from epigauge.errors import ArgumentError

__all__ = ["measured", "merged_sums"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Least ratio of the standard deviations of a covariance's axes.
_THIN = 1e-7


def measured(
    sigma: ArrayLike | None, covariance: ArrayLike | None, count: int
) -> tuple[float, Array, Array | None]:
    """Return the unit of weight, the factors of weights (N,), and whitening (2, 2, N) or None.

    Parameters
    ----------
    sigma, covariance : array_like, optional
        As for `Tracks`; one of them or neither.
    count : int
        Number of observations.

    Raises
    ------
    ArgumentError
        On both, other shapes, and what is no standard deviation or covariance.
    """
    if covariance is not None:
        if sigma is not None:
            raise ArgumentError("covariance", "is given beside sigma", "one of them")
        return _of_covariances(covariance, count)
    if sigma is None:
        return 1.0, np.ones(count), None
    array = as_real("sigma", sigma, "a number, (N,) or (N, 2)")
    if array.shape not in ((), (count,), (count, 2)):
        raise ArgumentError("sigma", f"has shape {array.shape}", f"({count},) or ({count}, 2)")
    both = np.broadcast_to(array if array.ndim == 2 else array.reshape(-1, 1), (count, 2))
    bad = np.flatnonzero(~((both >= MIN_PX) & (both <= MAX_PX)).all(axis=1))
    if len(bad):
        needed = f"positive numbers, {MIN_PX:g} to {MAX_PX:g}"
        raise ArgumentError("sigma", f"is {both[bad[0]]} in row {bad[0]}", needed)
    unit = float(np.median(both))
    mean = np.sqrt(both[:, 0] * both[:, 1])
    if (both[:, 0] == both[:, 1]).all():
        return unit, (unit / mean) ** 2, None
    whitening = np.zeros((2, 2, count))
    whitening[[0, 1], [0, 1]] = mean / both.T
    return unit, (unit / mean) ** 2, whitening


def _of_covariances(covariance: ArrayLike, count: int) -> tuple[float, Array, Array]:
    array = as_real("covariance", covariance, "an (N, 2, 2) array")
    if array.shape not in ((2, 2), (count, 2, 2)):
        needed = f"(2, 2) or ({count}, 2, 2)"
        raise ArgumentError("covariance", f"has shape {array.shape}", needed)
    C = np.broadcast_to(array, (count, 2, 2))
    with np.errstate(all="ignore"):
        skew = np.abs(C[:, 0, 1] - C[:, 1, 0])
        size = np.sqrt(np.abs(C[:, 0, 0] * C[:, 1, 1]))
        good = np.isfinite(C).all(axis=(1, 2)) & (C[:, 0, 0] > 0.0) & (C[:, 1, 1] > 0.0)
        good &= skew <= 1e-9 * size
        good &= C[:, 0, 1] ** 2 < (1.0 - _THIN**2) * C[:, 0, 0] * C[:, 1, 1]
    bad = np.flatnonzero(~good)
    if len(bad):
        was = f"is {C[bad[0]].tolist()} in row {bad[0]}"
        raise ArgumentError("covariance", was, "symmetric and positive definite matrices")
    whitening, mean = _split(np.asarray(np.linalg.inv(C), np.float64))
    unit = float(np.median(mean))
    return unit, (unit / mean) ** 2, whitening


def _split(information: Array) -> tuple[Array, Array]:
    """Return W (2, 2, N) of determinant one and s (N,) with information W^T W / s^2."""
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    s = 1.0 / np.sqrt(root[:, 0, 0] * root[:, 1, 1])
    return np.ascontiguousarray((s[:, None, None] * root).transpose(1, 2, 0)), s


def merged_sums(
    first: Indices, xy: Array, weights: Array, whitening: Array
) -> tuple[Array, Array, Array, float]:
    """Put runs of observations together by their information.

    Parameters
    ----------
    first : ndarray of int, shape (k,)
        Where each run begins.
    xy, weights, whitening : ndarray, shape (N, 2), (N,), (2, 2, N)
        Observations; weights of zero in all of a run count as equal ones, but for the result.

    Returns
    -------
    xy, weights, whitening : ndarray
        Of the runs.
    constant : float
        Half the weighted squares within the runs.
    """
    counts = np.diff([*first, len(xy)])
    given = np.add.reduceat(weights, first)
    shares = np.where(np.repeat(given == 0.0, counts), 1.0, weights)
    W = whitening.transpose(2, 0, 1)
    each = shares[:, None, None] * (np.swapaxes(W, 1, 2) @ W)
    information = np.add.reduceat(each, first)
    pulled = np.add.reduceat((each @ xy[..., None])[..., 0], first)
    mean = np.linalg.solve(information, pulled[..., None])[..., 0]
    away = xy - np.repeat(mean, counts, axis=0)
    squares = np.einsum("ni,nij,nj->n", away, each, away)
    made, s = _split(information)
    constant = 0.5 * float(np.sum(squares[weights > 0.0]))
    return mean, np.where(given == 0.0, 0.0, s**-2), made, constant
