"""Standard deviations of focal lengths, with what a model leaves out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.uncertainty.scatter import scatter_of

__all__ = ["focal_lengths_of", "known_to", "turn_std"]

Array = NDArray[np.float64]

#: Share of a focal length that is unknown where a model has one for both axes. In published
#: calibrations fx and fy differ by up to 0.17 %: one number for both is anywhere between them.
_ONE_FOR_BOTH = 0.0017 / np.sqrt(12.0)

#: Views that scatter so many times as much as noise ever lets them show an error of the model.
_CLEARLY = 2.0

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
    cameras = known.reconstruction.cameras
    model = camera_model(cameras.model)
    wanted = np.zeros(len(model.adjusted))
    wanted[list(model.focal)] = 1.0 / len(model.focal)
    blocks = [known.intrinsics(c) for c in range(len(cameras))]
    std = np.sqrt([max(float(wanted @ block @ wanted), 0.0) for block in blocks])
    factor, erroneous = 1.0, False
    if known.noise_px > _EXACT * unit:
        scatter = scatter_of(known, wanted)
        factor = scatter.factor
        erroneous = scatter.ratio > _CLEARLY * scatter.limit
    std = factor * std
    if len(model.focal) == 1:
        std = np.hypot(std, _ONE_FOR_BOTH * focal_lengths_of(known.reconstruction))
    return std, factor, erroneous


def turn_std(known: MetricCovariance) -> float:
    """Return the median standard deviation of the rotations, radians."""
    n = known.reconstruction.n_views
    variances = [np.trace(known.camera(i)[:3, :3]) for i in range(n)]
    return float(np.sqrt(np.median(variances)))
