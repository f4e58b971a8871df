"""The covariance of F: its form, its size against experiment, scenes that do not determine F."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.scenes import two_view_scene
from epigauge.two_view.covariance import Uncertainty, fundamental_covariance, tangent_basis
from laws import central_differences
from two_views import Array, homogeneous, normalizing, project


def truth(distance: float = 3.0, seed: int = 5, **options):
    """A noise-free scene, off the origin as pixels are."""
    view = two_view_scene(distance, noise_px=0.0, seed=seed, **options)
    corner = np.array([900.0, 700.0])
    return view.x1 + corner, view.x2 + corner


def noisy(x: Array, noise_px: float, seed: int) -> Array:
    return x + noise_px * np.random.default_rng(seed).standard_normal(x.shape)


def planar(noise_px: float = 0.0):
    """All points on one plane: a homography, two parameters of F are free."""
    view = two_view_scene(5.0, seed=2)
    X = view.X.copy()
    X[:, 2] = 0.4 * X[:, 0] - 0.2 * X[:, 1]
    x1, x2 = project(view.P1, X), project(view.P2, X)
    return noisy(x1, noise_px, 1), noisy(x2, noise_px, 2)


def rotation():
    """The camera turned and did not move."""
    view = two_view_scene(5.0, noise_px=0.0, seed=2)
    c, s = np.cos(0.1), np.sin(0.1)
    H = view.K @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.linalg.inv(view.K)
    x2 = homogeneous(view.x1) @ H.T
    return view.x1, x2[:, :2] / x2[:, 2:]


def comparable(F: Array, x1: Array, x2: Array) -> Array:
    """Derivative of vect of a normalised unit-norm F by vect(F) of pixels: a (9, 9) matrix.

    Entries of F in pixels differ by orders of magnitude; tests look at them where they do not.
    """
    A = np.kron(np.linalg.inv(normalizing(x2)).T, np.linalg.inv(normalizing(x1)).T)
    mapped = A @ F.ravel()
    size = np.linalg.norm(mapped)
    unit = mapped / size
    return (np.eye(9) - np.outer(unit, unit)) @ A / size


class TestForm:
    @pytest.mark.parametrize("structure", ["eliminated", "joint"])
    def test_symmetric_positive_of_rank_seven(self, structure) -> None:
        x1, x2 = truth()
        x1, x2 = noisy(x1, 0.5, 1), noisy(x2, 0.5, 2)
        result = eg.refine_fundamental(x1, x2, structure=structure)
        np.testing.assert_array_equal(result.covariance, result.covariance.T)
        assert result.rank == 7
        assert 1.0 < result.condition < 1e3
        D = comparable(result.F, x1, x2)
        values = np.linalg.eigvalsh(D @ result.covariance @ D.T)
        # In comparable entries the seven span the square of the condition number at most.
        assert values[2] > 1e-7 * values[8]
        assert np.abs(values[:2]).max() < 1e-12 * values[8]

    def test_null_space_is_the_scale_of_F_and_the_direction_of_rank_three(self) -> None:
        x1, x2 = truth()
        result = eg.refine_fundamental(noisy(x1, 0.5, 1), noisy(x2, 0.5, 2))
        size = np.linalg.norm(result.covariance)
        # F stays of unit norm, and det(F + dF) = 0 to first order is u3^T dF v3 = 0.
        for null in (result.F, np.outer(result.U[:, 2], result.V[:, 2])):
            assert np.abs(result.covariance @ null.ravel()).max() < 1e-12 * size

    @pytest.mark.parametrize("distance", [3.0, 10.0])
    def test_is_the_propagated_inverse_of_the_normal_matrix(self, distance) -> None:
        """cov = D (J^T J)^-1 D^T, from differences through the seven orthonormal parameters."""
        x1, x2 = truth(distance)
        x1, x2 = noisy(x1, 0.5, 1), noisy(x2, 0.5, 2)
        w = np.random.default_rng(3).uniform(0.3, 2.0, len(x1))
        result = eg.refine_fundamental(x1, x2, weights=w, noise_px=0.7)
        T1, T2 = normalizing(x1 + 40.0), normalizing(x2 - 90.0)  # away from sigma = 1
        F = np.linalg.inv(T2).T @ result.F @ np.linalg.inv(T1)
        U, values, Vt = np.linalg.svd(F)
        assert values[1] < 0.95 * values[0]

        def pixels(delta: Array) -> Array:
            moved = rotation_matrix(delta[:3]), rotation_matrix(delta[3:6])
            middle = np.diag([1.0, values[1] / values[0] + delta[6], 0.0])
            return T2.T @ (U @ moved[0] @ middle @ (Vt.T @ moved[1]).T) @ T1

        def unit(delta: Array) -> Array:
            entries = pixels(delta).ravel()
            return entries / np.linalg.norm(entries)

        def distances(delta: Array) -> Array:
            return np.sqrt(w) * eg.reprojection_distances(pixels(delta), x1, x2)[0]

        J = central_differences(distances, np.zeros(7), 1e-5)
        D = comparable(result.F, x1, x2)
        D_unit = D @ central_differences(unit, np.zeros(7), 1e-5)
        expected = 0.7**2 * D_unit @ np.linalg.inv(J.T @ J) @ D_unit.T
        actual = D @ result.covariance @ D.T
        # Distances known to 1e-13 pixels over the step: 1e-8, and J spans three orders.
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-4 * np.abs(expected).max())

    @pytest.mark.parametrize("noise_px", [0.1, 3.0])
    def test_grows_with_the_square_of_the_noise(self, noise_px) -> None:
        x1, x2 = truth()
        x1, x2 = noisy(x1, 0.5, 1), noisy(x2, 0.5, 2)
        one = eg.refine_fundamental(x1, x2, noise_px=1.0)
        other = eg.refine_fundamental(x1, x2, noise_px=noise_px)
        np.testing.assert_allclose(other.covariance, noise_px**2 * one.covariance, rtol=1e-12)
        assert (one.noise_px, other.noise_px) == (1.0, noise_px)
        # Nothing else depends on it.
        np.testing.assert_array_equal(one.F, other.F)
        assert one.condition == other.condition

    def test_shrinks_with_the_weights(self) -> None:
        x1, x2 = truth()
        x1, x2 = noisy(x1, 0.5, 1), noisy(x2, 0.5, 2)
        one = eg.refine_fundamental(x1, x2, noise_px=1.0)
        four = eg.refine_fundamental(x1, x2, weights=np.full(len(x1), 4.0), noise_px=1.0)
        np.testing.assert_allclose(four.covariance, one.covariance / 4, rtol=1e-7)

    def test_is_that_of_the_same_matches_in_other_pixels(self) -> None:
        x1, x2 = truth()
        x1, x2 = noisy(x1, 0.5, 1), noisy(x2, 0.5, 2)
        one = eg.refine_fundamental(x1, x2, noise_px=1.0, ftol=1e-14)
        half = eg.refine_fundamental(x1 / 2, x2 / 2, noise_px=0.5, ftol=1e-14)
        ours = comparable(one.F, x1, x2), comparable(half.F, x1 / 2, x2 / 2)
        first, second = (D @ r.covariance @ D.T for D, r in zip(ours, (one, half), strict=True))
        np.testing.assert_allclose(second, first, rtol=0, atol=1e-6 * np.abs(first).max())
        assert half.condition == pytest.approx(one.condition, rel=1e-6)


class TestNoise:
    def test_is_estimated_from_the_residuals(self) -> None:
        x1, x2 = truth()
        estimates = []
        for seed in range(40):
            x = noisy(np.stack([x1, x2]), 0.3, seed)
            result = eg.refine_fundamental(x[0], x[1], noise_px=None)
            # 4 m coordinates, 3 m + 7 parameters: m - 7 degrees of freedom are left.
            expected = np.sqrt(2 * result.cost / (len(x1) - 7))
            assert result.noise_px == pytest.approx(expected, rel=1e-12)
            estimates.append(result.noise_px)
        # 43 degrees of freedom each: a relative error of 1 / sqrt(86), over sqrt(40): 1.7 %.
        assert np.mean(estimates) == pytest.approx(0.3, rel=4 * 0.017)

    def test_estimate_scales_the_covariance(self) -> None:
        x1, x2 = truth()
        x1, x2 = noisy(x1, 0.3, 1), noisy(x2, 0.3, 2)
        estimated = eg.refine_fundamental(x1, x2, noise_px=None)
        given = eg.refine_fundamental(x1, x2, noise_px=estimated.noise_px)
        np.testing.assert_array_equal(estimated.covariance, given.covariance)

    def test_matches_of_weight_zero_give_no_degrees_of_freedom(self) -> None:
        x1, x2 = truth()
        x1, x2 = noisy(x1, 0.3, 1), noisy(x2, 0.3, 2)
        w = np.ones(len(x1))
        w[:10] = 0.0
        weighted = eg.refine_fundamental(x1, x2, weights=w, noise_px=None)
        dropped = eg.refine_fundamental(x1[10:], x2[10:], noise_px=None)
        assert weighted.noise_px == pytest.approx(dropped.noise_px, rel=1e-9)

    def test_eight_matches_leave_one_degree_of_freedom(self) -> None:
        x1, x2 = truth()
        result = eg.refine_fundamental(noisy(x1[:8], 0.3, 1), noisy(x2[:8], 0.3, 2), noise_px=None)
        assert result.noise_px == pytest.approx(np.sqrt(2 * result.cost), rel=1e-12)


def uncertainty_of(F: Array, N: Array) -> Uncertainty:
    """What a normal matrix (9, 9) says about F in coordinates that are pixels."""
    return fundamental_covariance(F, N, N, (np.eye(3), np.eye(3)), tangent_basis(F))


def rotation_matrix(angles: Array) -> Array:
    """Exponential map, not the Euler angles of the library: the covariance must not care."""
    angle = float(np.linalg.norm(angles))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = angles / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@pytest.mark.slow
class TestExperiment:
    COUNT = 400

    @pytest.mark.parametrize(
        ("options", "noise_px"),
        [({}, 0.1), ({"distance": 10.0}, 0.02), ({"motion": "forward"}, 0.02)],
    )
    def test_predicts_the_scatter_of_the_estimates(self, options, noise_px) -> None:
        """400 noisy versions of one scene, in the seven directions that F can move in.

        Small noise, so that the first order holds. With the directions whitened by the predicted
        covariance, the sample covariance S of n estimates of seven numbers must look like that of
        unit noise: n trace(S) is chi-squared with 7 n degrees of freedom, and the eigenvalues lie
        in the Marchenko-Pastur range (1 -+ sqrt(7/n))^2 = 0.75 .. 1.28, give or take 0.1.
        """
        x1, x2 = truth(**options)
        exact = eg.refine_fundamental(x1, x2, noise_px=noise_px)
        D = comparable(exact.F, x1, x2)
        predicted = D @ exact.covariance @ D.T
        values, vectors = np.linalg.eigh(predicted)
        whiten = (vectors[:, 2:] / np.sqrt(values[2:])).T
        samples = []
        for seed in range(self.COUNT):
            x = noisy(np.stack([x1, x2]), noise_px, seed)
            F = eg.refine_fundamental(x[0], x[1], exact.F).F
            F = F * np.sign(np.sum(F * exact.F))
            # D is the derivative at F, and F - exact.F is small
            samples.append(whiten @ D @ (F - exact.F).ravel())
        S = np.cov(np.array(samples).T)
        n = self.COUNT - 1
        assert abs(np.trace(S) / 7 - 1) < 4 * np.sqrt(2 / (7 * n))
        eigenvalues = np.linalg.eigvalsh(S)
        assert eigenvalues[0] > (1 - np.sqrt(7 / n)) ** 2 - 0.1
        assert eigenvalues[-1] < (1 + np.sqrt(7 / n)) ** 2 + 0.1
        # And the mean is the truth: its square is chi-squared with 7 degrees of freedom.
        mean = np.mean(samples, axis=0)
        assert self.COUNT * np.sum(mean**2) < 7 + 4 * np.sqrt(14) + 4


class TestSingularPlaces:
    def test_tangent_space_has_seven_directions_at_sigma_one(self) -> None:
        rng = np.random.default_rng(0)
        for sigma in (1.0, 1.0 - 1e-12, 0.5, 1e-9):
            U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
            F = U @ np.diag([1.0, sigma, 0.0]) @ V.T
            F /= np.linalg.norm(F)
            basis = tangent_basis(F)
            np.testing.assert_allclose(basis.T @ basis, np.eye(7), rtol=0, atol=1e-14)
            np.testing.assert_allclose(basis.T @ F.ravel(), 0, atol=1e-14)
            if sigma > 1e-6:
                # Moving along any of them keeps the determinant zero to first order.
                for direction in basis.T.reshape(7, 3, 3):
                    assert abs(np.linalg.det(F + 1e-4 * direction)) < 1e-7

    def test_is_finite_and_continuous_at_sigma_one(self) -> None:
        rng = np.random.default_rng(1)
        A = rng.standard_normal((30, 9))
        U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
        found = []
        for sigma in (1.0 - 1e-9, 1.0):
            F = U @ np.diag([1.0, sigma, 0.0]) @ V.T
            uncertainty = uncertainty_of(F / np.linalg.norm(F), A.T @ A)
            assert uncertainty.rank == 7
            found.append(uncertainty.of_fundamental())
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-7)

    def test_scene_with_equal_singular_values_has_a_finite_covariance(self) -> None:
        view = two_view_scene(10.0, noise_px=0.0, seed=3)  # the origin is the principal point
        result = eg.refine_fundamental(view.x1, view.x2)
        assert result.sigma == pytest.approx(1.0, abs=1e-9)
        assert result.rank == 7
        assert np.isfinite(result.covariance).all()
        assert result.condition < 1e3

    @pytest.mark.parametrize(
        "form",
        [{}, {"hessian": "gauss-newton"}, {"structure": "joint"}, {"damping": "seber"}],
        ids=str,
    )
    @pytest.mark.parametrize("scene", [planar, rotation])
    def test_exact_homography_is_recognised(self, scene, form) -> None:
        result = eg.refine_fundamental(*scene(), **form)
        assert result.status > 0
        assert not result.success
        # rounding of coordinates of some hundred pixels
        assert result.rms_px < 1e-12
        assert result.rank == 5  # F = [e']x H: the epipole is free
        assert result.condition == np.inf
        assert not np.isnan(result.covariance).any()
        assert np.isinf(np.diag(result.covariance)).any()
        for name in ("F", "points", "fun", "jac", "grad", "P2"):
            assert np.isfinite(getattr(result, name)).all(), name

    def test_nearly_planar_scene_has_a_huge_condition(self) -> None:
        general = eg.refine_fundamental(*truth())
        result = eg.refine_fundamental(*planar(noise_px=1e-4))
        assert not np.isnan(result.covariance).any()
        assert result.condition > 1e3 * general.condition

    def test_nothing_observed_leaves_everything_undetermined(self) -> None:
        F = np.diag([1.0, 0.5, 0.0]) / np.linalg.norm([1.0, 0.5])
        found = uncertainty_of(F, np.zeros((9, 9)))
        assert found.rank == 0
        assert found.condition == np.inf
        covariance = found.of_fundamental()
        assert not np.isnan(covariance).any()
        # Entry (3, 3) cannot move: rank two forbids it. All others can.
        assert covariance[8, 8] == 0.0
        assert np.isinf(np.diag(covariance)[:8]).all()


def test_the_deviation_of_sigma_is_that_of_the_singular_values_of_F() -> None:
    """Away from 1, by differences: sigma = s2 / s1 of F as its nine entries vary."""
    for seed in range(3):
        scene = eg.two_view_scene(distance=3.0, n_points=80, noise_px=0.02, seed=seed)
        flat = scene.x2 * [1.0, 0.5]  # pixels that are not square: sigma is not 1
        result = eg.refine_fundamental(scene.x1, flat, noise_px=0.02)
        assert result.sigma < 1.0 - 20.0 * result.sigma_std

        def sigma(F: np.ndarray) -> float:
            s = np.linalg.svd(F, compute_uv=False)
            return float(s[1] / s[0])

        steps = 1e-6 * np.abs(result.F).ravel()
        slope = [
            (sigma(result.F + E.reshape(3, 3)) - sigma(result.F - E.reshape(3, 3))) / (2.0 * h)
            for h, E in zip(steps, np.diag(steps), strict=True)
        ]
        expected = np.sqrt(slope @ result.covariance @ slope)
        assert result.sigma_std == pytest.approx(expected, rel=1e-3)
