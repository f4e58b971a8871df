"""How far off a robustly estimated F is, as a probability that holds on pairs with a known truth.

The covariance predicts the distances of true matches to the epipolar lines of F, as long as F is
the geometry of the scene. Two things it does not know: errors that are no noise (lenses, surveys),
and that matches may agree on another geometry, by chance or because things repeat. The logarithm of
the median error is taken as logistic around the prediction with the former added, and the odds of
the latter as a power of how unlikely it is that wrong matches agree as well. The constants are
fitted by `benchmarks/confidence.py`, which also tells how reliable they are on other pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_real
from epigauge.errors import ArgumentError
from epigauge.two_view.covariance import Uncertainty

__all__ = ["FITTED", "Confidence", "Constants", "Signs", "error_text", "probability_below"]

Array = NDArray[np.float64]

#: Median error of a geometry that is another one: with these, a few are below a pixel by chance.
_ELSEWHERE_PX = 30.0


@dataclass(frozen=True)
class Constants:
    """What was fitted.

    Attributes
    ----------
    factor : float
        Median error over the median predicted standard deviation.
    unmodelled : float
        Errors that are no noise, in conditioned units.
    width : float
        Of the logistic distribution of the logarithm of the error.
    odds, power : float
        The logarithm of the odds of another geometry is ``odds + power asinh(a)``, with 10^a chance
        agreements expected.
    """

    factor: float
    unmodelled: float
    width: float
    odds: float
    power: float


FITTED = Constants(factor=0.98, unmodelled=2.09e-4, width=0.338, odds=-0.783, power=0.7)


@dataclass(frozen=True)
class Signs:
    """What the error is predicted from.

    Attributes
    ----------
    spread_px : float
        Median over the inliers of the standard deviation of the distance of their true points to
        their epipolar lines, the mean of both images.
    unit_px : float
        Pixels of a conditioned unit, a seventh of the width of the images.
    log10_alarms : float
        Logarithm of how many geometries would agree as well by chance.
    """

    spread_px: float
    unit_px: float
    log10_alarms: float

    @staticmethod
    def of(uncertainty: Uncertainty, x1: Array, x2: Array, log10_alarms: float) -> Signs:
        """Return those of an F with its inliers (n, 2) in pixels."""
        unit_px = 1.0 / float(uncertainty.to_units1[0, 0])
        return Signs(unit_px * _spread(uncertainty, x1, x2), unit_px, log10_alarms)


@dataclass(frozen=True)
class Confidence:
    """The distribution of the median error.

    Attributes
    ----------
    error_px : float
        Half of the geometries that are right have a smaller median error.
    p_wrong : float
        Probability that this is another geometry.
    """

    error_px: float
    p_wrong: float

    @staticmethod
    def of(signs: Signs, fitted: Constants = FITTED) -> Confidence:
        """Return the distribution by what was fitted."""
        error = fitted.factor * signs.spread_px + fitted.unmodelled * signs.unit_px
        a = fitted.odds + fitted.power * math.asinh(signs.log10_alarms)
        p_wrong = 1.0 / (1.0 + math.exp(-a)) if a > -700.0 else 0.0
        return Confidence(error, p_wrong)


def probability_below(
    px: ArrayLike, error_px: ArrayLike, p_wrong: ArrayLike, width: float = FITTED.width
) -> Array:
    """Return the probability of a median error below some pixels, by `Confidence`.

    Raises
    ------
    ArgumentError
        If `px` is not above 0, or neither one number nor one for each probability.
    """
    bound, p_wrong = as_real("px", px, "a distance in pixels"), np.asarray(p_wrong)
    if not np.all((bound > 0.0) & np.isfinite(bound)):
        raise ArgumentError("px", "is not finite and above 0", "a distance in pixels")
    if bound.shape not in ((), p_wrong.shape):
        raise ArgumentError("px", f"has shape {bound.shape}", "one distance in pixels")
    with np.errstate(over="ignore"):
        right = 1.0 / (1.0 + (np.asarray(error_px) / bound) ** (1.0 / width))
        elsewhere = 1.0 / (1.0 + _ELSEWHERE_PX / bound)
    return np.asarray((1.0 - p_wrong) * right + p_wrong * elsewhere)


def error_text(error_px: float, p_wrong: float) -> str:
    """Say how far off the geometry may be, for people."""
    good = float(probability_below(1.0, error_px, p_wrong))
    return f"{error_px:.3g} px expected; below 1 px with probability {good:.3f}"


def _spread(uncertainty: Uncertainty, x1: Array, x2: Array) -> float:
    """Return the median standard deviation of the distances of true points, conditioned."""
    if uncertainty.undetermined.size:
        return math.inf
    h1, h2 = (
        np.column_stack([x, np.ones(len(x))]) @ to_units.T
        for x, to_units in ((x1, uncertainty.to_units1), (x2, uncertainty.to_units2))
    )
    lines2, lines1 = h1 @ uncertainty.F.T, h2 @ uncertainty.F
    products = (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9)
    deviations = np.linalg.norm(products @ uncertainty.root, axis=1)
    with np.errstate(divide="ignore"):  # a point on an epipole
        reciprocals = sum(1.0 / np.linalg.norm(line[:, :2], axis=1) for line in (lines1, lines2))
    return float(np.median(deviations * reciprocals)) / 2.0
