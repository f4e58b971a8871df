"""Passes of C functions over the chunks of observations, shared among threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import Part, Share, aligned_zeros, checked, function
from epigauge.bundle.lanes import LaneLayout, Range

__all__ = ["Passes"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class Passes:
    """Ranges of chunks, one a thread, and the threads.

    Each thread has sums of its own, added up in a fixed order: the same number of threads gives the
    same result to the last bit.

    Parameters
    ----------
    layout : LaneLayout
        The chunks.
    workers : int
        Most threads; the calling one is the first. Little work takes fewer.
    """

    def __init__(self, layout: LaneLayout, workers: int) -> None:
        self._passes, self._pairs = layout.shares(workers)
        self._pool = ThreadPoolExecutor(self.workers - 1) if self.workers > 1 else None

    @property
    def workers(self) -> int:
        """Return how many threads work."""
        return max(len(self._passes), len(self._pairs))

    @property
    def edges(self) -> tuple[Indices, Indices]:
        """Return where the threads' ranges of chunks end, for passes and for those over pairs."""
        passes, pairs = ([0, *(end for _, end in own)] for own in (self._passes, self._pairs))
        return np.array(passes, np.intp), np.array(pairs, np.intp)

    @cached_property
    def share(self) -> Any:
        """Return what does the parts of a pass at the same time, an eg_share; null if alone."""
        pool = self._pool  # not self: the threads end with it

        def together(part: int, work: int, count: int) -> None:
            call = Part(part)
            _together(pool, [partial(call, work, k) for k in range(count)])

        return Share() if pool is None else Share(together)

    def each(self, name: str, *arguments: Any, pairs: bool = False) -> None:
        """Call a C function for all chunks, which write to places of their own.

        The first argument is the bundle; `pairs` tells that it works on pairs of observations.
        """
        call, (bundle, *rest) = function(name), arguments
        self._share(pairs, lambda _, begin, end: call(bundle, begin, end, *rest))

    def summed(
        self,
        name: str,
        bundle: Any,
        before: tuple[Any, ...],
        *shapes: tuple[int, ...],
        pairs: bool = False,
    ) -> list[Array]:
        """Call a C function for all chunks, which add to its last arguments, arrays of `shapes`.

        `pairs` tells that it works on pairs of observations.
        """
        call, count = function(name), len(self._pairs if pairs else self._passes)
        sums = [[aligned_zeros(shape) for shape in shapes] for _ in range(count)]
        self._share(
            pairs,
            lambda k, begin, end: call(bundle, begin, end, *before, *map(address, sums[k])),
        )
        for others in sums[1:]:
            for total, other in zip(sums[0], others, strict=True):
                total += other
        return sums[0]

    def over(self, m: int, call: Callable[[slice], Any]) -> list[Any]:
        """Call a function with as many ranges of m points as there are workers."""
        count = len(self._passes)
        edges = [m * k // count for k in range(count + 1)]
        parts = [slice(begin, end) for begin, end in zip(edges[:-1], edges[1:], strict=True)]
        return _together(self._pool, [partial(call, part) for part in parts])

    def _share(self, pairs: bool, call: Callable[[int, int, int], int]) -> None:
        ranges: list[Range] = self._pairs if pairs else self._passes
        calls = [partial(call, k, *own) for k, own in enumerate(ranges)]
        for status in _together(self._pool, calls):
            checked(status)


def _together(pool: ThreadPoolExecutor | None, calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Make calls at the same time, the first one here."""
    if pool is None:
        return [call() for call in calls]
    pending = [pool.submit(call) for call in calls[1:]]
    try:
        return [calls[0](), *(future.result() for future in pending)]
    finally:  # C has addresses only: after Ctrl-C, too, the arrays stay until it is done
        wait(pending)
