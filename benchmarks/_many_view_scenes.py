"""The problems of the many-view benchmarks: simulated scenes and the BAL sets."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
from epigauge.io.tracks import load_track_file

Problem = tuple[eg.Tracks, eg.Reconstruction]

#: Size of the cube of points, distance of the cameras from it, in metres, focal length in pixels.
CUBE, DISTANCE, FOCAL = 1.0, 10.0, 1000.0


def banded(
    n: int, m: int, seen: int = 10, window: int = 20, arc: float = 5.0, seed: int = 0
) -> Problem:
    """Return cameras on an arc (radians), each point in some of so many consecutive views.

    Nothing of size n m is formed. Noise of 1 px; the start is the truth with relative noise of a
    thousandth in the cameras and 1 cm in the points.
    """
    rng = np.random.default_rng(seed)
    angles = np.linspace(-arc / 2.0, arc / 2.0, n)
    centres = DISTANCE * np.column_stack(
        [np.sin(angles), 0.1 * np.sin(7.0 * angles), -np.cos(angles)]
    )
    P = np.empty((n, 3, 4))
    for camera, centre in zip(P, centres, strict=True):
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        camera[...] = np.diag([FOCAL, FOCAL, 1.0]) @ np.column_stack([R, -R @ centre])
    Q = np.column_stack([CUBE * rng.uniform(-0.5, 0.5, (m, 3)), np.ones(m)])
    width = min(window, n)
    first = rng.integers(0, n - width + 1, m)
    chosen = rng.random((m, width)).argsort(axis=1)[:, : min(seen, width)]
    view, point = (first[:, None] + chosen).ravel(), np.repeat(np.arange(m), chosen.shape[1])
    h = np.einsum("nij,nj->ni", P[view], Q[point])
    xy = h[:, :2] / h[:, 2:] + rng.standard_normal((len(view), 2))
    start = eg.Reconstruction(
        P * (1.0 + 1e-3 * rng.standard_normal(P.shape)),
        Q + np.column_stack([1e-2 * rng.standard_normal((m, 3)), np.zeros(m)]),
    )
    return eg.Tracks(view, point, xy, n_views=n), start


def street(
    n: int = 372, m: int = 50_000, seen: float = 4.3, most: int = 40, seed: int = 0
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return what a vehicle sees on its way, a camera of its own each metre, as BAL's Ladybug sets.

    Tracks of consecutive views have geometric lengths from two on, so many on average; noise of
    half a pixel; the reconstruction is the truth.
    """
    rng = np.random.default_rng(seed)
    heading = np.cumsum(0.03 * rng.standard_normal(n))
    forward = np.column_stack([np.sin(heading), np.zeros(n), np.cos(heading)])
    centres = np.cumsum(forward, axis=0)
    right = np.column_stack([np.cos(heading), np.zeros(n), -np.sin(heading)])
    down = np.broadcast_to([0.0, 1.0, 0.0], (n, 3))
    # BAL's cameras look along -z, with y upwards.
    R = np.stack([right, -down, -forward], axis=1)
    t = -np.einsum("nij,nj->ni", R, centres)
    length = np.minimum(1 + rng.geometric(1.0 / (seen - 1.0), m), min(most, n))
    first = (rng.random(m) * (n - length + 1)).astype(np.intp)
    last = first + length - 1
    ahead, side, high = (
        rng.uniform(4.0, 20.0, m),
        rng.uniform(3.0, 10.0, m),
        rng.normal(0.0, 2.0, m),
    )
    side *= rng.choice([-1.0, 1.0], m)
    X = centres[last] + ahead[:, None] * forward[last] + side[:, None] * right[last]
    X = X + high[:, None] * down[last]
    point = np.repeat(np.arange(m), length)
    view = np.arange(len(point)) - np.repeat(np.cumsum(length) - length, length) + first[point]
    params = np.column_stack(
        [rng.uniform(480.0, 520.0, n), rng.normal(-0.02, 0.005, n), rng.normal(0.0, 1e-3, n)]
    )
    scene = eg.MetricReconstruction(R, t, X, eg.Cameras("bal", params, np.arange(n)))
    tracks = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = scene.project(tracks) + rng.normal(0.0, 0.5, (len(view), 2))
    return eg.Tracks(tracks.view, tracks.point, xy), scene


def papers() -> Problem:
    """Return the scene of Bartoli 2003: five views, a hundred points, registered in turn."""
    tracks = eg.multi_view_scene().tracks
    return tracks, eg.initialize(tracks)


def sparse() -> Problem:
    """Return fifty views of five thousand points, a fifth of them seen in each."""
    scene = eg.multi_view_scene(n_views=50, n_points=5000, visible=0.2, baseline=1.2)
    rng = np.random.default_rng(1)
    noise = np.column_stack([1e-2 * rng.standard_normal((5000, 3)), np.zeros(5000)])
    return scene.tracks, eg.Reconstruction(scene.true.P, scene.true.Q + noise)


def bal(name: str) -> Problem:
    """Return a BAL set with the cameras that come with it, as projective ones."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("EPIGAUGE_DATA", default)) / "bal" / name
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: set EPIGAUGE_DATA")
    read = load_track_file(path)
    assert read.start is not None
    return read.tracks, read.start


#: What each problem is, by name.
PROBLEMS: dict[str, tuple[str, Callable[[], Problem]]] = {
    "paper": ("n = 5, m = 100, Bartoli 2003", papers),
    "sparse": ("n = 50, m = 5,000, 20 % visible", sparse),
    "bal49": ("BAL 49, projective", lambda: bal("problem-49-7776-pre.txt.bz2")),
    "bal16": ("BAL 16, projective", lambda: bal("problem-16-22106-pre.txt.bz2")),
    "banded": ("n = 500, m = 50,000, banded", lambda: banded(500, 50_000)),
}

#: Cameras of the problems of growing size; 200 points a camera, ten views a point.
GROWTH = (25, 50, 100, 200, 500, 1000)
