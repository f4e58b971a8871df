"""Normal equations in the unknowns, and the one way to a damped step.

Points are eliminated, then the shared unknowns from what is left: the reduced system of the views
has blocks for pairs that see common points, and a border of the shared unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Coupling, Normal, Pairs
from epigauge.bundle.ties import Ties, congruent
from epigauge.cameras import CameraModel

__all__ = [
    "Blocks",
    "Border",
    "Bordered",
    "BundleSystem",
    "Iterated",
    "Step",
    "System",
    "reduced_system",
]

Array = NDArray[np.float64]

_CG_TOLERANCE = 1e-10
_CG_ITERATIONS = 2000


class Blocks(NamedTuple):
    """A damping in the unknowns: blocks of views (n, a, a), a diagonal (r,), points (m, b, b)."""

    cameras: Array
    shared: Array
    points: Array


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
    """

    cameras: Array
    points: Array
    promised: float

    def shortened(self, system: System, share: float) -> Step:
        """Return a share of the step, with its own promise."""
        cameras, points = share * self.cameras, share * self.points
        slope = float(np.vdot(system.normal.g_cameras, cameras))
        slope += float(np.vdot(system.normal.g_points, points))
        # promised = -(slope + bend / 2), and the bend goes with the square of the share.
        half_bend = -(self.promised + slope / share) * share**2
        return Step(cameras, points, -(slope + half_bend))

    def __array__(self, dtype: Any = None, copy: Any = None) -> Array:
        """Return the step as one vector: cameras, then points."""
        return np.concatenate([self.cameras.ravel(), self.points.ravel()])


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
    """

    normal: Normal
    inverse_roots: Callable[[Array, Array, float, Array], tuple[Array, Array]]
    ties: Ties = field(default_factory=Ties)
    constraints: Border | None = None

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
        """Return the gradient as one vector: views, shared unknowns, points."""
        return np.concatenate([part.ravel() for part in self.gradients])

    def largest(self) -> float:
        """Return the largest mean diagonal entry of a block.

        Unlike the largest entry, an orthonormal change of basis does not change it.
        """
        traces = [np.einsum("nii->n", blocks) / blocks.shape[1] for blocks in (self.U, self.V)]
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
        x, s, y = damped.newton()
        if self.constraints is not None:
            x, s, y = self._constrained(damped, (x, s, y))
        energy = float(np.vdot(x, x) + np.vdot(s, s))
        energy += float(np.einsum("mi,mij,mj->", y, blocks.points, y))
        # step^T J^T J step = -g^T step - lam step^T blocks step.
        return self._step(damped.ties, (x, s, y), lambda _, slope: 0.5 * (lam * energy - slope))

    def step_of(self, x: Array, s: Array, y: Array) -> Step:
        """Return the step of given unknowns, however they were found."""

        def promised(own: tuple[Array, Array], slope: float) -> float:
            bend = sum(float(np.vdot(*pair)) for pair in zip(self.product(*own), own, strict=True))
            return -(slope + 0.5 * bend)

        return self._step(self.ties, (x, s, y), promised)

    def _step(
        self,
        ties: Ties,
        unknowns: tuple[Array, Array, Array],
        promised: Callable[[tuple[Array, Array], float], float],
    ) -> Step:
        x, s, y = unknowns
        own = ties.cameras(x[..., None], s[:, None])[..., 0], ties.points(y[..., None])[..., 0]
        slope = float(np.vdot(self.normal.g_cameras, own[0]))
        slope += float(np.vdot(self.normal.g_points, own[1]))
        return Step(*own, promised(own, slope))

    def _constrained(
        self, damped: _Damped, free: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Return the step with the constraints' B B^T (Woodbury), from the one without."""
        assert self.constraints is not None
        Bc, Bp = self.constraints
        columns = damped.ties.local(Bc), damped.ties.shared(Bc), self.ties.of_points(Bp)
        moved = damped.solve(*columns)

        def along(x: Array, s: Array, y: Array) -> Array:
            """Return B^T times columns, (k, l)."""
            total = np.einsum("nak,nal->kl", columns[0], x) + np.einsum("rk,rl->kl", columns[1], s)
            return np.asarray(total + np.einsum("mbk,mbl->kl", columns[2], y))

        inner = np.eye(Bc.shape[2]) + along(*moved)
        x, s, y = free
        shift = np.linalg.solve(inner, along(x[..., None], s[:, None], y[..., None]))[:, 0]
        return x - moved[0] @ shift, s - moved[1] @ shift, y - moved[2] @ shift

    def product(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return J^T J, and the constraints' term, times own tangents (n, d) and (m, b)."""
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
        self._root, self._half = system.inverse_roots(
            system.V, blocks.points, lam, system.gradients[2]
        )
        self._T = system.own_roots(self._root)
        white = congruent(self.ties.A, system.normal.U)
        white = white + lam * np.eye(white.shape[1])
        self._reduced, self._right = reduced_system(
            system.normal, self.ties, self._T, self._wide(self._half), white, lam
        )

    def newton(self) -> tuple[Array, Array, Array]:
        """Return minus this times the gradient."""
        right = (self._right - self._system.normal.g_cameras)[..., None]
        x, s = self._reduced.solve(self.ties.local(right), self.ties.shared(right))
        coupled = self._coupled(self.ties.cameras(x, s)[..., 0])
        y = -np.einsum("mij,mj->mi", self._root, self._half + coupled)
        return x[..., 0], s[:, 0], y

    def solve(self, x: Array, s: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return this times (n, a, k), (r, k), (m, b', k)."""
        coupling, half = self._system.normal.coupling, np.swapaxes(self._root, 1, 2) @ y
        columns = range(half.shape[2])
        right = np.stack(
            [coupling.to_cameras(self._T, self._wide(half[..., k])) for k in columns], axis=2
        )
        x, s = self._reduced.solve(x - self.ties.local(right), s - self.ties.shared(right))
        own = self.ties.cameras(x, s)
        coupled = np.stack([self._coupled(own[..., k]) for k in columns], axis=2)
        return x, s, self._root @ (half - coupled)

    def _coupled(self, own: Array) -> Array:
        """Return T^T W^T own for roots T of the points' unknowns, (m, b')."""
        coupled = self._system.normal.coupling.to_points(self._T, np.ascontiguousarray(own))
        return coupled[:, : self._root.shape[2]]

    def _wide(self, half: Array) -> Array:
        """Return (m, b') with zeros where the points have fewer unknowns than coordinates."""
        lack = self._T.shape[2] - half.shape[1]
        return np.ascontiguousarray(np.pad(half, ((0, 0), (0, lack))) if lack else half)


def reduced_system(
    normal: Normal, ties: Ties, T: Array, half: Array | None, white: Array, lam: float
) -> tuple[Bordered | Iterated, Array]:
    """Return the reduced system of the views' unknowns, and W T half, (n, d).

    Parameters
    ----------
    normal : Normal
        In own tangents.
    ties : Ties
        From the unknowns.
    T : ndarray, shape (m, b, b)
        Inverse roots of the points' blocks, in own tangents.
    half : ndarray, shape (m, b), or None
        T^T times a right-hand side.
    white : ndarray, shape (n, a, a)
        Blocks of the views' own unknowns, lam I and all else included.
    lam : float
        Added to the diagonal of the shared ones.
    """
    coupling = normal.coupling
    if coupling.direct:
        pairs, right = coupling.schur(T, half)
        return Bordered(pairs, normal.U, ties, white, lam), right
    right = np.zeros(normal.g_cameras.shape) if half is None else coupling.to_cameras(T, half)
    return Iterated(coupling, normal.U, ties, T, white, lam), right


class Bordered:
    """The reduced system by a factor of its blocks, and elimination of the shared unknowns.

    S = [S_xx S_xs; S_sx S_ss] of U - P in the unknowns, plus lam I.
    """

    def __init__(self, pairs: Pairs, U: Array, ties: Ties, white: Array, lam: float) -> None:
        self._factor = pairs.factor(white, ties.A)
        self._across: Array | None = None
        if ties.n_shared:
            border = ties.border(*U.shape[:2])
            own = U @ border - pairs.times(border)
            self._across = ties.local(own)
            self._moved = self._factor.solve(self._across)
            inner = ties.shared(own) + lam * np.eye(ties.n_shared)
            inner = inner - np.einsum("iar,ias->rs", self._across, self._moved)
            self._inner = 0.5 * (inner + inner.T)
            np.linalg.cholesky(self._inner)  # raises where it is not positive definite

    def solve(self, x: Array, s: Array) -> tuple[Array, Array]:
        """Return S^-1 times (n, a, k) and (r, k)."""
        x = self._factor.solve(np.ascontiguousarray(x))
        if self._across is None:
            return x, s
        s = np.linalg.solve(self._inner, s - np.einsum("iar,iak->rk", self._across, x))
        return x - self._moved @ s, s


class Iterated:
    """The reduced system by conjugate gradients, never formed; diagonal blocks precondition."""

    def __init__(
        self, coupling: Coupling, U: Array, ties: Ties, T: Array, white: Array, lam: float
    ) -> None:
        self._coupling, self._U, self._ties, self._T = coupling, U, ties, T
        self._white, self._lam = white, lam
        P = coupling.diagonal(T)
        less = P if ties.A is None else np.swapaxes(ties.A, 1, 2) @ P @ ties.A
        self._inverse = np.linalg.inv(white - less)
        own = (U - P) @ ties.border(*U.shape[:2])
        self._inner = np.linalg.inv(ties.shared(own) + lam * np.eye(ties.n_shared))

    def solve(self, x: Array, s: Array) -> tuple[Array, Array]:
        """Return S^-1 times (n, a, k) and (r, k)."""
        parts = [self._solve(x[..., k], s[:, k]) for k in range(x.shape[2])]
        return np.stack([x for x, _ in parts], axis=2), np.stack([s for _, s in parts], axis=1)

    def _solve(self, x: Array, s: Array) -> tuple[Array, Array]:
        size = x.size

        def times(z: Array) -> Array:
            local, shared = self._times(z[:size].reshape(x.shape), z[size:])
            return np.concatenate([local.ravel(), shared])

        def precondition(z: Array) -> Array:
            local = np.einsum("nij,nj->ni", self._inverse, z[:size].reshape(x.shape))
            return np.concatenate([local.ravel(), self._inner @ z[size:]])

        found = conjugate_gradients(times, precondition, np.concatenate([x.ravel(), s]))
        return found[:size].reshape(x.shape), found[size:]

    def _times(self, x: Array, s: Array) -> tuple[Array, Array]:
        ties, T, coupling = self._ties, self._T, self._coupling
        own = np.ascontiguousarray(ties.cameras(x[..., None], s[:, None])[..., 0])
        less = coupling.to_cameras(T, coupling.to_points(T, own))[..., None]
        of_shared = self._U @ ties.cameras(np.zeros((*x.shape, 1)), s[:, None])
        local = np.einsum("nij,nj->ni", self._white, x) + ties.local(of_shared - less)[..., 0]
        shared = ties.shared(self._U @ own[..., None] - less)[:, 0] + self._lam * s
        return local, shared


def conjugate_gradients(
    times: Callable[[Array], Array], precondition: Callable[[Array], Array], right: Array
) -> Array:
    """Solve a linear system that is only multiplied with.

    Parameters
    ----------
    times, precondition : callable
        Products of a vector (p,) with the matrix, positive definite, and with about its inverse.
    right : ndarray, shape (p,)
        Right-hand side.

    Returns
    -------
    ndarray, shape (p,)
        The solution, to a relative 1e-10 in the norm of the preconditioned residual.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is seen not to be positive definite, or is not finite.
    """
    x = np.zeros_like(right)
    residual = right.copy()
    z = precondition(residual)
    direction, energy = z, float(residual @ z)
    goal = _CG_TOLERANCE**2 * energy
    for _ in range(_CG_ITERATIONS):
        if energy <= goal:
            break
        image = times(direction)
        curvature = float(direction @ image)
        if not curvature > 0.0:
            raise np.linalg.LinAlgError("the reduced system is not positive definite")
        length = energy / curvature
        x = x + length * direction
        residual = residual - length * image
        z = precondition(residual)
        previous, energy = energy, float(residual @ z)
        direction = z + (energy / previous) * direction
    return x
