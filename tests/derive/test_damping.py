"""The Taylor expansion of the error e in the damping matrix, Bartoli (2003) eq. (10)."""

from __future__ import annotations

import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive.models import damping


def eq10(n):
    """Return the coefficient of K(n) as the paper prints it."""
    return (-1) ** (n + 1) * (1 + sp.Rational(n, 2))


def test_coefficients_are_those_of_eq10():
    assert damping.error_coefficients(8) == [eq10(n) for n in range(9)]


def test_coefficients_do_not_depend_on_where_the_expansion_ends():
    for order in range(9):
        assert damping.error_coefficients(order) == damping.error_coefficients(8)[: order + 1]


def test_coefficients_are_the_taylor_series_of_the_scalar_case():
    # One parameter: e = g d + N d^2 / 2 at d = -g / (N + W), in x = N / W and units of g^2 / W.
    x = sp.Symbol("x")
    e = -1 / (1 + x) + x / (1 + x) ** 2 / 2
    taylor = sp.Poly(sp.series(e, x, 0, 9).removeO(), x).all_coeffs()[::-1]
    assert damping.error_coefficients(8) == taylor


@pytest.mark.parametrize("n", range(4))
@pytest.mark.parametrize("m", range(4))
def test_product_of_terms_is_a_term(n, m):
    N = sp.Symbol("N", commutative=False)
    assert damping.series_term(n) * N * damping.series_term(m) == damping.series_term(n + m + 1)


def test_terms_invert_n_plus_w():
    # (N + W) sum (-1)^n Z(n) = I up to the last word, with matrices for the symbols.
    N, W = sp.Matrix([[3, 1], [1, 2]]), sp.Matrix([[5, -2], [-2, 4]])

    def Z(n):
        word = sp.Mul.make_args(damping.series_term(n))
        factors = [factor.as_base_exp() for factor in word]
        product = sp.eye(2)
        for symbol, power in factors:
            product *= {"N": N, "Winv": W.inv()}[symbol.name] ** power
        return product

    for last in range(4):
        partial = sum(((-1) ** n * Z(n) for n in range(last + 1)), sp.zeros(2, 2))
        assert (N + W) * partial == sp.eye(2) + (-1) ** last * N * Z(last)


def test_kernel_truncates_the_series_at_every_order():
    (kernel,) = damping.kernels()
    (K,), (e,) = kernel.inputs, kernel.outputs
    assert K.shape == e.shape == (9,)
    for order, truncation in enumerate(e.entries):
        expected = sum(eq10(n) * K.entries()[n] for n in range(order + 1))
        assert sp.expand(truncation - expected) == 0
