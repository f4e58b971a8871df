"""Lines: a kind of features of four unknowns, beside points.

A line is a row (n, v) of Pluecker coordinates. With calibrated cameras v is a unit vector, and the
update is that of the orthonormal representation about the centre, of those cameras that see the
line, that is farthest from it: similarities take it along, and the line is off it. In a projective
basis the whole row has length one and the representation is that of four dimensions, the same in
all bases that differ by an orthonormal matrix; the covariant method computes in one of these.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.moves import Move
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.cameras import CameraModel
from epigauge.kernels import Table
from epigauge.two_view.losses import Loss

__all__ = ["LineLinearizer", "Segments", "sized_lines"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_QUIET: dict[str, Any] = {"divide": "ignore", "invalid": "ignore", "over": "ignore"}

#: Entries of the tangent of a camera's pose.
_POSE = 6


@dataclass(frozen=True)
class Segments:
    """Measured segments, and the cameras that see them without distortion.

    Attributes
    ----------
    view, line : ndarray of int, shape (N,)
        Sorted by line, then view.
    ends, spread : ndarray, shape (4, N), (6, N)
        Both end points as the cameras see them, and the covariances that the squared distance of an
        end point of weight one is divided by.
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
        away = np.sum((n - np.cross(centres, v)) ** 2, axis=1)
        away = np.where(np.isfinite(away), away, -1.0)
        every = np.arange(len(lines))
        farthest = np.maximum.reduceat(away, np.searchsorted(self.line, every))
        those = np.flatnonzero(away == farthest[self.line])
        # Of equal ones the first.
        return np.asarray(centres[those[np.searchsorted(self.line[those], every)]])


@dataclass(frozen=True)
class LineLinearizer(NumpyLinearizer):
    """The evaluation of lines: a `FeatureKind`, its features rows (L, 6), their tangents (L, 4).

    Residuals are the distances of both end points from the image of the line, over their standard
    deviations.

    Attributes
    ----------
    segments : Segments
        The observations.
    """

    segments: Segments = field(kw_only=True)

    @staticmethod
    def of(
        segments: Segments,
        model: CameraModel,
        kernels: Table,
        sizes: tuple[int, int],
        loss: Loss | None = None,
    ) -> LineLinearizer:
        """Return the evaluation of segments in cameras of a model; sizes are views and lines."""
        graph = ObservationGraph(segments.view, segments.line, *sizes)
        ones = np.ones(len(segments.view))
        parts = model, kernels, graph, segments.ends, ones, loss or Loss()
        return LineLinearizer(*parts, segments=segments)

    @property
    def has_depths(self) -> bool:
        """Tell whether Z = d log depth belongs to the damping: lines have no depth."""
        return False

    @property
    def _kernels(self) -> str:
        """Return what the kernels of the update begin with."""
        return "projective_line" if self.model.homogeneous else "line"

    def _about(self, cameras: Array, lines: Array) -> tuple[Array, ...]:
        """Return where updates are written, (3, L) of an origin each; of no place in a basis."""
        if self.model.homogeneous:
            return ()
        return (self.segments.origins(cameras, lines).T,)

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return the distances over their deviations, (2, N)."""
        own = self.segments
        residual = getattr(self.kernels, f"{own.prefix}_line_residual")
        with np.errstate(**_QUIET):
            parts = own.cameras(cameras), points.T[:, own.line], own.ends, own.spread
            return np.asarray(residual(*parts))

    def observe(self, cameras: Array, points: Array) -> tuple[Array, Array, Array]:
        """Return r (2, N), and the Jacobians by camera (2, d, N) and line (2, 4, N)."""
        own = self.segments
        observe = getattr(self.kernels, f"{own.prefix}_line_observe")
        with np.errstate(**_QUIET):
            about = [place[:, own.line] for place in self._about(cameras, points)]
            parts = own.cameras(cameras), points.T[:, own.line], *about, own.ends, own.spread
            r, by_camera, by_line = observe(*parts)
        if own.intrinsics is None:
            return r, by_camera, by_line
        # Cameras that stand for others have intrinsics of their own, which stay.
        A = np.zeros((2, self.model.tangent_size, r.shape[1]))
        A[:, :_POSE] = by_camera[:, :_POSE]
        return r, A, by_line

    def generators(self, cameras: Array, lines: Array) -> Array:
        """Return the velocities of lines by the gauge, as updates, (L, 4, g)."""
        generators = getattr(self.kernels, f"{self._kernels}_generators")
        return np.asarray(generators(lines.T, *self._about(cameras, lines)).transpose(2, 0, 1))

    def tangents(self, cameras: Array, lines: Array) -> Array:
        """Return the derivatives of lines, of the length they have here, by updates, (L, 6, 4)."""
        name = "projective_line_tangent" if self.model.homogeneous else "line_unit_tangent"
        tangent = getattr(self.kernels, name)
        return np.asarray(tangent(lines.T, *self._about(cameras, lines)).transpose(2, 0, 1))

    def _of_one(self, alone: ObservationGraph, rows: slice) -> LineLinearizer:
        """Return the segments of one line, which becomes the only one."""
        every = self.segments
        ends, spread = every.ends[:, rows], every.spread[:, rows]
        own = replace(every, view=alone.view, line=alone.point, ends=ends, spread=spread)
        return replace(self, graph=alone, q=ends, segments=own)

    def moved(self, cameras: Array, points: Array, step: Array) -> Array:
        """Return the lines after a step of their tangents at these cameras."""
        retract = getattr(self.kernels, f"{self._kernels}_retract")
        with np.errstate(**_QUIET):
            moved = np.array(retract(points.T, *self._about(cameras, points), step.T).T)
            if not self.model.homogeneous:
                moved /= np.linalg.norm(moved[:, 3:], axis=1, keepdims=True)
        return moved

    def carried(self, move: Move, points: Array) -> Array:
        """Return the lines after a move of space."""
        return self.sized(move.lines(points))

    def sized(self, lines: Array) -> Array:
        """Return lines of the length they have here: unit directions, or of length one."""
        return sized_lines(lines, self.model)


def sized_lines(lines: Array, model: CameraModel) -> Array:
    """Return Pluecker coordinates with n orthogonal to v, as the cameras of a model have them.

    Unit directions v; in a projective basis, where any line may be infinitely far, length one.
    """
    with np.errstate(**_QUIET):
        if not model.homogeneous:
            lines = lines / np.linalg.norm(lines[:, 3:], axis=1, keepdims=True)
            n, v = lines[:, :3], lines[:, 3:]
            return np.concatenate([n - np.sum(n * v, axis=1, keepdims=True) * v, v], axis=1)
        # The nearest on the quadric: n + v and n - v get the same length, one, as the whole does.
        n, v = lines[:, :3], lines[:, 3:]
        sides = [side / np.linalg.norm(side, axis=1, keepdims=True) for side in (n + v, n - v)]
        return np.concatenate([sides[0] + sides[1], sides[0] - sides[1]], axis=1) / 2.0
