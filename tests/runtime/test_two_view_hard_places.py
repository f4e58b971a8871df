"""Noise-free data, epipoles amid the points, few matches, poor starts: no NaN, an honest status."""

from __future__ import annotations

import dataclasses

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.lm import STATUS
from epigauge.scenes import two_view_scene
from epigauge.verdicts import usable
from two_views import homogeneous, same_geometry

FORMS = [
    {},
    {"hessian": "gauss-newton"},
    {"damping": "seber"},
    {"structure": "joint"},
    {"structure": "joint", "damping": "seber"},
]

forms = pytest.mark.parametrize("form", FORMS, ids=lambda f: " ".join(f.values()) or "default")


def assert_no_nan(result: eg.FundamentalResult) -> None:
    """NaN nowhere; infinity in the covariance and the condition number only."""
    assert result.status in STATUS
    assert result.success == (result.status > 0 and usable(result.flags, "F"))
    for field in dataclasses.fields(result):
        value = getattr(result, field.name)
        if isinstance(value, np.ndarray | float):
            assert not np.isnan(value).any(), field.name
            if field.name not in ("covariance", "condition"):
                assert np.isfinite(value).all(), field.name
    for row in result.history:
        assert not np.isnan([row.cost, row.lam, row.step_norm]).any()
    if result.rank < 7:
        assert result.condition == np.inf
    else:
        assert np.isfinite(result.covariance).all()


class TestWithoutNoise:
    @forms
    @pytest.mark.parametrize("motion", ["sideways", "forward"])
    @pytest.mark.parametrize("distance", [3.0, 10.0, 30.0])
    @pytest.mark.parametrize("m", [8, 50])
    def test_ends_at_rounding_with_the_truth(self, form, motion, distance, m) -> None:
        view = two_view_scene(distance, noise_px=0.0, n_points=m, motion=motion, seed=3)
        for start in (None, view.F_true):
            result = eg.refine_fundamental(view.x1, view.x2, start, **form)
            assert result.success, result.message
            assert_no_nan(result)
            # Coordinates of up to 250 pixels are rounded to 3e-14.
            assert result.rms_px < 1e-12
            assert result.nit <= 10  # it does not wander about in the rounding
            assert result.cost <= result.history[0].cost
        # The farther, the less the points determine the perspective part: condition number 1e4.
        assert same_geometry(result.F, view.F_true, view.x1, view.x2) < 1e-8

    def test_optimum_is_recognised_at_once(self) -> None:
        view = two_view_scene(3.0, noise_px=0.0, seed=3)
        result = eg.refine_fundamental(view.x1, view.x2, view.F_true)
        assert result.status == 5
        assert (result.nfev, result.njev, result.nit) == (1, 1, 0)

    @forms
    def test_noise_of_a_billionth_of_a_pixel(self, form) -> None:
        view = two_view_scene(3.0, noise_px=1e-9, seed=3)
        result = eg.refine_fundamental(view.x1, view.x2, **form)
        assert result.success
        assert_no_nan(result)
        assert 1e-10 < result.rms_px < 1e-9

    @forms
    def test_refined_again_stays(self, form) -> None:
        view = two_view_scene(6.0, seed=3)
        first = eg.refine_fundamental(view.x1, view.x2, ftol=1e-14, **form)
        again = eg.refine_fundamental(view.x1, view.x2, first.F, **form)
        assert again.success
        assert again.cost == pytest.approx(first.cost, rel=1e-10)
        assert same_geometry(again.F, first.F, view.x1, view.x2) < 1e-5
        if "structure" not in form:
            assert again.nfev <= 2


class TestEpipoles:
    @forms
    @pytest.mark.parametrize("seed", range(4))
    def test_forward_motion_converges(self, form, seed) -> None:
        view = two_view_scene(6.0, noise_px=0.2, motion="forward", seed=seed)
        result = eg.refine_fundamental(view.x1, view.x2, max_iter=300, **form)
        # With points as unknowns the valley is too narrow for some: they must say so.
        assert result.status >= 0
        if "structure" not in form:
            assert result.status > 0, result.message
        assert_no_nan(result)
        d, _, _ = eg.reprojection_distances(view.F_true, view.x1, view.x2)
        assert result.cost < 0.5 * np.sum(d**2)
        # Both epipoles are found amid the points.
        for epipole in (result.U[:, 2], result.V[:, 2]):
            assert np.linalg.norm(epipole[:2] / epipole[2]) < 40.0

    @forms
    @pytest.mark.parametrize("noise_px", [0.0, 1.0])
    @pytest.mark.parametrize(
        "extra",
        [
            ([0.0, 0.0], [0.0, 0.0]),  # on both epipoles
            ([0.0, 0.0], [7.0, 2.0]),  # on one of them
            ([5.0, 3.0], [0.0, 0.0]),
            ([1e-7, 0.0], [0.0, 1e-7]),
        ],
    )
    def test_match_on_an_epipole_gives_no_nan(self, form, noise_px, extra) -> None:
        view = two_view_scene(4.0, noise_px=noise_px, motion="forward", seed=1)
        x1, x2 = np.vstack([view.x1, extra[0]]), np.vstack([view.x2, extra[1]])
        for start in (None, view.F_true):
            result = eg.refine_fundamental(x1, x2, start, **form)
            assert_no_nan(result)
            assert result.cost <= result.history[0].cost

    def test_rectified_geometry_with_epipoles_at_infinity(self) -> None:
        rng = np.random.default_rng(0)
        x1 = rng.uniform(0, 640, (60, 2))
        x2 = x1 - np.column_stack([rng.uniform(5, 80, 60), np.zeros(60)])
        F = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]) / 2**0.5
        exact = eg.refine_fundamental(x1, x2)
        assert exact.success
        assert same_geometry(exact.F, F, x1, x2) < 1e-9
        noise = rng.standard_normal((2, 60, 2))
        for form in FORMS:
            result = eg.refine_fundamental(x1 + 0.5 * noise[0], x2 + 0.5 * noise[1], **form)
            assert result.success
            assert_no_nan(result)
            assert result.rank == 7
            assert 0.15 < result.rms_px < 0.35  # 0.5 * sqrt(53 / 240) = 0.23


class TestFewMatches:
    @forms
    @pytest.mark.parametrize("seed", range(4))
    def test_eight_suffice(self, form, seed) -> None:
        view = two_view_scene(3.0, noise_px=0.3, n_points=8, seed=seed)
        result = eg.refine_fundamental(view.x1, view.x2, max_iter=300, **form)
        assert result.success
        assert_no_nan(result)
        assert result.cost <= result.history[0].cost

    @forms
    def test_repeated_matches_are_legal(self, form) -> None:
        view = two_view_scene(3.0, n_points=9, seed=2)
        x1, x2 = np.tile(view.x1, (3, 1)), np.tile(view.x2, (3, 1))
        result = eg.refine_fundamental(x1, x2, max_iter=300, **form)
        once = eg.refine_fundamental(view.x1, view.x2, max_iter=300, **form)
        assert result.cost == pytest.approx(once.cost, rel=1e-12)

    @forms
    def test_seven_different_matches_are_too_few(self, form) -> None:
        view = two_view_scene(3.0, n_points=7, noise_px=0.3, seed=2)
        x1, x2 = np.tile(view.x1, (2, 1)), np.tile(view.x2, (2, 1))
        with pytest.raises(ArgumentError, match="hold 7 different matches; needed: at least 8"):
            eg.refine_fundamental(x1, x2, **form)


class TestStarts:
    @forms
    @pytest.mark.parametrize("seed", range(3))
    def test_poor_start_is_never_made_worse(self, form, seed) -> None:
        view = two_view_scene(6.0, seed=1)
        F0 = np.random.default_rng(seed).standard_normal((3, 3))
        result = eg.refine_fundamental(view.x1, view.x2, F0, **form)
        assert_no_nan(result)
        assert result.cost <= result.history[0].cost * (1 + 1e-12)
        accepted = [row.cost for row in result.history if row.accepted]
        assert accepted == sorted(accepted, reverse=True)

    def test_start_of_full_rank_is_taken_to_rank_two(self) -> None:
        view = two_view_scene(6.0, seed=1)
        U, values, Vt = np.linalg.svd(view.F_true)
        F0 = U @ np.diag([values[0], values[1], 0.1 * values[1]]) @ Vt
        result = eg.refine_fundamental(view.x1, view.x2, F0)
        assert result.success
        assert np.linalg.matrix_rank(result.F, tol=1e-14) == 2

    @forms
    def test_start_with_a_tiny_second_singular_value(self, form) -> None:
        # Nearly a product of two lines: legal, and far from the solution.
        view = two_view_scene(6.0, seed=1)
        line1, line2 = np.array([1.0, 0.2, 3.0]), np.array([-0.3, 1.0, 5.0])
        F0 = np.outer(line2, line1) / np.linalg.norm(np.outer(line2, line1)) + 1e-6 * view.F_true
        assert_no_nan(eg.refine_fundamental(view.x1, view.x2, F0, **form))


class TestDegenerateScenes:
    @forms
    def test_identical_images(self, form) -> None:
        # The camera did not move at all: every skew matrix fits.
        view = two_view_scene(5.0, seed=1)
        result = eg.refine_fundamental(view.x1, view.x1, **form)
        assert_no_nan(result)
        assert result.status > 0
        assert not result.success
        assert "still camera" in result.flags
        assert "pure rotation" not in result.flags
        assert result.rms_px < 1e-12
        assert result.rank == 5

    @forms
    def test_noisy_homography(self, form) -> None:
        view = two_view_scene(5.0, seed=1)
        H = np.array([[0.9, 0.1, 20], [-0.1, 1.1, -5], [1e-4, 2e-4, 1]])
        x2 = homogeneous(view.x1) @ H.T
        x2 = x2[:, :2] / x2[:, 2:] + np.random.default_rng(0).standard_normal((50, 2))
        result = eg.refine_fundamental(view.x1, x2, **form)
        assert_no_nan(result)
        assert result.cost <= result.history[0].cost

    @forms
    def test_points_on_two_planes(self, form) -> None:
        view = two_view_scene(5.0, seed=1, noise_px=0.0)
        X = view.X.copy()
        X[:25, 2], X[25:, 2] = 0.2 * X[:25, 0], 0.3 - 0.4 * X[25:, 1]
        h1, h2 = X @ view.P1.T, X @ view.P2.T
        result = eg.refine_fundamental(h1[:, :2] / h1[:, 2:], h2[:, :2] / h2[:, 2:], **form)
        assert_no_nan(result)
        assert result.success
        assert result.rank == 7

    @forms
    def test_all_points_but_one_on_a_line(self, form) -> None:
        view = two_view_scene(5.0, seed=1, n_points=20)
        X = view.X.copy()
        X[1:, :3] = X[1:, :1] * [1.0, 0.5, 0.3]
        h1, h2 = X @ view.P1.T, X @ view.P2.T
        result = eg.refine_fundamental(h1[:, :2] / h1[:, 2:], h2[:, :2] / h2[:, 2:], **form)
        assert_no_nan(result)
        assert result.rank < 7


class TestHonesty:
    @pytest.mark.parametrize("ftol", [1e-3, 1e-6, 1e-10])
    def test_joint_solution_with_stuck_points_is_no_success(self, ftol) -> None:
        view = eg.two_view_scene(10, seed=1)
        # The cost creeps: below 1e-6 the steps run out.
        options = {"structure": "joint", "max_iter": 300}
        result = eg.refine_fundamental(view.x1, view.x2, np.eye(3), ftol=ftol, **options)
        assert result.status == -4
        assert not result.success
        assert "start" in result.message
        # What it warns of: other points for the same F cost far less.
        assert result.cost > 10.0 * (0.5 * np.sum(result.fun**2))

    def test_points_on_their_way_are_not_stuck(self) -> None:
        view = eg.two_view_scene(10, seed=1)
        for max_iter in (1, 2, 3):
            options = {"structure": "joint", "max_iter": max_iter, "ftol": 0.0}
            assert eg.refine_fundamental(view.x1, view.x2, **options).status == 0

    def test_match_on_both_epipoles_of_the_start_does_not_stop_the_others(self) -> None:
        view = eg.two_view_scene(4, motion="forward", seed=1)
        x1, x2 = np.vstack([view.x1, [0, 0]]), np.vstack([view.x2, [0, 0]])
        result = eg.refine_fundamental(x1, x2, view.F_true, max_iter=300)
        joint = eg.refine_fundamental(x1, x2, view.F_true, structure="joint", max_iter=300)
        assert result.status > 0
        # The match in question has no derivative there: rounding decides which minimum is met.
        assert result.cost <= joint.cost * (1.0 + 1e-8)

    def test_sampson_distance_on_both_epipoles_is_zero(self) -> None:
        view = eg.two_view_scene(4, motion="forward", seed=1)
        e1, e2 = (np.linalg.svd(F)[2][2] for F in (view.F_true, view.F_true.T))
        d = eg.sampson_distances(view.F_true, e1[None, :2] / e1[2], e2[None, :2] / e2[2])
        np.testing.assert_array_equal(d, 0.0)
