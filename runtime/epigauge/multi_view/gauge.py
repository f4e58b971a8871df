"""Gauges: changes of projective basis and scales, and rules that choose one (B03 sections 4, 5).

A `Transformation` is the T~ of B03 eq. (5). A gauge is an object that finds the transformation
which moves a reconstruction to where the gauge wants it. Two reconstructions of the same geometry
are moved to the same place, up to signs and, for the normalised basis, an orthonormal change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_real
from epigauge.bundle.similarity import Similarity
from epigauge.cameras import AffineReconstruction, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Reconstruction
from epigauge.rotations import as_rotation
from epigauge.scatter import spreading_basis

__all__ = [
    "GAUGES",
    "Gauge",
    "Group",
    "Similarity",
    "Transformation",
    "equivalent",
    "five_points",
    "group",
    "identity",
    "inner",
    "normalized",
    "reference_camera",
    "similarity",
    "transform",
    "two_cameras",
]

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
        """
        cameras = self.camera_scales[:, None, None] * (P @ self.T)
        return cameras, self.point_scales[:, None] * np.linalg.solve(self.T, Q.T).T

    def inverse(self) -> Transformation:
        """Return the transformation back.

        Returns
        -------
        Transformation
            What undoes this one.
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
        """
        table, inverse = kernels.table("numpy"), np.linalg.inv(self.T)
        cameras = table.camera_transformation(self.T[..., None], self.camera_scales)
        points = table.point_transformation(inverse[..., None], self.point_scales)
        return np.moveaxis(cameras, -1, 0), np.moveaxis(points, -1, 0)


class Gauge(Protocol):
    """A rule that chooses basis and scales."""

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
        """


@dataclass(frozen=True)
class Group:
    """The gauge group of a camera model: what moves cameras and points and changes no image.

    Attributes
    ----------
    model : str
        Name of the camera model.
    dimension : int
        Of the group, beside the scales of homogeneous cameras and points.
    names : tuple of str
        What its generators are.
    """

    model: str
    dimension: int
    names: tuple[str, ...]

    def generators(
        self, reconstruction: Reconstruction | MetricReconstruction | AffineReconstruction
    ) -> tuple[Array, Array]:
        """Return the velocities of cameras and points along the group.

        Parameters
        ----------
        reconstruction : Reconstruction, MetricReconstruction or AffineReconstruction
            Where, with cameras of this model.

        Returns
        -------
        cameras, points : ndarray, shape (n, d, dimension), (m, b, dimension)
            In each camera's own tangent (turn and move in its own frame, intrinsics; all entries of
            a projective one, two rows of an affine one) and in the coordinates of each point. The
            Jacobian of the images times them is zero.

        Raises
        ------
        ArgumentError
            If the reconstruction has other cameras.
        """
        model = camera_model(self.model)
        if isinstance(reconstruction, MetricReconstruction):
            name, rows, points = (
                reconstruction.cameras.model,
                reconstruction.vectors,
                reconstruction.X,
            )
        elif isinstance(reconstruction, AffineReconstruction):
            name, rows, points = "affine", reconstruction.vectors, reconstruction.X
        else:
            name, rows, points = "projective", reconstruction.P.reshape(-1, 12), reconstruction.Q
        if name != model.name:
            raise ArgumentError("reconstruction", f"has {name} cameras", f"{model.name} cameras")
        of_cameras, of_points = (
            model.kernel(f"{what}_generators")(array.T)
            for what, array in (("camera", rows), ("point", points))
        )
        return of_cameras.transpose(2, 0, 1), of_points.transpose(2, 0, 1)


def group(model: str) -> Group:
    """Return the gauge group of a camera model, as derived from its formula.

    Parameters
    ----------
    model : str
        Name of the camera model, as ``"projective"`` or ``"SIMPLE_RADIAL"``.

    Returns
    -------
    Group
        Dimension, names and generators.

    Raises
    ------
    ArgumentError
        On an unknown model.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.gauge.group("projective").dimension, eg.gauge.group("bal").dimension
    (15, 7)
    """
    found = camera_model(model)
    return Group(found.name, found.gauge_dimension, found.gauge_names)


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
        as before.

    Raises
    ------
    ArgumentError
        If T is singular, a scale is zero, or T is of the other kind.
    """
    if isinstance(reconstruction, MetricReconstruction) or isinstance(T, Similarity):
        kinds = isinstance(reconstruction, MetricReconstruction), isinstance(T, Similarity)
        if not isinstance(reconstruction, MetricReconstruction) or not isinstance(T, Similarity):
            what = "is a similarity" if kinds[1] else "is no similarity"
            kind = "metric" if kinds[0] else "projective"
            needed = "eg.gauge.similarity(s, R, t)" if kinds[0] else "a (4, 4) matrix"
            raise ArgumentError("T", f"{what}, the reconstruction {kind}", needed)
        _no_scales("metric", camera_scales, point_scales)
        moved, X = T.apply(reconstruction.vectors, reconstruction.X)
        pose = moved[:, :12].reshape(-1, 3, 4)
        return MetricReconstruction(pose[:, :, :3], pose[:, :, 3], X, reconstruction.cameras)
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
    return Reconstruction(
        *Transformation(matrix, *scales).apply(reconstruction.P, reconstruction.Q)
    )


def _no_scales(kind: str, camera_scales: ArrayLike, point_scales: ArrayLike) -> None:
    for name, scales in (("camera_scales", camera_scales), ("point_scales", point_scales)):
        if not np.array_equal(scales, 1.0):
            raise ArgumentError(name, "is given", f"none for {kind} reconstructions")


def equivalent(a: Reconstruction, b: Reconstruction, tol: float = 1e-8) -> bool:
    """Tell whether two reconstructions are the same geometry (B03 eq. 6).

    Parameters
    ----------
    a, b : Reconstruction
        Of the same views and points.
    tol : float
        Largest sine of the angle between a camera (or point) of b and its image from a, as vectors
        of R^12 (R^4), in the basis where the points of b are spread evenly.

    Returns
    -------
    bool
        True where some T, gamma, alpha take a to b.
    """
    if a.P.shape != b.P.shape or a.Q.shape != b.Q.shape:
        return False
    P_a, Q_a = normalized().transformation(a.P, a.Q).apply(a.P, a.Q)
    P_b, Q_b = normalized().transformation(b.P, b.Q).apply(b.P, b.Q)
    # P_a T ~ P_b: the part of P_a T across P_b vanishes; the unknown is vect(T).
    normal = np.zeros((16, 16))
    for camera_a, camera_b in zip(P_a, P_b, strict=True):
        linear = np.kron(camera_a, np.eye(4))
        across = linear - np.outer(camera_b.ravel(), camera_b.ravel() @ linear)
        normal += across.T @ across
    T = np.linalg.eigh(normal)[1][:, 0].reshape(4, 4)
    if np.linalg.cond(T) > 1e12:
        return False
    ones = (np.ones(len(P_a)), np.ones(len(Q_a)))
    moved_P, moved_Q = Transformation(T, *ones).apply(P_a, Q_a)
    return _sine(moved_P.reshape(-1, 12), P_b.reshape(-1, 12)) <= tol and _sine(moved_Q, Q_b) <= tol


@dataclass(frozen=True)
class identity:
    """The gauge the reconstruction is in."""

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
    """

    points: Sequence[int] | None = None

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge."""
        chosen = self.choose(Q) if self.points is None else list(self.points)
        basis = Q[chosen[:4]].T
        T = basis * np.linalg.solve(basis, Q[chosen[4]])
        return _unit_scales(T, P, Q)

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
    """

    def transformation(self, P: Array, Q: Array) -> Transformation:
        """Return what moves cameras and points into the gauge."""
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


def _unit_scales(T: Array, P: Array, Q: Array) -> Transformation:
    """Return T with the scales that make every camera and point of unit norm."""
    moved_P, moved_Q = P @ T, np.linalg.solve(T, Q.T)
    return Transformation(
        T, 1.0 / np.linalg.norm(moved_P, axis=(1, 2)), 1.0 / np.linalg.norm(moved_Q, axis=0)
    )


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


def _sine(a: Array, b: Array) -> float:
    """Return the largest sine of the angle between corresponding rows."""
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    along = np.sum(a * b, axis=1, keepdims=True)
    return float(np.linalg.norm(a - along * b, axis=1).max(initial=0.0))
