"""Many image pairs in one call."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import lm
from epigauge._arguments import as_count, as_matches, as_weights
from epigauge.errors import ArgumentError
from epigauge.two_view.refine import refine_fundamental
from epigauge.two_view.result import FundamentalResult

__all__ = ["BATCH_STATUS", "FundamentalBatch", "refine_fundamental_batch"]

Array = NDArray[np.float64]

#: Status of a pair that could not be refined, beside those of `epigauge.lm.STATUS`.
REFUSED = -9

#: Meaning of `FundamentalBatch.status`.
BATCH_STATUS = lm.STATUS | {REFUSED: "the matches of this pair cannot determine F: see `reasons`"}


@dataclass(frozen=True)
class FundamentalBatch:
    """Results of many pairs, one row a pair; fields as in `FundamentalResult`.

    Attributes
    ----------
    F : ndarray, shape (n, 3, 3)
        Fundamental matrices; zero where the pair was refused.
    sigma, cost, rms_px, noise_px, condition : ndarray, shape (n,)
        Per pair; zero where it was refused, `condition` infinite.
    covariance : ndarray, shape (n, 9, 9)
        Covariance of vect(F); infinite on the diagonal where it is not determined.
    rank, nfev, njev, nit, status : ndarray of int, shape (n,)
        Per pair; `status` is that of `BATCH_STATUS`, -9 for a refused pair.
    success : ndarray of bool, shape (n,)
        Whether `status` is positive.
    distances : ndarray, shape (m,)
        Signed distances of all matches, in the order they were given.
    reasons : dict of int to str
        Why a pair was refused, by its number.
    """

    F: Array
    sigma: Array
    cost: Array
    rms_px: Array
    noise_px: Array
    condition: Array
    covariance: Array
    rank: NDArray[np.intp]
    nfev: NDArray[np.intp]
    njev: NDArray[np.intp]
    nit: NDArray[np.intp]
    status: NDArray[np.intp]
    success: NDArray[np.bool_]
    distances: Array
    reasons: dict[int, str]

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.F)


def refine_fundamental_batch(
    x1: ArrayLike,
    x2: ArrayLike,
    offsets: ArrayLike,
    F0: ArrayLike | None = None,
    *,
    weights: ArrayLike | None = None,
    workers: int = 1,
    progress: Callable[[int, int], object] | None = None,
    **options: Any,
) -> FundamentalBatch:
    """Refine the fundamental matrices of many pairs, each as by `refine_fundamental`.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        The matches of all pairs, one pair after the other, in pixels.
    offsets : array_like of int, shape (n + 1,)
        Pair k has the matches ``offsets[k]:offsets[k + 1]``; from 0 to m.
    F0 : array_like, shape (n, 3, 3), optional
        Start values; by default the 8-point estimates.
    weights : array_like, shape (m,), optional
        Factor of each match's squared distance.
    workers : int
        Threads. The results do not depend on it.
    progress : callable, optional
        Called as ``progress(done, n)`` after every pair, from the calling thread.
    **options
        All other options of `refine_fundamental`, the same for every pair.

    Returns
    -------
    FundamentalBatch
        Arrays with one row a pair. A pair that cannot determine F (fewer than eight matches, all
        points equal or on one line) is refused by its status and does not stop the others.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN or infinity, offsets that do not partition the matches, and unknown
        options.
    """
    x1, x2 = as_matches(x1, x2, at_least=0)
    bounds = _as_offsets(offsets, len(x1))
    count = len(bounds) - 1
    w = None if weights is None else as_weights(weights, len(x1))
    starts = None if F0 is None else np.asarray(F0, dtype=np.float64)
    if starts is not None and starts.shape != (count, 3, 3):
        raise ArgumentError("F0", f"has shape {starts.shape}", f"({count}, 3, 3)")
    _check_options(options)

    def one(k: int) -> FundamentalResult | str:
        rows = slice(bounds[k], bounds[k + 1])
        try:
            return refine_fundamental(
                x1[rows],
                x2[rows],
                None if starts is None else starts[k],
                weights=None if w is None else w[rows],
                **options,
            )
        except ArgumentError as error:
            return str(error)

    results: list[FundamentalResult | str] = [""] * count
    with ThreadPoolExecutor(as_count("workers", workers)) as pool:
        futures = {pool.submit(one, k): k for k in range(count)}
        for done, future in enumerate(as_completed(futures), start=1):
            results[futures[future]] = future.result()
            if progress is not None:
                progress(done, count)
    return _gather(results, bounds)


def _as_offsets(offsets: ArrayLike, m: int) -> NDArray[np.intp]:
    """Check that offsets partition m matches."""
    bounds = np.asarray(offsets)
    if bounds.ndim != 1 or len(bounds) < 1 or bounds.dtype.kind not in "iu":
        raise ArgumentError("offsets", f"is {bounds.dtype} {bounds.shape}", "(n + 1,) integers")
    if bounds[0] != 0 or bounds[-1] != m or np.any(np.diff(bounds.astype(np.int64)) < 0):
        raise ArgumentError("offsets", "do not partition the matches", f"a rise from 0 to {m}")
    return bounds.astype(np.intp)


def _check_options(options: dict[str, Any]) -> None:
    """Raise now, and not once a pair, what is wrong with every pair: tried on a made-up one."""
    grid = np.stack(np.meshgrid([0.0, 1.0, 2.5], [0.0, 1.0, 3.0]), axis=-1).reshape(-1, 2)
    refine_fundamental(grid, grid @ [[1.0, 0.2], [0.1, 1.1]] + grid**2, **options)


def _gather(results: list[FundamentalResult | str], bounds: NDArray[np.intp]) -> FundamentalBatch:
    """Return results as arrays, neutral rows for those refused."""
    count = len(results)
    batch = FundamentalBatch(
        F=np.zeros((count, 3, 3)),
        sigma=np.zeros(count),
        cost=np.zeros(count),
        rms_px=np.zeros(count),
        noise_px=np.zeros(count),
        condition=np.full(count, np.inf),
        covariance=np.tile(np.diag(np.full(9, np.inf)), (count, 1, 1)),
        rank=np.zeros(count, dtype=np.intp),
        nfev=np.zeros(count, dtype=np.intp),
        njev=np.zeros(count, dtype=np.intp),
        nit=np.zeros(count, dtype=np.intp),
        status=np.full(count, REFUSED, dtype=np.intp),
        success=np.zeros(count, dtype=np.bool_),
        distances=np.zeros(int(bounds[-1])),
        reasons={k: result for k, result in enumerate(results) if isinstance(result, str)},
    )
    shared = set(FundamentalBatch.__dataclass_fields__) - {"distances", "reasons"}
    for k, result in enumerate(results):
        if not isinstance(result, str):
            for name in shared:
                getattr(batch, name)[k] = getattr(result, name)
            batch.distances[bounds[k] : bounds[k + 1]] = result.fun
    return batch
