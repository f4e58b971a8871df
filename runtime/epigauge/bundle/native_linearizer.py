"""The evaluation in C: one pass over the observations of each point, no Jacobian stored.

Two routes share all loops (runtime/c/bundle*.c). Projective cameras have J_camera = a (x) Q^T, so
that their sums are a few factors times the moments Q Q^T of the points; any other model is computed
with by its kernels `observe`, `residual` and `sight`. Same interface as `numpy_linearizer`.
"""

from __future__ import annotations

import copy
import ctypes
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._library import address
from epigauge._native import (
    BLOCK,
    FACTORED,
    MOST_TANGENT,
    TRACE,
    Blocks,
    Refinement,
    function,
)
from epigauge.bundle.lanes import FULL, LaneLayout
from epigauge.bundle.linearizer import Normal, PointRefinement
from epigauge.bundle.native_coupling import NativeCoupling, NativePairs
from epigauge.bundle.native_inverse import NativeBlocks
from epigauge.bundle.numpy_linearizer import DENSE_CAMERAS
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.passes import Passes
from epigauge.bundle.skyline import Skyline
from epigauge.cameras import CameraModel
from epigauge.errors import ArgumentError
from epigauge.two_view.losses import Loss

__all__ = ["NativeLinearizer", "is_direct"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A reduced system is factored where that takes at most so many products of blocks, or so many an
#: observation: about what a hundred conjugate gradients cost.
_QUICK, _PATIENCE = 1e6, 20.0


class NativeLinearizer:
    """The evaluation by the C library.

    Parameters
    ----------
    model : CameraModel
        The camera.
    graph : ObservationGraph
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Measurements.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    loss : Loss
        Applied to each squared residual.
    workers : int
        Threads; each has a share of the points and sums of its own, added up in a fixed order.
    columns : sequence of int, optional
        Entries of a camera's tangent that are computed with; all others count as known: their rows
        in the normal equations are zero. By default all.
    factored : bool, optional
        Whether cameras of homogeneous points, whose tangent is their matrix, go by the factors of
        their Jacobian; by default they do.
    heaviest : float, optional
        Largest weight of all observations, where these are a part of them.
    beside : sequence of ObservationGraph
        Those of features of other kinds, which take off the same cameras' blocks.
    """

    def __init__(
        self,
        model: CameraModel,
        graph: ObservationGraph,
        q: Array,
        weights: Array,
        loss: Loss,
        workers: int = 1,
        columns: ArrayLike | None = None,
        factored: bool | None = None,
        heaviest: float | None = None,
        beside: Sequence[ObservationGraph] = (),
    ) -> None:
        self.model, self.graph, self.loss = model, graph, loss
        self.q, self.weights = q, weights
        by_factors = model.homogeneous if factored is None else factored
        row = FACTORED if by_factors else function("camera_model_row")(model.prefix.encode())
        whole = np.arange(model.tangent_size)
        used = whole if columns is None or by_factors else np.unique(np.asarray(columns, np.intp))
        if len(used) > MOST_TANGENT:
            raise ArgumentError(
                "backend",
                f"is 'c', which takes at most {MOST_TANGENT} unknowns a camera; {model.name} has "
                f"{len(used)}",
                "'numpy', which takes any",
            )
        #: None where all entries are computed with.
        self._used: Indices | None = None if len(used) == len(whole) else used
        entries = used.astype(np.int32)
        self.layout = LaneLayout(graph, q, weights, row, entries, heaviest, beside)
        self._heaviest, self._beside = heaviest, beside
        self._bundle = self.layout.bundle(loss)
        self.reference = ctypes.byref(self._bundle)
        camera_sums, self.pair_sums = ctypes.c_ssize_t(), Blocks()
        widths = map(ctypes.addressof, (camera_sums, self.pair_sums))
        function("bundle_widths")(self.reference, *widths)
        self.camera_sums = camera_sums.value
        self.passes = Passes(self.layout, workers)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it was made from: addresses and threads mean nothing elsewhere."""
        own = self.model, self.graph, self.q, self.weights, self.loss
        parts = self.passes.workers, self._used, self.factored, self._heaviest, self._beside
        return NativeLinearizer, (*own, *parts)

    def __copy__(self) -> NativeLinearizer:
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    @property
    def factored(self) -> bool:
        """Tell whether cameras go by their factors."""
        return bool(self._bundle.model == FACTORED)

    @property
    def skyline(self) -> Skyline:
        """Return the skyline of the reduced system, in blocks of cameras."""
        return self.layout.skyline

    @property
    def width(self) -> int:
        """Return the number of entries of a tangent that are computed with."""
        return int(self._bundle.width)

    @cached_property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored."""
        return is_direct(self.skyline, len(self.graph.point))

    def with_loss(self, loss: Loss) -> NativeLinearizer:
        """Return the same observations with another loss."""
        other = copy.copy(self)
        other.loss, other._bundle = loss, self.layout.bundle(loss)
        other.reference = ctypes.byref(other._bundle)
        return other

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return r = q - q_hat, (2, N)."""
        graph, residual = self.graph, self.model.kernel("residual", "c")
        seen_by = np.ascontiguousarray(cameras.T[:, graph.view])
        return np.asarray(residual(seen_by, np.ascontiguousarray(points.T[:, graph.point]), self.q))

    def point_costs(self, cameras: Array, points: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""
        costs, estimate = np.empty(len(points)), self._estimate(cameras, points)
        self.passes.each("bundle_costs", self.reference, *map(address, (*estimate, costs)))
        return costs

    def distances(self, cameras: Array, points: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""
        if not self.factored:
            with np.errstate(invalid="ignore", over="ignore"):
                return np.asarray(np.linalg.norm(self.residuals(cameras, points), axis=0))
        found, estimate = np.empty(len(self.graph.point)), self._estimate(cameras, points)
        first = np.ascontiguousarray(self.graph.first)
        self.passes.each(
            "bundle_distances", self.reference, *map(address, (*estimate, first, found))
        )
        return found

    def intersect(self, cameras: Array) -> Array:
        """Return homogeneous points of least algebraic error, unit vectors (m, 4)."""
        points, inner = np.empty((self.graph.n_points, 4)), self.layout.inward(cameras)
        self.passes.each("bundle_intersect", self.reference, address(inner), address(points))
        return points

    def linearize(self, cameras: Array, points: Array) -> Normal:
        """Return the normal equations."""
        skyline = self.skyline  # the order of the cameras is settled from here on
        estimate, (V, depths, g) = self._estimate(cameras, points), self.room(points)
        before = tuple(map(address, (*estimate, V, depths, g)))
        (sums,) = self.passes.summed(
            "bundle_linearize", self.reference, before, (skyline.n, self.camera_sums)
        )
        return self.gathered(estimate, sums, V, depths, g)

    def room(self, points: Array) -> tuple[Array, Array | None, Array]:
        """Return room for the blocks of points, their depths and gradients."""
        m, b = points.shape
        depths = np.empty((m, b, b)) if self.factored else None
        return np.empty((m, b, b)), depths, np.empty((m, b))

    def gathered(
        self,
        estimate: tuple[Array, Array],
        sums: Array,
        V: Array,
        depths: Array | None,
        g: Array,
    ) -> Normal:
        """Return normal equations from sums of cameras and the blocks of points."""
        n, d = self.skyline.n, self.width
        U, g_cameras = np.empty((n, d, d)), np.empty((n, d))
        of_cameras = np.empty((n, d, d)) if self.factored else None
        arrays = map(address, (sums, U, of_cameras, g_cameras))
        function("bundle_camera_blocks")(self.reference, *arrays)
        normal = self.normal(*estimate, U, V, g_cameras, g)
        if depths is None or of_cameras is None:
            return normal
        return replace(normal, depth_blocks=(self.layout.outward(of_cameras), depths))

    def normal(
        self, cameras: Array, points: Array, U: Array, V: Array, g_cameras: Array, g: Array
    ) -> Normal:
        """Return normal equations of cameras in the order of the skyline in their own."""
        coupling = NativeCoupling(self, cameras, points)
        return Normal(self.wide(U), V, self.wide(g_cameras), g, coupling)

    def refine_points(
        self, cameras: Array, points: Array, how: PointRefinement
    ) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""
        costs = np.empty(len(points))
        inner, moved = self.layout.inward(cameras), np.array(points, order="C")
        options = self.refinement(how)
        arrays = map(address, (inner, moved, costs, None))
        self.passes.each("bundle_refine_points", self.reference, *arrays, ctypes.addressof(options))
        return moved, costs

    def refinement(self, how: PointRefinement) -> Refinement:
        """Return the C structure of a refinement."""
        damping = TRACE if self.model.metric else BLOCK
        return Refinement(how.iterations, damping, how.lam, how.factor, how.tolerance)

    def inverse_roots(self, V: Array, D: Array, lam: float, g: Array) -> tuple[Array, Array]:
        """Return T with T T^T = (V + lam D)^-1 for blocks (m, b, b), and T^T g."""
        m, b, _ = V.shape
        if b not in (3, 4):
            T = np.swapaxes(np.linalg.inv(np.linalg.cholesky(V + lam * D)), 1, 2)
            return T, np.einsum("mij,mi->mj", T, g)
        V, D, g = map(np.ascontiguousarray, (V, D, g))
        T, half = np.empty((m, b, b)), np.empty((m, b))

        def roots(part: slice) -> bool:
            before, after = (V[part], D[part]), (g[part], T[part], half[part])
            count, arrays = part.stop - part.start, map(address, after)
            return bool(
                function("bundle_inverse_roots")(
                    count, b, *map(address, before), b * b, lam, *arrays
                )
            )

        if any(self.passes.over(self.graph.n_points, roots)):
            raise np.linalg.LinAlgError("the block of a point is not positive definite")
        return T, half

    # ---------------------------------------------------------------- orders and widths

    def wide(self, cameras: Array) -> Array:
        """Return vectors or blocks of the skyline's order and width in their own, zeros added."""
        return self.spread_out(self.layout.outward(cameras), cameras.ndim - 1)

    def spread_out(self, own: Array, axes: int = 2) -> Array:
        """Return arrays (n, ...) with zeros for entries that are known, on so many axes."""
        if self._used is None:
            return own
        d, rest = self.model.tangent_size, own.shape[1 + axes :]
        result = np.zeros((len(own), *[d] * axes, *rest))
        result[np.ix_(np.arange(len(own)), *[self._used] * axes)] = own
        return result

    def narrow(self, cameras: Array | None) -> Array | None:
        """Return (n, d, ...) in the order of the skyline, without the entries that are known."""
        if cameras is not None and self._used is not None:
            cameras = cameras[:, self._used]
        inner: Array | None = self.layout.inward(cameras)
        return inner

    def _estimate(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        return self.layout.inward(cameras), np.ascontiguousarray(points)

    # ---------------------------------------------------------------- passes

    def to_points(self, at: tuple[Array, Array], T: Array | None, x: Array) -> Array:
        """Return T^T W^T x, (m, b, ...), for x (n, d, ...)."""
        inner, T = self.narrow(x), _contiguous(T)
        points = np.empty((*at[1].shape, *x.shape[2:]))
        before = tuple(map(address, (*at, T)))
        after = tuple(map(address, (inner, None, points, None)))
        self.passes.each("bundle_couple", self.reference, *before, _columns(x), *after)
        return points

    def to_cameras(self, at: tuple[Array, Array], T: Array | None, y: Array) -> Array:
        """Return W T y, (n, d, ...), for y (m, b, ...)."""
        T, y = _contiguous(T), np.ascontiguousarray(y)  # C has addresses only: both are kept
        before = (*map(address, (*at, T)), _columns(y), *map(address, (None, y, None)))
        shape = len(at[0]), self.width, *y.shape[2:]
        found = self.passes.summed("bundle_couple", self.reference, before, shape)[0]
        return self.spread_out(self.layout.outward(found), 1)

    def marginals(
        self, at: tuple[Array, Array], T: Array, cameras: NativeBlocks, coupled: bool
    ) -> tuple[Array, Array]:
        """Return the points' blocks of an inverse, and those of each observation."""
        (m, b), T = at[1].shape, np.ascontiguousarray(T)
        found, graph = np.empty((m, b, b)), self.graph
        across = np.empty((len(graph.point) if coupled else 0, self.width, b))
        first = np.ascontiguousarray(graph.first)
        before = (*map(address, (*at, T, cameras.X)), cameras.skyline.reference)
        after = map(address, (found, first, across if coupled else None))
        self.passes.each("bundle_marginals", self.reference, *before, *after, pairs=True)
        return found, self.spread_out(across, 1)

    def schur(
        self, at: tuple[Array, Array], T: Array, half: Array | None, skyline: Skyline
    ) -> tuple[NativePairs, Array]:
        """Return the pairs of W T T^T W^T within a skyline, and W T half (n, d)."""
        T, half = np.ascontiguousarray(T), _contiguous(half)
        before = (*map(address, (*at, T, half)), skyline.reference)
        shapes = ((skyline.blocks, self.pair_sums.size), (len(at[0]), self.width))
        pairs, cameras = self.passes.summed(
            "bundle_schur", self.reference, before, *shapes, pairs=True
        )
        return NativePairs(self, skyline, pairs, self.pair_sums), self.wide(cameras)


def is_direct(skyline: Skyline, n_observations: int) -> bool:
    """Tell whether a reduced system is to be stored and factored."""
    if skyline.n <= FULL:
        return True
    few = skyline.blocks <= DENSE_CAMERAS * (DENSE_CAMERAS + 1) // 2
    return few and skyline.work <= max(_QUICK, _PATIENCE * n_observations)


def _columns(x: Array) -> int:
    """Return how many columns (n, d) or (n, d, k) are."""
    return x.shape[2] if x.ndim == 3 else 1


def _contiguous(array: Array | None) -> Array | None:
    return None if array is None else np.ascontiguousarray(array)
