"""A seven-parameter chart of the fundamental matrix that is regular at sigma = 1.

F = U12 M V12^T with the first two columns of U and V and a 2x2 matrix M of unit norm. The epipoles
move by rotations about the first two axes, as in the orthonormal representation; M moves in its
tangent plane. Rank 7 everywhere, and the parts of B&S section 4.4 are still separate parameters.
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, derivatives_at
from epigauge_derive.models.orthonormal import camera_of
from epigauge_derive.models.rotations import euler_rotation

U, V, M = Input("U", (3, 3)), Input("V", (3, 3)), Input("M", (2, 2))
DELTA = Input("delta", (7,))
FACTORS = (U, V, M)


def tangent(m: sp.Matrix) -> sp.Matrix:
    """Return an orthonormal basis (4, 3) of the tangent plane at a unit vector of R^4.

    The products of a quaternion with i, j, k: orthogonal to it and to each other.
    """
    a, b, c, d = m
    return sp.Matrix([[-b, -c, -d], [a, d, -c], [-d, a, b], [c, -b, a]])


def updated() -> tuple[sp.Matrix, sp.Matrix, sp.Matrix]:
    """Return U R(x1, x2, 0), V R(y1, y2, 0) and M moved in its tangent plane, of unit norm."""
    x1, x2, y1, y2, *in_plane = DELTA.entries()
    entries = sp.Matrix(list(M.matrix()))
    moved = entries + tangent(entries) * sp.Matrix(in_plane)
    # |moved|^2 = |M|^2 + |in_plane|^2, and M has unit norm.
    length = sp.sqrt(1 + sum(p**2 for p in in_plane))
    return (
        U.matrix() * euler_rotation([x1, x2, 0]),
        V.matrix() * euler_rotation([y1, y2, 0]),
        sp.Matrix(2, 2, list(moved / length)),
    )


def fundamental(u: sp.Matrix, v: sp.Matrix, m: sp.Matrix) -> sp.Matrix:
    """Return F = U12 M V12^T."""
    return u[:, :2] * m * v[:, :2].T


def canonical_camera(u: sp.Matrix, v: sp.Matrix, m: sp.Matrix) -> sp.Matrix:
    """Return P' = ([e']_x F | e'); B&S eq. (5) is the case M = diag(1, sigma)."""
    return camera_of(u, sp.diag(m, 0), v)


def kernels() -> list[Kernel]:
    """Return F and P' with their derivatives, and the update."""
    plain = (U.matrix(), V.matrix(), M.matrix())
    delta = DELTA.entries()
    still = dict.fromkeys(delta, 0)
    dF, d2F = derivatives_at(list(fundamental(*updated())), delta, still)
    dP2, _ = derivatives_at(list(canonical_camera(*updated())), delta, still)
    u_new, v_new, m_new = updated()
    return [
        Kernel(
            "block_fundamental",
            "F = U12 M V12^T.",
            FACTORS,
            (Output.of("F", fundamental(*plain)),),
        ),
        Kernel(
            "block_derivatives",
            "F = U12 M V12^T with first and second derivatives of vect(F) by the seven update "
            "parameters (x1, x2, y1, y2, and three of M), at no update.",
            FACTORS,
            (
                Output.of("F", fundamental(*plain)),
                Output.of("dF", dF),
                Output.of("d2F", d2F),
            ),
        ),
        Kernel(
            "block_camera_derivatives",
            "canonic P' of F = U12 M V12^T and d vect(P') by the seven update parameters.",
            FACTORS,
            (Output.of("P2", canonical_camera(*plain)), Output.of("dP2", dP2)),
        ),
        Kernel(
            "block_retract",
            "U <- U R(x1, x2, 0), V <- V R(y1, y2, 0), M moved in its tangent plane.",
            (*FACTORS, DELTA),
            (Output.of("U_new", u_new), Output.of("V_new", v_new), Output.of("M_new", m_new)),
        ),
    ]
