"""Standard deviations of focal lengths, with what a model leaves out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.prior_kinds import IntrinsicPrior
from epigauge.cameras import Cameras, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.metric.usual import BEND_KNOWN, CENTRE_KNOWN
from epigauge.multi_view.adjust import bundle_adjust
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.uncertainty import covariance
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.uncertainty.scatter import scatter_of

__all__ = [
    "beside_the_bend",
    "beside_the_held",
    "beside_the_model",
    "focal_lengths_of",
    "known_to",
    "turn_std",
]

Array = NDArray[np.float64]

#: Share of a focal length that is unknown where a model has one for both axes. In published
#: calibrations fx and fy differ by up to 0.17 %: one number for both is anywhere between them.
_ONE_FOR_BOTH = 0.0017 / np.sqrt(12.0)

#: Views that scatter so many times as much as noise ever lets them show an error of the model.
_CLEARLY = 2.0

#: Models that are part of a richer one, and what its parameters are called there.
_RICHER, _NAMES = "OPENCV", {"f": ("fx", "fy"), "k": ("k1",)}
_PARTS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")

#: Relative decrease of the cost that ends the richer adjustment.
_SHIFTED = 1e-4

#: Views of a camera that determine the richer model, at least.
_VIEWS = 4

#: Noise below this share of width plus height is rounding, which hangs together as it likes.
_EXACT = 1e-6


def focal_lengths_of(found: MetricReconstruction) -> Array:
    """Return the focal length of each camera, the mean of both where there are two."""
    places = list(camera_model(found.cameras.model).focal)
    return np.asarray(found.cameras.params[:, places].mean(axis=1))


def known_to(known: MetricCovariance, unit: float) -> tuple[Array, float, bool]:
    """Return the standard deviation of each focal length, and whether the model is in error.

    Parameters
    ----------
    known : MetricCovariance
        Of the adjustment.
    unit : float
        Width plus height of the images, in pixels.

    Returns
    -------
    std : ndarray, shape (c,)
        To first order, widened where the views contradict one another, and by what a model with one
        focal length for both axes leaves open.
    factor : float
        By how much it was widened for the views.
    erroneous : bool
        Whether they clearly contradict one another.
    """
    model = camera_model(known.reconstruction.cameras.model)
    wanted, variances = _focal(known)
    std = np.sqrt(variances)
    factor, erroneous = 1.0, False
    if known.noise_px > _EXACT * unit:
        scatter = scatter_of(known, wanted)
        factor = scatter.factor
        erroneous = scatter.ratio > _CLEARLY * scatter.limit
    std = factor * std
    if len(model.focal) == 1:
        std = np.hypot(std, _ONE_FOR_BOTH * focal_lengths_of(known.reconstruction))
    return std, factor, erroneous


def beside_the_model(
    tracks: Tracks, known: MetricCovariance, backend: str | None, workers: int = 1
) -> Array:
    """Return how far a richer camera model moves each focal length, beyond what noise would.

    Two estimates of one quantity, one of them with more unknowns, differ by the noise of what the
    richer one knows less [1]_. What they differ by more the poorer model has put into the focal
    length: tangential distortion, a second radial term, axes of different length.

    Parameters
    ----------
    tracks : Tracks
        What was adjusted, with its weights.
    known : MetricCovariance
        Of the adjustment, with all parameters of the model refined.
    backend : str or None
        Where the formulas are computed.
    workers : int
        Threads.

    Returns
    -------
    ndarray, shape (c,)
        In pixels; zero where the views do not determine a richer model, or there is none.

    References
    ----------
    .. [1] J. A. Hausman, "Specification tests in econometrics", Econometrica 46(6), 1978.
    """
    poor = known.reconstruction
    none = np.zeros(len(poor.cameras))
    views = np.bincount(poor.cameras.camera_of_view)
    if poor.cameras.model not in _PARTS or views.min() < _VIEWS:
        return none
    options: Any = {"workers": workers, "backend": backend}
    try:
        found = bundle_adjust(tracks, _richer(poor), ftol=_SHIFTED, max_iter=20, **options)
        rich = found.reconstruction
        assert isinstance(rich, MetricReconstruction)
        sure = covariance(tracks, rich, noise_px=known.noise_px, backend=backend)
    except ArgumentError:
        return none
    shift = focal_lengths_of(rich) - focal_lengths_of(poor)
    by_noise = np.maximum(_focal(sure)[1] - _focal(known)[1], 0.0)
    return np.asarray(np.sqrt(np.maximum(shift**2 - by_noise, 0.0)))


def beside_the_bend(tracks: Tracks, known: MetricCovariance, options: Any) -> Array:
    """Return what each focal length is uncertain by as far as the distortion alone determines it.

    Of most motions a little: the distortion shows in the images themselves. Where views turn about
    one axis, or look at one point, one number trades for the other, and what the distortion is
    wrong by, as any model of a real lens is, is in the focal length many times over. So the focal
    length counts as known no better than without distortion: how far it is from there, and what it
    is uncertain by there, less the noise by which two estimates differ that have one in the other.

    Parameters
    ----------
    tracks : Tracks
        What was adjusted, with its weights.
    known : MetricCovariance
        Of the adjustment.
    options : dict
        Of `covariance`, as of the adjustment: what was refined, and the back end.

    Returns
    -------
    ndarray, shape (c,)
        In pixels; infinite where the other intrinsics are open without distortion, too.
    """
    bent = known.reconstruction
    model = camera_model(bent.cameras.model)
    straight = np.array([name[0] in "fc" for name in model.params])
    cameras = Cameras(
        model.name, np.where(straight, bent.cameras.params, 0.0), bent.cameras.camera_of_view
    )
    start = MetricReconstruction(bent.R, bent.t, bent.X, cameras)
    plainly = options | {"refine": tuple(name for name in options["refine"] if name[0] in "fc")}
    try:
        # To the end: the valley is long.
        plain = bundle_adjust(tracks, start, max_iter=100, **plainly).reconstruction
        assert isinstance(plain, MetricReconstruction)
        sure = covariance(tracks, plain, noise_px=known.noise_px, **plainly)
    except ArgumentError:
        return np.full(len(cameras), np.inf)
    shift = focal_lengths_of(plain) - focal_lengths_of(bent)
    by_noise = _focal(known)[1] - _focal(sure)[1]  # negative where only the distortion tells
    return np.asarray(np.sqrt(np.maximum(shift**2 - by_noise, 0.0)))


def beside_the_held(tracks: Tracks, known: MetricCovariance, unit: float, options: Any) -> Array:
    """Return what each focal length is uncertain by as intrinsics were held that are not known.

    A principal point is left at the centre where the motion does not determine it. It is somewhere
    near, though, and where it is moves the focal length, by more than noise does in just these
    motions. So with the distortion. They are unknowns here, known as of usual cameras.

    Parameters
    ----------
    tracks : Tracks
        What was adjusted, with its weights.
    known : MetricCovariance
        Of the adjustment.
    unit : float
        Width plus height of the images, in pixels.
    options : dict
        Of `covariance`, as of the adjustment: what was refined (not all), the back end, priors.

    Returns
    -------
    ndarray, shape (c,)
        In pixels.
    """
    found = known.reconstruction
    model = camera_model(found.cameras.model)
    held = [name for name in model.adjusted if name not in options["refine"]]
    usual = tuple(
        IntrinsicPrior(c, name, row[model.params.index(name)], sigma)
        for c, row in enumerate(found.cameras.params)
        for name in held
        for sigma in [CENTRE_KNOWN * unit if name in ("cx", "cy") else BEND_KNOWN]
    )
    freed = {"refine": model.adjusted, "priors": (*options.get("priors", ()), *usual)}
    every = covariance(tracks, found, **options | freed | {"noise_px": known.noise_px})
    return np.asarray(np.sqrt(np.maximum(_focal(every)[1] - _focal(known)[1], 0.0)))


def _richer(found: MetricReconstruction) -> MetricReconstruction:
    """Return the same cameras as those of the richer model."""
    old, new = camera_model(found.cameras.model), camera_model(_RICHER)
    params = np.zeros((len(found.cameras), len(new.params)))
    for k, name in enumerate(old.params):
        for other in _NAMES.get(name, (name,)):
            params[:, new.params.index(other)] = found.cameras.params[:, k]
    cameras = Cameras(_RICHER, params, found.cameras.camera_of_view)
    return MetricReconstruction(found.R, found.t, found.X, cameras)


def _focal(known: MetricCovariance) -> tuple[Array, Array]:
    """Return the weights of parameters in the mean focal length, and its variances, (c,)."""
    cameras = known.reconstruction.cameras
    model = camera_model(cameras.model)
    wanted = np.zeros(len(model.adjusted))
    wanted[list(model.focal)] = 1.0 / len(model.focal)
    blocks = [known.intrinsics(c) for c in range(len(cameras))]
    return wanted, np.array([max(float(wanted @ block @ wanted), 0.0) for block in blocks])


def turn_std(known: MetricCovariance) -> float:
    """Return the median standard deviation of the rotations, radians."""
    n = known.reconstruction.n_views
    variances = [np.trace(known.camera(i)[:3, :3]) for i in range(n)]
    return float(np.sqrt(np.median(variances)))
