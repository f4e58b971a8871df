"""Points as unknowns in compiled passes: the same equations and courses as written out in NumPy."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.scenes import two_view_scene
from epigauge.two_view import solve
from epigauge.two_view.free import FreeProblem
from epigauge.two_view.fused import FusedProblem
from epigauge.two_view.joint import JointProblem
from epigauge.two_view.losses import LOSSES, Loss
from epigauge.two_view.parameterizations import PARAMETERIZATIONS, ParFree

pytestmark = pytest.mark.skipif(kernels.available()["c"] is not None, reason="needs the C library")

NAMES = (*PARAMETERIZATIONS, *solve.REDUNDANT)

#: Rows are compared while lambda over its first value is above this. Below it a free gauge makes
#: the step a matter of rounding: the course in NumPy then also changes with the order of matches.
COMPARABLE = {"parfree": 3e-8, "free": 3e-5, "normalized": 3e-8}


def problems(name, loss="linear", m=300):
    """Return both problems, and a motion and points near the minimum."""
    rng = np.random.default_rng(2)
    view = two_view_scene(8.0, n_points=m, seed=4)
    weights = rng.uniform(0.5, 2.0, m)
    weights[[5, 200]] = 0.0
    table = kernels.table("c")
    matches = solve.Matches.of(view.x1, view.x2, weights, view.F_true, table)
    fitted = (matches.q1, matches.q2, weights, Loss(loss, 1.0 / matches.frame.scale))
    if name in ("free", "normalized"):
        reference = FreeProblem(table, *fitted, name == "normalized")
    else:
        kind = ParFree if name == "parfree" else PARAMETERIZATIONS[name]
        reference = JointProblem(table, kind(table), *fitted)
    motion, points = reference.start(matches.frame.from_pixels(view.F_true))
    return (
        reference,
        FusedProblem(reference),
        (motion, points + 1e-3 * rng.standard_normal(points.shape)),
    )


def relative(actual, expected):
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("loss", LOSSES)
def test_same_equations(name, loss):
    reference, fused, estimate = problems(name, loss)
    expected, state = reference.evaluate(estimate), fused.evaluate(estimate)
    assert state.cost == pytest.approx(expected.cost, rel=1e-13)
    arrow, system = reference.linearize(expected), fused.linearize(state)
    p, k = len(arrow.U), arrow.V.shape[1]

    def reordered(vector):
        """Point by point, as the reference has it."""
        return np.concatenate([vector[:p], vector[p:].reshape(k, -1).T.ravel()])

    assert relative(reordered(system.gradient), arrow.gradient) < 1e-12
    assert system.largest() == pytest.approx(arrow.largest(), rel=1e-12)
    assert system.typical() == pytest.approx(arrow.typical(), rel=1e-12)
    assert system.decrement() == arrow.decrement()
    for scaled, lam in ((False, 1e-2 * arrow.typical()), (True, 1e-2)):
        step, other = system.solve(lam, scaled=scaled), arrow.solve(lam, scaled=scaled)
        # Free gauges are held by the damping alone, at conditions of 1e5 and more.
        assert relative(reordered(step), other) < 1e-7
        assert system.predicted(step) == pytest.approx(arrow.predicted(other), rel=1e-9)
        moved, expected_moved = fused.retract(state, step), reference.retract(expected, other)
        cost = fused.evaluate(moved).cost
        assert cost == pytest.approx(reference.evaluate(expected_moved).cost, rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("damping", ["levenberg", "seber"])
@pytest.mark.parametrize("loss", LOSSES)
def test_same_course(monkeypatch, name, damping, loss):
    view = two_view_scene(7.0, n_points=30, seed=5)
    weights = np.random.default_rng(0).uniform(0.5, 2.0, 30)
    weights[[3, 17]] = 0.0
    options = {"parameterization": name, "structure": "joint", "damping": damping, "loss": loss}
    options |= {"loss_scale_px": 2.0, "weights": weights, "max_iter": 20, "backend": "c"}
    # From a given start: without one, that of the truncated loss is a minimum already.
    options["F0"] = eg.fundamental_8point(view.x1, view.x2)
    fused = eg.refine_fundamental(view.x1, view.x2, **options)
    with monkeypatch.context() as patch:
        patch.setattr(solve, "FusedProblem", lambda reference: reference)
        reference = eg.refine_fundamental(view.x1, view.x2, **options)
    compared = 0
    for row, other in zip(fused.history, reference.history, strict=False):
        if row.iteration and other.lam < COMPARABLE.get(name, 0.0) * reference.history[1].lam:
            break
        assert (row.iteration, row.accepted) == (other.iteration, other.accepted)
        assert row.cost == pytest.approx(other.cost, rel=1e-8)
        assert row.lam == pytest.approx(other.lam, rel=1e-6)
        assert row.step_norm == pytest.approx(other.step_norm, rel=1e-2, abs=1e-9)
        compared += 1
    assert compared > 3
    if name in PARAMETERIZATIONS:
        counts = [(r.status, r.nfev, r.njev, r.nit) for r in (fused, reference)]
        assert counts[0] == counts[1]


def test_points_without_weight_and_damping_are_refused():
    for problem in problems("ortho")[:2]:
        estimate = problems("ortho")[2]
        system = problem.linearize(problem.evaluate(estimate))
        with pytest.raises(np.linalg.LinAlgError):
            system.solve(0.0, scaled=False)


@pytest.mark.parametrize("m", [8, 127, 128, 129, 1000])
def test_any_number_of_matches(m):
    view = two_view_scene(6.0, n_points=m, seed=1)
    options = {"structure": "joint", "ftol": 1e-12}
    fused = eg.refine_fundamental(view.x1, view.x2, backend="c", **options)
    reference = eg.refine_fundamental(view.x1, view.x2, backend="numpy", **options)
    assert fused.cost == pytest.approx(reference.cost, rel=1e-9, abs=1e-20)
