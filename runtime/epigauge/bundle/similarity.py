"""Similarities of space: the gauge freedom of cameras with known or modelled intrinsics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Similarity", "normal_frame"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """X -> scale rotation (X - origin) + target.

    Origin and target are kept apart: a scene far from its origin is first moved there, without
    rounding.

    Attributes
    ----------
    scale : float
        Positive.
    rotation : ndarray, shape (3, 3)
        A rotation.
    origin, target : ndarray, shape (3,)
        The point that moves, and where it moves to.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    >>> move.positions(np.array([[1.0, 2.0, 3.0]])).tolist()
    [[2.0, 4.0, 7.0]]
    """

    scale: float
    rotation: Array
    origin: Array
    target: Array

    def inverse(self) -> Similarity:
        """Return the similarity that undoes this one.

        Returns
        -------
        Similarity
            The inverse.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        >>> move.inverse().positions(np.array([[2.0, 4.0, 7.0]])).tolist()
        [[1.0, 2.0, 3.0]]
        """
        return Similarity(1.0 / self.scale, self.rotation.T, self.target, self.origin)

    def positions(self, X: Array) -> Array:
        """Return moved positions.

        Parameters
        ----------
        X : ndarray, shape (m, 3)
            Positions.

        Returns
        -------
        ndarray, shape (m, 3)
            Where they go.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        >>> move.positions(np.array([[1.0, 2.0, 3.0]])).tolist()
        [[2.0, 4.0, 7.0]]
        """
        return np.asarray(self.scale * (X - self.origin) @ self.rotation.T + self.target)

    def lines(self, lines: Array) -> Array:
        """Return moved lines.

        Parameters
        ----------
        lines : ndarray, shape (L, 6)
            Pluecker coordinates (n, v), n = X x v for the points X of the line.

        Returns
        -------
        ndarray, shape (L, 6)
            Where they go; v turns, and keeps its length.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        >>> along_x = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
        >>> move.lines(along_x).tolist()
        [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]]
        """
        n, v = lines[:, :3], lines[:, 3:]
        turned = v @ self.rotation.T
        moment = self.scale * (n - np.cross(self.origin, v)) @ self.rotation.T
        return np.concatenate([moment + np.cross(self.target, turned), turned], axis=1)

    def information(self, blocks: Array) -> Array:
        """Return moved inverse covariances of positions.

        Parameters
        ----------
        blocks : ndarray, shape (k, 3, 3)
            Inverse covariances.

        Returns
        -------
        ndarray, shape (k, 3, 3)
            Those of the moved positions.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        >>> move.information(np.eye(3)[None])[0, 0].tolist()
        [0.25, 0.0, 0.0]
        """
        return np.asarray(self.rotation @ blocks @ self.rotation.T / self.scale**2)

    def apply(self, cameras: Array, points: Array) -> tuple[Array, Array]:
        """Return moved cameras and points.

        No image changes: R <- R rotation^T, and the centres move as the points do.

        Parameters
        ----------
        cameras : ndarray, shape (n, c)
            Rows (R | t) and intrinsics.
        points : ndarray, shape (m, 3)
            Points.

        Returns
        -------
        tuple of ndarray
            Cameras and points in the new frame.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        >>> cameras = np.eye(3, 4).reshape(1, 12)
        >>> cameras, points = move.apply(cameras, np.array([[1.0, 2.0, 3.0]]))
        >>> cameras.reshape(3, 4)[:, 3].tolist(), points.tolist()
        ([0.0, 0.0, -1.0], [[2.0, 4.0, 7.0]])
        """
        pose = cameras[:, :12].reshape(-1, 3, 4)
        R = pose[:, :, :3] @ self.rotation.T
        # t <- scale (t + R origin) - R' target.
        t = self.scale * (pose[:, :, 3] + pose[:, :, :3] @ self.origin) - R @ self.target
        moved = cameras.copy()
        moved[:, :12] = np.concatenate([R, t[:, :, None]], axis=2).reshape(-1, 12)
        return moved, self.positions(points)

    def blocks(self, n: int, m: int, d: int) -> tuple[Array, Array]:
        """Return what own tangents are multiplied by.

        Parameters
        ----------
        n, m, d : int
            Numbers of cameras, of points, and of entries of a camera's tangent.

        Returns
        -------
        tuple of ndarray, shape (n, d, d), (m, 3, 3)
            Blocks of cameras and of points.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> move = eg.gauge.Similarity(2.0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        >>> cameras, points = move.blocks(2, 5, 6)
        >>> cameras.shape, points.shape
        ((2, 6, 6), (5, 3, 3))
        """
        scales = np.ones(d)
        scales[3:6] = self.scale
        return (
            np.broadcast_to(np.diag(scales), (n, d, d)),
            np.broadcast_to(self.scale * self.rotation, (m, 3, 3)),
        )


def normal_frame(cameras: Array, points: Array) -> Similarity:
    """Return the move to where computing suits best: the cameras about the origin, of size one.

    The median distance of the points from the mean centre becomes one; directions stay.
    """
    pose = cameras[:, :12].reshape(-1, 3, 4)
    # Differences of positions are what counts: nothing is added up far from the origin.
    centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    centre = centres[0] + np.mean(centres - centres[0], axis=0)
    size = float(np.median(np.linalg.norm(points - centre, axis=1)))
    return Similarity(1.0 / size if size > 0.0 else 1.0, np.eye(3), centre, np.zeros(3))
