"""Dampings of the many-view problem: what is added to J^T J, or how a step is made without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import point_damping
from epigauge.bundle.solve import Blocks, Step, System

__all__ = ["DAMPINGS", "ByMatrix", "Covariant", "Levenberg", "Marquardt"]

Array = NDArray[np.float64]

#: First lambda, relative to the size of the system where the damping does not scale with it.
START = 1e-3

#: The same for the covariant damping of metric cameras, which holds points by their mean entry.
START_METRIC = 1e-4

#: Least diagonal entry of lambda diag(N), of the mean of its block.
_LEAST = 1e-6

#: The same for the own unknowns of metric cameras, of the largest entry of the same kind.
_SMALL = 1e-12


class ByMatrix:
    """A damping that adds lambda W; W is block diagonal."""

    def start(self, system: System) -> float:
        """Return the first lambda."""
        return START

    def blocks(self, system: System) -> Blocks:
        """Return the blocks of W in the unknowns."""
        raise NotImplementedError

    def step(self, system: System, lam: float) -> Step:
        """Return -(N + lambda W)^-1 g."""
        return system.damped_step(self.blocks(system), lam)


class Levenberg(ByMatrix):
    """W = I: invariant under orthonormal changes of basis only."""

    def start(self, system: System) -> float:
        """Return a fraction of the largest diagonal entry."""
        return START * system.largest()

    def blocks(self, system: System) -> Blocks:
        """Return identities."""
        x, s, y = system.gradients
        return Blocks(_identities(x), np.ones(len(s)), _identities(y))


class Marquardt(ByMatrix):
    """W = diag(N): invariant under the scales of cameras and points only."""

    def blocks(self, system: System) -> Blocks:
        """Return the diagonals."""
        shared = np.diagonal(system.U_shared)
        return Blocks(_diagonals(system.U), _positive(shared), _diagonals(system.V))


class Covariant(ByMatrix):
    """The damping that the gauge of the camera model leaves as it is.

    Homogeneous: W = blockdiag(N) + blockdiag(Z^T Z), Z = d log depth, which satisfies B03 eq. (8)
    for every T~. Metric: diag(N) of each camera, whose update is in its own frame, and the trace of
    each point's block. Affine: blockdiag(N).
    """

    def start(self, system: System) -> float:
        """Return the first lambda."""
        return START_METRIC if system.model.metric else START

    def blocks(self, system: System) -> Blocks:
        """Return the blocks of W."""
        if system.model.homogeneous:
            cameras, points = system.depth_blocks
            return Blocks(
                system.U + cameras, np.ones(0), point_damping(system.model, system.V, points)
            )
        points = point_damping(system.model, system.V, None)
        if not system.model.metric:
            return Blocks(system.U, np.ones(0), points)
        diagonal = np.einsum("nii->ni", system.U)
        # An unknown that moves no image, as the distortion of points on the axis: of the others'.
        diagonal = np.maximum(diagonal, _SMALL * diagonal.max(axis=0))
        cameras = np.where(diagonal > 0.0, diagonal, 1.0)[:, :, None] * np.eye(diagonal.shape[1])
        return Blocks(cameras, _positive(np.diagonal(system.U_shared)), points)


def _identities(gradient: Array) -> Array:
    count, size = gradient.shape
    return np.broadcast_to(np.eye(size), (count, size, size))


def _diagonals(blocks: Array) -> Array:
    diagonals = np.einsum("nii->ni", blocks)
    # A point on an axis, as in the five-point gauge, has a zero for its scale.
    diagonals = np.maximum(diagonals, _LEAST * diagonals.mean(axis=1, keepdims=True))
    return np.asarray(diagonals[:, :, None] * np.eye(blocks.shape[1]))


def _positive(diagonal: Array) -> Array:
    return np.where(diagonal > 0.0, diagonal, 1.0)


#: The dampings by name.
DAMPINGS: dict[str, Callable[[], Any]] = {
    "levenberg": Levenberg,
    "marquardt": Marquardt,
    "covariant": Covariant,
}
