"""The evaluation observation by observation, all Jacobians stored: the reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.dense import DenseBlocks, DensePairs
from epigauge.bundle.linearizer import (
    LEAST_WEIGHT,
    CameraBlocks,
    Normal,
    PointRefinement,
    point_damping,
)
from epigauge.bundle.observations import ObservationGraph, whitened
from epigauge.cameras import CameraModel
from epigauge.kernels import Table
from epigauge.two_view.losses import Loss

__all__ = ["NumpyLinearizer", "inverse_roots", "normal_equations"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Points are eliminated in chunks of about this many matrix entries, which bounds the memory.
_CHUNK = 4_000_000

#: The reduced system of so many cameras is stored, dense; beyond, conjugate gradients.
DENSE_CAMERAS = 300

#: Places of the entries of a symmetric 4x4 matrix in its upper triangle, row by row.
_SYMMETRIC = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])

_QUIET: dict[str, Any] = {"divide": "ignore", "invalid": "ignore", "over": "ignore"}


@dataclass(frozen=True)
class NumpyLinearizer:
    """The evaluation by the kernels of a table.

    Attributes
    ----------
    model : CameraModel
        The camera.
    kernels : Table
        Back end.
    graph : ObservationGraph
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Measurements.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    loss : Loss
        Applied to each squared residual.
    whitening : ndarray, shape (2, 2, N), or None
        What residuals are multiplied by, where their coordinates are not measured alike.
    heaviest : float, optional
        Largest weight of all observations, where these are a part of them.
    """

    model: CameraModel
    kernels: Table
    graph: ObservationGraph
    q: Array
    weights: Array
    loss: Loss
    whitening: Array | None = None
    heaviest: float | None = None

    def with_loss(self, loss: Loss) -> Self:
        """Return the same observations with another loss."""
        return replace(self, loss=loss)

    @property
    def has_depths(self) -> bool:
        """Tell whether Z = d log depth belongs to the damping."""
        return self.model.homogeneous

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return r = q - q_hat, (2, N)."""
        residual = self._kernel("residual")
        with np.errstate(**_QUIET):
            return np.asarray(residual(*self._gathered(cameras, points), self.q))

    def observe(self, cameras: Array, points: Array) -> tuple[Array, Array, Array]:
        """Return r (2, N), and the Jacobians of q_hat by camera (2, d, N) and point (2, b, N).

        All are whitened.
        """
        observe = self._kernel("observe")
        with np.errstate(**_QUIET):
            r, J_camera, J_point = observe(*self._gathered(cameras, points), self.q)
            found = tuple(whitened(self.whitening, part) for part in (r, J_camera, J_point))
        return found[0], found[1], found[2]

    def log_depths(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return Z = d log depth by camera (d, N) and point (b, N)."""
        P, Q = self._gathered(cameras, points)
        with np.errstate(**_QUIET):
            Z_camera, Z_point = self.kernels.log_depth_derivatives(P.reshape(3, 4, -1), Q)
        return Z_camera, Z_point

    def point_costs(self, cameras: Array, points: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""
        with np.errstate(**_QUIET):
            r = self.residuals(cameras, points)
            return self._costs(whitened(self.whitening, r))[0]

    def distances(self, cameras: Array, points: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""
        with np.errstate(**_QUIET):
            return np.asarray(np.linalg.norm(self.residuals(cameras, points), axis=0))

    def intersect(self, cameras: Array) -> Array:
        """Return homogeneous points of least algebraic error, unit vectors (m, 4)."""
        P = cameras.reshape(-1, 3, 4).transpose(1, 2, 0)[:, :, self.graph.view]
        upper = self.kernels.sight_normal(np.ascontiguousarray(P), self.q, np.ones(self.q.shape[1]))
        gram = self.graph.sum_points(upper.T)[:, _SYMMETRIC]
        return np.asarray(np.linalg.eigh(gram)[1][:, :, 0])

    def weights_at(self, r: Array) -> Array:
        """Return the weight of each squared residual, that of the robust loss included, (N,)."""
        with np.errstate(**_QUIET):
            return self._costs(r)[1]

    def linearize(self, cameras: Array, points: Array) -> Normal:
        """Return the normal equations."""
        r, A, B = self.observe(cameras, points)
        with np.errstate(**_QUIET):
            # A start with a point in a focal plane has no finite blocks; its cost stops the run.
            root = np.sqrt(self.weights_at(r))
            blocks = None
            if self.has_depths:
                Z = self.log_depths(cameras, points)
                blocks = self._sums(root * Z[0], root * Z[1])
            return normal_equations(self.graph, root * A, root * B, -root * r, blocks)

    def coupling_blocks(self, cameras: Array, points: Array) -> Array:
        """Return W = J_camera^T J_point of each observation, weighted, (N, d, b)."""
        r, A, B = self.observe(cameras, points)
        weight = self.weights_at(r)
        return np.asarray(np.einsum("kin,kjn,n->nij", A, B, weight, optimize=True))

    def coupling_of(self, cameras: Array, points: Array, point: int) -> tuple[Indices, Array]:
        """Return the views of a point, (k,), and W of these edges, (k, d, b)."""
        graph = self.graph
        rows = slice(graph.first[point], graph.first[point + 1])
        view = graph.view[rows]
        alone = ObservationGraph(view, np.zeros(len(view), np.intp), graph.n_views, 1)
        own = self._of_one(alone, rows)
        r, A, B = own.observe(cameras, points[point][None])
        weight = self._effective(self.weights[rows], r)[1]
        W = np.einsum("kin,kjn,n->nij", A, B, weight, optimize=True)
        return alone.simple.view, alone.sum_edges(W)

    def _of_one(self, alone: ObservationGraph, rows: slice) -> NumpyLinearizer:
        """Return the observations of one point, which becomes the only one."""
        whitening = None if self.whitening is None else self.whitening[..., rows]
        return replace(self, graph=alone, q=self.q[:, rows], whitening=whitening)

    def refine_points(
        self, cameras: Array, points: Array, how: PointRefinement
    ) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""
        graph = self.graph
        lam = np.full(graph.n_points, how.lam)
        r, _, J = self.observe(cameras, points)
        with np.errstate(**_QUIET):
            cost, weight = self._costs(r)
            for _ in range(how.iterations):
                B = np.sqrt(weight) * J
                V = graph.sum_points(np.einsum("ikn,iln->nkl", B, B))
                g = -graph.sum_points(np.einsum("ikn,in->nk", B, np.sqrt(weight) * r))
                depth = None
                if self.has_depths:
                    Z = (np.sqrt(weight) * self.log_depths(cameras, points)[1]).T
                    depth = graph.sum_points(Z[:, :, None] * Z[:, None, :])
                D = point_damping(self.model, V, depth)
                step = -_solved(V + lam[:, None, None] * D, g)
                moving = -np.sum(g * step, axis=1) > how.tolerance * cost
                if not moving.any():
                    break
                trial = self.moved(cameras, points, step)
                r_trial, _, J_trial = self.observe(cameras, trial)
                cost_trial, weight_trial = self._costs(r_trial)
                better = moving & (cost_trial < cost)
                rows = better[graph.point]
                points = np.where(better[:, None], trial, points)
                r, J = np.where(rows, r_trial, r), np.where(rows, J_trial, J)
                weight = np.where(rows, weight_trial, weight)
                cost = np.where(better, cost_trial, cost)
                lam = np.where(better, lam / how.factor, lam * how.factor)
        return points, cost

    def moved(self, cameras: Array, points: Array, step: Array) -> Array:
        """Return the points after a step of their own tangents."""
        return np.asarray(points + step)

    def inverse_roots(self, V: Array, D: Array, lam: float, g: Array) -> tuple[Array, Array]:
        """Return T with T T^T = (V + lam D)^-1 for blocks (m, b, b), and T^T g."""
        return inverse_roots(V, D, lam, g)

    def _costs(self, r: Array) -> tuple[Array, Array]:
        rho, weight = self._effective(self.weights, r)
        return self.graph.sum_points(rho), weight

    def _effective(self, weights: Array, r: Array) -> tuple[Array, Array]:
        """Return weighted robust squares of residuals, and weights in the normal equations."""
        rho, first, _ = self.loss(np.sum(r**2, axis=0))
        heaviest = np.max(self.weights) if self.heaviest is None else self.heaviest
        least = LEAST_WEIGHT * float(heaviest)
        return weights * rho, np.maximum(weights * first, least)

    def _sums(self, Z_camera: Array, Z_point: Array) -> tuple[Array, Array]:
        x, y = Z_camera.T, Z_point.T
        return (
            self.graph.sum_views(x[:, :, None] * x[:, None, :]),
            self.graph.sum_points(y[:, :, None] * y[:, None, :]),
        )

    def _kernel(self, name: str) -> Any:
        return getattr(self.kernels, f"{self.model.prefix}_{name}")

    def _gathered(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        graph = self.graph
        return (
            np.ascontiguousarray(cameras.T[:, graph.view]),
            np.ascontiguousarray(points.T[:, graph.point]),
        )


def inverse_roots(V: Array, D: Array, lam: float, g: Array) -> tuple[Array, Array]:
    """Return T with T T^T = (V + lam D)^-1 for blocks (m, b, b), and T^T g."""
    T = np.swapaxes(np.linalg.inv(np.linalg.cholesky(V + lam * D)), 1, 2)
    return T, np.einsum("mij,mi->mj", T, g)


def normal_equations(
    graph: ObservationGraph,
    A: Array,
    B: Array,
    e: Array,
    depth_blocks: tuple[Array, Array] | None = None,
) -> Normal:
    """Return the normal equations of Jacobians by camera and point, and of residuals.

    Parameters
    ----------
    graph : ObservationGraph
        Which observation belongs to what.
    A, B, e : ndarray, shape (k, d, N), (k, b, N), (k, N)
        Weighted, k residuals an observation: the cost is 0.5 sum |e + A x + B y|^2.
    depth_blocks : tuple of ndarray, optional
        As in `Normal`.
    """
    by_view = np.ascontiguousarray(A[:, :, graph.by_view])
    size = A.shape[1]
    U = np.empty((graph.n_views, size, size))
    for i in range(graph.n_views):
        rows = slice(graph.first_in_view[i], graph.first_in_view[i + 1])
        J = by_view[:, :, rows].transpose(1, 0, 2).reshape(size, -1)
        U[i] = J @ J.T
    J_camera, J_point = A.transpose(2, 0, 1), B.transpose(2, 0, 1)
    J_camera_T, J_point_T = np.swapaxes(J_camera, 1, 2), np.swapaxes(J_point, 1, 2)
    residual = e.T[..., None]
    return Normal(
        U,
        graph.sum_points(J_point_T @ J_point),
        graph.sum_views((J_camera_T @ residual)[..., 0]),
        graph.sum_points((J_point_T @ residual)[..., 0]),
        StoredCoupling(graph, J_camera_T @ J_point),
        depth_blocks,
    )


@dataclass(frozen=True)
class StoredCoupling:
    """W as an array (N, d, b), one block an observation."""

    graph: ObservationGraph
    W: Array

    @property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored, or only iterated with."""
        return self.graph.n_views <= DENSE_CAMERAS

    def to_points(self, T: Array | None, x: Array) -> Array:
        """Return T^T W^T x, (m, b, ...), for x (n, d, ...)."""
        y = self.graph.sum_points(np.einsum("nij,ni...->nj...", self.W, x[self.graph.view]))
        return y if T is None else np.einsum("mij,mi...->mj...", T, y)

    def to_cameras(self, T: Array | None, y: Array) -> Array:
        """Return W T y, (n, d, ...), for y (m, b, ...)."""
        y = y if T is None else np.einsum("mij,mj...->mi...", T, y)
        moved = np.einsum("nij,nj...->ni...", self.W, y[self.graph.point])
        return self.graph.sum_views(moved)

    def schur(self, T: Array, half: Array | None) -> tuple[DensePairs, Array]:
        """Return P = W T T^T W^T, and W T half (n, d); half None is zero."""
        Y = self._edges(T)
        n, (_, d, b) = self.graph.n_views, Y.shape
        P, graph = np.zeros((n, d, n, d)), self.graph.simple
        size = max(1, _CHUNK // (n * d * b))
        for begin in range(0, graph.n_points, size):
            end = min(begin + size, graph.n_points)
            rows = slice(graph.first[begin], graph.first[end])
            seen, where = np.unique(graph.view[rows], return_inverse=True)
            block = np.zeros((len(seen), d, end - begin, b))
            block[where, :, graph.point[rows] - begin, :] = Y[rows]
            flat = block.reshape(len(seen) * d, -1)
            update = (flat @ flat.T).reshape(len(seen), d, len(seen), d)
            P[seen[:, None], :, seen[None, :], :] += update.transpose(0, 2, 1, 3)
        if half is None:
            return DensePairs(P), np.zeros((n, d))
        return DensePairs(P), graph.sum_views(np.einsum("nij,nj->ni", Y, half[graph.point]))

    def diagonal(self, T: Array) -> Array:
        """Return the diagonal blocks of P, (n, d, d)."""
        Y = self._edges(T)
        return self.graph.simple.sum_views(Y @ np.swapaxes(Y, 1, 2))

    def cliques(self) -> NDArray[np.bool_]:
        """Return the set of all views, (1, n): all blocks are stored."""
        return np.ones((1, self.graph.n_views), np.bool_)

    def marginals(self, T: Array, cameras: CameraBlocks, coupled: bool) -> tuple[Array, Array]:
        """Return the points' blocks of an inverse, (m, b, b), and those of each observation."""
        assert isinstance(cameras, DenseBlocks)
        graph, all_Y = self.graph.simple, self._edges(T)
        inner, across = np.zeros_like(T), np.empty_like(all_Y)
        counts, (_, d, b) = np.diff(graph.first), all_Y.shape
        for k in np.unique(counts):
            those = np.flatnonzero(counts == k)
            size = max(1, _CHUNK // int((k * d) ** 2))
            for begin in range(0, len(those), size):
                chunk = those[begin : begin + size]
                rows = graph.first[chunk][:, None] + np.arange(k)
                Y = all_Y[rows].reshape(len(chunk), k * d, b)
                XY = cameras.among(graph.view[rows]) @ Y
                inner[chunk] = np.eye(b) + np.swapaxes(Y, 1, 2) @ XY
                across[rows] = -(XY @ np.swapaxes(T[chunk], 1, 2)).reshape(len(chunk), k, d, b)
        found = T @ (0.5 * (inner + np.swapaxes(inner, 1, 2))) @ np.swapaxes(T, 1, 2)
        return found, self.graph.of_edges(across) if coupled else across[:0]

    def _edges(self, T: Array) -> Array:
        graph = self.graph
        return graph.sum_edges(self.W) @ T[graph.simple.point]


def _solved(A: Array, b: Array) -> Array:
    """Return A^-1 b for each of many symmetric systems, A^+ b where one is singular to rounding."""
    try:
        return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.asarray((np.linalg.pinv(A, hermitian=True) @ b[..., None])[..., 0])
