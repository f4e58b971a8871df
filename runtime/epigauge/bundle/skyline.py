"""Where the blocks of the reduced system are stored, in which order, and their Cholesky factor."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import _native
from epigauge._library import address
from epigauge._native import PANEL, Blocks, checked, function

__all__ = ["Skyline", "SkylineFactor", "SkylineInverse", "narrow"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A new order is looked for with so many cameras, whose graph is a dense matrix, and where the work
#: for the old one is more than this share of that for a full matrix.
_FEW, _MANY, _NARROW = 50, 5000, 0.02


@dataclass(frozen=True, eq=False)
class Skyline:
    """Block row k of the lower triangle of a matrix holds the blocks from column `first[k]` to k.

    Attributes
    ----------
    first : ndarray of int32, shape (n,)
        First column of each row.
    slot : ndarray of int, shape (n + 1,)
        Number of blocks before each row.
    """

    first: NDArray[np.int32]
    slot: Indices

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arrays: addresses in memory mean nothing elsewhere."""
        return Skyline, (self.first, self.slot)

    @staticmethod
    def of(first: NDArray[Any]) -> Skyline:
        """Return the skyline with these first columns."""
        slot = np.concatenate([[0], np.cumsum(np.arange(len(first)) - first + 1)])
        return Skyline(first.astype(np.int32), slot.astype(np.intp))

    @staticmethod
    @lru_cache(maxsize=32)
    def full(n: int) -> Skyline:
        """Return the skyline of a dense lower triangle."""
        return Skyline.of(np.zeros(n, np.intp))

    @staticmethod
    def diagonal(n: int) -> Skyline:
        """Return the skyline of the diagonal."""
        return Skyline.of(np.arange(n))

    @property
    def n(self) -> int:
        """Return the number of block rows."""
        return len(self.first)

    @property
    def blocks(self) -> int:
        """Return the number of blocks."""
        return int(self.slot[-1])

    @cached_property
    def work(self) -> float:
        """Return the operations of a factorisation, in products of blocks."""
        return float(np.sum(np.diff(self.slot).astype(np.float64) ** 2)) / 2.0

    @property
    def wide(self) -> bool:
        """Tell whether a search for a narrower one may pay."""
        return _FEW <= self.n <= _MANY and self.work > _NARROW * Skyline.full(self.n).work

    @cached_property
    def places(self) -> tuple[Indices, Indices]:
        """Return row and column of every block."""
        widths = np.diff(self.slot)
        rows = np.repeat(np.arange(self.n), widths)
        return rows, np.arange(self.blocks) - np.repeat(self.slot[1:] - 1, widths) + rows

    @cached_property
    def reference(self) -> Any:
        """Return the C structure, by reference."""
        arrays = map(address, (self.first, self.slot))
        return ctypes.byref(_native.Envelope(self.n, *arrays))

    def diagonal_of(self, S: Array, size: int) -> Array:
        """Return the first entries of the diagonal of a matrix in panels."""
        at = np.arange(size)
        block = self.slot[1:][at // PANEL] - 1
        return np.asarray(S[block * PANEL**2 + (PANEL + 1) * (at % PANEL)])

    @lru_cache(maxsize=8)  # noqa: B019  # a skyline lives as long as its problem
    def panels(self, a: int) -> Skyline:
        """Return the skyline in rows of panels, for blocks of (a, a) entries."""
        count = -(-a * self.n // PANEL)
        rows = np.minimum(np.arange(count * PANEL) // a, self.n - 1)
        columns = (a * self.first[rows].astype(np.intp)) // PANEL
        first = columns.reshape(count, PANEL).min(axis=1)
        return Skyline.of(np.minimum(first, np.arange(count)))

    def factor(self, blocks: Array, how: Blocks, U: Array, A: Array | None) -> SkylineFactor:
        """Return a factor of U - A^T P A.

        Parameters
        ----------
        blocks : ndarray
            P: an entry a block; rows are own tangents of the column.
        how : Blocks
            How a block is stored.
        U : ndarray, shape (n, a, a)
            Blocks of the diagonal.
        A : ndarray, shape (n, d, a), or None
            Own tangents by unknowns.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is not positive definite.
        """
        a = U.shape[1]
        panels = self.panels(a)
        S = np.empty(panels.blocks * PANEL**2)
        function("skyline_reduce")(
            self.reference,
            panels.reference,
            ctypes.byref(how),
            a,
            *map(address, (blocks, U, A, S)),
        )
        diagonal = panels.diagonal_of(S, a * self.n)
        if function("envelope_factor")(panels.reference, address(S)):
            raise np.linalg.LinAlgError("the reduced system is not positive definite")
        return SkylineFactor(panels, S, a * self.n, diagonal)


@dataclass(frozen=True)
class SkylineFactor:
    """A Cholesky factor in panels, and the diagonal of the matrix."""

    panels: Skyline
    S: Array
    unknowns: int
    diagonal: Array

    def solve(self, right: Array) -> Array:
        """Return the solutions for right-hand sides (k, unknowns)."""
        x = np.zeros((len(right), PANEL * self.panels.n))
        x[:, : self.unknowns] = right
        function("envelope_solve")(self.panels.reference, address(self.S), len(x), address(x))
        return x[:, : self.unknowns]

    def inverse(self) -> SkylineInverse:
        """Return the blocks of the inverse within the skyline."""
        Z = self.S.copy()
        checked(function("envelope_invert")(self.panels.reference, address(Z)))
        found = self.panels.diagonal_of(Z, self.unknowns)
        return SkylineInverse(self.panels, Z, self.unknowns, (self.diagonal, found))


@dataclass(frozen=True)
class SkylineInverse:
    """The blocks of S^-1 within a skyline, in panels, and the diagonals of S and S^-1."""

    panels: Skyline
    Z: Array
    unknowns: int
    diagonals: tuple[Array, Array]


def narrow(together: NDArray[np.bool_]) -> tuple[Skyline, Indices | None]:
    """Choose the skyline for a graph of cameras, and an order of the cameras that narrows it.

    Parameters
    ----------
    together : ndarray of bool, shape (n, n)
        Which pairs of cameras share a point; symmetric.

    Returns
    -------
    skyline : Skyline
        In the order.
    order : ndarray of int, shape (n,), or None
        Old numbers of the cameras; None where they stay as they are.
    """
    best, order = _skyline(together), None
    if best.wide:
        renumbered = _reverse_cuthill_mckee(together)
        other = _skyline(together[np.ix_(renumbered, renumbered)])
        if other.work < 0.9 * best.work:
            best, order = other, renumbered
    return best, order


def _skyline(together: NDArray[np.bool_]) -> Skyline:
    n = len(together)
    first = np.argmax(together | np.eye(n, dtype=np.bool_), axis=1)
    return Skyline.of(np.minimum(first, np.arange(n)))


def _reverse_cuthill_mckee(together: NDArray[np.bool_]) -> Indices:
    """Return an order of the vertices of a graph in which neighbours are near each other.

    References
    ----------
    .. [1] A. George, J. W. H. Liu, "Computer solution of large sparse positive definite systems",
       1981, ch. 4: breadth first from a vertex far out, neighbours by rising degree, reversed.
    """
    degree = np.count_nonzero(together, axis=1)
    far = int(np.argmin(degree))
    for _ in range(3):
        order = _breadth_first(together, degree, far)
        far = int(order[-1])
    return order[::-1].copy()


def _breadth_first(together: NDArray[np.bool_], degree: Indices, start: int) -> Indices:
    left = np.ones(len(together), dtype=np.bool_)
    order: list[int] = []
    for begin in (start, *np.argsort(degree, kind="stable").tolist()):
        if not left[begin]:
            continue
        left[begin] = False
        order.append(begin)
        done = len(order) - 1
        while done < len(order):
            near = np.flatnonzero(together[order[done]] & left)
            left[near] = False
            order += near[np.argsort(degree[near], kind="stable")].tolist()
            done += 1
    return np.array(order)
