"""Calibrated scenes: rotations, translations, points, and the cameras that saw them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras.checks import counted, finite_rows, frozen
from epigauge.cameras.intrinsics import Cameras
from epigauge.cameras.models import camera_model
from epigauge.errors import ArgumentError
from epigauge.multi_view.reconstruction import Reconstruction, ReconstructionBase
from epigauge.multi_view.tracks import Tracks

__all__ = ["MetricReconstruction"]

Array = NDArray[np.float64]

#: How far R^T R may be from the identity.
ORTHONORMAL = 1e-8

#: Observations projected at a time: what they take stays in the cache.
_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class MetricReconstruction(ReconstructionBase):
    """Calibrated cameras and points: shape without unit of length, place and direction in space.

    Parameters
    ----------
    R : array_like, shape (n, 3, 3)
        Rotations, ``x_cam = R X + t``.
    t : array_like, shape (n, 3)
        Translations.
    X : array_like, shape (m, 3)
        Points.
    cameras : Cameras
        Their model and parameters.
    lines : array_like, shape (L, 6), optional
        Lines as Pluecker coordinates (n, v), v the direction and n = X x v for every point X of the
        line; they are stored with a unit vector v, and as None where there is no line.

    Raises
    ------
    ArgumentError
        On other shapes, numbers that are not finite, lines at infinity, matrices R that are no
        rotations (the message says how to repair them), and cameras that have no rotation.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> cameras = eg.Cameras("SIMPLE_PINHOLE", [[800.0, 320.0, 240.0]], [0])
    >>> scene = eg.MetricReconstruction(np.eye(3)[None], [[1, 0, 2]], [[0, 0, 4.0]], cameras)
    >>> (scene.centres + 0.0).tolist(), scene.P.shape
    ([[-1.0, 0.0, -2.0]], (1, 3, 4))
    """

    R: Array
    t: Array
    X: Array
    cameras: Cameras
    lines: Array | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Cameras):
            was = f"is a {type(self.cameras).__name__}"
            raise ArgumentError("cameras", was, "eg.Cameras(model, params, camera_of_view)")
        if not camera_model(self.cameras.model).metric:
            was = f"are of the model {self.cameras.model!r}, which has no rotation"
            raise ArgumentError("cameras", was, "a calibrated model, or eg.Reconstruction(P, Q)")
        R = finite_rows("R", self.R, (3, 3), "one rotation a view")
        t = finite_rows("t", self.t, (3,), "one translation a view")
        X = finite_rows("X", self.X, (3,), "one point a row")
        n = len(self.cameras.camera_of_view)
        for name, array in (("R", R), ("t", t)):
            if len(array) != n:
                raise ArgumentError(name, f"has {len(array)} rows", f"{n}, a row a view")
        if not len(X):
            raise ArgumentError("X", "has no row", "at least one point")
        _check_rotations(R)
        for name, array in (("R", R), ("t", t), ("X", X)):
            object.__setattr__(self, name, frozen(array))
        if self.lines is not None:
            lines = _checked_lines(self.lines)
            object.__setattr__(self, "lines", frozen(lines) if len(lines) else None)

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.R)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self.X)

    @property
    def vectors(self) -> Array:
        """What the kernels of the model take for each view, (n, 12 + k): (R | t), parameters."""
        pose = np.concatenate([self.R, self.t[:, :, None]], axis=2).reshape(-1, 12)
        return np.asarray(np.concatenate([pose, self.cameras.of_views], axis=1))

    @property
    def centres(self) -> Array:
        """Centres of projection -R^T t, (n, 3)."""
        return np.asarray(-np.einsum("nji,nj->ni", self.R, self.t))

    @property
    def P(self) -> Array:
        """Cameras to pixels without distortion, (n, 3, 4).

        K (R | t), where K is the camera near its optical axis: (K h)[:2] / (K h)[2] is the image of
        h to first order in h[0] and h[1].
        """
        K = self._calibrations()
        return np.asarray(K @ np.concatenate([self.R, self.t[:, :, None]], axis=2))

    def project(self, tracks: Tracks, backend: str | None = None) -> Array:
        """Return the predicted pixels of all observations.

        Parameters
        ----------
        tracks : Tracks
            Which point is seen in which view.
        backend : {"c", "numpy", "casadi"}, optional
            Whose kernels to use; by default the active one's.

        Returns
        -------
        ndarray, shape (N, 2)
            In the tracks' order; infinite or NaN where the model has no image of a point.

        Raises
        ------
        ArgumentError
            If the tracks are of other numbers of views or points.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> true = scene.true
        >>> true.project(scene.tracks).shape
        (240, 2)
        """
        return np.ascontiguousarray(self._images(tracks, backend)[0].T)

    def depths(self, tracks: Tracks, backend: str | None = None) -> Array:
        """Return how far in front of its camera each observed point lies.

        Parameters
        ----------
        tracks : Tracks
            Which point is seen in which view.
        backend : {"c", "numpy", "casadi"}, optional
            Whose kernels to use; by default the active one's.

        Returns
        -------
        ndarray, shape (N,)
            Along the optical axis (the distance where a camera sees all around), in the unit of the
            scene; zero or less for a point that is not in front.

        Raises
        ------
        ArgumentError
            If the tracks are of other numbers of views or points.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> true = scene.true
        >>> bool((true.depths(scene.tracks) > 0.0).all())
        True
        """
        return np.asarray(self._images(tracks, backend)[1])

    def seen(self, tracks: Tracks) -> tuple[Array, Array]:
        """Return what `project` and `depths` return, computed once.

        Parameters
        ----------
        tracks : Tracks
            Which point is seen in which view.

        Returns
        -------
        pixels, depths : ndarray, shape (N, 2), (N,)
            As there.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> true = scene.true
        >>> pixels, depths = true.seen(scene.tracks)
        >>> pixels.shape, depths.shape
        ((240, 2), (240,))
        """
        pixels, depths = self._images(tracks, None)
        return np.ascontiguousarray(pixels.T), depths

    def to_projective(self) -> Reconstruction:
        """Return the scene as projective cameras and points.

        Distortion has no place there.

        Returns
        -------
        Reconstruction
            ``P`` of this scene, and the points with a fourth coordinate one. It projects to the
            same pixels where the model has no distortion.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> true = scene.true
        >>> true.to_projective().P.shape
        (4, 3, 4)
        """
        Q = np.column_stack([self.X, np.ones(len(self.X))])
        return Reconstruction(self.P, Q, self.lines)

    def _images(self, tracks: Tracks, backend: str | None) -> tuple[Array, Array]:
        """Return pixels (2, N) and depths (N,)."""
        self.check_fits(tracks)
        model = camera_model(self.cameras.model)
        cameras, points = (np.ascontiguousarray(rows.T) for rows in (self.vectors, self.X))
        pixels, depths = np.empty((2, len(tracks))), np.empty(len(tracks))
        for begin in range(0, len(tracks), _BLOCK):
            part = slice(begin, begin + _BLOCK)
            view, point = tracks.view[part], tracks.point[part]
            at = np.take(cameras, view, axis=1), np.take(points, point, axis=1)
            pixels[:, part], depths[part] = model.seen(*at, backend)
        return pixels, depths

    def _calibrations(self) -> Array:
        """Return K of each view, from image and derivative on the optical axis."""
        axis = np.broadcast_to(np.array([0.0, 0.0, 1.0])[:, None], (3, len(self.cameras)))
        image = camera_model(self.cameras.model).kernel("image")
        with np.errstate(all="ignore"):
            centre, slope = image(axis, self.cameras.params.T)
        K = np.zeros((len(self.cameras), 3, 3))
        K[:, :2, :2] = np.moveaxis(slope[:, :2], 2, 0)
        K[:, :2, 2] = centre.T
        K[:, 2, 2] = 1.0
        if not np.isfinite(K).all():
            was = f"are of the model {self.cameras.model!r}"
            raise ArgumentError("cameras", was, "a model with an optical axis")
        return np.asarray(K[self.cameras.camera_of_view])

    def _heading(self) -> str:
        return repr(self)

    def _summary_rows(self) -> dict[str, str]:
        size = np.ptp(self.X, axis=0)
        return {
            "model": self.cameras.model,
            "extent of the points": " x ".join(f"{side:.4g}" for side in size),
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments: arrays from a pickle could be written to."""
        return type(self), (self.R, self.t, self.X, self.cameras, self.lines)

    def __repr__(self) -> str:
        views, points = counted(self.n_views, "view"), counted(self.n_points, "point")
        lines = "" if self.lines is None else f"{counted(len(self.lines), 'line')}, "
        return f"MetricReconstruction({views}, {points}, {lines}{self.cameras!r})"


def _checked_lines(lines: Any) -> Array:
    """Return lines with unit directions."""
    rows = finite_rows("lines", lines, (6,), "Pluecker coordinates (n, v) of one line a row")
    n, v = rows[:, :3], rows[:, 3:]
    length = np.linalg.norm(v, axis=1)
    bad = np.flatnonzero(length <= 1e-12 * np.linalg.norm(n, axis=1))
    if len(bad):
        raise ArgumentError("lines", f"is at infinity in row {bad[0]}", "finite lines, v not zero")
    sizes = np.maximum(length * np.linalg.norm(n, axis=1), 1e-300)
    bad = np.flatnonzero(np.abs(np.sum(n * v, axis=1)) > ORTHONORMAL * sizes)
    if len(bad):
        was = f"is no line in row {bad[0]}: n and v are not orthogonal"
        raise ArgumentError("lines", was, "n = X x v of a point X and a direction v")
    scaled = np.abs(length - 1.0) > 1e-12
    return np.where(scaled[:, None], rows / length[:, None], rows)


def _check_rotations(R: Array) -> None:
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~(error <= ORTHONORMAL))
    if len(bad):
        was = f"has R^T R away from the identity by {error[bad[0]]:.1g} in row {bad[0]}"
        needed = "rotations; the nearest one of a matrix is U @ Vt of U, s, Vt = np.linalg.svd(R)"
        raise ArgumentError("R", was, needed)
    mirrored = np.flatnonzero(np.linalg.det(R) < 0.0)
    if len(mirrored):
        was = f"has a reflection (determinant -1) in row {mirrored[0]}"
        raise ArgumentError("R", was, "rotations: change the sign of R and t where all are so")
