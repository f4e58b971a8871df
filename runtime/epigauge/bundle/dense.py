"""The reduced system of the cameras as dense arrays: the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Pairs

__all__ = ["DenseBlocks", "DenseFactor", "DenseInverse", "DensePairs"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class DensePairs:
    """P as an array (n, d, n, d)."""

    P: Array

    def factor(self, U: Array, A: Array | None) -> DenseFactor:
        """Return a factor of U - A^T P A, blocks U (n, a, a) and A (n, d, a)."""
        n, a, _ = U.shape
        blocks = -self.P.transpose(0, 2, 1, 3)
        if A is not None:
            blocks = np.swapaxes(A, 1, 2)[:, None] @ blocks @ A
        S = blocks.transpose(0, 2, 1, 3).copy()
        S[np.arange(n), :, np.arange(n), :] += U
        S = S.reshape(n * a, n * a)
        if not np.isfinite(S).all():
            raise np.linalg.LinAlgError("the reduced system is not finite")
        np.linalg.cholesky(S)  # raises where S is not positive definite
        return DenseFactor(S, n)

    def without(self, F: Array) -> DensePairs:
        """Return P - F F^T, F (n, d, k)."""
        n, d, k = F.shape
        flat = F.reshape(n * d, k)
        return DensePairs(self.P - (flat @ flat.T).reshape(n, d, n, d))

    def plus(self, other: Pairs) -> DensePairs:
        """Return the sum with what features of another kind take off."""
        return DensePairs(self.P + other.dense())

    def times(self, x: Array) -> Array:
        """Return P x for x (n, d, k)."""
        n, d, k = x.shape
        return (self.P.reshape(n * d, n * d) @ x.reshape(n * d, k)).reshape(x.shape)

    def dense(self) -> Array:
        """Return P, (n, d, n, d)."""
        return self.P


@dataclass(frozen=True)
class DenseFactor:
    """The matrix itself (n a, n a), positive definite: NumPy solves from it; n views."""

    S: Array
    n: int

    def solve(self, right: Array) -> Array:
        """Return the solution for right-hand sides (n, a, k)."""
        flat = right.reshape(len(self.S), right.shape[2])
        return np.asarray(np.linalg.solve(self.S, flat)).reshape(right.shape)

    def inverse(self) -> DenseInverse:
        """Return the inverse."""
        scale = 1.0 / np.sqrt(np.diagonal(self.S))
        Z = scale[:, None] * np.linalg.inv(scale[:, None] * self.S * scale) * scale
        diagonals = np.diagonal(self.S).reshape(self.n, -1), np.diagonal(Z).reshape(self.n, -1)
        return DenseInverse(0.5 * (Z + Z.T), diagonals)


@dataclass(frozen=True)
class DenseInverse:
    """S^-1 (n a, n a), and the diagonals (n, a) of S and S^-1."""

    Z: Array
    diagonals: tuple[Array, Array]

    def spread(self, A: Array | None, K: Array) -> DenseBlocks:
        """Return the blocks of A S^-1 A^T + K K^T for A (n, d, a) and K (n, d, k)."""
        (n, a), (_, d, k) = self.diagonals[0].shape, K.shape
        flat = K.reshape(n * d, k)
        X = self.Z.reshape(n, a, n, a).transpose(0, 2, 1, 3)
        if A is not None:
            X = A[:, None] @ X @ np.swapaxes(A, 1, 2)
        low = (flat @ flat.T).reshape(n, d, n, d).transpose(0, 2, 1, 3)
        return DenseBlocks(np.ascontiguousarray(X + low))


@dataclass(frozen=True)
class DenseBlocks:
    """The cameras' part of an inverse, (n, n, d, d)."""

    X: Array

    @property
    def diagonal(self) -> Array:
        """Return the blocks of the views themselves, (n, d, d)."""
        own = np.arange(len(self.X))
        return self.X[own, own]

    def block(self, i: int, k: int) -> Array | None:
        """Return the block of two views, (d, d)."""
        return np.asarray(self.X[i, k])

    def among(self, views: Indices) -> Array:
        """Return the blocks of all pairs of some views (c, k) as matrices, (c, k d, k d)."""
        (c, k), d = views.shape, self.X.shape[2]
        blocks = self.X[views[:, :, None], views[:, None, :]]
        return blocks.transpose(0, 1, 3, 2, 4).reshape(c, k * d, k * d)
