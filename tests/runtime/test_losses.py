"""Robust losses: their derivatives, the robust problem's, scales, and what outliers do to F."""

from __future__ import annotations

import math

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.two_view.conditioning import condition
from epigauge.two_view.criteria import CRITERIA, Mahalanobis
from epigauge.two_view.eliminated import EliminatedProblem
from epigauge.two_view.losses import EFFICIENT, LOSSES, Loss, median, robust_scale
from epigauge.two_view.parameterizations import Block, Ortho
from laws import assert_jacobian, central_differences, distance
from two_views import same_geometry

#: Squares on both sides of the scale, none on it, where the second derivative may jump.
SQUARES = np.array([0.0, 0.01, 0.3, 0.9, 1.2, 3.0, 40.0]) + 0.02


def loss_cases():
    """Return every loss, at two scales."""
    return [Loss(name, scale) for name in LOSSES for scale in (1.0, 0.7)]


@pytest.mark.parametrize("loss", loss_cases(), ids=str)
def test_derivatives_are_those_of_the_value(loss):
    _, first, second = loss(SQUARES)
    assert_jacobian(lambda s: loss(s)[0], SQUARES, np.diag(first))
    assert_jacobian(lambda s: loss(s)[1], SQUARES, np.diag(second), tolerance=1e-8)


@pytest.mark.parametrize("name", LOSSES)
def test_small_distances_cost_their_square_whatever_the_scale(name):
    for scale in (0.1, 1.0, 25.0):
        squared = np.array([0.0, 1e-6]) * scale**2
        value, weight, _ = Loss(name, scale)(squared)
        assert value == pytest.approx(squared, rel=1e-6)
        assert weight == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("name", ["huber", "soft_l1", "cauchy"])
def test_losses_are_those_of_scipy(name):
    least_squares = pytest.importorskip("scipy.optimize").least_squares
    residuals = np.array([0.1, -0.8, 2.0, 9.0])
    found = least_squares(lambda x: residuals + 0 * x, [0.0], loss=name, f_scale=0.7, max_nfev=1)
    assert 0.5 * Loss(name, 0.7)(residuals**2)[0].sum() == pytest.approx(found.cost, rel=1e-12)


def efficiency(loss: Loss) -> float:
    """Asymptotic efficiency for a mean of normal data: E[psi']^2 / E[psi^2], psi = w(x^2) x."""
    x = np.linspace(-12.0, 12.0, 240_001)
    density = np.exp(-(x**2) / 2.0) / math.sqrt(2.0 * math.pi) * (x[1] - x[0])
    psi = loss(x**2)[1] * x
    # E[psi'] = E[psi x] for normal x (Stein), which holds at the jumps of `truncated` too.
    return float(np.sum(density * psi * x) ** 2 / np.sum(density * psi**2))


@pytest.mark.parametrize("name", EFFICIENT)
def test_estimated_scales_keep_95_per_cent_efficiency(name):
    # The truncated loss, at three standard deviations, has 97 %.
    expected = {"truncated": 0.971}.get(name, 0.95)
    assert efficiency(Loss(name, EFFICIENT[name])) == pytest.approx(expected, abs=1e-3)


def robust_problem(criterion: str, name: str, chart):
    """Return a problem with outliers, its state near the minimum, in conditioned coordinates."""
    scene = eg.two_view_scene(n_points=20, distance=4.0, noise_px=2.0, seed=0)
    x1, x2 = scene.x1, scene.x2.copy()
    x2[:4] += [[30.0, 25.0], [-40.0, 30.0], [5.0, -60.0], [80.0, 70.0]]
    frame = condition(x1, x2)
    F = frame.from_pixels(scene.F_true)
    table = kernels.table("numpy")
    distances = CRITERIA[criterion](table, *frame.forward(x1, x2))
    # Between right and wrong: no match is near the scale, where second derivatives may jump.
    right, wrong = np.sort(np.abs(distances.evaluate(F).signed))[15:17]
    assert right < 0.5 * wrong
    scale = float(np.sqrt(right * wrong))
    weights = np.random.default_rng(0).uniform(0.5, 2.0, 20)
    problem = EliminatedProblem(distances, chart(table), weights, Loss(name, scale), True)
    return problem, problem.evaluate(problem.start(F))


@pytest.mark.parametrize("chart", [Ortho, Block])
@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("criterion", CRITERIA)
def test_gradient_and_exact_hessian_are_those_of_the_robust_cost(criterion, name, chart):
    problem, state = robust_problem(criterion, name, chart)
    system = problem.linearize(state)

    def cost(step):
        return problem.evaluate(problem.retract(state, step)).cost

    expected = central_differences(cost, np.zeros(7), 1e-4)
    assert np.abs(expected).max() > 1e-2  # not a minimum, where zero would pass
    assert distance(system.gradient, expected) < 1e-9

    # Second differences of fourth order along e_i and e_i + e_j: rounding is 1e-16 / h^2.
    h, axes, centre = 3e-4, np.eye(7), cost(np.zeros(7))

    def along(direction):
        near = cost(h * direction) + cost(-h * direction)
        far = cost(2 * h * direction) + cost(-2 * h * direction)
        return (16 * near - far - 30 * centre) / (12 * h**2)

    H = np.diag([along(axis) for axis in axes])
    for i in range(7):
        for j in range(i):
            H[i, j] = H[j, i] = (along(axes[i] + axes[j]) - H[i, i] - H[j, j]) / 2
    assert distance(system.hessian, H) < 1e-7


@pytest.mark.parametrize("loss", ["linear", "huber", "soft_l1", "cauchy"])
def test_minimum_is_that_of_scipy(loss):
    least_squares = pytest.importorskip("scipy.optimize").least_squares
    scene = eg.two_view_scene(n_points=40, distance=4.0, seed=2)
    x1, x2 = scene.x1, scene.x2.copy()
    x2[:6] += np.random.default_rng(0).uniform(-30.0, 30.0, (6, 2))
    scale_px = 2.0
    ours = eg.refine_fundamental(x1, x2, scene.F_true, loss=loss, loss_scale_px=scale_px)

    table = kernels.table("numpy")
    chart = Ortho(table)
    frame = condition(x1, x2)
    origin = chart.start(frame.from_pixels(ours.F))

    def residuals(step):
        F = frame.to_pixels(chart.fundamental(chart.retract(origin, step)))
        return eg.reprojection_distances(F, x1, x2)[0]

    away = 1e-3 * np.random.default_rng(1).standard_normal(7)
    theirs = least_squares(
        residuals,
        away,
        loss=loss,
        f_scale=scale_px,
        xtol=1e-12,
        ftol=1e-14,
        gtol=1e-12,
        jac="3-point",
    )
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-9)
    assert np.abs(theirs.x).max() < 1e-4  # it comes back to our minimum


@pytest.mark.parametrize("loss", EFFICIENT)
def test_automatic_scale_is_near_the_truth_with_a_fifth_of_outliers(loss):
    noise_px, found = 0.8, []
    for seed in range(5):
        scene = eg.two_view_scene(n_points=300, distance=4.0, noise_px=noise_px, seed=seed)
        x2 = scene.x2.copy()
        x2[:60] += np.random.default_rng(seed).uniform(-40.0, 40.0, (60, 2))
        result = eg.refine_fundamental(scene.x1, x2, scene.F_true, loss=loss)
        found.append(result.loss_scale_px / (EFFICIENT[loss] * noise_px))
    # The median distance of 80 % right matches is their 62 % quantile: 0.88 / 0.67 of sigma.
    assert 0.95 < np.mean(found) < 1.4


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
@pytest.mark.parametrize("special", [None, np.inf, -np.inf, np.nan])
def test_median_is_that_of_numpy(count, special):
    values = np.random.default_rng(count).standard_normal(count)
    if special is not None:
        values[::3] = special
    with np.errstate(invalid="ignore"):
        np.testing.assert_equal(median(values), np.median(values))


def test_robust_scale_of_normal_distances_is_their_standard_deviation():
    d = 3.0 * np.random.default_rng(0).standard_normal(20_000)
    assert robust_scale(d) == pytest.approx(3.0, rel=0.02)  # 1.2 / sqrt(m), twice
    d[:6000] = 1e6
    assert robust_scale(d) < 6.0


@pytest.mark.parametrize("count", [16, 24])
def test_robust_scale_of_what_seven_parameters_leave_is_that_of_the_noise(count):
    # Least squares of seven parameters: the residuals are smaller than the noise.
    rng = np.random.default_rng(3)
    found = []
    for _ in range(2000):
        A, noise = rng.standard_normal((count, 7)), rng.standard_normal(count)
        found.append(robust_scale(noise - A @ np.linalg.lstsq(A, noise, rcond=None)[0]))
    # The factor 1 + 5 / (m - 7) is Rousseeuw's and approximate.
    assert np.mean(found) == pytest.approx(1.0, abs=0.25)
    assert robust_scale(np.ones(count)) == pytest.approx(1.4826 * (1.0 + 5.0 / (count - 7)))


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy", "truncated"])
def test_gross_error_changes_a_robust_estimate_little(loss):
    scene = eg.two_view_scene(n_points=60, distance=4.0, noise_px=0.5, seed=4)
    x2 = scene.x2.copy()
    x2[0] += [0.0, 60.0]

    def moved(**options):
        clean = eg.refine_fundamental(scene.x1[1:], scene.x2[1:], **options).F
        spoilt = eg.refine_fundamental(scene.x1, x2, clean, **options).F
        return same_geometry(clean, spoilt, scene.x1, scene.x2)

    robust = moved(loss=loss)
    assert robust < 0.2 * moved()
    # The influence of one match is bounded; that of a gross error is zero at last.
    assert robust < {"cauchy": 2e-3, "truncated": 1e-5}.get(loss, 2e-2)


# ---------------------------------------------------------------- covariances of the points


def covariances(seed: int, m: int) -> np.ndarray:
    """Random symmetric positive definite matrices."""
    A = np.random.default_rng(seed).standard_normal((m, 2, 2))
    return A @ np.swapaxes(A, 1, 2) + 0.3 * np.eye(2)


def test_isotropic_covariances_are_weights():
    scene = eg.two_view_scene(n_points=30, distance=4.0, seed=1)
    sigma = np.random.default_rng(0).uniform(0.5, 2.0, 30)
    isotropic = sigma[:, None, None] ** 2 * np.eye(2)
    options = {"ftol": 1e-15, "hessian": "gauss-newton"}
    weighted = eg.refine_fundamental(scene.x1, scene.x2, weights=1.0 / sigma**2, **options)
    whitened = eg.refine_fundamental(
        scene.x1, scene.x2, covariance1=isotropic, covariance2=isotropic, **options
    )
    # The same course, step by step, and not only the same end.
    for a, b in zip(weighted.history[:5], whitened.history[:5], strict=True):
        assert b.cost == pytest.approx(a.cost, rel=1e-11)
        assert b.step_norm == pytest.approx(a.step_norm, rel=1e-9)
    assert whitened.cost == pytest.approx(weighted.cost, rel=1e-12)
    assert same_geometry(whitened.F, weighted.F, scene.x1, scene.x2) < 1e-6
    np.testing.assert_allclose(whitened.fun, weighted.fun / sigma, atol=1e-6)
    assert whitened.rms_px == pytest.approx(weighted.rms_px, rel=1e-7)
    assert distance(whitened.covariance, weighted.covariance) < 1e-7


def test_one_covariance_for_all_scales_the_cost_and_leaves_f():
    scene = eg.two_view_scene(n_points=20, distance=4.0, seed=2)
    plain = eg.refine_fundamental(scene.x1, scene.x2)
    scaled = eg.refine_fundamental(
        scene.x1, scene.x2, covariance1=4.0 * np.eye(2), covariance2=4.0 * np.eye(2), noise_px=None
    )
    assert scaled.cost == pytest.approx(plain.cost / 4.0, rel=1e-8)
    assert same_geometry(scaled.F, plain.F, scene.x1, scene.x2) < 1e-4
    # Unit weight: noise of sqrt 2 px against the 2 px that the covariances say.
    assert scaled.noise_px == pytest.approx(math.sqrt(2.0 * plain.cost / 13.0) / 2.0, rel=1e-4)


def test_mahalanobis_distance_is_the_least_over_the_structure():
    optimize = pytest.importorskip("scipy.optimize")
    rng = np.random.default_rng(5)
    scene = eg.two_view_scene(n_points=8, distance=4.0, noise_px=3.0, seed=5)
    frame = condition(scene.x1, scene.x2)
    F = frame.from_pixels(scene.F_true)
    q1, q2 = frame.forward(scene.x1, scene.x2)
    q2 = q2 + 0.3 * rng.standard_normal(q2.shape)
    S1, S2 = covariances(6, 8), covariances(7, 8)
    for backend in ("numpy", *(["c"] if kernels.available()["c"] is None else [])):
        criterion = Mahalanobis(kernels.table(backend), q1, q2, S1, S2)
        feet = criterion.evaluate(F)
        q1_hat, q2_hat, derivative = criterion.corrected(feet)
        for i in range(8):
            z = np.concatenate([q1[:, i], q2[:, i]])
            precision = np.zeros((4, 4))
            precision[:2, :2], precision[2:, 2:] = np.linalg.inv(S1[i]), np.linalg.inv(S2[i])

            def constraint(p):
                return np.append(p[2:], 1.0) @ F @ np.append(p[:2], 1.0)

            best = min(
                (
                    optimize.minimize(
                        lambda p, z=z, W=precision: (p - z) @ W @ (p - z),
                        z + 0.1 * rng.standard_normal(4),
                        constraints={"type": "eq", "fun": constraint},
                        method="SLSQP",
                        options={"ftol": 1e-14, "maxiter": 500},
                    )
                    for _ in range(3)
                ),
                key=lambda found: found.fun,
            )
            assert feet.squared[i] == pytest.approx(best.fun, rel=1e-6)
            hat = np.concatenate([q1_hat[:, i], q2_hat[:, i]])
            assert abs(constraint(hat)) < 1e-14
            assert (hat - z) @ precision @ (hat - z) == pytest.approx(feet.squared[i], rel=1e-12)
        assert_jacobian(
            lambda G, c=criterion: c.evaluate(G).signed, F, derivative.T.reshape(8, 3, 3), step=1e-4
        )


def test_minimum_with_covariances_has_no_gradient_and_is_that_of_all_back_ends():
    scene = eg.two_view_scene(n_points=30, distance=4.0, seed=1)
    options = {"covariance1": covariances(1, 30), "covariance2": covariances(2, 30), "ftol": 1e-14}
    results = [
        eg.refine_fundamental(scene.x1, scene.x2, backend=name, **options)
        for name, reason in kernels.available().items()
        if reason is None
    ]
    for result in results:
        assert result.success
        assert result.optimality < 1e-5 * result.cost
        assert result.cost == pytest.approx(results[0].cost, rel=1e-9)
    # The noise is sqrt 2 px and the covariances are about 2.3 px^2.
    assert 0.3 < np.sqrt(2.0 * results[0].cost / 23.0) < 3.0


def test_covariances_lower_the_error_of_unequal_noise():
    errors = []
    for seed in range(20):
        scene = eg.two_view_scene(n_points=40, distance=4.0, noise_px=0.0, seed=seed)
        S1, S2 = covariances(seed, 40) ** 2, covariances(seed + 100, 40) ** 2
        S1, S2 = (S + 0.01 * np.eye(2) for S in (S1, S2))
        rng = np.random.default_rng(seed)
        x1, x2 = (
            x + np.einsum("mij,mj->mi", np.linalg.cholesky(S), rng.standard_normal((40, 2)))
            for x, S in ((scene.x1, S1), (scene.x2, S2))
        )
        estimates = (
            eg.refine_fundamental(x1, x2),
            eg.refine_fundamental(x1, x2, covariance1=S1, covariance2=S2),
        )
        errors.append(
            [
                np.sqrt(np.mean(eg.reprojection_distances(r.F, scene.x1, scene.x2)[0] ** 2))
                for r in estimates
            ]
        )
    plain, whitened = np.median(errors, axis=0)
    assert whitened < 0.8 * plain


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.eye(3), "has shape"),
        (np.zeros((9, 2, 2)), "has shape"),
        ([[1.0, 0.5], [0.0, 1.0]], "row 0.*positive definite"),
        ([[1.0, 2.0], [2.0, 1.0]], "row 0.*positive definite"),
        ([[0.0, 0.0], [0.0, 1.0]], "row 0.*positive definite"),
        ([[np.nan, 0.0], [0.0, 1.0]], "row 0.*positive definite"),
    ],
)
@pytest.mark.parametrize("name", ["covariance1", "covariance2"])
def test_bad_covariances_are_refused(name, value, message):
    scene = eg.two_view_scene(n_points=10, distance=4.0)
    with pytest.raises(eg.ArgumentError, match=f"{name}.*{message}"):
        eg.refine_fundamental(scene.x1, scene.x2, **{name: value})


@pytest.mark.parametrize(
    "options", [{"criterion": "sampson"}, {"structure": "joint"}, {"parameterization": "free"}]
)
def test_covariances_where_they_are_not_defined_are_refused(options):
    scene = eg.two_view_scene(n_points=10, distance=4.0)
    with pytest.raises(eg.ArgumentError, match="covariance"):
        eg.refine_fundamental(scene.x1, scene.x2, covariance1=np.eye(2), **options)
