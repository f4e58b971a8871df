"""Moves of an estimate into a gauge, for cameras of any model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.similarity import normal_frame
from epigauge.cameras import CameraModel
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import Gauge, Transformation, identity, normalized
from epigauge.multi_view.gauge.transformations import moved_lines

__all__ = ["Move", "best_conditioned", "move_into"]

Array = NDArray[np.float64]


class Move(Protocol):
    """An element of the gauge group, acting on the rows of the engine."""

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return moved cameras (n, c) and points (m, b)."""

    def lines(self, lines: Array) -> Array:
        """Return moved lines, Pluecker coordinates (L, 6)."""

    def inverse(self) -> Move:
        """Return the move back."""

    def blocks(self, n: int, m: int, d: int) -> tuple[Array, Array]:
        """Return what own tangents are multiplied by, (n, d, d) and (m, b, b)."""


@dataclass(frozen=True)
class _Projective:
    """A `Transformation` of cameras as rows (n, 12)."""

    transformation: Transformation

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return moved cameras (n, 12) and points (m, 4)."""
        P, Q = self.transformation.apply(cameras.reshape(-1, 3, 4), points)
        return P.reshape(-1, 12), Q

    def lines(self, lines: Array) -> Array:
        """Return moved lines (L, 6)."""
        return self.transformation.lines(lines)

    def inverse(self) -> _Projective:
        """Return the move back."""
        return _Projective(self.transformation.inverse())

    def blocks(self, n: int, m: int, d: int) -> tuple[Array, Array]:
        """Return what own tangents are multiplied by, (n, 12, 12) and (m, 4, 4)."""
        return self.transformation.blocks()


@dataclass(frozen=True)
class _Affine:
    """P <- P T^-1, X <- T X, for affine cameras as rows (n, 12); the last row of T is 0 0 0 1."""

    T: Array

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return moved cameras (n, 12) and points (m, 3)."""
        P = cameras.reshape(-1, 3, 4) @ np.linalg.inv(self.T)
        P[:, 2] = np.array([0.0, 0.0, 0.0, 1.0])
        return P.reshape(-1, 12), points @ self.T[:3, :3].T + self.T[:3, 3]

    def lines(self, lines: Array) -> Array:
        """Return moved lines (L, 6)."""
        return moved_lines(self.T, lines)

    def inverse(self) -> _Affine:
        """Return the move back."""
        return _Affine(np.asarray(np.linalg.inv(self.T)))

    def blocks(self, n: int, m: int, d: int) -> tuple[Array, Array]:
        """Return what own tangents are multiplied by, (n, 8, 8) and (m, 3, 3)."""
        rows = np.kron(np.eye(2), np.linalg.inv(self.T).T)
        return np.broadcast_to(rows, (n, d, d)), np.broadcast_to(self.T[:3, :3], (m, 3, 3))


def move_into(gauge: Gauge, model: CameraModel, cameras: Array, points: Array) -> Move:
    """Return what moves an estimate into a gauge."""
    if model.homogeneous:
        return _Projective(gauge.transformation(cameras.reshape(-1, 3, 4), points))
    if not model.metric and isinstance(gauge, identity | normalized):
        return _Affine(np.eye(4)) if isinstance(gauge, identity) else _spread_evenly(points)
    similarity: Any = getattr(gauge, "similarity", None)
    if not model.metric or similarity is None:
        was = f"is {gauge!r:.60} for cameras of the model {model.name!r}"
        raise ArgumentError("gauge", was, "a gauge with a method similarity(cameras, points)")
    found: Move = similarity(cameras, points)
    return found


def best_conditioned(
    model: CameraModel, cameras: Array, points: Array
) -> tuple[Move, Array, Array]:
    """Return the move to where computing suits best, and cameras and points there."""
    if model.homogeneous:
        there, P, Q = normalized().moved(cameras.reshape(-1, 3, 4), points)
        return _Projective(there), P.reshape(-1, 12), Q
    move: Move = normal_frame(cameras, points) if model.metric else _spread_evenly(points)
    return (move, *move.apply(cameras, points))


def _spread_evenly(points: Array) -> _Affine:
    """Return the affine move to points of mean zero and unit covariance, as far as they spread."""
    centre = points[0] + np.mean(points - points[0], axis=0)
    spread, axes = np.linalg.eigh(np.cov((points - centre).T, bias=True))
    size = np.sqrt(np.maximum(spread, 1e-12 * max(float(spread[-1]), 1e-300)))
    T = np.eye(4)
    T[:3, :3] = axes.T / size[:, None]
    T[:3, 3] = -T[:3, :3] @ centre
    return _Affine(T)
