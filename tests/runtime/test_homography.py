"""Homographies by maximum likelihood: minima, covariances, backends, wrong matches, bad input."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.two_view.conditioning import condition
from epigauge.two_view.homography import fit_homography, robust_homography
from epigauge.two_view.homography_problem import HomographyProblem
from numpy.typing import NDArray

Array = NDArray[np.float64]


def mapped(H: Array, x: Array) -> Array:
    y = np.column_stack([x, np.ones(len(x))]) @ H.T
    return np.asarray(y[:, :2] / y[:, 2:])


def plane(seed: int, m: int = 60, noise: float = 1.0) -> tuple[Array, Array, Array]:
    """Return noisy matches of a homography, and that of unit norm."""
    rng = np.random.default_rng(seed)
    x1 = rng.uniform(0.0, 1000.0, (m, 2))
    size = np.array([[0.2, 0.2, 100.0], [0.2, 0.2, 100.0], [2e-4, 2e-4, 0.0]])
    H = np.eye(3) + size * rng.uniform(-1.0, 1.0, (3, 3))
    x2 = mapped(H, x1)
    x1, x2 = (x + noise * rng.standard_normal((m, 2)) for x in (x1, x2))
    return x1, x2, H / np.linalg.norm(H)


def apart(H1: Array, H2: Array) -> float:
    return min(float(np.linalg.norm(H1 - H2)), float(np.linalg.norm(H1 + H2)))


class TestRefinement:
    def test_exact_matches_give_the_homography(self) -> None:
        x1, x2, H = plane(1, noise=0.0)
        result = eg.refine_homography(x1, x2)
        assert result.success
        assert apart(result.H, H) < 1e-10

    def test_four_matches_are_enough(self) -> None:
        x1, x2, H = plane(2, m=4, noise=0.0)
        result = eg.refine_homography(x1, x2)
        assert apart(result.H, H) < 1e-8
        assert "few matches" in result.flags
        assert np.isinf(np.diag(result.covariance)).all()

    def test_gradient_is_that_of_the_cost(self) -> None:
        x1, x2, _ = plane(3, noise=5.0)
        q = condition(x1, x2).forward(x1, x2)
        S = np.tile([[1.5], [0.4], [0.7]], 60)
        problem = HomographyProblem(
            kernels.table(), *q, np.linspace(0.5, 2.0, 60), covariances=(S, S[::-1].copy())
        )
        H = np.eye(3) / 3.0**0.5
        state = problem.evaluate(H)
        step = 1e-6
        expected = [
            (
                problem.evaluate(problem.retract(state, step * e)).cost
                - problem.evaluate(problem.retract(state, -step * e)).cost
            )
            / (2.0 * step)
            for e in np.eye(8)
        ]
        gradient = problem.linearize(state).gradient
        np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.max(np.abs(expected)))

    def test_no_corrected_match_is_nearer(self) -> None:
        # The squared distance is that of the corrected points, and no others on H are nearer.
        x1, x2, _ = plane(4, noise=5.0)
        result = eg.refine_homography(x1, x2)

        def squared(p: Array) -> Array:
            return np.asarray(np.sum((x1 - p) ** 2 + (x2 - mapped(result.H, p)) ** 2, axis=1))

        np.testing.assert_allclose(squared(result.points1), result.fun**2, rtol=1e-9)
        for move in ([0.05, 0.0], [-0.05, 0.0], [0.0, 0.05], [0.0, -0.05]):
            assert (squared(result.points1 + move) > result.fun**2).all()

    @pytest.mark.parametrize("seed", range(3))
    def test_random_starts_find_nothing_lower(self, seed: int) -> None:
        x1, x2, H = plane(seed, m=12)
        rng = np.random.default_rng(seed)
        cost = eg.refine_homography(x1, x2).cost
        for _ in range(10):
            start = H * (1.0 + 0.05 * rng.standard_normal((3, 3)))
            assert eg.refine_homography(x1, x2, start).cost >= cost * (1.0 - 1e-9)

    def test_both_images_play_the_same_part(self) -> None:
        x1, x2, _ = plane(5)
        there, back = eg.refine_homography(x1, x2), eg.refine_homography(x2, x1)
        inverse = np.linalg.inv(there.H)
        assert apart(back.H, inverse / np.linalg.norm(inverse)) < 1e-6
        assert back.cost == pytest.approx(there.cost, rel=1e-9)

    def test_equal_covariances_change_nothing_but_the_unit(self) -> None:
        x1, x2, _ = plane(6)
        plain = eg.refine_homography(x1, x2)
        scaled = eg.refine_homography(x1, x2, covariance1=4 * np.eye(2), covariance2=4 * np.eye(2))
        assert apart(plain.H, scaled.H) < 1e-8
        assert scaled.cost == pytest.approx(plain.cost / 4.0)
        np.testing.assert_allclose(scaled.covariance, plain.covariance, rtol=1e-4, atol=1e-16)

    def test_covariance_is_that_of_many_trials(self) -> None:
        clean1, clean2, H = plane(7, noise=0.0)
        rng = np.random.default_rng(0)
        chi2 = []
        for _ in range(60):
            x1, x2 = (x + rng.standard_normal(x.shape) for x in (clean1, clean2))
            result = eg.refine_homography(x1, x2, noise_px=1.0)
            off = (result.H * np.sign(np.sum(result.H * H)) - H).ravel()
            values, vectors = np.linalg.eigh(result.covariance)
            chi2.append(np.sum((vectors[:, 1:].T @ off) ** 2 / values[1:]))
        # The mean of 60 variables of chi-square with 8 degrees has the deviation 0.52.
        assert abs(np.mean(chi2) - 8.0) < 1.8

    def test_backends_agree(self) -> None:
        x1, x2, _ = plane(8)
        names: list[Any] = [name for name, reason in kernels.available().items() if reason is None]
        found = [eg.refine_homography(x1, x2, backend=name) for name in names]
        for other in found[1:]:
            assert apart(found[0].H, other.H) < 1e-9

    @pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy", "truncated"])
    def test_robust_losses_bear_wrong_matches(self, loss: Any) -> None:
        x1, x2, H = plane(9)
        x2[:9] += 100.0
        result = eg.refine_homography(x1, x2, loss=loss)
        right = np.linalg.norm(mapped(result.H, x1[9:]) - mapped(H, x1[9:]), axis=1)
        assert np.median(right) < 1.5
        assert "gross errors" in eg.refine_homography(x1, x2).flags

    def test_four_matches_say_nothing_of_the_noise(self) -> None:
        x1, x2, _ = plane(2, m=4, noise=0.0)
        for loss in ("linear", "cauchy"):
            result = eg.refine_homography(x1, x2, loss=loss)
            assert result.flags == ("weak geometry", "few matches")
            assert np.isinf(result.noise_px)
        known = eg.refine_homography(x1, x2, noise_px=0.1)
        assert "still camera" not in known.flags
        assert np.isfinite(known.covariance).all()

    @pytest.mark.parametrize("m", [5, 6, 7, 8, 60])
    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    def test_random_matches_are_not_said_to_agree(self, m: int, loss: Any) -> None:
        for seed in range(3):
            x1, x2 = np.random.default_rng(seed).uniform(0.0, 1000.0, (2, m, 2))
            result = eg.refine_homography(x1, x2, loss=loss)
            assert "no common geometry" in result.flags
            assert "still camera" not in result.flags
            assert not result.success

    @pytest.mark.parametrize("noise", [0.5, 10.0])
    def test_noise_is_no_lack_of_common_geometry(self, noise: float) -> None:
        for m in (6, 20, 60):
            x1, x2, _ = plane(30 + m, m=m, noise=noise)
            S = np.eye(2) * noise**2
            for options in ({}, {"covariance1": S, "covariance2": S}, {"weights": np.full(m, 9.0)}):
                result = eg.refine_homography(x1, x2, **options)
                assert "no common geometry" not in result.flags, (m, options)

    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    @pytest.mark.parametrize("backend", ["c", "numpy"])
    def test_a_start_that_leads_nowhere_is_said(self, loss: Any, backend: Any) -> None:
        if kernels.available()[backend] is not None:
            pytest.skip(f"back end {backend} {kernels.available()[backend]}")
        x1, x2, _ = plane(5)
        for H0 in (np.diag([1.0, 1.0, 0.0]), np.diag([1.0, 0.0, 0.0])):
            result = eg.refine_homography(x1, x2, H0, loss=loss, backend=backend)
            assert result.status < 0
            assert not result.success
            assert np.isfinite(result.points1).all()

    def test_matches_almost_on_a_line_have_a_start(self) -> None:
        # The algebraic fit sends one of them to infinity.
        for seed in (5, 12, 20, 21, 22):
            rng = np.random.default_rng(seed)
            line = np.column_stack([np.linspace(0.0, 900.0, 60), np.linspace(3.0, 1803.0, 60)])
            H = np.array([[1.0, 0.1, 20.0], [-0.1, 1.0, 5.0], [1e-4, 0.0, 1.0]])
            x1, x2 = (x + 0.01 * rng.standard_normal((60, 2)) for x in (line, mapped(H, line)))
            result = eg.refine_homography(x1, x2)
            assert np.isfinite(result.points1).all()
            # A direction is all but open: rounding decides whether it settles within the limit.
            assert result.status >= 0
            assert result.status > 0 or not result.success

    def test_bad_input_is_refused(self) -> None:
        x1, x2, _ = plane(10)
        with pytest.raises(eg.ArgumentError, match="at least 4"):
            eg.refine_homography(x1[:3], x2[:3])
        with pytest.raises(eg.ArgumentError, match="loss"):
            eg.refine_homography(x1, x2, loss="square")  # type: ignore[arg-type]
        with pytest.raises(eg.ArgumentError, match="H0"):
            eg.refine_homography(x1, x2, np.zeros((3, 3)))
        with pytest.raises(eg.ArgumentError, match="H0"):
            eg.estimate_homography(x1, x2, H0=np.eye(3))


class TestRawMatches:
    @pytest.mark.parametrize(("m", "wrong"), [(20, 0.3), (200, 0.6), (1000, 0.8)])
    def test_wrong_matches_are_found(self, m: int, wrong: float) -> None:
        x1, x2, H = plane(11, m, 0.5)
        rng = np.random.default_rng(1)
        count = round(wrong * m)
        x2[:count] = rng.uniform(0.0, 1000.0, (count, 2))
        result = eg.estimate_homography(x1, x2)
        found, inlier = result.H, result.inlier
        assert [np.array_equal(a, b) for a, b in zip(result, (found, inlier), strict=True)] == [
            True,
            True,
        ]
        off = np.linalg.norm(mapped(found, x1[count:]) - mapped(H, x1[count:]), axis=1)
        assert np.median(off) < 1.0
        assert np.mean(inlier[:count]) < 0.02
        assert np.mean(inlier[count:]) > 0.9

    @pytest.mark.parametrize("m", [20, 200])
    def test_random_matches_have_nothing_in_common(self, m: int) -> None:
        rng = np.random.default_rng(m)
        x1, x2 = rng.uniform(0.0, 1000.0, (2, m, 2))
        result = eg.estimate_homography(x1, x2)
        assert "no common geometry" in result.flags
        assert not result.success

    def test_what_the_camera_did_is_said(self) -> None:
        rng = np.random.default_rng(3)
        x1 = rng.uniform(0.0, 1000.0, (80, 2))
        still = eg.estimate_homography(x1, x1 + 0.5 * rng.standard_normal(x1.shape))
        assert "still camera" in still.flags
        K = np.array([[900.0, 0.0, 500.0], [0.0, 900.0, 500.0], [0.0, 0.0, 1.0]])
        c, s = np.cos(0.1), np.sin(0.1)
        R = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        x2 = mapped(K @ R @ np.linalg.inv(K), x1)
        assert "pure rotation" in eg.estimate_homography(x1, x2).flags

    def test_the_seed_decides(self) -> None:
        x1, x2, _ = plane(12, 50)
        first, second = (eg.estimate_homography(x1, x2, seed=4) for _ in range(2))
        assert np.array_equal(first.H, second.H)

    def test_a_wide_threshold_is_no_chance(self) -> None:
        x1, x2, _ = plane(6)
        assert eg.estimate_homography(x1, x2, threshold_px=1e6).success

    def test_ragged_options_are_refused(self) -> None:
        x1, x2, _ = plane(7)
        for name in ("weights", "covariance1"):
            for estimate in (eg.estimate_homography, eg.estimate_fundamental):
                with pytest.raises(eg.ArgumentError, match=name):
                    estimate(x1, x2, **{name: [[1.0], [1.0, 2.0]]})  # type: ignore[operator]

    @pytest.mark.study
    @pytest.mark.parametrize("estimate", [eg.estimate_homography, eg.estimate_fundamental])
    def test_matches_to_one_place_do_not_agree(self, estimate: Any) -> None:
        def verdict(seed: int) -> str:
            x1, x2, _ = plane(seed)
            x2[:50] = x2[0]
            try:
                return "usable" if estimate(x1, x2).success else "not usable"
            except eg.ArgumentError as error:
                return str(error)

        told = [verdict(seed) for seed in (0, 1, 2, 8)]
        assert all(one == "not usable" or "that agree" in one for one in told), told


@pytest.mark.skipif(kernels.available()["c"] is not None, reason="no C library")
@pytest.mark.parametrize("m", [9, 30, 401])
def test_compiled_planes_are_those_of_the_formulas(m) -> None:
    rng = np.random.default_rng(m)
    q1, w = 1.2 * rng.normal(size=(2, m)), rng.uniform(0.5, 2.0, m)
    there = (np.eye(3) + 0.1 * rng.normal(size=(3, 3))) @ np.vstack([q1, np.ones(m)])
    q2 = there[:2] / (2.0 + there[2]) + 1e-3 * rng.normal(size=(2, m))
    q2[:, : m // 3] = rng.normal(size=(2, m // 3))
    tables = kernels.table("c"), kernels.table("numpy")
    for fit in (robust_homography, fit_homography):
        one, two = (fit(q1, q2, w, table) for table in tables)
        assert abs(np.sum(one[0] * two[0])) == pytest.approx(1.0, abs=1e-9)
        for own, other in zip(one[1:], two[1:], strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-6, atol=1e-9 * np.max(other))
