"""A first reconstruction from random cameras: all views at once, by variable projection.

The pseudo object space error (pOSE) of Hong and Zach is bilinear in cameras and points and has no
pole at depth zero. Points are eliminated exactly, so that only the cameras are minimised over; the
basin of its minimum is wide enough for random cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.kernels import Table
from epigauge.multi_view.dampings import ByMatrix
from epigauge.multi_view.system import BundleSystem, Layout

__all__ = ["FactorizationProblem", "factorized"]

Array = NDArray[np.float64]

#: Stages as (eta, ridge, ftol): weight of the affine part, weight of a ridge relative to
#: `FactorizationProblem.unit`, and when to go on. The first stage is nearly affine, and its ridge
#: keeps what few observations determine from running away; the second leaves perspective free.
_STAGES = ((0.9, 0.1, 1e-3), (0.05, 1e-9, 1e-6))
_MAX_ITER = 300


class FactorizationProblem:
    """Pseudo object space error and a ridge, as a function of the cameras alone.

    0.5 sum |r|^2 + 0.5 ridge (sum |P_i without its last column|^2 + sum |X_j|^2), minimised over
    the points (X_j, 1) for given cameras. The ridge bounds the nuclear norm of the matrix of
    projections (Srebro's identity) and leaves only rotations of the basis free.

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
    eta : float
        Share of the affine camera's error.
    ridge : float
        Positive.
    """

    floor = 0.0

    def __init__(
        self, kernels: Table, layout: Layout, q: Array, weights: Array, eta: float, ridge: float
    ) -> None:
        self.kernels, self.layout, self.q = kernels, layout, q
        self.root, self.eta = np.sqrt(weights), np.array(eta)
        self.ridge = ridge * self.unit(layout)
        self.held = np.tile([1.0, 1.0, 1.0, 0.0], 3)

    @staticmethod
    def unit(layout: Layout) -> float:
        """Return the typical size of a block of the points' normal matrix.

        The three singular values of the matrix of projections are about the root of the number of
        observations N; cameras and points share them evenly, and a point is seen in the share
        N / (n m) of the views.
        """
        N = len(layout.view)
        return N / (layout.n_views * layout.n_points) * float(np.sqrt(N))

    def evaluate(self, P: Array) -> FactorizationState:
        """Return the state of cameras (n, 3, 4), with the points that fit them best."""
        layout = self.layout
        cameras = np.ascontiguousarray(P.transpose(1, 2, 0)[:, :, layout.view])
        r, _, J_X = self._residuals(cameras, np.zeros((layout.n_points, 3)))
        V = layout.sum_points(np.einsum("ikn,iln->nkl", J_X, J_X)) + self.ridge * np.eye(3)
        g = layout.sum_points(np.einsum("ikn,in->nk", J_X, r))
        X = -np.linalg.solve(V, g[..., None])[..., 0]
        r, J_P, _ = self._residuals(cameras, X)
        ridge = np.sum((self.held * P.reshape(-1, 12)) ** 2) + np.sum(X**2)
        cost = 0.5 * float(np.sum(r**2) + self.ridge * ridge)
        return FactorizationState(P, X, r, J_P, J_X, V, cost if np.isfinite(cost) else np.inf)

    def linearize(self, state: FactorizationState) -> BundleSystem:
        """Return the normal equations; the points have no gradient."""
        layout = self.layout
        J_P, J_X = state.J_P.transpose(2, 0, 1), state.J_X.transpose(2, 0, 1)
        J_P_T = np.swapaxes(J_P, 1, 2)
        g = layout.sum_views((J_P_T @ state.r.T[..., None])[..., 0])
        return BundleSystem(
            layout,
            U=layout.sum_views(J_P_T @ J_P) + self.ridge * np.diag(self.held),
            V=state.V,
            W=J_P_T @ J_X,
            g_cameras=g + self.ridge * self.held * state.P.reshape(-1, 12),
            g_points=np.zeros_like(state.X),
        )

    def retract(self, state: FactorizationState, step: Array) -> Array:
        """Return the cameras that a step leads to; its points are found anew."""
        return np.asarray(state.P + step[: state.P.size].reshape(state.P.shape))

    def _residuals(self, cameras: Array, X: Array) -> tuple[Array, Array, Array]:
        points = np.ascontiguousarray(X.T[:, self.layout.point])
        found = self.kernels.pseudo_object_space(self.eta, cameras, points, self.q)
        r, J_P, J_X = (self.root * part for part in found)
        return r, J_P, J_X


@dataclass(frozen=True)
class FactorizationState:
    """Cameras with their best points, residuals (4, N), Jacobians, point blocks and cost."""

    P: Array
    X: Array
    r: Array
    J_P: Array
    J_X: Array
    V: Array
    cost: float


class _OnCameras(ByMatrix):
    """lambda I on the cameras only: with exact points this is variable projection (RW2)."""

    def start(self, system: BundleSystem) -> float:
        """Return a small fraction of the largest diagonal entry."""
        return 1e-6 * system.largest()

    def matrix(self, system: BundleSystem) -> tuple[Array, Array]:
        """Return identities and zeros."""
        n, a = system.g_cameras.shape
        return np.broadcast_to(np.eye(a), (n, a, a)), np.zeros_like(system.V)


def factorized(
    kernels: Table, layout: Layout, q: Array, weights: Array, seed: int
) -> tuple[Array, Array]:
    """Return cameras (n, 3, 4) and points (m, 4) from random affine cameras.
    """
    random = np.random.default_rng(seed)
    P = random.normal(size=(layout.n_views, 3, 4))
    P[:, 2] = 0.0, 0.0, 0.0, 1.0
    for eta, ridge, ftol in _STAGES:
        problem = FactorizationProblem(kernels, layout, q, weights, eta, ridge)
        stopping = lm.Stopping(ftol=ftol, xtol=0.0, gtol=0.0, max_iter=_MAX_ITER)
        state = lm.minimize(problem, P, _OnCameras(), lm.Classic(), stopping).state
        P = state.P
    return P, np.column_stack([state.X, np.ones(len(state.X))])
