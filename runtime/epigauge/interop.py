"""Matches and fundamental matrices to and from OpenCV, pycolmap and PoseLib.

Everywhere ``x2^T F x1 = 0`` with x = (column, row, 1), row-major, of any scale: OpenCV, COLMAP,
PoseLib and epigauge agree, and F can be passed on as it is. What differs is

- **pixels**: (0, 0) is the middle of the top-left pixel in OpenCV, and its corner in COLMAP, where
  the middle is (0.5, 0.5). epigauge and PoseLib take any, as long as points, F and K agree.
  `move_points` and `move_fundamental` change between the two; nothing else here does;
- **order**: OpenCV's query and PoseLib's first image are image 1. COLMAP's database has the image
  of the smaller number first;
- **motion**: ``x2 = R x1 + t`` in the frames of the cameras, in all of them.

Arrays of OpenCV's shape (m, 1, 2), integers and float32 are taken by every function of epigauge.
BAL problems are read and written by `load_scene` and `save_scene`; `bal_to_colmap` and
`colmap_to_bal` change between their cameras and COLMAP's.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import (
    as_array,
    as_calibration,
    as_choice,
    as_fundamental,
    as_matches,
    as_real,
)
from epigauge.cameras.bal import bal_to_colmap, colmap_to_bal
from epigauge.errors import ArgumentError, MissingPackageError
from epigauge.two_view.free import fundamental_from_cameras

__all__ = [
    "bal_to_colmap",
    "colmap_to_bal",
    "from_colmap",
    "from_opencv",
    "from_poselib",
    "from_two_view_geometry",
    "move_fundamental",
    "move_points",
    "to_colmap",
    "to_opencv",
    "to_poselib",
    "to_two_view_geometry",
]

Array = NDArray[np.float64]

#: Both coordinates of the middle of the top-left pixel.
_MIDDLE = {"opencv": 0.0, "colmap": 0.5}

#: Parameters of PoseLib's camera models without distortion: fx, fy, cx, cy among them.
_PINHOLE = {"PINHOLE": (0, 1, 2, 3), "SIMPLE_PINHOLE": (0, 0, 1, 2)}


def move_points(x: ArrayLike, source: str, target: str) -> Array:
    """Give points in the pixels of another library.

    Parameters
    ----------
    x : array_like, shape (..., 2)
        Points.
    source, target : {"opencv", "colmap"}
        Whose pixels they are in, and shall be in.

    Returns
    -------
    ndarray, shape (..., 2)
        x + 0.5 from OpenCV to COLMAP.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.interop.move_points([[0.0, 0.0]], "opencv", "colmap")
    array([[0.5, 0.5]])
    """
    points = as_real("x", x, "an (m, 2) array")
    if not points.ndim or points.shape[-1] != 2:
        raise ArgumentError("x", f"has shape {points.shape}", "an (m, 2) array")
    if not np.isfinite(points).all():
        raise ArgumentError("x", "is not finite", "finite coordinates")
    return points + _shift(source, target)


def move_fundamental(F: ArrayLike, source: str, target: str) -> Array:
    """Give a fundamental matrix for the pixels of another library, in both images.

    Parameters
    ----------
    F : array_like, shape (3, 3)
        Fundamental matrix.
    source, target : {"opencv", "colmap"}
        Whose pixels it belongs to, and shall belong to.

    Returns
    -------
    ndarray, shape (3, 3)
        S^T F S with the translation S from the target's pixels to the source's; not scaled.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> F = eg.fundamental_8point(scene.x1, scene.x2)
    >>> eg.interop.move_fundamental(F, "opencv", "colmap").shape
    (3, 3)
    """
    S = np.eye(3)
    S[:2, 2] = -_shift(source, target)
    return np.asarray(S.T @ as_fundamental(F, "F") @ S)


def from_opencv(
    keypoints1: Sequence[Any], keypoints2: Sequence[Any], matches: Iterable[Any]
) -> tuple[Array, Array]:
    """Return the points of OpenCV's matches.

    Parameters
    ----------
    keypoints1, keypoints2 : sequence of cv2.KeyPoint
        What a detector found in image 1 (query) and 2 (train).
    matches : iterable of cv2.DMatch
        As by ``matcher.match(descriptors1, descriptors2)``.

    Returns
    -------
    x1, x2 : ndarray, shape (m, 2)
        Points in OpenCV's pixels.

    Raises
    ------
    ArgumentError
        If a match has no such keypoint.

    Examples
    --------
    >>> import epigauge as eg
    >>> x1, x2 = eg.interop.from_opencv(*eg.interop.to_opencv([[10.0, 20.0]], [[11.0, 20.5]]))
    >>> x1.tolist(), x2.tolist()
    ([[10.0, 20.0]], [[11.0, 20.5]])
    """
    indices = [(match.queryIdx, match.trainIdx) for match in matches]
    points1, points2 = (np.array([k.pt for k in found]) for found in (keypoints1, keypoints2))
    return _picked(points1, points2, indices)


def to_opencv(
    x1: ArrayLike, x2: ArrayLike, size: float = 1.0
) -> tuple[list[Any], list[Any], list[Any]]:
    """Return matches as OpenCV's objects, for ``cv2.drawMatches`` and the like.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        Points in OpenCV's pixels. Keypoints hold them as float32.
    size : float
        Diameter of the keypoints, in pixels.

    Returns
    -------
    keypoints1, keypoints2 : list of cv2.KeyPoint
        A keypoint a match.
    matches : list of cv2.DMatch
        Match k joins keypoints k.

    Raises
    ------
    MissingPackageError
        If OpenCV is not installed.

    Examples
    --------
    >>> import epigauge as eg
    >>> keypoints1, keypoints2, found = eg.interop.to_opencv([[10.0, 20.0]], [[11.0, 20.5]])
    >>> keypoints2[found[0].trainIdx].pt
    (11.0, 20.5)
    """
    cv2 = _package("cv2", "opencv-python-headless")
    x1, x2 = as_matches(x1, x2, at_least=0)
    keypoints1, keypoints2 = ([cv2.KeyPoint(*row, size) for row in x.tolist()] for x in (x1, x2))
    return keypoints1, keypoints2, [cv2.DMatch(k, k, 0.0) for k in range(len(x1))]


def from_colmap(keypoints1: Any, keypoints2: Any, matches: Any) -> tuple[Array, Array]:
    """Return the points of COLMAP's matches.

    Parameters
    ----------
    keypoints1, keypoints2 : array_like, shape (n, 2), (n, 4) or (n, 6)
        As ``Database.read_keypoints`` returns them, x and y first; or pycolmap.FeatureKeypoints.
    matches : array_like of int, shape (m, 2)
        As ``Database.read_matches`` returns them, or ``TwoViewGeometry.inlier_matches``; or
        pycolmap.FeatureMatches.

    Returns
    -------
    x1, x2 : ndarray, shape (m, 2)
        Points in COLMAP's pixels.

    Raises
    ------
    ArgumentError
        If a match has no such keypoint, or the shapes are others.

    Examples
    --------
    >>> import epigauge as eg
    >>> x1, x2 = eg.interop.from_colmap([[10.0, 20.0], [5.0, 6.0]], [[11.0, 20.5]], [[1, 0]])
    >>> x1.tolist(), x2.tolist()
    ([[5.0, 6.0]], [[11.0, 20.5]])
    """
    if hasattr(_first(matches), "point2D_idx1"):
        matches = [(match.point2D_idx1, match.point2D_idx2) for match in matches]
    sets = []
    for name, points in (("keypoints1", keypoints1), ("keypoints2", keypoints2)):
        if hasattr(_first(points), "x"):
            points = [(point.x, point.y) for point in points]
        table = as_real(name, points, "an (n, 2), (n, 4) or (n, 6) array")
        if table.size and (table.ndim != 2 or table.shape[1] not in (2, 4, 6)):
            raise ArgumentError(name, f"has shape {table.shape}", "(n, 2), (n, 4) or (n, 6)")
        sets.append(table)
    return _picked(sets[0], sets[1], matches)


def to_colmap(
    x1: ArrayLike, x2: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]:
    """Return matches as arrays for ``Database.write_keypoints`` and ``write_matches``.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        Points in COLMAP's pixels; those of OpenCV go through `move_points` first.

    Returns
    -------
    keypoints1, keypoints2 : ndarray of float32, shape (m, 2)
        A keypoint a match.
    matches : ndarray of uint32, shape (m, 2)
        Match k joins keypoints k.

    Examples
    --------
    >>> import epigauge as eg
    >>> keypoints1, keypoints2, found = eg.interop.to_colmap([[10.0, 20.0]], [[11.0, 20.5]])
    >>> keypoints2.tolist(), found.tolist()
    ([[11.0, 20.5]], [[0, 0]])
    """
    x1, x2 = as_matches(x1, x2, at_least=0)
    indices = np.arange(len(x1), dtype=np.uint32)
    return x1.astype(np.float32), x2.astype(np.float32), np.column_stack([indices, indices])


def from_two_view_geometry(geometry: Any) -> tuple[Array, NDArray[np.uint32]]:
    """Return F and inliers of COLMAP's two-view geometry.

    Parameters
    ----------
    geometry : pycolmap.TwoViewGeometry
        As ``Database.read_two_view_geometry(id1, id2)`` returns it, for id1 as image 1.

    Returns
    -------
    F : ndarray, shape (3, 3)
        For COLMAP's pixels.
    inlier_matches : ndarray of uint32, shape (m, 2)
        Numbers of keypoints, for `from_colmap`.

    Raises
    ------
    ArgumentError
        If it holds no F, as a homography does not.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> scene = eg.two_view_scene(seed=1)
    >>> geometry = eg.interop.to_two_view_geometry(scene.F_true, [[0, 0], [1, 2]])
    >>> F, rows = eg.interop.from_two_view_geometry(geometry)
    >>> bool(np.isclose(abs(np.sum(F * scene.F_true)), 1.0)), rows.tolist()
    (True, [[0, 0], [1, 2]])
    """
    if geometry.F is None or not np.any(geometry.F):
        raise ArgumentError("geometry", "holds no F", "one with a fundamental matrix")
    return as_fundamental(geometry.F, "geometry"), np.asarray(geometry.inlier_matches, np.uint32)


def to_two_view_geometry(F: ArrayLike, inlier_matches: ArrayLike) -> Any:
    """Return an uncalibrated two-view geometry for ``Database.write_two_view_geometry``.

    Parameters
    ----------
    F : array_like, shape (3, 3)
        For COLMAP's pixels.
    inlier_matches : array_like of int, shape (m, 2)
        Numbers of keypoints of image 1 and 2.

    Returns
    -------
    pycolmap.TwoViewGeometry
        With F, the inliers, and ``config`` UNCALIBRATED.

    Raises
    ------
    MissingPackageError
        If pycolmap is not installed.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(seed=1)
    >>> geometry = eg.interop.to_two_view_geometry(scene.F_true, [[0, 0], [1, 2]])
    >>> len(geometry.inlier_matches)
    2
    """
    pycolmap = _package("pycolmap", "pycolmap")
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    geometry.F = as_fundamental(F, "F")
    geometry.inlier_matches = np.asarray(inlier_matches, np.uint32)
    return geometry


def from_poselib(pair: Any) -> tuple[Array, Array, Array]:
    """Return the fundamental matrix of PoseLib's image pair.

    Parameters
    ----------
    pair : poselib.ImagePair
        Two cameras without distortion (PINHOLE, SIMPLE_PINHOLE), and the pose x2 = R x1 + t.

    Returns
    -------
    F : ndarray, shape (3, 3)
        K2^-T [t]x R K1^-1, of unit norm.
    K1, K2 : ndarray, shape (3, 3)
        Calibration matrices.

    Raises
    ------
    ArgumentError
        If a camera has distortion, or the cameras did not move apart.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> K = np.diag([800.0, 800.0, 1.0])
    >>> F, K1, K2 = eg.interop.from_poselib(eg.interop.to_poselib(np.eye(3), [1.0, 0.0, 0.0], K, K))
    >>> bool(np.allclose(K1, K)), F.shape
    (True, (3, 3))
    """
    K1, K2 = _calibration("camera1", pair.camera1), _calibration("camera2", pair.camera2)
    if not np.any(pair.pose.t):
        raise ArgumentError("pair", "has two cameras with the same centre", "cameras that moved")
    F = fundamental_from_cameras(np.stack([K1 @ np.eye(3, 4), K2 @ pair.pose.Rt]))
    return F / np.linalg.norm(F), K1, K2


def to_poselib(
    R: ArrayLike,
    t: ArrayLike,
    K1: ArrayLike,
    K2: ArrayLike,
    image_sizes: tuple[tuple[int, int], tuple[int, int]] = ((-1, -1), (-1, -1)),
) -> Any:
    """Return a calibrated pair as PoseLib's, to refine with ``refine_relative_pose`` and the like.

    Parameters
    ----------
    R, t : array_like, shape (3, 3), (3,)
        Motion x2 = R x1 + t, as of ``refine_fundamental(..., essential=True)``.
    K1, K2 : array_like, shape (3, 3)
        Calibration matrices without skew.
    image_sizes : ((int, int), (int, int))
        (width, height) of both images; PoseLib has -1 for unknown.

    Returns
    -------
    poselib.ImagePair
        With cameras of the model PINHOLE.

    Raises
    ------
    ArgumentError
        If R is no rotation, or K1 or K2 is no calibration matrix without skew.
    MissingPackageError
        If PoseLib is not installed.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> K = np.diag([800.0, 800.0, 1.0])
    >>> pair = eg.interop.to_poselib(np.eye(3), [1.0, 0.0, 0.0], K, K)
    >>> type(pair).__name__
    'ImagePair'
    """
    poselib = _package("poselib", "poselib")
    rotation = as_real("R", R, "a rotation (3, 3)")
    # The inverse of an orthonormal matrix of determinant one is the matrix of its cofactors.
    if rotation.shape != (3, 3) or not np.allclose(
        np.cross(rotation[[1, 2, 0]], rotation[[2, 0, 1]]), rotation, atol=1e-9
    ):
        raise ArgumentError("R", "is no rotation", "an orthonormal matrix of determinant 1")
    cameras = []
    for name, K, (width, height) in zip(("K1", "K2"), (K1, K2), image_sizes, strict=True):
        (fx, skew, cx), (_, fy, cy), _ = as_calibration(name, K).tolist()
        if skew:
            raise ArgumentError(name, f"has skew {skew}", "zero, since PoseLib's models have none")
        cameras.append(poselib.Camera("PINHOLE", [fx, fy, cx, cy], width, height))
    pair = poselib.ImagePair()
    pair.camera1, pair.camera2 = cameras
    pair.pose = poselib.CameraPose()
    pair.pose.R, pair.pose.t = rotation, as_real("t", t, "(3,)")
    return pair


def _shift(source: str, target: str) -> float:
    as_choice("source", source, _MIDDLE)
    as_choice("target", target, _MIDDLE)
    return _MIDDLE[target] - _MIDDLE[source]


def _first(sequence: Any) -> Any:
    """Return the first item; None where there is none, or no sequence."""
    try:
        return sequence[0] if len(sequence) else None
    except (TypeError, LookupError):
        return None


def _picked(points1: Array, points2: Array, matches: ArrayLike) -> tuple[Array, Array]:
    """Return the points that matches, pairs of their numbers, join."""
    indices = as_array("matches", matches, "pairs of keypoint numbers, (m, 2) integers")
    if not indices.size:
        return np.zeros((0, 2)), np.zeros((0, 2))
    if indices.ndim != 2 or indices.shape[1] != 2 or indices.dtype.kind not in "iu":
        was = f"has type {indices.dtype}, shape {indices.shape}"
        raise ArgumentError("matches", was, "pairs of keypoint numbers, (m, 2) integers")
    for image, (column, points) in enumerate(zip(indices.T, (points1, points2), strict=True), 1):
        bad = np.flatnonzero((column < 0) | (column >= len(points)))
        if len(bad):
            was = f"join keypoint {column[bad[0]]} of image {image} in row {bad[0]}"
            raise ArgumentError("matches", was, f"numbers below {len(points)}")
    try:
        return as_matches(points1[indices[:, 0], :2], points2[indices[:, 1], :2], at_least=0)
    except ArgumentError as error:
        name = {"x1": "keypoints1", "x2": "keypoints2"}.get(error.argument, error.argument)
        raise ArgumentError(name, error.was.replace("row", "match"), error.needed) from None


def _calibration(name: str, camera: Any) -> Array:
    """Return the calibration matrix of PoseLib's camera."""
    model = camera.model_name()
    if model not in _PINHOLE:
        needed = f"{' or '.join(_PINHOLE)}: undistort the points first"
        raise ArgumentError(name, f"is of the model {model}", needed)
    fx, fy, cx, cy = (camera.params[k] for k in _PINHOLE[model])
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _package(module: str, package: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingPackageError(package, "interop") from None
