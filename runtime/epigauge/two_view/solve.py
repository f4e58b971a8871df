"""From options to a problem and its minimum, in conditioned coordinates.

This is where parameterisation, criterion, structure, damping and loss meet; `refine` checks the
caller's arguments before and brings the result back to pixels afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.kernels import Table
from epigauge.linear import Levenberg, Seber
from epigauge.two_view import native
from epigauge.two_view.conditioning import Conditioning, condition, displaced
from epigauge.two_view.covariance import scale_of_kept
from epigauge.two_view.criteria import CRITERIA, Criterion, Mahalanobis, Reprojection
from epigauge.two_view.eliminated import EliminatedProblem
from epigauge.two_view.essential import Calibrated, Essential
from epigauge.two_view.free import FreeProblem
from epigauge.two_view.fused import FusedProblem
from epigauge.two_view.joint import JointProblem
from epigauge.two_view.losses import EFFICIENT, Loss, robust_scale
from epigauge.two_view.parameterizations import (
    PARAMETERIZATIONS,
    RESTRICTABLE,
    Ortho,
    Parameterization,
    ParFree,
    Reduced,
    Remapped,
    frozen_directions,
)

__all__ = [
    "DAMPINGS",
    "REDESCENDING",
    "REDUNDANT",
    "Matches",
    "Options",
    "Solution",
    "best_start",
    "joined",
    "minimize",
]

Array = NDArray[np.float64]

DAMPINGS: dict[str, type[Levenberg] | type[Seber]] = {"levenberg": Levenberg, "seber": Seber}

#: Parameterisations by cameras, more than seven parameters, always solved jointly with the points.
REDUNDANT = ("parfree", "free", "normalized")

#: The loss whose influence falls to zero: where it ends depends on the start most of all.
REDESCENDING = "truncated"

#: The scale of a loss is estimated anew until it changes by less than this (relative).
_SCALE_SETTLED = 1e-3
_SCALE_ROUNDS = 10

#: Joint solutions whose cost exceeds that of the best points by more than this did not converge.
_SETTLED = 1e-6

#: The same where the number of steps ran out.
_STUCK = 1e-2


@dataclass(frozen=True)
class Options:
    """The choices of `refine_fundamental`, checked.

    `anchor` is the F in pixels whose parts `fix` leaves as they are.
    """

    parameterization: str = "ortho"
    criterion: str = "reprojection"
    structure: str = "eliminated"
    damping: str = "levenberg"
    hessian: str = "exact"
    fix: tuple[str, ...] = ()
    anchor: Array | None = None
    calibration: tuple[Array, Array] | None = None
    loss: str = "linear"
    bias_correction: bool = False
    loss_scale_px: float | None = None
    stopping: lm.Stopping = field(default_factory=lm.Stopping)

    def scaled_loss(self, scale: float) -> Loss:
        """Return the loss with a scale in conditioned coordinates."""
        return Loss(self.loss, scale)


@dataclass(frozen=True)
class Matches:
    """Matches with weights, in the coordinates that are computed in.

    Attributes
    ----------
    table : Table
        Backend.
    frame : Conditioning
        These coordinates.
    q1, q2 : ndarray, shape (2, m)
        Matches.
    weights : ndarray, shape (m,)
        Factor of the cost of each match.
    covariances : tuple of ndarray, shape (m, 2, 2) each, or None
        In pixels: distances, times ``frame.scale``, are then in units of the noise.
    """

    table: Table
    frame: Conditioning
    q1: Array
    q2: Array
    weights: Array
    covariances: tuple[Array, Array] | None = None

    @staticmethod
    def of(
        x1: Array,
        x2: Array,
        weights: Array,
        F: Array | None,
        table: Table,
        covariances: tuple[Array, Array] | None = None,
    ) -> Matches:
        """Condition matches in pixels around those that count, for a start value in pixels."""
        counts = weights > 0.0
        frame = condition(x1[counts], x2[counts])
        if F is not None:
            frame = displaced(frame, frame.from_pixels(F))
        return Matches(table, frame, *frame.forward(x1, x2), weights, covariances)

    def calibrated(self, calibration: tuple[Array, Array]) -> Calibrated:
        """Return the matches of cameras with these calibration matrices."""
        maps = zip(self.frame.maps_from_pixels(), calibration, strict=True)
        return Calibrated(self.q1, self.q2, *(to_units @ K for to_units, K in maps))

    def reprojection(self) -> Reprojection:
        """Return the exact criterion."""
        if self.covariances is not None:
            return Mahalanobis(self.table, self.q1, self.q2, *self.covariances)
        return Reprojection(self.table, self.q1, self.q2)

    def criterion(self, name: str) -> Criterion:
        """Return a criterion by name."""
        if name == "reprojection":
            return self.reprojection()
        return CRITERIA[name](self.table, self.q1, self.q2)


@dataclass(frozen=True)
class Solution:
    """A minimum in conditioned coordinates.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    chart : Parameterization
        Seven or fewer parameters around it, for derivatives.
    motion : Any
        The estimate in this chart.
    outcome : lm.Outcome
        How it was found.
    loss_scale_px : float
        Scale of the loss; 0 for the linear one.
    """

    F: Array
    chart: Parameterization
    motion: Any
    outcome: lm.Outcome[Any]
    loss_scale_px: float


def minimize(
    matches: Matches,
    options: Options,
    start: Array,
    callback: Callable[[lm.Row], object] | None = None,
) -> Solution:
    """Minimise from a start value.

    Parameters
    ----------
    matches : Matches
        What is fitted.
    options : Options
        How.
    start : ndarray, shape (3, 3)
        Conditioned F.
    callback : callable, optional
        As in `epigauge.lm.minimize`.

    Returns
    -------
    Solution
        The minimum. With a loss scale to be estimated, that of the last of several rounds, and the
        history of all of them.
    """
    if options.loss == "linear" or options.loss_scale_px is not None:
        return _minimize_once(matches, options, start, callback)
    history: tuple[lm.Row, ...] = ()
    njev = 0
    scale = _estimated_scale(matches, options, start)
    for _ in range(_SCALE_ROUNDS):
        fixed = replace(options, loss_scale_px=scale)
        solution = _minimize_once(matches, fixed, start, callback)
        history = joined(history, solution.outcome.history)
        njev += solution.outcome.njev
        start = solution.F
        previous, scale = scale, _estimated_scale(matches, options, start)
        if abs(scale - previous) <= _SCALE_SETTLED * previous or solution.outcome.status < 0:
            break
    nit = history[-1].iteration
    outcome = replace(solution.outcome, history=history, nfev=len(history), njev=njev, nit=nit)
    return replace(solution, outcome=outcome)


def best_start(matches: Matches, options: Options, start: Array) -> Array:
    """Return the better minimum of a redescending loss: from a start, and from Cauchy's there.

    The residuals of a start that wrong matches bend are wide, and so is then the loss. Cauchy's
    lets none of them go, and ends nearer; of both minima the one of lower cost counts.
    """
    smooth = replace(options, loss="cauchy", loss_scale_px=None)
    starts = (start, minimize(matches, smooth, start).F)
    found = (minimize(matches, options, F) for F in starts)
    return min(found, key=lambda solution: float(solution.outcome.state.cost)).F


def _minimize_once(
    matches: Matches,
    options: Options,
    start: Array,
    callback: Callable[[lm.Row], object] | None,
) -> Solution:
    scale_px = 0.0 if options.loss_scale_px is None else options.loss_scale_px
    loss = options.scaled_loss(scale_px / matches.frame.scale)
    chart = _chart(matches, options, start)
    if _is_native(matches, options, chart):
        exact = options.hessian == "exact"
        run = partial(
            native.minimize,
            chart,
            chart.start(start),
            (matches.q1, matches.q2, matches.weights),
            (options.criterion, options.loss, options.damping, exact),
            loss.scale,
            options.stopping,
            matches.frame.scale**2,
        )
        compiled = run()
        last = None if callback is None else stop_of(compiled.history, callback)
        if last is not None:
            told = tuple(row for row in compiled.history if row.iteration <= last)
            compiled = replace(run(at_most=last), status=-2, history=told)
        motion = compiled.state.motion
        return Solution(chart.fundamental(motion), chart, motion, compiled, scale_px)
    problem = _problem(matches, options, chart, loss)
    outcome: lm.Outcome[Any] = lm.minimize(
        problem,
        problem.start(start),
        DAMPINGS[options.damping](),
        lm.Classic(),
        options.stopping,
        callback,
        matches.frame.scale**2,
    )
    if options.parameterization in REDUNDANT:
        assert not isinstance(problem, EliminatedProblem)
        F = problem.fundamental(outcome.state.motion)
        motion = chart.start(F)
    else:
        motion = outcome.state.motion
    F = chart.fundamental(motion)
    if outcome.status >= -1 and not isinstance(problem, EliminatedProblem):
        outcome = replace(outcome, status=_settled(matches, F, loss, outcome))
    return Solution(F, chart, motion, outcome, scale_px)


def stop_of(history: tuple[lm.Row, ...], callback: Callable[[lm.Row], object]) -> int | None:
    """Tell a callback of a minimisation that is over; return the iteration that it stops at."""
    return next((row.iteration for row in history if callback(row)), None)


def _is_native(matches: Matches, options: Options, chart: Parameterization) -> bool:
    """Tell whether the compiled loop does the same, sooner."""
    over_F = options.structure == "eliminated" and options.parameterization not in REDUNDANT
    plain = matches.table.name == "c" and matches.covariances is None
    return over_F and plain and native.supports(options.criterion, chart)


def _settled(matches: Matches, F: Array, loss: Loss, outcome: lm.Outcome[Any]) -> int:
    """Return the status, corrected where points are left far from the best ones for this F.

    A point that crosses a focal plane or starts near an epipole can hold up all the others; the
    steps, though short, are then no sign of convergence. Where the number of steps ran out, that is
    so if the points have more to gain than the second half of the steps did.
    """
    rho, _, _ = loss(matches.reprojection().evaluate(F).squared)
    lowest = 0.5 * float(np.sum(matches.weights * rho))
    rounding = 1e-24 * float(np.sum(matches.weights))
    gap = outcome.state.cost - lowest
    if gap <= _SETTLED * lowest + rounding:
        return outcome.status
    if outcome.status == 0:
        rows = outcome.history[: max(len(outcome.history) // 2, 1)]
        before = min(row.cost for row in rows if row.accepted) / matches.frame.scale**2
        if gap <= max(before - outcome.state.cost, _STUCK * lowest):
            return 0
    return -4


def _chart(matches: Matches, options: Options, start: Array) -> Parameterization:
    """Return the minimal parameterisation, restricted as asked for, suited to a start value."""
    name = "ortho" if options.parameterization in REDUNDANT else options.parameterization
    kind = PARAMETERIZATIONS[name]
    chart: Parameterization = kind(matches.table)
    to1, to2 = matches.frame.maps_from_pixels()
    if options.calibration is not None:
        cameras = matches.calibrated(options.calibration)
        rays = cameras.rays(matches.q1, matches.q2)
        return Remapped(Essential(matches.table, rays), cameras.A1, cameras.A2)
    if "epipolar_transformation" in options.fix:
        # Its coordinates are those of the pixels. Here both charts move alike; only in this one
        # sigma is a number that stays to the last bit.
        basis = frozen_directions(Ortho.parts, options.fix)
        inner = Reduced(Ortho(matches.table), basis)
        return Remapped(inner, to1, to2, options.anchor).balanced(start)
    if options.fix:
        # An epipole that stays in pixels stays in all coordinates
        restrictable = RESTRICTABLE[name]
        basis = frozen_directions(restrictable.parts, options.fix)
        return Reduced(restrictable(matches.table), basis)
    return chart


def _problem(
    matches: Matches, options: Options, chart: Parameterization, loss: Loss
) -> EliminatedProblem | JointProblem | FreeProblem | FusedProblem:
    if options.structure != "joint" and options.parameterization not in REDUNDANT:
        criterion = matches.criterion(options.criterion)
        exact = options.hessian == "exact"
        return EliminatedProblem(criterion, chart, matches.weights, loss, exact)
    reference = _joint_problem(matches, options, chart, loss)
    return FusedProblem(reference) if matches.table.name == "c" else reference


def _joint_problem(
    matches: Matches, options: Options, chart: Parameterization, loss: Loss
) -> JointProblem | FreeProblem:
    table, fitted = matches.table, (matches.q1, matches.q2, matches.weights, loss)
    if options.parameterization in ("free", "normalized"):
        return FreeProblem(table, *fitted, options.parameterization == "normalized")
    redundant = options.parameterization == "parfree"
    return JointProblem(table, ParFree(table) if redundant else chart, *fitted)


def _estimated_scale(matches: Matches, options: Options, F: Array) -> float:
    """Return the scale of the loss, in pixels, at which it is 95 % efficient for clean data."""
    criterion = matches.criterion(options.criterion)
    counts = matches.weights > 0.0
    signed = criterion.evaluate(F).signed[counts]
    sigma = robust_scale(signed)
    if options.loss == REDESCENDING:  # it leaves wrong ones out, and so its scale can
        sigma = scale_of_kept(signed, sigma)
    # Noise-free data: any scale will do that is not zero.
    return EFFICIENT[options.loss] * max(sigma, 1e-12) * matches.frame.scale


def joined(first: tuple[lm.Row, ...], second: tuple[lm.Row, ...]) -> tuple[lm.Row, ...]:
    """Return two histories as one."""
    if not first:
        return second
    last = first[-1]
    return first + tuple(
        replace(row, iteration=row.iteration + last.iteration, seconds=row.seconds + last.seconds)
        for row in second
    )
