"""The bundle adjustment problem for cameras of any model: what `epigauge.lm` minimises."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle import compiled
from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import FeatureKind, Linearizer, Normal, PointRefinement
from epigauge.bundle.priors import Priors
from epigauge.bundle.solve import BundleSystem, Step
from epigauge.cameras import MAX_FOCAL, MIN_FOCAL, CameraModel

__all__ = ["BundleProblem", "BundleState", "Estimate", "in_range"]

Array = NDArray[np.float64]

#: Largest entry of a homogeneous vector; lambda diag(N) leaves scales as free as they come.
_LARGE = 1e30

Retraction = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Estimate:
    """Cameras (n, c) and points (m, b).

    Attributes
    ----------
    others : tuple of ndarray
        Features of other kinds, in the order of the problem's `kinds`.
    steps : int
        How many steps led here.
    point_costs : ndarray, shape (m,), or None
        The features' share of the cost, where it is known already: points, then other kinds.
    """

    cameras: Array
    points: Array
    steps: int = 0
    point_costs: Array | None = None
    others: tuple[Array, ...] = ()


@dataclass(frozen=True)
class BundleState:
    """An estimate and its cost, 0.5 times the weighted robust sum and the priors'."""

    estimate: Estimate
    cost: float

    @property
    def cameras(self) -> Array:
        """Return the cameras, (n, c)."""
        return self.estimate.cameras

    @property
    def points(self) -> Array:
        """Return the points, (m, b)."""
        return self.estimate.points

    @property
    def others(self) -> tuple[Array, ...]:
        """Return the features of other kinds."""
        return self.estimate.others


@dataclass(frozen=True)
class BundleProblem:
    """Robust weighted sum of squared residuals as a function of cameras and points.

    Attributes
    ----------
    model : CameraModel
        The camera.
    linearizer : Linearizer
        The observations, and what evaluates them.
    retraction : callable
        Moves cameras (n, c) by own tangents (n, d).
    freedom : Freedom
        What is free, and the gauge that estimates are kept in.
    priors : Priors or None
        What is known beside the images.
    refinement : PointRefinement or None
        After each step re-triangulate every point (variable projection), and how.
    floor : float
        A cost this low is rounding error.
    kinds : tuple of FeatureKind
        Features of other kinds than points, and what evaluates them.
    """

    model: CameraModel
    linearizer: Linearizer
    retraction: Retraction
    freedom: Freedom = field(default_factory=Freedom)
    priors: Priors | None = None
    refinement: PointRefinement | None = None
    floor: float = 0.0
    kinds: tuple[FeatureKind, ...] = ()

    def compiled(
        self,
        start: Estimate,
        damping: Any,
        schedule: Any,
        stopping: lm.Stopping,
        scale: float,
        lam_floor: float,
    ) -> lm.Outcome[BundleState] | None:
        """Return what `lm.minimize` would, by the compiled loop; None where it cannot."""
        if type(self) is not BundleProblem:
            return None
        done = compiled.minimized(self, start, damping, schedule, stopping, scale, lam_floor)
        if done is None:
            return None
        steps = sum(row.accepted for row in done.history) - 1
        found = Estimate(done.cameras, done.points, start.steps + steps)
        system = None if done.normal is None else self._system(done.normal, found)
        return lm.Outcome(BundleState(found, done.cost), system, *done.counts, done.history)

    def fetched(self, outcome: lm.Outcome[BundleState]) -> lm.Outcome[BundleState]:
        """Return an outcome with all that belongs to points here, were they elsewhere."""
        return outcome

    def evaluate(self, estimate: Estimate) -> BundleState:
        """Return the state of an estimate; a cost of infinity where it has none."""
        costs = estimate.point_costs
        if costs is None:
            costs = self.linearizer.point_costs(estimate.cameras, estimate.points)
            more = (own.point_costs(estimate.cameras, rows) for own, rows in self._each(estimate))
            costs = np.concatenate([costs, *more]) if self.kinds else costs
        with np.errstate(over="ignore"):
            cost = 0.5 * float(costs.sum())
        if self.priors is not None:
            cost += self.priors.cost(estimate.cameras, estimate.points)
        # A point may fall onto a focal plane, a focal length to nothing: such trials are rejected.
        usable = math.isfinite(cost) and self._focal(estimate.cameras)
        return BundleState(estimate, cost if usable else float("inf"))

    def linearize(self, state: BundleState) -> BundleSystem:
        """Return the normal equations."""
        normal = self.linearizer.linearize(state.cameras, state.points)
        others = [own.linearize(state.cameras, rows) for own, rows in self._each(state.estimate)]
        normal = normal.beside(others)
        return self._system(normal, state.estimate)

    def _system(self, normal: Normal, estimate: Estimate) -> BundleSystem:
        cameras, points = estimate.cameras, estimate.points
        if self.priors is not None:
            normal = self.priors.added(normal, cameras, points)
        normal, border = self.freedom.constrained(normal, cameras, points)
        known = None if self.priors is None else self.priors.border(normal, points)
        border = known if border is None else border.beside(known)
        ties = self.freedom.ties_at(cameras, points)
        return BundleSystem(
            normal,
            self.linearizer.inverse_roots,
            ties,
            border,
            tuple(own.inverse_roots for own in self.kinds),
            model=self.model,
            cameras=cameras,
            points=points,
        )

    def retract(self, state: BundleState, step: Step) -> Estimate:
        """Return the estimate that a step leads to, its points re-triangulated where asked for."""
        cameras = self.retraction(state.cameras, step.cameras)
        cameras = self.freedom.retracted(state.cameras, cameras, step.cameras)
        points, steps = state.points + step.points, state.estimate.steps + 1
        others = tuple(
            own.moved(state.cameras, rows, tangents)
            for (own, rows), tangents in zip(self._each(state.estimate), step.others, strict=True)
        )
        move = self.freedom.moving(cameras, points, steps)
        if move is not None:
            cameras, points = move.apply(cameras, points)
            pairs = zip(self.kinds, others, strict=True)
            others = tuple(kind.carried(move, rows) for kind, rows in pairs)
        if self.model.homogeneous:
            cameras, points = in_range(cameras), in_range(points)
        if self.refinement is None:
            return Estimate(cameras, points, steps, None, others)
        points, costs = self.refined(cameras, points)
        if not others:
            return Estimate(cameras, points, steps, costs)
        how = self.refinement
        own = [
            kind.refine_points(cameras, rows, how)
            for kind, rows in zip(self.kinds, others, strict=True)
        ]
        costs = np.concatenate([costs, *(more for _, more in own)])
        return Estimate(cameras, points, steps, costs, tuple(rows for rows, _ in own))

    def refined(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return points after iterations of their own, and their costs."""
        assert self.refinement is not None
        refined, costs = self.linearizer.refine_points(cameras, points, self.refinement)
        kept = self.freedom.kept
        if kept is None:
            return refined, costs
        refined = np.where(kept[:, None], points, refined)
        return refined, self.linearizer.point_costs(cameras, refined)

    def _each(self, estimate: Estimate) -> list[tuple[FeatureKind, Array]]:
        """Return the kinds beside points, each with its features."""
        return list(zip(self.kinds, estimate.others, strict=True)) if self.kinds else []

    def _focal(self, cameras: Array) -> bool:
        places = list(self.model.focal)
        focal = cameras[:, 12:][:, places]
        return bool(np.all((focal >= MIN_FOCAL) & (focal <= MAX_FOCAL)))


def in_range(vectors: Array) -> Array:
    """Return homogeneous vectors, those whose scale has run away as unit vectors."""
    sizes = np.abs(vectors).max(axis=1, keepdims=True)
    away = ((sizes > _LARGE) & (sizes < np.inf)) | ((sizes < 1.0 / _LARGE) & (sizes > 0.0))
    if not away.any():
        return vectors
    unit = vectors / np.where(away, sizes, 1.0)
    lengths = np.linalg.norm(unit, axis=1, keepdims=True)
    return np.asarray(unit / np.where(away, lengths, 1.0))
