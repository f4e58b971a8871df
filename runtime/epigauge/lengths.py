"""Length of a Gaussian vector of the plane near its kink at zero, where first order fails.

|q| has no derivative at q = 0. Of all linear functions of q the one nearest to |q| in the mean
square has the slope w = E[q / |q|], because Cov(|q|, q) = C w (Stein); what it leaves is not
correlated with q. Far from zero, in standard deviations, w is q / |q| and nothing is left: first
order.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["linear_length"]

Array = NDArray[np.float64]

#: Distance from zero, in the largest standard deviation, below which the mean slope counts fully,
#: and beyond which the derivative alone does; between them there is no step.
_NEAR, _FAR = 4.0, 8.0

#: Directions of the sum over the circle at least; the summand is smooth and periodic.
_NODES = 128

#: Least ratio of the deviations across and along the longer axis.
_THIN = 1e-3

_erf = np.vectorize(math.erf, otypes=[np.float64])


def linear_length(mean: Array, covariance: Array) -> tuple[Array, float, float]:
    """Return the slope of |q| in q, the variance that it leaves, and the mean.

    Parameters
    ----------
    mean : ndarray, shape (2,)
        Of q.
    covariance : ndarray, shape (2, 2)
        Of q.

    Returns
    -------
    slope : ndarray, shape (2,)
        w in |q| = w . q + rest; the derivative q / |q| where that is far from zero.
    rest : float
        Variance of the rest.
    length : float
        Mean of |q|; far from zero, |q| of the mean. All depend continuously on the arguments.
    """
    size = float(np.hypot(*mean))
    derivative = mean / size if size > 0.0 else np.zeros(2)
    variances, axes = np.linalg.eigh(covariance)
    largest = math.sqrt(max(float(variances[1]), 0.0))
    if size >= _FAR * largest:
        return derivative, 0.0, size
    variances = np.maximum(variances, (_THIN * largest) ** 2)
    slope, length = _mean_slope(axes.T @ mean, variances)
    slope = axes @ slope
    # Var |q| less what the linear part explains
    rest = size**2 + float(variances.sum()) - length**2 - float(slope @ covariance @ slope)
    share = min(max((_FAR - size / largest) / (_FAR - _NEAR), 0.0), 1.0)
    share *= share * (3.0 - 2.0 * share)
    slope = derivative + share * (slope - derivative)
    return slope, share * max(rest, 0.0), size + share * (length - size)


def _mean_slope(mean: Array, variances: Array) -> tuple[Array, float]:
    """Return E[q / |q|] and E|q|, q with independent coordinates, by a sum over directions."""
    thin = math.sqrt(float(variances.max() / variances.min()))
    nodes = int(_NODES * max(thin, 1.0))
    angles = 2.0 * np.pi * (np.arange(nodes) + 0.5) / nodes
    n = np.stack([np.cos(angles), np.sin(angles)])
    # Along r n the exponent is -(a r^2 - 2 b r + c) / 2.
    a, b = (1.0 / variances) @ n**2, (mean / variances) @ n
    z = b / np.sqrt(a)
    outside = np.exp(-0.5 * np.maximum(mean @ (mean / variances) - z**2, 0.0))
    at_zero = np.exp(-0.5 * z**2)
    inside = np.sqrt(0.5 * np.pi / a) * (1.0 + _erf(z / math.sqrt(2.0)))
    first = outside * (at_zero / a + b / a * inside)
    second = outside * (b / a**2 * at_zero + (1.0 / a + (b / a) ** 2) * inside)
    weight = 1.0 / (nodes * math.sqrt(float(np.prod(variances))))
    return weight * (n @ first), weight * float(second.sum())
