"""Proof of the formulas of `epigauge.two_view.plane_motions`: the two motions of a plane.

A homography of rays, scaled so that its middle singular value is one, is H = R + t n^T exactly for
the planes that it does not stretch. All is said in the basis V: H^T H = V diag(s1^2, 1, s3^2) V^T.
"""

from __future__ import annotations

import pytest
import sympy as sp

S1, S3, X, Y, Z = sp.symbols("s1 s3 x y z", real=True)
SQUARE = sp.diag(S1**2, 1, S3**2)
LOW, HIGH = sp.sqrt(1 - S3**2), sp.sqrt(S1**2 - 1)
SECOND = sp.Matrix([0, 1, 0])


@pytest.mark.parametrize("sign", [1, -1])
def test_nothing_is_stretched_in_the_plane_of_a_normal(sign: int) -> None:
    across = sp.Matrix([LOW, 0, sign * HIGH])
    a, b = sp.symbols("a b", real=True)
    u = a * SECOND + b * across
    assert sp.expand((u.T * SQUARE * u)[0] - u.dot(u)) == 0
    # The normal that `normals` returns is v2 x (low v1 +- high v3), up to its sign.
    normal = sp.Matrix([-sign * HIGH, 0, LOW])
    assert sp.expand(normal.dot(across)) == 0
    assert normal.dot(SECOND) == 0
    crossed = SECOND.cross(across)
    assert sp.simplify(crossed.cross(normal)) == sp.zeros(3, 1)


def test_no_other_plane_through_the_second_axis_keeps_all_lengths() -> None:
    # Of v2 and (x, 0, z): (s1^2 - 1) x^2 = (1 - s3^2) z'^2 with two solutions, up to scale.
    u = sp.Matrix([X, 0, Z])
    stretch = sp.expand((u.T * SQUARE * u)[0] - u.dot(u))
    found = sp.solve(stretch, X)
    assert len(found) == 2
    assert all(sp.simplify(one**2 * (S1**2 - 1) - Z**2 * (1 - S3**2)) == 0 for one in found)


def test_a_plane_that_is_not_stretched_has_the_second_axis_in_it() -> None:
    # The stretch is the form (s1^2 - 1) x^2 - (1 - s3^2) z^2: no y. On a plane with normal n it
    # vanishes everywhere only where n has no part along v2, unless both factors are zero.
    p, q = sp.symbols("p q", real=True)
    stretch = sp.expand(
        (sp.Matrix([X, Y, Z]).T * SQUARE * sp.Matrix([X, Y, Z]))[0] - X**2 - Y**2 - Z**2
    )
    on_plane = sp.Poly(stretch.subs(Y, p * X + q * Z), X, Z)
    assert [sp.factor(c) for c in on_plane.coeffs()] == [
        sp.factor(S1**2 - 1),
        sp.factor(S3**2 - 1),
    ]
