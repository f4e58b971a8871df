"""Starts far from any minimum, with points on the wrong side of infinity, and degenerate ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate
from epigauge.bundle.solve import BundleSystem, Step
from epigauge.two_view.losses import Loss, median

__all__ = ["FAR", "JumpingProblem", "minimize", "minimized_from", "short_of_minimum"]

Array = NDArray[np.float64]

#: A start is far where the median residual is beyond this share of the RMS of the image
#: coordinates.
#: Nearer ones need fewer evaluations without the first steps.
FAR = 0.08

#: Scale of the Cauchy loss of the first steps, in the same unit.
_SCALE = 0.05

#: When the steps that bring it nearer end: relative decrease of their cost, and trial steps.
_FTOL, _STEPS = 1e-3, 15


#: A method has stopped short of a minimum where this many covariant steps lower the cost by this
#: part of it.
_CHECKING, _SHORT = 3, 1e-4

#: Steps from a far start to compare with.
_AGAIN = 50

#: Relative size of the change that makes a degenerate start regular.
_NUDGE = 1e-3


@dataclass(frozen=True)
class JumpingProblem(BundleProblem):
    """A problem whose points may jump, after each step, to where their lines of sight meet.

    Steps of its own do not take a point across a focal plane, where its cost is infinite: those of
    a bad start stay on the wrong side, and the cameras suffer for it. The linear meeting of the
    lines of sight knows no sides; each point begins from there where it ends at a lower cost.

    The loss is Cauchy's: in the cost of a linear loss few points near a focal plane outweigh all
    others.
    """

    @staticmethod
    def of(asked: BundleProblem) -> JumpingProblem:
        """Return this for the measurements of a problem."""
        parts = {part.name: getattr(asked, part.name) for part in fields(BundleProblem)}
        loss = Loss("cauchy", _SCALE)
        parts["linearizer"] = asked.linearizer.with_loss(loss)
        parts["kinds"] = tuple(kind.with_loss(loss) for kind in asked.kinds)
        return JumpingProblem(**parts)

    def refined(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return the points after iterations of their own, with or without a jump first."""
        stayed, costs = super().refined(cameras, points)
        jumped, others = super().refined(cameras, self.linearizer.intersect(cameras))
        better = np.less(*(np.nan_to_num(cost, nan=np.inf) for cost in (others, costs)))
        if self.freedom.kept is not None:
            better &= ~self.freedom.kept
        return np.where(better[:, None], jumped, stayed), np.where(better, others, costs)


@dataclass
class _Watched:
    """A problem that notes the cost, in the loss asked for, of the estimate last evaluated."""

    jumping: JumpingProblem
    asked: BundleProblem
    cost_asked: float = float("inf")

    @property
    def floor(self) -> float:
        """Return a cost so low that it is rounding error."""
        return self.jumping.floor

    def evaluate(self, estimate: Estimate) -> BundleState:
        """Return the state of cameras and points."""
        self.cost_asked = self.asked.evaluate(replace(estimate, point_costs=None)).cost
        return self.jumping.evaluate(estimate)

    def linearize(self, state: BundleState) -> BundleSystem:
        """Return the normal equations."""
        return self.jumping.linearize(state)

    def retract(self, state: BundleState, step: Step) -> Estimate:
        """Return the estimate that a step leads to."""
        return self.jumping.retract(state, step)


def minimize(
    problem: BundleProblem,
    start: Estimate,
    damping: lm.Damping,
    schedule: lm.Schedule,
    stopping: lm.Stopping,
    callback: Callable[[lm.Row], object] | None,
    scale: float,
) -> lm.Outcome[BundleState]:
    """Minimise as `epigauge.lm.minimize` does, a far start being brought nearer first.

    The first steps from a far start are those of a `JumpingProblem`; if they have not lowered the
    cost asked for, the others begin at the start. All of them have one history.

    Parameters
    ----------
    problem, start, damping, schedule, stopping, callback, scale
        As there; measurements are in coordinates of RMS one.

    Returns
    -------
    Outcome
        Of all steps. The costs of its history are those asked for, which the first steps, accepted
        by another loss, need not lower one by one.
    """
    if not _is_far(problem, start):
        return lm.minimize(problem, start, damping, schedule, stopping, callback, scale)
    jumping = _Watched(JumpingProblem.of(problem), problem)
    history: list[lm.Row] = []

    def record(row: lm.Row) -> object:
        history.append(row)
        return callback(row) if callback is not None else None

    def record_first(row: lm.Row) -> object:
        return record(replace(row, cost=scale * jumping.cost_asked))

    few = lm.Stopping(_FTOL, xtol=0.0, gtol=0.0, max_iter=min(_STEPS, stopping.max_iter))
    first = lm.minimize(jumping, start, damping, lm.Classic(), few, record_first)
    nearer = problem.evaluate(replace(first.state.estimate, point_costs=None))
    if scale * nearer.cost > history[0].cost:
        nearer = problem.evaluate(start)
    left = stopping.max_iter - first.nit
    stopped = first.status == -2
    if stopped or left == 0:
        return replace(
            first,
            state=nearer,
            system=None,
            status=-2 if stopped else 0,
            history=tuple(history),
        )

    def record_second(row: lm.Row) -> object:
        if row.iteration == 0:  # where the first steps ended: told already
            return None
        iteration, seconds = row.iteration + first.nit, row.seconds + first.history[-1].seconds
        return record(replace(row, iteration=iteration, seconds=seconds))

    rest = replace(stopping, max_iter=left)
    second = lm.minimize(problem, nearer.estimate, damping, schedule, rest, record_second, scale)
    return replace(
        second,
        nfev=len(history),
        njev=first.njev + second.njev,
        nit=first.nit + second.nit,
        history=tuple(history),
    )


def short_of_minimum(problem: BundleProblem, state: BundleState, start: Estimate) -> bool:
    """Tell whether the default method lowers a cost by much, in a few steps or from a far start.

    Parameters
    ----------
    problem : BundleProblem
        Of homogeneous cameras, free in all, with the measurements that the state was found from.
    state : BundleState
        Where another method stopped, in the best conditioned basis.
    start : Estimate
        Where it began, in such a basis, too.
    """
    if not math.isfinite(state.cost) or state.cost <= problem.floor:
        return False
    costs = problem.linearizer.point_costs(state.cameras, state.points)
    jumped, others = problem.refined(state.cameras, problem.linearizer.intersect(state.cameras))
    better = np.less(*(np.nan_to_num(cost, nan=np.inf) for cost in (others, costs)))
    points = np.where(better[:, None], jumped, state.points)
    few = lm.Stopping(ftol=_SHORT, xtol=0.0, gtol=0.0, max_iter=_CHECKING)
    damping, schedule = Covariant(), lm.Classic()
    trial = Estimate(state.cameras, points, others=state.others)
    found = lm.minimize(problem, trial, damping, schedule, few)
    if found.state.cost < (1.0 - _SHORT) * state.cost:
        return True
    if not _is_far(problem, start):
        return False
    again = lm.Stopping(ftol=_SHORT, xtol=0.0, gtol=0.0, max_iter=_AGAIN)
    found = minimize(problem, start, damping, schedule, again, None, 1.0)
    return found.state.cost < (1.0 - _SHORT) * state.cost


def _is_far(problem: BundleProblem, start: Estimate) -> bool:
    distances = problem.linearizer.distances(start.cameras, start.points)
    # To count is faster than the median, which lies between the two middle ones.
    if 2 * np.count_nonzero(distances > FAR) < len(distances):
        return False
    return bool(np.isfinite(distances).all()) and median(distances) > FAR


def minimized_from(
    minimized: Callable[[Estimate], tuple[lm.Outcome[BundleState], Estimate]],
    start: Estimate,
    seeing: Callable[[Estimate], Estimate],
) -> tuple[lm.Outcome[BundleState], Estimate]:
    """Minimise from a start or, where no step can be made from it, from one a thousandth away.

    Parameters
    ----------
    minimized : callable
        Returns outcome and estimate; the steps may turn out singular.
    start : Estimate
        Where to begin.
    seeing : callable
        Returns an estimate whose cameras have images of their points; asked when no step can be
        made: a camera that has none tells nothing of where it is.

    Returns
    -------
    outcome, estimate
        Those of the better of both.

    Raises
    ------
    numpy.linalg.LinAlgError
        If both are singular.
    """
    found = None
    try:
        # A start with a point in a focal plane has no finite blocks: its cost tells.
        with np.errstate(invalid="ignore", over="ignore"):
            found = minimized(start)
        stuck = not any(row.accepted for row in found[0].history[1:])
        if not (stuck and found[0].status in (-3, -1)):
            return found
    except np.linalg.LinAlgError:
        pass
    start, rng = seeing(start), np.random.default_rng(0)
    cameras, points = (
        part + _NUDGE * np.linalg.norm(part, axis=1, keepdims=True) * rng.normal(size=part.shape)
        for part in (start.cameras, start.points)
    )
    try:
        again = minimized(replace(start, cameras=cameras, points=points))
    except np.linalg.LinAlgError:
        if found is None:
            raise
        return found
    better = found is None or again[0].state.cost < found[0].state.cost
    return again if better or found is None else found
