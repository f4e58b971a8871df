"""Selected blocks of the inverse of the reduced system, within its skyline, in C."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import function
from epigauge.bundle.skyline import Skyline, SkylineInverse

if TYPE_CHECKING:
    from epigauge.bundle.native_linearizer import NativeLinearizer

__all__ = ["NativeBlocks", "NativeInverse"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NativeInverse:
    """The selected blocks of an inverse, in panels of unknowns in the order of the skyline.

    Attributes
    ----------
    linearizer : NativeLinearizer
        The observations.
    skyline : Skyline
        Which pairs of views have blocks.
    inner : SkylineInverse
        The blocks.
    """

    linearizer: NativeLinearizer
    skyline: Skyline
    inner: SkylineInverse

    @property
    def diagonals(self) -> tuple[Array, Array]:
        """Return those of S and S^-1, (n, a)."""
        outward, n = self.linearizer.layout.outward, self.skyline.n
        S, Z = self.inner.diagonals
        return outward(S.reshape(n, -1)), outward(Z.reshape(n, -1))

    def spread(self, A: Array | None, K: Array) -> NativeBlocks:
        """Return the blocks of A S^-1 A^T + K K^T for A (n, d, a) and K (n, d, k)."""
        own, how = self.linearizer, self.linearizer.pair_sums
        a = self.inner.unknowns // self.skyline.n
        inner_A, inner_K = own.narrow(A), own.narrow(K)
        assert inner_K is not None
        X = np.empty((self.skyline.blocks, how.size))
        function("skyline_spread")(
            self.skyline.reference,
            self.inner.panels.reference,
            ctypes.byref(how),
            a,
            address(inner_A),
            K.shape[2],
            *map(address, (inner_K, self.inner.Z, X)),
        )
        return NativeBlocks(own, self.skyline, X)


@dataclass(frozen=True)
class NativeBlocks:
    """Blocks of the cameras' part of an inverse.

    Attributes
    ----------
    linearizer : NativeLinearizer
        The observations.
    skyline : Skyline
        Which pairs of views have blocks.
    X : ndarray, shape (l, w)
        As the C library stores them.
    """

    linearizer: NativeLinearizer
    skyline: Skyline
    X: Array

    @cached_property
    def diagonal(self) -> Array:
        """Return the blocks of the views themselves, (n, d, d)."""
        return self.linearizer.wide(self._blocks(self.X[self.skyline.slot[1:] - 1]))

    def block(self, i: int, k: int) -> Array | None:
        """Return the block of two views, (d, d); None where it was not computed."""
        number = self.linearizer.layout.number
        s, t = int(number[i]), int(number[k])
        row, column = max(s, t), min(s, t)
        first = int(self.skyline.first[row])
        if column < first:
            return None
        found = self._blocks(self.X[self.skyline.slot[row] + column - first][None])
        # Rows are those of the view with the lower number.
        whole = np.asarray(self.linearizer.spread_out(found)[0])
        return whole if s <= t else whole.T

    def _blocks(self, X: Array) -> Array:
        how = self.linearizer.pair_sums
        return X.reshape(len(X), how.d, how.length)[:, :, : how.d]
