"""Residuals of a match (q1, q2) that need no structure, with their derivatives by vect(F)."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, jacobian

F = Input("F", (3, 3), shared=True)
Q1, Q2 = Input("q1", (2,)), Input("q2", (2,))


def homogeneous(q: Input) -> sp.Matrix:
    """Return (x, y, 1)."""
    return sp.Matrix([*q.entries(), 1])


def kernels() -> list[Kernel]:
    """Return the algebraic, point-to-epipolar-line and gradient-weighted (Sampson) residuals."""
    C = (homogeneous(Q2).T * F.matrix() * homogeneous(Q1))[0]
    line1 = F.matrix().T * homogeneous(Q2)
    line2 = F.matrix() * homogeneous(Q1)
    gradient = sp.Matrix([C]).jacobian([*Q1.entries(), *Q2.entries()])
    to_lines = [C / sp.sqrt(line[0] ** 2 + line[1] ** 2) for line in (line1, line2)]
    sampson = C / sp.sqrt(sum(entry**2 for entry in gradient))
    return [
        _residual("algebraic", "r = q'^T F q (B&S section 4).", [C]),
        _residual(
            "epipolar_distances",
            "signed distances in pixels of q to the line F^T q' and of q' to the line F q (B&S "
            "section 4, point-to-epipolar-line criterion).",
            to_lines,
        ),
        _residual(
            "sampson",
            "r = C / |dC/d(q, q')| with C = q'^T F q, in pixels (gradient-weighted criterion, B&S "
            "section 4).",
            [sampson],
        ),
    ]


def _residual(name: str, formula: str, residuals: list[sp.Expr]) -> Kernel:
    derivatives = jacobian(residuals, F.entries())
    return Kernel(
        name,
        formula,
        (F, Q1, Q2),
        (Output.of("r", residuals), Output("dr_dF", (len(residuals), 9), tuple(derivatives))),
    )
