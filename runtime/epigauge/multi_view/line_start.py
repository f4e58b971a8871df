"""Lines from segments in views whose cameras are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.bundle.lines import LineLinearizer, Segments, sized_lines
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.run import REFINEMENT_METRIC
from epigauge.cameras import CameraModel, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.line_agreement import agreeing, lengths, meets, usual
from epigauge.multi_view.line_segments import (
    checked_lines,
    frame_of,
    projective_segments,
    segments_of,
)
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.reconstruction import Reconstruction

__all__ = [
    "OPEN",
    "ROUNDING",
    "SeenLines",
    "refuse_absurd",
    "seen_lines",
    "spreads",
    "triangulate_lines",
    "triangulated",
]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A line is open whose update is uncertain by more than this: radians, or shares of its distance.
OPEN = 0.3

#: An eigenvalue of a system whose diagonal is one, that is rounding.
ROUNDING = 1e-11

#: Half of a line's segments are this far from it where it is absurd: in usual distances, and as a
#: share of the extent of all segments.
_ABSURD, _FAR = 20.0, 0.05


class SeenLines(NamedTuple):
    """Segments and the cameras that see them, as the engine takes both.

    Attributes
    ----------
    model : CameraModel
        The camera.
    cameras, points : ndarray, shape (n, c), (m, b)
        Cameras, and the points of the scene.
    segments : Segments
        The observations.
    scale_px : float
        Pixels a unit of the image coordinates.
    n_lines : int
        Number of lines.
    """

    model: CameraModel
    cameras: Array
    points: Array
    segments: Segments
    scale_px: float
    n_lines: int

    def linearizer(self, table: Table) -> LineLinearizer:
        """Return what evaluates the segments."""
        sizes = len(self.cameras), self.n_lines
        return LineLinearizer.of(self.segments, self.model, table, sizes)


def seen_lines(
    name: str, lines: LineTracks, scene: Any, unit: float = 1.0, frame: Frame | None = None
) -> SeenLines:
    """Return segments and the cameras of a scene.

    Parameters
    ----------
    name : str
        What the scene is called where it is refused.
    lines : LineTracks
        The segments.
    scene : MetricReconstruction or Reconstruction
        The cameras.
    unit : float
        Standard deviation of an image coordinate of weight one.
    frame : Frame, optional
        Image coordinates of projective cameras to compute in; else some that suit the segments.

    Raises
    ------
    ArgumentError
        On other scenes, views that have no camera, or end points without direction.
    """
    if isinstance(scene, MetricReconstruction):
        model = camera_model(scene.cameras.model)
        segments = segments_of(lines, scene, unit)
        return SeenLines(model, scene.vectors, scene.X, segments, 1.0, lines.n_lines)
    if not isinstance(scene, Reconstruction):
        was = f"is a {type(scene).__name__}"
        needed = "an eg.MetricReconstruction or eg.Reconstruction (to_projective), as lines need"
        raise ArgumentError(name, was, needed)
    lines = checked_lines(lines, scene.n_views)
    frame = frame_of(lines, scene.n_views) if frame is None else frame
    rows = frame.cameras_in(scene.P).reshape(-1, 12)
    segments = projective_segments(lines, frame, unit)
    model = camera_model("projective")
    return SeenLines(model, rows, scene.Q, segments, frame.scale, lines.n_lines)


def triangulate_lines(
    lines: LineTracks,
    reconstruction: MetricReconstruction | Reconstruction,
    backend: str | None = None,
) -> Array:
    """Return the lines that segments are images of, cameras being known.

    Each segment and its camera's centre span a plane; the line nearest to all planes of a line is
    refined to the least squared distances of the end points from its images. Of four segments and
    more, those that disagree with most of the others are left out.

    Parameters
    ----------
    lines : LineTracks
        Measured segments.
    reconstruction : MetricReconstruction or Reconstruction
        The cameras; the points say where in space computing suits best.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.

    Returns
    -------
    ndarray, shape (L, 6)
        Pluecker coordinates (n, v): v the unit direction, n = X x v for every point X of the line.
        With projective cameras the whole row has length one.

    Raises
    ------
    ArgumentError
        If lines are not determined, by their numbers: all planes are one within the noise, as of a
        line in the plane of two centres (an epipolar plane), or the line is infinitely far from
        calibrated cameras. If half of a line's segments are far from any one line.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.line_scene(seed=1)
    >>> eg.triangulate_lines(scene.line_tracks, scene.true).shape
    (60, 6)
    """
    table = kernels.table(backend)
    seen = seen_lines("reconstruction", lines, reconstruction)
    found, deviations = triangulated(seen, table)
    bad = np.flatnonzero(~(deviations <= OPEN))
    if len(bad):
        named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        was = f"have {len(bad)} lines that their views do not determine: {named}"
        needed = "lines off the plane of the centres that see them (epipolar plane), not too far"
        raise ArgumentError("lines", was, needed)
    refuse_absurd("lines", seen, found, table)
    return found


def refuse_absurd(name: str, seen: SeenLines, lines: Array, table: Table) -> None:
    """Refuse lines that half of their segments are absurdly far from, beside what is usual.

    Raises
    ------
    ArgumentError
        Naming the lines.
    """
    segments, line = seen.segments, seen.segments.line
    sizes = lengths(seen.linearizer(table), seen.cameras, lines)
    distances = sizes * np.sqrt(segments.spread[[0, 2, 3, 5]].mean(axis=0))
    extent = float(np.ptp(segments.ends.reshape(2, 2, -1), axis=(0, 2)).max())
    far = (sizes > _ABSURD * usual(sizes)) & (distances > _FAR * extent)
    half = 2 * np.bincount(line, far, minlength=seen.n_lines) >= np.bincount(line)
    bad = np.flatnonzero(half)
    if len(bad):
        named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        verb = "has" if name == "start" else "have"
        was = f"{verb} {len(bad)} lines that half of their segments are far from: {named}"
        raise ArgumentError(name, was, "segments of one line each, and no start far from them")


def triangulated(seen: SeenLines, table: Table) -> tuple[Array, Array]:
    """Return lines (L, 6), and the largest standard deviation of each one's update, (L,)."""
    home, cameras, _ = best_conditioned(seen.model, seen.cameras, seen.points)
    planes = _planes(seen.segments, cameras)
    with np.errstate(all="ignore"):
        nearest = _nearest(planes, seen.segments.line, seen.n_lines)
        first = sized_lines(nearest, seen.model)
    bad = ~np.isfinite(first).all(axis=1)
    first[bad] = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    linearizer = seen.linearizer(table)
    refined, _ = linearizer.refine_points(cameras, first, REFINEMENT_METRIC)
    agree, refined = agreeing(linearizer, planes, cameras, refined)
    if not agree.all():
        linearizer = replace(linearizer, weights=agree.astype(np.float64))
        refined, _ = linearizer.refine_points(cameras, refined, REFINEMENT_METRIC)
    J = linearizer.observe(cameras, refined)[2] * agree
    deviations = spreads(linearizer.graph.sum_points(np.einsum("ikn,iln->nkl", J, J)))
    deviations[bad | ~np.isfinite(refined).all(axis=1)] = np.inf
    return linearizer.carried(home.inverse(), refined), deviations / seen.scale_px


def spreads(V: Array) -> Array:
    """Return the largest standard deviation that blocks (L, 4, 4) leave; it may be infinite."""
    finite = np.all(np.isfinite(V), axis=(1, 2), keepdims=True)
    values = np.linalg.eigvalsh(np.where(finite, V, 0.0))
    least = np.where(values[:, 0] > ROUNDING * values[:, -1], values[:, 0], 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(least))


def _planes(segments: Segments, cameras: Array) -> Array:
    """Return the planes of segments and centres, their normals of length one, (N, 4).

    In a projective basis, where a plane may be infinitely far, the planes themselves are.
    """
    rows = segments.cameras(cameras).T
    x1, y1, x2, y2 = segments.ends
    ones, k = np.ones(len(rows)), rows[:, 12:]
    if k.shape[1]:
        fx, fy = k[:, 0], k[:, 1] if k.shape[1] == 4 else k[:, 0]
        cx, cy = k[:, -2], k[:, -1]
        x1, y1, x2, y2 = (x1 - cx) / fx, (y1 - cy) / fy, (x2 - cx) / fx, (y2 - cy) / fy
    image = np.cross(np.stack([x1, y1, ones], axis=1), np.stack([x2, y2, ones], axis=1))
    planes = np.einsum("nij,ni->nj", rows[:, :12].reshape(-1, 3, 4), image)
    # The normal of a plane has the direction of space; the scene has the size of about one.
    size = planes[:, :3] if k.shape[1] else planes
    return np.asarray(planes / np.linalg.norm(size, axis=1, keepdims=True))


def _nearest(planes: Array, line: Indices, count: int) -> Array:
    """Return the lines of least algebraic distance to their planes, (L, 6)."""
    first = np.searchsorted(line, np.arange(count))
    gram = np.add.reduceat(planes[:, :, None] * planes[:, None, :], first, axis=0)
    axes = np.linalg.eigh(gram)[1]
    return meets(axes[:, :, 2], axes[:, :, 3])
