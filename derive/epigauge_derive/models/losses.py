"""Robust losses c^2 rho(s / c^2) of a squared residual s, c the scale (definitions: SciPy's)."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Output, log1p, select

SQUARED, SCALE2 = Input("squared"), Input("scale2", (), shared=True)
_s, _root_of = sp.Symbol("ratio", real=True), sp.Symbol("beyond", real=True)

#: rho(s) where s <= 1 and where s > 1; one entry where it is the same function.
LOSSES: dict[str, tuple[sp.Expr, ...]] = {
    "huber": (_s, 2 * sp.sqrt(_s) - 1),
    "soft_l1": (2 * (sp.sqrt(1 + _s) - 1),),
    "cauchy": (log1p(_s),),
    "truncated": (_s, sp.Integer(1)),
}


def kernels() -> list[Kernel]:
    """Return each loss with its first two derivatives by the squared residual."""
    return [_kernel(name, rho) for name, rho in LOSSES.items()]


def _kernel(name: str, rho: tuple[sp.Expr, ...]) -> Kernel:
    scale2 = SCALE2.symbol()
    values = {_s: SQUARED.symbol() / scale2}
    if _s in rho[-1].free_symbols and len(rho) == 2:
        # The branch that is not taken must be finite too.
        values |= {_root_of: select(_s - 1, _s, sp.Integer(1))}
    derivatives = []
    for order in range(3):
        inside, *outside = (sp.diff(branch, _s, order) for branch in rho)
        if outside:
            beyond = outside[0].xreplace({_s: _root_of})
            inside = select(_s - 1, beyond, inside) if beyond != inside else inside
        derivatives.append(inside * scale2 ** (1 - order))
    return Kernel(
        f"loss_{name}",
        "c^2 rho(s / c^2) with its first two derivatives by the squared residual s, and scale2 = "
        f"c^2: the loss {name}.",
        (SQUARED, SCALE2),
        tuple(map(Output.of, ("value", "first", "second"), derivatives)),
        (Let(values),),
    )
