"""Starts far from the minimum: perturbed ones, random cameras, sparse tracks with gross errors."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels, lm
from epigauge.bundle.far import FAR, JumpingProblem
from epigauge.bundle.observations import ObservationGraph
from epigauge.multi_view.factorization import FactorizationProblem, _OnCameras, _trust, factorized
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import normalized
from laws import assert_jacobian, distance

# The package has a function of the same name.
initialize_module = import_module("epigauge.multi_view.initialize")

#: Published optima (Hong et al., ECCV 2016, Table 7), RMS a coordinate in pixels.
OPTIMA = {
    "library": 0.172830,
    "corridor": 0.272462,
    "house": 0.441660,
    "merton_1": 0.118450,
    "dinosaur_trimmed": 1.114493,
    "Sthlm_trimmed": 5.619975,
}


def simulated(n_views: int, n_points: int, seed: int) -> eg.Tracks:
    return eg.multi_view_scene(n_views=n_views, n_points=n_points, seed=seed).tracks


def perturbed(tracks: eg.Tracks, share: float, seed: int) -> eg.Reconstruction:
    """Return the default start with errors of a share of the norm of each camera and point."""
    start, frame = eg.initialize(tracks), Frame.of(tracks)
    P, Q = frame.cameras_in(start.P), start.Q
    P, Q = normalized().transformation(P, Q).apply(P, Q)
    rng = np.random.default_rng(seed)
    P = P + share / np.sqrt(12.0) * rng.standard_normal(P.shape)
    return eg.Reconstruction(frame.cameras_out(P), Q + share / 2.0 * rng.standard_normal(Q.shape))


# ---------------------------------------------------------------- random cameras


def factorization(eta: float = 0.2, ridge: float = 0.3) -> tuple[FactorizationProblem, eg.Tracks]:
    tracks = many_views.observed(many_views.cameras_and_points(4, 15), seen=0.7)
    layout = ObservationGraph(tracks.view, tracks.point, 4, 15)
    weights = np.random.default_rng(0).uniform(0.2, 2.0, len(tracks))
    q = Frame.of(tracks).conditioned(tracks)
    return FactorizationProblem(kernels.table(), layout, q, weights, eta, ridge), tracks


@pytest.mark.parametrize(("eta", "ridge"), [(0.9, 0.3), (0.05, 1e-3)])
def test_gradient_of_the_factorization_is_that_of_the_cost_at_the_best_points(
    eta: float, ridge: float
) -> None:
    problem, _ = factorization(eta, ridge)
    P = np.random.default_rng(1).standard_normal((4, 3, 4))
    state = problem.evaluate(P)
    found = problem.linearize(state).normal.g_cameras.reshape(P.shape)
    scale = np.abs(found).max()
    assert_jacobian(lambda x: problem.evaluate(x).cost / scale, P, found / scale, tolerance=1e-8)


def test_points_of_the_factorization_are_the_best() -> None:
    problem, _ = factorization()
    state = problem.evaluate(np.random.default_rng(1).standard_normal((4, 3, 4)))

    def cost(X: np.ndarray) -> float:
        r = problem._residuals(state.P, X)[0]
        held = problem.held * state.P.reshape(-1, 12)
        return 0.5 * float(np.sum(r**2) + problem.ridge * (np.sum(held**2) + np.sum(X**2)))

    assert cost(state.X) == pytest.approx(state.cost, rel=1e-12)
    rng = np.random.default_rng(2)
    for size in (1e-3, 1.0):
        assert cost(state.X + size * rng.standard_normal(state.X.shape)) > state.cost


def test_steps_of_the_factorization_leave_the_points_undamped() -> None:
    problem, _ = factorization()
    system = problem.linearize(
        problem.evaluate(np.random.default_rng(1).standard_normal((4, 3, 4)))
    )
    N, lam = many_views.dense(system), 0.1
    damped = N + lam * np.diag(np.arange(len(N)) < 48)
    expected = -np.linalg.solve(damped, system.gradient)
    assert distance(np.asarray(_OnCameras().step(system, lam)), expected) < 1e-9


@pytest.mark.parametrize("seed", [0, 1])
def test_random_cameras_lead_to_the_optimum(seed: int) -> None:
    tracks = simulated(6, 60, 3)
    best = eg.bundle_adjust(tracks)
    start = eg.initialize(tracks, method="factorization", seed=seed)
    found = eg.bundle_adjust(tracks, start)
    assert found.cost == pytest.approx(best.cost, rel=1e-6)


#: Seeds tried for each measured set; from 25 of them, all lead to the optimum of the first three
#: and 24 to those of merton_1 and dinosaur_trimmed.
@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        ("library", 2),
        ("corridor", 1),
        ("house", 1),
        ("merton_1", 1),
        pytest.param("dinosaur_trimmed", 3, marks=pytest.mark.slow),
        pytest.param("Sthlm_trimmed", 1, marks=pytest.mark.slow),
    ],
)
def test_random_cameras_lead_to_the_published_optimum(
    data_dir: Path, name: str, seeds: int
) -> None:
    tracks = many_views.real_tracks(data_dir, name)
    for seed in range(seeds):
        start = eg.initialize(tracks, method="factorization", seed=seed)
        found = eg.bundle_adjust(tracks, start)
        assert found.rms_px == pytest.approx(OPTIMA[name], rel=1e-5)


def test_seed_decides_and_the_same_one_gives_the_same_start() -> None:
    tracks = simulated(5, 40, 1)
    first, again, other = (
        eg.initialize(tracks, method="factorization", seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.P, again.P)
    assert not np.array_equal(first.P, other.P)


@pytest.mark.parametrize("backend", ["c", "casadi"])
def test_the_backends_factor_alike(backend: str) -> None:
    many_views.need_backend(backend)
    tracks = simulated(5, 40, 1)
    expected, found = (
        eg.initialize(tracks, method="factorization", backend=name) for name in ("numpy", backend)
    )
    assert distance(found.project(tracks), expected.project(tracks)) < 1e-6


def test_registration_is_what_auto_does_where_it_succeeds() -> None:
    tracks = simulated(5, 40, 1)
    auto = eg.initialize(tracks)
    np.testing.assert_array_equal(auto.P, eg.initialize(tracks, method="registration").P)


@pytest.mark.parametrize(("name", "value"), [("method", "magic"), ("seed", -1), ("seed", 1.5)])
def test_bad_options_are_refused(name: str, value: object) -> None:
    tracks = simulated(5, 40, 1)
    with pytest.raises(eg.ArgumentError, match=name):
        eg.initialize(tracks, **{name: value})


# ---------------------------------------------------------------- sparse, with gross errors


@pytest.mark.parametrize(("share", "seed"), [(0.05, 0), (0.1, 1)])
def test_sparse_tracks_with_gross_errors_need_no_start(
    share: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def counted(*args: Any, **options: Any) -> Any:
        tried.append(1)
        return factorized(*args, **options)

    monkeypatch.setattr(initialize_module, "factorized", counted)
    truth = many_views.cameras_and_points(20, 300, seed=seed)
    clean = many_views.observed(truth, seen=0.2, seed=seed)
    tracks, good = many_views.with_gross_errors(clean, share, seed=seed)

    def median(found: eg.Reconstruction) -> float:
        return float(np.median(np.linalg.norm(tracks.xy - found.project(tracks), axis=1)[good]))

    # One pixel of noise: 1.18 is the median of its length, less what the points take up.
    assert median(eg.initialize(tracks)) < 1.5
    assert len(tried) > 1  # the lowest cost was reached twice
    assert median(eg.initialize(tracks, method="registration")) > 5.0


def test_weight_zero_does_not_tell_whether_a_start_is_good() -> None:
    truth = many_views.cameras_and_points()
    clean = many_views.observed(truth)
    on = np.random.default_rng(0).uniform(size=len(clean)) < 0.4
    xy = clean.xy + np.where(on, 0.0, 500.0)[:, None]
    tracks = eg.Tracks(clean.view, clean.point, xy, weights=1.0 * on)
    assert initialize_module._median_residual(tracks, truth) < 2.0


def test_weight_zero_does_not_count_for_the_trust_in_others() -> None:
    rng = np.random.default_rng(0)
    near, on = np.abs(rng.normal(size=100)), rng.uniform(size=100) < 0.4
    trusts = [_trust(np.where(on, near, far), on)[on] for far in (near, 1e6)]
    np.testing.assert_array_equal(*trusts)


# ---------------------------------------------------------------- far starts


#: Nearly all such starts lead to the optimum; from seed 0, a point lies so near a focal plane that
#: the first step is undetermined, and library's seed 3 ends elsewhere in the NumPy back end.
@pytest.mark.parametrize(
    ("name", "share", "seed"),
    [
        ("library", 0.05, 1),
        ("library", 0.05, 2),
        *(("corridor", 0.2, seed) for seed in (1, 2, 3)),
    ],
)
def test_perturbed_starts_lead_to_the_published_optimum(
    data_dir: Path, name: str, share: float, seed: int
) -> None:
    tracks = many_views.real_tracks(data_dir, name)
    found = eg.bundle_adjust(tracks, perturbed(tracks, share, seed))
    assert found.rms_px == pytest.approx(OPTIMA[name], rel=1e-5)


@pytest.fixture(scope="module")
def far() -> tuple[eg.Tracks, eg.Reconstruction]:
    """Return tracks and a start with residuals of the size of the image."""
    tracks = simulated(5, 60, 2)
    return tracks, perturbed(tracks, 0.2, 0)


def test_far_starts_take_the_same_steps_in_every_basis(
    far: tuple[eg.Tracks, eg.Reconstruction],
) -> None:
    tracks, start = far
    rng = np.random.default_rng(0)
    expected = eg.bundle_adjust(tracks, start)
    assert expected.cost == pytest.approx(eg.bundle_adjust(tracks).cost, rel=1e-6)
    for condition in (1.0, 100.0):
        change = many_views.gauge_change(rng, 5, 60, condition)
        found = eg.bundle_adjust(tracks, many_views.changed(change, start))
        assert found.nit == expected.nit
        for a, b in zip(found.history, expected.history, strict=True):
            assert a.cost == pytest.approx(b.cost, rel=1e-9)
        there = many_views.changed(change, expected.reconstruction)
        for camera, image in zip(found.reconstruction.P, there.P, strict=True):
            assert distance(camera / np.abs(image).max(), image / np.abs(image).max()) < 1e-6


def test_all_steps_of_a_far_start_are_told(far: tuple[eg.Tracks, eg.Reconstruction]) -> None:
    tracks, start = far
    told: list[lm.Row] = []
    found = eg.bundle_adjust(tracks, start, callback=told.append)
    assert tuple(told) == found.history
    assert [row.iteration for row in told] == list(range(found.nfev))
    assert found.nit == found.nfev - 1
    assert found.njev == sum(row.accepted for row in told) + 1  # for each loss where they meet
    assert found.cost == min(row.cost for row in told)
    assert [row.seconds for row in told] == sorted(row.seconds for row in told)
    residuals = tracks.xy - start.project(tracks)
    assert told[0].cost == pytest.approx(0.5 * float(np.sum(residuals**2)), rel=1e-9)


@pytest.mark.parametrize("steps", range(1, 9))
def test_far_starts_keep_to_the_steps_allowed(
    far: tuple[eg.Tracks, eg.Reconstruction], steps: int
) -> None:
    tracks, start = far
    limited = eg.bundle_adjust(tracks, start, max_iter=steps)
    assert (limited.status, limited.nit) == (0, steps)
    stopped = eg.bundle_adjust(tracks, start, callback=lambda row: row.iteration == steps)
    assert (stopped.status, stopped.nit) == (-2, steps)
    assert stopped.cost == pytest.approx(limited.cost, rel=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_far_starts_never_end_above_their_cost(seed: int) -> None:
    tracks, rng = simulated(4, 30, 1), np.random.default_rng(seed)
    start = eg.Reconstruction(rng.standard_normal((4, 3, 4)), rng.standard_normal((30, 4)))
    for steps in (1, 3, 30):
        found = eg.bundle_adjust(tracks, start, max_iter=steps)
        assert found.cost <= found.history[0].cost
        assert found.cost == pytest.approx(0.5 * float(np.sum(found.fun**2)), rel=1e-6)


def test_near_starts_are_minimised_from_as_they_are() -> None:
    tracks = simulated(5, 60, 2)
    start, frame = eg.initialize(tracks), Frame.of(tracks)
    residuals = np.linalg.norm(tracks.xy - start.project(tracks), axis=1)
    assert np.median(residuals) < FAR * frame.scale
    found = eg.bundle_adjust(tracks, start)
    assert found.history[0].cost == pytest.approx(0.5 * float(np.sum(residuals**2)), rel=1e-9)
    assert [row.accepted for row in found.history] == [True] * found.nfev
    costs = [row.cost for row in found.history]
    assert costs == sorted(costs, reverse=True)


def test_points_jump_from_the_wrong_side_of_a_focal_plane() -> None:
    truth = many_views.cameras_and_points(4, 30)
    tracks = many_views.observed(truth, 0.1)
    problem = many_views.problem_of(tracks)
    P, Q = many_views.in_units(truth)
    beyond = Q.copy()
    # Through the first camera's centre, to the other side of it and of all others.
    centre = np.linalg.svd(P[0])[2][3]
    depth, own = (P[:, 2] @ point for point in (Q[0], centre))
    beyond[0] = Q[0] - 3.0 * np.abs(depth).max() / np.abs(own).max() * np.sign(own @ depth) * centre
    stuck = beyond
    for _ in range(10):
        stuck = problem.triangulated(P, stuck)
    problem.embedded = True
    jumped = JumpingProblem.of(problem.inner).refined(P.reshape(-1, 12), beyond)[0]
    best = problem.point_costs(P, problem.triangulated(P, Q))
    assert problem.point_costs(P, stuck)[0] > 1e4 * best[0]
    assert problem.point_costs(P, jumped)[0] == pytest.approx(best[0], rel=1e-3)


def test_jumps_never_raise_the_cost_of_a_point() -> None:
    rng = np.random.default_rng(0)
    truth = many_views.cameras_and_points(4, 50)
    tracks = many_views.observed(truth, seen=0.7)
    problem = JumpingProblem.of(many_views.problem_of(tracks, embedded=True).inner)
    P, _ = many_views.in_units(truth)
    for size in (0.01, 0.3):
        moved = P + size * rng.standard_normal(P.shape) / np.sqrt(12.0)
        points = rng.standard_normal((50, 4))
        rows = moved.reshape(-1, 12)
        before = problem.linearizer.point_costs(rows, points)
        refined, costs = problem.refined(rows, points)
        assert (costs <= before).all()
        assert distance(problem.linearizer.point_costs(rows, refined), costs) < 1e-9


# ---------------------------------------------------------------- memory


_WITHIN = """
import numpy as np
import epigauge as eg

tracks = eg.multi_view_scene(n_views=51, n_points=491, baseline=0.3).tracks
assert len(tracks) == 25041
result = eg.bundle_adjust(tracks, eg.initialize(tracks))
found = eg.covariance(tracks, result.reconstruction)
found.cameras, found.points, found.of_projections(np.arange(50), np.arange(50))
with open("/proc/self/status") as status:
    print(next(int(line.split()[1]) for line in status if line.startswith("VmHWM:")))
"""


@pytest.mark.slow
def test_fifty_views_with_covariances_stay_under_half_a_gigabyte() -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("the peak is read from /proc")
    # VmHWM is the peak of this program alone; ru_maxrss starts at that of the process it was
    # forked from, a whole test suite.
    run = subprocess.run(
        [sys.executable, "-c", _WITHIN], capture_output=True, text=True, check=True
    )
    # Measured: 160 MB.
    assert int(run.stdout) < 500_000
