"""Lines in calibrated views: triangulated, and adjusted together with points and cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from epigauge_generated.signatures import SIGNATURES
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge._arguments import as_choice, as_positive
from epigauge.bundle.dampings import DAMPINGS, LAM_FLOOR_METRIC, Covariant
from epigauge.bundle.jobs import Job, metric_job
from epigauge.bundle.lines import (
    FeatureLinearizer,
    FeatureProblem,
    Segments,
    feature_freedom,
    features_of,
    joint_graph,
    unit_lines,
)
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleState, Estimate
from epigauge.bundle.run import REFINEMENT_METRIC
from epigauge.bundle.similarity import Similarity, normal_frame
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.front import BEHIND
from epigauge.multi_view.verdicts.gross import gross_flags
from epigauge.two_view.losses import EFFICIENT, Loss, median, robust_scale
from epigauge.verdicts import ordered

__all__ = ["Adjusted", "LineJob", "adjusted_lines", "segments_of", "triangulate_lines"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A line is open whose update is uncertain by more than this: radians, or shares of its distance.
_OPEN = 0.3

#: Methods that leave all parameters free, as lines need.
METHODS = ("covariant", "levenberg", "marquardt")

#: Newton steps to a direction without distortion, and pixels that it may be off.
_STEPS, _MISSED = 30, 1e-6

#: An eigenvalue of the reduced system, where its diagonal is one, that is rounding.
_ROUNDING = 1e-11


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
    if not isinstance(lines, LineTracks):
        raise ArgumentError("lines", f"is a {type(lines).__name__}", "eg.LineTracks(...)")
    if lines.view.max() >= reconstruction.n_views:
        was = f"name view {lines.view.max()}"
        raise ArgumentError("lines", was, f"views 0 to {reconstruction.n_views - 1}")
    model = camera_model(reconstruction.cameras.model)
    ends, spread, prefix = lines.segments.T, lines.spread.T / unit**2, model.prefix
    if f"{prefix}_line_residual" in SIGNATURES:
        return Segments(lines.view, lines.line, _whole(ends), _whole(spread), prefix)
    K = reconstruction._calibrations()
    params = reconstruction.cameras.of_views[lines.view].T
    moved, covariances = ends.copy(), spread.copy()
    for k in (0, 1):
        straight, D = _undistorted(model.kernel("image"), ends[2 * k : 2 * k + 2], params)
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


def _undistorted(image: Any, q: Array, params: Array) -> tuple[Array, Array]:
    """Return h0/h2, h1/h2 of pixels (2, N), NaN where there is none, and their derivatives."""
    h = np.zeros((3, q.shape[1]))
    h[2] = 1.0
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            found, slope = image(h, params)
            a = slope[:, :2].transpose(2, 0, 1)
            inverse = _inverses(a)
            h[:2] -= np.einsum("nij,jn->in", inverse, found - q)
        found, slope = image(h, params)
        off = np.abs(found - q).max(axis=0)
        h[:2, ~(off <= _MISSED * np.maximum(1.0, np.abs(q).max(axis=0)))] = np.nan
        return h[:2], _inverses(slope[:, :2].transpose(2, 0, 1))


def _inverses(a: Array) -> Array:
    """Return inverses of 2x2 matrices, not finite where there are none."""
    determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    adjoint = np.array([[a[:, 1, 1], -a[:, 0, 1]], [-a[:, 1, 0], a[:, 0, 0]]]).transpose(2, 0, 1)
    return np.asarray(adjoint / determinant[:, None, None])


def triangulate_lines(
    lines: LineTracks, reconstruction: MetricReconstruction, backend: str | None = None
) -> Array:
    """Return the lines that segments are images of, cameras being known.

    Each segment and its camera's centre span a plane; the line nearest to all planes of a line is
    refined to the least squared distances of the end points from its images.

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
        line in the plane of two centres (an epipolar plane), or the line is infinitely far.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.line_scene(seed=1)
    >>> eg.triangulate_lines(scene.line_tracks, scene.true).shape
    (60, 6)
    """
    _metric("reconstruction", reconstruction)
    found, deviations = _triangulated(lines, reconstruction, kernels.table(backend))
    bad = np.flatnonzero(~(deviations <= _OPEN))
    if len(bad):
        named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        was = f"have {len(bad)} lines that their views do not determine: {named}"
        needed = "lines off the plane of the centres that see them (epipolar plane), not too far"
        raise ArgumentError("lines", was, needed)
    return found


def _metric(name: str, scene: Any) -> None:
    if not isinstance(scene, MetricReconstruction):
        was = f"is a {type(scene).__name__}"
        raise ArgumentError(name, was, "an eg.MetricReconstruction, as lines need")


def _triangulated(
    lines: LineTracks, reconstruction: MetricReconstruction, table: Table
) -> tuple[Array, Array]:
    """Return lines (L, 6), and the largest standard deviation of each one's update, (L,)."""
    segments = segments_of(lines, reconstruction)
    home = normal_frame(reconstruction.vectors, reconstruction.X)
    cameras, _ = home.apply(reconstruction.vectors, reconstruction.X)
    first = unit_lines(_nearest(segments, cameras, lines.n_lines))
    bad = ~np.isfinite(first).all(axis=1)
    first[bad] = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    # No points: an empty part of the features.
    alone = ObservationGraph(segments.view, segments.line, len(cameras), lines.n_lines)
    model = camera_model(reconstruction.cameras.model)
    linearizer = FeatureLinearizer(
        model,
        table,
        alone,
        np.zeros((2, 0)),
        np.ones(len(lines)),
        Loss(),
        segments=segments,
        n_points=0,
    )
    refined, _ = linearizer.refine_points(cameras, first, REFINEMENT_METRIC)
    J = linearizer.observe(cameras, refined)[2]
    deviations = _deviations(alone.sum_points(np.einsum("ikn,iln->nkl", J, J)))
    deviations[bad | ~np.isfinite(refined).all(axis=1)] = np.inf
    return home.inverse().lines(refined), deviations


def _deviations(V: Array) -> Array:
    """Return the largest standard deviation that blocks (L, 4, 4) leave; it may be infinite."""
    finite = np.all(np.isfinite(V), axis=(1, 2), keepdims=True)
    values = np.linalg.eigvalsh(np.where(finite, V, 0.0))
    least = np.where(values[:, 0] > _ROUNDING * values[:, -1], values[:, 0], 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(least))


def _nearest(segments: Segments, cameras: Array, count: int) -> Array:
    """Return the lines of least algebraic distance to the planes of their segments, (L, 6)."""
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
    planes /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    first = np.searchsorted(segments.line, np.arange(count))
    gram = np.add.reduceat(planes[:, :, None] * planes[:, None, :], first, axis=0)
    axes = np.linalg.eigh(gram)[1]
    A, B = axes[:, :, 2], axes[:, :, 3]
    # The planes A and B meet in the direction of both normals' product.
    v = np.cross(A[:, :3], B[:, :3])
    n = A[:, 3:] * B[:, :3] - B[:, 3:] * A[:, :3]
    with np.errstate(all="ignore"):
        rows = np.concatenate([n, v], axis=1) / np.linalg.norm(v, axis=1, keepdims=True)
        return np.asarray(rows)


class LineJob(NamedTuple):
    """A problem of points and lines about the origin, and the way back."""

    job: Job
    problem: FeatureProblem
    start: Estimate
    home: Similarity


class Adjusted(NamedTuple):
    """What an adjustment of points and lines found."""

    reconstruction: MetricReconstruction
    outcome: lm.Outcome[BundleState]
    fun: Array
    line_fun: Array
    flags: tuple[str, ...]
    rank: int
    n_behind: int
    condition: float
    loss_scale_px: float


def line_job(
    tracks: Tracks,
    start: MetricReconstruction,
    lines: LineTracks,
    table: Table,
    loss: str = "linear",
    loss_scale_px: float | str = "auto",
    *,
    refine: str | Sequence[str] = "all",
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    embedded: bool = True,
) -> tuple[LineJob, float]:
    """Return the problem of points and lines, and the scale of the loss in pixels."""
    _metric("start", start)
    segments = segments_of(lines, start, tracks.unit)
    if segments.intrinsics is not None and refine != "pose":
        was = f"is {refine!r} with lines in {start.cameras.model} cameras, which bend lines"
        raise ArgumentError("refine", was, "'pose': end points are undistorted once")
    job = metric_job(
        tracks,
        start,
        refine=refine,
        fixed_views=fixed_views,
        fixed_points=fixed_points,
        priors=None,
    )
    first = _first_lines(lines, start, table)
    home = normal_frame(job.cameras, job.points)
    cameras, points = home.apply(job.cameras, job.points)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    whitening = job.whitening
    if whitening is not None:
        more = np.repeat(np.eye(2)[:, :, None], len(lines), axis=2)
        whitening = np.concatenate([whitening, more], axis=2)
    linearizer = FeatureLinearizer(
        job.model,
        table,
        joint_graph(graph, segments, lines.n_lines),
        job.q,
        np.concatenate([tracks.weights, np.ones(len(lines))]),
        Loss(),
        whitening,
        segments=segments,
        n_points=tracks.n_points,
    )
    features = features_of(points, home.lines(first))
    scale = 0.0
    if loss != "linear":
        if loss_scale_px != "auto":
            scale = as_positive("loss_scale_px", loss_scale_px)
        else:
            sizes = np.linalg.norm(linearizer.observe(cameras, features)[0], axis=0)
            scale = EFFICIENT[loss] * max(robust_scale(sizes[linearizer.weights > 0.0]), 1e-12)
    retract = job.model.kernel("retract", table.name)
    problem = FeatureProblem(
        job.model,
        linearizer.with_loss(Loss(loss, scale)),
        lambda rows, own: np.ascontiguousarray(retract(rows.T, own.T).T),
        feature_freedom(job.freedom, tracks.n_points, lines.n_lines),
        refinement=REFINEMENT_METRIC if embedded else None,
        floor=0.5 * float(np.sum(tracks.weights * (1e-14 * job.q) ** 2)),
    )
    return LineJob(job, problem, Estimate(cameras, features), home), scale


def _first_lines(lines: LineTracks, start: MetricReconstruction, table: Table) -> Array:
    """Return the lines of the start, or triangulated ones."""
    if start.lines is None:
        found, deviations = _triangulated(lines, start, table)
        bad = np.flatnonzero(~np.isfinite(deviations))
        if len(bad):
            was = f"have lines that no views determine: {', '.join(map(str, bad[:5]))}"
            needed = "lines off the plane of the centres that see them (epipolar plane)"
            raise ArgumentError("lines", was, needed)
        return found
    if len(start.lines) != lines.n_lines:
        was = f"has {len(start.lines)} lines"
        raise ArgumentError("start", was, f"{lines.n_lines}, as lines; or none")
    return start.lines


def adjusted_lines(
    tracks: Tracks,
    start: Any,
    lines: LineTracks,
    *,
    method: str,
    damping: str | None,
    schedule: Callable[[], lm.Schedule],
    loss: str,
    loss_scale_px: float | str,
    stopping: lm.Stopping,
    backend: str | None,
    callback: Callable[[lm.Row], object] | None,
    **free: Any,
) -> Adjusted:
    """Adjust cameras, points and lines; see `eg.bundle_adjust`."""
    as_choice("method", method, METHODS)
    name = method if damping is None else as_choice("damping", damping, METHODS)
    table = kernels.table(backend)
    (job, problem, begin, home), scale = line_job(
        tracks, start, lines, table, loss, loss_scale_px, **free
    )
    act: Any = Covariant(LAM_FLOOR_METRIC) if name == "covariant" else DAMPINGS[name](table)
    try:
        outcome = lm.minimize(problem, begin, act, schedule(), stopping, callback)
    except np.linalg.LinAlgError:
        was = f"leaves the steps of method={method!r} undetermined (singular normal equations)"
        raise ArgumentError("start", was, "method='covariant'") from None
    m, cameras, features = tracks.n_points, outcome.state.cameras, outcome.state.points
    back = home.inverse()
    whole = job.result(*back.apply(cameras, features[:m, :3]))
    assert isinstance(whole, MetricReconstruction)
    space = unit_lines(back.lines(features[m:]))
    found = MetricReconstruction(whole.R, whole.t, whole.X, whole.cameras, space)
    predicted, depths = found.seen(tracks)
    n_behind = int(np.count_nonzero(~(depths > 0.0)))
    raised = {"behind the cameras"} if n_behind > BEHIND * len(tracks) else set()
    assert isinstance(problem.linearizer, FeatureLinearizer)
    r = problem.linearizer.observe(cameras, features)[0]
    rank, condition = 0, float("inf")
    system: Any = outcome.system() if callable(outcome.system) else outcome.system
    if isinstance(system, BundleSystem) and np.isfinite(outcome.state.cost):
        rank, missing, condition = _determined(system, job)
        weights = problem.linearizer.weights
        counts = weights > 0.0
        share = max(1.0 - rank / max(2 * int(np.count_nonzero(counts)), 1), 1e-3)
        sizes = (np.sqrt(weights) * np.linalg.norm(r, axis=0))[counts]
        usual = median(sizes) / 1.1774 / float(np.sqrt(share))
        middles = 0.5 * (lines.segments[:, :2] + lines.segments[:, 2:])
        if loss == "linear":
            raised.update(gross_flags(sizes, usual, np.concatenate([tracks.xy, middles])[counts]))
        if missing:
            raised.add("undetermined")
        V = system.normal.V[m:]
        if (usual * _deviations(V) > _OPEN).any():
            raised.add("open lines")
    line_fun = np.ascontiguousarray(r[:, len(tracks) :].T)
    fun = tracks.xy - predicted
    flags = ordered(raised)
    return Adjusted(found, outcome, fun, line_fun, flags, rank, n_behind, condition, scale)


def _determined(system: BundleSystem, job: Job) -> tuple[int, int, float]:
    """Return the rank, how many directions of cameras nothing determines, and the condition."""
    W = Covariant().blocks(system)
    V = system.V
    values = np.linalg.eigvalsh(V)
    open_features = int(np.count_nonzero(values <= _ROUNDING * values[:, -1:]))
    T, _ = system.inverse_roots(V, W.points, 1e-12, system.gradients[2])
    S = system.reduced(T)
    size = np.sqrt(np.maximum(np.diagonal(S), 1e-300))
    frozen = 0 if system.ties.A is None else int(np.count_nonzero(~system.ties.A.any(axis=1)))
    spectrum = np.linalg.eigvalsh(S / size[:, None] / size)
    gauge = 0 if job.fixes_gauge else system.model.gauge_dimension
    if job.fixes_gauge:
        # What a fixed view or point leaves of the gauge is no fault of the observations.
        gauge = min(int(np.count_nonzero(spectrum <= _ROUNDING)), system.model.gauge_dimension)
    missing = max(int(np.count_nonzero(spectrum <= _ROUNDING)) - gauge, 0)
    rank = len(S) - frozen - gauge - missing + V.shape[0] * V.shape[1] - open_features
    least = spectrum[min(gauge + missing, len(spectrum) - 1)]
    return rank, missing, float(1.0 / max(least, 1e-300)) if not missing else float("inf")
