"""What `bundle_adjust` returns."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._results import Result
from epigauge.cameras import AnyReconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.verdicts import FLAGS, usable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["BundleResult", "told"]

Array = NDArray[np.float64]

#: Fields that are a matter of the verdict.
_JUDGED = ("flags", "rank", "n_behind", "condition", "weakest", "message", "success")


@dataclass(frozen=True)
class BundleResult(Result):
    """An adjusted reconstruction and how it was found. All lengths are in pixels.

    Attributes
    ----------
    reconstruction : Reconstruction, MetricReconstruction or AffineReconstruction
        Cameras and points, of the kind of the start; with method "covariant" in its basis.
    rms_px : float
        sqrt(sum of squared residual coordinates / (2 N)), of the N observations whose weight is not
        zero and that were not set aside.
    cost : float
        0.5 * (weighted, robust) sum of squared residuals, in px^2.
    fun : ndarray, shape (N, 2)
        Residuals q - q_hat, in the order of the tracks.
    method : str
        Name of the strategy.
    loss_scale_px : float
        Scale of the robust loss; 0 for the linear loss.
    noise_px : float
        Noise of the image that priors were weighed with, given or estimated.
    flags : tuple of str
        What can be said against it, from `epigauge.verdicts.FLAGS`; `success` is False with one
        that spoils a reconstruction.
    rank : int
        Of the normal matrix: 11 n + 3 m - 15 where the observations determine everything, m being
        the points with two observations that count.
    n_behind : int
        Observations of points that do not lie in front of their camera; they keep the residual that
        the camera's formula gives.
    rejected : ndarray of bool, shape (N,)
        Observations that were set aside as gross errors, in the order of the tracks.
    condition : float
        Beside the gauge, the inverse of the least eigenvalue of the reduced normal matrix: of
        metric cameras scaled to a unit diagonal, of projective ones where the W of the covariant
        damping is one. Infinite where something is undetermined or the system is not factored.
    weakest : str
        The direction of that eigenvalue in words: of metric and affine cameras its three largest
        standard deviations, as shares of a radian, of the scene's size, or of the focal length, and
        the group of points that moves with it; of projective ones the views with most part in it.
        Where nothing determines a direction, what moves most along it.
    nfev, njev, nit, status, message, success, history
        As in `FundamentalResult`.
    line_fun : ndarray, shape (K, 2), or None
        With lines: signed distances of both end points of each segment from the image of its line,
        in the order of the `LineTracks`, in pixels; over their standard deviations and times
        `Tracks.unit` where these were given.

    Notes
    -----
    Flags, rank, n_behind, condition, weakest, message and success are computed when the first of
    them is asked for: the verdict on a few hundred points takes as long as their adjustment. Until
    then the result holds the normal equations; with several workers it is judged at once.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> result = eg.bundle_adjust(tracks)
    >>> result.success, result.reconstruction.P.shape, round(result.rms_px, 3)
    (True, (5, 3, 4), 0.796)
    """

    _shown: ClassVar[tuple[str, ...]] = (
        *("reconstruction", "rms_px", "cost", "method", "noise_px", "n_behind", "condition"),
        *("nfev", "message"),
    )

    reconstruction: AnyReconstruction = field(repr=False)
    rms_px: float
    cost: float
    fun: Array = field(repr=False)
    method: str
    loss_scale_px: float
    noise_px: float
    flags: tuple[str, ...]
    rank: int
    n_behind: int
    rejected: NDArray[np.bool_] = field(repr=False)
    condition: float
    weakest: str
    nfev: int
    njev: int
    nit: int
    status: int
    message: str
    success: bool
    history: tuple[lm.Row, ...] = field(repr=False)
    line_fun: Array | None = field(default=None, repr=False)

    @classmethod
    def unjudged(
        cls,
        judge: Callable[[], Verdict],
        outcome: lm.Outcome[Any],
        tracks: Tracks,
        residuals: Array,
        **known: Any,
    ) -> BundleResult:
        """Return a result that is judged when its verdict is first asked for.

        Parameters
        ----------
        judge : callable
            Returns the verdict.
        outcome : Outcome
            How the minimisation ended.
        tracks : Tracks
            What was adjusted.
        residuals : ndarray, shape (N, 2)
            Of the points.
        **known
            All other fields that do not depend on the verdict.
        """
        counts = tracks.weights > 0.0
        counted = residuals if counts.all() else residuals[counts]
        made = object.__new__(cls)
        made.__dict__.update(
            known,
            rms_px=math.sqrt(np.vdot(counted, counted) / counted.size),
            fun=residuals,
            rejected=np.zeros(len(residuals), dtype=np.bool_),
            nfev=outcome.nfev,
            njev=outcome.njev,
            nit=outcome.nit,
            status=outcome.status,
            history=outcome.history,
            _judge=judge,
            _judging=threading.Lock(),
        )
        return made

    def judge(self) -> None:
        """Compute what is a matter of the verdict now; asking for any of it does the same."""
        waiting = self.__dict__.get("_judging")
        if waiting is None:
            return
        with waiting:  # threads would write to the same normal equations
            judge = self.__dict__.get("_judge")
            if judge is not None:
                self.__dict__.update(told(judge(), self.status))
                del self.__dict__["_judge"]

    if not TYPE_CHECKING:  # to a type checker all fields are there

        def __getattr__(self, name: str) -> Any:
            if name in _JUDGED:
                try:
                    self.judge()
                except AttributeError as error:  # `getattr` would take it for no such field
                    raise RuntimeError(f"the result cannot be judged: {error}") from error
            if name not in self.__dict__:
                raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
            return self.__dict__[name]

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields, judged: a copy does not know how."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def _summary_rows(self) -> dict[str, str]:
        aside = f"{np.count_nonzero(self.rejected)} of {len(self.rejected)} observations"
        rows = super()._summary_rows()
        return rows | ({"set aside": aside} if self.rejected.any() else {})

    def plot(self, tracks: Tracks, title: str = "", **options: Any) -> Figure:
        """Draw cameras and points from three sides, the residuals, and the convergence.

        Parameters
        ----------
        tracks : Tracks
            What was adjusted.
        title : str
            What to call them.
        **options
            Of `epigauge.plots.plot_bundle`.

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
        >>> result.plot(tracks)  # doctest: +SKIP
        """
        from epigauge.plots import plot_bundle

        return plot_bundle(self, tracks, title, **options)


def told(verdict: Verdict, status: int) -> dict[str, Any]:
    """Return the fields that are a matter of a verdict."""
    return {
        "flags": verdict.flags,
        "rank": verdict.rank,
        "n_behind": verdict.n_behind,
        "condition": verdict.condition,
        "weakest": verdict.weakest,
        "message": _message(status, verdict),
        "success": status > 0 and usable(verdict.flags, "views"),
    }


def _message(status: int, verdict: Verdict) -> str:
    """Return why the adjustment stopped and, where its result must not be used, why not."""
    stopped = lm.STATUS[status]
    if status == 0 and verdict.weakest:  # what a valley with many steps is along, most often
        stopped += f" (weakest: {verdict.weakest})"
    spoiling = [name for name in verdict.flags if not usable([name], "views")]
    reasons = [f"{name}: {FLAGS[name].sentence}" for name in spoiling]
    return "; but ".join([stopped, *reasons])
