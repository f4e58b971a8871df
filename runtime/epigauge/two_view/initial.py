"""Linear estimates to start from."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_matches

__all__ = ["fundamental_8point"]

Array = NDArray[np.float64]


def fundamental_8point(x1: ArrayLike, x2: ArrayLike) -> Array:
    """Estimate F by the normalised 8-point algorithm.

    Each image is moved to its centroid and scaled to a mean squared distance of 2; the algebraic
    error is minimised over unit-norm matrices; the rank is then lowered to 2, still in normalised
    coordinates.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least eight matches in pixels.

    Returns
    -------
    ndarray, shape (3, 3)
        F of rank 2 and unit Frobenius norm with ``x2^T F x1 = 0``.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN or infinity, fewer than eight matches, or all points of an image equal
        or on one line.

    References
    ----------
    .. [1] R. Hartley, "In Defence of the 8-Point Algorithm", ICCV 1995.
    """
    x1, x2 = as_matches(x1, x2, general_position=True)
    n1, T1 = _normalize(x1)
    n2, T2 = _normalize(x2)
    products = (n2[:, :, None] * n1[:, None, :]).reshape(len(n1), 9)
    F = np.linalg.svd(np.linalg.qr(products, mode="r"))[2][-1].reshape(3, 3)
    U, values, Vt = np.linalg.svd(F)
    F = T2.T @ (U[:, :2] * values[:2]) @ Vt[:2] @ T1
    return np.asarray(F / np.linalg.norm(F))


def _normalize(x: Array) -> tuple[Array, Array]:
    """Return homogeneous normalised points (m, 3) and the (3, 3) map from pixels to them."""
    centre = x.mean(axis=0)
    centred = x - centre
    scale = np.sqrt(np.mean(centred**2))
    normalized = np.column_stack([centred / scale, np.ones(len(x))])
    return normalized, np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, scale]]) / scale
