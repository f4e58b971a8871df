"""Bundle adjustment of B&S Table 1: motion and one point a match, sparse normal equations.

Camera P = (I | 0), camera P' from the parameterisation, points (a, b, 1, c).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.linear import Arrow
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.losses import Loss

__all__ = ["CanonicMotion", "JointProblem", "JointState", "intersect"]

Array = NDArray[np.float64]


class CanonicMotion(Protocol):
    """What the joint problem needs of a parameterisation."""

    @property
    def dimension(self) -> int:
        """Return the number of motion parameters."""

    def start(self, F: Array) -> Any:
        """Return the representation of a start value."""

    def fundamental(self, estimate: Any) -> Array:
        """Return F."""

    def camera(self, estimate: Any) -> tuple[Array, Array]:
        """Return P' and its derivative by the motion parameters."""

    def retract(self, estimate: Any, delta: Array) -> Any:
        """Return the moved estimate."""


def intersect(P2: Array, q1_hat: Array, q2_hat: Array) -> Array:
    """Return the points (a, b, 1, c) that project to corrected matches.

    Parameters
    ----------
    P2 : ndarray, shape (3, 4)
        Second camera; the first is (I | 0).
    q1_hat, q2_hat : ndarray, shape (2, m)
        Matches that satisfy the epipolar geometry.

    Returns
    -------
    ndarray, shape (3, m)
        (a, b, c) of each point. On the epipole c is not determined and comes out as zero.
    """
    h = P2[:, :2] @ q1_hat + P2[:, 2:3]
    e = P2[:, 3:4]
    across = e[:2] - q2_hat * e[2]
    beside = q2_hat * h[2] - h[:2]
    length = np.sum(across**2, axis=0)
    c = np.sum(beside * across, axis=0) / np.where(length > 0.0, length, 1.0)
    return np.concatenate([q1_hat, c[None]])


def first_structure(kernels: Table, F: Array, P2: Array, q1: Array, q2: Array) -> Array:
    """Return the points of smallest reprojection error, (3, m), as B&S start with."""
    criterion = Reprojection(kernels, q1, q2)
    q1_hat, q2_hat, _ = criterion.corrected(criterion.evaluate(F))
    return intersect(P2, q1_hat, q2_hat)


def reweighted(r: Array, weights: Array, loss: Loss) -> tuple[float, Array]:
    """Return the robust cost of residuals (k, m), and the root of each match's weight."""
    rho, first, _ = loss(np.sum(r**2, axis=0))
    cost = 0.5 * float(np.sum(weights * rho))
    return cost if np.isfinite(cost) else float("inf"), np.sqrt(weights * first)


@dataclass(frozen=True)
class JointState:
    """Motion and structure, residuals with their Jacobian blocks, root weights and cost."""

    motion: Any
    S: Array
    camera_derivative: Array
    r: Array
    J_S: Array
    J_P2: Array
    root: Array
    cost: float


class JointProblem:
    """Robust weighted sum of squared residuals as a function of motion and structure.

    Parameters
    ----------
    kernels : Table
        Backend.
    parameterization : CanonicMotion
        Gives the second camera.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    weights : ndarray, shape (m,)
        Factor of the cost of each match.
    loss : Loss
        Applied to the squared residual of each match.
    """

    def __init__(
        self,
        kernels: Table,
        parameterization: CanonicMotion,
        q1: Array,
        q2: Array,
        weights: Array,
        loss: Loss,
    ) -> None:
        self.kernels = kernels
        self.parameterization = parameterization
        self.q = np.concatenate([q1, q2])
        self.weights, self.loss = weights, loss
        self.floor = 0.5 * float(np.sum(weights)) * 1e-30

    def start(self, F: Array) -> tuple[Any, Array]:
        """Return motion and structure of a start value, each point at its foot point."""
        motion = self.parameterization.start(F)
        F, (P2, _) = self.parameterization.fundamental(motion), self.parameterization.camera(motion)
        return motion, first_structure(self.kernels, F, P2, self.q[:2], self.q[2:])

    def evaluate(self, estimate: tuple[Any, Array]) -> JointState:
        """Return the state of motion and structure."""
        motion, S = estimate
        P2, derivative = self.cameras(motion)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # A point may step through the focal plane: the trial is then rejected by its cost.
            r, J_S, J_P2 = self.kernels.two_view_structure(P2, S, self.q[:2], self.q[2:])
            cost, root = reweighted(r, self.weights, self.loss)
        return JointState(motion, S, derivative, r, J_S, J_P2, root, cost)

    def linearize(self, state: JointState) -> Arrow:
        """Return the normal equations, blocks (iii') to (v) of the algorithm."""
        r, J_S = state.root * state.r, state.root * state.J_S
        A = state.root * np.tensordot(state.camera_derivative, state.J_P2, axes=(0, 1))
        p, _, m = A.shape
        flat = A.reshape(p, 2 * m)
        return Arrow(
            U=flat @ flat.T,
            W=np.einsum("pim,ikm->mpk", A, J_S[2:]),
            V=np.einsum("ikm,ilm->mkl", J_S, J_S),
            g_motion=flat @ r[2:].ravel(),
            g_points=np.einsum("ikm,im->mk", J_S, r),
        )

    def retract(self, state: JointState, step: Array) -> tuple[Any, Array]:
        """Return motion and structure that a step leads to (step viii)."""
        p = self.parameterization.dimension
        return self.moved((state.motion, state.S), step[:p], step[p:].reshape(-1, 3).T)

    def cameras(self, motion: Any) -> tuple[Array, Array]:
        """Return P' and its derivative by the motion parameters."""
        return self.parameterization.camera(motion)

    def moved(self, estimate: tuple[Any, Array], motion: Array, points: Array) -> tuple[Any, Array]:
        """Return motion and structure moved by steps (p,) and (3, m)."""
        return self.parameterization.retract(estimate[0], motion), estimate[1] + points

    def fundamental(self, motion: Any) -> Array:
        """Return F of a motion."""
        return self.parameterization.fundamental(motion)
