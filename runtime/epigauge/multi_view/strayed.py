"""Views whose cameras are wrong among right ones: told by what they reject, and found anew.

A camera that begins far from its place is given up by a robust loss: it ends where a few of its
points agree with it by chance, and the others are set aside. But the other views hold these points,
and the camera follows from them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.kernels import Table
from epigauge.multi_view.agreement import agreed_camera
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.resection import resect
from epigauge.multi_view.three_points import agreed_pose
from epigauge.multi_view.tracks import MIN_POINTS, MIN_VIEWS, Tracks
from epigauge.multi_view.verdicts.gross import STRAYED

__all__ = ["found_anew", "strayed"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Where more than this share of a view's observations is set aside, its camera is looked for
#: elsewhere, and taken where so many times as many agree.
_MANY, _MORE = 0.2, 1.1

#: Half a turn about the x axis: cameras that look along -z as if they did along z.
_HALF_TURN = np.diag([1.0, -1.0, -1.0])


def strayed(tracks: Tracks, rejected: Mask, share: float = STRAYED) -> Indices:
    """Return the views of whose observations more than a share, most, are set aside.

    Parameters
    ----------
    tracks : Tracks
        Observations; those of weight zero do not count.
    rejected : ndarray of bool, shape (N,)
        What is set aside.
    share : float
        The share.
    """
    counts = tracks.weights > 0.0
    every, aside = (
        np.bincount(tracks.view[rows], minlength=tracks.n_views)
        for rows in (counts, counts & rejected)
    )
    return np.flatnonzero(aside > share * every)


def found_anew(
    kernels: Table, tracks: Tracks, found: Any, rejected: Mask, fixed: Indices, limit: float
) -> Any | None:
    """Return a reconstruction in which doubtful views are found from the points of others.

    A view is doubtful where more than a fifth of its observations is set aside.

    Parameters
    ----------
    kernels : Table
        Back end.
    tracks : Tracks
        Observations.
    found : Reconstruction or MetricReconstruction
        Cameras and points.
    rejected : ndarray of bool, shape (N,)
        What is set aside of them.
    fixed : ndarray of int
        Views that stay where they are.
    limit : float
        Largest distance of an observation that agrees, times the root of its weight, in pixels.

    Returns
    -------
    Reconstruction, MetricReconstruction or None
        None where no view has a camera that more of its observations agree with.
    """
    if not isinstance(found, Reconstruction | MetricReconstruction):
        return None
    views = np.setdiff1d(strayed(tracks, rejected, _MANY), fixed)
    if not len(views):
        return None
    counts = tracks.weights > 0.0
    holds = counts & ~rejected & ~np.isin(tracks.view, views)
    held = np.bincount(tracks.point[holds], minlength=tracks.n_points) >= MIN_VIEWS

    def agreeing(scene: Any) -> Indices:
        """Return how many observations of points that others hold agree, of each view."""
        with np.errstate(all="ignore"):
            away = np.linalg.norm(tracks.xy - scene.project(tracks), axis=1)
            near = counts & held[tracks.point] & (np.sqrt(tracks.weights) * away <= limit)
        return np.bincount(tracks.view[near], minlength=tracks.n_views)

    proposed: Any = found
    for view in views.tolist():
        rows = np.flatnonzero(counts & held[tracks.point] & (tracks.view == view))
        if len(rows) >= MIN_POINTS:
            proposed = _seen_anew(kernels, tracks, proposed, view, rows, limit)
    better = agreeing(proposed) > _MORE * agreeing(found)
    if not better.any():
        return None
    kept = better[:, None]
    if isinstance(found, Reconstruction):
        return Reconstruction(np.where(kept[:, None], proposed.P, found.P), found.Q)
    R = np.where(kept[:, None], proposed.R, found.R)
    return replace(found, R=R, t=np.where(kept, proposed.t, found.t))


def _seen_anew(
    kernels: Table, tracks: Tracks, found: Any, view: int, rows: Indices, limit: float
) -> Any:
    """Return the reconstruction with the camera of a view that most of its points agree on."""
    points = tracks.point[rows]
    if isinstance(found, Reconstruction):
        frame = Frame.of(tracks)
        q, Q = frame.points_in(tracks.xy[rows], tracks.view[rows]), found.Q[points].T
        P = frame.cameras_in(found.P)
        P[view] = resect(kernels, q, Q, agreed_camera(q, Q))
        return Reconstruction(frame.cameras_out(P), found.Q)
    model, params = camera_model(found.cameras.model), found.cameras.of_views[view]
    (f,), (along,) = model.on_axis(params[None])
    h, _ = model.directions(tracks.xy[rows].T, np.tile(params[:, None], len(rows)))
    sees = np.isfinite(h).all(axis=0)
    turn = np.eye(3) if along > 0.0 else _HALF_TURN
    # Of the plane one away behind the camera, seen through its centre
    rays = (h if along > 0.0 else h * [[-1.0], [1.0]])[:, sees]
    pose = agreed_pose(kernels, f * rays.T, found.X[points[sees]], np.array([f]), limit)
    if pose is None:
        return found
    R, t = found.R.copy(), found.t.copy()
    R[view], t[view] = turn @ pose.R, turn @ pose.t
    return replace(found, R=R, t=t)
