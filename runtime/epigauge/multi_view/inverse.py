"""A generalised inverse of a reconstruction's normal matrix, from the cameras' reduced system."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.numpy_linearizer import NumpyLinearizer, inverse_roots
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.solve import System
from epigauge.errors import ArgumentError
from epigauge.multi_view.datum import freedom

__all__ = ["Inverse"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Inverse:
    """A generalised inverse X of N, in parameters in which W of the covariant damping is one.

    X = (N + A A^T)^-1 with A along the scales and, for the cameras, the changes of basis: the
    reduced matrix of the cameras is definite, and N X N = N.

    Attributes
    ----------
    layout : ObservationGraph
        The observations.
    cameras : ndarray, shape (12 n, 12 n)
        The cameras' part of X.
    V_inverse : ndarray, shape (m, 4, 4)
        Inverse point blocks.
    W, Y : ndarray, shape (N, 12, 4)
        Coupling of each observation, and that times V^-1.
    whitening : tuple of ndarray, shape (n, 12, 12), (m, 4, 4)
        Blocks from these parameters to those of the state.
    state : tuple of ndarray, shape (n, 12), (m, 4)
        Where N was made, in conditioned coordinates.
    linearizer : NumpyLinearizer
        What made it.
    scale : float
        Pixels a unit of the image.
    """

    layout: ObservationGraph
    cameras: Array
    V_inverse: Array
    W: Array
    Y: Array
    whitening: tuple[Array, Array]
    state: tuple[Array, Array]
    linearizer: NumpyLinearizer
    scale: float

    @staticmethod
    def of(linearizer: NumpyLinearizer, state: tuple[Array, Array], scale: float) -> Inverse:
        """Invert the normal equations at a state."""
        try:
            normal = linearizer.linearize(*state)
            assert normal.depth_blocks is not None
            cameras, points = normal.depth_blocks
            damping = normal.U + cameras, normal.V + points
            roots = [np.swapaxes(np.linalg.cholesky(W), 1, 2) for W in damping]
            whitening = (np.asarray(np.linalg.inv(roots[0])), np.asarray(np.linalg.inv(roots[1])))
            white = System(normal, inverse_roots).tied(*whitening)
            P, Q = state[0].reshape(-1, 3, 4), state[1]
            p, q, G = freedom(linearizer.kernels, P, Q, (roots[0], roots[1]))
            V = white.V + q[:, :, None] * q[:, None, :]
            V_inverse = np.asarray(np.linalg.inv(V))
            reduced = white.reduced(inverse_roots(V, V, 0.0, q)[0])
            n, a = p.shape
            blocks = reduced.reshape(n, a, n, a)
            blocks[np.arange(n), :, np.arange(n)] += p[:, :, None] * p[:, None, :]
            moves = G[: p.size]
            reduced += moves @ moves.T
            values = np.linalg.eigvalsh(reduced)
            if not values[0] > 1e-14 * values[-1]:
                raise np.linalg.LinAlgError
            inverse = np.asarray(np.linalg.inv(reduced))
        except np.linalg.LinAlgError:
            raise ArgumentError(
                "reconstruction",
                "is not determined by the tracks (singular normal equations)",
                "cameras and points in general position, at a minimum",
            ) from None
        layout = linearizer.graph
        views, points_of = whitening[0][layout.view], whitening[1][layout.point]
        W = np.swapaxes(views, 1, 2) @ linearizer.coupling_blocks(*state) @ points_of
        Y = W @ V_inverse[layout.point]
        return Inverse(
            layout,
            0.5 * (inverse + inverse.T),
            V_inverse,
            W,
            Y,
            whitening,
            state,
            linearizer,
            scale,
        )

    def apply(self, vectors: Array) -> Array:
        """Return X times vectors (12 n + 4 m, r)."""
        size, layout = len(self.cameras), self.layout
        points = vectors[size:].reshape(layout.n_points, 4, -1)
        coupled = layout.sum_views(self.Y @ points[layout.point])
        x = self.cameras @ (vectors[:size] - coupled.reshape(size, -1))
        back = np.swapaxes(self.W, 1, 2) @ x.reshape(layout.n_views, 12, -1)[layout.view]
        y = self.V_inverse @ (points - layout.sum_points(back))
        return np.concatenate([x, y.reshape(len(vectors) - size, -1)])

    @cached_property
    def points(self) -> Array:
        """Return the points' diagonal blocks of X, (m, 4, 4)."""
        return self._points_and_couplings[0]

    @cached_property
    def observed(self) -> Array:
        """Return J X J^T of each observation, (N, 2, 2)."""
        layout = self.layout
        points, couplings = self._points_and_couplings
        n = layout.n_views
        blocks = self.cameras.reshape(n, 12, n, 12)[np.arange(n), :, np.arange(n)]
        return self._propagated(
            layout.view, layout.point, blocks[layout.view], couplings, points[layout.point]
        )

    def projected(self, views: Indices, points: Indices) -> Array:
        """Return J X J^T of any points in any views, (k, 2, 2)."""
        n = self.layout.n_views
        blocks = self.cameras.reshape(n, 12, n, 12)
        couplings = np.empty((len(views), 12, 4))
        for k, (i, j) in enumerate(zip(views, points, strict=True)):
            rows = slice(self.layout.first[j], self.layout.first[j + 1])
            Y = self.Y[rows].reshape(-1, 4)
            couplings[k] = -blocks[i][:, self.layout.view[rows]].reshape(12, -1) @ Y
        return self._propagated(
            views, points, blocks[views, :, views], couplings, self.points[points]
        )

    @cached_property
    def _points_and_couplings(self) -> tuple[Array, Array]:
        """Return point blocks of X, and its block (camera, point) of each observation."""
        layout, n = self.layout, self.layout.n_views
        blocks = self.cameras.reshape(n, 12, n, 12)
        points, couplings = self.V_inverse.copy(), np.empty_like(self.Y)
        for j in range(layout.n_points):
            rows = slice(layout.first[j], layout.first[j + 1])
            views = layout.view[rows]
            among = blocks[views[:, None], :, views[None, :], :]
            size = 12 * len(views)
            Y = self.Y[rows].reshape(size, 4)
            XY = among.transpose(0, 2, 1, 3).reshape(size, size) @ Y
            points[j] += Y.T @ XY
            couplings[rows] = -XY.reshape(-1, 12, 4)
        return points, couplings

    def _propagated(
        self, views: Indices, points: Indices, X_ii: Array, X_ij: Array, X_jj: Array
    ) -> Array:
        """Return J X J^T of points in views from the blocks of X."""
        J_camera, J_point = self.jacobians(views, points)
        mixed = J_camera @ X_ij @ np.swapaxes(J_point, 1, 2)
        found = J_camera @ X_ii @ np.swapaxes(J_camera, 1, 2)
        found = found + J_point @ X_jj @ np.swapaxes(J_point, 1, 2)
        return np.asarray(found + mixed + np.swapaxes(mixed, 1, 2))

    def pull(self, observations: Indices, psi: Array) -> Array:
        """Return how far residuals (N, 2) move when forces psi (k, 2) on some are taken off."""
        layout = self.layout
        views, points = layout.view[observations], layout.point[observations]
        J_camera, J_point = self.jacobians(views, points)
        cameras, own = np.zeros((layout.n_views, 12)), np.zeros((layout.n_points, 4))
        np.add.at(cameras, views, np.einsum("kij,ki->kj", J_camera, psi))
        np.add.at(own, points, np.einsum("kij,ki->kj", J_point, psi))
        moved = self.apply(np.concatenate([cameras.ravel(), own.ravel()])[:, None])[:, 0]
        J_camera, J_point = self.jacobians(layout.view, layout.point)
        x = moved[: cameras.size].reshape(-1, 12)[layout.view]
        y = moved[cameras.size :].reshape(-1, 4)[layout.point]
        moves = np.einsum("kij,kj->ki", J_camera, x) + np.einsum("kij,kj->ki", J_point, y)
        return np.asarray(moves)

    def jacobians(self, views: Indices, points: Indices) -> tuple[Array, Array]:
        """Return derivatives (k, 2, 12), (k, 2, 4) of points in views, by whitened parameters."""
        P = self.state[0].reshape(-1, 3, 4).transpose(1, 2, 0)[:, :, views]
        Q = self.state[1].T[:, points]
        _, J_P, J_Q, _ = self.linearizer.kernels.project(
            np.ascontiguousarray(P), np.ascontiguousarray(Q)
        )
        J_camera = J_P.transpose(2, 0, 1) @ self.whitening[0][views]
        return J_camera, J_Q.transpose(2, 0, 1) @ self.whitening[1][points]
