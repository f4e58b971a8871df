"""Homographies of matches: what a plane, or a camera that only turned, does to points."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import (
    Input,
    Kernel,
    Let,
    Loop,
    Output,
    cross,
    jacobian,
    select,
    upper,
)
from epigauge_derive.models.criteria import Q1, Q2, F, homogeneous

H = Input("H", (3, 3), shared=True)
E2 = Input("e2", (3,), shared=True)
WEIGHT = Input("weight")

#: Covariances of both points, packed by their upper triangles.
S1, S2 = Input("S1", (3,)), Input("S2", (3,))
FOOT = Input("foot", (2,))
SAMPLE1, SAMPLE2 = Input("sample1", (2, 4)), Input("sample2", (2, 4))

_TINY = sp.Float("1e-200")

#: Gauss-Newton steps to a foot point: each gains as many digits as the noise is below the size.
_STEPS = 8


def equations() -> sp.Matrix:
    """Return c = q' (h3 q) - (h1 q, h2 q), zero where H takes q to q'."""
    y = H.matrix() * homogeneous(Q1)
    return Q2.matrix() * y[2] - y[:2, :]


def kernels() -> list[Kernel]:
    """Return what a homography is fitted with, and the parallax off a plane of F."""
    return [*_fit(), *_reprojection(), _four_points(), _parallax()]


def _fit() -> list[Kernel]:
    c = equations()
    rows = jacobian(list(c), H.entries())
    by_match = jacobian(list(c), (*Q1.entries(), *Q2.entries()))
    covariance = by_match * by_match.T
    xx, xy, yy = sp.symbols("xx xy yy", real=True)
    determinant = sp.Symbol("determinant", real=True)
    inverse = sp.Matrix([[yy, -xy], [-xy, xx]]) / determinant
    plain = sp.Symbol("plain", real=True)
    given = Let({xx: covariance[0, 0], xy: covariance[0, 1], yy: covariance[1, 1]})
    product = Let({plain: xx * yy - xy**2})
    # The determinant of a homography of lower rank may vanish.
    stage = Let({determinant: select(plain - _TINY, plain, _TINY)})
    stages = (given, product, stage)
    return [
        Kernel(
            "homography_squared",
            "squared distance of a match from a homography to first order (Sampson), c^T (dc/dq "
            "dc/dq^T)^-1 c with c = q' (h3 q) - (h1 q, h2 q) and q both points.",
            (H, Q1, Q2),
            (Output.of("squared", (c.T * inverse * c)[0]),),
            stages,
        ),
        Kernel(
            "homography_normal",
            "J^T J by vect(H) (upper triangle) of distances from a homography, (dc/dH)^T (dc/dq "
            "dc/dq^T)^-1 dc/dH with c = q' (h3 q) - (h1 q, h2 q) and q both points.",
            (H, Q1, Q2, WEIGHT),
            (Output.of("N", upper(WEIGHT.symbol() * rows.T * inverse * rows), summed=True),),
            stages,
        ),
    ]


def _symmetric(packed: Input) -> sp.Matrix:
    xx, xy, yy = packed.entries()
    return sp.Matrix([[xx, xy], [xy, yy]])


def _inverse(matrix: sp.Matrix) -> sp.Matrix:
    (a, b), (c, d) = matrix.tolist()
    return sp.Matrix([[d, -b], [-c, a]]) / (a * d - b * c)


def _mapped(point: sp.Matrix) -> sp.Matrix:
    """Return h(p), where the homography takes a point."""
    y = H.matrix() * sp.Matrix([*point, 1])
    return y[:2, :] / y[2]


def _linearized(foot: sp.Matrix) -> tuple[dict[sp.Symbol, sp.Expr], sp.Matrix, sp.Matrix]:
    """Return names with values, B = dh/dp, and the multipliers of a match, at a foot point.

    With the constraint q' = h(q) to first order, the multipliers are S^-1 (q' - h - B (q - p)) with
    S = S2 + B S1 B^T, the covariance of the constraint.
    """
    h = sp.Matrix(sp.symbols("h0 h1", real=True))
    B = sp.Matrix(2, 2, sp.symbols("b:4", real=True))
    S = sp.symbols("s:3", real=True)
    e = sp.Matrix(sp.symbols("e0 e1", real=True))
    values = dict(zip(h, _mapped(foot), strict=True))
    # The columns of dh/dp are those of H, less h times the third row, over y3.
    third = (H.matrix() * sp.Matrix([*foot, 1]))[2]
    derivative = (H.matrix()[:2, :2] - h * H.matrix()[2, :2]) / third
    values |= dict(zip(B, derivative, strict=True))
    values |= dict(zip(S, upper(_symmetric(S2) + B * _symmetric(S1) * B.T), strict=True))
    values |= dict(zip(e, Q2.matrix() - h - B * (Q1.matrix() - foot), strict=True))
    xx, xy, yy = S
    return values, B, _inverse(sp.Matrix([[xx, xy], [xy, yy]])) * e


def _reprojection() -> list[Kernel]:
    """Return the exact reprojection error of a homography, and its normal equations."""
    p = sp.Matrix(sp.symbols("p0 p1", real=True))
    values, B, multipliers = _linearized(p)
    corrected = Q1.matrix() + _symmetric(S1) * B.T * multipliers
    steps = Loop(
        dict(zip(p, Q1.matrix(), strict=True)),
        values,
        dict(zip(p, corrected, strict=True)),
        _STEPS,
    )
    off1, off2 = Q1.matrix() - p, Q2.matrix() - _mapped(p)
    squared = off1.dot(_inverse(_symmetric(S1)) * off1) + off2.dot(_inverse(_symmetric(S2)) * off2)

    values, _, multipliers = _linearized(FOOT.matrix())
    h, S = sp.Matrix(sp.symbols("h0 h1", real=True)), sp.symbols("s:3", real=True)
    third = (H.matrix() * sp.Matrix([*FOOT.entries(), 1]))[2]
    moved = [entry / third for entry in (*FOOT.entries(), sp.S.One)]
    zero = [sp.S.Zero] * 3
    J = sp.Matrix(
        [
            [*moved, *zero, *(-h[0] * entry for entry in moved)],
            [*zero, *moved, *(-h[1] * entry for entry in moved)],
        ]
    )
    inverse = _inverse(sp.Matrix([[S[0], S[1]], [S[1], S[2]]]))
    weight = WEIGHT.symbol()
    return [
        Kernel(
            "homography_foot",
            "the point p of image 1 with the least (q - p)^T S1^-1 (q - p) + (q' - h(p))^T S2^-1 "
            "(q' - h(p)), h the homography, and that squared distance.",
            (H, Q1, Q2, S1, S2),
            (Output.of("foot", p), Output.of("squared", squared)),
            (steps,),
        ),
        Kernel(
            "homography_system",
            "J^T S^-1 J (upper triangle) and the gradient of half the squared distances by "
            "vect(H), J = dh(p)/dH at the foot points p, S = S2 + B S1 B^T, B = dh/dp.",
            (H, Q1, Q2, S1, S2, FOOT, WEIGHT),
            (
                Output.of("N", upper(weight * J.T * inverse * J), summed=True),
                Output.of("gradient", -weight * J.T * multipliers, summed=True),
            ),
            (Let(values),),
        ),
    ]


def _four_points() -> Kernel:
    """Return the homography of four matches: by the projective bases that they are."""
    stages: list[Let] = []
    bases, weights = [], []
    for tag, sample in (("1", SAMPLE1), ("2", SAMPLE2)):
        x, y = sample.entries()[:4], sample.entries()[4:]
        points = [sp.Matrix([x[k], y[k], 1]) for k in range(4)]
        # The determinants of the fourth point with two others: by Cramer's rule the weights of
        # the first three whose sum it is, times the determinant of these.
        names = sp.Matrix(sp.symbols(f"w{tag}_:3", real=True))
        volumes = [
            sp.Matrix.hstack(*(points[3] if i == k else points[i] for i in range(3))).det()
            for k in range(3)
        ]
        stages.append(Let(dict(zip(names, volumes, strict=True))))
        bases.append(sp.Matrix.hstack(*points[:3]))
        weights.append(names)
    # H takes point k of image 1, times its weight, to that of image 2.
    ratios = sp.Matrix(sp.symbols("r:3", real=True))
    first, second = weights
    products = [second[k] * first[(k + 1) % 3] * first[(k + 2) % 3] for k in range(3)]
    stages.append(Let(dict(zip(ratios, products, strict=True))))
    sides = sp.symbols("side:4", real=True)
    area1, area2 = (bases[k].det() for k in (0, 1))
    values = [a * b for a, b in zip(first, second, strict=True)]
    stages.append(Let(dict(zip(sides, (*values, area1 * area2), strict=True))))
    votes = sum(select(side, sp.Integer(1), sp.Integer(-1)) for side in sides)
    return Kernel(
        "four_points",
        "H of four matches in closed form. Votes are 4 or -4 where all triangles of the four keep, "
        "or all change, their orientation, as those do that one side of a plane shows.",
        (SAMPLE1, SAMPLE2),
        (
            Output.of("H", (bases[1] * sp.diag(*ratios) * bases[0].adjugate()).tolist()),
            Output.of("votes", votes),
        ),
        tuple(stages),
    )


def _parallax() -> Kernel:
    q2, e2 = homogeneous(Q2), E2.matrix()
    y = cross(list(e2)) * F.matrix() * homogeneous(Q1)
    names = sp.symbols("y0 y1 y2", real=True)
    kappa = sp.Symbol("k", real=True)
    given = Let(dict(zip(names, y, strict=True)))
    base = sp.Matrix(names)
    across = cross(list(q2)) * e2
    nearest = -(cross(list(q2)) * base).dot(across) / across.dot(across)
    moved = e2[:2, :] - Q2.matrix() * e2[2]
    depth = names[2] + kappa * e2[2]
    return Kernel(
        "plane_parallax",
        "k with q' ~ [e']_x F q + k e' (plane and parallax): matches of a plane have k = v^T q. "
        "And the length that q' moves by a change of k.",
        (F, E2, Q1, Q2),
        (
            Output.of("kappa", kappa),
            Output.of("gain", sp.sqrt(moved.dot(moved) / depth**2)),
        ),
        (given, Let({kappa: nearest})),
    )
