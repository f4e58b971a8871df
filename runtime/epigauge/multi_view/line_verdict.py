"""What is to be known of an adjustment of points and lines before it is used."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.diagnosis import Diagnosis, diagnosed
from epigauge.bundle.jobs import Job
from epigauge.bundle.null_space import scales
from epigauge.bundle.observations import ObservationGraph, whitened
from epigauge.bundle.problem import BundleState, Estimate
from epigauge.bundle.run import conditioned_problem
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import MetricReconstruction
from epigauge.kernels import Table
from epigauge.multi_view.line_start import OPEN, spreads
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.counting import missing_beside
from epigauge.multi_view.verdicts.front import BEHIND
from epigauge.multi_view.verdicts.gross import TailOfArrays, gross_flags, strayed_flags
from epigauge.multi_view.verdicts.projective import judged
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.two_view.losses import Loss, median
from epigauge.verdicts import ordered

__all__ = ["LinesFound", "judged_lines", "without_scales"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A segment farther from its line than this, in standard deviations, is one of another line.
_WRONG = 12.0

#: Views whose segments any line fits.
_FREE = 2

#: Noise below this, in pixels, is rounding.
_EXACT = 1e-4


class LinesFound(NamedTuple):
    """What was adjusted, and how it ended.

    Attributes
    ----------
    tracks, lines : Tracks, LineTracks
        Observations.
    job : Job
        Their problem.
    reached : Estimate
        Its minimum.
    found : MetricReconstruction or Reconstruction
        The same.
    depths : ndarray, shape (N,), or None
        Of the points, where cameras have a front.
    fixed_views, fixed_points : ndarray of int
        No unknowns.
    """

    tracks: Tracks
    lines: LineTracks
    job: Job
    reached: Estimate
    found: MetricReconstruction | Reconstruction
    depths: Array | None
    fixed_views: Indices
    fixed_points: Indices


def judged_lines(parts: LinesFound, table: Table, loss: Loss, finite: bool) -> Verdict:
    """Return flags, rank, observations behind the cameras and condition.

    Parameters
    ----------
    parts : LinesFound
        What is judged.
    table : Table
        Back end.
    loss : Loss
        That was minimised.
    finite : bool
        Whether its sum is.
    """
    tracks, job, bends = parts.tracks, parts.job, loss.name == "linear"
    raised: set[str] = set()
    if parts.depths is not None:
        n_behind = int(np.count_nonzero(~(parts.depths > 0.0)))
        raised |= {"behind the cameras"} if n_behind > BEHIND * len(tracks) else set()
    else:
        assert isinstance(parts.found, Reconstruction)
        none, fixed = np.zeros(len(tracks), np.bool_), (parts.fixed_views, parts.fixed_points)
        stays = fixed if job.fixes_gauge else None
        points = judged(tracks, parts.found, none, bends, table, 1, stays)
        # What points leave open lines may determine: that is told below.
        raised, n_behind = set(points.flags) - {"undetermined"}, points.n_behind
    if not finite:
        return Verdict(ordered(raised | {"undetermined"}), 0, n_behind)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    observed = job, graph, np.asarray(tracks.weights), table, loss
    _, problem, at = conditioned_problem(*observed, parts.reached)
    system = problem.linearize(BundleState(at, 0.0))
    diagnosis = _diagnosis(parts, system, table)
    r = whitened(tracks.whitening, problem.linearizer.residuals(at.cameras, at.points))
    both = r, problem.kinds[0].residuals(at.cameras, at.others[0])
    of_points, of_lines = (job.scale_px * np.linalg.norm(part, axis=0) for part in both)
    # A line fits the segments of two views whatever they are: its residuals tell nothing.
    told = np.bincount(parts.lines.line)[parts.lines.line] > _FREE
    counts = np.concatenate([tracks.weights > 0.0, told])
    sizes = np.concatenate([np.sqrt(tracks.weights) * of_points, of_lines])[counts]
    rank = diagnosis.rank - 2 * int(np.count_nonzero(~told))
    share = max(1.0 - rank / max(2 * len(sizes), 1), 1e-3)
    noise = median(sizes) / 1.1774 / float(np.sqrt(share))
    middles = 0.5 * (parts.lines.segments[:, :2] + parts.lines.segments[:, 2:])
    measured = np.concatenate([tracks.xy, middles])
    if bends:
        raised.update(gross_flags(TailOfArrays(sizes, measured[counts]), noise))
        if (of_lines > _WRONG * max(noise, _EXACT)).any():
            raised.add("wrong segments")
    elif parts.depths is not None:  # of projective cameras the points have told it
        raised.update(_strayed(tracks, np.sqrt(tracks.weights) * of_points, noise, job.scale_px))
    if diagnosis.missing:
        raised.add("undetermined")
    if (noise / job.scale_px * spreads(system.normal.others[0].V) > OPEN).any():
        raised.add("open lines")
    return Verdict(ordered(raised), diagnosis.rank, n_behind, diagnosis.condition)


def _strayed(tracks: Tracks, sizes: Array, noise: float, scale: float) -> tuple[str, ...]:
    """Return the flag of views most of whose points, of weighted distances (N,), are far off."""
    every, n = tracks.view[tracks.weights > 0.0], tracks.n_views

    def far_of_views(limit: float) -> Indices:
        return np.bincount(tracks.view[sizes > limit], minlength=n)

    return strayed_flags(far_of_views, np.bincount(every, minlength=n), noise, scale)


def _diagnosis(parts: LinesFound, system: BundleSystem, table: Table) -> Diagnosis:
    """Return what the normal equations say, scales being no unknowns."""
    job, gauge = parts.job, None
    known = np.isin(np.arange(parts.tracks.n_points), parts.fixed_points)
    if job.model.homogeneous:
        system = without_scales(system)
        if job.fixes_gauge:
            fixed = system.cameras[parts.fixed_views].reshape(-1, 3, 4)
            gauge = missing_beside((fixed, system.points[parts.fixed_points]))
    return diagnosed(system, table, known, job.fixes_gauge, gauge)


def without_scales(system: BundleSystem) -> BundleSystem:
    """Return the system in unknowns across the scales of homogeneous cameras and points."""
    p, q = scales(system.cameras, system.points)
    return system.tied(_across(p), _across(q))


def _across(directions: Array) -> Array:
    """Return orthonormal bases (k, d, d - 1) of what is across unit vectors (k, d)."""
    # The reflection that takes the first axis to the vector, or to minus it.
    w = directions.copy()
    w[:, 0] += np.where(w[:, 0] < 0.0, -1.0, 1.0)
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    return np.asarray(np.eye(w.shape[1])[:, 1:] - 2.0 * w[:, :, None] * w[:, None, 1:])
