"""Dampings of the many-view problem: what is added to J^T J, or how a step is made without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import point_damping
from epigauge.bundle.moves import move_into
from epigauge.bundle.null_space import minimum_norm_step
from epigauge.bundle.solve import Blocks, BundleSystem, Step
from epigauge.kernels import Table
from epigauge.multi_view.gauge import Gauge

__all__ = [
    "DAMPINGS",
    "ByMatrix",
    "Covariant",
    "GaugeInvariant",
    "Implicit",
    "Levenberg",
    "Marquardt",
    "PseudoInverse",
    "lifted",
]

Array = NDArray[np.float64]

#: First lambda, relative to the size of the system where the damping does not scale with it.
START = 1e-3

#: The same for the covariant damping of metric cameras, which holds points by their mean entry.
START_METRIC = 1e-4

#: Least lambda over the first, where W scales with the system. Below, rounding decides on steps
#: along directions that a flat scene hardly determines: other ones in every basis.
LAM_FLOOR = 1e-8

#: The same for metric cameras: the least lambda is that of the others, over a smaller first one.
LAM_FLOOR_METRIC = LAM_FLOOR * START / START_METRIC

#: Least diagonal entry of lambda diag(N), of the mean of its block.
_LEAST = 1e-6

#: The same for the own unknowns of metric cameras, of the largest entry of the same kind.
_SMALL = 1e-12


class ByMatrix:
    """A damping that adds lambda W; W is block diagonal."""

    def start(self, system: BundleSystem) -> float:
        """Return the first lambda."""
        return START

    def blocks(self, system: BundleSystem) -> Blocks:
        """Return the blocks of W in the unknowns."""
        raise NotImplementedError

    def step(self, system: BundleSystem, lam: float) -> Step:
        """Return -(N + lambda W)^-1 g."""
        return system.damped_step(self.blocks(system), lam)


class Levenberg(ByMatrix):
    """W = I: invariant under orthonormal changes of basis only."""

    def start(self, system: BundleSystem) -> float:
        """Return a fraction of the largest diagonal entry."""
        return START * system.largest()

    def blocks(self, system: BundleSystem) -> Blocks:
        """Return identities."""
        x, s, y = system.gradients
        others = tuple(_identities(own.g_points) for own in system.normal.others)
        return Blocks(_identities(x), np.ones(len(s)), _identities(y), others)


class Marquardt(ByMatrix):
    """W = diag(N): invariant under the scales of cameras and points only."""

    def blocks(self, system: BundleSystem) -> Blocks:
        """Return the diagonals."""
        shared = np.diagonal(system.U_shared)
        others = tuple(_diagonals(own.V) for own in system.normal.others)
        return Blocks(_diagonals(system.U), _positive(shared), _diagonals(system.V), others)


@dataclass(frozen=True)
class Covariant(ByMatrix):
    """The damping that the gauge of the camera model leaves as it is.

    Homogeneous: W = blockdiag(N) + blockdiag(Z^T Z), Z = d log depth, which satisfies B03 eq. (8)
    for every T~. Metric: diag(N) of each camera, whose update is in its own frame, and the trace of
    each point's block. Affine: blockdiag(N).

    Parameters
    ----------
    lam_floor : float
        Least lambda over the first.
    """

    lam_floor: float = LAM_FLOOR

    def start(self, system: BundleSystem) -> float:
        """Return the first lambda."""
        return START_METRIC if system.model.metric else START

    def blocks(self, system: BundleSystem) -> Blocks:
        """Return the blocks of W."""
        model = system.model
        others = tuple(
            point_damping(model, own.V, None if own.depth_blocks is None else own.depth_blocks[1])
            for own in system.normal.others
        )
        if model.homogeneous:
            cameras, points = system.depth_blocks
            points = point_damping(model, system.V, points)
            return Blocks(system.U + cameras, np.ones(0), points, others)
        points = point_damping(model, system.V, None)
        if not model.metric:
            return Blocks(lifted(system.U), np.ones(0), lifted(points), others)
        diagonal = np.einsum("nii->ni", system.U)
        # An unknown that moves no image, as the distortion of points on the axis: of the others'.
        diagonal = np.maximum(diagonal, _SMALL * diagonal.max(axis=0))
        cameras = np.where(diagonal > 0.0, diagonal, 1.0)[:, :, None] * np.eye(diagonal.shape[1])
        return Blocks(cameras, _positive(np.diagonal(system.U_shared)), points, others)


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

    def start(self, system: BundleSystem) -> float:
        """Return the inner damping's first lambda in the gauge."""
        return self.inner.start(self._moved(system)[0])

    def blocks(self, system: BundleSystem) -> Blocks:
        """Return T~^T W T~, T~ from here to the gauge."""
        moved, (cameras, points) = self._moved(system)
        W = self.inner.blocks(moved)
        return Blocks(
            np.swapaxes(cameras, 1, 2) @ W.cameras @ cameras,
            W.shared,
            np.swapaxes(points, 1, 2) @ W.points @ points,
        )

    def _moved(self, system: BundleSystem) -> tuple[BundleSystem, tuple[Array, Array]]:
        there = move_into(self.gauge, system.model, system.cameras, system.points)
        sizes = len(system.cameras), len(system.points), system.model.tangent_size
        return system.tied(*there.inverse().blocks(*sizes)), there.blocks(*sizes)


@dataclass(frozen=True)
class GaugeInvariant:
    """Table 1 of B03; its W^-1 may be singular, so the step is taken in dual form.

    delta = -R^T (R N R^T + lambda I)^-1 R g with R = diag(M_1, M_1, M_1, ..., S, ..., S), which
    depends on R^T R only. Each block maximises sum |R g_k|^2 = <R^T R, G> over the gradients g_k,
    G = sum g_k g_k^T, under a normalisation with b = 12 (cameras) or 4 (points).

    Parameters
    ----------
    norm : {"product", "factor"}
        What is normalised. "product": |R^T R|^2 = b as Table 1 prints, whose maximiser is
        R^T R = sqrt(b) G / |G| (Cauchy-Schwarz). "factor": |vec R|^2 = b, for which the paper's
        solution by a singular vector is right; R^T R = b v v^T of rank one, v the top eigenvector
        of G: each camera moves in three directions, all points along one.
    """

    norm: str = "product"

    def start(self, system: BundleSystem) -> float:
        """Return a fraction of the largest diagonal entry."""
        return START * system.largest()

    def step(self, system: BundleSystem, lam: float) -> Step:
        """Return the dual step."""
        reduced = system.tied(*self.directions(system))
        return reduced.damped_step(Levenberg().blocks(reduced), lam)

    def directions(self, system: BundleSystem) -> tuple[Array, Array]:
        """Return R^T: (n, 12, 3 k) and (m, 4, k), k = 4 for "product" and 1 for "factor"."""
        of_cameras, _, of_points = system.gradients
        rows = of_cameras.reshape(-1, 3, 4)
        cameras = [np.kron(np.eye(3), self._block(g.T @ g, 12)) for g in rows]
        points = self._block(of_points.T @ of_points, 4)
        return np.stack(cameras), np.tile(points, (len(of_points), 1, 1))

    def _block(self, gram: Array, b: int) -> Array:
        values, vectors = np.linalg.eigh(gram)
        if self.norm == "factor":
            return np.asarray(np.sqrt(b) * vectors[:, 3:])
        size = max(float(np.linalg.norm(values)), np.finfo(float).tiny)
        return np.asarray(vectors * np.sqrt(np.sqrt(b) * np.maximum(values, 0.0) / size))


@dataclass(frozen=True)
class PseudoInverse:
    """Minimum-norm Gauss-Newton steps by the known null space (FREE of B03); lambda shortens them.

    A rejected step is retried with the length 1 / (1 + lambda).
    """

    kernels: Table

    def start(self, system: BundleSystem) -> float:
        """Return the first lambda: practically the full step."""
        return START

    def step(self, system: BundleSystem, lam: float) -> Step:
        """Return -N^+ g / (1 + lambda)."""
        return minimum_norm_step(system, self.kernels).shortened(system, 1.0 / (1.0 + lam))


def _identities(gradient: Array) -> Array:
    count, size = gradient.shape
    return np.broadcast_to(np.eye(size), (count, size, size))


def _diagonals(blocks: Array) -> Array:
    diagonals = np.einsum("nii->ni", blocks)
    # A point on an axis, as in the five-point gauge, has a zero for its scale.
    diagonals = np.maximum(diagonals, _LEAST * diagonals.mean(axis=1, keepdims=True))
    return np.asarray(diagonals[:, :, None] * np.eye(blocks.shape[1]))


def lifted(blocks: Array) -> Array:
    """Return blocks that a flat scene does not leave singular; else the same to rounding."""
    mean = np.einsum("nii->n", blocks) / blocks.shape[1]
    return np.asarray(blocks + (_SMALL * mean)[:, None, None] * np.eye(blocks.shape[1]))


def _positive(diagonal: Array) -> Array:
    return np.where(diagonal > 0.0, diagonal, 1.0)


#: The dampings by name, made for the kernels of a back end.
DAMPINGS: dict[str, Callable[[Table], Any]] = {
    "levenberg": lambda _: Levenberg(),
    "marquardt": lambda _: Marquardt(),
    "covariant": lambda _: Covariant(),
    "gauge_invariant": lambda _: GaugeInvariant(),
    "gauge_invariant_factor": lambda _: GaugeInvariant("factor"),
    "none": PseudoInverse,
}
