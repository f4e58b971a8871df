"""The pose of a camera, and its focal length, from points of which a share is wrong."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table

__all__ = ["Pose", "agreed_pose"]

Array = NDArray[np.float64]

#: Samples of three points that are tried for each focal length.
_SAMPLES = 150

#: A root is real whose imaginary part is below this share of it.
_REAL = 1e-6

_THREE = np.array([[0, 1], [0, 2], [1, 2]])


class Pose(NamedTuple):
    """A camera that most points agree with.

    ``inlier`` are those within the bound, ``focal`` the focal length that was best.
    """

    R: Array
    t: Array
    focal: float
    inlier: NDArray[np.bool_]


def agreed_pose(
    kernels: Table, xy: Array, X: Array, focal: Array, within_px: float, seed: int = 0
) -> Pose | None:
    """Return the pose that most points agree with, of three of them at a time.

    Parameters
    ----------
    kernels : Table
        Backend.
    xy : ndarray, shape (N, 2)
        Measurements about the principal point, in pixels.
    X : ndarray, shape (N, 3)
        Points.
    focal : ndarray, shape (k,)
        Focal lengths to try, in pixels.
    within_px : float
        Distances beyond count as this.
    seed : int
        Of the samples.

    Returns
    -------
    Pose or None
        The best; None of fewer than four points, or where no sample has a pose.

    References
    ----------
    .. [1] R. M. Haralick, C.-N. Lee, K. Ottenberg, M. Noelle, "Review and analysis of solutions of
       the three point perspective pose estimation problem", IJCV 13(3), 1994.
    """
    if len(X) < 4:
        return None
    rng = np.random.default_rng(seed)
    samples = np.argsort(rng.random((_SAMPLES, len(X))), axis=1)[:, :3]
    best: tuple[float, Pose] | None = None
    for f in focal.tolist():
        R, t = _poses(kernels, np.column_stack([xy / f, np.ones(len(xy))])[samples], X[samples])
        if not len(R):
            continue
        Y = np.einsum("sij,nj->sni", R, X) + t[:, None]
        with np.errstate(all="ignore"):
            away = np.linalg.norm(xy - f * Y[..., :2] / Y[..., 2:], axis=2)
        away = np.where(Y[..., 2] > 0.0, np.nan_to_num(away, nan=np.inf), np.inf)
        costs = np.sum(np.minimum(away, within_px) ** 2, axis=1)
        k = int(np.argmin(costs))
        if best is None or costs[k] < best[0]:
            best = float(costs[k]), Pose(R[k], t[k], f, away[k] < within_px)
    return None if best is None else best[1]


def _poses(kernels: Table, rays: Array, X: Array) -> tuple[Array, Array]:
    """Return rotations and translations of samples of three rays and points, (S, 3, 3)."""
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    cosines = np.sum(rays[:, _THREE[:, 0]] * rays[:, _THREE[:, 1]], axis=2)
    sides = np.sum((X[:, _THREE[:, 0]] - X[:, _THREE[:, 1]]) ** 2, axis=2)
    with np.errstate(all="ignore"):
        quartic, above, below = kernels.three_points(
            np.ascontiguousarray(cosines.T), np.ascontiguousarray(sides.T)
        )
        monic = quartic[1:] / quartic[0]
    usable = np.isfinite(monic).all(axis=0)
    companion = np.zeros((int(usable.sum()), 4, 4))
    companion[:, 0] = -monic[:, usable].T
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    roots = np.linalg.eigvals(companion)
    row, column = np.nonzero((np.abs(roots.imag) <= _REAL * np.abs(roots)) & (roots.real > 0.0))
    v, sample = roots[row, column].real, np.flatnonzero(usable)[row]
    with np.errstate(all="ignore"):
        u = np.polyval(above[:, sample], v) / np.polyval(below[:, sample], v)
        first = np.sqrt(sides[sample, 1] / (1.0 + v**2 - 2.0 * v * cosines[sample, 1]))
    good = np.isfinite(first) & np.isfinite(u) & (u > 0.0)
    sample, first, u, v = sample[good], first[good], u[good], v[good]
    seen = (first[:, None] * np.column_stack([np.ones(len(u)), u, v]))[..., None] * rays[sample]
    return _moved(X[sample], seen)


def _moved(X: Array, Y: Array) -> tuple[Array, Array]:
    """Return the rotations and translations Y = R X + t, in least squares, of (S, 3, 3)."""
    x, y = X.mean(axis=1), Y.mean(axis=1)
    U, _, Vt = np.linalg.svd(np.swapaxes(Y - y[:, None], 1, 2) @ (X - x[:, None]))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, y - np.einsum("sij,sj->si", R, x)
