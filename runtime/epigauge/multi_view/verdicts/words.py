"""Directions of the unknowns in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.solve import BundleSystem

__all__ = ["largest", "named"]

Array = NDArray[np.float64]


def largest(system: BundleSystem, sizes: Array) -> str:
    """Return the names of the three largest entries of own tangents (n, d)."""
    views, entries = np.unravel_index(np.argsort(-sizes, axis=None)[:3], sizes.shape)
    names = system.model.tangent_names
    return ", ".join(f"{names[k]} of view {i}" for i, k in zip(views, entries, strict=True))


def named(system: BundleSystem, deviations: Array) -> tuple[str, float]:
    """Return the largest standard deviations of a direction by name, as shares of their sizes.

    Turns are in radians, moves as shares of the median distance of the points, focal lengths and
    other parameters in their unit as shares of the focal length; all others count for nothing.
    Affine cameras are as they are computed with: points of unit covariance, images of RMS one.
    """
    model = system.model
    sizes = np.ones(deviations.shape)
    if model.metric:
        _set_sizes(sizes, system)
    shares = deviations / sizes
    views, entries = np.unravel_index(np.argsort(-shares, axis=None)[:3], shares.shape)
    told = [
        f"{model.tangent_names[k]} of view {i} ({100.0 * shares[i, k]:.2g} %)"
        for i, k in zip(views, entries, strict=True)
    ]
    return ", ".join(told), float(shares.max())


def _set_sizes(sizes: Array, system: BundleSystem) -> None:
    """Set the sizes (n, d) of a metric camera's own tangents."""
    model, cameras = system.model, system.cameras
    pose = cameras[:, :12].reshape(-1, 3, 4)
    centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    extent = np.median(np.linalg.norm(system.points - centres.mean(axis=0), axis=1))
    sizes[:, 3:6] = max(float(extent), 1e-300)
    focal = cameras[:, 12:][:, list(model.focal)]
    sizes[:, 6:] = focal.mean(axis=1, keepdims=True) if focal.size else np.inf
    of_image = {model.units[k] for k in model.focal}
    without = [k for k in range(len(model.adjusted)) if model.units[k] not in of_image]
    sizes[:, [6 + k for k in without]] = np.inf
