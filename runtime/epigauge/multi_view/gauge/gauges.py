"""Gauges: rules that choose a basis and scales (B03 sections 4 and 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.similarity import Similarity
from epigauge.multi_view.gauge.transformations import Transformation, changed_basis
from epigauge.scatter import spreading_basis

__all__ = [
    "GAUGES",
    "five_points",
    "identity",
    "inner",
    "normalized",
    "reference_camera",
    "two_cameras",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class identity:
    """The gauge the reconstruction is in.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> P, Q = eg.gauge.identity().transformation(found.P, found.Q).apply(found.P, found.Q)
    >>> bool(np.allclose(P, found.P))
    True
    """

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return the transformation that moves nothing."""
        return Transformation(np.eye(4), np.ones(len(P)), np.ones(len(Q)))

    def similarity(self, cameras: Array, points: Array) -> Similarity:
        """Return the similarity that moves nothing."""
        return Similarity(1.0, np.eye(3), np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class reference_camera:
    """One camera is (I | 0) and points are (a, b, 1, c); the others have unit norm.

    What this leaves open, the plane at infinity and the scene's scale, is fixed by c being
    orthogonal to a, b and 1 over the points, and of unit mean square.

    Parameters
    ----------
    camera : int
        Number of the reference camera.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> P, Q = eg.gauge.reference_camera(2).transformation(found.P, found.Q).apply(found.P, found.Q)
    >>> bool(np.allclose(P[2], np.eye(3, 4)))
    True
    """

    camera: int = 0

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge."""
        T = _camera_basis(P[self.camera])
        there = np.asarray(np.linalg.solve(T, Q.T).T)
        plane, depth = there[:, :3] / there[:, 2:3], there[:, 3] / there[:, 2]
        across, *_ = np.linalg.lstsq(plane, depth, rcond=None)
        size = float(np.sqrt(np.mean((depth - plane @ across) ** 2)))
        # (q, c) <- (q, (c - across q) / size)
        slide = np.eye(4)
        slide[3, :3], slide[3, 3] = across, size
        return _scaled(T @ slide, P, there[:, 2], self.camera)

    def similarity(self, cameras: Array, points: Array) -> Similarity:
        """Return what moves the camera to (I | 0), the points' median distance from it to one."""
        R, centre = _pose(cameras, self.camera)
        size = float(np.median(np.linalg.norm(points - centre, axis=1)))
        return Similarity(1.0 / size, R, centre, np.zeros(3))


@dataclass(frozen=True)
class two_cameras:
    """One camera is (I | 0), another the canonic (H* | e') of B&S eq. (5); points (a, b, 1, c).

    Parameters
    ----------
    first, second : int
        Numbers of the reference cameras.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> P, Q = eg.gauge.two_cameras(0, 4).transformation(found.P, found.Q).apply(found.P, found.Q)
    >>> bool(np.allclose(P[0], np.eye(3, 4)))
    True
    """

    first: int = 0
    second: int = 1

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge."""
        T = _camera_basis(P[self.first])
        camera = P[self.second] @ T
        H, e = camera[:, :3], camera[:, 3]
        length = float(np.linalg.norm(e))
        across = -(e @ H) / length**2
        size = float(np.linalg.norm(H + np.outer(e, across), 2)) / length
        slide = np.eye(4)
        slide[3, :3], slide[3, 3] = across, size
        T = T @ slide
        third = np.linalg.solve(T, Q.T)[2]
        found = _scaled(T, P, third, self.first)
        found.camera_scales[self.second] = 1.0 / np.linalg.norm((P[self.second] @ T)[:, 3])
        return found

    def similarity(self, cameras: Array, points: Array) -> Similarity:
        """Return what moves the first camera to (I | 0), and the second to distance one."""
        (R, centre), (_, other) = (_pose(cameras, view) for view in (self.first, self.second))
        return Similarity(1.0 / float(np.linalg.norm(other - centre)), R, centre, np.zeros(3))


@dataclass(frozen=True)
class five_points:
    """Five points are the standard projective basis; all cameras and points have unit norm.

    Parameters
    ----------
    points : sequence of int, optional
        Numbers of the five; by default those found by `choose`, the best conditioned.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> P, Q = eg.gauge.five_points().transformation(found.P, found.Q).apply(found.P, found.Q)
    >>> bool(np.allclose(np.linalg.norm(Q, axis=1), 1.0))
    True
    """

    points: Sequence[int] | None = None

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge."""
        chosen = self.choose(Q) if self.points is None else list(self.points)
        basis = Q[chosen[:4]].T
        T = basis * np.linalg.solve(basis, Q[chosen[4]])
        return _unit_scales(T, P, Q)[0]

    def similarity(self, cameras: Array, points: Array) -> Similarity:
        """Return what moves three points to (0, 0, 0), (1, 0, 0) and the plane z = 0."""
        chosen = self.choose_three(points) if self.points is None else list(self.points)
        first, second, third = points[chosen[:3]]
        size = float(np.linalg.norm(second - first))
        x = (second - first) / size
        z = np.cross(x, third - first)
        z /= np.linalg.norm(z)
        return Similarity(1.0 / size, np.stack([x, np.cross(z, x), z]), first, np.zeros(3))

    @staticmethod
    def choose_three(X: Array) -> list[int]:
        """Return three points far apart and far from a line, the same in every metric frame.

        Parameters
        ----------
        X : ndarray, shape (m, 3)
            Points; the tenth of them farthest out is left alone.

        Returns
        -------
        list of int
            Their numbers.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.4, 0.3, 0.1], [0.3, 0.4, 0.1]])
        >>> sorted(eg.gauge.five_points.choose_three(X))
        [0, 1, 2]
        """
        out = np.linalg.norm(X - X.mean(axis=0), axis=1)
        usual = np.where(out <= np.quantile(out, 0.9), 1.0, 0.0)
        first = int(np.argmax(usual * out))
        along = np.linalg.norm(X - X[first], axis=1)
        second = int(np.argmax(usual * along))
        across = np.linalg.norm(np.cross(X - X[first], X[second] - X[first]), axis=1)
        return [first, second, int(np.argmax(usual * across))]

    @staticmethod
    def choose(Q: Array, candidates: int = 12) -> list[int]:
        """Return five points whose smallest 4x4 minor is the largest among some candidates.

        The candidates are spread as far as possible in the normalised basis. All that is compared
        are cosines and minors there, so that the choice is the same in every basis.

        Parameters
        ----------
        Q : ndarray, shape (m, 4)
            Points in any basis.
        candidates : int
            How many.

        Returns
        -------
        list of int
            Their numbers.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> Q = np.vstack([np.eye(4), np.ones((1, 4)), [[1.0, 1.0, 1.0, 0.9]]])
        >>> len(set(eg.gauge.five_points.choose(Q)))
        5
        """
        moved = normalized().transformation(np.zeros((0, 3, 4)), Q).apply(np.zeros((0, 3, 4)), Q)[1]
        # The loneliest point, of the smallest sum of fourth powers of cosines with all others.
        products = (moved[:, :, None] * moved[:, None, :]).reshape(-1, 16)
        loneliness = np.einsum("ja,ab,jb->j", products, products.T @ products, products)
        spread = [int(np.argmin(loneliness))]
        rest = moved.copy()
        while len(spread) < min(candidates, len(Q)):
            nearest = np.abs(rest @ moved[spread].T).max(axis=1)
            nearest[spread] = np.inf
            spread.append(int(np.argmin(nearest)))
        minors = {
            four: abs(np.linalg.det(moved[list(four)])) for four in combinations(sorted(spread), 4)
        }
        return list(
            max(
                combinations(sorted(spread), 5),
                key=lambda five: min(minors[four] for four in combinations(five, 4)),
            )
        )


@dataclass(frozen=True)
class normalized:
    """Unit-norm cameras and points with sum Q Q^T = (m / 4) I: the best conditioned basis.

    The fixed point of Tyler's scatter iteration; an orthonormal change of basis is left open.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> P, Q = eg.gauge.normalized().transformation(found.P, found.Q).apply(found.P, found.Q)
    >>> bool(np.allclose(np.linalg.norm(Q, axis=1), 1.0))
    True
    """

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge."""
        return self.moved(P, Q)[0]

    def moved(self, P: Array, Q: Array) -> tuple[Transformation, Array, Array]:
        """Return what moves cameras and points into the gauge, and both there."""
        return _unit_scales(spreading_basis(Q), P, Q)

    def similarity(self, cameras: Array, points: Array) -> Similarity:
        """Return what moves the points' mean to the origin and their mean square distance to one.

        Directions stay: a rotation is left open.
        """
        centre = points[0] + np.mean(points - points[0], axis=0)
        size = float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1))))
        return Similarity(1.0 / size, np.eye(3), centre, np.zeros(3))


@dataclass(frozen=True)
class inner:
    """Inner constraints: of all equivalent small motions the one of least squares over some parts.

    Their mean, their moment about it and their scale do not change; the trace of their covariance
    is least.

    Parameters
    ----------
    points, views : sequence of int, optional
        Points and centres of views that take part; by default all points.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.gauge.inner(points=[0, 1, 5])
    inner(points=[0, 1, 5], views=None)
    """

    points: Sequence[int] | None = None
    views: Sequence[int] | None = None


#: The gauges of this module.
GAUGES = (identity, reference_camera, two_cameras, five_points, normalized)


def _unit_scales(T: Array, P: Array, Q: Array) -> tuple[Transformation, Array, Array]:
    """Return T with the scales that make every camera and point of unit norm, and both moved."""
    moved_P, moved_Q, gamma, alpha = changed_basis(T, P, Q)
    return Transformation(T, gamma, alpha), moved_P, moved_Q


def _scaled(T: Array, P: Array, third: Array, camera: int) -> Transformation:
    """Return T with points scaled to third coordinate one, cameras to unit norm but for one."""
    scales = 1.0 / np.linalg.norm(P @ T, axis=(1, 2))
    scales[camera] = 1.0
    return Transformation(T, scales, 1.0 / third)


def _camera_basis(P: Array) -> Array:
    """Return T with P T = (I | 0): pseudo-inverse, then camera centre."""
    centre = np.linalg.svd(P)[2][3]
    return np.column_stack([np.linalg.pinv(P), centre])


def _pose(cameras: Array, view: int) -> tuple[Array, Array]:
    """Return rotation and centre of a row (R | t) of metric cameras."""
    pose = cameras[view, :12].reshape(3, 4)
    return pose[:, :3], -pose[:, :3].T @ pose[:, 3]
