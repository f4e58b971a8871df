"""The exact correction of a match: it satisfies the epipolar geometry and nothing nearer does.

The reference is Hartley and Sturm's polynomial of degree 6, whose real roots hold the minimum.
"""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from laws import distance, factor_cases, fundamental, fundamental_cases, matches

MATRICES = {name: F / np.linalg.norm(F) for name, F in fundamental_cases().items()}
#: Upper left blocks by name; what the frame has to diagonalise.
BLOCKS = {
    "general": [[0.3, -1.2], [0.7, 0.4]],
    "zero": [[0.0, 0.0], [0.0, 0.0]],
    "rank 1": [[1.0, 2.0], [2.0, 4.0]],
    "single entry": [[0.0, 0.0], [0.0, -2.0]],
    "identity": [[1.0, 0.0], [0.0, 1.0]],
    "half turn": [[-1.0, 0.0], [0.0, -1.0]],
    "rotation": [[0.6, -0.8], [0.8, 0.6]],
    "reflection": [[0.6, 0.8], [0.8, -0.6]],
    "diagonal, small first": [[0.1, 0.0], [0.0, 5.0]],
    "negative determinant": [[1.0, 2.0], [3.0, 4.0]],
    "tiny": [[1e-160, 0.0], [3e-160, 2e-160]],
    "nearly equal singular values": [[1.0, 1e-9], [0.0, 1.0]],
}


def homogeneous(q):
    """Return (x, y, 1)."""
    return np.concatenate([q, np.ones((1, *q.shape[1:]))])


def constraint(F, q1, q2):
    """Return q2^T F q1."""
    return np.einsum("i...,ij,j...->...", homogeneous(q2), F, homogeneous(q1))


def gradient(F, q1, q2):
    """Return the derivative of q2^T F q1 by (q1, q2)."""
    line1, line2 = F.T @ homogeneous(q2), F @ homogeneous(q1)
    return np.concatenate([line1[:2], line2[:2]])


def corrected(table, F, q1, q2):
    """Return multiplier, distance and corrected match."""
    frame = table.bilinear_frame(F)
    multiplier, _, d = table.foot_point_safe(*frame, q1, q2)
    q1_hat, q2_hat, _ = table.foot_point_derivative(*frame, q1, q2, multiplier)
    return multiplier, d, q1_hat, q2_hat


def epipoles(F):
    """Return the homogeneous epipoles of both images."""
    U, _, Vt = np.linalg.svd(F)
    return Vt[2], U[:, 2]


# ---------------------------------------------------------------- the frame


@pytest.mark.parametrize("name", BLOCKS)
def test_frame_diagonalises_the_upper_left_block(table, name):
    F = np.array([[0.0, 0.0, 0.3], [0.0, 0.0, -0.8], [1.1, 0.2, 0.5]])
    B = F[:2, :2] = np.array(BLOCKS[name])
    R1, R2, s, b1, b2, f = table.bilinear_frame(F)
    # Squares below 1e-308 underflow: entries below 1e-154, which are nothing beside the others.
    size = max(np.abs(B).max(), 1e-140)
    for R in (R1, R2):
        np.testing.assert_allclose(R.T @ R, np.eye(2), rtol=0, atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(R2.T @ B @ R1, np.diag(s), rtol=0, atol=4e-15 * size)
    assert s[0] >= abs(s[1])
    values = np.linalg.svd(B, compute_uv=False)
    np.testing.assert_allclose(np.abs(s), values, rtol=0, atol=4e-15 * size)
    np.testing.assert_allclose(b1, R1.T @ F[2, :2], rtol=0, atol=1e-15)
    np.testing.assert_allclose(b2, R2.T @ F[:2, 2], rtol=0, atol=1e-15)
    assert f == F[2, 2]


def test_frame_diagonalises_random_blocks(table):
    rng = np.random.default_rng(1)
    F = rng.standard_normal((3, 3, 500)) * 10.0 ** rng.uniform(-6, 6, 500)
    R1, R2, s, *_ = table.bilinear_frame(F)
    size = np.linalg.norm(F[:2, :2], axis=(0, 1))
    product = np.einsum("jin,jkn,kln->iln", R2, F[:2, :2], R1)
    expected = np.stack([[s[0], 0.0 * s[0]], [0.0 * s[1], s[1]]])
    assert np.all(np.abs(product - expected) <= 4e-15 * size)
    assert np.all(s[0] >= np.abs(s[1]))


# ---------------------------------------------------------------- the corrected match


def noisy(seed, F, count=60):
    """Return matches with noise from 0.001 to 30 times the scene."""
    rng = np.random.default_rng(seed)
    parts = [matches(rng, F, count, noise) for noise in (0.001, 0.03, 0.3, 3.0, 30.0)]
    return tuple(np.concatenate(part, axis=1) for part in zip(*parts, strict=True))


@pytest.mark.parametrize("name", MATRICES)
def test_corrected_match_satisfies_the_epipolar_geometry(table, name):
    F = MATRICES[name]
    _, _, q1_hat, q2_hat = corrected(table, F, *noisy(2, F))
    sizes = np.linalg.norm(homogeneous(q1_hat), axis=0) * np.linalg.norm(
        homogeneous(q2_hat), axis=0
    )
    # Rounding of the corrected points, relative to the largest terms of C.
    assert np.all(np.abs(constraint(F, q1_hat, q2_hat)) <= 1e-13 * sizes)


@pytest.mark.parametrize("name", MATRICES)
def test_distance_is_the_length_of_the_correction_with_the_sign_of_c(table, name):
    F = MATRICES[name]
    q1, q2 = noisy(3, F)
    _, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    shift = np.concatenate([q1 - q1_hat, q2 - q2_hat])
    # Cancellation in the shift: rounding of the coordinates.
    size = 1.0 + np.abs(np.concatenate([q1, q2])).max(axis=0)
    assert np.all(np.abs(np.linalg.norm(shift, axis=0) - np.abs(d)) <= 1e-14 * size)
    assert np.all(np.sign(d) == np.sign(constraint(F, q1, q2)))


@pytest.mark.parametrize("name", MATRICES)
def test_correction_is_along_the_gradient_at_the_corrected_match(table, name):
    F = MATRICES[name]
    q1, q2 = noisy(4, F)
    multiplier, _, q1_hat, q2_hat = corrected(table, F, q1, q2)
    shift = np.concatenate([q1 - q1_hat, q2 - q2_hat])
    normal = multiplier * gradient(F, q1_hat, q2_hat)
    size = 1.0 + np.abs(np.concatenate([q1, q2])).max(axis=0)
    # |l| is below 1 / s1, which bounds how the rounding of the gradient is amplified.
    assert np.all(np.abs(shift - normal) <= 1e-13 * size * (1.0 + np.abs(multiplier)))


@pytest.mark.parametrize("name", MATRICES)
def test_multiplier_stays_between_the_poles(table, name):
    F = MATRICES[name]
    s = table.bilinear_frame(F)[2]
    multiplier, *_ = corrected(table, F, *noisy(5, F))
    assert np.all(np.abs(multiplier) * s[0] < 1.0)


def polynomial_minimum(F, q1, q2):
    """Return the smallest squared correction of one match, after Hartley and Sturm (1997)."""
    shift1, shift2 = np.eye(3), np.eye(3)
    shift1[:2, 2], shift2[:2, 2] = q1, q2
    F = shift2.T @ F @ shift1
    turns, thirds = [], []
    for e in epipoles(F):
        e = e / np.hypot(e[0], e[1])
        turns.append(np.array([[e[0], e[1], 0.0], [-e[1], e[0], 0.0], [0.0, 0.0, 1.0]]))
        thirds.append(e[2] if abs(e[2]) > 1e-12 else 0.0)  # rounding of an epipole at infinity
    F = turns[1] @ F @ turns[0].T
    (a, b), (c, d) = F[1:, 1:]
    f1, f2 = thirds
    # g(t) = t ((at + b)^2 + f2^2 (ct + d)^2)^2 - (ad - bc) (1 + f1^2 t^2)^2 (at + b) (ct + d)
    ab, cd = np.array([a, b]), np.array([c, d])
    inner = np.convolve(ab, ab) + f2**2 * np.convolve(cd, cd)
    weight = np.array([f1**2, 0.0, 1.0])
    g = np.concatenate([np.convolve(inner, inner), [0.0]])
    g = np.concatenate([[0.0], g])
    last = np.convolve(np.convolve(weight, weight), np.convolve(ab, cd))
    g = g - (a * d - b * c) * last
    if not g.any():
        return 0.0

    def cost(t):
        with np.errstate(divide="ignore"):  # a line at infinity
            return t**2 / (1 + f1**2 * t**2) + (c * t + d) ** 2 / (
                (a * t + b) ** 2 + f2**2 * (c * t + d) ** 2
            )

    t = np.roots(g / np.abs(g).max()).real
    at_infinity = 1 / f1**2 + c**2 / (a**2 + f2**2 * c**2) if f1 else np.inf
    return min(cost(t).min(initial=np.inf), at_infinity)


@cache
def polynomial_minima(name):
    """Return the minima of noisy(6, F)."""
    F = MATRICES[name]
    q1, q2 = noisy(6, F)
    return np.array([polynomial_minimum(F, *pair) for pair in zip(q1.T, q2.T, strict=True)])


@pytest.mark.parametrize("name", [name for name in MATRICES if name != "sigma near 0"])
def test_correction_is_the_global_minimum_of_the_polynomial_of_degree_6(table, name):
    F = MATRICES[name]
    q1, q2 = noisy(6, F)
    _, d, *_ = corrected(table, F, q1, q2)
    reference = polynomial_minima(name)
    size = 1.0 + np.sum(q1**2 + q2**2, axis=0)
    # Every t of the polynomial is a legal correction and so is ours (tests above): none may be
    # below the minimum. Rounding is relative to the coordinates.
    assert np.all(d**2 <= reference * (1 + 1e-9) + 1e-14 * size)
    # The polynomial itself is badly conditioned on a few matches (math: 1 in 4000).
    agree = np.abs(d**2 - reference) <= 1e-7 * reference + 1e-13 * size
    assert np.mean(agree) >= 0.98


def test_correction_of_a_matrix_of_rank_1_goes_to_the_nearer_of_two_lines(table):
    # C = (u1 . q') (v1 . q): either point moves to its line. The polynomial fails here.
    U, V, sigma = factor_cases()["sigma near 0"]
    q1, q2 = noisy(6, fundamental(U, V, sigma))
    _, d, *_ = corrected(table, fundamental(U, V, sigma), q1, q2)
    to_lines = [
        np.abs(line @ homogeneous(q)) / np.linalg.norm(line[:2])
        for line, q in ((V[:, 0], q1), (U[:, 0], q2))
    ]
    # Up to sigma = 1e-9 times the coordinates.
    assert np.all(np.abs(np.abs(d) - np.minimum(*to_lines)) <= 1e-6)


def near_epipoles(F, seed):
    """Return matches with one or both points near an epipole, at 1e-1 to 1e-9, and which both."""
    rng = np.random.default_rng(seed)
    first, second = (e[:2] / e[2] for e in epipoles(F))
    q1, q2 = [], []
    for exponent in range(1, 10):
        for near1, near2 in ((True, False), (False, True), (True, True)):
            offset = 10.0**-exponent * rng.standard_normal((2, 2))
            q1.append(first + offset[0] if near1 else rng.standard_normal(2))
            q2.append(second + offset[1] if near2 else rng.standard_normal(2))
    return np.array(q1).T, np.array(q2).T, np.tile([False, False, True], 9)


@pytest.mark.parametrize(
    "name", ["general", "sigma near 0", "sigma 1", "forward motion", "reflection"]
)
def test_correction_is_the_global_minimum_near_epipoles(table, name):
    F = MATRICES[name]
    q1, q2, both = near_epipoles(F, 7)
    _, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    reference = np.array([polynomial_minimum(F, *pair) for pair in zip(q1.T, q2.T, strict=True)])
    size = 1.0 + np.sum(q1**2 + q2**2, axis=0)
    assert np.all(d**2 <= reference * (1 + 1e-9) + 1e-15 * size)
    assert np.all(np.abs(constraint(F, q1_hat, q2_hat)) <= 1e-13 * size)
    shift = np.concatenate([q1 - q1_hat, q2 - q2_hat])
    assert np.all(np.abs(np.linalg.norm(shift, axis=0) - np.abs(d)) <= 1e-13 * np.sqrt(size))
    # No match is farther than its nearest epipole: with q on e any q' is on its line. Near both
    # epipoles C is a quadratic form in the offsets, computed to 1e-16: its root is good to 1e-8.
    to_epipole = [
        np.linalg.norm(q - (e[:2] / e[2])[:, None], axis=0)
        for q, e in zip((q1, q2), epipoles(F), strict=True)
    ]
    rounding = np.where(both, 2e-8, 1e-14) * size
    assert np.all(np.abs(d) <= np.minimum(*to_epipole) * (1 + 1e-9) + rounding)


@pytest.mark.slow
def test_correction_is_the_global_minimum_of_thousands_of_matches(table):
    if table.name == "casadi":
        pytest.skip("the same formulas; slow")
    rng = np.random.default_rng(8)
    worse = 0
    for k in range(40):
        F = rng.standard_normal((3, 3))
        U, values, Vt = np.linalg.svd(F)
        F = U @ np.diag([1.0, values[1] / values[0], 0.0]) @ Vt
        q1, q2 = noisy(100 + k, F, 40)
        _, d, *_ = corrected(table, F, q1, q2)
        reference = np.array([polynomial_minimum(F, *p) for p in zip(q1.T, q2.T, strict=True)])
        size = 1.0 + np.sum(q1**2 + q2**2, axis=0)
        assert np.all(d**2 <= reference * (1 + 1e-9) + 1e-14 * size)
        worse += np.sum(np.abs(d**2 - reference) > 1e-7 * reference + 1e-13 * size)
    # Of 8000; where the polynomial's roots are inaccurate.
    assert worse <= 40


# ---------------------------------------------------------------- special matches


@pytest.mark.parametrize("name", MATRICES)
def test_noise_free_match_is_left_alone(table, name):
    F = MATRICES[name]
    q1, q2 = matches(np.random.default_rng(9), F, 200, 0.0)
    _, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    # Rounding of the matches themselves over the length of the gradient, at least 1e-3 here.
    normal = np.linalg.norm(gradient(F, q1, q2), axis=0)
    size = 1.0 + np.sum(q1**2 + q2**2, axis=0)
    assert np.all(np.abs(d) <= 1e-15 * size / normal)
    assert distance(q1_hat, q1) <= 1e-12
    assert distance(q2_hat, q2) <= 1e-12


def test_match_with_no_error_at_all_has_distance_zero(table):
    # C is exactly zero in floating point.
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    q1, q2 = np.array([[3.0, -1.0], [2.0, 0.5]]), np.array([[7.0, 4.0], [2.0, 0.5]])
    multiplier, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    assert not multiplier.any()
    assert not d.any()
    np.testing.assert_array_equal(q1_hat, q1)
    np.testing.assert_array_equal(q2_hat, q2)


EXACT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # epipoles at the origins


@pytest.mark.parametrize(("on1", "on2"), [(True, False), (False, True), (True, True)])
@pytest.mark.parametrize("F", [EXACT, -3.0 * EXACT, EXACT @ np.diag([1.0, 0.4, 1.0])])
def test_match_on_epipoles_has_distance_zero_and_finite_derivatives(table, F, on1, on2):
    q1 = np.zeros((2, 1)) if on1 else np.array([[0.7], [-0.2]])
    q2 = np.zeros((2, 1)) if on2 else np.array([[-1.5], [0.3]])
    frame = table.bilinear_frame(F)
    for foot in (table.foot_point, table.foot_point_safe):
        multiplier, change, d = foot(*frame, q1, q2)
        assert not any(value.any() for value in (multiplier, change, d))
    q1_hat, q2_hat, derivative = table.foot_point_derivative(*frame, q1, q2, multiplier)
    # Rotated into the frame and back.
    assert distance(q1_hat, q1) <= 1e-15
    assert distance(q2_hat, q2) <= 1e-15
    assert np.all(np.isfinite(derivative))
    weight = np.ones(1)
    g, N = table.reprojection_gauss_newton(*frame, q1, q2, multiplier, weight)
    assert not g.any()
    assert np.all(np.isfinite(N))


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize(("on1", "on2"), [(True, False), (False, True), (True, True)])
def test_match_on_rounded_epipoles_is_finite(table, name, on1, on2):
    F = MATRICES[name]
    e1, e2 = epipoles(F)
    if (on1 and abs(e1[2]) < 1e-9) or (on2 and abs(e2[2]) < 1e-9):
        return  # that epipole is at infinity
    q1 = (e1[:2] / e1[2] if on1 else np.array([0.7, -0.2]))[:, None]
    q2 = (e2[:2] / e2[2] if on2 else np.array([-1.5, 0.3]))[:, None]
    _, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    # On both epipoles C, a quadratic form in the offsets, is rounding: its root is good to 1e-8.
    rounding = (2e-8 if on1 and on2 else 1e-14) * (1.0 + np.sum(q1**2 + q2**2))
    assert abs(d[0]) <= rounding
    assert distance(q1_hat, q1) <= rounding
    assert distance(q2_hat, q2) <= rounding


@pytest.mark.parametrize("scale", [1e-100, 1e-8, 1e8, 1e100])
def test_distance_does_not_depend_on_the_scale_of_f(table, scale):
    F = MATRICES["general"]
    q1, q2 = noisy(10, F)
    _, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    for sign in (1.0, -1.0):
        _, scaled, *hats = corrected(table, sign * scale * F, q1, q2)
        size = 1.0 + np.abs(np.concatenate([q1, q2])).max()
        assert distance(sign * scaled, d) <= 1e-13 * size
        assert distance(hats[0], q1_hat) <= 1e-13 * size
        assert distance(hats[1], q2_hat) <= 1e-13 * size


@pytest.mark.parametrize("name", MATRICES)
def test_swapping_the_images_transposes_f(table, name):
    F = MATRICES[name]
    q1, q2 = noisy(11, F)
    _, d, q1_hat, q2_hat = corrected(table, F, q1, q2)
    _, swapped, *hats = corrected(table, F.T.copy(), q2, q1)
    size = 1.0 + np.abs(np.concatenate([q1, q2])).max()
    assert distance(swapped, d) <= 1e-13 * size
    # A correction is less well determined than its length, near the poles.
    assert distance(hats[1], q1_hat) <= 1e-9 * size
    assert distance(hats[0], q2_hat) <= 1e-9 * size


# ---------------------------------------------------------------- the fast version


@pytest.mark.parametrize("name", MATRICES)
def test_fast_foot_point_that_settled_is_the_safe_one(table, name):
    F = MATRICES[name]
    q1, q2 = noisy(12, F)
    frame = table.bilinear_frame(F)
    multiplier, change, d = table.foot_point(*frame, q1, q2)
    safe, _, d_safe = table.foot_point_safe(*frame, q1, q2)
    # Newton's method converges quadratically: a relative change of 1e-7 leaves 1e-13.
    settled = np.abs(change) <= 1e-7 * np.abs(multiplier)
    assert np.mean(settled[:60]) > 0.9, "small noise settles in a few passes"
    assert np.all(np.abs(multiplier - safe)[settled] <= 1e-12 * np.abs(safe[settled]))
    assert np.all(np.abs(d - d_safe)[settled] <= 1e-12 * np.abs(d_safe[settled]))


@pytest.mark.parametrize("name", MATRICES)
def test_fast_foot_point_beyond_half_way_to_the_poles_does_not_count_as_settled(table, name):
    # Near the poles +-1 / s1 the fast form cancels: a tiny last change there proves nothing.
    F = MATRICES[name]
    frame = table.bilinear_frame(F)
    with np.errstate(all="ignore"):  # Newton may step onto a pole
        multiplier, change, _ = table.foot_point(*frame, *noisy(16, F, 4000))
        beyond = ~(frame[2][0] * np.abs(multiplier) < 0.5)
    np.testing.assert_array_equal(change[beyond], multiplier[beyond])


@pytest.mark.parametrize("name", MATRICES)
def test_safe_foot_point_has_converged_to_rounding(table, name):
    F = MATRICES[name]
    frame = table.bilinear_frame(F)
    multiplier, change, _ = table.foot_point_safe(*frame, *noisy(13, F))
    assert np.all(np.abs(change) <= 1e-13 * np.abs(multiplier) + 1e-300)


def test_sampson_distance_is_that_of_the_first_newton_step(table):
    # At first order in the noise the exact distance is Sampson's.
    for name, noise in itertools.product(("general", "sigma 1", "affine"), (1e-3, 1e-4)):
        F = MATRICES[name]
        q1, q2 = matches(np.random.default_rng(14), F, 100, noise)
        keep = np.linalg.norm(gradient(F, q1, q2), axis=0) > 0.3
        _, d, *_ = corrected(table, F, q1[:, keep], q2[:, keep])
        r, _ = table.sampson(F, q1[:, keep], q2[:, keep])
        # The difference is of second order in the noise, over the curvature radius of 0.3.
        assert np.abs(r[0] - d).max() <= 100 * noise**2
