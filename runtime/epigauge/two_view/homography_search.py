"""The homography that most raw matches agree on, from samples of four matches.

As in the search for F, a sample is judged by all matches without a threshold, the best is fitted to
the matches around, and the noise and the share of right matches follow from the likelihood of the
distances: those of right matches have two normal coordinates, wrong matches are uniform.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_count, as_matches, as_positive, as_score
from epigauge._logged import logged
from epigauge._options import HomographyOptions, known_options
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.two_view.chance import CEILING, SIGNIFICANT, chance_on_plane, log10_false_alarms
from epigauge.two_view.collinear import is_plane_left_open
from epigauge.two_view.conditioning import condition_raw
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.copies import earliest
from epigauge.two_view.evidence import ROUNDING
from epigauge.two_view.homography import fit_homography, plane_squares
from epigauge.two_view.homography_problem import PARAMETERS
from epigauge.two_view.homography_refine import (
    DEVIATIONS,
    LEAST,
    refine_homography,
    with_flags,
)
from epigauge.two_view.homography_result import HomographyResult
from epigauge.two_view.neighbours import ranked
from epigauge.two_view.robust_fit import of_matches
from epigauge.two_view.search import SCALES

__all__ = ["PlaneMixture", "estimate_homography"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

#: Samples at least and at most, a batch of them, and how many times more than give one clean one.
_LEAST, _MOST, _BATCH, _PATIENCE = 256, 8192, 64, 20.0

#: Matches that judge all samples of a batch, and samples that all matches judge.
_JUDGES, _FINALISTS = 192, 6

#: Shares of the matches, best first, that samples are drawn from in turns.
_POOLS = (1.0, 0.5, 0.25, 0.125)

#: Widths of the fits around a sample in scales, and the part of the scale that is rounding.
_WIDTHS, _FLOOR = (8.0, 3.0, 1.5), 0.01

#: What is left of the variance within `DEVIATIONS`, which 99.9 % of right matches are within.
_KEPT = 1.0 - math.log(1000.0) / 999.0

#: Of fewer matches a sharp score sees no more than the samples that fit best by chance: they are
#: judged by their likelihood, with the eight parameters counted. Least deviation, conditioned.
_FEW, _SHARPEST = 64, 1e-9

#: Steps of the maximisation of the likelihood, and rounds of inliers at most.
_STEPS, _ROUNDS = 30, 10

#: Another plane is named where so many times the matches agree on it.
_AS_MANY = 0.5

#: Numbers of nearest matches, about, that are tried for a sharper plane.
_CORES = 16


@dataclass(frozen=True)
class PlaneMixture:
    """Density of the distances to a homography: right matches and wrong ones.

    Attributes
    ----------
    sigma : float
        Standard deviation of a coordinate.
    share : float
        Share of right matches.
    logarithm : float
        Logarithm of the likelihood of all matches.
    """

    sigma: float
    share: float
    logarithm: float

    @property
    def even(self) -> float:
        """Return the distance at which right and wrong are as likely; 0 where there is none."""
        peak = self.share / (2.0 * math.pi * self.sigma**2)
        odds = peak * RANGE**2 / max(1.0 - self.share, 1e-12)
        return self.sigma * math.sqrt(max(2.0 * math.log(max(odds, 1e-300)), 0.0))

    @staticmethod
    def of(squared: Array, sigma: float, *, parameters: int = PARAMETERS) -> PlaneMixture:
        """Return the mixture of highest likelihood, by expectation and maximisation."""
        share, m = 0.5, len(squared)
        widest = CEILING * RANGE / 3.0
        squared = np.minimum(squared, RANGE**2)
        for step in range(_STEPS + 1):
            right = share / (2.0 * math.pi * sigma**2) * np.exp(-0.5 * squared / sigma**2)
            total = right + (1.0 - share) / RANGE**2
            if step == _STEPS:
                break
            p = right / total
            weight = max(float(np.sum(p)), 1e-12)
            # Parameters absorb squares: four matches fit exactly and say nothing of the noise
            free = max(2.0 * weight - parameters, 1.0)
            sigma = min(max(math.sqrt(float(p @ squared) / free), 1e-12), widest)
            share = min(max(weight / m, 1e-3), 0.999)
        return PlaneMixture(sigma, share, float(np.sum(np.log(total))))


@logged
def estimate_homography(
    x1: ArrayLike,
    x2: ArrayLike,
    *,
    threshold_px: float | Literal["auto"] = "auto",
    score: ArrayLike | None = None,
    seed: int = 0,
    **options: Unpack[HomographyOptions],
) -> HomographyResult:
    """Find the homography of raw matches, gross errors and points off the plane among them.

    Samples of four matches give starts; the best by all matches is fitted to the matches around.
    The noise and the share of right matches follow from its distances, and `refine_homography` fits
    the inliers until they stand still.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least four different matches in pixels; exact duplicates count once.
    threshold_px : float or "auto"
        Largest distance of an inlier. "auto" takes what 99.9 % of right matches are within, but no
        more than where a match is as likely right as wrong.
    score : array_like, shape (m,), optional
        How promising each match is, the highest first; by default, matches are ranked by whether
        their neighbours move alike.
    seed : int
        Of everything random: one seed, one answer.
    **options
        Of `refine_homography`, but for `H0`; `weights` and covariances are those of all matches.

    Returns
    -------
    HomographyResult
        As `refine_homography`, with the inliers. The flag "no common geometry" says that no more
        matches agree than wrong ones would by chance; "undetermined" that all which agree are in
        one place or on one line of an image, and H, that of all matches, means nothing; "several
        planes" that half as many others agree on another homography, or some of them far better.

    Raises
    ------
    ArgumentError
        On bad arguments.

    Examples
    --------
    >>> import numpy as np
    >>> import epigauge as eg
    >>> rng = np.random.default_rng(0)
    >>> x1 = rng.uniform(0.0, 1000.0, (100, 2))
    >>> x2 = x1 @ [[0.9, -0.2], [0.2, 0.9]] + [30.0, -5.0] + 0.3 * rng.standard_normal((100, 2))
    >>> x2[::3] = rng.uniform(0.0, 1000.0, (34, 2))  # every third match is wrong
    >>> H, inlier = eg.estimate_homography(x1, x2)
    >>> bool(inlier[::3].any()), int(np.count_nonzero(inlier))
    (False, 66)
    """
    known = known_options("estimate_homography", options, HomographyOptions, ("H0",))
    if "H0" in known:
        raise ArgumentError("H0", "is given", "refine_homography, which starts from it")
    x1, x2 = as_matches(x1, x2, at_least=LEAST, general_position=True)
    seed = as_count("seed", seed, at_least=0)
    threshold = None if threshold_px == "auto" else as_positive("threshold_px", threshold_px)
    promise = None if score is None else as_score(score, len(x1))
    first = earliest(x1, x2)
    rows = np.flatnonzero(first == np.arange(len(x1)))
    if len(rows) < LEAST:
        raise ArgumentError("x1, x2", f"hold {len(rows)} different matches", "at least 4")
    copies = np.searchsorted(rows, first)
    y1, y2 = x1[rows], x2[rows]
    frame, is_near = condition_raw(y1, y2, LEAST)
    table, (q1, q2) = kernels.table(known.get("backend")), frame.forward(y1, y2)
    order = _in_any_order(q1, q2)
    if promise is None:
        order = order[ranked(table, *(np.ascontiguousarray(q[:, order]) for q in (q1, q2)))]
    else:
        order = order[np.argsort(-promise[rows[order]], kind="stable")]
    H = sharp = _searched(table, q1, q2, order, np.random.default_rng(seed))
    mixture = PlaneMixture.of(plane_squares(table, H, q1, q2), SCALES[0])
    result, limit = None, 0.0
    tried: set[bytes] = set()
    is_open = False
    for _ in range(_ROUNDS):
        squared = plane_squares(table, H, q1, q2)
        mixture = PlaneMixture.of(squared, mixture.sigma)
        limit = min(mixture.even, DEVIATIONS * mixture.sigma, CEILING * RANGE)
        limit = max(limit, ROUNDING) if threshold is None else threshold / frame.scale
        inlier = (squared <= limit**2) & is_near
        if np.count_nonzero(inlier) < LEAST:
            inlier = np.zeros(len(rows), np.bool_)
            away = np.where(is_near, squared, np.inf)
            inlier[np.argsort(away, kind="stable")[:LEAST]] = True
        if is_open or inlier.tobytes() in tried:
            break
        tried.add(inlier.tobytes())
        H0: Array | None = frame.homography_to_pixels(H)
        used = inlier
        while True:
            chosen = of_matches(known, len(x1), rows[used])
            try:
                result = refine_homography(y1[used], y2[used], H0, **chosen)
                break
            except ArgumentError as error:
                if is_open or error.argument not in ("x1", "x2", "H0"):
                    raise
            # All that agree are in one place or on one line, and leave H open: fitted to all
            used, H0, is_open = is_near, None, True
        H = frame.homography_from_pixels(result.H)
    assert result is not None
    bound = min(limit, CEILING * RANGE)  # within more, wrong matches agree, too
    agreed = int(np.count_nonzero(plane_squares(table, H, q1, q2)[used] <= bound**2))
    chance = chance_on_plane(table, H, q1, q2, bound)
    alarms = log10_false_alarms(len(rows), agreed, chance, LEAST)
    is_left_open = is_open or is_plane_left_open(table, H, q1, q2, used, bound)
    squared = plane_squares(table, H, q1, q2)
    rest = is_near & (squared > bound**2)
    among = (np.cumsum(rest) - 1)[order[rest[order]]]
    r1, r2 = (np.ascontiguousarray(q[:, rest]) for q in (q1, q2))
    sharper = plane_squares(table, sharp, q1, q2)
    is_one_of_several = _is_between_planes(
        sharper[used], squared[used], mixture.sigma
    ) or _has_another(table, r1, r2, among, agreed, bound, seed)
    told = {
        "no common geometry": alarms > SIGNIFICANT,
        "undetermined": is_left_open,
        "several planes": is_one_of_several and alarms <= SIGNIFICANT,
    }
    if threshold is None and known.get("noise_px") is None and np.isfinite(result.noise_px):
        tails = 1.0 / math.sqrt(_KEPT)  # the threshold has cut them off
        result = replace(
            result, noise_px=result.noise_px * tails, covariance=result.covariance * tails**2
        )
    agrees = (inlier if is_open else used)[copies]
    result = replace(result, inlier=agrees, used=rows[used], threshold_px=limit * frame.scale)
    return with_flags(result, tuple(name for name, raised in told.items() if raised))


def _agreements(squared: Array) -> Array:
    """Return the scores of homographies by squared distances (k, m).

    As that of F, a mixture of all noises; of few matches, the likelihood.
    """
    if squared.shape[1] <= _FEW:
        return _likelihoods(squared)
    scale2 = SCALES[0] ** 2
    return np.asarray(np.sum(np.log1p(scale2 / (squared + _FLOOR * scale2)), axis=1))


def _likelihoods(squared: Array) -> Array:
    """Return logarithms of likelihoods of squared distances (k, m), less what four matches gain.

    The best number of right matches is taken: n of them, nearest first, have the variance
    sum / (2 n - 8), and their share is n / m.
    """
    m = squared.shape[1]
    n = np.arange(LEAST + 1, m + 1)
    with np.errstate(over="ignore"):
        sums = np.cumsum(np.sort(np.minimum(squared, RANGE**2), axis=1), axis=1)[:, LEAST:]
    free = 2.0 * (n - LEAST)
    sigma = np.maximum(np.sqrt(sums / free), _SHARPEST)
    mixing = n * np.log(n / m) + (m - n) * np.log(np.maximum(m - n, 1) / m)
    logs = free * np.log(RANGE / sigma) - n * math.log(2.0 * math.pi) - 0.5 * free + mixing
    return np.asarray(np.max(logs, axis=1, initial=-np.inf))


def _in_any_order(q1: Array, q2: Array) -> Rows:
    """Return the rows of different matches mixed, the same whatever order they are given in."""
    by_place = np.lexsort((*q1, *q2))
    return np.asarray(by_place[np.random.default_rng(0).permutation(len(by_place))])


def _has_another(
    table: Table, q1: Array, q2: Array, order: Rows, agreed: int, bound: float, seed: int
) -> bool:
    """Tell whether other matches agree on a plane of their own, nearly as many as on the best."""
    m, enough = q1.shape[1], max(math.ceil(_AS_MANY * agreed), LEAST + 1)
    if m < enough:
        return False
    most = _PATIENCE * (m / enough) ** 4
    H = _searched(table, q1, q2, order, np.random.default_rng(seed), most)
    count = int(np.count_nonzero(plane_squares(table, H, q1, q2) <= bound**2))
    chance = chance_on_plane(table, H, q1, q2, bound)
    return count >= enough and log10_false_alarms(m, count, chance, LEAST) <= SIGNIFICANT


def _is_between_planes(sharp: Array, squares: Array, sigma: float) -> bool:
    """Tell whether some of the matches that agree do so far better with another homography.

    With normal noise as many would be as near to one homography by an accident: what lies between
    planes takes their distances for noise. Where they are as near to the one found, the noise has
    heavy tails.
    """
    n = len(sharp)
    nearest, own = np.sort(sharp), np.sort(squares)
    for k in range(LEAST + 1, n + 1, max(n // _CORES, 1)):
        chance = -math.expm1(-0.5 * float(nearest[k - 1]) / sigma**2)
        if (
            log10_false_alarms(n, k, chance, LEAST) <= SIGNIFICANT
            and np.searchsorted(own, nearest[k - 1], "right") <= _AS_MANY * k
        ):
            return True
    return False


def _searched(
    table: Table,
    q1: Array,
    q2: Array,
    order: Rows,
    rng: np.random.Generator,
    most: float = _MOST,
) -> Array:
    """Return the best homography of samples, fitted to the matches around."""
    m = q1.shape[1]
    judges = order[
        np.arange(min(m, _JUDGES)) * max((m + 1) // 2, min(m, _JUDGES)) // min(m, _JUDGES)
    ]
    j1, j2 = (np.ascontiguousarray(q[:, judges]) for q in (q1, q2))
    pool = np.maximum(min(8, m), np.resize(_POOLS, _BATCH) * m).astype(int)
    best, highest, done, needed = np.eye(3) / 3.0**0.5, -np.inf, 0, min(most, _MOST)
    while done < needed:
        rows = order[(rng.random((_BATCH, 4)) * pool[:, None]).astype(int)]
        samples = (np.ascontiguousarray(q[:, rows].transpose(0, 2, 1)) for q in (q1, q2))
        with np.errstate(all="ignore"):
            H, votes = table.four_points(*samples)
            H = H.transpose(2, 0, 1)
            size = np.linalg.norm(H, axis=(1, 2))
            good = (np.abs(votes) == 4.0) & np.isfinite(size) & (size > 1e-12)
            candidates = H[good] / size[good, None, None]
        done += _BATCH
        if not len(candidates):
            continue
        first = _agreements(np.array([plane_squares(table, one, j1, j2) for one in candidates]))
        finalists = candidates[np.argsort(-first, kind="stable")[:_FINALISTS]]
        scores = _agreements(np.array([plane_squares(table, one, q1, q2) for one in finalists]))
        if np.max(scores) <= highest:
            continue
        highest = float(np.max(scores))
        best, fitted = _improved(table, finalists[int(np.argmax(scores))], q1, q2, best)
        near = np.count_nonzero(plane_squares(table, best, q1, q2) <= (3.0 * SCALES[0]) ** 2)
        needed = min(max(_PATIENCE * (m / max(near, 4.0)) ** 4, _LEAST), most, _MOST)
        highest = max(highest, fitted)
    return np.asarray(best)


def _improved(table: Table, H: Array, q1: Array, q2: Array, before: Array) -> tuple[Array, float]:
    """Fit to the matches around, wide first and then narrow; return the best, and its score."""
    found = [before, H]
    for width in SCALES[0] * np.array(_WIDTHS):
        weights = np.exp(-0.5 * np.minimum(plane_squares(table, H, q1, q2) / width**2, 100.0))
        if np.count_nonzero(weights > 0.1) < LEAST:
            break
        H = fit_homography(q1, q2, weights, table)[0]
        found.append(H)
    scores = _agreements(np.array([plane_squares(table, one, q1, q2) for one in found]))
    return np.asarray(found[int(np.argmax(scores))]), float(np.max(scores))
