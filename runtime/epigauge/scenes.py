"""Simulated scenes of the papers, with their truth, for experiments, demos and tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_choice, as_count, as_positive
from epigauge.errors import ArgumentError
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import MIN_POINTS, MIN_VIEWS, Tracks

__all__ = ["MultiViewScene", "TwoViewScene", "multi_view_scene", "two_view_scene"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewScene:
    """Two views of random points, and the truth behind them.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Measured points of image 1 and 2, in pixels.
    x1_true, x2_true : ndarray, shape (m, 2)
        The same points without noise.
    F_true : ndarray, shape (3, 3)
        True fundamental matrix, x2^T F x1 = 0, of Frobenius norm 1.
    P1, P2 : ndarray, shape (3, 4)
        True cameras K (R | t), from metres to pixels.
    K : ndarray, shape (3, 3)
        Calibration of both cameras.
    X : ndarray, shape (m, 4)
        Points (x, y, z, 1) in metres; the centre of the cube is the origin.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(n_points=30)
    >>> scene.x1.shape, scene.F_true.shape, float(scene.K[0, 0])
    ((30, 2), (3, 3), 1000.0)
    """

    x1: Array
    x2: Array
    x1_true: Array
    x2_true: Array
    F_true: Array
    P1: Array
    P2: Array
    K: Array
    X: Array


def two_view_scene(
    distance: float = 10.0,
    noise_px: float = 2.0**0.5,
    n_points: int = 50,
    baseline: float = 1.0,
    focal: float = 1000.0,
    cube: float = 1.0,
    motion: Literal["sideways", "forward"] = "sideways",
    seed: int = 0,
) -> TwoViewScene:
    """Simulate the two views of Bartoli and Sturm's experiments.

    Points drawn uniformly in a cube are seen by two equal cameras that look at the cube's centre.
    The defaults are the paper's standard configuration. The origin of the image coordinates is
    the principal point. One seed gives the same points in the cube and the same noise, in units
    of `noise_px`, whatever the other arguments: configurations can be compared trial by trial.

    Parameters
    ----------
    distance : float
        Distance of each camera (``sideways``), or of the middle between them (``forward``), from
        the centre of the cube, in metres.
    noise_px : float
        Standard deviation of the Gaussian noise on each image coordinate, in pixels. The paper's
        2-pixel variance is a deviation of sqrt(2).
    n_points : int
        Number of points.
    baseline : float
        Distance between the cameras, in metres.
    focal : float
        Focal length, in pixels.
    cube : float
        Side of the cube, in metres.
    motion : {"sideways", "forward"}
        Move across the line of sight and turn, or along the line of sight without turning: then
        both epipoles lie at the principal point, amid the points.
    seed : int
        Seed of NumPy's default generator.

    Returns
    -------
    TwoViewScene
        Measurements and truth.

    Raises
    ------
    ArgumentError
        If an argument is out of range, or a camera could have points beside or behind it.

    References
    ----------
    .. [BS04] A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with
       minimal parameters", PAMI 26(3), 2004, section 5.1.1.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.two_view_scene(distance=5.0, n_points=30, seed=1).x1.shape
    (30, 2)
    """
    distance = as_positive("distance", distance)
    baseline = as_positive("baseline", baseline)
    focal = as_positive("focal", focal)
    cube = as_positive("cube", cube)
    noise_px = as_positive("noise_px", noise_px, zero=True)
    n_points = as_count("n_points", n_points)
    as_choice("motion", motion, ("sideways", "forward"))
    nearest = distance - (baseline / 2 if motion == "forward" else 0.0)
    if nearest <= cube * 3**0.5 / 2 or distance <= baseline / 2:
        raise ArgumentError(
            "distance",
            f"is {distance:g} m, with a baseline of {baseline:g} m and a cube of {cube:g} m",
            "cameras outside the cube",
        )

    random = np.random.default_rng(as_count("seed", seed, at_least=0))
    X = np.ones((n_points, 4))
    X[:, :3] = cube * random.uniform(-0.5, 0.5, (n_points, 3))
    noise = noise_px * random.standard_normal((2, n_points, 2))

    if motion == "forward":
        centres = [np.array([0.0, 0.0, -distance + side * baseline / 2]) for side in (-1, 1)]
    else:
        depth = np.sqrt(distance**2 - baseline**2 / 4)
        centres = [np.array([side * baseline / 2, 0.0, -depth]) for side in (-1, 1)]
    K = np.diag([focal, focal, 1.0])
    rotations = [_looking_at_origin(centre) for centre in centres]
    P1, P2 = (
        K @ R @ np.column_stack([np.eye(3), -centre])
        for R, centre in zip(rotations, centres, strict=True)
    )
    x1, x2 = (_project(P, X) for P in (P1, P2))

    # With x_cam2 = R x_cam1 + t, F ~ K^-T [t]x R K^-1.
    R = rotations[1] @ rotations[0].T
    t = rotations[1] @ (centres[0] - centres[1])
    K_inverse = np.diag([1 / focal, 1 / focal, 1.0])
    F = K_inverse @ np.cross(np.eye(3), t).T @ R @ K_inverse
    return TwoViewScene(
        x1=x1 + noise[0],
        x2=x2 + noise[1],
        x1_true=x1,
        x2_true=x2,
        F_true=F / np.linalg.norm(F),
        P1=P1,
        P2=P2,
        K=K,
        X=X,
    )


@dataclass(frozen=True, slots=True, eq=False)
class MultiViewScene:
    """Views of random points, and the truth behind them.

    Parameters
    ----------
    tracks : Tracks
        Measured points, in pixels; the origin is the principal point.
    true : Reconstruction
        True cameras K (R | t), from metres to pixels, and points (x, y, z, 1) in metres; the
        centre of the cube is the origin.
    xy_true : ndarray, shape (N, 2)
        The measured points without noise, in the order of the tracks.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.multi_view_scene(n_points=30)
    >>> scene.tracks.n_points, scene.true.P.shape
    (30, (5, 3, 4))
    """

    tracks: Tracks
    true: Reconstruction
    xy_true: Array


def multi_view_scene(
    flatness: float = 0.5,
    n_views: int = 5,
    n_points: int = 100,
    noise_px: float = 1.0,
    distance: float = 10.0,
    baseline: float = 3.0,
    focal: float = 1000.0,
    cube: float = 1.0,
    visible: float = 1.0,
    seed: int = 0,
) -> MultiViewScene:
    """Simulate the views of Bartoli's gauge experiments.

    Points are offset from a base plane inside a cube and seen by equal cameras on an arc around
    it, which look at its centre. The base plane faces the middle of the arc, and offsets are
    uniform in [0, 2 `flatness`], which the paper does not say: the points fill a slab of that
    thickness in the middle of the cube. The defaults are the paper's, with its strongest geometry.

    Parameters
    ----------
    flatness : float
        Mean offset d of the points from the base plane, in metres; at most half the cube.
    n_views, n_points : int
        Numbers of cameras and points.
    noise_px : float
        Standard deviation of the Gaussian noise on each image coordinate, in pixels.
    distance : float
        Distance of the cameras from the centre of the cube, in metres.
    baseline : float
        Distance between consecutive cameras, in metres.
    focal : float
        Focal length, in pixels.
    cube : float
        Side of the cube, in metres.
    visible : float
        Chance that a point is seen in a view; every point is seen twice at least, and every view
        sees six points.
    seed : int
        Seed of NumPy's default generator. One seed gives the same points, but for their offset's
        scale, whatever the other arguments.

    Returns
    -------
    MultiViewScene
        Measurements and truth.

    Raises
    ------
    ArgumentError
        If an argument is out of range, or a camera could have points beside or behind it.

    References
    ----------
    .. [B03] A. Bartoli, "Towards gauge invariant bundle adjustment", ICCV 2003, section 7.1.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.multi_view_scene(n_points=20, seed=1).tracks
    Tracks(5 views, 20 points, 100 observations)
    """
    distance, baseline = as_positive("distance", distance), as_positive("baseline", baseline)
    focal, cube = as_positive("focal", focal), as_positive("cube", cube)
    flatness = as_positive("flatness", flatness, zero=True)
    noise_px = as_positive("noise_px", noise_px, zero=True)
    visible = as_positive("visible", visible)
    n_views = as_count("n_views", n_views, at_least=MIN_VIEWS)
    n_points = as_count("n_points", n_points, at_least=MIN_POINTS)
    if 2.0 * flatness > cube:
        raise ArgumentError("flatness", f"is {flatness:g} m", f"at most half the cube's {cube:g} m")
    if distance <= cube * 3**0.5 / 2 or distance <= baseline / 2:
        raise ArgumentError(
            "distance",
            f"is {distance:g} m, with a baseline of {baseline:g} m and a cube of {cube:g} m",
            "cameras outside the cube",
        )
    if visible > 1.0:
        raise ArgumentError("visible", f"is {visible:g}", "a share, at most 1")

    random = np.random.default_rng(as_count("seed", seed, at_least=0))
    place = random.uniform(-0.5, 0.5, (n_points, 3))
    Q = np.column_stack([place * [cube, cube, 2.0 * flatness], np.ones(n_points)])
    turn = 2.0 * np.arcsin(baseline / (2.0 * distance))
    angles = turn * (np.arange(n_views) - (n_views - 1) / 2.0)
    K = np.diag([focal, focal, 1.0])
    P = np.stack(
        [
            K @ _looking_at_origin(centre) @ np.column_stack([np.eye(3), -centre])
            for centre in distance * np.column_stack([np.sin(angles), 0 * angles, -np.cos(angles)])
        ]
    )
    noise = noise_px * random.standard_normal((n_points, n_views, 2))
    point, view = np.nonzero(_visibility(random, n_points, n_views, visible))
    true = Reconstruction(P, Q)
    h = np.einsum("nij,nj->ni", P[view], Q[point])
    xy_true = h[:, :2] / h[:, 2:]
    tracks = Tracks(view, point, xy_true + noise[point, view])
    return MultiViewScene(tracks, true, xy_true)


def _visibility(
    random: np.random.Generator, n_points: int, n_views: int, share: float
) -> NDArray[np.bool_]:
    """Draw who sees whom: the least likely pairs are dropped, but for the few each one needs."""
    chance = random.uniform(size=(n_points, n_views))
    rank_of_view = chance.argsort(axis=1).argsort(axis=1)
    rank_of_point = chance.argsort(axis=0).argsort(axis=0)
    needed = (rank_of_view < MIN_VIEWS) | (rank_of_point < MIN_POINTS)
    return np.asarray((chance < share) | needed)


def _looking_at_origin(centre: Array) -> Array:
    """Rotation from the world to a camera whose z axis points at the origin, its y axis along y."""
    z = -centre / np.linalg.norm(centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _project(P: Array, X: Array) -> Array:
    """Project points and divide by their third coordinate."""
    x = X @ P.T
    return x[:, :2] / x[:, 2:]
