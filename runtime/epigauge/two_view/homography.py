"""A homography of matches with points off the plane and wrong matches among them."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._library import address, library
from epigauge._native import check_sizes
from epigauge.kernels import Table
from epigauge.two_view.losses import median

__all__ = ["fit_homography", "plane_squares", "robust_homography"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

#: Iterations of the robust fit at most, and the relative change of the median square at which it
#: stands.
_ROUNDS = 15
_STANDS = 1e-6

#: Fits that are weighed as the one before says: converging as the noise over the size of the scene.
_FITS = 4

#: Fours of matches that it is tried from: with half of them on the plane one in sixteen is clean.
_SAMPLES = 40

#: Weights fall at the median distance while the plane is looked for, which is sharp; once it is
#: found, at so many times the median square: few matches would bend to half of themselves.
_SHARP, _WIDE = 1.0, 4.0

#: A distance below this, in conditioned coordinates, is rounding.
_ROUNDING = 1e-8

#: With this homography, all equations are weighed alike; and where a packed matrix is kept.
_EQUAL = np.diag([0.0, 0.0, 1.0])
_UPPER = np.triu_indices(9)


def fit_homography(
    q1: Array, q2: Array, weights: Array, table: Table | None = None
) -> tuple[Array, Array, Array]:
    """Fit q2 ~ H q1 by Sampson's weights: the reprojection error to first order.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, n)
        Conditioned matches, contiguous.
    weights : ndarray, shape (n,)
        Weights of the squared distances.
    table : Table, optional
        Backend.

    Returns
    -------
    H : ndarray, shape (3, 3)
        Homography of unit Frobenius norm.
    squares : ndarray, shape (n,)
        Squared distance of each match, in both images.
    N : ndarray, shape (9, 9)
        J^T J by vect(H).
    """
    table = table or kernels.table()
    H = _EQUAL
    if table.compiled:
        return _fitted(q1, q2, weights)
    for _ in range(_FITS):
        H, N = _least(table, H, q1, q2, weights)
    return H, table.homography_squared(H, q1, q2), N


def plane_squares(table: Table, H: Array, q1: Array, q2: Array) -> Array:
    """Return squared distances to first order; infinite where there are none."""
    with np.errstate(all="ignore"):
        squared = table.homography_squared(H, q1, q2)
    return np.asarray(np.where(np.isfinite(squared), squared, np.inf))


def robust_homography(
    q1: Array, q2: Array, weights: Array, table: Table | None = None
) -> tuple[Array, Array]:
    """Fit a homography to the plane that most matches are in.

    Reweighted by the median distance: gross errors and points off the plane lose their weight. It
    starts from all matches, and from the best of random fours of them.

    Parameters
    ----------
    q1, q2, weights, table
        As for `fit_homography`.

    Returns
    -------
    H : ndarray, shape (3, 3)
        Homography of unit Frobenius norm.
    squares : ndarray, shape (n,)
        Squared distance of each match, in both images.
    """
    table = table or kernels.table()
    rng = np.random.default_rng(0)
    fours = np.argpartition(rng.random((_SAMPLES, q1.shape[1])), 3, axis=1)[:, :4]
    if table.compiled:
        return _compiled(q1, q2, weights, fours)
    starts = (weights, _near_a_sample(table, q1, q2, weights, fours))
    ends = [_reweighted(table, q1, q2, weights, own, _SHARP) for own in starts]
    squares = min((end[1] for end in ends), key=median)
    return _reweighted(table, q1, q2, weights, _falling(weights, squares, _WIDE), _WIDE)


class _Options(ctypes.Structure):
    _fields_ = (
        ("equal", ctypes.c_double * 9),
        *((name, ctypes.c_double) for name in ("stands", "sharp", "wide", "rounding2")),
        ("rounds", ctypes.c_int),
    )


@cache
def _functions() -> Any:
    check_sizes({"eg_plane_options": _Options})
    fit, robust = library().eg_fit_homography, library().eg_robust_homography
    pointer, size = ctypes.c_void_p, ctypes.c_ssize_t
    fit.argtypes, fit.restype = [size, *[pointer] * 3, size, *[pointer] * 3], None
    robust.argtypes = [size, *[pointer] * 3, size, *[pointer] * 4]
    return fit, robust


def _fitted(q1: Array, q2: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return what `fit_homography` does, of the C library (runtime/c/homography.c)."""
    inputs = [np.ascontiguousarray(array, dtype=np.float64) for array in (q1, q2, weights)]
    n = q1.shape[1]
    H, squares, N = _EQUAL.copy(), np.empty(n), np.empty((9, 9))
    _functions()[0](n, *map(address, inputs), _FITS, *map(address, (H, squares, N)))
    return H, squares, N


def _compiled(q1: Array, q2: Array, weights: Array, fours: Rows) -> tuple[Array, Array]:
    """Return what `robust_homography` does, of the C library (runtime/c/homography.c)."""
    equal = (ctypes.c_double * 9)(*_EQUAL.ravel().tolist())
    options = _Options(equal, _STANDS, _SHARP, _WIDE, _ROUNDING**2, _ROUNDS)
    n = q1.shape[1]
    inputs = [np.ascontiguousarray(array, dtype=np.float64) for array in (q1, q2, weights)]
    rows = np.ascontiguousarray(fours, dtype=np.intp)
    H, squares = np.empty((3, 3)), np.empty(n)
    done = _functions()[1](
        *(n, *map(address, inputs), len(rows), address(rows)),
        *(ctypes.addressof(options), address(H), address(squares)),
    )
    if not done:
        raise MemoryError(f"no room for {n} matches")
    return H, squares


def _reweighted(
    table: Table, q1: Array, q2: Array, weights: Array, own: Array, reach: float
) -> tuple[Array, Array]:
    """Fit with weights, and again with those that the distances give."""
    H, last = _EQUAL, np.inf
    for _ in range(_ROUNDS):
        H = _least(table, H, q1, q2, own)[0]
        squares = table.homography_squared(H, q1, q2)
        middle = _middle(squares)
        if abs(middle - last) <= _STANDS * middle:
            break
        own, last = _falling(weights, squares, reach), middle
    return H, squares


def _falling(weights: Array, squares: Array, reach: float) -> Array:
    """Return weights that fall where squares are so many times their median."""
    with np.errstate(over="ignore"):  # infinitely far: no weight
        return np.asarray(weights / (1.0 + squares / (reach * _middle(squares))) ** 2)


def _least(table: Table, H: Array, q1: Array, q2: Array, weights: Array) -> tuple[Array, Array]:
    """Return what minimises the equations weighed as H says, and their J^T J."""
    N = np.zeros((9, 9))
    N[_UPPER] = table.homography_normal(H, q1, q2, weights)
    N.T[_UPPER] = N[_UPPER]
    return np.linalg.eigh(N)[1][:, 0].reshape(3, 3), N


def _near_a_sample(table: Table, q1: Array, q2: Array, weights: Array, four: Rows) -> Array:
    """Return weights of the matches near the homography of four of them, the best of many fours."""
    candidates = np.linalg.svd(_equations(q1[:, four], q2[:, four]))[2][:, 8].reshape(-1, 3, 3)
    tried = [table.homography_squared(H, q1, q2) for H in candidates]
    best = min(tried, key=median)
    return _falling(weights, best, _SHARP)


def _middle(squares: Array) -> float:
    return max(median(squares), _ROUNDING**2)


def _equations(q1: Array, q2: Array) -> Array:
    """Return the equations (k, 8, 9) of fours (2, k, 4), q2 (h3 q) - (h1 q, h2 q) = 0."""
    q = np.stack([*q1, np.ones(q1.shape[1:])], axis=-1)
    A = np.zeros((*q1.shape[1:], 2, 9))
    A[..., 0, 0:3] = A[..., 1, 3:6] = -q
    A[..., 6:9] = q2.transpose(1, 2, 0)[..., None] * q[..., None, :]
    return A.reshape(len(A), 8, 9)
