"""Motions of the cameras that leave their intrinsics open, or nearly so."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction
from epigauge.metric.scene import Images
from epigauge.rotations import rodrigues

__all__ = ["motion_flags"]

Array = NDArray[np.float64]

#: Rotations below this angle (radians; a third of a degree) are none, and axes of rotations are one
#: if they deviate from it by less, times the angle.
_TURN = 0.006

#: Cameras within this share of the depth of the scene are in one place.
_PLACE = 1e-3

#: A point that all views look at stays within this share of width plus height in all images.
_STILL = 0.008


def motion_flags(
    found: MetricReconstruction, images: Images, turn_std: float = 0.0
) -> tuple[str, ...]:
    """Name the kind of motion, where it is one that self-calibration has trouble with.

    Parameters
    ----------
    found : MetricReconstruction
        Adjusted cameras; their median depth is about one.
    images : Images
        Sizes.
    turn_std : float
        Standard deviation of the rotations, in radians; four of it are no rotation.

    Returns
    -------
    tuple of str
        Of "pure rotation", "pure translation", "one rotation axis", "one viewing point". The latter
        two are asked of three views or more: two have one axis of rotation always.

    References
    ----------
    .. [1] P. Sturm, "Critical motion sequences for monocular self-calibration and uncalibrated
       Euclidean reconstruction", CVPR 1997.
    """
    centres = found.centres - found.centres.mean(axis=0)
    if np.linalg.norm(centres, axis=1).max() < _PLACE:
        return ("pure rotation",)
    # In the frame of the scene: R_0^T R_i turns about the same axis in any frame of one axis.
    turns = rodrigues(np.swapaxes(found.R[:1], 1, 2) @ found.R)[1:]
    least = max(_TURN, 4.0 * turn_std)
    extents = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if np.linalg.norm(turns, axis=1).max() < least:
        return ("pure translation",)
    if len(found.R) < 3:
        return ()
    flags = []
    if extents[1] < least:
        flags.append("one rotation axis")
    if _drift(found, images) < _STILL:
        flags.append("one viewing point")
    return tuple(flags)


def _drift(found: MetricReconstruction, images: Images) -> float:
    """Return how far the images of the point that moves least in the images move."""
    axes = found.R[:, 2]
    # The point nearest to all optical axes, then its images in units of the image.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    N = across.sum(axis=0)
    if np.linalg.eigvalsh(N)[0] < 1e-9 * len(axes):
        return float("inf")
    X = np.linalg.solve(N, np.einsum("nij,nj->i", across, found.centres))
    h = np.einsum("nij,j->ni", found.P, np.append(X, 1.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = h[:, :2] / h[:, 2:] / images.unit[:, None]
    away = seen - seen.mean(axis=0)
    return float(np.nan_to_num(np.linalg.norm(away, axis=1).max(), nan=np.inf))
