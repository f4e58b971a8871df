"""What is free at an estimate, and where the estimate goes after a step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Normal
from epigauge.bundle.solve import Border
from epigauge.bundle.ties import Ties

if TYPE_CHECKING:
    from epigauge.bundle.moves import Move

__all__ = ["Freedom"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Freedom:
    """Ties that are the same everywhere; strategies with a gauge of their own override the rest.

    Attributes
    ----------
    ties : Ties
        From the unknowns to own tangents.
    kept : ndarray of bool, shape (m,), or None
        Points that are not re-triangulated after a step: fixed ones, and those with priors, which
        their observations alone do not know of.
    """

    ties: Ties = field(default_factory=Ties)
    kept: NDArray[np.bool_] | None = None

    def ties_at(self, cameras: Array, points: Array) -> Ties:
        """Return the ties at an estimate."""
        return self.ties

    def constrained(
        self, normal: Normal, cameras: Array, points: Array
    ) -> tuple[Normal, Border | None]:
        """Return the normal equations with constraints of the gauge."""
        return normal, None

    def retracted(self, cameras: Array, moved: Array, own: Array) -> Array:
        """Return cameras after a step, given where their model takes them."""
        return moved

    def moving(self, cameras: Array, points: Array, steps: int) -> Move | None:
        """Return what moves an estimate into the gauge after so many accepted steps."""
        return None
