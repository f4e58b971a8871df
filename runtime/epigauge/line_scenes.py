"""Simulated scenes of points and lines, with their truth, for experiments, demos and tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epigauge._arguments import as_count, as_positive
from epigauge.cameras import Cameras, MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.tracks import MIN_POINTS, MIN_VIEWS, Tracks
from epigauge.scenes import _looking_at_origin

__all__ = ["LineScene", "line_scene"]

#: A segment is so many times as long as its noise at least; how often other lines are tried.
_LENGTH, _TRIES = 10.0, 100


@dataclass(frozen=True, slots=True, eq=False)
class LineScene:
    """Views of points and lines, and the truth behind them.

    Parameters
    ----------
    tracks : Tracks
        Measured points, in pixels; the origin is the principal point.
    line_tracks : LineTracks
        Measured segments: each view sees another part of a line.
    true : MetricReconstruction
        True cameras, points and lines, in metres.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.line_scene(n_views=4, n_lines=10)
    >>> scene.line_tracks.n_lines, scene.tracks.n_views
    (10, 4)
    """

    tracks: Tracks
    line_tracks: LineTracks
    true: MetricReconstruction


def line_scene(
    n_views: int = 8,
    n_points: int = 60,
    n_lines: int = 60,
    noise_px: float = 1.0,
    distance: float = 10.0,
    focal: float = 1000.0,
    cube: float = 4.0,
    seed: int = 0,
) -> LineScene:
    """Simulate views of points and lines in a cube.

    Equal cameras on three quarters of a circle, at changing heights, look at the cube's centre. Of
    each line a view sees the image of a random part of a piece one side of the cube long, both of
    its end points with noise. No view sees a line nearly end on.

    Parameters
    ----------
    n_views, n_points, n_lines : int
        Numbers of cameras, points and lines.
    noise_px : float
        Standard deviation of the Gaussian noise on each image coordinate, in pixels.
    distance : float
        Distance of the cameras from the centre of the cube, in metres.
    focal : float
        Focal length, in pixels.
    cube : float
        Side of the cube, in metres.
    seed : int
        Seed of NumPy's default generator.

    Returns
    -------
    LineScene
        Measurements and truth.

    Raises
    ------
    ArgumentError
        If an argument is out of range, or a camera could have points beside or behind it.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.line_scene(n_lines=20, seed=1).line_tracks
    LineTracks(20 lines, 160 observations)
    """
    n_views = as_count("n_views", n_views, at_least=MIN_VIEWS)
    n_points = as_count("n_points", n_points, at_least=MIN_POINTS)
    n_lines = as_count("n_lines", n_lines)
    noise_px = as_positive("noise_px", noise_px, zero=True)
    cube, focal = as_positive("cube", cube), as_positive("focal", focal)
    distance = as_positive("distance", distance)
    if distance <= 2.0 * cube:
        was = f"is {distance:g} m, with a cube of {cube:g} m"
        raise ArgumentError("distance", was, "more than twice the side of the cube")
    random = np.random.default_rng(as_count("seed", seed, at_least=0))
    angles = 1.5 * np.pi * (np.arange(n_views) / n_views - 0.5)
    heights = 0.3 * np.sin(3.0 * angles + 0.5)
    centres = np.column_stack([np.sin(angles), heights, -np.cos(angles)])
    centres *= distance / np.linalg.norm(centres, axis=1, keepdims=True)
    R = np.stack([_looking_at_origin(centre) for centre in centres])
    t = -np.einsum("nij,nj->ni", R, centres)
    X = cube * random.uniform(-0.5, 0.5, (n_points, 3))
    middle = cube * random.uniform(-0.5, 0.5, (n_lines, 3))
    v = _directions(random, n_lines)

    def seen(points: np.ndarray) -> np.ndarray:
        """Return the images (k, n, 2) of points (k, n, 3), one a view."""
        h = np.einsum("nij,knj->kni", R, points) + t
        return np.asarray(focal * h[..., :2] / h[..., 2:])

    noise = noise_px * random.standard_normal((n_points, n_views, 2))
    xy = seen(np.broadcast_to(X[:, None], (n_points, n_views, 3))) + noise
    # From where to where on the line: each view sees a third of the piece at least.
    begin = cube * random.uniform(-0.5, 0.0, (n_lines, n_views, 1))
    end = begin + cube * random.uniform(1.0 / 3.0, 0.5, (n_lines, n_views, 1))

    def images() -> np.ndarray:
        """Return the exact segments, (k, n, 4)."""
        ends = [seen(middle[:, None] + s * v[:, None]) for s in (begin, end)]
        return np.concatenate(ends, axis=2)

    segments = images()
    for _ in range(_TRIES):
        long = np.linalg.norm(segments[..., 2:] - segments[..., :2], axis=2).min(axis=1)
        end_on = np.flatnonzero(long < _LENGTH * noise_px)
        if not len(end_on):
            break
        v[end_on] = _directions(random, len(end_on))
        segments = images()
    segments += noise_px * random.standard_normal(segments.shape)
    point, view = np.divmod(np.arange(n_points * n_views), n_views)
    tracks = Tracks(view, point, xy.reshape(-1, 2))
    line, view = np.divmod(np.arange(n_lines * n_views), n_views)
    line_tracks = LineTracks(view, line, segments.reshape(-1, 4))
    cameras = Cameras("SIMPLE_PINHOLE", np.array([[focal, 0.0, 0.0]]), np.zeros(n_views, np.intp))
    lines = np.column_stack([np.cross(middle, v), v])
    return LineScene(tracks, line_tracks, MetricReconstruction(R, t, X, cameras, lines))


def _directions(random: np.random.Generator, count: int) -> np.ndarray:
    """Return random unit vectors, (k, 3)."""
    v = random.standard_normal((count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))
