"""The projective camera: 3x4 matrix, homogeneous point, projection with Jacobians."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, jacobian


def project(P: sp.Matrix, Q: sp.Matrix) -> sp.Matrix:
    """Return the image point of Q by P, q_hat ~ P Q (B03 section 3)."""
    h = P * Q
    return sp.Matrix([h[0] / h[2], h[1] / h[2]])


def kernels() -> list[Kernel]:
    """Return the projection with its Jacobians by vect(P) and Q, and the two-view residual."""
    P, Q = Input("P", (3, 4)), Input("Q", (4,))
    q_hat = project(P.matrix(), Q.matrix())
    depth = (P.matrix() * Q.matrix())[2]
    return [
        Kernel(
            "project",
            "projection of Q by P, its Jacobians by vect(P) and by Q, and the homogeneous scale "
            "(depth) p3^T Q (B03 section 3).",
            (P, Q),
            (
                Output.of("q_hat", q_hat),
                Output.of("J_P", jacobian(list(q_hat), P.entries())),
                Output.of("J_Q", jacobian(list(q_hat), Q.entries())),
                Output.of("depth", depth),
            ),
        ),
        Kernel(
            "log_depth_derivatives",
            "derivatives of log(p3^T Q) by vect(P) and by Q; a gauge transformation only adds a "
            "constant to this logarithm.",
            (P, Q),
            (
                Output.of("Z_P", derivative_of_log(depth, P.entries())),
                Output.of("Z_Q", derivative_of_log(depth, Q.entries())),
            ),
        ),
        *_generators(P, Q),
        _two_view_structure(),
    ]


def derivative_of_log(value: sp.Expr, variables: list[sp.Symbol]) -> list[sp.Expr]:
    """Differentiate log |value|."""
    return [sp.diff(value, variable) / value for variable in variables]


def _generators(P: Input, Q: Input) -> list[Kernel]:
    """Return the directions in which a change of basis moves a camera and a point.

    P exp(E) and exp(-E) Q to first order, for the sixteen entries of E: with the scales they span
    the null space of the normal equations.
    """
    E = sp.Matrix(4, 4, lambda i, j: sp.Symbol(f"E{i}{j}", real=True))
    camera = P.matrix() * (sp.eye(4) + E)
    point = (sp.eye(4) - E) * Q.matrix()
    return [
        Kernel(
            f"{name}_generators",
            f"derivatives of {what} by the entries of E, at E = 0 (generators of B03 eq. 5).",
            (argument,),
            (Output.of("G", jacobian(list(moved), list(E))),),
        )
        for name, what, argument, moved in (
            ("camera", "vect(P exp(E))", P, camera),
            ("point", "exp(-E) Q", Q, point),
        )
    ]


def _two_view_structure() -> Kernel:
    """Return r = q - q_hat for P = (I | 0), P' and a point (a, b, 1, c), with Jacobian blocks."""
    P2 = Input("P2", (3, 4), shared=True)
    S, q1, q2 = Input("S", (3,)), Input("q1", (2,)), Input("q2", (2,))
    a, b, c = S.entries()
    Q = sp.Matrix([a, b, 1, c])
    first = q1.matrix() - project(sp.eye(3).row_join(sp.zeros(3, 1)), Q)
    second = q2.matrix() - project(P2.matrix(), Q)
    r = [*first, *second]
    return Kernel(
        "two_view_structure",
        "residual r = q - q_hat of a point (a, b, 1, c) in P = (I | 0) and P', its Jacobian by "
        "the point, and that of the second image by vect(P') (B&S sections 4.1, 4.3, 5).",
        (P2, S, q1, q2),
        (
            Output.of("r", r),
            Output.of("J_S", jacobian(r, S.entries())),
            Output.of("J_P2", jacobian(list(second), P2.entries())),
        ),
    )
