"""The projective bundle adjustment problem: cameras P (n, 3, 4) and points Q (m, 4), all free."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.multi_view.engine import Engine, Reference, Triangulation
from epigauge.multi_view.fused import Fused
from epigauge.multi_view.layout import Layout
from epigauge.multi_view.system import BundleSystem
from epigauge.two_view.losses import Loss

__all__ = ["BundleProblem", "BundleState", "Linearized"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BundleState:
    """Cameras and points with their cost; what else is asked for is computed then.

    Attributes
    ----------
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        The estimate.
    cost : float
        0.5 * weighted robust sum.
    problem : BundleProblem
        What it was evaluated by.
    """

    P: Array
    Q: Array
    cost: float
    problem: BundleProblem

    @property
    def r(self) -> Array:
        """Return the residuals r = q - q_hat, (2, N)."""
        return self.problem.by_observation.residuals(self.P, self.Q)

    @property
    def J_P(self) -> Array:
        """Return the Jacobians of q_hat by the camera, (2, 12, N)."""
        return self.problem.by_observation.jacobians(self.P, self.Q)[0]

    @property
    def J_Q(self) -> Array:
        """Return the Jacobians of q_hat by the point, (2, 4, N)."""
        return self.problem.by_observation.jacobians(self.P, self.Q)[1]

    @property
    def root(self) -> Array:
        """Return the root of each observation's weight, that of the robust loss included, (N,)."""
        return self.problem.by_observation.roots(self.r)

    @cached_property
    def depth_blocks(self) -> tuple[Array, Array]:
        """Return the diagonal blocks of Z^T Z, Z = d log depth / d(P, Q) weighted as residuals."""
        return self.problem.engine.depth_blocks(self.P, self.Q)


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
    workers : int
        Threads to use where the back end can.
    """

    triangulation = Triangulation()

    def __init__(
        self,
        kernels: Table,
        layout: Layout,
        q: Array,
        weights: Array,
        loss: Loss,
        embedded: bool = False,
        workers: int = 1,
    ) -> None:
        self.kernels, self.layout = kernels, layout
        self.q, self.weights, self.loss = q, weights, loss
        self.embedded, self.workers = embedded, workers
        # Conditioned coordinates are of order one; products of P and Q round a few times.
        self.floor = 0.5 * float(np.sum(weights)) * 1e-28
        self._fused: Fused | None = None
        #: Cameras and points last triangulated, and the points' costs.
        self._costs: tuple[Any, ...] | None = None

    @property
    def by_observation(self) -> Reference:
        """Return the evaluation by the kernels of any back end, observation by observation."""
        return Reference(self.kernels, self.layout, self.q, self.weights, self.loss)

    @property
    def engine(self) -> Engine:
        """Return what evaluates: one pass a point in C, or the reference."""
        if self.kernels.name != "c":
            return self.by_observation
        made = self._fused
        if made is None or made.q is not self.q or made.weights is not self.weights:
            made = Fused(self.layout, self.q, self.weights, self.loss, self.workers)
        elif made.loss is not self.loss:
            made = made.with_loss(self.loss)
        self._fused = made
        return made

    def evaluate(self, estimate: tuple[Array, Array]) -> BundleState:
        """Return the state of cameras and points."""
        P, Q = estimate
        known = self._known(P, Q)
        costs = self.point_costs(P, Q) if known is None else known
        with np.errstate(over="ignore"):
            cost = 0.5 * float(costs.sum())
        # A point may fall onto a focal plane: the trial is then rejected by its cost.
        return BundleState(P, Q, cost if math.isfinite(cost) else float("inf"), self)

    def linearize(self, state: BundleState) -> Linearized:
        """Return the normal equations."""
        normal = self.engine.linearize(state.P, state.Q)
        if normal.depth_blocks is not None:
            state.__dict__["depth_blocks"] = normal.depth_blocks
        return Linearized(
            self.layout,
            normal.U,
            normal.V,
            normal.coupling,
            normal.g_cameras,
            normal.g_points,
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
        return state.depth_blocks

    def point_costs(self, P: Array, Q: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""
        return self.engine.point_costs(P, Q)

    def triangulated(self, P: Array, Q: Array) -> Array:
        """Return the points after a few covariantly damped Gauss-Newton iterations of their own."""
        Q, costs = self.engine.triangulated(P, Q, self.triangulation)
        self._costs = (costs, *self._given(P, Q))
        return Q

    def _given(self, P: Array, Q: Array) -> tuple[object, ...]:
        return P, Q, self.q, self.weights, self.loss, self.kernels

    def _known(self, P: Array, Q: Array) -> Array | None:
        """Return the costs of points that were triangulated just now."""
        if self._costs is None:
            return None
        costs, *given = self._costs
        return costs if all(map(is_, given, self._given(P, Q))) else None
