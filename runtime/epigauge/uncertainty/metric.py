"""From tracks and a calibrated reconstruction at its minimum to covariances."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_choice, as_positive
from epigauge.bundle.jobs import Job, metric_job
from epigauge.bundle.lines import LineLinearizer
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.prior_kinds import Prior
from epigauge.bundle.priors import Priors
from epigauge.bundle.problem import Estimate
from epigauge.bundle.refinement import listed
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.similarity import Similarity
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.line_adjust import line_problem
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import EFFICIENT, LOSSES, Loss, robust_scale
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.uncertainty.features import FeatureLinearizer
from epigauge.uncertainty.influence import RobustFit
from epigauge.uncertainty.inverse import Inverse, Motions
from epigauge.uncertainty.sandwich import Difference, Sandwich, pull

__all__ = ["metric_covariance", "redundancy_of", "robust_loss"]

Array = NDArray[np.float64]


def metric_covariance(
    tracks: Tracks,
    reconstruction: MetricReconstruction,
    gauge: Any = "inner",
    noise_px: float | None = None,
    *,
    loss: str = "linear",
    loss_scale_px: float | str = "auto",
    refine: str | Sequence[str] = "all",
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    priors: Iterable[Prior] | None = None,
    lines: LineTracks | None = None,
    backend: str | None = None,
) -> MetricCovariance:
    """Return the covariance of an adjusted calibrated reconstruction; see `eg.covariance`."""
    if as_choice("loss", loss, LOSSES) != "linear" and tracks.n_repeated:
        was = f"see {tracks.n_repeated} points again in one view, with a robust loss"
        raise ArgumentError("tracks", was, "the linear loss, as the adjustment")
    tracks = tracks.merged()[0]
    if noise_px is not None:
        noise_px = as_positive("noise_px", noise_px)
    free: dict[str, Any] = {
        "refine": refine,
        "fixed_views": listed("fixed_views", fixed_views),
        "fixed_points": listed("fixed_points", fixed_points),
    }
    table = kernels.table(backend)
    free |= {"priors": priors, "noise_px": tracks.unit if noise_px is None else noise_px}
    if lines is None:
        job = metric_job(tracks, reconstruction, **free)
        network = _of_points(tracks, job, table)
    else:
        network = _of_lines(tracks, reconstruction, lines, table, free)
    known, weights, at = network.priors, network.weights, network.at
    cost, system, reference = network.normal(weights)
    motions = network.motions(system, reference)
    redundancy = redundancy_of(weights, known, system, motions)
    fit = None
    if loss != "linear":
        r = reference.observe(at.cameras, at.points)[0].T
        scaled = robust_loss(loss, loss_scale_px, r, weights)
        net = 2 * int(np.count_nonzero(weights > 0.0)) - redundancy
        fit = RobustFit.of(r, weights, scaled, max(net, 0))
        _, system, reference = network.normal(fit.weights)
    inverse = Inverse.of(system, reference, known, motions)
    whole: Inverse | Sandwich = inverse
    if fit is not None:
        influence = fit.influence(pull(reference, system, inverse, fit.wrong, fit.psi))
        noise_px = influence.noise if noise_px is None else noise_px
        rest = Difference.of(influence, reference, system, known)
        whole = Sandwich(inverse, influence.kappa, rest)
    elif noise_px is None:
        if redundancy <= 0:
            raise ArgumentError("noise_px", "is not given", "a number: nothing is redundant")
        noise_px = float(np.sqrt(2.0 * cost / redundancy))
    m = tracks.n_points
    rows = at.cameras, np.ascontiguousarray(at.points[:m, :3])
    of_lines = None
    if isinstance(reference, FeatureLinearizer):
        # From updates to Pluecker coordinates of the scene.
        tangents = reference.of_lines.tangents(at.cameras, reference.split(at.points)[1])
        back, count = network.home.inverse(), tangents.shape[2]
        of_lines = np.stack([back.lines(tangents[..., k]) for k in range(count)], axis=2)
    found = MetricCovariance(
        reconstruction,
        noise_px,
        redundancy,
        gauge,
        inverse.motions.open.shape[1],
        whole,
        network.home,
        rows,
        of_lines,
    )
    # The usual datum can wait until it is asked for.
    return found if isinstance(gauge, str) and gauge == "inner" else found.in_gauge(gauge)


class _Network(NamedTuple):
    """What is inverted.

    Attributes
    ----------
    home : Similarity
        To where computing suits best.
    at : Estimate
        Cameras, and points or features, there.
    weights : ndarray, shape (N,)
        Of the observations.
    priors : Priors or None
        Moved there.
    normal : callable
        For weights: cost, normal equations, and what evaluates observation by observation.
    motions : callable
        For both: the gauge freedom.
    """

    home: Similarity
    at: Estimate
    weights: Array
    priors: Priors | None
    normal: Callable[[Array], tuple[float, BundleSystem, NumpyLinearizer]]
    motions: Callable[[BundleSystem, NumpyLinearizer], Motions]


def _of_points(tracks: Tracks, job: Job, table: Table) -> _Network:
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    home, cameras, points = best_conditioned(job.model, job.cameras, job.points)
    assert isinstance(home, Similarity)
    at = Estimate(cameras, points)
    priors = None if job.priors is None else job.priors.moved(home)

    def normal(weights: Array) -> tuple[float, BundleSystem, NumpyLinearizer]:
        parts = job.model, table, graph, job.q, weights, Loss()
        beside: Any = {"freedom": job.freedom, "priors": priors}
        problem = bundle_problem(*parts, whitening=job.whitening, **beside)
        state = problem.evaluate(at)
        return state.cost, problem.linearize(state), NumpyLinearizer(*parts, job.whitening)

    def motions(system: BundleSystem, reference: NumpyLinearizer) -> Motions:
        return Motions.of(system, priors, table)

    return _Network(home, at, np.asarray(tracks.weights), priors, normal, motions)


def _of_lines(
    tracks: Tracks,
    scene: MetricReconstruction,
    lines: LineTracks,
    table: Table,
    free: dict[str, Any],
) -> _Network:
    if scene.lines is None:
        was = "is given, and the reconstruction has no lines"
        raise ArgumentError("lines", was, "what was adjusted: eg.bundle_adjust(..., lines=lines)")
    made = line_problem(tracks, scene, lines, table, **free)
    job, at, home, priors = made.job, made.start, made.home, made.problem.priors
    assert isinstance(home, Similarity)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    parts = job.model, table, graph, job.q, np.asarray(tracks.weights), Loss()
    (of_lines,) = made.problem.kinds
    assert isinstance(of_lines, LineLinearizer)
    whole = FeatureLinearizer.of(NumpyLinearizer(*parts, job.whitening), of_lines)
    rows = whole.rows(at.points, *at.others)

    def normal(weights: Array) -> tuple[float, BundleSystem, NumpyLinearizer]:
        own = whole.reweighted(weights)
        cost = 0.5 * float(np.sum(own.point_costs(at.cameras, rows)))
        if priors is not None:
            cost += priors.cost(at.cameras, rows)
        return cost, own.system(job.freedom.ties, at.cameras, rows, priors), own

    def motions(system: BundleSystem, reference: NumpyLinearizer) -> Motions:
        return Motions.along_gauge(system, priors, *whole.generators(at.cameras, rows))

    weights = whole.weights
    return _Network(home, Estimate(at.cameras, rows), weights, priors, normal, motions)


def redundancy_of(
    weights: Array, priors: Priors | None, system: BundleSystem, motions: Motions
) -> int:
    """Return how many observations and priors there are beyond what the unknowns need."""
    ties = system.ties
    (n, d), (m, b) = system.normal.g_cameras.shape, system.normal.g_points.shape
    of_views = n * d if ties.A is None else int(np.count_nonzero(ties.A.any(axis=1)))
    of_points = m * b if ties.C is None else int(np.count_nonzero(ties.C.any(axis=1)))
    observed = 2 * int(np.count_nonzero(weights > 0.0))
    known = 0 if priors is None else int(priors.n_numbers)
    unknowns = of_views + ties.n_shared + of_points - motions.open.shape[1]
    return int(observed + known - unknowns)


def robust_loss(loss: str, loss_scale_px: float | str, r: Array, weights: Array) -> Loss:
    """Return a loss for residuals (N, 2), with the scale given or told by them."""
    if loss_scale_px == "auto":
        scale = robust_scale(np.linalg.norm(r, axis=1)[weights > 0.0])
        return Loss(loss, EFFICIENT[loss] * max(scale, 1e-12))
    return Loss(loss, as_positive("loss_scale_px", loss_scale_px))
