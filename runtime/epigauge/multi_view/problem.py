"""The projective bundle adjustment problem: cameras P (n, 3, 4) and points Q (m, 4), all free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.multi_view.system import BundleSystem, Layout
from epigauge.two_view.losses import Loss

__all__ = ["BundleProblem", "BundleState", "Linearized"]

Array = NDArray[np.float64]

#: Embedded point iterations a trial, and the first and the factor of their damping.
_POINT_ITERATIONS = 5
_POINT_LAM, _POINT_FACTOR = 1e-3, 10.0

#: Least weight in the normal equations, of the largest: what only observations without weight (or
#: beyond a truncated loss) determine stays determined, and does not influence the rest.
_LEAST_WEIGHT = 1e-8


@dataclass(frozen=True)
class BundleState:
    """Cameras and points with residuals, Jacobians, root weights and cost.

    Attributes
    ----------
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        The estimate.
    r, J_P, J_Q : ndarray, shape (2, N), (2, 12, N), (2, 4, N)
        Residuals r = q - q_hat and the Jacobians of q_hat.
    root : ndarray, shape (N,)
        Root of each observation's weight, that of the robust loss included.
    cost : float
        0.5 * weighted robust sum.
    """

    P: Array
    Q: Array
    r: Array
    J_P: Array
    J_Q: Array
    root: Array
    cost: float


@dataclass(frozen=True)
class Linearized(BundleSystem):
    """Normal equations that remember the problem and the state they were made at."""

    problem: BundleProblem | None = None
    state: BundleState | None = None


class BundleProblem:
    """Robust weighted sum of squared residuals as a function of all cameras and points.

    Parameters
    ----------
    kernels : Table
        Backend.
    layout : Layout
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Conditioned measurements.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    loss : Loss
        Applied to each squared residual.
    embedded : bool
        After each step re-triangulate every point (variable projection).
    """

    def __init__(
        self,
        kernels: Table,
        layout: Layout,
        q: Array,
        weights: Array,
        loss: Loss,
        embedded: bool = False,
    ) -> None:
        self.kernels, self.layout = kernels, layout
        self.q, self.weights, self.loss = q, weights, loss
        self.embedded = embedded
        # Conditioned coordinates are of order one; products of P and Q round a few times.
        self.floor = 0.5 * float(np.sum(weights)) * 1e-28

    def evaluate(self, estimate: tuple[Array, Array]) -> BundleState:
        """Return the state of cameras and points."""
        P, Q = estimate
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # A point may fall onto a focal plane: the trial is then rejected by its cost.
            r, J_P, J_Q = self._project(P, Q)
            rho, first, _ = self.loss(np.sum(r**2, axis=0))
            cost = 0.5 * float(np.sum(self.weights * rho))
        cost = cost if np.isfinite(cost) else float("inf")
        return BundleState(P, Q, r, J_P, J_Q, np.sqrt(self._effective(first)), cost)

    def linearize(self, state: BundleState) -> Linearized:
        """Return the normal equations."""
        with np.errstate(invalid="ignore", over="ignore"):
            # A start with a point in a focal plane has no finite blocks; its cost stops the run.
            return self._linearized(state)

    def _linearized(self, state: BundleState) -> Linearized:
        A = -state.root * state.J_P
        B = -state.root * state.J_Q
        r = state.root * state.r
        layout = self.layout
        by_view = np.ascontiguousarray(A[:, :, layout.by_view])
        U = np.empty((layout.n_views, 12, 12))
        for i in range(layout.n_views):
            rows = slice(layout.first_in_view[i], layout.first_in_view[i + 1])
            J = by_view[:, :, rows].transpose(1, 0, 2).reshape(12, -1)
            U[i] = J @ J.T
        J_camera, J_point = A.transpose(2, 0, 1), B.transpose(2, 0, 1)
        J_camera_T = np.swapaxes(J_camera, 1, 2)
        J_point_T = np.swapaxes(J_point, 1, 2)
        residual = r.T[..., None]
        return Linearized(
            layout,
            U=U,
            V=layout.sum_points(J_point_T @ J_point),
            W=J_camera_T @ J_point,
            g_cameras=layout.sum_views((J_camera_T @ residual)[..., 0]),
            g_points=layout.sum_points((J_point_T @ residual)[..., 0]),
            problem=self,
            state=state,
        )

    def retract(self, state: BundleState, step: Array) -> tuple[Array, Array]:
        """Return the estimate that a step leads to."""
        P = state.P + step[: state.P.size].reshape(state.P.shape)
        Q = state.Q + step[state.P.size :].reshape(state.Q.shape)
        return P, self.triangulated(P, Q) if self.embedded else Q

    def depth_blocks(self, state: BundleState) -> tuple[Array, Array]:
        """Return the diagonal blocks of Z^T Z, Z = d log depth / d(P, Q) weighted as residuals."""
        Z_P, Z_Q = (state.root * Z for Z in self._log_depths(state.P, state.Q))
        # A depth depends on the last row of its camera only.
        row = Z_P[8:].T
        cameras = np.zeros((self.layout.n_views, 12, 12))
        cameras[:, 8:, 8:] = self.layout.sum_views(row[:, :, None] * row[:, None, :])
        return cameras, self.layout.sum_points(Z_Q.T[:, :, None] * Z_Q.T[:, None, :])

    def triangulated(self, P: Array, Q: Array) -> Array:
        """Return the points after a few covariantly damped Gauss-Newton iterations of their own."""
        layout = self.layout
        lam = np.full(layout.n_points, _POINT_LAM)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            r, _, J = self._project(P, Q)
            cost, weight = self._point_costs(r)
            if not np.isfinite(cost).all():
                return Q
            for _ in range(_POINT_ITERATIONS):
                B = np.sqrt(weight) * J
                V = layout.sum_points(np.einsum("ikn,iln->nkl", B, B))
                g = -layout.sum_points(np.einsum("ikn,in->nk", B, np.sqrt(weight) * r))
                Z = np.sqrt(weight) * self._log_depths(P, Q)[1]
                damping = V + layout.sum_points(Z.T[:, :, None] * Z.T[:, None, :])
                trial = Q - _solved(V + lam[:, None, None] * damping, g)
                r_trial, _, J_trial = self._project(P, trial)
                cost_trial, weight_trial = self._point_costs(r_trial)
                better = cost_trial < cost
                if not better.any():
                    lam *= _POINT_FACTOR
                    continue
                rows = better[layout.point]
                Q = np.where(better[:, None], trial, Q)
                r, J = np.where(rows, r_trial, r), np.where(rows, J_trial, J)
                weight = np.where(rows, weight_trial, weight)
                settled = np.all(cost - np.where(better, cost_trial, cost) <= 1e-12 * cost)
                cost = np.where(better, cost_trial, cost)
                lam = np.where(better, lam / _POINT_FACTOR, lam * _POINT_FACTOR)
                if settled:
                    break
        return Q

    def _point_costs(self, r: Array) -> tuple[Array, Array]:
        rho, first, _ = self.loss(np.sum(r**2, axis=0))
        return self.layout.sum_points(self.weights * rho), self._effective(first)

    def _effective(self, first: Array) -> Array:
        least = _LEAST_WEIGHT * float(np.max(self.weights))
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
