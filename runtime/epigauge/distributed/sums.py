"""Sums over partitions in one fixed tree: the same bits wherever the terms are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Rows", "Terms", "combined", "whole"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Place in the tree: level, and number there. Level 0 are the partitions.
Node = tuple[int, int]
Terms = tuple[Any, ...]


@dataclass(frozen=True)
class Rows:
    """Some rows of an array whose others are zero.

    Attributes
    ----------
    index : ndarray of int, shape (k,)
        Which rows, rising.
    values : ndarray, shape (k, ...)
        The rows.
    """

    index: Indices
    values: Array

    def __add__(self, other: Rows) -> Rows:
        """Return the sum, with the rows of both."""
        if np.array_equal(self.index, other.index):
            return Rows(self.index, self.values + other.values)
        index = np.union1d(self.index, other.index)
        values = np.zeros((len(index), *self.values.shape[1:]))
        values[np.searchsorted(index, self.index)] = self.values
        values[np.searchsorted(index, other.index)] += other.values
        return Rows(index, values)

    def spread(self, count: int) -> Array:
        """Return the whole array of so many rows."""
        if len(self.index) == count:
            return self.values
        result = np.zeros((count, *self.values.shape[1:]))
        result[self.index] = self.values
        return result


def combined(terms: Mapping[Node, Terms], count: int) -> dict[Node, Terms]:
    """Add up what of the tree over `count` partitions can be.

    A node is the sum of its two children, in this order; one without a sibling moves up as it is.
    Terms may be joined here and there: the additions are the same.
    """
    found, width, level = dict(terms), count, 0
    while width > 1:
        for number in range(0, width, 2):
            left = found.get((level, number))
            if left is None:
                continue
            if number + 1 == width:
                found[level + 1, number // 2] = found.pop((level, number))
            elif (level, number + 1) in found:
                del found[level, number]
                right = found.pop((level, number + 1))
                found[level + 1, number // 2] = tuple(
                    a + b for a, b in zip(left, right, strict=True)
                )
        width, level = -(-width // 2), level + 1
    return found


def whole(terms: Mapping[Node, Terms], count: int) -> Terms:
    """Return the sum over all partitions."""
    (total,) = combined(terms, count).values()
    return total
