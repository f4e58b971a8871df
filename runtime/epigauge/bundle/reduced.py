"""The reduced system of the cameras and shared unknowns, factored or only multiplied with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import CameraBlocks, Coupling, Pairs
from epigauge.bundle.ties import Ties

__all__ = ["Bordered", "Eliminated", "Iterated", "conjugate_gradients", "reduced_system"]

Array = NDArray[np.float64]

_CG_TOLERANCE = 1e-10
_CG_ITERATIONS = 2000


class Eliminated(NamedTuple):
    """The features of one kind, in own tangents.

    Attributes
    ----------
    coupling : Coupling
        With the cameras.
    T : ndarray, shape (m, b, b)
        Inverse roots of the features' blocks.
    half : ndarray, shape (m, b), or None
        T^T times a right-hand side.
    """

    coupling: Coupling
    T: Array
    half: Array | None = None


def reduced_system(
    kinds: Sequence[Eliminated], U: Array, ties: Ties, white: Array, lam: float
) -> tuple[Bordered | Iterated, Array]:
    """Return the reduced system of the views' unknowns, and the sum of W T half, (n, d).

    Parameters
    ----------
    kinds : sequence of Eliminated
        All features: points, then those of other kinds.
    U : ndarray, shape (n, d, d)
        Blocks of the cameras, in own tangents.
    ties : Ties
        From the unknowns.
    white : ndarray, shape (n, a, a)
        Blocks of the views' own unknowns, lam I and all else included.
    lam : float
        Added to the diagonal of the shared ones.
    """
    if all(own.coupling.direct for own in kinds):
        pairs, right = kinds[0].coupling.schur(*kinds[0][1:])
        for own in kinds[1:]:
            more, rest = own.coupling.schur(*own[1:])
            pairs, right = pairs.plus(more), right + rest
        return Bordered(pairs, U, ties, white, lam), right
    right = np.zeros(U.shape[:2])
    for own in kinds:
        if own.half is not None:
            right = right + own.coupling.to_cameras(own.T, own.half)
    coupling: Any = kinds[0].coupling if len(kinds) == 1 else _Sum(kinds)
    return Iterated(coupling, U, ties, kinds[0].T, white, lam), right


class _Sum:
    """The couplings of all kinds of features as `Iterated` asks for one; it holds their roots."""

    def __init__(self, kinds: Sequence[Eliminated]) -> None:
        self._kinds = kinds

    def diagonal(self, _: Array) -> Array:
        """Return the diagonal blocks of what all kinds take off, (n, d, d)."""
        return np.asarray(sum(own.coupling.diagonal(own.T) for own in self._kinds))

    def to_points(self, _: Array, x: Array) -> list[Array]:
        """Return T^T W^T x of each kind."""
        return [own.coupling.to_points(own.T, x) for own in self._kinds]

    def to_cameras(self, _: Array, halves: list[Array]) -> Array:
        """Return the sum of W T half."""
        pairs = zip(self._kinds, halves, strict=True)
        return np.asarray(sum(own.coupling.to_cameras(own.T, half) for own, half in pairs))


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
            self._outer = np.diagonal(ties.shared(own)) + lam
            np.linalg.cholesky(self._inner)  # raises where it is not positive definite

    def solve(self, x: Array, s: Array) -> tuple[Array, Array]:
        """Return S^-1 times (n, a, k) and (r, k)."""
        x = self._factor.solve(np.ascontiguousarray(x))
        if self._across is None:
            return x, s
        s = np.linalg.solve(self._inner, s - np.einsum("iar,iak->rk", self._across, x))
        return x - self._moved @ s, s

    def inverse(self, ties: Ties) -> tuple[CameraBlocks, float]:
        """Return blocks of S^-1 in own tangents, and the largest variance inflation S_ii (S^-1)_ii.

        Of an unknown that nothing but rounding determines, the inflation has no end.
        """
        inverse = self._factor.inverse()
        of_S, of_inverse = inverse.diagonals
        if self._across is None:
            n, d = of_S.shape if ties.A is None else ties.A.shape[:2]
            largest = (of_S * of_inverse).max(initial=0.0)
            return inverse.spread(ties.A, np.zeros((n, d, 0))), float(largest)
        root = np.linalg.inv(np.linalg.cholesky(self._inner)).T
        # S^-1 has the blocks M + Z C Z^T, -Z C and C of the views' own and the shared unknowns.
        own = self._moved @ root
        shared = self._outer * np.sum(root**2, axis=1)
        whole = of_S * (of_inverse + np.sum(own**2, axis=2))
        found = inverse.spread(ties.A, ties.cameras(own, -root))
        return found, float(max(whole.max(initial=0.0), shared.max()))


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
