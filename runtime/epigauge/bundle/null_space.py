"""The gauge freedom as the null space of J^T J, and the pseudo-inverse that follows from it.

The generators of a model's gauge group are derived with its formulas; where points are homogeneous,
the scales of cameras and points come beside.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.solve import BundleSystem, Step
from epigauge.cameras import CameraModel
from epigauge.kernels import Table

__all__ = ["generators", "minimum_norm_step", "scales"]

Array = NDArray[np.float64]


def scales(cameras: Array, points: Array) -> tuple[Array, Array]:
    """Return the unit directions in which rows of cameras and points only change scale."""
    p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (cameras, points))
    return p, q


def generators(
    model: CameraModel, kernels: Table, cameras: Array, points: Array
) -> tuple[Array, Array]:
    """Return the velocities of cameras (n, d, g) and points (m, b, g) in own tangents."""
    of_cameras = getattr(kernels, f"{model.prefix}_camera_generators")(cameras.T)
    of_points = getattr(kernels, f"{model.prefix}_point_generators")(points.T)
    return of_cameras.transpose(2, 0, 1), of_points.transpose(2, 0, 1)


def minimum_norm_step(system: BundleSystem, kernels: Table) -> Step:
    """Return -N^+ g in the unknowns: any solution of N delta = -g, less its part along the gauge.

    With the inner constraints of photogrammetry the same step: it is orthogonal to all motions that
    change no image.

    Parameters
    ----------
    system : BundleSystem
        Undamped, nothing that moves with the gauge being fixed.
    kernels : Table
        Back end.
    """
    model, ties = system.model, system.ties
    of_cameras, of_points = generators(model, kernels, system.cameras, system.points)
    x, y = ties.local(of_cameras), ties.of_points(of_points)
    U, V = system.U, system.V
    u = np.einsum("nii->n", U)
    if model.homogeneous:
        p, q = scales(system.cameras, system.points)
        # Each block in its own measure: scales of cameras and points may be worlds apart.
        v = np.einsum("nii->n", V)
        grounded = replace(
            system.normal,
            U=system.normal.U + u[:, None, None] * p[:, :, None] * p[:, None, :],
            V=system.normal.V + v[:, None, None] * q[:, :, None] * q[:, None, :],
        )
        system = replace(system, normal=grounded)
        V = system.V
        x, y = _across(p, x), _across(q, y)
    n, a, g = x.shape
    moves = np.concatenate([x.reshape(n * a, g), y.reshape(-1, g)])
    G = np.linalg.svd(moves, full_matrices=False)[0][:, : model.gauge_dimension]
    # The cameras' part of the gauge makes the reduced system definite.
    g_x, g_s, g_y = system.gradients
    root, half = system.inverse_roots(V, V, 0.0, g_y)
    S = system.reduced(root)
    size = n * a
    lifted = np.sqrt(np.max(u)) * G[:size]
    S[:size, :size] += lifted @ lifted.T
    right = system.normal.coupling.to_cameras(system.own_roots(root), half)[..., None]
    rhs = np.concatenate(
        [(ties.local(right)[..., 0] - g_x).ravel(), ties.shared(right)[:, 0] - g_s]
    )
    found = np.linalg.solve(S, rhs)
    step_x, step_s = found[:size].reshape(n, a), found[size:]
    own = ties.cameras(step_x[..., None], step_s[:, None])[..., 0]
    coupled = system.normal.coupling.to_points(system.own_roots(root), own)
    step_y = -np.einsum("mij,mj->mi", root, half + coupled[:, : root.shape[2]])
    if model.homogeneous:
        step_x, step_y = (
            _across(p, step_x[..., None])[..., 0],
            _across(q, step_y[..., None])[..., 0],
        )
    along = G.T @ np.concatenate([step_x.ravel(), step_y.ravel()])
    step_x = step_x - (G[:size] @ along).reshape(n, a)
    step_y = step_y - (G[size:] @ along).reshape(step_y.shape)
    return system.step_of(step_x, step_s, step_y)


def _across(directions: Array, vectors: Array) -> Array:
    """Return vectors (n, d, k) without their parts along unit directions (n, d)."""
    along = np.einsum("nd,ndk->nk", directions, vectors)
    return np.asarray(vectors - directions[:, :, None] * along[:, None])
