"""Radial and tangential distortion as OpenCV's plain model has them."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import direction, polynomial, tangential


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    fx, fy, cx, cy, k1, k2, p1, p2 = k
    u, v = direction(h)
    scale = polynomial(u**2 + v**2, [k1, k2])
    shift = tangential(u, v, p1, p2)
    return [fx * (scale * u + shift[0]) + cx, fy * (scale * v + shift[1]) + cy]


MODEL = CameraModel(
    name="OPENCV",
    title="two radial and two tangential coefficients (COLMAP, OpenCV)",
    parameters={
        "fx": "px",
        "fy": "px",
        "cx": "px",
        "cy": "px",
        "k1": "1",
        "k2": "1",
        "p1": "1",
        "p2": "1",
    },
    image=image,
)
