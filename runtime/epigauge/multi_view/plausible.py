"""The projective basis in which cameras and points look most like usual ones.

What most cameras have: square pixels, the principal point amid the image points, one focal length,
and the scene in front of them. What most scenes have: about the same extent in two directions.
Deviations from that are measured in usual ones, the basis with the fewest is looked for by trying
pairs of cameras with focal lengths, and the best of these are refined. This is **no calibration**.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.linear import Dense, Seber

__all__ = ["basis_of_pair", "camera_basis", "camera_deviations", "depth_signs", "plausible_basis"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Focal lengths tried, in units of width plus height of what the views show.
_FOCAL = np.geomspace(0.15, 15.0, 24)
#: Usual deviations: of the principal point, in focal lengths; of the logarithm of the aspect ratio;
#: of the skew, in radians; of the logarithm of the focal length from the common one, and of that
#: from 0.7 units; of the logarithm of the scene's length over its width.
_CENTRE, _ASPECT, _SKEW, _SAME_FOCAL, _ANY_FOCAL, _LENGTH = 0.05, 0.05, 0.05, 0.1, 2.0, 0.7
#: A camera's deviation grows slowly beyond so many usual ones.
_GROSS = 5.0
#: Cameras of one sequence deviate alike: all together they count as so many.
_COUNTED = 5.0
#: Points lose weight beyond so many usual distances from their middle.
_FAR = 3.0
#: Penalty where all points are behind the cameras, in squared usual deviations.
_BEHIND = 3000.0
_PAIRS, _OBSERVATIONS, _POINTS, _REFINED = 40, 2000, 300, 6


@np.errstate(all="ignore")
def plausible_basis(P: Array, Q: Array, view: Indices, point: Indices) -> Array:
    """Return the basis T in which cameras P T and points T^-1 Q look most like usual ones.

    Parameters
    ----------
    P : ndarray, shape (n, 3, 4)
        Cameras, to image points with the origin in the middle of what the views show and the unit
        of its width plus height; x to the right and y down, if the scene is not to be mirrored.
    Q : ndarray, shape (m, 4)
        Points, in the same well-conditioned basis (see `gauge.normalized`).
    view, point : ndarray of int, shape (N,)
        Which view sees which point.

    Returns
    -------
    ndarray, shape (4, 4)
        T; most points are in front of the cameras (`depth_signs`).

    Raises
    ------
    LinAlgError
        If cameras or points are so degenerate that no basis can be tried.

    References
    ----------
    .. [GF10] R. Gherardi, A. Fusiello, "Practical autocalibration", ECCV 2010: the plane at
       infinity that two guessed focal lengths imply, and trying them in turn.
    """
    rows = slice(None, None, -(-len(view) // _OBSERVATIONS))
    views, seen = view[rows], Q[point[rows]]
    few = Q[:: -(-len(Q) // _POINTS)]

    def penalty(T: Array) -> float:
        ahead = float(np.mean(depth_signs(P @ T, _in_basis(T, seen), views) > 0.0))
        return _BEHIND * min(ahead, 1.0 - ahead)

    tried: list[tuple[float, int, _Plausibility, Array]] = []

    def attempt(problem: _Plausibility, T: Array) -> None:
        tried.append((problem.evaluate(T).cost, len(tried), problem, T))

    a, b = np.nonzero(~np.eye(len(P), dtype=np.bool_))
    some = np.linspace(0, len(a) - 1, min(len(a), _PAIRS)).astype(int)
    for i, k in zip(a[some].tolist(), b[some].tolist(), strict=True):
        problem = _Plausibility(P, few, camera_basis(P[i]), penalty)
        # A camera and its negative are the same, but of the planes at infinity that they lead to
        # one has the points in front of one camera and behind the other.
        for P2 in (P[k] @ problem.first, -P[k] @ problem.first):
            for f in _FOCAL:
                attempt(problem, problem.first @ basis_of_pair(P2, f))
    tried.sort()
    if tried[0][0] == float("inf"):
        raise np.linalg.LinAlgError("no basis")
    for cost, _, problem, T in tried[:_REFINED]:
        if cost < float("inf"):
            attempt(problem, _refined(problem, T, ftol=1e-4))
    best = min(tried)
    T = _refined(best[2], best[3], ftol=1e-8)
    signs = depth_signs(P @ T, _in_basis(T, Q)[point], view)
    # The other of the two bases with this plane at infinity has every depth of the other sign.
    return T if np.mean(signs > 0.0) >= 0.5 else T @ np.diag([1.0, 1.0, 1.0, -1.0])


def camera_deviations(P: Array) -> Array:
    """Return how far cameras are from usual ones, in usual deviations.

    Parameters
    ----------
    P : ndarray, shape (n, 3, 4)
        Cameras, to the image points of `plausible_basis`.

    Returns
    -------
    ndarray, shape (5, n)
        Deviations of the principal point (two), of the aspect ratio, of the skew, and of the focal
        length from the cameras' median.
    """
    intrinsics = _intrinsics(P)
    return _from_usual(intrinsics, float(np.median(intrinsics[4])))


def depth_signs(P: Array, Q: Array, view: Indices) -> Array:
    """Return the sign of the depth of points in the views that see them.

    Parameters
    ----------
    P : ndarray, shape (n, 3, 4)
        Cameras in a basis whose plane at infinity is the last coordinate.
    Q : ndarray, shape (N, 4)
        The point of each observation.
    view : ndarray of int, shape (N,)
        The view of each observation.

    Returns
    -------
    ndarray, shape (N,)
        1 for a point in front of a camera that takes pictures and not mirror images, -1 behind it,
        0 in its focal plane and at infinity.

    References
    ----------
    .. [HZ04] R. Hartley, A. Zisserman, "Multiple View Geometry", 2nd edition, 2004, eq. (6.15).
    """
    handed = np.sign(np.linalg.det(P[:, :, :3]))
    third = np.einsum("ni,ni->n", P[view, 2], Q)
    return np.asarray(handed[view] * np.sign(third) * np.sign(Q[:, 3]))


@dataclass(frozen=True)
class _Basis:
    T: Array
    r: Array
    cost: float


class _Plausibility:
    """Deviations of cameras and scene from usual ones, over the six numbers of a basis.

    The numbers are a focal length and principal point of one camera, and the plane at infinity.
    """

    floor = 0.0

    def __init__(
        self, P: Array, few: Array, first: Array, penalty: Callable[[Array], float]
    ) -> None:
        self.P, self.few, self.first, self.penalty = P, few, first, penalty

    def evaluate(self, T: Array) -> _Basis:
        try:
            r = self._deviations(T)
            cost = 0.5 * float(r @ r) + self.penalty(T)
        except np.linalg.LinAlgError:  # two cameras in one place, for instance
            return _Basis(T, np.zeros(0), float("inf"))
        return _Basis(T, r, cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: _Basis) -> Dense:
        columns = []
        for k in range(6):
            ahead, behind = (
                self._deviations(self.retract(state, h * np.eye(6)[k])) for h in (1e-6, -1e-6)
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

    def _deviations(self, T: Array) -> Array:
        """Return all deviations, gross ones of cameras reduced.

        A camera with few points is badly determined, and a long sequence drifts: not all cameras
        of a projective reconstruction can be usual in one basis.
        """
        intrinsics = _intrinsics(self.P @ T)
        log_f = float(np.median(intrinsics[4]))
        cameras = _from_usual(intrinsics, log_f)
        size = np.sum(cameras**2, axis=0)
        cameras = cameras * _GROSS * np.sqrt(np.log1p(size / _GROSS**2) / np.maximum(size, 1e-300))
        cameras *= np.sqrt(min(1.0, _COUNTED / len(self.P)))
        scene = (log_f - np.log(0.7)) / _ANY_FOCAL, _log_length(_in_basis(T, self.few)) / _LENGTH
        return np.append(cameras.ravel(), scene)


def _refined(problem: _Plausibility, T: Array, ftol: float) -> Array:
    """Return the most plausible basis near another."""
    stopping = lm.Stopping(ftol=ftol, max_iter=60)
    return lm.minimize(problem, T, Seber(), lm.Classic(), stopping).state.T


def basis_of_pair(P2: Array, f: float) -> Array:
    """Return the basis that two focal lengths imply for (I | 0) and another camera [GF10]_.

    Parameters
    ----------
    P2 : ndarray, shape (3, 4)
        Second camera.
    f : float
        Both focal lengths, principal points in the origin.

    Returns
    -------
    ndarray, shape (4, 4)
        T, in which both cameras have them: section 3.1.
    """
    K, K_inverse = np.diag([f, f, 1.0]), np.diag([1.0 / f, 1.0 / f, 1.0])
    t = K_inverse @ P2[:, 3]
    length = np.linalg.norm(t)
    R = np.vstack([t / length, np.linalg.svd(t[None])[2][1:]])
    R[2] *= np.sign(np.linalg.det(R))
    w1, w2, w3 = R @ K_inverse @ P2[:, :3] @ K
    T = np.eye(4)
    T[:3, :3], T[3, :3] = K, (np.cross(w2, w3) / np.linalg.norm(w3) - w1) / length
    return T


def _from_usual(intrinsics: Array, common_log_f: float) -> Array:
    """Return the deviations (5, n) of what `_intrinsics` returned from the usual."""
    usual = np.array([_CENTRE, _CENTRE, _ASPECT, _SKEW, _SAME_FOCAL])
    means = np.array([0.0, 0.0, 0.0, 0.0, common_log_f])
    return np.asarray((intrinsics - means[:, None]) / usual[:, None])


def _intrinsics(P: Array) -> Array:
    """Return principal point (two), log of fx / fy, skew, and log of f, (5, n).

    The principal point and the skew are in focal lengths.
    """
    # K K^T = (f^2 + s^2 + u^2, ...), up to scale.
    M = P[:, :, :3]
    dual = M @ M.swapaxes(1, 2)
    dual = dual / dual[:, 2:, 2:]
    u, v = dual[:, 0, 2], dual[:, 1, 2]
    xx, yy = (np.maximum(dual[:, k, k] - dual[:, k, 2] ** 2, 1e-12) for k in (0, 1))
    log_f = 0.25 * np.log(xx * yy)
    f = np.exp(log_f)
    log_aspect, skew = 0.5 * np.log(xx / yy), (dual[:, 0, 1] - u * v) / f**2
    return np.stack([u / f, v / f, log_aspect, skew, log_f])


def _log_length(Q: Array) -> float:
    """Return the logarithm of the extent of points along their first axis over the second."""
    X = Q[:, :3] / Q[:, 3:]
    X = X - np.median(X, axis=0)
    squared = np.sum(X**2, axis=1)
    X = X / np.sqrt(1.0 + squared / (_FAR**2 * np.median(squared)))[:, None]
    extents = np.linalg.svd(X, compute_uv=False)
    return float(np.log(extents[0] / extents[1]))


def _in_basis(T: Array, Q: Array) -> Array:
    """Return points T^-1 Q."""
    return np.asarray(Q @ np.linalg.inv(T).T)


def camera_basis(P: Array) -> Array:
    """Return T with P T = (I | 0): pseudo-inverse, then camera centre.

    Parameters
    ----------
    P : ndarray, shape (3, 4)
        Camera.

    Returns
    -------
    ndarray, shape (4, 4)
        T.
    """
    return np.column_stack([np.linalg.pinv(P), np.linalg.svd(P)[2][3]])
