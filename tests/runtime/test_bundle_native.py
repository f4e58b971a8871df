"""The evaluation in C against the NumPy reference: parts, steps, whole runs, threads."""

from __future__ import annotations

import threading
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels, scatter
from epigauge.bundle import lanes, numpy_linearizer
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.lanes import LaneLayout
from epigauge.bundle.linearizer import PointRefinement
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.skyline import Skyline, narrow
from epigauge.bundle.strategies import STRATEGIES
from epigauge.cameras import camera_model
from epigauge.multi_view import adjust
from epigauge.multi_view.resection import resect
from epigauge.two_view.losses import LOSSES, Loss
from laws import distance

Array = many_views.Array
Linearizers = tuple[NativeLinearizer, NumpyLinearizer]

if kernels.available()["c"] is not None:
    pytest.skip("back end c " + str(kernels.available()["c"]), allow_module_level=True)

#: Cameras, points, share seen: padded lanes, a single chunk, points of two views, long tracks.
SHAPES = [(4, 20, 0.7), (3, 6, 1.0), (5, 101, 0.01), (70, 30, 0.5), (12, 300, 0.3)]

#: Models of both routes through the loops, and of several widths of a camera's block.
MODELS = ["projective", "bal", "SIMPLE_PINHOLE", "OPENCV"]

#: Parameters of the metric ones, for points around (0, 0, 10) and pixels of about 1000.
PARAMS = {
    "bal": [1000.0, -0.1, 0.01],
    "SIMPLE_PINHOLE": [1000.0, 3.0, -4.0],
    "OPENCV": [1000.0, 990.0, 3.0, -4.0, -0.1, 0.02, 1e-3, -2e-3],
}


def scene_of(
    model: str, n: int = 4, m: int = 20, seen: float = 0.7, *, loss: str = "linear", seed: int = 0
) -> tuple[dict[str, Any], tuple[Array, Array]]:
    """Return the parts of a linearizer, weights some of which are zero, and an estimate."""
    truth = many_views.cameras_and_points(n, m, seed=seed)
    tracks = many_views.observed(truth, 3.0, seen=seen, seed=seed)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.5, 2.0, len(tracks)) * (rng.uniform(size=len(tracks)) > 0.05)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    if model == "projective":
        P, Q = many_views.in_units(many_views.shaken(truth, seed=seed))
        q, estimate, scale = tracks.xy.T / 1000.0, (P.reshape(-1, 12), Q), 0.004
    else:
        K = np.array([[1000.0, 0.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]])
        pose = np.linalg.solve(K, truth.P).reshape(-1, 12)
        if model == "bal":  # looks along -z, y up
            pose = (np.diag([1.0, -1.0, -1.0]) @ pose.reshape(-1, 3, 4)).reshape(-1, 12)
        cameras = np.column_stack([pose, np.tile(PARAMS[model], (n, 1))])
        X = truth.Q[:, :3] + 0.01 * rng.standard_normal((m, 3))
        project = camera_model(model).kernel("project", "numpy")
        q = project(cameras.T[:, graph.view], truth.Q[graph.point, :3].T)[0]
        q, estimate, scale = q + 3.0 * rng.standard_normal(q.shape), (cameras, X), 4.0
    parts = {
        "graph": graph,
        "q": np.ascontiguousarray(q),
        "weights": weights,
        "loss": Loss(loss, scale),
    }
    return parts, estimate


def both(model: str, parts: dict[str, Any], workers: int = 1) -> Linearizers:
    """Return both ways of evaluating."""
    camera = camera_model(model)
    native = NativeLinearizer(camera, *parts.values(), workers)
    return native, NumpyLinearizer(camera, kernels.table("numpy"), *parts.values())


def relative(actual: Array, expected: Array) -> float:
    """Return the largest difference, relative to the largest entry."""
    size = np.abs(expected).max()
    return distance(actual / size, expected / size)


def roots(V: Array) -> Array:
    """Return inverse roots of definite blocks near V."""
    size = np.einsum("mii->m", V)[:, None, None] / V.shape[1]
    return numpy_linearizer.inverse_roots(V, size * np.eye(V.shape[1]), 0.01, V[:, 0])[0]


@pytest.mark.parametrize("model", MODELS)
class TestParts:
    @pytest.mark.parametrize(
        ("shape", "loss"),
        [(shape, "linear") for shape in SHAPES]
        + [(shape, loss) for loss in LOSSES if loss != "linear" for shape in SHAPES[::4]],
        ids=str,
    )
    def test_costs_blocks_and_gradient(self, model: str, shape: tuple, loss: str) -> None:
        parts, estimate = scene_of(model, *shape, loss=loss)
        native, reference = both(model, parts)
        expected = reference.point_costs(*estimate)
        assert relative(native.point_costs(*estimate), expected) < 1e-12
        a, b = native.linearize(*estimate), reference.linearize(*estimate)
        for name in ("U", "V", "g_cameras", "g_points"):
            assert relative(getattr(a, name), getattr(b, name)) < 1e-12
        assert (a.depth_blocks is None) == (model != "projective")
        for x, y in zip(a.depth_blocks or (), b.depth_blocks or (), strict=True):
            assert relative(x, y) < 1e-12
        found = native.with_loss(Loss("cauchy", 1e-3)).point_costs(*estimate)
        assert (
            relative(found, reference.with_loss(Loss("cauchy", 1e-3)).point_costs(*estimate))
            < 1e-12
        )

    @pytest.mark.parametrize("shape", SHAPES, ids=str)
    def test_distances_and_residuals(self, model: str, shape: tuple) -> None:
        parts, estimate = scene_of(model, *shape)
        native, reference = both(model, parts)
        assert relative(native.residuals(*estimate), reference.residuals(*estimate)) < 1e-10
        a, b = (each.distances(*estimate) for each in (native, reference))
        assert relative(np.sort(a), np.sort(b)) < 1e-10

    @pytest.mark.parametrize("loss", ["linear", "cauchy", "truncated"])
    @pytest.mark.parametrize("iterations", [1, 2, 5])
    def test_refinement_of_points(self, model: str, loss: str, iterations: int) -> None:
        how = PointRefinement(iterations=iterations)
        for shape in SHAPES:
            parts, (cameras, points) = scene_of(model, *shape, loss=loss)
            (a, costs_a), (b, costs_b) = (
                each.refine_points(cameras, points, how) for each in both(model, parts)
            )
            # Points of two views are determined to rounding times the condition of their block;
            # where a loss ends, rounding may decide.
            assert loss == "truncated" or distance(a, b) < 1e-6
            assert relative(costs_a, costs_b) < 1e-7

    @pytest.mark.parametrize("shape", SHAPES, ids=str)
    def test_coupling(self, model: str, shape: tuple) -> None:
        parts, estimate = scene_of(model, *shape)
        normals = [each.linearize(*estimate) for each in both(model, parts)]
        a, b = (normal.coupling for normal in normals)
        rng = np.random.default_rng(0)
        x = rng.standard_normal(normals[0].g_cameras.shape)
        y = rng.standard_normal(normals[0].g_points.shape)
        T = roots(normals[1].V)
        T[1] = 0.0  # a frozen point
        for root in (None, T):
            assert relative(a.to_points(root, x), b.to_points(root, x)) < 1e-10
            assert relative(a.to_cameras(root, y), b.to_cameras(root, y)) < 1e-10
        assert relative(a.diagonal(T), b.diagonal(T)) < 1e-10
        (P_a, right_a), (P_b, right_b) = (each.schur(T, y) for each in (a, b))
        assert relative(right_a, right_b) < 1e-10
        assert (a.schur(T, None)[1] == 0.0).all()
        assert relative(P_a.dense(), P_b.dense()) < 1e-10
        columns = rng.standard_normal((*x.shape, 2))
        assert relative(P_a.times(columns), P_b.times(columns)) < 1e-10
        n, d = x.shape
        for A in (None, np.eye(d)[:, : d - 2] + 0.1 * rng.standard_normal((n, d, d - 2))):
            white = normals[1].U if A is None else A.swapaxes(1, 2) @ normals[1].U @ A
            size = np.einsum("nii->n", white)[:, None, None]
            white = white + size * np.eye(white.shape[1])
            right = rng.standard_normal((n, white.shape[1], 3))
            found, expected = (each.factor(white, A).solve(right) for each in (P_a, P_b))
            assert relative(found, expected) < 1e-9
            with pytest.raises(np.linalg.LinAlgError):
                P_a.factor(-white, A)

    @pytest.mark.parametrize("lam", [0.0, 0.1])
    def test_inverse_roots(self, model: str, lam: float) -> None:
        parts, estimate = scene_of(model, 5, 101, 0.5)
        native, reference = both(model, parts)
        normal = reference.linearize(*estimate)
        V = normal.V + np.eye(normal.V.shape[1]) * np.einsum("mii->m", normal.V)[:, None, None]
        D = np.tile(np.eye(V.shape[1]), (len(V), 1, 1))
        found, expected = (
            each.inverse_roots(V, D, lam, normal.g_points) for each in (native, reference)
        )
        for a, b in zip(found, expected, strict=True):
            assert relative(a, b) < 1e-12
        with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
            native.inverse_roots(-V, D, 0.0, normal.g_points)


def test_intersections() -> None:
    for shape in SHAPES:
        parts, (cameras, _) = scene_of("projective", *shape)
        a, b = (each.intersect(cameras) for each in both("projective", parts))
        sign = np.sign(np.sum(a * b, axis=1, keepdims=True))
        # Squaring eight times leaves (ratio of the two least eigenvalues)^256 of the second vector.
        assert distance(a * sign, b) < 1e-6


@pytest.mark.parametrize("workers", [1, 2])
def test_cameras_in_any_order_give_the_same_steps(
    workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lanes, "_SHARE", 1.0)
    # A sequence whose views are numbered at random, with few of them together.
    rng = np.random.default_rng(1)
    n, m = 60, 800
    truth = many_views.cameras_and_points(n, m)
    begin = rng.integers(0, n - 5, m)
    point = np.repeat(np.arange(m), 6)
    view = (begin[:, None] + np.arange(6)).ravel()
    h = np.einsum("kij,kj->ki", truth.P[view], truth.Q[point])
    xy = h[:, :2] / h[:, 2:] + rng.standard_normal((len(view), 2))
    mixed = rng.permutation(n)
    tracks = eg.Tracks(np.argsort(mixed)[view], point, xy, n_views=n)
    problem = many_views.problem_of(tracks)
    problem.workers = workers
    state = problem.evaluate(many_views.in_units(eg.Reconstruction(truth.P[mixed], truth.Q)))
    system = problem.linearize(state)
    native = problem.inner.linearizer
    assert isinstance(native, NativeLinearizer)
    assert native.skyline.blocks < 0.5 * Skyline.full(n).blocks
    problem.kernels = kernels.table("numpy")
    reference = problem.linearize(state)
    assert relative(system.U, reference.U) < 1e-12
    assert relative(system.normal.g_cameras, reference.normal.g_cameras) < 1e-10
    step, expected = (np.asarray(Covariant().step(each, 1e-3)) for each in (system, reference))
    assert relative(step, expected) < 1e-7


def test_a_shuffled_band_is_found_again() -> None:
    rng = np.random.default_rng(0)
    n, width = 80, 4
    band = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= width
    mixed = rng.permutation(n)
    skyline, order = narrow(band[np.ix_(mixed, mixed)])
    assert order is not None
    assert sorted(order) == list(range(n))
    assert skyline.blocks <= 1.5 * narrow(band)[0].blocks
    assert narrow(band)[1] is None


@pytest.fixture(scope="module")
def scene() -> tuple[eg.Tracks, eg.Reconstruction]:
    truth = many_views.cameras_and_points(5, 60)
    tracks = many_views.observed(truth, seen=0.8)
    return tracks, many_views.shaken(eg.initialize(tracks), 0.02)


def assert_same_history(a: eg.BundleResult, b: eg.BundleResult, tolerance: float = 1e-8) -> None:
    assert (a.status, a.nfev, a.njev) == (b.status, b.nfev, b.njev)
    for x, y in zip(a.history, b.history, strict=True):
        assert x.accepted == y.accepted
        assert x.cost == pytest.approx(y.cost, rel=tolerance)
        assert x.lam == pytest.approx(y.lam, rel=1e-6)
        assert x.step_norm == pytest.approx(y.step_norm, rel=1e-3)


class TestRuns:
    @pytest.mark.parametrize("method", STRATEGIES)
    def test_every_method_takes_the_same_steps(self, scene: Any, method: str) -> None:
        runs = [
            eg.bundle_adjust(*scene, method=method, backend=backend, ftol=1e-6, max_iter=30)
            for backend in ("c", "numpy")
        ]
        assert_same_history(*runs)

    @pytest.mark.parametrize("loss", sorted(set(LOSSES) - {"linear"}))
    @pytest.mark.parametrize("schedule", ["classic", "nielsen"])
    def test_every_loss_takes_the_same_steps(self, scene: Any, loss: str, schedule: str) -> None:
        tracks, _ = many_views.with_gross_errors(scene[0])
        options: dict[str, Any] = {"loss": loss, "schedule": schedule, "ftol": 1e-6}
        runs = [
            eg.bundle_adjust(tracks, scene[1], backend=backend, **options)
            for backend in ("c", "numpy")
        ]
        assert_same_history(*runs)

    @pytest.mark.parametrize("mode", ["explicit", "implicit"])
    @pytest.mark.parametrize("damping", ["levenberg", "marquardt", "covariant"])
    def test_gauges(self, scene: Any, mode: str, damping: str) -> None:
        options: dict[str, Any] = {
            "method": "levenberg",
            "gauge": eg.gauge.reference_camera(),
            "gauge_mode": mode,
            "damping": damping,
            "ftol": 1e-6,
        }
        runs = [eg.bundle_adjust(*scene, backend=b, **options) for b in ("c", "numpy")]
        assert_same_history(*runs)

    def test_initialisation(self) -> None:
        tracks = many_views.observed(many_views.cameras_and_points(6, 80), seen=0.7)
        starts = [eg.initialize(tracks, backend=backend) for backend in ("c", "numpy")]
        pixels = [start.project(tracks) for start in starts]
        # The rounds of a robust scale stop at changes of 1e-8.
        assert distance(*pixels) < 1e-3

    def test_resection_and_basis(self) -> None:
        parts, (_, Q) = scene_of("projective", 2, 41, 1.0)
        rows = parts["graph"].view == 1
        found = [resect(kernels.table(b), parts["q"][:, rows], Q.T) for b in ("c", "numpy")]
        assert distance(*(camera * np.sign(camera[2, 3]) for camera in found)) < 1e-6
        bases = []
        for backend in ("c", "numpy"):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(scatter, "backend", lambda backend=backend: backend)
                bases.append(scatter.spreading_basis(Q))
                flat = Q * [1.0, 1.0, 1.0, 0.0]
                assert np.isfinite(scatter.spreading_basis(flat)).all()
        assert relative(*bases) < 1e-10


class TestHostileInput:
    def test_a_point_in_a_focal_plane_costs_infinity_and_the_others_move(self) -> None:
        parts, (cameras, Q) = scene_of("projective", 4, 20, 1.0)
        Q[7] = 0.0  # on every focal plane
        for each in both("projective", parts):
            costs = each.point_costs(cameras, Q)
            assert not np.isfinite(costs[7])
            assert np.isfinite(np.delete(costs, 7)).all()
            moved, after = each.refine_points(cameras, Q, PointRefinement())
            np.testing.assert_array_equal(moved[7], Q[7])
            others = np.arange(20) != 7
            assert (after[others] < costs[others]).all()

    @pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
    def test_what_is_not_finite_is_rejected_quietly(self, bad: float) -> None:
        problem, state, _ = many_views.small_system()
        problem.embedded = True
        step = np.zeros(state.P.size + state.Q.size)
        step[3] = bad
        assert problem.evaluate(problem.retract(state, step)).cost >= state.cost

    @pytest.mark.parametrize("model", MODELS)
    def test_no_weight_at_all_for_a_point(self, model: str) -> None:
        parts, estimate = scene_of(model)
        parts["weights"][parts["graph"].point == 5] = 0.0
        native, reference = both(model, parts)
        assert native.point_costs(*estimate)[5] == 0.0
        a, b = (each.linearize(*estimate).V[5] for each in (native, reference))
        assert relative(a, b) < 1e-12

    @pytest.mark.parametrize("model", MODELS)
    def test_arrays_of_any_order_and_read_only(self, model: str) -> None:
        parts, (cameras, points) = scene_of(model)
        expected = both(model, parts)[0].linearize(cameras, points)
        cameras, points = np.asfortranarray(cameras), points[::-1].copy()[::-1]
        for array in (cameras, points):
            array.setflags(write=False)
        found = both(model, parts)[0].linearize(cameras, points)
        np.testing.assert_array_equal(found.U, expected.U)
        x = expected.g_cameras
        y = [each.coupling.to_points(None, x) for each in (found, expected)]
        np.testing.assert_array_equal(*y)


class TestThreads:
    @pytest.fixture(autouse=True)
    def _small_problems_are_shared_too(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(lanes, "_SHARE", 1.0)

    @pytest.mark.parametrize("workers", [2, 3, 64])
    @pytest.mark.parametrize("model", MODELS)
    def test_parts_are_the_same_to_rounding(self, model: str, workers: int) -> None:
        parts, estimate = scene_of(model, 6, 500, 0.5, loss="huber")
        one, many = both(model, parts)[0], both(model, parts, workers)[0]
        np.testing.assert_array_equal(one.point_costs(*estimate), many.point_costs(*estimate))
        a, b = (each.linearize(*estimate) for each in (one, many))
        np.testing.assert_array_equal(a.V, b.V)
        assert relative(b.U, a.U) < 1e-13
        T = roots(a.V)
        (P_a, right_a), (P_b, right_b) = (x.coupling.schur(T, a.g_points) for x in (a, b))
        assert relative(P_b.dense(), P_a.dense()) < 1e-12
        assert relative(right_b, right_a) < 1e-12
        how = PointRefinement()
        np.testing.assert_array_equal(
            one.refine_points(*estimate, how)[0], many.refine_points(*estimate, how)[0]
        )

    @staticmethod
    def laid(parts: dict[str, Any]) -> LaneLayout:
        return both("projective", parts)[0].layout

    def test_shares_cover_all_chunks_once(self) -> None:
        laid = self.laid(scene_of("projective", 12, 300, 0.3)[0])
        for workers in (1, 2, 5, 1000):
            for shares in laid.shares(workers):
                assert [begin for begin, _ in shares] == [0, *(end for _, end in shares[:-1])]
                assert shares[-1][1] == len(laid.lanes) - 1
                assert len(shares) <= workers

    def test_little_work_is_not_shared(self, monkeypatch: pytest.MonkeyPatch) -> None:
        laid = self.laid(scene_of("projective", 5, 100, 1.0)[0])
        assert [len(shares) for shares in laid.shares(2)] == [2, 2]
        monkeypatch.undo()
        whole = [(0, len(laid.lanes) - 1)]
        assert laid.shares(2) == laid.shares(64) == (whole, whole)

    def test_shares_are_of_equal_work_for_the_pass_they_are_for(self) -> None:
        # Half of the observations in long tracks: these have most of the pairs.
        lengths = np.repeat([20, 2], [100, 1000])
        first = np.concatenate([[0], np.cumsum(lengths)])
        point = np.repeat(np.arange(len(lengths)), lengths)
        graph = ObservationGraph(np.arange(len(point)) - first[point], point, 20, len(lengths))
        N = len(point)
        laid = self.laid(
            {"graph": graph, "q": np.zeros((2, N)), "weights": np.ones(N), "loss": Loss()}
        )
        passes, pairs = laid.shares(2)
        rows, slots = np.diff(laid.rows), np.diff(laid.rows) // np.diff(laid.lanes)
        by_rows = [rows[slice(*own)].sum() for own in passes]
        by_pairs = [(rows * slots)[slice(*own)].sum() for own in pairs]
        assert by_rows[0] > 1.2 * by_rows[1]  # points cost something, too
        assert max(by_pairs) < 3.0 * min(by_pairs)
        assert pairs[0][1] < passes[0][1]

    def test_no_pass_outlives_the_call_that_waits_for_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(lanes, "_SHARE", 1.0)
        parts, _ = scene_of("projective", 6, 500, 0.5)
        ended: list[slice] = []

        def interrupted(points: slice) -> None:
            if points.start == 0:
                raise KeyboardInterrupt
            time.sleep(0.2)
            ended.append(points)

        with pytest.raises(KeyboardInterrupt):
            both("projective", parts, 2)[0].passes.over(500, interrupted)
        assert ended == [slice(250, 500)]

    def test_threads_end_with_the_problem(self, scene: Any) -> None:
        before = set(threading.enumerate())
        eg.bundle_adjust(*scene, workers=2)
        for thread in set(threading.enumerate()) - before:
            thread.join(5.0)
            assert not thread.is_alive()

    def test_runs_are_deterministic_for_a_number_of_workers(self, scene: Any) -> None:
        tracks = many_views.observed(many_views.cameras_and_points(5, 400))
        start = eg.initialize(tracks)
        a, b = (eg.bundle_adjust(tracks, start, workers=2) for _ in range(2))
        np.testing.assert_array_equal(a.reconstruction.P, b.reconstruction.P)
        np.testing.assert_array_equal(a.reconstruction.Q, b.reconstruction.Q)
        assert_same_history(a, eg.bundle_adjust(tracks, start))

    def test_runs_side_by_side_do_not_disturb_each_other(self, scene: Any) -> None:
        expected = [eg.bundle_adjust(*scene, loss=loss) for loss in ("linear", "cauchy")]
        with ThreadPoolExecutor(4) as pool:
            pending = [
                pool.submit(eg.bundle_adjust, *scene, loss=loss)
                for loss in ("linear", "cauchy") * 4
            ]
        for k, future in enumerate(pending):
            found = future.result()
            assert [row.cost for row in found.history] == [
                row.cost for row in expected[k % 2].history
            ]

    @pytest.mark.parametrize("workers", [0, -1, 1.5, True, "2"])
    def test_bad_numbers_are_refused(self, scene: Any, workers: Any) -> None:
        with pytest.raises(ValueError, match="workers"):
            eg.bundle_adjust(*scene, workers=workers)

    def test_bad_numbers_are_refused_before_the_work(
        self, scene: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(adjust, "initialize", pytest.fail)
        with pytest.raises(ValueError, match="workers"):
            eg.bundle_adjust(scene[0], workers=0)


def test_neither_jacobians_nor_couplings_are_stored() -> None:
    truth = many_views.cameras_and_points(10, 3000)
    tracks = many_views.observed(truth)
    problem = many_views.problem_of(tracks, embedded=True)
    state, inner = problem.evaluate(many_views.in_units(truth)).inner, problem.inner
    Covariant().step(inner.linearize(state), 1e-3)
    tracemalloc.start()
    system = inner.linearize(state)
    inner.evaluate(inner.retract(state, Covariant().step(system, 1e-3)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Blocks of points, 3000 x (4, 4) a few times over; one coupling alone would be 384 bytes.
    assert peak < 100 * len(tracks)
