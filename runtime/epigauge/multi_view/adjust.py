"""Bundle adjustment of cameras of any model, with any gauge strategy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

from epigauge import kernels, lm
from epigauge._arguments import as_positive
from epigauge._logged import logged
from epigauge._options import Backend, BundleDamping, GaugeMode, Method, Schedule
from epigauge._options import Loss as LossName
from epigauge.bundle.prior_kinds import Prior, listed_priors
from epigauge.bundle.refinement import fixed_indices, listed
from epigauge.bundle.way import Way
from epigauge.cameras import AnyReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.adjust_points import adjusted_points
from epigauge.multi_view.gauge import Gauge
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.line_adjust import adjusted_lines
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.prior_noise import with_estimated_noise
from epigauge.multi_view.rejection import without_gross_errors
from epigauge.multi_view.repeated import merging_sightings
from epigauge.multi_view.result import BundleResult
from epigauge.multi_view.tracks import Tracks

__all__ = ["BundleResult", "bundle_adjust"]


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
        (``initialize(tracks, robust=True)``), adjust with a Cauchy loss, from points where most
        of their lines of sight meet, set aside what is beyond six standard deviations of the
        noise, and adjust the rest with the `loss` asked for, until the same is set aside again. A
        view that would lose most of its observations is first found anew from the points that
        others hold; the flag "strayed views" says that it lost them all the same. What was set
        aside is told in `rejected`; it has no part in cost, RMS, flags and rank. Counts and
        history are those of the last adjustment.
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
    way = Way(
        method=method,
        gauge=gauge,
        gauge_mode=gauge_mode,
        damping=damping,
        embedded=embedded,
        schedule=schedule,
        loss=loss,
        loss_scale_px=loss_scale_px,
        stopping=lm.Stopping(ftol=ftol, xtol=xtol, gtol=gtol, max_iter=max_iter),
        workers=workers,
        callback=callback,
    )
    known = None if priors is None else listed_priors(priors)
    if noise_px != "tracks" and not known:
        raise ArgumentError("noise_px", "is given without priors", "priors, or the default")
    unit = tracks.unit if noise_px == "tracks" else noise_px
    unit = unit if unit is None else as_positive("noise_px", unit)
    if lines is not None and (robust or unit is None):
        name = "robust" if robust else "noise_px"
        raise ArgumentError(name, "is given with lines", "the default, and a robust loss")
    free: dict[str, Any] = {
        "refine": refine,
        "fixed_views": listed("fixed_views", fixed_views),
        "fixed_points": listed("fixed_points", fixed_points),
        "priors": known,
    }
    table = kernels.table(backend)
    start = initialize(tracks, robust=robust, backend=backend) if start is None else start
    if lines is not None:
        return adjusted_lines(tracks, start, lines, way, table, noise_px=unit, **free)

    def adjusted(noise_px: float, start: Any) -> BundleResult:
        if not robust:
            return adjusted_points(tracks, start, way, table, noise_px=noise_px, **free)

        def again(tracks: Tracks, start: Any, **loss: Any) -> BundleResult:
            how = replace(way, **loss)
            return adjusted_points(tracks, start, how, table, noise_px=noise_px, **free)

        last = way.loss, way.loss_scale_px
        held = (
            fixed_indices("fixed_views", free["fixed_views"], tracks.n_views),
            fixed_indices("fixed_points", free["fixed_points"], tracks.n_points),
        )
        return without_gross_errors(again, tracks, start, table, last, held)

    if unit is None:
        return with_estimated_noise(adjusted, tracks, start)
    return adjusted(unit, start)
