"""The two-view problem over F alone: criterion, loss and parameterisation put together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.linear import Dense
from epigauge.two_view.criteria import Criterion, Distances
from epigauge.two_view.losses import Loss
from epigauge.two_view.parameterizations import Parameterization

__all__ = ["EliminatedProblem", "EliminatedState"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EliminatedState:
    """Estimate, its F, the distances and the cost."""

    motion: Any
    F: Array
    distances: Distances
    cost: float


class EliminatedProblem:
    """Robust weighted sum of squared distances as a function of the parameters of F.

    Parameters
    ----------
    criterion : Criterion
        Distances of the matches.
    parameterization : Parameterization
        Represents F.
    weights : ndarray, shape (m,)
        Factor of each match's cost.
    loss : Loss
        Applied to the squared distances.
    exact : bool
        Exact Hessian (Newton), and steps bent like F, rather than J^T J (Gauss-Newton).
    """

    def __init__(
        self,
        criterion: Criterion,
        parameterization: Parameterization,
        weights: Array,
        loss: Loss,
        exact: bool,
    ) -> None:
        self.criterion = criterion
        self.parameterization = parameterization
        self.weights, self.loss = weights, loss
        self.exact = exact
        # Rounding of coordinates of size ~2 moves a distance by ~1e-15.
        self.floor = 0.5 * float(np.sum(weights)) * 1e-30

    def start(self, F: Array) -> Any:
        """Return the representation of a start value."""
        return self.parameterization.start(F)

    def evaluate(self, estimate: Any) -> EliminatedState:
        """Return the state of an estimate."""
        F = self.parameterization.fundamental(estimate)
        distances = self.criterion.evaluate(F)
        rho, _, _ = self.loss(distances.squared)
        cost = 0.5 * float(np.sum(self.weights * rho))
        return EliminatedState(estimate, F, distances, cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: EliminatedState) -> Dense:
        """Return gradient and Hessian by the parameters (chain rule)."""
        _, first, second = self.loss(state.distances.squared)
        weight = self.weights * first
        curvature = 2.0 * self.weights * second if self.exact else None
        g, N, H = self.criterion.normal(state.F, state.distances, weight, curvature)
        dF, d2F = self.parameterization.derivatives(state.motion)
        normal = dF.T @ N @ dF
        diagonal = np.diag(normal).copy()
        if not self.exact:
            return Dense(dF.T @ g, normal, diagonal)
        hessian = dF.T @ H @ dF + np.tensordot(g, d2F, axes=1)
        # Where the residuals hardly change, they bend as F does: r'' ~ (dr/dF) d2F
        return Dense(dF.T @ g, hessian, diagonal, np.tensordot(dF.T @ N, d2F, axes=1))

    def retract(self, state: EliminatedState, step: Array) -> Any:
        """Return the estimate that a step leads to."""
        return self.parameterization.retract(state.motion, step)
