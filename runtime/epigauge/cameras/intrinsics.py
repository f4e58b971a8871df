"""Parameters of cameras, and which of them took which view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array
from epigauge.cameras.checks import counted, finite_rows, frozen
from epigauge.cameras.models import camera_model
from epigauge.errors import ArgumentError

__all__ = ["MAX_FOCAL", "MIN_FOCAL", "Cameras", "check_parameters"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Lengths among the parameters are accepted between these: beyond, a file is broken. Nearly affine
#: cameras may well have long ones.
MIN_FOCAL, MAX_FOCAL = 1e-9, 1e11


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
    array = finite_rows("params", params, (len(known.params),), " ".join(known.params))
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
        lengths that are not between 1e-9 and 1e11, cameras that do not exist or have no view.

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
        object.__setattr__(self, "params", frozen(params))
        object.__setattr__(self, "camera_of_view", frozen(views.astype(np.intp)))

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
        cameras = counted(len(self.params), "camera")
        focal = self.params[:, list(camera_model(self.model).focal)]
        low, high = (f"{x:.6g}" for x in (focal.min(initial=np.inf), focal.max(initial=0.0)))
        span = low if low == high else f"{low} to {high}"
        text = f"{cameras} of {counted(len(self.camera_of_view), 'view')}"
        return f"Cameras({self.model!r}, {text}{f', f {span}' if focal.size else ''})"
