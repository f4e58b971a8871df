"""The evaluation by many processes: each has some points, cameras are known to all."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Normal, Pairs, PointRefinement
from epigauge.bundle.native_linearizer import is_direct
from epigauge.bundle.numpy_linearizer import DENSE_CAMERAS, inverse_roots
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem
from epigauge.bundle.skyline import Skyline
from epigauge.cameras import CameraModel
from epigauge.distributed.dispatch import Dispatch, Run
from epigauge.distributed.observations import Order, Setup
from epigauge.distributed.pieces import Piece, order_of_cameras
from epigauge.distributed.reduced import Reduced
from epigauge.distributed.worker import Recipe
from epigauge.kernels import Table
from epigauge.two_view.losses import Loss

__all__ = ["DistributedCoupling", "DistributedLinearizer"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class DistributedLinearizer:
    """What `epigauge.bundle.linearizer.Linearizer` says, summed over partitions.

    Parameters
    ----------
    dispatch : Dispatch
        The workers.
    pieces : list of Piece
        The partitions.
    sizes : tuple of int
        Numbers of views, points and observations.
    model : CameraModel
        The camera.
    kernels : Table
        Back end of the workers.
    loss : Loss
        Applied to each squared residual.
    used : ndarray of int, or None
        Entries of a camera's tangent that are computed with.
    heaviest : float
        Largest weight.
    solver : {"auto", "factor", "cg"}
        Whether the reduced system is factored.
    graph : ObservationGraph, optional
        Where the client has it.
    order : Order, optional
        Of the cameras, where it is known.
    """

    def __init__(
        self,
        dispatch: Dispatch,
        pieces: list[Piece],
        sizes: tuple[int, int, int],
        model: CameraModel,
        kernels: Table,
        loss: Loss,
        used: Indices | None,
        heaviest: float,
        solver: str = "auto",
        graph: ObservationGraph | None = None,
        order: Order | None = None,
    ) -> None:
        self._parts = dispatch, pieces, sizes, model, kernels
        self._more = used, heaviest, solver, graph
        self.dispatch, self.pieces, self.sizes, self.model = dispatch, pieces, sizes, model
        self.loss, self.kernels, self._solver, self._graph = loss, kernels, solver, graph
        self._compiled = kernels.compiled and not any(piece.source.whitened for piece in pieces)
        if not self._compiled or model.homogeneous:
            used = None
        self._used = used
        self.recover: Callable[[int, Recipe], Recipe] = lambda _, recipe: recipe
        self.kept: NDArray[np.bool_] | None = None
        self.order = self._ordered() if order is None else order
        self._setup = Setup(model.name, kernels.name, loss, used, heaviest, self.order)
        # A cycle would keep the partitions at the workers until it is collected.
        own = weakref.ref(self)
        self.run = Run(dispatch, len(pieces), lambda k: _recipe(own, k))
        weakref.finalize(self, self.run.release)

    def recipe(self, number: int) -> Recipe:
        """Return what a partition is made from."""
        piece = self.pieces[number]
        kept = None if self.kept is None else self.kept[piece.points]
        return self.recover(number, Recipe(self._setup, piece.source, kept))

    def _ordered(self) -> Order:
        n = self.sizes[0]
        if not self._compiled:
            return Order(np.arange(n), Skyline.full(n))
        return order_of_cameras(self.dispatch, self.pieces, n)

    @property
    def graph(self) -> ObservationGraph:
        """Return which observation belongs to what, where the client knows."""
        assert self._graph is not None
        return self._graph

    @cached_property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored."""
        if self._solver != "auto":
            return self._solver == "factor"
        if not self._compiled:
            return self.sizes[0] <= DENSE_CAMERAS
        return is_direct(self.order.skyline, self.sizes[2])

    @cached_property
    def reduced(self) -> Reduced:
        """Return the order and widths of the reduced system."""
        width = self.model.tangent_size if self._used is None else len(self._used)
        return Reduced(self.model, self.order, self._used, width, self._compiled)

    def with_loss(self, loss: Loss) -> DistributedLinearizer:
        """Return the same observations with another loss."""
        return DistributedLinearizer(*self._parts, loss, *self._more, order=self.order)

    def resident(self, problem: BundleProblem) -> BundleProblem:
        """Return a problem whose points stay at the workers, where it knows all parts."""
        from epigauge.distributed.resident import ResidentProblem

        return ResidentProblem.of(problem)

    # ---------------------------------------------------------------- points

    def own(self, *arrays: Array | None) -> Callable[[int], tuple[Any, ...]]:
        """Return what gives a partition its part of arrays over points."""

        def part(number: int) -> tuple[Any, ...]:
            rows = self.pieces[number].points
            return tuple(None if array is None else array[rows] for array in arrays)

        return part

    def joined(self, parts: list[Array]) -> Array:
        """Return an array over points from the partitions' own."""
        result = np.empty((self.sizes[1], *parts[0].shape[1:]))
        for piece, part in zip(self.pieces, parts, strict=True):
            result[piece.points] = part
        return result

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return r = q - q_hat, (2, N)."""
        _, parts = self.run.each("residuals", (cameras,), self.own(points))
        found = np.empty((2, self.sizes[2]))
        for piece, part in zip(self.pieces, parts, strict=True):
            assert piece.rows is not None
            found[:, piece.rows] = part.T
        return found

    def point_costs(self, cameras: Array, points: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""
        return self.joined(self.run.each("point_costs", (cameras,), self.own(points))[1])

    def distances(self, cameras: Array, points: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""
        return np.concatenate(self.run.each("distances", (cameras,), self.own(points))[1])

    def intersect(self, cameras: Array) -> Array:
        """Return homogeneous points of least algebraic error, unit vectors (m, 4)."""
        return self.joined(self.run.each("intersect", (cameras,))[1])

    def refine_points(
        self, cameras: Array, points: Array, how: PointRefinement
    ) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""
        _, parts = self.run.each("refine_points", (cameras, how), self.own(points))
        moved, costs = zip(*parts, strict=True)
        return self.joined(list(moved)), self.joined(list(costs))

    def inverse_roots(self, V: Array, D: Array, lam: float, g: Array) -> tuple[Array, Array]:
        """Return T with T T^T = (V + lam D)^-1 for blocks (m, b, b), and T^T g."""
        return inverse_roots(V, D, lam, g)

    def linearize(self, cameras: Array, points: Array) -> Normal:
        """Return the normal equations."""
        sums, parts = self.run.each("linearize", (cameras,), self.own(points))
        return self.normal(sums, parts, cameras, points)

    def normal(
        self, sums: tuple[Any, ...], parts: list[dict[str, Any]], cameras: Array, points: Array
    ) -> Normal:
        """Return normal equations from the partitions' sums and blocks."""
        U, g, *depth = (self.reduced.outward(rows) for rows in sums)
        V, g_points = (self.joined([part[key] for part in parts]) for key in ("V", "g"))
        blocks = None
        if depth:
            blocks = depth[0], self.joined([part["depth"] for part in parts])
        return Normal(U, V, g, g_points, DistributedCoupling.of(self, cameras, points), blocks)


def _recipe(own: weakref.ref[DistributedLinearizer], number: int) -> Recipe:
    linearizer = own()
    assert linearizer is not None
    return linearizer.recipe(number)


@dataclass(frozen=True)
class DistributedCoupling:
    """The blocks W of J^T J that couple cameras and points, computed where the points are."""

    linearizer: DistributedLinearizer
    cameras: Array
    points: Array

    @staticmethod
    def of(linearizer: DistributedLinearizer, cameras: Array, points: Array) -> Any:
        """Return this as a `Coupling` of which nobody asks for parts of an inverse."""
        return DistributedCoupling(linearizer, cameras, points)

    @property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored, or only iterated with."""
        return self.linearizer.direct

    def to_points(self, T: Array | None, x: Array) -> Array:
        """Return T^T W^T x, (m, b, ...), for x (n, d, ...) and T (m, b, b), or one."""
        own = self.linearizer
        return own.joined(own.run.each("to_points", (self.cameras, x), own.own(self.points, T))[1])

    def to_cameras(self, T: Array | None, y: Array) -> Array:
        """Return W T y, (n, d, ...), for y (m, b, ...) and T (m, b, b), or one."""
        (rows,) = self._summed("to_cameras", T, y)
        return self.linearizer.reduced.outward(rows)

    def schur(self, T: Array, half: Array | None) -> tuple[Pairs, Array]:
        """Return P = W T T^T W^T, and W T half (n, d); half None is zero."""
        blocks, right = self._summed("schur", T, half)
        reduced = self.linearizer.reduced
        return reduced.pairs(blocks), reduced.outward(right)

    def diagonal(self, T: Array) -> Array:
        """Return the diagonal blocks of P, (n, d, d)."""
        (rows,) = self._summed("diagonal", T)
        return self.linearizer.reduced.outward(rows)

    def _summed(self, call: str, *arrays: Array | None) -> tuple[Any, ...]:
        own = self.linearizer
        return own.run.each(call, (self.cameras,), own.own(self.points, *arrays))[0]
