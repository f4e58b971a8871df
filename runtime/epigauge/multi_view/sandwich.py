"""Covariance of a projective reconstruction under a robust loss.

A^-1 B A^-1 = kappa A^-1 + Z C Z^T with Z = A^-1 J^T of the wrong observations, see
`epigauge.uncertainty.influence`. No matrix larger than those of least squares is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge.uncertainty.influence import Influence

if TYPE_CHECKING:
    from epigauge.multi_view.inverse import Inverse

__all__ = ["Sandwich"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Wrong observations worked on at a time.
_CHUNK = 32


@dataclass(frozen=True)
class Sandwich:
    """A^-1 B A^-1, with the methods of the plain inverse.

    Attributes
    ----------
    plain : Inverse
        A^-1.
    influence : Influence
        Right and wrong observations.
    """

    plain: Inverse
    influence: Influence

    @property
    def scale(self) -> float:
        """Pixels a unit of the image."""
        return self.plain.scale

    @property
    def cameras(self) -> Array:
        """The cameras' part, (12 n, 12 n)."""
        return self._blocks[0]

    @property
    def views(self) -> Array:
        """The cameras' diagonal blocks, (n, 12, 12)."""
        n = self.plain.layout.n_views
        return self.cameras.reshape(n, 12, n, 12)[np.arange(n), :, np.arange(n)]

    @property
    def points(self) -> Array:
        """The points' diagonal blocks, (m, 4, 4)."""
        return self._blocks[1]

    @property
    def observed(self) -> Array:
        """J X J^T of each observation, (N, 2, 2)."""
        return self._blocks[2]

    def apply(self, vectors: Array) -> Array:
        """Return X times vectors (12 n + 4 m, r)."""
        found = self.influence.kappa * self.plain.apply(vectors)
        for Z, C in self._parts():
            along = np.einsum("pki,pr->kir", Z, vectors, optimize=True)
            found += np.einsum("pki,kij,kjr->pr", Z, C, along, optimize=True)
        return found

    def projected(self, views: Indices, points: Indices) -> Array:
        """Return J X J^T of any points in any views, (k, 2, 2)."""
        found = np.empty((len(views), 2, 2))
        for k in range(0, len(views), _CHUNK):
            rows = self._rows(views[k : k + _CHUNK], points[k : k + _CHUNK])
            X = self.apply(rows.reshape(len(rows), -1)).reshape(rows.shape)
            found[k : k + _CHUNK] = np.einsum("pki,pkj->kij", rows, X)
        return found

    @cached_property
    def _blocks(self) -> tuple[Array, Array, Array]:
        kappa, layout = self.influence.kappa, self.plain.layout
        cameras, points = kappa * self.plain.cameras, kappa * self.plain.points
        observed = kappa * self.plain.observed
        size = len(cameras)
        J_camera, J_point = self.plain.jacobians(layout.view, layout.point)
        for Z, C in self._parts():
            first = Z[:size].reshape(size, -1)
            second = Z[size:].reshape(len(points), 4, -1)
            blocks = np.zeros((len(C), 2, len(C), 2))
            blocks[np.arange(len(C)), :, np.arange(len(C))] = C
            middle = blocks.reshape(2 * len(C), -1)
            cameras += first @ middle @ first.T
            points += second @ middle @ np.swapaxes(second, 1, 2)
            seen = J_camera @ first.reshape(layout.n_views, 12, -1)[layout.view]
            seen += J_point @ second[layout.point]
            observed += seen @ middle @ np.swapaxes(seen, 1, 2)
        return cameras, points, observed

    def _parts(self) -> Iterator[tuple[Array, Array]]:
        """Yield A^-1 J^T (12 n + 4 m, k, 2) and C (k, 2, 2) of some wrong observations."""
        layout = self.plain.layout
        for k in range(0, len(self.influence.wrong), _CHUNK):
            wrong = self.influence.wrong[k : k + _CHUNK]
            rows = self._rows(layout.view[wrong], layout.point[wrong])
            Z = self.plain.apply(rows.reshape(len(rows), -1)).reshape(rows.shape)
            yield Z, self.influence.rest[k : k + _CHUNK]

    def _rows(self, views: Indices, points: Indices) -> Array:
        """Return J^T of points in views, (12 n + 4 m, k, 2)."""
        layout, k = self.plain.layout, np.arange(len(views))
        J_camera, J_point = self.plain.jacobians(views, points)
        cameras = np.zeros((layout.n_views, 12, len(views), 2))
        own = np.zeros((layout.n_points, 4, len(views), 2))
        cameras[views, :, k] = np.swapaxes(J_camera, 1, 2)
        own[points, :, k] = np.swapaxes(J_point, 1, 2)
        return np.concatenate([cameras.reshape(-1, len(views), 2), own.reshape(-1, len(views), 2)])
