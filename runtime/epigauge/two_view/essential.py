"""Essential matrices: their five parameters, and the motion of calibrated cameras behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.two_view.parameterizations import OrthonormalF

__all__ = [
    "Calibrated",
    "Essential",
    "Motion",
    "in_front",
    "motion_from_essential",
    "motions",
    "rotation_between",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Squared standard deviations that a match may speak against a motion at most: one wrong match far
#: behind the cameras must not turn the motion of all others round.
_DOUBT = 9.0

#: A noise below this, in conditioned coordinates, is rounding.
_ROUNDING = 1e-8

#: Matches that tell R from that of the twisted pair at a start, about.
_VOTERS = 100

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Essential:
    """Five parameters of E = U diag(1, 1, 0) V^T = [t]_x R: three turn R, two move t.

    R = U W V^T, W the quarter turn, stays exactly where it is while t = u3 moves. In a narrow field
    of view t is known to a tenth of a radian and R to 1e-7: moving both epipoles independently, as
    `Ortho` does, would turn R by the square of the step in t.

    Parameters
    ----------
    kernels : Table
        Backend.
    rays : pair of ndarray, shape (m, 3), optional
        Matches as directions: tell R from that of the twisted pair, U W^T V^T, at a start.
    """

    dimension = 5

    def __init__(self, kernels: Table, rays: tuple[Array, Array] | None = None) -> None:
        self._kernels = kernels
        self._rays = rays

    def start(self, F: Array) -> OrthonormalF:
        """Return the factors of the nearest essential matrix, both right-handed."""
        U, _, Vt = np.linalg.svd(F)
        U, V = U * np.linalg.det(U), Vt.T * np.linalg.det(Vt)
        if self._rays is not None:
            step = len(self._rays[0]) // _VOTERS + 1
            R, _ = motion_from_essential(F, *(rays[::step] for rays in self._rays))
            if np.sum(R * (U @ _QUARTER_TURN.T @ V.T)) > np.sum(R * (U @ _QUARTER_TURN @ V.T)):
                U = U * [-1.0, -1.0, 1.0]  # the same E up to sign
        return OrthonormalF(U, V, np.asarray(1.0))

    def fundamental(self, estimate: OrthonormalF) -> Array:
        """Return E."""
        return np.asarray(self._kernels.fundamental_from_factors(*estimate))

    def derivatives(self, estimate: OrthonormalF) -> tuple[Array, Array]:
        """Return the derivatives of E."""
        _, first, second = self._kernels.essential_derivatives(estimate.U, estimate.V)
        return first, second

    def camera(self, estimate: OrthonormalF) -> tuple[Array, Array]:
        """Return the canonic P' and its derivative."""
        P2, derivative = self._kernels.essential_camera_derivatives(estimate.U, estimate.V)
        return P2, derivative

    def retract(self, estimate: OrthonormalF, delta: Array) -> OrthonormalF:
        """Return the updated factors."""
        U, V = self._kernels.essential_retract(estimate.U, estimate.V, delta)
        return OrthonormalF(U, V, estimate.sigma)


@dataclass(frozen=True)
class Motion:
    """The motion behind an essential matrix, and which points lie in front of both cameras.

    Attributes
    ----------
    R : ndarray, shape (3, 3)
        Rotation with x2 = R x1 + t.
    t : ndarray, shape (3,)
        Of unit length.
    excess : ndarray, shape (m,)
        By how much the squared distance of each match to the nearest match of a point in front of
        both cameras exceeds that to the epipolar geometry: zero for points in front.
    doubt : float or ndarray
        Half the excess in units of the noise squared, no match counting more than three standard
        deviations: what speaks against points in front, beside the cost.
    """

    R: Array
    t: Array
    excess: Array
    doubt: Any


class Calibrated:
    """Matches of calibrated cameras in the coordinates that are computed in.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, m)
        Matches.
    A1, A2 : ndarray, shape (3, 3)
        Maps of the images from rays (x, y, 1) in the camera frame.
    """

    def __init__(self, q1: Array, q2: Array, A1: Array, A2: Array) -> None:
        self.q1, self.q2 = q1, q2
        self.A1, self.A2 = A1, A2
        self._from1, self._from2 = np.linalg.inv(A1), np.linalg.inv(A2)

    def some(self, rows: NDArray[np.intp] | Mask) -> Calibrated:
        """Return some of the matches."""
        return Calibrated(self.q1[:, rows], self.q2[:, rows], self.A1, self.A2)

    def rays(self, q1: Array, q2: Array) -> tuple[Array, Array]:
        """Return points as directions (m, 3) in the camera frames, with z = 1."""
        first = q1.T @ self._from1[:, :2].T + self._from1[:, 2]
        return first, q2.T @ self._from2[:, :2].T + self._from2[:, 2]

    def fundamental(self, E: Array) -> Array:
        """Return essential matrices as F of unit norm in the coordinates of the matches."""
        F = self._from2.T @ E @ self._from1
        return np.asarray(F / np.linalg.norm(F, axis=(-2, -1), keepdims=True))

    def motion(
        self,
        F: Array,
        hats: tuple[Array, Array],
        squared: Array,
        weights: Array,
        noise2: Array | float,
        unit2: Array | float = 1.0,
    ) -> Motion:
        """Choose among the four motions of essential matrices (cheirality).

        Parameters
        ----------
        F : ndarray, shape (..., 3, 3)
            Essential matrices, in the coordinates of the matches.
        hats : pair of ndarray, shape (2, m)
            Corrected matches.
        squared : ndarray, shape (..., m)
            Their squared distances from the measured ones, over `unit2`.
        weights : ndarray, shape (m,)
            Of the matches.
        noise2 : float or ndarray, shape (...)
            Variance of a coordinate of weight one.
        unit2 : ndarray, shape (m,), optional
            Unit of the squared distances.

        Returns
        -------
        Motion
            The one with the least doubt; all of it with the leading axes of F.

        Notes
        -----
        Matches of points in front of both cameras end where the point is at infinity (q2 ~ R q1),
        or in the centre of a camera (q1 = e1 or q2 = e2). A match beyond is as far from a possible
        one as from the nearest of these ends, so that no threshold is needed: a point that noise
        puts beyond infinity exceeds by no more than noise.
        """
        rays = self.rays(*hats)
        R, t = motions(np.swapaxes(self.A2, 0, 1) @ F @ self.A1)
        with np.errstate(over="ignore"):
            nearest = self._from_ends(R, t) / unit2
        excess = np.where(in_front(R, t, *rays), 0.0, np.maximum(nearest - squared, 0.0))
        least2 = np.maximum(noise2, _ROUNDING**2)[..., None]
        with np.errstate(over="ignore"):
            doubt = 0.5 * np.sum(np.minimum(weights * excess / least2, _DOUBT), axis=-1)
        best = np.argmin(doubt, axis=0)[None, ..., None]
        return Motion(
            np.take_along_axis(R, best[..., None], axis=0)[0],
            np.take_along_axis(t, best, axis=0)[0],
            np.take_along_axis(excess, best, axis=0)[0],
            np.take_along_axis(doubt, best[..., 0], axis=0)[0],
        )

    def _from_ends(self, R: Array, t: Array) -> Array:
        """Return squared distances of matches to where those of points in front end."""
        nearest = self.from_infinity(R)
        # A centre is seen by the other camera only where it is in front of it
        centre1 = -np.squeeze(np.swapaxes(R, -1, -2) @ t[..., None], -1)
        for A, q, centre in ((self.A1, self.q1, centre1), (self.A2, self.q2, t)):
            depth = np.where(centre[..., 2:] > 0.0, centre[..., 2:], np.inf)
            with np.errstate(over="ignore"):
                epipole = (centre / depth) @ A[:2].T
                squared = np.sum((q.T - epipole[..., None, :]) ** 2, axis=-1)
            nearest = np.where(np.isinf(depth), nearest, np.minimum(nearest, squared))
        return np.asarray(nearest)

    def from_infinity(self, R: Array) -> Array:
        """Return squared distances to q2 ~ R q1, matches of points at infinity, to first order."""
        H = self.A2 @ R @ self._from1
        mapped = H[..., :2] @ self.q1 + H[..., 2:]
        depth = mapped[..., 2, :]
        c = mapped[..., :2, :] - self.q2 * depth[..., None, :]
        # Rows of d c / d q1; d c / d q2 = -depth I
        J = H[..., :2, :2, None] - self.q2[:, None] * H[..., 2:, :2, None]
        a, b = J[..., 0, :, :], J[..., 1, :, :]
        aa, ab, bb = (np.sum(p * q, axis=-2) for p, q in ((a, a), (a, b), (b, b)))
        aa, bb = aa + depth**2, bb + depth**2
        c1, c2 = c[..., 0, :], c[..., 1, :]
        determinant = np.maximum(aa * bb - ab**2, np.finfo(float).tiny)
        with np.errstate(over="ignore"):  # a point that is mapped to infinity is infinitely far
            return np.asarray((bb * c1**2 - 2.0 * ab * c1 * c2 + aa * c2**2) / determinant)

    def from_rotation(self, weights: Array) -> Array:
        """Return squared distances to the best q2 ~ R q1: those of a camera that only turned.

        R is best for the rays, which is best for the images to first order in the noise.
        """
        units1, units2 = (
            r / np.linalg.norm(r, axis=1)[:, None] for r in self.rays(self.q1, self.q2)
        )
        return self.from_infinity(rotation_between(units1, units2, weights))


def motions(E: Array) -> tuple[Array, Array]:
    """Return the four motions of essential matrices (..., 3, 3) of any scale and sign.

    Rotations (4, ..., 3, 3) and translations (4, ..., 3) of unit length.
    """
    U, _, Vt = np.linalg.svd(E)
    U = U * np.linalg.det(U)[..., None, None]
    Vt = Vt * np.linalg.det(Vt)[..., None, None]
    turned = [U @ turn @ Vt for turn in (_QUARTER_TURN, _QUARTER_TURN.T)]
    t = U[..., 2]
    return np.stack([turned[0], turned[0], turned[1], turned[1]]), np.stack([t, -t, t, -t])


def in_front(R: Array, t: Array, rays1: Array, rays2: Array) -> Mask:
    """Tell which points have positive depths: depth2 rays2 = depth1 R rays1 + t.

    R (..., 3, 3) and t (..., 3) give a mask (..., m).
    """
    turned, along = rays1 @ np.swapaxes(R, -1, -2), t[..., None]
    # Crossed with either ray b = rays2, a = R rays1: depth1 (a x b) = b x t, depth2 (a x b) = a x t
    along1, along2 = (turned @ along)[..., 0], (rays2 @ along)[..., 0]
    product = np.einsum("...i,...i->...", turned, rays2)
    depth1 = product * along2 - np.einsum("...i,...i->...", rays2, rays2) * along1
    depth2 = np.einsum("...i,...i->...", rays1, rays1) * along2 - product * along1
    return np.asarray((depth1 > 0.0) & (depth2 > 0.0))


def motion_from_essential(E: Array, rays1: Array, rays2: Array) -> tuple[Array, Array]:
    """Choose among the four motions of an essential matrix that with most points in front.

    Parameters
    ----------
    E : ndarray, shape (3, 3)
        Essential matrix ``[t]x R``, of any scale and sign.
    rays1, rays2 : ndarray, shape (m, 3)
        Matches as directions in the camera frames: ``rays2^T E rays1 = 0``.

    Returns
    -------
    R : ndarray, shape (3, 3)
        Rotation with x2 = R x1 + t.
    t : ndarray, shape (3,)
        Of unit length.
    """
    R, t = motions(E)
    best = int(np.argmax(np.count_nonzero(in_front(R, t, rays1, rays2), axis=1)))
    return R[best], t[best]


def rotation_between(rays1: Array, rays2: Array, weights: Array | float = 1.0) -> Array:
    """Return the R of least squares of rays2 = R rays1, directions (m, 3) of unit length."""
    U, _, Vt = np.linalg.svd((rays2 * np.reshape(weights, (-1, 1))).T @ rays1)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
