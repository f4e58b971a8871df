"""One focal length and two coefficients of radial distortion."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import direction, polynomial


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    f, cx, cy, k1, k2 = k
    u, v = direction(h)
    scale = f * polynomial(u**2 + v**2, [k1, k2])
    return [scale * u + cx, scale * v + cy]


MODEL = CameraModel(
    name="RADIAL",
    title="one focal length, two coefficients of radial distortion (COLMAP)",
    parameters={"f": "px", "cx": "px", "cy": "px", "k1": "1", "k2": "1"},
    image=image,
)
