"""Normal equations of cameras and points: blocks, solutions, null space, against dense algebra."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.multi_view import coupling as coupling_module
from epigauge.multi_view import null_space
from epigauge.multi_view import system as system_module
from epigauge.multi_view.problem import BundleState
from epigauge.two_view.losses import Loss
from laws import central_differences, distance

SEEDS = [0, 1]


@pytest.fixture(params=SEEDS)
def small(request: pytest.FixtureRequest) -> tuple:
    return many_views.small_system(seed=request.param)


def damped(system: system_module.BundleSystem, seed: int = 0) -> system_module.BundleSystem:
    """Return the system with random positive definite blocks added."""
    rng = np.random.default_rng(seed)
    blocks = []
    for like in (system.U, system.V):
        root = rng.standard_normal(like.shape)
        size = np.einsum("nii->n", like)[:, None, None] / like.shape[1]
        blocks.append(0.1 * size * (root @ root.swapaxes(1, 2)))
    return system.damped(*blocks)


@pytest.mark.parametrize("backend", kernels.NAMES)
def test_blocks_and_gradient_equal_a_dense_jacobian_by_differences(backend: str) -> None:
    many_views.need_backend(backend)
    problem, state, _ = many_views.small_system(3, 12)
    problem.kernels = kernels.table(backend)
    problem.weights = np.random.default_rng(0).uniform(0.5, 2.0, problem.q.shape[1])
    state = problem.evaluate((state.P, state.Q))
    system = problem.linearize(state)

    def residuals(step: np.ndarray) -> np.ndarray:
        moved: BundleState = problem.evaluate(problem.retract(state, step))
        return np.sqrt(problem.weights) * moved.r

    count = system.gradient.size
    J = central_differences(residuals, np.zeros(count)).reshape(-1, count)
    r = residuals(np.zeros(count)).ravel()
    # Values of order one; central_differences promises about 1e-12.
    assert distance(many_views.dense(system), J.T @ J) < 1e-9
    assert distance(system.gradient, J.T @ r) < 1e-9


@pytest.mark.parametrize("name", ["linear", "huber", "soft_l1", "cauchy"])
def test_gradient_is_the_derivative_of_the_robust_cost(name: str) -> None:
    problem, state, _ = many_views.small_system(3, 12)
    # Residuals are about 3 px of 1000: the scale has them on both sides.
    problem.loss = Loss(name, 0.004)
    state = problem.evaluate((state.P, state.Q))
    size = state.cost
    found = problem.linearize(state).gradient / size
    expected = central_differences(
        lambda step: problem.evaluate(problem.retract(state, step)).cost / size,
        np.zeros(found.size),
        1e-5,
    )
    # Rounding 1e-16 / 1e-5, times a gradient that is large against the small cost. A difference
    # across the jump of Huber's second derivative is of first order.
    assert distance(found, expected) < (1e-4 if name == "huber" else 1e-7)


def test_beyond_a_truncated_loss_nothing_pulls_but_everything_stays_determined() -> None:
    problem, state, _ = many_views.small_system(3, 12)
    problem.loss = Loss("truncated", 0.003)
    state = problem.evaluate((state.P, state.Q))
    far = np.sum(state.r**2, axis=0) > problem.loss.scale**2
    assert far.any()
    assert not far.all()
    np.testing.assert_allclose(state.root[far], 1e-4)
    np.testing.assert_allclose(state.root[~far], 1.0)


def test_solve_equals_a_dense_solve(small: tuple) -> None:
    system = damped(small[2])
    expected = np.linalg.solve(many_views.dense(system), -system.gradient)
    size = np.abs(expected).max()
    assert distance(system.solve() / size, expected / size) < 1e-9


def test_border_is_solved_by_woodbury(small: tuple) -> None:
    system = damped(small[2])
    rng = np.random.default_rng(3)
    shapes = (system.g_cameras.shape, system.g_points.shape)
    border = rng.standard_normal((*shapes[0], 5)), rng.standard_normal((*shapes[1], 5))
    bordered = replace(system, border=border)
    N = many_views.dense(bordered)
    expected = np.linalg.solve(N, -system.gradient)
    size = np.abs(expected).max()
    assert distance(bordered.solve() / size, expected / size) < 1e-9
    step = rng.standard_normal(system.gradient.size)
    assert distance(bordered.product(step), N @ step) < 1e-12


@pytest.mark.parametrize("entry", [2.0, np.nan])
def test_conjugate_gradients_tell_of_a_system_that_is_not_definite(entry: float) -> None:
    S = np.array([[1.0, entry], [entry, 1.0]])
    reduced = SimpleNamespace(
        diagonal=lambda: np.ones((2, 1, 1)), times=lambda x: (S @ x.ravel()).reshape(x.shape)
    )
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        coupling_module.conjugate_gradients(reduced, np.array([[1.0], [-1.0]]))


def test_conjugate_gradients_give_the_same_solution(
    small: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = damped(small[2])
    border = tuple(
        np.random.default_rng(4).standard_normal((*g.shape, 2))
        for g in (system.g_cameras, system.g_points)
    )
    for each in (system, replace(system, border=border)):
        direct = each.solve()
        with monkeypatch.context() as patch:
            patch.setattr(coupling_module, "DENSE_CAMERAS", 0)
            patch.setattr(
                system_module.BundleSystem, "_reduced_matrix", lambda self: pytest.fail("dense")
            )
            iterated = each.solve()
        size = np.abs(direct).max()
        # The tolerance of the iteration is 1e-10 in the norm of the preconditioned system.
        assert distance(iterated / size, direct / size) < 1e-7


def test_product_and_prediction_equal_dense_ones(small: tuple) -> None:
    _, _, system = small
    N = many_views.dense(system)
    step = np.random.default_rng(5).standard_normal(len(N))
    assert distance(system.product(step), N @ step) < 1e-12
    model = system.gradient @ step + 0.5 * step @ N @ step
    assert system.predicted(step) == pytest.approx(-model, rel=1e-12)


def test_prediction_is_the_decrease_of_the_cost_to_second_order(small: tuple) -> None:
    problem, state, system = small
    direction = damped(system).solve()
    errors = []
    for size in (1e-3, 1e-4):
        actual = state.cost - problem.evaluate(problem.retract(state, size * direction)).cost
        errors.append(abs(actual - system.predicted(size * direction)))
    # Gauss-Newton leaves out r d2r: second order, with small residuals in front.
    assert errors[1] < errors[0] / 50.0


def test_transformed_is_the_congruence_and_freezes_columns_of_zeros(small: tuple) -> None:
    _, _, system = small
    rng = np.random.default_rng(6)
    B_cameras = rng.standard_normal((len(system.U), 12, 9))
    B_points = rng.standard_normal((len(system.V), 4, 3))
    frozen = [2, 5, 9 * len(system.U) + 1]
    B_cameras[0][:, frozen[:2]] = 0.0
    B_points[0][:, 1] = 0.0
    shapes = (system.g_cameras.shape, system.g_points.shape)
    system = replace(
        system, border=(rng.standard_normal((*shapes[0], 2)), rng.standard_normal((*shapes[1], 2)))
    )
    moved = system.transformed(B_cameras, B_points)
    B = many_views.block_diagonal((B_cameras, B_points))
    expected = B.T @ many_views.dense(system) @ B
    expected[frozen, frozen] = 1.0
    assert distance(many_views.dense(moved), expected) < 1e-12
    assert distance(moved.gradient, B.T @ system.gradient) < 1e-12
    identity = (np.tile(np.eye(k), (len(b), 1, 1)) for k, b in ((9, moved.U), (3, moved.V)))
    assert (moved.damped(*identity).solve()[frozen] == 0.0).all()


def test_grounded_solution_equals_a_dense_one(small: tuple) -> None:
    _, state, system = small
    p, q = null_space.scales(state.P, state.Q)
    grounded = system.damped(p[:, :, None] * p[:, None, :], q[:, :, None] * q[:, None, :])
    moves = null_space.generators(kernels.table(), state.P, state.Q)[: state.P.size]
    N = many_views.dense(grounded)
    N[: len(moves), : len(moves)] += moves @ moves.T
    expected = np.linalg.solve(N, -system.gradient)
    size = np.abs(expected).max()
    # The flattest direction of a small scene costs a few digits.
    assert distance(grounded.solve_grounded(moves) / size, expected / size) < 1e-7


def test_kernels_have_the_kronecker_structure_of_the_projective_camera() -> None:
    # J_P = D kron Q^T and J_Q = D P give J_P^T J_P = (D^T D) kron Q Q^T and
    # J_P^T J_Q = A kron Q, A = D^T D P.
    rng = np.random.default_rng(7)
    P, Q = rng.standard_normal((3, 4, 50)), rng.standard_normal((4, 50))
    _, J_P, J_Q, depth = kernels.table().project(P, Q)
    for k in range(50):
        h = P[..., k] @ Q[:, k]
        D = np.array([[1.0, 0.0, -h[0] / h[2]], [0.0, 1.0, -h[1] / h[2]]]) / h[2]
        assert depth[k] == pytest.approx(h[2], rel=1e-12)
        QQ = np.outer(Q[:, k], Q[:, k])
        pairs = (
            (J_P[..., k], np.kron(D, Q[:, k])),
            (J_Q[..., k], D @ P[..., k]),
            (J_P[..., k].T @ J_P[..., k], np.kron(D.T @ D, QQ)),
            (J_P[..., k].T @ J_Q[..., k], np.kron(D.T @ D @ P[..., k], Q[:, k : k + 1])),
        )
        for found, expected in pairs:
            size = max(np.abs(expected).max(), 1.0)
            assert distance(found / size, expected / size) < 1e-12


class TestNullSpace:
    def test_scales_and_changes_of_basis_span_the_null_space(self, small: tuple) -> None:
        _, state, system = small
        n, m = len(state.P), len(state.Q)
        p, q = null_space.scales(state.P, state.Q)
        scales = many_views.block_diagonal((p[:, :, None], q[:, :, None]))
        G = np.hstack([scales, null_space.generators(kernels.table(), state.P, state.Q)])
        N = many_views.dense(system)
        values = np.linalg.eigvalsh(N)
        assert distance(G.T @ G, np.eye(15 + n + m)) < 1e-12
        assert np.abs(N @ G).max() < 1e-12 * values[-1]
        # The dense spectrum has a gap exactly there.
        assert values[14 + n + m] < 1e-13 * values[-1]
        assert values[15 + n + m] > 1e-9 * values[-1]

    def test_projected_out_is_the_orthogonal_projection(self, small: tuple) -> None:
        _, state, system = small
        table = kernels.table()
        step = np.random.default_rng(8).standard_normal(system.gradient.size)
        found = null_space.project_out(table, state.P, state.Q, step)
        values, vectors = np.linalg.eigh(many_views.dense(system))
        G = vectors[:, : 15 + len(state.P) + len(state.Q)]
        assert values[G.shape[1]] > 0.0
        assert distance(found, step - G @ (G.T @ step)) < 1e-6  # G by rounding of N
        again = null_space.project_out(table, state.P, state.Q, found)
        assert distance(again, found) < 1e-12

    def test_minimum_norm_step_is_the_pseudo_inverse(self, small: tuple) -> None:
        _, state, system = small
        N = many_views.dense(system)
        values, vectors = np.linalg.eigh(N)
        rank = len(values) - 15 - len(state.P) - len(state.Q)
        kept = vectors[:, -rank:]
        expected = -kept @ ((kept.T @ system.gradient) / values[-rank:])
        found = null_space.minimum_norm_step(kernels.table(), system, state.P, state.Q)
        size = np.abs(expected).max()
        # The reference loses the condition of N, about 1e9 here, from its rounding.
        assert distance(found / size, expected / size) < 1e-6
        assert np.abs(N @ found + system.gradient).max() < 1e-9 * np.abs(system.gradient).max()
        G = vectors[:, :-rank]
        assert np.linalg.norm(G.T @ found) < 1e-6 * np.linalg.norm(found)

    @pytest.mark.parametrize("size", [1e-4, 1e4])
    def test_minimum_norm_step_bears_any_scales(self, small: tuple, size: float) -> None:
        problem, state, _ = small
        state = problem.evaluate((state.P, size * state.Q))
        system = problem.linearize(state)
        found = null_space.minimum_norm_step(problem.kernels, system, state.P, state.Q)
        residual = system.product(found) + system.gradient
        for part, whole in zip(system.split(residual), system.split(system.gradient), strict=True):
            assert np.abs(part).max() < 1e-7 * np.abs(whole).max()
