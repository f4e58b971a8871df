"""The epipolar geometries of many pairs of raw matches in one call."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_count, as_matches, as_positive, as_score, as_weights
from epigauge._logged import logged
from epigauge._options import FrontEnd, PairOptions, known_options
from epigauge.errors import ArgumentError
from epigauge.two_view.batch import as_offsets, check_options
from epigauge.two_view.batch_parts import elsewhere, no_callback, threads
from epigauge.two_view.batch_result import FundamentalBatch
from epigauge.two_view.confidence import probability_below
from epigauge.two_view.front_ends import checked
from epigauge.two_view.robust import RobustResult, estimated
from epigauge.two_view.tensors import REFUSED

__all__ = ["RobustBatch", "estimate_fundamental_batch"]

Array = NDArray[np.float64]

#: Pairs that go to an executor at a time: one takes ten milliseconds and more.
_PART = 32

#: Fields with a row a pair: those that a result has when it is made, and with what of it is
#: computed when it is asked for.
_NOW = ("F", "sigma", "cost", "rms_px", "threshold_px", "nfev", "njev", "nit", "status")
_LATER = ("noise_px", "condition", "covariance", "rank", "error_px", "p_wrong")


@dataclass(frozen=True, kw_only=True)
class RobustBatch(FundamentalBatch):
    """Results of many pairs of raw matches, one row a pair; fields as in `RobustResult`.

    Attributes
    ----------
    inlier : ndarray of bool, shape (m,)
        Which of all matches agree with F of their pair.
    threshold_px : ndarray, shape (n,)
        Largest distance of an inlier of each pair.
    offsets : ndarray of int, shape (n + 1,)
        As given: pair k has the matches ``offsets[k]:offsets[k + 1]``.
    distances : ndarray, shape (m,)
        Signed distances of all matches, wrong ones too.
    error_px, p_wrong : ndarray, shape (n,)
        What `probability_good` follows from; infinite and 1 for a pair that was refused.

    Examples
    --------
    >>> import epigauge as eg
    >>> raw = eg.load_matches(eg.samples.path("raw_matches.csv"))
    >>> result = eg.estimate_fundamental_batch(raw.x1, raw.x2, [0, len(raw)])
    >>> result.F.shape, result.success.tolist(), result.inlier.shape == (len(raw),)
    ((1, 3, 3), [True], True)
    """

    inlier: NDArray[np.bool_] = field(repr=False)
    threshold_px: Array
    offsets: NDArray[np.intp] = field(repr=False)
    error_px: Array
    p_wrong: Array

    def probability_good(self, px: ArrayLike) -> Array:
        """Return the probability of each pair that its median error is below so many pixels.

        Parameters
        ----------
        px : float or array_like, shape (n,)
            Bound, in pixels; or one for each pair.

        Returns
        -------
        ndarray, shape (n,)
            As of `RobustResult.probability_good`; zero for a pair that was refused.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.two_view_scene(n_points=100, noise_px=0.5, seed=1)
        >>> batch = eg.estimate_fundamental_batch(scene.x1, scene.x2, [0, 100])
        >>> batch.probability_good(3.0).shape
        (1,)
        """
        good = probability_below(px, self.error_px, self.p_wrong)
        return np.where(self.status == REFUSED, 0.0, good)

    def _heading(self) -> str:
        return f"RobustBatch: {len(self)} pairs"


@logged
def estimate_fundamental_batch(
    x1: ArrayLike,
    x2: ArrayLike,
    offsets: ArrayLike,
    *,
    robust: FrontEnd = "auto",
    threshold_px: float | Literal["auto"] = "auto",
    score: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    seed: int = 0,
    workers: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int, int], object] | None = None,
    flags: bool = False,
    **options: Unpack[PairOptions],
) -> RobustBatch:
    """Find the fundamental matrices of many pairs of raw matches, each by `estimate_fundamental`.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        The raw matches of all pairs, one pair after the other, in pixels.
    offsets : array_like of int, shape (n + 1,)
        Pair k has the matches ``offsets[k]:offsets[k + 1]``; from 0 to m.
    robust, threshold_px : optional
        As of `estimate_fundamental`.
    score : array_like, shape (m,), optional
        How promising each match is.
    weights : array_like, shape (m,), optional
        Factor of each match's squared distance, in the refinement.
    seed : int
        Of everything random, the same for every pair: results depend neither on the other pairs
        nor on how many are computed at a time.
    workers : int
        Threads.
    executor : concurrent.futures.Executor, optional
        Where to compute, instead of threads of this process, as of `refine_fundamental_batch`.
    progress : callable, optional
        Called as ``progress(done, n)`` after every pair, from the calling thread.
    flags : bool
        Diagnose every pair at once, in the threads, not when `flags` or `success` is asked for.
    **options
        All other options of `refine_fundamental`, the same for every pair.

    Returns
    -------
    RobustBatch
        Arrays with one row a pair. A pair that cannot be estimated (fewer than eight different
        matches) is refused by its status and does not stop the others.

    Raises
    ------
    MissingPackageError
        If the package of the front end is not installed.
    ArgumentError
        On bad shapes, NaN or infinity, offsets that do not partition the matches, and unknown
        options.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(n_points=200, noise_px=0.1)
    >>> x2 = scene.x2.copy()
    >>> x2[::4] = x2[::4][::-1]  # every fourth match is wrong
    >>> batch = eg.estimate_fundamental_batch(scene.x1, x2, [0, 80, 200])
    >>> batch.F.shape, bool(batch.success.all()), bool(batch.inlier[::4].any())
    ((2, 3, 3), True, False)
    """
    known = known_options("estimate_fundamental_batch", options, PairOptions)
    x1, x2 = as_matches(x1, x2, at_least=0)
    bounds = as_offsets(offsets, len(x1))
    checked(robust)
    own: dict[str, Any] = {
        "robust": robust,
        "threshold_px": threshold_px
        if threshold_px == "auto"
        else as_positive("threshold_px", threshold_px),
        "seed": as_count("seed", seed, at_least=0),
    }
    per_match = {
        "score": None if score is None else as_score(score, len(x1)),
        "weights": None if weights is None else as_weights(weights, len(x1)),
    }
    check_options(known)
    if executor is not None:
        no_callback(known)
        call = partial(estimate_fundamental_batch, flags=True, **own, **known)
        return elsewhere(executor, call, (x1, x2, bounds), per_match, {}, _PART, progress)
    work = _Work(x1, x2, bounds, per_match, own, known, flags)
    threads(work.estimate, [range(k, k + 1) for k in range(len(bounds) - 1)], workers, progress)
    return work.result()


class _Work:
    """The pairs, how they are estimated, and the tables their results go to."""

    def __init__(
        self,
        x1: Array,
        x2: Array,
        bounds: NDArray[np.intp],
        per_match: dict[str, Array | None],
        own: dict[str, Any],
        options: dict[str, Any],
        flags: bool,
    ) -> None:
        self.x1, self.x2, self.bounds, self.per_match = x1, x2, bounds, per_match
        self.own, self.options, self.flags = own, options, flags
        count = len(bounds) - 1
        kinds = {"nfev": np.intp, "njev": np.intp, "nit": np.intp}
        self.known: dict[str, Any] = {
            name: np.zeros(count, kinds.get(name, float)) for name in _NOW
        }
        self.known |= {
            "F": np.zeros((count, 3, 3)),
            "status": np.full(count, REFUSED, dtype=np.intp),
            "distances": np.zeros(len(x1)),
            "inlier": np.zeros(len(x1), np.bool_),
            "offsets": bounds,
        }
        self.reasons: dict[int, str] = {}
        self.results: dict[int, RobustResult] = {}

    def estimate(self, chunk: range) -> None:
        """Estimate some pairs."""
        for k in chunk:
            rows = slice(int(self.bounds[k]), int(self.bounds[k + 1]))
            chosen: dict[str, Any] = {
                name: None if value is None else value[rows]
                for name, value in self.per_match.items()
            }
            options = self.options | {"weights": chosen.pop("weights")}
            try:
                result, distances = estimated(
                    self.x1[rows], self.x2[rows], **self.own, **chosen, options=options
                )
            except ArgumentError as error:
                self.reasons[k] = str(error)
                continue
            for name in _NOW:
                self.known[name][k] = getattr(result, name)
            self.known["distances"][rows] = distances
            self.known["inlier"][rows] = result.inlier
            self.results[k] = result
            if self.flags:
                _ = result.flags  # computed when asked for

    def result(self) -> RobustBatch:
        """Return the batch; what is costly is computed when it is asked for."""
        known = self.known | {"reasons": dict(sorted(self.reasons.items()))}
        return RobustBatch.partial(known, self._rest, flags=self._judged, success=self._judged)

    def _judged(self) -> SimpleNamespace:
        """Return flags and success of all pairs."""
        count = range(len(self.bounds) - 1)
        return SimpleNamespace(
            flags=tuple(self.results[k].flags if k in self.results else () for k in count),
            success=np.array(
                [k in self.results and self.results[k].success for k in count], np.bool_
            ),
        )

    def _rest(self) -> SimpleNamespace:
        """Return what takes longer than the estimate, neutral for pairs that were refused."""
        count = len(self.bounds) - 1
        rest = SimpleNamespace(
            noise_px=np.zeros(count),
            condition=np.full(count, np.inf),
            covariance=np.tile(np.diag(np.full(9, np.inf)), (count, 1, 1)),
            rank=np.zeros(count, dtype=np.intp),
            error_px=np.full(count, np.inf),
            p_wrong=np.ones(count),
        )
        for k, result in self.results.items():
            for name in _LATER:
                getattr(rest, name)[k] = getattr(result, name)
        return rest
