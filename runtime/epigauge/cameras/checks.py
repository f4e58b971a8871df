"""Checks that cameras and reconstructions share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_real
from epigauge.errors import ArgumentError

__all__ = ["counted", "finite_rows", "frozen"]

Array = NDArray[np.float64]

#: Parameters, positions and points are accepted up to this size.
MAX_SIZE = 1e15


def finite_rows(name: str, value: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """Return finite numbers (n, *shape)."""
    needed = f"({', '.join(map(str, ('n', *shape)))}): {what}"
    array = as_real(name, value, needed)
    if array.ndim != 1 + len(shape) or array.shape[1:] != shape:
        raise ArgumentError(name, f"has shape {array.shape}", needed)
    entries = tuple(range(1, array.ndim))
    bad = np.flatnonzero(~(np.abs(array) <= MAX_SIZE).all(axis=entries))
    if len(bad):
        row = array[bad[0]]
        worst = row[~(np.abs(row) <= MAX_SIZE)][0]
        raise ArgumentError(name, f"has {worst} in row {bad[0]}", f"numbers up to {MAX_SIZE:g}")
    return array


def frozen(array: NDArray[Any]) -> Any:
    """Return a copy that nobody writes to."""
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def counted(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
