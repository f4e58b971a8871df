"""What evaluates the many-view problem: costs, normal equations, triangulation.

`Reference` is NumPy over the generated kernels of any back end, and stores all Jacobians; `Fused`
(module `fused`) passes over the observations of each point in C and stores none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.multi_view.coupling import Coupling, StoredCoupling
from epigauge.multi_view.layout import Layout
from epigauge.two_view.losses import Loss

__all__ = [
    "LEAST_WEIGHT",
    "Engine",
    "Normal",
    "Reference",
    "Triangulation",
    "normal_equations",
]

Array = NDArray[np.float64]

#: Least weight in the normal equations, of the largest: what only observations without weight (or
#: beyond a truncated loss) determine stays determined, and does not influence the rest.
LEAST_WEIGHT = 1e-8


@dataclass(frozen=True)
class Triangulation:
    """How a point is moved, all cameras kept: covariantly damped Gauss-Newton of its own.

    Attributes
    ----------
    iterations : int
        Most steps tried.
    lam, factor : float
        First lambda, and what it is divided or multiplied by.
    tolerance : float
        A point is done where a step promises to lower its cost by less than this share.
    """

    iterations: int = 5
    lam: float = 1e-3
    factor: float = 10.0
    tolerance: float = 1e-12


#: Places of the entries of a symmetric 4x4 matrix in its upper triangle, row by row.
_SYMMETRIC = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])


class Normal(NamedTuple):
    """Normal equations: blocks (n, 12, 12) and (m, 4, 4), gradient, depth blocks if at hand."""

    U: Array
    V: Array
    coupling: Coupling
    g_cameras: Array
    g_points: Array
    depth_blocks: tuple[Array, Array] | None = None


def normal_equations(layout: Layout, A: Array, B: Array, r: Array) -> Normal:
    """Return the normal equations of Jacobians by camera and point, and of residuals.

    Parameters
    ----------
    layout : Layout
        Which observation belongs to what.
    A, B, r : ndarray, shape (k, a, N), (k, b, N), (k, N)
        Weighted, k residuals an observation.
    """
    by_view = np.ascontiguousarray(A[:, :, layout.by_view])
    size = A.shape[1]
    U = np.empty((layout.n_views, size, size))
    for i in range(layout.n_views):
        rows = slice(layout.first_in_view[i], layout.first_in_view[i + 1])
        J = by_view[:, :, rows].transpose(1, 0, 2).reshape(size, -1)
        U[i] = J @ J.T
    J_camera, J_point = A.transpose(2, 0, 1), B.transpose(2, 0, 1)
    J_camera_T = np.swapaxes(J_camera, 1, 2)
    J_point_T = np.swapaxes(J_point, 1, 2)
    residual = r.T[..., None]
    return Normal(
        U=U,
        V=layout.sum_points(J_point_T @ J_point),
        coupling=StoredCoupling(layout, J_camera_T @ J_point),
        g_cameras=layout.sum_views((J_camera_T @ residual)[..., 0]),
        g_points=layout.sum_points((J_point_T @ residual)[..., 0]),
    )


class Engine(Protocol):
    """Evaluates cameras P (n, 3, 4) and points Q (m, 4)."""

    def point_costs(self, P: Array, Q: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""

    def distances(self, P: Array, Q: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""

    def intersected(self, P: Array) -> Array:
        """Return the points of least algebraic error, unit vectors (m, 4): lines of sight meet."""

    def linearize(self, P: Array, Q: Array) -> Normal:
        """Return the normal equations."""

    def depth_blocks(self, P: Array, Q: Array) -> tuple[Array, Array]:
        """Return the diagonal blocks of Z^T Z, Z = d log depth / d(P, Q) weighted as residuals."""

    def triangulated(self, P: Array, Q: Array, how: Triangulation) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""


@dataclass(frozen=True)
class Reference:
    """The evaluation observation by observation, all Jacobians stored."""

    kernels: Table
    layout: Layout
    q: Array
    weights: Array
    loss: Loss

    def residuals(self, P: Array, Q: Array) -> Array:
        """Return r = q - q_hat, (2, N)."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return self._project(P, Q)[0]

    def jacobians(self, P: Array, Q: Array) -> tuple[Array, Array]:
        """Return the derivatives of q_hat by camera and point, (2, 12, N) and (2, 4, N)."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return self._project(P, Q)[1:]

    def roots(self, r: Array) -> Array:
        """Return the root of each observation's weight, that of the robust loss included, (N,)."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.sqrt(self._effective(self.loss(np.sum(r**2, axis=0))[1]))

    def point_costs(self, P: Array, Q: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return self._point_costs(self._project(P, Q)[0])[0]

    def distances(self, P: Array, Q: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray(np.linalg.norm(self.residuals(P, Q), axis=0))

    def intersected(self, P: Array) -> Array:
        """Return the points of least algebraic error, unit vectors (m, 4): lines of sight meet."""
        cameras = np.ascontiguousarray(P.transpose(1, 2, 0)[:, :, self.layout.view])
        upper = self.kernels.sight_normal(cameras, self.q, np.ones(self.q.shape[1]))
        gram = self.layout.sum_points(upper.T)[:, _SYMMETRIC]
        return np.asarray(np.linalg.eigh(gram)[1][:, :, 0])

    def linearize(self, P: Array, Q: Array) -> Normal:
        """Return the normal equations."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # A start with a point in a focal plane has no finite blocks; its cost stops the run.
            r, J_P, J_Q = self._project(P, Q)
            root = self.roots(r)
            return normal_equations(self.layout, -root * J_P, -root * J_Q, root * r)

    def depth_blocks(self, P: Array, Q: Array) -> tuple[Array, Array]:
        """Return the diagonal blocks of Z^T Z, Z = d log depth / d(P, Q) weighted as residuals."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            root = self.roots(self._project(P, Q)[0])
            Z_P, Z_Q = (root * Z for Z in self._log_depths(P, Q))
        # A depth depends on the last row of its camera only.
        row = Z_P[8:].T
        cameras = np.zeros((self.layout.n_views, 12, 12))
        cameras[:, 8:, 8:] = self.layout.sum_views(row[:, :, None] * row[:, None, :])
        return cameras, self.layout.sum_points(Z_Q.T[:, :, None] * Z_Q.T[:, None, :])

    def triangulated(self, P: Array, Q: Array, how: Triangulation) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""
        layout = self.layout
        lam = np.full(layout.n_points, how.lam)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            r, _, J = self._project(P, Q)
            cost, weight = self._point_costs(r)
            for _ in range(how.iterations):
                B = np.sqrt(weight) * J
                V = layout.sum_points(np.einsum("ikn,iln->nkl", B, B))
                g = -layout.sum_points(np.einsum("ikn,in->nk", B, np.sqrt(weight) * r))
                Z = np.sqrt(weight) * self._log_depths(P, Q)[1]
                damping = V + layout.sum_points(Z.T[:, :, None] * Z.T[:, None, :])
                step = -_solved(V + lam[:, None, None] * damping, g)
                moving = -np.sum(g * step, axis=1) > how.tolerance * cost
                if not moving.any():
                    break
                trial = Q + step
                r_trial, _, J_trial = self._project(P, trial)
                cost_trial, weight_trial = self._point_costs(r_trial)
                better = moving & (cost_trial < cost)
                rows = better[layout.point]
                Q = np.where(better[:, None], trial, Q)
                r, J = np.where(rows, r_trial, r), np.where(rows, J_trial, J)
                weight = np.where(rows, weight_trial, weight)
                cost = np.where(better, cost_trial, cost)
                lam = np.where(better, lam / how.factor, lam * how.factor)
        return Q, cost

    def _point_costs(self, r: Array) -> tuple[Array, Array]:
        rho, first, _ = self.loss(np.sum(r**2, axis=0))
        return self.layout.sum_points(self.weights * rho), self._effective(first)

    def _effective(self, first: Array) -> Array:
        least = LEAST_WEIGHT * float(np.max(self.weights))
        return np.asarray(np.maximum(self.weights * first, least))

    def _project(self, P: Array, Q: Array) -> tuple[Array, Array, Array]:
        cameras, points = self._gathered(P, Q)
        q_hat, J_P, J_Q, _ = self.kernels.project(cameras, points)
        return self.q - q_hat, J_P, J_Q

    def _log_depths(self, P: Array, Q: Array) -> tuple[Array, Array]:
        Z_P, Z_Q = self.kernels.log_depth_derivatives(*self._gathered(P, Q))
        return Z_P, Z_Q

    def _gathered(self, P: Array, Q: Array) -> tuple[Array, Array]:
        cameras = np.ascontiguousarray(P.transpose(1, 2, 0)[:, :, self.layout.view])
        return cameras, np.ascontiguousarray(Q.T[:, self.layout.point])


def _solved(A: Array, b: Array) -> Array:
    """Return A^-1 b for each of many symmetric systems, A^+ b where one is singular to rounding."""
    try:
        return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.asarray((np.linalg.pinv(A, hermitian=True) @ b[..., None])[..., 0])
