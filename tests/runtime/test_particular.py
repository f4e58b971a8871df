"""Parts held fixed, and essential matrices."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view.essential import motion_from_essential
from two_views import Array, homogeneous, up_to_sign

STRUCTURES = ("eliminated", "joint")
EPIPOLES = (("epipole1",), ("epipole2",), ("epipole1", "epipole2"))


def shifted(distance: float, seed: int, shift: float) -> tuple[Array, Array, Array]:
    """A simulated scene with the origin of the pixels elsewhere, and its 8-point start."""
    view = eg.two_view_scene(distance, seed=seed)
    x1, x2 = view.x1 + shift, view.x2 + shift
    return x1, x2, eg.fundamental_8point(x1, x2)


def calibrated(seed: int = 0, m: int = 60, noise: float = 0.5) -> tuple[Array, ...]:
    """Matches of two calibrated cameras in general position with K1, K2, R and t."""
    rng = np.random.default_rng(seed)
    K1 = np.array([[900.0, 0.0, 500.0], [0.0, 920.0, 380.0], [0.0, 0.0, 1.0]])
    K2 = np.array([[1100.0, 2.0, 640.0], [0.0, 1090.0, 350.0], [0.0, 0.0, 1.0]])
    axis = np.array([0.2, 1.0, 0.1]) * 0.25
    R = rotation(axis)
    t = np.array([-0.9, 0.2, 0.3]) / np.linalg.norm([-0.9, 0.2, 0.3])
    X = np.column_stack([rng.uniform(-2, 2, (m, 2)), rng.uniform(4, 9, m)])
    x1, x2 = (pixels(K, Y) for K, Y in ((K1, X), (K2, X @ R.T + t)))
    x1, x2 = (x + noise * rng.standard_normal(x.shape) for x in (x1, x2))
    return x1, x2, K1, K2, R, t


def rotation(vector: Array) -> Array:
    """The rotation about a vector by its length (Rodrigues)."""
    angle = np.linalg.norm(vector)
    C = np.cross(np.eye(3), -vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * C + (1 - np.cos(angle)) * C @ C)


def pixels(K: Array, X: Array) -> Array:
    h = X @ K.T
    return h[:, :2] / h[:, 2:]


def degrees(A: Array, B: Array) -> float:
    """The angle of the rotation between two rotations."""
    return float(np.degrees(2 * np.arcsin(min(1, np.linalg.norm(A - B) / np.sqrt(8)))))


class TestFixed:
    @pytest.mark.parametrize("structure", STRUCTURES)
    @pytest.mark.parametrize("damping", ["levenberg", "seber"])
    @pytest.mark.parametrize("parameterization", ["ortho", "block"])
    @pytest.mark.parametrize("fix", EPIPOLES)
    def test_epipoles_stay_to_the_last_bit_and_the_rest_converges(
        self, fix, parameterization, damping, structure
    ) -> None:
        costs = []
        for shift in (0.0, 1000.0):
            x1, x2, F0 = shifted(5.0, 0, shift)
            U, _, Vt = np.linalg.svd(F0)
            result = eg.refine_fundamental(
                x1,
                x2,
                F0,
                fix=fix,
                parameterization=parameterization,
                damping=damping,
                structure=structure,
            )
            assert result.success
            assert result.nfev <= 30  # 3 to 10; in the factors of pixels it would be above 100
            if "epipole1" in fix:
                np.testing.assert_array_equal(result.epipole1, Vt[2])
            if "epipole2" in fix:
                np.testing.assert_array_equal(result.epipole2, U[:, 2])
            d = eg.reprojection_distances(result.F, x1, x2)[0]
            assert result.cost == pytest.approx(0.5 * np.sum(d**2), rel=1e-8)
            assert result.jac.shape == (50, 7 - 2 * len(fix))
            assert result.rank == 7 - 2 * len(fix)
            tolerance = 1e-13 * np.linalg.norm(result.covariance)
            assert np.linalg.matrix_rank(result.covariance, tol=tolerance) <= result.rank
            costs.append(result.cost)
        # The same epipole in other coordinates: the same problem
        assert costs[0] == pytest.approx(costs[1], rel=1e-7)
        assert costs[0] > eg.refine_fundamental(x1, x2, F0).cost * (1 + 1e-9)

    @pytest.mark.parametrize("structure", STRUCTURES)
    @pytest.mark.parametrize("parameterization", ["ortho", "block"])
    def test_epipolar_transformation_keeps_sigma_to_the_last_bit(
        self, parameterization, structure
    ) -> None:
        for seed in range(3):
            x1, x2, F0 = shifted(5.0, seed, 0.0)
            s = np.linalg.svd(F0)[1]
            result = eg.refine_fundamental(
                x1,
                x2,
                F0,
                fix="epipolar_transformation",
                parameterization=parameterization,
                structure=structure,
            )
            assert result.sigma == s[1] / s[0]
            assert result.rank == 4
            start = 0.5 * np.sum(eg.reprojection_distances(F0, x1, x2)[0] ** 2)
            assert result.cost < start

    def test_transformation_with_an_epipole_leaves_the_other_epipole(self) -> None:
        x1, x2, F0 = shifted(5.0, 1, 0.0)
        _, s, Vt = np.linalg.svd(F0)
        result = eg.refine_fundamental(x1, x2, F0, fix=("epipole1", "epipolar_transformation"))
        assert result.success
        np.testing.assert_array_equal(result.epipole1, Vt[2])
        assert result.sigma == s[1] / s[0]
        assert result.rank == 2

    @pytest.mark.parametrize("fix", [*EPIPOLES, ("epipolar_transformation",)])
    def test_gradient_vanishes_in_the_directions_left(self, fix) -> None:
        x1, x2, F0 = shifted(5.0, 1, 0.0)
        result = eg.refine_fundamental(x1, x2, F0, fix=fix, ftol=1e-15, max_iter=500)
        # jac spans one standard deviation of each distance; fun is about a pixel
        whitened = np.linalg.qr(result.jac)[0].T @ result.fun
        assert np.abs(whitened).max() < 1e-4
        full = np.linalg.qr(eg.refine_fundamental(x1, x2, result.F, max_iter=1).jac)[0]
        assert np.linalg.norm(full.T @ result.fun) > 1e-3  # but not in all directions

    def test_covariance_of_a_fixed_epipole_is_zero(self) -> None:
        x1, x2, F0 = shifted(5.0, 0, 300.0)
        result = eg.refine_fundamental(x1, x2, F0, fix="epipole1")
        free = eg.refine_fundamental(x1, x2, F0)
        ratio = result.epipole_covariance(1).max() / free.epipole_covariance(1).max()
        assert ratio < 1e-12
        assert result.epipole_covariance(2).max() > 0

    def test_robust_rounds_start_from_the_same_parts(self) -> None:
        x1, x2, F0 = shifted(5.0, 0, 300.0)
        Vt = np.linalg.svd(F0)[2]
        result = eg.refine_fundamental(x1, x2, F0, fix="epipole1", loss="huber")
        np.testing.assert_array_equal(result.epipole1, Vt[2])

    def test_several_starts_are_refused(self) -> None:
        x1, x2, F0 = shifted(5.0, 0, 0.0)
        with pytest.raises(eg.ArgumentError, match="starts"):
            eg.refine_fundamental(x1, x2, F0, fix="epipole1", starts=3)


class TestEssential:
    @pytest.mark.parametrize("structure", STRUCTURES)
    @pytest.mark.parametrize("parameterization", ["ortho", "block"])
    def test_motion_is_recovered(self, structure, parameterization) -> None:
        x1, x2, K1, K2, R, t = calibrated()
        result = eg.refine_fundamental(
            x1,
            x2,
            essential=True,
            K1=K1,
            K2=K2,
            structure=structure,
            parameterization=parameterization,
        )
        assert result.success
        s = np.linalg.svd(K2.T @ result.F @ K1, compute_uv=False)
        np.testing.assert_allclose(s / s[0], [1, 1, 0], rtol=0, atol=1e-10)
        s = np.linalg.svd(result.E, compute_uv=False)
        np.testing.assert_allclose(s, [np.sqrt(0.5), np.sqrt(0.5), 0], rtol=0, atol=1e-10)
        np.testing.assert_allclose(result.R @ result.R.T, np.eye(3), rtol=0, atol=1e-14)
        assert np.linalg.det(result.R) == pytest.approx(1)
        assert np.linalg.norm(result.t) == pytest.approx(1)
        # 60 points, half a pixel at 1000 px focal length: about 0.1 degrees
        assert degrees(result.R, R) < 0.3
        assert result.t @ t > np.cos(np.radians(1.0))
        assert up_to_sign(np.cross(np.eye(3), -result.t) @ result.R, result.E) < 1e-10
        assert result.rank == 5
        assert result.jac.shape == (60, 5)

    def test_minimum_is_that_of_a_search_over_rotation_and_translation(self) -> None:
        optimize = pytest.importorskip("scipy.optimize")
        x1, x2, K1, K2, R, t = calibrated(seed=3)
        result = eg.refine_fundamental(x1, x2, essential=True, K1=K1, K2=K2)
        in1, in2 = np.linalg.inv(K1), np.linalg.inv(K2)

        def distances(p: Array) -> Array:
            E = np.cross(np.eye(3), -p[3:] / np.linalg.norm(p[3:])) @ rotation(p[:3]) @ R
            return eg.reprojection_distances(in2.T @ E @ in1, x1, x2)[0]

        start = np.concatenate([np.full(3, 1e-3), t])
        found = optimize.least_squares(distances, start, x_scale=1e-3, xtol=1e-13, ftol=1e-13)
        assert result.cost == pytest.approx(found.cost, rel=1e-7)
        assert degrees(result.R, rotation(found.x[:3]) @ R) < 1e-3

    def test_one_calibration_serves_both_images(self) -> None:
        view = eg.two_view_scene(4.0, noise_px=0.3, seed=2)
        one = eg.refine_fundamental(view.x1, view.x2, essential=True, K1=view.K)
        both = eg.refine_fundamental(view.x1, view.x2, essential=True, K1=view.K, K2=view.K)
        np.testing.assert_array_equal(one.F, both.F)
        np.testing.assert_array_equal(one.R, both.R)

    def test_retina_coordinates_need_no_calibration(self) -> None:
        x1, x2, K1, K2, R, t = calibrated()
        y1, y2 = (np.linalg.solve(K, homogeneous(x).T)[:2].T for K, x in ((K1, x1), (K2, x2)))
        result = eg.refine_fundamental(y1, y2, essential=True)
        assert result.success
        np.testing.assert_allclose(result.sigma, 1.0, rtol=0, atol=1e-12)
        assert degrees(result.R, R) < 0.3
        assert result.t @ t > np.cos(np.radians(1.0))

    def test_five_parameters_know_more_than_seven(self) -> None:
        x1, x2, K1, K2, _, _ = calibrated()
        five = eg.refine_fundamental(x1, x2, essential=True, K1=K1, K2=K2)
        seven = eg.refine_fundamental(x1, x2)
        assert np.trace(five.covariance) < np.trace(seven.covariance)
        values = np.linalg.eigvalsh(whitened(five.covariance, seven.covariance))
        assert values.max() < 1.2  # the two estimates differ a little
        assert five.cost > seven.cost

    def test_an_uncalibrated_result_has_no_motion(self) -> None:
        view = eg.two_view_scene(4.0)
        result = eg.refine_fundamental(view.x1, view.x2)
        assert result.E is None
        assert result.R is None
        assert result.t is None

    def test_cheirality_is_decided_by_most_points(self) -> None:
        _, _, _, _, R, t = calibrated()
        rng = np.random.default_rng(1)
        X = np.column_stack([rng.uniform(-2, 2, (30, 2)), rng.uniform(4, 9, 30)])
        Y = X @ R.T + t
        E = np.cross(np.eye(3), -t) @ R
        X[:5] *= -1  # five matches that would be behind the first camera
        for factor in (1.0, -2.0):
            found_R, found_t = motion_from_essential(factor * E, X, Y)
            np.testing.assert_allclose(found_R, R, rtol=0, atol=1e-12)
            np.testing.assert_allclose(found_t, t, rtol=0, atol=1e-12)


def whitened(A: Array, B: Array) -> Array:
    """A in units of B over the directions that B knows."""
    values, vectors = np.linalg.eigh(B)
    keep = values > 1e-9 * values[-1]
    root = vectors[:, keep] / np.sqrt(values[keep])
    return np.asarray(root.T @ A @ root)
