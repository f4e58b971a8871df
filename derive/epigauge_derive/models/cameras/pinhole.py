"""Two focal lengths and the principal point, no distortion."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import direction


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    fx, fy, cx, cy = k
    u, v = direction(h)
    return [fx * u + cx, fy * v + cy]


MODEL = CameraModel(
    name="PINHOLE",
    title="two focal lengths and the principal point, no distortion (COLMAP)",
    parameters={"fx": "px", "fy": "px", "cx": "px", "cy": "px"},
    image=image,
    aliases=("pinhole",),
)
