"""The coupling of cameras and points in the normal equations, stored block by block.

The NumPy reference of what `fused` computes without storing anything: products with the coupling
W = J_P^T J_Q, and the reduced system U - W V^-1 W^T of the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.layout import Layout

__all__ = ["Coupling", "Reduced", "StoredCoupling", "most_blocks", "solved"]

Array = NDArray[np.float64]

#: Points are eliminated in chunks of about this many matrix entries, which bounds the memory.
_CHUNK = 4_000_000

#: As many blocks of the reduced system as this many cameras have, all with all, are stored and
#: factored; beyond, conjugate gradients on the implicit Schur complement.
DENSE_CAMERAS = 300

_CG_TOLERANCE = 1e-10
_CG_ITERATIONS = 2000


class Reduced(Protocol):
    """The reduced system S = U - W V^-1 W^T of the cameras, (n a, n a)."""

    @property
    def direct(self) -> bool:
        """Tell whether it is to be stored and factored, rather than iterated with."""

    def matrix(self) -> Array:
        """Return S, dense."""

    def solve(self, right: Array) -> Array:
        """Return S^-1 times right-hand sides (n, a, r), by a factor of S."""

    def times(self, x: Array) -> Array:
        """Return S times a vector (n, a)."""

    def diagonal(self) -> Array:
        """Return the diagonal blocks of S, (n, a, a)."""


class Coupling(Protocol):
    """The blocks W of J^T J that couple cameras (a parameters) and points (b parameters)."""

    def blocks(self) -> Array:
        """Return the blocks, one an observation, (N, a, b)."""

    def times_points(self, y: Array) -> Array:
        """Return W y for vectors y (m, b, r), (n, a, r)."""

    def times_cameras(self, x: Array) -> Array:
        """Return W^T x for vectors x (n, a, r), (m, b, r)."""

    def transformed(self, B_cameras: Array, B_points: Array) -> Coupling:
        """Return B_cameras^T W B_points, blocks (n, a, a') and (m, b, b')."""

    def inverse_roots(self, V: Array) -> Array:
        """Return upper triangular T with T T^T = V^-1 for blocks V (m, b, b)."""

    def reduced(self, U: Array, roots: Array) -> Reduced:
        """Return the reduced system for camera blocks U, and roots of the inverse point blocks."""

    def whitened_step(
        self,
        U: Array,
        V: Array,
        g_cameras: Array,
        g_points: Array,
        W: tuple[Array, Array],
        lam: float,
    ) -> tuple[Array, float] | None:
        """Return -(N + lam W)^-1 g and its W-norm squared; None leaves it to the system."""


@dataclass(frozen=True)
class StoredCoupling:
    """The reference: W as an array.

    Attributes
    ----------
    layout : Layout
        The observations.
    W : ndarray, shape (N, a, b)
        Coupling of each observation's camera and point.
    """

    layout: Layout
    W: Array

    def blocks(self) -> Array:
        """Return the blocks, one an observation, (N, a, b)."""
        return self.W

    def times_points(self, y: Array) -> Array:
        """Return W y for vectors y (m, b, r), (n, a, r)."""
        return self.layout.sum_views(self.W @ y[self.layout.point])

    def times_cameras(self, x: Array) -> Array:
        """Return W^T x for vectors x (n, a, r), (m, b, r)."""
        return self.layout.sum_points(np.swapaxes(self.W, 1, 2) @ x[self.layout.view])

    def transformed(self, B_cameras: Array, B_points: Array) -> StoredCoupling:
        """Return B_cameras^T W B_points, blocks (n, a, a') and (m, b, b')."""
        B_view, B_point = B_cameras[self.layout.view], B_points[self.layout.point]
        return StoredCoupling(self.layout, np.swapaxes(B_view, 1, 2) @ self.W @ B_point)

    def inverse_roots(self, V: Array) -> Array:
        """Return upper triangular T with T T^T = V^-1 for blocks V (m, b, b)."""
        return np.asarray(np.swapaxes(np.linalg.inv(np.linalg.cholesky(V)), 1, 2))

    def whitened_step(self, *_: Any) -> None:
        """Leave it to the system."""

    def reduced(self, U: Array, roots: Array) -> StoredReduced:
        """Return the reduced system for camera blocks U, and roots of the inverse point blocks."""
        return StoredReduced(self.layout, U, self.W @ roots[self.layout.point])


@dataclass(frozen=True)
class StoredReduced:
    """The reference: S = U - sum Y Y^T, dense, with Y (N, a, b) = W times the inverse roots."""

    layout: Layout
    U: Array
    Y: Array

    @property
    def direct(self) -> bool:
        """Tell whether it is to be stored and factored, rather than iterated with."""
        return self.layout.n_views <= DENSE_CAMERAS

    def matrix(self) -> Array:
        """Return S, dense."""
        layout = self.layout
        n, (_, a, b) = layout.n_views, self.Y.shape
        S = np.zeros((n, a, n, a))
        S[np.arange(n), :, np.arange(n), :] = self.U
        size = max(1, _CHUNK // (n * a * b))
        for begin in range(0, layout.n_points, size):
            end = min(begin + size, layout.n_points)
            rows = slice(layout.first[begin], layout.first[end])
            seen, where = np.unique(layout.view[rows], return_inverse=True)
            block = np.zeros((len(seen), a, end - begin, b))
            block[where, :, layout.point[rows] - begin, :] = self.Y[rows]
            flat = block.reshape(len(seen) * a, -1)
            update = (flat @ flat.T).reshape(len(seen), a, len(seen), a)
            S[seen[:, None], :, seen[None, :], :] -= update.transpose(0, 2, 1, 3)
        return S.reshape(n * a, n * a)

    def solve(self, right: Array) -> Array:
        """Return S^-1 times right-hand sides (n, a, r), by a factor of S."""
        n, a, r = right.shape
        return np.asarray(np.linalg.solve(self.matrix(), right.reshape(n * a, r))).reshape(n, a, r)

    def times(self, x: Array) -> Array:
        """Return S times a vector (n, a)."""
        layout = self.layout
        inner = layout.sum_points(np.einsum("nij,ni->nj", self.Y, x[layout.view]))
        outer = layout.sum_views(np.einsum("nij,nj->ni", self.Y, inner[layout.point]))
        return np.asarray(np.einsum("nij,nj->ni", self.U, x) - outer)

    def diagonal(self) -> Array:
        """Return the diagonal blocks of S, (n, a, a)."""
        return np.asarray(self.U - self.layout.sum_views(self.Y @ np.swapaxes(self.Y, 1, 2)))


def most_blocks() -> int:
    """Return how many blocks of a lower triangle are stored at most."""
    return DENSE_CAMERAS * (DENSE_CAMERAS + 1) // 2


def solved(reduced: Reduced, right: Array) -> Array:
    """Return S^-1 times right-hand sides (n, a, r): by a factor, or by conjugate gradients."""
    if reduced.direct:
        return reduced.solve(right)
    columns = [conjugate_gradients(reduced, right[..., k]) for k in range(right.shape[2])]
    return np.stack(columns, axis=2)


def conjugate_gradients(reduced: Reduced, right: Array) -> Array:
    """Solve a reduced system without forming it, preconditioned by its diagonal blocks.

    Parameters
    ----------
    reduced : Reduced
        S, positive definite.
    right : ndarray, shape (n, a)
        Right-hand side.

    Returns
    -------
    ndarray, shape (n, a)
        S^-1 right, to a relative 1e-10 in the norm of the preconditioned residual.

    Raises
    ------
    numpy.linalg.LinAlgError
        If S is seen not to be positive definite, or is not finite.
    """
    inverse = np.linalg.inv(reduced.diagonal())
    x = np.zeros_like(right)
    residual = right.copy()
    z = np.einsum("nij,nj->ni", inverse, residual)
    direction, energy = z, float(np.sum(residual * z))
    goal = _CG_TOLERANCE**2 * energy
    for _ in range(_CG_ITERATIONS):
        if energy <= goal:
            break
        image = reduced.times(direction)
        curvature = float(np.sum(direction * image))
        if not curvature > 0.0:
            raise np.linalg.LinAlgError("the reduced system is not positive definite")
        length = energy / curvature
        x = x + length * direction
        residual = residual - length * image
        z = np.einsum("nij,nj->ni", inverse, residual)
        previous, energy = energy, float(np.sum(residual * z))
        direction = z + (energy / previous) * direction
    return x
