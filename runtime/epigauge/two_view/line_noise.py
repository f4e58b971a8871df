"""Noise along epipolar lines: an F of parallel lines takes noise of one axis for parallax.

Where a camera stands still or sees a plane, and one axis is measured much worse than the other, F
follows: all matches agree with epipolar lines along that axis, and are off the plane by their
noise. Parallax is a function of the place, and noise is not. Of the distances off the plane it is
asked whether they are alike for neighbours, and whether the large ones are to one side, as of what
stands before a wall, or stand apart. Noise does neither.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.consensus import RANGE
from epigauge.two_view.evidence import ROUNDING, WITHIN, Evidence
from epigauge.two_view.homography import plane_squares, robust_homography
from epigauge.two_view.losses import median
from epigauge.two_view.planes import NO_RELIEF, OnPlane

__all__ = ["is_noise", "with_that_noise"]

Array = NDArray[np.float64]

#: Median of the size of a normal number of standard deviation one.
_MEDIAN = 0.6745

#: Fewer matches do not tell.
_LEAST = 40

#: What is off a plane may be noise of one axis if it is so many times that across epipolar lines:
#: less is F's own freedom, or the small relief of a real scene, more is data without noise.
_WORSE, _WORST = 6.0, 60.0

#: Beyond so many times their median are distances that are large, and a tenth are beyond so many at
#: most: 6.3 of Cauchy's distribution.
_LARGE, _TENTH = 3.0, 16.0

#: The 99 % quantile of the size of a normal number.
_UNLIKELY = 2.576

#: Variance of the mean product of neighbours, times their number: one in three is the neighbour of
#: its own neighbour, and counts twice.
_MUTUAL = 1.6


def is_noise(found: Evidence, plane: OnPlane) -> bool:
    """Tell whether matches are off a plane by noise along their epipolar lines, not by relief.

    Parameters
    ----------
    found : Evidence
        F and the matches.
    plane : OnPlane
        How some of them lie to a plane.
    """
    off, size = plane.off, np.abs(plane.off)
    half = median(size)
    noise = max(found.noise, ROUNDING)
    worse = half / (_MEDIAN * noise)
    if len(off) < _LEAST or half > NO_RELIEF * RANGE or not _WORSE < worse < _WORST:
        return False
    if np.quantile(size, 0.9) > _TENTH * half:
        return False
    large = off[size > _LARGE * half]
    if abs(np.sum(np.sign(large))) > _UNLIKELY * max(len(large), 1) ** 0.5:
        return False
    q = found.q1[:, plane.rows]
    apart = np.sum((q[:, :, None] - q[:, None]) ** 2, axis=0)
    np.fill_diagonal(apart, np.inf)
    ranks = np.argsort(np.argsort(off)).astype(np.float64)
    ranks = (ranks - ranks.mean()) / ranks.std()
    alike = float(np.mean(ranks * ranks[np.argmin(apart, axis=1)]))
    return bool(alike <= _UNLIKELY * (_MUTUAL / len(off)) ** 0.5)


def with_that_noise(found: Evidence, plane: OnPlane) -> Evidence:
    """Return the evidence with what is off the plane as its noise, without the tails of it."""
    noise = median(np.abs(plane.off)) / _MEDIAN
    H, _ = robust_homography(found.q1, found.q2, found.weights, found.table)
    apart = plane_squares(found.table, H, found.all1, found.all2)
    near = found.all_weights * apart <= (WITHIN * noise) ** 2
    return replace(found, inlier=found.inlier & near, noise=noise, limit=WITHIN * noise)
