"""What every reconstruction of tracks can do, and the projective one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array, as_double
from epigauge._results import Result
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Tracks

__all__ = ["Reconstruction", "ReconstructionBase"]

Array = NDArray[np.float64]

#: Size of a camera or a point, its largest entry: products of others overflow.
MIN_SIZE, MAX_SIZE = 1e-100, 1e100

#: How far the product of n and v of a line of length one may be from zero.
_ORTHOGONAL = 1e-8


class ReconstructionBase(Result):
    """Cameras and points of any kind."""

    __slots__ = ()

    @property
    def n_views(self) -> int:
        """Number of views."""
        raise NotImplementedError

    @property
    def n_points(self) -> int:
        """Number of points."""
        raise NotImplementedError

    def project(self, tracks: Tracks) -> Array:
        """Return the predicted pixels of all observations.

        Parameters
        ----------
        tracks : Tracks
            Which point is seen in which view.

        Returns
        -------
        ndarray, shape (N, 2)
            In the tracks' order; infinite or NaN where the camera has no image of a point.

        Raises
        ------
        ArgumentError
            If the tracks are of other numbers of views or points.
        """
        raise NotImplementedError

    def rms_px(self, tracks: Tracks) -> float:
        """Return the root mean square of the residual coordinates.

        Parameters
        ----------
        tracks : Tracks
            Observations.

        Returns
        -------
        float
            sqrt(sum of squared residual coordinates / (2 N)), in pixels, of the N observations
            whose weight is not zero.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> 0.0 < scene.true.rms_px(scene.tracks) < 2.0
        True
        """
        counts = tracks.weights > 0.0
        with np.errstate(over="ignore"):
            return float(np.sqrt(np.mean((tracks.xy - self.project(tracks))[counts] ** 2)))

    def check_fits(self, tracks: Tracks) -> None:
        """Refuse tracks of other numbers of views or points.

        Parameters
        ----------
        tracks : Tracks
            Observations.

        Raises
        ------
        ArgumentError
            If they are of others.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> scene.true.check_fits(scene.tracks)
        """
        if (tracks.n_views, tracks.n_points) != (self.n_views, self.n_points):
            was = f"are of {tracks.n_views} views and {tracks.n_points} points"
            raise ArgumentError("tracks", was, f"{self.n_views} and {self.n_points}, as here")


@dataclass(frozen=True)
class Reconstruction(ReconstructionBase):
    """Cameras and points up to a projective change of basis; scales are free too.

    Attributes
    ----------
    P : ndarray, shape (n, 3, 4)
        Cameras, to pixels.
    Q : ndarray, shape (m, 4)
        Homogeneous points.
    lines : ndarray, shape (L, 6), or None
        Lines as Pluecker coordinates (n, v), stored with length one: of the line through the points
        (a, 1) and (b, 1) v = b - a and n = a x v. Those at infinity have v = 0. None where there is
        no line.

    Examples
    --------
    >>> import numpy as np, epigauge as eg
    >>> scene = eg.Reconstruction(np.tile(np.eye(3, 4), (2, 1, 1)), np.ones((8, 4)))
    >>> scene.P.shape
    (2, 3, 4)
    """

    P: Array
    Q: Array
    lines: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "P", _homogeneous("P", self.P, (3, 4)))
        object.__setattr__(self, "Q", _homogeneous("Q", self.Q, (4,)))
        if self.lines is not None:
            lines = _lines_of_length_one(_homogeneous("lines", self.lines, (6,)))
            object.__setattr__(self, "lines", lines if len(lines) else None)

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.P)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self.Q)

    def _heading(self) -> str:
        lines = "" if self.lines is None else f", {len(self.lines)} lines"
        return f"Reconstruction: {len(self.P)} views, {len(self.Q)} points{lines}"

    def _summary_rows(self) -> dict[str, str]:
        return {"cameras": "projective, known up to a change of basis"}

    def project(self, tracks: Tracks) -> Array:
        """Return the predicted pixels of all observations.

        Parameters
        ----------
        tracks : Tracks
            Which point is seen in which view.

        Returns
        -------
        ndarray, shape (N, 2)
            In the tracks' order; infinite or NaN for points in a camera's focal plane.

        Raises
        ------
        ArgumentError
            If the tracks are of other numbers of views or points.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> scene.true.project(scene.tracks).shape
        (80, 2)
        """
        self.check_fits(tracks)
        P, Q = self.P.take(tracks.view, axis=0), self.Q.take(tracks.point, axis=0)
        h = np.einsum("nij,nj->ni", P, Q)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.asarray(h[:, :2] / h[:, 2:])


def _lines_of_length_one(rows: Array) -> Array:
    """Return Pluecker coordinates of length one, n and v being orthogonal."""
    unit = rows / np.abs(rows).max(axis=1, keepdims=True)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    # Those of length one stay as they are, to the last bit.
    rows = np.where(np.abs(np.sum(rows**2, axis=1, keepdims=True) - 1.0) > 1e-12, unit, rows)
    bad = np.flatnonzero(np.abs(np.sum(rows[:, :3] * rows[:, 3:], axis=1)) > _ORTHOGONAL)
    if len(bad):
        was = f"is no line in row {bad[0]}: n and v are not orthogonal"
        raise ArgumentError("lines", was, "n = a x v and v = b - a of points a and b")
    return np.asarray(rows)


def _homogeneous(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return homogeneous matrices or vectors, of any scale but zero."""
    array = as_array(name, value, "a regular array")
    if array.dtype.kind not in "iuf" or array.shape[1:] != shape or array.ndim == 0:
        needed = ", ".join(map(str, shape))
        raise ArgumentError(name, f"is {array.dtype} {array.shape}", f"real numbers, (n, {needed})")
    array = np.ascontiguousarray(as_double(array))
    size = np.abs(array.reshape(len(array), math.prod(shape))).max(axis=1)
    good = (size >= MIN_SIZE) & (size <= MAX_SIZE)
    if not good.all():
        row = int(np.argmin(good))
        what = f"of size {size[row]:g}" if np.isfinite(size[row]) else "not finite"
        needed = f"a largest entry between {MIN_SIZE:g} and {MAX_SIZE:g}"
        raise ArgumentError(name, f"is {what} in row {row}", needed)
    return array
