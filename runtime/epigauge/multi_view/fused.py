"""The many-view problem in C: one pass over the observations of each point, nothing stored.

With a = d q_hat / d h and h = P Q, the coupling of an observation is (a^T a P) x Q and the Schur
update of a pair of cameras (3x3) x (Q Q^T): the C library (runtime/c/bundle*.c) accumulates these
factors. Same interface as the NumPy reference in `engine`.
"""

from __future__ import annotations

import copy
import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import CAMERA, Refinement, aligned_zeros, checked, function
from epigauge.multi_view.coupling import most_blocks
from epigauge.multi_view.engine import Normal, Triangulation
from epigauge.multi_view.envelope import Envelope
from epigauge.multi_view.fused_coupling import FusedCoupling
from epigauge.multi_view.layout import Layout
from epigauge.multi_view.packing import Packed, Range
from epigauge.two_view.losses import Loss

__all__ = ["Fused"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A reduced system is factored where that takes at most so many products of blocks, or so many an
#: observation: about what a hundred conjugate gradients cost.
_QUICK, _PATIENCE = 1e6, 20.0


class Fused:
    """The evaluation in C.

    Parameters
    ----------
    layout : Layout
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Conditioned measurements.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    loss : Loss
        Applied to each squared residual.
    workers : int
        Threads; each has a share of the points and sums of its own, added up in a fixed order.
    """

    def __init__(
        self, layout: Layout, q: Array, weights: Array, loss: Loss, workers: int = 1
    ) -> None:
        self.layout, self.q, self.weights, self.loss = layout, q, weights, loss
        self._packed = Packed(layout, q, weights)
        self._bundle = self._packed.bundle(loss)
        self.reference = ctypes.byref(self._bundle)
        self._passes, self._pairs = self._packed.shares(workers)
        # The calling thread has the first share.
        others = max(len(self._passes), len(self._pairs)) - 1
        self._pool = ThreadPoolExecutor(others) if others else None

    @property
    def envelope(self) -> Envelope:
        """Return the envelope of the reduced system."""
        return self._packed.narrowed()

    @cached_property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored."""
        work, few = self.envelope.work, self.envelope.blocks <= most_blocks()
        return few and work <= max(_QUICK, _PATIENCE * len(self.layout.point))

    @property
    def order(self) -> Indices | None:
        """Return the numbers of the cameras as they are ordered; None where they are not."""
        return self._packed.order

    @property
    def alone(self) -> bool:
        """Tell whether one thread does all."""
        return self._pool is None

    def with_loss(self, loss: Loss) -> Fused:
        """Return the same observations with another loss."""
        other = copy.copy(self)
        other.loss, other._bundle = loss, self._packed.bundle(loss)
        other.reference = ctypes.byref(other._bundle)
        return other

    def inward(self, cameras: Array) -> Array:
        """Return rows of cameras in the order of the envelope, contiguous."""
        return np.ascontiguousarray(cameras if self.order is None else cameras[self.order])

    def outward(self, cameras: Array) -> Array:
        """Return rows of cameras from the order of the envelope in their own."""
        if self.order is None:
            return cameras
        result = np.empty_like(cameras)
        result[self.order] = cameras
        return result

    def each(self, name: str, *arguments: Any) -> None:
        """Call a C function for all chunks, which write to places of their own."""
        call = function(name)
        self._share(
            self._passes, lambda _, begin, end: call(self.reference, begin, end, *arguments)
        )

    def summed(
        self, name: str, before: tuple[Any, ...], *shapes: tuple[int, ...], pairs: bool = False
    ) -> list[Array]:
        """Call a C function for all chunks, which add to its last arguments, arrays of `shapes`.

        `pairs` tells that it works on pairs of observations.
        """
        call, ranges = function(name), self._pairs if pairs else self._passes
        sums = [[aligned_zeros(shape) for shape in shapes] for _ in ranges]
        self._share(
            ranges,
            lambda k, begin, end: call(self.reference, begin, end, *before, *map(address, sums[k])),
        )
        for others in sums[1:]:
            for total, other in zip(sums[0], others, strict=True):
                total += other
        return sums[0]

    def over_points(self, call: Callable[[slice], Any]) -> list[Any]:
        """Call a function with as many ranges of points as there are workers."""
        count, m = len(self._passes), self.layout.n_points
        edges = [m * k // count for k in range(count + 1)]
        parts = [slice(begin, end) for begin, end in zip(edges[:-1], edges[1:], strict=True)]
        return self._together([partial(call, part) for part in parts])

    def _share(self, ranges: list[Range], call: Callable[[int, int, int], int]) -> None:
        for status in self._together([partial(call, k, *own) for k, own in enumerate(ranges)]):
            checked(status)

    def _together(self, calls: list[Callable[[], Any]]) -> list[Any]:
        """Make calls at the same time, the first one here."""
        if self._pool is None:
            return [call() for call in calls]
        pending = [self._pool.submit(call) for call in calls[1:]]
        try:
            return [calls[0](), *(future.result() for future in pending)]
        finally:  # C has addresses only: after Ctrl-C, too, the arrays stay until it is done
            wait(pending)

    def point_costs(self, P: Array, Q: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""
        costs, P, Q = np.empty(len(Q)), self.inward(P), np.ascontiguousarray(Q)
        self.each("bundle_costs", address(P), address(Q), address(costs))
        return costs

    def distances(self, P: Array, Q: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""
        found, P, Q = np.empty(len(self.layout.point)), self.inward(P), np.ascontiguousarray(Q)
        first = np.ascontiguousarray(self.layout.first)
        self.each("bundle_distances", *map(address, (P, Q, first, found)))
        return found

    def intersected(self, P: Array) -> Array:
        """Return the points of least algebraic error, unit vectors (m, 4): lines of sight meet."""
        Q, P = np.empty((self.layout.n_points, 4)), self.inward(P)
        self.each("bundle_intersect", address(P), address(Q))
        return Q

    def linearize(self, P: Array, Q: Array) -> Normal:
        """Return the normal equations."""
        self._packed.narrowed()  # the order of the cameras is settled from here on
        n, m = len(P), len(Q)
        P, Q = self.inward(P), np.ascontiguousarray(Q)
        V, D, g = np.empty((m, 4, 4)), np.empty((m, 4, 4)), np.empty((m, 4))
        before = tuple(map(address, (P, Q, V, D, g)))
        (sums,) = self.summed("bundle_linearize", before, (n, CAMERA))
        U, depths, g_cameras = np.empty((n, 12, 12)), np.empty((n, 12, 12)), np.empty((n, 12))
        blocks = map(address, (sums, U, depths, g_cameras))
        function("bundle_camera_blocks")(self.reference, *blocks)
        U, depths, g_cameras = map(self.outward, (U, depths, g_cameras))
        return Normal(U, V, FusedCoupling(self, P, Q), g_cameras, g, (depths, D))

    def depth_blocks(self, P: Array, Q: Array) -> tuple[Array, Array]:
        """Return the diagonal blocks of Z^T Z, Z = d log depth / d(P, Q) weighted as residuals."""
        blocks = self.linearize(P, Q).depth_blocks
        assert blocks is not None
        return blocks

    def triangulated(self, P: Array, Q: Array, how: Triangulation) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""
        costs, P, Q = np.empty(len(Q)), self.inward(P), np.array(Q, order="C")
        options = Refinement(how.iterations, 0, how.lam, how.factor, how.tolerance)
        arrays = map(address, (P, Q, costs, None))
        self.each("bundle_refine_points", *arrays, ctypes.addressof(options))
        return Q, costs
