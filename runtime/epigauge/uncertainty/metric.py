"""From tracks and a calibrated reconstruction at its minimum to covariances."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_choice, as_positive
from epigauge.bundle.jobs import Job, metric_job
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.prior_kinds import Prior
from epigauge.bundle.problem import Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.similarity import Similarity
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import EFFICIENT, LOSSES, Loss, robust_scale
from epigauge.uncertainty.covariance import MetricCovariance
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
    backend: str | None = None,
) -> MetricCovariance:
    """Return the covariance of an adjusted calibrated reconstruction; see `eg.covariance`."""
    if as_choice("loss", loss, LOSSES) != "linear" and tracks.n_repeated:
        was = f"see {tracks.n_repeated} points again in one view, with a robust loss"
        raise ArgumentError("tracks", was, "the linear loss, as the adjustment")
    tracks = tracks.merged()[0]
    if noise_px is not None:
        noise_px = as_positive("noise_px", noise_px)
    job = metric_job(
        tracks,
        reconstruction,
        refine=refine,
        fixed_views=tuple(fixed_views),
        fixed_points=tuple(fixed_points),
        priors=priors,
        noise_px=tracks.unit if noise_px is None else noise_px,
    )
    table = kernels.table(backend)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    home = best_conditioned(job.model, job.cameras, job.points)
    assert isinstance(home, Similarity)
    cameras, points = home.apply(job.cameras, job.points)
    priors_there = None if job.priors is None else job.priors.moved(home)
    weights, at = np.asarray(tracks.weights), Estimate(cameras, points)

    def normal(weights: Array) -> tuple[float, BundleSystem, NumpyLinearizer]:
        """Return cost, normal equations, and what evaluates observation by observation."""
        parts = job.model, table, graph, job.q, weights, Loss()
        beside: Any = {"freedom": job.freedom, "priors": priors_there}
        problem = bundle_problem(*parts, whitening=job.whitening, **beside)
        state = problem.evaluate(at)
        system = problem.linearize(state)
        return state.cost, system, NumpyLinearizer(*parts, job.whitening)

    cost, system, reference = normal(weights)
    redundancy = redundancy_of(tracks, job, Motions.of(system, priors_there, table))
    fit = None
    if loss != "linear":
        r = reference.observe(cameras, points)[0].T
        known = robust_loss(loss, loss_scale_px, r, weights)
        net = 2 * int(np.count_nonzero(weights > 0.0)) - redundancy
        fit = RobustFit.of(r, weights, known, max(net, 0))
        _, system, reference = normal(fit.weights)
    inverse = Inverse.of(system, reference, priors_there, table)
    whole: Inverse | Sandwich = inverse
    if fit is not None:
        influence = fit.influence(pull(reference, system, inverse, fit.wrong, fit.psi))
        noise_px = influence.noise if noise_px is None else noise_px
        rest = Difference.of(influence, reference, system, priors_there)
        whole = Sandwich(inverse, influence.kappa, rest)
    elif noise_px is None:
        if redundancy <= 0:
            raise ArgumentError("noise_px", "is not given", "a number: nothing is redundant")
        noise_px = float(np.sqrt(2.0 * cost / redundancy))
    found = MetricCovariance(
        reconstruction,
        noise_px,
        redundancy,
        gauge,
        inverse.motions.open.shape[1],
        whole,
        home,
        (cameras, points),
    )
    # The usual datum can wait until it is asked for.
    return found if isinstance(gauge, str) and gauge == "inner" else found.in_gauge(gauge)


def redundancy_of(tracks: Tracks, job: Job, motions: Motions) -> int:
    """Return how many observations and priors there are beyond what the unknowns need."""
    ties = job.freedom.ties
    n, m = tracks.n_views, tracks.n_points
    d = job.model.tangent_size
    of_views = n * d if ties.A is None else int(np.count_nonzero(ties.A.any(axis=1)))
    of_points = 3 * m if ties.C is None else int(np.count_nonzero(ties.C.any(axis=1)))
    observed = 2 * int(np.count_nonzero(tracks.weights > 0.0))
    known = 0 if job.priors is None else int(job.priors.n_numbers)
    unknowns = of_views + ties.n_shared + of_points - motions.open.shape[1]
    return int(observed + known - unknowns)


def robust_loss(loss: str, loss_scale_px: float | str, r: Array, weights: Array) -> Loss:
    """Return a loss for residuals (N, 2), with the scale given or told by them."""
    if loss_scale_px == "auto":
        scale = robust_scale(np.linalg.norm(r, axis=1)[weights > 0.0])
        return Loss(loss, EFFICIENT[loss] * max(scale, 1e-12))
    return Loss(loss, as_positive("loss_scale_px", loss_scale_px))
