"""A metric scene that grows camera by camera, from a guess of the focal length.

Where the views of a scene hang together by what they see of one plane, projective cameras do not
follow from it, and calibrated ones do: each from three points, or two from five matches.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.bundle.prior_kinds import IntrinsicPrior
from epigauge.cameras import Cameras, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError, EpigaugeError
from epigauge.metric.scene import Images, cameras_of, with_all_points
from epigauge.multi_view.adjust import bundle_adjust
from epigauge.multi_view.first_pair import common_points, rows_of
from epigauge.multi_view.three_points import agreed_pose
from epigauge.multi_view.tracks import MIN_VIEWS, Tracks
from epigauge.two_view.calibrated import estimate_essential

__all__ = ["grown"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Observations within this share of width plus height agree with a scene that grows.
_WITHIN = 2e-3

#: Pairs with most points in common that are tried to begin with, and the angle between the rays of
#: a good one; less counts in proportion.
_PAIRS, _ANGLE = 6, np.deg2rad(10.0)

#: A view needs so many points that agree, and this share of those it sees.
_LEAST, _SHARE = 12, 0.2

#: Focal lengths of a camera that are tried with its first view, in those of the guess; by how much
#: the guess may be wrong, as a share; views without which focal lengths are held.
_RATIOS, _UNSURE, _TELL = np.geomspace(0.4, 2.5, 9), 0.5, 4

#: Everything is adjusted with each view of a few, and when there are so many times the views.
_FEW, _GROWN = 20, 1.15


def grown(
    tracks: Tracks, images: Images, camera: str, focal_px: Array, options: dict[str, Any]
) -> MetricReconstruction | None:
    """Return a metric scene of all views, found one by one.

    Parameters
    ----------
    tracks : Tracks
        Observations, gross errors among them.
    images : Images
        Sizes and cameras.
    camera : str
        Name of the model.
    focal_px : ndarray, shape (n,)
        Guess of the focal length of each view.
    options : dict
        ``workers`` and ``backend`` of the adjustments.

    Returns
    -------
    MetricReconstruction or None
        None where not all views are found.
    """
    growth = _Growth(tracks, images, camera, focal_px, options)
    if not growth.begin():
        return None
    while not growth.registered.all():
        if not growth.register():
            return None
    return growth.whole()


class _Growth:
    """Cameras and points known so far."""

    def __init__(
        self, tracks: Tracks, images: Images, camera: str, focal_px: Array, options: dict[str, Any]
    ) -> None:
        self.tracks, self.images, self.options = tracks, images, options
        self.model, self.kernels = camera_model(camera), kernels.table(options["backend"])
        self.cameras = cameras_of(camera, focal_px, images)
        self.guess = images.of_group(focal_px)
        n, m = tracks.n_views, tracks.n_points
        self.R, self.t, self.X = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((m, 3))
        self.registered = np.zeros(n, dtype=np.bool_)
        self.counts = tracks.weights > 0.0
        #: Observations that agree, of views that are registered; new ones are taken to.
        self.agrees = self.counts.copy()
        self.adjusted = 0

    @property
    def focal(self) -> Array:
        """Focal length of each view."""
        mean = self.cameras.params[:, list(self.model.focal)].mean(axis=1)
        return np.asarray(mean[self.images.group])

    def begin(self) -> bool:
        """Start with two views of many points and a good angle between their rays."""
        above = common_points(self.tracks)
        best, chosen = 0.0, None
        for flat in np.argsort(-above, axis=None, kind="stable")[:_PAIRS].tolist():
            i, k = divmod(flat, len(above))
            found = self._pair(i, k)
            if found is not None and found[0] > best:
                best, chosen = found[0], (i, k, *found[1:])
        if chosen is None:
            return False
        i, k, self.R[k], self.t[k], rows, agrees = chosen
        self.registered[[i, k]] = True
        for own in rows:
            self.agrees[own[~agrees]] = False
        return self._adjust()

    def _pair(self, i: int, k: int) -> tuple[float, Array, Array, Any, Any] | None:
        """Return how good a pair is to begin with, its motion, its rows and which agree."""
        rows = rows_of(self.tracks, i), rows_of(self.tracks, k)
        both = np.flatnonzero((rows[0] >= 0) & (rows[1] >= 0))
        if len(both) < 2 * _LEAST:
            return None
        own = rows[0][both], rows[1][both]
        focal = self.focal
        x1, x2 = (
            self.tracks.xy[r] - self.images.centres[v] for r, v in zip(own, (i, k), strict=True)
        )
        K1, K2 = (np.diag([focal[v], focal[v], 1.0]) for v in (i, k))
        try:
            found = estimate_essential(x1, x2, K1, K2, seed=0)
        except EpigaugeError:
            return None
        if found.R is None or found.t is None:
            return None
        first = np.column_stack([x1 / focal[i], np.ones(len(x1))]) @ np.asarray(found.R).T
        second = np.column_stack([x2 / focal[k], np.ones(len(x2))])
        cosines = np.sum(first * second, axis=1)
        cosines /= np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        inlier = np.asarray(found.inlier)
        if np.count_nonzero(inlier) < _LEAST:
            return None
        angle = float(np.median(np.arccos(np.clip(cosines[inlier], -1.0, 1.0))))
        good = np.count_nonzero(inlier) * min(angle / _ANGLE, 1.0)
        return good, np.asarray(found.R), np.asarray(found.t), own, inlier

    def register(self) -> bool:
        """Find one more view, of most known points first; tell whether any was found."""
        tracks = self.tracks
        own = self.registered[tracks.view] & self.agrees
        known = np.bincount(tracks.point[own], minlength=tracks.n_points) >= MIN_VIEWS
        seen = known[tracks.point] & ~self.registered[tracks.view] & self.counts
        counts = np.bincount(tracks.view[seen], minlength=tracks.n_views)
        for view in np.argsort(-counts, kind="stable").tolist():
            if counts[view] < _LEAST:
                return False
            if self._found(view, np.flatnonzero(seen & (tracks.view == view))):
                n = np.count_nonzero(self.registered)
                if n <= _FEW or n >= _GROWN * self.adjusted or self.registered.all():
                    return self._adjust()
                return True
        return False

    def _found(self, view: int, rows: Indices) -> bool:
        """Find a view from points, and its focal length where no other view of its camera tells."""
        c = int(self.images.group[view])
        told = (self.registered & (self.images.group == c)).any()
        focal = self.focal[view] * (np.ones(1) if told else _RATIOS)
        within = _WITHIN * float(self.images.unit[view])
        x = self.tracks.xy[rows] - self.images.centres[view]
        pose = agreed_pose(self.kernels, x, self.X[self.tracks.point[rows]], focal, within)
        if pose is None or np.count_nonzero(pose.inlier) < max(_LEAST, _SHARE * len(rows)):
            return False
        self.R[view], self.t[view] = pose.R, pose.t
        params = self.cameras.params.copy()
        params[c, list(self.model.focal)] = pose.focal
        self.cameras = Cameras(self.model.name, params, self.images.group)
        self.registered[view] = True
        self.agrees[rows[~pose.inlier]] = False
        return True

    def _part(
        self, rows: NDArray[np.bool_]
    ) -> tuple[Tracks, MetricReconstruction, Indices, Indices, Indices]:
        """Return some observations, their views with points anew; old views, points, cameras."""
        lengths = np.bincount(self.tracks.point[rows], minlength=self.tracks.n_points)
        part, views, points = self.tracks.subset(
            rows & (lengths[self.tracks.point] >= MIN_VIEWS), min_points=1
        )
        numbers, group = np.unique(self.images.group[views], return_inverse=True)
        cameras = Cameras(self.model.name, self.cameras.params[numbers], group)
        images = Images(self.images.sizes[views], group)
        blank = MetricReconstruction(
            self.R[views], self.t[views], np.zeros((len(points), 3)), cameras
        )
        scene = with_all_points(blank, part, images, self.kernels)
        return part, scene, views, points, numbers

    def _adjust(self) -> bool:
        """Adjust everything known, and tell anew which observations agree."""
        tracks = self.tracks
        try:
            part, scene, views, points, numbers = self._part(
                self.agrees & self.registered[tracks.view]
            )
            if len(views) < np.count_nonzero(self.registered):
                return False
            names = [self.model.params[k] for k in self.model.focal]
            free = names if len(views) >= _TELL else "pose"
            priors = [
                IntrinsicPrior(c, name, float(self.guess[g]), _UNSURE * float(self.guess[g]))
                for c, g in enumerate(numbers.tolist())
                for name in names
            ]
            found = bundle_adjust(
                part,
                scene,
                refine=free,
                priors=None if free == "pose" else priors,
                loss="cauchy",
                ftol=1e-3,
                max_iter=10,
                **self.options,
            ).reconstruction
        except ArgumentError:
            return False
        assert isinstance(found, MetricReconstruction)
        self.R[views], self.t[views], self.X[points] = found.R, found.t, found.X
        params = self.cameras.params.copy()
        params[numbers] = found.cameras.params
        self.cameras = Cameras(self.model.name, params, self.images.group)
        self.adjusted = len(views)
        self._compare(points)
        return True

    def _compare(self, points: Indices) -> None:
        """Tell which observations of registered views agree, of points that have a place."""
        tracks = self.tracks
        whole = MetricReconstruction(self.R, self.t, self.X, self.cameras)
        placed = np.zeros(tracks.n_points, dtype=np.bool_)
        placed[points] = True
        away = np.linalg.norm(tracks.xy - whole.project(tracks), axis=1)
        near = (away < _WITHIN * self.images.unit[tracks.view]) & (whole.depths(tracks) > 0.0)
        own = placed[tracks.point] & self.registered[tracks.view]
        self.agrees = self.counts & np.where(own, near, True)

    def whole(self) -> MetricReconstruction:
        """Return all cameras, and all points from observations that agree, or any."""
        agreed = np.where(self.agrees, self.tracks.weights, 1e-3 * self.tracks.weights)
        blank = MetricReconstruction(self.R, self.t, self.X, self.cameras)
        return with_all_points(blank, self.tracks.weighted(agreed), self.images, self.kernels)
