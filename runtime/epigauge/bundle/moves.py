"""Moves of an estimate into a gauge, for cameras of any model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.similarity import normal_frame
from epigauge.cameras import CameraModel
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import Gauge, Transformation, normalized

__all__ = ["Move", "best_conditioned", "move_into"]

Array = NDArray[np.float64]


class Move(Protocol):
    """An element of the gauge group, acting on the rows of the engine."""

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return moved cameras (n, c) and points (m, b)."""

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

    def inverse(self) -> _Projective:
        """Return the move back."""
        return _Projective(self.transformation.inverse())

    def blocks(self, n: int, m: int, d: int) -> tuple[Array, Array]:
        """Return what own tangents are multiplied by, (n, 12, 12) and (m, 4, 4)."""
        return self.transformation.blocks()


def move_into(gauge: Gauge, model: CameraModel, cameras: Array, points: Array) -> Move:
    """Return what moves an estimate into a gauge."""
    if model.homogeneous:
        return _Projective(gauge.transformation(cameras.reshape(-1, 3, 4), points))
    similarity: Any = getattr(gauge, "similarity", None)
    if not model.metric or similarity is None:
        was = f"is {gauge!r:.60} for cameras of the model {model.name!r}"
        raise ArgumentError("gauge", was, "a gauge with a method similarity(cameras, points)")
    found: Move = similarity(cameras, points)
    return found


def best_conditioned(model: CameraModel, cameras: Array, points: Array) -> Move:
    """Return the move to where computing suits best."""
    if model.homogeneous:
        return move_into(normalized(), model, cameras, points)
    return normal_frame(cameras, points)
