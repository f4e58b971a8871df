"""Every strategy of the paper: the same optimum on strong geometry, frozen parameters frozen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge.bundle import far
from epigauge.bundle.problem import BundleProblem, Estimate
from epigauge.bundle.strategies import (
    STRATEGIES,
    InGauge,
    ReferenceOfProjective,
    canonic_factors,
)
from epigauge.cameras import camera_model
from laws import assert_jacobian, distance

Array = many_views.Array

#: All but Table 1 as solved in the text of B03, whose blocks of rank one hardly let anything move.
METHODS = [name for name in STRATEGIES if name != "gauge_invariant_factor"]

#: Evaluations that are enough on strong geometry (measured: 4 to 8).
ENOUGH = 15


@pytest.fixture(scope="module", params=range(3))
def strong(request: pytest.FixtureRequest) -> tuple[eg.Tracks, eg.Reconstruction, float]:
    tracks = many_views.observed(
        many_views.cameras_and_points(flatness=0.5, seed=request.param), seed=request.param
    )
    start = eg.initialize(tracks)
    return tracks, start, eg.bundle_adjust(tracks, start, ftol=1e-12).cost


@pytest.mark.parametrize("method", METHODS)
def test_every_method_reaches_the_same_cost_on_strong_geometry(strong: Any, method: str) -> None:
    tracks, start, best = strong
    found = eg.bundle_adjust(tracks, start, method=method)
    assert found.success
    assert found.method == method
    assert found.cost == pytest.approx(best, rel=1e-6)
    assert found.nfev <= ENOUGH


def test_table_1_as_solved_in_the_text_hardly_moves(strong: Any) -> None:
    # Each camera moves in three directions, all points along one.
    tracks, start, best = strong
    found = eg.bundle_adjust(tracks, start, method="gauge_invariant_factor", max_iter=40)
    assert found.nfev == 41
    assert found.cost > (1.0 + 1e-8) * best


def recorded(
    monkeypatch: pytest.MonkeyPatch, tracks: eg.Tracks, start: eg.Reconstruction, method: str
) -> list[tuple[Array, Array]]:
    """Return all estimates that a method evaluates, in conditioned coordinates."""
    estimates = []
    evaluate = BundleProblem.evaluate

    def recording(self: BundleProblem, estimate: Estimate) -> Any:
        estimates.append((estimate.cameras.reshape(-1, 3, 4), estimate.points))
        return evaluate(self, estimate)

    with monkeypatch.context() as patch:
        patch.setattr(BundleProblem, "evaluate", recording)
        # What the default method says of the result has a basis of its own.
        patch.setattr(far, "short_of_minimum", lambda *_: False)
        eg.bundle_adjust(tracks, start, method=method)
    assert len(estimates) > 3
    return estimates


class TestFrozen:
    def test_hartley_never_touches_the_reference_camera(
        self, strong: Any, monkeypatch: Any
    ) -> None:
        estimates = recorded(monkeypatch, *strong[:2], "hartley")
        P, Q = estimates[0]
        assert distance(P[0], np.eye(3, 4)) < 1e-12
        for moved_P, moved_Q in estimates[1:]:
            np.testing.assert_array_equal(moved_P[0], P[0])
            np.testing.assert_array_equal(moved_Q[:, 2], Q[:, 2])
            assert (moved_P[1:] != P[1:]).all()
            assert (moved_Q[:, [0, 1, 3]] != Q[:, [0, 1, 3]]).all()

    def test_bartoli_keeps_the_second_camera_canonic(self, strong: Any, monkeypatch: Any) -> None:
        estimates = recorded(monkeypatch, *strong[:2], "bartoli")
        P, Q = estimates[0]
        for moved_P, moved_Q in estimates:
            np.testing.assert_array_equal(moved_P[0], P[0])
            np.testing.assert_array_equal(moved_Q[:, 2], Q[:, 2])
            H, e = moved_P[1][:, :3], moved_P[1][:, 3]
            assert abs(np.linalg.norm(e) - 1.0) < 1e-10
            assert np.abs(e @ H).max() < 1e-10
            values = np.linalg.svd(H, compute_uv=False)
            assert min(abs(values[:2] - 1.0)) < 1e-10
            assert values[2] < 1e-10
        assert (estimates[-1][0][1:] != P[1:]).any(axis=(1, 2)).all()

    def test_faugeras_never_touches_the_five_points(self, strong: Any, monkeypatch: Any) -> None:
        estimates = recorded(monkeypatch, *strong[:2], "faugeras")
        P, Q = estimates[0]
        five = np.flatnonzero((Q == estimates[-1][1]).all(axis=1))
        assert len(five) == 5
        standard = np.vstack([np.eye(4), np.full(4, 0.5)])
        cosines = np.abs(Q[five] @ standard.T)
        assert distance(np.sort(cosines.max(axis=0)), np.ones(5)) < 1e-12
        for moved_P, moved_Q in estimates[1:]:
            np.testing.assert_array_equal(moved_Q[five], Q[five])
            assert (moved_P != P).any(axis=(1, 2)).all()

    @pytest.mark.parametrize("method", ["mclauchlan", "kanatani"])
    def test_normalised_methods_return_to_their_basis(
        self, strong: Any, monkeypatch: Any, method: str
    ) -> None:
        estimates = recorded(monkeypatch, *strong[:2], method)
        every = STRATEGIES[method].every
        for k, (P, Q) in enumerate(estimates):
            if k % every == 0:
                assert distance(Q.T @ Q * 4 / len(Q), np.eye(4)) < 1e-11
                assert distance(np.linalg.norm(P, axis=(1, 2)), np.ones(len(P))) < 1e-12
        if method == "kanatani":
            assert distance(np.linalg.norm(estimates[1][1], axis=1), np.ones(len(Q))) > 1e-9


def restricted(kind: str, sigma: float | None = None) -> tuple[many_views.Problem, Any]:
    truth = many_views.cameras_and_points(4, 20)
    problem = many_views.problem_of(many_views.observed(truth, 3.0))
    P, Q = many_views.in_units(many_views.shaken(truth))
    chosen = eg.gauge.five_points.choose(Q)
    gauge: Any = {
        "camera": eg.gauge.reference_camera(),
        "cameras": eg.gauge.two_cameras(),
        "points": eg.gauge.five_points(chosen),
    }[kind]
    problem.freedom = ReferenceOfProjective(
        kernels=problem.kernels, reference=kind, chosen=tuple(chosen)
    )
    P, Q = gauge.transformation(P, Q).apply(P, Q)
    if sigma is not None:
        U, V, _ = canonic_factors(P[1])
        P[1] = problem.kernels.canonical_camera(U, V, np.array(sigma))
    return problem, problem.evaluate((P, Q))


@pytest.mark.parametrize("kind", ["camera", "cameras", "points"])
def test_restricted_gradient_is_the_derivative_through_retract(kind: str) -> None:
    problem, state = restricted(kind)
    system = problem.linearize(state)
    size, own = state.cost, many_views.whole_ties(system)
    assert_jacobian(
        lambda step: problem.evaluate(problem.retract(state, own @ step)).cost / size,
        np.zeros(system.gradient.size),
        system.gradient / size,
        step=1e-4,
        tolerance=1e-7,  # rounding 1e-16 / 1e-4 times a gradient large against the cost
    )


@pytest.mark.parametrize("sigma", [0.5, 0.999, 1.001, 1.3])
def test_second_camera_is_factored_on_both_sides_of_sigma_one(sigma: float) -> None:
    problem, state = restricted("cameras", sigma)
    P, Q = problem.retract(state, np.zeros(state.P.size + state.Q.size))
    assert distance(P, state.P) < 1e-12
    np.testing.assert_array_equal(Q, state.Q)
    assert float(canonic_factors(state.P[1]).sigma) == pytest.approx(sigma, rel=1e-12)


@pytest.mark.parametrize("method", ["hartley", "bartoli", "faugeras", "mclauchlan"])
@pytest.mark.parametrize("damping", ["marquardt", "covariant"])
def test_other_dampings_serve_the_restricted_methods(
    strong: Any, method: str, damping: str
) -> None:
    tracks, start, best = strong
    found = eg.bundle_adjust(tracks, start, method=method, damping=damping)
    assert found.cost == pytest.approx(best, rel=1e-6)
    assert found.nfev <= ENOUGH


def test_covariant_damping_of_a_restricted_problem_is_that_of_its_parameters() -> None:
    problem, state = restricted("cameras")
    system = problem.linearize(state)
    assert system.normal.depth_blocks is not None
    bases = system.ties.A, system.ties.C
    pairs = zip(system.depth_blocks, system.normal.depth_blocks, bases, strict=True)
    for found, blocks, basis in pairs:
        expected = basis.swapaxes(1, 2) @ blocks @ basis
        free = np.einsum("ni,nj->nij", *[basis.any(axis=1)] * 2)
        assert distance(found * free, expected) < 1e-12


def test_an_estimate_is_moved_into_its_gauge_every_so_often() -> None:
    P, Q = many_views.in_units(many_views.cameras_and_points(4, 20))
    kept = InGauge(model=camera_model("projective"), gauge=eg.gauge.normalized(), every=3)
    far = 2.0 * P.reshape(-1, 12), 2.0 * Q
    moves = [kept.moving(*far, steps) for steps in range(1, 7)]
    moved = [far if move is None else move.apply(*far) for move in moves]
    normed = [distance(np.linalg.norm(Q, axis=1), np.ones(20)) < 1e-12 for _, Q in moved]
    assert normed == [False, False, True, False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corridor", "house"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_reaches_the_optimum_of_measured_sets(
    data_dir: Path, name: str, method: str
) -> None:
    tracks = many_views.real_tracks(data_dir, name)
    found = eg.bundle_adjust(tracks, method=method, max_iter=300)
    assert found.rms_px == pytest.approx({"corridor": 0.272462, "house": 0.441660}[name], rel=1e-4)
