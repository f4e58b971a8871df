"""Scenes and networks that leave intrinsics weak: flat ones, and centres on one line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.point_blocks import Triangle
from epigauge.bundle.solve import BundleSystem
from epigauge.two_view.losses import median

__all__ = ["flat_scene", "one_line"]

Array = NDArray[np.float64]

#: Thickness of a flat scene, in standard deviations of the points across it, and over its extent.
_THICK, _THIN = 3.0, 1e-6

#: Points farther from the middle than so many median distances do not count.
_FAR = 10.0

#: Largest distance of centres from their line, over their extent along it.
_LINE = 0.01


def flat_scene(system: BundleSystem, noise_px: float) -> bool:
    """Tell whether all points lie in one plane, within what the noise makes of them."""
    X = system.points - np.median(system.points, axis=0)
    distances = np.linalg.norm(X, axis=1)
    # Points that went far away, in whatever direction, would be the only ones to have an extent.
    near = distances <= _FAR * median(distances)
    X = X[near] - X[near].mean(axis=0)
    values, axes = np.linalg.eigh(X.T @ X / len(X))
    across = Triangle.of(system.normal.V, 1e-14).energy(axes[:, :1])[near]
    noise = noise_px * np.sqrt(max(median(across), 0.0))
    thickness, extent = np.sqrt(np.maximum(values[[0, 2]], 0.0))
    return bool(thickness <= max(_THICK * noise, _THIN * extent))


def one_line(centres: Array) -> bool:
    """Tell whether three or more centres of cameras are on one line."""
    if len(centres) < 3:
        return False
    values = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    return bool(values[1] <= _LINE * values[0])
