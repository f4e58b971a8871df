"""Which camera models there are: their parameters and kernels.

A camera model is data: its row of ``epigauge_generated.signatures.MODELS`` names its parameters
and kernels. Nothing here knows one model from another.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from epigauge_generated import signatures

from epigauge import kernels
from epigauge.errors import ArgumentError

__all__ = ["CameraModel", "camera_model", "models"]

Kernel = Callable[..., Any]

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
