"""The likelihood of all matches by the compiled code: what `consensus.Consensus` does in Python."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address, library
from epigauge._native import check_sizes

__all__ = ["Judged", "MixtureOptions", "climb", "judge", "settle"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class MixtureOptions(ctypes.Structure):
    """The eg_mixture_options of two_view.h."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("extent", "range", "widest", "floor")),
        *((name, ctypes.c_double) for name in ("least", "most", "halo", "climbed", "ftol")),
        *((name, ctypes.c_int) for name in ("climbs", "steps")),
    )


class Judged(NamedTuple):
    """What is known of a geometry F, as in `consensus.Agreement`."""

    F: Array
    signed: Array
    oriented: Mask
    sigma: float
    share: float
    score: float
    near: float
    spread: float


@cache
def _functions() -> tuple[Any, Any, Any]:
    check_sizes({"eg_mixture_options": MixtureOptions})
    pointer, size = ctypes.c_void_p, ctypes.c_ssize_t
    judge_, climb_, settle_ = library().eg_judge, library().eg_climb, library().eg_settle
    for function in (judge_, climb_):
        function.argtypes = [size, *[pointer] * 7]
    numbers = ctypes.c_double, size, ctypes.c_int
    settle_.argtypes = [size, *[pointer] * 4, *numbers, *[pointer] * 4]
    return judge_, climb_, settle_


def judge(
    q1: Array,
    q2: Array,
    F: Array,
    fitted: tuple[float, float, float, float] | None,
    options: MixtureOptions,
) -> Judged:
    """Measure the matches; fit deviation and share from some, where these are given.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches, contiguous.
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    fitted : (float, float, float, float) or None
        Deviation of right distances and their share, share of wrong ones near, and their spread.
    options : MixtureOptions
        How.
    """
    m = q1.shape[1]
    sigma, share, *others = fitted or (0.0,) * 4
    numbers = np.array([sigma, share, 0.0, *others])
    matrix, signed, oriented = np.ascontiguousarray(F), np.empty(m), np.empty(m, np.bool_)
    done = _functions()[0](
        m,
        *map(address, (matrix, q1, q2)),
        ctypes.addressof(options),
        *map(address, (None if fitted is None else numbers, signed, oriented)),
    )
    if not done:
        raise MemoryError(f"no room for {m} matches")
    return Judged(F, signed, oriented, *numbers.tolist())


def climb(q1: Array, q2: Array, start: Judged, options: MixtureOptions) -> Judged:
    """Maximise the likelihood over F, deviation and share in turns.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches, contiguous.
    start : Judged
        From where.
    options : MixtureOptions
        How.
    """
    numbers = np.array([start.sigma, start.share, start.score, start.near, start.spread])
    F, signed, oriented = start.F.copy(), start.signed.copy(), start.oriented.copy()
    done = _functions()[1](
        q1.shape[1],
        *map(address, (q1, q2)),
        ctypes.addressof(options),
        *map(address, (F, numbers, signed, oriented)),
    )
    if not done:
        raise MemoryError(f"no room for {q1.shape[1]} matches")
    return Judged(F, signed, oriented, *numbers.tolist())


def settle(
    q1: Array,
    q2: Array,
    weights: Array,
    start: tuple[Array, Array, Mask],
    limit: float,
    choices: tuple[float, int, int],
    options: MixtureOptions,
) -> tuple[tuple[Array, Array, Mask], float, int]:
    """Fit F to the matches within a limit until these stand still.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches, contiguous.
    weights : ndarray, shape (m,)
        Of the matches; one without weight is never within.
    start : tuple of ndarray, shape (3, 3), (m,), (m,)
        F, distances and which matches are oriented.
    limit : float
        Largest distance.
    choices : tuple of float, int, int
        Deviations that the limit falls to, 0 for none; matches that are enough; fits at most.
    options : MixtureOptions
        How.

    Returns
    -------
    tuple
        As `start`, the limit, and how many fits that took.
    """
    F, signed, oriented = start[0].copy(), start[1].copy(), start[2].copy()
    bound = np.array(limit)
    fits = _functions()[2](
        q1.shape[1],
        *map(address, (q1, q2, weights)),
        ctypes.addressof(options),
        *choices,
        *map(address, (F, bound, signed, oriented)),
    )
    if fits < 0:
        raise MemoryError(f"no room for {q1.shape[1]} matches")
    return (F, signed, oriented), float(bound), int(fits)
