"""Dampings of the many-view problem: what is added to J^T J, or how a step is made without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.gauge import Gauge
from epigauge.multi_view.null_space import minimum_norm_step
from epigauge.multi_view.problem import Linearized
from epigauge.multi_view.system import BundleSystem

__all__ = [
    "ByMatrix",
    "Covariant",
    "GaugeInvariant",
    "Implicit",
    "Levenberg",
    "Marquardt",
    "PseudoInverse",
]

Array = NDArray[np.float64]
Blocks = tuple[Array, Array]

#: First lambda, relative to the size of the system where the damping does not scale with it.
START = 1e-3


class ByMatrix:
    """A damping that adds lambda W; W is block diagonal."""

    def start(self, system: Linearized) -> float:
        """Return the first lambda."""
        return START

    def matrix(self, system: Linearized) -> Blocks:
        """Return the blocks of W, (n, a, a) and (m, b, b)."""
        raise NotImplementedError

    def step(self, system: Linearized, lam: float) -> Array:
        """Return -(N + lambda W)^-1 g."""
        cameras, points = self.matrix(system)
        return system.damped(lam * cameras, lam * points).solve()


class Levenberg(ByMatrix):
    """W = I: invariant under orthonormal changes of basis only."""

    def start(self, system: Linearized) -> float:
        """Return a fraction of the largest diagonal entry."""
        return START * system.largest()

    def matrix(self, system: Linearized) -> Blocks:
        """Return identities."""
        return _identities(system)


class Marquardt(ByMatrix):
    """W = diag(N): invariant under the scales of cameras and points only."""

    def matrix(self, system: Linearized) -> Blocks:
        """Return the diagonals."""
        return tuple(_diagonals(blocks) for blocks in (system.U, system.V))  # type: ignore[return-value]


class Covariant(ByMatrix):
    """W = blockdiag(N) + blockdiag(Z^T Z), Z = d log depth: satisfies B03 eq. (8) for every T~."""

    def matrix(self, system: Linearized) -> Blocks:
        """Return the blocks of N and of the depths."""
        assert system.problem is not None
        assert system.state is not None
        cameras, points = system.problem.depth_blocks(system.state)
        return system.U + cameras, system.V + points


@dataclass(frozen=True)
class Implicit(ByMatrix):
    """An inner damping as if in another gauge, without moving there (B03 eq. 9).

    Parameters
    ----------
    inner : ByMatrix
        The damping.
    gauge : Gauge
        Where it is to act.
    """

    inner: ByMatrix
    gauge: Gauge

    def start(self, system: Linearized) -> float:
        """Return the inner damping's first lambda in the gauge."""
        return self.inner.start(self._moved(system)[0])

    def matrix(self, system: Linearized) -> Blocks:
        """Return T~^T W T~, T~ from here to the gauge."""
        moved, (cameras, points) = self._moved(system)
        W_cameras, W_points = self.inner.matrix(moved)
        return (
            np.swapaxes(cameras, 1, 2) @ W_cameras @ cameras,
            np.swapaxes(points, 1, 2) @ W_points @ points,
        )

    def _moved(self, system: Linearized) -> tuple[Linearized, Blocks]:
        assert system.state is not None
        there = self.gauge.transformation(system.state.P, system.state.Q)
        moved = system.transformed(*there.inverse().blocks())
        assert isinstance(moved, Linearized)
        P, Q = there.apply(system.state.P, system.state.Q)
        return replace(moved, state=replace(system.state, P=P, Q=Q)), there.blocks()


@dataclass(frozen=True)
class GaugeInvariant:
    """Table 1 of B03 as printed; its W^-1 has rank one a block, so the step is taken in dual form.

    delta = -R^T (R N R^T + lambda I)^-1 R g with R = diag(M_1, M_1, M_1, ..., S, ..., S). The
    constrained maximisation puts all weight on the top eigenvector of a Gram matrix of gradients.

    Parameters
    ----------
    norm : {"product", "factor"}
        What is normalised: |R^T R|^2 as printed in Table 1, or |vec R|^2 as its solution suggests.
    """

    norm: str = "product"

    def start(self, system: Linearized) -> float:
        """Return a fraction of the largest diagonal entry."""
        return START * system.largest()

    def step(self, system: Linearized, lam: float) -> Array:
        """Return the dual step."""
        B_cameras, B_points = self.directions(system)
        reduced = system.transformed(B_cameras, B_points)
        cameras, points = _identities(reduced)
        y = reduced.damped(lam * cameras, lam * points).solve()
        x, s = reduced.split(y)
        moved = (np.einsum("nij,nj->ni", B_cameras, x), np.einsum("nij,nj->ni", B_points, s))
        return np.concatenate([moved[0].ravel(), moved[1].ravel()])

    def directions(self, system: Linearized) -> Blocks:
        """Return R^T: (n, 12, 3) and (m, 4, 1)."""
        n, m = len(system.g_cameras), len(system.g_points)
        rows = system.g_cameras.reshape(n, 3, 4)
        cameras = np.zeros((n, 3, 4, 3))
        for i in range(n):
            direction = self._length(12) * _top_eigenvector(rows[i].T @ rows[i])
            for k in range(3):
                cameras[i, k, :, k] = direction
        direction = self._length(4) * _top_eigenvector(system.g_points.T @ system.g_points)
        return cameras.reshape(n, 12, 3), np.tile(direction[:, None], (m, 1, 1))

    def _length(self, b: int) -> float:
        # r r^T has Frobenius norm |r|^2.
        return float(b**0.25 if self.norm == "product" else b**0.5)


class PseudoInverse:
    """Minimum-norm Gauss-Newton steps by the known null space (FREE of B03); lambda shortens them.

    A rejected step is retried with the length 1 / (1 + lambda).
    """

    def start(self, system: Linearized) -> float:
        """Return the first lambda: practically the full step."""
        return START

    def step(self, system: Linearized, lam: float) -> Array:
        """Return -N^+ g / (1 + lambda)."""
        assert system.problem is not None
        assert system.state is not None
        state, kernels = system.state, system.problem.kernels
        return minimum_norm_step(kernels, system, state.P, state.Q) / (1.0 + lam)


def _identities(system: BundleSystem) -> Blocks:
    n, a = system.g_cameras.shape
    m, b = system.g_points.shape
    return np.broadcast_to(np.eye(a), (n, a, a)), np.broadcast_to(np.eye(b), (m, b, b))


def _diagonals(blocks: Array) -> Array:
    return blocks * np.eye(blocks.shape[1])


def _top_eigenvector(gram: Array) -> Array:
    return np.asarray(np.linalg.eigh(gram)[1][:, -1])
