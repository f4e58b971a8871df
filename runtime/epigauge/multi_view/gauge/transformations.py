"""Changes of basis and scales that move a reconstruction and change no image (B03 eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_real
from epigauge._library import address
from epigauge._native import function
from epigauge.bundle.similarity import Similarity
from epigauge.cameras import AffineReconstruction, MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.rotations import as_rotation

__all__ = ["Gauge", "Transformation", "changed_basis", "moved_lines", "similarity", "transform"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Transformation:
    """P_i <- camera_scales_i P_i T and Q_j <- point_scales_j T^-1 Q_j (B03 section 4.1).

    Attributes
    ----------
    T : ndarray, shape (4, 4)
        Invertible.
    camera_scales, point_scales : ndarray, shape (n,), (m,)
        gamma and alpha, none zero.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> change = eg.gauge.normalized().transformation(found.P, found.Q)
    >>> P, Q = change.apply(found.P, found.Q)
    >>> bool(np.allclose(Q.T @ Q, len(Q) / 4 * np.eye(4)))
    True
    """

    T: Array
    camera_scales: Array
    point_scales: Array

    def apply(self, P: Array, Q: Array) -> tuple[Array, Array]:
        """Move cameras and points.

        Parameters
        ----------
        P : ndarray, shape (n, 3, 4)
            Cameras.
        Q : ndarray, shape (m, 4)
            Points.

        Returns
        -------
        P, Q : ndarray, shape (n, 3, 4), (m, 4)
            The same geometry.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> found = eg.bundle_adjust(eg.load_tracks(eg.samples.path("tracks.csv"))).reconstruction
        >>> change = eg.gauge.two_cameras().transformation(found.P, found.Q)
        >>> P, Q = change.apply(found.P, found.Q)
        >>> bool(np.allclose(P[0] / P[0, 0, 0], np.eye(3, 4), atol=1e-9))
        True
        """
        return changed_basis(self.T, P, Q, (self.camera_scales, self.point_scales))[:2]

    def lines(self, lines: Array) -> Array:
        """Move lines.

        Parameters
        ----------
        lines : ndarray, shape (L, 6)
            Pluecker coordinates (n, v).

        Returns
        -------
        ndarray, shape (L, 6)
            Of length one.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> change = eg.gauge.Transformation(np.diag([2.0, 1.0, 1.0, 1.0]), np.ones(1), np.ones(1))
        >>> along_x = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
        >>> abs(change.lines(along_x)).tolist()
        [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]
        """
        return moved_lines(np.asarray(np.linalg.inv(self.T)), lines)

    def inverse(self) -> Transformation:
        """Return the transformation back.

        Returns
        -------
        Transformation
            What undoes this one.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> found = eg.bundle_adjust(eg.load_tracks(eg.samples.path("tracks.csv"))).reconstruction
        >>> change = eg.gauge.two_cameras().transformation(found.P, found.Q)
        >>> there = change.apply(found.P, found.Q)
        >>> P, Q = change.inverse().apply(*there)
        >>> bool(np.allclose(P, found.P) and np.allclose(Q, found.Q))
        True
        """
        return Transformation(
            np.asarray(np.linalg.inv(self.T)), 1.0 / self.camera_scales, 1.0 / self.point_scales
        )

    def blocks(self) -> tuple[Array, Array]:
        """Return the blocks of T~ on its diagonal (B03 eq. 5).

        Returns
        -------
        cameras, points : ndarray, shape (n, 12, 12), (m, 4, 4)
            They act on vect(P_i) and on Q_j.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> found = eg.bundle_adjust(eg.load_tracks(eg.samples.path("tracks.csv"))).reconstruction
        >>> change = eg.gauge.two_cameras().transformation(found.P, found.Q)
        >>> cameras, points = change.blocks()
        >>> cameras.shape[1:], points.shape[1:]
        ((12, 12), (4, 4))
        """
        table, inverse = kernels.table("numpy"), np.linalg.inv(self.T)
        cameras = table.camera_transformation(self.T[..., None], self.camera_scales)
        points = table.point_transformation(inverse[..., None], self.point_scales)
        return np.moveaxis(cameras, -1, 0), np.moveaxis(points, -1, 0)


class Gauge(Protocol):
    """A rule that chooses basis and scales.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> rule: eg.gauge.Gauge = eg.gauge.two_cameras()
    >>> rule.transformation(found.P, found.Q).T.shape
    (4, 4)
    """

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge.

        Parameters
        ----------
        P : ndarray, shape (n, 3, 4)
            Cameras.
        Q : ndarray, shape (m, 4)
            Points.

        Returns
        -------
        Transformation
            For this reconstruction.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> found = eg.bundle_adjust(eg.load_tracks(eg.samples.path("tracks.csv"))).reconstruction
        >>> change = eg.gauge.two_cameras().transformation(found.P, found.Q)
        >>> change.T.shape
        (4, 4)
        """


def changed_basis(
    T: Array, P: Array, Q: Array, scales: tuple[Array, Array] | None = None
) -> tuple[Array, Array, Array, Array]:
    """Return gamma_i P_i T, alpha_j T^-1 Q_j, gamma and alpha; by default those of unit norms."""
    n, m = len(P), len(Q)
    if scales is not None and (len(scales[0]), len(scales[1])) != (n, m):
        scales = np.broadcast_to(scales[0], n), np.broadcast_to(scales[1], m)
    if kernels.backend() == "c":
        gamma, alpha = (np.empty(n), np.empty(m)) if scales is None else scales
        moved_P, moved_Q = np.empty((n, 3, 4)), np.empty((m, 4))
        given = [np.ascontiguousarray(a, np.float64) for a in (T, gamma, alpha, P, Q)]
        first, *rest = map(address, (*given, moved_P, moved_Q))
        if function("change_basis")(n, m, first, scales is None, *rest):
            raise np.linalg.LinAlgError("the change of basis is singular")
        return moved_P, moved_Q, gamma, alpha
    cameras, points = P @ T, np.linalg.solve(T, Q.T)
    if scales is None:
        gamma = 1.0 / np.sqrt(np.einsum("nij,nij->n", cameras, cameras))
        alpha = 1.0 / np.sqrt(np.einsum("im,im->m", points, points))
    else:
        gamma, alpha = scales
    moved = np.ascontiguousarray((alpha * points).T)
    return gamma[:, None, None] * cameras, moved, gamma, alpha


def moved_lines(T: Array, lines: Array) -> Array:
    """Return lines (L, 6) where points are moved to T X, their coordinates of length one."""
    moved = kernels.table("numpy").line_transform(T[..., None], lines.T).T
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def similarity(s: float, R: ArrayLike, t: ArrayLike) -> Similarity:
    """Return the similarity X -> s R X + t.

    Parameters
    ----------
    s : float
        Scale, positive.
    R : array_like, shape (3, 3)
        Rotation.
    t : array_like, shape (3,)
        Translation.

    Returns
    -------
    Similarity
        For `transform`.

    Raises
    ------
    ArgumentError
        If the scale is not positive, R no rotation or t not finite.

    Examples
    --------
    >>> import numpy as np, epigauge as eg
    >>> eg.gauge.similarity(2.0, np.eye(3), [1.0, 0.0, 0.0]).positions(np.zeros((1, 3)))
    array([[1., 0., 0.]])
    """
    scale = as_real("s", s, "a positive number")
    if scale.ndim or not 0.0 < scale < np.inf:
        raise ArgumentError("s", f"is {s!r:.60}", "a positive number")
    rotation = as_rotation("R", R)
    target = as_real("t", t, "three numbers")
    if target.shape != (3,) or not np.isfinite(target).all():
        raise ArgumentError("t", f"is {t!r:.60}", "three finite numbers")
    return Similarity(float(scale), rotation, np.zeros(3), target)


@overload
def transform(reconstruction: MetricReconstruction, T: Similarity) -> MetricReconstruction: ...


@overload
def transform(reconstruction: AffineReconstruction, T: ArrayLike) -> AffineReconstruction: ...


@overload
def transform(
    reconstruction: Reconstruction,
    T: ArrayLike,
    camera_scales: ArrayLike = 1.0,
    point_scales: ArrayLike = 1.0,
) -> Reconstruction: ...


def transform(
    reconstruction: Reconstruction | MetricReconstruction | AffineReconstruction,
    T: ArrayLike | Similarity,
    camera_scales: ArrayLike = 1.0,
    point_scales: ArrayLike = 1.0,
) -> Reconstruction | MetricReconstruction | AffineReconstruction:
    """Apply a gauge transformation, which changes no projected point.

    Parameters
    ----------
    reconstruction : Reconstruction, MetricReconstruction or AffineReconstruction
        Cameras and points.
    T : array_like, shape (4, 4), or Similarity
        Change of basis, invertible, of an affine reconstruction with the last row 0 0 0 1; of a
        metric reconstruction a `similarity`.
    camera_scales, point_scales : array_like
        Factors of each camera and point, or one for all; none zero. Of projective ones only.

    Returns
    -------
    Reconstruction, MetricReconstruction or AffineReconstruction
        P_i' = gamma_i P_i T, Q_j' = alpha_j T^-1 Q_j; or X' = s R X + t, and cameras that see it
        as before; lines move along.

    Raises
    ------
    ArgumentError
        If T is singular, a scale is zero, or T is of the other kind.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> found = eg.bundle_adjust(tracks).reconstruction
    >>> moved = eg.gauge.transform(found, np.diag([1.0, 2.0, 3.0, 1.0]))
    >>> bool(np.isclose(moved.rms_px(tracks), found.rms_px(tracks)))
    True
    """
    if isinstance(reconstruction, MetricReconstruction) or isinstance(T, Similarity):
        kinds = isinstance(reconstruction, MetricReconstruction), isinstance(T, Similarity)
        if not isinstance(reconstruction, MetricReconstruction) or not isinstance(T, Similarity):
            what = "is a similarity" if kinds[1] else "is no similarity"
            kind = "metric" if kinds[0] else "not"
            needed = "eg.gauge.similarity(s, R, t)" if kinds[0] else "a (4, 4) matrix"
            raise ArgumentError("T", f"{what}, the reconstruction {kind}", needed)
        _no_scales("metric", camera_scales, point_scales)
        moved, X = T.apply(reconstruction.vectors, reconstruction.X)
        pose = moved[:, :12].reshape(-1, 3, 4)
        lines = None if reconstruction.lines is None else T.lines(reconstruction.lines)
        parts = pose[:, :, :3], pose[:, :, 3], X, reconstruction.cameras
        return MetricReconstruction(*parts, lines)
    matrix = as_real("T", T, "a finite (4, 4) matrix")
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ArgumentError("T", f"has shape {matrix.shape}", "a finite (4, 4) matrix")
    if np.linalg.cond(matrix) > 1e15:
        raise ArgumentError("T", "is singular", "an invertible (4, 4) matrix")
    if isinstance(reconstruction, AffineReconstruction):
        _no_scales("affine", camera_scales, point_scales)
        if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise ArgumentError("T", f"has the last row {matrix[3].tolist()}", "0 0 0 1")
        there = np.asarray(np.linalg.solve(matrix[:3, :3], (reconstruction.X - matrix[:3, 3]).T)).T
        return AffineReconstruction(reconstruction.P[:, :2] @ matrix, np.asarray(there))
    scales = []
    for name, value, count in (
        ("camera_scales", camera_scales, len(reconstruction.P)),
        ("point_scales", point_scales, len(reconstruction.Q)),
    ):
        array = as_real(name, value, f"a number or a ({count},) array")
        if array.shape not in ((), (1,), (count,)):
            raise ArgumentError(name, f"has shape {array.shape}", f"a number or ({count},)")
        array = np.broadcast_to(array, (count,))
        if not np.isfinite(array).all() or (array == 0.0).any():
            raise ArgumentError(name, "has a zero or is not finite", "finite factors, none zero")
        scales.append(array)
    move, lines = Transformation(matrix, *scales), reconstruction.lines
    P, Q = move.apply(reconstruction.P, reconstruction.Q)
    return Reconstruction(P, Q, None if lines is None else move.lines(lines))


def _no_scales(kind: str, camera_scales: ArrayLike, point_scales: ArrayLike) -> None:
    for name, scales in (("camera_scales", camera_scales), ("point_scales", point_scales)):
        if not np.array_equal(scales, 1.0):
            raise ArgumentError(name, "is given", f"none for {kind} reconstructions")
