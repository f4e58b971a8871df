"""The foot point and the exact Hessian: the closed forms are what their definitions say.

C(z) = q'^T F q in images rotated so that the upper left block of F is diag(s). Rational functions
are compared at rational points, in exact arithmetic.
"""

from __future__ import annotations

import random

import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive.kernel import jacobian
from epigauge_derive.models import reprojection as rp

L = rp.MULTIPLIER.symbol()
Z = [*rp.A1, *rp.A2]
GEOMETRY = [*rp.S.entries(), *rp.B1.entries(), *rp.B2.entries(), rp.F22.symbol()]
HALF = sp.Rational(1, 2)
# C by its definition, with an F typed here.
S0, S1, B10, B11, B20, B21, F22 = GEOMETRY
X1, Y1, X2, Y2 = Z
C = S0 * X1 * X2 + S1 * Y1 * Y2 + B10 * X1 + B11 * Y1 + B20 * X2 + B21 * Y2 + F22


def reciprocals(over=1):
    """Return what the named reciprocals stand for."""
    return {r: over / (1 + L * k) for r, k in zip(rp.RECIPROCALS, rp.KAPPA, strict=True)}


def rational_points(symbols, seed, count=4):
    """Return substitutions of random rational numbers, none of them zero."""
    rng = random.Random(seed)
    return [
        {
            s: sp.Rational(rng.choice([-1, 1]) * rng.randint(1, 30), rng.randint(31, 60))
            for s in symbols
        }
        for _ in range(count)
    ]


def test_bilinear_form_is_the_epipolar_constraint():
    assert sp.expand(rp.bilinear(rp.A1, rp.A2) - C) == 0


def test_diagonal_coordinates_are_an_isometry_that_diagonalises_c_zz():
    T = jacobian(rp.diagonal_coordinates(Z), Z)
    assert sp.eye(4) == T * T.T
    assert (T * sp.hessian(C, Z) * T.T).expand() == sp.diag(*rp.KAPPA)


def resolved(expression, names):
    """Return an expression with its names replaced by what they stand for."""
    while expression.free_symbols & set(names):
        expression = expression.subs(names)
    return expression


@pytest.mark.parametrize("over", [sp.S.One, sp.Rational(1, 2)])
def test_reciprocals_are_one_over_one_plus_l_kappa(over):
    names = rp.reciprocals(L, over)
    for r, k in zip(rp.RECIPROCALS, rp.KAPPA, strict=True):
        assert sp.simplify(resolved(r, names) * (1 + L * k) - over) == 0


@pytest.mark.parametrize(
    ("term", "power"), [(rp.phi_term, 2), (rp.slope_term, 3), (rp.square_term, 2), (rp.phi_term, 4)]
)
def test_sums_over_common_denominators_are_those_over_the_reciprocals(term, power):
    names, over = rp.over_denominators(L)
    sums = {}
    for k, (plus, minus) in enumerate((rp.SQUARES[:2], rp.SQUARES[2:])):
        sums |= {rp.SUMS[k]: plus + minus, rp.DIFFERENCES[k]: (plus - minus) / 2}
    D = sp.prod(1 - L**2 * k**2 for k in (S0, S1))
    assert sp.expand(resolved(sp.prod(rp.DENOMINATORS), names) - D) == 0
    apart = rp.total(term).subs(reciprocals()) * D**power
    assert sp.simplify(resolved(over(term, power), names).subs(sums) - apart) == 0


def test_phi_has_the_derivative_that_newton_divides_by_and_starts_at_c():
    phi, slope = (e.subs(reciprocals()) for e in rp.secular(L))
    assert sp.simplify(sp.diff(phi, L) + slope) == 0
    assert phi.subs(L, 0) == rp.C0


@pytest.mark.parametrize("point", rational_points([L, *Z, *GEOMETRY], seed=1))
def test_stationary_point_satisfies_its_equation_and_phi_is_c_there(point):
    def number(expression, over=1):
        return sp.expand(expression.subs(reciprocals(over)).subs(point))

    a1, a2, n = ([number(e, HALF) for e in part] for part in rp.stationary_point())
    moved = point | dict(zip(Z, (*a1, *a2), strict=True))
    # z_hat = z - l grad C(z_hat), and the named gradient is the one at z_hat.
    for z, normal in zip(Z, n, strict=True):
        assert moved[z] == point[z] - point[L] * normal
        assert sp.diff(C, z).subs(moved) == normal
    squares = [h**2 for h in rp.gradient_at_measurement()]
    phi = rp.secular(L)[0].subs(dict(zip(rp.SQUARES, squares, strict=True)))
    assert number(phi.subs(rp.C0, C)) == C.subs(moved)


def test_phi_falls_between_the_poles():
    # Each term h^2 / (1 + l kappa)^3 of the slope is positive for |l kappa| < 1.
    _, slope = rp.secular(L)
    assert slope == sum(h * r**3 for h, r in zip(rp.SQUARES, rp.RECIPROCALS, strict=True))


def bordered(z, n, l, point):
    """Return K and R of the optimality conditions, from C with nine free entries of F."""
    F = sp.Matrix(3, 3, sp.symbols("F:3:3"))
    form = (sp.Matrix([z[2], z[3], 1]).T * F * sp.Matrix([z[0], z[1], 1]))[0]
    C_zz = sp.hessian(form, z).subs({F[0, 0]: S0, F[1, 1]: S1, F[0, 1]: 0, F[1, 0]: 0})
    K = (sp.eye(4) + l * C_zz).row_join(n).col_join(n.T.row_join(sp.zeros(1, 1)))
    C_zF = jacobian([sp.diff(form, v) for v in z], list(F))
    R = (l * C_zF).col_join(jacobian([form], list(F)))
    return K.subs(point), R.subs(point)


NORMAL = sp.symbols("n0:4", real=True)


@pytest.fixture(scope="module")
def exact_hessian():
    """Return a function that gives Hessian and slope at a point."""
    names, *both = rp.exact_hessian(Z, list(NORMAL), L)

    def at(point):
        at_point = {name: value.subs(point) for name, value in reciprocals(HALF).items()} | point
        for name, value in names.items():
            at_point[name] = value.subs(at_point)
        return [expression.subs(at_point) for expression in both]

    return at


@pytest.mark.parametrize("point", rational_points([L, *Z, *GEOMETRY, *NORMAL], seed=2, count=3))
def test_exact_hessian_is_that_of_the_bordered_matrix(exact_hessian, point):
    K, R = bordered(Z, sp.Matrix(NORMAL), L, point)
    inverse = K.inv()
    assert K * inverse == sp.eye(5)
    hessian, slope = exact_hessian(point)
    assert hessian == -R.T * inverse * R
    # -phi'(l) = n^T M^-1 n is minus the reciprocal of the corner of K^-1.
    assert slope * inverse[4, 4] == -1


def test_exact_hessian_is_symmetric_and_reduces_to_gauss_newton_at_no_distance(exact_hessian):
    (point,) = rational_points([L, *Z, *GEOMETRY, *NORMAL], seed=3, count=1)
    assert exact_hessian(point)[0].is_symmetric()
    hessian, _ = exact_hessian(point | {L: sp.S.Zero})
    C_F = sp.Matrix([X2 * X1, X2 * Y1, X2, Y2 * X1, Y2 * Y1, Y2, X1, Y1, 1])
    gauss_newton = C_F * C_F.T / sum(n**2 for n in NORMAL)
    assert hessian == gauss_newton.subs(point)


@pytest.mark.parametrize("point", rational_points([*Z, *GEOMETRY], seed=4))
@pytest.mark.parametrize("found", [rp.foot_point_fast, rp.foot_point_more])
def test_first_trial_is_the_sampson_correction(found, point):
    names = {}
    for stage in found(1)[0]:
        names |= getattr(stage, "values", {})
    # Down to the rotated match, which has names, too
    names = {name: value for name, value in names.items() if name not in Z}
    start = resolved(sp.Symbol("start", real=True), names)
    sampson = C / sum(sp.diff(C, z) ** 2 for z in Z)
    # In floating point, since the guard against 0 / 0 (1e-300) is a float.
    assert float(start.subs(point)) == pytest.approx(float(sampson.subs(point)), rel=1e-14)
