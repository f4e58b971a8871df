"""The accumulation in C against the NumPy reference: parts, steps, whole runs, threads."""

from __future__ import annotations

import threading
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels, scatter
from epigauge.multi_view import adjust, packing
from epigauge.multi_view import coupling as coupling_module
from epigauge.multi_view import envelope as envelope_module
from epigauge.multi_view.coupling import StoredCoupling, conjugate_gradients
from epigauge.multi_view.dampings import Covariant
from epigauge.multi_view.engine import Normal, Reference, Triangulation
from epigauge.multi_view.envelope import Envelope, narrow
from epigauge.multi_view.fused import Fused
from epigauge.multi_view.layout import Layout
from epigauge.multi_view.problem import BundleProblem, Linearized
from epigauge.multi_view.resection import resect
from epigauge.multi_view.strategies import STRATEGIES
from epigauge.two_view.losses import LOSSES, Loss
from laws import distance

Array = many_views.Array

if kernels.available()["c"] is not None:
    pytest.skip("back end c " + str(kernels.available()["c"]), allow_module_level=True)

#: Cameras, points, share seen: padded lanes, a single chunk, points of two views, long tracks.
SHAPES = [(4, 20, 0.7), (3, 6, 1.0), (5, 101, 0.01), (70, 30, 0.5), (12, 300, 0.3)]


def problem_and_estimate(
    n: int = 4, m: int = 20, seen: float = 0.7, *, loss: str = "linear", seed: int = 0
) -> tuple[BundleProblem, tuple[Array, Array]]:
    """Return a problem away from its minimum, with weights some of which are zero."""
    truth = many_views.cameras_and_points(n, m, seed=seed)
    tracks = many_views.observed(truth, 3.0, seen=seen, seed=seed)
    problem = many_views.problem_of(tracks, loss=Loss(loss, 0.004))
    rng = np.random.default_rng(seed)
    problem.weights = rng.uniform(0.5, 2.0, len(tracks)) * (rng.uniform(size=len(tracks)) > 0.05)
    return problem, many_views.in_units(many_views.shaken(truth, seed=seed))


def engines(problem: BundleProblem, workers: int = 1) -> tuple[Fused, Reference]:
    """Return both ways of evaluating a problem."""
    parts = (problem.layout, problem.q, problem.weights, problem.loss)
    return Fused(*parts, workers), Reference(kernels.table("numpy"), *parts)


def relative(actual: Array, expected: Array) -> float:
    """Return the largest difference, relative to the largest entry."""
    size = np.abs(expected).max()
    return distance(actual / size, expected / size)


def damped(normal: Normal, layout: Any) -> Linearized:
    """Return a definite system made of normal equations."""
    system = Linearized(layout, normal.U, normal.V, normal.coupling, *normal[3:5])
    sizes = [np.einsum("nii->n", blocks)[:, None, None] for blocks in (system.U, system.V)]
    cameras, points = (0.01 * size * np.eye(k) for size, k in zip(sizes, (12, 4), strict=True))
    found = system.damped(cameras, points)
    assert isinstance(found, Linearized)
    return found


@pytest.fixture(params=SHAPES, ids=str)
def both(request: pytest.FixtureRequest) -> tuple[Linearized, Linearized]:
    """Return the same definite system, coupled in C and by the reference."""
    problem, estimate = problem_and_estimate(*request.param)
    fused, stored = (damped(e.linearize(*estimate), problem.layout) for e in engines(problem))
    return fused, stored


class TestParts:
    @pytest.mark.parametrize("loss", LOSSES)
    @pytest.mark.parametrize("shape", SHAPES, ids=str)
    def test_costs_blocks_and_gradient(self, shape: tuple, loss: str) -> None:
        problem, (P, Q) = problem_and_estimate(*shape, loss=loss)
        fused, reference = engines(problem)
        assert relative(fused.point_costs(P, Q), reference.point_costs(P, Q)) < 1e-12
        a, b = fused.linearize(P, Q), reference.linearize(P, Q)
        for name in ("U", "V", "g_cameras", "g_points"):
            assert relative(getattr(a, name), getattr(b, name)) < 1e-12
        for x, y in zip(fused.depth_blocks(P, Q), reference.depth_blocks(P, Q), strict=True):
            assert relative(x, y) < 1e-12

    @pytest.mark.parametrize("shape", SHAPES, ids=str)
    def test_distances_and_intersections(self, shape: tuple) -> None:
        problem, (P, Q) = problem_and_estimate(*shape)
        fused, reference = engines(problem)
        a, b = fused.distances(P, Q), reference.distances(P, Q)
        assert relative(np.sort(a), np.sort(b)) < 1e-12
        a, b = fused.intersected(P), reference.intersected(P)
        sign = np.sign(np.sum(a * b, axis=1, keepdims=True))
        # Squaring eight times leaves (ratio of the two least eigenvalues)^256 of the second vector.
        assert distance(a * sign, b) < 1e-6

    @pytest.mark.parametrize("loss", ["linear", "cauchy", "truncated"])
    @pytest.mark.parametrize("iterations", [1, 2, 5])
    def test_triangulation(self, loss: str, iterations: int) -> None:
        how = Triangulation(iterations=iterations)
        for shape in SHAPES:
            problem, (P, Q) = problem_and_estimate(*shape, loss=loss)
            (Q_a, costs_a), (Q_b, costs_b) = (e.triangulated(P, Q, how) for e in engines(problem))
            # Points of two views are determined to rounding times the condition of their block.
            assert distance(Q_a, Q_b) < 1e-6
            assert relative(costs_a, costs_b) < 1e-7

    def test_a_point_alone_is_moved_as_among_others(self) -> None:
        problem, (P, Q) = problem_and_estimate(5, 60, 0.8)
        layout = problem.layout
        together = engines(problem)[0].triangulated(P, Q, Triangulation())[0]
        for point in (0, 13, 59):
            rows = slice(layout.first[point], layout.first[point + 1])
            view = layout.view[rows]
            alone = Fused(
                type(layout)(view, np.zeros(len(view), np.intp), 5, 1),
                problem.q[:, rows],
                problem.weights[rows],
                problem.loss,
            )
            moved = alone.triangulated(P, Q[point : point + 1], Triangulation())[0]
            least = alone._packed.bundle(Loss()).least, engines(problem)[0]._packed.bundle(Loss())
            if least[0] == least[1].least:
                np.testing.assert_array_equal(moved[0], together[point])
            else:  # the least weight is relative to the largest of all
                assert distance(moved[0], together[point]) < 1e-7


class TestCoupling:
    def test_products(self, both: tuple[Linearized, Linearized]) -> None:
        fused, stored = both
        rng = np.random.default_rng(0)
        n, m = len(stored.U), len(stored.V)
        x, y = rng.standard_normal((n, 12, 2)), rng.standard_normal((m, 4, 2))
        a, b = fused.coupling, stored.coupling
        assert isinstance(b, StoredCoupling)
        assert relative(a.blocks(), b.blocks()) < 1e-12
        assert relative(a.times_points(y), b.times_points(y)) < 1e-12
        assert relative(a.times_cameras(x), b.times_cameras(x)) < 1e-12
        A, C = rng.standard_normal((n, 12, 9)), rng.standard_normal((m, 4, 3))
        a, b = a.transformed(A, C), b.transformed(A, C)
        assert relative(a.blocks(), b.blocks()) < 1e-12
        assert relative(a.times_points(y[:, :3]), b.times_points(y[:, :3])) < 1e-12
        assert relative(a.times_cameras(x[:, :9]), b.times_cameras(x[:, :9])) < 1e-12
        a, b = (c.transformed(A[:, :9, :7], C[:, :3]) for c in (a, b))
        assert relative(a.blocks(), b.blocks()) < 1e-12

    @pytest.mark.parametrize(
        ("moved", "columns"), [(False, (12, 4)), (True, (12, 4)), (True, (9, 3))]
    )
    def test_reduced_system(
        self, both: tuple[Linearized, Linearized], moved: bool, columns: tuple[int, int]
    ) -> None:
        rng = np.random.default_rng(1)
        n, m = len(both[0].U), len(both[0].V)
        changes = (
            np.eye(12)[:, : columns[0]] + 0.1 * rng.standard_normal((n, 12, columns[0])),
            np.eye(4)[:, : columns[1]] + 0.1 * rng.standard_normal((m, 4, columns[1])),
        )
        a, b = (each.transformed(*changes) if moved else each for each in both)
        roots = b.coupling.inverse_roots(b.V)
        assert relative(a.coupling.inverse_roots(a.V), roots) < 1e-8
        S_a, S_b = (each.coupling.reduced(b.U, roots) for each in (a, b))
        assert relative(S_a.matrix(), S_b.matrix()) < 1e-10
        assert relative(S_a.diagonal(), S_b.diagonal()) < 1e-10
        x = rng.standard_normal((n, columns[0], 2))
        assert relative(S_a.times(x[..., 0]), S_b.times(x[..., 0])) < 1e-10
        # By a factor: what the condition of S leaves.
        assert relative(S_a.solve(x), S_b.solve(x)) < 1e-6
        assert relative(a.solve(), b.solve()) < 1e-6

    def test_steps(self, both: tuple[Linearized, Linearized]) -> None:
        fused, stored = both
        W = (fused.U + np.eye(12), fused.V + np.eye(4))
        for lam in (1e-3, 1.0):
            step = fused.whitened_step(W, lam)
            expected = stored.whitened_step(W, lam)
            assert relative(step, expected) < 1e-7
            # The promise that comes with the step is what the model says.
            told = fused.predicted(step)
            assert told == pytest.approx(stored.predicted(expected), rel=1e-6)
            assert told == pytest.approx(replace(fused).predicted(step), rel=1e-6)

    def test_a_system_that_is_not_definite_is_told(self) -> None:
        problem, estimate = problem_and_estimate()
        fused, _ = engines(problem)
        normal = fused.linearize(*estimate)
        system = Linearized(problem.layout, *normal[:5])
        ones = np.broadcast_to(np.eye(12), normal.U.shape), np.broadcast_to(np.eye(4), (20, 4, 4))
        for W in ((ones[0], -ones[1]), (-ones[0], ones[1]), (np.nan * ones[0], ones[1])):
            with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
                system.whitened_step(W, 1e-3)
        negative = replace(system, U=-system.U).damped(ones[0], ones[1])
        with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
            negative.solve()


class TestEnvelope:
    @pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 30])
    @pytest.mark.parametrize("width", [1, 3, 40])
    def test_factor_solves_within_a_ragged_envelope(self, n: int, width: int) -> None:
        rng = np.random.default_rng(n)
        first = np.maximum(0, np.arange(n) - rng.integers(0, width, n))
        envelope = Envelope.of(first)
        S = rng.standard_normal((12 * n, 12 * n))
        S = S + S.T + 40.0 * np.sqrt(n) * np.eye(12 * n)
        blocks = S.reshape(n, 12, n, 12).transpose(0, 2, 1, 3)
        inside = np.arange(n) >= first[:, None]
        inside = inside & (np.arange(n)[:, None] >= np.arange(n))
        packed = np.ascontiguousarray(np.swapaxes(blocks[inside], 1, 2))
        whole = envelope.whole(packed)
        outside = ~(inside | inside.T)
        assert (whole[outside] == 0.0).all()
        np.testing.assert_array_equal(whole[~outside], blocks[~outside])
        dense = whole.transpose(0, 2, 1, 3).reshape(12 * n, 12 * n)
        right = rng.standard_normal((n, 12, 2))
        pairs, U = np.zeros((envelope.blocks, 112)), whole[np.arange(n), np.arange(n)]
        # Without pairs there are only the diagonal blocks.
        found = envelope.solved(pairs, np.ascontiguousarray(U), None, right)
        assert relative(found, np.linalg.solve(U, right)) < 1e-13
        x = np.ascontiguousarray(right.reshape(12 * n, 2).T)
        native = envelope_module.function
        assert native("envelope_factor")(envelope.reference, packed.ctypes.data) == 0
        native("envelope_solve")(envelope.reference, packed.ctypes.data, 2, x.ctypes.data)
        assert relative(x.T, np.linalg.solve(dense, right.reshape(12 * n, 2))) < 1e-12

    def test_a_shuffled_band_is_found_again(self) -> None:
        rng = np.random.default_rng(0)
        n, width = 80, 4
        band = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= width
        mixed = rng.permutation(n)
        envelope, order = narrow(band[np.ix_(mixed, mixed)])
        assert order is not None
        assert sorted(order) == list(range(n))
        assert envelope.blocks <= 1.5 * narrow(band)[0].blocks
        assert narrow(band)[1] is None

    @pytest.mark.parametrize("workers", [1, 2])
    def test_cameras_in_any_order_give_the_same_steps(
        self, workers: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(packing, "_SHARE", 1.0)
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
        estimate = many_views.in_units(eg.Reconstruction(truth.P[mixed], truth.Q))
        state = problem.evaluate(estimate)
        system = problem.linearize(state)
        fused = problem.engine
        assert isinstance(fused, Fused)
        assert fused.order is not None
        assert fused.envelope.blocks < 0.5 * Envelope.full(n).blocks
        reference = problem.by_observation.linearize(*estimate)
        assert relative(system.U, reference.U) < 1e-12
        assert relative(system.g_cameras, reference.g_cameras) < 1e-10
        stored = replace(system, W=reference.coupling)
        W = Covariant().matrix(system)
        expected = stored.whitened_step(W, 1e-3)
        assert relative(system.whitened_step(W, 1e-3), expected) < 1e-7
        roots = stored.coupling.inverse_roots(system.V + W[1])
        U = system.U + W[0]
        a, b = (each.coupling.reduced(U, roots) for each in (system, stored))
        assert relative(a.matrix(), b.matrix()) < 1e-9
        assert relative(a.diagonal(), b.diagonal()) < 1e-9
        x = rng.standard_normal((n, 12))
        assert relative(a.times(x), b.times(x)) < 1e-9
        # And without storing the reduced system at all.
        monkeypatch.setattr(coupling_module, "DENSE_CAMERAS", 0)
        assert relative(system.whitened_step(W, 1e-3), expected) < 1e-6
        y = conjugate_gradients(a, x)
        assert relative(a.times(y), x) < 1e-6


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
        problem, (_, Q) = problem_and_estimate(2, 41, 1.0)
        rows = problem.layout.view == 1
        found = [resect(kernels.table(b), problem.q[:, rows], Q.T) for b in ("c", "numpy")]
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
        problem, (P, Q) = problem_and_estimate(4, 20, 1.0)
        Q[7] -= P[2, 2] * (P[2, 2] @ Q[7]) / (P[2, 2] @ P[2, 2])
        Q[7] = np.round(Q[7] * 0.0)  # on every focal plane
        for engine in engines(problem):
            costs = engine.point_costs(P, Q)
            assert not np.isfinite(costs[7])
            assert np.isfinite(np.delete(costs, 7)).all()
            moved, after = engine.triangulated(P, Q, Triangulation())
            np.testing.assert_array_equal(moved[7], Q[7])
            others = np.arange(20) != 7
            assert (after[others] < costs[others]).all()
        assert problem.evaluate((P, Q)).cost == np.inf

    @pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
    def test_what_is_not_finite_is_rejected_quietly(self, bad: float) -> None:
        problem, (P, Q) = problem_and_estimate()
        problem.embedded = True
        state = problem.evaluate((P, Q))
        step = np.zeros(P.size + Q.size)
        step[3] = bad
        assert problem.evaluate(problem.retract(state, step)).cost >= state.cost

    def test_points_at_infinity(self) -> None:
        problem, (P, Q) = problem_and_estimate()
        Q[::3, 3] = 0.0
        fused, reference = engines(problem)
        assert relative(fused.linearize(P, Q).V, reference.linearize(P, Q).V) < 1e-12

    def test_no_weight_at_all_for_a_point(self) -> None:
        problem, (P, Q) = problem_and_estimate()
        weights = problem.weights.copy()
        weights[problem.layout.point == 5] = 0.0
        problem.weights = weights
        fused, reference = engines(problem)
        assert fused.point_costs(P, Q)[5] == 0.0
        assert relative(fused.linearize(P, Q).V[5], reference.linearize(P, Q).V[5]) < 1e-12

    def test_arrays_of_any_order_and_read_only(self) -> None:
        problem, (P, Q) = problem_and_estimate()
        expected = problem.linearize(problem.evaluate((P, Q)))
        P, Q = np.asfortranarray(P), Q[::-1].copy()[::-1]
        for array in (P, Q):
            array.setflags(write=False)
        found = problem.linearize(problem.evaluate((P, Q)))
        np.testing.assert_array_equal(found.U, expected.U)
        np.testing.assert_array_equal(
            Covariant().step(found, 1e-3), Covariant().step(expected, 1e-3)
        )


class TestThreads:
    @pytest.fixture(autouse=True)
    def _small_problems_are_shared_too(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(packing, "_SHARE", 1.0)

    @pytest.mark.parametrize("workers", [2, 3, 64])
    def test_parts_are_the_same_to_rounding(self, workers: int) -> None:
        problem, (P, Q) = problem_and_estimate(6, 500, 0.5, loss="huber")
        one, many = engines(problem)[0], engines(problem, workers)[0]
        np.testing.assert_array_equal(one.point_costs(P, Q), many.point_costs(P, Q))
        a, b = (damped(engine.linearize(P, Q), problem.layout) for engine in (one, many))
        np.testing.assert_array_equal(a.V, b.V)
        assert relative(b.U, a.U) < 1e-13
        W = (a.U, a.V)
        assert relative(b.whitened_step(W, 1.0), a.whitened_step(W, 1.0)) < 1e-9
        how = Triangulation()
        np.testing.assert_array_equal(
            one.triangulated(P, Q, how)[0], many.triangulated(P, Q, how)[0]
        )

    def test_shares_cover_all_chunks_once(self) -> None:
        problem, _ = problem_and_estimate(12, 300, 0.3)
        packed = packing.Packed(problem.layout, problem.q, problem.weights)
        for workers in (1, 2, 5, 1000):
            for shares in packed.shares(workers):
                assert [begin for begin, _ in shares] == [0, *(end for _, end in shares[:-1])]
                assert shares[-1][1] == len(packed.lanes) - 1
                assert len(shares) <= workers

    def test_little_work_is_not_shared(self, monkeypatch: pytest.MonkeyPatch) -> None:
        problem, _ = problem_and_estimate(5, 100, 1.0)
        packed = packing.Packed(problem.layout, problem.q, problem.weights)
        assert [len(shares) for shares in packed.shares(2)] == [2, 2]
        monkeypatch.undo()
        whole = [(0, len(packed.lanes) - 1)]
        assert packed.shares(2) == packed.shares(64) == (whole, whole)

    def test_two_chunks_are_shared_by_two(self) -> None:
        problem, _ = problem_and_estimate(3, 112, 1.0)
        packed = packing.Packed(problem.layout, problem.q, problem.weights)
        assert packed.shares(2) == ([(0, 1), (1, 2)], [(0, 1), (1, 2)])

    def test_shares_are_of_equal_work_for_the_pass_they_are_for(self) -> None:
        # Half of the observations in long tracks: these have most of the pairs.
        lengths = np.repeat([20, 2], [100, 1000])
        first = np.concatenate([[0], np.cumsum(lengths)])
        point = np.repeat(np.arange(len(lengths)), lengths)
        layout = Layout(np.arange(len(point)) - first[point], point, 20, len(lengths))
        packed = packing.Packed(layout, np.zeros((2, len(point))), np.ones(len(point)))
        passes, pairs = packed.shares(2)
        rows, slots = np.diff(packed.rows), np.diff(packed.rows) // np.diff(packed.lanes)
        by_rows = [rows[slice(*own)].sum() for own in passes]
        by_pairs = [(rows * slots)[slice(*own)].sum() for own in pairs]
        assert by_rows[0] > 1.2 * by_rows[1]  # points cost something, too
        assert max(by_pairs) < 3.0 * min(by_pairs)
        assert pairs[0][1] < passes[0][1]

    def test_no_pass_outlives_the_call_that_waits_for_it(self) -> None:
        problem, _ = problem_and_estimate(6, 500, 0.5)
        ended: list[int] = []

        def interrupted(k: int, *_: int) -> int:
            if k == 0:
                raise KeyboardInterrupt
            time.sleep(0.2)
            ended.append(k)
            return 0

        with pytest.raises(KeyboardInterrupt):
            engines(problem, 2)[0]._share([(0, 1), (1, 2)], interrupted)
        assert ended == [1]

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
    problem = many_views.problem_of(tracks)
    problem.embedded = True
    state = problem.evaluate(many_views.in_units(truth))
    Covariant().step(problem.linearize(state), 1e-3)
    tracemalloc.start()
    system = problem.linearize(state)
    problem.evaluate(problem.retract(state, Covariant().step(system, 1e-3)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Blocks of points, 3000 x (4, 4) a few times over; one coupling alone would be 384 bytes.
    assert peak < 100 * len(tracks)
