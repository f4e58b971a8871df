"""A fisheye lens: the distance from the centre is a polynomial of the angle of sight."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import fisheye


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    fx, fy, cx, cy, *coefficients = k
    u, v = fisheye(h, coefficients)
    return [fx * u + cx, fy * v + cy]


MODEL = CameraModel(
    name="OPENCV_FISHEYE",
    title="fisheye, four coefficients of the angle of sight (COLMAP, OpenCV)",
    parameters={
        "fx": "px",
        "fy": "px",
        "cx": "px",
        "cy": "px",
        "k1": "1",
        "k2": "1",
        "k3": "1",
        "k4": "1",
    },
    image=image,
)
