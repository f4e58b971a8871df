"""Directions of the unknowns in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.solve import BundleSystem
from epigauge.two_view.losses import median

__all__ = ["largest", "named", "of_points", "of_views", "tangent_sizes"]

Array = NDArray[np.float64]

#: Share of the squared motion that a group of points has, and largest share of them it may be.
_NEARLY, _GROUP = 0.95, 0.5


def largest(system: BundleSystem, sizes: Array) -> str:
    """Return the names of the three largest entries of own tangents (n, d)."""
    views, entries = np.unravel_index(np.argsort(-sizes, axis=None)[:3], sizes.shape)
    names = system.model.tangent_names
    return ", ".join(f"{names[k]} of view {i}" for i, k in zip(views, entries, strict=True))


def tangent_sizes(system: BundleSystem) -> Array:
    """Return the sizes of own tangents (n, d), of which standard deviations are shares.

    Turns are in radians, moves as shares of the median distance of the points, focal lengths and
    other parameters in their unit as shares of the focal length; all others count for nothing.
    Affine cameras are as they are computed with: points of unit covariance, images of RMS one.
    """
    sizes = np.ones(system.normal.g_cameras.shape)
    if system.model.metric:
        _set_sizes(sizes, system)
    return sizes


def named(system: BundleSystem, shares: Array) -> str:
    """Return the three largest shares of `tangent_sizes` (n, d) by name."""
    views, entries = np.unravel_index(np.argsort(-shares, axis=None)[:3], shares.shape)
    return ", ".join(
        f"{system.model.tangent_names[k]} of view {i} ({100.0 * shares[i, k]:.2g} %)"
        for i, k in zip(views, entries, strict=True)
    )


def of_views(parts: Array, views: NDArray[np.intp]) -> str:
    """Return which cameras have most part (n,) in a direction, by their numbers."""
    if not parts.any():
        return ""
    first = np.argsort(-parts, kind="stable")[:3]
    told = ", ".join(f"{views[k]} ({100.0 * parts[k]:.0f} %)" for k in first if parts[k] > 0.01)
    return f"cameras of views {told}"


def of_points(motion: Array) -> str:
    """Return the group of points that has nearly all of a motion (m, b), or nothing."""
    squares = np.sum(motion.T**2, axis=0)
    most, enough = int(_GROUP * len(squares)), _NEARLY * float(squares.sum())
    if not (most and 0.0 < enough < np.inf):
        return ""
    of_half = np.partition(squares, len(squares) - most)[-most:]
    if of_half.sum() < enough:
        return ""
    order = np.argsort(-squares, kind="stable")
    count = 1 + int(np.searchsorted(np.cumsum(squares[order]), enough))
    if count > most:
        return ""
    listed = ", ".join(map(str, sorted(order[: min(count, 5)].tolist())))
    return f"points {listed}{' ...' if count > 5 else ''} ({count} of {len(motion)})"


def _set_sizes(sizes: Array, system: BundleSystem) -> None:
    """Set the sizes (n, d) of a metric camera's own tangents."""
    model, cameras = system.model, system.cameras
    pose = cameras[:, :12].reshape(-1, 3, 4)
    centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    offsets = system.points.T - centres.mean(axis=0)[:, None]
    extent = np.sqrt(median(np.sum(offsets**2, axis=0)))
    sizes[:, 3:6] = max(float(extent), 1e-300)
    focal = cameras[:, 12:][:, list(model.focal)]
    sizes[:, 6:] = focal.mean(axis=1, keepdims=True) if focal.size else np.inf
    of_image = {model.units[k] for k in model.focal}
    without = [k for k in range(len(model.adjusted)) if model.units[k] not in of_image]
    sizes[:, [6 + k for k in without]] = np.inf
