"""What is the matter with a pair of images: flags, computed in one place for every entry.

A refinement always returns some F. Whether the matches determine it is another question, which is
answered here by comparing simpler models with it, and "all matches are wrong", and by the size of
its covariance. Beside each significance stands an effect size, since real noise has heavy tails and
is correlated: with enough matches everything is significant.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.calibration import is_calibration_wrong
from epigauge.two_view.chance import SIGNIFICANT, chances_off_plane, log10_false_alarms
from epigauge.two_view.collinear import is_left_open
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.essential import Calibrated
from epigauge.two_view.evidence import ROUNDING, Evidence
from epigauge.two_view.homography import fit_homography, plane_squares
from epigauge.two_view.line_noise import is_noise, with_that_noise
from epigauge.two_view.plane_motions import leaves_two_motions
from epigauge.two_view.planes import (
    EPIPOLE,
    HIDDEN,
    MOST_ON,
    RELIEF,
    affine_cost,
    displacement,
    is_plain_relief,
    judge_plane,
    on_a_plane,
)
from epigauge.two_view.rotation import may_be_rotation
from epigauge.two_view.suspicion import WIDE, agreeing, is_common, is_inflated, is_suspicious
from epigauge.verdicts import ordered

__all__ = [
    "AFFINE",
    "BLUNT",
    "PIXELS",
    "REDUNDANCY",
    "WEAK",
    "diagnose",
    "planar_bound",
    "plane_flags",
    "still_bound",
]

#: A redundancy below this estimates the noise worse than to 1 / sqrt(2 * 8) = 25 %.
REDUNDANCY = 8

#: Largest standard deviation of F that linear propagation can be trusted with.
WEAK = 0.1

#: The 99 % quantile of chi-square with the 3 parameters that an affine F lacks.
AFFINE = 11.34

#: Coordinates that spread over less are hardly pixels.
PIXELS = 2.0

#: Nearly planar: no more than this share of the matches is far off the plane, and fewer than this
#: number, with which the two parameters that a plane leaves are well determined.
_FEW_OFF = 0.1
_ENOUGH_OFF = 30

#: The same share where matches are off the plane by less than this share of the range, RMS (5 px
#: in an image of 1000): what small relief fixes says little of points at other depths.
_FEW_OFF_FLAT = 0.25
_FLAT = 0.005

#: Variance of the residuals of a homography over that of F, below which the geometric AIC prefers
#: the homography (many matches); and the 99 % quantile of the normal distribution, for few.
_AIC_RATIO = 1.5
_NORMAL_99 = 2.326

#: A camera stood still when no motion fits as well as the homography: by the 99 % quantile of
#: Fisher's F with its 8 parameters, or to a twentieth of the variance of the noise.
_STILL = 0.05

#: Real points are hardly measured worse than to so many pixels, in a thousandth of the focal length
#: where the coordinates are on the retina. Where they seem to be, how many agree is judged at
#: distances of so many standard deviations.
BLUNT = 4.0
_DISTANCES = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)


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
      wrong matches, with F and with the best other geometry; than one, of few matches. Matches in
      front of one camera only do not agree. With a noise of more than 4 pixels, wrong matches may
      be near where a homography takes them, and move from there in any direction;
    - gross errors: the geometry of highest likelihood under a mixture of right and wrong matches is
      no chance, leaves some far off, and the variance of those near it is less than half of s^2;
      with a robust loss, where s is more than a quarter per cent of the range of the coordinates;
    - undetermined: the inliers are on one line of both images within the noise, but for a few that
      no geometry through that line needs, or that agree by chance with one;
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
      most, RMS; at most a quarter where all are within half a per cent, RMS. Such a scene
      is planar where all are within a thousandth, RMS, but for those that agree by chance.
      Distances off a plane along the epipolar lines count as noise, where half are within a
      thousandth, neighbours are not off alike, and large ones are to both sides (`line_noise`);
    - still camera: planar, and ``S_I - S_H <= max(8 F99, 0.1 n) s_H^2``, F99 being the quantile
      for 8 and 2 n - 8 degrees of freedom and ``s_H^2 = S_H / (2 n - 8)`` the noise, since F fits a
      plane too well; in place of the former;
    - pure rotation: planar, and H = K R K^-1 within three standard deviations, with square pixels
      and a focal length and principal point that cameras have. Of calibrated cameras, planar, and
      the same bound holds for ``S_R / (2 n - 3)``, the rotation's;
    - two motions: of calibrated cameras, planar, and both motions of the homography have all points
      in front of the cameras, but for one in fifty;
    - not oriented; of calibrated cameras behind the cameras: some points farther from being in
      front of both than three standard deviations;
    - wrong calibration: of calibrated cameras, a free F leaves a sum of squares that is less by
      more than its two parameters take by chance (1 in 10^5), and less than two thirds of the
      variance; or it agrees with a quarter more raw matches. A plane agrees with any calibration;
    - near-affine: ``S_A - S <= 11.34 s^2``;
    - weak geometry: ``deviation > 0.1``, or a homography explains the matches and the noise hides
      relief; few matches: ``n - p < 8``.

    References
    ----------
    .. [1] K. Kanatani, "Geometric information criterion for model selection", IJCV 26(3), 1998.
    .. [2] O. Chum, T. Werner, J. Matas, "Two-view geometry estimation unaffected by a dominant
       plane", CVPR 2005.
    """
    if not np.isfinite(found.noise):
        return ("weak geometry",)  # a run that did not begin: there are no residuals to judge
    n, p = int(np.count_nonzero(found.inlier)), found.parameters
    raised = {
        "ambiguous": ambiguous,
        "not oriented": found.from_rays is None and not found.oriented,
        "behind the cameras": found.from_rays is not None and not found.oriented,
        "weak geometry": not deviation <= WEAK,
        "few matches": n - p < REDUNDANCY,
        "not pixels": not found.retina and _extent(found) < PIXELS,
    }
    judged = found
    # A robust loss that ends with a wide noise may have been drawn away: many were wrong.
    drawn = found.by_loss and found.noise > WIDE * RANGE
    if drawn or (not found.searched and is_suspicious(found)):
        best = agreeing(found)
        if best.searched and is_common(best):
            judged = best
            raised["gross errors"] = is_inflated(found, judged)
    # So few cannot be significant; but no more geometries than one may agree by chance.
    # Where nothing is redundant nothing speaks against them either.
    few = raised["few matches"] and not found.searched and len(found.inlier) > found.parameters
    wide = found.noise > WIDE * RANGE
    doubtful = judged.searched or wide or few
    if (doubtful and not is_common(judged, 0.0 if few else SIGNIFICANT)) or _is_random(judged):
        raised["no common geometry"] = True
    else:
        raised["undetermined"] = is_left_open(judged)
        raised["wrong calibration"] = found.from_rays is not None and is_calibration_wrong(judged)
        for name, is_raised in plane_flags(judged).items():
            raised[name] = is_raised or raised.get(name, False)
    return ordered(name for name, is_raised in raised.items() if is_raised)


def _is_random(found: Evidence) -> bool:
    """Tell whether wrong matches that hardly move would agree as well.

    F follows from the direction in which matches move off the homography that most are on, which
    leaves F the parameters of its epipole; wrong ones move in any. Relief that is little
    more than the noise shows at distances less than those of inliers: the one that tells most is
    taken. Noise that hides the relief of a distant scene looks alike but for its size in pixels.
    """
    blunt = BLUNT / 1000.0 if found.retina else BLUNT
    if found.noise <= max(WIDE * RANGE, blunt * float(found.to_units1[0, 0])):
        return False
    H = fit_homography(found.q1, found.q2, found.weights, found.table)[0]
    apart = plane_squares(found.table, H, found.all1, found.all2)
    m, alarms = len(found.inlier), []
    for limit in np.array(_DISTANCES) * found.noise:
        chance = float(np.mean(chances_off_plane(apart, limit)))
        agreed = int(np.count_nonzero(found.squared <= limit**2))
        alarms.append(log10_false_alarms(m, agreed, chance, EPIPOLE))
    return min(alarms) + math.log10(len(alarms)) > SIGNIFICANT


def _extent(found: Evidence) -> float:
    """Return over how many pixels the points of an image spread, in either direction."""
    widest = max(float(np.max(np.ptp(q, axis=1))) for q in (found.all1, found.all2))
    return widest / float(found.to_units1[0, 0])


def planar_bound(n: int, parameters: int) -> float:
    """Return the bound of the sum of squares to a homography, in units of the noise squared."""
    ratio = max(_AIC_RATIO, _variance_ratio_99(max(2 * n - 8, 1), max(n - parameters, 4)))
    return (2 * n - 8) * ratio


def still_bound(n: int) -> float:
    """Return by how much no motion may fit worse than H does, in units of its noise squared."""
    return max(8.0 * _variance_ratio_99(8, max(2 * n - 8, 4)), 2 * n * _STILL)


def plane_flags(found: Evidence, *, tested: bool = False) -> dict[str, bool]:
    """Return which flags about simpler models than F the inliers of some evidence raise.

    Where it is known that a cheap test does not tell that they are off any plane, that is left out.
    """
    noise2 = max(found.noise, ROUNDING) ** 2
    hidden = found.noise > HIDDEN * RANGE
    everywhere = np.ones(len(found.weights), np.bool_)
    if not hidden:
        plane = on_a_plane(found)
        if is_noise(found, plane):
            found = with_that_noise(found, plane)
            noise2 = found.noise**2
        elif not tested and (
            is_plain_relief(found, plane) if found.searched else np.mean(plane.on) < MOST_ON
        ):
            return {"near-affine": _is_affine(found, everywhere)}
    model = judge_plane(found, hidden=hidden)
    on, weights = model.on, found.weights[model.on]
    bound = planar_bound(int(np.count_nonzero(on)), found.parameters) * noise2
    explained = model.cost <= bound
    if hidden:
        return {"weak geometry": explained, "near-affine": _is_affine(found, on)}
    share = _FEW_OFF_FLAT if model.mean <= (_FLAT * RANGE) ** 2 else _FEW_OFF
    few = model.far <= share * len(on) and model.far < _ENOUGH_OFF
    nearly = few and model.relief <= (RELIEF * RANGE) ** 2
    explained = explained or (nearly and model.flat)
    q1, q2 = found.q1[:, on], found.q2[:, on]
    n, more = len(weights), displacement(found, q1, q2, weights) - model.cost
    two = False
    if found.from_rays is None:
        maps, redundancy = (found.to_units1, found.to_units2), n - found.parameters
        turned = explained and may_be_rotation(
            *maps, model.H, model.normal, noise2**0.5, redundancy
        )
    else:
        A1, A2 = found.from_rays
        cameras = Calibrated(q1, q2, A1, A2)
        squared = cameras.from_rotation(weights)
        with np.errstate(invalid="ignore"):  # a match that no rotation maps: none is claimed
            S_R = float(weights @ squared)
        turned = (2 * n - 3) * bound >= (2 * n - 8) * S_R
        if explained:
            H = np.asarray(np.linalg.solve(A2, model.H @ A1))
            two = leaves_two_motions(H, cameras.rays(q1, q2)[0])
    still = explained and more <= still_bound(n) * max(model.cost / max(2 * n - 8, 1), ROUNDING**2)
    return {
        "still camera": still,
        "planar scene": explained and not still,
        "nearly planar": nearly and not explained,
        "pure rotation": explained and not still and turned,
        "two motions": two and not still and not turned,
        "near-affine": not still and _is_affine(found, on),
    }


def _is_affine(found: Evidence, on: NDArray[np.bool_]) -> bool:
    """Tell whether an affine F explains some matches as well, but for its fewer parameters."""
    weights = found.weights[on]
    if not np.any(weights):
        return False
    bound = float(weights @ found.squared[on]) + AFFINE * max(found.noise, ROUNDING) ** 2
    return affine_cost(found.q1[:, on], found.q2[:, on], weights) <= bound


def _variance_ratio_99(above: int, below: int) -> float:
    """Return the 99 % quantile of Fisher's F with degrees of freedom, below >= 4 (Paulson 1942)."""
    a, b = 2.0 / (9.0 * above), 2.0 / (9.0 * below)
    z2 = _NORMAL_99**2
    root = np.sqrt((1.0 - a) ** 2 * b + (1.0 - b) ** 2 * a - a * b * z2)
    quotient = ((1.0 - a) * (1.0 - b) + _NORMAL_99 * root) / ((1.0 - b) ** 2 - b * z2)
    return float(quotient**3)
