"""The exact reprojection error over F alone: the points are eliminated, not approximated.

For each match the nearest pair of points that satisfies the epipolar geometry (the foot point) is
found to rounding, so that the sum of squared signed distances d is the bundle adjustment cost of
B&S with m residuals and no structure unknowns. Gradient and exact Hessian are summed up over the
entries of F; the parameterisation's derivatives do the rest by the chain rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.linear import Dense
from epigauge.two_view.parameterizations import Ortho

__all__ = ["EliminatedProblem", "EliminatedState", "FootPoints", "foot_points"]

Array = NDArray[np.float64]

#: A foot point is accepted when its last Newton change moved it by less than this (relative);
#: convergence is quadratic, so that the error left is the square of it.
_SETTLED = 1e-7

_UPPER = np.triu_indices(9)


@dataclass(frozen=True)
class FootPoints:
    """Foot points of all matches for one F.

    Attributes
    ----------
    frame : tuple of ndarray
        F in rotated images, as the kernel ``bilinear_frame`` gives it.
    multiplier, d : ndarray, shape (m,)
        Lagrange multiplier and signed distance of each match.
    """

    frame: tuple[Array, ...]
    multiplier: Array
    d: Array


def foot_points(kernels: Table, F: Array, q1: Array, q2: Array) -> FootPoints:
    """Find the foot point of every match.

    A fixed number of Newton steps settles nearly all of them; the others, near an epipole, are
    bracketed down to rounding.

    Parameters
    ----------
    kernels : Table
        Backend.
    F : ndarray, shape (3, 3)
        Fundamental matrix of rank 2.
    q1, q2 : ndarray, shape (2, m)
        Matches.

    Returns
    -------
    FootPoints
        Global minimisers of the squared distance.
    """
    frame = kernels.bilinear_frame(F)
    multiplier, change, d = kernels.foot_point(*frame, q1, q2)
    unsettled = np.abs(change * d) > (_SETTLED * np.abs(d) + 1e-15) * np.abs(multiplier)
    if unsettled.any():
        safe = kernels.foot_point_safe(*frame, q1[:, unsettled], q2[:, unsettled])
        multiplier[unsettled], _, d[unsettled] = safe
    return FootPoints(frame, multiplier, d)


def _rotate_entries(frame: tuple[Array, ...], derivatives: Array) -> Array:
    """Return R2^T dF R1 for derivatives of shape (9, ...)."""
    R1, R2 = np.eye(3), np.eye(3)
    R1[:2, :2], R2[:2, :2] = frame[0], frame[1]
    rotated = np.kron(R2.T, R1.T) @ derivatives.reshape(9, -1)
    return np.asarray(rotated.reshape(derivatives.shape))


@dataclass(frozen=True)
class EliminatedState:
    """Estimate, foot points and cost."""

    motion: Any
    feet: FootPoints
    cost: float


class EliminatedProblem:
    """Sum of weighted squared distances as a function of F.

    Parameters
    ----------
    kernels : Table
        Backend.
    parameterization : Ortho
        Represents F.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    weights : ndarray, shape (m,)
        Factor of each squared distance.
    exact : bool
        Exact Hessian (Newton) rather than J^T J (Gauss-Newton).
    """

    def __init__(
        self,
        kernels: Table,
        parameterization: Ortho,
        q1: Array,
        q2: Array,
        weights: Array,
        exact: bool,
    ) -> None:
        self.kernels = kernels
        self.parameterization = parameterization
        self.q1, self.q2, self.weights = q1, q2, weights
        self.exact = exact
        # Rounding of coordinates of size ~2 moves a distance by ~1e-15.
        self.floor = 0.5 * float(np.sum(weights)) * 1e-30

    def start(self, F: Array) -> Any:
        """Return the representation of a start value."""
        return self.parameterization.start(F)

    def evaluate(self, estimate: Any) -> EliminatedState:
        """Return the state of an estimate."""
        F = self.parameterization.fundamental(estimate)
        feet = foot_points(self.kernels, F, self.q1, self.q2)
        cost = 0.5 * float(np.sum(self.weights * feet.d**2))
        return EliminatedState(estimate, feet, cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: EliminatedState) -> Dense:
        """Return gradient and Hessian by the parameters."""
        feet = state.feet
        first, second = self.parameterization.derivatives(state.motion)
        A = _rotate_entries(feet.frame, first)
        matches = (self.q1, self.q2, feet.multiplier, self.weights)
        g, packed = self.kernels.reprojection_gauss_newton(*feet.frame, *matches)
        normal = A.T @ _unpack(packed) @ A
        if not self.exact:
            return Dense(A.T @ g, normal, np.diag(normal).copy())
        no_curvature = np.zeros_like(self.weights)
        _, packed = self.kernels.reprojection_newton(*feet.frame, *matches, no_curvature)
        curvature = np.tensordot(g, _rotate_entries(feet.frame, second), axes=1)
        hessian = A.T @ _unpack(packed) @ A + curvature
        return Dense(A.T @ g, hessian, np.diag(normal).copy())

    def retract(self, state: EliminatedState, step: Array) -> Any:
        """Return the estimate that a step leads to."""
        return self.parameterization.retract(state.motion, step)


def _unpack(packed: Array) -> Array:
    """Return the symmetric matrix of an upper triangle."""
    matrix = np.zeros((9, 9))
    matrix[_UPPER] = packed
    return matrix + np.triu(matrix, 1).T
