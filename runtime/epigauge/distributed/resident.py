"""A problem whose points stay at the workers from step to step; cameras and sums travel."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.dampings import START, START_METRIC
from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import Normal
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate, in_range
from epigauge.bundle.reduced import Bordered, Iterated
from epigauge.bundle.solve import Blocks, BundleSystem
from epigauge.bundle.ties import congruent
from epigauge.distributed.linearizer import DistributedCoupling, DistributedLinearizer
from epigauge.distributed.sums import Rows
from epigauge.distributed.worker import Recipe

__all__ = ["ResidentProblem"]

Array = NDArray[np.float64]

_TOKENS = itertools.count()

#: Accepted steps after which the client fetches the points: so many at most are made once more
#: where a partition is lost.
_REPLAYED = 4


@dataclass(frozen=True)
class ResidentEstimate:
    """Cameras here, and points that are known by a token.

    Attributes
    ----------
    cameras : ndarray, shape (n, c)
        The cameras.
    token : int
        Name of the points' state.
    total : float
        Sum of the points' costs.
    steps : int
        How many steps led here.
    """

    cameras: Array
    token: int
    total: float
    steps: int
    point_costs: None = None


@dataclass
class ResidentStep:
    """A step of the cameras; that of the points is made where they are."""

    cameras: Array
    lam: float
    energy: float
    slope: float
    of_points: float = 0.0

    def __array__(self, dtype: Any = None, copy: Any = None) -> Array:
        """Return a vector as long as the whole step."""
        return np.append(self.cameras.ravel(), math.sqrt(self.of_points))

    def take(self, slope: float, energy: float, squared: float) -> None:
        """Take what the points' part adds."""
        self.slope, self.energy = self.slope + slope, self.energy + energy
        self.of_points = squared

    @property
    def promised(self) -> float:
        """Return the decrease of the cost in the quadratic model."""
        return 0.5 * (self.lam * self.energy - self.slope)


@dataclass(frozen=True)
class ResidentSystem(BundleSystem):
    """Normal equations of the cameras; those of the points are where these are.

    Attributes
    ----------
    linearizer : DistributedLinearizer
        The workers.
    token : int
        Name of the points' state.
    peak, steepest : float
        Largest mean diagonal entry of a point's block, and largest entry of its gradient.
    ahead : tuple or None
        A lambda, and what eliminating the points damped by it leaves, if that is known already.
    """

    linearizer: DistributedLinearizer = field(kw_only=True)
    token: int = field(kw_only=True)
    peak: float = field(kw_only=True)
    steepest: float = field(kw_only=True)
    ahead: tuple[float, Rows, Rows] | None = field(kw_only=True)

    @property
    def gradient(self) -> Array:
        """Return the gradient of views and shared unknowns, and the points' largest entry."""
        x, s, _ = self.gradients
        return np.concatenate([x.ravel(), s, [self.steepest]])

    def largest(self) -> float:
        """Return the largest mean diagonal entry of a block."""
        return max(super().largest(), self.peak)

    def predicted(self, step: Any) -> float:
        """Return the decrease that the quadratic model promises for a step that was tried."""
        return float(step.promised)

    def damped_step(self, blocks: Blocks, lam: float) -> Any:
        """Return the cameras' part of -(J^T J + lam blocks)^-1 g."""
        own, normal = self.linearizer, self.normal
        whitening = _inverse_roots(blocks.cameras)
        ties = self.ties.then(whitening, None).scaled(1.0 / np.sqrt(blocks.shared))
        white = congruent(ties.A, normal.U)
        white = white + lam * np.eye(white.shape[1])
        if self.ahead is not None and self.ahead[0] == lam:
            _, found, right = self.ahead
        else:
            (found, right), _ = own.run.each("eliminate", (self.token, lam, own.direct))
        reduced: Bordered | Iterated
        if own.direct:
            reduced = Bordered(own.reduced.pairs(found), normal.U, ties, white, lam)
        else:
            coupling: Any = _Product(own, self.token, lam, own.reduced.outward(found))
            none = np.zeros((0, 3, 3))
            reduced = Iterated(coupling, normal.U, ties, none, white, lam)
        rhs = (own.reduced.outward(right) - normal.g_cameras)[..., None]
        x, s = reduced.solve(ties.local(rhs), ties.shared(rhs))
        step = np.ascontiguousarray(ties.cameras(x, s)[..., 0])
        energy, slope = np.vdot(x, x) + np.vdot(s, s), np.vdot(normal.g_cameras, step)
        return ResidentStep(step, lam, float(energy), float(slope))

    def whole(self, points: Array) -> BundleSystem:
        """Return the normal equations with the blocks of points, all of them here."""
        own = self.linearizer
        _, parts = own.run.each("blocks_of_state", (self.token,))
        blank, cameras = self.normal, self.cameras
        V, g = (own.joined([part[key] for part in parts]) for key in ("V", "g"))
        depth = None
        if blank.depth_blocks is not None:
            depth = blank.depth_blocks[0], own.joined([part["depth"] for part in parts])
        coupling = DistributedCoupling.of(own, cameras, points)
        normal = Normal(blank.U, V, blank.g_cameras, g, coupling, depth)
        parts_of = self.inverse_roots, self.ties, self.constraints
        return BundleSystem(normal, *parts_of, model=self.model, cameras=cameras, points=points)


@dataclass(frozen=True)
class _Product:
    """P by its products at the workers, as `Iterated` asks for it."""

    linearizer: DistributedLinearizer
    token: int
    lam: float
    blocks: Array

    def diagonal(self, T: Array) -> Array:
        """Return the diagonal blocks, which came with the right-hand side."""
        return self.blocks

    def to_points(self, T: Array, x: Array) -> Array:
        """Return what `to_cameras` goes on with: both are one pass at the workers."""
        return x

    def to_cameras(self, T: Array, x: Array) -> Array:
        """Return P x."""
        own = self.linearizer
        (rows,), _ = own.run.each("product", (self.token, self.lam, x))
        return own.reduced.outward(rows)


@dataclass(frozen=True)
class ResidentProblem(BundleProblem):
    """The problem of which points stay at the workers.

    The client keeps the points of an accepted state and the cameras of the steps since, from which
    lost partitions are rebuilt.
    """

    held: _Held = field(kw_only=True)

    @staticmethod
    def of(problem: BundleProblem) -> BundleProblem:
        """Return this for a problem, or the problem itself where it has parts unknown here."""
        known = type(problem) is BundleProblem and type(problem.freedom) is Freedom
        if not known or problem.priors is not None:
            return problem
        parts = {part.name: getattr(problem, part.name) for part in fields(BundleProblem)}
        own: Any = problem.linearizer
        own.kept = problem.freedom.kept
        return ResidentProblem(**parts, held=_Held(own))

    def evaluate(self, estimate: Any) -> BundleState:
        """Return the state of an estimate; a cost of infinity where it has none."""
        if not isinstance(estimate, ResidentEstimate):
            return super().evaluate(estimate)
        cost = 0.5 * estimate.total
        usable = math.isfinite(cost) and self._focal(estimate.cameras)
        own: Any = estimate
        return BundleState(own, cost if usable else float("inf"))

    def expect(self, lam: float) -> None:
        """Take the lambda of the next step from the state to be linearised, 0 for none."""
        self.held.expected = lam

    def linearize(self, state: BundleState) -> BundleSystem:
        """Return the normal equations of the cameras."""
        estimate: Any = state.estimate
        own, held = self._own, self.held
        if not isinstance(estimate, ResidentEstimate):
            token = held.begin(estimate.cameras, estimate.points)
            # Points alone: recipes would take all observations along.
            own.run.each("load", (token, estimate.cameras), own.own(estimate.points))
        else:
            token = estimate.token
        lam, held.expected = held.expected, 0.0
        sums, parts = own.run.each("linearize_state", (token, lam, own.direct))
        ahead = None
        if lam > 0.0:
            found, right = sums[-2:]
            sums = sums[:-2]
            if not any(part["singular"] for part in parts):
                ahead = lam, found, right
        if held.accept(token) >= _REPLAYED:
            held.take(token, state.cameras, self._points(token))
        U, g, *depth = (own.reduced.outward(rows) for rows in sums)
        b = self.model.point_size
        none = np.zeros((0, b, b))
        blocks = (depth[0], none) if depth else None
        coupling: Any = None
        normal = Normal(U, none, g, np.zeros((0, b)), coupling, blocks)
        ties = replace(self.freedom.ties, C=None)
        return ResidentSystem(
            normal,
            own.inverse_roots,
            ties,
            model=self.model,
            cameras=state.cameras,
            points=np.zeros((0, b)),
            linearizer=own,
            token=token,
            peak=max(part["largest"] for part in parts),
            steepest=max(part["steepest"] for part in parts),
            ahead=ahead,
        )

    def retract(self, state: BundleState, step: Any) -> Any:
        """Return the estimate that a step leads to, its points where they are."""
        cameras = self.retraction(state.cameras, step.cameras)
        if self.model.homogeneous:
            cameras = in_range(cameras)
        reached, held = next(_TOKENS), self.held
        trial = held.token, step.lam, step.cameras, cameras, self.refinement, reached
        held.trial = trial
        (total, slope, energy, squared), _ = self._own.run.each("advance", trial)
        step.take(slope, energy, squared)
        return ResidentEstimate(cameras, reached, total, state.estimate.steps + 1)

    def fetched(self, outcome: lm.Outcome[BundleState]) -> lm.Outcome[BundleState]:
        """Return an outcome with all points and blocks here."""
        state, system = outcome.state, outcome.system
        estimate: Any = state.estimate
        if isinstance(system, ResidentSystem):
            # The last system is that of the state.
            points = self._points(system.token)
            if isinstance(estimate, ResidentEstimate):
                estimate = Estimate(state.cameras, points, estimate.steps)
            system = replace(system.whole(points), ties=self.freedom.ties)
        return replace(outcome, state=replace(state, estimate=estimate), system=system)

    def _points(self, token: int) -> Array:
        """Return the points of a state, (m, b)."""
        return self._own.joined(self._own.run.each("points_of_state", (token,))[1])

    @property
    def _own(self) -> DistributedLinearizer:
        own: Any = self.linearizer
        found: DistributedLinearizer = own
        return found


def _inverse_roots(D: Array) -> Array:
    """Return A with A^T D A = I for blocks (n, d, d)."""
    diagonal = np.einsum("nii->ni", D)
    if np.count_nonzero(D) > np.count_nonzero(diagonal):
        return np.linalg.inv(np.swapaxes(np.linalg.cholesky(D), 1, 2))
    roots = np.zeros_like(D)
    np.einsum("nii->ni", roots)[...] = 1.0 / np.sqrt(diagonal)
    return roots


class _Held:
    """A state whose points are here, and the steps since: what lost partitions are rebuilt from."""

    def __init__(self, linearizer: DistributedLinearizer) -> None:
        self._linearizer = linearizer
        self._state: tuple[int, Array, Array] | None = None
        self._steps: tuple[tuple[Any, ...], ...] = ()
        #: Arguments of the `advance` to a state that is not accepted yet.
        self.trial: tuple[Any, ...] | None = None
        #: Lambda of the next step where it is known before the state is linearised, else 0; the
        #: first is that of `Covariant.start`.
        self.expected = START_METRIC if linearizer.model.metric else START
        linearizer.recover = self._recovered

    @property
    def token(self) -> int:
        """Return the name of the last accepted state."""
        assert self._state is not None
        found: int = self._steps[-1][-1] if self._steps else self._state[0]
        return found

    def begin(self, cameras: Array, points: Array) -> int:
        """Take a start; return its token."""
        token = next(_TOKENS)
        self.take(token, cameras, points)
        return token

    def take(self, token: int, cameras: Array, points: Array) -> None:
        """Take an accepted state with its points."""
        self._state, self._steps, self.trial = (token, cameras, points), (), None

    def accept(self, token: int) -> int:
        """Take the step to a state; return how many there are since the points."""
        if self.trial is not None and self.trial[-1] == token:
            self._steps = (*self._steps, self.trial)
        self.trial = None
        return len(self._steps)

    def _recovered(self, number: int, recipe: Recipe) -> Recipe:
        if self._state is None:
            return recipe
        token, cameras, points = self._state
        rows = self._linearizer.pieces[number].points
        trials = self._steps if self.trial is None else (*self._steps, self.trial)
        return replace(recipe, state=(token, cameras, points[rows]), trials=trials)
