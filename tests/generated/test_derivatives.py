"""Every generated Jacobian and Hessian against central differences, through the retraction.

The tests name the kernels they check, and the last one fails when a kernel has a derivative that
no test here has checked.
"""

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


def second_differences(f, size):
    """Differentiate `f` twice at zero."""
    # Nested: rounding 1e-16 / h^2 and truncation h^4 are both about 1e-10 at this step.
    zero, step = np.zeros(size), 5e-3

    def first(a):
        return central_differences(lambda b: f(a + b), zero, step)

    return central_differences(first, zero, step)


# ---------------------------------------------------------------- charts of F and P'


@pytest.mark.parametrize("case", CASES)
def test_rotation_derivatives(case):
    U, _, _ = CASES[case]
    dU, d2U = K.rotation_derivatives(U)

    def moved(theta):
        return K.rotate_columns(U, theta)

    assert_jacobian(moved, np.zeros(3), dU)
    assert distance(d2U, second_differences(moved, 3)) <= 1e-8


@pytest.mark.parametrize("case", CASES)
def test_fundamental_derivatives_through_the_retraction(case):
    factors = CASES[case]
    F, dF, d2F = K.fundamental_derivatives(*factors)
    assert distance(F, K.fundamental_from_factors(*factors)) <= 1e-15

    def moved(delta):
        return K.fundamental_from_factors(*K.retract_factors(*factors, delta)).ravel()

    assert_jacobian(moved, np.zeros(7), dF)
    assert distance(d2F, second_differences(moved, 7)) <= 1e-8


@pytest.mark.parametrize("case", CASES)
def test_canonical_camera_derivatives_through_the_retraction(case):
    factors = CASES[case]
    P2, A_perp = K.canonical_camera_derivatives(*factors)
    assert distance(P2, K.canonical_camera(*factors)) <= 1e-15

    def moved(delta):
        return K.canonical_camera(*K.retract_factors(*factors, delta)).ravel()

    assert_jacobian(moved, np.zeros(7), A_perp)


def block_matrices():
    """Return 2x2 matrices of unit norm: singular values different, equal, and one zero."""
    general = np.array([[0.5, -0.3], [0.2, 0.7]])
    equal = np.array([[0.6, -0.8], [0.8, 0.6]])
    mirrored = np.array([[0.6, 0.8], [0.8, -0.6]])
    single = np.array([[0.2, 0.4], [0.1, 0.2]])
    return [M / np.linalg.norm(M) for M in (general, equal, mirrored, single)]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("M", block_matrices(), ids=["general", "equal", "mirrored", "single"])
def test_block_derivatives_through_the_retraction(case, M):
    factors = (*CASES[case][:2], M)
    F, dF, d2F = K.block_derivatives(*factors)
    P2, dP2 = K.block_camera_derivatives(*factors)

    def moved(delta):
        return K.block_derivatives(*K.block_retract(*factors, delta))[0].ravel()

    def moved_camera(delta):
        return K.block_camera_derivatives(*K.block_retract(*factors, delta))[0].ravel()

    assert distance(moved(np.zeros(7)), F.ravel()) <= 1e-15
    assert distance(moved_camera(np.zeros(7)), P2.ravel()) <= 1e-15
    assert_jacobian(moved, np.zeros(7), dF)
    assert_jacobian(moved_camera, np.zeros(7), dP2)
    assert distance(d2F, second_differences(moved, 7)) <= 1e-8


@pytest.mark.parametrize("case", CASES)
def test_essential_derivatives_through_the_retraction(case):
    factors = CASES[case][:2]
    F, dF, d2F = K.essential_derivatives(*factors)
    P2, dP2 = K.essential_camera_derivatives(*factors)

    def moved(delta):
        return K.essential_derivatives(*K.essential_retract(*factors, delta))[0].ravel()

    def moved_camera(delta):
        return K.essential_camera_derivatives(*K.essential_retract(*factors, delta))[0].ravel()

    assert distance(moved(np.zeros(5)), F.ravel()) <= 1e-15
    assert distance(moved_camera(np.zeros(5)), P2.ravel()) <= 1e-15
    assert_jacobian(moved, np.zeros(5), dF)
    assert_jacobian(moved_camera, np.zeros(5), dP2)
    assert distance(d2F, second_differences(moved, 5)) <= 1e-8


@pytest.mark.parametrize("case", CASES)
def test_essential_update_keeps_r_where_t_moves_and_t_where_r_turns(case):
    U, V = CASES[case][:2]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved_t, turned = [0.0, 0.0, 0.0, 0.3, -0.2], [0.3, -0.2, 0.5, 0.0, 0.0]
    U_new, V_new = K.essential_retract(U, V, moved_t)
    assert distance(U_new @ quarter @ V_new.T, U @ quarter @ V.T) <= 1e-15
    assert np.linalg.norm(U_new[:, 2] - U[:, 2]) > 0.3
    U_new, V_new = K.essential_retract(U, V, turned)
    assert distance(U_new, U) == 0.0
    assert np.linalg.norm(V_new - V) > 0.3


def test_essential_constraints_are_the_polar_form_of_a_cubic(table):
    rng = np.random.default_rng(3)
    A, B, C = rng.standard_normal((3, 3, 3))
    form = table.essential_constraints

    def cubic(E):
        return np.append(2 * E @ E.T @ E - np.trace(E @ E.T) * E, np.linalg.det(E))

    assert distance(form(A, A, A), cubic(A)) <= 1e-14
    assert distance(form(A, B, C), form(C, A, B)) <= 1e-14
    assert distance(form(2.0 * A - B, B, C), 2.0 * form(A, B, C) - form(B, B, C)) <= 1e-14
    # Zero for [t]_x R, by another way than the factors
    R = np.linalg.qr(A)[0]
    E = np.cross(rng.standard_normal(3), R, axisb=0, axisc=0)
    assert np.abs(form(E, E, E)).max() <= 1e-14 * np.linalg.norm(E) ** 3


def test_maps_derivatives():
    parameters = np.random.default_rng(7).uniform(-1.0, 1.0, 7)
    _, dF, d2F, _, dP2 = K.maps(parameters)
    assert_jacobian(lambda p: K.maps(p)[0].ravel(), parameters, dF)
    assert_jacobian(lambda p: K.maps(p)[1], parameters, d2F)
    assert_jacobian(lambda p: K.maps(p)[3].ravel(), parameters, dP2)


# ---------------------------------------------------------------- projections


def cameras(rng):
    """Return cameras and points: general, at infinity, and near the focal plane."""
    P, Q = rng.standard_normal((3, 4)), rng.standard_normal(4)
    infinite = np.append(rng.standard_normal(3), 0.0)
    near = rng.standard_normal(4)
    near[3] = (0.05 - P[2, :3] @ near[:3]) / P[2, 3]  # depth 0.05
    return {"general": (P, Q), "at infinity": (P, infinite), "near the focal plane": (P, near)}


@pytest.mark.parametrize("case", cameras(np.random.default_rng(0)))
def test_projection_derivatives(case):
    P, Q = cameras(np.random.default_rng(0))[case]
    q_hat, J_P, J_Q, depth = K.project(P, Q)
    h = P @ Q
    np.testing.assert_allclose(q_hat, h[:2] / h[2], rtol=1e-13)
    np.testing.assert_allclose(depth, h[2], rtol=1e-13)
    # The steps change the depth by at most a thousandth of it.
    step = 1e-3 * abs(float(depth)) / np.abs([*P.ravel(), *Q]).max()
    assert_jacobian(lambda x: K.project(x, Q)[0], P, J_P.reshape(2, 3, 4), step=step)
    assert_jacobian(lambda x: K.project(P, x)[0], Q, J_Q, step=step)


@pytest.mark.parametrize("case", cameras(np.random.default_rng(0)))
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["in front", "behind"])
def test_log_depth_derivatives(case, sign):
    P, Q = cameras(np.random.default_rng(0))[case]
    P, Q = sign * P, np.array(Q)
    depth = float(K.project(P, Q)[3])
    step = 1e-3 * abs(depth) / np.abs([*P.ravel(), *Q]).max()
    Z_P, Z_Q = K.log_depth_derivatives(P, Q)
    assert_jacobian(lambda x: np.log(abs(K.project(x, Q)[3])), P, Z_P.reshape(3, 4), step=step)
    assert_jacobian(lambda x: np.log(abs(K.project(P, x)[3])), Q, Z_Q, step=step)


def exponential(E):
    """Return exp(E) of a matrix of norm below 0.1."""
    term = total = np.eye(len(E))
    for k in range(1, 12):
        term = term @ E / k
        total = total + term
    return total


def test_generators_are_the_derivatives_of_a_change_of_basis():
    rng = np.random.default_rng(12)
    P, Q = rng.standard_normal((3, 4)), rng.standard_normal(4)
    zero = np.zeros((4, 4))
    G_P, G_Q = K.camera_generators(P), K.point_generators(Q)
    assert_jacobian(lambda E: (P @ exponential(E)).ravel(), zero, G_P.reshape(12, 4, 4))
    assert_jacobian(lambda E: exponential(-E) @ Q, zero, G_Q.reshape(4, 4, 4))
    # Together they move no image point, and no depth.
    _, J_P, J_Q, _ = K.project(P, Q)
    assert np.abs(J_P @ G_P + J_Q @ G_Q).max() <= 1e-12 * np.abs(J_Q).max()
    Z_P, Z_Q = K.log_depth_derivatives(P, Q)
    assert np.abs(Z_P @ G_P + Z_Q @ G_Q).max() <= 1e-12 * np.abs(Z_Q).max()


def test_scales_move_no_image_point_and_the_depth_by_their_sum():
    rng = np.random.default_rng(13)
    P, Q = rng.standard_normal((3, 4)), rng.standard_normal(4)
    _, J_P, J_Q, _ = K.project(P, Q)
    Z_P, Z_Q = K.log_depth_derivatives(P, Q)
    assert np.abs(J_P @ P.ravel()).max() <= 1e-12 * np.abs(J_P).max()
    assert np.abs(J_Q @ Q).max() <= 1e-12 * np.abs(J_Q).max()
    assert Z_P @ P.ravel() == pytest.approx(1.0, rel=1e-12)
    assert Z_Q @ Q == pytest.approx(1.0, rel=1e-12)


def test_two_view_structure_derivatives():
    rng = np.random.default_rng(1)
    P2, S = rng.standard_normal((3, 4)), rng.standard_normal((3, COUNT))
    q1, q2 = rng.standard_normal((2, 2, COUNT))
    r, J_S, J_P2 = K.two_view_structure(P2, S, q1, q2)
    points = np.stack([S[0], S[1], np.ones(COUNT), S[2]])
    np.testing.assert_allclose(r[:2], q1 - K.project(np.eye(3, 4), points)[0], atol=1e-14)
    np.testing.assert_allclose(r[2:], q2 - K.project(P2, points)[0], rtol=1e-12)
    step = 1e-3 * np.abs(P2[2] @ points).min()
    for k in range(COUNT):
        one = (q1[:, k], q2[:, k])
        assert_jacobian(
            lambda s, one=one: K.two_view_structure(P2, s, *one)[0], S[:, k], J_S[..., k], step=step
        )
        assert_jacobian(
            lambda p, one=one, k=k: K.two_view_structure(p, S[:, k], *one)[0][2:],
            P2,
            J_P2[..., k].reshape(2, 3, 4),
            step=step,
        )





def test_projection_derivatives_are_those_casadi_takes():
    casadi = pytest.importorskip("casadi")
    from epigauge_generated.casadi_backend import camera

    P, Q = casadi.SX.sym("P", 3, 4), casadi.SX.sym("Q", 4)
    h = P @ Q
    q_hat = h[:2] / h[2]
    own = casadi.Function(
        "own", [P, Q], [casadi.jacobian(q_hat, vect(P)), casadi.jacobian(q_hat, Q)]
    )
    rng = np.random.default_rng(2)
    for _ in range(20):
        point = rng.standard_normal((3, 4)), rng.standard_normal(4)
        J_P, J_Q = (np.asarray(J) for J in own(*point))
        # Two orders of the same dozen operations.
        assert distance(K.project(*point)[1], J_P) <= 1e-12
        assert distance(K.project(*point)[2], J_Q) <= 1e-12
        generated = camera.project()(P=point[0], Q=point[1])
        assert distance(np.asarray(generated["J_P"]), J_P) <= 1e-12


@pytest.mark.parametrize("eta", [0.0, 0.05, 0.9, 1.0])
def test_pseudo_object_space_derivatives(eta):
    rng = np.random.default_rng(12)
    P, X, q = rng.standard_normal((3, 4)), rng.standard_normal(3), rng.standard_normal(2)
    r, J_P, J_X = K.pseudo_object_space(eta, P, X, q)
    h = P @ [*X, 1.0]
    parts = np.sqrt(1.0 - eta) * (h[:2] - h[2] * q), np.sqrt(eta) * (h[:2] - q)
    np.testing.assert_allclose(r, np.concatenate(parts), rtol=0.0, atol=1e-14)

    assert_jacobian(lambda x: K.pseudo_object_space(eta, x, X, q)[0], P, J_P.reshape(4, 3, 4))
    assert_jacobian(lambda x: K.pseudo_object_space(eta, P, x, q)[0], X, J_X)


def test_blocks_of_a_gauge_transformation():
    rng = np.random.default_rng(13)
    T, P, Q = rng.standard_normal((4, 4)), rng.standard_normal((3, 4)), rng.standard_normal(4)
    inverse, gamma, alpha = np.linalg.inv(T), 1.7, -0.6
    camera, point = K.camera_transformation(T, gamma), K.point_transformation(inverse, alpha)
    assert_jacobian(lambda P: (gamma * P @ T).ravel(), P, camera.reshape(12, 3, 4))
    assert_jacobian(lambda Q: alpha * inverse @ Q, Q, point)
    for W, block in zip(K.implicit_damping(T, inverse, gamma, alpha), (camera, point), strict=True):
        assert distance(block.T @ W @ block, np.eye(len(block))) <= 1e-12


def test_the_first_epipolar_distance_is_that_in_the_first_image():
    rng = np.random.default_rng(15)
    F, q1, q2 = rng.standard_normal((3, 3)), rng.standard_normal(2), rng.standard_normal(2)
    r, _ = K.epipolar(F, q1, q2)
    for distance_px, line, q in zip(
        r, (F.T @ [*q2, 1.0], F @ [*q1, 1.0]), (q1, q2), strict=True
    ):
        expected = (line[:2] @ q + line[2]) / np.hypot(*line[:2])
        assert distance_px == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("count", [1, 9, 700])
def test_equations_of_the_8_point_algorithm(count):
    # Weights of zero and one tell which matches count; others weigh the equations.
    rng = np.random.default_rng(14)
    q1, q2, F = (rng.standard_normal(s) for s in ((2, count), (2, count), (3, 3)))
    weight = rng.choice([0.0, 0.5, 1.0], count)
    _, row = K.algebraic(F, q1, q2)
    A = row.reshape(9, count)
    N, g = K.algebraic_normal(q1, q2, weight), K.algebraic_gradient(F, q1, q2, weight)
    assert distance(N, ((A * weight) @ A.T)[UPPER]) <= 1e-14
    assert distance(g, (A * weight) @ A.T @ F.ravel()) <= 1e-14


# ---------------------------------------------------------------- self-calibration


def test_camera_intrinsics_through_the_change_of_basis():
    rng = np.random.default_rng(5)
    for _ in range(4):
        P = np.column_stack([np.eye(3) + 0.3 * rng.standard_normal((3, 3)), rng.standard_normal(3)])

        def moved(delta, P=P):
            basis = np.eye(4)
            basis[[0, 0, 0, 1, 1], [0, 1, 2, 1, 2]] += delta[:5]
            basis[3, :3] = delta[5:]
            return K.camera_intrinsics(P @ basis)[0]

        assert_jacobian(moved, np.zeros(8), K.camera_intrinsics(P)[1], tolerance=1e-7)


def test_two_view_focals_by_f_and_principal_points():
    rng = np.random.default_rng(6)
    for _ in range(4):
        F, e1, e2 = rng.standard_normal((3, 3)), rng.standard_normal(3), rng.standard_normal(3)
        c = 0.1 * rng.standard_normal(4)
        _, J_F, J_c = K.two_view_focals(F, c[:2], c[2:], e1, e2)

        def of_f(f, c=c, e1=e1, e2=e2):
            return K.two_view_focals(f.reshape(3, 3), c[:2], c[2:], e1, e2)[0]

        def of_c(c, F=F, e1=e1, e2=e2):
            return K.two_view_focals(F, c[:2], c[2:], e1, e2)[0]

        assert_jacobian(of_f, F.ravel(), J_F, step=1e-4, tolerance=1e-6)
        assert_jacobian(of_c, c, J_c, step=1e-4, tolerance=1e-6)


def test_dual_image_rows_are_the_image_of_a_quadric():
    rng = np.random.default_rng(7)
    P, root = rng.standard_normal((3, 4)), rng.standard_normal((4, 4))
    quadric = root + root.T
    image = P @ quadric @ P.T
    found = K.dual_image_rows(P) @ quadric[np.triu_indices(4)]
    assert distance(found, image[np.triu_indices(3)]) <= 1e-14


def test_every_derivative_is_checked_here():
    # Criteria and losses: test_criterion_derivatives.py.
    criteria = [name for name, s in SIGNATURES.items() if s.outputs[-1].name == "dr_dF"]
    losses = [name for name, s in SIGNATURES.items() if s.family == "losses"]
    checked = {
        "camera_intrinsics",
        "two_view_focals",
        "dual_image_rows",
        "camera_transformation",
        "point_transformation",
        "implicit_damping",
        "algebraic_normal",
        "algebraic_gradient",
        *losses,
        "pseudo_object_space",
        "rotation_derivatives",
        "fundamental_derivatives",
        "canonical_camera_derivatives",
        "block_derivatives",
        "block_camera_derivatives",
        "essential_derivatives",
        "essential_camera_derivatives",
        "project",
        "log_depth_derivatives",
        "camera_generators",
        "point_generators",
        "two_view_structure",
        "foot_point_derivative",
        "reprojection_gauss_newton",
        "reprojection_newton",
        *criteria,
        *(f"{name}{kind}_newton" for name in ("sampson", "epipolar") for kind in ("", "_gauss")),
        "maps",
    }
    # Names of outputs that are no derivatives.
    values = {"r", "F", "P2", "R", "U_new", "V_new", "M_new", "sigma_new", "q_hat", "depth"}
    values |= {"R1", "R2", "s", "b1", "b2", "f", "multiplier", "last_change", "c", "d", "e"}
    values |= {"moved"}
    derived = {n for n, s in SIGNATURES.items() if {a.name for a in s.outputs} - values}
    # Parts of normal equations: test_bundle.py, test_joint.py compare them with their definition.
    derived -= {name for name, s in SIGNATURES.items() if s.family in ("bundle", "joint")}
    # Solutions of samples of matches, and how well these agree with them: test_search.py.
    derived -= {name for name, s in SIGNATURES.items() if s.family in ("minimal", "search")}
    # The same of homographies: test_homography.py.
    derived -= {name for name, s in SIGNATURES.items() if s.family == "homography"}
    # Updates, images and residuals of lines: test_lines.py.
    derived -= {name for name, s in SIGNATURES.items() if s.family == "lines"}
    # The polynomials of three points and their roots: tests/runtime/test_metric_growth.py; those of
    # a shared focal length against moved F and centres: tests/runtime/test_metric_upgrade.py.
    derived -= {"three_points", "shared_focal"}
    # Camera models: test_cameras.py.
    derived -= {name for name, s in SIGNATURES.items() if s.family.startswith("cameras_")}
    # A kernel of one F each is compared with the one of a shared F in test_backends.py.
    assert {name.removesuffix("_each") for name in derived} - checked == set()
