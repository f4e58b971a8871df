"""The one Levenberg-Marquardt loop: problem + damping + schedule + linear system.

A *problem* evaluates the cost of an estimate, linearises it into a linear system, and retracts a
step. A *damping* turns the system and lambda into a step, a *schedule* chooses lambda. Every method
that epigauge compares is a combination of such parts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError

__all__ = [
    "STATUS",
    "Adaptive",
    "Classic",
    "Damping",
    "Nielsen",
    "Outcome",
    "Problem",
    "Row",
    "Schedule",
    "State",
    "Stopping",
    "System",
    "minimize",
    "rows",
]

Array = NDArray[np.float64]

#: Meaning of `status`; positive is success.
STATUS = {
    -4: "stopped where the points are not at their minimum for this F: a better start is needed",
    -3: "the cost at the start is not finite",
    -2: "stopped by the callback",
    -1: "stopped short of a minimum: no step of this method lowers the cost, however short, as "
    "gross errors or a bad start bring about: use a robust loss, another start or method",
    0: "max_iter trial steps taken without convergence",
    1: "converged: gradient below gtol",
    2: "converged: relative decrease of the cost below ftol",
    3: "converged: step below xtol",
    4: "converged: the decrease still to be expected is below ftol",
    5: "converged: the cost is at the rounding of the data",
}

_LAM_CEILING = 1e16

#: Shares of the cost: what no sum of squares tells apart, and by how much rounding at most raises a
#: cost whose points are refined to a tolerance of as much.
_ROUNDING, _NOISE = 1e-15, 1e-12

#: Most trial steps: the compiled loop keeps a row for each.
_MAX_ITER = 1_000_000


class State(Protocol):
    """What a problem knows about one estimate; at least its cost, 0.5 * sum of squares."""

    @property
    def cost(self) -> float:
        """Return the cost."""


S = TypeVar("S", bound=State)


class System(Protocol):
    """A problem linearised at one estimate; how it is solved is between it and its dampings."""

    @property
    def gradient(self) -> Array:
        """Return the gradient of the cost."""

    def largest(self) -> float:
        """Return the largest diagonal entry of the Hessian."""

    def predicted(self, step: Any) -> float:
        """Return the decrease of the cost that the quadratic model promises for a step."""

    def decrement(self) -> float:
        """Return the decrease promised by the undamped step; infinity where it is not known."""


class Problem(Protocol[S]):
    """A cost function over estimates of any kind."""

    @property
    def floor(self) -> float:
        """Return a cost so low that it is rounding error."""

    def evaluate(self, estimate: Any) -> S:
        """Return the state of an estimate; a cost of infinity rejects it."""

    def linearize(self, state: S) -> System:
        """Return the linear system at a state."""

    def retract(self, state: S, step: Any) -> Any:
        """Return the estimate that a step leads to."""


class Damping(Protocol):
    """Turns a linear system and lambda into a step."""

    def start(self, system: Any) -> float:
        """Return the first lambda."""

    def step(self, system: Any, lam: float) -> Any:
        """Return the step: a vector, or what NumPy makes one of."""


class Schedule(Protocol):
    """Chooses lambda after each trial step; `ratio` is the actual over the predicted decrease."""

    def accepted(self, lam: float, ratio: float) -> float:
        """Return the next lambda after a step that reduced the cost."""

    def rejected(self, lam: float) -> float:
        """Return the next lambda after a step that did not."""


@dataclass
class Classic:
    """Divide or multiply lambda by a constant factor: both papers' rule."""

    factor: float = 10.0

    def accepted(self, lam: float, ratio: float) -> float:
        """Divide lambda by the factor."""
        return lam / self.factor

    def rejected(self, lam: float) -> float:
        """Multiply lambda by the factor."""
        return lam * self.factor


@dataclass
class Nielsen:
    """Nielsen's rule: lambda shrinks smoothly with the gain ratio, and grows ever faster.

    References
    ----------
    .. [1] H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, 1999.
    """

    growth: float = 2.0

    def accepted(self, lam: float, ratio: float) -> float:
        """Multiply lambda by max(1/3, 1 - (2 ratio - 1)^3)."""
        self.growth = 2.0
        return lam * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)

    def rejected(self, lam: float) -> float:
        """Multiply lambda by a factor that doubles with each rejection."""
        lam *= self.growth
        self.growth *= 2.0
        return lam


@dataclass
class Adaptive:
    """The classic rule until a step is rejected, then Nielsen's.

    Steps along a curved valley fail beyond some length: the constant factor then tries too long a
    step after every one that is accepted, while the gain ratio holds lambda near its best.
    """

    rule: Classic | Nielsen = field(default_factory=Classic)

    def accepted(self, lam: float, ratio: float) -> float:
        """Return what the rule in force says."""
        return self.rule.accepted(lam, ratio)

    def rejected(self, lam: float) -> float:
        """Multiply lambda by the constant factor the first time, then as Nielsen does."""
        if isinstance(self.rule, Nielsen):
            return self.rule.rejected(lam)
        larger = self.rule.rejected(lam)
        self.rule = Nielsen()
        return larger


@dataclass(frozen=True)
class Stopping:
    """When to stop; tolerances are compared as written in `minimize`.

    Attributes
    ----------
    ftol : float
        Relative decrease of the cost.
    xtol : float
        Length of an accepted step in the units of the parameterisation.
    gtol : float
        Largest absolute entry of the gradient.
    max_iter : int
        Trial steps, accepted or rejected; from 1 to 1,000,000.
    """

    ftol: float = 1e-10
    xtol: float = 1e-12
    gtol: float = 1e-14
    max_iter: int = 100

    def __post_init__(self) -> None:
        for name in ("ftol", "xtol", "gtol"):
            value = getattr(self, name)
            if not (isinstance(value, float | int | np.floating) and 0.0 <= value < 1.0):
                raise ArgumentError(name, f"is {value!r}", "a number in [0, 1)")
        count = isinstance(self.max_iter, int | np.integer) and not isinstance(self.max_iter, bool)
        if not count or not 1 <= self.max_iter <= _MAX_ITER:
            needed = f"an integer of at least 1, at most {_MAX_ITER}"
            raise ArgumentError("max_iter", f"is {self.max_iter!r}", needed)


@dataclass(frozen=True)
class Row:
    """One evaluation of the cost: row 0 is the start, every other one a trial step.

    Attributes
    ----------
    iteration : int
        Number of the trial step.
    cost : float
        Cost of the trial, whether accepted or not.
    lam : float
        Damping the step was made with; NaN never occurs, the start has 0.
    step_norm : float
        Euclidean length of the step in the units of the parameterisation.
    accepted : bool
        Whether the trial became the estimate.
    seconds : float
        Time since the start of the minimisation.
    """

    iteration: int
    cost: float
    lam: float
    step_norm: float
    accepted: bool
    seconds: float


@dataclass(frozen=True)
class Outcome(Generic[S]):
    """Where a minimisation ended: state, linear system there, counts, reason and history.

    The compiled loop (`epigauge.two_view.native`) leaves no linear system behind, nor do the first
    steps of a far start (`epigauge.bundle.far`).
    """

    state: S
    system: System | None
    nfev: int
    njev: int
    nit: int
    status: int
    history: tuple[Row, ...]


def rows(history: Array, scale: float) -> tuple[Row, ...]:
    """Return the history of a compiled loop, (k, 6), as rows; costs are multiplied by `scale`."""
    return tuple(
        Row(int(iteration), cost * scale, lam, norm, accepted == 1.0, seconds)
        for iteration, cost, lam, norm, accepted, seconds in history.tolist()
    )


def minimize(
    problem: Problem[S],
    start: Any,
    damping: Damping,
    schedule: Schedule,
    stopping: Stopping,
    callback: Callable[[Row], object] | None = None,
    scale: float = 1.0,
) -> Outcome[S]:
    """Minimise a cost by damped steps.

    A problem may have a method `compiled` that runs the same loop in C; it returns None where that
    does not know all parts. One that can linearise and make a step in one pass may have a method
    `expect`, which is told the next lambda before `linearize`, 0 where no step follows.

    Parameters
    ----------
    problem : Problem
        Cost, linearisation and retraction.
    start : object
        Where to begin: an estimate of the problem.
    damping : Damping
        Turns a linear system and lambda into a step; lambda stays above its `lam_floor` times the
        first one, if it has one.
    schedule : Schedule
        Accepts or rejects the step and gives the next lambda.
    stopping : Stopping
        Tolerances and the number of steps allowed.
    callback : callable, optional
        Called with each `Row`; a true return value stops the minimisation.
    scale : float
        Factor from the problem's cost to the unit that the history is told in.

    Returns
    -------
    Outcome
        The best state, never worse than the start.

    Notes
    -----
    With c the cost, dc > 0 the decrease of an accepted step and g the gradient, the loop ends when

    - ``max|g| <= gtol`` (status 1),
    - ``dc <= ftol * c``, c being the cost after the step (2),
    - ``|step| <= xtol`` for an accepted step (3),
    - ``decrement <= ftol * c`` before a step, the decrement being the decrease that the undamped
      quadratic model still promises (4); not all linear systems know it,
    - ``c <= problem.floor`` (5), or a step neither lowers nor raises the cost beyond
      ``1e-15 * c``, or the least damped one that knows what it promises (attribute `promised`)
      promises no more than that and raises the cost by at most ``1e-12 * c`` (2): then rounding
      decides.
    """
    # Only a damping whose lambda has no unit can say which one is too small.
    lam_floor: float = getattr(damping, "lam_floor", 0.0)
    compiled = getattr(problem, "compiled", None)
    if compiled is not None and callback is None:
        done = compiled(start, damping, schedule, stopping, scale, lam_floor)
        if done is not None:
            found: Outcome[S] = done
            return found
    expect = getattr(problem, "expect", None)
    begun = time.perf_counter()
    state = problem.evaluate(start)
    history: list[Row] = []
    njev, iteration = 0, 0

    def record(cost: float, lam: float, norm: float, accepted: bool) -> bool:
        seconds = time.perf_counter() - begun
        history.append(Row(iteration, cost * scale, lam, norm, accepted, seconds))
        return bool(callback(history[-1])) if callback is not None else False

    stop = record(state.cost, 0.0, 0.0, True)
    system = problem.linearize(state)
    njev += 1
    lam = damping.start(system)
    least = lam_floor * lam

    def outcome(status: int) -> Outcome[S]:
        counts = (len(history), njev, iteration)
        return Outcome(state, system, *counts, status, tuple(history))

    def too_large(lam: float) -> bool:
        # Not `>`: lam has outgrown a ceiling that is infinite or NaN, too.
        return not lam <= min(_LAM_CEILING * max(system.largest(), 1e-300), 1e300)

    if stop:
        return outcome(-2)
    if not math.isfinite(state.cost):
        return outcome(-3)
    while True:
        if state.cost <= problem.floor:
            return outcome(5)
        if float(np.max(np.abs(system.gradient))) <= stopping.gtol:
            return outcome(1)
        if system.decrement() <= stopping.ftol * state.cost:
            return outcome(4)
        rejected = False
        while True:
            if iteration >= stopping.max_iter:
                return outcome(0)
            try:
                step = damping.step(system, lam)
            except np.linalg.LinAlgError:  # singular to rounding: more damping
                lam = schedule.rejected(lam)
                if too_large(lam):
                    return outcome(-1)
                continue
            iteration += 1
            trial = problem.evaluate(problem.retract(state, step))
            decrease = state.cost - trial.cost
            with np.errstate(over="ignore"):  # of nearly singular equations: it is rejected
                norm = float(np.linalg.norm(step))
            accepted = decrease > 0.0
            stop = record(trial.cost, lam, norm, accepted)
            if accepted:
                break
            if stop:
                return outcome(-2)
            if abs(decrease) <= _ROUNDING * state.cost:
                return outcome(2)
            # More damping makes any promise small: only that of the first step tells.
            promised = getattr(step, "promised", math.inf)
            settled = promised <= _ROUNDING * state.cost and -decrease <= _NOISE * state.cost
            if settled and not rejected:
                return outcome(2)
            rejected = True
            lam = schedule.rejected(lam)
            if too_large(lam):
                return outcome(-1)
        predicted = system.predicted(step)
        lam = max(schedule.accepted(lam, decrease / predicted if predicted > 0.0 else 1.0), least)
        state = trial
        ended = 0
        if stop:
            ended = -2
        elif decrease <= stopping.ftol * state.cost:
            ended = 2
        elif norm <= stopping.xtol:
            ended = 3
        if expect is not None:
            expect(0.0 if ended or iteration >= stopping.max_iter else lam)
        system = problem.linearize(state)
        njev += 1
        if ended:
            return outcome(ended)
