"""The result of a two-view refinement."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import verdicts
from epigauge.errors import ArgumentError
from epigauge.lm import Row
from epigauge.two_view._partial import Partial
from epigauge.two_view.covariance import Uncertainty
from epigauge.two_view.diagnostics import diagnose
from epigauge.two_view.evidence import Evidence
from epigauge.two_view.minima import Minimum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FundamentalResult"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FundamentalResult(Partial):
    """A fundamental matrix with everything known about it. All lengths are in pixels.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Fundamental matrix of unit Frobenius norm, ``x2^T F x1 = 0``.
    U, V : ndarray, shape (3, 3)
        Its orthonormal factors, F ~ U diag(1, sigma, 0) V^T.
    sigma : float
        Ratio of its singular values, between 0 and 1.
    P1, P2 : ndarray, shape (3, 4)
        Canonic cameras (B&S eqs. 4, 5).
    points : ndarray, shape (m, 4)
        Reconstructed points, homogeneous of unit norm, in the basis of P1, P2.
    covariance : ndarray, shape (9, 9)
        Covariance of vect(F) to first order, of rank 7, or 5 for an essential matrix, or fewer by
        the parameters fixed; its diagonal is infinite where the matches do not determine F. It is
        ``noise_px^2 (J^T W J)^-1`` with the weights W, which are taken for inverse variances in
        units of 1 / noise_px^2; with a robust loss it is that of an M-estimate, ``A^-1 B A^-1``
        (`epigauge.two_view.covariance.influence`). J is that of the reprojection error
        whatever the criterion, whose minimum has the same covariance to first order.
    rank : int
        Number of free directions of F that the matches determine: 7 if nothing is held fixed.
    condition : float
        Largest over smallest standard deviation among them, in conditioned coordinates.
    noise_px : float
        Standard deviation of a coordinate that the covariance was computed with. Infinite, as the
        covariance, where it was to be estimated and nothing is redundant (an essential matrix from
        five matches).
    rms_px : float
        sqrt(sum of squared residual coordinates / (4 m)), whatever criterion and loss, over the
        matches of positive weight.
    loss_scale_px : float
        Scale of the robust loss, given or estimated; 0 for the linear loss.
    x : ndarray, shape (9,)
        vect(F).
    cost : float
        0.5 * sum of (weighted) squared residuals, in px^2; of rho of them with a robust loss.
    fun : ndarray, shape (m,)
        Signed distance of each match in the sense of the criterion.
    jac : ndarray, shape (m, p)
        Derivatives of `fun` by the p update parameters of the parameterisation, at the solution.
    grad : ndarray, shape (p,)
        Gradient of `cost` by the same.
    optimality : float
        Largest absolute entry of `grad`.
    nfev, njev, nit : int
        Evaluations of the cost including the start, linearisations, trial steps; of all starts.
    status : int
        Reason for stopping as in `epigauge.lm.STATUS`; positive is success.
    message : str
        The same in words.
    flags : tuple of str
        What the matches do not support: names from `epigauge.verdicts.FLAGS`, which explains them;
        the tests are in `epigauge.two_view.diagnostics.diagnose`. They use the noise of the
        residuals. Computed when asked for.
    success : bool
        Whether the result may be used: `status` is positive, and no flag spoils it
        (`epigauge.verdicts.usable`).
    history : tuple of Row
        One row an evaluation of the cost, of all starts one after the other.
    minima : tuple of Minimum
        The local minima that the starts ended in, by rising cost. The result is the lowest of those
        that satisfy the oriented epipolar constraint, or the lowest if none does ("not oriented").
    ambiguous : bool
        Whether another oriented minimum is within the noise of the result:
        ``2 (its cost - cost) <= 9 s^2``, three standard deviations, with the noise s estimated from
        the residuals of the result whatever `noise_px` says, since a wrong `noise_px` would hide a
        rival or make one up.
    E, R, t : ndarray, shape (3, 3), (3, 3), (3,), or None
        With ``essential=True``: the essential matrix of unit norm with ``E = K2^T F K1`` up to
        scale, and the motion ``x2 = R x1 + t`` of unit length that explains the matches best by
        points in front of both cameras.
    in_front : int or None
        With ``essential=True``: how many of the points that count (of positive weight; with a
        robust loss, within three standard deviations) lie in front of both cameras, or no farther
        from that than three standard deviations, as points nearly at infinity do.

    Examples
    --------
    >>> import epigauge as eg
    >>> matches = eg.load_matches(eg.samples.path("matches.csv"))
    >>> result = eg.refine_fundamental(matches.x1, matches.x2)
    >>> result.success, result.rank, result.F.shape, round(result.rms_px, 2)
    (True, 7, (3, 3), 0.66)
    """

    _shown: ClassVar[tuple[str, ...]] = (
        *("F", "sigma", "rms_px", "noise_px", "rank", "condition"),
        *("E", "R", "t", "in_front", "nfev", "message"),
    )

    F: Array
    U: Array
    V: Array
    sigma: float
    P1: Array
    P2: Array
    points: Array = field(repr=False)
    covariance: Array = field(repr=False)
    rank: int
    condition: float
    noise_px: float
    rms_px: float
    loss_scale_px: float
    x: Array = field(repr=False)
    cost: float
    fun: Array = field(repr=False)
    jac: Array = field(repr=False)
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
    minima: tuple[Minimum, ...] = field(repr=False)
    ambiguous: bool
    E: Array | None
    R: Array | None
    t: Array | None
    in_front: int | None
    _uncertainty: Uncertainty = field(repr=False)
    _evidence: Evidence = field(repr=False)

    def plot(self, x1: ArrayLike, x2: ArrayLike, **options: Any) -> Figure:
        """Draw the matches with their distances, epipolar lines and the convergence.

        Parameters
        ----------
        x1, x2 : array_like, shape (m, 2)
            The matches that the result was computed from; those of `used` of a `RobustResult`.
        **options
            Of `epigauge.plots.plot_refinement`.

        Returns
        -------
        matplotlib.figure.Figure
            The picture; `epigauge.plots.save_figure` writes it.

        Raises
        ------
        MissingPackageError
            If Matplotlib is not installed.

        Examples
        --------
        >>> result.plot(x1, x2)  # doctest: +SKIP
        """
        from epigauge.plots import plot_refinement

        return plot_refinement(self, x1, x2, **options)

    @property
    def epipole1(self) -> Array:
        """Epipole in image 1, a homogeneous unit vector (3,) in pixels: F e = 0."""
        return self.V[:, 2]

    @property
    def epipole2(self) -> Array:
        """Epipole in image 2, a homogeneous unit vector (3,) in pixels: F^T e' = 0."""
        return self.U[:, 2]

    @property
    def sigma_std(self) -> float:
        """Standard deviation of sigma, for Gaussian errors of F.

        Finite at sigma = 1 too, where the two singular values change places and sigma has a kink:
        it is then the deviation of a folded distribution, since sigma cannot exceed 1.
        """
        return self._uncertainty.of_sigma()

    def judged(self, found: Evidence) -> SimpleNamespace:
        """Return `flags` and `success` by some evidence."""
        # Where nothing is redundant the noise is not known: "few matches".
        largest = self._uncertainty.largest() if np.isfinite(self.noise_px) else 0.0
        if np.isfinite(largest) and 0.0 < self.noise_px < np.inf:
            largest *= found.noise_of_weight_one / found.to_units1[0, 0] / self.noise_px
        flags = diagnose(found, largest, self.ambiguous)
        usable = verdicts.usable(flags, "F" if self.E is None else "E")
        return SimpleNamespace(flags=flags, success=self.status > 0 and usable)

    def epipole_covariance(self, image: int) -> Array:
        """Return the covariance (3, 3) of `epipole1` or `epipole2`, of rank 2.

        Parameters
        ----------
        image : {1, 2}
            Which epipole.

        Returns
        -------
        ndarray, shape (3, 3)
            To first order; its diagonal is infinite where the matches do not determine the epipole.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.two_view_scene(seed=1)
        >>> result = eg.refine_fundamental(scene.x1, scene.x2)
        >>> result.epipole_covariance(1).shape
        (3, 3)
        """
        return self._uncertainty.of_epipole(_image(image))

    def epipole_px_covariance(self, image: int) -> Array:
        """Return the covariance (2, 2) of an epipole in pixels, ``epipole[:2] / epipole[2]``.

        Parameters
        ----------
        image : {1, 2}
            Which epipole.

        Returns
        -------
        ndarray, shape (2, 2)
            To first order, which is good while the epipole is many deviations from infinity; its
            diagonal is infinite for an epipole at infinity or not determined.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.two_view_scene(seed=1)
        >>> result = eg.refine_fundamental(scene.x1, scene.x2)
        >>> result.epipole_px_covariance(1).shape
        (2, 2)
        """
        return self._uncertainty.of_epipole_px(_image(image))


def _image(image: int) -> int:
    if image not in (1, 2):
        raise ArgumentError("image", f"is {image!r}", "1 or 2")
    return image
