"""What most observations agree on, among gross errors: a pair of views, a camera, points.

Each is proposed from few observations, drawn again and again, and judged by all: the best proposal
is the one that leaves half of the distances smallest. What follows starts from it with a robust
loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.backends import linearizer_for
from epigauge.bundle.linearizer import PointRefinement
from epigauge.bundle.observations import ObservationGraph
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.tracks import Tracks
from epigauge.scatter import spread
from epigauge.two_view.conditioning import condition_raw
from epigauge.two_view.consensus import Consensus
from epigauge.two_view.losses import Loss

__all__ = ["agreed_camera", "agreed_fundamental", "agreed_points", "agreed_positions"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Cameras are proposed from so many points, each size so often, and judged by so many points.
_SIZES, _DRAWS, _JUDGES = (6, 8, 12), 120, 500

#: Standard deviations of matches, in coordinates of RMS two, that a search begins with, and the one
#: that subsets of all matches are judged by.
_SIGMAS, _ROUGH = (0.03, 0.003), 0.01

#: A match agrees within so many standard deviations.
_AGREES = 4.0

#: Pairs of observations that propose a point.
_PAIRS = 12


def agreed_fundamental(kernels: Table, x1: Array, x2: Array) -> tuple[Array, Mask]:
    """Return the F that most matches agree on, and which do.

    Parameters
    ----------
    kernels : Table
        Backend.
    x1, x2 : ndarray, shape (m, 2)
        Matches, at least eight.

    Returns
    -------
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    agrees : ndarray of bool, shape (m,)
        Matches within four standard deviations.

    Raises
    ------
    ArgumentError
        Where fewer than eight matches agree.
    """
    frame, is_near = condition_raw(x1, x2, 8)
    consensus = Consensus(kernels, *frame.forward(x1, x2))
    F = consensus.linear_fits(np.ones((1, consensus.products.shape[1])))[0]
    rng = np.random.default_rng(0)
    rough = replace(consensus.judge(F, _ROUGH), sigma=_ROUGH, share=0.5)
    everything = np.arange(consensus.products.shape[1])
    drawn = consensus.promising(consensus.subset_fits(everything, rng), rough)
    starts = [consensus.judge(one, sigma) for one in (F, *drawn) for sigma in _SIGMAS]
    found = consensus.search(starts, rng)
    agrees = found.inliers(_AGREES * max(found.sigma, 1e-9)) & is_near
    if np.count_nonzero(agrees) < 8:
        raise ArgumentError("x1, x2", "agree on no epipolar geometry", "matches that do")
    return frame.to_pixels(found.F), agrees


def agreed_camera(q: Array, Q: Array) -> Array:
    """Return the camera that leaves half of the points closest to their measurements.

    Parameters
    ----------
    q, Q : ndarray, shape (2, c), (4, c)
        At least six measurements and points.

    Returns
    -------
    ndarray, shape (3, 4)
        A camera of unit norm, to be refined.
    """
    rng = np.random.default_rng(0)
    points, T = spread(Q.T)
    few = np.sort(rng.permutation(len(points))[:_JUDGES])
    X, x = points[few], q.T[few]
    # Rows of the equations (X, 0, -x X) and (0, X, -y X), summed as products of three factors.
    square = X[:, :, None] * X[:, None, :]
    weights = np.stack([np.ones(len(X)), *x.T, np.sum(x**2, axis=1)], axis=1)
    blocks = (weights[:, :, None, None] * square[:, None]).reshape(len(X), -1)
    best, least = np.zeros((3, 4)), np.inf
    for size in _SIZES:
        size = min(size, len(X))
        drawn = np.argsort(rng.random((_DRAWS, len(X))), axis=1)[:, :size]
        sums = blocks[drawn].sum(axis=1).reshape(_DRAWS, 4, 4, 4)
        cameras = _least_algebraic(sums)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            h = cameras @ X.T
            squared = np.sum((h[:, :2] / h[:, 2:] - x.T) ** 2, axis=1)
        # Half of the points, those that a camera is drawn from being right by construction.
        rank = min((len(X) + size + 1) // 2, len(X) - 1)
        middle = np.partition(np.nan_to_num(squared, nan=np.inf), rank, axis=1)[:, rank]
        if middle.min() < least:
            best, least = cameras[np.argmin(middle)], float(middle.min())
    P = best @ np.linalg.inv(T)
    return np.asarray(P / np.linalg.norm(P))


def _least_algebraic(sums: Array) -> Array:
    """Return cameras (k, 3, 4) from the sums of X X^T times 1, x, y and x^2 + y^2."""
    N = np.zeros((len(sums), 12, 12))
    N[:, :4, :4] = N[:, 4:8, 4:8] = sums[:, 0]
    N[:, :4, 8:] = N[:, 8:, :4] = -sums[:, 1]
    N[:, 4:8, 8:] = N[:, 8:, 4:8] = -sums[:, 2]
    N[:, 8:, 8:] = sums[:, 3]
    return np.asarray(np.linalg.eigh(N)[1][:, :, 0].reshape(-1, 3, 4))


def agreed_points(
    kernels: Table,
    graph: ObservationGraph,
    q: Array,
    weights: Array,
    P: Array,
    Q: Array,
    scale: float,
    possible: Callable[[Array], Mask] | None = None,
) -> Array:
    """Return points, each where a pair of its lines of sight meets if that suits the others more.

    Parameters
    ----------
    kernels : Table
        Back end.
    graph : ObservationGraph
        Which observation belongs to what.
    q, weights : ndarray, shape (2, N), (N,)
        Measurements, and factor of each squared residual.
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        Cameras, and points to begin from.
    scale : float
        Distance, in the unit of the problem, at which an observation is doubtful: one loss for all.
    possible : callable, optional
        Tells which of points (m, 4) can be proposed; by default all.

    Returns
    -------
    ndarray, shape (m, 4)
        Points of least Cauchy loss among those proposed, refined.
    """
    model, cameras = camera_model("projective"), P.reshape(-1, 12)
    judge = linearizer_for(model, kernels, graph, q, weights, Loss("cauchy", scale))
    rng = np.random.default_rng(0)
    first, lengths = graph.first[:-1], np.diff(graph.first)
    best, least = Q, _finite(judge.point_costs(cameras, Q))
    for k in range(-1, _PAIRS):
        if k < 0:
            proposed = judge.intersect(cameras)
        else:
            one = rng.integers(0, lengths)
            two = (one + rng.integers(1, np.maximum(lengths, 2))) % lengths
            rows = np.sort(np.column_stack([first + one, first + two]), axis=1).ravel()
            alone = ObservationGraph(
                graph.view[rows], graph.point[rows], graph.n_views, graph.n_points
            )
            measured = np.ascontiguousarray(q[:, rows]), np.ones(len(rows))
            pair = linearizer_for(model, kernels, alone, *measured, Loss())
            proposed = pair.intersect(cameras)
        costs = _finite(judge.point_costs(cameras, proposed))
        better = costs < least
        better &= True if possible is None else possible(proposed)
        best, least = np.where(better[:, None], proposed, best), np.where(better, costs, least)
    return judge.refine_points(cameras, np.ascontiguousarray(best), PointRefinement())[0]


def agreed_positions(
    kernels: Table,
    tracks: Tracks,
    graph: ObservationGraph,
    found: MetricReconstruction,
    scale_px: float,
) -> Array:
    """Return points of a metric scene, each where most of its lines of sight want it.

    Lines of sight are those of the cameras without distortion; only points in front of all views
    that see them are taken.

    Parameters
    ----------
    kernels : Table
        Back end.
    tracks, graph : Tracks, ObservationGraph
        Observations, and which belongs to what.
    found : MetricReconstruction
        Cameras, and points to begin from.
    scale_px : float
        Distance, in pixels, at which an observation is doubtful.

    Returns
    -------
    ndarray, shape (m, 3)
        Points; those that nothing better is found of are as they were.
    """
    model = camera_model(found.cameras.model)
    of_views = found.cameras.of_views
    focal, sense = model.on_axis(of_views)
    unit = float(np.median(focal))
    focal, ahead = focal / unit, sense[tracks.view]
    params = np.ascontiguousarray(of_views[tracks.view].T)
    h, _ = model.directions(np.ascontiguousarray(tracks.xy.T), params)
    known = np.isfinite(h).all(axis=0)
    q = np.ascontiguousarray(np.where(known, focal[tracks.view] * h, 0.0))
    weights = np.where(known, tracks.weights, 0.0)
    P = np.concatenate([found.R, found.t[:, :, None]], axis=2)

    def possible(Q: Array) -> Mask:
        depths = np.einsum("nj,nj->n", P[tracks.view, 2], Q[tracks.point]) * Q[tracks.point, 3]
        hidden = (weights > 0.0) & ~(ahead * depths > 0.0)
        return np.asarray(np.bincount(tracks.point[hidden], minlength=len(Q)) == 0)

    Q = np.column_stack([found.X, np.ones(len(found.X))])
    cameras = P * np.stack([focal, focal, np.ones(len(focal))], axis=1)[:, :, None]
    Q = agreed_points(kernels, graph, q, weights, cameras, Q, scale_px / unit, possible)
    with np.errstate(all="ignore"):
        X = Q[:, :3] / Q[:, 3:]
    taken = possible(Q) & np.isfinite(X).all(axis=1)
    return np.where(taken[:, None], X, found.X)


def _finite(costs: Array) -> Array:
    return np.nan_to_num(costs, nan=np.inf)
