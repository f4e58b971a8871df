"""Made-up tracks of cameras that move in some way, for self-calibration."""

from __future__ import annotations

import epigauge as eg
import numpy as np
from epigauge.rotations import from_rodrigues
from numpy.typing import NDArray

SIZE = (800, 600)
CENTRE = np.array([399.5, 299.5])

Array = NDArray[np.float64]


def looking_at(centre: Array, target: Array, roll: float = 0.0) -> Array:
    """Return the rotation of a camera that looks from one point to another."""
    z = target - centre
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return from_rodrigues(np.array([0.0, 0.0, roll])) @ np.stack([x, np.cross(z, x), z])


def poses(motion: str, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return rotations and centres of n cameras about 6 from points around the origin."""
    R, C = np.empty((n, 3, 3)), np.empty((n, 3))
    first = looking_at(np.array([0.2, -0.3, -6.0]), np.zeros(3))
    for i in range(n):
        along = 1.4 * (i / max(n - 1, 1) - 0.5)
        match motion:
            case "general":
                turn = rng.normal(0.0, 0.35, 2)
                C[i] = 6.0 * rng.uniform(0.8, 1.2) * np.array([np.sin(turn[0]), turn[1], -1.0])
                R[i] = looking_at(C[i], rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.4))
            case "translation":
                C[i] = np.array([0.2, -0.3, -6.0]) + rng.normal(0.0, 0.6, 3)
                R[i] = first
            case "rotation":
                C[i] = np.array([0.2, -0.3, -6.0])
                R[i] = from_rodrigues(rng.normal(0.0, 0.08, 3)) @ first
            case "axis":  # on a plane, turned about its normal
                C[i] = [6.0 * np.sin(along), 0.1, -6.0 * np.cos(along)]
                C[i, [0, 2]] *= rng.uniform(0.8, 1.2)
                turn = rng.normal(0.0, 0.06)
                R[i] = from_rodrigues(np.array([0.0, turn, 0.0])) @ looking_at(
                    C[i], np.array([0.0, 0.1, 0.0])
                )
            case "point":  # all towards one point, from one distance
                w = rng.normal(0.0, 0.35, 2)
                C[i] = [np.sin(w[0]) * np.cos(w[1]), np.sin(w[1]), -np.cos(w[0]) * np.cos(w[1])]
                C[i] *= 6.0
                R[i] = looking_at(C[i], np.zeros(3), rng.normal(0.0, 0.3))
            case "table":  # the scene stood on a turntable
                turn = 0.15 * (i - 0.5 * n)
                C[i] = 6.0 * np.array([0.97 * np.sin(turn), -0.25, -0.97 * np.cos(turn)])
                R[i] = looking_at(C[i], np.zeros(3))
    return R, C


def tracks_of(
    motion: str = "general",
    seed: int = 0,
    *,
    n_views: int = 6,
    n_points: int = 150,
    focal: float | Array = 900.0,
    noise_px: float = 0.0,
    bend: float = 0.0,
    wrong: float = 0.0,
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return tracks of SIMPLE_RADIAL cameras, a share of them wrong, and the truth."""
    rng = np.random.default_rng(seed)
    R, C = poses(motion, n_views, rng)
    X = rng.uniform(-1.3, 1.3, (n_points, 3))
    focal = np.broadcast_to(focal, n_views if np.ndim(focal) else 1)
    params = np.column_stack([focal, *np.tile(CENTRE[:, None], len(focal)), 0.0 * focal + bend])
    group = np.arange(n_views) if len(focal) > 1 else np.zeros(n_views, dtype=np.intp)
    t = -np.einsum("nij,nj->ni", R, C)
    scene = eg.MetricReconstruction(R, t, X, eg.Cameras("SIMPLE_RADIAL", params, group))
    sees = rng.random((n_views, n_points)) < 0.85
    sees[:2] = True
    view, point = np.nonzero(sees)
    xy = scene.project(eg.Tracks(view, point, np.zeros((len(view), 2))))
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = xy + rng.normal(0.0, 1.0, xy.shape) * noise_px
    out = rng.random(len(xy)) < wrong
    xy[out] = rng.uniform(0.0, 1.0, (int(out.sum()), 2)) * SIZE
    return eg.Tracks(blank.view, blank.point, xy), scene
