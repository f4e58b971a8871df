"""The two problems' derivatives against central differences through their own retraction.

The states are in general position and at the hard places: sigma near 0 and 1, epipoles at
infinity, amid the points, and every choice of signs of the factors of one F.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.kernels import Table, table
from epigauge.scenes import two_view_scene
from epigauge.two_view.criteria import CRITERIA, Reprojection
from epigauge.two_view.eliminated import EliminatedProblem
from epigauge.two_view.joint import JointProblem, intersect
from epigauge.two_view.losses import LOSSES, Loss
from epigauge.two_view.parameterizations import (
    PARAMETERIZATIONS,
    MapsF,
    Ortho,
    OrthonormalF,
    factorize,
)
from laws import central_differences, distance
from two_views import Array, algebraic, cross, project, up_to_sign

M = 12

FRONT = [0.3, 0.1, 1.0]
FLAT = [0.6, 0.8, 0.0]

#: sigma, left epipole, right epipole: general, then the hard places.
PLACES = {
    "general": (0.6, [2.0, -1.0, 0.4], [-1.5, 0.7, 0.3]),
    "sigma near 1": (1.0 - 1e-9, [2.0, -1.0, 0.4], [-1.5, 0.7, 0.3]),
    "sigma 1": (1.0, [2.0, -1.0, 0.4], [-1.5, 0.7, 0.3]),
    "sigma above 1": (1.2, [2.0, -1.0, 0.4], [-1.5, 0.7, 0.3]),
    "sigma near 0": (1e-9, [2.0, -1.0, 0.4], [-1.5, 0.7, 0.3]),
    "sigma below 0": (-0.2, [2.0, -1.0, 0.4], [-1.5, 0.7, 0.3]),
    "epipoles at infinity": (0.5, FLAT, [0.0, 1.0, 0.0]),
    "rectified": (1.0, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
    "one epipole at infinity": (0.8, [2.0, -1.0, 0.4], FLAT),
    "epipoles amid the points": (0.7, FRONT, [-0.2, 0.2, 1.0]),
}

#: Each criterion, parameterisation and loss once with the others as they are by default.
PARTS = [
    *(("general", {"parameterization": name}) for name in PARAMETERIZATIONS),
    *(("epipoles at infinity", {"parameterization": name}) for name in PARAMETERIZATIONS),
    *(("epipoles amid the points", {"criterion": name}) for name in CRITERIA),
    *(("general", {"loss": name}) for name in LOSSES),
    ("general", {"parameterization": "maps", "criterion": "epipolar", "loss": "cauchy"}),
    ("sigma 1", {"parameterization": "block", "criterion": "sampson", "loss": "soft_l1"}),
]
EVERYWHERE = [*((place, {}) for place in PLACES), *PARTS]
#: Of two residuals a match, J^T J is not that of their length.
ONE_RESIDUAL = [case for case in EVERYWHERE if case[1].get("criterion") != "epipolar"]

#: Matches beside an epipole, and sigma near 0, give large fifth derivatives: a small step.
STEP = 3e-5


def name(case: Any) -> str:
    """Label a place, or a choice of parts."""
    return " ".join(case.values()) if isinstance(case, dict) else str(case)


def second_derivative(f: Callable[[float], float], step: float) -> float:
    """Second derivative of f at zero by central differences of fourth order."""
    near, far = f(step) + f(-step), f(2 * step) + f(-2 * step)
    return (16 * near - far - 30 * f(0.0)) / (12 * step**2)


def orthonormal(last: list[float], rng: np.random.Generator) -> Array:
    """An orthonormal matrix with given direction of the last column, of either handedness."""
    Q = np.linalg.qr(np.column_stack([last, rng.standard_normal((3, 2))]))[0]
    return Q[:, [1, 2, 0]]


def scene(place: str, noise: float = 0.05, seed: int = 0) -> tuple[OrthonormalF, Array, ...]:
    """Factors, matches (2, m) near the epipolar geometry, and weights that differ."""
    rng = np.random.default_rng(seed)
    sigma, left, right = PLACES[place]
    factors = OrthonormalF(orthonormal(left, rng), orthonormal(right, rng), np.asarray(sigma))
    F = Ortho(table()).fundamental(factors)
    x1, x2 = rng.uniform(-2, 2, (2, M, 2))
    _, x1, x2 = eg.reprojection_distances(F, x1, x2)
    x1, x2 = x1 + noise * rng.standard_normal((M, 2)), x2 + noise * rng.standard_normal((M, 2))
    weights = rng.uniform(0.5, 2.0, M)
    return factors, np.ascontiguousarray(x1.T), np.ascontiguousarray(x2.T), weights


def estimate_in(chart: Any, factors: OrthonormalF) -> Any:
    """The factors themselves, which a start value would bring to 0 <= sigma <= 1."""
    if isinstance(chart, Ortho):
        return factors
    return chart.start(Ortho(table()).fundamental(factors))


@pytest.fixture
def kernels() -> Table:
    return table()


@pytest.fixture
def ortho(kernels) -> Ortho:
    return Ortho(kernels)


class TestEliminated:
    @staticmethod
    def problem(kernels: Table, place: str, parts: dict[str, str], *, exact: bool, noise=0.05):
        factors, q1, q2, w = scene(place, noise)
        chart = PARAMETERIZATIONS[parts.get("parameterization", "ortho")](kernels)
        criterion = CRITERIA[parts.get("criterion", "reprojection")](kernels, q1, q2)
        # Some matches are within the scale of the loss and some beyond.
        loss = Loss(parts.get("loss", "linear"), 0.05)
        problem = EliminatedProblem(criterion, chart, w, loss, exact)
        state = problem.evaluate(estimate_in(chart, factors))
        return problem, state, problem.linearize(state)

    @staticmethod
    def cost(problem: EliminatedProblem, state: Any) -> Callable[[Array], float]:
        return lambda delta: problem.evaluate(problem.retract(state, delta)).cost

    @pytest.mark.parametrize(("place", "parts"), EVERYWHERE, ids=name)
    def test_gradient_is_that_of_the_cost_through_retract(self, kernels, place, parts) -> None:
        problem, state, system = self.problem(kernels, place, parts, exact=True)
        expected = central_differences(self.cost(problem, state), np.zeros(7), STEP)
        assert np.abs(expected).max() > 1e-3  # not a minimum, where zero would pass
        # Rounding: costs of order 0.1 are known to 1e-17, over the step.
        assert distance(system.gradient, expected) < 1e-9

    @pytest.mark.parametrize(("place", "parts"), EVERYWHERE, ids=name)
    def test_exact_hessian_is_that_of_the_cost_through_retract(self, kernels, place, parts) -> None:
        problem, state, system = self.problem(kernels, place, parts, exact=True)
        cost = self.cost(problem, state)
        np.testing.assert_allclose(system.hessian, system.hessian.T, rtol=1e-10, atol=1e-12)
        # Along random directions, each of which sees all entries.
        for v in np.random.default_rng(6).standard_normal((8, 7)) / 2:
            expected = second_derivative(lambda t, v=v: cost(t * v), 3e-4)
            # sigma near 0 has the largest derivatives of higher order; the others agree to 1e-9.
            assert distance(v @ system.hessian @ v, expected) < 1e-6

    @pytest.mark.parametrize(("place", "parts"), ONE_RESIDUAL, ids=name)
    def test_gauss_newton_matrix_is_the_jacobians_product(self, kernels, place, parts) -> None:
        problem, state, system = self.problem(kernels, place, parts, exact=False)
        _, first, _ = problem.loss(state.distances.squared)

        def weighted(delta: Array) -> Array:
            distances = problem.evaluate(problem.retract(state, delta)).distances
            return np.sqrt(problem.weights * first) * distances.signed

        J = central_differences(weighted, np.zeros(7), STEP)
        assert distance(system.hessian, J.T @ J) < 1e-9
        np.testing.assert_allclose(system.diagonal, np.diag(system.hessian), rtol=1e-15)

    @pytest.mark.parametrize("place", PLACES)
    def test_scale_of_the_parameters_does_not_depend_on_the_hessian(self, kernels, place) -> None:
        newton = self.problem(kernels, place, {}, exact=True)[2]
        gauss = self.problem(kernels, place, {}, exact=False)[2]
        assert distance(newton.diagonal, gauss.diagonal) < 1e-14
        assert distance(newton.gradient, gauss.gradient) < 1e-14
        assert distance(newton.hessian, gauss.hessian) > 1e-4  # there is a second-order term

    @pytest.mark.parametrize("place", PLACES)
    def test_without_noise_both_hessians_agree(self, kernels, place) -> None:
        newton = self.problem(kernels, place, {}, exact=True, noise=0.0)
        gauss = self.problem(kernels, place, {}, exact=False, noise=0.0)
        assert newton[1].cost < 1e-25  # rounding, squared, of coordinates of order one
        assert distance(newton[2].hessian, gauss[2].hessian) < 1e-9

    def test_cost_is_half_the_weighted_sum_of_squares(self, kernels) -> None:
        state = self.problem(kernels, "general", {}, exact=True)[1]
        _, q1, q2, w = scene("general")
        d = eg.reprojection_distances(state.F, q1.T, q2.T)[0]
        assert state.cost == pytest.approx(0.5 * np.sum(w * d**2), rel=1e-12)

    def test_zero_update_changes_nothing(self, kernels) -> None:
        problem, state, _ = self.problem(kernels, "general", {}, exact=True)
        again = problem.evaluate(problem.retract(state, np.zeros(7)))
        assert again.cost == pytest.approx(state.cost, rel=1e-14)


class TestJoint:
    @staticmethod
    def problem(kernels: Table, place: str, chart_name: str = "ortho", loss: str = "linear"):
        """The joint problem at points off their foot points, so that no residual is special."""
        factors, q1, q2, w = scene(place)
        chart = PARAMETERIZATIONS[chart_name](kernels)
        problem = JointProblem(kernels, chart, q1, q2, w, Loss(loss, 0.05))
        motion = estimate_in(chart, factors)
        F, (P2, _) = chart.fundamental(motion), chart.camera(motion)
        _, x1_hat, x2_hat = eg.reprojection_distances(F, q1.T, q2.T)
        S = intersect(P2, x1_hat.T, x2_hat.T)
        S = S + 0.01 * np.random.default_rng(1).standard_normal(S.shape)
        state = problem.evaluate((motion, S))
        return problem, state, problem.linearize(state)

    @staticmethod
    def matrix(system) -> Array:
        """The normal equations as one matrix."""
        m, p, k = system.W.shape
        N = np.zeros((p + m * k, p + m * k))
        N[:p, :p] = system.U
        for j in range(m):
            own = slice(p + j * k, p + (j + 1) * k)
            N[:p, own], N[own, :p], N[own, own] = system.W[j], system.W[j].T, system.V[j]
        return N

    @pytest.mark.parametrize("place", PLACES)
    def test_jacobian_blocks_are_those_of_the_residuals_through_retract(
        self, kernels, place
    ) -> None:
        problem, state, _ = self.problem(kernels, place)
        _, derivative = problem.parameterization.camera(state.motion)

        def residuals(delta: Array) -> Array:
            return problem.evaluate(problem.retract(state, delta)).r

        # Points near the focal plane have large fifth derivatives: a smaller step.
        J = central_differences(residuals, np.zeros(7 + 3 * M), step=1e-4)
        motion = np.zeros((4, M, 7))
        motion[2:] = np.einsum("ap,iam->imp", derivative, state.J_P2)
        # Rounding 1e-16 / 1e-4, and values up to some tens.
        assert distance(J[:, :, :7], motion) < 1e-8
        points = J[:, :, 7:].reshape(4, M, M, 3)
        for j, other in itertools.product(range(M), range(M)):
            expected = state.J_S[:, :, j] if j == other else np.zeros((4, 3))
            assert distance(points[:, j, other], expected) < 1e-8

    @pytest.mark.parametrize(
        ("place", "chart_name"),
        [*((place, "ortho") for place in PLACES), ("general", "block"), ("general", "maps")],
    )
    def test_normal_equations_are_those_of_the_whole_vector(
        self, kernels, place, chart_name
    ) -> None:
        problem, state, system = self.problem(kernels, place, chart_name)

        def weighted(delta: Array) -> Array:
            r = problem.evaluate(problem.retract(state, delta)).r
            return (np.sqrt(problem.weights) * r).ravel()

        J = central_differences(weighted, np.zeros(7 + 3 * M), step=1e-4)
        r = weighted(np.zeros(7 + 3 * M))
        assert distance(system.gradient, J.T @ r) < 1e-8
        assert distance(self.matrix(system), J.T @ J) < 1e-8

    @pytest.mark.parametrize(
        ("place", "loss"),
        [*((place, "linear") for place in PLACES), *(("general", loss) for loss in LOSSES)],
    )
    def test_gradient_is_that_of_the_cost_through_retract(self, kernels, place, loss) -> None:
        problem, state, system = self.problem(kernels, place, loss=loss)

        def cost(delta: Array) -> float:
            return problem.evaluate(problem.retract(state, delta)).cost

        expected = central_differences(cost, np.zeros(7 + 3 * M), step=1e-4)
        assert distance(system.gradient, expected) < 1e-8

    @pytest.mark.parametrize("chart_name", PARAMETERIZATIONS)
    @pytest.mark.parametrize("place", PLACES)
    def test_starts_at_the_cost_of_the_eliminated_problem(self, kernels, place, chart_name) -> None:
        factors, q1, q2, w = scene(place)
        F = Ortho(kernels).fundamental(factors)
        chart = PARAMETERIZATIONS[chart_name](kernels)
        joint = JointProblem(kernels, chart, q1, q2, w, Loss())
        eliminated = EliminatedProblem(Reprojection(kernels, q1, q2), chart, w, Loss(), True)
        cost = eliminated.evaluate(eliminated.start(F)).cost
        # Points far behind or on the focal plane amplify the rounding of their coordinates.
        assert joint.evaluate(joint.start(F)).cost == pytest.approx(cost, rel=1e-8)

    @pytest.mark.parametrize("place", PLACES)
    def test_eliminated_gradient_is_the_joint_one_at_the_foot_points(
        self, kernels, ortho, place
    ) -> None:
        # The envelope theorem: there the gradient by the points is zero.
        factors, q1, q2, w = scene(place)
        joint = JointProblem(kernels, ortho, q1, q2, w, Loss())
        eliminated = EliminatedProblem(Reprojection(kernels, q1, q2), ortho, w, Loss(), True)
        P2, _ = ortho.camera(factors)
        _, x1_hat, x2_hat = eg.reprojection_distances(ortho.fundamental(factors), q1.T, q2.T)
        system = joint.linearize(joint.evaluate((factors, intersect(P2, x1_hat.T, x2_hat.T))))
        expected = eliminated.linearize(eliminated.evaluate(factors)).gradient
        assert distance(system.gradient, np.append(expected, np.zeros(3 * M))) < 1e-8

    def test_point_on_the_focal_plane_rejects_the_trial(self, kernels) -> None:
        problem, state, _ = self.problem(kernels, "general")
        P2, _ = problem.parameterization.camera(state.motion)
        S = state.S.copy()
        a, b, _ = S[:, 3]
        S[2, 3] = -(P2[2, 0] * a + P2[2, 1] * b + P2[2, 2]) / P2[2, 3]
        # Of the third coordinate rounding is left: the cost is huge or infinite, never NaN.
        assert problem.evaluate((state.motion, S)).cost > 1e20
        S[2, 3] = np.inf
        assert problem.evaluate((state.motion, S)).cost == np.inf


class TestFootPoints:
    @pytest.mark.parametrize("place", PLACES)
    def test_every_sign_of_the_factors_gives_the_same_distances(
        self, kernels, ortho, place
    ) -> None:
        factors, q1, q2, _ = scene(place)
        U, V, sigma = factors
        F = ortho.fundamental(factors)
        d = Reprojection(kernels, q1, q2).evaluate(F).signed
        for s1, s2, s3, s4 in itertools.product((1, -1), repeat=4):
            signed = OrthonormalF(U * [s1, s2, s3], V * [s1, s2, s4], sigma)
            other = ortho.fundamental(signed)
            np.testing.assert_allclose(other, F, rtol=0, atol=1e-16)
            again = Reprojection(kernels, q1, q2).evaluate(other).signed
            np.testing.assert_allclose(again, d, rtol=0, atol=1e-14)

    @pytest.mark.parametrize("factor", [-3.0, 1e6, 1e-6, -1e-12])
    def test_scale_of_F_does_not_matter_but_its_sign_does(self, kernels, ortho, factor) -> None:
        factors, q1, q2, _ = scene("general")
        F = ortho.fundamental(factors)
        d = Reprojection(kernels, q1, q2).evaluate(F).signed
        scaled = Reprojection(kernels, q1, q2).evaluate(factor * F).signed
        np.testing.assert_allclose(scaled, np.sign(factor) * d, rtol=0, atol=1e-14)

    def test_unsettled_matches_are_finished_by_the_safe_iteration(self, kernels, ortho) -> None:
        # Matches anywhere, also beside the epipoles: the quick iteration leaves some unsettled.
        rng = np.random.default_rng(5)
        F = ortho.fundamental(scene("epipoles amid the points")[0])
        q1, q2 = rng.uniform(-2, 2, (2, 2, 2000))
        criterion = Reprojection(kernels, q1, q2)
        feet = criterion.evaluate(F)
        quick = kernels.foot_point(*feet.frame, q1, q2)
        safe = kernels.foot_point_safe(*feet.frame, q1, q2)
        assert np.abs(quick[2] - safe[2]).max() > 1e-3
        np.testing.assert_allclose(feet.signed, safe[2], rtol=1e-9, atol=1e-12)
        hat1, hat2, _ = criterion.corrected(feet)
        assert np.abs(algebraic(F, hat1.T, hat2.T)).max() < 1e-9


class TestCriteria:
    @pytest.mark.parametrize("criterion", CRITERIA)
    @pytest.mark.parametrize("place", PLACES)
    def test_derivative_is_that_of_the_distances(self, kernels, ortho, place, criterion) -> None:
        factors, q1, q2, _ = scene(place)
        F = ortho.fundamental(factors)
        distances = CRITERIA[criterion](kernels, q1, q2)

        def signed(F: Array) -> Array:
            return distances.evaluate(F).signed

        expected = central_differences(signed, F, STEP).reshape(M, 9)
        # Truncation where sigma is near 0: the direction of an epipolar line is hardly known.
        tolerance = 1e-6 if place == "sigma near 0" else 1e-8
        assert distance(distances.derivative(F, distances.evaluate(F)), expected) < tolerance

    @pytest.mark.parametrize("criterion", CRITERIA)
    def test_sign_is_that_of_the_equation_and_the_square_is_the_square(
        self, kernels, ortho, criterion
    ) -> None:
        factors, q1, q2, _ = scene("general")
        F = ortho.fundamental(factors)
        found = CRITERIA[criterion](kernels, q1, q2).evaluate(F)
        np.testing.assert_array_equal(np.sign(found.signed), np.sign(algebraic(F, q1.T, q2.T)))
        np.testing.assert_allclose(found.signed**2, found.squared, rtol=1e-14)


class TestParameterizations:
    @pytest.mark.parametrize("chart_name", PARAMETERIZATIONS)
    @pytest.mark.parametrize("place", PLACES)
    def test_derivatives_are_those_through_retract(self, kernels, place, chart_name) -> None:
        chart = PARAMETERIZATIONS[chart_name](kernels)
        estimate = estimate_in(chart, scene(place)[0])
        first, second = chart.derivatives(estimate)

        def moved(delta: Array) -> Any:
            if isinstance(estimate, MapsF):  # without a change of chart, which changes the scale
                return estimate._replace(parameters=estimate.parameters + delta)
            return chart.retract(estimate, delta)

        def entries(delta: Array) -> Array:
            return chart.fundamental(moved(delta)).ravel()

        assert distance(first, central_differences(entries, np.zeros(7))) < 1e-11
        numeric = central_differences(
            lambda delta: central_differences(entries, delta, 3e-3), np.zeros(7), 3e-3
        )
        # Truncation h^4 ~ 1e-10, rounding 1e-16 / h^2 ~ 1e-11.
        assert distance(second, numeric) < 1e-8

        def camera(delta: Array) -> Array:
            return chart.camera(moved(delta))[0].ravel()

        P2, derivative = chart.camera(estimate)
        np.testing.assert_allclose(camera(np.zeros(7)), P2.ravel(), rtol=0, atol=1e-14)
        # Entries of the maps and of their cameras reach ten: rounding over the step.
        assert distance(derivative, central_differences(camera, np.zeros(7))) < 1e-10

    @pytest.mark.parametrize("chart_name", PARAMETERIZATIONS)
    @pytest.mark.parametrize("place", PLACES)
    def test_camera_realises_the_matrix(self, kernels, place, chart_name) -> None:
        chart = PARAMETERIZATIONS[chart_name](kernels)
        estimate = estimate_in(chart, scene(place)[0])
        P2, _ = chart.camera(estimate)
        assert up_to_sign(cross(P2[:, 3]) @ P2[:, :3], chart.fundamental(estimate)) < 1e-13

    @pytest.mark.parametrize("chart_name", PARAMETERIZATIONS)
    @pytest.mark.parametrize("place", PLACES)
    def test_rank_is_seven_but_for_sigma_zero_and_orthos_sigma_one(
        self, kernels, place, chart_name
    ) -> None:
        chart = PARAMETERIZATIONS[chart_name](kernels)
        factors = scene(place)[0]
        estimate = estimate_in(chart, factors)
        first, _ = chart.derivatives(estimate)
        f = chart.fundamental(estimate).ravel()
        f = f / np.linalg.norm(f)
        # Of F up to scale.
        singular = np.linalg.svd(first - np.outer(f, f @ first), compute_uv=False)
        sigma = float(factors.sigma)
        if abs(sigma) < 1e-8:
            # F loses rank: it does not change when u2 and u3, or v2 and v3, turn.
            assert np.sum(singular > 1e-7) == 5
        elif abs(sigma - 1) < 1e-8 and chart_name == "ortho":
            assert np.sum(singular > 1e-7) == 6
        else:
            assert np.sum(singular > 1e-3) == 7
        if chart_name == "ortho" and sigma == 1.0:
            null = np.array([0, 0, 1, 0, 0, 1, 0])  # B&S section 4.3
            np.testing.assert_allclose(first @ null, 0, rtol=0, atol=1e-15)

    @pytest.mark.parametrize("chart_name", PARAMETERIZATIONS)
    def test_start_reproduces_F_whatever_its_scale_and_sign(self, kernels, chart_name) -> None:
        chart = PARAMETERIZATIONS[chart_name](kernels)
        for seed, factor in itertools.product(range(5), (1.0, -3.0, 1e6)):
            U, values, Vt = np.linalg.svd(np.random.default_rng(seed).standard_normal((3, 3)))
            F = (U[:, :2] * values[:2]) @ Vt[:2]
            assert up_to_sign(chart.fundamental(chart.start(factor * F)), F) < 1e-13

    def test_start_takes_the_nearest_matrix_of_rank_two(self, ortho) -> None:
        U, V = orthonormal([1, 2, 3], np.random.default_rng(0)), np.eye(3)[:, [1, 0, 2]]
        start = factorize(U @ np.diag([5.0, 3.0, 2.0]) @ V.T)
        assert start.sigma == pytest.approx(0.6, rel=1e-14)
        assert up_to_sign(ortho.fundamental(start), U @ np.diag([5.0, 3.0, 0.0]) @ V.T) < 1e-14

    def test_factors_stay_orthonormal_over_many_updates(self, ortho) -> None:
        factors = scene("general")[0]
        rng = np.random.default_rng(3)
        for _ in range(200):
            factors = ortho.retract(factors, 0.5 * rng.standard_normal(7))
        for Q in factors[:2]:
            # Each update adds a rounding or two.
            np.testing.assert_allclose(Q.T @ Q, np.eye(3), rtol=0, atol=200 * 1e-15)


class TestBothStructures:
    @pytest.mark.parametrize("seed", range(3))
    def test_reach_the_same_minimum_of_the_standard_scene(self, seed) -> None:
        view = two_view_scene(10.0, seed=seed)
        # ftol of the joint form is a decrease, which may stay small for long: both to rounding.
        options = {"ftol": 1e-15, "max_iter": 1000}
        eliminated = eg.refine_fundamental(view.x1, view.x2, **options)
        joint = eg.refine_fundamental(view.x1, view.x2, structure="joint", **options)
        # Converged; at this distance the noise hides the parallax of some seeds.
        assert eliminated.status > 0
        assert joint.status > 0
        assert joint.cost == pytest.approx(eliminated.cost, rel=1e-10)
        assert up_to_sign(joint.F, eliminated.F) < 1e-5  # square root of what the cost leaves

    def test_intersect_gives_the_points_that_project_to_corrected_matches(self) -> None:
        view = two_view_scene(5.0, seed=2)
        P1, P2 = eg.canonical_cameras(view.F_true)
        _, x1_hat, x2_hat = eg.reprojection_distances(view.F_true, view.x1, view.x2)
        a, b, c = intersect(P2, x1_hat.T, x2_hat.T)
        Q = np.column_stack([a, b, np.ones_like(a), c])
        np.testing.assert_array_equal(project(P1, Q), x1_hat)
        np.testing.assert_allclose(project(P2, Q), x2_hat, rtol=0, atol=1e-9)
