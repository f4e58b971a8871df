"""The pseudo object space error: bilinear in camera and point, and with no pole at depth zero."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, jacobian


def pseudo_object_space(P: sp.Matrix, X: sp.Matrix, q: sp.Matrix, eta: sp.Symbol) -> sp.Matrix:
    """Return the four residuals of a point (X, 1), 0 < eta <= 1.

    Their squares are (1 - eta) |p12 - p3 q|^2, the reprojection error times the depth, and
    eta |p12 - q|^2, that of an affine camera, with (p12, p3) = P (X, 1).
    """
    h = P * X.col_join(sp.Matrix([1]))
    image = sp.Matrix([h[0], h[1]])
    return (sp.sqrt(1 - eta) * (image - h[2] * q)).col_join(sp.sqrt(eta) * (image - q))


def kernels() -> list[Kernel]:
    """Return the residuals with their Jacobians by vect(P) and X."""
    eta, P = Input("eta", shared=True), Input("P", (3, 4))
    X, q = Input("X", (3,)), Input("q", (2,))
    r = list(pseudo_object_space(P.matrix(), X.matrix(), q.matrix(), eta.symbol()))
    return [
        Kernel(
            "pseudo_object_space",
            "residuals sqrt(1 - eta) (p12 - p3 q) and sqrt(eta) (p12 - q) with (p12, p3) = "
            "P (X, 1), and their Jacobians by vect(P) and X (pOSE; J. H. Hong, C. Zach, CVPR "
            "2018).",
            (eta, P, X, q),
            (
                Output.of("r", r),
                Output.of("J_P", jacobian(r, P.entries())),
                Output.of("J_X", jacobian(r, X.entries())),
            ),
        )
    ]
