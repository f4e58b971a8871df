"""The verdict on a plain pair by cheap tests, where they suffice: one pass of the C library.

Most pairs are plainly in order, and `diagnostics.diagnose` says so by way of searches and fits.
Here each test is one of its own, or sufficient for one: no plane that a search by parallax
could have missed, no residual that calls for a search. Where one does not suffice, there is no
verdict here, and `diagnose` gives it.
"""

from __future__ import annotations

import ctypes
import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import verdicts
from epigauge._library import address, library
from epigauge._native import check_sizes
from epigauge.two_view import native
from epigauge.two_view.chance import PAIRS, RANK, SIGNIFICANT, log10_false_alarms
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.diagnostics import AFFINE, PIXELS, REDUNDANCY, WEAK, planar_bound
from epigauge.two_view.evidence import WITHIN
from epigauge.two_view.planes import FAR_OFF, HIDDEN, MOST_ON, POOL, REACH, SAMPLES
from epigauge.two_view.suspicion import FOURTH, TAIL, TAIL_SHARE, WIDE

__all__ = ["Facts", "flags", "verdicts_of"]

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
        how many points of an image are there more than once (all matches count here).
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


class _Options(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("within", "wide", "hidden", "tail", "reach", "far")),
        *((name, ctypes.c_ssize_t) for name in ("samples", "pool", "pairs", "rank")),
    )


_OPTIONS = _Options(
    *(WITHIN, WIDE * RANGE, HIDDEN * RANGE, TAIL, REACH, FAR_OFF), *(SAMPLES, POOL, PAIRS, RANK)
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
    n = len(offsets) - 1
    table = np.empty((n, len(Facts._fields)))
    done = _function()(
        n,
        *map(address, (offsets, x1, x2, weights, pair.numbers)),
        pair.numbers.shape[1],
        *map(address, (pair.distances, pair.table)),
        ctypes.addressof(_OPTIONS),
        address(table),
    )
    if not done:
        raise MemoryError(f"no room for {len(x1)} matches")
    found: list[tuple[tuple[str, ...] | None, bool]] = []
    for row, scale, own in zip(
        table.tolist(), pair.table[:, 35].tolist(), pair.numbers.tolist(), strict=True
    ):
        raised = None if own[0] else flags(Facts(*row), scale)
        success = raised is not None and own[4] > 0 and verdicts.usable(raised, "F")
        found.append((raised, success))
    return found


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
    n, squares = int(own.number), own.squares
    if n - _FREE < REDUNDANCY or own.unoriented or own.extent * scale < PIXELS:
        return None
    noise2 = squares / (n - _FREE)
    noise = math.sqrt(noise2)
    if noise < _EXACT or not own.least > 0.0:
        return None
    weak = noise2 > WEAK**2 * own.least
    if own.tail > TAIL_SHARE * (1.0 - _CLOSE) * squares:
        return None
    if noise > WIDE * RANGE and not _is_plainly_common(own):
        return None
    if noise > HIDDEN * RANGE:
        bound = planar_bound(n, _FREE) * noise2
        if abs(own.plane - bound) < _CLOSE * bound:
            return None
        weak = weak or own.plane <= bound
    elif own.on_plane >= MOST_ON:
        return None
    affine = own.affine <= squares + AFFINE * noise2
    return ("weak geometry",) * weak + ("near-affine",) * affine


def _is_plainly_common(own: Facts) -> bool:
    """Tell whether wide residuals look normal, and agree better than wrong matches do."""
    if own.fourth * own.number > (1.0 - _CLOSE) * FOURTH * own.squares**2:
        return False
    m, agreed = int(own.number - own.repeated), int(own.near - own.repeated)
    return log10_false_alarms(m, agreed, own.chance) <= 2.0 * SIGNIFICANT
