"""A basis in which a projective reconstruction looks like the scene, for pictures and PLY only.

A projective reconstruction has no angles and no lengths. To be looked at it needs a plane at
infinity and a conic on it; they are guessed here from what most cameras have: square pixels, the
principal point amid the image points, one focal length, and the scene in front. This is **no
calibration**: nothing is estimated to any accuracy, and no number must be measured in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.linear import Dense, Levenberg
from epigauge.multi_view.gauge import normalized
from epigauge.multi_view.tracks import Reconstruction, Tracks

__all__ = ["Display", "display"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Focal lengths tried, in units of width plus height of what the views show.
_FOCAL = np.geomspace(0.25, 12.0, 21)
#: Usual deviations: of the principal point, in focal lengths; of the logarithm of the aspect ratio;
#: of the skew, in radians; of the logarithm of the focal length from the common one, and of that
#: from 0.7 units.
_CENTRE, _ASPECT, _SKEW, _SAME_FOCAL, _ANY_FOCAL = 0.05, 0.05, 0.05, 0.1, 1.0
#: A camera's deviation grows slowly beyond so many usual ones.
_GROSS = 5.0
#: Penalty where every point is behind the cameras, in squared usual deviations.
_BEHIND = 1e4
_PAIRS, _OBSERVATIONS, _REFINED = 60, 4000, 6
#: Points farther from the middle are not shown, cameras farther away moved in.
FAR_POINT, FAR_CAMERA = 8.0, 6.0


@dataclass(frozen=True)
class Display:
    """Points and cameras to look at; no calibration.

    The unit of length is the usual distance of a point from their middle, which is the origin. The
    cameras' mean up is z, and they look along y on the average.

    Attributes
    ----------
    points : ndarray, shape (m, 3)
        Points; not finite at infinity.
    centres : ndarray, shape (n, 3)
        Centres of the cameras; those farther than `FAR_CAMERA` are put there, in their direction.
    corners : ndarray, shape (n, 4, 3)
        For each camera the directions in which it sees the corners of what the views show.
    shown : ndarray of bool, shape (m,)
        Points near the others and in front of the cameras that see them.
    T : ndarray, shape (4, 4)
        Change of basis: cameras P T, points T^-1 Q.
    """

    points: Array
    centres: Array
    corners: Array
    shown: NDArray[np.bool_]
    T: Array


def display(reconstruction: Reconstruction, tracks: Tracks) -> Display:
    """Choose a basis in which a reconstruction looks plausible.

    Parameters
    ----------
    reconstruction : Reconstruction
        Cameras and points, in any basis.
    tracks : Tracks
        What they were made from.

    Returns
    -------
    Display
        What to draw. It is no calibration.

    Notes
    -----
    Where the views are nearly affine (a small scene far away) many bases are as plausible: the one
    chosen may stretch the scene in depth.

    References
    ----------
    .. [GF10] R. Gherardi, A. Fusiello, "Practical autocalibration", ECCV 2010: the plane at
       infinity that two guessed focal lengths imply, and trying them in turn.
    """
    low, high = tracks.xy.min(axis=0), tracks.xy.max(axis=0)
    unit = float(np.sum(high - low))
    to_pixels = np.diag([unit, unit, 1.0])
    to_pixels[:2, 2] = (low + high) / 2.0
    there = normalized().transformation(reconstruction.P, reconstruction.Q)
    P, Q = there.apply(np.asarray(np.linalg.solve(to_pixels, reconstruction.P)), reconstruction.Q)
    T = _best_basis(P, Q, tracks)
    P, Q = P @ T, np.asarray(np.linalg.solve(T, Q.T).T)
    depths = _depths(P, Q[tracks.point], tracks.view)
    if np.mean(depths > 0.0) < 0.5:
        mirror = np.diag([1.0, 1.0, 1.0, -1.0])
        T, P, Q, depths = T @ mirror, P @ mirror, Q @ mirror, -depths
    behind = np.bincount(tracks.point, depths <= 0.0, minlength=len(Q)) > 0
    upright = _upright(P, Q[~behind] if (~behind).any() else Q)
    P, Q = P @ upright, np.asarray(np.linalg.solve(upright, Q.T).T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = Q[:, :3] / Q[:, 3:]
        far = ~(np.linalg.norm(points, axis=1) < FAR_POINT)
    box = (np.array([low, (high[0], low[1]), high, (low[0], high[1])]) - to_pixels[:2, 2]) / unit
    centres, corners = _pyramids(P, box)
    distances = np.linalg.norm(centres, axis=1, keepdims=True)
    centres = centres * (FAR_CAMERA / np.maximum(distances, FAR_CAMERA))
    return Display(points, centres, corners, ~(behind | far), there.T @ T @ upright)


def _best_basis(P: Array, Q: Array, tracks: Tracks) -> Array:
    """Try pairs of cameras with focal lengths, refine the best few, and return the best."""
    rows = slice(None, None, -(-len(tracks) // _OBSERVATIONS))
    view, seen = tracks.view[rows], Q[tracks.point[rows]]

    def penalty(T: Array) -> float:
        ahead = float(np.mean(_depths(P @ T, np.asarray(np.linalg.solve(T, seen.T).T), view) > 0.0))
        return _BEHIND * min(ahead, 1.0 - ahead)

    a, b = np.nonzero(~np.eye(len(P), dtype=np.bool_))
    some = np.linspace(0, len(a) - 1, min(len(a), _PAIRS)).astype(int)
    tried: list[tuple[float, int, int, Array]] = []
    for i, k in zip(a[some].tolist(), b[some].tolist(), strict=True):
        first = _camera_basis(P[i])
        for f in _FOCAL:
            T = first @ _basis_of_pair(P[k] @ first, f)
            tried.append((_unlikely(P @ T) + penalty(T), len(tried), i, T))
    tried.sort()
    for _, _, i, T in tried[:_REFINED]:
        T = _refined(P, i, T)
        tried.append((_unlikely(P @ T) + penalty(T), len(tried), i, T))
    return min(tried)[3]


def _basis_of_pair(P2: Array, f: float) -> Array:
    """Return the basis that two focal lengths f imply for (I | 0) and P2 (GF10, section 3.1)."""
    K, K_inverse = np.diag([f, f, 1.0]), np.diag([1.0 / f, 1.0 / f, 1.0])
    t = K_inverse @ P2[:, 3]
    length = np.linalg.norm(t)
    R = np.vstack([t / length, np.linalg.svd(t[None])[2][1:]])
    R[2] *= np.sign(np.linalg.det(R))
    w1, w2, w3 = R @ K_inverse @ P2[:, :3] @ K
    T = np.eye(4)
    T[:3, :3], T[3, :3] = K, (np.cross(w2, w3) / np.linalg.norm(w3) - w1) / length
    return T


def _unlikely(P: Array) -> float:
    """Return the mean squared deviation of cameras from usual ones."""
    return float(np.mean(_deviations(P) ** 2))


def _deviations(P: Array) -> Array:
    """Return how far cameras are from usual ones, in usual deviations; large ones grow slowly.

    A camera with few points is badly determined, and a long sequence drifts: not all cameras of a
    projective reconstruction can be usual in one basis.
    """
    # K K^T = (f^2 + s^2 + u^2, ...), up to scale.
    M = P[:, :, :3]
    dual = M @ M.swapaxes(1, 2)
    dual = dual / dual[:, 2:, 2:]
    u, v = dual[:, 0, 2], dual[:, 1, 2]
    xx, yy = (np.maximum(dual[:, k, k] - dual[:, k, 2] ** 2, 1e-12) for k in (0, 1))
    log_f = 0.25 * np.log(xx * yy)
    f = np.exp(log_f)
    cameras = np.stack(
        [
            u / f / _CENTRE,
            v / f / _CENTRE,
            0.5 * np.log(xx / yy) / _ASPECT,
            (dual[:, 0, 1] - u * v) / f**2 / _SKEW,
            (log_f - np.median(log_f)) / _SAME_FOCAL,
        ]
    )
    size = np.sum(cameras**2, axis=0)
    cameras = cameras * _GROSS * np.sqrt(np.log1p(size / _GROSS**2) / np.maximum(size, 1e-300))
    return np.append(cameras.ravel(), (np.median(log_f) - np.log(0.7)) / _ANY_FOCAL)


@dataclass(frozen=True)
class _Basis:
    T: Array
    r: Array
    cost: float


class _Refinement:
    """Six numbers of a basis: focal length, principal point of a camera; plane at infinity."""

    floor = 0.0

    def __init__(self, P: Array, camera: int) -> None:
        self.P, self.first = P, _camera_basis(P[camera])

    def evaluate(self, T: Array) -> _Basis:
        with np.errstate(all="ignore"):
            r = _deviations(self.P @ T)
        cost = 0.5 * float(r @ r)
        return _Basis(T, r, cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: _Basis) -> Dense:
        columns = []
        for k in range(6):
            ahead, behind = (
                self.evaluate(self.retract(state, h * np.eye(6)[k])).r for h in (1e-6, -1e-6)
            )
            columns.append((ahead - behind) / 2e-6)
        J = np.stack(columns, axis=1)
        N = J.T @ J
        return Dense(J.T @ state.r, N, np.diag(N).copy())

    def retract(self, state: _Basis, step: Array) -> Array:
        move = np.eye(4)
        move[[0, 1], [0, 1]] = np.exp(step[0])
        move[:2, 2] = step[1:3]
        move[3, :3] = step[3:]
        return np.asarray(self.first @ move @ np.linalg.solve(self.first, state.T))


def _refined(P: Array, camera: int, T: Array) -> Array:
    """Return the basis of least squared deviations near another."""
    stopping = lm.Stopping(ftol=1e-4, max_iter=30)
    return lm.minimize(_Refinement(P, camera), T, Levenberg(), lm.Classic(), stopping).state.T


def _depths(P: Array, seen: Array, view: Indices) -> Array:
    """Return numbers with the sign of the depth of points in the views that see them."""
    signs = np.sign(np.linalg.det(P[:, :, :3]))
    third = np.einsum("ni,ni->n", P[view, 2], seen)
    return np.asarray(signs[view] * third * np.sign(seen[:, 3]))


def _upright(P: Array, Q: Array) -> Array:
    """Return the similarity to the points' middle, their usual distance from it, and z up."""
    points = Q[:, :3] / Q[:, 3:]
    middle = np.median(points, axis=0)
    size = float(np.median(np.linalg.norm(points - middle, axis=1)))
    M = P[:, :, :3] * np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    ahead = np.mean(M[:, 2] / np.linalg.norm(M[:, 2], axis=1, keepdims=True), axis=0)
    # Down the image is the second row of the rotation.
    z, y = M[:, 2], M[:, 1]
    down = y - np.sum(y * z, axis=1, keepdims=True) / np.sum(z * z, axis=1, keepdims=True) * z
    up = -np.mean(down / np.linalg.norm(down, axis=1, keepdims=True), axis=0)
    # ahead ~ y as far as up = z allows, and a fixed axis where cameras look all around.
    up = up / (np.linalg.norm(up) or 1.0)
    if np.linalg.norm(np.cross(up, ahead)) < 1e-3:
        ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(ahead, up)
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = size * np.column_stack([x, np.cross(up, x), up])
    T[:3, 3] = middle
    return T


def _pyramids(P: Array, box: Array) -> tuple[Array, Array]:
    """Return centres, and directions to the corners of a box in the image."""
    M = P[:, :, :3] * np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    inverse = np.linalg.inv(M)
    centres = -(np.linalg.inv(P[:, :, :3]) @ P[:, :, 3:])[:, :, 0]
    corners = np.column_stack([box, np.ones(len(box))])
    directions = np.einsum("nij,cj->nci", inverse, corners)
    return centres, directions / np.linalg.norm(directions, axis=2, keepdims=True)


def _camera_basis(P: Array) -> Array:
    """Return T with P T = (I | 0): pseudo-inverse, then camera centre."""
    return np.column_stack([np.linalg.pinv(P), np.linalg.svd(P)[2][3]])
