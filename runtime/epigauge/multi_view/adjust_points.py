"""One adjustment of cameras and points: what `bundle_adjust` does, once or again and again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.jobs import Job, job_of
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleState, Estimate
from epigauge.bundle.refinement import fixed_indices
from epigauge.bundle.run import minimized
from epigauge.bundle.strategies import STRATEGIES
from epigauge.bundle.way import Way, loss_scale
from epigauge.cameras import AffineReconstruction, MetricReconstruction
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.result import BundleResult
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.evidence import EvidenceOfTracks
from epigauge.multi_view.verdicts.metric import judged_metric
from epigauge.multi_view.verdicts.projective import judged
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.two_view.losses import Loss

__all__ = ["adjusted_points"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Outcome = lm.Outcome[BundleState]


def adjusted_points(
    tracks: Tracks, start: Any, way: Way, table: Table, *, noise_px: float, **free: Any
) -> BundleResult:
    """Adjust cameras and points; see `eg.bundle_adjust`.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    start : Reconstruction, MetricReconstruction or AffineReconstruction
        Where to begin.
    way : Way
        How.
    table : Table
        Back end.
    noise_px : float
        Noise of the image that priors are weighed with.
    **free
        Of `job_of`: refine, fixed_views, fixed_points, priors.
    """
    job = job_of(tracks, start, noise_px=noise_px, **free)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    scale_px = loss_scale(way, job, tracks, start)
    loss = Loss(way.loss, scale_px / job.scale_px)
    outcome, reached = minimized(job, graph, np.asarray(tracks.weights), table, way, loss)
    found = job.result(reached.cameras, reached.points)
    stays = (
        fixed_indices("fixed_views", free["fixed_views"], tracks.n_views),
        fixed_indices("fixed_points", free["fixed_points"], tracks.n_points),
    )
    what = tracks, job, way, table, stays
    if isinstance(found, Reconstruction):
        predicted = found.project(tracks)
        judge = _of_projective(*what, outcome, reached)
    else:
        predicted, judge = _of_others(*what, outcome, found)
    result = BundleResult.unjudged(
        judge,
        outcome,
        tracks,
        tracks.xy - predicted,
        reconstruction=found,
        cost=outcome.state.cost * job.scale_px**2,
        method=way.method,
        loss_scale_px=scale_px,
        noise_px=noise_px,
    )
    if way.workers != 1:
        result.judge()  # while the workers are there: threads do not outlive a fork
    return result


def _of_others(
    tracks: Tracks,
    job: Job,
    way: Way,
    table: Table,
    stays: tuple[Indices, Indices],
    outcome: Outcome,
    found: MetricReconstruction | AffineReconstruction,
) -> tuple[Array, Callable[[], Verdict]]:
    """Return the projection of a metric or affine reconstruction, and what judges it."""
    fixed = np.zeros(tracks.n_points, dtype=np.bool_)
    fixed[stays[1]] = True
    fixes_gauge = job.fixes_gauge or bool(STRATEGIES[way.method].reference)
    if isinstance(found, MetricReconstruction):
        predicted, depths = found.seen(tracks)
    else:
        predicted, depths = found.project(tracks), None

    def judge() -> Verdict:
        evidence = EvidenceOfTracks(tracks, Frame.of(tracks).scale, predicted, depths)
        how = table, fixed, fixes_gauge, way.loss == "linear"
        return judged_metric(evidence, found, outcome, *how)

    return predicted, judge


def _of_projective(
    tracks: Tracks,
    job: Job,
    way: Way,
    table: Table,
    stays: tuple[Indices, Indices],
    outcome: Outcome,
    reached: Estimate,
) -> Callable[[], Verdict]:
    """Return what judges a projective reconstruction."""

    def judge() -> Verdict:
        # The arrays of the result can be written to: what is judged is what was found.
        found = job.result(reached.cameras, reached.points)
        assert isinstance(found, Reconstruction)
        none, linear = np.zeros(len(tracks), np.bool_), way.loss == "linear"
        system: Any = outcome.system if linear else None
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            system = system() if callable(system) else system
        fixed = stays if job.fixes_gauge else None
        return judged(tracks, found, none, linear, table, way.threads, fixed, system)

    return judge
