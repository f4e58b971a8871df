"""What a worker holds of a problem: some points, and their part of a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.dampings import lifted
from epigauge.bundle.linearizer import Normal, PointRefinement, point_damping
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.problem import in_range
from epigauge.bundle.ties import congruent
from epigauge.cameras import camera_model
from epigauge.distributed.evaluation import Evaluation
from epigauge.distributed.fused import Elimination, eliminate, fits
from epigauge.distributed.observations import Observations, Setup, Source
from epigauge.distributed.sums import Rows, Terms

__all__ = ["Partition"]

Array = NDArray[np.float64]
Arrays = dict[str, Any]

#: Bytes that an observation takes once laid out, and that a point's blocks take.
_OF_OBSERVATION, _OF_POINT = 90, 270


class Partition:
    """A part of the problem, and the states of its points.

    Cameras are passed whole, (n, c), in the caller's order; sums over the partition come back as
    `Rows` in the order of the reduced system, the partition's points as arrays of their own.

    Parameters
    ----------
    setup : Setup
        What all partitions have in common.
    source : Observations or Source
        Its observations, or where they are. Those that can be read again may be dropped.
    kept : ndarray of bool, shape (m,), or None
        Points that are fixed.
    """

    def __init__(
        self, setup: Setup, source: Observations | Source, kept: NDArray[np.bool_] | None = None
    ) -> None:
        self.setup, self._kept = setup, kept
        self.model = camera_model(setup.model)
        self.states: dict[int, _State] = {}
        self._source = None if isinstance(source, Observations) else source
        self._evaluation: Evaluation | None = None
        if isinstance(source, Observations):
            self._evaluation = Evaluation(setup, source)

    @property
    def evaluation(self) -> Evaluation:
        """Return the observations laid out, read again where they were dropped."""
        found = self._evaluation
        if found is None:
            assert self._source is not None
            found = self._evaluation = Evaluation(self.setup, self._source.load())
        return found

    @property
    def laid_out(self) -> bool:
        """Tell whether the observations are here and can be read again."""
        return self._evaluation is not None and self._source is not None

    @property
    def nbytes(self) -> int:
        """Return about what `drop` would free."""
        if self._evaluation is None or self._source is None:
            return 0
        points = max((len(state.points) for state in self.states.values()), default=0)
        return _OF_OBSERVATION * self._evaluation.count + _OF_POINT * points

    def drop(self) -> None:
        """Forget all but where the points are."""
        self._evaluation = None
        for state in self.states.values():
            state.normal = state.damped = None

    # ---------------------------------------------------------------- points that stay here

    def load(self, token: int, cameras: Array, points: Array) -> tuple[Terms, None]:
        """Take the points of a state from outside."""
        self.states[token] = _State(cameras, points)
        return (), None

    def linearize_state(self, token: int, lam: float, direct: bool) -> tuple[Terms, Arrays]:
        """Linearise at a state; return the sums of cameras, and what is largest.

        With lam > 0 the sums go on with those of `eliminate`, made in the same pass; where that is
        singular, with nothing.
        """
        state, singular = self.states[token], False
        more: Terms = ()
        if lam > 0.0:
            try:
                more, _ = self.eliminate(token, lam, direct)
            except np.linalg.LinAlgError:
                singular = True
        normal = self._normal(token)
        own = {"largest": 0.0, "steepest": 0.0, "singular": singular}
        if len(normal.V):
            traces = np.einsum("mii->m", normal.V) / normal.V.shape[1]
            own["largest"] = float(traces.max())
            own["steepest"] = float(np.abs(normal.g_points).max())
        self.states = {token: state}
        sums = self.evaluation.sums(normal)
        if singular:
            more = tuple(Rows(rows.index[:0], rows.values[:0]) for rows in sums[:2])
        return (*sums, *more), own

    def points_of_state(self, token: int) -> tuple[Terms, Array]:
        """Return the points of a state."""
        return (), self.states[token].points

    def blocks_of_state(self, token: int) -> tuple[Terms, Arrays]:
        """Return the blocks of points at a state."""
        return (), self.evaluation.blocks(self._normal(token))

    def eliminate(self, token: int, lam: float, direct: bool) -> tuple[Terms, None]:
        """Return what eliminating damped points leaves: blocks of pairs or of views, and W T h."""
        own = self.evaluation
        made = self._damped(token, lam, direct)
        if made.pairs is not None and made.right is not None:
            return own.eliminated(made.pairs, made.right), None
        coupling = made.normal.coupling
        if direct:
            return own.eliminated(*coupling.schur(made.T, made.half)), None
        right = coupling.to_cameras(made.T, made.half)
        return (own.rows(coupling.diagonal(made.T)), own.rows(right)), None

    def product(self, token: int, lam: float, x: Array) -> tuple[Terms, None]:
        """Return W T T^T W^T x."""
        made, local = self._damped(token, lam), np.ascontiguousarray(x[self.evaluation.views])
        coupling, T = made.normal.coupling, made.T
        moved = coupling.to_cameras(T, coupling.to_points(T, local))
        return (self.evaluation.rows(moved),), None

    def advance(
        self,
        token: int,
        lam: float,
        own: Array,
        cameras: Array,
        how: PointRefinement | None,
        reached: int,
    ) -> tuple[Terms, None]:
        """Move the points with cameras that take a step, into a state of their own.

        Returns
        -------
        tuple
            Sums: cost, doubled; g . y, y . D y and y . y for the step y of the points.
        """
        state, made = self.states[token], self._damped(token, lam)
        y, energy = made.point_steps(np.ascontiguousarray(own[self.evaluation.views]))
        points, local = state.points + y, cameras[self.evaluation.views]
        if self.model.homogeneous:
            points = in_range(points)
        with np.errstate(invalid="ignore", over="ignore"):
            if how is None:
                costs = self.evaluation.linearizer.point_costs(local, points)
            else:
                refined, costs = self.evaluation.linearizer.refine_points(local, points, how)
                if self._kept is not None:
                    refined = np.where(self._kept[:, None], points, refined)
                    costs = self.evaluation.linearizer.point_costs(local, refined)
                points = refined
            sums = float(costs.sum()), float(np.vdot(made.normal.g_points, y)), energy
        self.states = {token: state, reached: _State(cameras, points)}
        return (*sums, float(np.vdot(y, y))), None

    def _normal(self, token: int) -> Normal:
        state = self.states[token]
        if state.normal is None:
            own = self.evaluation
            state.normal = own.linearizer.linearize(state.cameras[own.views], state.points)
        return state.normal

    def _damped(self, token: int, lam: float, pairs: bool = False) -> Elimination:
        """Return the points' damped inverse roots; with new pairs of cameras, where asked for."""
        state, own = self.states[token], self.evaluation.linearizer
        if state.damped is not None and state.damped[0] == lam and not pairs:
            return state.damped[1]
        free = self._kept is None or not self._kept.any()
        if isinstance(own, NativeLinearizer) and free and fits(own):
            # Whatever was made before: the same bits where a partition is rebuilt.
            local = state.cameras[self.evaluation.views]
            made = eliminate(own, local, state.points, lam, pairs)
            state.normal = made.normal
        else:
            made = self._rooted(self._normal(token), lam)
        state.damped = lam, made._replace(pairs=None, right=None)
        if made.singular:
            state.damped = None
            raise np.linalg.LinAlgError("the block of a point is not positive definite")
        return made

    def _rooted(self, normal: Normal, lam: float) -> Elimination:
        """Return the inverse roots of any camera model; those of fixed points are zero."""
        V, g = normal.V, normal.g_points
        depth = None if normal.depth_blocks is None else normal.depth_blocks[1]
        C = self._free(V)
        V, depth = congruent(C, V), None if depth is None else congruent(C, depth)
        D = point_damping(self.model, V, depth)
        if not (self.model.metric or self.model.homogeneous):
            D = lifted(D)
        g = g if C is None else (C @ g[..., None])[..., 0]
        T, half = self.evaluation.linearizer.inverse_roots(V, D, lam, g)
        if C is not None:
            T = np.ascontiguousarray(C @ T)
        return Elimination(normal, T, half, D=D)

    def _free(self, V: Array) -> Array | None:
        if self._kept is None or not self._kept.any():
            return None
        return np.where(self._kept[:, None, None], 0.0, np.eye(V.shape[1]))


@dataclass
class _State:
    """Cameras and points somewhere, and what was computed there."""

    cameras: Array
    points: Array
    normal: Normal | None = None
    damped: tuple[float, Elimination] | None = None
