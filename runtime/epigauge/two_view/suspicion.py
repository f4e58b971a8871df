"""Whether matches that were given as right ones are: gross errors among them, or nothing at all.

Least squares bend F to wrong matches and hide them. Where the residuals look suspicious, the
geometry that most matches agree on is looked for, as among raw ones.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.chance import (
    CEILING,
    SIGNIFICANT,
    chance_agreement,
    independent,
    log10_false_alarms,
)
from epigauge.two_view.consensus import RANGE, Consensus
from epigauge.two_view.evidence import ROUNDING, Evidence
from epigauge.two_view.losses import robust_scale
from epigauge.two_view.planes import HIDDEN, MOST_ON, share_on_a_plane

__all__ = [
    "FOURTH",
    "TAIL",
    "TAIL_SHARE",
    "WIDE",
    "agreeing",
    "is_common",
    "is_inflated",
    "is_suspicious",
    "log10_alarms",
]

Array = NDArray[np.float64]

#: A noise beyond this share of the range of the coordinates (2.5 px in an image of 1000) must agree
#: better than chance, and look normal: a fourth moment, over the squared second, of 3 if it is.
WIDE = 0.0025
FOURTH = 4.5

#: Matches beyond so many robust deviations that carry more than this share of the squared error.
TAIL, TAIL_SHARE = 5.0, 0.3

#: Gross errors are told when the variance of least squares is so many times that of the matches
#: that agree with the best F.
_INFLATED = 2.0


def is_suspicious(found: Evidence) -> bool:
    """Tell whether least squares may have been bent by gross errors: cheap, and often wrong."""
    if found.noise <= ROUNDING:
        return False
    squares = found.weights * found.squared
    total, tail = np.sum(squares), (TAIL * robust_scale(np.sqrt(squares))) ** 2
    if np.sum(squares[squares > tail]) > TAIL_SHARE * total:
        return True
    if found.noise <= WIDE * RANGE:
        return False
    if found.noise <= HIDDEN * RANGE and share_on_a_plane(found) >= MOST_ON:
        return True  # an F that a plane leaves free bends to wrong matches with little error
    return bool(np.mean(squares**2) > FOURTH * np.mean(squares) ** 2) or not is_common(found)


def agreeing(found: Evidence) -> Evidence:
    """Return the evidence for the geometry that most matches agree on, as if they were raw."""
    consensus = Consensus(found.table, found.all1, found.all2, np.inf)
    own = consensus.judge(found.F, found.noise, 0.9)
    best = consensus.better(own, np.random.default_rng(0))
    limit = max(best.mixture.even, ROUNDING)
    inlier = best.inliers(limit)
    count = int(np.count_nonzero(inlier))
    squares = np.sum(found.all_weights[inlier] * best.signed[inlier] ** 2)
    return replace(
        found,
        F=best.F,
        inlier=inlier,
        limit=limit,
        searched=True,
        by_loss=False,
        noise=float(np.sqrt(squares / max(count - found.parameters, 1))),
    )


def is_inflated(found: Evidence, judged: Evidence) -> bool:
    """Tell whether a few matches far off the common geometry are most of the error."""
    if not judged.rejected:
        return False
    return found.noise**2 > _INFLATED * max(judged.noise, ROUNDING) ** 2


def is_common(found: Evidence, bar: float = SIGNIFICANT) -> bool:
    """Tell whether more matches agree with F than wrong ones would by chance.

    They would with 10 to the power `bar` geometries at most.
    """
    return log10_alarms(found) <= bar


def log10_alarms(found: Evidence) -> float:
    """Return the logarithm of how many geometries wrong matches would agree with as well.

    Matches in front of one camera only do not agree.
    """
    limit = min(found.limit, CEILING * RANGE) if found.searched else found.limit
    near = found.squared <= limit**2
    if found.from_rays is None:
        near &= found.in_front
    m, agreed = len(found.inlier), int(np.count_nonzero(near))
    if not agreed:
        return math.inf
    copies = agreed - independent(found.q1[:, near], found.q2[:, near])
    chance = chance_agreement(found.table, found.F, found.all1, found.all2, limit)
    return log10_false_alarms(m - copies, agreed - copies, chance, found.parameters)
