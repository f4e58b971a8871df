"""Lines beside points: both are features of four unknowns, eliminated alike.

The features of a problem are rows (m + L, 6): points (X, 0, 0, 0), then lines (n, v) with v a unit
vector. Their tangents have four entries; the last one of a point moves nothing. A line's update is
that of its orthonormal representation about the centre, of those cameras that see it, that is
farthest from it: similarities take it along, and the line is off it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.freedom import Freedom
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem, BundleState
from epigauge.bundle.ties import Ties
from epigauge.multi_view.measured import whitened

__all__ = [
    "FeatureLinearizer",
    "FeatureProblem",
    "Segments",
    "feature_freedom",
    "features_of",
    "joint_graph",
    "unit_lines",
]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_QUIET: dict[str, Any] = {"divide": "ignore", "invalid": "ignore", "over": "ignore"}

#: Entries of a feature, and of its tangent.
_ROW, _TANGENT = 6, 4


@dataclass(frozen=True)
class Segments:
    """Measured segments, and the cameras that see them without distortion.

    Attributes
    ----------
    view, line : ndarray of int, shape (N,)
        Sorted by line, then view.
    ends, spread : ndarray, shape (4, N), (6, N)
        Pixels of both end points, and their covariances where a point of weight one has one.
    prefix : str
        What the kernels are called.
    intrinsics : ndarray, shape (n, 4), or None
        Of the cameras without distortion that stand for others; None where lines are seen by the
        cameras themselves.
    """

    view: Indices
    line: Indices
    ends: Array
    spread: Array
    prefix: str
    intrinsics: Array | None = None

    def cameras(self, rows: Array) -> Array:
        """Return what the kernels take for each observation, (c, N)."""
        if self.intrinsics is not None:
            rows = np.concatenate([rows[:, :12], self.intrinsics], axis=1)
        return np.ascontiguousarray(rows.T[:, self.view])

    def origins(self, cameras: Array, lines: Array) -> Array:
        """Return for each line the farthest centre of the cameras that see it, (L, 3)."""
        pose = cameras[:, :12].reshape(-1, 3, 4)
        centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])[self.view]
        n, v = lines[self.line, :3], lines[self.line, 3:]
        away = np.linalg.norm(n - np.cross(centres, v), axis=1)
        order = np.lexsort((-away, self.line))
        first = np.searchsorted(self.line, np.arange(len(lines)))
        return np.asarray(centres[order[first]])


@dataclass(frozen=True)
class FeatureLinearizer(NumpyLinearizer):
    """The evaluation of points, then lines; graph, weights and whitening are those of both.

    Attributes
    ----------
    segments : Segments
        The observations of lines.
    n_points : int
        Number of points.
    """

    segments: Segments = field(kw_only=True)
    n_points: int = field(kw_only=True)

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return r = q - q_hat of points, distances of lines over their deviations, (2, N)."""
        own, lines = self.segments, points[self.n_points :]
        residual = getattr(self.kernels, f"{own.prefix}_line_residual")
        with np.errstate(**_QUIET):
            of_points = self._kernel("residual")(*self._gathered(cameras, points), self.q)
            parts = own.cameras(cameras), lines.T[:, own.line], own.ends, own.spread
            of_lines = residual(*parts)
        return np.concatenate([of_points, of_lines], axis=1)

    def observe(self, cameras: Array, points: Array) -> tuple[Array, Array, Array]:
        """Return r (2, N), and the Jacobians by camera (2, d, N) and feature (2, 4, N)."""
        own, lines = self.segments, points[self.n_points :]
        count = self.q.shape[1]
        d, N = self.model.tangent_size, count + len(own.view)
        r, A, B = np.empty((2, N)), np.zeros((2, d, N)), np.zeros((2, _TANGENT, N))
        observe = getattr(self.kernels, f"{own.prefix}_line_observe")
        with np.errstate(**_QUIET):
            found = self._kernel("observe")(*self._gathered(cameras, points), self.q)
            r[:, :count], A[:, :, :count], B[:, :3, :count] = found
            origin = self.segments.origins(cameras, lines).T[:, own.line]
            parts = own.cameras(cameras), lines.T[:, own.line], origin, own.ends, own.spread
            r[:, count:], by_camera, B[:, :, count:] = observe(*parts)
            # Cameras that stand for others have intrinsics of their own, which stay.
            size = by_camera.shape[1] if own.intrinsics is None else 6
            A[:, :size, count:] = by_camera[:, :size]
            whole = tuple(whitened(self.whitening, part) for part in (r, A, B))
        return whole[0], whole[1], whole[2]

    def moved(self, cameras: Array, points: Array, step: Array) -> Array:
        """Return features after a step: points by addition, lines by their update."""
        m = self.n_points
        moved = points.copy()
        moved[:m, :3] += step[:m, :3]
        lines = points[m:]
        origins = self.segments.origins(cameras, lines)
        with np.errstate(**_QUIET):
            moved[m:] = self.kernels.line_retract(lines.T, origins.T, step[m:].T).T
            moved[m:] /= np.linalg.norm(moved[m:, 3:], axis=1, keepdims=True)
        return moved

    def _gathered(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        graph, count = self.graph, self.q.shape[1]
        return (
            np.ascontiguousarray(cameras.T[:, graph.view[:count]]),
            np.ascontiguousarray(points.T[:3, graph.point[:count]]),
        )


@dataclass(frozen=True)
class FeatureProblem(BundleProblem):
    """The problem of points and lines."""

    def moved(self, state: BundleState, step: Array) -> Array:
        """Return the features after a step."""
        assert isinstance(self.linearizer, FeatureLinearizer)
        return self.linearizer.moved(state.cameras, state.points, step)


def features_of(points: Array, lines: Array) -> Array:
    """Return points (m, 3) and lines (L, 6) as rows (m + L, 6)."""
    rows = np.zeros((len(points) + len(lines), _ROW))
    rows[: len(points), :3], rows[len(points) :] = points, lines
    return rows


def feature_freedom(freedom: Freedom, m: int, count: int) -> Freedom:
    """Return what is free where so many lines, which are free, follow the m points."""
    C, kept, ties = freedom.ties.C, freedom.kept, freedom.ties
    if C is not None:
        whole = np.tile(np.eye(_TANGENT), (m + count, 1, 1))
        whole[:m, :3, :3] = C
        C = whole
    if kept is not None:
        kept = np.concatenate([kept, np.zeros(count, np.bool_)])
    return Freedom(Ties(ties.A, ties.E, ties.index, ties.n_shared, C), kept)


def joint_graph(graph: ObservationGraph, segments: Segments, count: int) -> ObservationGraph:
    """Return who sees which feature, so many lines after the points."""
    return replace(
        graph,
        view=np.concatenate([graph.view, segments.view]),
        point=np.concatenate([graph.point, graph.n_points + segments.line]),
        n_points=graph.n_points + count,
    )


def unit_lines(lines: Array) -> Array:
    """Return Pluecker coordinates with n orthogonal to v, and v of length one."""
    n, v = lines[:, :3], lines[:, 3:]
    length = np.linalg.norm(v, axis=1, keepdims=True)
    n, v = n / length, v / length
    return np.concatenate([n - np.sum(n * v, axis=1, keepdims=True) * v, v], axis=1)
