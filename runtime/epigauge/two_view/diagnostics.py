"""What is the matter with a pair of images: named flags, each a test that the matches fail.

A refinement always returns some F. Whether the matches determine it is another question, which is
answered here by comparing simpler models with it, and by the size of its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.covariance import residual_noise
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.essential import Calibrated, Motion
from epigauge.two_view.solve import Matches, Options, Solution
from epigauge.verdicts import ordered

__all__ = [
    "Evidence",
    "diagnose",
    "evidence",
    "fit_homography",
    "is_oriented",
    "without_chance_matches",
]

Array = NDArray[np.float64]

#: A redundancy below this estimates the noise worse than to 1 / sqrt(2 * 8) = 25 %.
_REDUNDANCY = 8

#: Largest standard deviation of F that linear propagation can be trusted with.
_WEAK = 0.1

#: The 99 % quantile of chi-square with the 3 parameters that an affine F lacks.
_AFFINE = 11.34

#: Standard deviations that count as within the noise.
_WITHIN = 3.0

#: Iterations of the robust homography, and the distance from it in standard deviations of the noise
#: beyond which a match is off the plane: one right match in a hundred thousand.
_ROBUST_ROUNDS = 20
_OFF_PLANE = 5.0

#: A noise below this, in conditioned coordinates, is rounding.
_ROUNDING = 1e-8

#: Variance of the residuals of a homography over that of F, below which the geometric AIC prefers
#: the homography (many matches); and the 99 % quantile of the normal distribution, for few.
_AIC_RATIO = 1.5
_NORMAL_99 = 2.326


@dataclass(frozen=True)
class Evidence:
    """A solution and the matches that count for it, in conditioned coordinates.

    With a robust loss, those beyond three standard deviations do not count.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Estimate.
    q1, q2, q1_hat, q2_hat : ndarray, shape (2, n)
        Matches, measured and corrected.
    to_units1, to_units2 : ndarray, shape (3, 3)
        Maps of the images from pixels to these coordinates.
    weights, squared : ndarray, shape (n,)
        Weight and squared reprojection distance of each match.
    noise : float
        Standard deviation of a coordinate, from the residuals.
    parameters : int
        Number of parameters of F.
    cameras : Calibrated or None
        The same matches of calibrated cameras.
    n_behind : int
        Of calibrated cameras, the number of points behind one, by more than the noise explains.
    """

    F: Array
    q1: Array
    q2: Array
    q1_hat: Array
    q2_hat: Array
    to_units1: Array
    to_units2: Array
    weights: Array
    squared: Array
    noise: float
    parameters: int
    cameras: Calibrated | None = None
    n_behind: int = 0

    @cached_property
    def oriented(self) -> bool:
        """Whether F satisfies the oriented epipolar constraint; of E, whether none is behind."""
        if self.cameras is not None:
            return self.n_behind == 0
        return is_oriented(self.F, self.q1_hat, self.q2_hat, self.noise)


def evidence(
    matches: Matches, options: Options, solution: Solution, motion: Motion | None = None
) -> Evidence:
    """Collect what the diagnosis of a solution needs."""
    criterion = Reprojection(matches.table, matches.q1, matches.q2)
    feet = criterion.evaluate(solution.F)
    q1_hat, q2_hat, _ = criterion.corrected(feet)
    parameters = solution.chart.dimension
    loss = options.scaled_loss(solution.loss_scale_px / matches.frame.scale)
    noise = residual_noise(feet.signed, matches.weights, loss, parameters)
    counts = matches.weights > 0.0
    if loss.name != "linear":
        counts &= np.sqrt(matches.weights) * np.abs(feet.signed) <= _WITHIN * noise
    to_units1, to_units2 = matches.frame.maps_from_pixels()
    cameras, n_behind = None, 0
    if options.calibration is not None and motion is not None:
        cameras = matches.calibrated(options.calibration).some(counts)
        unexplained = matches.weights * motion.excess > (_WITHIN * noise) ** 2
        n_behind = int(np.count_nonzero(counts & unexplained))
    return Evidence(
        F=solution.F,
        q1=matches.q1[:, counts],
        q2=matches.q2[:, counts],
        q1_hat=q1_hat[:, counts],
        q2_hat=q2_hat[:, counts],
        to_units1=to_units1,
        to_units2=to_units2,
        weights=matches.weights[counts],
        squared=feet.squared[counts],
        noise=noise,
        parameters=parameters,
        cameras=cameras,
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
    With S the weighted sum of squared distances to F, S_H to a homography, S_A to an affine F, and
    the noise s^2 = S / (n - p), the flags say

    - planar scene: ``S_H / (2 n - 8) <= max(1.5, F99) s^2``, with F99 the 99 % quantile of the
      ratio of two such variances. The bound 1.5 is that of the geometric AIC [1]_ for many matches,
      ``S_H + 2 (2 n + 8) s^2 <= S + 2 (3 n + p) s^2``; with few matches an F fits a plane better
      than its 7 parameters promise, since its epipoles are free to move among the points;
    - pure rotation: planar, and ``|tr H - tr H^-1|`` (det H = 1) within three standard deviations
      of zero: H = K R K^-1 has the eigenvalues of a rotation whatever K. Of calibrated cameras,
      planar, and the same bound holds for ``S_R / (2 n - 3)``, the rotation's;
    - not oriented; of calibrated cameras behind the cameras: some points farther from being in
      front of both than three standard deviations;
    - near-affine: ``S_A - S <= 11.34 s^2``;
    - weak geometry: ``deviation > 0.1``; few matches: ``n - p < 8``.

    References
    ----------
    .. [1] K. Kanatani, "Geometric information criterion for model selection", IJCV 26(3), 1998.
    """
    calibrated = found.cameras is not None
    raised = {"ambiguous": ambiguous, "not oriented": not calibrated and not found.oriented}
    raised["behind the cameras"] = calibrated and not found.oriented
    n, p, noise2 = len(found.squared), found.parameters, max(found.noise, _ROUNDING) ** 2
    S = float(np.sum(found.weights * found.squared))
    H, squares, N_H = fit_homography(found.q1, found.q2, found.weights)
    S_H = float(found.weights @ squares)
    ratio = max(_AIC_RATIO, _variance_ratio_99(2 * n - 8, max(n - p, 4)))
    raised["planar scene"] = (2 * n - 8) * ratio * noise2 >= S_H
    if found.cameras is None:
        turned = _may_be_rotation(found, H, N_H)
    else:
        S_R = float(found.weights @ found.cameras.from_rotation(found.weights))
        turned = (2 * n - 3) * ratio * noise2 >= S_R
    raised["pure rotation"] = raised["planar scene"] and turned
    raised["near-affine"] = _affine_cost(found) <= S + _AFFINE * noise2
    raised["weak geometry"] = not deviation <= _WEAK
    raised["few matches"] = n - p < _REDUNDANCY
    return ordered(name for name, is_raised in raised.items() if is_raised)


def without_chance_matches(found: Evidence, rejected: int, chance: float) -> Evidence:
    """Leave out matches off a plane that are no more than wrong ones agree with F by chance.

    An F that fits a homography is free to move its epipole, and so to explain two wrong matches
    more; of the others, some lie by chance on their epipolar lines. A few such matches would hide
    that all the rest are in one plane [1]_.

    Parameters
    ----------
    found : Evidence
        Solution and inliers.
    rejected : int
        Number of matches that do not agree with F.
    chance : float
        Probability that a wrong match agrees.

    Returns
    -------
    Evidence
        Without the matches off the plane, where these are no more than `_by_chance` says; else as
        it was.

    References
    ----------
    .. [1] O. Chum, T. Werner, J. Matas, "Two-view geometry estimation unaffected by a dominant
       plane", CVPR 2005.
    """
    weights = found.weights
    for _ in range(_ROBUST_ROUNDS):
        _, squares, _ = fit_homography(found.q1, found.q2, weights)
        scale2 = max(float(np.median(squares)), _ROUNDING**2)
        weights = found.weights / (1.0 + squares / scale2) ** 2
    on = found.weights * squares <= (_OFF_PLANE * max(found.noise, _ROUNDING)) ** 2
    off = int(np.count_nonzero(~on))
    if off == 0 or off > _by_chance(rejected + off, chance):
        return found
    return replace(
        found,
        q1=found.q1[:, on],
        q2=found.q2[:, on],
        q1_hat=found.q1_hat[:, on],
        q2_hat=found.q2_hat[:, on],
        weights=found.weights[on],
        squared=found.squared[on],
    )


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
    return min(2 + q, wrong)


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


def fit_homography(q1: Array, q2: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Fit q2 ~ H q1 by Sampson's weights: the reprojection error to first order.

    Parameters
    ----------
    q1, q2 : ndarray, shape (2, n)
        Conditioned matches.
    weights : ndarray, shape (n,)
        Weights of the squared distances.

    Returns
    -------
    H : ndarray, shape (3, 3)
        Homography of unit Frobenius norm.
    squares : ndarray, shape (n,)
        Squared distance of each match, in both images.
    N : ndarray, shape (9, 9)
        J^T J by vect(H).
    """
    n = q1.shape[1]
    q = np.vstack([q1, np.ones(n)])
    # Two equations a match, q2 (h3 q) - (h1 q, h2 q) = 0, linear in vect(H)
    A = np.zeros((n, 2, 9))
    A[:, 0, 0:3] = A[:, 1, 3:6] = -q.T
    A[:, :, 6:9] = np.einsum("in,jn->nij", q2, q)
    inverse = np.broadcast_to(np.eye(2), (n, 2, 2))
    for _ in range(4):  # converges as the noise over the size of the scene
        N = np.einsum("n,nia,nij,njb->ab", weights, A, inverse, A, optimize=True)
        H = np.linalg.eigh(N)[1][:, 0].reshape(3, 3)
        J1 = np.einsum("in,j->nij", q2, H[2, :2]) - H[:2, :2]
        depth = H[2] @ q
        squares = J1 @ J1.transpose(0, 2, 1) + depth[:, None, None] ** 2 * np.eye(2)
        inverse = np.linalg.inv(squares + np.finfo(float).tiny * np.eye(2))
    c = A @ H.ravel()
    return H, np.einsum("ni,nij,nj->n", c, inverse, c), N


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
    variance = max(found.noise, _ROUNDING) ** 2 * np.sum(
        (vectors[:, 1:].T @ by_H) ** 2 / values[1:]
    )
    return bool(abs(trace - trace_inverse) <= _WITHIN * np.sqrt(variance))


def _affine_cost(found: Evidence) -> float:
    """Return the weighted sum of squared distances to the best affine F, a plane in 4-space."""
    z = np.vstack([found.q1, found.q2])
    z = z - np.average(z, axis=1, weights=found.weights)[:, None]
    return float(np.linalg.eigvalsh((found.weights * z) @ z.T)[0])
