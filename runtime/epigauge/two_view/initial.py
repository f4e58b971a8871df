"""Linear estimates to start from."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_matches
from epigauge.errors import ArgumentError

__all__ = ["fundamental_7point", "fundamental_8point"]

Array = NDArray[np.float64]

#: Two roots closer than this (relative) are one, split by rounding: the root of its epsilon.
_DOUBLE = 2.0**-26


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

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> eg.fundamental_8point(scene.x1, scene.x2).shape
    (3, 3)
    """
    x1, x2 = as_matches(x1, x2, general_position=True)
    n1, T1 = _normalize(x1)
    n2, T2 = _normalize(x2)
    products = (n2[:, :, None] * n1[:, None, :]).reshape(len(n1), 9)
    f = np.linalg.svd(np.linalg.qr(products, mode="r"))[2][-1]
    # One of the two signs, whatever the linear algebra: the first large entry is positive.
    f = f * np.sign(f[np.argmax(np.abs(f) > 0.5 * np.max(np.abs(f)))])
    U, values, Vt = np.linalg.svd(f.reshape(3, 3))
    F = T2.T @ (U[:, :2] * values[:2]) @ Vt[:2] @ T1
    return np.asarray(F / np.linalg.norm(F))


def fundamental_7point(x1: ArrayLike, x2: ArrayLike) -> Array:
    """Find the fundamental matrices that seven matches satisfy exactly.

    Seven equations leave a pencil a F1 + b F2 of matrices; det(a F1 + b F2) = 0 is a cubic.

    Parameters
    ----------
    x1, x2 : array_like, shape (7, 2)
        Seven matches in pixels.

    Returns
    -------
    ndarray, shape (k, 3, 3)
        One to three matrices of rank 2 and unit Frobenius norm with ``x2^T F x1 = 0``, one for each
        real root. Real roots that differ by rounding only may be counted once or twice.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN or infinity, another number of matches, all points of an image equal or
        on one line, and matches that leave infinitely many solutions.

    References
    ----------
    .. [1] R. Hartley, A. Zisserman, "Multiple View Geometry", 2003, section 11.1.2.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> eg.fundamental_7point(scene.x1[:7], scene.x2[:7]).shape[1:]
    (3, 3)
    """
    x1, x2 = as_matches(x1, x2, at_least=7, general_position=True)
    if len(x1) != 7:
        raise ArgumentError("x1, x2", f"hold {len(x1)} matches", "exactly 7")
    n1, T1 = _normalize(x1)
    n2, T2 = _normalize(x2)
    products = (n2[:, :, None] * n1[:, None, :]).reshape(7, 9)
    _, values, Vt = np.linalg.svd(products)
    pencil = Vt[7:].reshape(2, 3, 3)
    # The second matrix is the most regular of several, so that no root is at infinity.
    angles = np.pi * np.arange(8) / 8.0
    members = np.tensordot(np.column_stack([np.sin(angles), np.cos(angles)]), pencil, axes=1)
    determinants = np.linalg.det(members)
    most = int(np.argmax(np.abs(determinants)))
    if values[6] <= 1e-12 * values[0] or abs(determinants[most]) <= 1e-12:
        raise ArgumentError("x1, x2", "are in a degenerate position", "matches that determine F")
    G1, G2 = members[(most + 4) % 8], members[most]
    ends, c0, c3 = np.linalg.det([G1 + G2, G1 - G2]), np.linalg.det(G1), determinants[most]
    roots = np.roots([c3, ends.mean() - c0, (ends[0] - ends[1]) / 2.0 - c3, c0])
    real = roots.real[np.abs(roots.imag) <= _DOUBLE * (1.0 + np.abs(roots.real))]
    U, singular, Vt = np.linalg.svd(G1 + real[:, None, None] * G2)
    F = T2.T @ ((U[:, :, :2] * singular[:, None, :2]) @ Vt[:, :2]) @ T1
    return np.asarray(F / np.linalg.norm(F, axis=(1, 2), keepdims=True))


def _normalize(x: Array) -> tuple[Array, Array]:
    """Return homogeneous normalised points (m, 3) and the (3, 3) map from pixels to them."""
    centre = x.mean(axis=0)
    centred = x - centre
    scale = np.sqrt(np.mean(centred**2))
    normalized = np.column_stack([centred / scale, np.ones(len(x))])
    return normalized, np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, scale]]) / scale
