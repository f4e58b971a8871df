"""The density of the distances of right and wrong matches to an epipolar geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Mixture"]

Array = NDArray[np.float64]

_ROOT_TWO_PI = float(np.sqrt(2.0 * np.pi))

#: Halvings that find the distance at which right and wrong are as likely.
_HALVINGS = 50


@dataclass(frozen=True)
class Mixture:
    """Right distances are normal; wrong ones are partly normal, too, but wide, or uniform.

    The density of a distance d is

        share N(d; 0, sigma^2) + near N(d; 0, spread^2) + (1 - share - near) / extent.

    Attributes
    ----------
    sigma : float
        Standard deviation of right distances.
    share : float
        Share of right matches.
    extent : float
        Largest distance.
    near : float
        Share of the wrong matches that lie about the epipolar lines.
    spread : float
        Standard deviation of their distances.
    """

    sigma: float
    share: float
    extent: float
    near: float = 0.0
    spread: float = 1.0

    @property
    def peak(self) -> float:
        """Return the density of right distances at zero, times their share."""
        return self.share / (self.sigma * _ROOT_TWO_PI)

    @property
    def halo(self) -> float:
        """Return that of the wrong ones about the epipolar lines."""
        return self.near / (self.spread * _ROOT_TWO_PI)

    @property
    def odds(self) -> float:
        """Return the density of the wrong ones anywhere."""
        return max(1.0 - self.share - self.near, 1e-4) / self.extent

    def parts(self, squared: Array) -> tuple[Array, Array, Array]:
        """Return the density of squared distances, and its parts of right and of near ones."""
        right = self.peak * np.exp(-0.5 * squared / self.sigma**2)
        near = self.halo * np.exp(-0.5 * squared / self.spread**2)
        return right + near + self.odds, right, near

    def right(self, squared: Array) -> Array:
        """Return the probabilities that matches are right."""
        total, right, _ = self.parts(squared)
        return np.asarray(right / total)

    def logarithm(self, squared: Array) -> Array:
        """Return the logarithm of the density."""
        return np.asarray(np.log(self.parts(squared)[0]))

    @property
    def even(self) -> float:
        """Return the distance at which right and wrong are as likely; 0 where there is none."""
        high = self.sigma * float(np.sqrt(max(2.0 * np.log(self.peak / self.odds), 0.0)))
        if not self.near:
            return high
        low = 0.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self.right(np.array(middle**2)) > 0.5:
                low = middle
            else:
                high = middle
        return low
