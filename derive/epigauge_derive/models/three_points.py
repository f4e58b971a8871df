"""Three points seen by a calibrated camera: the distances that they may have from it.

With distances s1, s2, s3 of the points and u = s2 / s1, v = s3 / s1, the law of cosines for the
three sides gives two conics in u and v. Their difference is linear in u; put into one of them, it
leaves a quartic in v (J. A. Grunert, 1841; in R. M. Haralick et al., IJCV 13(3), 1994).
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output

#: Of the points (1, 2), (1, 3), (2, 3).
COSINES, SQUARES = Input("cosines", (3,)), Input("squares", (3,))


def kernels() -> list[Kernel]:
    """Return the quartic of three points, and u as a quotient of polynomials."""
    c12, c13, c23 = COSINES.entries()
    d12, d13, d23 = SQUARES.entries()
    u, v = sp.symbols("u v", real=True)
    # Squares of the sides in units of s1^2.
    side12, side13 = 1 + u**2 - 2 * u * c12, 1 + v**2 - 2 * v * c13
    side23 = u**2 + v**2 - 2 * u * v * c23
    first = sp.expand(side12 - d12 / d13 * side13)
    second = sp.expand(side23 - d23 / d13 * side13)
    line = sp.Poly(sp.expand(first - second), u)
    assert line.degree() == 1
    below, above = line.coeff_monomial(u), -line.coeff_monomial(1)
    square, linear, constant = sp.Poly(first, u).all_coeffs()
    assert square == 1
    quartic = sp.Poly(sp.expand(above**2 + linear * above * below + constant * below**2), v)
    return [
        Kernel(
            "three_points",
            "coefficients, highest first, of the quartic in v = s3 / s1, and of the polynomials in "
            "v whose quotient is u = s2 / s1, for the distances s1, s2, s3 of three points; from "
            "the cosines of the angles between their rays, and the squares of their distances from "
            "one another.",
            (COSINES, SQUARES),
            (
                Output.of("quartic", quartic.all_coeffs()),
                Output.of("above", sp.Poly(above, v).all_coeffs()),
                Output.of("below", sp.Poly(below, v).all_coeffs()),
            ),
        )
    ]
