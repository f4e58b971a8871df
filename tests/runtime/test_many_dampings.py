"""Which damping satisfies B03 eq. (8), which does not, and what Table 1 of B03 really gives."""

from __future__ import annotations

from typing import Any

import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.bundle import dampings
from epigauge.bundle.solve import BundleSystem
from epigauge.multi_view.gauge import Transformation
from epigauge.two_view.losses import Loss
from laws import distance

Array = many_views.Array

N_VIEWS, N_POINTS = 4, 20


def system_at(problem: many_views.Problem, P: Array, Q: Array) -> BundleSystem:
    return problem.linearize(problem.evaluate((P, Q)))


def transformation(seed: int, kind: str) -> Transformation:
    """Return T~ of some kind: general, orthonormal without scales, or scales only."""
    rng = np.random.default_rng(seed)
    change = many_views.gauge_change(rng, N_VIEWS, N_POINTS, 1.0 if kind == "orthonormal" else 10.0)
    if kind == "orthonormal":
        return Transformation(change.T, np.ones(N_VIEWS), np.ones(N_POINTS))
    return (
        change
        if kind == "general"
        else Transformation(np.eye(4), change.camera_scales, change.point_scales)
    )


def violation_of_eq8(damping: Any, change: Transformation, **options: Any) -> float:
    """Return |W' - T~^-T W T~^-1| / |W'|, for dampings without W that of W^-1' = T~ W^-1 T~^T."""
    problem, state, system = many_views.small_system(N_VIEWS, N_POINTS, **options)
    other = system_at(problem, *change.apply(state.P, state.Q))
    worst = 0.0
    if isinstance(damping, dampings.ByMatrix):
        blocks = zip(
            many_views.matrix(damping, system),
            many_views.matrix(damping, other),
            change.inverse().blocks(),
            strict=True,
        )
        for W, W_other, back in blocks:
            expected = back.swapaxes(1, 2) @ W @ back
            error = np.linalg.norm(W_other - expected, axis=(1, 2))
            worst = max(worst, (error / np.linalg.norm(W_other, axis=(1, 2))).max())
        return float(worst)
    blocks = zip(
        damping.directions(system), damping.directions(other), change.blocks(), strict=True
    )
    for R_T, R_T_other, there in blocks:
        expected = there @ R_T @ R_T.swapaxes(1, 2) @ there.swapaxes(1, 2)
        found = R_T_other @ R_T_other.swapaxes(1, 2)
        error = np.linalg.norm(found - expected, axis=(1, 2)) / np.linalg.norm(found, axis=(1, 2))
        worst = max(worst, error.max())
    return float(worst)


@pytest.mark.parametrize("seed", range(10))
def test_covariant_damping_satisfies_eq8(seed: int) -> None:
    change = transformation(seed, "general")
    assert violation_of_eq8(dampings.Covariant(), change, seed=seed % 3) < 1e-9


def test_covariant_damping_satisfies_eq8_with_a_robust_loss() -> None:
    problem, state, _ = many_views.small_system(N_VIEWS, N_POINTS)
    problem.loss = Loss("cauchy", 0.003)
    change = transformation(3, "general")
    W = many_views.matrix(dampings.Covariant(), system_at(problem, state.P, state.Q))
    W_other = many_views.matrix(
        dampings.Covariant(), system_at(problem, *change.apply(state.P, state.Q))
    )
    for a, b, back in zip(W, W_other, change.inverse().blocks(), strict=True):
        expected = back.swapaxes(1, 2) @ a @ back
        assert distance(b / np.abs(b).max(), expected / np.abs(b).max()) < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_covariant_damping_is_positive_definite(seed: int) -> None:
    # Views of all points, points of two views: the fewest a point may have.
    for seen in (1.0, 0.01):
        problem, _, system = many_views.small_system(N_VIEWS, 30, seen=seen, seed=seed)
        assert np.bincount(problem.graph.point).min() == (N_VIEWS if seen == 1.0 else 2)
        for W in many_views.matrix(dampings.Covariant(), system):
            values = np.linalg.eigvalsh(W)
            assert (values[:, 0] > 1e-9 * values[:, -1]).all()
        # Without the depths the blocks are singular along the homogeneous scales.
        for block in (system.U, system.V):
            values = np.linalg.eigvalsh(block)
            assert (values[:, 0] < 1e-12 * values[:, -1]).all()


@pytest.mark.parametrize(
    "damping",
    [
        dampings.Levenberg(),
        dampings.Marquardt(),
        dampings.GaugeInvariant("product"),
        dampings.GaugeInvariant("factor"),
    ],
    ids=lambda damping: type(damping).__name__ + getattr(damping, "norm", ""),
)
class TestOthers:
    def test_violate_eq8_for_a_general_change(self, damping: Any) -> None:
        for seed in range(5):
            assert violation_of_eq8(damping, transformation(seed, "general")) > 0.1

    def test_satisfy_eq8_for_an_orthonormal_change_but_for_the_diagonal(self, damping: Any) -> None:
        for seed in range(5):
            violation = violation_of_eq8(damping, transformation(seed, "orthonormal"))
            if isinstance(damping, dampings.Marquardt):
                assert violation > 0.1
            else:
                assert violation < 1e-9

    def test_violate_eq8_for_scales_but_for_the_diagonal(self, damping: Any) -> None:
        for seed in range(5):
            violation = violation_of_eq8(damping, transformation(seed, "scales"))
            if isinstance(damping, dampings.Marquardt):
                assert violation < 1e-9
            else:
                assert violation > 0.1


class TestImplicit:
    @pytest.mark.parametrize("inner", [dampings.Levenberg(), dampings.Covariant()])
    def test_damps_as_if_in_the_gauge(self, inner: Any) -> None:
        problem, state, system = many_views.small_system(N_VIEWS, N_POINTS)
        gauge = many_views.eg.gauge.reference_camera()
        there = gauge.transformation(state.P, state.Q)
        W_there = many_views.matrix(inner, system_at(problem, *there.apply(state.P, state.Q)))
        W = many_views.matrix(dampings.Implicit(inner, gauge), system)
        for a, b, T in zip(W, W_there, there.blocks(), strict=True):
            expected = T.swapaxes(1, 2) @ b @ T
            assert distance(a / np.abs(expected).max(), expected / np.abs(expected).max()) < 1e-9

    def test_of_lambda_I_is_eq9_with_the_scales_inverse(self) -> None:
        # Basis and scales by themselves: a gauge that finds both together would hide the exponents.
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        rng = np.random.default_rng(5)
        T = np.eye(4) + 0.3 * rng.standard_normal((4, 4))
        gamma, alpha = rng.uniform(0.3, 3.0, N_VIEWS), rng.uniform(-3.0, -0.3, N_POINTS)

        class Elsewhere:
            def transformation(self, P: Array, Q: Array) -> Any:
                # The paper's T leads from where W = I to here; a gauge's leads there.
                return many_views.eg.gauge.Transformation(T, gamma, alpha).inverse()

        cameras, points = many_views.matrix(
            dampings.Implicit(dampings.Levenberg(), Elsewhere()), system
        )
        A = T.T @ T
        for i in range(N_VIEWS):
            expected = np.kron(np.eye(3), np.linalg.inv(A) / gamma[i] ** 2)
            assert distance(cameras[i], expected) < 1e-12
            assert distance(cameras[i], expected * gamma[i] ** 4) > 0.1  # as printed
        for j in range(N_POINTS):
            assert distance(points[j], A / alpha[j] ** 2) < 1e-12
        kernel = kernels.table("numpy").implicit_damping(T, np.linalg.inv(T), gamma[0], alpha[0])
        assert distance(cameras[0], kernel[0]) < 1e-12
        assert distance(points[0], kernel[1]) < 1e-12

    def test_of_the_covariant_damping_is_itself(self) -> None:
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        W = many_views.matrix(dampings.Covariant(), system)
        implicit = dampings.Implicit(dampings.Covariant(), many_views.eg.gauge.two_cameras())
        for a, b in zip(many_views.matrix(implicit, system), W, strict=True):
            assert distance(a / np.abs(b).max(), b / np.abs(b).max()) < 1e-9


class TestTable1:
    """max <R^T R, G> under |R^T R| (as printed) or |vec R| (as solved in the text)."""

    @pytest.fixture
    def grams(self) -> tuple[BundleSystem, list[tuple[Array, float]]]:
        """Return a system and, for each block of R, its G and normalisation b."""
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        blocks = [(g.reshape(3, 4).T @ g.reshape(3, 4), 12.0) for g in system.normal.g_cameras]
        return system, [*blocks, (system.normal.g_points.T @ system.normal.g_points, 4.0)]

    @staticmethod
    def factors(norm: str, system: BundleSystem) -> list[Array]:
        """Return M_1^T, ..., M_n^T and S^T, checking that they are repeated."""
        cameras, points = dampings.GaugeInvariant(norm).directions(system)
        k = cameras.shape[2] // 3
        found = []
        for block in cameras:
            M = block[:4, :k]
            np.testing.assert_array_equal(block, np.kron(np.eye(3), M))
            found.append(M)
        assert (points == points[0]).all()
        return [*found, points[0]]

    @staticmethod
    def size(norm: str, R_T: Array) -> float:
        return float(np.sum((R_T @ R_T.T if norm == "product" else R_T) ** 2))

    @pytest.mark.parametrize("norm", ["product", "factor"])
    def test_R_is_feasible_and_better_than_every_other(self, norm: str, grams: Any) -> None:
        system, blocks = grams
        rng = np.random.default_rng(0)
        for R_T, (G, b) in zip(self.factors(norm, system), blocks, strict=True):
            assert self.size(norm, R_T) == pytest.approx(b, rel=1e-12)
            best = np.trace(R_T.T @ G @ R_T)
            for near in (0.0, 0.0, 1.0, 1.0, 1.0) * 40:
                # Any, or a small change of the solution; upper triangular, as the paper has it.
                upper = np.triu(rng.standard_normal((4, 4)))
                if near:
                    A = R_T @ R_T.T + 1e-3 * np.trace(R_T @ R_T.T) * upper.T @ upper
                    upper = np.linalg.cholesky(A).T
                power = 0.25 if norm == "product" else 0.5
                upper = upper * (b / self.size(norm, upper.T)) ** power
                assert self.size(norm, upper.T) == pytest.approx(b, rel=1e-9)
                assert np.trace(upper @ G @ upper.T) <= best * (1.0 + 1e-12)

    def test_as_solved_in_the_text_every_block_has_rank_one(self, grams: Any) -> None:
        system, blocks = grams
        for R_T, (G, b) in zip(self.factors("factor", system), blocks, strict=True):
            values, vectors = np.linalg.eigh(R_T @ R_T.T)
            assert abs(values[:3]).max() < 1e-12 * values[3]
            top = np.linalg.eigh(G)[1][:, 3]
            assert abs(vectors[:, 3] @ top) == pytest.approx(1.0, rel=1e-12)
            assert values[3] == pytest.approx(b, rel=1e-12)

    def test_as_printed_the_blocks_are_proportional_to_G(self, grams: Any) -> None:
        # Cauchy-Schwarz: <R^T R, G> <= |R^T R| |G|. A camera has three gradients: rank three, and
        # W still does not exist; but it moves in nine directions, points in all.
        system, blocks = grams
        for R_T, (G, b) in zip(self.factors("product", system), blocks, strict=True):
            expected = np.sqrt(b) * G / np.linalg.norm(G)
            assert distance(R_T @ R_T.T, expected) < 1e-12
        cameras, points = dampings.GaugeInvariant("product").directions(system)
        for block in cameras:
            values = np.linalg.eigvalsh(block @ block.T)
            assert (values[:3] < 1e-12 * values[-1]).all()
            assert values[3] > 1e-12 * values[-1]
        values = np.linalg.eigvalsh(points[0] @ points[0].T)
        assert values[0] > 1e-9 * values[-1]

    def test_the_singular_vector_is_not_the_solution_of_the_printed_problem(
        self, grams: Any
    ) -> None:
        system, blocks = grams
        ones = self.factors("factor", system)
        for R_T, v, (G, b) in zip(self.factors("product", system), ones, blocks, strict=True):
            v = v * (b / self.size("product", v)) ** 0.25
            assert self.size("product", v) == pytest.approx(b, rel=1e-12)
            assert np.trace(R_T.T @ G @ R_T) > (1.0 + 1e-6) * np.trace(v.T @ G @ v)

    def test_in_neither_reading_W_exists_for_a_camera(self, grams: Any) -> None:
        # Three rows, three gradients: G has rank 3 of 4.
        system, blocks = grams
        for G, b in blocks:
            values = np.linalg.eigvalsh(G)
            assert (values[0] < 1e-12 * values[3]) == (b == 12.0)
            assert values[1] > 1e-12 * values[3]
        for norm in ("product", "factor"):
            for R_T in self.factors(norm, system)[:-1]:
                assert np.linalg.matrix_rank(R_T @ R_T.T, tol=1e-9) < 4

    def test_b_of_a_camera_is_three_times_that_of_the_identity(self, grams: Any) -> None:
        # The paper normalises "as the standard choice": |W|^2 = |I|^2 = p, 4 for each 4x4 block.
        system, _ = grams
        cameras, points = dampings.GaugeInvariant("product").directions(system)
        identities = np.eye(12), np.eye(4)
        for block, identity, ratio in zip((cameras[0], points[0]), identities, (3, 1), strict=True):
            size = float(np.sum((block @ block.T) ** 2))
            assert size == pytest.approx(ratio * np.sum(identity**2), rel=1e-12)

    def test_the_first_normalisation_of_section_6_has_no_maximum(self) -> None:
        # max g^T W^-1 g over |W|^2 = p: an eigenvalue along g that goes to zero.
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        g, p = system.gradient, len(system.gradient)
        unit = g / np.linalg.norm(g)
        values = []
        for along in (1.0, 1e-2, 1e-4):
            W = np.eye(p) + (along - 1.0) * np.outer(unit, unit)
            W *= np.sqrt(p) / np.linalg.norm(W)
            values.append(g @ np.linalg.solve(W, g))
        assert values[2] > 90.0 * values[1] > 8000.0 * values[0]

    @pytest.mark.parametrize("norm", ["product", "factor"])
    def test_a_larger_lambda_shortens_the_step_as_in_section_6(self, norm: str) -> None:
        # With Table 1's W^-1 = lambda R^T R a rejected step would be followed by a longer one.
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        damping = dampings.GaugeInvariant(norm)
        start = damping.start(system)
        lengths = [np.linalg.norm(damping.step(system, start * 10.0**k)) for k in range(10)]
        assert (np.diff(lengths) < 0.0).all()
        # Far out, delta = -R^T R g / lambda.
        assert lengths[-1] == pytest.approx(0.1 * lengths[-2], rel=0.05)

    @pytest.mark.parametrize("norm", ["product", "factor"])
    @pytest.mark.parametrize("lam", [1e-2, 1.0, 1e3])
    def test_dual_step_is_the_damped_step_where_R_is_invertible(
        self, norm: str, lam: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        rng = np.random.default_rng(1)
        R_T = (
            rng.standard_normal((N_VIEWS, 12, 12)) + 3.0 * np.eye(12),
            rng.standard_normal((N_POINTS, 4, 4)) + 2.0 * np.eye(4),
        )
        damping = dampings.GaugeInvariant(norm)
        monkeypatch.setattr(dampings.GaugeInvariant, "directions", lambda self, system: R_T)
        found = np.asarray(damping.step(system, lam))
        R = many_views.block_diagonal(R_T).T
        N = many_views.dense(system)
        expected = -np.linalg.solve(N + lam * np.linalg.inv(R.T @ R), system.gradient)
        size = np.abs(expected).max()
        assert distance(found / size, expected / size) < 1e-8

    @pytest.mark.parametrize("norm", ["product", "factor"])
    def test_dual_step_without_a_W(self, norm: str) -> None:
        _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
        damping = dampings.GaugeInvariant(norm)
        lam = 0.1 * damping.start(system)
        R = many_views.block_diagonal(damping.directions(system)).T
        N, g = many_views.dense(system), system.gradient
        inner = R @ N @ R.T + lam * np.eye(len(R))
        expected = -R.T @ np.linalg.solve(inner, R @ g)
        size = np.abs(expected).max()
        assert distance(np.asarray(damping.step(system, lam)) / size, expected / size) < 1e-9


@pytest.mark.parametrize(
    "damping", [dampings.Levenberg(), dampings.Marquardt(), dampings.Covariant()]
)
def test_steps_solve_the_damped_normal_equations(damping: Any) -> None:
    _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
    lam = 10.0 * damping.start(system)
    step = damping.step(system, lam)
    W = many_views.block_diagonal(many_views.matrix(damping, system))
    damped = many_views.dense(system) + lam * W
    scale = np.abs(system.gradient).max()
    assert np.abs(damped @ np.asarray(step) + system.gradient).max() < 1e-9 * scale
    assert system.predicted(step) > 0.0


def test_a_rejected_pseudo_inverse_step_gets_shorter() -> None:
    _, _, system = many_views.small_system(N_VIEWS, N_POINTS)
    damping = dampings.PseudoInverse(kernels.table())
    full, half = (damping.step(system, lam) for lam in (0.0, 1.0))
    assert distance(np.asarray(half), 0.5 * np.asarray(full)) < 1e-14
    # The promise is a parabola of the length: at half of it, three quarters of the best.
    assert half.promised == pytest.approx(0.75 * full.promised, rel=1e-9)
