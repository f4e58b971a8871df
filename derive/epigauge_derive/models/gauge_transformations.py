"""What a change of gauge does to the parameters, and to the damping: B03 eqs. (5), (8) and (9).

Inputs are P' = gamma P T and Q' = alpha T^-1 Q (B03 section 4.1). T~ is their Jacobian by the
parameters (eq. 5), and W' = T~^-T W T~^-1 (eq. 8) with W = I gives eq. (9).
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, jacobian

T, INVERSE = Input("T", (4, 4)), Input("inverse", (4, 4))
GAMMA, ALPHA = Input("gamma"), Input("alpha")


def camera_block(T: sp.Matrix, gamma: sp.Expr) -> sp.Matrix:
    """Return the block of T~ that acts on vect(P): d vect(gamma P T) / d vect(P)."""
    P = Input("P", (3, 4))
    return jacobian(list(gamma * P.matrix() * T), P.entries())


def point_block(inverse: sp.Matrix, alpha: sp.Expr) -> sp.Matrix:
    """Return the block of T~ that acts on Q: d (alpha T^-1 Q) / d Q."""
    Q = Input("Q", (4,))
    return jacobian(list(alpha * inverse * Q.matrix()), Q.entries())


def moved_damping(W: sp.Matrix, back: sp.Matrix) -> sp.Matrix:
    """Return W' = T~^-T W T~^-1 (B03 eq. 8) from a block of W and one of T~^-1."""
    return back.T * W * back


def kernels() -> list[Kernel]:
    """Return the blocks of T~, and of the damping that acts as the identity does elsewhere."""
    matrix, inverse, gamma, alpha = T.matrix(), INVERSE.matrix(), GAMMA.symbol(), ALPHA.symbol()
    # The change back has T^-1, 1 / gamma and 1 / alpha.
    camera_back, point_back = camera_block(inverse, 1 / gamma), point_block(matrix, 1 / alpha)
    return [
        Kernel(
            "camera_transformation",
            "block of T~ that acts on vect(P), P' = gamma P T (B03 eq. 5).",
            (T, GAMMA),
            (Output.of("block", camera_block(matrix, gamma)),),
        ),
        Kernel(
            "point_transformation",
            "block of T~ that acts on Q, Q' = alpha T^-1 Q (B03 eq. 5); `inverse` is T^-1.",
            (INVERSE, ALPHA),
            (Output.of("block", point_block(inverse, alpha)),),
        ),
        Kernel(
            "implicit_damping",
            "W' = T~^-T T~^-1 for a camera and a point, the damping that acts in the gauge T leads "
            "to as the identity in the one it comes from (B03 eqs. 8, 9; by them gamma^-2 A^-1 and "
            "alpha^-2 A, A = T^T T); `inverse` is T^-1.",
            (T, INVERSE, GAMMA, ALPHA),
            (
                Output.of("camera", moved_damping(sp.eye(12), camera_back)),
                Output.of("point", moved_damping(sp.eye(4), point_back)),
            ),
        ),
    ]
