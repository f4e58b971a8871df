"""The compiled loop and the readable one: the same course, evaluation by evaluation."""

from __future__ import annotations

import time

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels, lm
from epigauge.scenes import two_view_scene
from epigauge.two_view import minima, native, refine, solve
from epigauge.two_view.parameterizations import Ortho
from two_views import same_geometry

pytestmark = pytest.mark.skipif(kernels.available()["c"] is not None, reason="needs the C library")


def both(monkeypatch, x1, x2, **options):
    """Return the results of the compiled loop and of the one in Python, on the same kernels."""
    compiled = eg.refine_fundamental(x1, x2, backend="c", callback=None, **options)
    with monkeypatch.context() as patch:
        patch.setattr(solve, "_is_native", lambda *_: False)
        patch.setattr(refine, "_express", lambda *_: None)
        reference = eg.refine_fundamental(x1, x2, backend="c", **options)
    return compiled, reference


def assert_same_course(a, b, tolerance=1e-9):
    """Rows agree until the cost stands still, where rounding decides."""
    assert (a.status, a.nfev, a.njev, a.nit) == (b.status, b.nfev, b.njev, b.nit)
    for row, other in zip(a.history, b.history, strict=True):
        assert (row.iteration, row.accepted) == (other.iteration, other.accepted)
        assert row.cost == pytest.approx(other.cost, rel=tolerance)
        assert row.lam == pytest.approx(other.lam, rel=1e-6)
        assert row.step_norm == pytest.approx(other.step_norm, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_flat_minimum_is_known_by_the_decrease_that_is_left(monkeypatch, seed) -> None:
    """With a Hessian too ill-conditioned for a factor, in eigenvectors."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform(-1.5, 1.5, 60), rng.uniform(-1.0, 1.0, 60), np.ones(60)])
    X[:, 2] = 4.0 + 0.4 * X[:, 0] + 1e-4 * rng.standard_normal(60)  # next to no relief
    x1, x2 = (1000.0 * Y[:, :2] / Y[:, 2:] for Y in (X, X + np.array([0.6, 0.1, 0.1])))
    x1, x2 = (x + 1e-4 * rng.standard_normal(x.shape) for x in (x1, x2))
    compiled, reference = both(monkeypatch, x1, x2)
    assert compiled.condition > 1e4  # of the Jacobian; of the Hessian its square
    assert (compiled.status, compiled.nfev) == (reference.status, reference.nfev)
    assert compiled.status == 4


@pytest.mark.parametrize("parameterization", ["ortho", "block"])
@pytest.mark.parametrize("criterion", ["reprojection", "sampson", "epipolar"])
@pytest.mark.parametrize("damping", ["levenberg", "seber"])
@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
@pytest.mark.parametrize("distance", [6.0, 14.0])
def test_same_course(monkeypatch, parameterization, criterion, damping, hessian, distance):
    scene = two_view_scene(distance, n_points=40, seed=5)
    options = {
        "parameterization": parameterization,
        "criterion": criterion,
        "damping": damping,
        "hessian": hessian,
    }
    assert_same_course(*both(monkeypatch, scene.x1, scene.x2, **options), 1e-6)


RESTRICTED = {
    "epipole 1": {"fix": "epipole1"},
    "epipole 2": {"fix": "epipole2"},
    "transformation": {"fix": "epipolar_transformation"},
    "block, epipole 1": {"fix": "epipole1", "parameterization": "block"},
    "essential": {"essential": True, "K1": np.diag([1000.0, 1000.0, 1.0])},
    "essential, two K": {
        "essential": True,
        "K1": np.array([[1000.0, 0.0, 3.0], [0.0, 1010.0, -2.0], [0.0, 0.0, 1.0]]),
        "K2": np.array([[990.0, 0.0, -4.0], [0.0, 1000.0, 1.0], [0.0, 0.0, 1.0]]),
    },
}


@pytest.mark.parametrize("restriction", RESTRICTED)
@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
@pytest.mark.parametrize("distance", [6.0, 12.0])
def test_same_course_where_directions_are_left_out_or_mapped(
    monkeypatch, restriction, hessian, distance
):
    scene = two_view_scene(distance, n_points=40, seed=6)
    options = RESTRICTED[restriction] | {"hessian": hessian, "max_iter": 12}
    # The course of one start: what is cut off after twelve steps leads to no second one
    monkeypatch.setattr(minima, "_reversed", lambda *_: None)
    compiled, reference = both(monkeypatch, scene.x1, scene.x2, **options)
    assert compiled.nfev >= 3
    for row, other in zip(compiled.history, reference.history, strict=False):
        assert row.cost == pytest.approx(other.cost, rel=1e-5)
        assert row.step_norm == pytest.approx(other.step_norm, rel=1e-2, abs=1e-6)


def test_second_derivatives_of_a_restricted_chart_end_it_quadratically(monkeypatch):
    # Without them the steps are others than those of the readable loop, which has them: exact and
    # Gauss-Newton courses differ where residuals do not vanish.
    scene = two_view_scene(8.0, n_points=40, noise_px=4.0, seed=2)
    options = {"fix": "epipole1", "max_iter": 30, "ftol": 1e-14}
    exact, _ = both(monkeypatch, scene.x1, scene.x2, hessian="exact", **options)
    gauss, _ = both(monkeypatch, scene.x1, scene.x2, hessian="gauss-newton", **options)
    assert exact.cost == pytest.approx(gauss.cost, rel=1e-8)
    assert exact.nfev < gauss.nfev


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"gtol": 0.5, "ftol": 0.0, "xtol": 0.0}, 1),
        ({"gtol": 0.0, "ftol": 0.0, "xtol": 0.05}, 3),
        ({"gtol": 0.0, "ftol": 1e-3, "xtol": 0.0}, 4),
        ({"gtol": 0.0, "ftol": 0.0, "xtol": 0.0, "max_iter": 2}, 0),
    ],
)
@pytest.mark.parametrize("fix", [(), "epipole1"])
def test_ends_for_the_reason_it_gives(monkeypatch, options, status, fix):
    scene = two_view_scene(6.0, n_points=40, seed=5)
    for result in both(monkeypatch, scene.x1, scene.x2, fix=fix, **options):
        assert result.status == status
        assert result.success == (status > 0)
        assert result.message.startswith(lm.STATUS[status])


def test_status_of_a_start_whose_cost_is_not_finite():
    rng = np.random.default_rng(0)
    q1, q2 = 1e200 * rng.standard_normal((2, 2, 20))
    chart = Ortho(kernels.table("c"))
    start = chart.start(rng.standard_normal((3, 3)))
    choices = ("reprojection", "linear", "levenberg", True)
    matches = (q1, q2, np.ones(20))
    with np.errstate(all="ignore"):
        found = native.minimize(chart, start, matches, choices, 1.0, lm.Stopping(), 1.0)
    assert found.status == -3
    assert found.status in lm.STATUS
    assert (found.nfev, found.nit) == (1, 0)


@pytest.mark.parametrize("backend", ["c", "numpy"])
@pytest.mark.parametrize("seed", [1, 2, 6, 7, 13, 14])
def test_a_constant_in_the_cost_is_no_convergence(backend, seed):
    # One point at many wrong places, heavy but beyond the bounds of a truncated loss: a constant
    # against which every change is tiny, rejected steps on the way to the minimum included.
    scene = two_view_scene(6.0, n_points=30, noise_px=1.0, seed=seed)
    away = np.concatenate([np.arange(60.0, 1000.0, 40.0), -np.arange(60.0, 1000.0, 40.0)])
    x1 = np.vstack([scene.x1, np.tile(scene.x1[0], (len(away), 1))])
    x2 = np.vstack([scene.x2, scene.x2[0] + np.outer(away, [0.0, 1.0])])
    weights = np.r_[np.ones(30), np.full(len(away), 1e5)]
    constant = 0.5 * 1e5 * 20.0**2 * len(away)
    F0 = eg.fundamental_8point(scene.x1[:9], scene.x2[:9])
    options = {"loss": "truncated", "loss_scale_px": 20.0, "hessian": "gauss-newton"}
    options |= {"ftol": 0.0, "xtol": 0.0, "gtol": 0.0, "max_iter": 60, "backend": backend}
    clean = eg.refine_fundamental(scene.x1, scene.x2, F0, **options)
    found = eg.refine_fundamental(x1, x2, F0, weights=weights, **options)
    assert not all(row.accepted for row in found.history[:5])
    assert found.cost - constant == pytest.approx(clean.cost, abs=1e-3)


def test_a_match_on_both_epipoles_is_left_out_of_the_equations(monkeypatch):
    # There the distance has no derivative: it would spoil the sums of all matches.
    scene = two_view_scene(6.0, n_points=40, seed=5)
    F0 = eg.fundamental_8point(scene.x1, scene.x2)
    U, _, Vt = np.linalg.svd(F0)
    x1 = np.vstack([scene.x1, Vt[2, :2] / Vt[2, 2]])
    x2 = np.vstack([scene.x2, U[:2, 2] / U[2, 2]])
    a, b = both(monkeypatch, x1, x2, F0=F0)
    for result in (a, b):
        assert result.success
        assert np.isfinite(result.F).all()
        assert same_geometry(result.F, a.F, scene.x1, scene.x2) < 1e-6
    assert a.history[1].cost == pytest.approx(b.history[1].cost, rel=1e-6)


def test_an_ill_conditioned_minimum_is_recognised_at_once(monkeypatch):
    # Nearly flat: the least pivot of the Hessian's Cholesky factor is below what proves it well
    # conditioned (1e-8), and its eigenvalues are above rounding.
    scene = two_view_scene(5.0, n_points=60, noise_px=0.0, seed=3)
    X = scene.X * [1.0, 1.0, 2e-5, 1.0]
    rng = np.random.default_rng(0)
    x1, x2 = (
        h[:, :2] / h[:, 2:] + 3e-6 * rng.standard_normal((60, 2))
        for h in (X @ scene.P1.T, X @ scene.P2.T)
    )
    start = eg.refine_fundamental(x1, x2, scene.F_true, ftol=1e-14).F
    for result in both(monkeypatch, x1, x2, F0=start, ftol=0.3, gtol=0.0):
        assert 1e5 < result.condition < 1e7
        assert (result.status, result.nfev) == (4, 1)


def test_exact_matches_end_at_the_rounding_of_the_data(monkeypatch):
    scene = two_view_scene(6.0, n_points=40, noise_px=0.0, seed=5)
    for result in both(monkeypatch, scene.x1, scene.x2, F0=scene.F_true):
        # At the rounding of the data, or one step of that size away from it
        assert (result.status, result.nfev) in ((5, 1), (3, 2))


def test_rows_tell_the_time():
    scene = two_view_scene(6.0, n_points=2000, seed=5)
    begun = time.perf_counter()
    history = eg.refine_fundamental(scene.x1, scene.x2, backend="c").history
    seconds = [row.seconds for row in history]
    assert seconds == sorted(seconds)
    assert 0.0 <= seconds[0] < seconds[-1] < time.perf_counter() - begun


def test_distances_are_those_of_the_result_where_the_last_step_is_rejected():
    rejected = 0
    for seed in range(4):
        scene = two_view_scene(16.0, n_points=30, noise_px=2.0, seed=seed)
        for steps in range(1, 12):
            result = eg.refine_fundamental(scene.x1, scene.x2, max_iter=steps, backend="c")
            rejected += not result.history[-1].accepted
            d, _, _ = eg.reprojection_distances(result.F, scene.x1, scene.x2)
            np.testing.assert_allclose(np.abs(result.fun), np.abs(d), atol=1e-6)
    assert rejected >= 4
