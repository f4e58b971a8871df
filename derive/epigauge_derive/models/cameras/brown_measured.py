"""The camera of photogrammetry as `brown`, with the lens corrected on the measured side."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Vector
from epigauge_derive.lenses import balanced, direction, tangential
from epigauge_derive.models.cameras.brown import MODEL as BROWN


def image(h: sp.Matrix, k: Vector) -> Sequence[sp.Expr]:
    """Return the image point of an ideal lens."""
    c, x0, y0 = k[:3]
    u, v = direction(h)
    return [x0 - c * u, y0 - c * v]


def correct(q: Vector, k: Vector) -> Sequence[sp.Expr]:
    """Return a measured point with the correction added (D. C. Brown, 1971)."""
    _, x0, y0, *lens, R0 = k
    A, (B1, B2, C1, C2) = lens[:3], lens[3:]
    x, y = q[0] - x0, q[1] - y0
    radial = balanced(x**2 + y**2, A, R0)
    shift = tangential(x, y, B2, B1)
    return [q[0] + x * radial + shift[0] + C1 * x + C2 * y, q[1] + y * radial + shift[1]]


MODEL = CameraModel(
    name="brown_measured",
    title="as brown, with the distortion a polynomial of the measured point, which it corrects",
    parameters=BROWN.parameters,
    image=image,
    depth=BROWN.depth,
    constants=BROWN.constants,
    correct=correct,
)
