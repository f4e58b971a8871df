"""Calibrated cameras and points from a metric basis, and points from calibrated cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.run import bundle_problem
from epigauge.cameras import Cameras, MetricReconstruction, camera_model
from epigauge.kernels import Table
from epigauge.metric.quadric import Basis, Views
from epigauge.multi_view.plausible import depth_signs
from epigauge.multi_view.tracks import Tracks

__all__ = ["Images", "cameras_of", "metric_scene", "with_all_points"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Depth of points whose rays do not meet in front, in median depths.
_FAR = 30.0


class Images:
    """Sizes of the images, and which camera took which.

    Parameters
    ----------
    sizes : ndarray, shape (n, 2)
        Width and height of each view.
    group : ndarray of int, shape (n,)
        Camera of each view.
    """

    def __init__(self, sizes: Array, group: Indices) -> None:
        self.sizes, self.group = sizes, group
        self.unit = sizes.sum(axis=1)
        #: Principal points to begin with: (0, 0) is the centre of the first pixel.
        self.centres = 0.5 * (sizes - 1.0)

    def points_in(self, xy: Array, view: Indices) -> Array:
        """Return points about the centres in units of width plus height, (2, N)."""
        centred = (xy - self.centres[view]) / self.unit[view, None]
        return np.ascontiguousarray(centred.T)

    def cameras_in(self, P: Array) -> Array:
        """Return cameras to those units from cameras to pixels."""
        moved = P / self.unit[:, None, None]
        moved[:, :2] -= self.centres[:, :, None] / self.unit[:, None, None] * P[:, 2:]
        moved[:, 2] = P[:, 2]
        return np.asarray(moved)

    def of_group(self, values: Array) -> Array:
        """Return the first value of each group, of values (n, ...) equal in each."""
        return np.asarray(values[np.unique(self.group, return_index=True)[1]])


def metric_scene(
    views: Views, Q: Array, basis: Basis, tracks: Tracks, images: Images, camera: str
) -> tuple[MetricReconstruction, float]:
    """Return calibrated cameras and points, and the share of observations in front of cameras.

    Parameters
    ----------
    views : Views
        Projective cameras.
    Q : ndarray, shape (m, 4)
        Points in their basis.
    basis : Basis
        Metric basis.
    tracks : Tracks
        Observations.
    images : Images
        Sizes.
    camera : str
        Name of the model.

    Returns
    -------
    MetricReconstruction
        Principal points in the centres, no distortion, focal lengths in pixels as the basis has
        them; the scene is not mirrored, and its cameras are about a distance of one from it.
    ahead : float
        Share of the observations whose points the basis puts in front of their cameras.
    """
    M, X = views.P @ basis.H, Q @ np.linalg.inv(basis.H).T
    signs = depth_signs(M, X[tracks.point], tracks.view)
    counts = tracks.weights > 0.0
    ahead = float(np.mean(signs[counts] > 0.0))
    if ahead < 0.5:  # the basis mirrors the scene
        ahead = float(np.mean(signs[counts] < 0.0))
        M, X = M * np.array([1.0, 1.0, 1.0, -1.0]), X * np.array([1.0, 1.0, 1.0, -1.0])
    log_f = views.common(views.intrinsics(basis.H)[0][0])
    focal = np.exp(log_f)
    M = M * np.sign(np.linalg.det(M[:, :, :3]))[:, None, None]
    M[:, :2] /= focal[:, None, None]
    U, sizes, Vt = np.linalg.svd(M[:, :, :3])
    R = U @ Vt
    t = M[:, :, 3] / sizes.mean(axis=1)[:, None]
    cameras = cameras_of(camera, focal * images.unit, images)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = X[:, :3] / X[:, 3:]
    return _framed(R, t, points, cameras, tracks), ahead


def with_all_points(
    found: MetricReconstruction, tracks: Tracks, images: Images, kernels: Table
) -> MetricReconstruction:
    """Return the cameras with all points of other tracks, triangulated linearly.

    Parameters
    ----------
    found : MetricReconstruction
        Cameras.
    tracks : Tracks
        All observations.
    images : Images
        Sizes.
    kernels : Table
        Backend.

    Returns
    -------
    MetricReconstruction
        The cameras as they are; points that are not in front of theirs go far away on a ray.
    """
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    straight = tracks.xy - _bend(found, tracks)
    q = images.points_in(straight, tracks.view)
    P = images.cameras_in(found.P)
    P = (P / np.linalg.norm(P, axis=(1, 2))[:, None, None]).reshape(-1, 12)
    parts = kernels, graph, q, np.asarray(tracks.weights)
    Q = bundle_problem(camera_model("projective"), *parts).linearizer.intersect(P)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = Q[:, :3] / Q[:, 3:]
    return _framed(found.R, found.t, points, found.cameras, tracks)


def cameras_of(camera: str, focal_px: Array, images: Images) -> Cameras:
    """Return cameras of a model with focal lengths and centres, without distortion."""
    model = camera_model(camera)
    params = np.zeros((images.group.max() + 1, len(model.params)))
    params[:, list(model.focal)] = images.of_group(focal_px)[:, None]
    centre = [model.params.index("cx"), model.params.index("cy")]
    params[:, centre] = images.of_group(images.centres)
    return Cameras(camera, params, images.group)


def _bend(found: MetricReconstruction, tracks: Tracks) -> Array:
    """Return how far the lens moves the observed points, to first order, (N, 2)."""
    K = found.P[:, :, :3] @ np.swapaxes(found.R, 1, 2)
    focal, centre = K[:, [0, 1], [0, 1]][tracks.view], K[:, :2, 2][tracks.view]
    h = np.column_stack([(tracks.xy - centre) / focal, np.ones(len(tracks))])
    image = camera_model(found.cameras.model).kernel("image")
    params = found.cameras.of_views[tracks.view]
    bent = image(np.ascontiguousarray(h.T), np.ascontiguousarray(params.T))[0].T
    return np.asarray(bent - tracks.xy)


def _framed(R: Array, t: Array, X: Array, cameras: Cameras, tracks: Tracks) -> MetricReconstruction:
    """Return a scene with every point in front of the cameras that see it, of median depth one."""
    rows = np.einsum("nj,nj->n", R[tracks.view, 2], X[tracks.point]) + t[tracks.view, 2]
    counts = tracks.weights > 0.0
    good = np.isfinite(rows) & (rows > 0.0)
    typical = float(np.median(rows[good & counts])) if (good & counts).any() else 1.0
    wrong = np.zeros(len(X), dtype=np.bool_)
    wrong[tracks.point[~good | (rows > _FAR * typical)]] = True
    # On a ray of each: the last row of a point is the one that stays.
    row = np.zeros(len(X), dtype=np.intp)
    row[tracks.point] = np.arange(len(tracks))
    some = row[wrong]
    view = tracks.view[some]
    params = cameras.of_views[view]
    model = camera_model(cameras.model)
    centre = params[:, [model.params.index("cx"), model.params.index("cy")]]
    rays = np.column_stack(
        [(tracks.xy[some] - centre) / params[:, list(model.focal)], np.ones(len(some))]
    )
    depth = np.full(len(some), _FAR * typical)
    X = X.copy()
    X[wrong] = np.einsum("nji,nj->ni", R[view], depth[:, None] * rays - t[view])
    return MetricReconstruction(R, t / typical, X / typical, cameras)
