"""Made-up scenes of calibrated cameras of any model."""

from __future__ import annotations

import epigauge as eg
import numpy as np
from epigauge.cameras import camera_model, models
from numpy.typing import NDArray

#: All models whose cameras have a rotation and a position.
METRIC = tuple(name for name, model in models().items() if model.metric)
#: Those that COLMAP has too.
COLMAP = tuple(name for name in METRIC if name.isupper())


def parameters(model: str, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return plausible parameters of cameras for images of 640 x 480 pixels."""
    known = camera_model(model)
    rows = rng.uniform(-0.02, 0.02, (count, len(known.params)))
    for k, (name, unit) in enumerate(zip(known.params, known.units, strict=True)):
        middle = {"cx": 320.0, "cy": 240.0, "width": 640.0, "height": 320.0}.get(name)
        if k in known.focal:
            rows[:, k] = rng.uniform(600.0, 700.0, count)
        elif name in known.constants:
            rows[:, k] = middle or 1.0
        elif unit == "px":
            rows[:, k] = (middle or 0.0) + rng.uniform(-5.0, 5.0, count)
        elif unit != "1":  # coefficients of powers of pixels
            rows[:, k] = 0.0
    return rows


def looks_along(model: str) -> float:
    """Return 1 for cameras that look along z, -1 for those along -z, as of BAL."""
    known = camera_model(model)
    camera = np.concatenate([np.eye(3, 4).ravel(), np.ones(len(known.params))])
    return 1.0 if known.kernel("project")(camera, np.array([0.0, 0.0, 1.0]))[1] > 0.0 else -1.0


def metric_scene(
    model: str,
    seed: int = 0,
    *,
    n_views: int = 4,
    n_points: int = 30,
    n_cameras: int = 2,
    noise_px: float = 0.0,
    visible: float = 0.9,
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return cameras on a circle that look at points in its middle, and what they see."""
    rng = np.random.default_rng(seed)
    along = looks_along(model)
    X = rng.uniform(-1.0, 1.0, (n_points, 3))
    R, t = np.empty((n_views, 3, 3)), np.empty((n_views, 3))
    for i in range(n_views):
        angle = 2.0 * np.pi * i / n_views + rng.uniform(-0.1, 0.1)
        z = -np.array([np.cos(angle), rng.uniform(-0.2, 0.2), np.sin(angle)])
        centre = -6.0 * z / np.linalg.norm(z)
        z *= along / np.linalg.norm(z)
        x = np.cross([rng.uniform(-0.2, 0.2), 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        R[i] = [x, np.cross(z, x), z]
        t[i] = -R[i] @ centre
    cameras = eg.Cameras(model, parameters(model, n_cameras, rng), np.arange(n_views) % n_cameras)
    scene = eg.MetricReconstruction(R, t, X, cameras)
    sees = rng.random((n_views, n_points)) < visible
    sees[:2] = True
    view, point = np.nonzero(sees)
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = scene.project(blank) + rng.normal(0.0, noise_px, (len(view), 2))
    return eg.Tracks(blank.view, blank.point, xy), scene
