"""Calibrated and distorted cameras: which models there are, their parameters, and scenes of them.

A camera model is data: its row of ``epigauge_generated.signatures.MODELS`` names its parameters
and kernels. Nothing here knows one model from another.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from epigauge_generated import signatures
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_array, as_real
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Reconstruction, Tracks

__all__ = ["CameraModel", "Cameras", "MetricReconstruction", "camera_model", "models"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Kernel = Callable[..., Any]

#: Lengths among the parameters are accepted between these: a wider range means a broken file, and a
#: view of less than 1e-6 of a radian, where focal length and distance cannot be told apart.
MIN_FOCAL, MAX_FOCAL = 1e-9, 1e9

#: Parameters, positions and points are accepted up to this size.
MAX_SIZE = 1e15

#: How far R^T R may be from the identity.
ORTHONORMAL = 1e-8

_FOCAL = ("f", "fx", "fy", "c")
_SIDES = ("width", "height")


@dataclass(frozen=True)
class CameraModel:
    """A camera model: sizes, names of parameters, kernels.

    Attributes
    ----------
    name, prefix : str
        Name, and what the names of its kernels begin with.
    params, units : tuple of str
        Names of the parameters in their order, and units, as ``"px"`` or ``"1"``.
    constants : tuple of str
        The last of them, which are given and never adjusted, as the size of a spherical image.
    camera_size, tangent_size, point_size : int
        Numbers that a camera (12 of its pose, then the parameters), its update and a point consist
        of.
    tangent_names, gauge_names : tuple of str
        Names of what an update consists of, and of the directions of space that change no image.
    gauge_dimension : int
        Number of these directions: 7 for similarities.
    metric : bool
        Whether a camera has a rotation and a position.
    homogeneous : bool
        Whether points are homogeneous: they and the cameras have scales that change no image.
    """

    name: str
    prefix: str
    params: tuple[str, ...]
    units: tuple[str, ...]
    constants: tuple[str, ...]
    camera_size: int
    tangent_size: int
    point_size: int
    tangent_names: tuple[str, ...]
    gauge_names: tuple[str, ...]
    gauge_dimension: int
    metric: bool
    homogeneous: bool

    @property
    def adjusted(self) -> tuple[str, ...]:
        """Names of the parameters that can be refined: all but the constants, in order."""
        return self.params[: len(self.params) - len(self.constants)]

    @property
    def focal(self) -> tuple[int, ...]:
        """Places of the focal lengths among the parameters."""
        return tuple(k for k, name in enumerate(self.params) if name in _FOCAL)

    @property
    def positive(self) -> tuple[int, ...]:
        """Places of the parameters that are lengths: focal lengths, and sides of images."""
        return tuple(k for k, name in enumerate(self.params) if name in (*_FOCAL, *_SIDES))

    def kernel(self, name: str, backend: str | None = None) -> Kernel:
        """Return a kernel of the model, as ``project`` or ``observe``, of a backend.

        Parameters
        ----------
        name : str
            The kernel's name without the prefix of the model.
        backend : {"c", "numpy", "casadi"}, optional
            By default the active one.

        Returns
        -------
        callable
            See ``epigauge_generated.signatures`` for its arguments.
        """
        found: Kernel = getattr(kernels.table(backend), f"{self.prefix}_{name}")
        return found


_MODELS = {
    name: CameraModel(**{field: getattr(row, field) for field in CameraModel.__dataclass_fields__})
    for name, row in signatures.MODELS.items()
}


def models() -> dict[str, CameraModel]:
    """Return all camera models by name.

    Returns
    -------
    dict of str to CameraModel
        In the order of the derivation.
    """
    return dict(_MODELS)


def camera_model(name: str, argument: str = "model") -> CameraModel:
    """Return a camera model.

    Parameters
    ----------
    name : str
        Its name, as COLMAP's ``"SIMPLE_RADIAL"``, or ``"bal"``.
    argument : str
        What an error calls the name.

    Returns
    -------
    CameraModel
        Sizes, parameters, kernels.

    Raises
    ------
    ArgumentError
        If there is none of this name; the message lists those there are.
    """
    known = _MODELS
    if isinstance(name, str) and name in known:
        return known[name]
    listed = ", ".join(known)
    lower = {other.lower(): other for other in known}
    close = difflib.get_close_matches(str(name).lower(), lower, n=1)
    hint = f" (did you mean {lower[close[0]]!r}?)" if close else ""
    raise ArgumentError(argument, f"is {name!r:.60}", f"one of {listed}{hint}")


def check_parameters(model: str, params: ArrayLike) -> Array:
    """Check the parameters of cameras.

    Parameters
    ----------
    model : str
        Name of the camera model.
    params : array_like, shape (c, k)
        Parameters of each camera.

    Returns
    -------
    ndarray, shape (c, k)
        The same; do not write into it.

    Raises
    ------
    ArgumentError
        As `Cameras`.
    """
    known = camera_model(model)
    array = _numbers("params", params, (len(known.params),), " ".join(known.params))
    if not len(array):
        raise ArgumentError("params", "has no row", "a row a camera")
    for k in known.positive:
        bad = np.flatnonzero(~((array[:, k] >= MIN_FOCAL) & (array[:, k] <= MAX_FOCAL)))
        if len(bad):
            was = f"has {known.params[k]} = {array[bad[0], k]:g} in row {bad[0]}"
            needed = f"a length between {MIN_FOCAL:g} and {MAX_FOCAL:g}"
            raise ArgumentError("params", was, needed)
    return array


@dataclass(frozen=True, eq=False)
class Cameras:
    """Cameras of one model, and which of them took which view.

    Parameters
    ----------
    model : str
        Name of the camera model, as ``"SIMPLE_RADIAL"``.
    params : array_like, shape (c, k)
        Parameters of each camera in the order of the model.
    camera_of_view : array_like of int, shape (n,)
        For each view its camera, from 0. Views of one camera share its parameters.

    Raises
    ------
    ArgumentError
        On an unknown model, a wrong number of parameters, numbers that are not finite, focal
        lengths that are not between 1e-9 and 1e9, cameras that do not exist or have no view.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.Cameras("SIMPLE_RADIAL", [[800.0, 320.0, 240.0, -0.1]], [0, 0, 0])
    Cameras('SIMPLE_RADIAL', 1 camera of 3 views, f 800)
    """

    model: str
    params: Array
    camera_of_view: Indices

    def __post_init__(self) -> None:
        params = check_parameters(self.model, self.params)
        views = as_array("camera_of_view", self.camera_of_view, "an (n,) array")
        if views.ndim != 1 or views.dtype.kind not in "iu" or not len(views):
            was = f"is {views.dtype} {views.shape}"
            raise ArgumentError("camera_of_view", was, "integers (n,), one a view")
        bad = np.flatnonzero((views < 0) | (views >= len(params)))
        if len(bad):
            was = f"is {views[bad[0]]} for view {bad[0]}"
            raise ArgumentError("camera_of_view", was, f"0 to {len(params) - 1}, a row of params")
        unused = np.setdiff1d(np.arange(len(params)), views)
        if len(unused):
            was = f"names no view of camera {unused[0]}"
            raise ArgumentError("camera_of_view", was, "a view of every camera: drop other cameras")
        object.__setattr__(self, "model", str(self.model))
        object.__setattr__(self, "params", _frozen(params))
        object.__setattr__(self, "camera_of_view", _frozen(views.astype(np.intp)))

    @property
    def of_views(self) -> Array:
        """Parameters of each view, (n, k)."""
        return np.asarray(self.params[self.camera_of_view])

    def __len__(self) -> int:
        """Return the number of cameras."""
        return len(self.params)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments: arrays from a pickle could be written to."""
        return type(self), (self.model, self.params, self.camera_of_view)

    def __repr__(self) -> str:
        cameras = _count(len(self.params), "camera")
        focal = self.params[:, list(camera_model(self.model).focal)]
        low, high = (f"{x:.6g}" for x in (focal.min(initial=np.inf), focal.max(initial=0.0)))
        span = low if low == high else f"{low} to {high}"
        text = f"{cameras} of {_count(len(self.camera_of_view), 'view')}"
        return f"Cameras({self.model!r}, {text}{f', f {span}' if focal.size else ''})"


@dataclass(frozen=True, eq=False)
class MetricReconstruction:
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

    Raises
    ------
    ArgumentError
        On other shapes, numbers that are not finite, matrices R that are no rotations (the message
        says how to repair them), and cameras that have no rotation.
    """

    R: Array
    t: Array
    X: Array
    cameras: Cameras

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Cameras):
            was = f"is a {type(self.cameras).__name__}"
            raise ArgumentError("cameras", was, "eg.Cameras(model, params, camera_of_view)")
        if not camera_model(self.cameras.model).metric:
            was = f"are of the model {self.cameras.model!r}, which has no rotation"
            raise ArgumentError("cameras", was, "a calibrated model, or eg.Reconstruction(P, Q)")
        R = _numbers("R", self.R, (3, 3), "one rotation a view")
        t = _numbers("t", self.t, (3,), "one translation a view")
        X = _numbers("X", self.X, (3,), "one point a row")
        n = len(self.cameras.camera_of_view)
        for name, array in (("R", R), ("t", t)):
            if len(array) != n:
                raise ArgumentError(name, f"has {len(array)} rows", f"{n}, a row a view")
        if not len(X):
            raise ArgumentError("X", "has no row", "at least one point")
        _check_rotations(R)
        for name, array in (("R", R), ("t", t), ("X", X)):
            object.__setattr__(self, name, _frozen(array))

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
        """
        return np.asarray(self._images(tracks, backend)[1])

    def rms_px(self, tracks: Tracks) -> float:
        """Return the root mean square of the residual coordinates.

        Parameters
        ----------
        tracks : Tracks
            Observations.

        Returns
        -------
        float
            sqrt(sum of squared residual coordinates / (2 N)), in pixels.
        """
        with np.errstate(over="ignore"):
            return float(np.sqrt(np.mean((tracks.xy - self.project(tracks)) ** 2)))

    def to_projective(self) -> Reconstruction:
        """Return the scene as projective cameras and points; distortion has no place there.

        Returns
        -------
        Reconstruction
            ``P`` of this scene, and the points with a fourth coordinate one. It projects to the
            same pixels where the model has no distortion.
        """
        return Reconstruction(self.P, np.column_stack([self.X, np.ones(len(self.X))]))

    def _images(self, tracks: Tracks, backend: str | None) -> tuple[Array, Array]:
        """Return pixels (2, N) and depths (N,)."""
        if (tracks.n_views, tracks.n_points) != (self.n_views, self.n_points):
            was = f"are of {tracks.n_views} views and {tracks.n_points} points"
            raise ArgumentError("tracks", was, f"{self.n_views} and {self.n_points}, as here")
        project = camera_model(self.cameras.model).kernel("project", backend)
        with np.errstate(all="ignore"):
            pair: tuple[Array, Array] = project(self.vectors[tracks.view].T, self.X[tracks.point].T)
        return pair

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

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments: arrays from a pickle could be written to."""
        return type(self), (self.R, self.t, self.X, self.cameras)

    def __repr__(self) -> str:
        views, points = _count(self.n_views, "view"), _count(self.n_points, "point")
        return f"MetricReconstruction({views}, {points}, {self.cameras!r})"


def _numbers(name: str, value: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """Return finite numbers (n, *shape)."""
    needed = f"({', '.join(map(str, ('n', *shape)))}): {what}"
    array = as_real(name, value, needed)
    if array.ndim != 1 + len(shape) or array.shape[1:] != shape:
        raise ArgumentError(name, f"has shape {array.shape}", needed)
    entries = tuple(range(1, array.ndim))
    bad = np.flatnonzero(~(np.abs(array) <= MAX_SIZE).all(axis=entries))
    if len(bad):
        row = array[bad[0]]
        worst = row[~(np.abs(row) <= MAX_SIZE)][0]
        raise ArgumentError(name, f"has {worst} in row {bad[0]}", f"numbers up to {MAX_SIZE:g}")
    return array


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


def _frozen(array: NDArray[Any]) -> Any:
    """Return a copy that nobody writes to."""
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
