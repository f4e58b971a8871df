"""The orthonormal representation: what is derived is what Bartoli and Sturm (2004) print.

Identities in exact arithmetic. Where orthonormality matters, U and V are rational orthonormal
matrices (Cayley transforms), of both handednesses.
"""

from __future__ import annotations

import itertools
import math

import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive.models import block, orthonormal, rotations

U, V, SIGMA = orthonormal.U.matrix(), orthonormal.V.matrix(), orthonormal.SIGMA.symbol()


def cross(v):
    """Return [v]_x."""
    return sp.Matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def rational_orthonormal(a, b, c, sign):
    """Return a rational orthonormal matrix with determinant `sign` (Cayley transform)."""
    skew = cross(sp.Matrix([sp.Rational(a, 7), sp.Rational(b, 7), sp.Rational(c, 7)]))
    matrix = sign * (sp.eye(3) - skew) * (sp.eye(3) + skew).inv()
    assert matrix.T * matrix == sp.eye(3)
    assert matrix.det() == sign
    return matrix


def orthonormal_pairs():
    """Return (U, V) of all handednesses."""
    return [
        (rational_orthonormal(2, -3, 5, det_u), rational_orthonormal(-4, 1, 6, det_v))
        for det_u, det_v in itertools.product((1, -1), repeat=2)
    ]


def evaluated(expression, u, v, sigma):
    """Substitute numbers for U, V and sigma."""
    point = dict(zip(U, u, strict=True)) | dict(zip(V, v, strict=True)) | {SIGMA: sigma}
    return expression.subs(point)


@pytest.fixture(scope="module")
def outputs():
    """Return all outputs of the kernels as matrices of two axes, by kernel and name."""
    return {
        (kernel.name, output.name): sp.Matrix(
            output.shape[0], math.prod(output.shape[1:]), output.entries
        )
        for kernel in orthonormal.kernels()
        for output in kernel.outputs
        if output.shape
    }


@pytest.fixture(scope="module")
def a_perp(outputs):
    return outputs["canonical_camera_derivatives", "A_perp"]


def test_a_perp_is_eq7_entry_by_entry(a_perp):
    u1, u2, u3 = (U[:, k] for k in range(3))
    v1, v2, v3 = (V[:, k] for k in range(3))
    s, zero = SIGMA, sp.zeros(3, 1)
    eq7 = [
        (u3 * v1.T, -u2),
        (s * u3 * v2.T, u1),
        (-u1 * v1.T - s * u2 * v2.T, zero),
        (-s * u1 * v3.T, zero),
        (-u2 * v3.T, zero),
        (u2 * v2.T + s * u1 * v1.T, zero),
        (-u1 * v2.T, zero),
    ]
    assert a_perp.shape == (12, 7)
    for column, (left, right) in enumerate(eq7):
        vect = list(left.row_join(right))  # row-wise
        for row, entry in enumerate(vect):
            assert sp.expand(a_perp[row, column] - entry) == 0, (row, column)


def test_kernels_agree_on_what_they_share(outputs):
    for name in ("canonical_camera", "canonical_camera_derivatives"):
        expected = orthonormal.canonical_camera(U, V, SIGMA)
        assert (outputs[name, "P2"] - expected).expand() == sp.zeros(3, 4)
    for name in ("fundamental_from_factors", "fundamental_derivatives"):
        expected = orthonormal.fundamental(U, V, SIGMA)
        assert (outputs[name, "F"] - expected).expand() == sp.zeros(3, 3)


def test_second_derivatives_of_f_are_symmetric(outputs):
    d2F = outputs["fundamental_derivatives", "d2F"]
    for row in range(9):
        assert sp.Matrix(7, 7, d2F[row, :]).is_symmetric()


@pytest.mark.parametrize("sigma", [sp.Rational(1, 1000), sp.Rational(3, 5), sp.Rational(999, 1000)])
@pytest.mark.parametrize("u_v", orthonormal_pairs())
def test_a_perp_has_rank_7_in_general(a_perp, u_v, sigma):
    assert evaluated(a_perp, *u_v, sigma).rank() == 7


@pytest.mark.parametrize("u_v", orthonormal_pairs())
def test_a_perp_has_rank_6_at_sigma_1_with_null_vector_x3_plus_y3(a_perp, u_v):
    at_one = evaluated(a_perp, *u_v, 1)
    assert at_one.rank() == 6
    (null,) = at_one.nullspace()
    assert null / null[2] == sp.Matrix([0, 0, 1, 0, 0, 1, 0])


def test_null_vector_at_sigma_1_holds_for_every_u_and_v(a_perp):
    x3, y3 = a_perp.subs(SIGMA, 1)[:, 2], a_perp.subs(SIGMA, 1)[:, 5]
    assert (x3 + y3).expand() == sp.zeros(12, 1)


@pytest.mark.parametrize("u_v", orthonormal_pairs())
def test_camera_of_eq5_has_epipole_u3_and_gives_f_back(u_v):
    u, v = u_v
    F = orthonormal.fundamental(u, v, SIGMA)
    camera = orthonormal.canonical_camera(u, v, SIGMA)
    H, epipole = camera[:, :3], camera[:, 3]
    assert epipole == u[:, 2]
    assert (F.T * epipole).expand() == sp.zeros(3, 1)
    # [u3]_x [u3]_x = -I on the span of u1 and u2; a left-handed U changes the sign once more.
    assert (cross(epipole) * H + u.det() * F).expand() == sp.zeros(3, 3)


def test_camera_of_eq5_is_the_canonic_camera_of_eq4_as_printed():
    u1, u2, u3, v1, v2 = (U[:, 0], U[:, 1], U[:, 2], V[:, 0], V[:, 1])
    printed = (u2 * v1.T - SIGMA * u1 * v2.T).row_join(u3)
    assert (orthonormal.canonical_camera(U, V, SIGMA) - printed).expand() == sp.zeros(3, 4)
    u, v = orthonormal_pairs()[0]
    F = orthonormal.fundamental(u, v, SIGMA)
    by_eq4 = (cross(u[:, 2]) * F).row_join(u[:, 2])
    assert (orthonormal.canonical_camera(u, v, SIGMA) - by_eq4).expand() == sp.zeros(3, 4)


@pytest.mark.parametrize("u_v", orthonormal_pairs())
def test_block_camera_is_the_canonic_camera_of_its_f(u_v):
    u, v = u_v
    M = block.M.matrix()
    F, camera = block.fundamental(u, v, M), block.canonical_camera(u, v, M)
    by_eq4 = (cross(u.det() * u[:, 2]) * F).row_join(u[:, 2])
    assert (camera - by_eq4).expand() == sp.zeros(3, 4)
    ortho = orthonormal.canonical_camera(u, v, SIGMA)
    assert (block.canonical_camera(u, v, sp.diag(1, SIGMA)) - ortho).expand() == sp.zeros(3, 4)


@pytest.mark.parametrize("u_v", orthonormal_pairs())
def test_projections_by_eq5_satisfy_the_epipolar_constraint(u_v):
    u, v = u_v
    Q = sp.Matrix(sp.symbols("X Y Z W"))
    q1, q2 = Q[:3, :], orthonormal.canonical_camera(u, v, SIGMA) * Q
    assert sp.expand((q2.T * orthonormal.fundamental(u, v, SIGMA) * q1)[0]) == 0


@pytest.mark.parametrize("u_v", orthonormal_pairs())
def test_fundamental_of_eq2_has_singular_values_1_sigma_0(u_v):
    F = orthonormal.fundamental(*u_v, SIGMA)
    z = sp.Symbol("z")
    characteristic = (F.T * F).charpoly(z).as_expr()
    assert sp.expand(characteristic - z * (z - 1) * (z - SIGMA**2)) == 0


def test_update_is_eq3():
    delta = orthonormal.DELTA.entries()
    u, v, sigma = orthonormal.updated()
    assert (u - U * eq1(*delta[:3])).expand() == sp.zeros(3, 3)
    assert (v - V * eq1(*delta[3:6])).expand() == sp.zeros(3, 3)
    assert sigma == SIGMA + delta[6]


def eq1(*theta):
    """Return Rx Ry Rz by Rodrigues' formula about the coordinate axes."""
    product = sp.eye(3)
    for axis, angle in enumerate(theta):
        K = cross(sp.eye(3)[:, axis])
        product *= sp.eye(3) + sp.sin(angle) * K + (1 - sp.cos(angle)) * K * K
    return product


def test_rotation_is_rx_ry_rz_of_eq1():
    theta = sp.symbols("theta1:4", real=True)
    R = rotations.euler_rotation(theta)
    assert (R - eq1(*theta)).expand() == sp.zeros(3, 3)


def test_rotation_is_orthonormal_with_determinant_1():
    theta = sp.symbols("theta1:4", real=True)
    R = rotations.euler_rotation(theta)
    pythagoras = {sp.sin(angle) ** 2: 1 - sp.cos(angle) ** 2 for angle in theta}
    assert (R.T * R).expand().xreplace(pythagoras).expand() == sp.eye(3)
    assert R.det().expand().xreplace(pythagoras).expand() == 1
