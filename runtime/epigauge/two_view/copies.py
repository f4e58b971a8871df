"""Repeated matches: a match that is listed several times is one observation.

Detectors list a point several times (SIFT once for each of its orientations), and so a match.
Copies would count as independent measurements: the noise would come out too small, and with it
everything that is judged by it.

Different matches of one point contradict each other: one of them is right at most. An epipole there
agrees with all of them exactly, so they must not decide what most matches agree on.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address, library
from epigauge.errors import BackendError

__all__ = ["contradicted", "counted_once", "earliest"]

Array = NDArray[np.float64]

#: Matchers give a point no more of them, right ones among them.
_SEVERAL = 5


@cache
def _function() -> Any:
    try:
        function = library().eg_copies
    except BackendError:
        return None
    function.argtypes = [ctypes.c_ssize_t, *[ctypes.c_void_p] * 4]
    function.restype = ctypes.c_ssize_t
    return function


def earliest(x1: Array, x2: Array, offsets: NDArray[np.intp] | None = None) -> NDArray[np.intp]:
    """Return for each match the earliest of its pair that has the same four coordinates.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Contiguous matches of one pair, or of several one after the other.
    offsets : ndarray of intp, shape (n + 1,), optional
        Where the pairs begin, as in `refine_fundamental_batch`.

    Returns
    -------
    ndarray of intp, shape (m,)
        Rows of x1 and x2; its own row for a match that is no copy.
    """
    return _counted(x1, x2, offsets)[0]


def _counted(
    x1: Array, x2: Array, offsets: NDArray[np.intp] | None
) -> tuple[NDArray[np.intp], int]:
    """Return the same and how many copies there are."""
    m = len(x1)
    bounds = np.array([0, m], np.intp) if offsets is None else offsets
    function = _function()
    first = np.empty(m, np.intp)
    if function is None:
        for begin, end in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
            rows = np.column_stack([x1[begin:end], x2[begin:end]]) + 0.0
            _, index, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
            first[begin:end] = begin + index[place.ravel()]
        return first, int(np.count_nonzero(first != np.arange(m)))
    copies = function(len(bounds) - 1, address(bounds), address(x1), address(x2), address(first))
    if copies < 0:
        raise MemoryError(f"no room for {m} matches")
    if offsets is not None:
        first += np.repeat(bounds[:-1], np.diff(bounds))
    return first, copies


def counted_once(
    x1: Array, x2: Array, weights: Array | None, offsets: NDArray[np.intp] | None = None
) -> Array | None:
    """Return weights with which each of several equal matches counts once.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Contiguous matches; may hold anything.
    weights : ndarray, shape (m,), or None
        Not negative; ones if None.
    offsets : ndarray of intp, shape (n + 1,), optional
        Where the pairs begin.

    Returns
    -------
    ndarray, shape (m,), or None
        The weights that were given where nothing is repeated. Else the earliest of equal matches
        has the largest of their weights, and the others have zero.
    """
    first, copies = _counted(x1, x2, offsets)
    if not copies:
        return weights
    copy = first != np.arange(len(first))
    once = np.ones(len(first)) if weights is None else weights.copy()
    np.maximum.at(once, first[copy], once[copy])
    once[copy] = 0.0
    return once


def contradicted(x1: Array, x2: Array) -> NDArray[np.bool_]:
    """Return which matches share a point of either image with several others.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Different matches.

    Returns
    -------
    ndarray of bool, shape (m,)
        Those of a point with more than five matches.
    """
    several = np.zeros(len(x1), np.bool_)
    for x in (x1, x2):
        across = np.sort(x[:, 0])
        if not np.any(across[_SEVERAL:] == across[:-_SEVERAL]):
            continue  # as for most pairs: no more points on one line, let alone in one place
        _, place, counts = np.unique(x @ [1.0, 1.0j], return_inverse=True, return_counts=True)
        several |= counts[place] > _SEVERAL
    return several
