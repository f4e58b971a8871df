"""The affine camera: parallel sight, a 2x4 matrix; the last row of the camera is 0 0 0 1."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import CameraModel, Frame, Vector

ENTRIES = tuple(f"P{i}{j}" for i in range(3) for j in range(4))


def act(h: sp.Matrix, X: sp.Matrix, delta: Vector) -> sp.Matrix:
    """Return what is seen with delta, row by row, added to the first two rows."""
    return h + sp.Matrix(2, 4, delta).col_join(sp.zeros(1, 4)) * X


MODEL = CameraModel(
    name="affine",
    title="q_hat = the first two rows of P (X, 1); everything is in front",
    parameters={},
    image=lambda h, k: [h[0], h[1]],
    depth=lambda h: sp.S.One,
    frame=Frame(
        entries=ENTRIES,
        unknowns=dict.fromkeys((f"d{name}" for name in ENTRIES[:8]), "1"),
        point_size=3,
        act=act,
        seen=lambda P, B: P * B,
    ),
)
