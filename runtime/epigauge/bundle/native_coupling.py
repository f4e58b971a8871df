"""What couples cameras and points in C, and what points take off the cameras: nothing is stored.

The blocks W of J^T J are computed whenever they are used, by the linearizer that made them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import Blocks, function
from epigauge.bundle.linearizer import CameraBlocks, Pairs
from epigauge.bundle.native_inverse import NativeBlocks, NativeInverse
from epigauge.bundle.skyline import Skyline, SkylineFactor

if TYPE_CHECKING:
    from epigauge.bundle.native_linearizer import NativeLinearizer

__all__ = ["NativeCoupling", "NativeFactor", "NativePairs"]

Array = NDArray[np.float64]

#: So many sets of views are offered as cliques.
_CLIQUES = 64


@dataclass(frozen=True)
class NativeCoupling:
    """The blocks W of J^T J that couple cameras and points, computed whenever they are used.

    Attributes
    ----------
    linearizer : NativeLinearizer
        The observations.
    cameras, points : ndarray, shape (n, c), (m, b)
        The estimate, cameras in the order of the skyline.
    """

    linearizer: NativeLinearizer
    cameras: Array
    points: Array

    @property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored, or only iterated with."""
        return self.linearizer.direct

    def to_points(self, T: Array | None, x: Array) -> Array:
        """Return T^T W^T x, (m, b), for x (n, d) and T (m, b, b), or one."""
        return self.linearizer.to_points(self._at, T, x)

    def to_cameras(self, T: Array | None, y: Array) -> Array:
        """Return W T y, (n, d), for y (m, b) and T (m, b, b), or one."""
        return self.linearizer.to_cameras(self._at, T, y)

    def schur(self, T: Array, half: Array | None) -> tuple[NativePairs, Array]:
        """Return P = W T T^T W^T, and W T half (n, d); half None is zero."""
        return self.linearizer.schur(self._at, T, half, self.linearizer.skyline)

    def diagonal(self, T: Array) -> Array:
        """Return the diagonal blocks of P, (n, d, d)."""
        alone = Skyline.diagonal(len(self.cameras))
        pairs, _ = self.linearizer.schur(self._at, T, None, alone)
        return self.linearizer.wide(pairs.blocks)

    def cliques(self) -> NDArray[np.bool_]:
        """Return some sets of views, (c, n), large ones: all blocks of a set are stored."""
        own, first = np.arange(len(self.cameras)), self.linearizer.skyline.first
        rows = np.unique(np.linspace(0, len(own) - 1, _CLIQUES).astype(np.intp))
        inner = [(first[k] <= own) & (own <= k) & (first <= first[k]) for k in rows]
        return np.array(inner)[:, self.linearizer.layout.number]

    def marginals(self, T: Array, cameras: CameraBlocks, coupled: bool) -> tuple[Array, Array]:
        """Return the points' blocks of an inverse, (m, b, b), and those of each observation."""
        assert isinstance(cameras, NativeBlocks)
        return self.linearizer.marginals(self._at, T, cameras, coupled)

    @property
    def _at(self) -> tuple[Array, Array]:
        return self.cameras, self.points


@dataclass(frozen=True)
class NativePairs:
    """P = W T T^T W^T, what the points take off the cameras' blocks.

    Attributes
    ----------
    linearizer : NativeLinearizer
        The observations.
    skyline : Skyline
        Which blocks there are.
    sums : ndarray, shape (l, w)
        What the C library has added up, or blocks.
    how : Blocks
        How blocks are stored; those of the factored route are not.
    """

    linearizer: NativeLinearizer
    skyline: Skyline
    sums: Array
    how: Blocks

    @cached_property
    def blocks(self) -> Array:
        """Return the blocks (l, k, k), rows for the column of the skyline's row."""
        own, d = self.linearizer, self.linearizer.width
        if self.how.size == d * d:
            return self.sums.reshape(len(self.sums), d, d)
        found = np.empty((len(self.sums), d, d))
        arrays = map(address, (self.sums, found))
        function("bundle_pair_blocks")(own.reference, len(found), *arrays)
        return found

    def factor(self, U: Array, A: Array | None) -> NativeFactor:
        """Return a factor of U - A^T P A, blocks U (n, a, a) and A (n, d, a)."""
        own, d = self.linearizer, self.linearizer.width
        if A is None and d < own.model.tangent_size:
            A = np.broadcast_to(np.eye(own.model.tangent_size), U.shape)
        inner_U, inner_A = own.layout.inward(U), own.narrow(A)
        blocks, how = (self.blocks, Blocks.dense(d)) if own.factored else (self.sums, self.how)
        return NativeFactor(own, self.skyline, self.skyline.factor(blocks, how, inner_U, inner_A))

    def without(self, F: Array) -> NativePairs:
        """Return P - F F^T, F (n, d, k); only blocks that P has are kept."""
        inner, (rows, columns) = self.linearizer.narrow(F), self.skyline.places
        assert inner is not None
        views = np.unique(np.nonzero(inner)[0])
        some = np.flatnonzero(np.isin(rows, views) & np.isin(columns, views))
        blocks = self.blocks.copy()
        blocks[some] -= inner[columns[some]] @ np.swapaxes(inner[rows[some]], 1, 2)
        return replace(self, sums=blocks, how=Blocks.dense(blocks.shape[1]))

    def plus(self, other: Pairs) -> NativePairs:
        """Return the sum with what features of another kind take off."""
        own, (rows, columns), P = self.linearizer, self.skyline.places, other.dense()
        order = own.layout.order
        if order is not None:
            rows, columns = order[rows], order[columns]
        more = P.transpose(0, 2, 1, 3)[columns, rows]
        if own._used is not None:
            more = more[:, own._used[:, None], own._used]
        blocks = self.blocks + more
        return replace(self, sums=blocks, how=Blocks.dense(blocks.shape[1]))

    def times(self, x: Array) -> Array:
        """Return P x for x (n, d, k)."""
        own = self.linearizer
        rows, columns = self.skyline.places
        inner = own.narrow(x)
        assert inner is not None
        result = np.zeros(inner.shape)
        across = rows != columns
        np.add.at(result, columns, self.blocks @ inner[rows])
        np.add.at(
            result, rows[across], np.swapaxes(self.blocks[across], 1, 2) @ inner[columns[across]]
        )
        columns_of = [own.wide(np.ascontiguousarray(result[..., k])) for k in range(x.shape[2])]
        return np.stack(columns_of, axis=2) if columns_of else np.zeros(x.shape)

    def dense(self) -> Array:
        """Return P, (n, d, n, d)."""
        own, n = self.linearizer, self.skyline.n
        d, order = own.model.tangent_size, own.layout.order
        rows, columns = self.skyline.places
        if order is not None:
            rows, columns = order[rows], order[columns]
        blocks = self.blocks
        if own._used is not None:
            blocks = np.zeros((len(blocks), d, d))
            blocks[:, own._used[:, None], own._used] = self.blocks
        P = np.zeros((n, n, d, d))
        P[rows, columns] = np.swapaxes(blocks, 1, 2)
        P[columns, rows] = blocks
        return P.transpose(0, 2, 1, 3)


@dataclass(frozen=True)
class NativeFactor:
    """A factor of the reduced system of the cameras, in the order of the skyline."""

    linearizer: NativeLinearizer
    skyline: Skyline
    inner: SkylineFactor

    def solve(self, right: Array) -> Array:
        """Return the solution for right-hand sides (n, a, k)."""
        layout, (n, a, k) = self.linearizer.layout, right.shape
        rows = layout.inward(right).reshape(n * a, k).T
        return layout.outward(self.inner.solve(rows).T.reshape(n, a, k))

    def inverse(self) -> NativeInverse:
        """Return the blocks of the inverse of all pairs of views, of the direct route."""
        return NativeInverse(self.linearizer, self.skyline, self.inner.inverse())
