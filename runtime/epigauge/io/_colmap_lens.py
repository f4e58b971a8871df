"""How far the lens of a COLMAP camera bends the points of an image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import camera_model, models

__all__ = ["bend_px"]

Array = NDArray[np.float64]

#: COLMAP's numbers of its camera models.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")


def bend_px(row: Any, points: Array) -> float:
    """Return how far a lens moves points from where a camera without distortion has them, RMS.

    Parameters
    ----------
    row : (model, params) or None
        Of the camera, as the database holds it.
    points : ndarray, shape (n, 2)
        Points of the image in COLMAP's pixels.

    Returns
    -------
    float
        Pixels. Points are taken for the undistorted ones, which is near enough to tell whether
        there is distortion. Zero where nothing is known of the camera, infinite where its model is
        not known here.
    """
    if row is None or not len(points):
        return 0.0
    number, data = row
    if not isinstance(number, int) or not 0 <= number < len(_MODELS):
        return 0.0
    name = _MODELS[number]
    if name in _PINHOLES:
        return 0.0
    if name not in models():
        return float("inf")
    model = camera_model(name)
    if not isinstance(data, bytes) or len(data) != 8 * len(model.params):
        return 0.0
    params = np.frombuffer(data, "<f8")
    places = {parameter: k for k, parameter in enumerate(model.params)}
    focal = params[list(model.focal)] * np.ones(2)
    if not np.isfinite(params).all() or not (focal > 0.0).all():
        return 0.0
    rays = (points - params[[places["cx"], places["cy"]]]) / focal
    pose = np.eye(3, 4).ravel()  # the camera frame is the world's
    cameras = np.broadcast_to(np.concatenate([pose, params]), (len(points), 12 + len(params)))
    with np.errstate(all="ignore"):
        image, _ = model.kernel("project")(
            np.ascontiguousarray(cameras.T),
            np.ascontiguousarray(np.column_stack([rays, np.ones(len(rays))]).T),
        )
        bend = float(np.sqrt(np.mean(np.sum((image.T - points) ** 2, axis=1))))
    return bend if np.isfinite(bend) else float("inf")
