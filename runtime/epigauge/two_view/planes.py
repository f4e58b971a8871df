"""How well simpler models than F explain matches: a homography, no motion, an affine camera.

Every motion F and a vector v make a homography [e']_x F + e' v^T, the one of a plane: off it, a
match moves along its epipolar line. Which share of the matches a plane explains is therefore told
by three numbers a plane, without a fit; only where that share is large, homographies are fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.chance import (
    chance_agreement,
    chances_off_plane,
    log10_false_alarms,
)
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.evidence import ROUNDING, Evidence
from epigauge.two_view.homography import fit_homography, robust_homography

__all__ = [
    "BESIDE",
    "EPIPOLE",
    "FAR_OFF",
    "GROWS",
    "HALF_ON",
    "HIDDEN",
    "MOST_ON",
    "NO_RELIEF",
    "OFF_PLANE",
    "PLAINLY",
    "PLENTY",
    "POOL",
    "REACH",
    "RELIEF",
    "SAMPLES",
    "OnPlane",
    "Planes",
    "affine_cost",
    "chance_pairs",
    "displacement",
    "is_plain_relief",
    "judge_plane",
    "on_a_plane",
    "share_on_a_plane",
    "threes",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Distance from a homography, in standard deviations of the noise, beyond which a match is off the
#: plane for Gaussian noise (one right match in a hundred thousand), and for real noise, which has
#: heavy tails, is correlated, and has the relief of a facade beside it.
OFF_PLANE = 5.0
FAR_OFF = 8.0

#: A plane that most are on is found by threes of the matches, judged by at most so many of them,
#: within this distance in standard deviations: farther than `FAR_OFF`, since three points fix a
#: plane less well than all do. So many times it is fitted to those that are: three of a strip reach
#: little of it at first. Where it then has less than this share, no plane has most; of
#: raw matches, where an F of few others may hide it, less than half.
SAMPLES, POOL = 24, 200
REACH, GROWS = 12.0, 4
MOST_ON = 0.7
HALF_ON = 0.5

#: The largest RMS off a plane that is its relief, as a share of the range of the coordinates (10 px
#: in an image of 1000), far matches counting as if they were eight deviations off. And the noise
#: that hides such relief: sqrt(2) times it is the relief that the geometric AIC tells from none.
RELIEF = 0.01
HIDDEN = RELIEF / 2.0**0.5

#: Less than this share of the range, RMS, is no relief (1 px in an image of 1000), whatever the
#: noise: that of photographs is not normal. Matches off by three times as much stand out.
NO_RELIEF = 0.001
_STANDS_OUT = 3.0

#: A share of so many off the plane is not taken for relief: as many matches are wrong.
_FEW_FAR = 0.02

#: Wrong matches that the epipole can be put through when all others are in one plane; how many such
#: pairs may be expected that as many agree with, where the agreement is one by chance; and what is
#: side by side, as a share of the range.
EPIPOLE = 2
_BY_CHANCE = 0.01
BESIDE = 0.01

#: Matches off a plane by no more than so many times the distance of an inlier are its relief where
#: they are more than this share of the inliers.
_SLIGHTLY = 5.0
_FEW_SLIGHT = 0.1

#: Matches off a plane by no more than so many times the distance of an inlier may be its noise.
_TAILS = 2.0


#: So many places off any plane are plainly relief, if they are so many times what chance explains.
PLENTY, PLAINLY = 40, 8.0


@dataclass(frozen=True, kw_only=True)
class Planes:
    """What homographies leave of some matches, in conditioned coordinates.

    Attributes
    ----------
    far : int
        Matches far off the homography that most are on.
    flat : bool
        Whether all have next to no relief, but for those that agree with F by chance.
    relief, mean : float
        Mean of the squared distances to it; with far matches as if they were just so far off.
    on : ndarray of bool, shape (n,)
        Matches that the other numbers are of: without those that agree by chance.
    H : ndarray, shape (3, 3)
        Homography that fits them best.
    normal : ndarray, shape (9, 9)
        Its J^T J by vect(H).
    cost : float
        Weighted sum of their squared distances to it.
    """

    far: int
    flat: bool
    relief: float
    mean: float
    on: Mask
    H: Array
    normal: Array
    cost: float


@dataclass(frozen=True)
class OnPlane:
    """Some inliers, and how they lie to the best of some planes through three of them.

    Attributes
    ----------
    rows : ndarray of int, shape (k,)
        The inliers.
    off : ndarray, shape (k,)
        Their distances from it along epipolar lines, as far as each image has a part in them;
        zero of matches on an epipole, which say nothing.
    on : ndarray of bool, shape (k,)
        Which are on it.
    """

    rows: NDArray[np.intp]
    off: Array
    on: Mask


def share_on_a_plane(found: Evidence) -> float:
    """Return which share of the inliers the best of some planes through three of them explains."""
    return float(np.mean(on_a_plane(found).on))


def is_plain_relief(found: Evidence, plane: OnPlane) -> bool:
    """Tell by a cheap test that many inliers are off any plane, and no wrong ones by chance.

    Matches side by side count once. False says nothing.
    """
    on = plane.on
    q = np.concatenate([found.q1, found.q2])[:, plane.rows[~on]]
    places = len(np.unique(np.round(q / (BESIDE * RANGE)), axis=1).T)
    if places < PLENTY or np.mean(on) >= HALF_ON:
        return False
    limit, share = found.limit, len(on) / found.q1.shape[1]
    chance = chance_agreement(found.table, found.F, found.all1, found.all2, limit)
    return bool(places > PLAINLY * share * chance * found.rejected)


def on_a_plane(found: Evidence) -> OnPlane:
    """Return how some inliers lie to the plane of `share_on_a_plane`."""
    U = np.linalg.svd(found.F)[0]
    n, noise = found.q1.shape[1], max(found.noise, ROUNDING)
    step = -(-n // POOL)
    with np.errstate(all="ignore"):  # a match on an epipole says nothing of a plane
        kappa, gain = found.table.plane_parallax(found.F, U[:, 2].copy(), found.q1, found.q2)
        q = np.vstack([found.q1, np.ones(n)])[:, ::step]
        kappa, gain = kappa[::step], gain[::step]
        a, b, c = threes(q.shape[1]).T
        ab, ac = q[:2, b] - q[:2, a], q[:2, c] - q[:2, a]
        bk, ck = kappa[b] - kappa[a], kappa[c] - kappa[a]
        area = ab[0] * ac[1] - ab[1] * ac[0]
        v = np.array([bk * ac[1] - ck * ab[1], ab[0] * ck - ac[0] * bk]) / area
        v = np.vstack([v, kappa[a] - v[0] * q[0, a] - v[1] * q[1, a]])
        counts = np.sum(np.abs(_off(v, q, kappa, gain)) <= REACH * noise, axis=1)
        counts[~np.isfinite(v).all(axis=0)] = 0
        best = v[:, [np.argmax(counts)]]
        for deviations in (REACH,) * GROWS + (FAR_OFF,):
            on = (np.abs(_off(best, q, kappa, gain)[0]) <= deviations * noise) & np.isfinite(gain)
            rows = (q * gain)[:, on]
            A, b = rows @ rows.T, rows @ (gain * kappa)[on]
            if np.linalg.cond(A) < 1e12:
                best = np.linalg.solve(A, b)[:, None]
        off = _off(best, q, kappa, gain)[0]
    return OnPlane(np.arange(0, n, step), off, np.abs(off) <= FAR_OFF * noise)


def _off(v: Array, q: Array, kappa: Array, gain: Array) -> Array:
    """Return how far matches are off planes v (3, k) in either image, along epipolar lines."""
    off = gain * (kappa - v.T @ q) / np.sqrt(2.0)
    return np.asarray(np.where(np.isnan(off), 0.0, off))


def threes(n: int) -> NDArray[np.intp]:
    """Return threes of n matches, by the generator that the C library has, too."""
    state, threes = 1, []
    for _ in range(3 * SAMPLES):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        threes.append((state >> 33) % n)
    return np.array(threes, np.intp).reshape(-1, 3)


def judge_plane(found: Evidence, *, hidden: bool) -> Planes:
    """Fit homographies to the inliers.

    Parameters
    ----------
    found : Evidence
        Inliers and F.
    hidden : bool
        Whether the noise would hide any relief. Then all matches count.

    Returns
    -------
    Planes
        What they leave.
    """
    noise2 = max(found.noise, ROUNDING) ** 2
    far, relief, mean, on = 0, 0.0, 0.0, np.ones(len(found.weights), np.bool_)
    flat = False
    if not hidden:
        H, _ = robust_homography(found.q1, found.q2, found.weights, found.table)
        apart = found.table.homography_squared(H, found.all1, found.all2)
        squares = found.weights * apart[found.inlier]
        far = int(np.count_nonzero(squares > FAR_OFF**2 * noise2))
        relief = float(np.mean(np.minimum(squares, FAR_OFF**2 * noise2)))
        mean = float(np.mean(squares))
        flat = _is_flat(found, apart)
        on = _without_chance(found, apart)
    weights = found.weights[on]
    q1, q2 = (np.ascontiguousarray(q[:, on]) for q in (found.q1, found.q2))
    H, squares, normal = fit_homography(q1, q2, weights, found.table)
    return Planes(
        far=far,
        flat=flat,
        relief=relief,
        mean=mean,
        on=on,
        H=H,
        normal=normal,
        cost=float(weights @ squares),
    )


def displacement(found: Evidence, q1: Array, q2: Array, weights: Array) -> float:
    """Return the weighted sum of squared distances to no motion at all, in pixels the same."""
    origin = found.to_units2[:2, 2] - found.to_units1[:2, 2]
    moved = q2 - q1 - origin[:, None]
    return float(np.sum(weights * np.sum(moved**2, axis=0))) / 2.0


def _without_chance(found: Evidence, apart: Array) -> Mask:
    """Return which inliers to judge a plane by: without those off it, if these agree by chance.

    An F that fits a homography is free to move its epipole, and so to explain two wrong matches
    more; some of the others lie by chance on their epipolar lines. A few such matches would hide
    that all the rest are in one plane.
    """
    off = found.all_weights * apart > (OFF_PLANE * max(found.noise, ROUNDING)) ** 2
    everywhere = np.ones(len(found.weights), np.bool_)
    return ~off[found.inlier] if _is_accidental(found, apart, off) else everywhere


def _is_flat(found: Evidence, apart: Array) -> bool:
    """Tell whether all are on the plane by any measure, but for a few.

    A few are a fiftieth beyond the relief that a plane may have, side by side counted once, and any
    number that agrees by chance: as many are wrong among matches that were checked.
    """
    bound = (NO_RELIEF * RANGE) ** 2
    squares = found.all_weights * apart
    off = squares > _STANDS_OUT**2 * bound
    on = found.inlier & ~off
    if 2 * np.count_nonzero(on) <= np.count_nonzero(found.inlier):
        return False
    if np.mean(squares[on]) > bound:
        return False
    far = off & found.inlier & (squares > (RELIEF * RANGE) ** 2)
    places = np.count_nonzero(_one_of_each(found.all1[:, far], found.all2[:, far]))
    if places <= _FEW_FAR * np.count_nonzero(found.inlier):
        return True
    return _is_accidental(found, apart, off)


def _is_accidental(found: Evidence, apart: Array, off: Mask) -> bool:
    """Tell whether no more matches off a plane agree with F than wrong ones would by chance.

    Matches side by side in both images count as one: features have several scales and
    orientations, and all of one place fix one line. Wrong matches are anywhere: where more than a
    few are only slightly off, or more lie within a distance of the plane than chance explains, that
    is relief.
    """
    agree = np.flatnonzero(off & found.inlier)
    slight = np.count_nonzero(apart[agree] <= (_SLIGHTLY * found.limit) ** 2)
    if slight - EPIPOLE > _FEW_SLIGHT * np.count_nonzero(found.inlier):
        return False
    agree = agree[_one_of_each(found.all1[:, agree], found.all2[:, agree])]
    wrong = np.concatenate([agree, np.flatnonzero(off & ~found.inlier)])
    if chance_pairs(chances_off_plane(apart[wrong], found.limit), len(agree)) <= _BY_CHANCE:
        return False
    return not _is_beside(np.sqrt(np.sort(apart[agree])), len(wrong), found.limit)


def _is_beside(distances: Array, n: int, limit: float) -> bool:
    """Tell whether more of n wrong matches agree within a distance of a plane than by chance.

    Those within d of where the homography takes them, and within l of an epipolar line through
    there, are in a part 4 l d of the range of the coordinates, squared. Those hardly beyond l are
    left out: noise has heavy tails.
    """
    distances = distances[distances > _TAILS * limit]
    part = np.minimum(4.0 * limit * distances / RANGE**2, 1.0)
    bar = math.log10(_BY_CHANCE / max(len(distances), 1))
    alarms = (log10_false_alarms(n, k, p, EPIPOLE) for k, p in enumerate(part.tolist(), 1))
    return any(own <= bar for own in alarms)


def _one_of_each(q1: Array, q2: Array) -> Mask:
    """Return one match of each place."""
    kept = np.zeros(q1.shape[1], np.bool_)
    for k in range(len(kept)):
        beside = [np.abs(q[:, kept] - q[:, [k]]) <= BESIDE * RANGE for q in (q1, q2)]
        kept[k] = not np.all(np.vstack(beside), axis=0).any()
    return kept


def chance_pairs(chances: Array, k: int) -> float:
    """Return with how many pairs of wrong matches k or more are expected to agree.

    An epipole that a homography leaves free can be put on the lines of any two.

    Parameters
    ----------
    chances : ndarray, shape (n,)
        Probability of each wrong match that it agrees.
    k : int
        How many do, both of the pair among them.

    Returns
    -------
    float
        ``choose(n, 2) P(k - 2 or more agree)``; infinite for a k of two or less.
    """
    more, n = k - EPIPOLE, len(chances)
    if more <= 0:
        return np.inf
    fewer = np.zeros(more)  # probabilities that 0, 1, ... of the first ones agree
    fewer[0] = 1.0
    for chance in chances.tolist():
        fewer[1:] += chance * (fewer[:-1] - fewer[1:])
        fewer[0] *= 1.0 - chance
    return 0.5 * n * (n - 1) * max(1.0 - float(np.sum(fewer)), 0.0)


def affine_cost(q1: Array, q2: Array, weights: Array) -> float:
    """Return the weighted sum of squared distances to the best affine F, a plane in 4-space."""
    z = np.vstack([q1, q2])
    z = z - np.average(z, axis=1, weights=weights)[:, None]
    return float(np.linalg.eigvalsh((weights * z) @ z.T)[0])
