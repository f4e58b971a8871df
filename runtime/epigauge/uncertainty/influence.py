"""What observations count for under a robust loss, told from their residuals.

An M-estimate has the covariance A^-1 B A^-1. Right observations share the mean slope and the mean
power of the loss, so that B = kappa A but for the wrong ones, which are counted one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.two_view.losses import Loss, median

__all__ = ["Influence", "RobustFit"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Median and cut of the length of a standard normal vector of the plane, and the share within.
_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))
_CUT = 3.0
_BEYOND = float(np.exp(-0.5 * _CUT**2))


@dataclass(frozen=True)
class Influence:
    """What observations add to the Hessian and to the covariance of the gradient.

    Attributes
    ----------
    noise : float
        Standard deviation of a coordinate of weight one, in the unit of the residuals.
    kappa : float
        B / A of the right observations, in units of the noise squared.
    wrong : ndarray of int, shape (k,)
        The others.
    rest : ndarray, shape (k, 2, 2)
        Their own blocks of B in these units, less kappa times those of A.
    """

    noise: float
    kappa: float
    wrong: Indices
    rest: Array


@dataclass(frozen=True)
class RobustFit:
    """Residuals of a robust fit, told apart into right and wrong ones.

    Attributes
    ----------
    r : ndarray, shape (N, 2)
        Residuals.
    factors : ndarray, shape (N,)
        Weights of their squares.
    loss : Loss
        Applied to each squared distance.
    parameters : int
        Number of parameters fitted, without the gauge.
    right : ndarray of bool, shape (N,)
        Observations within three standard deviations.
    slope : float
        Mean slope of their influence.
    weights : ndarray, shape (N,)
        a in A = sum(a J^T J): the right ones share their mean slope.
    wrong : ndarray of int, shape (k,)
        Observations beyond, as far as the loss lets them count.
    psi : ndarray, shape (k, 2)
        With what they pull: weight rho' r.
    """

    r: Array
    factors: Array
    loss: Loss
    parameters: int
    right: NDArray[np.bool_]
    slope: float
    weights: Array
    wrong: Indices
    psi: Array

    @staticmethod
    def of(r: Array, weights: Array, loss: Loss, parameters: int) -> RobustFit:
        """Tell right and wrong observations apart.

        Raises
        ------
        ArgumentError
            If there is nothing to estimate the noise from.
        """
        squared = np.sum(r**2, axis=1)
        lengths, counts = np.sqrt(weights * squared), weights > 0.0
        redundant = 2 * int(np.count_nonzero(counts)) - parameters
        if redundant <= 0:
            raise ArgumentError("noise_px", "is not given", "a number: nothing is redundant")
        share = redundant / (redundant + parameters)
        rough = median(lengths[counts]) / _MEDIAN / np.sqrt(share)
        variance = _variance(lengths**2, counts & (lengths <= _CUT * rough), parameters)
        right = counts & (lengths <= _CUT * np.sqrt(variance))
        _, first, second = loss(squared)
        # Mean eigenvalue of the second derivative, first I + 2 second r r^T
        slope = first + second * squared
        mean = float(np.mean(slope[right]))
        if loss.name == "truncated" and variance > 0.0:  # psi falls to zero at the scale
            jump = 0.5 * loss.scale**2 / variance
            mean = max(mean - jump * float(np.exp(-jump)) / (1.0 - _BEYOND), 1e-3)
        a = weights * (1.0 if variance == 0.0 else np.where(right, mean, np.maximum(slope, 0.0)))
        wrong = np.flatnonzero(counts & ~right & (first > 0.0))
        psi = (weights * first)[wrong, None] * r[wrong]
        return RobustFit(r, weights, loss, parameters, right, mean, np.asarray(a), wrong, psi)

    def influence(self, pull: Array) -> Influence:
        """Return what each observation adds, as `epigauge.two_view.covariance.influence`.

        Parameters
        ----------
        pull : ndarray, shape (N, 2)
            How far the residuals move when `psi` is taken off. What wrong observations do to the
            residuals of right ones is no noise: it is in the covariance as their own part.

        Returns
        -------
        Influence
            The noise is that of the right observations, freed from the pull, with the factor for
            what the cut takes off a normal distribution.
        """
        right = self.right
        squared = np.sum((self.r + pull) ** 2, axis=1)
        variance = _variance(self.factors * squared, right, self.parameters)
        none = np.zeros((0, 2, 2))
        if variance == 0.0:
            return Influence(0.0, 1.0, self.wrong[:0], none)
        number = 2 * int(np.count_nonzero(right))
        redundancy = number / max(number - self.parameters, 1)
        power = 0.5 * float(np.mean((self.factors * self.loss(squared)[1] ** 2 * squared)[right]))
        kappa = power * redundancy / (self.slope * variance)
        # Leverage goes with the weight that the loss leaves.
        first = self.loss(np.sum(self.r[self.wrong] ** 2, axis=1))[1]
        gain = 1.0 / (1.0 - first * (1.0 - 1.0 / redundancy))
        rest = (gain / variance)[:, None, None] * self.psi[:, :, None] * self.psi[:, None]
        rest -= kappa * self.weights[self.wrong, None, None] * np.eye(2)
        return Influence(float(np.sqrt(variance)), kappa, self.wrong, rest)


def _variance(squares: Array, chosen: NDArray[np.bool_], parameters: int) -> float:
    """Return the variance of a coordinate from weighted squares within the cut."""
    number = 2 * int(np.count_nonzero(chosen))
    mean = float(np.sum(squares[chosen])) / max(number - parameters, 1)
    # Mean square of a coordinate within the cut, over one
    return mean / (1.0 - 0.5 * _CUT**2 * _BEYOND / (1.0 - _BEYOND))
