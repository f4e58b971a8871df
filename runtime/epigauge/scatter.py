"""The normalised basis: points spread evenly over the directions of R^4."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import function
from epigauge.kernels import backend

__all__ = ["scatter_constraints", "spread", "spreading_basis"]

Array = NDArray[np.float64]


def spreading_basis(Q: Array) -> Array:
    """Return T such that the points T^-1 Q, of unit norm, have sum Q Q^T = (m / 4) I.

    The fixed point of Q <- (sum Q Q^T / Q^T Q)^(-1/2) Q, Tyler's scatter iteration; an orthonormal
    change of basis is left open.

    Parameters
    ----------
    Q : ndarray, shape (m, 4)
        Homogeneous points, not all in one plane.

    Returns
    -------
    ndarray, shape (4, 4)
        The basis; where none exists (too many points in a plane or on a line) the last one reached.
    """
    if backend() == "c":
        T, points = np.empty((4, 4)), np.ascontiguousarray(Q)
        if function("spreading_basis")(len(points), address(points), address(T)):
            raise MemoryError(f"no memory for {len(points)} points")
        return T
    T = np.eye(4)
    moved = Q / np.linalg.norm(Q, axis=1, keepdims=True)
    for _ in range(200):
        values, vectors = np.linalg.eigh(moved.T @ moved * (4.0 / len(Q)))
        if values[0] <= 1e-14 or abs(values - 1.0).max() <= 1e-13:
            break
        T = T @ ((vectors * np.sqrt(values)) @ vectors.T)
        moved = moved @ ((vectors / np.sqrt(values)) @ vectors.T)
        moved = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    return T


def spread(Q: Array) -> tuple[Array, Array]:
    """Return the points T^-1 Q of unit norm, (m, 4), and T, the `spreading_basis`."""
    T = spreading_basis(Q)
    moved = np.linalg.solve(T, Q.T)
    return np.ascontiguousarray((moved / np.linalg.norm(moved, axis=0)).T), T


def scatter_constraints(Q: Array) -> Array:
    """Return the ten first-order constraints sum (Q dQ^T + dQ Q^T) = 0.

    Weighted such that the sum of their squares is that of the symmetric matrix' entries, which an
    orthonormal change of basis leaves alone.

    Parameters
    ----------
    Q : ndarray, shape (m, 4)
        Points.

    Returns
    -------
    ndarray, shape (m, 4, 10)
        Coefficients of dQ.
    """
    columns = []
    for a in range(4):
        for b in range(a, 4):
            column = np.zeros_like(Q)
            column[:, a] += Q[:, b]
            column[:, b] += Q[:, a]
            columns.append(column if a == b else np.sqrt(2.0) * column)
    return np.stack(columns, axis=2)
