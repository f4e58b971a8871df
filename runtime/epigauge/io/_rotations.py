"""Rotations in the forms that files hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def quaternion(R: Array) -> Array:
    """Return the unit quaternion of a rotation matrix (3, 3), scalar first, of either sign."""
    # The largest of the four equations for the quaternion loses no digits.
    xx, yy, zz = np.diag(R)
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    even = R + R.T - np.trace(R) * np.eye(3)
    Q = np.block([[np.array([[xx + yy + zz]]), skew[None]], [skew[:, None], even]])
    return np.asarray(np.linalg.eigh(Q)[1][:, 3])
