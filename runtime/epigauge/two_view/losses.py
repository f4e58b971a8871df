"""Robust losses rho(s) of the squared distance s of a match, scaled in pixels.

A match costs ``c^2 rho(d^2 / c^2) / 2`` with the scale c; rho(s) ~ s for small s. Derivatives enter
the solver exactly: rho' as the weight of a match, rho'' in the exact Hessian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from epigauge_generated.numpy_backend import losses
from numpy.typing import NDArray

__all__ = ["EFFICIENT", "LOSSES", "Loss", "median", "robust_scale", "scale_of_median"]

Array = NDArray[np.float64]
_Values = tuple[Array, Array, Array]


def _linear(s: Array) -> _Values:
    return s, np.ones_like(s), np.zeros_like(s)


#: The losses by name, in the order of runtime/c/losses.h; all but the linear one are generated, the
#: first four are SciPy's.
LOSSES = ("linear", "huber", "soft_l1", "cauchy", "truncated")


#: Scale over the standard deviation of the noise at which a loss keeps 95 % efficiency on clean
#: Gaussian data, from E[psi x]^2 / E[psi^2] with psi = rho'(x^2) x; the truncated one, at three
#: standard deviations, keeps 97 %.
EFFICIENT = {"huber": 1.345, "soft_l1": 1.287, "cauchy": 2.385, "truncated": 3.0}


@dataclass(frozen=True)
class Loss:
    """A loss with its scale, in the unit of the distances it is applied to."""

    name: str = "linear"
    scale: float = 1.0

    def __call__(self, squared: Array) -> _Values:
        """Return the cost of each match, doubled, and its first two derivatives by the square."""
        if self.name == "linear":
            return _linear(squared)
        squared = np.asarray(squared)
        value, first, second = np.empty((3, *squared.shape))
        getattr(losses, f"loss_{self.name}")(squared, self.scale**2, value, first, second)
        return value, first, second


def median(values: Array) -> float:
    """Return what `numpy.median` returns of a vector, NaN if any is; several times as fast."""
    half, odd = divmod(len(values), 2)
    ordered = np.partition(values, (half, len(values) - 1))
    if np.isnan(ordered[-1]):
        return float("nan")
    return float(ordered[half] if odd else 0.5 * (ordered[:half].max() + ordered[half]))


def robust_scale(d: Array) -> float:
    """Estimate the standard deviation of distances, half of which may be gross errors.

    The median absolute distance over that of a standard normal variable, with the small-sample
    factor 1 + 5 / (m - 7) of robust regression with seven parameters.

    References
    ----------
    .. [1] P. J. Rousseeuw, A. M. Leroy, "Robust regression and outlier detection", 1987, ch. 5.
    """
    return scale_of_median(median(np.abs(d)), len(d))


def scale_of_median(found: float, count: int) -> float:
    """Return what `robust_scale` does, for the median absolute distance of so many."""
    return float(1.4826 * (1.0 + 5.0 / max(count - 7, 1)) * found)
