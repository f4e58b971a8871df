"""Many image pairs in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from functools import partial
from types import SimpleNamespace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import arrays
from epigauge._arguments import as_array, as_matches, as_real, as_weights
from epigauge._logged import logged
from epigauge._options import PairOptions, known_options
from epigauge.errors import ArgumentError
from epigauge.two_view import native, quick, tensors
from epigauge.two_view.batch_parts import elsewhere, no_callback, threads
from epigauge.two_view.batch_result import FundamentalBatch
from epigauge.two_view.copies import counted_once
from epigauge.two_view.express import completed
from epigauge.two_view.refine import plan_of, refine_fundamental
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.tensors import REFUSED

__all__ = ["as_offsets", "check_options", "refine_fundamental_batch"]

Array = NDArray[np.float64]

#: Pairs that a thread refines at a time.
_CHUNK = 64

#: Pairs that go to an executor at a time: results travel back, so that there are more.
_PART = 4 * _CHUNK


@logged
def refine_fundamental_batch(
    x1: ArrayLike,
    x2: ArrayLike,
    offsets: ArrayLike,
    F0: ArrayLike | None = None,
    *,
    weights: ArrayLike | None = None,
    workers: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int, int], object] | None = None,
    flags: bool = False,
    **options: Unpack[PairOptions],
) -> FundamentalBatch:
    """Refine the fundamental matrices of many pairs, each as by `refine_fundamental`.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        The matches of all pairs, one pair after the other, in pixels. Arrays of PyTorch, JAX, CuPy
        and others of the array API standard are refined where they are, all pairs at once, by the
        exact Newton loop only; the result then holds arrays of the same kind, through which
        derivatives of F, cost and distances by x1 and x2 can be taken (extra ``array``).
    offsets : array_like of int, shape (n + 1,)
        Pair k has the matches ``offsets[k]:offsets[k + 1]``; from 0 to m.
    F0 : array_like, shape (n, 3, 3), optional
        Start values; by default the 8-point estimates.
    weights : array_like, shape (m,), optional
        Factor of each match's squared distance.
    workers : int
        Threads. The results do not depend on it.
    executor : concurrent.futures.Executor, optional
        Where to refine, instead of threads of this process: a pool of threads or processes, Dask's
        ``client.get_executor()``, or anything else with this interface. The results are the same;
        covariances, flags and success are then computed there, too.
    progress : callable, optional
        Called as ``progress(done, n)`` after every pair, from the calling thread.
    flags : bool
        Diagnose every pair at once, not when `flags` or `success` of the result is asked for.
    **options
        All other options of `refine_fundamental`, the same for every pair;
        ``backend="array"`` computes NumPy arrays as those of other libraries. Of these options
        arrays of other libraries take `ftol`, `xtol`, `gtol` and `max_iter` only.

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

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> batch = eg.refine_fundamental_batch(scene.x1, scene.x2, [0, 20, 50])
    >>> batch.F.shape, bool(batch.success.all())
    ((2, 3, 3), True)
    """
    known = known_options("refine_fundamental_batch", options, PairOptions)
    if arrays.is_tensor(x1) or known.get("backend") == "array":
        found = _over_arrays(x1, x2, offsets, F0, weights, known)
        if flags:
            _ = found.flags  # computed when asked for
        return found
    x1, x2 = as_matches(x1, x2, at_least=0)
    bounds = as_offsets(offsets, len(x1))
    count = len(bounds) - 1
    w = None if weights is None else as_weights(weights, len(x1))
    needed = f"a ({count}, 3, 3) array"
    starts = None if F0 is None else np.ascontiguousarray(as_real("F0", F0, needed))
    if starts is not None and starts.shape != (count, 3, 3):
        raise ArgumentError("F0", f"has shape {starts.shape}", f"({count}, 3, 3)")
    check_options(known)
    if executor is not None:
        no_callback(known)
        call = partial(refine_fundamental_batch, flags=True, **known)
        more = {"weights": w}, {"F0": starts}
        return elsewhere(executor, call, (x1, x2, bounds), *more, _PART, progress)
    work = _Work(x1, x2, bounds, starts, w, known)
    size = 1 if work.plan.native is None else _CHUNK
    chunks = [range(first, min(first + size, count)) for first in range(0, count, size)]
    threads(work.refine, chunks, workers, progress)
    return work.result(flags)


def as_offsets(offsets: ArrayLike, m: int) -> NDArray[np.intp]:
    """Check that offsets partition m matches."""
    bounds = as_array("offsets", offsets, "an (n + 1,) array")
    if bounds.ndim != 1 or len(bounds) < 1 or bounds.dtype.kind not in "iu":
        raise ArgumentError("offsets", f"is {bounds.dtype} {bounds.shape}", "(n + 1,) integers")
    if bounds[0] != 0 or bounds[-1] != m or np.any(np.diff(bounds.astype(np.int64)) < 0):
        raise ArgumentError("offsets", "do not partition the matches", f"a rise from 0 to {m}")
    return bounds.astype(np.intp)


def check_options(options: dict[str, Any]) -> None:
    """Raise now, and not once a pair, what is wrong with every pair: tried on a made-up one."""
    # Which no callback is to hear of.
    options = {name: value for name, value in options.items() if name != "callback"}
    for name in ("covariance1", "covariance2"):
        if options.get(name) is not None and as_array(name, options[name], "(2, 2)").ndim == 3:
            raise ArgumentError(name, "is one a match", "a (2, 2) array, the same for all matches")
    grid = np.stack(np.meshgrid([0.0, 1.0, 2.5], [0.0, 1.0, 3.0]), axis=-1).reshape(-1, 2)
    refine_fundamental(grid, grid @ [[1.0, 0.2], [0.1, 1.1]] + grid**2, **options)


def _over_arrays(
    x1: Any, x2: Any, offsets: ArrayLike, F0: Any, weights: Any, options: dict[str, Any]
) -> FundamentalBatch:
    """Refine over the namespace of the matches; what is costly is computed by NumPy when asked."""
    if not arrays.is_tensor(x1):
        x1, x2 = as_matches(x1, x2, at_least=0)
    host1, host2 = as_matches(arrays.host(x1), arrays.host(x2), at_least=0)
    bounds = as_offsets(offsets, len(host1))
    known = tensors.refined(x1, x2, (host1, host2), bounds, F0, weights, options)
    convert = tensors.like(x1)

    def rest() -> SimpleNamespace:
        starts = arrays.host(known["F"])
        refused = list(known["reasons"])
        starts[refused] = np.eye(3)
        given = None if weights is None else arrays.host(weights)
        found = refine_fundamental_batch(host1, host2, bounds, starts, weights=given)
        names = ("noise_px", "condition", "covariance")
        values = {name: convert(getattr(found, name)) for name in names}
        success = found.success & (known["status"] > 0)
        return SimpleNamespace(**values, rank=found.rank, flags=found.flags, success=success)

    return FundamentalBatch.partial(known, rest)


class _Work:
    """The pairs, how they are refined, and the tables their results go to."""

    def __init__(
        self,
        x1: Array,
        x2: Array,
        bounds: NDArray[np.intp],
        starts: Array | None,
        weights: Array | None,
        options: dict[str, Any],
    ) -> None:
        self.x1, self.x2, self.bounds = x1, x2, bounds
        self.starts, self.weights = starts, counted_once(x1, x2, weights, bounds)
        self.options, self.plan = options, plan_of(options)
        count = len(bounds) - 1
        self.known: dict[str, Any] = {
            "F": np.zeros((count, 3, 3)),
            **{name: np.zeros(count) for name in ("sigma", "cost", "rms_px")},
            **{name: np.zeros(count, dtype=np.intp) for name in ("nfev", "njev", "nit")},
            "status": np.full(count, REFUSED, dtype=np.intp),
            "distances": np.zeros(len(x1)),
        }
        self.reasons: dict[int, str] = {}
        #: Whole results of pairs refined one by one, and how to get those of the others.
        self.results: dict[int, FundamentalResult] = {}
        self.tables: dict[int, native.Pair] = {}

    def refine(self, chunk: range) -> None:
        """Refine some pairs: by the compiled loop, or one by one."""
        rest: Iterable[int] = chunk
        if self.plan.native is not None:
            rest = self._compiled(chunk, self.plan.native)
        for k in rest:
            self._one(k)

    def _compiled(self, chunk: range, options: native.PairOptions) -> list[int]:
        """Refine what is plainly in order; return the others."""
        first, last = chunk.start, chunk.stop
        rows = self._rows(first, last)
        pairs = native.refine_pairs(
            self.x1[rows],
            self.x2[rows],
            self.bounds[first : last + 1] - self.bounds[first],
            None if self.starts is None else self.starts[first:last],
            None if self.weights is None else self.weights[rows],
            options,
        )
        done = pairs.numbers[:, 0] == 0
        own = slice(first, last)
        for name, values in columns(pairs).items():
            self.known[name][own][done] = values[done]
        self.known["distances"][rows] = pairs.distances
        self.tables[first] = pairs
        return [first + int(i) for i in np.flatnonzero(~done)]

    def _one(self, k: int) -> None:
        rows = self._rows(k, k + 1)
        self.known["distances"][rows] = 0.0
        try:
            result = refine_fundamental(
                self.x1[rows],
                self.x2[rows],
                None if self.starts is None else self.starts[k],
                weights=None if self.weights is None else self.weights[rows],
                **self.options,
            )
        except ArgumentError as error:
            self.reasons[k] = str(error)
            return
        self.results[k] = result
        for name in self.known:
            if name != "distances":
                self.known[name][k] = getattr(result, name)
        self.known["distances"][rows] = result.fun

    def _rows(self, first: int, last: int) -> slice:
        return slice(int(self.bounds[first]), int(self.bounds[last]))

    def result(self, flags: bool) -> FundamentalBatch:
        """Return the batch; what is costly is computed when it is asked for."""
        known = self.known | {"reasons": dict(sorted(self.reasons.items()))}
        # The caller may write into the arrays before the rest is computed.
        self.x1, self.x2 = self.x1.copy(), self.x2.copy()
        self.weights = None if self.weights is None else self.weights.copy()
        if flags:
            known |= self._judged().__dict__
        return FundamentalBatch.partial(known, self._rest, flags=self._judged, success=self._judged)

    def _judged(self) -> SimpleNamespace:
        """Return flags and success of all pairs."""
        found: list[tuple[tuple[str, ...] | None, bool]] = [((), False)] * len(self.known["F"])
        for first, pairs in self.tables.items():
            found[first : first + len(pairs.table)] = self._quickly(first, pairs)
        for k, (flags, _) in enumerate(found):
            if k not in self.reasons and (flags is None or k in self.results):
                whole = self._whole(k)
                found[k] = whole.flags, whole.success
        return SimpleNamespace(
            flags=tuple(flags or () for flags, _ in found),
            success=np.array([success for _, success in found], np.bool_),
        )

    def _quickly(self, first: int, pairs: native.Pair) -> list[tuple[tuple[str, ...] | None, bool]]:
        """Return flags and success of a chunk as far as cheap tests suffice."""
        last = first + len(pairs.table)
        if self.plan.options.criterion != "reprojection":
            return [(None, False)] * (last - first)
        rows, offsets = self._rows(first, last), self.bounds[first : last + 1] - self.bounds[first]
        weights = None if self.weights is None else self.weights[rows]
        return quick.verdicts_of(pairs, self.x1[rows], self.x2[rows], offsets, weights)

    def _rest(self) -> SimpleNamespace:
        """Return what takes longer than the refinement, neutral for pairs that were refused."""
        count = len(self.bounds) - 1
        rest = SimpleNamespace(
            noise_px=np.zeros(count),
            condition=np.full(count, np.inf),
            covariance=np.tile(np.diag(np.full(9, np.inf)), (count, 1, 1)),
            rank=np.zeros(count, dtype=np.intp),
        )
        for k in range(count):
            if k not in self.reasons:
                whole = self._whole(k)
                for name in rest.__dict__:
                    getattr(rest, name)[k] = getattr(whole, name)
        return rest

    def _whole(self, k: int) -> FundamentalResult:
        if k in self.results:
            return self.results[k]
        rows, first = self._rows(k, k + 1), k - k % _CHUNK
        weights = None if self.weights is None else self.weights[rows]
        plan = self.plan
        return completed(
            self.tables[first],
            k - first,
            self.x1[rows],
            self.x2[rows],
            weights,
            plan.options,
            plan.noise_px,
        )


def columns(pairs: native.Pair) -> dict[str, NDArray[Any]]:
    """Return what the compiled loop tells of each pair, in pixels."""
    _, nfev, njev, nit, status = pairs.numbers.T
    table = pairs.table
    with np.errstate(all="ignore"):  # rows of pairs that were left alone hold anything
        return {
            "F": table[:, :9].reshape(-1, 3, 3),
            "sigma": table[:, 27],
            "cost": table[:, 28] * table[:, 35] ** 2,
            "rms_px": table[:, 35] * np.sqrt(table[:, 29] / (4.0 * table[:, 30])),
            "nfev": nfev,
            "njev": njev,
            "nit": nit,
            "status": status,
        }
