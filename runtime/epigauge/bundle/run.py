"""One method on one job: gauge, damping and freedom put together, and minimised."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle import far
from epigauge.bundle.backends import Elsewhere, linearizer_for
from epigauge.bundle.dampings import (
    DAMPINGS,
    LAM_FLOOR_METRIC,
    ByMatrix,
    Covariant,
    Implicit,
)
from epigauge.bundle.jobs import Job
from epigauge.bundle.linearizer import PointRefinement
from epigauge.bundle.moves import Move, best_conditioned, move_into
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate
from epigauge.bundle.seeing import seeing
from epigauge.bundle.similarity import Similarity
from epigauge.bundle.strategies import STRATEGIES, freedom_of
from epigauge.bundle.way import Way
from epigauge.cameras import CameraModel
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.gauge import Gauge, five_points, identity
from epigauge.two_view.losses import Loss

__all__ = [
    "bundle_problem",
    "conditioned_problem",
    "minimized",
]

Array = NDArray[np.float64]

#: How points are re-triangulated: those of metric cameras are held by their mean entry.
REFINEMENT = PointRefinement()
REFINEMENT_METRIC = PointRefinement(lam=1e-4)

#: A residual this small, of the coordinate, is rounding.
_ROUNDING = 1e-14

#: Dampings, and methods, of projective cameras only.
PROJECTIVE_ONLY = ("gauge_invariant", "gauge_invariant_factor")


def bundle_problem(
    model: CameraModel,
    kernels: Table,
    graph: ObservationGraph,
    q: Array,
    weights: Array,
    loss: Loss | None = None,
    *,
    embedded: bool = False,
    workers: int | Elsewhere = 1,
    whitening: Array | None = None,
    **parts: Any,
) -> BundleProblem:
    """Return the problem of cameras of a model.

    Parameters
    ----------
    model : CameraModel
        The camera.
    kernels : Table
        Back end.
    graph : ObservationGraph
        Which observation belongs to what.
    q, weights : ndarray, shape (2, N), (N,)
        Measurements, and factor of each squared residual.
    loss : Loss, optional
        Applied to each squared residual.
    embedded : bool
        Re-triangulate the points after each step.
    workers : int or Elsewhere
        Threads to use where the back end can, or other processes.
    whitening : ndarray, shape (2, 2, N), optional
        What residuals are multiplied by.
    **parts
        Other parts of a `BundleProblem`: freedom, priors, kinds.
    """
    retract = model.kernel("retract", kernels.name)
    how = REFINEMENT_METRIC if model.metric else REFINEMENT
    ties = parts["freedom"].ties if "freedom" in parts else None
    seen = [kind.graph for kind in parts.get("kinds", ())]
    measured = graph, q, weights, loss or Loss()
    return BundleProblem(
        model,
        linearizer_for(model, kernels, *measured, workers, ties, whitening, seen),
        lambda cameras, own: np.ascontiguousarray(retract(cameras.T, own.T).T),
        refinement=how if embedded else None,
        floor=0.5 * _ROUNDING**2 * float(np.vdot(weights * q, q)),
        **parts,
    )


def conditioned_problem(
    job: Job,
    graph: ObservationGraph,
    weights: Array,
    kernels: Table,
    loss: Loss | None = None,
    at: Estimate | None = None,
    **parts: Any,
) -> tuple[Move, BundleProblem, Estimate]:
    """Return the problem of a job where computing suits best: the move there, problem, estimate.

    Parameters
    ----------
    job : Job
        Model, measurements, what is free and known, features of other kinds.
    graph : ObservationGraph
        Which observation belongs to what.
    weights : ndarray, shape (N,)
        Factor of each squared residual of points.
    kernels : Table
        Back end.
    loss : Loss, optional
        Applied to each squared residual.
    at : Estimate, optional
        In the frame of the job; its start by default.
    **parts
        Further options of `bundle_problem`.
    """
    at = Estimate(job.cameras, job.points, others=job.others) if at is None else at
    home, cameras, points = best_conditioned(job.model, at.cameras, at.points)
    kinds = tuple(kind.with_loss(loss or Loss()) for kind in job.kinds)
    others = tuple(kind.carried(home, rows) for kind, rows in zip(kinds, at.others, strict=True))
    priors = job.priors
    if priors is not None:
        assert isinstance(home, Similarity)
        priors = priors.moved(home)
    observed = job.model, kernels, graph, job.q, weights, loss
    parts = {"freedom": job.freedom, "whitening": job.whitening, "priors": priors, **parts}
    problem = bundle_problem(*observed, kinds=kinds, **parts)
    return home, problem, Estimate(cameras, points, others=others)


def minimized(
    job: Job, graph: ObservationGraph, weights: Array, kernels: Table, way: Way, loss: Loss
) -> tuple[lm.Outcome[BundleState], Estimate]:
    """Minimise by a method; return how it ended, and the estimate in the gauge of the result.

    Normal equations that were not needed to the end are made when the `system` of the outcome is
    called.

    Raises
    ------
    ArgumentError
        On parts that exclude one another, and a start that leaves the steps undetermined.
    """
    strategy, implicit = STRATEGIES[way.method], way.gauge_mode == "implicit"
    gauge: Gauge | None = way.gauge
    name = strategy.damping if way.damping is None else way.damping
    if name in PROJECTIVE_ONLY and not job.model.homogeneous:
        what = "damping" if way.damping else "method"
        needed = "a projective start, or another method"
        raise ArgumentError(what, f"is {name!r} for {job.model.name} cameras", needed)
    affine = not (job.model.metric or job.model.homogeneous)
    if affine and strategy.reference:
        was = f"is {way.method!r} for {job.model.name} cameras, which have no gauge of that name"
        others = (name for name, own in STRATEGIES.items() if not own.reference)
        usable = ", ".join(name for name in others if name not in PROJECTIVE_ONLY)
        raise ArgumentError("method", was, f"one of {usable}")
    act: Any = DAMPINGS[name](kernels)
    if isinstance(act, Covariant) and job.model.metric:
        act = Covariant(LAM_FLOOR_METRIC)
    if not isinstance(act, ByMatrix):
        # Such a step is made for all parameters, free and unconstrained.
        if strategy.reference or strategy.constrained:
            raise ArgumentError(
                "damping", f"is {name!r} with method={way.method!r}", "one that adds a matrix"
            )
        if gauge is not None and implicit:
            raise ArgumentError(
                "gauge_mode", "is 'implicit' with a damping that adds no matrix", "'explicit'"
            )
    moving = gauge is not None or strategy.gauge is not None or name == "none"
    if job.fixes_gauge and moving:
        was = f"leaves the gauge to be chosen, which what is fixed or known does ({way.method!r})"
        raise ArgumentError("method", was, "method='covariant', without a gauge")
    explicit = strategy.gauge if strategy.explicit else gauge
    if gauge is not None and implicit:
        act, explicit = Implicit(act, gauge), None
    chosen: tuple[int, ...] = ()
    own_gauge = strategy.gauge
    if strategy.reference == "points":
        choose = five_points.choose if job.model.homogeneous else five_points.choose_three
        chosen = tuple(choose(job.points))
        own_gauge = five_points(chosen)
    # The best conditioned frame, where the method does not mind and the caller does not ask.
    wanted = own_gauge or explicit
    home = isinstance(act, Covariant) and gauge is None and wanted is None
    homogeneous = job.model.homogeneous
    kinds = tuple(kind.with_loss(loss) for kind in job.kinds)

    def moved(there: Move, at: Estimate) -> Estimate:
        """Return an estimate after a move of space."""
        pairs = zip(kinds, at.others, strict=True)
        others = tuple(kind.carried(there, rows) for kind, rows in pairs)
        return Estimate(*there.apply(at.cameras, at.points), others=others)

    def conditioned(at: Estimate) -> Estimate:
        return moved(best_conditioned(job.model, at.cameras, at.points)[0], at)

    def checked(reached: BundleState, begun: Estimate) -> bool:
        """Tell whether the default method finds nothing lower, either."""
        parts = job.model, kernels, graph, job.q, weights, loss
        free = bundle_problem(*parts, embedded=True, workers=way.workers, kinds=kinds)
        there = BundleState(conditioned(reached.estimate), reached.cost)
        return not far.short_of_minimum(free, there, conditioned(begun))

    def attempt(at: Estimate) -> tuple[lm.Outcome[BundleState], Estimate]:
        start = job.model, at.cameras, at.points
        if home:
            there, cameras, points = best_conditioned(*start)
            pairs = zip(kinds, at.others, strict=True)
            others = tuple(kind.carried(there, own) for kind, own in pairs)
            begun = Estimate(cameras, points, others=others)
        else:
            there = move_into(wanted or identity(), *start)
            begun = moved(there, at)
        priors = job.priors
        if priors is not None:
            assert isinstance(there, Similarity)
            priors = priors.moved(there)
        problem = bundle_problem(
            job.model,
            kernels,
            graph,
            job.q,
            weights,
            loss,
            embedded=way.embedded and strategy.embedded and name == "covariant",
            workers=way.workers,
            freedom=freedom_of(
                strategy, explicit, job.model, kernels, begun.cameras, chosen, job.freedom
            ),
            priors=priors,
            whitening=job.whitening,
            kinds=kinds,
        )
        # Points jump alike whatever the basis, but only in the one chosen here: in no gauge.
        # Where points are elsewhere they can stay there from step to step.
        resident = getattr(problem.linearizer, "resident", None)
        if resident is not None and isinstance(act, Covariant):
            problem = resident(problem)
        jumps = homogeneous and problem.refinement is not None and gauge is None
        minimize = far.minimize if jumps else lm.minimize
        how = act, way.rule(job.model), way.stopping, way.callback, job.scale_px**2
        outcome = minimize(problem, begun, *how)
        outcome = problem.fetched(outcome)
        if homogeneous and home and outcome.system is None and np.isfinite(outcome.state.cost):
            later: Any = partial(problem.linearize, outcome.state)
            outcome = replace(outcome, system=later)
        claims = homogeneous and outcome.status > 0 and not jumps
        if claims and not checked(outcome.state, begun):
            outcome = replace(outcome, status=-1)
        found = outcome.state.estimate
        return outcome, moved(there.inverse(), found) if home else found

    first = Estimate(job.cameras, job.points, others=job.others)
    try:
        # What is fixed must not be moved by a thousandth.
        if homogeneous and not job.fixes_gauge:
            return far.minimized_from(attempt, first, partial(seeing, job, graph, kernels))
        return attempt(first)
    except np.linalg.LinAlgError:
        raise ArgumentError(
            "start",
            f"leaves the steps of method={way.method!r} undetermined (singular normal equations), "
            "and so does one a thousandth away",
            "cameras with different centres, points away from them and not in one plane, or "
            "method='covariant'",
        ) from None
