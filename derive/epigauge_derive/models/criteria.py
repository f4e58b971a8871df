"""Residuals of a match (q1, q2) that need no structure, with their derivatives by vect(F)."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, jacobian, upper

F = Input("F", (3, 3), shared=True)
Q1, Q2 = Input("q1", (2,)), Input("q2", (2,))


def homogeneous(q: Input) -> sp.Matrix:
    """Return (x, y, 1)."""
    return sp.Matrix([*q.entries(), 1])


def constraint() -> sp.Expr:
    """Return C = q'^T F q."""
    return (homogeneous(Q2).T * F.matrix() * homogeneous(Q1))[0]


def epipolar() -> list[sp.Expr]:
    """Return the signed distances of q to the line F^T q' and of q' to the line F q."""
    lines = (F.matrix().T * homogeneous(Q2), F.matrix() * homogeneous(Q1))
    return [constraint() / sp.sqrt(line[0] ** 2 + line[1] ** 2) for line in lines]


def sampson() -> list[sp.Expr]:
    """Return C over the length of its gradient by the match."""
    C = constraint()
    gradient = [sp.diff(C, entry) for entry in (*Q1.entries(), *Q2.entries())]
    return [C / sp.sqrt(sum(entry**2 for entry in gradient))]


def kernels() -> list[Kernel]:
    """Return residuals, and for the geometric ones what the solver sums up."""
    lines = (
        "signed distances in pixels of q to the line F^T q' and of q' to the line F q (B&S "
        "section 4, point-to-epipolar-line criterion)."
    )
    weighted = (
        "r = C / |dC/d(q, q')| with C = q'^T F q, in pixels (gradient-weighted criterion, B&S "
        "section 4)."
    )
    return [
        _residual("algebraic", "r = q'^T F q (B&S section 4).", [constraint()]),
        *_eight_point(),
        _residual("epipolar", lines, epipolar()),
        *_normal_equations("epipolar", epipolar()),
        _residual("sampson", weighted, sampson()),
        *_normal_equations("sampson", sampson()),
    ]


def _residual(name: str, formula: str, residuals: list[sp.Expr]) -> Kernel:
    derivatives = jacobian(residuals, F.entries())
    shape = (len(residuals), 9)
    outputs = (Output.of("r", residuals), Output("dr_dF", shape, tuple(derivatives)))
    return Kernel(name, formula, (F, Q1, Q2), outputs)


def _eight_point() -> list[Kernel]:
    """Return A^T A of the linear equations A vect(F) = 0, and its product with vect(F)."""
    weight = Input("weight")
    row = jacobian([constraint()], F.entries())
    normal = Output.of("N", upper(weight.symbol() * row.T * row), summed=True)
    product = Output.of("g", weight.symbol() * constraint() * row.T, summed=True)
    return [
        Kernel(
            "algebraic_normal",
            "A^T A (upper triangle) of the equations A vect(F) = 0 of the 8-point algorithm, a "
            "row of A being d(q'^T F q) / d vect(F).",
            (Q1, Q2, weight),
            (normal,),
        ),
        Kernel(
            "algebraic_gradient",
            "A^T A vect(F), from the residuals q'^T F q and not from A^T A (8-point algorithm).",
            (F, Q1, Q2, weight),
            (product,),
        ),
    ]


def _normal_equations(name: str, residuals: list[sp.Expr]) -> list[Kernel]:
    """Return gradient with Gauss-Newton matrix, and with exact Hessian, of a robust sum.

    The cost of a match is rho(s) / 2 with s the sum of its squared residuals: `weight` is rho' and
    `curvature` 2 rho'', which multiplies the square of ds/dF / 2.
    """
    weight, curvature = Input("weight"), Input("curvature")
    first = jacobian(residuals, F.entries())
    half = first.T * sp.Matrix(residuals)
    gauss_newton = first.T * first
    second = gauss_newton.copy()
    for r, row in zip(residuals, first.tolist(), strict=True):
        second += r * jacobian(row, F.entries())
    exact = weight.symbol() * second + curvature.symbol() * half * half.T
    gradient = Output.of("g", weight.symbol() * half, summed=True)
    normal = Output.of("N", upper(weight.symbol() * gauss_newton), summed=True)
    squared = sum(r**2 for r in residuals)
    cost = Output.of("cost", weight.symbol() * squared / 2, summed=True)
    arguments = (F, Q1, Q2, weight)
    return [
        Kernel(
            f"{name}_gauss_newton",
            f"half the weighted sum of squared {name} residuals, its gradient and Gauss-Newton "
            "matrix (upper triangle) by vect(F).",
            arguments,
            (cost, gradient, normal),
        ),
        Kernel(
            f"{name}_newton",
            f"half the weighted sum of squared {name} residuals, and by vect(F) the gradient, the "
            "Gauss-Newton matrix and exact Hessian (upper triangles) of their robust sum, halved.",
            (*arguments, curvature),
            (cost, gradient, normal, Output.of("H", upper(exact), summed=True)),
        ),
    ]
