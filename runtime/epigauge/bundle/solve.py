"""Normal equations in the unknowns, and the one way to a damped step.

Points, and features of other kinds, are eliminated, then the shared unknowns from what is left: the
reduced system of the views has blocks for pairs that see common features, and a border of the
shared unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Coupling, Normal
from epigauge.bundle.reduced import Eliminated, reduced_system
from epigauge.bundle.ties import Ties, congruent
from epigauge.cameras import CameraModel

__all__ = [
    "Blocks",
    "Border",
    "BundleSystem",
    "Step",
    "System",
]

Array = NDArray[np.float64]
InverseRoots = Callable[[Array, Array, float, Array], tuple[Array, Array]]


class Blocks(NamedTuple):
    """A damping in the unknowns: blocks of views (n, a, a), a diagonal (r,), points (m, b, b).

    `others` has the blocks of features of other kinds, as `Normal.others`.
    """

    cameras: Array
    shared: Array
    points: Array
    others: tuple[Array, ...] = ()


class Border(NamedTuple):
    """B in a term B B^T that couples everything, in own tangents (n, d, k) and (m, b, k)."""

    cameras: Array
    points: Array

    def beside(self, other: Border | None) -> Border:
        """Return the border of both terms."""
        if other is None:
            return self
        return Border(*(np.concatenate(pair, axis=2) for pair in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Step:
    """A step in own tangents.

    Attributes
    ----------
    cameras, points : ndarray, shape (n, d), (m, b)
        Own tangents.
    promised : float
        Decrease of the cost in the quadratic model.
    others : tuple of ndarray
        Own tangents of features of other kinds, as `Normal.others`.
    """

    cameras: Array
    points: Array
    promised: float
    others: tuple[Array, ...] = ()

    def shortened(self, system: System, share: float) -> Step:
        """Return a share of the step, with its own promise."""
        assert not self.others
        cameras, points = share * self.cameras, share * self.points
        slope = float(np.vdot(system.normal.g_cameras, cameras))
        slope += float(np.vdot(system.normal.g_points, points))
        # promised = -(slope + bend / 2), and the bend goes with the square of the share.
        half_bend = -(self.promised + slope / share) * share**2
        return Step(cameras, points, -(slope + half_bend))

    def __array__(self, dtype: Any = None, copy: Any = None) -> Array:
        """Return the step as one vector: cameras, points, other features."""
        parts = self.cameras, self.points, *self.others
        return np.concatenate([part.ravel() for part in parts])


class Roots(NamedTuple):
    """One kind of features, to be eliminated.

    Attributes
    ----------
    coupling : Coupling
        With the cameras.
    root : ndarray, shape (m, b', b')
        root root^T is the inverse of the features' damped blocks, in their unknowns.
    T : ndarray, shape (m, b, b)
        The same in own tangents.
    half : ndarray, shape (m, b')
        root^T times the gradient.
    """

    coupling: Coupling
    root: Array
    T: Array
    half: Array

    def coupled(self, own: Array) -> Array:
        """Return T^T W^T own, (m, b', ...)."""
        coupled = self.coupling.to_points(self.T, np.ascontiguousarray(own))
        return coupled[:, : self.root.shape[2]]

    def wide(self, half: Array) -> Array:
        """Return (m, b', ...) with zeros where features have fewer unknowns than coordinates."""
        lack = self.T.shape[2] - half.shape[1]
        if not lack:
            return np.ascontiguousarray(half)
        return np.pad(half, ((0, 0), (0, lack), *[(0, 0)] * (half.ndim - 2)))


@dataclass(frozen=True)
class System:
    """The normal equations of the unknowns x (n, a), s (r,), y (m, b').

    Attributes
    ----------
    normal : Normal
        In own tangents.
    inverse_roots : callable
        As `Linearizer.inverse_roots`.
    ties : Ties
        From the unknowns to own tangents.
    constraints : Border, optional
        A term B B^T beside J^T J.
    other_roots : tuple of callable
        As `FeatureKind.inverse_roots`, of features of other kinds.
    """

    normal: Normal
    inverse_roots: InverseRoots
    ties: Ties = field(default_factory=Ties)
    constraints: Border | None = None
    other_roots: tuple[InverseRoots, ...] = ()

    @cached_property
    def U(self) -> Array:
        """Return the blocks of the views' own unknowns, (n, a, a)."""
        return congruent(self.ties.A, self.normal.U)

    @cached_property
    def U_shared(self) -> Array:
        """Return the block of the shared unknowns, (r, r)."""
        E, index = self.ties.E, self.ties.index
        total = np.zeros((self.ties.n_shared, self.ties.n_shared))
        if E is not None:
            assert index is not None
            blocks = np.swapaxes(E, 1, 2) @ self.normal.U @ E
            np.add.at(total, (index[:, :, None], index[:, None, :]), blocks)
        return total

    @cached_property
    def V(self) -> Array:
        """Return the blocks of the points' unknowns, (m, b', b')."""
        return congruent(self.ties.C, self.normal.V)

    @cached_property
    def depth_blocks(self) -> tuple[Array, Array]:
        """Return the blocks of Z^T Z in the unknowns."""
        assert self.normal.depth_blocks is not None
        cameras, points = self.normal.depth_blocks
        return congruent(self.ties.A, cameras), congruent(self.ties.C, points)

    @cached_property
    def gradients(self) -> tuple[Array, Array, Array]:
        """Return the gradient by x (n, a), s (r,), y (m, b')."""
        own = self.normal.g_cameras[..., None]
        return (
            self.ties.local(own)[..., 0],
            self.ties.shared(own)[:, 0],
            self.ties.of_points(self.normal.g_points[..., None])[..., 0],
        )

    @property
    def gradient(self) -> Array:
        """Return the gradient as one vector: views, shared unknowns, points, other features."""
        others = (own.g_points for own in self.normal.others)
        return np.concatenate([part.ravel() for part in (*self.gradients, *others)])

    def largest(self) -> float:
        """Return the largest mean diagonal entry of a block.

        Unlike the largest entry, an orthonormal change of basis does not change it.
        """
        every = self.U, self.V, *(own.V for own in self.normal.others)
        traces = [np.einsum("nii->n", blocks) / blocks.shape[1] for blocks in every]
        return float(np.concatenate([*traces, np.diagonal(self.U_shared)]).max())

    def decrement(self) -> float:
        """Return infinity: J^T J is singular along the gauge."""
        return float("inf")

    def predicted(self, step: Step) -> float:
        """Return the decrease that the quadratic model promises for a step."""
        return step.promised

    def tied(self, B_cameras: Array, B_points: Array) -> Self:
        """Return the system in other unknowns z with x = B_cameras z and y = B_points z."""
        return replace(self, ties=self.ties.then(B_cameras, B_points))

    def damped_step(self, blocks: Blocks, lam: float) -> Step:
        """Return -(J^T J + lam blocks)^-1 g.

        It is solved by unknowns in which the damping is lam I: there the condition is about
        |blocks^-1 J^T J| / lam whatever the basis; a basis far from the one that suits the problem
        would cost digits, and the step its invariance.
        """
        damped = _Damped(self, blocks, lam)
        x, s, ys = damped.newton()
        if self.constraints is not None:
            x, s, ys = self._constrained(damped, (x, s, ys))
        energy = float(np.vdot(x, x) + np.vdot(s, s))
        for y, D in zip(ys, (blocks.points, *blocks.others), strict=True):
            energy += float(np.einsum("mi,mij,mj->", y, D, y))
        # step^T J^T J step = -g^T step - lam step^T blocks step.
        return self._step(damped.ties, (x, s, ys), lambda _, slope: 0.5 * (lam * energy - slope))

    def step_of(self, x: Array, s: Array, y: Array) -> Step:
        """Return the step of given unknowns of cameras and points, however they were found."""

        def promised(own: tuple[Array, Array], slope: float) -> float:
            bend = sum(float(np.vdot(*pair)) for pair in zip(self.product(*own), own, strict=True))
            return -(slope + 0.5 * bend)

        return self._step(self.ties, (x, s, [y]), promised)

    def _step(
        self,
        ties: Ties,
        unknowns: tuple[Array, Array, list[Array]],
        promised: Callable[[tuple[Array, Array], float], float],
    ) -> Step:
        x, s, (y, *others) = unknowns
        own = ties.cameras(x[..., None], s[:, None])[..., 0], ties.points(y[..., None])[..., 0]
        slope = float(np.vdot(self.normal.g_cameras, own[0]))
        slope += float(np.vdot(self.normal.g_points, own[1]))
        for normal, z in zip(self.normal.others, others, strict=True):
            slope += float(np.vdot(normal.g_points, z))
        return Step(*own, promised(own, slope), tuple(others))

    def _constrained(
        self, damped: _Damped, free: tuple[Array, Array, list[Array]]
    ) -> tuple[Array, Array, list[Array]]:
        """Return the step with the constraints' B B^T (Woodbury), from the one without."""
        assert self.constraints is not None
        Bc, Bp = self.constraints
        columns = damped.ties.local(Bc), damped.ties.shared(Bc), self.ties.of_points(Bp)
        along_x, along_s, along_ys = damped.solve(*columns)

        def along(x: Array, s: Array, y: Array) -> Array:
            """Return B^T times columns, (k, l)."""
            total = np.einsum("nak,nal->kl", columns[0], x) + np.einsum("rk,rl->kl", columns[1], s)
            return np.asarray(total + np.einsum("mbk,mbl->kl", columns[2], y))

        inner = np.eye(Bc.shape[2]) + along(along_x, along_s, along_ys[0])
        x, s, ys = free
        shift = np.linalg.solve(inner, along(x[..., None], s[:, None], ys[0][..., None]))[:, 0]
        moved = [y - more @ shift for y, more in zip(ys, along_ys, strict=True)]
        return x - along_x @ shift, s - along_s @ shift, moved

    def product(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return J^T J, and the constraints' term, times own tangents (n, d) and (m, b)."""
        assert not self.normal.others
        coupling = self.normal.coupling
        x = np.einsum("nij,nj->ni", self.normal.U, cameras) + coupling.to_cameras(None, points)
        y = np.einsum("mij,mj->mi", self.normal.V, points) + coupling.to_points(None, cameras)
        if self.constraints is not None:
            Bc, Bp = self.constraints
            along = np.einsum("nik,ni->k", Bc, cameras) + np.einsum("mik,mi->k", Bp, points)
            x, y = x + Bc @ along, y + Bp @ along
        return x, y

    def reduced(self, T: Array) -> Array:
        """Return the dense reduced system of x and s, points eliminated with T T^T = V^-1.

        Shape (n a + r, n a + r).
        """
        assert not self.normal.others
        n, d, _ = self.normal.U.shape
        S = -self.normal.coupling.schur(self.own_roots(T), None)[0].dense()
        S[np.arange(n), :, np.arange(n), :] += self.normal.U
        border = self.ties.border(n, d)
        A = np.broadcast_to(np.eye(d), (n, d, d)) if self.ties.A is None else self.ties.A
        a, r = A.shape[2], border.shape[2]
        whole = np.zeros((n * a + r, n * a + r))
        blocks = np.swapaxes(A, 1, 2)[:, None] @ S.transpose(0, 2, 1, 3) @ A
        whole[: n * a, : n * a] = blocks.transpose(0, 2, 1, 3).reshape(n * a, n * a)
        if r:
            across = np.einsum("iajb,jbr->iar", S, border, optimize=True)
            whole[n * a :, n * a :] = np.einsum("iar,ias->rs", border, across)
            whole[: n * a, n * a :] = (np.swapaxes(A, 1, 2) @ across).reshape(n * a, r)
            whole[n * a :, : n * a] = whole[: n * a, n * a :].T
        frozen = np.flatnonzero(~A.any(axis=1).ravel())
        whole[frozen, frozen] = 1.0
        return whole

    def eliminated(self, blocks: Blocks, lam: float) -> list[Roots]:
        """Return all kinds of features, lam times a damping added: points first."""
        root, half = self.inverse_roots(self.V, blocks.points, lam, self.gradients[2])
        found = [Roots(self.normal.coupling, root, self.own_roots(root), half)]
        others = self.normal.others, blocks.others, self.other_roots
        for own, D, inverse_roots in zip(*others, strict=True):
            root, half = inverse_roots(own.V, D, lam, own.g_points)
            found.append(Roots(own.coupling, root, root, half))
        return found

    def own_roots(self, T: Array) -> Array:
        """Return roots (m, b, b) in own tangents, columns of zeros added where unknowns lack."""
        own = self.ties.points(T)
        lack = own.shape[1] - own.shape[2]
        if lack:
            own = np.concatenate([own, np.zeros((*own.shape[:2], lack))], axis=2)
        return np.ascontiguousarray(own)


@dataclass(frozen=True)
class BundleSystem(System):
    """A system that knows where it was made.

    Attributes
    ----------
    model : CameraModel
        The camera.
    cameras, points : ndarray, shape (n, c), (m, b)
        The estimate.
    """

    model: CameraModel = field(kw_only=True)
    cameras: Array = field(kw_only=True)
    points: Array = field(kw_only=True)


class _Damped:
    """(J^T J + lam D)^-1, in unknowns of the views in which D is one."""

    def __init__(self, system: System, blocks: Blocks, lam: float) -> None:
        self._system = system
        whitening = np.linalg.inv(np.swapaxes(np.linalg.cholesky(blocks.cameras), 1, 2))
        self.ties = system.ties.then(whitening, None).scaled(1.0 / np.sqrt(blocks.shared))
        self._kinds = system.eliminated(blocks, lam)
        white = congruent(self.ties.A, system.normal.U)
        white = white + lam * np.eye(white.shape[1])
        parts = [Eliminated(own.coupling, own.T, own.wide(own.half)) for own in self._kinds]
        self._reduced, self._right = reduced_system(parts, system.normal.U, self.ties, white, lam)

    def newton(self) -> tuple[Array, Array, list[Array]]:
        """Return minus this times the gradient: of views, shared unknowns, kinds of features."""
        right = (self._right - self._system.normal.g_cameras)[..., None]
        x, s = self._reduced.solve(self.ties.local(right), self.ties.shared(right))
        own = self.ties.cameras(x, s)[..., 0]
        ys = [
            -np.einsum("mij,mj->mi", kind.root, kind.half + kind.coupled(own))
            for kind in self._kinds
        ]
        return x[..., 0], s[:, 0], ys

    def solve(self, x: Array, s: Array, y: Array) -> tuple[Array, Array, list[Array]]:
        """Return this times (n, a, k), (r, k), (m, b', k), and zeros of other features."""
        points = self._kinds[0]
        half = np.swapaxes(points.root, 1, 2) @ y
        right = points.coupling.to_cameras(points.T, points.wide(half))
        x, s = self._reduced.solve(x - self.ties.local(right), s - self.ties.shared(right))
        own = self.ties.cameras(x, s)
        ys = [-kind.root @ kind.coupled(own) for kind in self._kinds]
        return x, s, [ys[0] + points.root @ half, *ys[1:]]
