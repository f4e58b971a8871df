"""Lines from segments in calibrated views whose cameras are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.bundle.lines import LineLinearizer, Segments, unit_lines
from epigauge.bundle.run import REFINEMENT_METRIC
from epigauge.bundle.similarity import normal_frame
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.line_agreement import agreeing, lengths, meets, usual
from epigauge.multi_view.line_segments import segments_of
from epigauge.multi_view.line_tracks import LineTracks

__all__ = [
    "OPEN",
    "ROUNDING",
    "checked_scene",
    "refuse_absurd",
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


def triangulate_lines(
    lines: LineTracks, reconstruction: MetricReconstruction, backend: str | None = None
) -> Array:
    """Return the lines that segments are images of, cameras being known.

    Each segment and its camera's centre span a plane; the line nearest to all planes of a line is
    refined to the least squared distances of the end points from its images. Of four segments and
    more, those that disagree with most of the others are left out.

    Parameters
    ----------
    lines : LineTracks
        Measured segments.
    reconstruction : MetricReconstruction
        The cameras.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.

    Returns
    -------
    ndarray, shape (L, 6)
        Pluecker coordinates (n, v): v the unit direction, n = X x v for every point X of the line.

    Raises
    ------
    ArgumentError
        If lines are not determined, by their numbers: all planes are one within the noise, as of a
        line in the plane of two centres (an epipolar plane), or the line is infinitely far. If
        half of a line's segments are far from any one line.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.line_scene(seed=1)
    >>> eg.triangulate_lines(scene.line_tracks, scene.true).shape
    (60, 6)
    """
    checked_scene("reconstruction", reconstruction)
    table = kernels.table(backend)
    found, deviations = triangulated(lines, reconstruction, table)
    bad = np.flatnonzero(~(deviations <= OPEN))
    if len(bad):
        named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        was = f"have {len(bad)} lines that their views do not determine: {named}"
        needed = "lines off the plane of the centres that see them (epipolar plane), not too far"
        raise ArgumentError("lines", was, needed)
    refuse_absurd("lines", lines, reconstruction, found, table)
    return found


def refuse_absurd(
    name: str, tracks: LineTracks, scene: MetricReconstruction, lines: Array, table: Table
) -> None:
    """Refuse lines that half of their segments are absurdly far from, beside what is usual.

    Raises
    ------
    ArgumentError
        Naming the lines.
    """
    segments = segments_of(tracks, scene)
    model, count = camera_model(scene.cameras.model), (scene.n_views, tracks.n_lines)
    linearizer = LineLinearizer.of(segments, model, table, count)
    sizes = lengths(linearizer, scene.vectors, lines)
    pixels = sizes * np.sqrt(segments.spread[[0, 2, 3, 5]].mean(axis=0))
    extent = float(np.ptp(segments.ends.reshape(2, 2, -1), axis=(0, 2)).max())
    far = (sizes > _ABSURD * usual(sizes)) & (pixels > _FAR * extent)
    half = 2 * np.bincount(tracks.line, far, minlength=count[1]) >= np.bincount(tracks.line)
    bad = np.flatnonzero(half)
    if len(bad):
        named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        verb = "has" if name == "start" else "have"
        was = f"{verb} {len(bad)} lines that half of their segments are far from: {named}"
        raise ArgumentError(name, was, "segments of one line each, and no start far from them")


def checked_scene(name: str, scene: Any) -> None:
    """Check that an argument is a scene of calibrated cameras."""
    if not isinstance(scene, MetricReconstruction):
        was = f"is a {type(scene).__name__}"
        raise ArgumentError(name, was, "an eg.MetricReconstruction, as lines need")


def triangulated(
    lines: LineTracks, reconstruction: MetricReconstruction, table: Table
) -> tuple[Array, Array]:
    """Return lines (L, 6), and the largest standard deviation of each one's update, (L,)."""
    segments = segments_of(lines, reconstruction)
    home = normal_frame(reconstruction.vectors, reconstruction.X)
    cameras, _ = home.apply(reconstruction.vectors, reconstruction.X)
    planes = _planes(segments, cameras)
    first = unit_lines(_nearest(planes, segments.line, lines.n_lines))
    bad = ~np.isfinite(first).all(axis=1)
    first[bad] = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    model, sizes = camera_model(reconstruction.cameras.model), (len(cameras), lines.n_lines)
    linearizer = LineLinearizer.of(segments, model, table, sizes)
    refined, _ = linearizer.refine_points(cameras, first, REFINEMENT_METRIC)
    agree, refined = agreeing(linearizer, planes, cameras, refined)
    if not agree.all():
        linearizer = replace(linearizer, weights=agree.astype(np.float64))
        refined, _ = linearizer.refine_points(cameras, refined, REFINEMENT_METRIC)
    J = linearizer.observe(cameras, refined)[2] * agree
    deviations = spreads(linearizer.graph.sum_points(np.einsum("ikn,iln->nkl", J, J)))
    deviations[bad | ~np.isfinite(refined).all(axis=1)] = np.inf
    return home.inverse().lines(refined), deviations


def spreads(V: Array) -> Array:
    """Return the largest standard deviation that blocks (L, 4, 4) leave; it may be infinite."""
    finite = np.all(np.isfinite(V), axis=(1, 2), keepdims=True)
    values = np.linalg.eigvalsh(np.where(finite, V, 0.0))
    least = np.where(values[:, 0] > ROUNDING * values[:, -1], values[:, 0], 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(least))


def _planes(segments: Segments, cameras: Array) -> Array:
    """Return the planes of segments and centres, their normals of length one, (N, 4)."""
    rows = segments.cameras(cameras).T
    pose = rows[:, :12].reshape(-1, 3, 4)
    k = rows[:, 12:]
    fx, fy = k[:, 0], k[:, 1] if k.shape[1] == 4 else k[:, 0]
    cx, cy = k[:, -2], k[:, -1]
    x1, y1, x2, y2 = segments.ends
    ones = np.ones(len(rows))
    a = np.stack([(x1 - cx) / fx, (y1 - cy) / fy, ones], axis=1)
    b = np.stack([(x2 - cx) / fx, (y2 - cy) / fy, ones], axis=1)
    normal = np.cross(a, b)
    planes = np.einsum("nij,ni->nj", pose, normal)
    # The normal of a plane has the direction of space; the scene has the size of about one.
    return np.asarray(planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True))


def _nearest(planes: Array, line: Indices, count: int) -> Array:
    """Return the lines of least algebraic distance to their planes, (L, 6)."""
    first = np.searchsorted(line, np.arange(count))
    gram = np.add.reduceat(planes[:, :, None] * planes[:, None, :], first, axis=0)
    axes = np.linalg.eigh(gram)[1]
    return meets(axes[:, :, 2], axes[:, :, 3])
