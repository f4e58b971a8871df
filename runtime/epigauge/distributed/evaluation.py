"""What a worker computes with the observations of a partition: the linearizer's protocol."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.bundle.linearizer import Linearizer, Normal, PointRefinement
from epigauge.bundle.native_coupling import NativeCoupling
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.skyline import Skyline
from epigauge.cameras import camera_model
from epigauge.distributed.observations import Observations, Setup
from epigauge.distributed.questions import NETWORK, OF_FIT
from epigauge.distributed.sums import Rows, Terms

__all__ = ["Evaluation"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Arrays = dict[str, Any]


class Evaluation:
    """The observations of a partition, laid out for a camera model.

    Cameras are passed whole, (n, c), in the caller's order; sums over the partition come back as
    `Rows` in the order of the reduced system, the partition's points as arrays of their own.

    Parameters
    ----------
    setup : Setup
        What all partitions have in common.
    observations : Observations
        Its own.
    """

    def __init__(self, setup: Setup, observations: Observations) -> None:
        self.setup, self.model = setup, camera_model(setup.model)
        number = setup.order.number
        #: Numbers of the views in the order of the reduced system, and the caller's.
        self.numbers, graph = observations.graph(number)
        self.views = np.argsort(number, kind="stable")[self.numbers]
        self._order = rows = observations.rows(number)
        white = observations.whitening
        #: The graph of these views and of the points; measurements, sorted by it.
        self.graph, self.q = graph, np.ascontiguousarray(observations.q[:, rows])
        self.weights = observations.weights[rows]
        self.whitening = None if white is None else np.ascontiguousarray(white[..., rows])
        self.linearizer = self._made()

    def _made(self) -> Linearizer:
        setup, table = self.setup, kernels.table(self.setup.backend)
        graph, q, weights, heaviest = self.graph, self.q, self.weights, setup.heaviest
        if not (table.compiled and self.whitening is None):
            parts = self.model, table, graph, q, weights, setup.loss, self.whitening, heaviest
            return NumpyLinearizer(*parts)
        made = NativeLinearizer(
            *(self.model, graph, q, weights, setup.loss), columns=setup.used, heaviest=heaviest
        )
        made.layout.settle(Skyline.of(self.graph.lowest))
        return made

    @cached_property
    def _slots(self) -> tuple[Indices, tuple[Indices, Indices]]:
        """Blocks of the whole skyline, and rows and columns, of the partition's own blocks."""
        own, whole = self.linearizer, self.setup.order.skyline
        local = own.skyline if isinstance(own, NativeLinearizer) else Skyline.full(len(self.views))
        rows, columns = local.places
        wide, narrow = self.numbers[rows], self.numbers[columns]
        there = narrow >= whole.first[wide]
        assert there.all() or not isinstance(own, NativeLinearizer)
        rows, columns, wide, narrow = (part[there] for part in (rows, columns, wide, narrow))
        return whole.slot[wide + 1] - 1 - (wide - narrow), (rows, columns)

    @property
    def count(self) -> int:
        """Return the number of observations."""
        return len(self._order)

    def rows(self, own: Array) -> Rows:
        """Return rows of the partition's views in the order of the reduced system."""
        return Rows(self.numbers, own)

    def asked(
        self, question: str, cameras: Array, arguments: tuple[Any, ...], points: Array
    ) -> tuple[Terms, Any]:
        """Return the answer to a question about how an estimate fits."""
        return (), OF_FIT[question](self, cameras, points, *arguments)

    def network(self, question: str, arguments: tuple[Any, ...]) -> tuple[Terms, Any]:
        """Return the answer to a question about what sees what."""
        return (), NETWORK[question](self, *arguments)

    def residuals(self, cameras: Array, points: Array) -> tuple[Terms, Array]:
        """Return the partition's own residuals, (N, 2), in the order of `Observations`."""
        found = np.empty((len(self._order), 2))
        found[self._order] = self.linearizer.residuals(cameras[self.views], points).T
        return (), found

    def point_costs(self, cameras: Array, points: Array) -> tuple[Terms, Array]:
        """Return the costs of the points."""
        return (), self.linearizer.point_costs(cameras[self.views], points)

    def distances(self, cameras: Array, points: Array) -> tuple[Terms, Array]:
        """Return the distances of the observations, in any order."""
        return (), self.linearizer.distances(cameras[self.views], points)

    def intersect(self, cameras: Array) -> tuple[Terms, Array]:
        """Return where the lines of sight meet."""
        return (), self.linearizer.intersect(cameras[self.views])

    def refine_points(
        self, cameras: Array, how: PointRefinement, points: Array
    ) -> tuple[Terms, tuple[Array, Array]]:
        """Return refined points and their costs."""
        return (), self.linearizer.refine_points(cameras[self.views], points, how)

    def linearize(self, cameras: Array, points: Array) -> tuple[Terms, Arrays]:
        """Return the sums of cameras, and the blocks of points."""
        normal = self.linearizer.linearize(cameras[self.views], points)
        return self.sums(normal), self.blocks(normal)

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
        return (self.rows(self._coupling(cameras, points).to_cameras(T, y)),), None

    def schur(
        self, cameras: Array, points: Array, T: Array, half: Array | None
    ) -> tuple[Terms, None]:
        """Return the blocks of W T T^T W^T, and W T half."""
        return self.eliminated(*self._coupling(cameras, points).schur(T, half)), None

    def diagonal(self, cameras: Array, points: Array, T: Array) -> tuple[Terms, None]:
        """Return the diagonal blocks of W T T^T W^T."""
        return (self.rows(self._coupling(cameras, points).diagonal(T)),), None

    def _coupling(self, cameras: Array, points: Array) -> Any:
        own = self.linearizer
        if isinstance(own, NativeLinearizer):  # which needs no blocks for it
            return NativeCoupling(own, cameras[self.views], np.ascontiguousarray(points))
        return own.linearize(cameras[self.views], points).coupling

    def eliminated(self, pairs: Any, right: Array) -> Terms:
        """Return the blocks of W T T^T W^T, and W T half, as sums."""
        slots, (rows, columns) = self._slots
        if isinstance(self.linearizer, NativeLinearizer):
            blocks = pairs.blocks
        else:
            blocks = pairs.dense().transpose(0, 2, 1, 3)[columns, rows]
        return Rows(slots, blocks), self.rows(right)

    def sums(self, normal: Normal) -> Terms:
        """Return what of normal equations is summed over partitions."""
        sums = self.rows(normal.U), self.rows(normal.g_cameras)
        if normal.depth_blocks is None:
            return sums
        return *sums, self.rows(normal.depth_blocks[0])

    def blocks(self, normal: Normal) -> Arrays:
        """Return what belongs to the points."""
        depth = None if normal.depth_blocks is None else normal.depth_blocks[1]
        return {"V": normal.V, "g": normal.g_points, "depth": depth}
