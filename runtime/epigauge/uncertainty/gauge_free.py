"""What follows from a calibrated scene whatever the datum: lengths, angles, poses, images."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_real
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError

__all__ = ["GaugeFree"]

Array = NDArray[np.float64]

#: Numbers of a camera's own tangent before its intrinsics: turn and move.
_POSE = 6


class GaugeFree:
    """Propagation of the covariances of parts to what is computed from them."""

    reconstruction: MetricReconstruction

    @abstractmethod
    def joint(self, parts: Sequence[tuple[str, int]]) -> Array:
        """Return the covariance of several parts together."""

    @abstractmethod
    def _part(self, name: str, value: Any) -> Any:
        """Check a part."""

    def distance(self, i: int, j: int) -> tuple[float, float]:
        """Return the distance of two points and its standard deviation.

        Parameters
        ----------
        i, j : int
            Points.

        Returns
        -------
        tuple of float
            In the unit of the scene. The deviation is the same in every datum where priors hold
            the scale; else it is that in the datum, and only ratios are free of it.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> length, deviation = spread.distance(0, 1)
        >>> 0.0 < deviation < length
        True
        """
        length, slope = self._length(i, j)
        return length, self._sigma([("point", i), ("point", j)], slope)

    def ratio(self, first: tuple[int, int], second: tuple[int, int]) -> tuple[float, float]:
        """Return the ratio of two distances of points and its standard deviation, in any datum.

        Parameters
        ----------
        first, second : tuple of int
            Ends of the distances.

        Returns
        -------
        tuple of float
            First over second.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> ratio, deviation = spread.ratio((0, 1), (2, 3))
        >>> 0.0 < deviation < ratio
        True
        """
        (a, over_a), (b, over_b) = self._length(*first), self._length(*second)
        slope = np.concatenate([over_a / b, -a / b**2 * over_b])
        return a / b, self._sigma([("point", k) for k in (*first, *second)], slope)

    def angle(self, i: int, vertex: int, j: int) -> tuple[float, float]:
        """Return the angle between two points at a third one and its deviation, in any datum.

        Parameters
        ----------
        i, vertex, j : int
            Points.

        Returns
        -------
        tuple of float
            In radians.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> angle, deviation = spread.angle(0, 1, 2)
        >>> 0.0 < deviation < angle
        True
        """
        X = self.reconstruction.X
        sides = X[i] - X[vertex], X[j] - X[vertex]
        units = [side / np.linalg.norm(side) for side in sides]
        cosine = float(units[0] @ units[1])
        angle = float(np.arctan2(np.linalg.norm(np.cross(*units)), cosine))
        # The end of a side moves the angle by its part across the side, away from the other one.
        slopes = []
        for side, unit, other in zip(sides, units, units[::-1], strict=True):
            across = cosine * unit - other
            slopes.append(across / max(np.linalg.norm(across), 1e-300) / np.linalg.norm(side))
        slope = np.concatenate([slopes[0], -slopes[0] - slopes[1], slopes[1]])
        return angle, self._sigma([("point", k) for k in (i, vertex, j)], slope)

    def relative_pose(self, i: int, j: int) -> tuple[Array, Array, Array]:
        """Return view j as seen from view i, and its covariance.

        Parameters
        ----------
        i, j : int
            Views.

        Returns
        -------
        R, c : ndarray, shape (3, 3), (3,)
            R_j R_i^T, and the centre of j in the frame of i.
        covariance : ndarray, shape (6, 6)
            Of the small rotation of j about the axes of view i, and of c: the same in every datum,
            but for the scale where nothing holds it.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.relative_pose(0, 1)[2].shape
        (6, 6)
        """
        both = self.joint([("camera", i), ("camera", j)])
        scene = self.reconstruction
        R = scene.R[i]
        apart = scene.centres[j] - scene.centres[i]
        slope = np.zeros((6, 12))
        slope[:3, :3], slope[:3, 6:9] = -R, R
        # c = R_i (C_j - C_i); the view i turns by w: c changes by -R_i (w x apart).
        slope[3:, :3] = R @ np.cross(apart, np.eye(3)).T
        slope[3:, 3:6], slope[3:, 9:] = -R, R
        return scene.R[j] @ R.T, R @ apart, np.asarray(slope @ both @ slope.T)

    def of_projections(self, view: ArrayLike, point: ArrayLike) -> Array:
        """Return the covariance of points projected to views where they need not be observed.

        Parameters
        ----------
        view, point : array_like of int, shape (k,)
            Which.

        Returns
        -------
        ndarray, shape (k, 2, 2)
            In px^2, the same in every datum.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.of_projections([0, 1], [3, 3]).shape
        (2, 2, 2)
        """
        views, points = np.asarray(view), np.asarray(point)
        for name, indices in (("view", views), ("point", points)):
            if indices.ndim != 1 or indices.dtype.kind not in "iu" or len(views) != len(points):
                raise ArgumentError(name, f"is {indices.dtype} {indices.shape}", "integers, (k,)")
        found = np.empty((len(views), 2, 2))
        scene = self.reconstruction
        for k, (i, j) in enumerate(zip(views.tolist(), points.tolist(), strict=True)):
            self._part("view", ("camera", i))
            self._part("point", ("point", j))
            camera = int(scene.cameras.camera_of_view[i])
            slopes = self._projected(scene.R[i], scene.centres[i], camera, j)[1]
            both = self.joint([("camera", i), ("intrinsics", camera), ("point", j)])
            found[k] = slopes @ both @ slopes.T
        return found

    def projection(
        self,
        point: int,
        R: ArrayLike,
        centre: ArrayLike,
        camera: int = 0,
        *,
        relative_to: int | None = None,
        covariance: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return a point as a new view sees it, which is no part of the network.

        Parameters
        ----------
        point : int
            Which.
        R, centre : array_like, shape (3, 3), (3,)
            Pose of the new view, ``x_cam = R (X - centre)``: in the frame of the scene or, with
            `relative_to`, in that of a view, as `relative_pose` returns it.
        camera : int
            Row of `Cameras.params` whose intrinsics it has, as uncertain as they are.
        relative_to : int, optional
            View that it is mounted to. The result is then the same in every datum (but for the
            scale of `centre` where nothing holds it); a pose in the frame of the scene belongs to
            the datum.
        covariance : array_like, shape (6, 6), optional
            Of the pose: a small rotation and the centre, in the same frame, independent of the
            network. By default the pose is known exactly.

        Returns
        -------
        xy : ndarray, shape (2,)
            In pixels.
        covariance : ndarray, shape (2, 2)
            In px^2; what an observation has beside it is its own noise.

        Raises
        ------
        ArgumentError
            On parts that do not exist, no rotation, or a point that the view has no image of.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> random = np.random.default_rng(0)
        >>> R, X = np.array([np.eye(3)] * 3), random.uniform(-1.0, 1.0, (20, 3))
        >>> t = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 4.0]])
        >>> cameras = eg.Cameras("SIMPLE_PINHOLE", [[800.0, 320.0, 240.0]], [0, 0, 0])
        >>> scene = eg.MetricReconstruction(R, t, X, cameras)
        >>> tracks = eg.Tracks(*np.divmod(np.arange(60), 20), np.zeros((60, 2)))
        >>> tracks = eg.Tracks(tracks.view, tracks.point, scene.project(tracks))
        >>> cov = eg.covariance(tracks, scene, noise_px=1.0, refine="pose")
        >>> xy, spread = cov.projection(5, np.eye(3), [0.5, 0.5, 0.0], relative_to=0)
        >>> spread.shape
        (2, 2)
        """
        scene = self.reconstruction
        turn, place = _finite("R", R, (3, 3)), _finite("centre", centre, (3,))
        if not np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6 or np.linalg.det(turn) < 0.0:
            raise ArgumentError("R", "is no rotation", "a rotation matrix")
        spread = np.zeros((6, 6))
        if covariance is not None:
            spread = _finite("covariance", covariance, (6, 6))
            if not np.allclose(spread, spread.T) or np.linalg.eigvalsh(spread)[
                0
            ] < -1e-9 * np.trace(spread):
                raise ArgumentError("covariance", "is no covariance", "symmetric, not negative")
        self._part("point", ("point", point))
        self._part("camera", ("intrinsics", camera))
        parts = [("intrinsics", camera), ("point", point)]
        axes, carried = np.eye(6), np.zeros((6, 0))
        if relative_to is not None:
            self._part("relative_to", ("camera", relative_to))
            there = scene.R[relative_to]
            arm = there.T @ place
            turn, place = turn @ there, scene.centres[relative_to] + arm
            axes = np.kron(np.eye(2), there.T)
            # The mount turns by w: the new centre moves by w x arm.
            carried = np.eye(6)
            carried[3:, :3] = np.cross(np.eye(3), arm).T
            parts = [("camera", relative_to), *parts]
        xy, slopes = self._projected(turn, place, camera, point)
        own = slopes[:, :_POSE]
        of_parts, of_pose = np.hstack([own @ carried, slopes[:, _POSE:]]), own @ axes
        found = of_parts @ self.joint(parts) @ of_parts.T + of_pose @ spread @ of_pose.T
        return xy, np.asarray(found)

    def _projected(self, R: Array, centre: Array, camera: int, point: int) -> tuple[Array, Array]:
        """Return an image, and its derivatives (2, 6 + k + 3).

        By the small rotation about the axes of the scene and the centre, intrinsics and point.
        """
        scene = self.reconstruction
        known = camera_model(scene.cameras.model)
        pose = np.column_stack([R, -R @ centre])
        vector = np.concatenate([pose.ravel(), scene.cameras.params[camera]])
        pixels, _ = known.seen(vector[:, None], scene.X[point][:, None])
        xy = pixels[:, 0]
        if not np.isfinite(xy).all():
            raise ArgumentError("point", f"is {point}, of which the view has no image", "another")
        with np.errstate(all="ignore"):
            _, J, J_point = known.kernel("observe")(vector, scene.X[point], xy)
        if known.corrects:  # J is that of the corrected point
            slope = known.kernel("correct")(xy, scene.cameras.params[camera])[1]
            J, J_point = np.linalg.solve(slope, J), np.linalg.solve(slope, J_point)
        # x_cam = exp(w) (R X + t - move): the view turns by -R^T w, its centre moves by R^T move.
        return xy, np.hstack([-J[:, :3] @ R, J[:, 3:_POSE] @ R, J[:, _POSE:], J_point])

    def _length(self, i: int, j: int) -> tuple[float, Array]:
        """Return the distance of two points, and its derivatives (6,)."""
        for name, index in (("i", i), ("j", j)):
            self._part(name, ("point", index))
        apart = self.reconstruction.X[i] - self.reconstruction.X[j]
        length = float(np.linalg.norm(apart))
        if not length > 0.0:
            raise ArgumentError("i, j", f"are at one place ({i}, {j})", "points apart")
        return length, np.concatenate([apart, -apart]) / length

    def _sigma(self, parts: Sequence[tuple[str, int]], slope: Array) -> float:
        variance = float(slope @ self.joint(parts) @ slope)
        return float(max(variance, 0.0) ** 0.5)


def _finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Check an array of a shape."""
    array = as_real(name, value, f"an array of shape {shape}")
    if array.shape != shape or not np.isfinite(array).all():
        was = "is not finite" if array.shape == shape else f"has shape {array.shape}"
        raise ArgumentError(name, was, f"finite numbers of shape {shape}")
    return array
