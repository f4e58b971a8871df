"""Lines in calibrated views, adjusted together with points and cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge._arguments import as_choice, as_positive
from epigauge.bundle.dampings import DAMPINGS, LAM_FLOOR_METRIC, Covariant
from epigauge.bundle.diagnosis import diagnosed
from epigauge.bundle.jobs import Job, metric_job
from epigauge.bundle.lines import LineLinearizer, Segments, unit_lines
from epigauge.bundle.observations import ObservationGraph, whitened
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.similarity import Similarity, normal_frame
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.line_agreement import BEYOND, lengths, usual
from epigauge.multi_view.line_segments import segments_of
from epigauge.multi_view.line_start import (
    OPEN,
    checked_scene,
    refuse_absurd,
    spreads,
    triangulated,
)
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.front import BEHIND
from epigauge.multi_view.verdicts.gross import TailOfArrays, gross_flags
from epigauge.two_view.losses import EFFICIENT, Loss, median, robust_scale
from epigauge.verdicts import ordered

__all__ = ["Adjusted", "LineJob", "adjusted_lines"]

Array = NDArray[np.float64]

#: Methods that leave all parameters free, as lines need.
METHODS = ("covariant", "levenberg", "marquardt")

#: A segment farther from its line than this, in standard deviations, is one of another line.
_WRONG = 12.0

#: Noise below this, in those deviations, is rounding.
_EXACT = 1e-4


class LineJob(NamedTuple):
    """A problem of points and lines about the origin, and the way back."""

    job: Job
    problem: BundleProblem
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
    first = _first_lines(lines, start, segments, table)
    home = normal_frame(job.cameras, job.points)
    cameras, points = home.apply(job.cameras, job.points)
    begin = Estimate(cameras, points, others=(home.lines(first),))
    of_lines = LineLinearizer.of(segments, job.model, table, (len(cameras), lines.n_lines))
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    parts = job.model, table, graph, job.q, tracks.weights
    options: dict[str, Any] = {"whitening": job.whitening, "freedom": job.freedom}
    scale = 0.0
    if loss != "linear":
        if loss_scale_px != "auto":
            scale = as_positive("loss_scale_px", loss_scale_px)
        else:
            problem = bundle_problem(*parts, kinds=(of_lines,), **options)
            sizes = np.concatenate(_sizes(problem, begin, tracks.whitening))
            counts = np.concatenate([tracks.weights > 0.0, np.ones(len(lines), np.bool_)])
            scale = EFFICIENT[loss] * max(robust_scale(sizes[counts]), 1e-12)
    robust = Loss(loss, scale)
    kinds = (of_lines.with_loss(robust),)
    problem = bundle_problem(*parts, robust, embedded=embedded, kinds=kinds, **options)
    return LineJob(job, problem, begin, home), scale


def _sizes(problem: BundleProblem, at: Estimate, whitening: Array | None) -> list[Array]:
    """Return the length of each residual, whitened: of points, then of lines."""
    r = problem.linearizer.residuals(at.cameras, at.points)
    (own,), (lines,) = problem.kinds, at.others
    parts = whitened(whitening, r), own.residuals(at.cameras, lines)
    return [np.linalg.norm(part, axis=0) for part in parts]


def _first_lines(
    lines: LineTracks, start: MetricReconstruction, segments: Segments, table: Table
) -> Array:
    """Return the lines of the start, or triangulated ones where there are none or wild ones."""
    if start.lines is None:
        found, deviations = triangulated(lines, start, table)
        refuse_absurd("lines", lines, start, found, table)
        bad = np.flatnonzero(~np.isfinite(deviations))
        if len(bad):
            was = f"have lines that no views determine: {', '.join(map(str, bad[:5]))}"
            needed = "lines off the plane of the centres that see them (epipolar plane)"
            raise ArgumentError("lines", was, needed)
        return found
    if len(start.lines) != lines.n_lines:
        was = f"has {len(start.lines)} lines"
        raise ArgumentError("start", was, f"{lines.n_lines}, as lines; or none")
    model, count = camera_model(start.cameras.model), (start.n_views, lines.n_lines)
    linearizer = LineLinearizer.of(segments, model, table, count)
    sizes = lengths(linearizer, start.vectors, start.lines)
    bound = BEYOND * usual(sizes)
    if (sizes <= bound).all():
        return start.lines
    found, deviations = triangulated(lines, start, table)

    def cost(rows: Array) -> Array:
        """Return the costs of lines, what is beyond counted alike."""
        capped = np.minimum(lengths(linearizer, start.vectors, rows), bound) ** 2
        return np.asarray(np.bincount(lines.line, capped, minlength=lines.n_lines), np.float64)

    better = np.isfinite(deviations) & (cost(found) + bound**2 < cost(start.lines))
    chosen = np.where(better[:, None], found, start.lines)
    refuse_absurd("start", lines, start, chosen, table)
    return chosen


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
    reached, back = outcome.state.estimate, home.inverse()
    whole = job.result(*back.apply(reached.cameras, reached.points))
    assert isinstance(whole, MetricReconstruction)
    space = unit_lines(back.lines(reached.others[0]))
    found = MetricReconstruction(whole.R, whole.t, whole.X, whole.cameras, space)
    predicted, depths = found.seen(tracks)
    n_behind = int(np.count_nonzero(~(depths > 0.0)))
    raised = {"behind the cameras"} if n_behind > BEHIND * len(tracks) else set()
    line_fun = problem.kinds[0].residuals(reached.cameras, reached.others[0])
    rank, condition = 0, float("inf")
    system: Any = outcome.system() if callable(outcome.system) else outcome.system
    if isinstance(system, BundleSystem) and np.isfinite(outcome.state.cost):
        known = np.isin(np.arange(tracks.n_points), np.asarray([*free["fixed_points"]], np.intp))
        diagnosis = diagnosed(system, table, known, job.fixes_gauge)
        rank, condition = diagnosis.rank, diagnosis.condition
        of_points, of_lines = _sizes(problem, reached, tracks.whitening)
        sizes = np.concatenate([np.sqrt(tracks.weights) * of_points, of_lines])
        counts = np.concatenate([tracks.weights > 0.0, np.ones(len(lines), np.bool_)])
        sizes = sizes[counts]
        share = max(1.0 - rank / max(2 * len(sizes), 1), 1e-3)
        noise = median(sizes) / 1.1774 / float(np.sqrt(share))
        middles = 0.5 * (lines.segments[:, :2] + lines.segments[:, 2:])
        measured = np.concatenate([tracks.xy, middles])
        if loss == "linear":
            raised.update(gross_flags(TailOfArrays(sizes, measured[counts]), noise))
            if (of_lines > _WRONG * max(noise, _EXACT)).any():
                raised.add("wrong segments")
        if diagnosis.missing:
            raised.add("undetermined")
        if (noise * spreads(system.normal.others[0].V) > OPEN).any():
            raised.add("open lines")
    line_fun, fun = np.ascontiguousarray(line_fun.T), tracks.xy - predicted
    flags = ordered(raised)
    return Adjusted(found, outcome, fun, line_fun, flags, rank, n_behind, condition, scale)
