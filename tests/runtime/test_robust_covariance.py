"""Covariances under robust losses: what they promise, against simulated gross errors."""

from __future__ import annotations

from importlib.util import find_spec

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.two_view.covariance import (
    influence,
    residual_noise,
    truncated_deviation,
    untruncated,
)
from epigauge.two_view.losses import Loss
from epigauge.uncertainty.influence import RobustFit
from two_views import Array, normalizing

#: Share of wrong matches, and how far off they are in standard deviations of the right ones.
WRONG = [(0.0, 0.0), (0.05, 60.0), (0.15, 60.0), (0.15, 5.0), (0.3, 60.0), (0.3, 5.0)]


def scene(m: int = 120) -> tuple[Array, Array, Array]:
    """Noise-free matches of a wide view of a deep scene, and the true F."""
    rng = np.random.default_rng(1)
    c, s = np.cos(0.2), np.sin(0.2)
    R, t = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array([-1.0, 0.1, 0.3])
    K = np.array([[800.0, 0, 500], [0, 800, 500], [0, 0, 1]])
    X = np.column_stack([rng.uniform(-2, 2, (m, 2)), rng.uniform(4, 8, m)])
    h1, h2 = X @ K.T, (X @ R.T + t) @ K.T
    inverse = np.linalg.inv(K)
    F = inverse.T @ np.cross(t, R, axisb=0, axisc=0) @ inverse
    return h1[:, :2] / h1[:, 2:], h2[:, :2] / h2[:, 2:], F


def disturbed(rng: np.random.Generator, share: float, off: float) -> tuple[Array, Array]:
    """The scene with noise of 1 px and some points of the second image moved off."""
    x1, x2, _ = scene()
    x1, x2 = x1 + rng.standard_normal(x1.shape), x2 + rng.standard_normal(x2.shape)
    wrong = rng.choice(len(x1), round(share * len(x1)), replace=False)
    angle = rng.uniform(0, 2 * np.pi, len(wrong))
    length = off if off > 10.0 else off * np.abs(rng.standard_normal(len(wrong)))
    x2[wrong] += (length * np.array([np.cos(angle), np.sin(angle)])).T
    return x1, x2


def squared_error(r: eg.FundamentalResult, F: Array) -> float:
    """The squared error of F in units of its covariance, over the seven degrees of freedom."""
    x1, x2, _ = scene()
    A = np.kron(np.linalg.inv(normalizing(x2)).T, np.linalg.inv(normalizing(x1)).T)
    values, vectors = np.linalg.eigh(A @ r.covariance @ A.T)
    F = F / np.linalg.norm(F)
    error = A @ (F * np.sign(np.sum(F * r.F)) - r.F).ravel()
    return float(np.sum((vectors[:, 2:].T @ error) ** 2 / values[2:]) / 7.0)


def mean_squared_error(loss: str, share: float, off: float, trials: int, **options) -> float:
    rng = np.random.default_rng(3)
    F = scene()[2]
    found = []
    for _ in range(trials):
        r = eg.refine_fundamental(*disturbed(rng, share, off), F, loss=loss, **options)
        found.append(min(squared_error(r, F), 20.0))
    return float(np.mean(found))


class TestTwoViews:
    @pytest.mark.parametrize(
        ("loss", "share", "off"),
        [
            *(("huber", *wrong) for wrong in WRONG),
            *((loss, *wrong) for loss in ("soft_l1", "cauchy") for wrong in WRONG[2::3]),
        ],
    )
    def test_errors_are_as_large_as_promised(self, loss, share, off) -> None:
        # The mean of 60 has a deviation of 0.07; one factor for all matches: up to 2.5. With 30 %
        # far off, a few estimates are drawn away by more than any covariance says.
        most = 1.7 if share * off > 10.0 else 1.35
        assert 0.75 <= mean_squared_error(loss, share, off, 60, noise_px=None) <= most

    def test_estimates_that_were_drawn_away_are_flagged(self) -> None:
        flagged = 0
        for seed in range(6):
            view = eg.two_view_scene(4.0, n_points=120, noise_px=1.0, seed=seed)
            rng = np.random.default_rng(seed)
            x2 = view.x2.copy()
            wrong = rng.choice(120, 36, replace=False)
            angle = rng.uniform(0.0, 2.0 * np.pi, 36)
            x2[wrong] += 60.0 * np.column_stack([np.cos(angle), np.sin(angle)])
            result = eg.refine_fundamental(view.x1, x2, loss="cauchy")
            assert result.success == ("gross errors" not in result.flags)
            assert result.noise_px <= 2.0 or not result.success
            flagged += not result.success
        assert 1 <= flagged <= 4
        assert "gross errors" not in eg.refine_fundamental(view.x1, view.x2, loss="cauchy").flags

    @pytest.mark.parametrize(("share", "off"), WRONG[::2])
    def test_truncated_loss(self, share, off) -> None:
        assert 0.75 <= mean_squared_error("truncated", share, off, 60, noise_px=None) <= 1.6

    def test_a_truncated_loss_is_as_wide_as_the_right_matches_say(self) -> None:
        """With 30 % wrong the median of all distances would make it half as wide again."""
        rng = np.random.default_rng(11)
        F = scene()[2]
        pairs = (disturbed(rng, 0.3, 60.0) for _ in range(16))
        found = [eg.refine_fundamental(*pair, loss="truncated") for pair in pairs]
        scales = np.array([r.loss_scale_px for r in found])
        assert np.median(scales) == pytest.approx(3.0, rel=0.15)
        assert np.mean([r.success for r in found]) > 0.9
        assert np.median([squared_error(r, F) for r in found]) < 1.5

    def test_given_noise_scales_the_covariance(self) -> None:
        x1, x2 = disturbed(np.random.default_rng(0), 0.15, 60.0)
        found = [eg.refine_fundamental(x1, x2, loss="huber", noise_px=s) for s in (0.5, 1.0, None)]
        size = np.abs(found[1].covariance).max()
        np.testing.assert_allclose(4 * found[0].covariance, found[1].covariance, atol=1e-12 * size)
        factor = found[2].noise_px ** 2
        np.testing.assert_allclose(
            found[2].covariance, factor * found[1].covariance, atol=1e-9 * size
        )

    def test_a_batch_promises_the_same(self) -> None:
        x1, x2 = disturbed(np.random.default_rng(0), 0.15, 60.0)
        one = eg.refine_fundamental(x1, x2, loss="cauchy", noise_px=None)
        batch = eg.refine_fundamental_batch(
            np.tile(x1, (2, 1)), np.tile(x2, (2, 1)), [0, 120, 240], loss="cauchy", noise_px=None
        )
        np.testing.assert_array_equal(batch.covariance, [one.covariance] * 2)

    def test_weights_are_inverse_variances_under_a_robust_loss(self) -> None:
        """A match of weight four tells as much as four matches of weight one (within the cut)."""
        x1, x2, _ = scene()
        rng = np.random.default_rng(4)
        x1, x2 = x1 + 0.1 * rng.standard_normal(x1.shape), x2 + 0.1 * rng.standard_normal(x2.shape)
        options = {"loss": "huber", "loss_scale_px": 50.0, "noise_px": 1.0}
        plain = eg.refine_fundamental(x1, x2, **options).covariance
        heavy = eg.refine_fundamental(x1, x2, weights=np.full(len(x1), 4.0), **options).covariance
        np.testing.assert_allclose(4.0 * heavy, plain, atol=1e-9 * np.abs(plain).max())


class TestNoise:
    @pytest.mark.parametrize("loss", ["huber", "truncated"])
    def test_of_clean_matches_is_consistent(self, loss) -> None:
        rng = np.random.default_rng(7)
        found = []
        for _ in range(60):
            x1, x2 = disturbed(rng, 0.0, 0.0)
            found.append(eg.refine_fundamental(x1, x2, loss=loss, noise_px=None).noise_px)
        # A mean of 60 has a deviation of 0.01; without the factor it is 0.95
        assert np.mean(found) == pytest.approx(1.0, abs=0.025)

    def test_of_five_matches_and_an_essential_matrix_is_not_known(self) -> None:
        view = eg.two_view_scene(6.0, n_points=5, seed=1)
        options = {"essential": True, "K1": view.K, "K2": view.K}
        found = eg.refine_fundamental(view.x1, view.x2, **options)
        assert found.noise_px == np.inf
        assert np.isinf(np.diag(found.covariance)).all()
        assert not np.isnan(found.covariance).any()
        assert np.isinf(found.sigma_std)
        assert np.isinf(found.epipole_px_covariance(1)).any()
        assert "few matches" in found.flags
        assert "weak geometry" not in found.flags
        known = eg.refine_fundamental(view.x1, view.x2, noise_px=1.0, **options)
        assert np.isfinite(known.covariance).all()
        assert known.rank == found.rank == 5

    @pytest.mark.parametrize("limit", [1.5, 2.5, 3.0, 8.0])
    def test_deviation_within_a_limit_tells_that_without_it(self, limit) -> None:
        for sigma in (0.3, 1.0):
            within = sigma * truncated_deviation(limit)
            assert untruncated(within, limit * sigma) == pytest.approx(sigma, rel=1e-3)
        assert untruncated(0.0, 1.0) == 0.0

    @pytest.mark.skipif(
        all(find_spec(name) is None for name in ("poselib", "cv2")),
        reason="neither PoseLib nor OpenCV is installed",
    )
    def test_an_estimate_gives_back_the_tails_that_its_threshold_cuts_off(self) -> None:
        x1, x2 = disturbed(np.random.default_rng(2), 0.15, 60.0)
        found = eg.estimate_fundamental(x1, x2)
        kept = found.used
        refined = eg.refine_fundamental(x1[kept], x2[kept], found.F)
        noise = untruncated(refined.noise_px, found.threshold_px)
        assert noise > 1.005 * refined.noise_px
        assert found.noise_px == pytest.approx(noise, rel=1e-6)
        size = np.abs(refined.covariance).max()
        factor = (noise / refined.noise_px) ** 2
        np.testing.assert_allclose(
            found.covariance / size, factor * refined.covariance / size, atol=1e-5
        )
        assert found.sigma_std == pytest.approx(np.sqrt(factor) * refined.sigma_std, rel=1e-3)

    @pytest.mark.parametrize("limit", [0.5, 1.0, 2.5, 3.0, 8.0])
    def test_truncated_deviation_is_that_of_a_truncated_normal_variable(self, limit) -> None:
        x = np.linspace(-limit, limit, 200_001)
        density = np.exp(-0.5 * x**2)
        variance = np.sum(x**2 * density) / np.sum(density)
        assert truncated_deviation(limit) == pytest.approx(np.sqrt(variance), rel=1e-4)

    def test_linear_loss_is_the_plain_estimate(self) -> None:
        d, w = np.array([1.0, -2.0, 3.0, 9.0]), np.array([1.0, 4.0, 1.0, 0.0])
        assert residual_noise(d, w, Loss(), 1) == pytest.approx(np.sqrt((1 + 16 + 9) / 2))
        a, b = influence(d, w, Loss(), 1, 1.0)
        np.testing.assert_array_equal(a, w)
        np.testing.assert_array_equal(b, w)

    def test_a_loss_without_influence_leaves_the_variance_of_the_residuals(self) -> None:
        rng = np.random.default_rng(8)
        d, w = rng.uniform(-1.0, 1.0, 40), rng.uniform(0.5, 2.0, 40) * (np.arange(40) > 3)
        a, b = influence(d, w, Loss("huber", 1e6), 7, 1.5)
        np.testing.assert_allclose(a, w, rtol=1e-9)
        # Each counts with the power of all, freed from the parameters fitted.
        variance = np.sum(w * d**2) / (36 - 7)
        np.testing.assert_allclose(b * 1.5**2, w * variance, rtol=1e-9)

    def test_slope_is_that_of_the_influence(self) -> None:
        # One match alone in the cut: a = w psi'(d), by differences.
        loss, w = Loss("cauchy", 1.0), np.array([1.0, 1.0])
        for d in (0.2, 0.7, 3.0):
            a, _ = influence(np.array([d, 50.0]), w, loss, 0, 4.0)
            psi = [loss(np.array([x * x]))[1][0] * x for x in (d - 1e-6, d + 1e-6)]
            assert a[0] == pytest.approx(max((psi[1] - psi[0]) / 2e-6, 0.0), abs=1e-8)


def tracks_with_errors(
    rng: np.random.Generator, share: float, off: float
) -> tuple[eg.Tracks, eg.Reconstruction]:
    """Five views of forty points, noise of 1 px, some observations off; and the truth."""
    truth = many_views.cameras_and_points(5, 40, seed=1)
    tracks = many_views.observed(truth, 0.0, seed=1)
    xy = tracks.xy + rng.standard_normal(tracks.xy.shape)
    wrong = rng.choice(len(xy), round(share * len(xy)), replace=False)
    angle = rng.uniform(0, 2 * np.pi, len(wrong))
    length = off if off > 10.0 else off * np.abs(rng.standard_normal(len(wrong)))
    xy[wrong] += (length * np.array([np.cos(angle), np.sin(angle)])).T
    return eg.Tracks(tracks.view, tracks.point, xy), truth


#: A point and its neighbours.
_STAR = 1e-3 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])


class TestManyViews:
    @pytest.mark.parametrize(("share", "off"), [(0.0, 0.0), (0.05, 60.0), (0.15, 5.0)])
    @pytest.mark.parametrize("loss", ["huber", "cauchy"])
    def test_errors_of_projections_are_as_large_as_promised(self, loss, share, off) -> None:
        """Projected points do not depend on the gauge: their errors, in units of the covariance.

        The mean of 8 has a deviation of 0.03 to 0.06. Over 16, it is 0.97 to 1.0, and 1.11 with
        errors that are not far off. Were the pull of wrong observations on the others taken for
        noise, it would be 0.77 for the Huber loss with errors far off.
        """
        rng = np.random.default_rng(5)
        found = []
        for _ in range(8):
            tracks, truth = tracks_with_errors(rng, share, off)
            r = eg.bundle_adjust(tracks, truth, loss=loss)
            spread = eg.covariance(
                tracks, r.reconstruction, loss=loss, loss_scale_px=r.loss_scale_px
            )
            error = r.reconstruction.project(tracks) - truth.project(tracks)
            squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(spread.projections), error)
            found.append(np.mean(np.minimum(squares, 40.0)) / 2.0)
        assert 0.83 <= np.mean(found) <= 1.22

    def test_a_loss_without_influence_leaves_the_variance_of_the_residuals(self) -> None:
        rng = np.random.default_rng(8)
        r, w = rng.uniform(-1.0, 1.0, (40, 2)), rng.uniform(0.5, 2.0, 40) * (np.arange(40) > 3)
        fit = RobustFit.of(r, w, Loss("huber", 1e6), 11)
        said = fit.influence(np.zeros_like(r))
        assert len(said.wrong) == 0
        np.testing.assert_allclose(fit.weights, w, rtol=1e-9)
        variance = np.sum(w[:, None] * r**2) / (2 * 36 - 11)
        assert said.kappa * said.noise**2 == pytest.approx(variance, rel=1e-9)

    def test_noise_of_normal_residuals_is_theirs(self) -> None:
        r = np.random.default_rng(9).standard_normal((20_000, 2))
        fit = RobustFit.of(r, np.ones(20_000), Loss("huber", 1.0), 0)
        assert fit.influence(np.zeros_like(r)).noise == pytest.approx(1.0, abs=0.015)

    @pytest.mark.parametrize("length", [0.2, 0.7])
    def test_slope_is_the_mean_curvature_of_the_loss(self, length: float) -> None:
        loss, angle = Loss("cauchy", 1.0), np.arange(6.0)
        r = length * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        r[5] *= 100.0  # wrong
        fit = RobustFit.of(r, np.ones(6), loss, 0)
        value = [0.5 * loss(np.array([np.sum((r[0] + step) ** 2)]))[0][0] for step in _STAR]
        laplacian = (sum(value[1:]) - 4.0 * value[0]) / 1e-6
        assert list(fit.wrong) == [5]
        assert fit.weights[0] == pytest.approx(0.5 * laplacian, abs=1e-5)

    def test_equals_the_dense_sandwich(self) -> None:
        rng = np.random.default_rng(6)
        tracks, truth = tracks_with_errors(rng, 0.1, 20.0)
        r = eg.bundle_adjust(tracks, truth, loss="huber", ftol=1e-12)
        scale, found = r.loss_scale_px, r.reconstruction
        n, m = tracks.n_views, tracks.n_points
        spread = eg.covariance(tracks, found, loss="huber", loss_scale_px=scale)
        residuals = tracks.xy - found.project(tracks)
        ones = np.ones(len(tracks))
        fit = RobustFit.of(residuals, ones, Loss("huber", scale), 11 * n + 3 * m - 15)
        assert len(fit.wrong) > 10
        _, J_P, J_Q, _ = kernels.table("numpy").project(
            found.P.transpose(1, 2, 0)[:, :, tracks.view], found.Q.T[:, tracks.point]
        )
        J = np.zeros((len(tracks), 2, 12 * n + 4 * m))
        for k, (i, j) in enumerate(zip(tracks.view, tracks.point, strict=True)):
            J[k, :, 12 * i : 12 * i + 12] = J_P[:, :, k]
            J[k, :, 12 * n + 4 * j : 12 * n + 4 * j + 4] = J_Q[:, :, k]
        # Columns of one size, so that the pseudo-inverse of the dense matrix keeps its digits
        size = np.sqrt(np.sum(J**2, axis=(0, 1)))
        J = J / size
        A = np.einsum("k,kip,kiq->pq", fit.weights, J, J)
        values, vectors = np.linalg.eigh(A)
        kept = slice(15 + n + m, None)
        inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
        pull = J @ (inverse @ np.einsum("kip,ki->p", J[fit.wrong], fit.psi))
        said = fit.influence(pull)
        assert said.noise < 0.99 * fit.influence(np.zeros_like(pull)).noise
        B = said.kappa * A
        B += np.einsum("kip,kij,kjq->pq", J[said.wrong], said.rest, J[said.wrong])
        expected = said.noise**2 * J @ (inverse @ B @ inverse) @ np.swapaxes(J, 1, 2)
        assert spread.noise_px == pytest.approx(said.noise, rel=1e-6)
        np.testing.assert_allclose(spread.projections, expected, rtol=1e-4, atol=1e-6)
        some = np.arange(0, len(tracks), 7)
        projected = spread.of_projections(tracks.view[some], tracks.point[some])
        np.testing.assert_allclose(projected, spread.projections[some], rtol=1e-6, atol=1e-9)
        fixed = spread.in_gauge(eg.gauge.two_cameras())
        full = fixed.dense()
        np.testing.assert_allclose(full[24:36, 24:36], fixed.cameras[2], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(full[-4:, -4:], fixed.points[-1], rtol=1e-6, atol=1e-12)

    def test_without_influence_of_the_loss_it_is_the_plain_covariance(self) -> None:
        rng = np.random.default_rng(7)
        ratios = []
        for _ in range(8):
            tracks, truth = tracks_with_errors(rng, 0.0, 0.0)
            plain = eg.covariance(tracks, truth, noise_px=1.0).projections
            wide = eg.covariance(tracks, truth, noise_px=1.0, loss="huber", loss_scale_px=1e4)
            ratios.append(np.trace(wide.projections.sum(axis=0)) / np.trace(plain.sum(axis=0)))
        # At the truth no redundancy is lost: 400 residual coordinates count as 205
        assert np.mean(ratios) == pytest.approx(1.0, abs=0.06)
