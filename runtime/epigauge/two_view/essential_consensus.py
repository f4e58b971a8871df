"""The essential matrix that most matches agree on, among matches with gross errors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.two_view.consensus import RANGE, Agreement, Consensus
from epigauge.two_view.essential import Calibrated, Essential
from epigauge.two_view.five_point import essential_starts
from epigauge.two_view.homography import robust_homography
from epigauge.two_view.parameterizations import Remapped
from epigauge.two_view.plane_motions import essentials
from epigauge.two_view.search import FLOOR, SCALES

__all__ = ["EssentialConsensus"]

Array = NDArray[np.float64]

#: How many of the front ends' geometries give pools of right matches, how many essential matrices
#: are taken from each, the best of which are climbed from, and rounds of looking for a better one
#: among the matches that agree.
_POOLS, _EACH, _CLIMBERS = 2, 5, 2
_ROUNDS = 3

#: An E whose noise is so many times that of F is not sharp: its K may be wrong.
_BLUNTER = 2.0

#: An improvement of the likelihood that is worth another round.
_CLIMBED = 1e-3

#: Where a larger share of the matches that agree is behind the cameras, each by three standard
#: deviations, they may be on a plane whose other motion sees them; it agrees with this part of the
#: matches at least.
_BEHIND, _DOUBT, _AS_MANY = 0.02, 4.5, 0.9

#: Standard deviation of the noise, conditioned, that few matches are judged with.
_BLIND = 0.01


class EssentialConsensus(Consensus):
    """Search for the essential matrix with the best agreement of given matches.

    Geometries of uncalibrated front ends only tell which matches may be right. Where perspective
    hardly shows, or on a plane, the essential matrix nearest to a good F explains nothing;
    solutions of five matches do.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    A1, A2 : ndarray, shape (3, 3)
        Maps of the images from rays to these coordinates.
    """

    def __init__(self, kernels: Table, q1: Array, q2: Array, A1: Array, A2: Array) -> None:
        super().__init__(kernels, q1, q2)
        self.cameras = Calibrated(q1, q2, A1, A2)
        self.chart = Remapped(Essential(kernels, self.cameras.rays(q1, q2)), A1, A2)

    def of_few(self) -> Agreement:
        """Return the agreement to begin from with five to seven matches, which leave F open."""
        found = essential_starts(self.cameras, np.ones(self.cameras.q1.shape[1]), 1)
        if not found:
            raise ArgumentError("x1, x2", "leave the motion open", "matches in general position")
        return self.judge(found[0], _BLIND)

    def search(self, starts: Iterable[Agreement], rng: np.random.Generator) -> Agreement:
        """Climb from what five of the matches that agree with a start lead to.

        Where F agrees sharply, E is judged by the matches near it, too, if it agrees as sharply.
        """
        starts = list(starts)
        best = self._searched(starts)
        sharpest = min(start.sigma for start in starts)
        if best.extent < RANGE and best.sigma > _BLUNTER * sharpest:
            best = self._searched([self.judge(a.F, a.sigma, a.share) for a in starts])
        return self._in_front(best)

    def _in_front(self, best: Agreement) -> Agreement:
        """Return an agreement, or that of the other motion of a plane if its points are in front.

        Both motions of a plane agree alike but for noise and for wrong matches.
        """
        pool = best.inliers(3.0 * best.sigma)
        near, doubt = np.count_nonzero(pool), self._doubt(best)
        if near < Essential.dimension or doubt <= _DOUBT * max(_BEHIND * near, 1.0):
            return best
        own = self.cameras.some(pool)
        H, _ = robust_homography(own.q1, own.q2, np.ones(near), self.criterion.kernels)
        for E in essentials(np.asarray(np.linalg.solve(own.A2, H @ own.A1))):
            known = best.sigma, best.share, best.extent, best.about
            other = self.climb(self.judge(self.cameras.fundamental(E), *known))
            as_many = np.count_nonzero(other.inliers(3.0 * other.sigma)) >= _AS_MANY * near
            if as_many and (less := self._doubt(other)) < doubt:
                best, doubt = other, less
        return best

    def _doubt(self, found: Agreement) -> float:
        """Return what speaks against the matches that agree being of points in front."""
        rows = found.inliers(3.0 * found.sigma)
        own, squared = self.cameras.some(rows), found.signed[rows] ** 2
        hats = own.q1, own.q2  # distances from the ends differ little from those of corrected ones
        return float(
            own.motion(found.F, hats, squared, np.ones(len(squared)), found.sigma**2).doubt
        )

    def _searched(self, starts: list[Agreement]) -> Agreement:
        ranked = sorted(starts, key=lambda start: -start.score)[:_POOLS]
        pools = [(start, start.inliers(3.0 * start.sigma)) for start in ranked]
        pools.append((ranked[0], np.ones(self.cameras.q1.shape[1], dtype=np.bool_)))
        best = max((a for pool in pools for a in self._from(*pool)), key=_worth)
        for _ in range(_ROUNDS):
            found = max(self._from(best, best.inliers(3.0 * best.sigma)), key=_worth)
            if _worth(found) <= _worth(best) + _CLIMBED:
                break
            best = found
        return best

    def _from(self, start: Agreement, pool: NDArray[np.bool_]) -> list[Agreement]:
        """Return agreements climbed to from subsets of a pool, and from the start itself."""
        known = start.sigma, start.share, start.extent, start.about
        essential = self.judge(self.nearest(start.F), *known)
        begun = [essential]
        if np.count_nonzero(pool) >= Essential.dimension:
            some = self.cameras.some(pool)
            candidates = essential_starts(some, np.ones(some.q1.shape[1]), _EACH, robust=True)
            begun += [self.judge(F, *known) for F in candidates]
        begun.sort(key=lambda agreement: -_worth(agreement))
        return [self.climb(agreement) for agreement in begun[:_CLIMBERS]]

    def nearest(self, F: Array) -> Array:
        """Return the essential matrix nearest to an F, in the coordinates of the matches."""
        return self.chart.fundamental(self.chart.start(F))


def _worth(found: Agreement) -> float:
    """Return what agreements of one extent are compared by.

    Where F is sharp, that is how sharply the matches agree, as in the search for F. The likelihood
    of all noises prefers an E of repeated structure that many agree with bluntly.
    """
    if found.extent >= RANGE:
        return found.score
    scale2 = SCALES[0] ** 2
    squared = found.signed[found.oriented] ** 2
    return float(np.sum(np.log1p(scale2 / (squared + FLOOR * scale2))))
