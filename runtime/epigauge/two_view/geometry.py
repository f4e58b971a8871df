"""Cameras, points and distances that follow from a fundamental matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_fundamental, as_matches, as_real, rescaled
from epigauge.errors import ArgumentError
from epigauge.two_view.conditioning import Conditioning, condition
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.free import fundamental_from_cameras
from epigauge.two_view.parameterizations import factorize

__all__ = ["canonical_cameras", "reprojection_distances", "sampson_distances", "triangulate"]

Array = NDArray[np.float64]


def canonical_cameras(F: ArrayLike) -> tuple[Array, Array]:
    """Return the canonic realisation P = (I | 0), P' = (u2 v1^T - sigma u1 v2^T | u3).

    Parameters
    ----------
    F : array_like, shape (3, 3)
        Fundamental matrix; of rank 3, the nearest matrix of rank 2 is taken.

    Returns
    -------
    P1, P2 : ndarray, shape (3, 4)
        Cameras whose fundamental matrix is F up to scale.

    Raises
    ------
    ArgumentError
        If F is not a finite (3, 3) matrix of rank 2 at least.

    References
    ----------
    .. [BS04] A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal
       parameters", PAMI 26(3), 2004, eqs. (4), (5).

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> P1, P2 = eg.canonical_cameras(eg.fundamental_8point(scene.x1, scene.x2))
    >>> P1.shape, P2.shape
    ((3, 4), (3, 4))
    """
    factors = factorize(_rank_two("F", as_fundamental(F, "F")))
    return np.eye(3, 4), np.asarray(kernels.table().canonical_camera(*factors))


def reprojection_distances(
    F: ArrayLike, x1: ArrayLike, x2: ArrayLike
) -> tuple[Array, Array, Array]:
    """Return the exact reprojection error of each match and the corrected matches.

    d^2 is the smallest sum of squared shifts, in both images, that makes a match satisfy the
    epipolar geometry: the error of optimal triangulation.

    Parameters
    ----------
    F : array_like, shape (3, 3)
        Fundamental matrix with ``x2^T F x1 = 0``; of rank 3, the nearest of rank 2 is taken.
    x1, x2 : array_like, shape (m, 2)
        Matches in pixels.

    Returns
    -------
    d : ndarray, shape (m,)
        Signed distances in pixels; the sign is that of ``x2^T F x1``.
    x1_hat, x2_hat : ndarray, shape (m, 2)
        Corrected matches in pixels: ``x2_hat^T F x1_hat = 0``.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN or infinity, or an F without a rank of 2.

    Notes
    -----
    The minimum is global: in suitable coordinates it is the root of one monotone scalar equation.
    Hartley and Sturm find it as a root of a polynomial of degree 6.

    References
    ----------
    .. [1] R. Hartley, P. Sturm, "Triangulation", CVIU 68(2), 1997.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> F = eg.fundamental_8point(scene.x1, scene.x2)
    >>> d, x1_hat, x2_hat = eg.reprojection_distances(F, scene.x1, scene.x2)
    >>> d.shape, x1_hat.shape
    ((50,), (50, 2))
    """
    x1, x2 = as_matches(x1, x2, at_least=0)
    frame, F_inside, q1, q2 = _conditioned(F, x1, x2)
    if not len(x1):
        return np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2))
    reprojection = Reprojection(kernels.table(), q1, q2)
    feet = reprojection.evaluate(F_inside)
    q1_hat, q2_hat, _ = reprojection.corrected(feet)
    return (feet.signed * frame.scale, *frame.backward(q1_hat, q2_hat))


def sampson_distances(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> Array:
    """Return the gradient-weighted (Sampson) distance of each match, C / norm(dC/d(x1, x2)).

    Parameters
    ----------
    F : array_like, shape (3, 3)
        Fundamental matrix with ``x2^T F x1 = 0``.
    x1, x2 : array_like, shape (m, 2)
        Matches in pixels.

    Returns
    -------
    ndarray, shape (m,)
        Signed distances in pixels: the exact ones to first order in the noise. A match that lies
        on both epipoles has distance zero.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN or infinity, or an F without a rank of 2.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> F = eg.fundamental_8point(scene.x1, scene.x2)
    >>> eg.sampson_distances(F, scene.x1, scene.x2).shape
    (50,)
    """
    x1, x2 = as_matches(x1, x2, at_least=0)
    frame, F_inside, q1, q2 = _conditioned(F, x1, x2)
    if not len(x1):
        return np.zeros(0)
    table = kernels.table()
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 on both epipoles
        r, _ = table.sampson(F_inside, q1, q2)
        C, terms = table.algebraic(F_inside, q1, q2)
    # C is a sum of nine products; below their rounding it, and hence the distance, is zero.
    size = np.abs(F_inside.ravel()) @ np.abs(terms[0])
    distances = np.where(np.abs(C[0]) <= 8.0 * np.finfo(float).eps * size, 0.0, r[0])
    return np.asarray(distances * frame.scale)


def triangulate(P: ArrayLike, x: ArrayLike) -> Array:
    """Return the points whose projections are nearest to the matches (maximum likelihood).

    Parameters
    ----------
    P : array_like, shape (2, 3, 4)
        Two cameras with different centres.
    x : array_like, shape (2, m, 2)
        Matches in pixels, ``x[0]`` in the first image.

    Returns
    -------
    ndarray, shape (m, 4)
        Homogeneous points of unit norm; the last coordinate is not negative. Points at infinity
        are legal. Of a match on both epipoles only the line through the camera centres is known:
        one point of it is returned.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN or infinity, or cameras with the same centre.

    Notes
    -----
    The matches are corrected to their foot points, whose rays meet exactly.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> P = eg.canonical_cameras(eg.fundamental_8point(scene.x1, scene.x2))
    >>> eg.triangulate(P, [scene.x1, scene.x2]).shape
    (50, 4)
    """
    cameras = as_real("P", P, "two finite cameras, (2, 3, 4)")
    if cameras.shape != (2, 3, 4):
        raise ArgumentError("P", f"has shape {cameras.shape}", "two finite cameras, (2, 3, 4)")
    if not np.isfinite(cameras).all():
        raise ArgumentError("P", "is not finite", "two finite cameras, (2, 3, 4)")
    if not cameras.any(axis=(1, 2)).all():
        raise ArgumentError("P", "has a camera of zeros", "two finite cameras, (2, 3, 4)")
    cameras = np.stack([rescaled(camera) for camera in cameras])
    points = as_real("x", x, "the two images' points, (2, m, 2)")
    if points.ndim != 3 or points.shape[0] != 2:
        raise ArgumentError("x", f"has shape {points.shape}", "the two images' points, (2, m, 2)")
    _, x1_hat, x2_hat = reprojection_distances(_fundamental(cameras), points[0], points[1])
    # Each row of x cross P X = 0 is scaled to unit norm, so that neither image dominates.
    rows = []
    for camera, hat in zip(cameras, (x1_hat, x2_hat), strict=True):
        for axis in (0, 1):
            row = hat[:, axis, None] * camera[2] - camera[axis]
            norms = np.linalg.norm(row, axis=1, keepdims=True)
            rows.append(row / np.where(norms > 0.0, norms, 1.0))
    Q = np.linalg.svd(np.stack(rows, axis=1))[2][:, -1]
    return np.asarray(np.where(Q[:, 3:] < 0.0, -Q, Q))


def _fundamental(cameras: Array) -> Array:
    """Return F of two cameras, refusing those that did not move."""
    F = fundamental_from_cameras(cameras)
    if np.linalg.svd(F, compute_uv=False)[1] <= 1e-13:
        raise ArgumentError("P", "has two cameras with the same centre", "cameras that moved")
    return F


def _rank_two(name: str, F: Array) -> Array:
    """Lower the rank of F to 2."""
    U, values, Vt = np.linalg.svd(F)
    if values[1] <= np.finfo(float).eps * values[0]:
        raise ArgumentError(name, "has rank 1", "a fundamental matrix, of rank 2")
    return np.asarray((U[:, :2] * (values[:2] / values[0])) @ Vt[:2])


def _conditioned(F: ArrayLike, x1: Array, x2: Array) -> tuple[Conditioning, Array, Array, Array]:
    """Return conditioning, F of rank 2 and matches in conditioned coordinates."""
    matrix = as_fundamental(F, "F")
    values = np.linalg.svd(matrix, compute_uv=False)
    if values[2] > 1e-8 * values[1]:  # not by rounding: the caller's own nearest matrix is meant
        matrix = _rank_two("F", matrix)
    if not len(x1):
        return Conditioning(np.zeros(2), np.zeros(2), 1.0), _rank_two("F", matrix), x1.T, x2.T
    frame = condition(x1, x2)
    if frame.scale == 0.0:  # a single match, or all equal
        frame = Conditioning(frame.origin1, frame.origin2, 1.0)
    # Here, not in pixels, the singular values are comparable and no digits are lost.
    return frame, _rank_two("F", frame.from_pixels(matrix)), *frame.forward(x1, x2)
