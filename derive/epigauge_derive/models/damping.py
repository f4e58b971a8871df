"""The Taylor expansion of the incremental error e in the damping matrix, B03 eq. (10).

With delta = -(N + W)^-1 g and the series (N + W)^-1 = sum (-1)^n Z(n), Z(n) = (W^-1 N)^n W^-1,
the error e = g^T delta + 1/2 delta^T N delta becomes a sum of K(n) = g^T Z(n) g. All of this is
done here with non-commutative symbols.

The kernel is there for the tests of the paper's claim; no solver calls it. The series converges
where the spectral radius of W^-1 N is below one only, that is for large lambda, and there the two
products g^T delta and delta^T N delta give e itself, at any lambda and with fewer products.
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output

ORDER = 8

_W_INVERSE = sp.Symbol("Winv", commutative=False)
_N = sp.Symbol("N", commutative=False)


def series_term(n: int) -> sp.Expr:
    """Return Z(n) = (W^-1 N)^n W^-1 as a non-commutative word."""
    return sp.Mul(*([_W_INVERSE, _N] * n), _W_INVERSE)


def error_coefficients(order: int) -> list[sp.Rational]:
    """Expand e and return the coefficient of K(n) for n = 0..order.

    Words between g^T and g are collected; the series is carried far enough for every product
    that reaches `order` to be there.
    """
    minus_delta = sum((-1) ** n * series_term(n) for n in range(order + 1))
    inner = sp.expand(-minus_delta + minus_delta * _N * minus_delta / 2)
    found = dict.fromkeys(map(series_term, range(order + 1)), sp.Integer(0))
    for term in sp.Add.make_args(inner):
        commutative, word = term.args_cnc()
        word = sp.Mul(*word)
        if word in found:
            found[word] += sp.Mul(*commutative)
    return list(found.values())


def kernels() -> list[Kernel]:
    """Return the truncations of eq. (10) at the orders 0..8, from K(0)..K(8)."""
    K = Input("K", (ORDER + 1,))
    terms = [
        coefficient * k
        for coefficient, k in zip(error_coefficients(ORDER), K.entries(), strict=True)
    ]
    truncations = [sum(terms[: n + 1]) for n in range(ORDER + 1)]
    return [
        Kernel(
            "error_series",
            "e truncated at order n = 0..8, e = sum (-1)^(n+1) (1 + n/2) K(n) with K(n) = "
            "g^T (W^-1 N)^n W^-1 g (B03 eq. 10).",
            (K,),
            (Output.of("e", truncations),),
        )
    ]
