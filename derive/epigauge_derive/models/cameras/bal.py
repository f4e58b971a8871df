"""The camera of BAL files (Bundle Adjustment in the Large): it looks along -z, y is up."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import direction, polynomial


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point."""
    f, k1, k2 = k
    u, v = direction(h)
    scale = -f * polynomial(u**2 + v**2, [k1, k2])
    return [scale * u, scale * v]


MODEL = CameraModel(
    name="bal",
    title="one focal length, two radial coefficients, looking along -z (BAL)",
    parameters={"f": "px", "k1": "1", "k2": "1"},
    image=image,
    depth=lambda h: -h[2],
)
