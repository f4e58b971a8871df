"""Linear systems of many points at once: symmetric blocks of three, entry by entry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Triangle", "solved_points"]

Array = NDArray[np.float64]


class Triangle(NamedTuple):
    """L D L^T of symmetric blocks (m, 3, 3): arrays (m,) of each entry.

    Where a block is singular to rounding the last pivot is rounding, zero or negative as well.
    """

    l10: Array
    l20: Array
    l21: Array
    d0: Array
    d1: Array
    d2: Array

    @staticmethod
    def of(blocks: Array, lift: float = 0.0) -> Triangle:
        """Factor blocks plus `lift` times their traces."""
        a, b, c, d, e, f = np.ascontiguousarray(
            blocks.reshape(-1, 9).T[[0, 1, 2, 4, 5, 8]], np.float64
        )
        if lift:
            more = lift * np.maximum(a + d + f, 1e-300)
            a, d, f = a + more, d + more, f + more
        with np.errstate(all="ignore"):
            l10, l20 = b / a, c / a
            d1, rest = d - l10 * b, e - l20 * b
            l21 = rest / d1
            return Triangle(l10, l20, l21, a, d1, f - l20 * c - l21 * rest)

    def solve(self, right: Array) -> Array:
        """Return the solutions (3, m) for right-hand sides (3, m), or one (3, 1) for all."""
        with np.errstate(all="ignore"):
            x = right[0]
            y = right[1] - self.l10 * x
            z = (right[2] - self.l20 * x - self.l21 * y) / self.d2
            y = y / self.d1 - self.l21 * z
            return np.stack([x / self.d0 - self.l10 * y - self.l20 * z, y, z])

    def energy(self, right: Array) -> Array:
        """Return right^T blocks^-1 right, (m,); see `solve`."""
        with np.errstate(all="ignore"):
            x = right[0]
            y = right[1] - self.l10 * x
            z = right[2] - self.l20 * x - self.l21 * y
            return np.asarray(x**2 / self.d0 + y**2 / self.d1 + z**2 / self.d2)


def solved_points(blocks: Array, right: Array, lift: float) -> Array:
    """Return x (m, 3) with (blocks + lift trace I) x = right, for blocks (m, 3, 3)."""
    return np.ascontiguousarray(Triangle.of(blocks, lift).solve(right.T).T)
