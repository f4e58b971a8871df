"""What is to be minimised and from where, by the kind of the start."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import FeatureKind
from epigauge.bundle.prior_kinds import Prior, listed_priors
from epigauge.bundle.priors import Priors
from epigauge.bundle.refinement import fixed_indices, refined_freedom, whole_freedom
from epigauge.cameras import (
    AffineReconstruction,
    AnyReconstruction,
    CameraModel,
    Cameras,
    MetricReconstruction,
    camera_model,
)
from epigauge.errors import ArgumentError
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

__all__ = ["Job", "job_of", "metric_job"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Numbers of (R | t) before the intrinsics of a camera.
_POSE = 12


@dataclass(frozen=True)
class Job:
    """A minimisation in the rows of the engine.

    Attributes
    ----------
    model : CameraModel
        The camera.
    q : ndarray, shape (2, N)
        Measurements, in the unit that is computed in.
    scale_px : float
        That unit, in pixels.
    cameras, points : ndarray, shape (n, c), (m, b)
        The start.
    result : callable
        Makes a reconstruction of cameras and points.
    freedom : Freedom
        What the caller leaves free.
    priors : Priors or None
        What is known beside the images.
    fixes_gauge : bool
        Whether something fixed or known ties the reconstruction to its frame.
    whitening : ndarray, shape (2, 2, N), or None
        What residuals are multiplied by, where their coordinates are not measured alike.
    kinds : tuple of FeatureKind
        Features of other kinds than points.
    others : tuple of ndarray
        Where they start.
    """

    model: CameraModel
    q: Array
    scale_px: float
    cameras: Array
    points: Array
    result: Callable[[Array, Array], AnyReconstruction]
    freedom: Freedom = field(default_factory=Freedom)
    priors: Priors | None = None
    fixes_gauge: bool = False
    whitening: Array | None = None
    kinds: tuple[FeatureKind, ...] = ()
    others: tuple[Array, ...] = ()


def job_of(
    tracks: Tracks,
    start: AnyReconstruction,
    *,
    refine: Any,
    fixed_views: Iterable[int],
    fixed_points: Iterable[int],
    priors: Iterable[Prior] | None,
    noise_px: float,
) -> Job:
    """Return the job of a start of any kind.

    Raises
    ------
    ArgumentError
        On anything that is no start, sizes other than the tracks', unknown parameters, priors on
        what is fixed, or nothing left to refine.
    """
    if isinstance(start, MetricReconstruction):
        return metric_job(
            tracks,
            start,
            refine=refine,
            fixed_views=fixed_views,
            fixed_points=fixed_points,
            priors=priors,
            noise_px=noise_px,
        )
    if not isinstance(start, Reconstruction | AffineReconstruction):
        kinds = "an eg.Reconstruction, eg.AffineReconstruction or eg.MetricReconstruction"
        raise ArgumentError("start", f"is a {type(start).__name__}", kinds)
    return uncalibrated_job(
        tracks,
        start,
        refine=refine,
        fixed_views=fixed_views,
        fixed_points=fixed_points,
        priors=priors,
    )


def uncalibrated_job(
    tracks: Tracks,
    start: Reconstruction | AffineReconstruction,
    *,
    refine: Any,
    fixed_views: Iterable[int],
    fixed_points: Iterable[int],
    priors: Iterable[Prior] | None,
) -> Job:
    """Return the job of a projective or affine start, in conditioned image coordinates.

    Raises
    ------
    ArgumentError
        If the start has another size than the tracks, nothing is left to refine, or options of
        metric starts are given.
    """
    affine = isinstance(start, AffineReconstruction)
    kind = "an affine" if affine else "a projective"
    if not (isinstance(refine, str) and refine == "all"):
        was = f"is {refine!r:.60} with {kind} start, whose cameras are refined as a whole"
        raise ArgumentError("refine", was, "'all', or fixed_views; or a metric start")
    if priors is not None and len(list(priors)):
        needed = "none, or a metric start: eg.MetricReconstruction"
        raise ArgumentError("priors", f"are given with {kind} start, which has no unit", needed)
    points = start.X if isinstance(start, AffineReconstruction) else start.Q
    _check_size(tracks, len(start.P), len(points), "cameras")
    views = fixed_indices("fixed_views", fixed_views, tracks.n_views)
    held = fixed_indices("fixed_points", fixed_points, tracks.n_points)
    if len(views) == tracks.n_views and len(held) == tracks.n_points:
        raise ArgumentError("fixed_views", "and fixed_points leave nothing to refine", "an unknown")
    frame, model = Frame.of(tracks), camera_model("affine" if affine else "projective")

    def measured(xy: Array) -> Array:
        return frame.points_in(xy, tracks.view)

    # Copies: results are made of them whenever one is judged, and the start may change meanwhile.
    fixed = start.P[views], points[held]

    def result(cameras: Array, found: Array) -> AnyReconstruction:
        P, found = frame.cameras_out(cameras.reshape(-1, 3, 4)), found.copy()
        # What was fixed comes back as it was, to the last bit.
        P[views], found[held] = fixed
        return AffineReconstruction(P[:, :2], found) if affine else Reconstruction(P, found)

    rows = frame.cameras_in(start.P).reshape(-1, _POSE)
    return Job(
        model,
        _trusted(tracks, start, measured),
        frame.scale,
        rows,
        points,
        result,
        whole_freedom(model, len(rows), len(points), views, held),
        None,
        bool(len(views) + len(held)),
        tracks.whitening,
    )


def metric_job(
    tracks: Tracks,
    start: MetricReconstruction,
    *,
    refine: Any,
    fixed_views: Iterable[int],
    fixed_points: Iterable[int],
    priors: Iterable[Prior] | None,
    noise_px: float = 1.0,
) -> Job:
    """Return the job of a metric start, in pixels.

    Raises
    ------
    ArgumentError
        On sizes other than the tracks', unknown parameters, priors on what is fixed, or nothing
        left to refine.
    """
    _check_size(tracks, start.n_views, start.n_points, "views")
    views = fixed_indices("fixed_views", fixed_views, start.n_views)
    points = fixed_indices("fixed_points", fixed_points, start.n_points)
    listed = listed_priors(priors or ())
    known = Priors.of(listed, start).weighted(noise_px**2)

    def result(cameras: Array, X: Array) -> MetricReconstruction:
        # What was fixed comes back as it was, to the last bit.
        cameras, X = cameras.copy(), X.copy()
        cameras[views, :_POSE], X[points] = start.vectors[views, :_POSE], start.X[points]
        try:
            return _reconstruction(start.cameras, cameras, X)
        except ArgumentError as error:  # no step has bounds beside those of focal lengths
            was = f"leads to cameras or points that are none: {error.argument} {error.was}"
            raise ArgumentError(
                "start", was, "another one, or fewer parameters to refine"
            ) from None

    return Job(
        camera_model(start.cameras.model),
        _trusted(tracks, start, lambda xy: np.ascontiguousarray(xy.T)),
        1.0,
        start.vectors,
        start.X,
        result,
        refined_freedom(start, refine, views, points, listed),
        known if len(known) else None,
        bool(len(views) + len(points) + len(known) - len(known.cameras)),
        tracks.whitening,
    )


def _reconstruction(like: Cameras, cameras: Array, X: Array) -> MetricReconstruction:
    pose = cameras[:, :_POSE].reshape(-1, 3, 4)
    first = np.unique(like.camera_of_view, return_index=True)[1]
    made = Cameras(like.model, cameras[first, _POSE:], like.camera_of_view)
    return MetricReconstruction(pose[:, :, :3], pose[:, :, 3], X, made)


def _check_size(tracks: Tracks, n: int, m: int, what: str) -> None:
    if (n, m) != (tracks.n_views, tracks.n_points):
        needed = f"{tracks.n_views} and {tracks.n_points}, as the tracks"
        raise ArgumentError("start", f"has {n} {what} and {m} points", needed)


def _trusted(
    tracks: Tracks,
    start: AnyReconstruction,
    measured: Callable[[Array], Array],
) -> Array:
    """Return the measurements (2, N); those of weight zero where the start has them.

    The least weight that keeps the equations regular (`linearizer.LEAST_WEIGHT`) must not draw
    towards anything, however wrong.
    """
    q, off = measured(tracks.xy), tracks.weights == 0.0
    if off.any():
        predicted = measured(start.project(tracks))[:, off]
        q[:, off] = np.where(np.isfinite(predicted), predicted, 0.0)
    return q
