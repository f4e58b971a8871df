"""Lines in calibrated views, adjusted together with points and cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge._arguments import as_choice, as_positive
from epigauge.bundle.dampings import DAMPINGS, LAM_FLOOR_METRIC, Covariant
from epigauge.bundle.jobs import Job, metric_job
from epigauge.bundle.lines import (
    FeatureLinearizer,
    FeatureProblem,
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
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.line_segments import segments_of
from epigauge.multi_view.line_start import OPEN, ROUNDING, checked_scene, spreads, triangulated
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.front import BEHIND
from epigauge.multi_view.verdicts.gross import gross_flags
from epigauge.two_view.losses import EFFICIENT, Loss, median, robust_scale
from epigauge.verdicts import ordered

__all__ = ["Adjusted", "LineJob", "adjusted_lines"]

Array = NDArray[np.float64]

#: Methods that leave all parameters free, as lines need.
METHODS = ("covariant", "levenberg", "marquardt")


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
    checked_scene("start", start)
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
        found, deviations = triangulated(lines, start, table)
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
        if (usual * spreads(V) > OPEN).any():
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
    open_features = int(np.count_nonzero(values <= ROUNDING * values[:, -1:]))
    T, _ = system.inverse_roots(V, W.points, 1e-12, system.gradients[2])
    S = system.reduced(T)
    size = np.sqrt(np.maximum(np.diagonal(S), 1e-300))
    frozen = 0 if system.ties.A is None else int(np.count_nonzero(~system.ties.A.any(axis=1)))
    spectrum = np.linalg.eigvalsh(S / size[:, None] / size)
    gauge = 0 if job.fixes_gauge else system.model.gauge_dimension
    if job.fixes_gauge:
        # What a fixed view or point leaves of the gauge is no fault of the observations.
        gauge = min(int(np.count_nonzero(spectrum <= ROUNDING)), system.model.gauge_dimension)
    missing = max(int(np.count_nonzero(spectrum <= ROUNDING)) - gauge, 0)
    rank = len(S) - frozen - gauge - missing + V.shape[0] * V.shape[1] - open_features
    least = spectrum[min(gauge + missing, len(spectrum) - 1)]
    return rank, missing, float(1.0 / max(least, 1e-300)) if not missing else float("inf")
