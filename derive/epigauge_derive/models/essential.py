"""Essential matrices: a minimal update by rotation and translation, and the five-point equations.

E = U diag(1, 1, 0) V^T with rotations U, V is the essential matrix [t]_x R of t = u3 and R = U W
V^T, W the quarter turn about the third axis (or its inverse: the twisted pair). The update turns R
about fixed t, or moves t while R stays *exactly*. Moving both epipoles by one another's Euler
angles, as the orthonormal representation does, turns R by the square of the step: nothing in a wide
field of view, but f step^2 pixels in a narrow one, where t is known to a tenth of a radian only.
"""

from __future__ import annotations

import itertools

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, derivatives_at
from epigauge_derive.models.orthonormal import canonical_camera, fundamental
from epigauge_derive.models.rotations import euler_rotation

U, V, DELTA = Input("U", (3, 3)), Input("V", (3, 3)), Input("delta", (5,))
FACTORS = (U, V)
QUARTER_TURN = sp.Matrix([[0, -1, 0], [1, 0, 0], [0, 0, 1]])


def updated() -> tuple[sp.Matrix, sp.Matrix]:
    """Return (U B, V A W^T B W) with A = R(a1, a2, a3), B = R(b1, b2, 0).

    Then R = U W V^T becomes U W A^T V^T, without b, and t = u3 becomes U B e3, without a.
    """
    a1, a2, a3, b1, b2 = DELTA.entries()
    moved = euler_rotation([b1, b2, 0])
    turned = euler_rotation([a1, a2, a3]) * QUARTER_TURN.T * moved * QUARTER_TURN
    return U.matrix() * moved, V.matrix() * turned


def constraints(E: sp.Matrix) -> list[sp.Expr]:
    """Return what is zero for essential matrices: 2 E E^T E - tr(E E^T) E, and det E."""
    return [*(2 * E * E.T * E - (E * E.T).trace() * E), E.det(method="berkowitz")]


def polarized(A: sp.Matrix, B: sp.Matrix, C: sp.Matrix) -> list[sp.Expr]:
    """Return the symmetric trilinear form of the cubic `constraints`: c(A, A, A) = c(A).

    By polarisation, the signed sum of c over the sums of A, B, C, divided by 3!.
    """
    matrices = (A, B, C)
    sums = [sp.S.Zero] * 10
    for count in range(1, 4):
        for some in itertools.combinations(matrices, count):
            values = constraints(sum(some[1:], some[0]))
            sums = [s + (-1) ** (3 - count) * v for s, v in zip(sums, values, strict=True)]
    return [sp.expand(s) / 6 for s in sums]


def kernels() -> list[Kernel]:
    """Return F and P' with their derivatives, the update, and the five-point equations."""
    plain = (U.matrix(), V.matrix(), sp.S.One)
    delta = DELTA.entries()
    still = dict.fromkeys(delta, 0)
    u_new, v_new = updated()
    dF, d2F = derivatives_at(list(fundamental(u_new, v_new, sp.S.One)), delta, still)
    dP2, _ = derivatives_at(list(canonical_camera(u_new, v_new, sp.S.One)), delta, still)
    members = tuple(Input(name, (3, 3)) for name in "ABC")
    return [
        Kernel(
            "essential_derivatives",
            "E = u1 v1^T + u2 v2^T with first and second derivatives of vect(E) by the five update "
            "parameters (three that turn R about fixed t, two that move t), at no update.",
            FACTORS,
            (
                Output.of("F", fundamental(*plain)),
                Output.of("dF", dF),
                Output.of("d2F", d2F),
            ),
        ),
        Kernel(
            "essential_camera_derivatives",
            "canonic P' = (u2 v1^T - u1 v2^T | u3) and d vect(P') by the five update parameters.",
            FACTORS,
            (Output.of("P2", canonical_camera(*plain)), Output.of("dP2", dP2)),
        ),
        Kernel(
            "essential_retract",
            "U <- U B, V <- V A W^T B W with A = R(a), B = R(b1, b2, 0), W the quarter turn.",
            (*FACTORS, DELTA),
            (Output.of("U_new", u_new), Output.of("V_new", v_new)),
        ),
        Kernel(
            "essential_constraints",
            "symmetric trilinear form whose diagonal is (2 E E^T E - tr(E E^T) E, det E), zero for "
            "essential matrices: the coefficients of the five-point equations.",
            members,
            (Output.of("c", sp.Matrix(polarized(*(m.matrix() for m in members)))),),
        ),
    ]
