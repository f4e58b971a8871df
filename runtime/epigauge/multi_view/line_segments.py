"""Measured segments as the engine takes them: end points of cameras with distortion without it."""

from __future__ import annotations

from typing import Any

import numpy as np
from epigauge_generated.signatures import SIGNATURES
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.bundle.lines import Segments
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.reconstruction import Reconstruction

__all__ = ["checked_lines", "frame_of", "line_pieces", "projective_segments", "segments_of"]

Array = NDArray[np.float64]


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


def line_pieces(lines: LineTracks, reconstruction: MetricReconstruction | Reconstruction) -> Array:
    """Return the ends of the piece of each line that its segments show, (L, 2, 3) or (L, 2, 4).

    An end point stands for the place of the line whose image is nearest to it. In the view with the
    longest segment of a line, the middle half of the places of all views decides where the piece
    begins and ends: images decide, so that no basis has a part in it. In a projective basis places
    are homogeneous, as its points are.
    """
    if not isinstance(reconstruction, MetricReconstruction | Reconstruction):
        was = f"is a {type(reconstruction).__name__}"
        raise ArgumentError("reconstruction", was, "a metric or projective one, with lines")
    checked_lines(lines, len(reconstruction.P))
    ends = lines.segments.T
    if isinstance(reconstruction, MetricReconstruction):
        ends = segments_of(lines, reconstruction).ends
    if reconstruction.lines is None or len(reconstruction.lines) != lines.n_lines:
        count = 0 if reconstruction.lines is None else len(reconstruction.lines)
        raise ArgumentError("reconstruction", f"has {count} lines", f"{lines.n_lines}")
    P, L = reconstruction.P[lines.view], reconstruction.lines[lines.line]
    along = kernels.table("numpy").line_project(P.transpose(1, 2, 0), L.T)[1::-1].T * [1.0, -1.0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.searchsorted(lines.line, np.arange(lines.n_lines + 1))
    spans = np.sum((ends[2:] - ends[:2]) ** 2, axis=0)
    longest = np.array([a + np.argmax(spans[a:b]) for a, b in zip(first, first[1:], strict=False)])
    there, axis = P[longest[lines.line]], along[longest[lines.line]]
    places = np.empty((2, len(lines)))
    with np.errstate(all="ignore"):
        for k in (0, 1):
            s = np.sum(along * ends[2 * k : 2 * k + 2].T, axis=1)
            h = np.einsum("nij,nj->ni", there, _places(P, L, along, s))
            seen = np.sum(axis * h[:, :2], axis=1) / h[:, 2]
            places[k] = np.where(np.isfinite(seen), seen, np.nan)
    low, high = np.sort(places, axis=0)
    found = np.empty((lines.n_lines, 2, 4))
    at = P[longest], reconstruction.lines, along[longest]
    for k, (side, share) in enumerate(((low, 0.25), (high, 0.75))):
        s = [np.nanquantile(side[a:b], share) for a, b in zip(first, first[1:], strict=False)]
        found[:, k] = _places(*at, np.array(s))
    if isinstance(reconstruction, MetricReconstruction):
        return np.asarray(found[..., :3] / found[..., 3:])
    return np.asarray(found / np.linalg.norm(found, axis=2, keepdims=True))


def _places(P: Array, L: Array, along: Array, s: Array) -> Array:
    """Return where the planes of the lines u . (x, y) = s of images meet lines, (N, 4).

    The plane (a, b) and the line (n, v) meet in (a x n - b v, a . v).
    """
    plane = np.einsum("nij,ni->nj", P, np.column_stack([along, -s]))
    a, b, n, v = plane[:, :3], plane[:, 3:], L[:, :3], L[:, 3:]
    return np.column_stack([np.cross(a, n) - b * v, np.sum(a * v, axis=1)])
