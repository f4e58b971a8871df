"""The camera of a COLMAP image: how far its lens bends points, and points without that."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import CameraModel, camera_model, models

__all__ = ["bend_px", "calibration", "undistorted"]

Array = NDArray[np.float64]

#: COLMAP's numbers of its camera models.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")

#: Newton steps that undo a distortion, and how near a point must come to its own place, in pixels.
_STEPS, _NEAR_PX = 50, 1e-6


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
    if not len(points):
        return 0.0
    if _name(row) not in (None, *_PINHOLES, *models()):
        return float("inf")
    known = _parameters(row)
    if known is None or known[0].name in _PINHOLES:
        return 0.0
    model, params, K = known
    rays = (points - K[:2, 2]) / np.diag(K)[:2]
    with np.errstate(all="ignore"):
        image = _seen(model, params, rays, points)[0]
        bend = float(np.sqrt(np.mean(np.sum((image - points) ** 2, axis=1))))
    return bend if np.isfinite(bend) else float("inf")


def calibration(row: Any) -> Array | None:
    """Return the calibration matrix (3, 3) of a camera without its distortion, None if unknown."""
    known = _parameters(row)
    return None if known is None else known[2]


def undistorted(row: Any, points: Array) -> Array | None:
    """Return where a camera without distortion would have seen points.

    Parameters
    ----------
    row, points
        As for `bend_px`.

    Returns
    -------
    ndarray, shape (n, 2), or None
        Places for the calibration matrix of `calibration`; the points themselves where nothing is
        known of the camera; NaN for those that no ray of the lens is seen at. None where the model
        is not known here.
    """
    if _name(row) not in (None, *_PINHOLES, *models()):
        return None
    known = _parameters(row)
    if known is None or known[0].name in _PINHOLES:
        return points
    model, params, K = known
    focal, centre = np.diag(K)[:2], K[:2, 2]
    rays = (points - centre) / focal
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            image, J = _seen(model, params, rays, points)
            off = points - image
            # NaN, of a point that went astray, is at no end
            if np.nanmax(np.abs(off), initial=0.0) <= 1e-3 * _NEAR_PX:
                break
            determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
            step = np.column_stack(
                [
                    J[:, 1, 1] * off[:, 0] - J[:, 0, 1] * off[:, 1],
                    J[:, 0, 0] * off[:, 1] - J[:, 1, 0] * off[:, 0],
                ]
            )
            rays = rays + step / determinant[:, None]
        image, J = _seen(model, params, rays, points)
        # Beyond the place where the lens folds the image back, there are other solutions.
        determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
        in_order = (determinant > 0.0) & (J[:, 0, 0] + J[:, 1, 1] > 0.0)
        lost = ~(in_order & (np.max(np.abs(points - image), axis=1) <= _NEAR_PX))
    rays[lost] = np.nan
    return np.asarray(rays * focal + centre)


def _name(row: Any) -> str | None:
    """Return the name of a camera's model, None where nothing is known."""
    number = None if row is None else row[0]
    return _MODELS[number] if isinstance(number, int) and 0 <= number < len(_MODELS) else None


def _parameters(row: Any) -> tuple[CameraModel, Array, Array] | None:
    """Return model, parameters and calibration matrix of a camera, if they are in order."""
    name = _name(row)
    if name is None or name not in models():
        return None
    model, data = camera_model(name), row[1]
    if not isinstance(data, bytes) or len(data) != 8 * len(model.params):
        return None
    params = np.frombuffer(data, "<f8")
    places = {parameter: k for k, parameter in enumerate(model.params)}
    focal = params[list(model.focal)] * np.ones(2)
    if not np.isfinite(params).all() or not (focal > 0.0).all():
        return None
    K = np.diag([*focal, 1.0])
    K[:2, 2] = params[[places["cx"], places["cy"]]]
    return model, params, K


def _seen(model: CameraModel, params: Array, rays: Array, points: Array) -> tuple[Array, Array]:
    """Return the images (n, 2) of rays, and their derivatives (n, 2, 2)."""
    pose = np.eye(3, 4).ravel()  # the camera frame is the world's
    cameras = np.broadcast_to(np.concatenate([pose, params]), (len(rays), 12 + len(params)))
    X = np.column_stack([rays, np.ones(len(rays))])
    r, J = model.kernel("sight")(*(np.ascontiguousarray(a.T) for a in (cameras, X, points)))
    return points - r.T, np.moveaxis(J, -1, 0)[:, :, :2]
