"""Whether given calibrations fit: an essential matrix against a free F of the same matches.

E has five parameters, F seven, and where K is wrong or a lens is distorted, F explains what E
cannot. The two more parameters take two squares of the noise by themselves; beside that
significance stands the size of the effect, since a calibration is never exact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.chance import two_by_chance
from epigauge.two_view.consensus import RANGE, WIDEST, Consensus
from epigauge.two_view.evidence import ROUNDING, Evidence

__all__ = ["is_calibration_wrong"]

Array = NDArray[np.float64]

#: Parameters of F.
_PARAMETERS = 7

#: The chance that a right calibration is called wrong, but for the next bound.
_MISSED = 1e-5

#: The variance that E leaves over that of F beyond which K is called wrong: what E misses is then
#: 0.7 of the noise, and the motion is off by several of its standard deviations.
_EXCESS = 1.5

#: How many times the matches of E agree with F where K is called wrong.
_MORE = 1.25

#: Matches more than parameters that the noise of F is known from at least.
_LEAST = 8


def is_calibration_wrong(found: Evidence) -> bool:
    """Tell whether a free F explains the matches of calibrated cameras so much better than E.

    Parameters
    ----------
    found : Evidence
        Of an essential matrix.

    Returns
    -------
    bool
        Whether the squares of the same matches differ by more than noise and chance explain; or,
        where E has chosen its matches, whether many more agree with F.
    """
    consensus = Consensus(found.table, found.q1, found.q2)
    F = consensus.fitted(found.F, found.weights)
    signed, _ = consensus.measured(F)
    of_E, of_F = (float(found.weights @ squared) for squared in (found.squared, signed**2))
    redundancy = len(found.weights) - _PARAMETERS
    if redundancy < _LEAST:
        return False
    variance = max(of_F / redundancy, ROUNDING**2)
    bound = two_by_chance(redundancy, _MISSED)
    if of_E - of_F > bound * variance and of_E > _EXCESS * variance * (redundancy + 2):
        return True
    return found.searched and _has_more(found, F, math.sqrt(variance))


def _has_more(found: Evidence, F: Array, noise: float) -> bool:
    """Tell whether an F near E agrees with many more of all matches, as sharply."""
    every = Consensus(found.table, found.all1, found.all2)
    free = every.climb(every.judge(F, noise))
    own = every.judge(found.F, noise)
    limit = min(free.mixture.even, WIDEST * RANGE)
    more, fewer = (np.count_nonzero(each.inliers(limit)) for each in (free, own))
    gain = free.score - own.score
    return bool(gain > -math.log(_MISSED) and more > _MORE * fewer)
