"""What a search among raw matches judges an F by: Sampson's distances without derivatives."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Output, select
from epigauge_derive.models.criteria import Q1, Q2, F, constraint, homogeneous

EPIPOLE = Input("e2", (3,), shared=True)
ONE = Input("F", (3, 3))
SCALE2, FLOOR2 = Input("scale2", shared=True), Input("floor2", shared=True)

#: Keeps a quotient finite where F has no line through a match.
_TINY = sp.Float(1e-300)


def kernels() -> list[Kernel]:
    """Return the factor of the score, distances with sides, and the epipole they are sides of."""
    C = constraint()
    length2 = sum(sp.diff(C, entry) ** 2 for entry in (*Q1.entries(), *Q2.entries()))
    factor = 1 + SCALE2.symbol() * length2 / (C**2 + FLOOR2.symbol() * length2 + _TINY)
    second = homogeneous(Q2)
    side = EPIPOLE.matrix().cross(second).dot(F.matrix() * homogeneous(Q1))
    return [
        Kernel(
            "agreement",
            "1 + scale^2 / (d^2 + floor^2) with Sampson's distance d of a match: the product over "
            "the matches is what a search judges F by.",
            (F, SCALE2, FLOOR2, Q1, Q2),
            (Output.of("factor", factor),),
        ),
        Kernel(
            "sampson_side",
            "squared Sampson distance of a match, and (e' x q') . (F q), of one sign for all "
            "points in front of both cameras (oriented epipolar constraint, Chum, Werner, Matas "
            "2004).",
            (F, EPIPOLE, Q1, Q2),
            (Output.of("squared", C**2 / (length2 + _TINY)), Output.of("side", side)),
        ),
        _epipole(),
    ]


def _epipole() -> Kernel:
    """Return the left null vector of F: across two columns, those of the longest product."""
    f = ONE.matrix()
    products = [f[:, k].cross(f[:, (k + 1) % 3]) for k in range(3)]
    stages: list[Let] = []
    named = []
    for k, product in enumerate(products):
        own = sp.Matrix(sp.symbols(f"c{k}_:3", real=True))
        stages.append(Let(dict(zip(own, product, strict=True))))
        named.append(own)
    lengths = sp.symbols("length:3", real=True)
    stages.append(Let({n: own.dot(own) for n, own in zip(lengths, named, strict=True)}))
    best, length = named[0], lengths[0]
    for k in (1, 2):
        longer = lengths[k] - length
        own = sp.Matrix(sp.symbols(f"best{k}_:3", real=True))
        size = sp.Symbol(f"most{k}", real=True)
        chosen = [select(longer, a, b) for a, b in zip(named[k], best, strict=True)]
        values = dict(zip(own, chosen, strict=True))
        stages.append(Let(values | {size: select(longer, lengths[k], length)}))
        best, length = own, size
    return Kernel(
        "epipole",
        "e' with e'^T F = 0, of any length: the longest product of two columns of F.",
        (ONE,),
        (Output.of("epipole", list(best)),),
        tuple(stages),
    )
