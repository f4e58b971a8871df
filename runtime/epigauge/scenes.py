"""Simulated scenes of the papers, with their truth, for experiments, demos and tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_choice, as_count, as_positive
from epigauge.errors import ArgumentError

__all__ = ["TwoViewScene", "two_view_scene"]

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
    motion: str = "sideways",
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
