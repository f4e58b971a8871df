"""Homographies of matches: what a plane, or a camera that only turned, does to points."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Output, cross, jacobian, select, upper
from epigauge_derive.models.criteria import Q1, Q2, F, homogeneous

H = Input("H", (3, 3), shared=True)
E2 = Input("e2", (3,), shared=True)
WEIGHT = Input("weight")

_TINY = sp.Float("1e-200")


def equations() -> sp.Matrix:
    """Return c = q' (h3 q) - (h1 q, h2 q), zero where H takes q to q'."""
    y = H.matrix() * homogeneous(Q1)
    return Q2.matrix() * y[2] - y[:2, :]


def kernels() -> list[Kernel]:
    """Return what a homography is fitted with, and the parallax off a plane of F."""
    return [*_fit(), _parallax()]


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
