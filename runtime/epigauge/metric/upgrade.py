"""From tracks to calibrated cameras: projective, then a metric basis, then metric adjustment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_count
from epigauge._options import UpgradeModel
from epigauge.bundle.prior_kinds import IntrinsicPrior
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.metric.checks import images_of, priors_of
from epigauge.metric.result import MetricUpgrade, nothing
from epigauge.metric.samples import sampled
from epigauge.metric.scene import with_all_points
from epigauge.metric.search import MODELS, Search, metric_of
from epigauge.metric.verdict import judged, noise_px
from epigauge.multi_view.adjust import BundleResult, bundle_adjust
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.rejection import GrossErrors, with_set_aside
from epigauge.multi_view.tracks import Tracks

__all__ = ["metric_upgrade"]

#: Relative decrease of the cost that ends the adjustment whose residuals only tell gross errors,
#: and the last ones: of 1e5 observations the latter leaves a few hundredths of a deviation.
_EARLY, _LATE = 1e-2, 1e-8

#: Last adjustments at most, and the share of the observations that may change sides after them.
_ROUNDS, _SETTLED = 4, 1e-3


def metric_upgrade(
    tracks: Tracks,
    reconstruction: Reconstruction | None = None,
    *,
    image_size: ArrayLike,
    shared: bool | ArrayLike = True,
    camera: UpgradeModel = "SIMPLE_RADIAL",
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
    images = images_of(tracks, image_size, shared)
    if camera not in MODELS:
        raise ArgumentError("camera", f"is {camera!r:.60}", f"one of {', '.join(MODELS)}")
    workers = as_count("workers", workers)
    if reconstruction is not None:
        size = len(reconstruction.P), len(reconstruction.Q)
        if size != (tracks.n_views, tracks.n_points):
            was = f"is of {size[0]} views and {size[1]} points"
            needed = f"{tracks.n_views} and {tracks.n_points}, as the tracks"
            raise ArgumentError("reconstruction", was, needed)
    known = priors_of(priors, camera, int(images.group.max()) + 1)
    search = Search(sampled(tracks), images, camera, workers, backend, known)
    fit = search.run(reconstruction)
    if fit is None:
        return nothing(tracks, images, search.flags)
    start = fit.reconstruction
    if not search.sample.whole:
        start = with_all_points(start, tracks, images, kernels.table(backend))
    refined = tuple(prior for prior in known if prior.name in fit.refined)
    options: Any = {"refine": fit.refined, "priors": refined or None}
    options |= {"workers": workers, "backend": backend}
    try:
        bundle = _adjusted(tracks, start, options, backend)
    except ArgumentError:  # so degenerate that no step can be made
        return nothing(tracks, images, ("undetermined",))
    return judged(tracks, images, search, fit, bundle, backend)


def _adjusted(
    tracks: Tracks, start: MetricReconstruction, options: Any, backend: str | None
) -> BundleResult:
    """Return the adjustment without gross errors, and without points behind cameras that see them.

    These agree with the cameras by chance: two of their observations are on epipolar lines. A
    robust adjustment that stops early tells what to set aside; the rest is adjusted to the end.
    """
    search = GrossErrors(tracks, kernels.table(backend))
    given = np.asarray(tracks.weights)

    def robust(start: MetricReconstruction) -> BundleResult:
        return bundle_adjust(tracks, start, loss="cauchy", ftol=_EARLY, **options)

    found = search.settled(robust, start, np.zeros(0, np.intp))
    aside = _aside(search, found)
    if options["priors"]:  # they count beside the noise
        options = options | {"noise_px": noise_px(found, tracks, aside | (given == 0.0))}
    for _ in range(_ROUNDS):
        kept = tracks.weighted(np.where(aside, 0.0, given))
        found = bundle_adjust(kept, metric_of(found), ftol=_LATE, **options)
        before, aside = aside, _aside(search, found)
        if np.mean(aside != before) < _SETTLED:
            break
    flags = set(found.flags)
    if (metric_of(found).depths(tracks) > 0.0)[~before & (given > 0.0)].all():
        flags.discard("behind the cameras")
    return with_set_aside(found, tracks, before, flags)


def _aside(search: GrossErrors, bundle: BundleResult) -> NDArray[np.bool_]:
    """Return observations that are gross errors, and those of points behind their cameras."""
    tracks, found = search.tracks, metric_of(bundle)
    gross = search.gross(found, bundle.fun)
    behind = np.zeros(tracks.n_points, dtype=np.bool_)
    behind[tracks.point[search.counts & ~gross & ~(found.depths(tracks) > 0.0)]] = True
    return np.asarray(gross | (search.counts & behind[tracks.point]))
