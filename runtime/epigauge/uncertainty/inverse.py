"""A generalised inverse of the normal matrix, block by block.

The normal matrix N of the unknowns is singular along the gauge freedom. `Inverse` holds
X = (N + F F^T)^-1, F along the free motions of the cameras: a generalised inverse of N, from which
every datum is reached by an S-transformation (`epigauge.uncertainty.datum`). Only the matrix of
the cameras is formed; blocks of points follow from it and their own small blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.dampings import Covariant
from epigauge.bundle.null_space import generators
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.priors import Priors
from epigauge.bundle.solve import Border, BundleSystem
from epigauge.bundle.ties import Ties
from epigauge.errors import ArgumentError
from epigauge.kernels import Table

__all__ = ["Inverse", "Motions", "Part", "added_by_priors", "products"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A view or a point: the number of one, and None for the other.
Part = tuple[int | None, int | None]

#: Singular values of what holds the gauge below this, of the largest one, are rounding.
_FREE = 1e-9

#: Least eigenvalue of the cameras' matrix where its diagonal is about one.
_SINGULAR = 1e-13

_SUMS = ("U", "V", "g_cameras", "g_points")

#: A point whose block has an eigenvalue below this, of the mean one, is undetermined along its ray:
#: as much is added, which leaves everything else as it is.
_RAY = 1e-12

#: Points are gone through in chunks of about this many matrix entries, which bounds the memory.
_CHUNK = 2_000_000


@dataclass(frozen=True)
class Motions:
    """Motions of the gauge group as own tangents of unit length.

    Attributes
    ----------
    cameras, points : ndarray, shape (n, d, 7), (m, 3, 7)
        The generators, each of norm one.
    open : ndarray, shape (7, f)
        Those that nothing holds.
    held : ndarray, shape (7, h)
        Those that priors hold; what is fixed does not make the others.
    """

    cameras: Array
    points: Array
    open: Array
    held: Array

    @staticmethod
    def of(system: BundleSystem, priors: Priors | None, kernels: Table) -> Motions:
        """Return the motions at an estimate.

        What holds a motion is read off the ties and the priors' derivatives, however weak these
        are beside the images.
        """
        cameras, points = generators(system.model, kernels, system.cameras, system.points)
        size = np.sqrt(np.sum(cameras**2, axis=(0, 1)) + np.sum(points**2, axis=(0, 1)))
        cameras, points = cameras / size, points / size
        count = cameras.shape[2]
        rows = [np.zeros((0, count))]
        for own, basis in ((cameras, system.ties.A), (points, system.ties.C)):
            if basis is not None:
                stuck = own - basis @ (np.linalg.pinv(basis) @ own)
                rows.append(_rows(stuck.reshape(-1, count), own))
        loose = _null(np.concatenate(rows))
        if priors is not None:
            known = priors.slopes(system.cameras, system.points, cameras, points)
            rows.append(_rows(known, points))
        open_ = _null(np.concatenate(rows))
        beside = loose - open_ @ (open_.T @ loose)
        turned, values, _ = np.linalg.svd(beside, full_matrices=False)
        return Motions(cameras, points, open_, turned[:, values > 0.5])

    @property
    def loose(self) -> Array:
        """Return those that the unknowns can make, (7, f + h)."""
        return np.column_stack([self.open, self.held])

    def along(self, chosen: Array) -> tuple[Array, Array]:
        """Return motions (n, d, k) and (m, 3, k) of combinations (7, k)."""
        return self.cameras @ chosen, self.points @ chosen

    def lifted(self, system: BundleSystem) -> Array:
        """Return F (n, d, f + h): as heavy along a motion as the images across it.

        It has no part in points, which N + F F^T would couple.
        """
        weight = np.einsum("nii->ni", system.normal.U).mean(axis=0)[:, None]
        columns = self.cameras @ self.loose
        return np.asarray(weight * columns / np.sqrt(np.sum(weight * columns**2, axis=(0, 1))))


def _rows(rows: Array, motions: Array) -> Array:
    """Return the rows that are more than rounding beside the motions themselves."""
    largest = float(np.max(np.linalg.norm(motions, axis=2), initial=0.0))
    return np.asarray(rows[np.linalg.norm(rows, axis=1) > _FREE * largest])


def _null(rows: Array) -> Array:
    """Return an orthonormal basis of what rows take to zero; each row counts alike."""
    if not len(rows):
        return np.eye(rows.shape[1])
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    values, basis = np.linalg.svd(unit, full_matrices=True)[1:]
    values = np.concatenate([values, np.zeros(rows.shape[1] - len(values))])
    return np.asarray(basis[values <= _FREE * values[0]].T)


@dataclass(frozen=True)
class Inverse:
    """X = X_0 + L M L^T, with X_0 that of the images and priors of one view or point.

    All in own tangents: d numbers a camera, three a point.

    Attributes
    ----------
    graph : ObservationGraph
        One edge a pair of view and point.
    cameras : ndarray, shape (n, d, n, d)
        The cameras' part of X_0.
    V_inverse : ndarray, shape (m, 3, 3)
        Inverse blocks of the points.
    W, Y : ndarray, shape (N, d, 3)
        Coupling of each edge, and that times V^-1.
    L_cameras, L_points : ndarray, shape (n, d, q), (m, 3, q)
        L.
    M : ndarray, shape (q, q)
        M.
    motions : Motions
        The gauge freedom.
    at_infinity : ndarray of bool, shape (m,)
        Points that their observations leave open along a ray.
    """

    graph: ObservationGraph
    cameras: Array
    V_inverse: Array
    W: Array
    Y: Array
    L_cameras: Array
    L_points: Array
    M: Array
    motions: Motions
    at_infinity: NDArray[np.bool_]

    @staticmethod
    def of(
        system: BundleSystem,
        reference: NumpyLinearizer,
        priors: Priors | None,
        kernels: Table,
    ) -> Inverse:
        """Invert the normal equations at an estimate.

        Raises
        ------
        ArgumentError
            Where the observations leave something undetermined beside the gauge.
        """
        motions = Motions.of(system, priors, kernels)
        try:
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                cameras, V_inverse = _cameras(system, motions)
        except (np.linalg.LinAlgError, FloatingPointError):
            raise ArgumentError(
                "reconstruction",
                "is not determined by the tracks (singular normal equations)",
                "views and points in general position, and only intrinsics in `refine` that they "
                "determine",
            ) from None
        graph = reference.graph
        W = graph.sum_edges(reference.coupling_blocks(system.cameras, system.points))
        edges = graph.simple
        parts = edges, cameras, V_inverse, W, W @ V_inverse[edges.point]
        none = np.zeros((*cameras.shape[:2], 0)), np.zeros((len(V_inverse), 3, 0)), np.zeros((0, 0))
        open_rays = undetermined(system.V)
        plain = Inverse(*parts, *none, motions, open_rays)
        if not motions.held.size and system.constraints is None:
            return plain
        # Known distances couple points: their few columns B are added. What priors hold of the
        # gauge is held by F no longer: (N + F F^T) G = F F^T G + (what priors add) G gives X F and
        # what is left of it without a difference of large numbers.
        B = system.constraints or Border(np.zeros((*cameras.shape[:2], 0)), none[1])
        F, G = motions.lifted(system), motions.along(motions.loose)
        back = np.linalg.inv(np.einsum("ndk,ndl->kl", F, G[0]))
        first = motions.open.shape[1]
        alone = added_by_priors(system, priors)
        firm = alone[0] @ G[0], alone[1] @ G[1]
        weak = plain.apply(firm[0] @ back[:, first:], firm[1] @ back[:, first:])
        XF = G[0] @ back[:, first:] - weak[0], G[1] @ back[:, first:] - weak[1]
        XB = plain.apply(*B)
        L = np.concatenate([XB[0], XF[0]], axis=2), np.concatenate([XB[1], XF[1]], axis=2)
        across = products(B, XF)
        left = np.einsum("ndk,ndl->kl", F[..., first:], weak[0])
        inner = np.block([[np.eye(across.shape[0]) + products(B, XB), across], [across.T, -left]])
        M = -np.linalg.inv(0.5 * (inner + inner.T))
        return Inverse(*parts, *L, 0.5 * (M + M.T), motions, open_rays)

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return X times columns (n, d, k) and (m, 3, k)."""
        edges, (n, d) = self.graph, self.cameras.shape[:2]
        coupled = cameras - edges.sum_views(self.Y @ points[edges.point])
        flat = self.cameras.reshape(n * d, n * d) @ coupled.reshape(n * d, -1)
        x = flat.reshape(n, d, -1)
        back = edges.sum_points(np.swapaxes(self.W, 1, 2) @ x[edges.view])
        y = self.V_inverse @ (points - back)
        if self.M.size:
            small = self.M @ products((self.L_cameras, self.L_points), (cameras, points))
            x, y = x + self.L_cameras @ small, y + self.L_points @ small
        return x, y

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of cameras, of a camera's tangent, and of points."""
        return (*self.cameras.shape[:2], len(self.V_inverse))

    def block(self, first: Part, second: Part) -> Array:
        """Return the block of X of two parts."""
        (i, a), (k, b) = first, second
        if a is not None and b is not None:
            found = self.pair(a, b)
        elif a is not None:
            found = self.cross(a)[k].T
        elif b is not None:
            found = self.cross(b)[i]
        else:
            found = self.cameras[i, :, k]
        return np.asarray(found + self._low(first) @ self.M @ self._low(second).T)

    def _low(self, part: Part) -> Array:
        return np.asarray(self.L_cameras[part[0]] if part[1] is None else self.L_points[part[1]])

    @cached_property
    def diagonals(self) -> tuple[Array, Array]:
        """The diagonal blocks of X of cameras (n, d, d) and points (m, 3, 3)."""
        n = len(self.cameras)
        blocks = self.cameras[np.arange(n), :, np.arange(n)], self.points
        low = self.L_cameras, self.L_points
        both = (X + L @ self.M @ np.swapaxes(L, 1, 2) for X, L in zip(blocks, low, strict=True))
        cameras, points = both
        return cameras, points

    @cached_property
    def points(self) -> Array:
        """Return the points' diagonal blocks of X_0, (m, 3, 3)."""
        edges = self.graph
        found = self.V_inverse.copy()
        counts, d = np.diff(edges.first), self.cameras.shape[1]
        by_pair = np.ascontiguousarray(self.cameras.transpose(0, 2, 1, 3))
        for k in np.unique(counts):
            those = np.flatnonzero(counts == k)
            size = max(1, _CHUNK // int((k * d) ** 2))
            for begin in range(0, len(those), size):
                chunk = those[begin : begin + size]
                rows = edges.first[chunk][:, None] + np.arange(k)
                views = edges.view[rows]
                among = by_pair[views[:, :, None], views[:, None, :]]
                Y = self.Y[rows].reshape(len(chunk), k * d, 3)
                among = among.transpose(0, 1, 3, 2, 4).reshape(len(chunk), k * d, k * d)
                found[chunk] += np.swapaxes(Y, 1, 2) @ (among @ Y)
        return found

    def cross(self, point: int) -> Array:
        """Return the blocks of X_0 of all cameras and a point, (n, d, 3)."""
        rows = slice(self.graph.first[point], self.graph.first[point + 1])
        n, d = self.cameras.shape[:2]
        views = self.graph.view[rows]
        among = self.cameras[:, :, views].reshape(n, d, -1)
        return np.asarray(-among @ self.Y[rows].reshape(-1, 3))

    def pair(self, i: int, j: int) -> Array:
        """Return the block of X_0 of two points, (3, 3)."""
        rows = slice(self.graph.first[j], self.graph.first[j + 1])
        crossed = self.cross(i)[self.graph.view[rows]]
        found = -np.einsum("ndi,ndj->ij", crossed, self.Y[rows])
        return np.asarray(found + (self.V_inverse[i] if i == j else 0.0))


def added_by_priors(system: BundleSystem, priors: Priors | None) -> tuple[Array, Array]:
    """Return what priors of one view or point add to J^T J, (n, d, d) and (m, 3, 3)."""
    if priors is None:
        return np.zeros_like(system.normal.U), np.zeros_like(system.normal.V)
    zero = {name: np.zeros_like(getattr(system.normal, name)) for name in _SUMS}
    alone = priors.added(replace(system.normal, **zero), system.cameras, system.points)
    return alone.U, alone.V


def products(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """Return the products (k, l) of columns in cameras and points."""
    cameras = np.einsum("ndk,ndl->kl", first[0], second[0], optimize=True)
    return np.asarray(cameras + np.einsum("mik,mil->kl", first[1], second[1], optimize=True))


def _cameras(system: BundleSystem, motions: Motions) -> tuple[Array, Array]:
    """Return the cameras' part of X_0, (n, d, n, d), and the inverse point blocks (m, 3, 3)."""
    W = Covariant().blocks(system)
    whitening = np.linalg.inv(np.swapaxes(np.linalg.cholesky(W.cameras), 1, 2))
    ties: Ties = system.ties.then(whitening, None).scaled(1.0 / np.sqrt(W.shared))
    V = system.V + _RAY * undetermined(system.V)[:, None, None] * _sized(system.V)
    root, _ = system.inverse_roots(V, W.points, 0.0, system.gradients[2])
    T = system.own_roots(root)
    white = BundleSystem(
        system.normal,
        system.inverse_roots,
        ties,
        model=system.model,
        cameras=system.cameras,
        points=system.points,
    )
    reduced = white.reduced(root)
    n, d = system.normal.g_cameras.shape
    a = (whitening if ties.A is None else ties.A).shape[2]
    A = np.broadcast_to(np.eye(d), (n, d, d)) if ties.A is None else ties.A
    lifted = motions.lifted(system)
    F = np.zeros((len(reduced), lifted.shape[2]))
    F[: n * a] = ties.local(lifted).reshape(n * a, -1)
    if ties.n_shared:
        F[n * a :] = ties.shared(lifted)
    reduced += F @ F.T
    frozen = np.flatnonzero(~A.any(axis=1).ravel())
    scale = 1.0 / np.sqrt(np.diagonal(reduced))
    unit = scale[:, None] * reduced * scale
    values = np.linalg.eigvalsh(unit)
    if not values[0] > _SINGULAR * values[-1]:
        raise np.linalg.LinAlgError
    inverse = scale[:, None] * np.linalg.inv(unit) * scale
    inverse[frozen], inverse[:, frozen] = 0.0, 0.0
    half = _own(ties, inverse, n, a)
    whole = _own(ties, np.ascontiguousarray(half.T), n, a)
    return (0.5 * (whole + whole.T)).reshape(n, d, n, d), T @ np.swapaxes(T, 1, 2)


def _sized(V: Array) -> Array:
    """Return unit matrices as large as blocks (m, 3, 3)."""
    trace = np.einsum("mii->m", V) / V.shape[1]
    return np.asarray(trace[:, None, None] * np.eye(V.shape[1]))


def undetermined(V: Array) -> NDArray[np.bool_]:
    """Return which points their observations leave open along a ray, (m,)."""
    size = np.einsum("mii->m", V) / V.shape[1]
    least = np.linalg.eigvalsh(V / np.where(size > 0.0, size, 1.0)[:, None, None])[:, 0]
    return np.asarray(least < _RAY)


def _own(ties: Ties, columns: Array, n: int, a: int) -> Array:
    """Return own tangents (n d, k) of columns (n a + r, k) of unknowns."""
    own = ties.cameras(columns[: n * a].reshape(n, a, -1), columns[n * a :])
    return np.asarray(own.reshape(-1, columns.shape[1]))
