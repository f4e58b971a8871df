"""Normal equations of cameras and points, solved by the Schur complement of the points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

__all__ = ["BundleSystem", "Layout"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Points are eliminated in chunks of about this many matrix entries, which bounds the memory.
_CHUNK = 4_000_000

#: Up to this many cameras the reduced system is dense; beyond, conjugate gradients on the implicit
#: Schur complement.
DENSE_CAMERAS = 300

_CG_TOLERANCE = 1e-10
_CG_ITERATIONS = 2000


@dataclass(frozen=True)
class Layout:
    """Which observation belongs to which camera and point; sorted by point, then view.

    Attributes
    ----------
    view, point : ndarray of int, shape (N,)
        Indices.
    n_views, n_points : int
        Numbers of cameras and points; every index is used.
    """

    view: Indices
    point: Indices
    n_views: int
    n_points: int

    @cached_property
    def first(self) -> Indices:
        """Return the first observation of each point, and N."""
        return np.searchsorted(self.point, np.arange(self.n_points + 1))

    @cached_property
    def by_view(self) -> Indices:
        """Return the observations sorted by view."""
        return np.argsort(self.view, kind="stable")

    @cached_property
    def first_in_view(self) -> Indices:
        """Return where each view starts in `by_view`, and N."""
        return np.searchsorted(self.view[self.by_view], np.arange(self.n_views + 1))

    def sum_points(self, values: Array) -> Array:
        """Add up values (N, ...) over the observations of each point."""
        return np.add.reduceat(values, self.first[:-1], axis=0)

    def sum_views(self, values: Array) -> Array:
        """Add up values (N, ...) over the observations of each view."""
        return np.add.reduceat(values[self.by_view], self.first_in_view[:-1], axis=0)


@dataclass(frozen=True)
class BundleSystem:
    """Blocks of J^T J and the gradient; a = parameters a camera, b = parameters a point.

    Attributes
    ----------
    layout : Layout
        The observations.
    U : ndarray, shape (n, a, a)
        Camera blocks.
    V : ndarray, shape (m, b, b)
        Point blocks.
    W : ndarray, shape (N, a, b)
        Coupling of each observation's camera and point.
    g_cameras, g_points : ndarray, shape (n, a), (m, b)
        Gradient.
    border : tuple of ndarray, optional
        (n, a, r) and (m, b, r): B in a term B B^T that couples everything (gauge constraints).
    """

    layout: Layout
    U: Array
    V: Array
    W: Array
    g_cameras: Array
    g_points: Array
    border: tuple[Array, Array] | None = None

    @cached_property
    def gradient(self) -> Array:
        """Return the gradient as one vector: cameras, then points."""
        return np.concatenate([self.g_cameras.ravel(), self.g_points.ravel()])

    def largest(self) -> float:
        """Return the largest mean diagonal entry of a block.

        Unlike the largest entry, an orthonormal change of basis does not change it.
        """
        traces = (np.einsum("nii->n", blocks) / blocks.shape[1] for blocks in (self.U, self.V))
        return float(max(trace.max() for trace in traces))

    def decrement(self) -> float:
        """Return infinity: J^T J is singular along the gauge."""
        return float("inf")

    def split(self, vector: Array) -> tuple[Array, Array]:
        """Return camera part (n, a) and point part (m, b) of a vector."""
        size = self.g_cameras.size
        cameras, points = vector[:size], vector[size:]
        return cameras.reshape(self.g_cameras.shape), points.reshape(self.g_points.shape)

    def product(self, step: Array) -> Array:
        """Return J^T J times a vector."""
        x, y = self.split(step)
        view, point = self.layout.view, self.layout.point
        cameras = np.einsum("nij,nj->ni", self.U, x)
        cameras += self.layout.sum_views(np.einsum("nij,nj->ni", self.W, y[point]))
        points = np.einsum("nij,nj->ni", self.V, y)
        points += self.layout.sum_points(np.einsum("nij,ni->nj", self.W, x[view]))
        if self.border is not None:
            Bc, Bp = self.border
            along = np.einsum("nir,ni->r", Bc, x) + np.einsum("nir,ni->r", Bp, y)
            cameras, points = cameras + Bc @ along, points + Bp @ along
        return np.concatenate([cameras.ravel(), points.ravel()])

    def predicted(self, step: Array) -> float:
        """Return -(g^T step + step^T N step / 2)."""
        return float(-(self.gradient @ step + 0.5 * step @ self.product(step)))

    def damped(self, W_cameras: Array, W_points: Array) -> BundleSystem:
        """Return the system with block diagonal matrices added to J^T J."""
        return replace(self, U=self.U + W_cameras, V=self.V + W_points)

    def transformed(self, B_cameras: Array, B_points: Array) -> BundleSystem:
        """Return the system in parameters y with x = B y, blocks (n, a, a') and (m, b, b').

        A column of zeros freezes a parameter: its diagonal entry becomes one.
        """
        B_view, B_point = B_cameras[self.layout.view], B_points[self.layout.point]
        return replace(
            self,
            U=_congruent(B_cameras, self.U),
            V=_congruent(B_points, self.V),
            W=np.swapaxes(B_view, 1, 2) @ self.W @ B_point,
            g_cameras=np.einsum("nij,ni->nj", B_cameras, self.g_cameras),
            g_points=np.einsum("nij,ni->nj", B_points, self.g_points),
            border=None
            if self.border is None
            else (
                np.swapaxes(B_cameras, 1, 2) @ self.border[0],
                np.swapaxes(B_points, 1, 2) @ self.border[1],
            ),
        )

    def solve(self) -> Array:
        """Return -(J^T J)^-1 g."""
        rhs = (-self.g_cameras[..., None], -self.g_points[..., None])
        if self.border is None:
            x, y = self._apply_inverse(*rhs)
            return np.concatenate([x.ravel(), y.ravel()])
        # Woodbury: the border's columns are solved for along with the gradient.
        Bc, Bp = self.border
        x, y = self._apply_inverse(
            np.concatenate([rhs[0], Bc], axis=2), np.concatenate([rhs[1], Bp], axis=2)
        )
        overlap = np.einsum("nir,nis->rs", Bc, x) + np.einsum("nir,nis->rs", Bp, y)
        shift = np.linalg.solve(np.eye(Bc.shape[2]) + overlap[:, 1:], overlap[:, :1])
        x, y = x[..., :1] - x[..., 1:] @ shift, y[..., :1] - y[..., 1:] @ shift
        return np.concatenate([x.ravel(), y.ravel()])

    def solve_grounded(self, moves: Array) -> Array:
        """Return -(J^T J + moves moves^T)^-1 g, moves (n a, r) acting on the cameras only.

        For systems that are singular without it; the reduced system is dense.
        """
        rhs = (-self.g_cameras[..., None], -self.g_points[..., None])
        x, y = self._apply_inverse(*rhs, moves)
        return np.concatenate([x.ravel(), y.ravel()])

    def _apply_inverse(
        self, cameras: Array, points: Array, moves: Array | None = None
    ) -> tuple[Array, Array]:
        """Apply the inverse of the part without border to right-hand sides (n, a, r), (m, b, r)."""
        layout = self.layout
        V_inverse = np.linalg.inv(self.V)
        Y = self.W @ V_inverse[layout.point]
        right = cameras - layout.sum_views(Y @ points[layout.point])
        n, a, r = right.shape
        x: Array
        if n <= DENSE_CAMERAS or moves is not None:
            S = self._reduced_matrix()
            if moves is not None:
                S += moves @ moves.T
            x = np.asarray(np.linalg.solve(S, right.reshape(n * a, r))).reshape(n, a, r)
        else:
            x = np.stack([self._conjugate_gradients(Y, right[..., k]) for k in range(r)], axis=2)
        coupled = layout.sum_points(np.swapaxes(self.W, 1, 2) @ x[layout.view])
        return x, V_inverse @ (points - coupled)

    def _reduced_matrix(self) -> Array:
        """Return the Schur complement U - W V^-1 W^T, dense, (n a, n a)."""
        layout = self.layout
        n, a, b = len(self.U), self.U.shape[1], self.V.shape[1]
        S = np.zeros((n, a, n, a))
        S[np.arange(n), :, np.arange(n), :] = self.U
        # V^-1 = T T^T, so that each chunk of points is one symmetric product.
        T = np.swapaxes(np.linalg.inv(np.linalg.cholesky(self.V)), 1, 2)
        half = self.W @ T[layout.point]
        size = max(1, _CHUNK // (n * a * b))
        for begin in range(0, layout.n_points, size):
            end = min(begin + size, layout.n_points)
            rows = slice(layout.first[begin], layout.first[end])
            seen, where = np.unique(layout.view[rows], return_inverse=True)
            block = np.zeros((len(seen), a, end - begin, b))
            block[where, :, layout.point[rows] - begin, :] = half[rows]
            flat = block.reshape(len(seen) * a, -1)
            update = (flat @ flat.T).reshape(len(seen), a, len(seen), a)
            S[seen[:, None], :, seen[None, :], :] -= update.transpose(0, 2, 1, 3)
        return S.reshape(n * a, n * a)

    def _conjugate_gradients(self, Y: Array, right: Array) -> Array:
        """Solve the reduced system without forming it, preconditioned by its diagonal blocks."""
        layout = self.layout
        diagonal = self.U - layout.sum_views(Y @ np.swapaxes(self.W, 1, 2))
        inverse = np.linalg.inv(diagonal)

        def reduced(x: Array) -> Array:
            inner = layout.sum_points(np.einsum("nij,ni->nj", Y, x[layout.view]))
            outer = layout.sum_views(np.einsum("nij,nj->ni", self.W, inner[layout.point]))
            return np.asarray(np.einsum("nij,nj->ni", self.U, x) - outer)

        x = np.zeros_like(right)
        residual = right.copy()
        z = np.einsum("nij,nj->ni", inverse, residual)
        direction, energy = z, float(np.sum(residual * z))
        goal = _CG_TOLERANCE**2 * energy
        for _ in range(_CG_ITERATIONS):
            if energy <= goal:
                break
            image = reduced(direction)
            length = energy / float(np.sum(direction * image))
            x = x + length * direction
            residual = residual - length * image
            z = np.einsum("nij,nj->ni", inverse, residual)
            previous, energy = energy, float(np.sum(residual * z))
            direction = z + (energy / previous) * direction
        return x


def _congruent(B: Array, blocks: Array) -> Array:
    """Return B^T A B for each block, with ones on the diagonal where B has a column of zeros."""
    result = np.swapaxes(B, 1, 2) @ blocks @ B
    frozen = ~B.any(axis=1)
    k, i = np.nonzero(frozen)
    result[k, i, i] = 1.0
    return np.asarray(result)
