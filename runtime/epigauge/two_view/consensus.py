"""The epipolar geometry that most matches agree on, among matches with gross errors.

The exact distances of right matches are normal with an unknown standard deviation, those of wrong
ones uniform over the image, and the share of right ones is unknown too: the likelihood of all
matches under this mixture says how good a geometry is, without any threshold. It has many local
maxima; they are climbed from starts that subsets of the right matches give.

Wrong matches that a matcher has left are not uniform, though: many are a little beside the right
point. One normal distribution then takes right and wrong ones for right ones of much noise. A part
of the wrong matches may therefore be normal about the epipolar lines, too, but wide.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.kernels import Table
from epigauge.linear import Levenberg
from epigauge.two_view import mixture_native, native
from epigauge.two_view.chance import CEILING, chance_agreement, log10_false_alarms
from epigauge.two_view.conditioning import RMS
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.eliminated import EliminatedProblem
from epigauge.two_view.losses import Loss, robust_scale
from epigauge.two_view.mixture import Mixture
from epigauge.two_view.parameterizations import Block, Parameterization

__all__ = ["RANGE", "WIDEST", "Agreement", "Consensus", "narrowed"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Range of a uniform coordinate with the RMS of conditioned ones.
RANGE = 12.0**0.5 * RMS

#: Largest distance of an inlier that is chosen without the caller, as a share of the range: 30 px
#: in an image of 1000. It is twice that within which agreement of raw matches tells them from wrong
#: ones (`chance.CEILING`): a limit there cuts the noise of blunt matches off, and bends F.
WIDEST = 0.03

#: Standard deviation of the noise, conditioned, below which distances are rounding.
_FLOOR = 1e-12

#: Wrong matches about the epipolar lines are spread at least so many times as far as right ones:
#: the tails of these are not taken for them.
_HALO = 6.0

#: They are believed where that gains so much of the logarithm of the likelihood, what is left is
#: sharper by a factor, and a good part of those about: a few of many normal distances always are
#: sharp.
_WORTH, _SHARPER, _PART = 5.0, 0.5, 0.25

#: The share of right matches stays inside these.
_SHARES = (0.02, 0.999)

#: Climbing ends when the logarithm of the likelihood grows by less; one is a standard deviation.
_CLIMBED = 1e-3
_CLIMBS = 20

#: Fits while the inliers settle, at most.
_SETTLES = 20

#: Of a fit while climbing, or settling.
_STOPPING = lm.Stopping(ftol=1e-6, max_iter=10)

#: Subsets drawn a round, by their size, how many of the best are climbed, and rounds at most.
_SIZES = (8, 12, 20, 40)
_SUBSETS = 75
_CLIMBERS = 5
_ROUNDS = 5

#: With a noise of no more than this share of the range (2.5 px in an image of 1000), and so many
#: right matches, the likelihood has no other maximum that subsets of the right ones lead to.
_NARROW, _PLENTY = 0.0025, 50

#: Where more agreements as good are expected by chance than 10 to this, there are hardly right
#: matches to draw subsets from: what they lead to is climbed from only if it is better as it is.
_HOPELESS = 8.0

#: Without a start: so many times the subsets of the smallest size, of which one in 256 is clean
#: with half of the matches right; the matches they are drawn from and judged by, enough to tell
#: such a half; and the noise they are judged with, as shares of the range.
_BLIND = 12
_BLIND_FEW = 500
_SIGMAS = (0.0003, 0.001, 0.003)

#: What is found without a start is better by at least this logarithm of the likelihood: F of least
#: squares with Gaussian noise is at the maximum already.
_HIGHER = 5.0

#: Subsets are drawn from, and judged by, about this many matches.
_FEW = 2000


@dataclass(frozen=True)
class Agreement:
    """A geometry and how well the matches agree with it, in conditioned coordinates.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    signed : ndarray, shape (m,)
        Exact distances.
    oriented : ndarray of bool, shape (m,)
        Whether a match can lie in front of both cameras, as most do.
    sigma : float
        Standard deviation of the distances of right matches.
    share : float
        Share of right matches.
    score : float
        Logarithm of the likelihood, less what any seven matches gain by fitting exactly.
    extent : float
        Largest distance that counts: wrong matches are uniform up to it.
    near, spread : float
        Share of wrong matches about the epipolar lines, and standard deviation of their distances.
    """

    F: Array
    signed: Array
    oriented: Mask
    sigma: float
    share: float
    score: float
    extent: float = RANGE
    near: float = 0.0
    spread: float = 1.0

    @property
    def mixture(self) -> Mixture:
        """Return the density of the distances."""
        return Mixture(self.sigma, self.share, self.extent, self.near, self.spread)

    @property
    def about(self) -> tuple[float, float]:
        """Return what is known of the wrong matches about the epipolar lines."""
        return self.near, self.spread

    def inliers(self, limit: float) -> Mask:
        """Return which matches are oriented and within a distance."""
        return np.asarray(self.oriented & (np.abs(self.signed) <= limit))


class Consensus:
    """Search for the best agreement of given matches.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches.
    widest : float
        Largest standard deviation of the noise of right matches.
    """

    def __init__(
        self, kernels: Table, q1: Array, q2: Array, widest: float = WIDEST * RANGE / 3.0
    ) -> None:
        self.widest = widest
        self.criterion = Reprojection(kernels, q1, q2)
        self.chart: Parameterization = Block(kernels)
        ones = np.ones((1, q1.shape[1]))
        self.h1, self.h2 = np.vstack([q1, ones]), np.vstack([q2, ones])
        self.few = slice(None, None, -(-q1.shape[1] // _FEW))

    @cached_property
    def products(self) -> Array:
        """Coefficients (9, few) of the equations of the few matches by vect(F)."""
        return (self.h2[:, None, self.few] * self.h1[None, :, self.few]).reshape(9, -1)

    def judge(
        self,
        F: Array,
        sigma: float,
        share: float = 0.5,
        extent: float = RANGE,
        about: tuple[float, float] = (0.0, 1.0),
    ) -> Agreement:
        """Return the agreement with F, sigma and share being fitted from the values given.

        Scores are to be compared for one extent only. A small one sees no more of the wrong matches
        than how dense they are beside the epipolar lines. For all of them, `about` says so: the
        share of wrong matches that are near these and how far they are spread, to fit from; none by
        default.
        """
        near, spread = about
        if self.criterion.kernels.compiled:
            fitted = sigma, share, near, spread
            return _agreement(
                mixture_native.judge(*self._q, F, fitted, self._options(extent)), extent
            )
        signed, oriented = self.measured(F)
        there = np.abs(signed) < 1.0 / _FLOOR
        within = np.abs(signed) <= extent if extent < RANGE else np.ones(len(signed), np.bool_)
        squared, counts = np.where(there, signed, 0.0)[within] ** 2, oriented[within]
        best = None
        while True:
            mixture = Mixture(sigma, share, extent, near, spread)
            total, right, halo = mixture.parts(squared)
            logs = np.log(np.where(counts, total, mixture.odds))
            score = float(np.sum(logs)) - 7.0 * float(np.log(extent / sigma))
            # An F that has no distances (NaN) climbs no further.
            if best is not None and not score > best.score + _CLIMBED:
                return best
            best = Agreement(F, signed, oriented, sigma, share, score, extent, near, spread)
            right, halo = (np.where(counts, part / total, 0.0) for part in (right, halo))
            count, around, every = float(np.sum(right)), float(np.sum(halo)), max(len(squared), 1)
            share = float(np.clip(count / every, *_SHARES))
            # The seven parameters of F absorb seven squares of the noise
            variance = np.sum(right * squared) / max(count - 7.0, 1.0)
            sigma = min(max(float(np.sqrt(variance)), _FLOOR), self.widest)
            if near:
                near = min(around / every, _SHARES[1] - share)
                widths = np.sum(halo * squared) / max(around, 1e-300)
                spread = max(float(np.sqrt(widths)), _HALO * sigma)

    def heavier(self, own: Agreement, others: Iterable[Agreement]) -> Agreement:
        """Return the best agreement with wrong matches about the epipolar lines, if it is better.

        Climbed to from the geometries of all agreements, the first of which is best without these.
        """
        starts = []
        for one in (own, *others):
            spread = max(float(np.sqrt(one.sigma * RANGE)), _HALO * one.sigma)
            about = 0.5 * (1.0 - one.share), spread
            starts.append(self.judge(one.F, one.sigma, one.share, about=about))
        climbed = (a for a in map(self.climb, starts) if a.share > _PART * a.near)
        sharp = (a for a in climbed if a.sigma < _SHARPER * own.sigma)
        best = max(sharp, key=_score, default=own)
        return best if best.score > own.score + _WORTH else own

    def measured(self, F: Array) -> tuple[Array, Mask]:
        """Return exact distances, and which matches can lie in front of both cameras."""
        if self.criterion.kernels.compiled:
            return mixture_native.judge(*self._q, F, None, self._options(RANGE))[1:3]
        signed, oriented = self.criterion.evaluate(F).signed, self.oriented(F)
        # A match without a distance (beside a degenerate F) agrees with nothing.
        return signed, np.asarray(oriented & (np.abs(signed) < 1.0 / _FLOOR))

    def climb(self, start: Agreement) -> Agreement:
        """Maximise the likelihood over F, sigma and share in turns.

        F by least squares, each match weighing as it is probably right: expectation maximisation.
        """
        if self.criterion.kernels.compiled and isinstance(self.chart, Block):
            known = mixture_native.Judged(*(getattr(start, name) for name in _JUDGED))
            found = mixture_native.climb(*self._q, known, self._options(RANGE))
            return start if found.score == start.score else _agreement(found, RANGE)
        best = start
        for _ in range(_CLIMBS):
            squared = np.where(best.oriented, best.signed, 0.0) ** 2
            right = np.where(best.oriented, best.mixture.right(squared), 0.0)
            F = self.fitted(best.F, right)
            trial = self.judge(F, best.sigma, best.share, best.extent, best.about)
            if not trial.score > best.score + _CLIMBED:
                break
            best = trial
        return best

    def settle(
        self, found: Agreement, weights: Array, limit: float, deviations: float, least: int
    ) -> tuple[Agreement, float, int]:
        """Fit F to the inliers of some weight until these stand still.

        Their largest distance falls to so many standard deviations of the noise, unless that is 0.
        Returns the agreement, that distance, and how many fits it took: none where fewer agree than
        are needed.
        """
        if self.criterion.kernels.compiled and isinstance(self.chart, Block):
            start = np.ascontiguousarray(found.F), found.signed, found.oriented
            choices = deviations, least, _SETTLES
            (F, signed, oriented), limit, fits = mixture_native.settle(
                *(*self._q, weights, start, limit, choices), self._options(RANGE)
            )
            return replace(found, F=F, signed=signed, oriented=oriented), limit, fits
        before = np.zeros(len(weights), np.bool_)
        for fits in range(_SETTLES):
            inlier = found.inliers(limit) & (weights > 0.0)
            if np.array_equal(inlier, before) or np.count_nonzero(inlier) < least:
                return found, limit, fits
            before, F = inlier, self.fitted(found.F, np.where(inlier, weights, 0.0))
            signed, oriented = self.measured(F)
            found = replace(found, F=F, signed=signed, oriented=oriented)
            if deviations:
                limit = narrowed(limit, deviations, signed[inlier])
        return found, limit, _SETTLES

    def fitted(self, F: Array, weights: Array) -> Array:
        """Return the geometry of least squares near one."""
        start, criterion = self.chart.start(F), self.criterion
        if criterion.kernels.compiled:
            choices = ("reprojection", "linear", "levenberg", True)
            matches = (criterion.q1, criterion.q2, weights)
            fitted = native.minimize(self.chart, start, matches, choices, 1.0, _STOPPING, 1.0)
            return np.asarray(fitted.state.F)
        problem = EliminatedProblem(criterion, self.chart, weights, Loss("linear"), exact=True)
        found = lm.minimize(problem, start, Levenberg(), lm.Classic(), _STOPPING)
        return np.asarray(found.state.F)

    @property
    def _q(self) -> tuple[Array, Array]:
        return self.criterion.q1, self.criterion.q2

    def _options(self, extent: float) -> mixture_native.MixtureOptions:
        numbers = (extent, RANGE, self.widest, _FLOOR, *_SHARES, _HALO, _CLIMBED, _STOPPING.ftol)
        return mixture_native.MixtureOptions(*numbers, _CLIMBS, _STOPPING.max_iter)

    def search(self, starts: Iterable[Agreement], rng: np.random.Generator) -> Agreement:
        """Climb from the starts, and from what subsets of the right matches lead to."""
        best = max(map(self.climb, starts), key=_score)
        plain = best.sigma <= _NARROW * RANGE and best.share * len(best.signed) >= _PLENTY
        for _ in range(0 if plain else _ROUNDS):
            pool = np.flatnonzero(best.inliers(3.0 * best.sigma)[self.few])
            if len(pool) <= _SIZES[0]:
                break
            promising = self.promising(self.subset_fits(pool, rng), best)
            starts = [self.judge(F, best.sigma, best.share) for F in promising]
            if self._is_hopeless(best):
                starts = [start for start in starts if start.score > best.score]
            highest = max(map(self.climb, starts), key=_score, default=best)
            if highest.score <= best.score + _CLIMBED:
                break
            best = highest
        return best

    def _is_hopeless(self, found: Agreement) -> bool:
        """Tell whether an agreement is by far no better than those of wrong matches."""
        limit = min(found.mixture.even, CEILING * RANGE)
        agreed = int(np.count_nonzero(found.inliers(limit)))
        criterion = self.criterion
        chance = chance_agreement(criterion.kernels, found.F, criterion.q1, criterion.q2, limit)
        return log10_false_alarms(len(found.signed), agreed, chance) > _HOPELESS

    def better(self, own: Agreement, rng: np.random.Generator) -> Agreement:
        """Search without a front end: from subsets of all matches, if they lead above an agreement.

        Returns the agreement itself where they do not.
        """
        step = -(-len(own.signed) // _BLIND_FEW)
        criterion = self.criterion
        thin = Consensus(
            criterion.kernels,
            np.ascontiguousarray(criterion.q1[:, ::step]),
            np.ascontiguousarray(criterion.q2[:, ::step]),
            self.widest,
        )
        pool = np.arange(thin.products.shape[1])
        fits = thin.subset_fits(pool, rng, _SIZES[:1] * _BLIND)
        squared = thin.sampson(fits)
        found = own
        for sigma in _SIGMAS:
            guess = replace(own, sigma=sigma * RANGE, share=0.5)
            trial = self.judge(thin.promising(fits, guess, squared)[0], guess.sigma)
            found = max(found, trial, key=_score)
        return own if found.score <= own.score + _HIGHER else self.search([found], rng)

    def subset_fits(
        self, pool: NDArray[np.intp], rng: np.random.Generator, sizes: tuple[int, ...] = _SIZES
    ) -> Array:
        """Return 8-point estimates from random subsets of a pool of the few, shape (k, 3, 3)."""
        weights = np.zeros((_SUBSETS * len(sizes), self.products.shape[1]))
        for k, size in enumerate(sizes):
            order = np.argsort(rng.random((_SUBSETS, len(pool))), axis=1)[:, :size]
            rows = weights[k * _SUBSETS : (k + 1) * _SUBSETS]
            np.put_along_axis(rows, pool[order], 1.0, axis=1)
        return self.linear_fits(weights)

    def linear_fits(self, weights: Array) -> Array:
        """Return the 8-point estimate for each row of weights."""
        outer = (self.products[:, None] * self.products[None]).reshape(81, -1)
        N = (weights @ outer.T).reshape(-1, 9, 9)
        U, values, Vt = np.linalg.svd(np.linalg.eigh(N)[1][:, :, 0].reshape(-1, 3, 3))
        return np.asarray((U[:, :, :2] * values[:, None, :2]) @ Vt[:, :2])

    def promising(self, F: Array, best: Agreement, squared: Array | None = None) -> Array:
        """Return the few of many geometries that lead highest, after refits to their inliers.

        Their squared distances (k, few) are computed unless they are given.
        """
        mixture = best.mixture
        for keep in (len(F) // 4, len(F) // 10, _CLIMBERS):
            squared = self.sampson(F) if squared is None else squared
            order = np.argsort(-np.sum(mixture.logarithm(squared), axis=1))[:keep]
            F = F[order]
            if keep > _CLIMBERS:
                F, squared = self.linear_fits(mixture.right(squared[order])), None
        return F

    def sampson(self, F: Array) -> Array:
        """Return squared Sampson distances of the few matches to many F, shape (k, few)."""
        line2 = F.reshape(-1, 3) @ self.h1[:, self.few]
        line1 = np.swapaxes(F, 1, 2).reshape(-1, 3) @ self.h2[:, self.few]
        line1, line2 = line1.reshape(len(F), 3, -1), line2.reshape(len(F), 3, -1)
        C = F.reshape(-1, 9) @ self.products
        length2 = np.sum(line1[:, :2] ** 2, axis=1) + np.sum(line2[:, :2] ** 2, axis=1)
        return np.asarray(C**2 / np.maximum(length2, 1e-300))

    def oriented(self, F: Array) -> Mask:
        """Return which matches satisfy the oriented epipolar constraint with the sign most have."""
        epipole = np.linalg.svd(F)[0][:, 2]
        line = F @ self.h1
        # (e' x q') . (F q)
        sign = np.sum(np.cross(epipole, self.h2, axisb=0, axisc=0) * line, axis=0)
        return np.asarray(sign > 0.0 if np.sum(np.sign(sign)) >= 0.0 else sign < 0.0)


def narrowed(limit: float, deviations: float, signed: Array) -> float:
    """Return the largest distance of an inlier, fallen to so many standard deviations of theirs."""
    return min(limit, max(deviations * robust_scale(signed), 1e-9))


#: Fields of an agreement that the compiled code knows, in its order.
_JUDGED = mixture_native.Judged._fields


def _agreement(judged: mixture_native.Judged, extent: float) -> Agreement:
    return Agreement(*judged[:6], extent, *judged[6:])


def _score(agreement: Agreement) -> float:
    return agreement.score
