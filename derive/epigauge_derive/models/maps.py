"""The minimal parameterisations by epipoles and epipolar transformation (MAPS).

Each homogeneous entity, e, e' and the 2x2 epipolar transformation, has one entry frozen to one:
3 * 3 * 4 charts (B&S section 2, after Zhang). One is derived, which freezes the last entry of both
epipoles and the first of the transformation. The 3! * 3! orders of the axes of both images give
all 36: with permutation matrices S of image 1 and S' of image 2, F -> S' F S^T, e -> S e,
e' -> S' e', and [S' e']_x = det(S') S' [e']_x S'^T gives the camera.
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, derivatives_at
from epigauge_derive.models.orthonormal import cross

PARAMETERS = Input("parameters", (7,))


def chart() -> tuple[sp.Matrix, sp.Matrix]:
    """Return F and e' as functions of (x, y, x', y', b, c, d).

    e = (x, y, 1) and e' = (x', y', 1) are the null vectors; (1, b; c, d) is the upper left block.
    """
    x, y, x_, y_, b, c, d = PARAMETERS.entries()
    inner = sp.Matrix([[sp.S.One, b], [c, d]])
    # F e = 0 gives the last column, F^T e' = 0 the last row.
    wide = inner.row_join(-inner * sp.Matrix([x, y]))
    F = wide.col_join(-sp.Matrix([[x_, y_]]) * wide)
    return F.expand(), sp.Matrix([x_, y_, 1])


def kernels() -> list[Kernel]:
    """Return F and P' with their derivatives by the seven parameters."""
    parameters = PARAMETERS.entries()
    F, e_ = chart()
    P2 = (cross(e_) * F).expand().row_join(e_)
    dF, d2F = derivatives_at(list(F), parameters, {})
    dP2, _ = derivatives_at(list(P2), parameters, {})
    return [
        Kernel(
            "maps",
            "F and P' = ([e']_x F | e') by the epipoles (x, y, 1), (x', y', 1) and the epipolar "
            "transformation (1, b; c, d) (MAPS, B&S section 2).",
            (PARAMETERS,),
            (
                Output.of("F", F),
                Output.of("dF", dF),
                Output.of("d2F", d2F),
                Output.of("P2", P2),
                Output.of("dP2", dP2),
            ),
        )
    ]
