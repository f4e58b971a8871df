"""What is minimised over F: distances of matches, with the sums that a Newton step needs.

A criterion evaluates the squared distance of every match and then, with weights from the loss,
adds up gradient and second derivatives by the nine entries of F. It knows nothing of how F is
parameterised; a parameterisation knows nothing of criteria.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table

__all__ = [
    "CRITERIA",
    "Criterion",
    "Distances",
    "FootPoints",
    "LineDistances",
    "Mahalanobis",
    "Reprojection",
    "settled",
]

Array = NDArray[np.float64]

#: A foot point is accepted when its last Newton change moved it by less than this (relative);
#: convergence is quadratic, so that the error left is the square of it.
_SETTLED = 1e-6

#: Squared derivative of a distance by F (conditioned, of unit size) beyond which the match counts
#: as lying on both epipoles, where the distance has no derivative; it is then left out of the step.
_SINGULAR = 1e14

_UPPER = np.triu_indices(9)


class Distances(Protocol):
    """Distances of all matches for one F."""

    @property
    def squared(self) -> Array:
        """Return the squared distance of each match, shape (m,)."""

    @property
    def signed(self) -> Array:
        """Return its root with the sign of ``q2^T F q1``, shape (m,)."""


class Criterion(Protocol):
    """A squared distance of a match from an epipolar geometry."""

    def evaluate(self, F: Array) -> Distances:
        """Return the distances for an F."""

    def derivative(self, F: Array, distances: Distances) -> Array:
        """Return the derivative of the signed distances by vect(F), shape (m, 9)."""

    def normal(
        self, F: Array, distances: Distances, weight: Array, curvature: Array | None
    ) -> tuple[Array, Array, Array]:
        """Return gradient (9,), J^T J (9, 9) and Hessian (9, 9) by vect(F).

        Of the sum of rho(squared) / 2 with `weight` rho' and `curvature` 2 rho''. Without a
        curvature, the Hessian is J^T J.
        """


@dataclass(frozen=True)
class FootPoints:
    """Foot points of all matches for one F.

    Attributes
    ----------
    frame : tuple of ndarray
        F in rotated images, as the kernel ``bilinear_frame`` gives it.
    multiplier, signed : ndarray, shape (m,)
        Lagrange multiplier and signed distance of each match.
    """

    frame: tuple[Array, ...]
    multiplier: Array
    signed: Array

    @property
    def squared(self) -> Array:
        """Return the squared distances."""
        return self.signed**2


class Reprojection:
    """The exact reprojection error: each match at its foot point, structure eliminated.

    The nearest pair of points that satisfies the epipolar geometry is found to rounding, so that
    the sum of squares is the bundle adjustment cost of B&S with m residuals instead of 4 m.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Matches.
    """

    def __init__(self, kernels: Table, q1: Array, q2: Array) -> None:
        self.kernels = kernels
        self.q1, self.q2 = q1, q2

    def evaluate(self, F: Array) -> FootPoints:
        """Find the foot point of every match.

        A fixed number of Newton steps settles nearly all of them; the others, near an epipole, are
        bracketed down to rounding.
        """
        frame = self.kernels.bilinear_frame(F)
        with np.errstate(all="ignore"):  # Newton may step onto a pole
            multiplier, change, d = self.kernels.foot_point(*frame, self.q1, self.q2)
            unsettled = _unsettled(multiplier, change, d)
        if unsettled.any():
            q1, q2 = self.q1[:, unsettled], self.q2[:, unsettled]
            safe = self.kernels.foot_point_safe(*frame, q1, q2)
            multiplier[unsettled], _, d[unsettled] = safe
        return FootPoints(frame, multiplier, d)

    def corrected(self, feet: FootPoints) -> tuple[Array, Array, Array]:
        """Return corrected matches, shape (2, m) each, and dd / d vect(F), shape (9, m)."""
        q1_hat, q2_hat, derivative = self.kernels.foot_point_derivative(
            *feet.frame, self.q1, self.q2, feet.multiplier
        )
        return q1_hat, q2_hat, derivative

    def derivative(self, F: Array, distances: Distances) -> Array:
        """Return the derivative of the signed distances by vect(F), shape (m, 9)."""
        assert isinstance(distances, FootPoints)
        return self.corrected(distances)[2].T

    def normal(
        self, F: Array, distances: Distances, weight: Array, curvature: Array | None
    ) -> tuple[Array, Array, Array]:
        """Return gradient, J^T J and Hessian; summed in rotated images, turned back here."""
        assert isinstance(distances, FootPoints)
        matches = (self.q1, self.q2, distances.multiplier, weight)
        if curvature is None:
            g, packed = self.kernels.reprojection_gauss_newton(*distances.frame, *matches)
            N = H = _unpack(packed)
        else:
            g, *both = self.kernels.reprojection_newton(*distances.frame, *matches, curvature)
            N, H = map(_unpack, both)
        if not np.trace(N) < _SINGULAR and weight.any():
            rows = self.corrected(distances)[2]
            smooth = np.sum(rows**2, axis=0) < _SINGULAR
            if (weight * ~smooth).any():
                rest = None if curvature is None else curvature * smooth
                return self.normal(F, distances, weight * smooth, rest)
        turn = np.kron(_padded(distances.frame[1]), _padded(distances.frame[0]))
        N_back = turn @ N @ turn.T
        return turn @ g, N_back, N_back if H is N else turn @ H @ turn.T


class Mahalanobis(Reprojection):
    """The exact reprojection error of matches with 2x2 covariances, in units of the noise.

    With q = A q_white + (measured point) and A A^T the covariance, the noise of q_white is
    isotropic of unit size, and the epipolar constraint stays bilinear: q2_white^T F_white q1_white
    with F_white = L2^T F L1, L = [[A, q], [0, 1]], one for each match. Its foot point is exact; the
    Hessian is that of Gauss-Newton, in `normal` with or without a curvature.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Matches.
    covariance1, covariance2 : ndarray, shape (m, 2, 2)
        Symmetric positive definite.
    """

    def __init__(
        self, kernels: Table, q1: Array, q2: Array, covariance1: Array, covariance2: Array
    ) -> None:
        super().__init__(kernels, q1, q2)
        self.L1, self.L2 = _unwhitening(q1, covariance1), _unwhitening(q2, covariance2)
        self._measured = np.zeros_like(q1)

    def evaluate(self, F: Array) -> FootPoints:
        """Find the foot point of every match."""
        white = np.ascontiguousarray((np.swapaxes(self.L2, 1, 2) @ F @ self.L1).transpose(1, 2, 0))
        frame = self.kernels.bilinear_frame(white)
        origin = self._measured
        with np.errstate(all="ignore"):
            multiplier, change, d = self.kernels.foot_point_each(*frame, origin, origin)
            unsettled = _unsettled(multiplier, change, d)
        if unsettled.any():
            part = [np.ascontiguousarray(value[..., unsettled]) for value in (*frame, origin)]
            safe = self.kernels.foot_point_safe_each(*part, part[-1])
            multiplier[unsettled], _, d[unsettled] = safe
        return FootPoints(frame, multiplier, d)

    def corrected(self, feet: FootPoints) -> tuple[Array, Array, Array]:
        """Return corrected matches, shape (2, m) each, and dd / d vect(F), shape (9, m)."""
        white1, white2, by_white = self.kernels.foot_point_derivative_each(
            *feet.frame, self._measured, self._measured, feet.multiplier
        )
        by_white = by_white.T.reshape(-1, 3, 3)
        derivative = self.L2 @ by_white @ np.swapaxes(self.L1, 1, 2)
        q1_hat = self.q1 + np.einsum("mij,jm->im", self.L1[:, :2, :2], white1)
        q2_hat = self.q2 + np.einsum("mij,jm->im", self.L2[:, :2, :2], white2)
        return q1_hat, q2_hat, derivative.reshape(-1, 9).T

    def normal(
        self, F: Array, distances: Distances, weight: Array, curvature: Array | None
    ) -> tuple[Array, Array, Array]:
        """Return gradient, and J^T J for both matrices."""
        J = self.derivative(F, distances)
        N = (J.T * weight) @ J
        return J.T @ (weight * distances.signed), N, N


@dataclass(frozen=True)
class LineDistances:
    """Residuals of a criterion in closed form."""

    squared: Array
    signed: Array


class _ClosedForm:
    """A criterion whose residuals are functions of F: kernels ``name``, ``name_newton``..."""

    name = ""

    def __init__(self, kernels: Table, q1: Array, q2: Array) -> None:
        self._residuals = getattr(kernels, self.name)
        self._gauss_newton = getattr(kernels, f"{self.name}_gauss_newton")
        self._newton = getattr(kernels, f"{self.name}_newton")
        self.q1, self.q2 = q1, q2

    def evaluate(self, F: Array) -> LineDistances:
        with np.errstate(divide="ignore", invalid="ignore"):  # a match on an epipole
            r, _ = self._residuals(F, self.q1, self.q2)
        squared = np.sum(r**2, axis=0)
        return LineDistances(squared, np.copysign(np.sqrt(squared), r[0]))

    def derivative(self, F: Array, distances: Distances) -> Array:
        r, by_entries = self._residuals(F, self.q1, self.q2)
        length = np.where(distances.signed == 0.0, 1.0, distances.signed)
        return np.asarray(np.einsum("km,kpm->mp", r / length, by_entries))

    def normal(
        self, F: Array, distances: Distances, weight: Array, curvature: Array | None
    ) -> tuple[Array, Array, Array]:
        if curvature is None:
            _, g, packed = self._gauss_newton(F, self.q1, self.q2, weight)
            N = _unpack(packed)
            return g, N, N
        _, g, *both = self._newton(F, self.q1, self.q2, weight, curvature)
        N, H = map(_unpack, both)
        return g, N, H


class Sampson(_ClosedForm):
    """The gradient-weighted criterion: the reprojection error to first order."""

    name = "sampson"


class Epipolar(_ClosedForm):
    """Squared distances of both points of a match to their epipolar lines."""

    name = "epipolar"


#: The criteria by name.
CRITERIA: dict[str, type[Reprojection] | type[Sampson] | type[Epipolar]] = {
    "reprojection": Reprojection,
    "sampson": Sampson,
    "epipolar": Epipolar,
}


def settled(multiplier: Any, change: Any, d: Any) -> Any:
    """Return which foot points the last Newton step has left in place, of any array library."""
    return abs(change * d) <= (_SETTLED * abs(d) + 1e-15) * abs(multiplier)


def _unsettled(multiplier: Array, change: Array, d: Array) -> NDArray[np.bool_]:
    """Return which foot points the last Newton step has still moved, or lost (NaN)."""
    return ~np.asarray(settled(multiplier, change, d))


def _unwhitening(q: Array, covariance: Array) -> Array:
    """Return the (m, 3, 3) maps from white coordinates, zero at the measured points."""
    L = np.zeros((q.shape[1], 3, 3))
    L[:, :2, :2] = np.linalg.cholesky(covariance)
    L[:, :2, 2] = q.T
    L[:, 2, 2] = 1.0
    return L


def _padded(rotation: Array) -> Array:
    """Return a rotation of the image plane as a 3x3 matrix."""
    matrix = np.eye(3)
    matrix[:2, :2] = rotation
    return matrix


def _unpack(packed: Array) -> Array:
    """Return the symmetric matrix of an upper triangle."""
    matrix = np.zeros((9, 9))
    matrix[_UPPER] = packed
    return matrix + np.triu(matrix, 1).T
