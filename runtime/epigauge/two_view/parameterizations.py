"""Ways to represent and update a fundamental matrix during the optimisation.

Each offers the same few methods, so that the problems know nothing of the representation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table

__all__ = ["PARAMETERIZATIONS", "Ortho", "OrthonormalF", "factorize"]

Array = NDArray[np.float64]


class OrthonormalF(NamedTuple):
    """The orthonormal representation F ~ U diag(1, sigma, 0) V^T of B&S section 3.2.

    Attributes
    ----------
    U, V : ndarray, shape (3, 3)
        Orthonormal matrices; the epipoles are their last columns, e' = u3 and e = v3.
    sigma : ndarray, shape ()
        Ratio of the singular values.
    """

    U: Array
    V: Array
    sigma: Array


def factorize(F: Array) -> OrthonormalF:
    """Return the orthonormal representation of the rank-2 matrix nearest to F.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Not zero; of any scale and sign.

    Returns
    -------
    OrthonormalF
        With 0 <= sigma <= 1 (B&S Table 1, step i').
    """
    U, values, Vt = np.linalg.svd(F)
    return OrthonormalF(U, Vt.T, np.asarray(values[1] / values[0]))


class Ortho:
    """Seven parameters: U <- U R(x), V <- V R(y), sigma <- sigma + delta_sigma (B&S eq. 3)."""

    dimension = 7

    def __init__(self, kernels: Table) -> None:
        self._kernels = kernels

    def start(self, F: Array) -> OrthonormalF:
        """Return the representation of a start value."""
        return factorize(F)

    def fundamental(self, estimate: OrthonormalF) -> Array:
        """Return F (B&S eq. 2)."""
        return np.asarray(self._kernels.fundamental_from_factors(*estimate))

    def derivatives(self, estimate: OrthonormalF) -> tuple[Array, Array]:
        """Return dF, shape (9, 7), and d2F, shape (9, 7, 7), by the update at no update."""
        _, first, second = self._kernels.fundamental_derivatives(*estimate)
        return first, second

    def camera(self, estimate: OrthonormalF) -> tuple[Array, Array]:
        """Return P' (B&S eq. 5) and A_perp, shape (12, 7) (B&S eqs. 6, 7)."""
        P2, A_perp = self._kernels.canonical_camera_derivatives(*estimate)
        return P2, A_perp

    def retract(self, estimate: OrthonormalF, delta: Array) -> OrthonormalF:
        """Return the estimate moved by seven parameters."""
        return OrthonormalF(*self._kernels.retract_factors(*estimate, delta))


#: The parameterisations by name.
PARAMETERIZATIONS = {"ortho": Ortho}
