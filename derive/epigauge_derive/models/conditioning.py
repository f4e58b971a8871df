"""F in other coordinates of the images: those it is computed in, and pixels."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Output


def similarity(a: sp.Expr, b: sp.Expr, t: sp.Matrix) -> sp.Matrix:
    """Return the map q -> (a q + t) / b of homogeneous points; no turn."""
    return sp.Matrix([[a, 0, t[0]], [0, a, t[1]], [0, 0, b]])


def kernels() -> list[Kernel]:
    """Return what becomes of F where both images take other coordinates."""
    F, a, b = Input("F", (3, 3)), Input("a"), Input("b")
    first, second = Input("shift1", (2,)), Input("shift2", (2,))
    maps = [similarity(a.symbol(), b.symbol(), t.matrix()) for t in (first, second)]
    # q'^T F q = 0 with q = M1 p and q' = M2 p' is p'^T (M2^T F M1) p = 0.
    moved = maps[1].T * F.matrix() * maps[0]
    entries = [sp.Symbol(f"entry{i}{j}", real=True) for i in range(3) for j in range(3)]
    length = sp.sqrt(sum(entry**2 for entry in entries))
    return [
        Kernel(
            "fundamental_of_coordinates",
            "M'^T F M over its norm: F of points p, p' with q ~ M p = (a p + shift1) / b and "
            "q' ~ M' p' = (a p' + shift2) / b (conditioning of the 8-point algorithm, and back).",
            (F, a, b, first, second),
            (Output.of("moved", sp.Matrix(3, 3, entries) / length),),
            stages=(Let(dict(zip(entries, moved, strict=True))),),
        )
    ]
