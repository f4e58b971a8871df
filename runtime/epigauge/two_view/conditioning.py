"""Coordinates to compute in: one isotropic scale for both images, so that the minimum stays.

Scaling the two images by different factors would change the noise model and hence the answer; a
common factor and separate origins do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.losses import median

__all__ = ["Conditioning", "condition", "condition_raw", "displaced"]

Array = NDArray[np.float64]

#: Root mean square of a conditioned coordinate; `benchmarks/evaluations.py` compares others.
RMS = 2.0

#: A raw match is far where it is so many times as far from the middle as half of them are. Of
#: 206 measured pairs with wrong matches, seen before this was chosen, none has one beyond 5.4.
_FAR = 20.0

#: How far the second origin is moved off the centroid, in conditioned units (a quarter of the RMS).
OFFSET = 0.5


@dataclass(frozen=True)
class Conditioning:
    """Maps pixels to conditioned coordinates: (x - origin) / scale in each image.

    Attributes
    ----------
    origin1, origin2 : ndarray, shape (2,)
        Origins in pixels.
    scale : float
        Pixels a unit, the same in both images.
    """

    origin1: Array
    origin2: Array
    scale: float

    def forward(self, x1: Array, x2: Array) -> tuple[Array, Array]:
        """Return both point sets conditioned and observation-last, shape (2, m)."""
        q1 = np.ascontiguousarray(((x1 - self.origin1) / self.scale).T)
        q2 = np.ascontiguousarray(((x2 - self.origin2) / self.scale).T)
        return q1, q2

    def backward(self, q1: Array, q2: Array) -> tuple[Array, Array]:
        """Return conditioned points as pixels, shape (m, 2)."""
        return q1.T * self.scale + self.origin1, q2.T * self.scale + self.origin2

    def maps_from_pixels(self) -> tuple[Array, Array]:
        """Return the (3, 3) homogeneous maps of both images from pixels."""
        return self._to_units(self.origin1), self._to_units(self.origin2)

    def from_pixels(self, F: Array) -> Array:
        """Return the conditioned F with unit Frobenius norm."""
        conditioned = self._pixels_from(self.origin2).T @ F @ self._pixels_from(self.origin1)
        return np.asarray(conditioned / np.linalg.norm(conditioned))

    def to_pixels(self, F: Array) -> Array:
        """Return F for pixels, with unit Frobenius norm."""
        pixels = self._to_units(self.origin2).T @ F @ self._to_units(self.origin1)
        return np.asarray(pixels / np.linalg.norm(pixels))

    def homography_from_pixels(self, H: Array) -> Array:
        """Return the conditioned homography with unit Frobenius norm."""
        to1, to2 = self.maps_from_pixels()
        conditioned = to2 @ H @ np.linalg.inv(to1)
        return np.asarray(conditioned / np.linalg.norm(conditioned))

    def homography_to_pixels(self, H: Array) -> Array:
        """Return a homography for pixels, of any scale."""
        to1, to2 = self.maps_from_pixels()
        return np.asarray(np.linalg.inv(to2) @ H @ to1)

    def entry_map(self) -> Array:
        """Return the (9, 9) matrix from vect(F) conditioned to vect(F) for pixels."""
        product = np.kron(self._to_units(self.origin2).T, self._to_units(self.origin1).T)
        return np.asarray(product, dtype=np.float64)

    def _to_units(self, origin: Array) -> Array:
        x, y = origin
        pixels = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, self.scale]])
        return np.asarray(pixels / self.scale)

    def _pixels_from(self, origin: Array) -> Array:
        x, y = origin
        return np.array([[self.scale, 0.0, x], [0.0, self.scale, y], [0.0, 0.0, 1.0]])


def condition(x1: Array, x2: Array) -> Conditioning:
    """Centre both images and scale them by one factor to coordinates of RMS 2.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Matches in pixels, not all equal.

    Returns
    -------
    Conditioning
        Origins at the centroids.
    """
    m = len(x1)
    origin1, origin2 = np.add.reduce(x1) / m, np.add.reduce(x2) / m
    squares = sum(float(np.vdot(own, own)) for own in (x1 - origin1, x2 - origin2)) / (2 * m)
    return Conditioning(origin1, origin2, math.sqrt(squares / 2.0) / RMS)


def condition_raw(x1: Array, x2: Array, least: int) -> tuple[Conditioning, NDArray[np.bool_]]:
    """Condition raw matches, of which some may be nowhere near the images.

    A coordinate of a million, with which a program marks what it has not found, would set the unit
    of length of all others, and with it what is near, sharp and wrong.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Matches in pixels, not all equal.
    least : int
        With fewer matches that are near, none is said to be far.

    Returns
    -------
    frame : Conditioning
        That of `condition`, of the matches that are near.
    is_near : ndarray of bool, shape (m,)
        Whether a match is not absurdly far from the middle of either image.
    """
    is_near = np.ones(len(x1), np.bool_)
    for x in (x1, x2):
        away = np.hypot(*(own - median(own) for own in x.T))
        is_near &= away <= _FAR * (median(away) or np.inf)
    if is_near.all() or np.count_nonzero(is_near) < least:
        return condition(x1, x2), np.ones(len(x1), np.bool_)
    return condition(x1[is_near], x2[is_near]), is_near


def displaced(conditioning: Conditioning, F: Array) -> Conditioning:
    """Move the second origin off the centroid, across the epipolar lines.

    Centring makes the two singular values of a near-affine F equal, which is where the orthonormal
    representation loses a dimension (B&S section 4.3). B&S section 3.2 advises to translate the
    origin off the image centre; a quarter of the RMS of the coordinates is enough.

    Parameters
    ----------
    conditioning : Conditioning
        Centred coordinates.
    F : ndarray, shape (3, 3)
        An estimate in these coordinates.

    Returns
    -------
    Conditioning
        The same scale and first origin, another second origin.
    """
    normal = F[:2, 2]
    length = float(np.linalg.norm(normal))
    direction = normal / length if length > 0.0 else np.array([1.0, 0.0])
    if direction[np.argmax(np.abs(direction))] < 0.0:  # the sign of F must not matter
        direction = -direction
    origin2 = conditioning.origin2 - conditioning.scale * OFFSET * direction
    return Conditioning(conditioning.origin1, origin2, conditioning.scale)
