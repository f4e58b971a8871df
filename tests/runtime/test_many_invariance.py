"""Invariance of whole steps and runs in random bases: `covariant` has it, the others do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.bundle import dampings
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import Transformation

Array = many_views.Array

CONDITIONS = (1.0, 10.0, 100.0, 1000.0)
SETS = ("simulated", "corridor", "house")


@pytest.fixture(scope="module", params=SETS)
def tracked(request: pytest.FixtureRequest) -> tuple[eg.Tracks, eg.Reconstruction]:
    """Return tracks with a start: simulated (5 views, 100 points), or measured."""
    if request.param == "simulated":
        tracks = many_views.observed(many_views.cameras_and_points())
    else:
        data: Path = request.getfixturevalue("data_dir")
        tracks = many_views.real_tracks(data, request.param)
    return tracks, eg.initialize(tracks)


def conditioned(
    tracks: eg.Tracks, start: eg.Reconstruction
) -> tuple[many_views.Problem, tuple[Array, Array]]:
    frame = Frame.of(tracks)
    problem = many_views.problem_of(tracks)
    problem.q = frame.conditioned(tracks)
    return problem, (frame.cameras_in(start.P), start.Q)


def changes(n: int, m: int, count: int = 20) -> list[Transformation]:
    """Return random changes of basis of all conditions, with random scales of both signs."""
    return [
        many_views.gauge_change(
            np.random.default_rng(seed), n, m, CONDITIONS[seed % len(CONDITIONS)]
        )
        for seed in range(count)
    ]


def moved_step(change: Transformation, step: Array, n: int) -> Array:
    """Return T~ times a step."""
    cameras, points = change.blocks()
    x, y = step[: 12 * n].reshape(n, 12), step[12 * n :].reshape(-1, 4)
    return np.concatenate(
        [np.einsum("nij,nj->ni", cameras, x).ravel(), np.einsum("nij,nj->ni", points, y).ravel()]
    )


def method_step(problem: many_views.Problem, P: Array, Q: Array, damping: Any) -> Array:
    """Return the first step from (P, Q); the covariant method computes it in its own basis."""
    home: Any = eg.gauge.identity()
    if isinstance(damping, dampings.Covariant):
        home = eg.gauge.normalized()
    there = home.transformation(P, Q)
    system = problem.linearize(problem.evaluate(there.apply(P, Q)))
    step = np.asarray(damping.step(system, damping.start(system)))
    return moved_step(there.inverse(), step, len(P))


def step_defects(
    problem: many_views.Problem, P: Array, Q: Array, damping: Any, count: int = 20
) -> list[float]:
    """Return |delta' - T~ delta| / |delta'| in random bases."""
    step = method_step(problem, P, Q, damping)
    found = []
    for change in changes(len(P), len(Q), count):
        other = method_step(problem, *change.apply(P, Q), damping)
        found.append(
            float(np.linalg.norm(other - moved_step(change, step, len(P))) / np.linalg.norm(other))
        )
    return found


def test_covariant_step_is_invariant(tracked: tuple) -> None:
    problem, estimate = conditioned(*tracked)
    assert max(step_defects(problem, *estimate, dampings.Covariant())) < 1e-9


@pytest.mark.parametrize(
    "damping",
    [
        dampings.Levenberg(),
        dampings.Marquardt(),
        dampings.GaugeInvariant("product"),
        dampings.GaugeInvariant("factor"),
        dampings.PseudoInverse(kernels.table("numpy")),
    ],
    ids=lambda damping: type(damping).__name__ + getattr(damping, "norm", ""),
)
def test_other_steps_are_not_invariant(tracked: tuple, damping: Any) -> None:
    problem, estimate = conditioned(*tracked)
    defects = np.array(step_defects(problem, *estimate, damping, 4))
    # Condition 1 with scales of a decade is enough; diag(N) bears those, but not the rotation.
    assert defects.min() > 1e-3
    assert np.median(defects) > 0.5


def test_covariant_damping_keeps_most_digits_without_moving_to_its_basis() -> None:
    tracks = many_views.observed(many_views.cameras_and_points())
    problem, estimate = conditioned(tracks, eg.initialize(tracks))
    P, Q = eg.gauge.normalized().transformation(*estimate).apply(*estimate)
    damping = dampings.Covariant()
    step = np.asarray(damping.step(problem.linearize(problem.evaluate((P, Q))), 1e-3))
    for change in changes(len(P), len(Q), 8):
        moved = problem.evaluate(change.apply(P, Q))
        other = np.asarray(damping.step(problem.linearize(moved), 1e-3))
        expected = moved_step(change, step, len(P))
        # Blocks of condition 1e6 times what the geometry brings.
        assert np.linalg.norm(other - expected) < 1e-5 * np.linalg.norm(other)


def test_whole_covariant_runs_are_invariant(tracked: tuple) -> None:
    tracks, start = tracked
    n, m = len(start.P), len(start.Q)
    expected = eg.bundle_adjust(tracks, start)
    for change in changes(n, m, 20 if m == 100 else 4):
        found = eg.bundle_adjust(tracks, many_views.changed(change, start))
        assert (found.nfev, found.njev, found.status) == (
            expected.nfev,
            expected.njev,
            expected.status,
        )
        for a, b in zip(found.history, expected.history, strict=True):
            assert a.cost == pytest.approx(b.cost, rel=1e-9)
            assert (a.lam, a.accepted) == (b.lam, b.accepted)
        # Points that the measured tracks hardly determine move by rounding of their flat cost.
        tolerance = 1e-8 if m == 100 else 1e-6
        assert eg.gauge.equivalent(found.reconstruction, expected.reconstruction, tolerance)
        # The result is in the basis of the start.
        back = many_views.changed(change, expected.reconstruction)
        same_basis = np.abs(found.reconstruction.P[0] * np.sign(back.P[0, 0, 0])).ravel()
        other = np.abs(back.P[0]).ravel()
        np.testing.assert_allclose(
            same_basis / np.linalg.norm(same_basis), other / np.linalg.norm(other), atol=1e-5
        )


@pytest.mark.parametrize("method", ["levenberg", "marquardt", "gauge_invariant", "free"])
def test_other_runs_depend_on_the_basis(method: str) -> None:
    tracks = many_views.observed(many_views.cameras_and_points())
    start = eg.initialize(tracks)
    expected = eg.bundle_adjust(tracks, start, method=method)
    differences = []
    for change in changes(5, 100, 8):
        moved = many_views.changed(change, start)
        found = eg.bundle_adjust(tracks, moved, method=method, max_iter=30)
        first = [r.history[1].cost for r in (found, expected)]
        differences.append(abs(first[0] - first[1]) / first[1])
    assert max(differences) > 1e-6


@pytest.mark.parametrize(
    "gauge",
    [
        eg.gauge.identity(),
        eg.gauge.reference_camera(),
        eg.gauge.reference_camera(3),
        eg.gauge.two_cameras(),
        eg.gauge.five_points(),
        eg.gauge.normalized(),
    ],
    ids=repr,
)
@pytest.mark.parametrize("damping", ["levenberg", "marquardt", "covariant"])
@pytest.mark.parametrize("seen", [1.0, 0.7])
def test_explicit_and_implicit_gauges_give_the_same_costs(
    gauge: Any, damping: str, seen: float
) -> None:
    tracks = many_views.observed(many_views.cameras_and_points(), seen=seen)
    start = many_views.shaken(eg.initialize(tracks), 0.03)
    explicit, implicit = (
        eg.bundle_adjust(
            tracks,
            start,
            method="levenberg",
            damping=damping,
            gauge=gauge,
            gauge_mode=mode,
            ftol=1e-10,
        )
        for mode in ("explicit", "implicit")
    )
    assert len(explicit.history) > 4
    # diag(N) feels the orthonormal change of basis that the normalised gauge leaves open: moving
    # there from the last estimate or from the start differs by one, of second order.
    open_ = damping == "marquardt" and isinstance(gauge, eg.gauge.normalized)
    for a, b in zip(explicit.history, implicit.history, strict=False):
        assert a.cost == pytest.approx(b.cost, rel=1e-5 if open_ else 1e-8)
        assert a.accepted == b.accepted or abs(a.cost - explicit.cost) < 1e-8 * explicit.cost
    assert explicit.cost == pytest.approx(implicit.cost, rel=1e-9)


@pytest.mark.parametrize("gauge", [eg.gauge.reference_camera(), eg.gauge.five_points()], ids=repr)
def test_an_explicit_gauge_is_where_the_result_is(gauge: Any) -> None:
    tracks = many_views.observed(many_views.cameras_and_points())
    found = eg.bundle_adjust(tracks, method="levenberg", gauge=gauge)
    frame = Frame.of(tracks)
    P, Q = frame.cameras_in(found.reconstruction.P), found.reconstruction.Q
    there = gauge.transformation(P, Q)
    T = there.T / there.T[0, 0]
    np.testing.assert_allclose(T, np.diag(np.diag(T)), atol=1e-8)
    np.testing.assert_allclose(np.abs(np.diag(T)), 1.0, atol=1e-8)


def test_the_gauge_of_a_damped_iteration_matters() -> None:
    # What the two tests above compare is not the same in all gauges.
    tracks = many_views.observed(many_views.cameras_and_points())
    start = many_views.shaken(eg.initialize(tracks), 0.03)
    costs = [
        eg.bundle_adjust(tracks, start, method="levenberg", gauge=gauge).history[1].cost
        for gauge in (eg.gauge.normalized(), eg.gauge.two_cameras(), eg.gauge.five_points())
    ]
    assert np.ptp(costs) > 1e-3 * min(costs)
