"""Which camera models there are: their parameters and kernels.

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
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.errors import ArgumentError

__all__ = ["CameraModel", "camera_model", "models"]

Array = NDArray[np.float64]
Kernel = Callable[..., Any]

_FOCAL = ("f", "fx", "fy", "c")
_SIDES = ("width", "height")

#: A measured point whose correction is farther than this from the image, of its size, is another's;
#: and so is one whose direction has its image so far away.
_MISSED = 1e-6

#: Newton steps to a direction.
_STEPS = 30


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
    corrects : bool
        Whether the lens is corrected on the measured side: residuals are those of corrected points.
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
    corrects: bool

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

    def seen(
        self, cameras: Array, points: Array, backend: str | None = None
    ) -> tuple[Array, Array]:
        """Return pixels and depths of points.

        Parameters
        ----------
        cameras, points : ndarray, shape (c, N), (b, N)
            One column an observation.
        backend : {"c", "numpy", "casadi"}, optional
            By default the active one.

        Returns
        -------
        pixels, depths : ndarray, shape (2, N), (N,)
            Infinite or NaN where the model has no image of a point; infinite, too, where the
            correction of a measured point folds: Newton steps lead anywhere there.
        """
        with np.errstate(all="ignore"):
            pixels, depths = map(np.array, self.kernel("project", backend)(cameras, points))
            if self.corrects:
                params = np.ascontiguousarray(cameras[self.camera_size - len(self.params) :])
                slope = self.kernel("correct", backend)(pixels, params)[1]
                missed = np.abs(self.kernel("residual", backend)(cameras, points, pixels))
                size = np.maximum(np.abs(pixels).max(axis=0), 1.0)
                upright = slope[0, 0] * slope[1, 1] > slope[0, 1] * slope[1, 0]
                upright &= slope[0, 0] + slope[1, 1] > 0.0
                pixels[:, ~(upright & (missed.max(axis=0) <= _MISSED * size))] = np.inf
        return pixels, depths

    def directions(self, pixels: Array, params: Array) -> tuple[Array, Array]:
        """Return where cameras see pixels on the plane one away along their z axis.

        Parameters
        ----------
        pixels, params : ndarray, shape (2, N), (k, N)
            One column an observation.

        Returns
        -------
        h : ndarray, shape (2, N)
            The point (h, 1) has the image; NaN where none has.
        derivative : ndarray, shape (N, 2, 2)
            Of h by the pixel.
        """
        image = self.kernel("image")
        h = np.zeros((3, pixels.shape[1]))
        h[2] = 1.0
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                found, slope = image(h, params)
                inverse = _inverses(slope[:, :2].transpose(2, 0, 1))
                h[:2] -= np.einsum("nij,jn->in", inverse, found - pixels)
            found, slope = image(h, params)
            off = np.abs(found - pixels).max(axis=0)
            h[:2, ~(off <= _MISSED * np.maximum(1.0, np.abs(pixels).max(axis=0)))] = np.nan
            return h[:2], _inverses(slope[:, :2].transpose(2, 0, 1))

    def on_axis(self, params: Array) -> tuple[Array, Array]:
        """Return what a unit of slope is near the optical axis, in pixels, and which way it goes.

        Parameters
        ----------
        params : ndarray, shape (n, k)
            One row a camera.

        Returns
        -------
        focal, sense : ndarray, shape (n,), (n,)
            Geometric mean of both directions of the image; 1 where the camera looks along +z,
            -1 where along -z.
        """
        columns = np.ascontiguousarray(params.T)
        axis = np.repeat(np.array([[0.0], [0.0], [1.0]]), len(params), axis=1)
        pose = np.repeat(np.eye(3, 4).reshape(-1, 1), len(params), axis=1)
        with np.errstate(all="ignore"):
            slope = self.kernel("image")(axis, columns)[1]
            depths = self.seen(np.concatenate([pose, columns]), axis)[1]
            area = slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]
        return np.sqrt(np.abs(area)), np.where(depths > 0.0, 1.0, -1.0)


def _inverses(a: Array) -> Array:
    """Return inverses of 2x2 matrices, not finite where there are none."""
    determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    adjoint = np.array([[a[:, 1, 1], -a[:, 0, 1]], [-a[:, 1, 0], a[:, 0, 0]]]).transpose(2, 0, 1)
    return np.asarray(adjoint / determinant[:, None, None])


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
