"""Whether matches agree with a geometry better than wrong ones do by chance.

The best of all geometries always has some matches near it. With seven parameters it passes through
any seven of m matches; each of the others, if it is wrong, lies within a distance T of it with a
probability q. Of all C(m, 7) geometries the number that k or more matches agree with by chance is
then expected to be

    C(m, 7) P(Binomial(m - 7, q) >= k - 7),

and an agreement is common geometry where that is far below one [1]_. This is the likelihood of the
best F against "all wrong", with its degrees of freedom counted: no threshold on numbers of inliers.

References
----------
.. [1] L. Moisan, B. Stival, "A probabilistic criterion to detect rigid point matches between two
   images and estimate the fundamental matrix", IJCV 57(3), 2004.
"""

from __future__ import annotations

import ctypes
import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address, library
from epigauge.kernels import Table
from epigauge.two_view.homography import plane_squares

__all__ = [
    "CEILING",
    "PAIRS",
    "RANK",
    "SIGNIFICANT",
    "chance_agreement",
    "chance_on_plane",
    "chances_off_plane",
    "independent",
    "log10_false_alarms",
    "two_by_chance",
]

Array = NDArray[np.float64]

#: Largest distance of an inlier that is chosen without the caller, as a share of the range of the
#: coordinates: 15 px in an image of 1000. Within more, wrong matches agree because both images have
#: their features in similar places.
CEILING = 0.015

#: An agreement is no accident when fewer such are expected than 10 to this.
SIGNIFICANT = -3.0

#: Parameters of F.
_FREE = 7

#: Wrong pairs that chance is estimated from, and how many of them must lie within the distance.
PAIRS, RANK = 2000, 20


def log10_false_alarms(m: int, k: int, chance: float, free: int = _FREE) -> float:
    """Return the logarithm of how many chance agreements of k of m matches are expected.

    Parameters
    ----------
    m, k : int
        Matches, and how many of them agree.
    chance : float
        Probability that a wrong match agrees.
    free : int
        Matches that a geometry can be made to agree with.

    Returns
    -------
    float
        The logarithm to base 10, with Chernoff's bound for the tail of the binomial distribution,
        which is exact for k = m.
    """
    n, hits = m - free, k - free
    if n <= 0 or hits <= 0 or chance >= hits / n:
        return math.inf
    sets = (math.lgamma(m + 1) - math.lgamma(free + 1) - math.lgamma(n + 1)) / math.log(10)
    if chance <= 0.0:
        return -math.inf
    tail = hits * math.log10(hits / (n * chance))
    if hits < n:
        tail += (n - hits) * math.log10((n - hits) / (n * (1.0 - chance)))
    return sets - tail


def chance_agreement(table: Table, F: Array, q1: Array, q2: Array, limit: float) -> float:
    """Return the probability that a wrong match is within a distance of an epipolar geometry.

    Wrong matches are made of the points themselves: point i of one image with another point of the
    other, so that crowded places count for what they are.

    Parameters
    ----------
    table : Table
        Backend.
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    q1, q2 : ndarray, shape (2, m)
        All matches, right and wrong, contiguous.
    limit : float
        The distance, to first order (Sampson).

    Returns
    -------
    float
        Where few wrong pairs are so near, from the density of the distance further out.
    """
    if table.compiled:
        F = np.ascontiguousarray(F)
        m = q1.shape[1]
        chance = float(_function()(m, *map(address, (F, q1, q2)), limit, PAIRS, RANK))
        if chance < 0.0:
            raise MemoryError(f"no room for {m} matches")
        return chance
    e2 = table.epipole(F)
    rolled = (np.roll(q2, shift, axis=1) for shift in _shifts(q1.shape[1]))
    with np.errstate(all="ignore"):  # a point on an epipole
        squared = np.concatenate([table.sampson_side(F, e2, q1, own)[0] for own in rolled])
    return _share_within(np.sqrt(squared), limit)


@cache
def _function() -> Any:
    function = library().eg_chance_agreement
    pointer, size = ctypes.c_void_p, ctypes.c_ssize_t
    function.argtypes = [size, *[pointer] * 3, ctypes.c_double, size, size]
    function.restype = ctypes.c_double
    return function


def chance_on_plane(table: Table, H: Array, q1: Array, q2: Array, limit: float) -> float:
    """Return the same of a homography: the density grows as the square of the distance."""
    rolled = (np.ascontiguousarray(np.roll(q2, shift, axis=1)) for shift in _shifts(q1.shape[1]))
    squared = np.concatenate([plane_squares(table, H, q1, one) for one in rolled])
    return _share_within(squared, limit**2)


def _shifts(m: int) -> list[int]:
    """Return by how much to shift one image's points against the other's for wrong pairs."""
    rounds = min(-(-PAIRS // m), m - 1)
    return [1 + k * (m - 2) // max(rounds - 1, 1) for k in range(rounds)]


def _share_within(values: Array, bound: float) -> float:
    """Return the share of values up to a bound; where few are, from their density further out."""
    near = int(np.count_nonzero(values <= bound))
    if near >= RANK or near == len(values):
        return near / len(values)
    rank = min(RANK, len(values)) - 1
    wide = float(np.partition(values, rank)[rank])
    return (rank + 1) / len(values) * min(bound / wide, 1.0) if wide > 0.0 else 1.0


def chances_off_plane(squares: Array, limit: float) -> Array:
    """Return the probabilities that wrong matches off a plane agree with an F of it.

    The line from where the homography takes a match to the match itself is an epipolar line. That
    of a wrong one has any direction: it is within a distance l of another with the probability
    2 / pi asin(l / d), by the squared distances d^2 from the plane.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # on the plane; infinitely far
        sine = np.minimum(limit / np.sqrt(squares), 1.0)
    return np.asarray(2.0 / np.pi * np.arcsin(sine))


def two_by_chance(redundancy: int, probability: float) -> float:
    """Return how many variances two parameters more take at most by chance.

    Twice the quantile of Fisher's F with two and so many degrees of freedom, by which the variance
    is known.
    """
    return redundancy * math.expm1(-2.0 / redundancy * math.log(probability))


def independent(q1: Array, q2: Array) -> int:
    """Return how many of some matches are independent: each point of an image counts once.

    Where many points are matched to one, every line through it agrees with all of them.
    """
    return min(len(np.unique(q, axis=1).T) for q in (q1, q2))
