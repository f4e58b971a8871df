"""One focal length and one coefficient of radial distortion."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    f, cx, cy, k1 = k
    u, v = h[0] / h[2], h[1] / h[2]
    scale = f * (1 + k1 * (u**2 + v**2))
    return [scale * u + cx, scale * v + cy]


MODEL = CameraModel(
    name="SIMPLE_RADIAL",
    title="one focal length, one coefficient of radial distortion (COLMAP)",
    parameters={"f": "px", "cx": "px", "cy": "px", "k": "1"},
    image=image,
)
