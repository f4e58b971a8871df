"""The camera of photogrammetry (Brown): it looks along -z, y is up, c is the camera constant."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import balanced, direction, tangential


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    c, x0, y0, A1, A2, A3, B1, B2, C1, C2, R0 = k
    u, v = direction(h)
    x, y = -c * u, -c * v
    radial = balanced(x**2 + y**2, (A1, A2, A3), R0)
    shift = tangential(x, y, B2, B1)
    return [
        x0 + x * (1 + radial) + shift[0] + C1 * x + C2 * y,
        y0 + y * (1 + radial) + shift[1],
    ]


MODEL = CameraModel(
    name="brown",
    title="balanced radial A, tangential B, affine C distortion, looking along -z (photogrammetry)",
    parameters={
        "c": "mm",
        "x0": "mm",
        "y0": "mm",
        "A1": "1/mm2",
        "A2": "1/mm4",
        "A3": "1/mm6",
        "B1": "1/mm",
        "B2": "1/mm",
        "C1": "1",
        "C2": "1",
        "R0": "mm",
    },
    image=image,
    depth=lambda h: -h[2],
    constants=("R0",),
)
