"""FREE and NORMALIZED of B&S section 5: both cameras and homogeneous points, all entries free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.linear import Arrow
from epigauge.scatter import scatter_constraints, spreading_basis
from epigauge.two_view.joint import first_structure, reweighted
from epigauge.two_view.losses import Loss
from epigauge.two_view.parameterizations import factorize

__all__ = ["FreeProblem", "FreeState", "fundamental_from_cameras"]

Array = NDArray[np.float64]
Estimate = tuple[Array, Array]  # cameras (2, 3, 4) and points (4, m)

_OTHERS = ([1, 2], [2, 0], [0, 1])


def fundamental_from_cameras(cameras: Array) -> Array:
    """Return F of two cameras: entry (i, j) is a determinant without row j of P, row i of P'."""
    first, second = cameras / np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    blocks = [
        [np.vstack([first[_OTHERS[j]], second[_OTHERS[i]]]) for j in range(3)] for i in range(3)
    ]
    return np.asarray(np.linalg.det(np.array(blocks)))


@dataclass(frozen=True)
class FreeState:
    """Cameras and points, residuals with their Jacobian blocks, root weights and cost."""

    motion: Array
    Q: Array
    r: Array
    J_P: Array
    J_Q: Array
    root: Array
    cost: float


class FreeProblem:
    """Robust weighted sum of squared residuals as a function of 24 + 4 m homogeneous entries.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    weights : ndarray, shape (m,)
        Factor of the cost of each match.
    loss : Loss
        Applied to the squared residual of each match.
    normalized : bool
        NORMALIZED: the estimate is moved to the normalised basis before each iteration, and the
        first-order constraints that keep it there are added to the normal equations.
    """

    def __init__(
        self, kernels: Table, q1: Array, q2: Array, weights: Array, loss: Loss, normalized: bool
    ) -> None:
        self.kernels = kernels
        self.q = np.concatenate([q1, q2])
        self.weights, self.loss = weights, loss
        self.normalized = normalized
        self.floor = 0.5 * float(np.sum(weights)) * 1e-30

    def start(self, F: Array) -> Estimate:
        """Return the canonic cameras and the points of smallest reprojection error."""
        factors = factorize(F)
        P2 = self.kernels.canonical_camera(*factors)
        F = self.kernels.fundamental_from_factors(*factors)
        a, b, c = first_structure(self.kernels, F, P2, self.q[:2], self.q[2:])
        cameras = np.stack([np.eye(3, 4), P2])
        return self._settled(cameras, np.stack([a, b, np.ones_like(a), c]))

    def evaluate(self, estimate: Estimate) -> FreeState:
        """Return the state of cameras and points."""
        cameras, Q = estimate
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            views = [self.kernels.project(P[..., None], Q) for P in cameras]
            r = self.q - np.concatenate([q_hat for q_hat, _, _, _ in views])
            cost, root = reweighted(r, self.weights, self.loss)
        J_P = -np.stack([J for _, J, _, _ in views])
        J_Q = -np.concatenate([J for _, _, J, _ in views])
        return FreeState(cameras, Q, r, J_P, J_Q, root, cost)

    def linearize(self, state: FreeState) -> Arrow:
        """Return the normal equations, with the gauge constraints where they are wanted."""
        m = state.Q.shape[1]
        r, J_Q = state.root * state.r, state.root * state.J_Q
        A = np.zeros((24, 4, m))
        A[:12, :2] = np.swapaxes(state.root * state.J_P[0], 0, 1)
        A[12:, 2:] = np.swapaxes(state.root * state.J_P[1], 0, 1)
        flat = A.reshape(24, 4 * m)
        U = flat @ flat.T
        V = np.einsum("ikm,ilm->mkl", J_Q, J_Q)
        border = None
        if self.normalized:
            # Weighted like the rest of the system, so that damping sees no foreign scale.
            weight = float(np.mean(np.einsum("mkk->mk", V)))
            for k in (0, 1):
                P = state.motion[k].ravel()
                U[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] += weight * np.outer(P, P)
            V = V + weight * np.einsum("km,lm->mkl", state.Q, state.Q)
            border = np.sqrt(weight) * scatter_constraints(state.Q.T)
        return Arrow(
            U=U,
            W=np.einsum("pim,ikm->mpk", A, J_Q),
            V=V,
            g_motion=flat @ r.ravel(),
            g_points=np.einsum("ikm,im->mk", J_Q, r),
            border=border,
        )

    def retract(self, state: FreeState, step: Array) -> Estimate:
        """Return cameras and points that a step leads to."""
        return self.moved((state.motion, state.Q), step[:24], step[24:].reshape(-1, 4).T)

    def cameras(self, motion: Array) -> tuple[Array, Array]:
        """Return both cameras, one below the other, and the derivative of their entries."""
        return motion.reshape(6, 4), np.eye(24)

    def moved(self, estimate: Estimate, motion: Array, points: Array) -> Estimate:
        """Return cameras and points moved by steps (24,) and (4, m), in the wanted basis."""
        cameras, Q = estimate
        return self._settled(cameras + motion.reshape(2, 3, 4), Q + points)

    def fundamental(self, motion: Array) -> Array:
        """Return F of two cameras."""
        return fundamental_from_cameras(motion)

    def _settled(self, cameras: Array, Q: Array) -> Estimate:
        if not self.normalized:
            return cameras, Q
        T = spreading_basis(Q.T)
        cameras, points = cameras @ T, np.asarray(np.linalg.solve(T, Q))
        sizes = np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
        return cameras / sizes, points / np.linalg.norm(points, axis=0)
