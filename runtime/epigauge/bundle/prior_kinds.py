"""What may be known of a scene beside its images: positions, turns, intrinsics, points, lengths.

Each adds 0.5 e^T covariance^-1 e to the cost, e the deviation from what is known
(`epigauge.bundle.priors`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from epigauge.errors import ArgumentError

__all__ = [
    "Distance",
    "IntrinsicPrior",
    "PointPrior",
    "PositionPrior",
    "Prior",
    "RotationPrior",
    "listed_priors",
]


@dataclass(frozen=True)
class PositionPrior:
    """The centre of a view is known, as from a satellite receiver.

    Parameters
    ----------
    view : int
        Which.
    position : array_like, shape (3,)
        Where, in the frame of the start.
    sigma : float or array_like, shape (3,), optional
        Standard deviations of the three coordinates.
    covariance : array_like, shape (3, 3), optional
        In place of `sigma`.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.PositionPrior(0, (10.0, 20.0, 1.5), sigma=(0.02, 0.02, 0.05)).view
    0
    """

    view: int
    position: ArrayLike
    sigma: ArrayLike | None = None
    covariance: ArrayLike | None = None


@dataclass(frozen=True)
class RotationPrior:
    """The rotation of a view is known, as from an inertial sensor.

    Parameters
    ----------
    view : int
        Which.
    rotation : array_like, shape (3, 3)
        R of ``x_cam = R X + t``, in the frame of the start.
    sigma : float or array_like, shape (3,), optional
        Standard deviations of the turns about the camera's own axes, in radians.
    covariance : array_like, shape (3, 3), optional
        In place of `sigma`.

    Notes
    -----
    The deviation is 2 sin(angle / 2) axis, of the turn in the camera's frame from the known
    rotation to the camera's: the rotation vector, to third order in the angle.

    Examples
    --------
    >>> import numpy as np, epigauge as eg
    >>> eg.RotationPrior(2, np.eye(3), sigma=np.radians(0.5)).view
    2
    """

    view: int
    rotation: ArrayLike
    sigma: ArrayLike | None = None
    covariance: ArrayLike | None = None


@dataclass(frozen=True)
class IntrinsicPrior:
    """A parameter of a camera is known, as a focal length from a data sheet.

    Parameters
    ----------
    camera : int
        Row of `Cameras.params`.
    name : str
        Name of the parameter, as ``"f"``.
    value, sigma : float
        Value and standard deviation, in the parameter's unit.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.IntrinsicPrior(0, "f", 812.0, 4.0).name
    'f'
    """

    camera: int
    name: str
    value: float
    sigma: float


@dataclass(frozen=True)
class PointPrior:
    """A point is known, as a control point.

    Parameters
    ----------
    point : int
        Which.
    position : array_like, shape (3,)
        Where, in the frame of the start.
    sigma : float or array_like, shape (3,), optional
        Standard deviations of the three coordinates.
    covariance : array_like, shape (3, 3), optional
        In place of `sigma`.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.PointPrior(3, (10.0, 20.0, 1.5), sigma=0.01).point
    3
    """

    point: int
    position: ArrayLike
    sigma: ArrayLike | None = None
    covariance: ArrayLike | None = None


@dataclass(frozen=True)
class Distance:
    """The distance of two points is known, as of a scale bar.

    Parameters
    ----------
    point1, point2 : int
        Which.
    length, sigma : float
        Distance and standard deviation, in the unit of the start.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.Distance(3, 8, length=1389.688, sigma=0.01).length
    1389.688
    """

    point1: int
    point2: int
    length: float
    sigma: float


Prior = PositionPrior | RotationPrior | IntrinsicPrior | PointPrior | Distance


def listed_priors(priors: Any) -> tuple[Prior, ...]:
    """Return priors given in any iterable."""
    try:
        return tuple(priors)
    except TypeError:
        raise ArgumentError("priors", f"is {priors!r:.60}", "a list of priors") from None
