"""Where pairs of a batch are computed: in threads, or in parts wherever an executor has room."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_count
from epigauge.errors import ArgumentError
from epigauge.two_view.batch_result import FundamentalBatch

__all__ = ["elsewhere", "no_callback", "threads"]

Array = NDArray[np.float64]

Batch = TypeVar("Batch", bound=FundamentalBatch)


def threads(
    work: Callable[[range], object],
    chunks: list[range],
    workers: int,
    progress: Callable[[int, int], object] | None,
) -> None:
    """Work on chunks of pairs in threads; tell of every pair from the calling one."""
    done, count = 0, chunks[-1].stop if chunks else 0
    with ThreadPoolExecutor(as_count("workers", workers)) as pool:
        futures = {pool.submit(work, chunk): chunk for chunk in chunks}
        try:
            for future in as_completed(futures):
                future.result()
                for _ in futures[future]:
                    done += 1
                    if progress is not None:
                        progress(done, count)
        finally:  # the pool waits for what was submitted: after an error or Ctrl-C, drop the rest
            for future in futures:
                future.cancel()


def elsewhere(
    executor: Executor,
    call: Callable[..., Batch],
    matches: tuple[Array, Array, NDArray[np.intp]],
    per_match: dict[str, Array | None],
    per_pair: dict[str, Array | None],
    size: int,
    progress: Callable[[int, int], object] | None,
) -> Batch:
    """Call a batch function for parts of some pairs wherever an executor has room.

    Parameters
    ----------
    executor : Executor
        As of `refine_fundamental_batch`.
    call : callable
        Takes x1, x2 and offsets of a part, and the arguments by name; computes everything, since
        results travel back. A `functools.partial` of the function and of its other options.
    matches : (ndarray, ndarray, ndarray)
        x1, x2 and offsets of all pairs.
    per_match, per_pair : dict
        Arguments with a row a match, and with a row a pair.
    size : int
        Pairs a part.
    progress : callable or None
        As of `refine_fundamental_batch`.

    Returns
    -------
    FundamentalBatch
        The results in order, of the kind that `call` returns.
    """
    x1, x2, bounds = matches
    count = len(bounds) - 1
    if not callable(getattr(executor, "submit", None)):
        needed = "one as of concurrent.futures: it has a method submit"
        raise ArgumentError("executor", f"is of type {type(executor).__name__}", needed)
    futures = {}
    for first in range(0, max(count, 1), size):
        last = min(first + size, count)
        rows, own = slice(int(bounds[first]), int(bounds[last])), slice(first, last)
        more = {
            name: None if value is None else value[chosen]
            for arguments, chosen in ((per_match, rows), (per_pair, own))
            for name, value in arguments.items()
        }
        offsets = bounds[first : last + 1] - bounds[first]
        futures[first] = executor.submit(call, x1[rows], x2[rows], offsets, **more)
    parts: list[Batch] = []
    done = 0
    try:
        for first, future in futures.items():
            parts.append(future.result())
            for _ in range(min(size, count - first)):
                done += 1
                if progress is not None:
                    progress(done, count)
    finally:  # after an error or Ctrl-C, drop what has not begun
        for future in futures.values():
            future.cancel()
    return _joined(parts, list(futures), bounds)


def no_callback(options: dict[str, Any]) -> None:
    """Refuse a callback among options that travel."""
    if options.get("callback") is not None:
        raise ArgumentError("callback", "cannot be called from elsewhere", "none with an executor")


def _joined(parts: list[Batch], firsts: list[int], bounds: NDArray[np.intp]) -> Batch:
    """Put parts of a batch together, which begin with these pairs."""
    values: dict[str, Any] = {}
    for name in type(parts[0]).__dataclass_fields__:
        own = [getattr(part, name) for part in parts]
        if name == "reasons":
            values[name] = {
                first + k: reason
                for first, reasons in zip(firsts, own, strict=True)
                for k, reason in reasons.items()
            }
        elif name == "offsets":
            values[name] = bounds
        else:
            values[name] = tuple(chain(*own)) if name == "flags" else np.concatenate(own)
    return type(parts[0])(**values)
