"""Derivatives of the criteria of F, of exact distances and of losses, against differences."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge import kernels
from epigauge.kernels import SIGNATURES
from laws import (
    assert_jacobian,
    central_differences,
    distance,
    factor_cases,
    fundamental_cases,
    matches,
    unpacked,
    vect,
)

# The back ends agree (test_backends.py): the fast one, where it is there.
K = kernels.table("c" if kernels.available()["c"] is None else "numpy")
UPPER = np.triu_indices(9)
CASES = factor_cases()
MATRICES = fundamental_cases()
COUNT = 7
# Near an epipole residuals change with F over a range of about 0.01, and the fifth derivative is
# large. At this step truncation is below 1e-10 even there, and rounding, 1e-16 / STEP times the
# condition of a foot point, below 1e-9.
STEP, TOLERANCE = 2e-5, 1e-8


# ---------------------------------------------------------------- criteria without structure


CRITERIA = [name for name, s in SIGNATURES.items() if s.outputs[-1].name == "dr_dF"]


@pytest.mark.parametrize("name", ["sampson", "algebraic"])
def test_criterion_derivatives_are_those_casadi_takes(name):
    casadi = pytest.importorskip("casadi")

    F, q1, q2 = casadi.SX.sym("F", 3, 3), casadi.SX.sym("q1", 2), casadi.SX.sym("q2", 2)
    C = casadi.bilin(F, casadi.vertcat(q2, 1), casadi.vertcat(q1, 1))
    r = C
    if name == "sampson":
        r = C / casadi.norm_2(casadi.gradient(C, casadi.vertcat(q1, q2)))
    own = casadi.Function("own", [F, q1, q2], [r, casadi.jacobian(r, vect(F))])
    rng = np.random.default_rng(4)
    for case in MATRICES.values():
        pair = matches(rng, case, 1, 0.3)
        value, derivative = (np.asarray(x) for x in own(case, *pair))
        r_, dr_dF = getattr(K, name)(case, *pair)
        scale = max(1.0, np.abs(derivative).max())
        assert np.abs(r_ - value).max() <= 1e-12 * scale
        assert np.abs(dr_dF[..., 0] - derivative).max() <= 1e-12 * scale


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("case", MATRICES)
def test_criterion_derivatives(name, case):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    q1, q2 = matches(np.random.default_rng(5), F, COUNT, 0.1)
    _, dr_dF = getattr(K, name)(F, q1, q2)
    expected = central_differences(lambda x: getattr(K, name)(x, q1, q2)[0], F, STEP)
    expected = np.moveaxis(expected.reshape(-1, COUNT, 9), 1, 2)
    assert distance(dr_dF, expected) <= TOLERANCE


def cauchy(s, scale2):
    """Return rho' and rho'' of rho(s) = c^2 log(1 + s / c^2)."""
    first = 1.0 / (1.0 + s / scale2)
    return first, -(first**2) / scale2


SCALE2 = 0.3**2


@pytest.mark.parametrize("robust", [False, True], ids=["plain", "cauchy"])
@pytest.mark.parametrize("name", ["sampson", "epipolar"])
@pytest.mark.parametrize("case", MATRICES)
def test_criterion_gradient_and_hessian(name, case, robust):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    pair = matches(np.random.default_rng(6), F, COUNT, 0.1)

    def squares(x):
        return np.sum(getattr(K, name)(x, *pair)[0] ** 2, axis=0)

    def cost(x):
        s = squares(x)
        return 0.5 * np.sum(SCALE2 * np.log1p(s / SCALE2) if robust else s)

    def weights(x):
        first, second = cauchy(squares(x), SCALE2)
        # `curvature` multiplies the square of the gradient of s / 2.
        return (first, 2.0 * second) if robust else (np.ones(COUNT), np.zeros(COUNT))

    def gradient(x):
        return getattr(K, f"{name}_newton")(x, *pair, *weights(x))[1]

    half, g, normal, H = getattr(K, f"{name}_newton")(F, *pair, *weights(F))
    assert distance(g, central_differences(cost, F, STEP).ravel()) <= TOLERANCE
    assert distance(unpacked(H), central_differences(gradient, F, STEP).reshape(9, 9)) <= TOLERANCE
    r, dr_dF = getattr(K, name)(F, *pair)
    weight = weights(F)[0]
    N = np.einsum("kin,kjn,n->ij", dr_dF, dr_dF, weight)
    half_too, got, packed = getattr(K, f"{name}_gauss_newton")(F, *pair, weight)
    assert half == pytest.approx(0.5 * np.sum(weight * r**2), rel=1e-13)
    assert half_too == pytest.approx(half, rel=1e-14)
    assert distance(unpacked(packed), N) <= 1e-13
    assert distance(normal, packed) <= 1e-14
    assert distance(got, np.einsum("kin,kn,n->i", dr_dF, r, weight)) <= 1e-13


# ---------------------------------------------------------------- exact reprojection error


def foot(F, pair):
    """Return frame, multiplier and distance of matches."""
    frame = K.bilinear_frame(F)
    multiplier, _, d = K.foot_point_safe(*frame, *pair)
    return frame, multiplier, d


def to_images(frame):
    """Return the matrix that takes derivatives by the rotated F to derivatives by F."""
    R1, R2 = np.eye(3), np.eye(3)
    R1[:2, :2], R2[:2, :2] = frame[:2]
    return np.kron(R2, R1)


@pytest.mark.parametrize("case", MATRICES)
def test_distance_derivative(case):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    pair = matches(np.random.default_rng(7), F, COUNT, 0.1)
    frame, multiplier, d = foot(F, pair)
    _, _, dd_dF = K.foot_point_derivative(*frame, *pair, multiplier)
    assert np.abs(d).min() > 1e-4
    expected = central_differences(lambda x: foot(x, pair)[2], F, STEP).reshape(COUNT, 9).T
    assert distance(dd_dF, expected) <= TOLERANCE


@pytest.mark.parametrize("case", MATRICES)
def test_distance_derivative_where_the_distance_is_zero(case):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    pair = matches(np.random.default_rng(8), F, COUNT, 0.0)
    frame, multiplier, _ = foot(F, pair)
    _, _, dd_dF = K.foot_point_derivative(*frame, *pair, multiplier)
    # One of the matches is so near an epipole that d changes over a range of 0.01 in F.
    expected = central_differences(lambda x: foot(x, pair)[2], F, STEP / 100).reshape(COUNT, 9).T
    assert distance(dd_dF, expected) <= TOLERANCE


@pytest.mark.parametrize(
    ("case", "robust"),
    [
        *((case, False) for case in MATRICES),
        *((case, True) for case in ("general", "sigma 1", "both at infinity", "forward motion")),
    ],
)
def test_reprojection_gradient_and_hessian(case, robust):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    pair = matches(np.random.default_rng(9), F, COUNT, 0.1)

    def cost(x):
        d2 = foot(x, pair)[2] ** 2
        return 0.5 * np.sum(SCALE2 * np.log1p(d2 / SCALE2) if robust else d2)

    def weights(d):
        first, second = cauchy(d**2, SCALE2)
        # `curvature` multiplies the square of the gradient of d^2 / 2.
        return (first, 2.0 * second) if robust else (np.ones(COUNT), np.zeros(COUNT))

    def derivatives(x):
        frame, multiplier, d = foot(x, pair)
        g, _, H = K.reprojection_newton(*frame, *pair, multiplier, *weights(d))
        turn = to_images(frame)
        return turn @ g, turn @ unpacked(H) @ turn.T

    g, H = derivatives(F)
    assert distance(g, central_differences(cost, F, STEP).ravel()) <= TOLERANCE
    differences = central_differences(lambda x: derivatives(x)[0], F, STEP).reshape(9, 9)
    assert distance(H, differences) <= TOLERANCE


@pytest.mark.parametrize("case", MATRICES)
def test_gauss_newton_is_made_of_distance_derivatives(case):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    pair = matches(np.random.default_rng(10), F, COUNT, 0.1)
    frame, multiplier, d = foot(F, pair)
    _, _, dd_dF = K.foot_point_derivative(*frame, *pair, multiplier)
    weight = np.linspace(0.5, 2.0, COUNT)
    g, N = K.reprojection_gauss_newton(*frame, *pair, multiplier, weight)
    turn = to_images(frame)
    assert distance(turn @ g, dd_dF @ (weight * d)) <= 1e-12
    assert distance(turn @ unpacked(N) @ turn.T, (dd_dF * weight) @ dd_dF.T) <= 1e-12


@pytest.mark.parametrize("case", MATRICES)
def test_hessian_is_gauss_newton_where_the_distances_are_zero(case):
    F = MATRICES[case] / np.linalg.norm(MATRICES[case])
    pair = matches(np.random.default_rng(11), F, COUNT, 0.0)
    frame, multiplier, _ = foot(F, pair)
    weight = np.ones(COUNT)
    _, normal, H = K.reprojection_newton(*frame, *pair, multiplier, weight, np.zeros(COUNT))
    _, N = K.reprojection_gauss_newton(*frame, *pair, multiplier, weight)
    assert distance(normal, N) <= 1e-14
    assert distance(H, N) <= 1e-12


LOSSES = [name for name, s in SIGNATURES.items() if s.family == "losses"]


@pytest.mark.parametrize("name", LOSSES)
def test_loss_derivatives(name):
    # On both sides of the scale, none on it, where the second derivative may jump.
    squared = np.array([0.02, 0.3, 0.65, 0.75, 1.3, 9.0])
    _, first, second = getattr(K, name)(squared, 0.7)
    assert_jacobian(lambda s: getattr(K, name)(s, 0.7)[0], squared, np.diag(first))
    assert_jacobian(lambda s: getattr(K, name)(s, 0.7)[1], squared, np.diag(second))
