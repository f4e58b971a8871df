"""A generalised inverse of the normal matrix, block by block.

The normal matrix N of the unknowns is singular along the gauge freedom. `Inverse` holds
X = (N + F F^T)^-1, F along the free motions of the cameras: a generalised inverse of N, from which
every datum is reached by an S-transformation (`epigauge.uncertainty.datum`). Only the matrix of
the cameras is factored, within its skyline, and only the blocks of its inverse there are computed
(Takahashi's selected inversion): blocks of points follow from them and their own small blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.dampings import Covariant
from epigauge.bundle.linearizer import CameraBlocks, Coupling
from epigauge.bundle.null_space import generators
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.priors import Priors
from epigauge.bundle.reduced import Bordered
from epigauge.bundle.solve import Border, BundleSystem
from epigauge.bundle.ties import Ties, congruent
from epigauge.errors import ArgumentError
from epigauge.kernels import Table

__all__ = ["Inverse", "Motions", "Part", "added_by_priors", "products"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A view or a point: the number of one, and None for the other.
Part = tuple[int | None, int | None]

#: Singular values of what holds the gauge below this, of the largest one, are rounding.
_FREE = 1e-9

#: An unknown whose variance grows by more than this when all others are unknown, too, is not
#: determined: rounding leaves no more.
_SINGULAR = 1e13

_SUMS = ("U", "V", "g_cameras", "g_points")

#: A point whose block has an eigenvalue below this, of the mean one, is undetermined along its ray:
#: as much is added, which leaves everything else as it is.
_RAY = 1e-12

#: Blocks of so many points with all views are kept while they may be asked for again.
_CROSSED = 64


@dataclass(frozen=True)
class Motions:
    """Motions of the gauge group as own tangents of unit length.

    Attributes
    ----------
    cameras, points : ndarray, shape (n, d, 7), (m, b, 7)
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
        """Return the motions of cameras and points at an estimate."""
        moves = generators(system.model, kernels, system.cameras, system.points)
        return Motions.along_gauge(system, priors, *moves)

    @staticmethod
    def along_gauge(
        system: BundleSystem, priors: Priors | None, cameras: Array, points: Array
    ) -> Motions:
        """Return the motions, given the generators (n, d, 7) and (m, b, 7) of the gauge.

        What holds a motion is read off the ties and the priors' derivatives, however weak these
        are beside the images.
        """
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
        """Return motions (n, d, k) and (m, b, k) of combinations (7, k)."""
        return combined(self.cameras, chosen), combined(self.points, chosen)

    def lifted(self, system: BundleSystem) -> Array:
        """Return F (n, d, f + h): as heavy along a motion as the images across it.

        It has no part in points, which N + F F^T would couple.
        """
        weights, columns = self.weights(system), self.cameras @ self.loose
        return np.asarray(weights * columns / np.sqrt(np.sum(weights * columns**2, axis=(0, 1))))

    @staticmethod
    def weights(system: BundleSystem) -> Array:
        """Return how much the images make of an entry of a tangent, on average, (d, 1)."""
        return np.asarray(np.einsum("nii->ni", system.normal.U).mean(axis=0)[:, None])


def combined(columns: Array, mixing: Array) -> Array:
    """Return combinations (n, d, l) of columns (n, d, k), as one product."""
    n, d, k = columns.shape
    return np.asarray(columns.reshape(n * d, k) @ mixing).reshape(n, d, mixing.shape[1])


def spread(blocks: Array, L: Array, M: Array) -> Array:
    """Return blocks (n, d, d) with L M L^T added, for L (n, d, q)."""
    return blocks + combined(L, M) @ np.swapaxes(L, 1, 2) if L.shape[2] else blocks


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

    All in own tangents: d numbers a camera, b a point. Of the cameras' part of X_0 the blocks
    of views that see common points are stored, all that blocks of single views and points need;
    any other follows from the factor.

    Attributes
    ----------
    coupling : Coupling
        W.
    T : ndarray, shape (m, b, b)
        T T^T is the inverse V^-1 of the points' own blocks.
    V_inverse : ndarray, shape (m, b, b)
        V^-1.
    reduced : Bordered
        The factor of the cameras' part.
    ties : Ties
        From the unknowns of that to own tangents.
    blocks : CameraBlocks
        The stored blocks of the cameras' part.
    reference : NumpyLinearizer
        The observations, for W of a point.
    at : tuple of ndarray, shape (n, c), (m, b)
        The estimate.
    L_cameras, L_points : ndarray, shape (n, d, q), (m, b, q)
        L.
    M : ndarray, shape (q, q)
        M.
    motions : Motions
        The gauge freedom.
    at_infinity : ndarray of bool, shape (m,)
        Points that their observations leave open along a ray.
    """

    coupling: Coupling
    T: Array
    V_inverse: Array
    reduced: Bordered
    ties: Ties
    blocks: CameraBlocks
    reference: NumpyLinearizer
    at: tuple[Array, Array]
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
        motions: Motions,
    ) -> Inverse:
        """Invert the normal equations at an estimate.

        Raises
        ------
        ArgumentError
            Where the observations leave something undetermined beside the gauge.
        """
        unit = np.sqrt(motions.weights(system)) * combined(motions.cameras, motions.loose)
        return Inverse.held(system, reference, motions, unit, motions.lifted(system), priors)

    @staticmethod
    def held(
        system: BundleSystem,
        reference: NumpyLinearizer,
        motions: Motions,
        unit: Array,
        lifted: Array,
        priors: Priors | None = None,
    ) -> Inverse:
        """Invert the normal equations, given what holds the gauge.

        Parameters
        ----------
        system : BundleSystem
            Regular beside the motions.
        reference : NumpyLinearizer
            The observations.
        motions : Motions
            The gauge freedom.
        unit : ndarray, shape (n, d, f)
            What the motions are in the measure of the images.
        lifted : ndarray, shape (n, d, f)
            F, of all views.
        priors : Priors, optional
            What the system has beside the observations.

        Raises
        ------
        ArgumentError
            Where the observations leave something undetermined beside the gauge.
        """
        # Homogeneous points are where they are, infinitely far or not.
        homogeneous = system.model.homogeneous
        open_rays = np.zeros(len(system.V), np.bool_) if homogeneous else undetermined(system.V)
        try:
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                F = _held(system.normal.coupling, unit, lifted)
                T, reduced, ties, blocks = _cameras(system, F, open_rays)
        except (np.linalg.LinAlgError, FloatingPointError):
            raise ArgumentError(
                "reconstruction",
                "is not determined by the tracks (singular normal equations)",
                "views and points in general position, and only intrinsics in `refine` that they "
                "determine",
            ) from None
        n, d = system.normal.g_cameras.shape
        parts = system.normal.coupling, T, T @ np.swapaxes(T, 1, 2), reduced, ties, blocks
        at = system.cameras, system.points
        none = np.zeros((n, d, 0)), np.zeros((*T.shape[:2], 0)), np.zeros((0, 0))
        plain = Inverse(*parts, reference, at, *none, motions, open_rays)
        if not motions.held.size and system.constraints is None:
            return plain
        # Known distances couple points: their few columns B are added. What priors hold of the
        # gauge is held by F no longer: (N + F F^T) G = F F^T G + (what priors add) G gives X F and
        # what is left of it without a difference of large numbers.
        B = system.constraints or Border(*none[:2])
        G = motions.along(motions.loose)
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
        return replace(plain, L_cameras=L[0], L_points=L[1], M=0.5 * (M + M.T))

    @property
    def shape(self) -> tuple[int, int]:
        """Return (n, d)."""
        n, d, _ = self.L_cameras.shape
        return n, d

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return X times columns (n, d, k) and (m, b, k)."""
        own = self.V_inverse @ points
        x = self.solved(cameras - self.coupling.to_cameras(None, own))
        y = own - self.V_inverse @ self.coupling.to_points(None, np.ascontiguousarray(x))
        if self.M.size:
            small = self.M @ products((self.L_cameras, self.L_points), (cameras, points))
            x, y = x + self.L_cameras @ small, y + self.L_points @ small
        return x, y

    def forms(self, cameras: Array, points: Array) -> Array:
        """Return c^T X c of each column c, (n, d, k) and (m, b, k) -> (k,)."""
        own = self.V_inverse @ points
        right = cameras - self.coupling.to_cameras(None, own)
        found = np.sum(right * self.solved(right), axis=(0, 1)) + np.sum(points * own, axis=(0, 1))
        if self.M.size:
            small = products((self.L_cameras, self.L_points), (cameras, points))
            found = found + np.sum(small * (self.M @ small), axis=0)
        return np.asarray(found)

    @property
    def graph(self) -> ObservationGraph:
        """The observations, one edge a pair of view and point."""
        return self.reference.graph.simple

    @cached_property
    def W(self) -> Array:
        """Coupling of each edge, (E, d, b)."""
        return self.reference.graph.sum_edges(self.reference.coupling_blocks(*self.at))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of cameras, of a camera's tangent, and of points."""
        return (*self.L_cameras.shape[:2], len(self.T))

    def block(self, first: Part, second: Part) -> Array:
        """Return the block of X of two parts."""
        (i, a), (k, b) = first, second
        if a is not None and b is not None:
            found = self._points(a, b)
        elif a is not None:
            found = self._cross(a)[k].T
        elif b is not None:
            found = self._cross(b)[i]
        else:
            assert i is not None
            assert k is not None
            found = self._views(i, k)
        return np.asarray(found + self._low(first) @ self.M @ self._low(second).T)

    def _low(self, part: Part) -> Array:
        return np.asarray(self.L_cameras[part[0]] if part[1] is None else self.L_points[part[1]])

    @cached_property
    def diagonals(self) -> tuple[Array, Array]:
        """The diagonal blocks of X of cameras (n, d, d) and points (m, b, b)."""
        points = self.coupling.marginals(self.T, self.blocks, coupled=False)[0]
        views = spread(self.blocks.diagonal, self.L_cameras, self.M)
        return views, spread(points, self.L_points, self.M)

    def _views(self, i: int, k: int) -> Array:
        """Return the block of X_0 of two views, (d, d)."""
        found = self.blocks.block(i, k)
        if found is None:
            n, d, _ = self.sizes
            right = np.zeros((n, d, d))
            right[k] = np.eye(d)
            found = self.solved(right)[i]
        return found

    def _cross(self, point: int) -> Array:
        """Return the blocks of X_0 of all cameras and a point, (n, d, b)."""
        found = self._crossed.get(point)
        if found is None:
            views, Y = self._factors(point)
            right = np.zeros((*self.sizes[:2], Y.shape[2]))
            right[views] = Y
            found = -self.solved(right)
            if len(self._crossed) >= _CROSSED:
                self._crossed.clear()
            self._crossed[point] = found
        return found

    def _points(self, i: int, j: int) -> Array:
        """Return the block of X_0 of two points, (b, b)."""
        views, Y = self._factors(j)
        found = -np.einsum("ndi,ndj->ij", self._cross(i)[views], Y)
        return np.asarray(found + (self.V_inverse[i] if i == j else 0.0))

    @cached_property
    def _crossed(self) -> dict[int, Array]:
        return {}

    def _factors(self, point: int) -> tuple[Indices, Array]:
        """Return the views of a point, and W V^-1 of these edges, (k, d, b)."""
        views, W = self.reference.coupling_of(*self.at, point)
        return views, W @ self.V_inverse[point]

    def solved(self, own: Array) -> Array:
        """Return the cameras' part of X_0 times columns (n, d, k)."""
        return self.ties.cameras(*self.reduced.solve(self.ties.local(own), self.ties.shared(own)))


def _held(coupling: Coupling, unit: Array, lifted: Array) -> Array:
    """Return F (n, d, f), of some views only that hold the whole gauge.

    F F^T couples these views with one another. All of them share points, so that the reduced
    system keeps its blocks; of such sets that is taken whose views hold the gauge most firmly.
    """
    if not unit.shape[2]:
        return lifted
    unit = unit / np.sqrt(np.sum(unit**2, axis=(0, 1)))
    sets = coupling.cliques()
    grams = np.tensordot(sets.astype(float), np.swapaxes(unit, 1, 2) @ unit, 1)
    firmest = sets[int(np.argmax(np.linalg.eigvalsh(grams)[:, 0]))]
    return np.where(firmest[:, None, None], lifted, 0.0)


def added_by_priors(system: BundleSystem, priors: Priors | None) -> tuple[Array, Array]:
    """Return what priors of one view or point add to J^T J, (n, d, d) and (m, b, b)."""
    if priors is None:
        return np.zeros_like(system.normal.U), np.zeros_like(system.normal.V)
    zero = {name: np.zeros_like(getattr(system.normal, name)) for name in _SUMS}
    alone = priors.added(replace(system.normal, **zero), system.cameras, system.points)
    return alone.U, alone.V


def products(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """Return the products (k, l) of columns in cameras and points."""
    cameras = np.einsum("ndk,ndl->kl", first[0], second[0], optimize=True)
    return np.asarray(cameras + np.einsum("mik,mil->kl", first[1], second[1], optimize=True))


def _cameras(
    system: BundleSystem, F: Array, open_rays: NDArray[np.bool_]
) -> tuple[Array, Bordered, Ties, CameraBlocks]:
    """Return roots T of the points' inverse blocks, and the cameras' part of the inverse.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where it is singular to rounding.
    """
    W = Covariant().blocks(system)
    whitening = np.linalg.inv(np.swapaxes(np.linalg.cholesky(W.cameras), 1, 2))
    ties = system.ties.then(whitening, None).scaled(1.0 / np.sqrt(W.shared))
    V = system.V
    if open_rays.any():
        V = V + _RAY * open_rays[:, None, None] * _sized(V)
    root, _ = system.inverse_roots(V, V, 0.0, system.gradients[2])
    T = system.own_roots(root)
    pairs, _ = system.normal.coupling.schur(T, None)
    white = congruent(ties.A, system.normal.U)
    reduced = Bordered(pairs.without(F), system.normal.U, ties, white, 0.0)
    blocks, inflation = reduced.inverse(ties)
    if not inflation < _SINGULAR:
        raise np.linalg.LinAlgError("something is undetermined")
    return T, reduced, ties, blocks


def _sized(V: Array) -> Array:
    """Return unit matrices as large as blocks (m, b, b)."""
    trace = np.einsum("mii->m", V) / V.shape[1]
    return np.asarray(trace[:, None, None] * np.eye(V.shape[1]))


def undetermined(V: Array) -> NDArray[np.bool_]:
    """Return which points their observations leave open along a ray, (m,)."""
    size = np.einsum("mii->m", V) / V.shape[1]
    unit = V / np.where(size > 0.0, size, 1.0)[:, None, None]
    found = np.zeros(len(V), np.bool_)
    # The least eigenvalue is at least the determinant over the mean square of the others.
    doubtful = np.flatnonzero(~(_determinants(unit) > 10.0 * _RAY))
    found[doubtful] = np.linalg.eigvalsh(unit[doubtful])[:, 0] < _RAY
    return found


def _determinants(V: Array) -> Array:
    """Return those of blocks, (m, b, b) -> (m,)."""
    if V.shape[1] != 3:
        return np.asarray(np.linalg.det(V))
    return np.asarray(np.einsum("mi,mi->m", V[:, 0], np.cross(V[:, 1], V[:, 2])))
