"""Distances, corrected matches, points and cameras against references that share no formula."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.errors import ArgumentError
from epigauge.scenes import two_view_scene
from epigauge.two_view.conditioning import condition, displaced
from epigauge.two_view.criteria import Reprojection
from two_views import (
    Array,
    algebraic,
    cross,
    homogeneous,
    normalizing,
    project,
    same_geometry,
    up_to_sign,
)


def fundamental(P1: Array, P2: Array) -> Array:
    """F of two cameras by the textbook: [e']x P2 P1^+, with e' the image of the first centre."""
    centre = np.linalg.svd(P1)[2][-1]
    F = cross(P2 @ centre) @ P2 @ np.linalg.pinv(P1)
    return F / np.linalg.norm(F)


def random_cameras(seed: int) -> tuple[Array, Array]:
    """General projective cameras, neither of them (I | 0), with points in front of both."""
    rng = np.random.default_rng(seed)
    cameras = []
    for side in (-1, 1):
        Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        Q *= np.sign(np.linalg.det(Q))
        small = np.eye(3) + 0.2 * (Q - np.eye(3))
        K = np.array([[800 + 100 * rng.random(), 3, 320], [0, 750, 240], [0, 0, 1]])
        P = K @ np.column_stack([small, [side * (0.5 + rng.random()), rng.random(), 5.0]])
        cameras.append(P * rng.uniform(-3, 3))  # of any scale and sign
    return cameras[0], cameras[1]


def some_matches(seed: int, m: int = 50, noise: float = 1.0):
    P1, P2 = random_cameras(seed)
    rng = np.random.default_rng(seed + 1000)
    X = np.column_stack([rng.uniform(-1, 1, (m, 3)), np.ones(m)])
    x1 = project(P1, X) + noise * rng.standard_normal((m, 2))
    x2 = project(P2, X) + noise * rng.standard_normal((m, 2))
    return P1, P2, X, x1, x2


def scenes():
    """Scenes of all kinds: wide and narrow, sideways and forward, little noise and much."""
    rng = np.random.default_rng(0)
    for seed in range(60):
        yield two_view_scene(
            rng.uniform(1.6, 20),
            motion=("sideways", "forward")[seed % 2],
            seed=seed,
            noise_px=(0.1, 1.0, 10.0)[seed % 3],
            baseline=rng.uniform(0.3, 1.4),
        )


class TestReprojectionDistances:
    def test_never_above_the_polynomial_method_and_mostly_equal(self) -> None:
        cv2 = pytest.importorskip("cv2")
        excess, lost = [], 0
        for view in scenes():
            d, _, _ = eg.reprojection_distances(view.F_true, view.x1, view.x2)
            theirs = cv2.correctMatches(view.F_true, view.x1[None], view.x2[None])
            shifts = np.concatenate([theirs[0][0] - view.x1, theirs[1][0] - view.x2], axis=1)
            other = np.linalg.norm(shifts, axis=1)
            finite = np.isfinite(other)
            lost += np.count_nonzero(~finite)
            excess.extend((np.abs(d) - other)[finite])
        assert len(excess) == 3000 - lost > 2950
        assert np.median(np.abs(excess)) < 1e-12  # pixels
        # Roots of a polynomial of degree six have about half the digits.
        assert max(excess) < 1e-8

    @pytest.mark.parametrize("seed", range(6))
    def test_no_pair_on_the_epipolar_geometry_is_nearer(self, seed) -> None:
        """Brute force: pairs of corresponding epipolar lines that cross the images, in turn."""
        view = two_view_scene((2.0, 12.0)[seed % 2], noise_px=5.0, seed=seed)
        F = view.F_true
        d, _, _ = eg.reprojection_distances(F, view.x1, view.x2)
        e = np.linalg.svd(F)[2][-1]
        size = 1.2 * np.abs(view.x1).max()
        side = np.column_stack([np.linspace(-size, size, 4001), np.full(4001, size), np.ones(4001)])
        swapped = side[:, [1, 0, 2]]
        border = np.vstack([side, swapped, side * [1, -1, 1], swapped * [-1, 1, 1]])

        def offsets(lines: Array, x: Array) -> Array:
            return lines @ homogeneous(x).T / np.linalg.norm(lines[:, :2], axis=1)[:, None]

        squares = offsets(np.cross(e, border), view.x1) ** 2 + offsets(border @ F.T, view.x2) ** 2
        best = squares.min(axis=0)
        assert (d**2 <= best * (1 + 1e-9)).all()
        # The lines are a few hundredths of a pixel apart.
        assert np.median(np.sqrt(best) - np.abs(d)) < 1e-3

    def test_corrected_matches_lie_on_the_geometry_at_that_distance(self) -> None:
        for view in scenes():
            d, x1_hat, x2_hat = eg.reprojection_distances(view.F_true, view.x1, view.x2)
            assert np.abs(algebraic(view.F_true, x1_hat, x2_hat)).max() < 1e-9
            shifts = np.concatenate([x1_hat - view.x1, x2_hat - view.x2], axis=1)
            np.testing.assert_allclose(np.linalg.norm(shifts, axis=1), np.abs(d), atol=1e-9)

    def test_sign_is_that_of_the_equation(self) -> None:
        view = two_view_scene(5.0, seed=2)
        for F in (view.F_true, -view.F_true):
            d, _, _ = eg.reprojection_distances(F, view.x1, view.x2)
            np.testing.assert_array_equal(np.sign(d), np.sign(algebraic(F, view.x1, view.x2)))

    def test_corrected_matches_are_at_distance_zero_and_stay(self) -> None:
        view = two_view_scene(5.0, seed=2)
        _, x1_hat, x2_hat = eg.reprojection_distances(view.F_true, view.x1, view.x2)
        d, again1, again2 = eg.reprojection_distances(view.F_true, x1_hat, x2_hat)
        assert np.abs(d).max() < 1e-11
        np.testing.assert_allclose(again1, x1_hat, rtol=0, atol=1e-11)
        np.testing.assert_allclose(again2, x2_hat, rtol=0, atol=1e-11)

    @pytest.mark.parametrize("factor", [-3.0, 1e6, 1e-9])
    def test_scale_of_F_does_not_matter(self, factor) -> None:
        view = two_view_scene(5.0, seed=2)
        expected = eg.reprojection_distances(view.F_true, view.x1, view.x2)
        d, x1_hat, x2_hat = eg.reprojection_distances(factor * view.F_true, view.x1, view.x2)
        np.testing.assert_allclose(np.sign(factor) * d, expected[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(x1_hat, expected[1], rtol=0, atol=1e-11)
        np.testing.assert_allclose(x2_hat, expected[2], rtol=0, atol=1e-11)

    def test_full_rank_means_the_nearest_matrix_of_rank_two(self) -> None:
        view = two_view_scene(5.0, seed=2)
        U, values, Vt = np.linalg.svd(view.F_true)
        full = U @ np.diag([values[0], values[1], 0.5 * values[1]]) @ Vt
        expected = eg.reprojection_distances(view.F_true, view.x1, view.x2)
        for mine, other in zip(
            eg.reprojection_distances(full, view.x1, view.x2), expected, strict=True
        ):
            np.testing.assert_allclose(mine, other, rtol=0, atol=1e-9)

    def test_no_matches_give_empty_arrays(self) -> None:
        F = two_view_scene().F_true
        nothing = np.zeros((0, 2))
        d, x1_hat, x2_hat = eg.reprojection_distances(F, nothing, nothing)
        assert (d.shape, x1_hat.shape, x2_hat.shape) == ((0,), (0, 2), (0, 2))
        assert eg.sampson_distances(F, nothing, nothing).shape == (0,)

    def test_one_match_is_as_good_as_many(self) -> None:
        view = two_view_scene(5.0, seed=2)
        d, x1_hat, x2_hat = eg.reprojection_distances(view.F_true, view.x1, view.x2)
        sampson = eg.sampson_distances(view.F_true, view.x1, view.x2)
        for k in range(5):
            one = slice(k, k + 1)
            alone = eg.reprojection_distances(view.F_true, view.x1[one], view.x2[one])
            np.testing.assert_allclose(alone[0], d[one], rtol=0, atol=1e-11)
            np.testing.assert_allclose(alone[1], x1_hat[one], rtol=0, atol=1e-11)
            np.testing.assert_allclose(alone[2], x2_hat[one], rtol=0, atol=1e-11)
            mine = eg.sampson_distances(view.F_true, view.x1[one], view.x2[one])
            np.testing.assert_allclose(mine, sampson[one], rtol=0, atol=1e-11)

    def test_match_on_the_epipoles_has_distance_zero(self) -> None:
        view = two_view_scene(4.0, motion="forward", noise_px=0.0)
        # Both epipoles are the principal point, the origin: exactly.
        x1 = np.array([[0.0, 0.0], [0.0, 0.0], [5.0, 3.0], [1e-9, 0.0]])
        x2 = np.array([[0.0, 0.0], [7.0, 2.0], [0.0, 0.0], [0.0, 1e-9]])
        x1, x2 = np.vstack([view.x1, x1]), np.vstack([view.x2, x2])
        d, x1_hat, x2_hat = eg.reprojection_distances(view.F_true, x1, x2)
        # A cone has its vertex there: rounding of F shifts it by the root of 1e-16, times 60 px.
        assert np.abs(d).max() < 1e-6
        np.testing.assert_allclose(x1_hat, x1, rtol=0, atol=1e-6)
        np.testing.assert_allclose(x2_hat, x2, rtol=0, atol=1e-6)
        sampson = eg.sampson_distances(view.F_true, x1, x2)
        assert np.isfinite(sampson).all()
        # On both epipoles the first-order distance is 0 / 0; on one of them it is zero.
        assert np.abs(sampson[-3:-1]).max() < 1e-8

    def test_matches_around_the_epipoles_are_corrected_globally(self) -> None:
        """There the nearest point is not where the first-order correction leads."""
        view = two_view_scene(4.0, motion="forward", noise_px=0.0)
        rng = np.random.default_rng(3)
        x1, x2 = rng.uniform(-20, 20, (2, 500, 2))
        d, x1_hat, x2_hat = eg.reprojection_distances(view.F_true, x1, x2)
        assert np.abs(algebraic(view.F_true, x1_hat, x2_hat)).max() < 1e-9
        # Moving either point onto its epipole satisfies the geometry.
        e = np.linalg.svd(view.F_true)[2][-1]
        nearest = np.minimum(*(np.linalg.norm(x - e[:2] / e[2], axis=1) for x in (x1, x2)))
        assert (np.abs(d) <= nearest + 1e-9).all()
        sampson = np.abs(eg.sampson_distances(view.F_true, x1, x2))
        assert np.abs(sampson / np.abs(d) - 1).max() > 0.2


class TestSampsonDistances:
    def test_are_the_equation_over_its_gradient(self) -> None:
        for view in scenes():
            expected = algebraic(view.F_true, view.x1, view.x2)
            mine = eg.sampson_distances(view.F_true, view.x1, view.x2)
            np.testing.assert_allclose(mine, expected, rtol=1e-8, atol=1e-9)

    def test_differ_from_the_exact_ones_in_second_order(self) -> None:
        view = two_view_scene(3.0, noise_px=0.0, seed=1)
        direction1, direction2 = np.random.default_rng(0).standard_normal((2, 50, 2))
        differences = []
        for size in (1.0, 0.1, 0.01):
            x1, x2 = view.x1 + size * direction1, view.x2 + size * direction2
            exact, _, _ = eg.reprojection_distances(view.F_true, x1, x2)
            differences.append(np.abs(eg.sampson_distances(view.F_true, x1, x2) - exact).max())
            assert differences[-1] < 0.1 * size
        # A tenth of the noise, a hundredth (or less) of the difference; rounding is 1e-12.
        assert differences[1] < 0.015 * differences[0]
        assert differences[2] < 0.015 * differences[1] + 1e-11


class TestTriangulate:
    @pytest.mark.parametrize("seed", range(8))
    def test_projections_are_the_corrected_matches(self, seed) -> None:
        P1, P2, _, x1, x2 = some_matches(seed)
        Q = eg.triangulate([P1, P2], [x1, x2])
        assert Q.shape == (50, 4)
        np.testing.assert_allclose(np.linalg.norm(Q, axis=1), 1.0, rtol=1e-14)
        assert (Q[:, 3] >= 0).all()
        _, x1_hat, x2_hat = eg.reprojection_distances(fundamental(P1, P2), x1, x2)
        np.testing.assert_allclose(project(P1, Q), x1_hat, rtol=0, atol=1e-8)
        np.testing.assert_allclose(project(P2, Q), x2_hat, rtol=0, atol=1e-8)

    @pytest.mark.parametrize("seed", range(4))
    def test_no_point_nearby_projects_nearer(self, seed) -> None:
        P1, P2, _, x1, x2 = some_matches(seed, noise=5.0)
        Q = eg.triangulate([P1, P2], [x1, x2])

        def cost(Q: Array) -> Array:
            first, second = project(P1, Q) - x1, project(P2, Q) - x2
            return np.sum(first**2, axis=1) + np.sum(second**2, axis=1)

        best = cost(Q)
        rng = np.random.default_rng(seed)
        for size in (1e-1, 1e-2, 1e-3, 1e-4):
            for _ in range(200):
                assert (cost(Q + size * rng.standard_normal(Q.shape)) >= best - 1e-9).all()

    def test_exact_matches_give_the_points_back(self) -> None:
        P1, P2, X, x1, x2 = some_matches(3, noise=0.0)
        Q = eg.triangulate([P1, P2], [x1, x2])
        np.testing.assert_allclose(Q / Q[:, 3:], X, rtol=0, atol=1e-9)

    def test_points_at_infinity_are_points(self) -> None:
        P1, P2, _, _, _ = some_matches(1)
        rng = np.random.default_rng(0)
        directions = np.column_stack([rng.uniform(-0.3, 0.3, (10, 2)), np.ones(10), np.zeros(10)])
        x1, x2 = project(P1, directions), project(P2, directions)
        Q = eg.triangulate([P1, P2], [x1, x2])
        expected = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        for mine, other in zip(Q, expected, strict=True):
            assert up_to_sign(mine, other) < 1e-10
        # Parallel rays of a rectified pair, without a disparity: infinity exactly.
        P1, P2 = np.eye(3, 4), np.column_stack([np.eye(3), [-1.0, 0.0, 0.0]])
        x = rng.uniform(-1, 1, (5, 2))
        Q = eg.triangulate([P1, P2], [x, x])
        np.testing.assert_allclose(Q[:, 3], 0, atol=1e-15)
        np.testing.assert_allclose(Q[:, :2] / Q[:, 2:3], x, rtol=1e-12)

    def test_scale_and_sign_of_the_cameras_do_not_matter(self) -> None:
        P1, P2, _, x1, x2 = some_matches(2)
        expected = eg.triangulate([P1, P2], [x1, x2])
        for a, b in ((-1.0, 1.0), (1e9, -1e-9)):
            Q = eg.triangulate([a * P1, b * P2], [x1, x2])
            np.testing.assert_allclose(Q, expected, rtol=0, atol=1e-9)

    def test_projective_transformation_moves_the_points_along(self) -> None:
        P1, P2, _, x1, x2 = some_matches(2)
        T = np.eye(4) + 0.3 * np.random.default_rng(1).standard_normal((4, 4))
        moved = eg.triangulate([P1 @ np.linalg.inv(T), P2 @ np.linalg.inv(T)], [x1, x2])
        for mine, other in zip(moved, eg.triangulate([P1, P2], [x1, x2]) @ T.T, strict=True):
            assert up_to_sign(mine, other) < 1e-9

    def test_gives_the_points_of_the_refinement(self) -> None:
        view = two_view_scene(5.0, seed=2)
        result = eg.refine_fundamental(view.x1, view.x2)
        Q = eg.triangulate([result.P1, result.P2], [view.x1, view.x2])
        for mine, other in zip(Q, result.points, strict=True):
            assert up_to_sign(mine, other) < 1e-9

    def test_no_matches_give_no_points(self) -> None:
        P1, P2 = random_cameras(0)
        assert eg.triangulate([P1, P2], np.zeros((2, 0, 2))).shape == (0, 4)

    def test_match_on_both_epipoles_gives_a_point_of_the_baseline(self) -> None:
        P1 = np.eye(3, 4)
        P2 = np.column_stack([np.eye(3), [0.0, 0.0, -1.0]])  # forward: epipoles at the origin
        Q = eg.triangulate([P1, P2], np.zeros((2, 1, 2)))
        assert np.isfinite(Q).all()
        np.testing.assert_allclose(Q[0, :2], 0, atol=1e-12)

    @pytest.mark.parametrize("factor", [1.0, -2.0])
    def test_cameras_with_one_centre_are_refused(self, factor) -> None:
        P1, _, _, x1, x2 = some_matches(0)
        turned = factor * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]) @ P1
        for other in (factor * P1, turned):
            with pytest.raises(ArgumentError, match="same centre") as caught:
                eg.triangulate([P1, other], [x1, x2])
            assert caught.value.argument == "P"


class TestCanonicalCameras:
    def test_have_the_matrix_they_were_made_from(self) -> None:
        for seed in range(20):
            F = fundamental(*random_cameras(seed))
            for factor in (1.0, -3.0, 1e6):
                P1, P2 = eg.canonical_cameras(factor * F)
                np.testing.assert_array_equal(P1, np.eye(3, 4))
                assert up_to_sign(fundamental(P1, P2), F) < 1e-12

    def test_last_column_is_the_epipole_and_orthogonal_to_the_rest(self) -> None:
        F = fundamental(*random_cameras(1))
        _, P2 = eg.canonical_cameras(F)
        assert np.linalg.norm(P2[:, 3]) == pytest.approx(1.0, abs=1e-14)
        np.testing.assert_allclose(F.T @ P2[:, 3], 0, atol=1e-15)
        np.testing.assert_allclose(P2[:, 3] @ P2[:, :3], 0, atol=1e-15)  # eq. (5)
        values = np.linalg.svd(P2[:, :3], compute_uv=False)
        ratio = np.linalg.svd(F, compute_uv=False)
        assert values[0] == pytest.approx(1.0, abs=1e-14)
        assert values[1] == pytest.approx(ratio[1] / ratio[0], rel=1e-9)

    def test_full_rank_is_lowered_to_two(self) -> None:
        rng = np.random.default_rng(2)
        full = rng.standard_normal((3, 3))
        U, values, Vt = np.linalg.svd(full)
        nearest = (U[:, :2] * values[:2]) @ Vt[:2]
        assert up_to_sign(fundamental(*eg.canonical_cameras(full)), nearest) < 1e-14

    @pytest.mark.parametrize("F", [np.eye(3)[:, [1, 0, 2]] * [1, -1, 0], np.diag([1, 1, 0])])
    def test_equal_singular_values_are_legal(self, F) -> None:
        assert up_to_sign(fundamental(*eg.canonical_cameras(F)), F) < 1e-14


class TestEightPoint:
    @pytest.mark.parametrize("m", [8, 9, 50])
    @pytest.mark.parametrize("motion", ["sideways", "forward"])
    def test_exact_matches_give_the_truth(self, m, motion) -> None:
        view = two_view_scene(3.0, noise_px=0.0, n_points=m, motion=motion, seed=4)
        F = eg.fundamental_8point(view.x1, view.x2)
        # Eight random points lose some digits by their conditioning.
        assert same_geometry(F, view.F_true, view.x1, view.x2) < 1e-9
        assert np.abs(algebraic(F, view.x1, view.x2)).max() < 1e-9

    def test_has_unit_norm_and_rank_two(self) -> None:
        for seed in range(10):
            view = two_view_scene(10.0, seed=seed)
            F = eg.fundamental_8point(view.x1 + 500, view.x2 + 500)
            assert np.linalg.norm(F) == pytest.approx(1.0, abs=1e-15)
            values = np.linalg.svd(F, compute_uv=False)
            assert values[2] < 1e-15 < 1e-8 < values[1]

    def test_minimises_the_algebraic_error_in_normalised_coordinates(self) -> None:
        view = two_view_scene(3.0, seed=4)
        F = eg.fundamental_8point(view.x1, view.x2)
        T1, T2 = normalizing(view.x1), normalizing(view.x2)
        q1, q2 = homogeneous(view.x1) @ T1.T, homogeneous(view.x2) @ T2.T
        A = np.einsum("mi,mj->mij", q2, q1).reshape(-1, 9)
        full = np.linalg.svd(A)[2][-1].reshape(3, 3)
        U, values, Vt = np.linalg.svd(full)
        expected = T2.T @ (U[:, :2] * values[:2]) @ Vt[:2] @ T1
        assert up_to_sign(F, expected) < 1e-9

    def test_does_not_depend_on_the_pixels(self) -> None:
        view = two_view_scene(5.0, seed=4)
        F = eg.fundamental_8point(view.x1, view.x2)
        # Here each image may have a scale of its own.
        T1 = np.array([[2.0, 0, 100], [0, 2.0, -7], [0, 0, 1]])
        T2 = np.array([[0.1, 0, 1e4], [0, 0.1, 3], [0, 0, 1]])
        moved = [
            x @ T[:2, :2].T + T[:2, 2] for x, T in zip((view.x1, view.x2), (T1, T2), strict=True)
        ]
        back = T2.T @ eg.fundamental_8point(*moved) @ T1
        assert same_geometry(back, F, view.x1, view.x2) < 1e-9

    def test_seven_matches_are_too_few(self) -> None:
        view = two_view_scene(5.0, n_points=7)
        with pytest.raises(ArgumentError, match="at least 8"):
            eg.fundamental_8point(view.x1, view.x2)


class TestConditioning:
    def test_one_scale_for_both_images_and_rms_two(self) -> None:
        rng = np.random.default_rng(0)
        x1, x2 = rng.uniform(0, 100, (40, 2)), rng.uniform(1000, 9000, (40, 2))
        frame = condition(x1, x2)
        q1, q2 = frame.forward(x1, x2)
        assert (q1.shape, q2.shape) == ((2, 40), (2, 40))
        np.testing.assert_allclose(np.mean([q1, q2], axis=(0, 2)), 0, atol=1e-14)
        assert np.sqrt(np.mean(np.square([q1, q2]))) == pytest.approx(2.0, rel=1e-14)
        # Distances keep their proportions between the images, else the minimum would move.
        assert np.ptp(q1[0]) / np.ptp(x1[:, 0]) == pytest.approx(np.ptp(q2[0]) / np.ptp(x2[:, 0]))
        for back, x in zip(frame.backward(q1, q2), (x1, x2), strict=True):
            np.testing.assert_allclose(back, x, rtol=1e-14)

    def test_matrix_goes_in_and_out(self) -> None:
        view = two_view_scene(5.0, seed=1)
        x1, x2 = view.x1_true + 400, view.x2_true - 3000
        move = [np.array([[1, 0, -d], [0, 1, -d], [0, 0, 1.0]]) for d in (400, -3000)]
        F = move[1].T @ view.F_true @ move[0]
        frame = displaced(condition(x1, x2), np.eye(3))
        inside = frame.from_pixels(F)
        assert np.linalg.norm(inside) == pytest.approx(1.0)
        assert np.abs(algebraic(inside, *(q.T for q in frame.forward(x1, x2)))).max() < 1e-11
        assert up_to_sign(frame.to_pixels(inside), F) < 1e-14
        assert up_to_sign(frame.entry_map() @ inside.ravel(), F.ravel()) < 1e-14

    @pytest.mark.parametrize("seed", range(3))
    def test_displacement_is_the_same_for_F_and_minus_F(self, seed) -> None:
        view = two_view_scene(10.0, seed=seed)
        frame = condition(view.x1, view.x2)
        F = frame.from_pixels(view.F_true)
        one, other = displaced(frame, F), displaced(frame, -4 * F)  # rounding scales along
        np.testing.assert_array_equal(one.origin2, other.origin2)
        np.testing.assert_array_equal(one.origin1, frame.origin1)
        assert one.scale == frame.scale
        assert 0 < np.linalg.norm(one.origin2 - frame.origin2) < 2 * frame.scale

    def test_displacement_keeps_a_near_affine_scene_off_sigma_one(self) -> None:
        for seed in range(10):
            view = two_view_scene(20.0, seed=seed)
            frame = condition(view.x1, view.x2)
            F = view.F_true
            ratios = []
            for coordinates in (frame, displaced(frame, frame.from_pixels(F))):
                values = np.linalg.svd(coordinates.from_pixels(F), compute_uv=False)
                ratios.append(values[1] / values[0])
            assert ratios[0] > 0.94
            assert ratios[1] < 0.8


def test_near_both_epipoles_newton_counts_only_where_it_settles() -> None:
    """Its steps may leave a foot point anywhere there; the bracketed root is the reference."""
    table = kernels.table("numpy")
    rng = np.random.default_rng(0)
    for _ in range(8):
        U, s, Vt = np.linalg.svd(rng.standard_normal((3, 3)))
        F = (U[:, :2] * s[:2]) @ Vt[:2] / np.linalg.norm(s[:2])
        size = 10.0 ** rng.uniform(-5.0, 0.0, 200)
        q1, q2 = (
            (e[:2] / e[2])[:, None] + size * rng.standard_normal((2, 200)) for e in (Vt[2], U[:, 2])
        )
        found = Reprojection(table, q1, q2).evaluate(F).signed
        bracketed = table.foot_point_safe(*table.bilinear_frame(F), q1, q2)[2]
        np.testing.assert_array_less(np.abs(found - bracketed), 1e-9 * size)
