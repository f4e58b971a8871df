"""Uncertainty of a fundamental matrix and of what follows from it, to first order in the noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.losses import Loss, robust_scale

__all__ = [
    "Uncertainty",
    "fundamental_covariance",
    "residual_noise",
    "restricted_basis",
    "robust_inflation",
    "tangent_basis",
]

Array = NDArray[np.float64]

#: Where Gaussian errors are sampled, in standard deviations.
_NODES = np.linspace(-5.0, 5.0, 31)


@dataclass(frozen=True)
class Uncertainty:
    """What the matches say about F to second order.

    Kept in conditioned coordinates: those in pixels follow from it by first derivatives, without
    the cancellation that pixels far from the origin cause.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Conditioned F of unit Frobenius norm.
    root : ndarray, shape (9, rank)
        The covariance of vect(F) is ``root root^T`` over the directions that are determined.
    undetermined : ndarray, shape (9, free - rank)
        Unit vectors of the directions in which F can move without changing any distance.
    to_units1, to_units2 : ndarray, shape (3, 3)
        Homogeneous maps of the images from pixels to conditioned coordinates.
    rank : int
        Number of free directions that the matches determine.
    condition : float
        Ratio of the largest to the smallest standard deviation over the free directions;
        infinity where some are undetermined.
    """

    F: Array
    root: Array
    undetermined: Array
    to_units1: Array
    to_units2: Array
    rank: int
    condition: float

    @cached_property
    def _pixels(self) -> tuple[Array, Array]:
        """F in pixels of any scale, and the derivative (9, 9) of vect of it by vect(F)."""
        entry_map = np.kron(self.to_units2.T, self.to_units1.T)
        return self.to_units2.T @ self.F @ self.to_units1, np.asarray(entry_map, dtype=np.float64)

    def of_fundamental(self) -> Array:
        """Return the covariance (9, 9) of vect(F) in pixels, F of unit norm."""
        F, entry_map = self._pixels
        return self._propagated(_normalization(F.ravel()) @ entry_map)

    def of_epipole(self, image: int) -> Array:
        """Return the covariance (3, 3) of an epipole in pixels as a homogeneous unit vector."""
        e, derivative = self._epipole(image)
        e, derivative = self._epipole(image)
        return self._propagated(_normalization(e) @ derivative)

    def of_epipole_px(self, image: int) -> Array:
        """Return the covariance (2, 2) of an epipole in pixels; infinite for one at infinity."""
        e, derivative = self._epipole(image)
        e, derivative = self._epipole(image)
        if abs(e[2]) <= np.finfo(float).eps * np.linalg.norm(e):
            return np.diag([np.inf, np.inf])
        division = np.column_stack([np.eye(2), -e[:2] / e[2]]) / e[2]
        return self._propagated(division @ derivative)

    def of_sigma(self) -> float:
        """Return the standard deviation of sigma = s2 / s1 in pixels.

        Of the block B = U12^T F V12 / s1, changed by dB, ``p = (1 + sigma + dB11 + dB22) / 2`` and
        ``q = |(1 - sigma + dB11 - dB22, dB12 + dB21)| / 2`` give sigma = (p - q) / (p + q). Away
        from 1 this is linearised, d sigma = (u2^T dF v2 - sigma u1^T dF v1) / s1. Where q is within
        three deviations of its kink at zero, it is integrated over Gaussian dB instead.
        """
        F, entry_map = self._pixels
        U, s, Vt = np.linalg.svd(F)
        sigma = float(s[1] / s[0])
        block = np.kron(U[:, :2].T, Vt[:2]) @ entry_map / s[0]
        halves = np.array([[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, -1.0], [0.0, 1.0, 1.0, 0.0]]) / 2.0
        covariance = self._propagated(halves @ block)
        if not np.isfinite(covariance).all():
            return float("inf")
        if (1.0 - sigma) / 2.0 >= 3.0 * np.sqrt(covariance[2, 2]):
            linear = block[3:] - sigma * block[:1]
            return float(np.sqrt(self._propagated(linear)[0, 0]))
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        # A regular grid: a Gaussian rule is for smooth functions
        grid = np.stack(np.meshgrid(_NODES, _NODES, _NODES)).reshape(3, -1)
        weight = np.exp(-0.5 * np.sum(grid**2, axis=0))
        centre = np.array([[1.0 + sigma], [1.0 - sigma], [0.0]]) / 2.0
        p, q1, q2 = centre + root @ grid
        q = np.hypot(q1, q2)
        ratio = np.abs(p - q) / (np.abs(p) + q)
        mean = np.average(ratio, weights=weight)
        return float(np.sqrt(np.average((ratio - mean) ** 2, weights=weight)))

    def largest(self) -> float:
        """Return the largest standard deviation of the conditioned F of unit norm."""
        if self.undetermined.size:
            return float("inf")
        return float(np.linalg.norm(self.root, ord=2))

    def _epipole(self, image: int) -> tuple[Array, Array]:
        """Return the epipole in pixels, of any scale, and its derivative (3, 9) by vect(F).

        From F e = 0, de = -F^+ dF e; likewise F^T e' = 0.
        """
        F, to_units = (self.F, self.to_units1) if image == 1 else (self.F.T, self.to_units2)
        U, s, Vt = np.linalg.svd(F)
        e = Vt[2]
        inverse = (Vt[:2].T / s[:2]) @ U[:, :2].T
        by_entries = -np.einsum("ij,k->ijk", inverse, e)
        if image == 2:
            by_entries = by_entries.transpose(0, 2, 1)
        to_pixels = np.linalg.inv(to_units)
        return to_pixels @ e, to_pixels @ by_entries.reshape(3, 9)

    def _propagated(self, derivative: Array) -> Array:
        """Return the covariance of something whose derivative by vect(F) is given."""
        moved = derivative @ self.root
        covariance = moved @ moved.T
        touched = np.linalg.norm(derivative @ self.undetermined, axis=1)
        infinite = touched > 1e-12 * np.linalg.norm(derivative, axis=1)
        covariance[infinite] = covariance[:, infinite] = 0.0
        covariance[infinite, infinite] = np.inf
        return np.asarray(covariance)


def _normalization(v: Array) -> Array:
    """Return the derivative of v / |v|."""
    size = float(np.linalg.norm(v))
    unit = v / size
    return np.asarray((np.eye(len(v)) - np.outer(unit, unit)) / size)


def tangent_basis(F: Array) -> Array:
    """Return an orthonormal basis of the directions in which F stays of rank 2 and unit norm.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Of rank 2 and unit Frobenius norm.

    Returns
    -------
    ndarray, shape (9, 7)
        Columns are directions of vect(F). Unlike the derivative of the orthonormal representation,
        it has rank 7 at sigma = 1 too.
    """
    U, _, Vt = np.linalg.svd(F)
    # To first order the rank stays 2 when u3^T dF v3 = 0, and the norm when <F, dF> = 0.
    normals = np.column_stack([np.outer(U[:, 2], Vt[2]).ravel(), F.ravel()])
    return np.asarray(np.linalg.qr(normals, mode="complete")[0][:, 2:])


def restricted_basis(F: Array, derivative: Array) -> Array:
    """Return an orthonormal basis of the directions that a restricted parameterisation leaves.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Of unit Frobenius norm.
    derivative : ndarray, shape (9, k)
        Derivative of vect(F), of any scale, by independent parameters.

    Returns
    -------
    ndarray, shape (9, k)
        Columns are directions of vect(F) that keep its norm.
    """
    f = F.ravel()
    across = derivative - np.outer(f, f @ derivative)
    return np.asarray(np.linalg.qr(across / np.linalg.norm(across, axis=0))[0])


def fundamental_covariance(
    F: Array, N: Array, variance: float, to_units: tuple[Array, Array], basis: Array
) -> Uncertainty:
    """Propagate the noise of the matches to F.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Conditioned estimate with unit Frobenius norm.
    N : ndarray, shape (9, 9)
        J^T J, with the weights of the matches, by vect(F), conditioned.
    variance : float
        Variance of a conditioned coordinate of a match of weight one.
    to_units : pair of ndarray, shape (3, 3)
        Maps of the images from pixels to conditioned coordinates.
    basis : ndarray, shape (9, k)
        Orthonormal directions that F is free to move in.

    Returns
    -------
    Uncertainty
        The covariance ``variance * basis (basis^T N basis)^-1 basis^T``.
    """
    values, vectors = np.linalg.eigh(basis.T @ N @ basis)
    determined = values > 1e-14 * max(values[-1], np.finfo(float).tiny)
    directions = basis @ vectors
    complete = bool(determined.all())
    return Uncertainty(
        F=F,
        root=directions[:, determined] * np.sqrt(variance / values[determined]),
        undetermined=directions[:, ~determined],
        to_units1=to_units[0],
        to_units2=to_units[1],
        rank=int(np.count_nonzero(determined)),
        condition=float(np.sqrt(values[-1] / values[0])) if complete else float("inf"),
    )


def residual_noise(d: Array, weights: Array, loss: Loss, parameters: int) -> float:
    """Estimate the standard deviation of a coordinate of a match of weight one.

    Parameters
    ----------
    d : ndarray, shape (m,)
        Distances.
    weights : ndarray, shape (m,)
        Weights of their squares; those of weight zero do not count.
    loss : Loss
        Whether gross errors are to be expected.
    parameters : int
        Number of parameters fitted.

    Returns
    -------
    float
        ``sqrt(sum(w d^2) / (m - parameters))``; with a robust loss over the matches within 2.5
        times `robust_scale` only, m being their number.
    """
    counts = weights > 0.0
    standardized = (np.sqrt(weights) * d)[counts]
    if loss.name != "linear":
        standardized = standardized[np.abs(standardized) <= 2.5 * robust_scale(standardized)]
    return float(np.sqrt(np.sum(standardized**2) / max(len(standardized) - parameters, 1)))


def robust_inflation(d: Array, weights: Array, loss: Loss, parameters: int, noise: float) -> float:
    """Return how much larger variances are with a robust loss than with clean least squares.

    The variance of an M-estimate is ``kappa noise^2 (J^T W J)^-1`` with

        kappa = [sum(w psi^2) / (m - parameters)] / [noise mean(psi')]^2,

    psi(d) = rho'(d^2) d the influence of a residual, and both means over the matches that count
    [1]_. Down-weighting matches by rho' alone, ``(J^T W rho' J)^-1``, would be too large for clean
    data.

    Parameters
    ----------
    d, weights, loss, parameters
        As in `residual_noise`.
    noise : float
        Its value.

    Returns
    -------
    float
        kappa; one for the linear loss, infinity where no match has any influence.

    References
    ----------
    .. [1] P. J. Huber, "Robust Statistics", 1981, section 7.6.
    """
    if loss.name == "linear":
        return 1.0
    counts = weights > 0.0
    d, weights = d[counts], weights[counts]
    _, first, second = loss(d**2)
    slope = float(np.mean(first + 2.0 * second * d**2))
    power = float(np.sum(weights * (first * d) ** 2)) / max(len(d) - parameters, 1)
    if noise == 0.0:
        return 1.0
    return power / (noise * slope) ** 2 if slope > 0.0 else float("inf")
