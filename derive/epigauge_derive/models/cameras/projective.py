"""The projective camera: any 3x4 matrix, homogeneous points (B03 section 3)."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Frame, Vector
from epigauge_derive.lenses import direction

ENTRIES = tuple(f"P{i}{j}" for i in range(3) for j in range(4))


def act(h: sp.Matrix, X: sp.Matrix, delta: Vector) -> sp.Matrix:
    """Return (P + D) X, with D = delta row by row."""
    return h + sp.Matrix(3, 4, delta) * X


MODEL = CameraModel(
    name="projective",
    title="q_hat ~ P Q (B03 section 3)",
    parameters={},
    image=lambda h, k: list(direction(h)),
    frame=Frame(
        entries=ENTRIES,
        unknowns=dict.fromkeys((f"d{name}" for name in ENTRIES), "1"),
        point_size=4,
        act=act,
        seen=lambda P, B: P * B,
    ),
)
