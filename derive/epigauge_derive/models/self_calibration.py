"""Self-calibration: what cameras known up to a projective basis say of their intrinsics.

A camera P sees the dual absolute quadric as the dual image of the absolute conic, K K^T ~ P Omega
P^T. With P = (A | a) in a metric basis, Omega = diag(1, 1, 1, 0) and K K^T ~ A A^T. Two views with
known principal points have closed forms for both focal lengths (S. Bougnoux, ICCV 1998).
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Output, at, cross, jacobian, log1p, upper

P = Input("P", (3, 4))
UPDATE = Input("delta", (8,))


def dual_image(camera: sp.Matrix, quadric: sp.Matrix) -> sp.Matrix:
    """Return P Omega P^T."""
    return camera * quadric * camera.T


def intrinsics(omega: sp.Matrix) -> list[sp.Expr]:
    """Return (log f, log fx / fy, skew, cx, cy) of K K^T ~ omega; the skew is nearly an angle."""
    w = omega / omega[2, 2]
    cx, cy = w[0, 2], w[1, 2]
    xx, yy, xy = w[0, 0] - cx**2, w[1, 1] - cy**2, w[0, 1] - cx * cy
    return [log1p(xx * yy - 1) / 4, log1p(xx / yy - 1) / 2, xy / sp.sqrt(xx * yy), cx, cy]


def updated(camera: sp.Matrix) -> sp.Matrix:
    """Return the first three columns of P (U, 0; p^T, 1), U = 1 + an upper triangle with 0 last.

    Eight numbers: five of the frame's intrinsics, three of the plane at infinity.
    """
    d = UPDATE.entries()
    frame = sp.eye(3) + sp.Matrix([[d[0], d[1], d[2]], [0, d[3], d[4]], [0, 0, 0]])
    return camera[:, :3] * frame + camera[:, 3] * sp.Matrix([d[5:]])


def focal_squared(F: sp.Matrix, right: sp.Matrix) -> sp.Expr:
    """Return f^2 of the first camera, principal points in the origins (Bougnoux's formula).

    cof(F) = e' e^T up to scale for the epipoles F e = 0, F^T e' = 0, so that cof(F) `right` is e'
    for any vector but those orthogonal to e; its scale cancels.
    """
    p = sp.Matrix([0, 0, 1])
    flat = sp.diag(1, 1, 0)
    cofactors = sp.Matrix(3, 3, lambda i, j: F.cofactor(i, j))
    line = p.T * cross(list(cofactors * right)) * flat
    above = (line * F * p)[0] * (p.T * F.T * p)[0]
    return -above / (line * F * flat * F.T * p)[0]


def difference(F: sp.Matrix, f: sp.Expr) -> sp.Expr:
    """Return ((a - b) / (a + b))^2 of the squares a, b of the singular values of E = K F K.

    They are equal where both cameras have the focal length f. With E of rank two, a + b and
    a^2 + b^2 are traces of E E^T and of its square.
    """
    K = sp.diag(f, f, 1)
    E = K * F * K
    S = E * E.T
    return 2 * (S * S).trace() / S.trace() ** 2 - 1


def kernels() -> list[Kernel]:
    """Return the linear rows, the intrinsics with their derivatives, and the two-view formulas."""
    camera = P.matrix()
    unknown = sp.Matrix(4, 4, lambda i, j: sp.Symbol(f"o{min(i, j)}{max(i, j)}", real=True))
    seen = upper(dual_image(camera, unknown).expand())
    delta = UPDATE.entries()
    still = dict.fromkeys(delta, 0)
    moved = updated(camera)
    values = intrinsics(moved * moved.T)
    F, e1, e2 = Input("F", (3, 3)), Input("e1", (3,)), Input("e2", (3,))
    c1, c2 = Input("c1", (2,)), Input("c2", (2,))
    shifts = [
        sp.Matrix([[1, 0, c[0]], [0, 1, c[1]], [0, 0, 1]]) for c in (c1.matrix(), c2.matrix())
    ]
    centred = shifts[1].T * F.matrix() * shifts[0]
    # Differentiated by the entries of F about the principal points, then by the chain rule.
    G = sp.Matrix(3, 3, lambda i, j: sp.Symbol(f"G{i}{j}", real=True))
    about = dict(zip(G, centred, strict=True))
    squares = [focal_squared(G, e1.matrix()), focal_squared(G.T, e2.matrix())]
    by_G = jacobian(squares, list(G))
    slopes = sp.Matrix(2, 9, lambda i, j: sp.Symbol(f"slope{i}_{j}", real=True))
    named = dict(zip(slopes, by_G, strict=True))
    # By log f: one curvature at all scales.
    f = Input("f")
    focal = f.entries()[0]
    apart = difference(G, focal)
    slope = focal * sp.diff(apart, focal)
    along = sp.Matrix(1, 9, lambda i, j: sp.Symbol(f"along{j}", real=True))
    by_slope = dict(zip(along, jacobian([slope], list(G)), strict=True))
    return [
        Kernel(
            "shared_focal",
            "((a - b) / (a + b))^2 of the squared singular values of E = K F K, zero where both "
            "cameras have the focal length f (P. Sturm, 2001), with its first and second "
            "derivatives by log f, and those of the first by vect(F) and both principal points.",
            (F, c1, c2, f),
            (
                Output.of("difference", [apart]),
                Output.of("slope", [slope]),
                Output.of("curvature", [focal * sp.diff(slope, focal)]),
                Output.of("J_F", along * jacobian(list(centred), F.entries())),
                Output.of("J_c", along * jacobian(list(centred), [*c1.entries(), *c2.entries()])),
            ),
            (Let(about), Let(by_slope)),
        ),
        Kernel(
            "dual_image_rows",
            "coefficients of P Omega P^T (upper triangle) by the upper triangle of the dual "
            "absolute quadric Omega.",
            (P,),
            (Output.of("rows", jacobian(seen, upper(unknown))),),
        ),
        Kernel(
            "camera_intrinsics",
            "(log f, log fx / fy, skew, cx, cy) of a camera P = (A | a) in a metric basis, A A^T ~ "
            "K K^T, and their Jacobian by the update P (U, 0; p^T, 1) of the basis: five numbers "
            "of U, three of the plane at infinity.",
            (P,),
            (
                Output.of("values", [at(value, still) for value in values]),
                Output.of("J", at(jacobian(values, delta), still)),
            ),
        ),
        Kernel(
            "two_view_focals",
            "squared focal lengths of two cameras from F and their principal points (Bougnoux, "
            "1998), with Jacobians by vect(F) and by both points; e1, e2: the epipoles in "
            "coordinates about the principal points, as directions only.",
            (F, c1, c2, e1, e2),
            (
                Output.of("squares", squares),
                Output.of("J_F", slopes * jacobian(list(centred), F.entries())),
                Output.of("J_c", slopes * jacobian(list(centred), [*c1.entries(), *c2.entries()])),
            ),
            (Let(about), Let(named)),
        ),
    ]
