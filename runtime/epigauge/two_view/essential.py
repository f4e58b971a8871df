"""The motion of calibrated cameras from their essential matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["motion_from_essential"]

Array = NDArray[np.float64]

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def motion_from_essential(E: Array, rays1: Array, rays2: Array) -> tuple[Array, Array]:
    """Choose among the four motions of an essential matrix (cheirality).

    Parameters
    ----------
    E : ndarray, shape (3, 3)
        Essential matrix ``[t]x R``, of any scale and sign.
    rays1, rays2 : ndarray, shape (m, 3)
        Corrected matches as directions in the camera frames: ``rays2^T E rays1 = 0``.

    Returns
    -------
    R : ndarray, shape (3, 3)
        Rotation with x2 = R x1 + t.
    t : ndarray, shape (3,)
        Of unit length.

    Notes
    -----
    Of the four motions, the one with most points in front of both cameras is returned.
    """
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.linalg.det(U), Vt * np.linalg.det(Vt)
    motions = [
        (U @ turn @ Vt, sign * U[:, 2])
        for turn in (_QUARTER_TURN, _QUARTER_TURN.T)
        for sign in (1.0, -1.0)
    ]
    in_front = [_count_in_front(R, t, rays1, rays2) for R, t in motions]
    return motions[int(np.argmax(in_front))]


def _count_in_front(R: Array, t: Array, rays1: Array, rays2: Array) -> int:
    """Count the points with positive depths: depth2 rays2 = depth1 R rays1 + t."""
    turned = rays1 @ R.T
    normal = np.cross(turned, rays2)
    # Crossed with either ray: depth1 (turned x rays2) = rays2 x t, depth2 (same) = turned x t
    depth1 = np.sum(np.cross(rays2, t) * normal, axis=1)
    depth2 = np.sum(np.cross(turned, t) * normal, axis=1)
    return int(np.count_nonzero((depth1 > 0.0) & (depth2 > 0.0)))
