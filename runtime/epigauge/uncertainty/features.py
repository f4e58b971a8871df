"""Points and lines as features of one kind, as the inverse of the normal matrix has them.

Rows (m + L, 6): points, filled up with zeros, then lines. Their tangents have four entries, as
homogeneous points have; the last one of a point (x, y, z) moves nothing, and no unknown moves it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.lines import LineLinearizer
from epigauge.bundle.null_space import generators
from epigauge.bundle.numpy_linearizer import NumpyLinearizer, inverse_roots
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.priors import Priors
from epigauge.bundle.solve import BundleSystem
from epigauge.bundle.ties import Ties

__all__ = ["FeatureLinearizer"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Entries of a feature, and of its tangent.
_ROW, _TANGENT = 6, 4


@dataclass(frozen=True)
class FeatureLinearizer(NumpyLinearizer):
    """The evaluation of points, then lines, whitened.

    Attributes
    ----------
    of_points, of_lines : NumpyLinearizer, LineLinearizer
        Those of either kind.
    """

    of_points: NumpyLinearizer = field(kw_only=True)
    of_lines: LineLinearizer = field(kw_only=True)

    @staticmethod
    def of(points: NumpyLinearizer, lines: LineLinearizer) -> FeatureLinearizer:
        """Return the evaluation of both."""
        first, then = points.graph, lines.graph
        graph = ObservationGraph(
            np.concatenate([first.view, then.view]),
            np.concatenate([first.point, first.n_points + then.point]),
            first.n_views,
            first.n_points + then.n_points,
        )
        weights = np.concatenate([points.weights, lines.weights])
        q = np.concatenate([points.q, np.zeros((2, len(then.view)))], axis=1)
        parts = points.model, points.kernels, graph, q, weights, points.loss
        return FeatureLinearizer(*parts, of_points=points, of_lines=lines)

    def reweighted(self, weights: Array) -> FeatureLinearizer:
        """Return the same observations with other weights."""
        count = len(self.of_points.weights)
        points = replace(self.of_points, weights=weights[:count])
        return FeatureLinearizer.of(points, replace(self.of_lines, weights=weights[count:]))

    @staticmethod
    def rows(points: Array, lines: Array) -> Array:
        """Return points (m, b) and lines (L, 6) as rows (m + L, 6)."""
        found = np.zeros((len(points) + len(lines), _ROW))
        found[: len(points), : points.shape[1]], found[len(points) :] = points, lines
        return found

    def split(self, features: Array) -> tuple[Array, Array]:
        """Return points (m, b) and lines (L, 6)."""
        m, size = self.of_points.graph.n_points, self.model.point_size
        return np.ascontiguousarray(features[:m, :size]), features[m:]

    def log_depths(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return Z = d log depth by camera (d, N) and feature (4, N); lines have no depth."""
        Z = self.of_points.log_depths(cameras, self.split(points)[0])
        none = len(self.of_lines.graph.view)
        return tuple(np.pad(part, ((0, 0), (0, none))) for part in Z)  # type: ignore[return-value]

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return the residuals of points, whitened, then those of lines, (2, N)."""
        return self.observe(cameras, points)[0]

    def observe(self, cameras: Array, points: Array) -> tuple[Array, Array, Array]:
        """Return r (2, N), and the Jacobians by camera (2, d, N) and feature (2, 4, N)."""
        X, lines = self.split(points)
        r, A, J = self.of_points.observe(cameras, X)
        r_lines, A_lines, J_lines = self.of_lines.observe(cameras, lines)
        wide = np.concatenate([J, np.zeros((2, _TANGENT - J.shape[1], J.shape[2]))], axis=1)
        return (
            np.concatenate([r, r_lines], axis=1),
            np.concatenate([A, A_lines], axis=2),
            np.concatenate([wide, J_lines], axis=2),
        )

    def coupling_of(self, cameras: Array, points: Array, point: int) -> tuple[Indices, Array]:
        """Return the views of a feature, (k,), and W of these edges, (k, d, 4)."""
        X, lines = self.split(points)
        if point >= len(X):
            return self.of_lines.coupling_of(cameras, lines, point - len(X))
        views, W = self.of_points.coupling_of(cameras, X, point)
        return views, np.pad(W, ((0, 0), (0, 0), (0, _TANGENT - W.shape[2])))

    def system(
        self, ties: Ties, cameras: Array, features: Array, priors: Priors | None = None
    ) -> BundleSystem:
        """Return the normal equations, the ties being those of cameras and points."""
        m, count = self.of_points.graph.n_points, len(features)
        C = np.tile(np.eye(_TANGENT), (count, 1, 1))
        C[:m, 3, 3] = 0.0
        if ties.C is not None:
            C[:m, :3, :3] = ties.C
        normal = self.linearize(cameras, features)
        if priors is not None:
            normal = priors.added(normal, cameras, features)
        return BundleSystem(
            normal,
            inverse_roots,
            replace(ties, C=C),
            None if priors is None else priors.border(normal, features),
            model=self.model,
            cameras=cameras,
            points=features,
        )

    def generators(self, cameras: Array, features: Array) -> tuple[Array, Array]:
        """Return the velocities of cameras (n, d, 7) and features (m + L, 4, 7) by the gauge."""
        X, lines = self.split(features)
        of_cameras, of_points = generators(self.model, self.kernels, cameras, X)
        found = np.zeros((len(features), _TANGENT, of_cameras.shape[2]))
        found[: len(X), :3] = of_points
        found[len(X) :] = self.of_lines.generators(cameras, lines)
        return of_cameras, found
