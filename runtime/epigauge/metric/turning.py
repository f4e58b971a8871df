"""Cameras that only turned, or nearly so, through any lens: known before any scene is sought.

Distortion hides from two views that no point has parallax: no homography explains them, and a scene
of another focal length nearly does. Cameras in one place, with distortion, explain all views.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.prior_kinds import IntrinsicPrior, PositionPrior
from epigauge.cameras import Cameras, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.metric.scene import Images, cameras_of
from epigauge.metric.usual import BENDS, TURNING_FOCALS
from epigauge.multi_view.adjust import bundle_adjust
from epigauge.multi_view.first_pair import MIN_MATCHES, common_points, rows_of
from epigauge.multi_view.tracks import Tracks
from epigauge.rotations import rodrigues
from epigauge.two_view.losses import median

__all__ = ["Turned", "turned"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Points of a pair of views that this is done by, at most, and rounds of it, each robust by the
#: distances of the one before.
_POINTS, _ROUNDS = 100, 5

#: The median distance then of cameras that may have turned only, and of those that have, once they
#: are adjusted: shares of width plus height.
_NEAR, _FINE = 1e-2, 1e-3

#: Cameras that may move explain the views no better, if the noise they leave is not less than so.
_AS_WELL = 0.85

#: An observation beyond so many median distances is a gross error.
_GROSS = 3.0

#: How exactly positions are held; distances of points are one.
_HELD = 1e-6

#: Turns that move the images by so many median distances are none: the camera stood still.
_STILL = 5.0


@dataclass(frozen=True)
class Turned:
    """Cameras in one place that nearly explain the tracks.

    Attributes
    ----------
    fun : ndarray, shape (N, 2)
        What they leave of the observations, in pixels.
    moving : MetricReconstruction
        The nearest cameras that may move.
    tracks : Tracks
        The observations.
    """

    fun: Array
    moving: MetricReconstruction
    tracks: Tracks

    def explains_as_well(self, fun: Array) -> bool:
        """Tell whether moving cameras with these residuals leave as much for each free number.

        Of the observations that are no gross errors of the cameras in one place.
        """
        counts, n = self.tracks.weights > 0.0, self.tracks.n_views
        m = len(np.unique(self.tracks.point[counts]))
        distances = np.linalg.norm(self.fun, axis=1)
        counts &= distances < _GROSS * median(distances[counts])
        free = 2.0 * np.count_nonzero(counts) - np.array([3 * n + 2 * m, 6 * n + 3 * m])
        there, moving = (float(np.sum(r[counts] ** 2)) for r in (self.fun, fun))
        # With nothing left over nothing shows that they moved.
        return bool(moving / max(free[1], 1.0) > _AS_WELL**2 * there / max(free[0], 1.0))


def turned(
    tracks: Tracks,
    images: Images,
    camera: str,
    priors: tuple[IntrinsicPrior, ...],
    options: dict[str, Any],
) -> Turned | None:
    """Return cameras in one place, where they nearly explain the tracks.

    Parameters
    ----------
    tracks : Tracks
        Observations, gross errors among them.
    images : Images
        Sizes and cameras.
    camera : str
        Name of the model.
    priors : tuple of IntrinsicPrior
        What is known of the cameras.
    options : dict
        ``workers`` and ``backend`` of the adjustments.

    Returns
    -------
    Turned or None
        None for cameras that did not turn either.
    """
    start = _turned(tracks, images, camera)
    if start is None:
        return None
    held = [PositionPrior(view, np.zeros(3), sigma=_HELD) for view in range(tracks.n_views)]
    options = options | {"loss": "cauchy", "ftol": 1e-4, "max_iter": 40}
    try:
        there = bundle_adjust(tracks, start, priors=[*held, *priors], **options)
        found = there.reconstruction
        assert isinstance(found, MetricReconstruction)
        typical = median(np.linalg.norm(there.fun[tracks.weights > 0.0], axis=1))
        focal = found.cameras.params[:, list(camera_model(camera).focal)]
        turns = rodrigues(np.swapaxes(found.R[:1], 1, 2) @ found.R)
        still = np.linalg.norm(turns, axis=1).max() * float(focal.min()) < _STILL * typical
        if still or typical > _FINE * float(images.unit.min()):
            return None
        moving = bundle_adjust(tracks, found, priors=priors or None, **options).reconstruction
    except ArgumentError:
        return None
    assert isinstance(moving, MetricReconstruction)
    return Turned(there.fun, moving, tracks)


def _turned(tracks: Tracks, images: Images, camera: str) -> MetricReconstruction | None:
    """Return cameras in one place, or None where none are near what the views see."""
    joined = _joined(common_points(tracks))
    if joined is None:
        return None
    model = camera_model(camera)
    bend = next((name for name in ("k", "k1") if name in model.params), None)
    shares, bends = (
        grid.ravel() for grid in np.meshgrid(TURNING_FOCALS, BENDS if bend is not None else [0.0])
    )
    # In width plus height; a point as far out as f is seen with a bend of k: rays (x, f (1 + k)).
    x = images.points_in(tracks.xy, tracks.view).T
    squares = np.sum(x**2, axis=1)
    third = shares[:, None] * (1.0 + bends[:, None] * squares / shares[:, None] ** 2)
    rows = [rows_of(tracks, view) for view in range(tracks.n_views)]
    R = np.zeros((tracks.n_views, len(shares), 3, 3))
    R[joined[0][0]] = np.eye(3)
    away = []
    for i, k in joined:
        both = np.flatnonzero((rows[i] >= 0) & (rows[k] >= 0))
        both = both[:: -(-len(both) // _POINTS)]
        sides = [_rays(x[rows[view][both]], third[:, rows[view][both]]) for view in (i, k)]
        turn, distances = _turn(*sides)
        R[k] = turn @ R[i]
        away.append(shares * distances)
    typical = np.median(away, axis=0)
    best = int(np.argmin(typical))
    if typical[best] > _NEAR:
        return None
    own = np.swapaxes(R[:, best], 1, 2)[tracks.view]
    ahead = (own @ _rays(x, third[best : best + 1])[0][:, :, None])[:, :, 0]
    X = np.zeros((tracks.n_points, 3))
    np.add.at(X, tracks.point, ahead)
    X /= np.maximum(np.linalg.norm(X, axis=1), 1e-12)[:, None]
    cameras = cameras_of(camera, shares[best] * images.unit, images)
    if bend is not None:
        params = np.where(np.array(model.params) == bend, bends[best], cameras.params)
        cameras = Cameras(camera, params, images.group)
    return MetricReconstruction(R[:, best], np.zeros((tracks.n_views, 3)), X, cameras)


def _joined(above: Array) -> list[tuple[int, int]] | None:
    """Return pairs of most common points that lead from one view to all others in turn."""
    common = above + above.T
    reached = common.max(axis=1) == common.max()
    reached[np.argmax(reached) + 1 :] = False
    pairs = []
    while not reached.all():
        among = np.where(reached[:, None] & ~reached, common, -1.0)
        i, k = divmod(int(np.argmax(among)), len(common))
        if common[i, k] < MIN_MATCHES:
            return None
        pairs.append((i, k))
        reached[k] = True
    return pairs


def _rays(x: Array, third: Array) -> Array:
    """Return unit rays (g, N, 3) of image points (N, 2) for g third coordinates (g, N)."""
    rays = np.concatenate([np.broadcast_to(x, (len(third), *x.shape)), third[..., None]], axis=2)
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def _turn(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the rotations that take rays (g, N, 3) to others, and median distances, (g,)."""
    weights = np.ones(first.shape[:2])
    for _ in range(_ROUNDS):
        U, _, Vt = np.linalg.svd(np.swapaxes(weights[..., None] * second, 1, 2) @ first)
        U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
        R = U @ Vt
        distances = np.linalg.norm(second - first @ np.swapaxes(R, 1, 2), axis=2)
        typical = np.maximum(np.median(distances, axis=1), 1e-12)
        weights = 1.0 / (1.0 + (distances / typical[:, None]) ** 2)
    return R, typical
