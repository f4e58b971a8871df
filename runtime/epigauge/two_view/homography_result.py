"""The result of a maximum-likelihood homography."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from epigauge._results import Result
from epigauge.lm import Row

__all__ = ["HomographyResult"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class HomographyResult(Result):
    """A homography with everything known about it. All lengths are in pixels.

    Attributes
    ----------
    H : ndarray, shape (3, 3)
        Homography of unit Frobenius norm, ``x2 ~ H x1``.
    covariance : ndarray, shape (9, 9)
        Covariance of vect(H), of rank 8: ``noise_px^2 (J^T W J)^-1``; of an M-estimate with a
        robust loss, one factor for all matches [1]_. Infinite on its diagonal where the matches do
        not determine H.
    rank : int
        Number of directions of H that the matches determine: 8, or fewer.
    condition : float
        Largest over smallest standard deviation among them, in conditioned coordinates.
    noise_px : float
        Standard deviation of a coordinate that the covariance was computed with.
    rms_px : float
        sqrt(sum of squared residual coordinates / (4 m)) over the matches that count.
    loss_scale_px : float
        Scale of the robust loss, given or estimated; 0 for the linear loss.
    inlier : ndarray of bool, shape (m,)
        Which of all matches agree with H, duplicates included.
    used : ndarray of int, shape (n,)
        Rows of the matches that H was fitted to.
    threshold_px : float
        Largest distance of an inlier; infinite where all matches were said to be right.
    x : ndarray, shape (9,)
        vect(H).
    cost : float
        0.5 * sum of (weighted) squared residuals, in px^2; of rho of them with a robust loss.
    fun : ndarray, shape (n,)
        Distance of each match that was used: how far both its points have to move to be mapped onto
        one another.
    points1 : ndarray, shape (n, 2)
        These corrected points in image 1; H maps them to those of image 2.
    grad : ndarray, shape (8,)
        Gradient of `cost` in the directions across H.
    optimality : float
        Largest absolute entry of `grad`.
    nfev, njev, nit : int
        Evaluations of the cost including the start, linearisations, trial steps.
    status : int
        Reason for stopping as in `epigauge.lm.STATUS`; positive is success.
    message : str
        The same in words.
    flags : tuple of str
        Names from `epigauge.verdicts.FLAGS`, which explains them.
    success : bool
        Whether the result may be used: `status` is positive, and no flag spoils it.
    history : tuple of Row
        One row an evaluation of the cost.

    References
    ----------
    .. [1] P. J. Huber, "Robust Statistics", 1981, section 7.6.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> rng = np.random.default_rng(0)
    >>> x1 = rng.uniform(0, 500, (60, 2))
    >>> x2 = x1 @ [[1.1, 0.2], [-0.1, 0.9]] + [30, 5] + rng.normal(size=(60, 2))
    >>> result = eg.refine_homography(x1, x2)
    >>> result.rank, result.H.shape, bool(0.5 < result.noise_px < 2)
    (8, (3, 3), True)
    """

    _shown: ClassVar[tuple[str, ...]] = (
        *("H", "inliers", "threshold_px", "rms_px", "noise_px", "rank", "condition"),
        *("nfev", "message"),
    )

    H: Array
    covariance: Array = field(repr=False)
    rank: int
    condition: float
    noise_px: float
    rms_px: float
    loss_scale_px: float
    inlier: Mask = field(repr=False)
    used: NDArray[np.intp] = field(repr=False)
    threshold_px: float
    x: Array = field(repr=False)
    cost: float
    fun: Array = field(repr=False)
    points1: Array = field(repr=False)
    grad: Array = field(repr=False)
    optimality: float
    nfev: int
    njev: int
    nit: int
    status: int
    message: str
    flags: tuple[str, ...]
    success: bool
    history: tuple[Row, ...] = field(repr=False)

    def __iter__(self) -> Iterator[Array | Mask]:
        """Unpack as in OpenCV: ``H, mask = eg.estimate_homography(x1, x2)``."""
        return iter((self.H, self.inlier))

    def _summary_rows(self) -> dict[str, str]:
        found = super()._summary_rows()
        count = f"{np.count_nonzero(self.inlier)} of {len(self.inlier)} matches"
        return {"H": found.pop("H"), "inliers": count} | found
