"""Normal equations of cameras and points: blocks, solutions, null space, against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.bundle import null_space, numpy_linearizer
from epigauge.bundle.reduced import conjugate_gradients
from epigauge.bundle.solve import Blocks, Border, BundleSystem, Step
from epigauge.bundle.ties import Ties
from epigauge.two_view.losses import Loss
from laws import central_differences, distance

SEEDS = [0, 1]
Array = many_views.Array


@pytest.fixture(params=SEEDS)
def small(request: pytest.FixtureRequest) -> tuple:
    return many_views.small_system(seed=request.param)


def blocks_for(system: BundleSystem, seed: int = 0) -> Blocks:
    """Return random positive definite blocks for a damping."""
    rng = np.random.default_rng(seed)
    blocks = []
    for like, basis in ((system.U, system.ties.A), (system.V, system.ties.C)):
        root = rng.standard_normal(like.shape)
        size = np.einsum("nii->n", like)[:, None, None] / like.shape[1]
        found = 0.1 * size * (root @ root.swapaxes(1, 2) + np.eye(like.shape[1]))
        if basis is not None:  # no damping couples what is frozen with what is not
            free = basis.any(axis=1)
            found = np.where(free[:, :, None] & free[:, None, :], found, np.eye(like.shape[1]))
        blocks.append(found)
    shared = rng.uniform(0.5, 2.0, system.ties.n_shared)
    return Blocks(blocks[0], shared * np.diagonal(system.U_shared), blocks[1])


def whole(blocks: Blocks) -> Array:
    """Return the blocks of a damping as one matrix."""
    cameras, points = (
        many_views.block_diagonal((part, np.zeros((0, *part.shape[1:]))))
        for part in (blocks.cameras, blocks.points)
    )
    sizes = len(cameras), len(blocks.shared), len(points)
    result = np.zeros((sum(sizes), sum(sizes)))
    begin = 0
    for part in (cameras, np.diag(blocks.shared), points):
        rows = slice(begin, begin + len(part))
        result[rows, rows] = part
        begin += len(part)
    return result


def assert_solves(system: BundleSystem, step: Step, blocks: Blocks, lam: float) -> None:
    """Check a step, and what it promises, against a dense solution in the unknowns."""
    N, g = many_views.dense(system), system.gradient
    unknowns = np.linalg.solve(N + lam * whole(blocks), -g)
    expected = many_views.whole_ties(system) @ unknowns
    size = np.abs(expected).max()
    assert distance(np.asarray(step) / size, expected / size) < 1e-8
    assert step.promised == pytest.approx(-(g @ unknowns + 0.5 * unknowns @ N @ unknowns), rel=1e-8)


@pytest.mark.parametrize("backend", kernels.NAMES)
def test_blocks_and_gradient_equal_a_dense_jacobian_by_differences(backend: str) -> None:
    many_views.need_backend(backend)
    problem, state, _ = many_views.small_system(3, 12)
    problem.kernels = kernels.table(backend)
    problem.weights = np.random.default_rng(0).uniform(0.5, 2.0, problem.q.shape[1])
    state = problem.evaluate((state.P, state.Q))
    system = problem.linearize(state)

    def residuals(step: np.ndarray) -> np.ndarray:
        moved = problem.evaluate(problem.retract(state, step))
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


@pytest.mark.parametrize("lam", [1e-3, 1.0])
def test_damped_step_equals_a_dense_one(small: tuple, lam: float) -> None:
    system = small[2]
    blocks = blocks_for(system)
    assert_solves(system, system.damped_step(blocks, lam), blocks, lam)


def tied(system: BundleSystem, seed: int) -> BundleSystem:
    """Return the system in fewer unknowns, some shared by views, some frozen."""
    rng = np.random.default_rng(seed)
    n, m = len(system.cameras), len(system.points)
    A, C = rng.standard_normal((n, 12, 9)), rng.standard_normal((m, 4, 3))
    A[0][:, [2, 5]] = 0.0
    C[0][:, 1], C[1] = 0.0, 0.0
    E = rng.standard_normal((n, 12, 2))
    E[1, :, 0] = 0.0  # view 1 has one shared unknown only
    index = np.array([[0, 2], [0, 3], [1, 3], [1, 2]])
    return replace(system, ties=Ties(A, E, index, 4, C))


def test_ties_share_and_freeze_unknowns(small: tuple) -> None:
    system = tied(small[2], 6)
    blocks = blocks_for(system)
    step = system.damped_step(blocks, 0.1)
    assert_solves(system, step, blocks, 0.1)
    assert (step.points[1] == 0.0).all()
    B = many_views.whole_ties(system)
    own = np.concatenate([system.normal.g_cameras.ravel(), system.normal.g_points.ravel()])
    assert distance(system.gradient, B.T @ own) < 1e-12


@pytest.mark.parametrize("ties", [False, True])
def test_constraints_are_solved_by_woodbury(small: tuple, ties: bool) -> None:
    system = tied(small[2], 6) if ties else small[2]
    rng = np.random.default_rng(3)
    shapes = system.normal.g_cameras.shape, system.normal.g_points.shape
    border = Border(*(rng.standard_normal((*shape, 5)) for shape in shapes))
    constrained = replace(system, constraints=border)
    blocks = blocks_for(system)
    assert_solves(constrained, constrained.damped_step(blocks, 0.1), blocks, 0.1)


@pytest.mark.parametrize("n_constraints", [0, 5])  # each has a right-hand side of its own
@pytest.mark.parametrize("ties", [False, True])
def test_conjugate_gradients_give_the_same_step(
    small: tuple, ties: bool, n_constraints: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, state, _ = small
    problem.kernels = kernels.table("numpy")
    system = problem.linearize(state)
    system = tied(system, 6) if ties else system
    if n_constraints:
        rng = np.random.default_rng(3)
        shapes = system.normal.g_cameras.shape, system.normal.g_points.shape
        border = (rng.standard_normal((*shape, n_constraints)) for shape in shapes)
        system = replace(system, constraints=Border(*border))
    blocks = blocks_for(system)
    expected = np.asarray(system.damped_step(blocks, 0.1))
    monkeypatch.setattr(numpy_linearizer, "DENSE_CAMERAS", 0)
    coupling = type(system.normal.coupling)
    monkeypatch.setattr(coupling, "schur", lambda *_: pytest.fail("dense"))
    found = np.asarray(system.damped_step(blocks, 0.1))
    # The tolerance of the iteration is 1e-10 in the norm of the preconditioned system.
    assert distance(found, expected) < 1e-7 * np.abs(expected).max()


@pytest.mark.parametrize("entry", [2.0, np.nan])
def test_conjugate_gradients_tell_of_a_system_that_is_not_definite(entry: float) -> None:
    S = np.array([[1.0, entry], [entry, 1.0]])
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        conjugate_gradients(lambda x: S @ x, lambda x: x, np.array([1.0, -1.0]))


def test_an_indefinite_system_is_told(small: tuple) -> None:
    system = small[2]
    blocks = blocks_for(system)
    for wrong in (
        blocks._replace(cameras=-blocks.cameras),
        blocks._replace(points=-10.0 * blocks.points),
        blocks._replace(cameras=np.nan * blocks.cameras),
    ):
        with pytest.raises(np.linalg.LinAlgError):
            system.damped_step(wrong, 1.0)


def test_prediction_is_the_decrease_of_the_cost_to_second_order(small: tuple) -> None:
    problem, state, system = small
    direction = system.damped_step(blocks_for(system), 1.0)
    errors = []
    for size in (1e-3, 1e-4):
        step = direction.shortened(system, size)
        actual = state.cost - problem.evaluate(problem.retract(state, step)).cost
        errors.append(abs(actual - step.promised))
    # Gauss-Newton leaves out r d2r: second order, with small residuals in front.
    assert errors[1] < errors[0] / 50.0


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
    def generators(self, state: many_views.State) -> Array:
        system = state.problem.linearize(state)
        estimate = system.cameras, system.points
        parts = null_space.generators(system.model, kernels.table(), *estimate)
        p, q = null_space.scales(*estimate)
        scales = many_views.block_diagonal((p[:, :, None], q[:, :, None]))
        return np.hstack([scales, *[np.concatenate([part.reshape(-1, 15) for part in parts])]])

    def test_scales_and_changes_of_basis_span_the_null_space(self, small: tuple) -> None:
        _, state, system = small
        n, m = len(state.P), len(state.Q)
        G = self.generators(state)
        N = many_views.dense(system)
        values = np.linalg.eigvalsh(N)
        assert np.linalg.matrix_rank(G) == 15 + n + m
        assert np.abs(N @ G).max() < 1e-12 * values[-1] * np.abs(G).max()
        # The dense spectrum has a gap exactly there.
        assert values[14 + n + m] < 1e-13 * values[-1]
        assert values[15 + n + m] > 1e-9 * values[-1]

    def test_minimum_norm_step_is_the_pseudo_inverse(self, small: tuple) -> None:
        _, state, system = small
        N = many_views.dense(system)
        values, vectors = np.linalg.eigh(N)
        rank = len(values) - 15 - len(state.P) - len(state.Q)
        kept = vectors[:, -rank:]
        expected = -kept @ ((kept.T @ system.gradient) / values[-rank:])
        found = np.asarray(null_space.minimum_norm_step(system, kernels.table()))
        size = np.abs(expected).max()
        # The reference loses the condition of N, about 1e9 here, from its rounding.
        assert distance(found / size, expected / size) < 1e-6
        assert np.abs(N @ found + system.gradient).max() < 1e-9 * np.abs(system.gradient).max()
        G = np.linalg.qr(self.generators(state))[0]
        assert np.linalg.norm(G.T @ found) < 1e-9 * np.linalg.norm(found)

    @pytest.mark.parametrize("size", [1e-4, 1e4])
    def test_minimum_norm_step_bears_any_scales(self, small: tuple, size: float) -> None:
        problem, state, _ = small
        system = problem.linearize(problem.evaluate((state.P, size * state.Q)))
        found = null_space.minimum_norm_step(system, kernels.table())
        gradient = system.normal.g_cameras, system.normal.g_points
        product = system.product(found.cameras, found.points)
        for part, whole in zip(product, gradient, strict=True):
            assert np.abs(part + whole).max() < 1e-7 * np.abs(whole).max()
