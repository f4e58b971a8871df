"""The camera of BAL files (Bundle Adjustment in the Large): it looks along -z, y is up."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point, from the image centre."""
    f, k1, k2 = k
    u, v = -h[0] / h[2], -h[1] / h[2]
    squared = u**2 + v**2
    scale = f * (1 + squared * (k1 + k2 * squared))
    return [scale * u, scale * v]


MODEL = CameraModel(
    name="bal",
    title="one focal length, two coefficients of radial distortion, looking along -z (BAL)",
    parameters={"f": "px", "k1": "1", "k2": "1"},
    image=image,
    depth=lambda h: -h[2],
)
