"""What a worker holds of a problem: some points, their observations, and their part of a step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.bundle.dampings import lifted
from epigauge.bundle.linearizer import Linearizer, Normal, PointRefinement, point_damping
from epigauge.bundle.native_linearizer import NativeCoupling, NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import in_range
from epigauge.bundle.skyline import Skyline
from epigauge.bundle.ties import congruent
from epigauge.cameras import camera_model
from epigauge.distributed.sums import Rows, Terms
from epigauge.two_view.losses import Loss

__all__ = ["Observations", "Order", "Partition", "Setup"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Arrays = dict[str, Any]


@dataclass(frozen=True)
class Observations:
    """Observations of the points of a partition, sorted by point.

    Attributes
    ----------
    view, point : ndarray of int, shape (N,)
        Numbers of the views; of the points within the partition, each used.
    q : ndarray, shape (2, N)
        Measurements, in the unit that is computed in.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    whitening : ndarray, shape (2, 2, N), or None
        What residuals are multiplied by.
    """

    view: Indices
    point: Indices
    q: Array
    weights: Array
    whitening: Array | None = None

    def __len__(self) -> int:
        return len(self.view)

    def survey(self, question: str, argument: Any) -> tuple[Terms, Any]:
        """Return what another method says."""
        return (), getattr(self, question)(argument)

    def lowest(self, number: Indices) -> Rows:
        """Return the lowest view, of numbers (n,), that shares a point with each that is there."""
        views, graph = self.graph(number)
        return Rows(views, views[graph.lowest].astype(np.float64))

    def together(self, n: int) -> NDArray[np.uint8]:
        """Return which pairs of views share a point, (n, n) as bits row by row."""
        _, graph = self.graph(np.arange(n))
        found, counts = np.zeros((n, n), np.bool_), np.diff(graph.first)
        left = counts[graph.point] - (np.arange(len(graph.point)) - graph.first[graph.point]) - 1
        views = self.view[self.rows(np.arange(n))]
        for apart in range(1, int(counts.max(initial=1))):
            rows = np.flatnonzero(left >= apart)
            found[views[rows], views[rows + apart]] = True
        return np.packbits(found | found.T)

    def rows(self, number: Indices) -> Indices:
        """Return the observations sorted by point, then by the number of the view."""
        return np.lexsort((number[self.view], self.point))

    def graph(self, number: Indices) -> tuple[Indices, ObservationGraph]:
        """Return the numbers of the views that are there, rising, and the graph of these."""
        rows = self.rows(number)
        views, own = np.unique(number[self.view[rows]], return_inverse=True)
        point = self.point[rows]
        return views, ObservationGraph(own.astype(np.intp), point, len(views), int(point[-1]) + 1)


@dataclass(frozen=True)
class Order:
    """The order of the cameras in the reduced system, and where its blocks are.

    Attributes
    ----------
    number : ndarray of int, shape (n,)
        Number of each camera in that order.
    skyline : Skyline
        Of the blocks of all partitions together.
    """

    number: Indices
    skyline: Skyline


@dataclass(frozen=True)
class Setup:
    """What is the same for all partitions.

    Attributes
    ----------
    model, backend : str
        Names of the camera and of the back end.
    loss : Loss
        Applied to each squared residual.
    used : ndarray of int, or None
        Entries of a camera's tangent that are computed with; None for all.
    heaviest : float
        Largest weight of all observations.
    order : Order
        Of the cameras.
    """

    model: str
    backend: str
    loss: Loss
    used: Indices | None
    heaviest: float
    order: Order


class Partition:
    """A part of the problem, built once, and the states of its points.

    Cameras are passed whole, (n, c), in the caller's order; sums over the partition come back as
    `Rows` in the order of the reduced system, the partition's points as arrays of their own.

    Parameters
    ----------
    setup : Setup
        What all partitions have in common.
    observations : Observations
        Its own.
    kept : ndarray of bool, shape (m,), or None
        Points that are fixed.
    """

    def __init__(
        self, setup: Setup, observations: Observations, kept: NDArray[np.bool_] | None = None
    ) -> None:
        self.setup, self._kept = setup, kept
        self.model = camera_model(setup.model)
        number = setup.order.number
        #: Numbers of the views in the order of the reduced system, and the caller's.
        self.numbers, graph = observations.graph(number)
        self.views = np.argsort(number, kind="stable")[self.numbers]
        self._order = observations.rows(number)
        self.states: dict[int, _State] = {}
        self._linearizer = self._made(observations, graph)

    def _made(self, own: Observations, graph: ObservationGraph) -> Linearizer:
        setup, rows = self.setup, self._order
        table, q = kernels.table(setup.backend), np.ascontiguousarray(own.q[:, rows])
        weights, heaviest = own.weights[rows], setup.heaviest
        if not (table.compiled and own.whitening is None):
            whitening = None if own.whitening is None else own.whitening[..., rows]
            parts = self.model, table, graph, q, weights, setup.loss, whitening, heaviest
            return NumpyLinearizer(*parts)
        made = NativeLinearizer(
            *(self.model, graph, q, weights, setup.loss), columns=setup.used, heaviest=heaviest
        )
        made.layout.settle(Skyline.of(graph.lowest))
        return made

    @cached_property
    def _slots(self) -> tuple[Indices, tuple[Indices, Indices]]:
        """Blocks of the whole skyline, and rows and columns, of the partition's own blocks."""
        own, whole = self._linearizer, self.setup.order.skyline
        local = own.skyline if isinstance(own, NativeLinearizer) else Skyline.full(len(self.views))
        rows, columns = local.places
        wide, narrow = self.numbers[rows], self.numbers[columns]
        there = narrow >= whole.first[wide]
        assert there.all() or not isinstance(own, NativeLinearizer)
        rows, columns, wide, narrow = (part[there] for part in (rows, columns, wide, narrow))
        return whole.slot[wide + 1] - 1 - (wide - narrow), (rows, columns)

    def _rows(self, own: Array) -> Rows:
        return Rows(self.numbers, own)

    # ---------------------------------------------------------------- the protocol, part by part

    def residuals(self, cameras: Array, points: Array) -> tuple[Terms, Array]:
        """Return the partition's own residuals, (N, 2), in the order of `Observations`."""
        found = np.empty((len(self._order), 2))
        found[self._order] = self._linearizer.residuals(cameras[self.views], points).T
        return (), found

    def point_costs(self, cameras: Array, points: Array) -> tuple[Terms, Array]:
        """Return the costs of the points."""
        return (), self._linearizer.point_costs(cameras[self.views], points)

    def distances(self, cameras: Array, points: Array) -> tuple[Terms, Array]:
        """Return the distances of the observations, in any order."""
        return (), self._linearizer.distances(cameras[self.views], points)

    def intersect(self, cameras: Array) -> tuple[Terms, Array]:
        """Return where the lines of sight meet."""
        return (), self._linearizer.intersect(cameras[self.views])

    def refine_points(
        self, cameras: Array, how: PointRefinement, points: Array
    ) -> tuple[Terms, tuple[Array, Array]]:
        """Return refined points and their costs."""
        return (), self._linearizer.refine_points(cameras[self.views], points, how)

    def linearize(self, cameras: Array, points: Array) -> tuple[Terms, Arrays]:
        """Return the sums of cameras, and the blocks of points."""
        normal = self._linearizer.linearize(cameras[self.views], points)
        return self._sums(normal), self._blocks(normal)

    def to_points(
        self, cameras: Array, x: Array, points: Array, T: Array | None
    ) -> tuple[Terms, Array]:
        """Return T^T W^T x for the points."""
        coupling = self._coupling(cameras, points)
        return (), coupling.to_points(T, np.ascontiguousarray(x[self.views]))

    def to_cameras(
        self, cameras: Array, points: Array, T: Array | None, y: Array
    ) -> tuple[Terms, None]:
        """Return W T y."""
        return (self._rows(self._coupling(cameras, points).to_cameras(T, y)),), None

    def schur(
        self, cameras: Array, points: Array, T: Array, half: Array | None
    ) -> tuple[Terms, None]:
        """Return the blocks of W T T^T W^T, and W T half."""
        return self._eliminated(self._coupling(cameras, points), T, half), None

    def diagonal(self, cameras: Array, points: Array, T: Array) -> tuple[Terms, None]:
        """Return the diagonal blocks of W T T^T W^T."""
        return (self._rows(self._coupling(cameras, points).diagonal(T)),), None

    def _coupling(self, cameras: Array, points: Array) -> Any:
        own = self._linearizer
        if isinstance(own, NativeLinearizer):  # which needs no blocks for it
            return NativeCoupling(own, cameras[self.views], np.ascontiguousarray(points))
        return own.linearize(cameras[self.views], points).coupling

    def _eliminated(self, coupling: Any, T: Array, half: Array | None) -> Terms:
        pairs, right = coupling.schur(T, half)
        slots, (rows, columns) = self._slots
        if isinstance(self._linearizer, NativeLinearizer):
            blocks = pairs.blocks
        else:
            blocks = pairs.dense().transpose(0, 2, 1, 3)[columns, rows]
        return Rows(slots, blocks), self._rows(right)

    def _sums(self, normal: Normal) -> Terms:
        sums = self._rows(normal.U), self._rows(normal.g_cameras)
        if normal.depth_blocks is None:
            return sums
        return *sums, self._rows(normal.depth_blocks[0])

    def _blocks(self, normal: Normal) -> Arrays:
        depth = None if normal.depth_blocks is None else normal.depth_blocks[1]
        return {"V": normal.V, "g": normal.g_points, "depth": depth}

    # ---------------------------------------------------------------- points that stay here

    def load(self, token: int, cameras: Array, points: Array) -> None:
        """Take the points of a state from outside."""
        self.states[token] = _State(cameras, points)

    def linearize_state(self, token: int) -> tuple[Terms, Arrays]:
        """Linearise at a state; return the sums of cameras, what is largest, and the points."""
        state, normal = self.states[token], self._normal(token)
        own = {"points": state.points, "largest": 0.0, "steepest": 0.0}
        if len(normal.V):
            traces = np.einsum("mii->m", normal.V) / normal.V.shape[1]
            own["largest"] = float(traces.max())
            own["steepest"] = float(np.abs(normal.g_points).max())
        self.states = {token: state}
        return self._sums(normal), own

    def blocks_of_state(self, token: int) -> tuple[Terms, Arrays]:
        """Return the blocks of points at a state."""
        return (), self._blocks(self._normal(token))

    def eliminate(self, token: int, lam: float, direct: bool) -> tuple[Terms, None]:
        """Return what eliminating damped points leaves: blocks of pairs or of views, and W T h."""
        coupling, (T, half, _) = self._normal(token).coupling, self._roots(token, lam)
        if direct:
            return self._eliminated(coupling, T, half), None
        right = coupling.to_cameras(T, half)
        return (self._rows(coupling.diagonal(T)), self._rows(right)), None

    def product(self, token: int, lam: float, x: Array) -> tuple[Terms, None]:
        """Return W T T^T W^T x."""
        coupling, (T, _, _) = self._normal(token).coupling, self._roots(token, lam)
        own = np.ascontiguousarray(x[self.views])
        return (self._rows(coupling.to_cameras(T, coupling.to_points(T, own))),), None

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
        state, normal = self.states[token], self._normal(token)
        T, half, D = self._roots(token, lam)
        step = np.ascontiguousarray(own[self.views])
        y = -np.einsum("mij,mj->mi", T, half + normal.coupling.to_points(T, step))
        points, local = state.points + y, cameras[self.views]
        if self.model.homogeneous:
            points = in_range(points)
        with np.errstate(invalid="ignore", over="ignore"):
            if how is None:
                costs = self._linearizer.point_costs(local, points)
            else:
                refined, costs = self._linearizer.refine_points(local, points, how)
                if self._kept is not None:
                    refined = np.where(self._kept[:, None], points, refined)
                    costs = self._linearizer.point_costs(local, refined)
                points = refined
            energy = float(np.einsum("mi,mij,mj->", y, D, y))
            sums = float(costs.sum()), float(np.vdot(normal.g_points, y)), energy
        self.states = {token: state, reached: _State(cameras, points)}
        return (*sums, float(np.vdot(y, y))), None

    def _normal(self, token: int) -> Normal:
        state = self.states[token]
        if state.normal is None:
            state.normal = self._linearizer.linearize(state.cameras[self.views], state.points)
        return state.normal

    def _roots(self, token: int, lam: float) -> tuple[Array, Array, Array]:
        """Return T, T^T g and the damping D of the points; T of fixed ones is zero."""
        state, normal = self.states[token], self._normal(token)
        if state.damped is None or state.damped[0] != lam:
            V, g = normal.V, normal.g_points
            depth = None if normal.depth_blocks is None else normal.depth_blocks[1]
            C = self._free(V)
            V, depth = congruent(C, V), None if depth is None else congruent(C, depth)
            D = point_damping(self.model, V, depth)
            if not (self.model.metric or self.model.homogeneous):
                D = lifted(D)
            g = g if C is None else (C @ g[..., None])[..., 0]
            T, half = self._linearizer.inverse_roots(V, D, lam, g)
            if C is not None:
                T = np.ascontiguousarray(C @ T)
            state.damped = lam, T, half, D
        return state.damped[1:]

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
    damped: tuple[float, Array, Array, Array] | None = None
