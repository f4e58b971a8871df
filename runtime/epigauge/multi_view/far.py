"""Starts far from any minimum, with points on the wrong side of infinity, and degenerate ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.multi_view.problem import BundleProblem, BundleState
from epigauge.two_view.losses import Loss, median

__all__ = ["FAR", "JumpingProblem", "minimize", "minimized_from"]

Array = NDArray[np.float64]

#: A start is far where the median residual is beyond this share of the RMS of the image
#: coordinates.
#: Nearer ones need fewer evaluations without the first steps.
FAR = 0.08

#: Scale of the Cauchy loss of the first steps, in the same unit.
_SCALE = 0.05

#: When the steps that bring it nearer end: relative decrease of their cost, and trial steps.
_FTOL, _STEPS = 1e-3, 15


#: Relative size of the change that makes a degenerate start regular.
_NUDGE = 1e-3


class JumpingProblem(BundleProblem):
    """A problem whose points may jump, after each step, to where their lines of sight meet.

    Steps of its own do not take a point across a focal plane, where its cost is infinite: those of
    a bad start stay on the wrong side, and the cameras suffer for it. The linear meeting of the
    lines of sight knows no sides; each point begins from there where it ends at a lower cost.

    Parameters
    ----------
    asked : BundleProblem
        The same measurements with the loss asked for. The loss here is Cauchy's: in the
        cost of a linear loss few points near a focal plane outweigh all others.

    Attributes
    ----------
    cost_asked : float
        Cost of the estimate last evaluated, in the loss asked for.
    """

    def __init__(self, asked: BundleProblem) -> None:
        loss = Loss("cauchy", _SCALE)
        parts = (asked.kernels, asked.layout, asked.q, asked.weights, loss)
        super().__init__(*parts, embedded=True, workers=asked.workers)
        self.asked, self.cost_asked = asked, float("inf")

    def evaluate(self, estimate: tuple[Array, Array]) -> BundleState:
        """Return the state of cameras and points; note the cost asked for."""
        self.cost_asked = self.asked.evaluate(estimate).cost
        return super().evaluate(estimate)

    def triangulated(self, P: Array, Q: Array) -> Array:
        """Return the points after iterations of their own, with or without a jump first."""
        stayed = super().triangulated(P, Q)
        jumped = super().triangulated(P, self.engine.intersected(P))
        costs = (np.nan_to_num(self.point_costs(P, Q), nan=np.inf) for Q in (jumped, stayed))
        return np.where(np.less(*costs)[:, None], jumped, stayed)


def minimize(
    problem: BundleProblem,
    start: tuple[Array, Array],
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
    distances = problem.engine.distances(*start)
    if not np.isfinite(distances).all() or median(distances) <= FAR:
        return lm.minimize(problem, start, damping, schedule, stopping, callback, scale)
    jumping = JumpingProblem(problem)
    history: list[lm.Row] = []

    def record(row: lm.Row) -> object:
        history.append(row)
        return callback(row) if callback is not None else None

    def record_first(row: lm.Row) -> object:
        return record(replace(row, cost=scale * jumping.cost_asked))

    few = lm.Stopping(_FTOL, xtol=0.0, gtol=0.0, max_iter=min(_STEPS, stopping.max_iter))
    first = lm.minimize(jumping, start, damping, lm.Classic(), few, record_first)
    nearer = problem.evaluate((first.state.P, first.state.Q))
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

    begun, rest = (nearer.P, nearer.Q), replace(stopping, max_iter=left)
    second = lm.minimize(problem, begun, damping, schedule, rest, record_second, scale)
    return replace(
        second,
        nfev=len(history),
        njev=first.njev + second.njev,
        nit=first.nit + second.nit,
        history=tuple(history),
    )


def minimized_from(
    minimized: Callable[[Array, Array], tuple[lm.Outcome[BundleState], Array, Array]],
    P: Array,
    Q: Array,
) -> tuple[lm.Outcome[BundleState], Array, Array]:
    """Minimise from a start or, where no step can be made from it, from one a thousandth away.

    Parameters
    ----------
    minimized : callable
        Returns outcome, cameras and points; the steps may turn out singular.
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        The start.

    Returns
    -------
    outcome, P, Q
        Of the better of both.

    Raises
    ------
    numpy.linalg.LinAlgError
        If both are singular.
    """
    found = None
    try:
        # A start with a point in a focal plane has no finite blocks: its cost tells.
        with np.errstate(invalid="ignore", over="ignore"):
            found = minimized(P, Q)
        stuck = not any(row.accepted for row in found[0].history[1:])
        if not (stuck and found[0].status in (-3, -1)):
            return found
    except np.linalg.LinAlgError:
        pass
    rng = np.random.default_rng(0)
    sizes = np.linalg.norm(P, axis=(1, 2), keepdims=True), np.linalg.norm(Q, axis=1, keepdims=True)
    nudged = (
        part + _NUDGE * size * rng.normal(size=part.shape)
        for part, size in zip((P, Q), sizes, strict=True)
    )
    try:
        again = minimized(*nudged)
    except np.linalg.LinAlgError:
        if found is None:
            raise
        return found
    better = found is None or again[0].state.cost < found[0].state.cost
    return again if better or found is None else found
