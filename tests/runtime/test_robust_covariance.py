"""Covariances under robust losses: what they promise, against simulated gross errors."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view.covariance import influence, residual_noise, truncated_deviation
from epigauge.two_view.losses import Loss
from two_views import Array, normalizing

SMOOTH = ("huber", "soft_l1", "cauchy")
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
    @pytest.mark.parametrize(("share", "off"), WRONG)
    @pytest.mark.parametrize("loss", SMOOTH)
    def test_errors_are_as_large_as_promised(self, loss, share, off) -> None:
        # The mean of 80 has a deviation of 0.06; one factor for all matches: up to 2.5. With 30 %
        # far off, a few estimates are drawn away by more than any covariance says.
        most = 1.7 if share * off > 10.0 else 1.35
        assert 0.75 <= mean_squared_error(loss, share, off, 80, noise_px=None) <= most

    @pytest.mark.parametrize(("share", "off"), WRONG)
    def test_truncated_loss(self, share, off) -> None:
        assert 0.75 <= mean_squared_error("truncated", share, off, 80, noise_px=None) <= 1.6

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
    @pytest.mark.parametrize("loss", [*SMOOTH, "truncated"])
    def test_of_clean_matches_is_consistent(self, loss) -> None:
        rng = np.random.default_rng(7)
        found = []
        for _ in range(60):
            x1, x2 = disturbed(rng, 0.0, 0.0)
            found.append(eg.refine_fundamental(x1, x2, loss=loss, noise_px=None).noise_px)
        # A mean of 60 has a deviation of 0.01; without the factor it is 0.95
        assert np.mean(found) == pytest.approx(1.0, abs=0.025)

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
