"""The 36 minimal parameterisations by epipoles and epipolar transformation (MAPS).

Each homogeneous entity, e, e' and the 2x2 epipolar transformation, has one entry frozen to one:
3 * 3 * 4 charts (B&S section 2, after Zhang). The chart that freezes the last entry of both
epipoles is derived as the paper's references write it; permuting the axes of each image gives the
others.
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, derivatives_at

PARAMETERS = Input("parameters", (7,))


def chart(frozen1: int, frozen2: int, frozen: int) -> tuple[sp.Matrix, sp.Matrix]:
    """Return F and P' = ([e']_x F | e') as functions of the seven parameters.

    Parameters
    ----------
    frozen1, frozen2 : int
        Entry of e and of e' that is one.
    frozen : int
        Entry of the transformation (a, b, c, d) that is one.

    The parameters are the two free entries of e, those of e', and the three of (a, b, c, d).
    """
    x, y, x_, y_, *free = PARAMETERS.entries()
    free.insert(frozen, sp.S.One)
    a, b, c, d = free
    e, e_ = [x, y], [x_, y_]
    e.insert(frozen1, sp.S.One)
    e_.insert(frozen2, sp.S.One)
    inner = sp.Matrix([[a, b], [c, d]])
    F = sp.zeros(3, 3)
    axes1 = [k for k in range(3) if k != frozen1]
    axes2 = [k for k in range(3) if k != frozen2]
    for i, row in enumerate(axes2):
        for j, column in enumerate(axes1):
            F[row, column] = inner[i, j]
        # F e = 0 and F^T e' = 0 give the row and the column of the frozen entries.
        F[row, frozen1] = -sum(F[row, column] * e[column] for column in axes1)
    for column in range(3):
        F[frozen2, column] = -sum(F[row, column] * e_[row] for row in axes2)
    cross = sp.Matrix([[0, -e_[2], e_[1]], [e_[2], 0, -e_[0]], [-e_[1], e_[0], 0]])
    return F.expand(), (cross * F).expand().row_join(sp.Matrix(e_))


def kernels() -> list[Kernel]:
    """Return one kernel a chart: F and P' with their derivatives by the seven parameters."""
    made = []
    parameters = PARAMETERS.entries()
    for number in range(36):
        frozen1, frozen2, frozen = number // 12, number // 4 % 3, number % 4
        F, P2 = chart(frozen1, frozen2, frozen)
        dF, d2F = derivatives_at(list(F), parameters, {})
        dP2, _ = derivatives_at(list(P2), parameters, {})
        made.append(
            Kernel(
                f"maps_{frozen1}{frozen2}{frozen}",
                f"F and P' by epipoles with entries {frozen1} of e and {frozen2} of e' and entry "
                f"{frozen} of the epipolar transformation frozen to one (MAPS, B&S section 2).",
                (PARAMETERS,),
                (
                    Output.of("F", F),
                    Output.of("dF", dF),
                    Output.of("d2F", d2F),
                    Output.of("P2", P2),
                    Output.of("dP2", dP2),
                ),
            )
        )
    return made
