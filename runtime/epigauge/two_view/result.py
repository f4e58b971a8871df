"""The result of a two-view refinement."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from epigauge.lm import Row

__all__ = ["FundamentalResult"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FundamentalResult:
    """A fundamental matrix with everything known about it. All lengths are in pixels.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Fundamental matrix of unit Frobenius norm, ``x2^T F x1 = 0``.
    U, V : ndarray, shape (3, 3)
        Its orthonormal factors, F ~ U diag(1, sigma, 0) V^T.
    sigma : float
        Ratio of its singular values, between 0 and 1.
    P1, P2 : ndarray, shape (3, 4)
        Canonic cameras (B&S eqs. 4, 5).
    points : ndarray, shape (m, 4)
        Reconstructed points, homogeneous of unit norm, in the basis of P1, P2.
    covariance : ndarray, shape (9, 9)
        Covariance of vect(F) to first order, of rank 7; its diagonal is infinite where the matches
        do not determine F.
    rank : int
        Number of the 7 directions of F that the matches determine.
    condition : float
        Largest over smallest standard deviation among them, in conditioned coordinates.
    noise_px : float
        Standard deviation of a coordinate that the covariance was computed with.
    rms_px : float
        sqrt(sum of squared residual coordinates / (4 m)), whatever criterion and loss.
    loss_scale_px : float
        Scale of the robust loss, given or estimated; 0 for the linear loss.
    x : ndarray, shape (9,)
        vect(F).
    cost : float
        0.5 * sum of (weighted) squared residuals, in px^2; of rho of them with a robust loss.
    fun : ndarray, shape (m,)
        Signed distance of each match in the sense of the criterion.
    jac : ndarray, shape (m, p)
        Derivatives of `fun` by the p update parameters of the parameterisation, at the solution.
    grad : ndarray, shape (p,)
        Gradient of `cost` by the same.
    optimality : float
        Largest absolute entry of `grad`.
    nfev, njev, nit : int
        Evaluations of the cost including the start, linearisations, trial steps.
    status : int
        Reason for stopping as in `epigauge.lm.STATUS`; positive is success.
    message : str
        The same in words.
    success : bool
        Whether `status` is positive.
    history : tuple of Row
        One row an evaluation of the cost.
    """

    F: Array
    U: Array
    V: Array
    sigma: float
    P1: Array
    P2: Array
    points: Array = field(repr=False)
    covariance: Array = field(repr=False)
    rank: int
    condition: float
    noise_px: float
    rms_px: float
    loss_scale_px: float
    x: Array = field(repr=False)
    cost: float
    fun: Array = field(repr=False)
    jac: Array = field(repr=False)
    grad: Array = field(repr=False)
    optimality: float
    nfev: int
    njev: int
    nit: int
    status: int
    message: str
    success: bool
    history: tuple[Row, ...] = field(repr=False)
