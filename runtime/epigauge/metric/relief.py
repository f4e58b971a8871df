"""Whether a metric scene has depth: a plane, too, can have calibrated cameras.

No homography explains the pairs of a flat scene when the lens bends it, so that two views cannot
tell a bend from depth. Once the distortion is known they can.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import median

__all__ = ["flat"]

Array = NDArray[np.float64]

#: A point is off the plane if that moves one of its images by more than so many standard deviations
#: of a coordinate. Points of a plane move by as many as 4 where few views see them.
_OFF = 10.0

#: Share of points off the plane that wrong tracks explain.
_NONE = 0.05

#: Share of width plus height that is rounding.
_EXACT = 1e-6

#: Rounds of the fit of a plane, and its reach in median distances.
_ROUNDS, _REACH = 20, 1.5


def flat(tracks: Tracks, found: MetricReconstruction, noise_px: float, unit: float) -> bool:
    """Tell whether one plane explains the images of nearly all points within the noise.

    Parameters
    ----------
    tracks : Tracks
        Observations; those without weight do not count.
    found : MetricReconstruction
        Adjusted cameras and points.
    noise_px : float
        Standard deviation of a coordinate.
    unit : float
        Width plus height of the images, in pixels.

    Returns
    -------
    bool
        For cameras that did not move it tells nothing.
    """
    counts = tracks.weights > 0.0
    view, point = tracks.view[counts], tracks.point[counts]
    own, rows = np.unique(point, return_index=True)
    X = found.X[own]
    middle, normal = _plane(X)
    # Each point moves along the ray of its first view: what the others see of that is parallax.
    centres = found.centres[view[rows]]
    rays = X - centres
    with np.errstate(divide="ignore", invalid="ignore"):
        onto = centres + (((middle - centres) @ normal) / (rays @ normal))[:, None] * rays
    good = np.isfinite(onto).all(axis=1)
    moved = found.X.copy()
    moved[own[good]] = onto[good]
    other = MetricReconstruction(found.R, found.t, moved, found.cameras)
    distances = np.linalg.norm(other.project(tracks) - found.project(tracks), axis=1)[counts]
    parallax = np.zeros(tracks.n_points)
    np.maximum.at(parallax, point, np.nan_to_num(distances, nan=np.inf))
    off = ~good | (parallax[own] > max(_OFF * noise_px, _EXACT * unit))
    return bool(np.mean(off) < _NONE)


def _plane(X: Array) -> tuple[Array, Array]:
    """Return a point and the normal of the plane that most points are near to."""
    weights = np.ones(len(X))
    for _ in range(_ROUNDS):
        middle = weights @ X / weights.sum()
        Y = X - middle
        normal = np.linalg.eigh((Y * weights[:, None]).T @ Y)[1][:, 0]
        distances = np.abs(Y @ normal)
        weights = 1.0 / np.maximum(distances, _REACH * median(distances) + 1e-300)
    return middle, normal
