"""Lines adjusted together with points and cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.jobs import Job, job_of
from epigauge.bundle.moves import Move
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem, Estimate
from epigauge.bundle.run import conditioned_problem, minimized
from epigauge.bundle.way import Way, loss_scale
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.line_agreement import BEYOND, lengths, usual
from epigauge.multi_view.line_start import SeenLines, refuse_absurd, seen_lines, triangulated
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.line_verdict import LinesFound, judged_lines
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.result import BundleResult
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import Loss

__all__ = ["LineProblem", "adjusted_lines", "graph_of", "line_job", "line_problem"]

Array = NDArray[np.float64]

#: Methods and dampings that have no step for lines.
_WITHOUT = ("free", "none", "gauge_invariant", "gauge_invariant_factor")


class LineProblem(NamedTuple):
    """A job of points and lines, its problem and start where computing suits best, and the way."""

    job: Job
    problem: BundleProblem
    start: Estimate
    home: Move


def line_job(
    tracks: Tracks,
    start: MetricReconstruction | Reconstruction,
    lines: LineTracks,
    table: Table,
    *,
    refine: Any = "all",
    fixed_views: Any = (),
    fixed_points: Any = (),
    priors: Any = None,
    noise_px: float = 1.0,
) -> Job:
    """Return the job of points and lines, the lines being triangulated where the start has none.

    Raises
    ------
    ArgumentError
        On starts and options that lines do not go with, and lines that have no start.
    """
    frame = Frame.of(tracks) if isinstance(start, Reconstruction) else None
    seen = seen_lines("start", lines, start, tracks.unit, frame)
    if seen.segments.intrinsics is not None and refine != "pose":
        was = f"is {refine!r} with lines in {seen.model.name} cameras, which bend lines"
        raise ArgumentError("refine", was, "'pose': end points are undistorted once")
    job = job_of(
        tracks,
        start,
        refine=refine,
        fixed_views=fixed_views,
        fixed_points=fixed_points,
        priors=priors,
        noise_px=noise_px,
    )
    first = _first_lines(seen, start.lines, table)
    return replace(job, kinds=(seen.linearizer(table),), others=(first,))


def line_problem(
    tracks: Tracks,
    start: MetricReconstruction | Reconstruction,
    lines: LineTracks,
    table: Table,
    *,
    embedded: bool = False,
    **free: Any,
) -> LineProblem:
    """Return the problem of points and lines where computing suits best; see `line_job`."""
    job = line_job(tracks, start, lines, table, **free)
    observed = job, graph_of(tracks), np.asarray(tracks.weights), table
    home, problem, begin = conditioned_problem(*observed, embedded=embedded)
    return LineProblem(job, problem, begin, home)


def _first_lines(seen: SeenLines, given: Array | None, table: Table) -> Array:
    """Return the lines of the start, or triangulated ones where there are none or wild ones."""
    if given is None:
        found, deviations = triangulated(seen, table)
        refuse_absurd("lines", seen, found, table)
        bad = np.flatnonzero(~np.isfinite(deviations))
        if len(bad):
            was = f"have lines that no views determine: {', '.join(map(str, bad[:5]))}"
            needed = "lines off the plane of the centres that see them (epipolar plane)"
            raise ArgumentError("lines", was, needed)
        return found
    if len(given) != seen.n_lines:
        was = f"has {len(given)} lines"
        raise ArgumentError("start", was, f"{seen.n_lines}, as lines; or none")
    linearizer = seen.linearizer(table)
    sizes = lengths(linearizer, seen.cameras, given)
    bound = BEYOND * usual(sizes)
    if (sizes <= bound).all():
        return given
    found, deviations = triangulated(seen, table)

    def cost(rows: Array) -> Array:
        """Return the costs of lines, what is beyond counted alike."""
        capped = np.minimum(lengths(linearizer, seen.cameras, rows), bound) ** 2
        line = seen.segments.line
        return np.asarray(np.bincount(line, capped, minlength=seen.n_lines), np.float64)

    better = np.isfinite(deviations) & (cost(found) + bound**2 < cost(given))
    chosen = np.where(better[:, None], found, given)
    refuse_absurd("start", seen, chosen, table)
    return chosen


def adjusted_lines(
    tracks: Tracks, start: Any, lines: LineTracks, way: Way, table: Table, **free: Any
) -> BundleResult:
    """Adjust cameras, points and lines; see `eg.bundle_adjust`."""
    if not isinstance(way.workers, int):
        raise ArgumentError("lines", "are given with workers elsewhere", "none, or one machine")
    for name, value in (("method", way.method), ("damping", way.damping)):
        if value in _WITHOUT:
            raise ArgumentError(name, f"is {value!r} with lines", "another one: 'covariant'")
    if way.gauge_mode != "explicit":
        raise ArgumentError("gauge_mode", f"is {way.gauge_mode!r} with lines", "'explicit'")
    job = line_job(tracks, start, lines, table, **free)
    scale_px = loss_scale(way, job, tracks, start)
    robust, way = Loss(way.loss, scale_px / job.scale_px), replace(way, workers=1)
    weights = np.asarray(tracks.weights)
    outcome, reached = minimized(job, graph_of(tracks), weights, table, way, robust)
    (kind,) = job.kinds
    whole = job.result(reached.cameras, reached.points)
    assert isinstance(whole, MetricReconstruction | Reconstruction)
    found = replace(whole, lines=reached.others[0])
    line_fun = kind.residuals(reached.cameras, reached.others[0]) * job.scale_px
    if isinstance(found, MetricReconstruction):
        predicted, depths = found.seen(tracks)
    else:
        predicted, depths = found.project(tracks), None
    views, points = (np.asarray([*free[name]], np.intp) for name in ("fixed_views", "fixed_points"))
    parts = LinesFound(tracks, lines, job, reached, found, depths, views, points)
    verdict = judged_lines(parts, table, robust, bool(np.isfinite(outcome.state.cost)))
    return BundleResult.unjudged(
        lambda: verdict,
        outcome,
        tracks,
        tracks.xy - predicted,
        reconstruction=found,
        cost=outcome.state.cost * job.scale_px**2,
        method=way.method,
        loss_scale_px=scale_px,
        noise_px=free["noise_px"],
        line_fun=np.ascontiguousarray(line_fun.T),
    )


def graph_of(tracks: Tracks) -> ObservationGraph:
    """Return which observation of points belongs to what."""
    return ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
