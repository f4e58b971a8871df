"""What a solution is judged by: the matches that count for it, in conditioned coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table
from epigauge.two_view.covariance import residual_noise
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.essential import Motion
from epigauge.two_view.solve import Matches, Options, Solution

__all__ = ["ROUNDING", "WITHIN", "Evidence", "evidence", "of_median_one", "oriented_matches"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Standard deviations that count as within the noise.
WITHIN = 3.0

#: A noise below this, in conditioned coordinates, is rounding.
ROUNDING = 1e-8


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
        Their weights, of median one: a common factor changes nothing that is judged.
    unit : float
        The median of the weights as they were given.
    inlier : ndarray of bool, shape (n,)
        Which of them count for F.
    limit : float
        Largest distance at which a match counts.
    searched : bool
        Whether the inliers were chosen by F itself. Else the caller says that all are right.
    by_loss : bool
        Whether a robust loss chose them: from one start, without a search among all matches.
    to_units1, to_units2 : ndarray, shape (3, 3)
        Maps of the images from pixels to these coordinates.
    noise : float
        Standard deviation of a coordinate of the median weight, from the residuals of the inliers.
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
    unit: float = 1.0
    inlier: Mask
    limit: float
    searched: bool
    by_loss: bool = False
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

    @property
    def noise_of_weight_one(self) -> float:
        """Standard deviation of a coordinate whose weight was given as one."""
        return self.noise * math.sqrt(self.unit)

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
        return self.n_behind == 0 if self.from_rays is not None else bool(self.in_front.all())

    @cached_property
    def in_front(self) -> Mask:
        """Which inliers satisfy the oriented epipolar constraint, as most do, shape (m,)."""
        return oriented_matches(self.F, *self._corrected[:2], self.noise)

    def among(
        self, x1: Array, x2: Array, weights: Array, inlier: Mask, limit_px: float
    ) -> Evidence:
        """Return the evidence for the same F among other matches, chosen by F, in pixels."""
        counts = weights > 0.0
        inlier, limit = inlier[counts], limit_px * self.to_units1[0, 0]
        weights, unit = of_median_one(weights[counts])
        q1, q2 = (
            np.ascontiguousarray((x[counts] * M[0, 0] + M[:2, 2]).T)
            for x, M in ((x1, self.to_units1), (x2, self.to_units2))
        )
        found = replace(
            self,
            all1=q1,
            all2=q2,
            all_weights=weights,
            unit=unit,
            inlier=inlier,
            limit=float(limit),
            searched=True,
            by_loss=False,
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
        inlier = np.sqrt(weights) * np.abs(signed) <= WITHIN * noise
    to_units1, to_units2 = matches.frame.maps_from_pixels()
    calibration, from_rays, n_behind = options.calibration, None, 0
    if calibration is not None and motion is not None:
        from_rays = (to_units1 @ calibration[0], to_units2 @ calibration[1])
        unexplained = weights * motion.excess[counts] > (WITHIN * noise) ** 2
        n_behind = int(np.count_nonzero(inlier & unexplained))
    weights, unit = of_median_one(weights)
    noise /= math.sqrt(unit)
    return Evidence(
        table=matches.table,
        F=solution.F,
        all1=q1,
        all2=q2,
        all_weights=weights,
        unit=unit,
        inlier=inlier,
        limit=WITHIN * noise,
        searched=loss.name != "linear",
        by_loss=loss.name != "linear",
        to_units1=to_units1,
        to_units2=to_units2,
        noise=noise,
        parameters=parameters,
        retina=calibration is not None and all(np.array_equal(K, np.eye(3)) for K in calibration),
        from_rays=from_rays,
        n_behind=n_behind,
    )


def of_median_one(weights: Array) -> tuple[Array, float]:
    """Return positive weights divided by their median, and the median."""
    unit = float(np.median(weights)) if len(weights) else 1.0
    return (weights, 1.0) if unit == 1.0 else (weights / unit, unit)


def oriented_matches(F: Array, q1_hat: Array, q2_hat: Array, noise: float) -> Mask:
    """Test the oriented epipolar constraint on matches that satisfy q2^T F q1 = 0.

    Points in front of both cameras have (e' x q') . (F q) of one sign. Matches with a point within
    three standard deviations of an epipole pass: noise decides on their sign.

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
    ndarray of bool, shape (n,)
        Whether a match has the sign that most have.

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
    near = WITHIN * noise
    told = (np.hypot(*off1) > near * abs(e1[2])) & (np.hypot(*off2) > near * abs(e2[2]))
    majority = 1.0 if np.sum(np.sign(signs[told])) >= 0.0 else -1.0
    return np.asarray(~told | (majority * signs > 0.0))
