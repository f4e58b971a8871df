"""Pinhole cameras near projective ones, for programs that know no others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.multi_view.display import Display, display
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

__all__ = ["PinholeModel", "pinhole_model"]

Array = NDArray[np.float64]

#: Median deviation of the cameras from usual ones above which they are called no pinhole cameras.
_UNUSUAL = 3.0


@dataclass(frozen=True)
class PinholeModel:
    """Cameras without skew and points, in the basis of a `Display`; no calibration.

    Image coordinates have y down: where it points up in the tracks, its sign is changed.

    Attributes
    ----------
    intrinsics : ndarray, shape (n, 4)
        fx, fy, cx, cy of each camera, in pixels.
    R, t : ndarray, shape (n, 3, 3) and (n, 3)
        Poses: x_camera = R X + t.
    points : ndarray, shape (m, 3)
        Points; those not `ahead` may be anything.
    ahead : ndarray of bool, shape (m,)
        Finite points in front of all cameras that see them.
    xy : ndarray, shape (N, 2)
        The observations, with y down.
    residuals : ndarray, shape (N, 2)
        Observations minus projections by these cameras.
    rms_px : float
        RMS residual coordinate over the observations of the points ahead.
    projective_rms_px : float
        The same by the projective cameras. The difference is what the skew was good for.
    """

    intrinsics: Array
    R: Array
    t: Array
    points: Array
    ahead: NDArray[np.bool_]
    xy: Array
    residuals: Array
    rms_px: float
    projective_rms_px: float


def pinhole_model(
    reconstruction: Reconstruction,
    tracks: Tracks,
    *,
    y_up: bool = False,
    frame: Display | None = None,
) -> PinholeModel:
    """Return pinhole cameras near the projective ones, in a basis that makes them plausible.

    A projective camera in a metric basis is K (R | t), with five numbers in K. Its skew is small
    where the basis is plausible, and is left out, after the camera has been turned about its axis
    by the small angle that keeps the most of it.

    Parameters
    ----------
    reconstruction : Reconstruction
        Cameras and points, in any basis.
    tracks : Tracks
        What they were made from.
    y_up : bool
        Whether the y axis of the images points up; see `display`.
    frame : Display, optional
        What ``display(reconstruction, tracks, y_up=y_up)`` returned.

    Returns
    -------
    PinholeModel
        Cameras and points. They fit worse than the projective ones, and are a start for programs
        that calibrate, not a calibration.

    Raises
    ------
    ArgumentError
        If in no basis that was tried the cameras look like pinhole cameras with the scene in
        front of them.
    """
    if frame is None:
        frame = display(reconstruction, tracks, y_up=y_up)
    if not frame.deviation <= _UNUSUAL or np.mean(frame.ahead) < 0.5:
        raise ArgumentError(
            "reconstruction",
            f"has no basis in which its cameras look like pinhole cameras: half of them are more "
            f"than {frame.deviation:.2g} usual deviations away",
            "one without gross errors in its tracks (a robust loss may help); NPZ and PLY hold any",
        )
    mirror = np.array([1.0, -1.0 if frame.y_up else 1.0])
    P = np.append(mirror, 1.0)[:, None] * (reconstruction.P @ frame.T)
    intrinsics, R, t = _decomposed(P)
    X = np.where(frame.ahead[:, None], frame.points, 0.0)
    seen = np.einsum("nij,nj->ni", R[tracks.view], X[tracks.point]) + t[tracks.view]
    with np.errstate(divide="ignore", invalid="ignore"):
        image = seen[:, :2] / seen[:, 2:]
    K = intrinsics[tracks.view]
    xy = tracks.xy * mirror
    residuals = xy - (K[:, :2] * image + K[:, 2:])
    kept = frame.ahead[tracks.point]
    projective = (tracks.xy - reconstruction.project(tracks))[kept]
    return PinholeModel(
        intrinsics=intrinsics,
        R=R,
        t=t,
        points=frame.points,
        ahead=frame.ahead,
        xy=xy,
        residuals=residuals,
        rms_px=float(np.sqrt(np.mean(residuals[kept] ** 2))),
        projective_rms_px=float(np.sqrt(np.mean(projective**2))),
    )


def _decomposed(P: Array) -> tuple[Array, Array, Array]:
    """Return fx, fy, cx, cy and the poses of cameras P ~ K (R | t), their skew left out."""
    intrinsics, rotations, translations = [], [], []
    for camera in P:
        M = camera[:, :3]
        scaled = camera * np.sign(np.linalg.det(M)) / np.linalg.norm(M[2])
        # M = K R by the QR decomposition of the inverse: M^-1 = R^T K^-1.
        Q, triangle = np.linalg.qr(np.linalg.inv(scaled[:, :3]))
        signs = np.sign(np.diag(triangle))
        K = np.linalg.inv(signs[:, None] * triangle)
        R, t = (Q * signs).T, np.linalg.solve(K, scaled[:, 3])
        # Of all [[fx, s], [0, fy]] times a rotation, the one with the least beside the diagonal.
        fx, skew, fy = K[0, 0], K[0, 1], K[1, 1]
        angle = 0.5 * np.arctan2(-2.0 * fx * skew, fx**2 + fy**2 - skew**2)
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        intrinsics.append([*np.diag(K @ turn.T)[:2], *K[:2, 2]])
        rotations.append(turn @ R)
        translations.append(turn @ t)
    return np.array(intrinsics), np.array(rotations), np.array(translations)
