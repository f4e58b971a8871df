"""A homography of matches with points off the plane and wrong matches among them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["fit_homography", "robust_homography"]

Array = NDArray[np.float64]

#: Iterations of the robust fit, and fours of matches that it is tried from: with half of the
#: matches on the plane one in sixteen is clean.
_ROUNDS = 15
_SAMPLES = 40

#: A distance below this, in conditioned coordinates, is rounding.
_ROUNDING = 1e-8


def fit_homography(q1: Array, q2: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Fit q2 ~ H q1 by Sampson's weights: the reprojection error to first order.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, n)
        Conditioned matches.
    weights : ndarray, shape (n,)
        Weights of the squared distances.

    Returns
    -------
    H : ndarray, shape (3, 3)
        Homography of unit Frobenius norm.
    squares : ndarray, shape (n,)
        Squared distance of each match, in both images.
    N : ndarray, shape (9, 9)
        J^T J by vect(H).
    """
    A = _equations(q1, q2)
    inverse = np.broadcast_to(np.eye(2), (len(A), 2, 2))
    for _ in range(4):  # converges as the noise over the size of the scene
        H, N = _least(A, inverse, weights)
        inverse = _inverse(H, q1, q2)
    return H, _squares(H, q1, q2, A), N


def robust_homography(q1: Array, q2: Array, weights: Array) -> tuple[Array, Array]:
    """Fit a homography to the plane that most matches are in.

    Reweighted by the median distance: gross errors and points off the plane lose their weight. It
    starts from all matches, and from the best of random fours of them.

    Parameters
    ----------
    q1, q2, weights
        As for `fit_homography`.

    Returns
    -------
    H : ndarray, shape (3, 3)
        Homography of unit Frobenius norm.
    squares : ndarray, shape (n,)
        Squared distance of each match, in both images; their median is the lowest found.
    """
    ends = (
        _reweighted(q1, q2, weights, weights),
        _reweighted(q1, q2, weights, _near_a_sample(q1, q2, weights)),
    )
    return min(ends, key=lambda end: float(np.median(end[1])))


def _reweighted(q1: Array, q2: Array, weights: Array, own: Array) -> tuple[Array, Array]:
    """Fit with weights, and again with those that the distances give."""
    A = _equations(q1, q2)
    inverse = np.broadcast_to(np.eye(2), (len(A), 2, 2))
    for _ in range(_ROUNDS):
        H = _least(A, inverse, own)[0]
        inverse = _inverse(H, q1, q2)
        c = A @ H.ravel()
        squares = np.einsum("ni,nij,nj->n", c, inverse, c)
        own = weights / (1.0 + squares / _median(squares)) ** 2
    return H, squares


def _least(A: Array, inverse: Array, weights: Array) -> tuple[Array, Array]:
    """Return the H that minimises the weighted squares of the equations, and their J^T J."""
    scaled = (inverse @ A) * weights[:, None, None]
    N = A.reshape(-1, 9).T @ scaled.reshape(-1, 9)
    return np.linalg.eigh(N)[1][:, 0].reshape(3, 3), N


def _near_a_sample(q1: Array, q2: Array, weights: Array) -> Array:
    """Return weights of the matches near the homography of four of them, the best of many fours."""
    rng = np.random.default_rng(0)
    n = q1.shape[1]
    four = np.argsort(rng.random((_SAMPLES, n)), axis=1)[:, :4]
    A = _equations(q1, q2)
    H = np.linalg.svd(A[four].reshape(_SAMPLES, 8, 9))[2][:, 8]
    squares = _squares(H.reshape(-1, 3, 3), q1, q2, A)
    best = squares[np.argmin(np.median(squares, axis=1))]
    return np.asarray(weights / (1.0 + best / _median(best)) ** 2)


def _median(squares: Array) -> float:
    return max(float(np.median(squares)), _ROUNDING**2)


def _equations(q1: Array, q2: Array) -> Array:
    """Return the two equations of each match, q2 (h3 q) - (h1 q, h2 q) = 0, by vect(H)."""
    q = np.vstack([q1, np.ones(q1.shape[1])])
    A = np.zeros((q1.shape[1], 2, 9))
    A[:, 0, 0:3] = A[:, 1, 3:6] = -q.T
    A[:, :, 6:9] = np.einsum("in,jn->nij", q2, q)
    return A


def _inverse(H: Array, q1: Array, q2: Array) -> Array:
    """Return the inverse covariances (..., n, 2, 2) of the equations, for noise of variance one."""
    J1 = np.einsum("in,...j->...nij", q2, H[..., 2, :2]) - H[..., None, :2, :2]
    depth = H[..., 2, :2] @ q1 + H[..., 2, 2:]
    squares = J1 @ np.swapaxes(J1, -1, -2) + (depth**2)[..., None, None] * np.eye(2)
    xx, xy, yy = squares[..., 0, 0], squares[..., 0, 1], squares[..., 1, 1]
    inverse = np.stack([yy, -xy, -xy, xx], axis=-1).reshape(squares.shape)
    # The determinant of a homography of lower rank may vanish
    return np.asarray(inverse / np.maximum(xx * yy - xy * xy, 1e-200)[..., None, None])


def _squares(H: Array, q1: Array, q2: Array, A: Array) -> Array:
    """Return the squared distances (..., n) to homographies, to first order."""
    c = np.einsum("nia,...a->...ni", A, H.reshape(*H.shape[:-2], 9))
    return np.asarray(np.einsum("...ni,...nij,...nj->...n", c, _inverse(H, q1, q2), c))
