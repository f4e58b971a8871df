"""Images of the whole sphere: longitude and latitude of the direction of sight."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.kernel import floor


def image(h: sp.Matrix, k: Vector) -> list[sp.Expr]:
    """Return the image point; the middle of the image looks along z, its top along -y."""
    width, height = k
    longitude = sp.atan2(h[0], h[2])
    latitude = sp.atan2(h[1], sp.sqrt(h[0] ** 2 + h[2] ** 2))
    return [
        width * (sp.Rational(1, 2) + longitude / (2 * sp.pi)),
        height * (sp.Rational(1, 2) + latitude / sp.pi),
    ]


def wrap(r: Vector, k: Vector) -> list[sp.Expr]:
    """Return the residual across the seam where that is shorter."""
    turns = floor(r[0] / k[0] + sp.Rational(1, 2))
    return [r[0] - k[0] * turns, r[1]]


MODEL = CameraModel(
    name="spherical",
    title="360 degree image, longitude and latitude (COLMAP's EQUIRECTANGULAR)",
    parameters={"width": "px", "height": "px"},
    image=image,
    depth=lambda h: sp.sqrt(h[0] ** 2 + h[1] ** 2 + h[2] ** 2),
    constants=("width", "height"),
    wrap=wrap,
    aliases=("EQUIRECTANGULAR",),
)
