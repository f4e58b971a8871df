"""What a verdict says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["FITS", "Verdict", "poor_fit"]

#: Noise, as a share of the RMS of the image coordinates, up to which a fit is one.
FITS = 0.05

#: Median distance of the observations from their images, as a share of the same, above which a
#: minimum is not that of the tracks. Where some views only are wrong, more than such a share of the
#: observations is behind its camera, and the RMS of the residuals is beyond so much.
_MISSES, _BEHIND, _WRONG = 0.1, 0.05, 0.02

#: Share of the observations that are behind their cameras in a scene reflected in its centre, which
#: has the same images: more than noise leaves of points that are all far away.
_REFLECTED = 0.6


@dataclass(frozen=True)
class Verdict:
    """What is to be known of a reconstruction before it is used.

    Attributes
    ----------
    flags : tuple of str
        Names from `epigauge.verdicts.FLAGS`.
    rank : int
        Of the normal matrix; 11 n + 3 m - 15 where all is determined, n and m being the numbers of
        views and points that count, these with two observations.
    n_behind : int
        Observations of points behind the camera, signs of cameras and points being chosen best.
    condition, weakest : float, str
        See `BundleResult`.
    """

    flags: tuple[str, ...]
    rank: int
    n_behind: int
    condition: float = float("inf")
    weakest: str = ""


def poor_fit(misses: Callable[[float], bool], rms: float, scale: float, behind: float) -> bool:
    """Tell whether a minimum cannot be that of the tracks.

    Parameters
    ----------
    misses : callable
        Tells whether half of the observations are farther from their images than a limit.
    rms : float
        RMS of the coordinates of the residuals; zero where gross errors have their part in it.
    scale : float
        RMS of the image coordinates about the centroids of the views.
    behind : float
        Share of the observations whose point is behind the camera.
    """
    if behind > _REFLECTED or (behind > _BEHIND and rms > _WRONG * scale):
        return True
    return misses(_MISSES * scale)
