"""Bundle adjustment of B&S Table 1: F and one point a match, sparse normal equations.

Camera P = (I | 0), camera P' from the parameterisation, points (a, b, 1, c).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.linear import Arrow
from epigauge.two_view.eliminated import foot_points
from epigauge.two_view.parameterizations import Ortho

__all__ = ["JointProblem", "JointState", "intersect"]

Array = NDArray[np.float64]


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


@dataclass(frozen=True)
class JointState:
    """Motion and structure, residuals with their Jacobian blocks, and cost."""

    motion: Any
    S: Array
    A_perp: Array
    r: Array
    J_S: Array
    J_P2: Array
    cost: float


class JointProblem:
    """Sum of weighted squared residuals as a function of F and the points.

    Parameters
    ----------
    kernels : Table
        Backend.
    parameterization : Ortho
        Represents F and gives the second camera.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    weights : ndarray, shape (m,)
        Factor of the squared residuals of each match.
    """

    def __init__(
        self, kernels: Table, parameterization: Ortho, q1: Array, q2: Array, weights: Array
    ) -> None:
        self.kernels = kernels
        self.parameterization = parameterization
        self.q1, self.q2, self.weights = q1, q2, weights
        self.floor = 0.5 * float(np.sum(weights)) * 1e-30

    def start(self, F: Array) -> tuple[Any, Array]:
        """Return motion and structure of a start value, each point at its foot point."""
        motion = self.parameterization.start(F)
        F = self.parameterization.fundamental(motion)
        feet = foot_points(self.kernels, F, self.q1, self.q2)
        matches = (self.q1, self.q2, feet.multiplier)
        q1_hat, q2_hat, _ = self.kernels.foot_point_derivative(*feet.frame, *matches)
        P2, _ = self.parameterization.camera(motion)
        return motion, intersect(P2, q1_hat, q2_hat)

    def evaluate(self, estimate: tuple[Any, Array]) -> JointState:
        """Return the state of motion and structure."""
        motion, S = estimate
        P2, A_perp = self.parameterization.camera(motion)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # A point may step through the focal plane: the trial is then rejected by its cost.
            r, J_S, J_P2 = self.kernels.two_view_structure(P2, S, self.q1, self.q2)
            cost = 0.5 * float(np.sum(self.weights * r**2))
        cost = cost if np.isfinite(cost) else float("inf")
        return JointState(motion, S, A_perp, r, J_S, J_P2, cost)

    def linearize(self, state: JointState) -> Arrow:
        """Return the normal equations, blocks (iii') to (v) of the algorithm."""
        root = np.sqrt(self.weights)
        r, J_S = root * state.r, root * state.J_S
        A = root * np.tensordot(state.A_perp, state.J_P2, axes=(0, 1))
        p, m = A.shape[0], A.shape[2]
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
        motion = self.parameterization.retract(state.motion, step[:p])
        return motion, state.S + step[p:].reshape(-1, 3).T
