"""One focal length and the principal point, no distortion."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import direction


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    f, cx, cy = k
    u, v = direction(h)
    return [f * u + cx, f * v + cy]


MODEL = CameraModel(
    name="SIMPLE_PINHOLE",
    title="one focal length and the principal point, no distortion (COLMAP)",
    parameters={"f": "px", "cx": "px", "cy": "px"},
    image=image,
)
