"""Linear systems of the solver against dense solves with the damping matrix written out."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from epigauge.linear import Arrow, Dense, Levenberg, Seber

LAMBDAS = [1e-8, 1e-3, 1.0, 1e6]


def dense(seed: int = 0, p: int = 7, values: np.ndarray | None = None) -> Dense:
    """A system whose Hessian has given eigenvalues and is not J^T J, as Newton's is not."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((p, p)))[0]
    values = rng.uniform(0.5, 5.0, p) if values is None else values
    H = (Q * values) @ Q.T
    return Dense(rng.standard_normal(p), (H + H.T) / 2, rng.uniform(0.1, 10.0, p))


def arrow(seed: int = 0, p: int = 7, m: int = 5, k: int = 3) -> tuple[Arrow, np.ndarray]:
    """Normal equations in blocks, and J^T J as one matrix."""
    rng = np.random.default_rng(seed)
    rows = 4
    motion = rng.standard_normal((m, rows, p))
    points = rng.standard_normal((m, rows, k))
    r = rng.standard_normal((m, rows))
    blocks = Arrow(
        U=np.einsum("mip,miq->pq", motion, motion),
        W=np.einsum("mip,mik->mpk", motion, points),
        V=np.einsum("mik,mil->mkl", points, points),
        g_motion=np.einsum("mip,mi->p", motion, r),
        g_points=np.einsum("mik,mi->mk", points, r),
    )
    J = np.zeros((m, rows, p + m * k))
    J[:, :, :p] = motion
    for j in range(m):
        J[j, :, p + j * k : p + (j + 1) * k] = points[j]
    J = J.reshape(m * rows, -1)
    np.testing.assert_allclose(blocks.gradient, J.T @ r.ravel(), rtol=0, atol=1e-13)
    return blocks, J.T @ J


def damping_matrix(scaled: bool, diagonal: np.ndarray) -> np.ndarray:
    return np.diag(diagonal) if scaled else np.eye(len(diagonal))


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


class TestDense:
    @pytest.mark.parametrize("lam", LAMBDAS)
    @pytest.mark.parametrize("scaled", [False, True])
    def test_solves_the_damped_system(self, scaled, lam) -> None:
        system = dense()
        W = damping_matrix(scaled, system.diagonal)
        expected = np.linalg.solve(system.hessian + lam * W, -system.gradient)
        # Condition numbers below 100: four digits above rounding.
        assert relative(system.solve(lam, scaled=scaled), expected) < 1e-12

    @pytest.mark.parametrize("scaled", [False, True])
    def test_indefinite_hessian_that_damping_makes_definite_is_solved_as_it_is(
        self, scaled
    ) -> None:
        system = dense(values=np.array([-1.0, 0.5, 1, 2, 3, 4, 5]))
        W = damping_matrix(scaled, system.diagonal)
        expected = np.linalg.solve(system.hessian + 50.0 * W, -system.gradient)
        assert relative(system.solve(50.0, scaled=scaled), expected) < 1e-12

    @pytest.mark.parametrize("lam", LAMBDAS)
    @pytest.mark.parametrize("scaled", [False, True])
    @pytest.mark.parametrize("seed", range(5))
    def test_indefinite_hessian_gives_a_descent_direction(self, seed, scaled, lam) -> None:
        system = dense(seed, values=np.array([-4.0, -1.0, 0.0, 1e-8, 2, 3, 1e4]))
        step = system.solve(lam, scaled=scaled)
        slope = system.gradient @ step
        assert slope < 0.0
        assert system.predicted(step) > 0.0
        # It is the step of a definite matrix H + shift W, shift >= lam.
        scale = np.sqrt(system.diagonal) if scaled else np.ones(7)
        lowest = np.linalg.eigvalsh(system.hessian / np.outer(scale, scale))[0]
        shift = lam if lowest + lam > 0 else lam - 1.001 * lowest
        H = system.hessian + shift * np.diag(scale**2)
        # Its smallest eigenvalue is a thousandth of the negative one: three digits are lost.
        assert relative(step, np.linalg.solve(H, -system.gradient)) < 1e-9

    @pytest.mark.parametrize("scaled", [False, True])
    def test_step_shortens_and_turns_to_the_gradient_as_lambda_grows(self, scaled) -> None:
        system = dense(values=np.array([-4.0, 1, 1, 2, 3, 4, 5]))
        scale = np.sqrt(system.diagonal) if scaled else np.ones(7)
        lengths = [
            np.linalg.norm(scale * system.solve(lam, scaled=scaled)) for lam in 10.0 ** np.arange(8)
        ]
        # Where the lift ends, lambda beyond 4, no step is longer than the one before.
        assert all(a > b for a, b in itertools.pairwise(lengths[1:]))
        last = system.solve(1e12, scaled=scaled)
        assert relative(last * 1e12, -system.gradient / scale**2) < 1e-9

    def test_zero_gradient_gives_a_zero_step(self) -> None:
        system = Dense(np.zeros(3), np.diag([-1.0, 0.0, 2.0]), np.ones(3))
        for scaled in (False, True):
            np.testing.assert_array_equal(system.solve(1e-3, scaled=scaled), np.zeros(3))

    @pytest.mark.parametrize("scaled", [False, True])
    def test_parameter_without_influence_is_left_alone(self, scaled) -> None:
        # A column of zeros in J: its scale is zero too.
        system = Dense(np.array([1.0, 0.0]), np.diag([4.0, 0.0]), np.array([4.0, 0.0]))
        step = system.solve(1e-3, scaled=scaled)
        assert step[1] == 0.0
        assert step[0] == pytest.approx(-1 / (4 + 1e-3 * (4 if scaled else 1)), rel=1e-14)

    def test_predicted_is_the_decrease_of_the_quadratic_model(self) -> None:
        system = dense(values=np.array([-4.0, 1, 1, 2, 3, 4, 5]))
        rng = np.random.default_rng(1)
        for _ in range(5):
            s = rng.standard_normal(7)
            model = sum(system.gradient[i] * s[i] for i in range(7)) + 0.5 * sum(
                system.hessian[i, j] * s[i] * s[j] for i in range(7) for j in range(7)
            )
            assert system.predicted(s) == pytest.approx(-model, rel=1e-12, abs=1e-13)

    def test_decrement_is_what_the_undamped_step_promises(self) -> None:
        system = dense()
        step = np.linalg.solve(system.hessian, -system.gradient)
        assert system.decrement() == pytest.approx(system.predicted(step), rel=1e-12)
        rng = np.random.default_rng(2)
        for _ in range(20):  # no other step promises more
            other = step + 0.1 * rng.standard_normal(7)
            assert system.predicted(other) < system.decrement()

    @pytest.mark.parametrize("lowest", [-1.0, -1e-12, 0.0, 1e-17])
    def test_decrement_is_unknown_unless_the_hessian_is_definite(self, lowest) -> None:
        system = dense(values=np.array([lowest, 1, 1, 2, 3, 4, 5]))
        assert system.decrement() == math.inf

    def test_largest_is_that_of_the_diagonal(self) -> None:
        system = dense()
        assert system.largest() == system.diagonal.max()

    @pytest.mark.parametrize("factor", [1e-3, 1e3])
    def test_seber_steps_do_not_depend_on_the_units(self, factor) -> None:
        system = dense()
        units = np.array([factor, 1, 1, 1, 1 / factor, 1, 1])
        changed = Dense(
            system.gradient * units,
            system.hessian * np.outer(units, units),
            system.diagonal * units**2,
        )
        step = changed.solve(0.3, scaled=True) * units
        assert relative(step, system.solve(0.3, scaled=True)) < 1e-11

    @pytest.mark.parametrize("factor", [1e-12, 1e12])
    def test_steps_do_not_depend_on_the_unit_of_the_cost(self, factor) -> None:
        # Nor does what lifts a parameter without influence from zero.
        one = Dense(np.array([1.0, 1e-20]), np.diag([4.0, 0.0]), np.array([4.0, 0.0]))
        other = Dense(factor * one.gradient, factor * one.hessian, factor * one.diagonal)
        assert relative(other.solve(0.3, scaled=True), one.solve(0.3, scaled=True)) < 1e-12

    @pytest.mark.parametrize("scaled", [False, True])
    @pytest.mark.parametrize("share", [0.3749, -0.3749, 0.3751])
    def test_a_step_bends_where_that_is_short_against_it(self, scaled, share) -> None:
        # Transtrum and Sethna: twice the correction is at most 0.75 of the step.
        system, lam = dense(), 0.1
        straight = system.solve(lam, scaled=scaled)
        scale = np.sqrt(system.diagonal) if scaled else np.ones(7)
        damped = system.hessian + lam * np.diag(scale**2)
        # J^T r''(v, v) that bends the step v by `share` of its length, across it.
        across = np.roll(straight * scale, 1)
        across *= share * np.linalg.norm(straight * scale) / np.linalg.norm(across) / scale
        twice = -2.0 * damped @ across
        bend = np.multiply.outer(twice, np.outer(straight, straight)) / (straight @ straight) ** 2
        bent = replace(system, bend=bend).solve(lam, scaled=scaled)
        taken = 2.0 * abs(share) <= 0.75
        assert relative(bent, straight + across if taken else straight) < 1e-10


class TestArrow:
    @pytest.mark.parametrize("lam", LAMBDAS)
    @pytest.mark.parametrize("scaled", [False, True])
    @pytest.mark.parametrize(("m", "p", "k"), [(5, 7, 3), (1, 2, 3), (12, 24, 4), (40, 7, 1)])
    def test_solves_the_damped_normal_equations(self, m, p, k, scaled, lam) -> None:
        blocks, N = arrow(3, p=p, m=m, k=k)
        W = damping_matrix(scaled, np.diag(N))
        expected = np.linalg.solve(N + lam * W, -blocks.gradient)
        # Two solutions of a system of condition c agree to about c * 1e-16.
        tolerance = 1e-14 * np.linalg.cond(N + lam * W) + 1e-12
        assert relative(blocks.solve(lam, scaled=scaled), expected) < tolerance

    @pytest.mark.parametrize("scaled", [False, True])
    def test_solves_with_the_constraints_of_the_border(self, scaled) -> None:
        blocks, N = arrow(4, m=6, k=3)
        border = np.random.default_rng(2).standard_normal((*blocks.g_points.shape, 2))
        full = np.vstack([np.zeros((len(blocks.U), 2)), border.reshape(-1, 2)])
        damped = N + 0.1 * damping_matrix(scaled, np.diag(N)) + full @ full.T
        expected = np.linalg.solve(damped, -blocks.gradient)
        step = replace(blocks, border=border).solve(0.1, scaled=scaled)
        assert relative(step, expected) < 1e-11

    @pytest.mark.parametrize("factor", [1e-12, 1e12])
    def test_steps_do_not_depend_on_the_unit_of_the_cost(self, factor) -> None:
        one, _ = arrow(5)
        for block in (one.W, one.V):
            block[2] = 0.0
        one.g_points[2] = 1e-20
        parts = ("U", "W", "V", "g_motion", "g_points")
        other = Arrow(**{name: factor * getattr(one, name) for name in parts})
        assert relative(other.solve(0.3, scaled=True), one.solve(0.3, scaled=True)) < 1e-12

    def test_predicted_is_the_decrease_of_the_quadratic_model(self) -> None:
        blocks, N = arrow(4)
        rng = np.random.default_rng(1)
        for _ in range(5):
            s = rng.standard_normal(len(N))
            model = blocks.gradient @ s + 0.5 * s @ N @ s
            assert blocks.predicted(s) == pytest.approx(-model, rel=1e-12)

    def test_predicted_counts_the_constraints_of_the_border(self) -> None:
        blocks, N = arrow(4)
        rng = np.random.default_rng(2)
        border = rng.standard_normal((*blocks.g_points.shape, 2))
        bordered = replace(blocks, border=border)
        full = np.vstack([np.zeros((len(blocks.U), 2)), border.reshape(-1, 2)])
        N = N + full @ full.T
        for _ in range(5):
            s = rng.standard_normal(len(N))
            model = blocks.gradient @ s + 0.5 * s @ N @ s
            assert bordered.predicted(s) == pytest.approx(-model, rel=1e-12)

    def test_largest_is_that_of_the_diagonal(self) -> None:
        for seed in range(10):  # whether the motion or a point holds it
            blocks, N = arrow(seed, m=seed + 1)
            assert blocks.largest() == pytest.approx(np.diag(N).max(), rel=1e-14)

    def test_decrement_is_unknown(self) -> None:
        assert arrow()[0].decrement() == math.inf

    @pytest.mark.parametrize("scaled", [False, True])
    def test_point_without_influence_is_left_alone(self, scaled) -> None:
        # A match of weight zero: its blocks and its gradient vanish.
        blocks, N = arrow(5)
        for block in (blocks.W, blocks.V, blocks.g_points):
            block[2] = 0.0
        keep = np.r_[0:13, 16:22]  # without the three columns of point 2
        U = damping_matrix(scaled, np.diag(N))[np.ix_(keep, keep)]
        gradient = np.concatenate([blocks.g_motion, blocks.g_points.ravel()])[keep]
        expected = np.linalg.solve(N[np.ix_(keep, keep)] + 1e-3 * U, -gradient)
        step = blocks.solve(1e-3, scaled=scaled)
        np.testing.assert_array_equal(step[13:16], 0.0)
        assert relative(step[keep], expected) < 1e-12


class TestDampings:
    def test_levenberg_adds_lambda_times_the_identity(self) -> None:
        for system in (dense(), arrow()[0]):
            step = Levenberg().step(system, 0.25)
            np.testing.assert_array_equal(step, system.solve(0.25, scaled=False))
            assert Levenberg(0.5).start(system) == 0.5 * system.typical()

    def test_seber_multiplies_the_diagonal_by_one_plus_lambda(self) -> None:
        for system in (dense(), arrow()[0]):
            step = Seber().step(system, 0.25)
            np.testing.assert_array_equal(step, system.solve(0.25, scaled=True))
            assert Seber(0.5).start(system) == 0.5
