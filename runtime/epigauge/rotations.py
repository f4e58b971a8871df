"""Rotations as matrices, quaternions (scalar first) and Rodrigues vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_real
from epigauge.errors import ArgumentError

Array = NDArray[np.float64]

#: How far R^T R may be from the identity.
_ORTHONORMAL = 1e-8


def as_rotation(name: str, value: ArrayLike) -> Array:
    """Return a rotation (3, 3) given as an argument."""
    matrix = as_real(name, value, "a (3, 3) rotation")
    known = matrix.shape == (3, 3) and np.isfinite(matrix).all()
    if not known or np.abs(matrix.T @ matrix - np.eye(3)).max() > _ORTHONORMAL:
        raise ArgumentError(name, "is no rotation", "R with R^T R = I")
    if np.linalg.det(matrix) < 0.0:
        raise ArgumentError(name, "is a reflection (determinant -1)", "a rotation")
    return matrix


def quaternion(R: Array) -> Array:
    """Return the unit quaternions (..., 4) of rotations (..., 3, 3), the scalar not negative."""
    # The largest of the four equations for the quaternion loses no digits.
    trace = np.trace(R, axis1=-2, axis2=-1)[..., None, None]
    skew = np.stack(
        [
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ],
        axis=-1,
    )
    matrix = np.empty((*R.shape[:-2], 4, 4))
    matrix[..., :1, :1] = trace
    matrix[..., :1, 1:] = skew[..., None, :]
    matrix[..., 1:, :1] = skew[..., :, None]
    matrix[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) - trace * np.eye(3)
    q = np.linalg.eigh(matrix)[1][..., 3]
    return np.asarray(np.where(q[..., :1] < 0.0, -q, q))


def rotation(q: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def product(p: Array, q: Array) -> Array:
    """Return the quaternions of R(p) R(q)."""
    a, b = p[..., :1], p[..., 1:]
    c, d = q[..., :1], q[..., 1:]
    scalar = a * c - np.sum(b * d, axis=-1, keepdims=True)
    return np.concatenate([scalar, a * d + c * b + np.cross(b, d)], axis=-1)


def from_rodrigues(w: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of axes times angles (..., 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    cross = np.cross(np.eye(3), w[..., None, :])
    # R = I + sin(a) / a [w]x + (1 - cos(a)) / a^2 [w]x^2
    half = np.sinc(angle / (2.0 * np.pi)) ** 2 / 2.0
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + half * (cross @ cross))


def rodrigues(R: Array) -> Array:
    """Return the axes of rotations times their angles, (..., 3), by their quaternions."""
    q = quaternion(R)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    still = sine == 0.0
    return np.asarray(q[..., 1:] * np.where(still, 0.0, angle / np.where(still, 1.0, sine)))
