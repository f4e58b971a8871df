"""From tracks to calibrated cameras: projective, then a metric basis, then metric adjustment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_array, as_count, as_real
from epigauge._results import Result
from epigauge.bundle.prior_kinds import IntrinsicPrior
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.metric.deviation import beside_the_model, focal_lengths_of, known_to, turn_std
from epigauge.metric.motion import motion_flags
from epigauge.metric.pair import OPEN, WEAK
from epigauge.metric.samples import sampled
from epigauge.metric.scene import Images, with_all_points
from epigauge.metric.search import MODELS, Candidate, Fit, Search, metric_of
from epigauge.multi_view.adjust import BundleResult, bundle_adjust
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.rejection import GrossErrors
from epigauge.multi_view.tracks import MIN_VIEWS, Tracks
from epigauge.multi_view.uncertainty import covariance
from epigauge.two_view.losses import median
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.verdicts import FLAGS, ordered, usable

__all__ = ["MetricUpgrade", "metric_upgrade"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Relative decrease of the cost that ends the adjustment whose residuals only tell gross errors,
#: and the last ones: of 1e5 observations the latter leaves a few hundredths of a deviation.
_EARLY, _LATE = 1e-2, 1e-8

#: Median distance of two normal coordinates of standard deviation one.
_MEDIAN = 1.1774

#: Last adjustments at most, and the share of the observations that may change sides after them.
_ROUNDS, _SETTLED = 4, 1e-3


@dataclass(frozen=True)
class MetricUpgrade(Result):
    """A metric scene from tracks alone, and what is known of its cameras.

    Attributes
    ----------
    reconstruction : MetricReconstruction or None
        Cameras and points after metric adjustment; None where nothing was found, then `flags` say
        why.
    focal_px, focal_std_px : float or ndarray, shape (c,)
        Focal length in pixels and its standard deviation, of one camera, or of each of several (the
        mean of fx and fy of models that have both). The deviation is that of `covariance`, wider
        where views contradict one another beyond the noise ("model error"), with what a richer
        model (OPENCV) moves the focal length by beyond the noise, and with 0.05 % of models that
        have one focal length for both axes, which real cameras do not have exactly. It is infinite
        where nothing determines the focal length.
    flags : tuple of str
        From `epigauge.verdicts.FLAGS`.
    success : bool
        Whether the scene may be used: adjusted, and determined.
    message : str
        How it ended.
    rms_px : float
        Of the observations that were not set aside, per coordinate.
    noise_px : float
        Standard deviation of an image coordinate, estimated.
    rejected : ndarray of bool, shape (N,)
        Observations that were set aside as gross errors.
    refined : tuple of str
        Intrinsics that the tracks determine, and that were refined; the others are where they
        began: principal points in the centre, no distortion.
    candidates : tuple of Candidate
        Metric bases that were tried, the one taken first.
    bundle : BundleResult or None
        The last adjustment.
    covariance : MetricCovariance or None
        Of everything, by the noise of independent observations alone: `focal_std_px` is wider.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> result = eg.metric_upgrade(tracks, image_size=(512, 512))
    >>> result.success, result.reconstruction.cameras.model, "weak focal length" in result.flags
    (True, 'SIMPLE_RADIAL', True)
    """

    reconstruction: MetricReconstruction | None = field(repr=False)
    focal_px: float | Array
    focal_std_px: float | Array
    flags: tuple[str, ...]
    success: bool
    message: str
    rms_px: float
    noise_px: float
    rejected: NDArray[np.bool_] = field(repr=False)
    refined: tuple[str, ...]
    candidates: tuple[Candidate, ...] = field(repr=False)
    bundle: BundleResult | None = field(repr=False)
    covariance: MetricCovariance | None = field(repr=False)

    def _contents(self) -> dict[str, Any]:
        """Return what is known; `bundle` would tell the scene twice, and has a form of its own."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in own.items() if name != "bundle"}

    def _arrays(self) -> dict[str, Any]:
        """Return what arrays can hold."""
        left = "candidates", "covariance"
        return {name: value for name, value in self._contents().items() if name not in left}

    def kept(self, tracks: Tracks) -> tuple[Tracks, MetricReconstruction]:
        """Return the observations that were not set aside, and the scene of what they show.

        Parameters
        ----------
        tracks : Tracks
            Those that `metric_upgrade` was given.

        Returns
        -------
        tracks : Tracks
            Points with two good observations or more, renumbered; all views.
        reconstruction : MetricReconstruction
            Cameras, and these points.

        Raises
        ------
        ArgumentError
            Where there is no scene, or nothing is left of some view.
        """
        if self.reconstruction is None:
            raise ArgumentError("result", "has no scene", "tracks that determine one")
        good = ~self.rejected & (tracks.weights > 0.0)
        lengths = np.bincount(tracks.point[good], minlength=tracks.n_points)
        good &= lengths[tracks.point] >= MIN_VIEWS
        part, views, points = tracks.subset(good, min_points=1)
        lost = np.setdiff1d(np.arange(tracks.n_views), views)
        if len(lost):
            was = f"leave no good observation of view {lost[0]}"
            raise ArgumentError("tracks", was, "a scene without that view")
        scene = self.reconstruction
        return part, MetricReconstruction(scene.R, scene.t, scene.X[points], scene.cameras)


def metric_upgrade(
    tracks: Tracks,
    reconstruction: Reconstruction | None = None,
    *,
    image_size: ArrayLike,
    shared: bool | ArrayLike = True,
    camera: str = "SIMPLE_RADIAL",
    priors: Iterable[IntrinsicPrior] | None = None,
    workers: int = 1,
    backend: str | None = None,
) -> MetricUpgrade:
    """Reconstruct calibrated cameras and points from tracks, knowing nothing of the cameras.

    A projective reconstruction of some of the tracks is brought into the basis in which its cameras
    have square pixels and principal points near the centres [1]_; then all of them are adjusted,
    with the intrinsics free, and gross errors set aside.

    Parameters
    ----------
    tracks : Tracks
        Observations, gross errors included.
    reconstruction : Reconstruction, optional
        Projective cameras and points of all tracks to begin with; by default found from the tracks.
    image_size : array_like, shape (2,) or (n, 2)
        Width and height in pixels of all images, or of each.
    shared : bool or array_like of int, shape (n,)
        True: one camera took all views. False: each view has a camera of its own. Numbers: the
        camera of each view, from 0; its views have one size.
    camera : str
        Model of the cameras: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or
        FULL_OPENCV.
    priors : iterable of IntrinsicPrior, optional
        What is known of intrinsics, such as focal lengths from EXIF data: it counts by its `sigma`
        beside the noise of the tracks, and can determine what the motion leaves open.
    workers : int
        Threads, as of `bundle_adjust`.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.

    Returns
    -------
    MetricUpgrade
        Scene, focal lengths with their standard deviations, and flags. Where the views do not
        determine it (a camera that only turned, or only moved without turning), `success` is False.

    Raises
    ------
    ArgumentError
        If sizes or cameras do not fit the tracks.

    Notes
    -----
    Principal points and distortion are refined as far as the tracks determine them. Of two views
    only the focal length is.

    The motion is named where it is one that self-calibration has trouble with: "pure translation",
    "pure rotation", "one rotation axis", "one viewing point". With square pixels the latter two
    often determine everything; the standard deviations tell.

    References
    ----------
    .. [1] M. Pollefeys, R. Koch, L. Van Gool, "Self-calibration and metric reconstruction in spite
       of varying and unknown intrinsic camera parameters", IJCV 32(1), 1999.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.multi_view_scene(n_views=6, noise_px=0.3, focal=900.0, seed=1)
    >>> found = eg.metric_upgrade(scene.tracks, image_size=(800, 600))  # doctest: +SKIP
    """
    images = _images(tracks, image_size, shared)
    if camera not in MODELS:
        raise ArgumentError("camera", f"is {camera!r:.60}", f"one of {', '.join(MODELS)}")
    workers = as_count("workers", workers)
    if reconstruction is not None:
        size = len(reconstruction.P), len(reconstruction.Q)
        if size != (tracks.n_views, tracks.n_points):
            was = f"is of {size[0]} views and {size[1]} points"
            needed = f"{tracks.n_views} and {tracks.n_points}, as the tracks"
            raise ArgumentError("reconstruction", was, needed)
    known = _priors(priors, camera, int(images.group.max()) + 1)
    search = Search(sampled(tracks), images, camera, workers, backend, known)
    fit = search.run(reconstruction)
    if fit is None:
        return _nothing(tracks, images, search.flags)
    start = fit.reconstruction
    if not search.sample.whole:
        start = with_all_points(start, tracks, images, kernels.table(backend))
    refined = tuple(prior for prior in known if prior.name in fit.refined)
    options: Any = {"refine": fit.refined, "priors": refined or None}
    options |= {"workers": workers, "backend": backend}
    try:
        bundle = _adjusted(tracks, start, options, backend)
    except ArgumentError:  # so degenerate that no step can be made
        return _nothing(tracks, images, ("undetermined",))
    return _judged(tracks, images, search, fit, bundle, backend)


def _adjusted(
    tracks: Tracks, start: MetricReconstruction, options: Any, backend: str | None
) -> BundleResult:
    """Return the adjustment without gross errors, and without points behind cameras that see them.

    These agree with the cameras by chance: two of their observations are on epipolar lines. A
    robust adjustment that stops early tells what to set aside; the rest is adjusted to the end.
    """
    search = GrossErrors(tracks, kernels.table(backend))
    given = np.asarray(tracks.weights)
    found = bundle_adjust(tracks, start, loss="cauchy", ftol=_EARLY, **options)
    aside = _aside(search, found)
    if options["priors"]:  # they count beside the noise
        options = options | {"noise_px": _noise_px(found, tracks, aside | (given == 0.0))}
    for _ in range(_ROUNDS):
        kept = tracks.weighted(np.where(aside, 0.0, given))
        found = bundle_adjust(kept, metric_of(found), ftol=_LATE, **options)
        before, aside = aside, _aside(search, found)
        if np.mean(aside != before) < _SETTLED:
            break
    flags = set(found.flags)
    if (metric_of(found).depths(tracks) > 0.0)[~before & (given > 0.0)].all():
        flags.discard("behind the cameras")
    count = f"{np.count_nonzero(before)} of {len(tracks)}"
    message = f"{found.message}; {count} observations set aside as gross errors"
    return replace(found, rejected=before, flags=ordered(flags), message=message)


def _aside(search: GrossErrors, bundle: BundleResult) -> NDArray[np.bool_]:
    """Return observations that are gross errors, and those of points behind their cameras."""
    tracks, found = search.tracks, metric_of(bundle)
    gross = search.gross(found, bundle.fun)
    behind = np.zeros(tracks.n_points, dtype=np.bool_)
    behind[tracks.point[search.counts & ~gross & ~(found.depths(tracks) > 0.0)]] = True
    return np.asarray(gross | (search.counts & behind[tracks.point]))


def _judged(
    tracks: Tracks,
    images: Images,
    search: Search,
    fit: Fit,
    bundle: BundleResult,
    backend: str | None,
) -> MetricUpgrade:
    """Return the result of an adjustment, with standard deviations and flags."""
    found = metric_of(bundle)
    focal, known = focal_lengths_of(found), None
    weights = np.where(bundle.rejected, 0.0, tracks.weights)
    flags, turned, factor = set(bundle.flags), 0.0, 1.0
    std, beside = np.full(len(focal), np.inf), np.zeros(len(focal))
    try:
        options: Any = {"refine": fit.refined, "backend": backend}
        priors = tuple(prior for prior in search.priors if prior.name in fit.refined)
        if priors:
            options |= {"priors": priors, "noise_px": _noise_px(bundle, tracks, weights == 0.0)}
        kept = tracks.weighted(weights)
        known = covariance(kept, found, **options)
        std, factor, erroneous = known_to(known, float(np.median(images.unit)))
        if fit.refined == camera_model(search.camera).adjusted and not search.priors:
            beside = beside_the_model(kept, known, backend, search.options["workers"])
        if erroneous:
            flags.add("model error")
    except ArgumentError:
        flags.add("undetermined")
    with np.errstate(invalid="ignore"):
        share = np.nan_to_num(std / focal, nan=np.inf)
    if (np.hypot(share, beside / focal) > WEAK).any():
        flags.add("weak focal length")
    # By the noise alone: what a lens does beside tells nothing of the motion.
    if known is not None and (share > WEAK * factor).any():
        turned = turn_std(known)
    motion = set(motion_flags(found, images, turned))
    if (share > OPEN * factor).any():
        flags.add("undetermined")
    elif search.priors:  # these determine what the motion does not
        motion.discard("pure translation")
    flags |= motion
    of_sample = np.isin(tracks.point, search.sample.points)
    if search.misfit(fit, median(np.linalg.norm(bundle.fun[of_sample], axis=1))):
        flags.add("unlike cameras")
    std = np.hypot(std, beside)
    listed = ordered(flags)
    spoiling = [f"{name}: {FLAGS[name].sentence}" for name in listed if not usable([name], "views")]
    one = len(focal) == 1
    return MetricUpgrade(
        reconstruction=found,
        focal_px=float(focal[0]) if one else focal,
        focal_std_px=float(std[0]) if one else std,
        flags=listed,
        success=bundle.status > 0 and not spoiling,
        message="; but ".join([bundle.message.split("; but ")[0], *spoiling]),
        rms_px=_rms_px(bundle, weights),
        noise_px=float("nan") if known is None else known.noise_px,
        rejected=bundle.rejected,
        refined=fit.refined,
        candidates=fit.candidates,
        bundle=bundle,
        covariance=known,
    )


def _noise_px(bundle: BundleResult, tracks: Tracks, aside: NDArray[np.bool_]) -> float:
    """Return the standard deviation of a coordinate of what is not set aside, robustly."""
    distances = np.linalg.norm(bundle.fun[~aside], axis=1)
    unknowns = 6 * tracks.n_views + 3 * len(np.unique(tracks.point[~aside]))
    free = max(1.0 - unknowns / max(2 * len(distances), 1), 0.05)
    return max(median(distances) / _MEDIAN / float(np.sqrt(free)), 1e-9)


def _rms_px(bundle: BundleResult, weights: Array) -> float:
    kept = bundle.fun[weights > 0.0]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")


def _nothing(tracks: Tracks, images: Images, flags: tuple[str, ...]) -> MetricUpgrade:
    """Return that there is no metric scene, and why."""
    count = int(images.group.max()) + 1
    nan, inf = np.full(count, np.nan), np.full(count, np.inf)
    sentences = [f"{name}: {FLAGS[name].sentence}" for name in flags]
    return MetricUpgrade(
        reconstruction=None,
        focal_px=float("nan") if count == 1 else nan,
        focal_std_px=float("inf") if count == 1 else inf,
        flags=flags,
        success=False,
        message="; ".join(["no metric scene was found", *sentences]),
        rms_px=float("nan"),
        noise_px=float("nan"),
        rejected=np.zeros(len(tracks), dtype=np.bool_),
        refined=(),
        candidates=(),
        bundle=None,
        covariance=None,
    )


def _images(tracks: Tracks, image_size: ArrayLike, shared: bool | ArrayLike) -> Images:
    """Check sizes and cameras."""
    n = tracks.n_views
    sizes = as_real("image_size", image_size, "(width, height), or a row a view")
    if sizes.shape not in ((2,), (n, 2)):
        raise ArgumentError("image_size", f"has shape {sizes.shape}", f"(2,) or ({n}, 2)")
    if not (np.isfinite(sizes) & (sizes >= 1.0)).all():
        raise ArgumentError("image_size", "is not positive everywhere", "pixels")
    sizes = np.broadcast_to(sizes, (n, 2)).astype(np.float64)
    outside = np.any((tracks.xy < -0.5 * sizes[tracks.view]), axis=1)
    outside |= np.any(tracks.xy > 1.5 * sizes[tracks.view], axis=1)
    if outside.mean() > 0.5:
        was = "does not fit the tracks: most are far outside the images"
        raise ArgumentError("image_size", was, "width, height in the pixels of the tracks")
    if isinstance(shared, bool | np.bool_):
        group = np.zeros(n, dtype=np.intp) if shared else np.arange(n)
    else:
        group = _groups(shared, n)
    for c in range(int(group.max()) + 1):
        if len(np.unique(sizes[group == c], axis=0)) > 1:
            was = f"gives camera {c} images of different sizes"
            raise ArgumentError("shared", was, "one size a camera; False for a camera a view")
    return Images(sizes, group)


def _priors(
    priors: Iterable[IntrinsicPrior] | None, camera: str, count: int
) -> tuple[IntrinsicPrior, ...]:
    """Check what is known of the cameras."""
    found, names = tuple(priors or ()), camera_model(camera).adjusted
    for prior in found:
        if not isinstance(prior, IntrinsicPrior):
            raise ArgumentError("priors", f"holds a {type(prior).__name__}", "eg.IntrinsicPrior")
        if prior.name not in names or not 0 <= prior.camera < count:
            was = f"names {prior.name!r:.40} of camera {prior.camera}"
            raise ArgumentError("priors", was, f"{', '.join(names)} of cameras 0 to {count - 1}")
        if not (np.isfinite(prior.value) and np.isfinite(prior.sigma) and prior.sigma > 0.0):
            was = f"gives {prior.name} as {prior.value} +- {prior.sigma}"
            raise ArgumentError("priors", was, "finite numbers, the deviation positive")
    return found


def _groups(shared: ArrayLike, n: int) -> Indices:
    group = as_array("shared", shared, "True, False or a number a view")
    if group.shape != (n,) or group.dtype.kind not in "iu":
        was = f"is {group.dtype} {group.shape}"
        raise ArgumentError("shared", was, f"True, False, or integers ({n},)")
    if (group < 0).any() or len(np.unique(group)) != int(group.max()) + 1:
        raise ArgumentError("shared", "leaves numbers out", "cameras numbered from 0 without gaps")
    return group.astype(np.intp)
