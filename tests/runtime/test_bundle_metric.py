"""Bundle adjustment of metric cameras: ties, priors, methods, what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from bundle_scenes import CASES, PRIORS, problem_of, scene
from epigauge.bundle import compiled
from epigauge.bundle import problem as problem_module
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.diagnosis import _open as open_directions
from epigauge.bundle.jobs import metric_job
from epigauge.bundle.problem import BundleProblem, BundleState
from epigauge.bundle.solve import Step
from epigauge.bundle.strategies import STRATEGIES
from epigauge.rotations import from_rodrigues, rodrigues
from laws import central_differences, distance

Array = many_views.Array

#: All but Table 1, which is of projective cameras.
METHODS = [name for name in STRATEGIES if not name.startswith("gauge_invariant")]


def residuals_of(problem: BundleProblem, state: BundleState, start: Any) -> Any:
    """Return all residuals, priors' included, as a function of the unknowns."""
    system = problem.linearize(state)
    own = many_views.whole_ties(system)
    n, d = system.normal.g_cameras.shape

    def residuals(unknowns: Array) -> Array:
        step = own @ unknowns
        cameras, points = step[: n * d].reshape(n, d), step[n * d :].reshape(-1, 3)
        moved = problem.retract(state, Step(cameras, points, 0.0))
        r = [problem.linearizer.residuals(moved.cameras, moved.points).ravel()]
        for prior in start:
            if isinstance(prior, eg.IntrinsicPrior):
                r.append(np.array([(moved.cameras[0, 12] - prior.value) / prior.sigma]))
                continue
            if isinstance(prior, eg.PointPrior):
                away = moved.points[prior.point] - prior.position
            else:
                pose = moved.cameras[prior.view, :12].reshape(3, 4)
                if isinstance(prior, eg.PositionPrior):
                    away = -pose[:, :3].T @ pose[:, 3] - prior.position
                else:
                    turn = rodrigues(pose[:, :3] @ np.asarray(prior.rotation).T)
                    angle = np.linalg.norm(turn)
                    away = 2.0 * np.sin(0.5 * angle) * turn / angle
            C = prior.covariance
            C = np.diag(np.square(prior.sigma)) if C is None else C
            r.append(np.linalg.solve(np.linalg.cholesky(C), away))
        return np.concatenate(r)

    return residuals, system


@pytest.mark.parametrize("backend", ["numpy", "c"])
@pytest.mark.parametrize("case", CASES)
def test_normal_equations_and_steps_equal_a_dense_reference(case: str, backend: str) -> None:
    many_views.need_backend(backend)
    made, options = CASES[case]
    tracks, start = scene(**made)
    problem, state = problem_of(tracks, start, backend, **options)
    residuals, system = residuals_of(problem, state, options.get("priors") or ())
    count = system.gradient.size
    scales = 1.0 / np.sqrt(np.maximum(np.diagonal(many_views.dense(system)), 1e-300))
    J = central_differences(lambda z: residuals(scales * z), np.zeros(count), 1e-4)
    J = J.reshape(-1, count)
    r = residuals(np.zeros(count))
    assert state.cost == pytest.approx(0.5 * r @ r, rel=1e-12)
    N, g = J.T @ J, J.T @ r
    frozen = ~many_views.whole_ties(system).any(axis=0)
    N[frozen, frozen] = 1.0
    found = many_views.dense(system) * scales[:, None] * scales
    assert distance(found, N) < 1e-8
    assert distance(system.gradient * scales / np.abs(g).max(), g / np.abs(g).max()) < 1e-8
    blocks, lam = Covariant().blocks(system), 0.1
    W = np.zeros((count, count))
    sizes = system.U.shape[0] * system.U.shape[1], len(blocks.shared)
    W[: sizes[0], : sizes[0]] = many_views.block_diagonal((blocks.cameras, np.zeros((0, 1, 1))))
    middle = slice(sizes[0], sum(sizes))
    W[middle, middle] = np.diag(blocks.shared)
    W[sum(sizes) :, sum(sizes) :] = many_views.block_diagonal((blocks.points, np.zeros((0, 1, 1))))
    dense = np.linalg.solve(found + lam * W * scales[:, None] * scales, -system.gradient * scales)
    expected = many_views.whole_ties(system) @ (scales * dense)
    step = np.asarray(system.damped_step(blocks, lam))
    assert distance(step, expected) < 1e-8 * np.abs(expected).max()


def test_rotations_are_drawn_to_what_is_known_of_them() -> None:
    """With standard deviations to nothing they end there; with large ones they stay."""
    tracks, start = scene()
    free = eg.bundle_adjust(tracks, start, refine="pose")
    turn = from_rodrigues(np.array([0.0, 0.0, 0.05]))
    known = turn @ free.reconstruction.R[1]
    for sigma, expected in ((1e-9, known), (1e6, free.reconstruction.R[1])):
        priors = [
            eg.RotationPrior(0, free.reconstruction.R[0], sigma=1e-9),
            eg.RotationPrior(1, known, sigma=sigma),
        ]
        found = eg.bundle_adjust(tracks, free.reconstruction, refine="pose", priors=priors)
        assert np.linalg.norm(rodrigues(found.reconstruction.R[1] @ expected.T)) < 1e-5
    # They hold the axes: place and scale are left.
    assert found.rank == 6 * 4 + 3 * 25 - 4


@pytest.mark.parametrize("case", ["priors", "priors and fixed"])
def test_noise_weighs_observations_against_priors(case: str) -> None:
    made, options = CASES[case]
    tracks, start = scene(**made)
    noise = 0.4
    found = eg.bundle_adjust(tracks, start, **options, noise_px=noise, ftol=1e-14)

    def scaled(prior: Any) -> Any:
        if prior.sigma is not None:
            return replace(prior, sigma=np.asarray(prior.sigma) / noise)
        return replace(prior, covariance=prior.covariance / noise**2)

    options = {**options, "priors": [scaled(prior) for prior in options["priors"]]}
    expected = eg.bundle_adjust(tracks, start, **options, ftol=1e-14)
    # Where steps no longer lower the cost, rounding decides: the square root of its digits
    assert distance(found.reconstruction.X, expected.reconstruction.X) < 1e-7
    assert found.cost == pytest.approx(expected.cost, rel=1e-10)


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_estimated_from_the_images(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true_px = 0.1
    tracks, start = scene(m=60, seed=seed)
    exact = eg.bundle_adjust(tracks, start).reconstruction
    xy = exact.project(tracks) + true_px * rng.standard_normal((len(tracks), 2))
    tracks = eg.Tracks(tracks.view, tracks.point, xy)
    priors = [
        eg.PositionPrior(i, exact.centres[i] + 0.01 * rng.standard_normal(3), sigma=0.01)
        for i in range(4)
    ]
    found = eg.bundle_adjust(tracks, exact, priors=priors, noise_px=None)
    assert found.noise_px == pytest.approx(true_px, rel=0.1)
    again = eg.bundle_adjust(tracks, exact, priors=priors, noise_px=found.noise_px)
    assert distance(again.reconstruction.X, found.reconstruction.X) < 1e-3
    assert again.cost == pytest.approx(found.cost, rel=1e-3)
    assert eg.bundle_adjust(tracks, exact, priors=priors).noise_px == 1.0


@pytest.mark.parametrize("case", [case for case in CASES if case != "all"])
def test_adjusted_ties_hold_and_the_gradient_vanishes(case: str) -> None:
    made, options = CASES[case]
    tracks, start = scene(**made)
    found = eg.bundle_adjust(tracks, start, ftol=1e-14, **options)
    moved = found.reconstruction
    problem, state = problem_of(tracks, moved, **options)
    before, _ = problem_of(tracks, start, **options)
    scale = np.sqrt(np.maximum(np.diagonal(many_views.dense(problem.linearize(state))), 1e-300))
    gradient = problem.linearize(state).gradient / scale
    assert np.abs(gradient).max() < 1e-4 * np.sqrt(2.0 * state.cost)
    assert found.cost == pytest.approx(state.cost, rel=1e-9)
    for view in options.get("fixed_views", ()):
        np.testing.assert_array_equal(moved.R[view], start.R[view])
        np.testing.assert_array_equal(moved.t[view], start.t[view])
    for point in options.get("fixed_points", ()):
        np.testing.assert_array_equal(moved.X[point], start.X[point])
    refine = options.get("refine", "all")
    names = ["f", "cx", "cy", "k"]
    for k, name in enumerate(names):
        changed = (moved.cameras.params[:, k] != start.cameras.params[:, k]).all()
        assert changed == (refine == "all" or name in refine)
    assert before.freedom.ties.n_shared == problem.freedom.ties.n_shared


def test_bounds_of_every_focal_length_hold_in_both_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    many_views.need_backend("c")
    tracks, start = scene("PINHOLE", ((900.0, 990.0, 320.0, 240.0),) * 4, range(4))
    for module in (compiled, problem_module):
        monkeypatch.setattr(module, "MAX_FOCAL", 990.5)
    options = {"refine": ("fx", "fy"), "max_iter": 8}
    runs = [eg.bundle_adjust(tracks, start, backend=name, **options) for name in ("c", "numpy")]
    costs = [[row.cost for row in run.history] for run in runs]
    assert np.inf in costs[0]
    np.testing.assert_allclose(*costs, rtol=1e-6)
    for run in runs:
        assert (run.reconstruction.cameras.params[:, :2] <= 990.5).all()


@pytest.mark.parametrize("method", METHODS)
def test_every_method_reaches_the_same_cost(method: str) -> None:
    tracks, start = scene()
    best = eg.bundle_adjust(tracks, start, refine=("f",), ftol=1e-14)
    found = eg.bundle_adjust(tracks, start, refine=("f",), method=method, ftol=1e-12, max_iter=300)
    assert found.cost == pytest.approx(best.cost, rel=1e-4)
    if method == "free":
        assert found.nfev < 15
    moved = found.reconstruction
    if method in ("hartley", "bartoli"):
        assert distance(moved.R[0], np.eye(3)) < 1e-12
        assert distance(moved.t[0], np.zeros(3)) < 1e-12
    if method in ("mclauchlan", "kanatani") and found.nit % STRATEGIES[method].every == 0:
        assert distance(moved.X.mean(axis=0), np.zeros(3)) < 1e-9


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"refine": ("f", "k3")}, "refine.*k3"),
        ({"refine": 3}, "refine"),
        ({"refine": ("f", "f")}, "twice"),
        ({"refine": "pose", "fixed_views": range(4), "fixed_points": range(25)}, "nothing"),
        ({"fixed_views": [4]}, "fixed_views.*4"),
        ({"fixed_views": 3}, "fixed_views is 3"),
        ({"fixed_points": 3}, "fixed_points is 3"),
        ({"fixed_points": [-1]}, "fixed_points.*-1"),
        ({"priors": [eg.PositionPrior(9, (0, 0, 0), sigma=1.0)]}, r"priors\[0\].view"),
        ({"priors": [eg.PointPrior(1, (0, np.nan, 0), sigma=1.0)]}, "position"),
        ({"priors": [eg.PointPrior(1, (0, 0, 0))]}, "neither"),
        ({"priors": [eg.PointPrior(1, (0, 0, 0), covariance=-np.eye(3))]}, "positive definite"),
        ({"priors": [eg.IntrinsicPrior(0, "k9", 0.0, 1.0)]}, "k9"),
        ({"priors": [eg.IntrinsicPrior(1, "f", 0.0, 1.0)]}, "camera"),
        ({"priors": [eg.IntrinsicPrior(0, "f", 1.0, 0.0)]}, "sigma"),
        ({"priors": [eg.IntrinsicPrior(0, "f", np.nan, 1.0)]}, "value.*finite"),
        ({"priors": [eg.IntrinsicPrior(0, "f", [1.0, 2.0], 1.0)]}, "value.*finite"),
        ({"priors": [PRIORS[2]], "refine": "pose"}, "fixes"),
        ({"priors": [PRIORS[0]], "fixed_views": [1]}, "fixed"),
        ({"priors": ["GPS"]}, "str"),
        ({"priors": [eg.RotationPrior(0, 2.0 * np.eye(3), sigma=1.0)]}, "rotation"),
        ({"priors": [eg.RotationPrior(0, -np.eye(3), sigma=1.0)]}, "reflection"),
        ({"priors": [eg.RotationPrior(9, np.eye(3), sigma=1.0)]}, r"priors\[0\].view"),
        ({"priors": [PRIORS[4]], "fixed_views": [2]}, "fixed"),
        ({"priors": [PRIORS[0]], "noise_px": -1.0}, "noise_px"),
        ({"noise_px": 2.0}, "noise_px"),
        ({"priors": [PRIORS[0]], "method": "free"}, "method"),
        ({"fixed_views": [0], "method": "hartley"}, "method"),
        ({"method": "gauge_invariant"}, "gauge_invariant"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], named: str) -> None:
    with pytest.raises(eg.ArgumentError, match=named):
        eg.bundle_adjust(*scene(), **options)


def test_a_start_that_leads_to_no_camera_is_named() -> None:
    tracks, start = scene()
    options = {"refine": "all", "fixed_views": (), "fixed_points": (), "priors": None}
    job = metric_job(tracks, start, **options)
    away = job.cameras.copy()
    away[:, -1] = 1e20
    with pytest.raises(eg.ArgumentError, match="start leads to cameras or points that are none"):
        job.result(away, job.points)


def test_what_only_metric_starts_have_is_refused_for_others() -> None:
    tracks, start = scene()
    for options in ({"refine": "pose"}, {"priors": [PRIORS[0]]}):
        with pytest.raises(eg.ArgumentError, match="projective start"):
            eg.bundle_adjust(tracks, start.to_projective(), **options)


@pytest.mark.parametrize("backend", ["c", "numpy"])
@pytest.mark.parametrize(
    ("views", "points", "left"), [((0,), (), 4), ((0, 2), (7,), 0), ((), (1, 2, 3), 6)]
)
def test_projective_views_and_points_can_be_fixed(
    backend: str, views: tuple[int, ...], points: tuple[int, ...], left: int
) -> None:
    """Of the 15 changes of basis, a camera takes 11 and a point 3."""
    many_views.need_backend(backend)
    tracks, _ = scene()
    start = eg.initialize(tracks)
    found = eg.bundle_adjust(
        tracks, start, fixed_views=views, fixed_points=points, backend=backend, ftol=1e-13
    )
    assert np.array_equal(found.reconstruction.P[list(views)], start.P[list(views)])
    assert np.array_equal(found.reconstruction.Q[list(points)], start.Q[list(points)])
    assert found.success
    n, m = tracks.n_views - len(views), tracks.n_points - len(points)
    assert found.rank == 11 * n + 3 * m - left
    free = eg.bundle_adjust(tracks, start, ftol=1e-13)
    if left:  # the frame alone is fixed
        assert found.cost == pytest.approx(free.cost, rel=1e-9)
    else:
        assert free.cost < found.cost <= found.history[0].cost


def test_all_views_fixed_leaves_intersections() -> None:
    tracks, _ = scene()
    start = eg.initialize(tracks)
    found = eg.bundle_adjust(tracks, start, fixed_views=range(4), ftol=1e-13)
    assert found.success
    assert found.rank == 3 * tracks.n_points
    # Each point alone is at its minimum.
    for j in (0, 11):
        held = [k for k in range(tracks.n_points) if k != j]
        other = eg.bundle_adjust(
            tracks, found.reconstruction, fixed_views=range(4), fixed_points=held, ftol=1e-13
        )
        assert other.cost == pytest.approx(found.cost, rel=1e-12)
    with pytest.raises(eg.ArgumentError, match="method"):
        eg.bundle_adjust(tracks, start, fixed_views=[0], method="hartley")


def test_rank_counts_the_unknowns_and_what_fixes_the_gauge() -> None:
    tracks, start = scene()
    poses, points = 6 * 4, 3 * 25
    for options, expected in (
        ({}, poses + 4 + points - 7),
        ({"refine": "pose"}, poses + points - 7),
        ({"fixed_views": [0]}, poses - 6 + 4 + points - 1),
        ({"fixed_points": [0, 1, 2]}, poses + 4 + points - 9),
        ({"priors": [PRIORS[3]]}, poses + 4 + points - 4),
        ({"refine": ("f",), "method": "hartley"}, poses - 6 + 1 + points - 1),
    ):
        found = eg.bundle_adjust(tracks, start, **options)
        assert found.rank == expected, options
        assert np.isfinite(found.condition)


def test_what_nothing_determines_is_named() -> None:
    """Six coefficients of one radius: numerator and denominator exchange in a narrow view."""
    params = [[1000.0, 1000.0, 320.0, 240.0, -0.1, 0.01, 1e-3, 1e-3, 1e-3, 2e-3, 3e-3, 1e-3]]
    tracks, start = scene("FULL_OPENCV", params, m=40)
    tracks = eg.Tracks(tracks.view, tracks.point, start.project(tracks))
    found = eg.bundle_adjust(tracks, start)
    assert found.flags == ("undetermined", "open intrinsics")
    assert found.weakest.endswith("(undetermined)")
    named = {part.split(" of view")[0] for part in found.weakest.split(", ")}
    assert named <= {f"k{k}" for k in range(1, 7)}
    known = eg.bundle_adjust(tracks, start, refine=("f", "cx", "cy", "k1", "p1", "p2"))
    assert "undetermined" not in known.flags


def test_gauge_groups_are_those_of_the_cameras() -> None:
    tracks, start = scene()
    assert eg.gauge.group("SIMPLE_RADIAL").dimension == 7
    assert eg.gauge.group("projective").dimension == 15
    cameras, points = eg.gauge.group("SIMPLE_RADIAL").generators(start)
    problem, state = problem_of(tracks, start)
    system = problem.linearize(state)
    for k in range(7):
        x, y = system.product(cameras[..., k], points[..., k])
        assert np.abs(x).max() < 1e-9 * np.abs(system.U).max()
        assert np.abs(y).max() < 1e-9 * np.abs(system.V).max()
    with pytest.raises(eg.ArgumentError, match="projective cameras"):
        eg.gauge.group("projective").generators(start)
    with pytest.raises(eg.ArgumentError, match="T"):
        eg.gauge.transform(start, np.eye(4))
    with pytest.raises(eg.ArgumentError, match="reflection"):
        eg.gauge.similarity(1.0, -np.eye(3), np.zeros(3))


def test_points_of_one_line_of_sight_are_counted_in_silence():
    # Of rank one but for rounding, which leaves pivots of zero and of minus infinity.
    block = [
        [5.070977422640635e20, 1.1890489270433374e20, 1.1492828253583953e20],
        [1.1890489270433374e20, 2.7880963235814953e19, 2.694852286780884e19],
        [1.1492828253583953e20, 2.694852286780884e19, 2.604726668208991e19],
    ]
    sizes = 1.8700865739398945e20 * np.eye(3)
    assert open_directions(np.array([block]), sizes[None]) == 2
