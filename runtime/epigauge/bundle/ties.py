"""Ties: a view's own parameters and a point's as linear functions of the unknowns.

The own tangent of view i is A_i x_i + E_i s[index_i], with x_i unknowns of its own and s shared by
several views; that of point j is C_j y_j. Shared intrinsics, fixed parameters, reference cameras
and points, B&S's A_perp and whitening by a damping are all such ties. A column of zeros freezes an
unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ties", "congruent"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Ties:
    """What the own tangents of views and points are made of; None stands for identities.

    Attributes
    ----------
    A : ndarray, shape (n, d, a), or None
        From the own unknowns of a view.
    E : ndarray, shape (n, d, e), or None
        From the shared unknowns that the view depends on; None where nothing is shared.
    index : ndarray of int, shape (n, e), or None
        Which those are; a column of zeros in E may have any.
    n_shared : int
        Number of shared unknowns.
    C : ndarray, shape (m, b, b'), or None
        From the unknowns of a point.
    """

    A: Array | None = None
    E: Array | None = None
    index: Indices | None = None
    n_shared: int = 0
    C: Array | None = None

    @property
    def used(self) -> Indices | None:
        """Return which entries of a view's own tangent any unknown moves; None for all."""
        if self.A is None:
            return None
        moved = self.A.any(axis=(0, 2))
        return np.flatnonzero(moved if self.E is None else moved | self.E.any(axis=(0, 2)))

    def then(self, B_cameras: Array | None, B_points: Array | None) -> Ties:
        """Return the ties of other unknowns z with x = B_cameras z and y = B_points z."""
        return replace(self, A=_product(self.A, B_cameras), C=_product(self.C, B_points))

    def scaled(self, factors: Array) -> Ties:
        """Return the ties of other shared unknowns z with s = factors z."""
        if self.E is None:
            return self
        return replace(self, E=self.E * factors[self.index][:, None, :])

    def cameras(self, x: Array, s: Array) -> Array:
        """Return the own tangents of views (n, d, k) for unknowns (n, a, k) and (r, k)."""
        own = x if self.A is None else self.A @ x
        return own if self.E is None else own + self.E @ s[self.index]

    def points(self, y: Array) -> Array:
        """Return the own tangents of points (m, b, k) for unknowns (m, b', k)."""
        return y if self.C is None else self.C @ y

    def local(self, own: Array) -> Array:
        """Return A^T times (n, d, k)."""
        return own if self.A is None else np.swapaxes(self.A, 1, 2) @ own

    def shared(self, own: Array) -> Array:
        """Return the sum of E_i^T times (n, d, k) in the shared unknowns, (r, k)."""
        total = np.zeros((self.n_shared, own.shape[2]))
        if self.E is not None and self.index is not None:
            np.add.at(total, self.index, np.swapaxes(self.E, 1, 2) @ own)
        return total

    def of_points(self, own: Array) -> Array:
        """Return C^T times (m, b, k)."""
        return own if self.C is None else np.swapaxes(self.C, 1, 2) @ own

    def border(self, n: int, d: int) -> Array:
        """Return E spread over all shared unknowns, (n, d, r)."""
        whole = np.zeros((n, d, self.n_shared))
        if self.E is not None:
            assert self.index is not None
            # Columns of zeros may name an unknown that another column has.
            np.add.at(
                whole.transpose(0, 2, 1),
                (np.arange(n)[:, None], self.index),
                np.swapaxes(self.E, 1, 2),
            )
        return whole


def congruent(B: Array | None, blocks: Array) -> Array:
    """Return B^T blocks B, with ones on the diagonal where B has a column of zeros."""
    if B is None:
        return blocks
    result = np.swapaxes(B, 1, 2) @ blocks @ B
    k, i = np.nonzero(~B.any(axis=1))
    result[k, i, i] = 1.0
    return np.asarray(result)


def _product(first: Array | None, second: Array | None) -> Array | None:
    if first is None or second is None:
        return second if first is None else first
    return np.asarray(first @ second)
