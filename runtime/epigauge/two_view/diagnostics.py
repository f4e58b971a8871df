"""What is the matter with a pair of images: flags, computed in one place for every entry.

A refinement always returns some F. Whether the matches determine it is another question, which is
answered here by comparing simpler models with it, and "all matches are wrong", and by the size of
its covariance. Beside each significance stands an effect size, since real noise has heavy tails and
is correlated: with enough matches everything is significant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.two_view.chance import (
    CEILING,
    SIGNIFICANT,
    chance_agreement,
    independent,
    log10_false_alarms,
)
from epigauge.two_view.consensus import RANGE, Consensus
from epigauge.two_view.covariance import residual_noise
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.essential import Calibrated, Motion
from epigauge.two_view.homography import fit_homography, robust_homography
from epigauge.two_view.losses import robust_scale
from epigauge.two_view.solve import Matches, Options, Solution
from epigauge.verdicts import ordered

__all__ = ["Evidence", "diagnose", "evidence", "is_oriented"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A redundancy below this estimates the noise worse than to 1 / sqrt(2 * 8) = 25 %.
_REDUNDANCY = 8

#: Largest standard deviation of F that linear propagation can be trusted with.
_WEAK = 0.1

#: The 99 % quantile of chi-square with the 3 parameters that an affine F lacks.
_AFFINE = 11.34

#: Standard deviations that count as within the noise.
_WITHIN = 3.0

#: Distance from a homography, in standard deviations of the noise, beyond which a match is off the
#: plane for Gaussian noise (one right match in a hundred thousand), and for real noise, which has
#: heavy tails, is correlated, and has the relief of a facade beside it.
_OFF_PLANE = 5.0
_FAR_OFF = 8.0

#: Nearly planar: no more than this share of the matches is far off the plane, and fewer than this
#: number, with which the two parameters that a plane leaves are well determined.
_FEW_OFF = 0.1
_ENOUGH_OFF = 30

#: The same share where matches are off the plane by less than this share of the range, RMS (5 px
#: in an image of 1000): what small relief fixes says little of points at other depths. And the
#: largest RMS that is relief, far matches counting as if they were eight deviations off.
_FEW_OFF_FLAT = 0.25
_FLAT = 0.005
_RELIEF = 0.01

#: Wrong matches that the epipole can be put through when all others are in one plane.
_EPIPOLE = 2

#: A noise below this, in conditioned coordinates, is rounding.
_ROUNDING = 1e-8

#: Variance of the residuals of a homography over that of F, below which the geometric AIC prefers
#: the homography (many matches); and the 99 % quantile of the normal distribution, for few.
_AIC_RATIO = 1.5
_NORMAL_99 = 2.326

#: Least squares look suspicious beyond this noise, as a share of the range of the coordinates (2.5
#: px in an image of 1000), or where matches beyond five robust deviations carry much of the error.
_SUSPICIOUS = 0.0025
_TAIL, _TAIL_SHARE = 5.0, 0.3

#: Gross errors are told when the variance of least squares is so many times that of the matches
#: that agree with the best F.
_INFLATED = 2.0

#: A camera stood still when no motion fits as well as the homography: by the 99 % quantile of
#: chi-square with its 8 parameters, or to a twentieth of the variance of the noise.
_CHI2_8 = 20.09
_STILL = 0.05

#: Coordinates that spread over less are hardly pixels.
_PIXELS = 2.0


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A solution and the matches it is judged by, in conditioned coordinates.

    Attributes
    ----------
    table : Table
        Backend.
    F : ndarray, shape (3, 3)
        Estimate.
    all1, all2 : ndarray, shape (2, n)
        All matches of positive weight, each of several equal ones once.
    all_weights : ndarray, shape (n,)
        Their weights.
    inlier : ndarray of bool, shape (n,)
        Which of them count for F.
    limit : float
        Largest distance at which a match counts.
    searched : bool
        Whether the inliers were chosen by F itself. Else the caller says that all are right.
    to_units1, to_units2 : ndarray, shape (3, 3)
        Maps of the images from pixels to these coordinates.
    noise : float
        Standard deviation of a coordinate, from the residuals of the inliers.
    parameters : int
        Number of parameters of F.
    retina : bool
        Whether the coordinates may be those on the retina, not pixels.
    from_rays : tuple of ndarray, shape (3, 3) each, or None
        Of calibrated cameras, the maps of the images from rays to these coordinates.
    n_behind : int
        Of calibrated cameras, the number of points behind one, by more than the noise explains.
    """

    table: Table
    F: Array
    all1: Array
    all2: Array
    all_weights: Array
    inlier: Mask
    limit: float
    searched: bool
    to_units1: Array
    to_units2: Array
    noise: float
    parameters: int
    retina: bool = False
    from_rays: tuple[Array, Array] | None = None
    n_behind: int = 0

    @cached_property
    def q1(self) -> Array:
        """Inliers in image 1, shape (2, m)."""
        return np.ascontiguousarray(self.all1[:, self.inlier])

    @cached_property
    def q2(self) -> Array:
        """Inliers in image 2, shape (2, m)."""
        return np.ascontiguousarray(self.all2[:, self.inlier])

    @cached_property
    def weights(self) -> Array:
        """Weights of the inliers, shape (m,)."""
        return self.all_weights[self.inlier]

    @cached_property
    def _corrected(self) -> tuple[Array, Array, Array]:
        """The inliers moved onto the epipolar geometry, and their squared distances."""
        criterion = Reprojection(self.table, self.q1, self.q2)
        feet = criterion.evaluate(self.F)
        q1_hat, q2_hat, _ = criterion.corrected(feet)
        return q1_hat, q2_hat, feet.squared

    @property
    def squared(self) -> Array:
        """Squared reprojection distances of the inliers, shape (m,)."""
        return self._corrected[2]

    @cached_property
    def oriented(self) -> bool:
        """Whether F satisfies the oriented epipolar constraint; of E, whether none is behind."""
        if self.from_rays is not None:
            return self.n_behind == 0
        return is_oriented(self.F, *self._corrected[:2], self.noise)

    def among(
        self, x1: Array, x2: Array, weights: Array, inlier: Mask, limit_px: float
    ) -> Evidence:
        """Return the evidence for the same F among other matches, chosen by F, in pixels."""
        counts = weights > 0.0
        inlier, weights, limit = inlier[counts], weights[counts], limit_px * self.to_units1[0, 0]
        q1, q2 = (
            np.ascontiguousarray((x[counts] * M[0, 0] + M[:2, 2]).T)
            for x, M in ((x1, self.to_units1), (x2, self.to_units2))
        )
        found = replace(
            self,
            all1=q1,
            all2=q2,
            all_weights=weights,
            inlier=inlier,
            limit=float(limit),
            searched=True,
        )
        squares = float(np.sum(found.weights * found.squared))
        return replace(
            found, noise=float(np.sqrt(squares / max(len(found.weights) - self.parameters, 1)))
        )

    @property
    def rejected(self) -> int:
        """Number of matches that do not count."""
        return len(self.inlier) - int(np.count_nonzero(self.inlier))


def evidence(
    matches: Matches, options: Options, solution: Solution, motion: Motion | None = None
) -> Evidence:
    """Collect what the diagnosis of a solution needs.

    With a robust loss, matches beyond three standard deviations do not count.
    """
    counts = matches.weights > 0.0
    q1, q2 = (np.ascontiguousarray(q[:, counts]) for q in (matches.q1, matches.q2))
    weights = matches.weights[counts]
    signed = Reprojection(matches.table, q1, q2).evaluate(solution.F).signed
    parameters = solution.chart.dimension
    loss = options.scaled_loss(solution.loss_scale_px / matches.frame.scale)
    noise = residual_noise(signed, weights, loss, parameters)
    inlier = np.ones(len(weights), np.bool_)
    if loss.name != "linear":
        inlier = np.sqrt(weights) * np.abs(signed) <= _WITHIN * noise
    to_units1, to_units2 = matches.frame.maps_from_pixels()
    calibration, from_rays, n_behind = options.calibration, None, 0
    if calibration is not None and motion is not None:
        from_rays = (to_units1 @ calibration[0], to_units2 @ calibration[1])
        unexplained = weights * motion.excess[counts] > (_WITHIN * noise) ** 2
        n_behind = int(np.count_nonzero(inlier & unexplained))
    return Evidence(
        table=matches.table,
        F=solution.F,
        all1=q1,
        all2=q2,
        all_weights=weights,
        inlier=inlier,
        limit=_WITHIN * noise,
        searched=loss.name != "linear",
        to_units1=to_units1,
        to_units2=to_units2,
        noise=noise,
        parameters=parameters,
        retina=calibration is not None and all(np.array_equal(K, np.eye(3)) for K in calibration),
        from_rays=from_rays,
        n_behind=n_behind,
    )


def diagnose(found: Evidence, deviation: float, ambiguous: bool) -> tuple[str, ...]:
    """Return the flags that a solution raises, in the order of `verdicts.FLAGS`.

    Parameters
    ----------
    found : Evidence
        Solution and matches.
    deviation : float
        Largest standard deviation of the conditioned F of unit norm, at the noise of `found`.
    ambiguous : bool
        Whether several minima are within the noise.

    Returns
    -------
    tuple of str
        Names from `verdicts.FLAGS`.

    Notes
    -----
    With S the weighted sum of squared distances to F, S_H to a homography, S_A to an affine F, S_I
    to no motion at all, and the noise s^2 = S / (n - p), the flags say

    - no common geometry: more geometries than `chance.SIGNIFICANT` says would agree so well with
      wrong matches, with F and with the best other geometry;
    - gross errors: the geometry of highest likelihood under a mixture of right and wrong matches is
      no chance, leaves some far off, and the variance of those near it is less than half of s^2;
    - planar scene: ``S_H / (2 n - 8) <= max(1.5, F99) s^2``, with F99 the 99 % quantile of the
      ratio of two such variances. The bound 1.5 is that of the geometric AIC [1]_ for many matches,
      ``S_H + 2 (2 n + 8) s^2 <= S + 2 (3 n + p) s^2``; with few matches an F fits a plane better
      than its 7 parameters promise, since its epipoles are free to move among the points. A relief
      of ``sqrt(2) s`` RMS shows under that bound. Where this is more than one per cent of the range
      of the coordinates, the noise would hide the relief of any scene, and the flag is "weak
      geometry" instead. Matches off the plane are left out where they are no more than agree by
      chance [2]_;
    - nearly planar: of the matches that agree with F at most a tenth, and fewer than 30, are more
      than 8 s from the homography that most are on, the others by one per cent of the range at
      most, RMS; at most a quarter where all are within half a per cent, RMS;
    - still camera: planar, and ``S_I - S_H <= max(20.1, 0.1 n) s^2``; in place of the former;
    - pure rotation: planar, and ``|tr H - tr H^-1|`` (det H = 1) within three standard deviations
      of zero: H = K R K^-1 has the eigenvalues of a rotation whatever K. Of calibrated cameras,
      planar, and the same bound holds for ``S_R / (2 n - 3)``, the rotation's;
    - not oriented; of calibrated cameras behind the cameras: some points farther from being in
      front of both than three standard deviations;
    - near-affine: ``S_A - S <= 11.34 s^2``;
    - weak geometry: ``deviation > 0.1``, or a homography explains the matches and the noise hides
      relief; few matches: ``n - p < 8``.

    References
    ----------
    .. [1] K. Kanatani, "Geometric information criterion for model selection", IJCV 26(3), 1998.
    .. [2] O. Chum, T. Werner, J. Matas, "Two-view geometry estimation unaffected by a dominant
       plane", CVPR 2005.
    """
    n, p = int(np.count_nonzero(found.inlier)), found.parameters
    raised = {
        "ambiguous": ambiguous,
        "not oriented": found.from_rays is None and not found.oriented,
        "behind the cameras": found.from_rays is not None and not found.oriented,
        "weak geometry": not deviation <= _WEAK,
        "few matches": n - p < _REDUNDANCY,
        "not pixels": not found.retina and _extent(found) < _PIXELS,
    }
    judged = found
    if not found.searched and _is_suspicious(found):
        agreeing = _agreeing(found)
        if agreeing.searched and _is_common(agreeing):
            judged = agreeing
            raised["gross errors"] = _is_inflated(found, judged)
    few = raised["few matches"] and not found.searched  # too few to show anything: that is told
    wide = found.noise > _SUSPICIOUS * RANGE
    doubtful = judged.searched or (wide and not few)
    if doubtful and not _is_common(judged):
        raised["no common geometry"] = True
    else:
        for name, is_raised in _plane(judged).items():
            raised[name] = is_raised or raised.get(name, False)
    return ordered(name for name, is_raised in raised.items() if is_raised)


def _extent(found: Evidence) -> float:
    """Return over how many pixels the points of an image spread, in either direction."""
    widest = max(float(np.max(np.ptp(q, axis=1))) for q in (found.all1, found.all2))
    return widest / float(found.to_units1[0, 0])


def _is_suspicious(found: Evidence) -> bool:
    """Tell whether least squares may have been bent by gross errors: cheap, and often wrong."""
    if found.noise > _SUSPICIOUS * RANGE:
        return True
    if found.noise <= _ROUNDING:
        return False
    squares = found.weights * found.squared
    tail = squares > (_TAIL * robust_scale(np.sqrt(squares))) ** 2
    return bool(np.sum(squares[tail]) > _TAIL_SHARE * np.sum(squares))


def _agreeing(found: Evidence) -> Evidence:
    """Return the evidence for the geometry that most matches agree on, as if they were raw."""
    consensus = Consensus(found.table, found.all1, found.all2, np.inf)
    own = consensus.judge(found.F, found.noise, 0.9)
    best = consensus.better(own, np.random.default_rng(0))
    limit = max(best.mixture.even, _ROUNDING)
    inlier = best.inliers(limit)
    count = int(np.count_nonzero(inlier))
    squares = np.sum(found.all_weights[inlier] * best.signed[inlier] ** 2)
    return replace(
        found,
        F=best.F,
        inlier=inlier,
        limit=limit,
        searched=True,
        noise=float(np.sqrt(squares / max(count - found.parameters, 1))),
    )


def _is_inflated(found: Evidence, judged: Evidence) -> bool:
    """Tell whether a few matches far off the common geometry are most of the error."""
    if not judged.rejected:
        return False
    return found.noise**2 > _INFLATED * max(judged.noise, _ROUNDING) ** 2


def _is_common(found: Evidence) -> bool:
    """Tell whether more matches agree with F than wrong ones would by chance."""
    limit = min(found.limit, CEILING * RANGE) if found.searched else found.limit
    near = found.squared <= limit**2
    m, agreeing = len(found.inlier), int(np.count_nonzero(near))
    if not agreeing:
        return False
    copies = agreeing - independent(found.q1[:, near], found.q2[:, near])
    chance = chance_agreement(found.table, found.F, found.all1, found.all2, limit)
    return log10_false_alarms(m - copies, agreeing - copies, chance) <= SIGNIFICANT


def _plane(found: Evidence) -> dict[str, bool]:
    """Return the flags about simpler models than F."""
    noise2 = max(found.noise, _ROUNDING) ** 2
    _, squares = robust_homography(found.q1, found.q2, found.weights)
    squares = found.weights * squares
    far = int(np.count_nonzero(squares > _FAR_OFF**2 * noise2))
    relief = float(np.mean(np.minimum(squares, _FAR_OFF**2 * noise2)))
    flat = float(np.mean(squares)) <= (_FLAT * RANGE) ** 2
    few = (_FEW_OFF_FLAT if flat else _FEW_OFF) * len(squares)
    nearly = relief <= (_RELIEF * RANGE) ** 2 and far <= few and far < _ENOUGH_OFF
    on = _without_chance(found, squares <= _OFF_PLANE**2 * noise2)
    q1, q2, weights = found.q1[:, on], found.q2[:, on], found.weights[on]
    n, p = int(np.count_nonzero(on)), found.parameters
    H, squares, N_H = fit_homography(q1, q2, weights)
    S, S_H = float(weights @ found.squared[on]), float(weights @ squares)
    ratio = max(_AIC_RATIO, _variance_ratio_99(max(2 * n - 8, 1), max(n - p, 4)))
    explained = (2 * n - 8) * ratio * noise2 >= S_H
    planar = explained and 2.0 * noise2 <= (_RELIEF * RANGE) ** 2
    more = _displacement(found, q1, q2, weights) - S_H
    if found.from_rays is None:
        turned = _may_be_rotation(found, H, N_H)
    else:
        S_R = float(weights @ Calibrated(q1, q2, *found.from_rays).from_rotation(weights))
        turned = (2 * n - 3) * ratio * noise2 >= S_R
    still = planar and more <= max(_CHI2_8, 2 * n * _STILL) * noise2
    return {
        "still camera": still,
        "planar scene": planar and not still,
        "nearly planar": nearly and not planar,
        "pure rotation": planar and not still and turned,
        "weak geometry": explained and not planar,
        "near-affine": not still and _affine_cost(q1, q2, weights) <= S + _AFFINE * noise2,
    }


def _without_chance(found: Evidence, on: Mask) -> Mask:
    """Return which inliers to judge a plane by: without those off it, if these agree by chance.

    An F that fits a homography is free to move its epipole, and so to explain two wrong matches
    more; where it was searched for among wrong matches, some of the others lie by chance on their
    epipolar lines. A few such matches would hide that all the rest are in one plane.
    """
    off = len(on) - int(np.count_nonzero(on))
    if off <= _EPIPOLE:
        return on
    if found.searched:
        chance = chance_agreement(found.table, found.F, found.all1, found.all2, found.limit)
        if off <= _by_chance(found.rejected + off, chance):
            return on
    return np.ones(len(on), np.bool_)


def _displacement(found: Evidence, q1: Array, q2: Array, weights: Array) -> float:
    """Return the weighted sum of squared distances to no motion at all, in pixels the same."""
    origin = found.to_units2[:2, 2] - found.to_units1[:2, 2]
    moved = q2 - q1 - origin[:, None]
    return float(np.sum(weights * np.sum(moved**2, axis=0))) / 2.0


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


def is_oriented(F: Array, q1_hat: Array, q2_hat: Array, noise: float) -> bool:
    """Test the oriented epipolar constraint on matches that satisfy q2^T F q1 = 0.

    Points in front of both cameras have (e' x q') . (F q) of one sign. Matches with a point within
    three standard deviations of an epipole are left out: noise decides on their sign.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    q1_hat, q2_hat : ndarray, shape (2, m)
        Corrected matches.
    noise : float
        Standard deviation of a coordinate, in the unit of the matches.

    Returns
    -------
    bool
        Whether all signs agree.

    References
    ----------
    .. [1] O. Chum, T. Werner, J. Matas, "Epipolar geometry estimation via RANSAC benefits from the
       oriented epipolar constraint", ICPR 2004.
    """
    U, _, Vt = np.linalg.svd(F)
    e1, e2 = Vt[2], U[:, 2]
    off1 = q1_hat * e1[2] - e1[:2, None]
    off2 = q2_hat * e2[2] - e2[:2, None]
    third = e2[0] * q2_hat[1] - e2[1] * q2_hat[0]  # e' x q' = (-off2_y, off2_x, third)
    line = F[:, :2] @ q1_hat + F[:, 2:]
    signs = off2[0] * line[1] - off2[1] * line[0] + third * line[2]
    near = _WITHIN * noise
    told = (np.hypot(*off1) > near * abs(e1[2])) & (np.hypot(*off2) > near * abs(e2[2]))
    signs = signs[told]
    return bool((signs > 0.0).all() or (signs < 0.0).all())


def _variance_ratio_99(above: int, below: int) -> float:
    """Return the 99 % quantile of Fisher's F with degrees of freedom, below >= 4 (Paulson 1942)."""
    a, b = 2.0 / (9.0 * above), 2.0 / (9.0 * below)
    z2 = _NORMAL_99**2
    root = np.sqrt((1.0 - a) ** 2 * b + (1.0 - b) ** 2 * a - a * b * z2)
    quotient = ((1.0 - a) * (1.0 - b) + _NORMAL_99 * root) / ((1.0 - b) ** 2 - b * z2)
    return float(quotient**3)


def _may_be_rotation(found: Evidence, H: Array, N: Array) -> bool:
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
    variance = max(found.noise, _ROUNDING) ** 2 * np.sum(
        (vectors[:, 1:].T @ by_H) ** 2 / values[1:]
    )
    return bool(abs(trace - trace_inverse) <= _WITHIN * np.sqrt(variance))


def _affine_cost(q1: Array, q2: Array, weights: Array) -> float:
    """Return the weighted sum of squared distances to the best affine F, a plane in 4-space."""
    z = np.vstack([q1, q2])
    z = z - np.average(z, axis=1, weights=weights)[:, None]
    return float(np.linalg.eigvalsh((weights * z) @ z.T)[0])
