"""The coupling of cameras and points, and the reduced system, computed in C whenever used.

Same interface as the NumPy reference in `coupling`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import PAIR, checked, function
from epigauge.kernels import table
from epigauge.multi_view.coupling import solved
from epigauge.multi_view.engine import Reference
from epigauge.multi_view.envelope import Envelope

if TYPE_CHECKING:
    from epigauge.multi_view.fused import Fused

__all__ = ["FusedCoupling"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FusedCoupling:
    """The coupling at an estimate, computed whenever it is used.

    Attributes
    ----------
    engine : Fused
        The observations.
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        The estimate, cameras in the order of the envelope.
    A, C : ndarray, shape (n, 12, a), (m, 4, b), or None
        Changes of parameters, cameras in their own order.
    """

    engine: Fused
    P: Array
    Q: Array
    A: Array | None = None
    C: Array | None = None

    def blocks(self) -> Array:
        """Return the blocks, one an observation, (N, a, b)."""
        own = self.engine
        reference = Reference(table("c"), own.layout, own.q, own.weights, own.loss)
        stored = reference.linearize(own.outward(self.P), self.Q).coupling
        if self.A is not None and self.C is not None:
            stored = stored.transformed(self.A, self.C)
        return stored.blocks()

    def transformed(self, B_cameras: Array, B_points: Array) -> FusedCoupling:
        """Return B_cameras^T W B_points, blocks (n, a, a') and (m, b, b')."""
        A = B_cameras if self.A is None else self.A @ B_cameras
        C = B_points if self.C is None else self.C @ B_points
        return replace(self, A=A, C=C)

    def times_points(self, y: Array) -> Array:
        """Return W y for vectors y (m, b, r), (n, a, r)."""
        moved = y if self.C is None else self.C @ y
        columns = [self.to_cameras(None, y=moved[..., k]) for k in range(moved.shape[2])]
        x = np.stack(columns, axis=2)
        return x if self.A is None else np.swapaxes(self.A, 1, 2) @ x

    def times_cameras(self, x: Array) -> Array:
        """Return W^T x for vectors x (n, a, r), (m, b, r)."""
        moved = x if self.A is None else self.A @ x
        y = np.stack([self.to_points(None, moved[..., k]) for k in range(moved.shape[2])], axis=2)
        return y if self.C is None else np.swapaxes(self.C, 1, 2) @ y

    def inverse_roots(self, V: Array) -> Array:
        """Return upper triangular T with T T^T = V^-1 for blocks V (m, b, b)."""
        if V.shape[1] != 4:
            return np.asarray(np.swapaxes(np.linalg.inv(np.linalg.cholesky(V)), 1, 2))
        T = np.empty(V.shape)
        if _root_points(np.ascontiguousarray(V), None, 0.0, None, T, None):
            raise _singular("the block of a point")
        return T

    def reduced(self, U: Array, roots: Array) -> FusedReduced:
        """Return the reduced system for camera blocks U, and roots of the inverse point blocks."""
        T = roots if self.C is None else self.C @ roots
        if T.shape[2] < 4:
            T = np.concatenate([T, np.zeros((len(T), 4, 4 - T.shape[2]))], axis=2)
        return FusedReduced(self, U, np.ascontiguousarray(T))

    def whitened_step(
        self,
        U: Array,
        V: Array,
        g_cameras: Array,
        g_points: Array,
        W: tuple[Array, Array],
        lam: float,
    ) -> tuple[Array, float] | None:
        """Return -(N + lam W)^-1 g and its W-norm squared; None leaves it to the system."""
        if self.A is not None or self.C is not None:
            return None
        own = self.engine
        V, g_points, W_points = map(np.ascontiguousarray, (V, g_points, W[1]))
        if own.alone and own.direct:
            return self._step_at_once(U, V, g_cameras, g_points, W[0], W_points, lam)
        n, m = len(self.P), len(self.Q)
        A, white = np.empty((n, 12, 12)), np.empty((n, 12, 12))
        U, W_cameras = map(np.ascontiguousarray, (U, W[0]))
        if function("bundle_whiten")(
            n, address(U), address(W_cameras), lam, address(A), address(white)
        ):
            raise _singular("the damping of a camera")
        T, half = np.empty((m, 4, 4)), np.empty((m, 4))

        def roots(part: slice) -> bool:
            made = g_points[part], T[part], half[part]
            return _root_points(V[part], W_points[part], lam, *made)

        if any(own.over_points(roots)):
            raise _singular("the block of a point")
        reduced = FusedReduced(replace(self, A=A), white, T, half)
        right = reduced.eliminated - (g_cameras[:, None] @ A)[:, 0]
        z = solved(reduced, right[..., None])
        step = np.empty(12 * n + 4 * m)
        step[: 12 * n] = (A @ z).ravel()
        coupled = self.to_points(T, step[: 12 * n].reshape(n, 12))
        y = step[12 * n :].reshape(m, 4)

        def moved(part: slice) -> float:
            arrays = [address(array[part]) for array in (T, half, coupled, W_points)]
            count = part.stop - part.start
            return float(function("bundle_point_steps")(count, 4, *arrays, 16, address(y[part])))

        return step, sum(own.over_points(moved)) + float(np.vdot(z, z))

    def _step_at_once(
        self,
        U: Array,
        V: Array,
        g_cameras: Array,
        g_points: Array,
        W_cameras: Array,
        W_points: Array,
        lam: float,
    ) -> tuple[Array, float]:
        """Return the same by one call, which costs less where the system is small."""
        own = self.engine
        step, energy = np.empty(g_cameras.size + g_points.size), ctypes.c_double()
        U, g_cameras, W_cameras = (own.inward(part) for part in (U, g_cameras, W_cameras))
        arrays = (self.P, self.Q, U, V, g_cameras, g_points, W_cameras, W_points)
        status = function("bundle_step")(
            own.reference,
            own.envelope.reference,
            *map(address, arrays),
            lam,
            address(step),
            ctypes.byref(energy),
        )
        if status == 2:
            raise _singular("the damped system")
        checked(status)
        if own.order is not None:
            x = step[: g_cameras.size].reshape(g_cameras.shape)
            x[...] = own.outward(x)
        return step, energy.value

    def to_points(self, T: Array | None, x: Array) -> Array:
        """Return T^T W^T x, (m, 4), in the parameters of (P, Q)."""
        x, points = self.engine.inward(x), np.empty((len(self.Q), 4))
        arrays = (self.P, self.Q, T, x, None, points, None)
        self.engine.each("bundle_couple", *map(address, arrays))
        return points

    def to_cameras(self, T: Array | None, x: Array | None = None, y: Array | None = None) -> Array:
        """Return W T (y + T^T W^T x), (n, 12), in the parameters of (P, Q)."""
        x = None if x is None else self.engine.inward(x)
        y = None if y is None else np.ascontiguousarray(y)
        before = tuple(map(address, (self.P, self.Q, T, x, y, None)))
        return self.engine.outward(
            self.engine.summed("bundle_couple", before, (len(self.P), 12))[0]
        )

    def schur(self, T: Array, half: Array | None, envelope: Envelope) -> tuple[Array, Array]:
        """Return the sums of pairs of W T T^T W^T, and W T half (n, 12)."""
        arrays = tuple(map(address, (self.P, self.Q, T, half)))
        shapes = ((envelope.blocks, PAIR), (len(self.P), 12))
        pairs, cameras = self.engine.summed(
            "bundle_schur", (*arrays, envelope.reference), *shapes, pairs=True
        )
        return pairs, self.engine.outward(cameras)


@dataclass(frozen=True)
class FusedReduced:
    """The reduced system S = U - A^T W T T^T W^T A; only its blocks are stored, to factor it.

    Attributes
    ----------
    coupling : FusedCoupling
        W, and the change of parameters A.
    U : ndarray, shape (n, a, a)
        Camera blocks.
    T : ndarray, shape (m, 4, 4)
        Roots of the inverse point blocks.
    half : ndarray, shape (m, 4), or None
        T^T g for the points' gradient g.
    """

    coupling: FusedCoupling
    U: Array
    T: Array
    half: Array | None = None

    @property
    def direct(self) -> bool:
        """Tell whether it is to be stored and factored, rather than iterated with."""
        return self.coupling.engine.direct

    @cached_property
    def _sums(self) -> tuple[Array, Array]:
        return self.coupling.schur(self.T, self.half, self.coupling.engine.envelope)

    @property
    def eliminated(self) -> Array:
        """Return A^T W T half, (n, a)."""
        coupling = self.coupling
        moved = self._sums[1] if self.direct else coupling.to_cameras(self.T, y=self.half)
        return moved if coupling.A is None else (moved[:, None] @ coupling.A)[:, 0]

    def matrix(self) -> Array:
        """Return S, dense."""
        own = self.coupling.engine
        n, a, _ = self.U.shape
        blocks = own.envelope.reduced(self._sums[0], np.zeros((n, 12, 12)), None)
        number = np.arange(n) if own.order is None else np.argsort(own.order)
        S = own.envelope.whole(blocks)[number[:, None], number]
        if self.coupling.A is not None:
            A = self.coupling.A
            S = np.swapaxes(A, 1, 2)[:, None] @ S @ A
        S[np.arange(n), np.arange(n)] += self.U
        return S.transpose(0, 2, 1, 3).reshape(n * a, n * a)

    def solve(self, right: Array) -> Array:
        """Return S^-1 times right-hand sides (n, a, r), by a factor of S."""
        own, A = self.coupling.engine, self.coupling.A
        n, a, r = right.shape
        if a != 12:
            x = np.linalg.solve(self.matrix(), right.reshape(n * a, r))
            return np.asarray(x).reshape(n, a, r)
        U, inner = own.inward(self.U), own.inward(right)
        A = None if A is None else own.inward(A)
        return own.outward(own.envelope.solved(self._sums[0], U, A, inner))

    def times(self, x: Array) -> Array:
        """Return S times a vector (n, a)."""
        A = self.coupling.A
        moved = x if A is None else np.einsum("nij,nj->ni", A, x)
        inner = self.coupling.to_cameras(self.T, moved)
        inner = inner if A is None else np.einsum("nij,ni->nj", A, inner)
        return np.asarray(np.einsum("nij,nj->ni", self.U, x) - inner)

    def diagonal(self) -> Array:
        """Return the diagonal blocks of S, (n, a, a)."""
        n, A = len(self.U), self.coupling.A
        alone = Envelope.diagonal(n)
        pairs, _ = self.coupling.schur(self.T, None, alone)
        less = self.coupling.engine.outward(alone.reduced(pairs, np.zeros((n, 12, 12)), None))
        return self.U + (less if A is None else np.swapaxes(A, 1, 2) @ less @ A)


def _root_points(
    V: Array, W: Array | None, lam: float, g: Array | None, T: Array, half: Array | None
) -> bool:
    """Make T with T T^T = (V + lam W)^-1, V^-1 without W, and half = T^T g; tell of failure."""
    arrays = map(address, (g, T, half))
    return bool(
        function("bundle_inverse_roots")(len(V), 4, address(V), address(W), 16, lam, *arrays)
    )


def _singular(what: str) -> np.linalg.LinAlgError:
    return np.linalg.LinAlgError(f"{what} is not positive definite")
