"""Metric bases of a projective reconstruction, from what its cameras have in common.

Cameras have square pixels, a principal point near the centre of the image, and some share their
focal length. Linear equations in the dual absolute quadric, for a grid of focal lengths, give
bases; the best of them are refined over the eight numbers that a metric basis has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.kernels import Table
from epigauge.linear import Dense, Seber
from epigauge.metric.usual import FOCALS
from epigauge.multi_view.plausible import basis_of_pair, camera_basis

__all__ = ["Basis", "Views", "metric_bases"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Usual deviations in the linear equations [1]: of the focal length from the one tried, of the
#: aspect ratio from one, of the skew from zero, of the principal point, in focal lengths.
_LINEAR_FOCAL, _LINEAR_ASPECT, _LINEAR_SKEW, _LINEAR_CENTRE = 1.0, 0.1, 0.05, 0.2

#: Usual deviations in the refinement, which the equations there are divided by: of log f from
#: that of the group, log of the aspect ratio, skew, and principal point in width plus height.
_USUAL = np.array([0.02, 0.01, 0.01, 0.05, 0.05])

#: A focal length without a group is held loosely to the others': a factor of e^0.5.
_ALONE = 0.5

#: A view's deviation counts no more than so many usual ones: some views of a reconstruction from
#: raw tracks are wrong.
_GROSS = 5.0

#: Rotations of a camera that may be said not to turn, radians times its field of view.
_STRAIGHT = 0.05

#: Bases that are refined, and how near equal ones are: log of focal lengths, angle of planes.
_REFINED, _SAME = 6, 0.02


@dataclass(frozen=True)
class Views:
    """Projective cameras in image coordinates about the centre, in units of width plus height.

    Attributes
    ----------
    P : ndarray, shape (n, 3, 4)
        Cameras; see `conditioned`.
    group : ndarray of int, shape (n,)
        Which camera took which view.
    kernels : Table
        Backend.
    """

    P: Array
    group: Indices
    kernels: Table

    def conditioned(self) -> tuple[Views, Array]:
        """Return the views in a basis that spreads the cameras evenly, and the basis.

        P <- P T with third rows of length one and sum P^T P ~ I, alternately until both hold.
        """
        T = np.eye(4)
        P = self.P
        for _ in range(4):
            P = P / np.linalg.norm(P[:, 2], axis=1)[:, None, None]
            N = np.einsum("nij,nik->jk", P, P) / len(P)
            values, vectors = np.linalg.eigh(N)
            root = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
            P, T = P @ root, T @ root
        return Views(P, self.group, self.kernels), T

    def intrinsics(self, H: Array) -> tuple[Array, Array]:
        """Return (log f, log fx / fy, skew, cx, cy) of the cameras P H, (5, n), and Jacobians."""
        with np.errstate(all="ignore"):
            values, J = self.kernels.camera_intrinsics(np.moveaxis(self.P @ H, 0, -1))
        return values, J

    def common(self, x: Array) -> Array:
        """Return the mean of each group (last axis: views), for each of its views."""
        member = (self.group == np.arange(self.group.max() + 1)[:, None]).astype(float)
        means = x @ (member / member.sum(axis=1, keepdims=True)).T
        return np.asarray(means[..., self.group])

    def alone(self) -> NDArray[np.bool_]:
        """Return which views share their focal length with no other."""
        return np.asarray(np.bincount(self.group)[self.group] == 1)

    @np.errstate(invalid="ignore")
    def deviations(self, values: Array) -> Array:
        """Return how far intrinsics, or changes of them, are from usual ones, (..., 5, n)."""
        r = values / _USUAL[:, None]
        log_f = values[..., 0, :]
        from_group = (log_f - self.common(log_f)) / _USUAL[0]
        from_all = (log_f - log_f.mean(axis=-1, keepdims=True)) / _ALONE
        r[..., 0, :] = np.where(self.alone(), from_all, from_group)
        return np.asarray(r)


@dataclass(frozen=True)
class Basis:
    """A metric basis.

    Attributes
    ----------
    H : ndarray, shape (4, 4)
        Cameras P H are metric: the plane at infinity is the last coordinate.
    focal : float
        Median focal length, in units of width plus height.
    deviation : float
        Median over the views of the squared deviation of their intrinsics from usual ones.
    cost : float
        Half the sum of these, gross ones reduced.
    """

    H: Array
    focal: float
    deviation: float
    cost: float


def metric_bases(views: Views) -> list[Basis]:
    """Return metric bases, best first.

    Parameters
    ----------
    views : Views
        Cameras.

    Returns
    -------
    list of Basis
        Distinct ones; none where the cameras fit no metric basis.

    References
    ----------
    .. [1] M. Pollefeys, R. Koch, L. Van Gool, "Self-calibration and metric reconstruction in spite
       of varying and unknown intrinsic camera parameters", IJCV 32(1), 1999; weights as in
       M. Pollefeys et al., "Visual modeling with a hand-held camera", IJCV 59(3), 2004.
    """
    conditioned, T = views.conditioned()
    if len(views.P) == 2:
        starts = _of_pair(conditioned)
    else:
        starts = [H for H in (_linear(conditioned, f) for f in FOCALS) if H is not None]
    tried = [basis for basis in (_judged(conditioned, H) for H in starts) if basis.cost < np.inf]
    tried.sort(key=lambda basis: basis.deviation)
    found: list[Basis] = []
    for basis in tried[:_REFINED]:
        refined = _refined(conditioned, basis.H)
        if not any(_alike(refined, other) for other in found):
            found.append(refined)
    found.sort(key=lambda basis: basis.cost)
    # Of a camera that does not turn all bases are alike, and few of them good to begin from.
    still = _translated(conditioned)
    found = found if still is None else [_judged(conditioned, still), *found]
    return [Basis(T @ basis.H, basis.focal, basis.deviation, basis.cost) for basis in found]


def _alike(one: Basis, other: Basis) -> bool:
    """Tell whether two bases have nearly the same focal length and plane at infinity."""
    planes = [np.linalg.inv(basis.H)[3] for basis in (one, other)]
    cosine = planes[0] @ planes[1] / np.linalg.norm(planes[0]) / np.linalg.norm(planes[1])
    near = abs(np.log(one.focal / other.focal)) < _SAME
    return bool(near and 1.0 - abs(cosine) < _SAME**2)


def _linear(views: Views, focal: float) -> Array | None:
    """Return the basis that linear equations give for a focal length, of rank three and PSD."""
    P = views.P / np.array([focal, focal, 1.0])[:, None]
    P = P / np.linalg.norm(P[:, 2], axis=1)[:, None, None]
    rows = views.kernels.dual_image_rows(np.moveaxis(P, 0, -1))
    xx, xy, xz, yy, yz, zz = rows
    equations = np.concatenate(
        [
            xy / _LINEAR_SKEW,
            (xx - yy) / _LINEAR_ASPECT,
            xz / _LINEAR_CENTRE,
            yz / _LINEAR_CENTRE,
            (0.5 * (xx + yy) - zz) / _LINEAR_FOCAL,
        ],
        axis=1,
    )
    packed = np.linalg.eigh(equations @ equations.T)[1][:, 0]
    Omega = np.zeros((4, 4))
    Omega[np.triu_indices(4)] = packed
    Omega = Omega + np.triu(Omega, 1).T
    values, vectors = np.linalg.eigh(Omega)
    if values.sum() < 0.0:
        values, vectors = -values[::-1], vectors[:, ::-1]
    if not values[1] > 0.0:  # the nearest matrix of rank three is not positive semidefinite
        return None
    # The eigenvalue nearest to zero goes: the plane at infinity.
    return np.asarray(vectors[:, [3, 2, 1, 0]] * np.sqrt(np.append(values[:0:-1], values[3])))


def _translated(views: Views) -> Array | None:
    """Return the basis in which all cameras are nearly s_i (I | t_i), if there is one."""
    if views.group.max() > 0:
        return None
    # P_i H has no entries off its diagonal, and equal ones on it: linear in H (4, 3).
    seen = np.einsum("nij,jlk->nikl", views.P, np.eye(12).reshape(4, 3, 12)).swapaxes(2, 3)
    seen = seen.reshape(-1, 9, 12)
    rows = np.delete(seen, [0, 4, 8], axis=1)
    equal = seen[:, [0, 4]] - seen[:, [4, 8]]
    equations = np.concatenate([rows, equal], axis=1).reshape(-1, 12)
    frame = np.linalg.eigh(equations.T @ equations)[1][:, 0].reshape(4, 3)
    M = views.P @ frame
    scales = np.trace(M, axis1=1, axis2=2) / 3.0
    if np.abs(scales).min() < 1e-3 * np.abs(scales).max():
        return None
    if np.abs(M / scales[:, None, None] - np.eye(3)).max() > _STRAIGHT:
        return None
    return np.column_stack([frame, np.linalg.svd(frame)[0][:, 3]])


def _of_pair(views: Views) -> list[Array]:
    """Return bases of two views: both focal lengths as tried, principal points in the centres.

    Two views have no linear equations: C1 C2^T + C2 C1^T of their centres solves all of them.
    """
    first = camera_basis(views.P[0])
    second = views.P[1] @ first
    return [first @ basis_of_pair(P2, f) for P2 in (second, -second) for f in FOCALS]


def _judged(views: Views, H: Array) -> Basis:
    """Return a basis with its deviations."""
    values, _ = views.intrinsics(H)
    r = np.sum(views.deviations(values) ** 2, axis=0)
    if not np.isfinite(r).all():
        return Basis(H, float("nan"), float("inf"), float("inf"))
    cost = 0.5 * float(np.sum(_reduced(r)))
    focal = float(np.exp(np.median(values[0])))
    return Basis(H, focal, float(np.median(r)), cost)


def _reduced(squares: Array) -> Array:
    """Return squared deviations of views, gross ones reduced (Cauchy)."""
    return np.asarray(_GROSS**2 * np.log1p(squares / _GROSS**2))


def _refined(views: Views, H: Array) -> Basis:
    """Return the best basis near another: eight numbers, by Levenberg-Marquardt."""
    stopping = lm.Stopping(ftol=1e-8, max_iter=60)
    found = lm.minimize(_Refinement(views), H, Seber(), lm.Classic(), stopping)
    return _judged(views, found.state.H)


@dataclass(frozen=True)
class _State:
    H: Array
    r: Array
    J: Array
    cost: float


class _Refinement:
    """Deviations of the intrinsics of all views, over the eight numbers of a metric basis.

    They are counted from where the basis is: five of its frame's intrinsics, and three of the plane
    at infinity in units in which the cameras are spread over a distance of one.
    """

    floor = 0.0

    def __init__(self, views: Views) -> None:
        self.views = views

    @np.errstate(all="ignore")
    def evaluate(self, H: Array) -> _State:
        M = self.views.P @ H
        scale = np.linalg.norm(M[:, :, :3]) / max(float(np.linalg.norm(M[:, :, 3])), 1e-300)
        H = H * np.array([1.0, 1.0, 1.0, scale])
        values, J = self.views.intrinsics(H)
        r = self.views.deviations(values)
        squares = np.sum(r**2, axis=0)
        cost = 0.5 * float(np.sum(_reduced(squares)))
        return _State(H, r, J, cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: _State) -> Dense:
        root = 1.0 / np.sqrt(1.0 + np.sum(state.r**2, axis=0) / _GROSS**2)
        J = self.views.deviations(np.moveaxis(state.J, 1, 0))
        J, r = (J * root).reshape(8, -1), (state.r * root).ravel()
        N = J @ J.T
        return Dense(J @ r, N, np.maximum(np.diag(N), 1e-12 * np.trace(N)))

    def retract(self, state: _State, step: Array) -> Array:
        move = np.eye(4)
        move[0, :3] += step[:3]
        move[1, 1:3] += step[3:5]
        move[3, :3] = step[5:]
        return np.asarray(state.H @ move)
