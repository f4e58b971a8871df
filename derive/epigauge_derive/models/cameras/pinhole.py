"""Two focal lengths and the principal point, no distortion."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    fx, fy, cx, cy = k
    return [fx * h[0] / h[2] + cx, fy * h[1] / h[2] + cy]


MODEL = CameraModel(
    name="PINHOLE",
    title="two focal lengths and the principal point, no distortion (COLMAP)",
    parameters={"fx": "px", "fy": "px", "cx": "px", "cy": "px"},
    image=image,
    aliases=("pinhole",),
)
