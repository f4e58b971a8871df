"""The gauge freedom as the null space of J^T J, and the pseudo-inverse that follows from it.

The scales of cameras and points and the sixteen generators of gl(4), with one relation between
them: rank 15 + n + m.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.multi_view.system import BundleSystem

__all__ = ["generators", "minimum_norm_step", "project_out", "scales"]

Array = NDArray[np.float64]


def scales(P: Array, Q: Array) -> tuple[Array, Array]:
    """Return the unit directions in which cameras (n, 12) and points (m, 4) only change scale."""
    cameras = P.reshape(len(P), 12)
    cameras = cameras / np.linalg.norm(cameras, axis=1, keepdims=True)
    return cameras, Q / np.linalg.norm(Q, axis=1, keepdims=True)


def generators(kernels: Table, P: Array, Q: Array) -> Array:
    """Return an orthonormal basis (12 n + 4 m, 15) of the changes of basis, beside the scales."""
    cameras = kernels.camera_generators(P.transpose(1, 2, 0)).transpose(2, 0, 1)
    points = kernels.point_generators(Q.T).transpose(2, 0, 1)
    p, q = scales(P, Q)
    cameras = cameras - p[:, :, None] * np.einsum("ni,nik->nk", p, cameras)[:, None]
    points = points - q[:, :, None] * np.einsum("ni,nik->nk", q, points)[:, None]
    moves = np.concatenate([cameras.reshape(-1, 16), points.reshape(-1, 16)])
    # The identity only changes scales: one of the sixteen columns is dependent.
    return np.asarray(np.linalg.svd(moves, full_matrices=False)[0][:, :15])


def project_out(kernels: Table, P: Array, Q: Array, step: Array) -> Array:
    """Return a step without its part along the gauge freedom."""
    size = P.size
    p, q = scales(P, Q)
    cameras, points = step[:size].reshape(-1, 12), step[size:].reshape(-1, 4)
    cameras = cameras - p * np.sum(p * cameras, axis=1, keepdims=True)
    points = points - q * np.sum(q * points, axis=1, keepdims=True)
    step = np.concatenate([cameras.ravel(), points.ravel()])
    G = generators(kernels, P, Q)
    return np.asarray(step - G @ (G.T @ step))


def minimum_norm_step(kernels: Table, system: BundleSystem, P: Array, Q: Array) -> Array:
    """Return -N^+ g: any solution of N delta = -g, less its part along the null space.

    Parameters
    ----------
    kernels : Table
        Backend.
    system : BundleSystem
        Undamped, of all 12 n + 4 m parameters.
    P, Q : ndarray
        The estimate.

    Returns
    -------
    ndarray, shape (12 n + 4 m,)
        The solution of least norm.
    """
    p, q = scales(P, Q)
    # Each block in its own measure: scales of cameras and points may be worlds apart.
    u, v = np.einsum("nii->n", system.U), np.einsum("nii->n", system.V)
    grounded = replace(
        system,
        U=system.U + u[:, None, None] * p[:, :, None] * p[:, None, :],
        V=system.V + v[:, None, None] * q[:, :, None] * q[:, None, :],
    )
    # The cameras' part of the fifteen changes of basis makes the reduced system definite.
    moves = generators(kernels, P, Q)[: P.size]
    step = grounded.solve_grounded(np.sqrt(np.max(u)) * moves)
    return project_out(kernels, P, Q, step)
