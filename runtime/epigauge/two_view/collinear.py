"""Whether the matches that agree are on one line within the noise, but for a few.

The points of a line in space, one in both images, fix three parameters of F or E and five of a
homography, however many they are; those of a line of one image, a plane through its centre, fix
five of F. The others follow from noise, or from the few matches beside the line, and wrong ones can
be fitted to.
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
from epigauge.two_view.chance import (
    SIGNIFICANT,
    chance_agreement,
    chance_on_plane,
    independent,
    log10_false_alarms,
)
from epigauge.two_view.evidence import Evidence
from epigauge.two_view.homography import plane_squares
from epigauge.two_view.planes import FAR_OFF, MOST_ON, POOL, threes

__all__ = ["is_left_open", "is_plane_left_open", "may_be_lines"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Points spread across a line by no more than so many times the noise, RMS: no more is seen of it.
_SPREAD = 2.0

#: Parameters of F that the points of a line of one image fix, and of F or E those of both.
_FIXED = {1: 5, 2: 3}

#: Matches beside a line that a homography needs: they fix the three parameters that it leaves.
_PLANE = 2

_REFITS = 3

#: Points of single precision, as databases hold them, are rounded by so much, conditioned.
_SINGLE = 1e-7

#: Points next to one another in the list are on a line by so many times the noise; so many of such
#: threes are where most points are on one, and seldom elsewhere.
_NEAR, _THREES = 3.0, 0.25


def is_left_open(found: Evidence) -> bool:
    """Tell whether nearly all inliers are on one line, and the others agree by chance.

    Where the caller says that all are right, whether the others are no more than F needs.
    """
    judged = [_off_line(q, found.noise) for q in (found.q1, found.q2)]
    lines = [off for off in judged if off is not None]
    off, needed = np.any(lines, axis=0), 2 if found.from_rays is not None else 1
    if len(lines) < needed or np.mean(off) > 1.0 - MOST_ON:
        return False
    beside, free = int(np.count_nonzero(off)), found.parameters - _FIXED[len(lines)]
    if beside <= free:
        return True
    if not found.searched:
        return False
    agreed = np.zeros(len(found.inlier), np.bool_)
    agreed[np.flatnonzero(found.inlier)[off]] = True
    among = agreed | ~found.inlier
    q1, q2 = (np.ascontiguousarray(q[:, among]) for q in (found.all1, found.all2))
    copies = beside - independent(found.q1[:, off], found.q2[:, off])
    chance = chance_agreement(found.table, found.F, q1, q2, found.limit)
    alarms = log10_false_alarms(q1.shape[1] - copies, beside - copies, chance, free)
    return alarms > SIGNIFICANT


def is_plane_left_open(
    table: Table, H: Array, q1: Array, q2: Array, used: Mask, bound: float = 0.0
) -> bool:
    """Tell the same of a homography and the matches used among all, by a bound if not all right."""
    q = [np.ascontiguousarray(own[:, used]) for own in (q1, q2)]
    squares = float(np.sum(plane_squares(table, H, *q)))
    noise = math.sqrt(squares / max(2 * q[0].shape[1] - 8, 1))
    lines = [_off_line(own, noise) for own in q]
    if lines[0] is None or lines[1] is None:
        return False
    off = lines[0] | lines[1]
    count = int(np.count_nonzero(off))
    if count < _PLANE or not bound:
        return count < _PLANE
    beside = np.ones(len(used), np.bool_)
    beside[np.flatnonzero(used)[~off]] = False
    b1, b2 = (np.ascontiguousarray(q[:, beside]) for q in (q1, q2))
    chance = chance_on_plane(table, H, b1, b2, bound)
    return log10_false_alarms(b1.shape[1], count, chance, _PLANE) > SIGNIFICANT


def may_be_lines(
    x1: Array,
    x2: Array,
    offsets: NDArray[np.intp],
    noise_px: Array,
    weights: Array | None = None,
) -> Mask:
    """Tell by a cheap test of which pairs of images most points may be on one line.

    Compiled, as all of the quick tests are; without the library all pairs are judged in full.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2), float64, contiguous
        Matches in pixels.
    offsets : ndarray of intp, shape (n + 1,)
        Pair k has the matches ``offsets[k]:offsets[k + 1]``.
    noise_px : ndarray, shape (n,)
        Standard deviation of a coordinate of weight one.
    weights : ndarray, shape (m,), optional
        Factor of each squared residual, 1 by default.

    Returns
    -------
    ndarray of bool, shape (n,)
        Those that `is_left_open` has to judge.
    """
    may = np.empty(len(offsets) - 1, np.bool_)
    bound = np.asarray(_NEAR * noise_px, np.float64)
    arrays = (offsets, x1, x2, weights, bound)
    _function()(len(may), *map(address, arrays), _THREES, address(may))
    return may


@cache
def _function() -> Any:
    function = library().eg_may_be_lines
    function.argtypes = [ctypes.c_ssize_t, *[ctypes.c_void_p] * 5, ctypes.c_double, ctypes.c_void_p]
    function.restype = None
    return function


def _off_line(q: Array, noise: float) -> Mask | None:
    """Return which points are off the line that most are on; None where most are on none.

    Parameters
    ----------
    q : ndarray, shape (2, n)
        Points in conditioned coordinates.
    noise : float
        Standard deviation of a coordinate.

    Returns
    -------
    ndarray of bool, shape (n,), or None
        Points off the line.
    """
    noise = max(noise, _SINGLE)
    distances = _distances(q, FAR_OFF * noise)
    on = distances <= FAR_OFF * noise
    if np.mean(on) < MOST_ON or np.mean(distances[on] ** 2) > (_SPREAD * noise) ** 2:
        return None
    return ~on


def _distances(q: Array, bound: float) -> Array:
    """Return the distances of points (2, n) to the line that most of them are on."""
    few = q[:, :: -(-q.shape[1] // POOL)]
    a, b, _ = threes(few.shape[1]).T
    direction = few[:, b] - few[:, a]
    length = np.hypot(*direction)
    a, direction = a[length > 0.0], (direction / np.maximum(length, 1e-300))[:, length > 0.0]
    if not len(a):
        return np.zeros(q.shape[1])  # all in one place
    normal = np.array([-direction[1], direction[0]])
    across = np.abs(normal.T @ few - np.sum(normal * few[:, a], axis=0)[:, None])
    best = int(np.argmax(np.count_nonzero(across <= bound, axis=1)))
    middle, n = few[:, a[best]], normal[:, best]
    for _ in range(_REFITS):
        on = np.abs(n @ (q - middle[:, None])) <= bound
        if np.count_nonzero(on) < 2:
            break
        middle = np.mean(q[:, on], axis=1)
        centred = q[:, on] - middle[:, None]
        n = np.linalg.eigh(centred @ centred.T)[1][:, 0]
    return np.asarray(np.abs(n @ (q - middle[:, None])))
