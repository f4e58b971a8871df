"""Covariance of calibrated cameras and points under a robust loss: A^-1 B A^-1.

B is kappa A but for wrong observations, which pull one by one, and for priors, whose noise no loss
has cut (`epigauge.uncertainty.influence`). With X = A^-1 in a datum, X B X = kappa X + X D X; the
difference D has the blocks of A, so that nothing larger than the blocks of X is formed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.priors import Priors
from epigauge.bundle.solve import Border, BundleSystem
from epigauge.uncertainty.influence import Influence
from epigauge.uncertainty.inverse import Inverse, Motions, Part, added_by_priors, products

__all__ = ["Difference", "Sandwich", "pull"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """D = B - kappa A as blocks of cameras, points and edges, and a border.

    Attributes
    ----------
    cameras, points, edges : ndarray, shape (n, d, d), (m, b, b), (E, d, b)
        The blocks.
    border : Border
        Columns of a term share * border border^T.
    share : float
        1 - kappa.
    """

    cameras: Array
    points: Array
    edges: Array
    border: Border
    share: float

    @staticmethod
    def of(
        influence: Influence,
        reference: NumpyLinearizer,
        system: BundleSystem,
        priors: Priors | None,
    ) -> Difference:
        """Return what wrong observations and priors make of it."""
        wrong, share = influence.wrong, 1.0 - influence.kappa
        _, J_camera, J_point = reference.observe(system.cameras, system.points)
        A, B = (J[:, :, wrong].transpose(2, 0, 1) for J in (J_camera, J_point))
        graph, C = reference.graph, influence.rest
        cameras, points = (share * part for part in added_by_priors(system, priors))
        np.add.at(cameras, graph.view[wrong], np.swapaxes(A, 1, 2) @ C @ A)
        np.add.at(points, graph.point[wrong], np.swapaxes(B, 1, 2) @ C @ B)
        each = np.zeros((len(graph.view), cameras.shape[1], points.shape[1]))
        each[wrong] = np.swapaxes(A, 1, 2) @ C @ B
        none = Border(np.zeros((*cameras.shape[:2], 0)), np.zeros((*points.shape[:2], 0)))
        return Difference(cameras, points, graph.sum_edges(each), system.constraints or none, share)

    def apply(self, inverse: Inverse, x: Array, y: Array) -> tuple[Array, Array]:
        """Return D times columns (n, d, k) and (m, b, k)."""
        graph = inverse.graph
        along = self.share * products(self.border, (x, y))
        cameras = self.cameras @ x + graph.sum_views(self.edges @ y[graph.point])
        points = self.points @ y
        points = points + graph.sum_points(np.swapaxes(self.edges, 1, 2) @ x[graph.view])
        return cameras + self.border.cameras @ along, points + self.border.points @ along


def pull(
    reference: NumpyLinearizer,
    system: BundleSystem,
    inverse: Inverse,
    wrong: NDArray[np.intp],
    psi: Array,
) -> Array:
    """Return how far residuals (N, 2) move when forces psi (k, 2) on some are taken off."""
    _, A, B = reference.observe(system.cameras, system.points)
    graph = reference.graph
    cameras = np.zeros((*system.normal.g_cameras.shape, 1))
    points = np.zeros((graph.n_points, B.shape[1], 1))
    np.add.at(cameras[..., 0], graph.view[wrong], np.einsum("idk,ki->kd", A[..., wrong], psi))
    np.add.at(points[..., 0], graph.point[wrong], np.einsum("idk,ki->kd", B[..., wrong], psi))
    x, y = inverse.apply(cameras, points)
    moved = np.einsum("idk,kd->ki", A, x[graph.view, :, 0], optimize=True)
    return np.asarray(moved + np.einsum("idk,kd->ki", B, y[graph.point, :, 0], optimize=True))


@dataclass(frozen=True)
class Sandwich:
    """X B X with the methods of `Inverse`.

    Attributes
    ----------
    plain : Inverse
        X.
    kappa : float
        What B is of A, on the whole.
    rest : Difference
        What it is beside.
    """

    plain: Inverse
    kappa: float
    rest: Difference

    @property
    def motions(self) -> Motions:
        """The gauge freedom."""
        return self.plain.motions

    @property
    def at_infinity(self) -> NDArray[np.bool_]:
        """Points that their observations leave open along a ray."""
        return self.plain.at_infinity

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of cameras, of a camera's tangent, and of points."""
        return self.plain.sizes

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return this times columns (n, d, k) and (m, b, k)."""
        plain, bent = self._both(cameras, points)
        return self.kappa * plain[0] + bent[0], self.kappa * plain[1] + bent[1]

    def block(self, first: Part, second: Part) -> Array:
        """Return the block of two parts."""
        (n, d, m), b = self.sizes, self.plain.T.shape[1]
        view, point = second
        width = d if point is None else b
        columns = np.zeros((n, d, width)), np.zeros((m, b, width))
        if point is None:
            columns[0][view] = np.eye(d)
        else:
            columns[1][point] = np.eye(b)
        x, y = self.apply(*columns)
        return np.asarray(x[first[0]] if first[1] is None else y[first[1]])

    @cached_property
    def diagonals(self) -> tuple[Array, Array]:
        """The diagonal blocks of cameras (n, d, d) and points (m, b, b).

        Column by column of the cameras: two products with X a view.
        """
        plain, rest, graph = self.plain, self.rest, self.plain.graph
        (n, d, m), b = self.sizes, plain.T.shape[1]
        own, across = np.empty((n, d, d)), np.empty((2, len(graph.view), d, b))
        for i in range(n):
            columns = np.zeros((n, d, d))
            columns[i] = np.eye(d)
            (x, y), (u, v) = self._both(columns, np.zeros((m, b, d)))
            own[i] = self.kappa * x[i] + u[i]
            rows = np.flatnonzero(graph.view == i)
            across[:, rows] = np.swapaxes([y[graph.point[rows]], v[graph.point[rows]]], 2, 3)
        # The points' rows of A (X D X) = D X give their blocks from those of the edges.
        points = plain.diagonals[1]
        (_, y), (_, v) = self._both(*rest.border)
        right = rest.points @ points - graph.sum_points(np.swapaxes(plain.W, 1, 2) @ across[1])
        right += graph.sum_points(np.swapaxes(rest.edges, 1, 2) @ across[0])
        right += rest.border.points @ np.swapaxes(rest.share * y - v, 1, 2)
        found = self.kappa * points + plain.V_inverse @ right
        return own, 0.5 * (found + np.swapaxes(found, 1, 2))

    def _both(
        self, cameras: Array, points: Array
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Return X and X D X times columns."""
        plain = self.plain.apply(cameras, points)
        return plain, self.plain.apply(*self.rest.apply(self.plain, *plain))
