"""The orthonormal representation F ~ U diag(1, sigma, 0) V^T and its minimal update (B&S 2004).

Three equations of the paper are the inputs of this model: R(theta) = Rx Ry Rz (1, in `rotations`),
F = U diag(1, sigma, 0) V^T (2) and the update of U, V, sigma (3). The rest is derived: the camera
(5) from ([e']_x F | e') (4), and the Jacobian A_perp (6, 7) by differentiating (5) through (3).
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, derivatives_at
from epigauge_derive.models.rotations import euler_rotation

U, V, SIGMA = Input("U", (3, 3)), Input("V", (3, 3)), Input("sigma")
DELTA = Input("delta", (7,))
FACTORS = (U, V, SIGMA)


def cross(v: sp.Matrix) -> sp.Matrix:
    """Return [v]_x, with [v]_x w = v x w."""
    x, y, z = v
    return sp.Matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def middle(sigma: sp.Expr) -> sp.Matrix:
    """Return diag(1, sigma, 0), the middle factor of B&S eq. (2)."""
    return sp.diag(1, sigma, 0)


def fundamental(u: sp.Matrix, v: sp.Matrix, sigma: sp.Expr) -> sp.Matrix:
    """Return F = U diag(1, sigma, 0) V^T, B&S eq. (2)."""
    return u * middle(sigma) * v.T


def camera_of(u: sp.Matrix, inner: sp.Matrix, v: sp.Matrix) -> sp.Matrix:
    """Return P' = ([e']_x F | e') of F = U inner V^T with e' = u3 (B&S eq. 4).

    For a rotation U, [U w]_x = U [w]_x U^T, and e' = U (0, 0, 1)^T, so that
    [e']_x F = U [(0, 0, 1)^T]_x inner V^T. For a U of determinant -1 this is the camera of -F.
    """
    axis = sp.Matrix([0, 0, 1])
    return (u * cross(axis) * inner * v.T).row_join(u * axis)


def canonical_camera(u: sp.Matrix, v: sp.Matrix, sigma: sp.Expr) -> sp.Matrix:
    """Return the canonic second camera of eq. (2): (u2 v1^T - sigma u1 v2^T | u3), B&S eq. (5)."""
    return camera_of(u, middle(sigma), v)


def updated() -> tuple[sp.Matrix, sp.Matrix, sp.Expr]:
    """Return (U R(x), V R(y), sigma + delta_sigma), the update of B&S eq. (3)."""
    delta = DELTA.entries()
    return (
        U.matrix() * euler_rotation(delta[:3]),
        V.matrix() * euler_rotation(delta[3:6]),
        SIGMA.symbol() + delta[6],
    )


def update_derivatives(values: sp.Matrix) -> tuple[sp.Matrix, sp.Array]:
    """Differentiate once and twice by the seven update parameters, at no update."""
    delta = DELTA.entries()
    return derivatives_at(list(values), delta, dict.fromkeys(delta, 0))


def kernels() -> list[Kernel]:
    """Return F, its derivatives, the canonic camera, A_perp and the update."""
    plain = (U.matrix(), V.matrix(), SIGMA.symbol())
    F, camera = fundamental(*updated()), canonical_camera(*updated())
    u_new, v_new, sigma_new = updated()
    dF, d2F = update_derivatives(F)
    A_perp, _ = update_derivatives(camera)
    return [
        Kernel(
            "fundamental_from_factors",
            "F = u1 v1^T + sigma u2 v2^T (B&S eq. 2).",
            FACTORS,
            (Output.of("F", fundamental(*plain)),),
        ),
        Kernel(
            "fundamental_derivatives",
            "F (B&S eq. 2) with first and second derivatives of vect(F) by the seven update "
            "parameters of B&S eq. (3), at no update.",
            FACTORS,
            (
                Output.of("F", fundamental(*plain)),
                Output.of("dF", dF),
                Output.of("d2F", d2F),
            ),
        ),
        Kernel(
            "canonical_camera",
            "P' = (u2 v1^T - sigma u1 v2^T | u3) (B&S eq. 5).",
            FACTORS,
            (Output.of("P2", canonical_camera(*plain)),),
        ),
        Kernel(
            "canonical_camera_derivatives",
            "P' (B&S eq. 5) and A_perp = d vect(P') / d (x, y, sigma), obtained by "
            "differentiating eq. (5) through the update of eq. (3) (B&S eqs. 6, 7).",
            FACTORS,
            (
                Output.of("P2", canonical_camera(*plain)),
                Output.of("A_perp", A_perp),
            ),
        ),
        Kernel(
            "retract_factors",
            "U <- U R(x), V <- V R(y), sigma <- sigma + delta_sigma (B&S eq. 3).",
            (*FACTORS, DELTA),
            (
                Output.of("U_new", u_new),
                Output.of("V_new", v_new),
                Output.of("sigma_new", sigma_new),
            ),
        ),
    ]
