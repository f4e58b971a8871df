"""Whether matches move as those around them do.

Right matches have neighbours in one image that are neighbours in the other, too. Of raw matches
this says which are promising. Of those that agree with one F it tells a scene from repeated
structure: windows of a facade that are taken for others of their row agree with an F whose epipole
is the vanishing point of the rows, and may be more than the right matches off the wall; but they
lie among the right ones and go elsewhere.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address, library
from epigauge.kernels import Table

__all__ = ["accord", "ranked"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

#: Matches are near within this in each conditioned coordinate, whose range is about 7: 3 % of the
#: image where all matches are looked at, more where only those are that agree.
_REACH, _WIDE = 0.2, 0.3


@cache
def _function() -> Any:
    function = library().eg_neighbours
    pointer, number = ctypes.c_void_p, ctypes.c_double
    function.argtypes = [ctypes.c_ssize_t, pointer, number, number, pointer]
    return function


def ranked(kernels: Table, q1: Array, q2: Array) -> Rows:
    """Return the rows of the matches, those first whose neighbours move alike.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    """
    # Without neighbours nothing speaks for a match
    return np.argsort(-_shares(kernels, np.concatenate([q1, q2]), _REACH, 0.0), kind="stable")


def accord(kernels: Table, q1: Array, q2: Array) -> Array:
    """Return of matches that agree with an F, shape (m,), how far each moves as its neighbours do.

    That is the share of its neighbours in either image that are so in both, with one more that is
    by half: one half where it has none.
    """
    return _shares(kernels, np.concatenate([q1, q2]), _WIDE, 0.5)


def _shares(kernels: Table, q: Array, reach: float, alone: float) -> Array:
    """Return (both + alone) / (either + 1) of the neighbours in the two images, in float32."""
    q, m = np.ascontiguousarray(q), q.shape[1]
    share = np.empty(m)
    if kernels.compiled:
        if not _function()(m, address(q), reach, alone, address(share)):
            raise MemoryError(f"no room for {m} matches")
        return share
    q = q.astype(np.float32)
    for i in range(m):
        near = np.abs(q - q[:, i : i + 1]) < np.float32(reach)
        one, two = near[0] & near[1], near[2] & near[3]
        # Each is its own neighbour
        both, either = np.count_nonzero(one & two) - 1, np.count_nonzero(one | two)
        share[i] = (both + alone) / either
    return share
