"""Where the blocks of the reduced system are stored, in which order, and their Cholesky factor."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import function

__all__ = ["Envelope", "narrow"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A new order is looked for with so many cameras, whose graph is a dense matrix, and where the work
#: for the old one is more than this share of that for a full matrix.
_FEW, _MANY, _NARROW = 50, 5000, 0.02


class _Structure(ctypes.Structure):
    """The eg_envelope of bundle.h."""

    _fields_ = (
        ("n", ctypes.c_ssize_t),
        ("first", ctypes.c_void_p),
        ("slot", ctypes.c_void_p),
    )


@dataclass(frozen=True, eq=False)
class Envelope:
    """Block row k of the lower triangle holds the blocks from column `first[k]` to k.

    Attributes
    ----------
    first : ndarray of int32, shape (n,)
        First column of each row.
    slot : ndarray of int, shape (n + 1,)
        Number of blocks before each row.
    """

    first: NDArray[np.int32]
    slot: Indices

    @staticmethod
    def of(first: NDArray[Any]) -> Envelope:
        """Return the envelope with these first columns."""
        slot = np.concatenate([[0], np.cumsum(np.arange(len(first)) - first + 1)])
        return Envelope(first.astype(np.int32), slot.astype(np.intp))

    @staticmethod
    @lru_cache(maxsize=32)
    def full(n: int) -> Envelope:
        """Return the envelope of a dense lower triangle."""
        return Envelope.of(np.zeros(n, np.intp))

    @staticmethod
    def diagonal(n: int) -> Envelope:
        """Return the envelope of the diagonal."""
        return Envelope.of(np.arange(n))

    @property
    def blocks(self) -> int:
        """Return the number of blocks."""
        return int(self.slot[-1])

    @property
    def work(self) -> float:
        """Return the operations of a factorisation, in products of blocks."""
        return float(np.sum(np.diff(self.slot).astype(np.float64) ** 2)) / 2.0

    @cached_property
    def reference(self) -> Any:
        """Return the C structure, by reference."""
        return ctypes.byref(_Structure(len(self.first), *map(address, (self.first, self.slot))))

    def reduced(self, pairs: Array, U: Array, A: Array | None) -> Array:
        """Return the blocks of U - A^T (sums of pairs) A, each transposed, (l, 12, 12).

        Parameters
        ----------
        pairs : ndarray, shape (l, 112)
            What the points take off the blocks, as the C library sums it up.
        U : ndarray, shape (n, 12, 12)
            Camera blocks.
        A : ndarray, shape (n, 12, 12), or None
            Change of parameters.
        """
        S = np.empty((self.blocks, 12, 12))
        function("bundle_reduce")(self.reference, *map(address, (pairs, U, A, S)))
        return S

    def whole(self, blocks: Array) -> Array:
        """Return the symmetric matrix of such blocks, (n, n, 12, 12)."""
        n = len(self.first)
        widths = np.diff(self.slot)
        rows = np.repeat(np.arange(n), widths)
        columns = np.arange(self.blocks) - np.repeat(self.slot[1:] - 1, widths) + rows
        S = np.zeros((n, n, 12, 12))
        S[columns, rows] = blocks
        S[rows, columns] = np.swapaxes(blocks, 1, 2)
        return S

    def solved(self, pairs: Array, U: Array, A: Array | None, right: Array) -> Array:
        """Return the solution of the reduced system for right-hand sides (n, 12, r)."""
        n, _, r = right.shape
        S, x = self.reduced(pairs, U, A), np.ascontiguousarray(right.reshape(12 * n, r).T)
        if function("envelope_factor")(self.reference, address(S)):
            raise np.linalg.LinAlgError("the reduced system is not positive definite")
        function("envelope_solve")(self.reference, address(S), r, address(x))
        return x.T.reshape(n, 12, r)

    @property
    def wide(self) -> bool:
        """Tell whether a search for a narrower one may pay."""
        n = len(self.first)
        return _FEW <= n <= _MANY and self.work > _NARROW * Envelope.full(n).work


def narrow(together: NDArray[np.bool_]) -> tuple[Envelope, Indices | None]:
    """Choose the envelope for a graph of cameras, and an order of the cameras that narrows it.

    Parameters
    ----------
    together : ndarray of bool, shape (n, n)
        Which pairs of cameras share a point; symmetric.

    Returns
    -------
    envelope : Envelope
        In the order.
    order : ndarray of int, shape (n,), or None
        Old numbers of the cameras; None where they stay as they are.
    """
    best, order = _envelope(together), None
    if best.wide:
        renumbered = _reverse_cuthill_mckee(together)
        other = _envelope(together[np.ix_(renumbered, renumbered)])
        if other.work < 0.9 * best.work:
            best, order = other, renumbered
    return best, order


def _envelope(together: NDArray[np.bool_]) -> Envelope:
    n = len(together)
    first = np.argmax(together | np.eye(n, dtype=np.bool_), axis=1)
    return Envelope.of(np.minimum(first, np.arange(n)))


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
