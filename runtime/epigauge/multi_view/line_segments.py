"""Measured segments as the engine takes them: end points of cameras with distortion without it."""

from __future__ import annotations

from typing import Any

import numpy as np
from epigauge_generated.signatures import SIGNATURES
from numpy.typing import NDArray

from epigauge.bundle.lines import Segments
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.line_tracks import LineTracks

__all__ = ["checked_lines", "frame_of", "line_pieces", "projective_segments", "segments_of"]

Array = NDArray[np.float64]

#: A line of sight along the line meets it nowhere in particular.
_PARALLEL = 1e-6


def checked_lines(lines: Any, n_views: int) -> LineTracks:
    """Return lines of so many views.

    Raises
    ------
    ArgumentError
        If they are none, or name other views.
    """
    if not isinstance(lines, LineTracks):
        raise ArgumentError("lines", f"is a {type(lines).__name__}", "eg.LineTracks(...)")
    if lines.view.max() >= n_views:
        was = f"name view {lines.view.max()}"
        raise ArgumentError("lines", was, f"views 0 to {n_views - 1}")
    return lines


def projective_segments(lines: LineTracks, frame: Frame, unit: float = 1.0) -> Segments:
    """Return segments as projective cameras see them, in the image coordinates of a frame.

    The covariances stay those of pixels: residuals are in the unit of the frame, as those of
    points are.
    """
    ends = [frame.points_in(lines.segments[:, k : k + 2], lines.view) for k in (0, 2)]
    spread = _whole(lines.spread.T / unit**2)
    return Segments(lines.view, lines.line, np.concatenate(ends), spread, "projective")


def frame_of(lines: LineTracks, n_views: int) -> Frame:
    """Return image coordinates to compute in, where there are no points."""
    middles = 0.5 * (lines.segments[:, :2] + lines.segments[:, 2:])
    counts = np.maximum(np.bincount(lines.view, minlength=n_views), 1)
    sums = [np.bincount(lines.view, middles[:, k], minlength=n_views) / counts for k in (0, 1)]
    origins = np.stack(sums, axis=1)
    off = lines.segments.reshape(-1, 2, 2) - origins[lines.view][:, None]
    return Frame(origins, float(np.sqrt(np.mean(off**2))))


def segments_of(
    lines: LineTracks, reconstruction: MetricReconstruction, unit: float = 1.0
) -> Segments:
    """Return segments as the engine takes them: end points of cameras with distortion without it.

    Their covariances go along to first order.

    Raises
    ------
    ArgumentError
        If a view has no camera, or an end point no direction in its camera.
    """
    lines = checked_lines(lines, reconstruction.n_views)
    model = camera_model(reconstruction.cameras.model)
    ends, spread, prefix = lines.segments.T, lines.spread.T / unit**2, model.prefix
    if f"{prefix}_line_residual" in SIGNATURES:
        return Segments(lines.view, lines.line, _whole(ends), _whole(spread), prefix)
    K = reconstruction._calibrations()
    params = reconstruction.cameras.of_views[lines.view].T
    moved, covariances = ends.copy(), spread.copy()
    for k in (0, 1):
        straight, D = model.directions(ends[2 * k : 2 * k + 2], params)
        own, missed = K[lines.view], ~np.isfinite(straight).all(axis=0)
        if missed.any():
            was = f"have an end point in row {lines.order[int(np.argmax(missed))]} that the camera"
            needed = "end points inside of the image"
            raise ArgumentError("lines", f"{was} {model.name} sees in no direction", needed)
        moved[2 * k] = own[:, 0, 0] * straight[0] + own[:, 0, 2]
        moved[2 * k + 1] = own[:, 1, 1] * straight[1] + own[:, 1, 2]
        xx, xy, yy = spread[3 * k : 3 * k + 3]
        S = np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1)
        D = own[:, :2, :2] @ D
        S = D @ S @ np.swapaxes(D, 1, 2)
        covariances[3 * k : 3 * k + 3] = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    intrinsics = np.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], axis=1)
    return Segments(lines.view, lines.line, moved, covariances, "pinhole", intrinsics)


def _whole(array: Array) -> Array:
    return np.ascontiguousarray(array)


def line_pieces(lines: LineTracks, reconstruction: MetricReconstruction) -> Array:
    """Return the ends of the piece of each line that its segments show, (L, 2, 3).

    From each end point's line of sight the nearest place on the line is taken; of the places of all
    views the middle half of the views decides where the piece begins and ends.
    """
    if not isinstance(reconstruction, MetricReconstruction):
        was = f"is a {type(reconstruction).__name__}, in which pieces have no place"
        raise ArgumentError("reconstruction", was, "an eg.MetricReconstruction: eg.metric_upgrade")
    segments = segments_of(lines, reconstruction)
    if reconstruction.lines is None or len(reconstruction.lines) != lines.n_lines:
        count = 0 if reconstruction.lines is None else len(reconstruction.lines)
        raise ArgumentError("reconstruction", f"has {count} lines", f"{lines.n_lines}")
    K = reconstruction._calibrations()[segments.view]
    R, centres = reconstruction.R[segments.view], reconstruction.centres[segments.view]
    n, v = reconstruction.lines[segments.line, :3], reconstruction.lines[segments.line, 3:]
    # The place of the line that is nearest to each centre, as seen from there.
    foot = np.cross(v, n - np.cross(centres, v))
    places = np.empty((2, len(lines)))
    for k in (0, 1):
        xy = np.concatenate([segments.ends[2 * k : 2 * k + 2].T, np.ones((len(lines), 1))], axis=1)
        d = np.einsum("nji,nj->ni", R, np.linalg.solve(K, xy[:, :, None])[:, :, 0])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        along = np.sum(d * v, axis=1)
        across = np.maximum(1.0 - along**2, _PARALLEL)
        places[k] = along * np.sum(d * foot, axis=1) / across
    # From the foot of each centre to one origin of the line.
    first = np.searchsorted(segments.line, np.arange(lines.n_lines + 1))
    origin = np.cross(v, n)
    places += np.sum((centres + foot - origin) * v, axis=1)
    low, high = np.sort(places, axis=0)
    found = np.empty((lines.n_lines, 2, 3))
    for j, (begin, end) in enumerate(zip(first[:-1], first[1:], strict=True)):
        s = np.quantile(low[begin:end], 0.25), np.quantile(high[begin:end], 0.75)
        found[j] = origin[begin] + np.multiply.outer(s, v[begin])
    return found
