"""A generalised inverse of a projective network's normal matrix, and what images see of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Normal
from epigauge.bundle.lines import LineLinearizer
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer, inverse_roots
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.solve import BundleSystem
from epigauge.errors import ArgumentError
from epigauge.multi_view.datum import freedom
from epigauge.uncertainty.features import FeatureLinearizer
from epigauge.uncertainty.inverse import Inverse as Selected
from epigauge.uncertainty.inverse import Motions

__all__ = ["Inverse"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Inverse:
    """A generalised inverse X of N: N X N = N.

    X = (N + A A^T)^-1 with A along the scales and, for some cameras, the changes of basis, each as
    heavy as W of the covariant damping makes it.

    Attributes
    ----------
    selected : epigauge.uncertainty.inverse.Inverse
        X.
    linearizer : NumpyLinearizer
        The observations.
    state : tuple of ndarray, shape (n, 12), (m, 4)
        Where N was made, in conditioned coordinates.
    lines : ndarray, shape (L, 6)
        Lines there; they are features of the inverse behind the points.
    scale : float
        Pixels a unit of the image.
    """

    selected: Selected
    linearizer: NumpyLinearizer
    state: tuple[Array, Array]
    scale: float
    lines: Array

    @staticmethod
    def of(
        linearizer: NumpyLinearizer,
        state: tuple[Array, Array],
        scale: float,
        segments: LineLinearizer | None = None,
        lines: Array | None = None,
    ) -> Inverse:
        """Invert the normal equations at a state, with those of lines where there are any."""
        reference, features = linearizer, state[1]
        if segments is not None:
            assert lines is not None
            reference = FeatureLinearizer.of(linearizer, segments)
            features = FeatureLinearizer.rows(state[1], lines)
        normal = _normal(reference, (state[0], features))
        assert normal.depth_blocks is not None
        damping = normal.U + normal.depth_blocks[0], normal.V + normal.depth_blocks[1]
        try:
            cameras, points = (np.swapaxes(np.linalg.cholesky(W), 1, 2) for W in damping)
        except np.linalg.LinAlgError:
            raise ArgumentError(
                "reconstruction",
                "is not determined by the tracks (singular normal equations)",
                "cameras and points in general position, at a minimum",
            ) from None
        # Unit scales, and orthonormal changes of basis, in parameters in which W is one.
        P = state[0].reshape(-1, 3, 4)
        m = len(state[1])
        p, q, G = freedom(linearizer.kernels, P, state[1], (cameras, points[:m]))
        p = np.einsum("nji,nj->ni", cameras, p)
        # Lines have no scale.
        beside = (0, len(features) - m), (0, 0)
        q = np.pad(np.einsum("nji,nj->ni", points[:m], q), beside)
        grounded = replace(
            normal,
            U=normal.U + p[:, :, None] * p[:, None, :],
            V=normal.V + q[:, :, None] * q[:, None, :],
        )
        n, a = p.shape
        # Their own motions play no part: what holds the gauge are cameras.
        unit, y = G[: n * a].reshape(n, a, -1), G[n * a :].reshape(m, q.shape[1], -1)
        y = np.pad(y, (*beside, (0, 0)))
        free = unit.shape[2]
        x, y = (np.asarray(np.linalg.solve(*pair)) for pair in ((cameras, unit), (points, y)))
        motions = Motions(x, y, np.eye(free), np.zeros((free, 0)))
        system = BundleSystem(
            grounded,
            inverse_roots,
            model=linearizer.model,
            cameras=state[0],
            points=features,
        )
        lifted = np.swapaxes(cameras, 1, 2) @ unit
        selected = Selected.held(system, reference, motions, unit, lifted)
        none = np.zeros((0, 6)) if lines is None else lines
        return Inverse(selected, linearizer, state, scale, none)

    @property
    def layout(self) -> ObservationGraph:
        """Return the observations."""
        return self.linearizer.graph

    def apply(self, vectors: Array) -> Array:
        """Return X times vectors (12 n + 4 m, r)."""
        size, layout = 12 * self.layout.n_views, self.layout
        cameras = vectors[:size].reshape(layout.n_views, 12, -1)
        x, y = self._apply(cameras, vectors[size:].reshape(layout.n_points, 4, -1))
        return np.concatenate([x.reshape(size, -1), y.reshape(len(vectors) - size, -1)])

    def _apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return X times columns (n, 12, r) and (m, 4, r), without the lines' part."""
        m = len(points)
        x, y = self.selected.apply(cameras, np.pad(points, ((0, len(self.lines)), (0, 0), (0, 0))))
        return x, y[:m]

    @property
    def views(self) -> Array:
        """Return the cameras' diagonal blocks of X, (n, 12, 12)."""
        return self.selected.blocks.diagonal

    @cached_property
    def cameras(self) -> Array:
        """Return the cameras' part of X, (12 n, 12 n)."""
        n = self.layout.n_views
        found = self.selected.solved(np.eye(12 * n).reshape(n, 12, -1)).reshape(12 * n, -1)
        return np.asarray(0.5 * (found + found.T))

    @property
    def points(self) -> Array:
        """Return the points' diagonal blocks of X, (m, 4, 4)."""
        return self._marginals[0][: self.layout.n_points]

    @cached_property
    def observed(self) -> Array:
        """Return J X J^T of each observation, (N, 2, 2)."""
        layout, (points, couplings) = self.layout, self._marginals
        view, couplings = layout.view, couplings[: len(layout.view)]
        return self._propagated(
            view, layout.point, self.views[view], couplings, points[layout.point]
        )

    @cached_property
    def observed_lines(self) -> Array:
        """Return J X J^T of the distances of each segment's end points, (S, 2, 2)."""
        reference, (features, couplings) = self.selected.reference, self._marginals
        assert isinstance(reference, FeatureLinearizer)
        graph = reference.of_lines.graph
        _, J_camera, J_line = reference.of_lines.observe(self.state[0], self.lines)
        J = J_camera.transpose(2, 0, 1), J_line.transpose(2, 0, 1)
        own = features[self.layout.n_points + graph.point]
        return _combined(*J, self.views[graph.view], couplings[len(self.layout.view) :], own)

    def projected(self, views: Indices, points: Indices) -> Array:
        """Return J X J^T of any points in any views, (k, 2, 2)."""
        couplings = np.empty((len(views), 12, 4))
        for k, (i, j) in enumerate(zip(views.tolist(), points.tolist(), strict=True)):
            couplings[k] = self.selected.block((i, None), (None, j))
        return self._propagated(views, points, self.views[views], couplings, self.points[points])

    @cached_property
    def _marginals(self) -> tuple[Array, Array]:
        """Return point blocks of X, and its block (camera, point) of each observation."""
        selected = self.selected
        return selected.coupling.marginals(selected.T, selected.blocks, coupled=True)

    def _propagated(
        self, views: Indices, points: Indices, X_ii: Array, X_ij: Array, X_jj: Array
    ) -> Array:
        """Return J X J^T of points in views from the blocks of X."""
        return _combined(*self.jacobians(views, points), X_ii, X_ij, X_jj)

    def pull(self, observations: Indices, psi: Array) -> Array:
        """Return how far residuals (N, 2) move when forces psi (k, 2) on some are taken off."""
        layout = self.layout
        views, points = layout.view[observations], layout.point[observations]
        J_camera, J_point = self.jacobians(views, points)
        cameras, own = np.zeros((layout.n_views, 12)), np.zeros((layout.n_points, 4))
        np.add.at(cameras, views, np.einsum("kij,ki->kj", J_camera, psi))
        np.add.at(own, points, np.einsum("kij,ki->kj", J_point, psi))
        x, y = (part[..., 0] for part in self._apply(cameras[..., None], own[..., None]))
        J_camera, J_point = self.jacobians(layout.view, layout.point)
        moves = np.einsum("kij,kj->ki", J_camera, x[layout.view])
        return np.asarray(moves + np.einsum("kij,kj->ki", J_point, y[layout.point]))

    def jacobians(self, views: Indices, points: Indices) -> tuple[Array, Array]:
        """Return derivatives (k, 2, 12), (k, 2, 4) of points in views."""
        P = self.state[0].reshape(-1, 3, 4).transpose(1, 2, 0)[:, :, views]
        Q = self.state[1].T[:, points]
        _, J_P, J_Q, _ = self.linearizer.kernels.project(
            np.ascontiguousarray(P), np.ascontiguousarray(Q)
        )
        return J_P.transpose(2, 0, 1), J_Q.transpose(2, 0, 1)


def _combined(J_camera: Array, J_point: Array, X_ii: Array, X_ij: Array, X_jj: Array) -> Array:
    """Return J X J^T, (k, 2, 2), from Jacobians and blocks of X."""
    mixed = J_camera @ X_ij @ np.swapaxes(J_point, 1, 2)
    found = J_camera @ X_ii @ np.swapaxes(J_camera, 1, 2)
    found = found + J_point @ X_jj @ np.swapaxes(J_point, 1, 2)
    return np.asarray(found + mixed + np.swapaxes(mixed, 1, 2))


def _normal(linearizer: NumpyLinearizer, state: tuple[Array, Array]) -> Normal:
    """Return the normal equations; where the library can, nothing of an observation is stored."""
    stored = linearizer.whitening is not None or isinstance(linearizer, FeatureLinearizer)
    if not linearizer.kernels.compiled or stored:
        return linearizer.linearize(*state)
    parts = linearizer.model, linearizer.graph, linearizer.q, linearizer.weights, linearizer.loss
    normal = NativeLinearizer(*parts).linearize(*state)
    direct = NativeLinearizer(*parts, factored=False).linearize(*state)
    return replace(normal, coupling=direct.coupling)
