"""Bundle adjustment of two views in compiled passes over the matches: no Jacobian is kept.

`joint`, `free` and `linear.Arrow` are the readable reference; a test compares both row by row of
the history. What a point adds to the normal equations is a factor of a few rows times products of
its coordinates (derive/epigauge_derive/models/joint.py), cheap enough to be made anew wherever it
is needed.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address, library
from epigauge.scatter import scatter_constraints
from epigauge.two_view.free import FreeProblem
from epigauge.two_view.joint import JointProblem
from epigauge.two_view.losses import LOSSES

__all__ = ["FusedArrow", "FusedProblem", "FusedState"]

Array = NDArray[np.float64]

#: Numbers of the problems in runtime/c/joint.c.
_CANONIC, _FREE, _NORMALIZED = range(3)


class _Matches(ctypes.Structure):
    """The eg_joint of joint.c."""

    _fields_ = (
        ("m", ctypes.c_ssize_t),
        *((name, ctypes.c_void_p) for name in ("q", "weights")),
        ("loss_scale2", ctypes.c_double),
        *((name, ctypes.c_int) for name in ("problem", "loss")),
    )


@cache
def _passes() -> dict[str, Any]:
    """Return the functions of joint.c, all of whose arguments are addresses."""
    counts = {"cost": 4, "normal": 8, "reduce": 7, "step": 7, "curvature": 6}
    found = {}
    for name, count in counts.items():
        found[name] = getattr(library(), f"eg_joint_{name}")
        found[name].argtypes = [ctypes.c_void_p] * count
        found[name].restype = ctypes.c_double if name in ("cost", "curvature") else None
    return found


@dataclass(frozen=True)
class FusedState:
    """Motion and structure, the cameras with their derivative, weights and cost.

    Attributes
    ----------
    motion : Any
        That of the parameterisation, or both cameras (2, 3, 4).
    points : ndarray, shape (k, m)
        (a, b, c), or homogeneous points.
    cameras : ndarray, shape (3 v, 4)
        The v cameras that move.
    derivative : ndarray, shape (12 v, p)
        Of their entries by the motion parameters.
    weight : ndarray, shape (m,)
        Weight of each match in the normal equations.
    cost : float
        Half the weighted robust sum of squares.
    """

    motion: Any
    points: Array
    cameras: Array
    derivative: Array
    weight: Array
    cost: float


class FusedProblem:
    """The same cost function as a `JointProblem` or a `FreeProblem`, in compiled passes.

    Steps hold the motion first, then the first coordinate of all points, the second of all, ...

    Parameters
    ----------
    reference : JointProblem or FreeProblem
        Gives matches, weights and loss, the start value, and the retraction.
    """

    def __init__(self, reference: JointProblem | FreeProblem) -> None:
        self.reference = reference
        self.floor = reference.floor
        self.problem = _CANONIC
        if isinstance(reference, FreeProblem):
            self.problem = _NORMALIZED if reference.normalized else _FREE
        # Kept here, since C has their addresses only
        self._arrays = [np.ascontiguousarray(a) for a in (reference.q, reference.weights)]
        self._matches = _Matches(
            len(reference.weights),
            *map(address, self._arrays),
            reference.loss.scale**2,
            self.problem,
            LOSSES.index(reference.loss.name),
        )

    def start(self, F: Array) -> tuple[Any, Array]:
        """Return motion and structure of a start value, each point at its foot point."""
        return self.reference.start(F)

    def evaluate(self, estimate: tuple[Any, Array]) -> FusedState:
        """Return the state of motion and structure."""
        motion, points = estimate
        cameras, derivative = self.reference.cameras(motion)
        cameras, points = np.ascontiguousarray(cameras), np.ascontiguousarray(points)
        weight = np.empty(points.shape[1])
        cost = self.over_matches("cost", cameras, points, weight)
        cost = cost if np.isfinite(cost) else float("inf")
        return FusedState(motion, points, cameras, derivative, weight, cost)

    def linearize(self, state: FusedState) -> FusedArrow:
        """Return the normal equations."""
        return FusedArrow(self, state)

    def retract(self, state: FusedState, step: Array) -> tuple[Any, Array]:
        """Return motion and structure that a step leads to."""
        p = state.derivative.shape[1]
        estimate = (state.motion, state.points)
        return self.reference.moved(estimate, step[:p], step[p:].reshape(state.points.shape))

    def fundamental(self, motion: Any) -> Array:
        """Return F of a motion."""
        return self.reference.fundamental(motion)

    def over_matches(self, name: str, *arrays: Array) -> Any:
        """Call a function of joint.c with contiguous arrays, some of which it fills."""
        return _passes()[name](ctypes.addressof(self._matches), *map(address, arrays))


class FusedArrow:
    """Normal equations of motion and structure, with the methods of `linear.Arrow`.

    Parameters
    ----------
    problem : FusedProblem
        Passes over the matches.
    state : FusedState
        Where the equations hold.

    Attributes
    ----------
    gradient : ndarray, shape (p + k m,)
        In the order of `FusedProblem`.
    """

    def __init__(self, problem: FusedProblem, state: FusedState) -> None:
        self._problem = problem
        self._at = (state.cameras, state.points, state.weight)
        entries, p = state.derivative.shape
        self.gradient = np.empty(p + state.points.size)
        self._diagonal = np.empty_like(state.points)
        factors, by_entries = np.empty((entries // 12, 6, 10)), np.empty(entries)
        problem.over_matches(
            "normal", *self._at, self.gradient[p:], self._diagonal, factors, by_entries
        )
        U = np.zeros((entries, entries))
        for k, factor in enumerate(factors):
            U[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = _unpacked(factor)
        self.gradient[:p] = state.derivative.T @ by_entries
        self._derivative, self._added, self._bind = state.derivative, np.zeros((p, p)), 0.0
        if problem.problem == _NORMALIZED:
            self._constrain(state)
        self._U = state.derivative.T @ U @ state.derivative + self._added

    def _constrain(self, state: FusedState) -> None:
        """Add the sizes of cameras and points, and multipliers that bind the points' steps."""
        # Weighted like the rest of the system, so that damping sees no foreign scale
        self._bind = float(np.mean(self._diagonal))
        self._diagonal += self._bind * state.points**2
        for k in (0, 1):
            P = state.cameras[3 * k : 3 * k + 3].ravel()
            self._added[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = self._bind * np.outer(P, P)
        constraints = np.swapaxes(scatter_constraints(np.eye(4)), 0, 1).reshape(16, -1)
        self._derivative = _block_diagonal(state.derivative, np.sqrt(self._bind) * constraints)

    def largest(self) -> float:
        """Return the largest diagonal entry."""
        return float(max(np.max(np.diag(self._U)), np.max(self._diagonal)))

    def typical(self) -> float:
        """Return the median diagonal entry of the points; see `linear.Arrow.typical`."""
        return float(np.median(self._diagonal))

    def solve(self, lam: float, *, scaled: bool) -> Array:
        """Solve by the Schur complement of the points, the multipliers beside the motion.

        Raises
        ------
        numpy.linalg.LinAlgError
            If a point's block or the complement is singular to rounding.
        """
        p, D = len(self._U), self._derivative
        if scaled:
            # A match of weight zero leaves zeros on the diagonal, which no factor would lift.
            floor = np.finfo(float).eps * max(self.largest(), np.finfo(float).tiny)
            damping = np.array([0.0, lam, floor, self._bind])
            lifted = lam * np.maximum(np.diag(self._U), floor)
        else:
            damping = np.array([lam, 0.0, 0.0, self._bind])
            lifted = np.full(p, lam)
        rows = len(D) // 4
        factor, e = np.empty((rows * (rows + 1) // 2, 10)), np.empty(len(D))
        self._problem.over_matches("reduce", *self._at, damping, factor, e)
        _check_finite(factor)
        reduced = D.T @ _unpacked(factor) @ D
        reduced[:p, :p] += self._added + np.diag(lifted)
        multipliers = np.arange(p, D.shape[1])
        reduced[multipliers, multipliers] -= 1.0
        motion = np.asarray(-np.linalg.solve(reduced, D.T @ e))
        step = np.empty_like(self.gradient)
        step[:p] = motion[:p]
        self._problem.over_matches("step", *self._at, damping, self._moves(motion), step[p:])
        _check_finite(step)
        return step

    def predicted(self, step: Array) -> float:
        """Return -(g^T step + step^T N step / 2)."""
        p, step = len(self._U), np.ascontiguousarray(step)
        motion, points = step[:p], step[p:].reshape(self._diagonal.shape)
        moves = self._moves(np.concatenate([motion, np.zeros(self._derivative.shape[1] - p)]))
        curvature = self._problem.over_matches("curvature", *self._at, moves, step[p:])
        if self._bind:
            Q = self._at[1]
            curvature += motion @ self._added @ motion
            curvature += self._bind * np.sum(np.sum(Q * points, axis=0) ** 2)
            constrained = self._derivative[24:, p:].T @ (points @ Q.T).ravel()
            curvature += constrained @ constrained
        return float(-(self.gradient @ step + 0.5 * curvature))

    def decrement(self) -> float:
        """Return infinity: J^T J may be singular by a free gauge."""
        return float("inf")

    def _moves(self, motion: Array) -> Array:
        """Return the steps of the cameras and of the multipliers as rows of four."""
        rows = np.zeros((3 if self._problem.problem == _CANONIC else 10, 4))
        moved = self._derivative @ motion
        rows.ravel()[: len(moved)] = moved
        return rows


def _check_finite(values: Array) -> None:
    if not np.isfinite(values).all():
        raise np.linalg.LinAlgError("the block of a point is singular")


@cache
def _places(rows: int) -> NDArray[np.intp]:
    """Return the place of entry (i, j) in the upper triangle of a symmetric matrix."""
    places = np.empty((rows, rows), dtype=np.intp)
    above = np.triu_indices(rows)
    places[above] = places.T[above] = np.arange(len(above[0]))
    return places


def _unpacked(sums: Array) -> Array:
    """Return the matrix (4 rows, 4 rows) of sums L x Q Q^T, both by their upper triangles."""
    rows = int(np.sqrt(2 * len(sums)))
    blocks = sums[_places(rows)][:, :, _places(4)]
    return np.asarray(blocks.swapaxes(1, 2).reshape(4 * rows, 4 * rows))


def _block_diagonal(A: Array, B: Array) -> Array:
    """Return both matrices in one, zero elsewhere."""
    matrix = np.zeros((len(A) + len(B), A.shape[1] + B.shape[1]))
    matrix[: len(A), : A.shape[1]] = A
    matrix[len(A) :, A.shape[1] :] = B
    return matrix
