"""The verdict on a plain pair by cheap tests, where they suffice: one pass of the C library.

Most pairs are plainly in order, and `diagnostics.diagnose` says so by way of searches and fits.
Here each test is one of its own, or sufficient for one: no plane that a search by parallax
could have missed, no residual that calls for a search. Where one does not suffice, there is no
verdict here, and `diagnose` gives it.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, verdicts
from epigauge._library import address, library
from epigauge._native import check_sizes
from epigauge.two_view import native
from epigauge.two_view.chance import CEILING, PAIRS, RANK, SIGNIFICANT, log10_false_alarms
from epigauge.two_view.collinear import may_be_lines
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.diagnostics import (
    AFFINE,
    BLUNT,
    PIXELS,
    REDUNDANCY,
    WEAK,
    planar_bound,
    plane_flags,
)
from epigauge.two_view.evidence import WITHIN, Evidence, of_median_one
from epigauge.two_view.planes import (
    BESIDE,
    FAR_OFF,
    GROWS,
    HALF_ON,
    HIDDEN,
    MOST_ON,
    NO_RELIEF,
    PLAINLY,
    PLENTY,
    POOL,
    REACH,
    SAMPLES,
)
from epigauge.two_view.suspicion import FOURTH, TAIL, TAIL_SHARE, WIDE
from epigauge.verdicts import ordered

__all__ = ["Facts", "flags", "verdict_of_raw", "verdicts_of"]

Array = NDArray[np.float64]

#: Parameters of F.
_FREE = 7

#: Below this noise, in conditioned coordinates, rounding could decide.
_EXACT = 1e-7

#: Numbers this near to a bound are left to `diagnose` (relative).
_CLOSE = 1e-3


class Facts(NamedTuple):
    """What the C library tells of a pair (runtime/c/quick.c), in conditioned coordinates.

    Attributes
    ----------
    number : float
        Matches of positive weight; all else is of these.
    squares, fourth : float
        Sums of their weighted squared distances, and of the squares of these.
    extent : float
        Over how much the points of an image spread, in either direction.
    least : float
        Least eigenvalue of J^T J for F of unit norm; 0 where F is not determined.
    unoriented : float
        Matches in front of one camera only.
    median : float
        Median distance.
    tail : float
        Sum of the squares beyond `suspicion.TAIL` robust deviations.
    affine : float
        Sum of squares to the best affine F.
    on_plane : float
        As `planes.share_on_a_plane`, 0 where the noise hides any relief.
    plane : float
        Where it does, the sum of squares to the best homography.
    chance, near, repeated : float
        Where the noise is wide, the probability that a wrong match agrees, how many matches do, and
        how many points of an image are there more than once.
    places : float
        In how many places matches are off the plane of `on_plane`.
    little : float
        The share of the matches that are off it by no relief, whatever the noise.
    """

    number: float
    squares: float
    extent: float
    least: float
    unoriented: float
    median: float
    tail: float
    fourth: float
    affine: float
    on_plane: float
    plane: float
    chance: float
    near: float
    repeated: float
    places: float
    little: float


class _Options(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("within", "wide", "hidden", "tail", "reach", "far")),
        *((name, ctypes.c_ssize_t) for name in ("samples", "pool", "grows", "pairs", "rank")),
        ("beside", ctypes.c_double),
        ("little", ctypes.c_double),
        ("searched", ctypes.c_ssize_t),
    )


_NUMBERS = (
    WITHIN,
    WIDE * RANGE,
    HIDDEN * RANGE,
    TAIL,
    REACH,
    FAR_OFF,
    SAMPLES,
    POOL,
    GROWS,
    PAIRS,
    RANK,
)
_OPTIONS, _SEARCHED = (
    _Options(*_NUMBERS, BESIDE * RANGE, NO_RELIEF * RANGE, searched) for searched in (0, 1)
)


@cache
def _function() -> Any:
    check_sizes({"eg_quick_options": _Options})
    function = library().eg_quick_facts
    pointer, size = ctypes.c_void_p, ctypes.c_ssize_t
    function.argtypes = [size, *[pointer] * 5, size, *[pointer] * 4]
    return function


def verdicts_of(
    pair: native.Pair,
    x1: Array,
    x2: Array,
    offsets: NDArray[np.intp],
    weights: Array | None,
) -> list[tuple[tuple[str, ...] | None, bool]]:
    """Return flags and success of pairs that were refined with the exact criterion.

    Parameters
    ----------
    pair : native.Pair
        Results.
    x1, x2, offsets, weights
        As they were given to `native.refine_pairs`.

    Returns
    -------
    list of (tuple of str or None, bool)
        One entry a pair; flags are None where these tests do not suffice.
    """
    found: list[tuple[tuple[str, ...] | None, bool]] = []
    if weights is not None:
        weights, units = _of_median_one(weights, offsets)
    rows = [Facts(*row) for row in _facts(pair, x1, x2, offsets, weights, pair.distances, _OPTIONS)]
    if weights is not None:
        rows = [row._replace(least=row.least / unit) for row, unit in zip(rows, units, strict=True)]
    noise_px = pair.table[:, 35] * [_noise(own) for own in rows]
    on_lines = may_be_lines(x1, x2, offsets, noise_px, weights).tolist()
    for row, scale, own, doubtful in zip(
        rows, pair.table[:, 35].tolist(), pair.numbers.tolist(), on_lines, strict=True
    ):
        raised = None if own[0] or doubtful else flags(row, scale)
        success = raised is not None and own[4] > 0 and verdicts.usable(raised, "F")
        found.append((raised, success))
    return found


def verdict_of_raw(
    pair: native.Pair,
    matches: tuple[Array, Array, Array],
    distances: Array,
    agreeing: NDArray[np.bool_],
    limit_px: float,
    chance: Callable[[], float],
) -> tuple[tuple[str, ...] | None, bool]:
    """Return flags and success of a pair by all of its raw matches.

    Parameters
    ----------
    pair : native.Pair
        F, fitted to those that agree.
    matches : (ndarray, ndarray, ndarray)
        All different matches x1, x2 (m, 2) in pixels, contiguous, and their weights (m,).
    distances : ndarray, shape (m,)
        Their distances from F in pixels.
    agreeing : ndarray of bool, shape (m,)
        Which of them agree with F: within a limit, and oriented.
    limit_px : float
        The limit.
    chance : callable
        Returns the probability that a wrong match agrees (`chance.chance_agreement`).
    """
    x1, x2, weights = matches
    counts = weights > 0.0
    unit = of_median_one(weights[counts])[1] if np.any(weights != 1.0) else 1.0
    agreed = np.where(agreeing, weights / unit, 0.0)
    if np.count_nonzero(agreed) < _FREE + REDUNDANCY:
        return None, False
    row = _facts(
        pair,
        *(x1, x2, np.array([0, len(x1)], np.intp)),
        agreed,
        distances,
        _SEARCHED,
    )[0]
    own, scale = Facts(*row), float(pair.table[0, 35])
    own = own._replace(least=own.least / unit)
    if limit_px > CEILING * RANGE * scale:
        return None, False
    if own.squares > (own.number - _FREE) * (HIDDEN * RANGE) ** 2:
        return None, False
    y1, y2 = x1[agreed > 0.0], x2[agreed > 0.0]
    if may_be_lines(y1, y2, np.array([0, len(y1)]), np.array([scale * _noise(own)]))[0]:
        return None, False
    raised = _plain_flags(own, scale)
    if raised is None:
        return None, False
    m, n = int(np.count_nonzero(counts)), int(own.number)
    wrong, copies = chance(), int(own.repeated)
    if log10_false_alarms(m - copies, n - copies, wrong) > SIGNIFICANT:
        return None, False
    judges = -(-n // -(-n // POOL))
    many = max(PLENTY - 1, PLAINLY * (judges / n) * wrong * (m - n))
    flat = own.on_plane >= HALF_ON or own.places <= many  # a plane may be all that they are on
    if flat or own.little >= HALF_ON:
        found = _evidence(pair, matches, own, unit, agreeing, limit_px)
        about = {name for name, is_raised in plane_flags(found, tested=flat).items() if is_raised}
        raised = ordered(about.union({"weak geometry"}.intersection(raised)))
    return raised, int(pair.numbers[0, 4]) > 0 and verdicts.usable(raised, "F")


def _evidence(
    pair: native.Pair,
    matches: tuple[Array, Array, Array],
    own: Facts,
    unit: float,
    agreeing: NDArray[np.bool_],
    limit_px: float,
) -> Evidence:
    """Return the evidence that `Evidence.among` of the whole result would be."""
    x1, x2, weights = (values[matches[2] > 0.0] for values in matches)
    frame = pair.frame(0)
    q1, q2 = frame.forward(x1, x2)
    to_units1, to_units2 = frame.maps_from_pixels()
    return Evidence(
        table=kernels.table("c"),
        F=pair.table[0, 55:64].reshape(3, 3),
        all1=q1,
        all2=q2,
        all_weights=weights / unit,
        unit=unit,
        inlier=agreeing[matches[2] > 0.0],
        limit=limit_px / frame.scale,
        searched=True,
        to_units1=to_units1,
        to_units2=to_units2,
        noise=_noise(own),
        parameters=_FREE,
    )


def _facts(
    pair: native.Pair,
    x1: Array,
    x2: Array,
    offsets: NDArray[np.intp],
    weights: Array | None,
    distances: Array,
    options: _Options,
) -> list[list[float]]:
    """Return the facts of each pair."""
    n = len(offsets) - 1
    table = np.empty((n, len(Facts._fields)))
    done = _function()(
        n,
        *map(address, (offsets, x1, x2, weights, pair.numbers)),
        pair.numbers.shape[1],
        *map(address, (distances, pair.table)),
        ctypes.addressof(options),
        address(table),
    )
    if not done:
        raise MemoryError(f"no room for {len(x1)} matches")
    rows: list[list[float]] = table.tolist()
    return rows


def _of_median_one(weights: Array, offsets: NDArray[np.intp]) -> tuple[Array, list[float]]:
    """Return weights divided by the median of the positive ones of their pair, and the medians."""
    weights, units = weights.copy(), []
    for begin, end in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        own = weights[begin:end]
        positive = own > 0.0
        own[positive], unit = of_median_one(own[positive])
        units.append(unit)
    return weights, units


def flags(own: Facts, scale: float) -> tuple[str, ...] | None:
    """Return the flags of a pair, None where these tests do not suffice.

    Parameters
    ----------
    own : Facts
        About the pair.
    scale : float
        Pixels a conditioned unit.

    Returns
    -------
    tuple of str or None
        As `diagnostics.diagnose` returns them for F of seven parameters, least squares, one start.
    """
    found = _plain_flags(own, scale)
    if found is None or own.tail > TAIL_SHARE * (1.0 - _CLOSE) * own.squares:
        return None
    n, noise = int(own.number), _noise(own)
    noise2 = noise**2
    if noise > WIDE * RANGE and not _is_plainly_common(own):
        return None
    if noise > HIDDEN * RANGE:
        bound = planar_bound(n, _FREE) * noise2
        if abs(own.plane - bound) < _CLOSE * bound:
            return None
        if own.plane <= bound:
            return ordered({"weak geometry", *found})
    elif own.on_plane >= MOST_ON or own.little >= HALF_ON:
        return None
    return found


def _noise(own: Facts) -> float:
    """Return the standard deviation of a coordinate."""
    return math.sqrt(max(own.squares, 0.0) / max(own.number - _FREE, 1.0))


def _plain_flags(own: Facts, scale: float) -> tuple[str, ...] | None:
    """Return what the size of the covariance and an affine F say; None where that is not all."""
    n, squares = int(own.number), own.squares
    if n - _FREE < REDUNDANCY or own.unoriented or own.extent * scale < PIXELS:
        return None
    noise2 = squares / (n - _FREE)
    if noise2 < _EXACT**2 or not own.least > 0.0:
        return None
    if noise2 > (1.0 - _CLOSE) * max(WIDE * RANGE, BLUNT / scale) ** 2:
        return None  # wrong matches may be near where a homography takes them
    weak = noise2 > WEAK**2 * own.least
    affine = own.affine <= squares + AFFINE * noise2
    return ("weak geometry",) * weak + ("near-affine",) * affine


def _is_plainly_common(own: Facts) -> bool:
    """Tell whether wide residuals look normal, and agree better than wrong matches do."""
    if own.fourth * own.number > (1.0 - _CLOSE) * FOURTH * own.squares**2:
        return False
    m, agreed = int(own.number - own.repeated), int(own.near - own.repeated)
    return log10_false_alarms(m, agreed, own.chance) <= 2.0 * SIGNIFICANT
