"""Bundle adjustment of cameras of any model, with any gauge strategy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from epigauge import kernels, lm
from epigauge._arguments import as_choice, as_count, as_positive
from epigauge._logged import logged
from epigauge._options import Backend, BundleDamping, GaugeMode, Method, Schedule
from epigauge._options import Loss as LossName
from epigauge.bundle.dampings import DAMPINGS
from epigauge.bundle.jobs import job_of
from epigauge.bundle.observations import ObservationGraph, whitened
from epigauge.bundle.prior_kinds import Prior, listed_priors
from epigauge.bundle.refinement import fixed_indices, listed
from epigauge.bundle.run import checked_gauge, minimized
from epigauge.bundle.strategies import STRATEGIES
from epigauge.cameras import AffineReconstruction, AnyReconstruction, MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import Gauge
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.line_adjust import adjusted_lines
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.prior_noise import with_estimated_noise
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.rejection import without_gross_errors
from epigauge.multi_view.repeated import merging_sightings
from epigauge.multi_view.result import BundleResult
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.evidence import EvidenceOfTracks
from epigauge.multi_view.verdicts.metric import judged_metric
from epigauge.multi_view.verdicts.projective import judged
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.two_view.losses import EFFICIENT, LOSSES, Loss, robust_scale

__all__ = ["BundleResult", "bundle_adjust"]

SCHEDULES: dict[str, Callable[[], lm.Schedule]] = {
    "classic": lm.Classic,
    "nielsen": lm.Nielsen,
    "adaptive": lm.Adaptive,
}


@logged
@merging_sightings
def bundle_adjust(
    tracks: Tracks,
    start: AnyReconstruction | None = None,
    *,
    lines: LineTracks | None = None,
    refine: str | Sequence[str] = "all",
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    priors: Iterable[Prior] | None = None,
    noise_px: float | Literal["tracks"] | None = "tracks",
    method: Method = "covariant",
    gauge: Gauge | type[Gauge] | None = None,
    gauge_mode: GaugeMode = "explicit",
    damping: BundleDamping | None = None,
    embedded: bool = True,
    schedule: Schedule = "auto",
    robust: bool = False,
    loss: LossName = "linear",
    loss_scale_px: float | Literal["auto"] = "auto",
    ftol: float = 1e-8,
    xtol: float = 0.0,
    gtol: float = 0.0,
    max_iter: int = 100,
    workers: int = 1,
    backend: Backend | None = None,
    callback: Callable[[lm.Row], object] | None = None,
) -> BundleResult:
    """Minimise the reprojection error of cameras and points.

    The start decides what cameras are: a `Reconstruction` has projective ones, known up to a change
    of basis; a `MetricReconstruction` those of its camera model, known up to a similarity; an
    `AffineReconstruction` affine ones, known up to an affine change of space.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    start : Reconstruction, MetricReconstruction or AffineReconstruction, optional
        Where to begin, in any basis; by default `initialize(tracks)`.
    lines : LineTracks, optional
        Segments of lines, adjusted together with the points: the distances of their end points from
        the images of the lines. For metric and projective starts, with any method that adds a
        matrix, without `robust` and ``gauge_mode="implicit"``. The lines begin at those of
        the start, or triangulated where that suits their segments better; without ``lines`` those
        of the start are left out, and the result has none. `workers` does not count. Cameras with
        distortion see end points that are undistorted once, with their covariances to first order:
        then ``refine="pose"``.
    refine : "all", "pose" or sequence of str
        Intrinsics of a metric start to be refined beside rotations, positions and points: all of
        them, none, or those named, such as ``("f", "k1")``. "f" of a model with fx and fy changes
        both and keeps their ratio. Views of one camera share its intrinsics.
    fixed_views, fixed_points : iterable of int
        Views and points that stay where they are. Of a metric start a fixed view keeps rotation and
        position; its intrinsics are refined unless `refine` says otherwise. With method
        "covariant", without a gauge.
    priors : iterable, optional
        What is known of a metric reconstruction beside the images: `PositionPrior`,
        `RotationPrior`, `IntrinsicPrior` and `PointPrior`, in the frame of the start.
    noise_px : float, "tracks" or None
        With priors: standard deviation of an image coordinate of weight one, in pixels, which says
        how much observations count against them. By default what the `sigma` of the tracks says, or
        one pixel. None estimates it from the residuals, adjusting again until it stays the same.
    method : str
        Strategy: "covariant" (default) gives the same iterations in every basis; "free",
        "hartley", "bartoli", "faugeras", "mclauchlan", "kanatani" and "gauge_invariant" are those
        of B03, "gauge_invariant_factor" is the other reading of its Table 1; "levenberg" and
        "marquardt" leave everything free.
    gauge : Gauge, optional
        For methods that leave everything free: a gauge to iterate in, such as
        ``eg.gauge.normalized()``; without the parentheses it takes its defaults.
    gauge_mode : {"explicit", "implicit"}
        Move the estimate into the gauge before each iteration, or choose the damping that acts as
        if it were there (B03 eq. 9): the same iterates up to the gauge.
    damping : {"levenberg", "marquardt", "covariant", "gauge_invariant", "none"}, optional
        Another damping than the method's own.
    embedded : bool
        With "covariant", re-triangulate all points after each step.
    schedule : {"auto", "classic", "nielsen", "adaptive"}
        Rule for lambda: a constant factor, by the gain ratio, or the first until a step is rejected
        and then the second. By default the first for projective cameras, as in the papers, and the
        last for all others.
    robust : bool
        For measured tracks with gross errors: begin from what most observations agree on
        (``initialize(tracks, robust=True)``), adjust with a Cauchy loss, set aside what is beyond
        six standard deviations of the noise, and adjust the rest with the `loss` asked for, until
        the same is set aside again. A view that would lose most of its observations is first found
        anew from the points that others hold; the flag "strayed views" says that it lost them all
        the same. What was set aside is told in `rejected`; it has no part in cost, RMS,
        flags and rank. Counts and history are those of the last adjustment.
    loss : {"linear", "huber", "soft_l1", "cauchy", "truncated"}
        Loss of each squared residual. A robust one weighs gross errors down from a start that is
        not bent by them; see `robust` for one that finds it.
    loss_scale_px : float or "auto"
        Scale of the loss in pixels; by default from the residuals of the start, which had better
        not be far then.
    ftol, xtol, gtol : float
        As in `epigauge.lm.minimize`; `xtol` and `gtol` depend on the gauge and are off.
    max_iter : int
        Trial steps allowed.
    workers : int
        Most threads that share the points, with the back end "c"; small problems take fewer. The
        same number gives the same result to the last bit; others differ by rounding.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.
    callback : callable, optional
        Called with each row of the history; a true return value stops.

    Returns
    -------
    BundleResult
        Reconstruction, residuals and history.

    Raises
    ------
    ArgumentError
        On unknown names, options that exclude one another, a start of another size, or one so
        degenerate that the steps are undetermined.

    Notes
    -----
    A start is far where half of the residuals are beyond 8 % of the RMS of the image coordinates.
    From there "covariant", with embedded points and without a gauge, first takes up to 15 steps
    with a Cauchy loss of 5 % of it, in which points may also jump to where their lines of sight
    meet: no step of their own takes those on the wrong side of a focal plane across it.
    These steps count as all others do; their rows in the history have the cost asked for, but are
    accepted by the robust one. The result never costs more than the start. From random cameras
    this is not enough: begin with ``initialize(tracks, method="factorization")``.

    From a start so degenerate that no step can be made (all points in one plane, a point in a focal
    plane, all cameras at one place), the adjustment begins once more, a thousandth away.

    References
    ----------
    .. [B03] A. Bartoli, "Towards gauge invariant bundle adjustment", ICCV 2003.

    Examples
    --------
    >>> tracks, scene = eg.load_scene("sparse/0")  # doctest: +SKIP
    >>> eg.bundle_adjust(tracks, scene, refine=("f", "k"), fixed_views=[0])  # doctest: +SKIP
    """
    if not isinstance(tracks, Tracks):
        raise ArgumentError("tracks", f"is a {type(tracks).__name__}", "eg.Tracks(...)")
    fixed_views = listed("fixed_views", fixed_views)
    fixed_points = listed("fixed_points", fixed_points)
    priors = None if priors is None else listed_priors(priors)
    if noise_px != "tracks" and not priors:
        raise ArgumentError("noise_px", "is given without priors", "priors, or the default")
    noise_px = tracks.unit if noise_px == "tracks" else noise_px
    noise_px = noise_px if noise_px is None else as_positive("noise_px", noise_px)
    if lines is not None and (robust or noise_px is None):
        name = "robust" if robust else "noise_px"
        raise ArgumentError(name, "is given with lines", "the default, and a robust loss")
    if robust or noise_px is None:
        options: dict[str, Any] = {
            "refine": refine,
            "fixed_views": fixed_views,
            "fixed_points": fixed_points,
            "priors": priors,
            "method": method,
            "gauge": gauge,
            "gauge_mode": gauge_mode,
            "damping": damping,
            "embedded": embedded,
            "schedule": schedule,
            "ftol": ftol,
            "xtol": xtol,
            "gtol": gtol,
            "max_iter": max_iter,
            "workers": workers,
            "backend": backend,
            "callback": callback,
        }
        if noise_px is None:
            options.update(robust=robust, loss=loss, loss_scale_px=loss_scale_px)

            def adjusted(noise_px: float, start: Any) -> BundleResult:
                return bundle_adjust(tracks, start, noise_px=noise_px, **options)

            return with_estimated_noise(adjusted, tracks, start)
        if priors:
            options["noise_px"] = noise_px
        table = kernels.table(backend)
        start = initialize(tracks, robust=True, backend=backend) if start is None else start
        last = as_choice("loss", loss, LOSSES), loss_scale_px
        held = fixed_indices("fixed_views", fixed_views, tracks.n_views)
        once = partial(bundle_adjust, **options)
        return without_gross_errors(once, tracks, start, table, last, held)
    as_choice("method", method, STRATEGIES)
    as_choice("gauge_mode", gauge_mode, ("explicit", "implicit"))
    as_choice("schedule", schedule, ("auto", *SCHEDULES))
    as_choice("loss", loss, LOSSES)
    if damping is not None:
        as_choice("damping", damping, DAMPINGS)
    gauge = checked_gauge(gauge, method)
    threads = 1
    if not hasattr(workers, "linearizer"):  # what epigauge.distributed passes
        workers = threads = as_count("workers", workers)
    stopping = lm.Stopping(ftol=ftol, xtol=xtol, gtol=gtol, max_iter=max_iter)
    if lines is not None:
        if workers != threads:
            raise ArgumentError("lines", "are given with workers elsewhere", "none, or one machine")
        begin = initialize(tracks, backend=backend) if start is None else start
        mixed = adjusted_lines(
            tracks,
            begin,
            lines,
            method=method,
            gauge=gauge,
            gauge_mode=gauge_mode,
            damping=damping,
            loss=loss,
            loss_scale_px=loss_scale_px,
            backend=backend,
            options={
                "embedded": embedded,
                "schedule": SCHEDULES["adaptive" if schedule == "auto" else schedule],
                "stopping": stopping,
                "callback": callback,
            },
            refine=refine,
            fixed_views=fixed_views,
            fixed_points=fixed_points,
            priors=priors,
            noise_px=noise_px,
        )
        outcome, counts = mixed.outcome, tracks.weights > 0.0
        return BundleResult.unjudged(
            lambda: mixed.verdict,
            reconstruction=mixed.reconstruction,
            rms_px=float(np.sqrt(np.mean(mixed.fun[counts] ** 2))),
            cost=mixed.cost,
            fun=mixed.fun,
            method=method,
            loss_scale_px=mixed.loss_scale_px,
            noise_px=noise_px,
            rejected=np.zeros(len(tracks), dtype=np.bool_),
            nfev=outcome.nfev,
            njev=outcome.njev,
            nit=outcome.nit,
            status=outcome.status,
            history=outcome.history,
            line_fun=mixed.line_fun,
        )
    table = kernels.table(backend)
    start = initialize(tracks, backend=backend) if start is None else start
    job = job_of(
        tracks,
        start,
        refine=refine,
        fixed_views=fixed_views,
        fixed_points=fixed_points,
        priors=priors,
        noise_px=noise_px,
    )
    by_default = "classic" if job.model.homogeneous else "adaptive"
    rule = by_default if schedule == "auto" else schedule
    scale_px = _loss_scale(loss, loss_scale_px, tracks, start)
    outcome, cameras, points = minimized(
        job,
        ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points),
        np.asarray(tracks.weights),
        table,
        method=method,
        gauge=gauge,
        gauge_mode=gauge_mode,
        damping=damping,
        embedded=embedded,
        schedule=SCHEDULES[rule],
        loss=Loss(loss, scale_px / job.scale_px),
        stopping=stopping,
        workers=workers,
        callback=callback,
    )
    reconstruction = job.result(cameras, points)
    stays = (
        fixed_indices("fixed_views", fixed_views, tracks.n_views),
        fixed_indices("fixed_points", fixed_points, tracks.n_points),
    )
    if isinstance(reconstruction, MetricReconstruction | AffineReconstruction):
        fixed = np.zeros(tracks.n_points, dtype=np.bool_)
        fixed[stays[1]] = True
        reference = bool(STRATEGIES[method].reference)
        if isinstance(reconstruction, MetricReconstruction):
            predicted, depths = reconstruction.seen(tracks)
        else:
            predicted, depths = reconstruction.project(tracks), None
        free = fixed, job.fixes_gauge or reference, loss == "linear"

        def judge() -> Verdict:
            evidence = EvidenceOfTracks(tracks, Frame.of(tracks).scale, predicted, depths)
            return judged_metric(evidence, reconstruction, outcome, table, *free)

    else:
        linear = loss == "linear"
        predicted = reconstruction.project(tracks)
        how = linear, table, threads, stays if job.fixes_gauge else None

        def judge() -> Verdict:
            # The arrays of the result can be written to: what is judged is what was found.
            found, none = job.result(cameras, points), np.zeros(len(tracks), np.bool_)
            assert isinstance(found, Reconstruction)
            system: Any = outcome.system if linear else None
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                system = system() if callable(system) else system
            return judged(tracks, found, none, *how, system)

    residuals, counts = tracks.xy - predicted, tracks.weights > 0.0
    counted = residuals if counts.all() else residuals[counts]
    result = BundleResult.unjudged(
        judge,
        reconstruction=reconstruction,
        rms_px=float(np.sqrt(np.vdot(counted, counted) / counted.size)),
        cost=outcome.state.cost * job.scale_px**2,
        fun=residuals,
        method=method,
        loss_scale_px=scale_px,
        noise_px=noise_px,
        rejected=np.zeros(len(tracks), dtype=np.bool_),
        nfev=outcome.nfev,
        njev=outcome.njev,
        nit=outcome.nit,
        status=outcome.status,
        history=outcome.history,
    )
    if workers != 1:
        result.judge()  # while the workers are there: threads do not outlive a fork
    return result


def _loss_scale(
    loss: str,
    loss_scale_px: float | str,
    tracks: Tracks,
    start: AnyReconstruction,
) -> float:
    if loss == "linear":
        return 0.0
    if loss_scale_px != "auto":
        return as_positive("loss_scale_px", loss_scale_px)
    residuals = whitened(tracks.whitening, (tracks.xy - start.project(tracks)).T)
    distances = np.linalg.norm(residuals, axis=0)
    return EFFICIENT[loss] * max(robust_scale(distances[tracks.weights > 0.0]), 1e-12)
