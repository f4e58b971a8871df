"""Print expressions as infix text, the same in every language but for the names of functions.

Terms and factors are sorted, and products and sums associate to the left, so that NumPy and C
round alike. Integer powers are products. A node without a rule is an error.
"""

from __future__ import annotations

from collections.abc import Mapping

import sympy as sp
from sympy.core.sorting import default_sort_key

_SUM, _PRODUCT, _ATOM = 1, 2, 3


class Printer:
    """Infix printer of one language.

    Parameters
    ----------
    functions : mapping
        Spelling of ``sqrt``, ``sin``, ``cos``, ``atan2``, ``abs``, ``floor``,
        ``log1p``.
    select : str
        Format of the branch with fields ``condition``, ``then`` and ``other``.
    """

    def __init__(self, functions: Mapping[str, str], select: str) -> None:
        self._functions = functions
        self._select = select

    def __call__(self, expression: sp.Expr) -> str:
        """Return the text of an expression."""
        return self._print(expression)[0]

    def _at_least(self, level: int, expression: sp.Expr) -> str:
        text, own = self._print(expression)
        return text if own >= level else f"({text})"

    def _print(self, e: sp.Expr) -> tuple[str, int]:
        if e.is_Symbol:
            return e.name, _ATOM
        if e.is_Number:
            return self._number(e)
        if e.is_NumberSymbol:
            return repr(float(e)), _ATOM
        if e.is_Add:
            return self._sum(e), _SUM
        if e.is_Mul:
            return self._product(e)
        if e.is_Pow:
            return self._power(e)
        name = type(e).__name__
        arguments = [self(argument) for argument in e.args]
        if name == "select":
            condition, then, other = arguments
            text = self._select.format(condition=condition, then=then, other=other)
            return text, _ATOM
        key = "abs" if name == "Abs" else name
        if key not in self._functions:
            raise TypeError(f"no rule to print {name} in {e}")
        return f"{self._functions[key]}({', '.join(arguments)})", _ATOM

    def _number(self, e: sp.Number) -> tuple[str, int]:
        if not e.is_finite:
            raise TypeError(f"no rule to print the number {e}")
        if e.is_Rational and e.q & (e.q - 1):
            sign = "-" if e < 0 else ""
            return f"{sign}{abs(e.p)}.0/{e.q}.0", _PRODUCT
        return repr(float(e)), _SUM if e < 0 else _ATOM

    def _sum(self, e: sp.Add) -> str:
        terms = sorted(e.args, key=lambda t: (t.could_extract_minus_sign(), default_sort_key(t)))
        text = self._at_least(_PRODUCT, terms[0]) if terms[0].is_Add else self(terms[0])
        for term in terms[1:]:
            if term.could_extract_minus_sign():
                text += f" - {self._at_least(_PRODUCT, -term)}"
            else:
                text += f" + {self._at_least(_PRODUCT, term)}"
        return text

    def _product(self, e: sp.Mul) -> tuple[str, int]:
        coefficient, factors = e.as_coeff_mul()
        above: list[sp.Expr] = []
        below: list[sp.Expr] = []
        for factor in sorted(factors, key=default_sort_key):
            power = factor.as_base_exp()[1]
            (below if power.is_number and power < 0 else above).append(factor)
        sign, coefficient = ("-", -coefficient) if coefficient < 0 else ("", coefficient)
        numerator = [self._at_least(_PRODUCT, f) for f in above]
        if coefficient != 1 or not numerator:
            numerator.insert(0, self._at_least(_PRODUCT, coefficient))
        text = "*".join(numerator)
        if len(below) == 1:
            text += f"/{self._at_least(_ATOM, 1 / below[0])}"
        elif below:
            text += f"/({'*'.join(self._at_least(_PRODUCT, 1 / f) for f in below)})"
        return sign + text, _SUM if sign else _PRODUCT

    def _power(self, e: sp.Pow) -> tuple[str, int]:
        base, exponent = e.as_base_exp()
        if not exponent.is_Rational or exponent.q > 2:
            raise TypeError(f"no rule to print the power {e}")
        if exponent < 0:
            return f"1.0/{self._at_least(_ATOM, base**-exponent)}", _PRODUCT
        whole, half = divmod(exponent.p, exponent.q)
        factors = [self._at_least(_ATOM, base)] * whole
        if half:
            factors.append(f"{self._functions['sqrt']}({self(base)})")
        return "*".join(factors), _ATOM if len(factors) == 1 else _PRODUCT
