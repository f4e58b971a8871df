"""The reduced system of the cameras, summed over partitions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._native import Blocks
from epigauge.bundle.dense import DensePairs
from epigauge.bundle.linearizer import Pairs
from epigauge.bundle.native_coupling import NativePairs
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.cameras import CameraModel
from epigauge.distributed.observations import Order
from epigauge.distributed.sums import Rows

__all__ = ["Reduced"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class Reduced:
    """The order of the cameras in the reduced system, as `NativePairs` asks for it.

    Parameters
    ----------
    model : CameraModel
        The camera.
    order : Order
        Of the cameras.
    used : ndarray of int, or None
        Entries of a tangent that are computed with.
    width : int
        How many.
    compiled : bool
        Whether blocks are those of a skyline that the C library factors.
    """

    #: Pairs come as blocks whatever the model.
    factored = True

    def __init__(
        self,
        model: CameraModel,
        order: Order,
        used: Indices | None,
        width: int,
        compiled: bool,
    ) -> None:
        self.model, self.width, self._used, self._compiled = model, width, used, compiled
        self.skyline, self.number = order.skyline, order.number
        self.order = np.argsort(order.number)

    @property
    def layout(self) -> _Rows:
        """Return what reorders rows of cameras."""
        return _Rows(self.number, self.order)

    spread_out = NativeLinearizer.spread_out
    narrow = NativeLinearizer.narrow
    wide = NativeLinearizer.wide

    def outward(self, rows: Rows) -> Array:
        """Return a sum over partitions in the caller's order, (n, ...)."""
        return rows.spread(len(self.number))[self.number]

    def pairs(self, blocks: Rows) -> Pairs:
        """Return the pairs of summed blocks."""
        values = np.ascontiguousarray(blocks.spread(self.skyline.blocks))
        own: Any = self
        pairs = NativePairs(own, self.skyline, values, Blocks.dense(self.width))
        return pairs if self._compiled else DensePairs(pairs.dense())


@dataclass(frozen=True)
class _Rows:
    number: Indices
    order: Indices

    def inward(self, cameras: Any) -> Any:
        """Return rows of cameras in the order of the reduced system, contiguous."""
        return None if cameras is None else np.ascontiguousarray(cameras[self.order])

    def outward(self, cameras: Array) -> Array:
        """Return rows of cameras in the caller's order."""
        return cameras[self.number]
