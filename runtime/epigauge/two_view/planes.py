"""How well simpler models than F explain matches: a homography, no motion, an affine camera.

Every motion F and a vector v make a homography [e']_x F + e' v^T, the one of a plane: off it, a
match moves along its epipolar line. Which share of the matches a plane explains is therefore told
by three numbers a plane, without a fit; only where that share is large, homographies are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.chance import chance_agreement
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.evidence import ROUNDING, WITHIN, Evidence
from epigauge.two_view.homography import fit_homography, robust_homography

__all__ = [
    "FAR_OFF",
    "HIDDEN",
    "MOST_ON",
    "OFF_PLANE",
    "POOL",
    "REACH",
    "RELIEF",
    "SAMPLES",
    "Planes",
    "affine_cost",
    "displacement",
    "judge_plane",
    "may_be_rotation",
    "share_on_a_plane",
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
#: plane less well than all do. Where it then has less than this share, no plane has most.
SAMPLES, POOL = 24, 200
REACH = 12.0
MOST_ON = 0.7

#: The largest RMS off a plane that is its relief, as a share of the range of the coordinates (10 px
#: in an image of 1000), far matches counting as if they were eight deviations off. And the noise
#: that hides such relief: sqrt(2) times it is the relief that the geometric AIC tells from none.
RELIEF = 0.01
HIDDEN = RELIEF / 2.0**0.5

#: Less than this share of the range, RMS, is no relief (1 px in an image of 1000), whatever the
#: noise: that of photographs is not normal. Matches off by three times as much stand out.
_NO_RELIEF = 0.001
_STANDS_OUT = 3.0

#: Wrong matches that the epipole can be put through when all others are in one plane.
_EPIPOLE = 2


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


def share_on_a_plane(found: Evidence) -> float:
    """Return which share of the inliers the best of some planes through three of them explains."""
    U = np.linalg.svd(found.F)[0]
    n = found.q1.shape[1]
    step = -(-n // POOL)
    with np.errstate(all="ignore"):  # a match on an epipole says nothing of a plane
        kappa, gain = found.table.plane_parallax(found.F, U[:, 2].copy(), found.q1, found.q2)
        q = np.vstack([found.q1, np.ones(n)])[:, ::step]
        kappa, gain = kappa[::step], gain[::step]
        a, b, c = _threes(q.shape[1]).T
        ab, ac = q[:2, b] - q[:2, a], q[:2, c] - q[:2, a]
        bk, ck = kappa[b] - kappa[a], kappa[c] - kappa[a]
        area = ab[0] * ac[1] - ab[1] * ac[0]
        v = np.array([bk * ac[1] - ck * ab[1], ab[0] * ck - ac[0] * bk]) / area
        v = np.vstack([v, kappa[a] - v[0] * q[0, a] - v[1] * q[1, a]])
        counts = np.sum(_on(v, q, kappa, gain, REACH * found.noise), axis=1)
        counts[~np.isfinite(v).all(axis=0)] = 0
        best = v[:, [np.argmax(counts)]]
        for deviations in (REACH, FAR_OFF):
            on = _on(best, q, kappa, gain, deviations * found.noise)[0] & np.isfinite(gain)
            rows = (q * gain)[:, on]
            A, b = rows @ rows.T, rows @ (gain * kappa)[on]
            if np.linalg.cond(A) < 1e12:
                best = np.linalg.solve(A, b)[:, None]
        return float(np.mean(_on(best, q, kappa, gain, FAR_OFF * found.noise)))


def _on(v: Array, q: Array, kappa: Array, gain: Array, bound: float) -> Mask:
    """Return which matches are on planes v (3, k): off them by no more, in either image.

    A match on an epipole is; it says nothing.
    """
    return np.asarray(~(np.abs(gain * (kappa - v.T @ q)) > np.sqrt(2.0) * bound))


def _threes(n: int) -> NDArray[np.intp]:
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
        _, squares = robust_homography(found.q1, found.q2, found.weights, found.table)
        squares = found.weights * squares
        far = int(np.count_nonzero(squares > FAR_OFF**2 * noise2))
        relief = float(np.mean(np.minimum(squares, FAR_OFF**2 * noise2)))
        mean = float(np.mean(squares))
        flat = _is_flat(found, squares)
        on = _without_chance(found, squares <= OFF_PLANE**2 * noise2)
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


def _without_chance(found: Evidence, on: Mask) -> Mask:
    """Return which inliers to judge a plane by: without those off it, if these agree by chance.

    An F that fits a homography is free to move its epipole, and so to explain two wrong matches
    more; where it was searched for among wrong matches, some of the others lie by chance on their
    epipolar lines. A few such matches would hide that all the rest are in one plane.
    """
    off = len(on) - int(np.count_nonzero(on))
    return on if _is_accidental(found, off) else np.ones(len(on), np.bool_)


def _is_accidental(found: Evidence, off: int) -> bool:
    """Tell whether no more matches are off a plane than agree with F by chance."""
    if off <= _EPIPOLE:
        return True
    if not found.searched:
        return False
    chance = chance_agreement(found.table, found.F, found.all1, found.all2, found.limit)
    return off <= _by_chance(found.rejected + off, chance)


def _is_flat(found: Evidence, squares: Array) -> bool:
    """Tell whether all are on the plane by any measure, but for those that agree by chance."""
    bound = (_NO_RELIEF * RANGE) ** 2
    off = squares > _STANDS_OUT**2 * bound
    if off.all() or np.mean(squares[~off]) > bound:
        return False
    return _is_accidental(found, int(np.count_nonzero(off)))


def _by_chance(wrong: int, chance: float) -> int:
    """Return how many of some wrong matches may agree with an F that a homography leaves free.

    Two, through which the epipole is put, and as many more as the best of all pairs finds with
    99 %: the least q with ``choose(wrong, 2) P(Poisson(wrong chance) > q) <= 0.01``.
    """
    pairs, mean = wrong * (wrong - 1) / 2, min(wrong * chance, 700.0)
    q, term = 0, float(np.exp(-mean))
    tail = 1.0 - term
    while pairs * tail > 0.01 and q < wrong:
        q += 1
        term *= mean / q
        tail -= term
    return min(_EPIPOLE + q, wrong)


def may_be_rotation(found: Evidence, H: Array, N: Array) -> bool:
    """Tell whether H has the eigenvalues of a rotation, 1 and exp(+-i a), within the noise.

    Then tr H = tr H^-1 at det H = 1. Both images must have the same coordinates for that: H is
    mapped from the units of the second image to those of the first.
    """
    same = found.to_units1 @ np.linalg.inv(found.to_units2)
    G = same @ H
    determinant = float(np.linalg.det(G))
    if determinant == 0.0:
        return False
    root = np.cbrt(determinant)
    inverse = np.linalg.inv(G)
    trace, trace_inverse = np.trace(G) / root, np.trace(inverse) * root
    by_log_determinant = -(trace + trace_inverse) / 3.0 * inverse.T
    by_G = np.eye(3) / root + root * (inverse @ inverse).T + by_log_determinant
    by_H = (same.T @ by_G).ravel()
    values, vectors = np.linalg.eigh(N)
    values = np.maximum(values, np.finfo(float).eps * values[-1])
    variance = max(found.noise, ROUNDING) ** 2 * np.sum((vectors[:, 1:].T @ by_H) ** 2 / values[1:])
    return bool(abs(trace - trace_inverse) <= WITHIN * np.sqrt(variance))


def affine_cost(q1: Array, q2: Array, weights: Array) -> float:
    """Return the weighted sum of squared distances to the best affine F, a plane in 4-space."""
    z = np.vstack([q1, q2])
    z = z - np.average(z, axis=1, weights=weights)[:, None]
    return float(np.linalg.eigvalsh((weights * z) @ z.T)[0])
