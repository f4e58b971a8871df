"""The reprojection error of a homography as a problem of `epigauge.lm`: eight parameters.

Each match has its exact foot point, the point p of image 1 for which (p, h(p)) is nearest to the
match; what is left depends on H alone. H is a unit vector of nine entries, and moves along the
eight directions across it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.linear import Dense
from epigauge.two_view.losses import Loss

__all__ = ["PARAMETERS", "HomographyProblem", "Transfer", "across"]

Array = NDArray[np.float64]

#: Parameters of a homography.
PARAMETERS = 8

#: A cost of so small a mean square, conditioned, is rounding of the data.
_ROUNDING = 1e-15

_UPPER = np.triu_indices(9)


@dataclass(frozen=True)
class Transfer:
    """A homography with the foot points of all matches.

    Attributes
    ----------
    H : ndarray, shape (3, 3)
        Of unit norm.
    foot : ndarray, shape (2, m)
        Corrected points of image 1; as they are for a match that H takes to nowhere.
    squared : ndarray, shape (m,)
        Squared distances; infinite for a match that H takes to nowhere.
    cost : float
        Half the sum of their weighted losses.
    """

    H: Array
    foot: Array
    squared: Array
    cost: float


class HomographyProblem:
    """Matches, their covariances and the loss.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    weights : ndarray, shape (m,)
        Factors of the squared distances.
    loss : Loss
        Of a squared distance, in these coordinates.
    covariances : pair of ndarray, shape (3, m)
        Upper triangles of the points' covariances; the identity by default.
    """

    def __init__(
        self,
        kernels: Table,
        q1: Array,
        q2: Array,
        weights: Array,
        loss: Loss | None = None,
        covariances: tuple[Array, Array] | None = None,
    ) -> None:
        self.kernels, self.q1, self.q2, self.weights = kernels, q1, q2, weights
        self.loss = loss or Loss()
        equal = np.tile([[1.0], [0.0], [1.0]], q1.shape[1])
        self.S1: Array
        self.S2: Array
        self.S1, self.S2 = covariances or (equal, equal)
        self.floor = 0.5 * _ROUNDING**2 * float(np.count_nonzero(weights))

    def with_loss(self, loss: Loss) -> HomographyProblem:
        """Return the same with another loss."""
        same = (self.kernels, self.q1, self.q2, self.weights)
        return HomographyProblem(*same, loss, (self.S1, self.S2))

    def evaluate(self, H: Array) -> Transfer:
        """Return foot points and cost."""
        with np.errstate(all="ignore"):  # a match that H takes to infinity
            foot, squared = self.kernels.homography_foot(H, self.q1, self.q2, self.S1, self.S2)
            nowhere = ~np.isfinite(squared)
            squared[nowhere], foot[:, nowhere] = np.inf, self.q1[:, nowhere]
            values = np.where(self.weights > 0.0, self.loss(squared)[0], 0.0)
            cost = 0.5 * float(self.weights @ values)
        return Transfer(H, foot, squared, cost if np.isfinite(cost) else np.inf)

    def linearize(self, state: Transfer) -> Dense:
        """Return gradient and Gauss-Newton matrix, in the directions across H."""
        counts = np.isfinite(state.squared)
        slope = np.zeros_like(state.squared)
        slope[counts] = self.loss(state.squared[counts])[1]
        N, gradient = self.system(state, self.weights * slope)
        return Dense(gradient, N, np.maximum(np.diag(N), np.finfo(float).tiny))

    def system(self, state: Transfer, weights: Array) -> tuple[Array, Array]:
        """Return J^T J and the gradient for some weights."""
        use = (weights > 0.0) & np.isfinite(state.squared)
        some = [self.q1, self.q2, self.S1, self.S2, state.foot]
        if not use.all():
            some, weights = [np.ascontiguousarray(a[:, use]) for a in some], weights[use]
        with np.errstate(all="ignore"):
            packed, gradient = self.kernels.homography_system(state.H, *some, weights)
        if not (np.isfinite(packed).all() and np.isfinite(gradient).all()):
            return np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)  # H is singular there
        N = np.zeros((9, 9))
        N[_UPPER] = packed
        N.T[_UPPER] = packed
        B = across(state.H)
        return B.T @ N @ B, B.T @ gradient

    def retract(self, state: Transfer, step: Any) -> Array:
        """Return H moved along the directions across it, of unit norm."""
        H = state.H + (across(state.H) @ step).reshape(3, 3)
        return np.asarray(H / np.linalg.norm(H))


def across(H: Array) -> Array:
    """Return an orthonormal basis (9, 8) of what is across a unit vector, by a reflection."""
    v = H.ravel().copy()
    pivot = int(np.argmax(np.abs(v)))
    v[pivot] += np.copysign(1.0, v[pivot])
    reflection = np.eye(9) - np.outer(v, v) * (2.0 / (v @ v))
    return np.delete(reflection, pivot, axis=1)
