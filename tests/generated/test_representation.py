"""F, P' and the updates as numbers: one F has many representations, and an update keeps them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from epigauge.two_view.parameterizations import Maps
from laws import assert_jacobian, distance, factor_cases, fundamental, orthonormal

CASES = factor_cases()
SIGNS = list(itertools.product((1.0, -1.0), repeat=3))


def cross(v):
    """Return [v]_x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def same_up_to_scale(a, b, tolerance=1e-14):
    """Compare matrices of unit norm up to sign."""
    a, b = (m / np.linalg.norm(m) for m in (a, b))
    return min(np.abs(a - b).max(), np.abs(a + b).max()) <= tolerance


@pytest.mark.parametrize("case", CASES)
def test_all_sign_choices_give_one_f_and_cameras_of_it(table, case):
    U, V, sigma = CASES[case]
    F = fundamental(U, V, sigma)
    for u, v in itertools.product(SIGNS, SIGNS):
        if u[0] * v[0] != u[1] * v[1]:
            continue  # these change F
        factors = (U * u, V * v, sigma)
        assert same_up_to_scale(table.fundamental_from_factors(*factors), F)
        P2 = table.canonical_camera(*factors)
        assert same_up_to_scale(cross(P2[:, 3]) @ P2[:, :3], F)
        assert np.abs(F.T @ P2[:, 3]).max() <= 1e-15


@pytest.mark.parametrize("case", CASES)
def test_f_is_that_of_the_factors(table, case):
    U, V, sigma = CASES[case]
    assert distance(table.fundamental_from_factors(U, V, sigma), fundamental(U, V, sigma)) <= 1e-15


@pytest.mark.parametrize("case", CASES)
def test_a_perp_has_rank_7_but_6_at_sigma_1(table, case):
    U, V, sigma = CASES[case]
    _, A_perp = table.canonical_camera_derivatives(U, V, sigma)
    values = np.linalg.svd(A_perp, compute_uv=False)
    null = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
    gap = abs(1.0 - float(sigma))
    # x3 + y3 turns both planes together and moves P' by (1 - sigma) times a matrix of norm sqrt 2.
    assert np.linalg.norm(A_perp @ null) == pytest.approx(gap * np.sqrt(2.0), abs=1e-14)
    expected = 6 if case == "sigma 1" else 7
    # sigma itself moves P' along with y1: their norms are sigma and 1.
    threshold = 1e-10
    assert np.sum(values > threshold) == expected


@pytest.mark.parametrize("case", CASES)
def test_no_update_changes_nothing(table, case):
    for new, old in zip(table.retract_factors(*CASES[case], np.zeros(7)), CASES[case], strict=True):
        np.testing.assert_array_equal(new, old)


@pytest.mark.parametrize("case", CASES)
def test_update_keeps_orthonormality_and_handedness(table, case):
    U, V, sigma = CASES[case]
    delta = np.random.default_rng(1).uniform(-3.0, 3.0, (7, 50))
    U_new, V_new, sigma_new = table.retract_factors(U[..., None], V[..., None], sigma, delta)
    for new, old in ((U_new, U), (V_new, V)):
        new = np.moveaxis(new, -1, 0)
        assert np.abs(np.swapaxes(new, 1, 2) @ new - np.eye(3)).max() <= 4e-15
        np.testing.assert_allclose(np.linalg.det(new), np.linalg.det(old), atol=1e-14)
    np.testing.assert_allclose(sigma_new, sigma + delta[6], rtol=1e-15)


def test_update_by_x1_and_x2_zero_keeps_the_epipole_to_the_last_bit(table):
    U, V, sigma = CASES["general"]
    delta = np.array([0.0, 0.0, 0.7, 0.1, 0.2, 0.3, 0.1])
    U_new, *_ = table.retract_factors(U, V, sigma, delta)
    np.testing.assert_array_equal(U_new[:, 2], U[:, 2])


def test_rotation_is_orthonormal_and_a_product_of_three(table):
    theta = np.random.default_rng(2).uniform(-7.0, 7.0, (3, 200))
    R = table.rotation(theta)
    a, b, c = np.eye(3)
    one_axis = [
        table.rotation(np.multiply.outer(e, t)) for e, t in zip((a, b, c), theta, strict=True)
    ]
    product = np.einsum("ijn,jkn,kln->iln", *one_axis)
    assert distance(R, product) <= 2e-15
    assert np.abs(np.einsum("jin,jkn->ikn", R, R) - np.eye(3)[..., None]).max() <= 2e-15
    U = orthonormal(np.random.default_rng(3), -1)
    moved = table.rotate_columns(U[..., None], theta)
    assert distance(moved, np.einsum("ij,jkn->ikn", U, R)) <= 2e-15


def charts():
    """Return an F for each of the 36 charts: where e, e' and their transformation are largest."""
    rng = np.random.default_rng(4)
    made = []
    for i, j, row, column in itertools.product(range(3), range(3), range(2), range(2)):
        e1, e2 = (np.insert(rng.uniform(-0.9, 0.9, 2), at, 1.0) for at in (i, j))
        inner = rng.uniform(-0.9, 0.9, (2, 2))
        inner[row, column] = -1.0
        F = np.insert(np.insert(inner, i, 0.0, axis=1), j, 0.0, axis=0)
        # The other entries follow from F e = 0 and F^T e' = 0.
        F[:, i] = -(F @ e1)
        F[j] = -(e2 @ F)
        made.append(pytest.param(F, e1, e2, id=f"{i}{j}{row}{column}"))
    return made


@pytest.mark.parametrize(("F", "e1", "e2"), charts())
def test_maps_finds_the_chart_of_every_f_and_gives_it_back(table, F, e1, e2):
    maps = Maps(table)
    estimate = maps.start(-2.5 * F)
    assert np.abs(estimate.parameters).max() <= 1.0  # the largest entries are those frozen
    assert distance(maps.fundamental(estimate), -F) <= 1e-14
    P2, _ = maps.camera(estimate)
    assert distance(P2[:, 3], e2) <= 1e-14
    # P' = ([e']_x F | e'), whatever the order of the axes.
    assert distance(P2[:, :3], cross(e2) @ -F) <= 1e-14
    again = maps.start(maps.fundamental(estimate))
    assert (again.axes1, again.axes2) == (estimate.axes1, estimate.axes2)
    assert distance(again.parameters, estimate.parameters) <= 1e-13


@pytest.mark.parametrize(("F", "e1", "e2"), charts())
def test_maps_derivatives_in_every_chart(table, F, e1, e2):
    maps = Maps(table)
    estimate = maps.start(F)

    def at(parameters):
        return estimate._replace(parameters=parameters)

    dF, d2F = maps.derivatives(estimate)
    _, dP2 = maps.camera(estimate)
    p = estimate.parameters
    assert_jacobian(lambda p: maps.fundamental(at(p)).ravel(), p, dF)
    assert_jacobian(lambda p: maps.derivatives(at(p))[0], p, d2F)
    assert_jacobian(lambda p: maps.camera(at(p))[0].ravel(), p, dP2)


@pytest.mark.parametrize("case", CASES)
def test_block_update_keeps_norms_and_reaches_the_same_f(table, case):
    U, V, sigma = CASES[case]
    M = np.diag([1.0, float(sigma)]) / np.hypot(1.0, sigma)
    F = table.block_derivatives(U, V, M)[0]
    assert same_up_to_scale(F, fundamental(U, V, sigma))
    P2 = table.block_camera_derivatives(U, V, M)[0]
    assert same_up_to_scale(cross(P2[:, 3]) @ P2[:, :3], F)
    delta = np.random.default_rng(5).uniform(-2.0, 2.0, (7, 30))
    U_new, V_new, M_new = table.block_retract(U[..., None], V[..., None], M[..., None], delta)
    np.testing.assert_allclose(np.linalg.norm(M_new, axis=(0, 1)), 1.0, rtol=4e-15)
    for new in (U_new, V_new):
        new = np.moveaxis(new, -1, 0)
        assert np.abs(np.swapaxes(new, 1, 2) @ new - np.eye(3)).max() <= 4e-15


@pytest.mark.parametrize("case", CASES)
def test_block_chart_has_rank_7_even_at_sigma_1(table, case):
    U, V, sigma = CASES[case]
    M = np.diag([1.0, float(sigma)]) / np.hypot(1.0, sigma)
    _, dF, _ = table.block_derivatives(U, V, M)
    F = fundamental(U, V, sigma)
    # Directions that change F, not only its scale.
    unit = F.ravel() / np.linalg.norm(F)
    dF = dF - np.outer(unit, unit @ dF)
    values = np.linalg.svd(dF, compute_uv=False)
    # Epipoles move F by its second singular value.
    assert values[-1] >= 0.5 * min(1.0, float(sigma))


@pytest.mark.parametrize("case", CASES)
def test_block_fundamental_is_that_of_its_factors(table, case):
    U, V, sigma = CASES[case]
    M = np.random.default_rng(6).standard_normal((2, 2))
    assert distance(table.block_fundamental(U, V, M), U[:, :2] @ M @ V[:, :2].T) <= 1e-15


def test_fundamental_of_other_coordinates_keeps_the_epipolar_constraint(table):
    rng = np.random.default_rng(7)
    F, a, b = rng.standard_normal((3, 3)), 3.0, 0.4
    shifts = rng.standard_normal((2, 2))
    moved = table.fundamental_of_coordinates(F, a, b, *shifts)
    assert np.linalg.norm(moved) == pytest.approx(1.0, rel=1e-14)
    p = np.concatenate([rng.standard_normal((2, 2, 20)), np.ones((2, 1, 20))], axis=1)
    q = [(a * points[:2] + shift[:, None]) / b for points, shift in zip(p, shifts, strict=True)]
    q = [np.vstack([points, np.ones(20)]) for points in q]
    new = np.einsum("in,ij,jn->n", p[1], moved, p[0])
    old = np.einsum("in,ij,jn->n", q[1], F, q[0])
    np.testing.assert_allclose(new / new[0], old / old[0], rtol=1e-11)
    # There and back.
    back = table.fundamental_of_coordinates(moved, b / a, 1.0, *(-shifts / a))
    assert same_up_to_scale(back, F, 1e-14)
