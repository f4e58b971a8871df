"""The loops in C for every camera model, both routes, any chunk, width and skyline."""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
import pytest
from epigauge import _native, kernels, lm
from epigauge.bundle import lanes
from epigauge.bundle.dampings import Covariant, Levenberg
from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import Linearizer, PointRefinement, point_damping
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.skyline import Skyline, narrow
from epigauge.bundle.ties import Ties
from epigauge.cameras import CameraModel, camera_model, models
from epigauge.distributed import fused
from epigauge.errors import BackendError
from epigauge.two_view.losses import LOSSES, Loss
from laws import distance

Array = np.ndarray[Any, np.dtype[np.float64]]

if kernels.available()["c"] is not None:
    pytest.skip("back end c " + str(kernels.available()["c"]), allow_module_level=True)

MODELS = list(models())

#: Cameras, points, share seen: padded lanes, one chunk, points of two views, long tracks, ragged.
SHAPES = [(4, 20, 0.7), (3, 6, 1.0), (5, 101, 0.01), (70, 30, 0.5), (12, 300, 0.3)]

#: A value of every parameter of a camera that sees a scene at a distance of six units well.
_FOCAL = {"f": 500.0, "fx": 510.0, "fy": 490.0, "c": 500.0, "cx": 320.0, "cy": 240.0, "R0": 100.0}
#: Coefficients of `brown` multiply powers of the radius in pixels.
_FOCAL |= {"A1": 1e-8, "A2": 1e-14, "A3": 1e-20, "B1": 1e-6, "B2": 1e-6}
_SMALL = 1e-3


class Scene(NamedTuple):
    """Observations and an estimate."""

    model: CameraModel
    graph: ObservationGraph
    q: Array
    weights: Array
    cameras: Array
    points: Array

    def native(self, loss: Loss, **options: Any) -> NativeLinearizer:
        """Return the evaluation in C."""
        return NativeLinearizer(self.model, self.graph, self.q, self.weights, loss, **options)

    def reference(self, loss: Loss) -> NumpyLinearizer:
        """Return the evaluation in NumPy."""
        table = kernels.table("numpy")
        return NumpyLinearizer(self.model, table, self.graph, self.q, self.weights, loss)

    def loss(self, name: str) -> Loss:
        """Return a loss whose scale is about the noise."""
        return Loss(name, 0.01 if self.model.homogeneous else 1.0)


def scene(
    name: str, n: int, m: int, seen: float, *, seed: int = 0, repeated: int = 0, gross: int = 0
) -> Scene:
    """Return cameras around points, away from the minimum; some observations have no weight.

    `repeated` observations come twice, the last `gross` points have gross errors.
    """
    model, rng = camera_model(name), np.random.default_rng(seed)
    turned = np.linalg.qr(np.eye(3) + 0.2 * rng.standard_normal((n, 3, 3)))[0]
    R = turned * np.linalg.det(turned)[:, None, None]
    R = R * np.sign(np.einsum("nii->ni", R))[:, :, None]
    R *= np.linalg.det(R)[:, None, None]
    ahead = -6.0 if model.name in ("bal", "brown", "brown_measured") else 6.0
    t = 0.3 * rng.standard_normal((n, 3)) + [0.0, 0.0, ahead]
    P, X = np.concatenate([R, t[:, :, None]], axis=2), rng.uniform(-1.0, 1.0, (m, 3))
    if not model.metric:
        P = np.diag([2.0, 2.0, 1.0]) @ P
        if not model.homogeneous:
            P[:, 2] = [0.0, 0.0, 0.0, 1.0]
    values = [_FOCAL.get(name, _SMALL) for name in model.params]
    cameras = np.hstack([P.reshape(n, 12), np.tile(values, (n, 1))])
    points = np.column_stack([X, np.ones(m)]) if model.homogeneous else X
    mask = rng.random((n, m)) < seen
    for j in np.flatnonzero(mask.sum(axis=0) < 2):
        mask[rng.choice(n, 2, replace=False), j] = True
    mask[~mask.any(axis=1), 0] = True
    point, view = np.nonzero(mask.T)
    again = rng.choice(len(point), repeated, replace=False)
    point, view = np.concatenate([point, point[again]]), np.concatenate([view, view[again]])
    order = np.lexsort((view, point))
    view, point = view[order], point[order]
    project = model.kernel("project", "numpy")
    q = project(np.ascontiguousarray(cameras.T[:, view]), np.ascontiguousarray(points.T[:, point]))[
        0
    ]
    q += (0.5 if model.metric else 0.005) * rng.standard_normal(q.shape)
    q[:, point >= m - gross] += (50.0 if model.metric else 0.5) * rng.standard_normal(2)[:, None]
    weights = rng.uniform(0.5, 2.0, len(point)) * (rng.uniform(size=len(point)) > 0.05)
    points = points + 0.01 * rng.standard_normal(points.shape)
    graph = ObservationGraph(view, point, n, m)
    return Scene(model, graph, q, weights, cameras, points)


def relative(actual: Array, expected: Array) -> float:
    """Return the largest difference, relative to the largest entry."""
    size = np.abs(expected).max()
    return distance(actual / size, expected / size)


def roots(at: Scene, linearizer: Linearizer, lam: float = 0.1) -> tuple[Array, Array]:
    """Return inverse roots of damped points, and what they make of the gradient."""
    normal = at.reference(linearizer.loss).linearize(at.cameras, at.points)
    depth = None if normal.depth_blocks is None else normal.depth_blocks[1]
    damping = point_damping(at.model, normal.V, depth)
    T, half = linearizer.inverse_roots(normal.V, damping, lam, normal.g_points)
    # They are roots to the condition of each point, in which two back ends differ.
    blocks = normal.V + lam * damping
    off = np.swapaxes(T, 1, 2) @ blocks @ T - np.eye(T.shape[1])
    assert np.max(np.abs(off).max(axis=(1, 2)) / np.linalg.cond(blocks)) < 1e-14
    assert relative(half, np.einsum("mij,mi->mj", T, normal.g_points)) < 1e-14
    return T, half


def assert_same(at: Scene, loss: Loss, **options: Any) -> None:
    """Compare every part of both evaluations."""
    native, reference = at.native(loss, **options), at.reference(loss)
    C, X = at.cameras, at.points
    assert relative(native.point_costs(C, X), reference.point_costs(C, X)) < 1e-12
    assert relative(native.residuals(C, X), reference.residuals(C, X)) < 1e-12
    a, b = native.linearize(C, X), reference.linearize(C, X)
    for name in ("U", "V", "g_cameras", "g_points"):
        assert relative(getattr(a, name), getattr(b, name)) < 1e-11, name
    T, half = roots(at, reference)
    for x, y in zip(roots(at, native), (T, half), strict=True):
        assert relative(x, y) < 1e-6  # a point of two views is determined to its condition
    (P, right), (P_b, right_b) = (part.coupling.schur(T, half) for part in (a, b))
    assert relative(P.dense(), P_b.dense()) < 1e-10
    assert relative(right, right_b) < 1e-10
    rng = np.random.default_rng(1)
    x, y = rng.standard_normal(b.g_cameras.shape), rng.standard_normal(X.shape)
    for root in (T, None):
        for name, vector in (("to_points", x), ("to_cameras", y)):
            pair = (getattr(part.coupling, name)(root, vector) for part in (a, b))
            assert relative(*pair) < 1e-10, name
        for name, vectors in (("to_points", x), ("to_cameras", y)):
            columns = np.stack([vectors, -2.0 * vectors, 0.1 * vectors], axis=2)
            pair = (getattr(part.coupling, name)(root, columns) for part in (a, b))
            assert relative(*pair) < 1e-10, name
    assert relative(a.coupling.diagonal(T), b.coupling.diagonal(T)) < 1e-10
    columns = np.stack([x, -2.0 * x], axis=2)
    assert relative(P.times(columns), P_b.times(columns)) < 1e-10
    n, d = x.shape
    A, right = 0.1 * rng.standard_normal((n, d, d - 1)), rng.standard_normal((n, d - 1, 2))
    size = np.abs(np.linalg.eigvalsh(P_b.dense().reshape(n * d, -1))).max() * d
    U = np.broadcast_to(size * np.eye(d - 1), (n, d - 1, d - 1))
    factors = P.factor(U, A), P_b.factor(U, A)
    assert relative(*(factor.solve(right) for factor in factors)) < 1e-10
    if not options.get("factored", at.model.homogeneous):
        assert_same_inverse(at, (a, b), factors, A, T)


def assert_same_inverse(
    at: Scene, normals: Any, factors: Any, A: Array, T: Array, rtol: float = 1e-10
) -> None:
    """Compare the blocks of the inverse that a skyline holds, and the points' own."""
    n, d, _ = A.shape
    K = 0.01 * A[:, :, :2]
    found, expected = (factor.inverse() for factor in factors)
    for one, other in zip(found.diagonals, expected.diagonals, strict=True):
        assert relative(one, other) < rtol
    X, X_b = found.spread(A, K), expected.spread(A, K)
    assert relative(X.diagonal, X_b.diagonal) < rtol
    seen = np.zeros((n, at.graph.n_points), np.bool_)
    seen[at.graph.view, at.graph.point] = True
    together = seen.astype(int) @ seen.T.astype(int) > 0
    size = np.abs(X_b.X).max()
    for i, k in np.ndindex(n, n):
        block = X.block(i, k)
        assert block is not None or not together[i, k]
        if block is not None:
            assert distance(block / size, X_b.block(i, k) / size) < rtol
    (own, across), (own_b, across_b) = (
        normal.coupling.marginals(T, blocks, coupled=True)
        for normal, blocks in zip(normals, (X, X_b), strict=True)
    )
    assert relative(own, own_b) < rtol
    assert relative(across, across_b) < 1e-6  # as the roots of points above
    alone, none = normals[0].coupling.marginals(T, X, coupled=False)
    np.testing.assert_array_equal(alone, own)
    assert not none.size
    for j in range(0, at.graph.n_points, 9):
        views, W = at.reference(Loss()).coupling_of(at.cameras, at.points, j)
        assert (np.diff(views) > 0).all()
        assert W.shape == (len(views), d, T.shape[1])


class TestParts:
    @pytest.mark.parametrize("name", MODELS)
    @pytest.mark.parametrize("shape", SHAPES, ids=str)
    def test_every_model_agrees_with_the_reference(self, name: str, shape: Any) -> None:
        at = scene(name, *shape)
        assert_same(at, at.loss("linear"))

    @pytest.mark.parametrize("name", ["bal", "projective"])
    @pytest.mark.parametrize("loss", sorted(set(LOSSES) - {"linear"}))
    def test_losses_with_gross_errors_in_the_last_chunk(self, name: str, loss: str) -> None:
        at = scene(name, 5, 200, 0.8, gross=3)
        assert_same(at, at.loss(loss))

    @pytest.mark.parametrize("shape", SHAPES, ids=str)
    def test_both_routes_of_projective_cameras_agree(self, shape: Any) -> None:
        at = scene("projective", *shape)
        assert_same(at, at.loss("linear"), factored=False)

    @pytest.mark.parametrize("m", [1, 7, 8, 9, 55, 56, 57, 64, 112, 113])
    def test_chunks_begin_and_end_anywhere(self, m: int) -> None:
        assert_same(at := scene("SIMPLE_RADIAL", 3, m, 1.0), at.loss("linear"))

    @pytest.mark.parametrize("name", ["bal", "projective"])
    @pytest.mark.parametrize("seen", [0.5, 1.0])
    def test_points_seen_twice_in_one_view(self, name: str, seen: float) -> None:
        at = scene(name, 4, 40, seen, repeated=30)
        assert_same(at, at.loss("linear"))

    @pytest.mark.parametrize("name", MODELS)
    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    @pytest.mark.parametrize("iterations", [1, 5])
    def test_refinement_of_points(self, name: str, loss: str, iterations: int) -> None:
        how = PointRefinement(iterations=iterations, lam=1e-4)
        at = scene(name, 6, 60, 0.6)
        pair = at.native(at.loss(loss)), at.reference(at.loss(loss))
        (_, costs), (_, costs_b) = (e.refine_points(at.cameras, at.points, how) for e in pair)
        assert relative(costs, costs_b) < 1e-8
        assert (costs <= pair[1].point_costs(at.cameras, at.points)).all()


class TestFusedPass:
    @pytest.mark.parametrize("name", ["bal", "SIMPLE_RADIAL", "FULL_OPENCV", "projective"])
    def test_without_pairs_all_else_has_the_same_bits(
        self, name: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        at = scene(name, 6, 60, 0.6)
        parts, shapes = (at.native(at.loss("linear")), at.cameras, at.points, 0.01), []

        def zeros(shape: tuple[int, ...]) -> Array:
            shapes.append(shape)
            return _native.aligned_zeros(shape)

        monkeypatch.setattr(fused, "aligned_zeros", zeros)
        whole, alone = fused.eliminate(*parts, pairs=True), fused.eliminate(*parts, pairs=False)
        assert whole.pairs is not None
        assert alone.pairs is None
        # Of many views, room for the pairs would be more than there is.
        assert [len(shape) for shape in shapes] == [2, 2, 2]
        for part in ("T", "half"):
            np.testing.assert_array_equal(getattr(alone, part), getattr(whole, part))
        for part in ("U", "V", "g_cameras", "g_points"):
            np.testing.assert_array_equal(getattr(alone.normal, part), getattr(whole.normal, part))


class TestColumns:
    @pytest.mark.parametrize("name", [name for name in MODELS if camera_model(name).params])
    @pytest.mark.parametrize("loss", ["linear", "huber"])
    def test_known_entries_have_no_rows(self, name: str, loss: str) -> None:
        at = scene(name, 12, 80, 0.4)
        last = at.model.tangent_size - 1
        for columns in (range(6), [1, 4, last]):
            native, reference = (
                at.native(at.loss(loss), columns=columns),
                at.reference(at.loss(loss)),
            )
            used = np.isin(np.arange(at.model.tangent_size), list(columns)).astype(float)
            a, b = (e.linearize(at.cameras, at.points) for e in (native, reference))
            assert relative(a.U, b.U * used[:, None] * used) < 1e-11
            assert relative(a.g_cameras, b.g_cameras * used) < 1e-11
            T, half = roots(at, reference)
            (P, right), (P_b, right_b) = (part.coupling.schur(T, half) for part in (a, b))
            assert relative(P.dense(), P_b.dense() * used[:, None, None] * used) < 1e-10
            assert relative(right, right_b * used) < 1e-10
            x = np.random.default_rng(1).standard_normal(a.g_cameras.shape)
            to_points = b.coupling.to_points(T, x * used)
            assert relative(a.coupling.to_points(T, x), to_points) < 1e-10
            assert (
                relative(
                    P.times(x[..., None])[..., 0], P_b.times((x * used)[..., None])[..., 0] * used
                )
                < 1e-10
            )
            A = np.zeros((12, len(used), 6))
            A[:, :, : len(list(columns))] = np.eye(len(used))[:, list(columns)]
            size = 12 * len(used) * np.abs(P_b.dense()).max()
            U = np.broadcast_to(size * np.eye(6), (12, 6, 6))
            right = x[:, :6, None]
            factors = P.factor(U, A), P_b.factor(U, A)
            assert relative(*(factor.solve(right) for factor in factors)) < 1e-10
            assert_same_inverse(at, (a, b), factors, A, T)


class TestHostileInput:
    @pytest.mark.parametrize("name", MODELS)
    def test_a_view_without_points_has_zeros(self, name: str) -> None:
        at = scene(name, 4, 40, 0.8)
        number = np.array([0, 1, 3, 4])
        graph = ObservationGraph(number[at.graph.view], at.graph.point, 5, 40)
        cameras = np.insert(at.cameras, 2, at.cameras[0], axis=0)
        native = NativeLinearizer(at.model, graph, at.q, at.weights, at.loss("linear"))
        a = native.linearize(cameras, at.points)
        b = at.native(at.loss("linear")).linearize(at.cameras, at.points)
        np.testing.assert_array_equal(a.U[number], b.U)
        assert not a.U[2].any()
        T, half = roots(at, native)
        P, right = a.coupling.schur(T, half)
        assert not P.dense()[2].any()
        assert not right[2].any()

    def test_singular_blocks_are_told(self) -> None:
        at = scene("bal", 4, 20, 1.0)
        native = at.native(at.loss("linear"))
        normal = native.linearize(at.cameras, at.points)
        with pytest.raises(np.linalg.LinAlgError, match="point"):
            native.inverse_roots(-normal.V, 0.0 * normal.V, 0.0, normal.g_points)
        pairs, _ = normal.coupling.schur(roots(at, native)[0], None)
        with pytest.raises(np.linalg.LinAlgError, match="reduced system"):
            pairs.factor(0.0 * normal.U, None)


class TestThreads:
    @pytest.fixture(autouse=True)
    def _small_problems_are_shared_too(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(lanes, "_SHARE", 1.0)

    @pytest.mark.parametrize("workers", [2, 3, 64])
    def test_the_same_number_gives_the_same_bits(self, workers: int) -> None:
        at = scene("bal", 6, 500, 0.5)

        def parts(workers: int) -> list[Array]:
            native = at.native(at.loss("huber"), workers=workers)
            normal = native.linearize(at.cameras, at.points)
            T, half = roots(at, native)
            pairs, right = normal.coupling.schur(T, half)
            moved, costs = native.refine_points(at.cameras, at.points, PointRefinement(lam=1e-4))
            return [moved, costs, normal.V, T, half, normal.U, pairs.dense(), right]

        first, again, one = parts(workers), parts(workers), parts(1)
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a, b)
        for a, b in zip(first[:5], one[:5], strict=True):
            np.testing.assert_array_equal(a, b)
        for a, b in zip(first[5:], one[5:], strict=True):
            assert relative(a, b) < 1e-12


class TestSkyline:
    @pytest.mark.parametrize("a", [1, 6, 7, 9, 12, 17])
    @pytest.mark.parametrize("n", [1, 2, 13])
    def test_factor_of_blocks_of_any_width(self, a: int, n: int) -> None:
        rng = np.random.default_rng(0)
        first = np.minimum(np.maximum(np.arange(n) - rng.integers(0, 4, n), 0), np.arange(n))
        skyline = Skyline.of(first)
        rows, columns = skyline.places
        blocks = rng.standard_normal((skyline.blocks, a, a))
        same = rows == columns
        blocks[same] = blocks[same] + np.swapaxes(blocks[same], 1, 2)
        P = np.zeros((n, n, a, a))
        P[columns, rows], P[rows, columns] = blocks, np.swapaxes(blocks, 1, 2)
        U = np.broadcast_to(20.0 * a * np.eye(a), (n, a, a)).copy()
        factor = skyline.factor(blocks, _native.Blocks.dense(a), U, None)
        S = -P
        S[np.arange(n), np.arange(n)] += U
        right = rng.standard_normal((3, n * a))
        expected = np.linalg.solve(S.transpose(0, 2, 1, 3).reshape(n * a, n * a), right.T).T
        assert relative(factor.solve(right), expected) < 1e-12

    def test_an_order_makes_a_ring_narrow(self) -> None:
        n = 60
        shuffled = np.random.default_rng(0).permutation(n)
        near = np.abs(shuffled[:, None] - shuffled)
        together = np.minimum(near, n - near) <= 2
        skyline, order = narrow(together)
        assert order is not None
        assert sorted(order) == list(range(n))
        assert skyline.work < 0.2 * Skyline.full(n).work
        rows, columns = skyline.places
        held = np.zeros((n, n), np.bool_)
        held[rows, columns] = held[columns, rows] = True
        assert (held | ~together[np.ix_(order, order)]).all()


def test_structures_of_another_size_are_refused() -> None:
    class Longer(ctypes.Structure):
        _fields_ = (*_native.Envelope._fields_, ("more", ctypes.c_double))

    _native.check_sizes({"eg_envelope": _native.Envelope})
    with pytest.raises(BackendError, match="eg_envelope"):
        _native.check_sizes({"eg_envelope": Longer})


class TestCompiledLoop:
    @pytest.mark.parametrize("name", ["projective", "bal", "OPENCV"])
    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    def test_it_takes_the_steps_of_the_readable_one(self, name: str, loss: str) -> None:
        at = scene(name, 5, 60, 0.8)
        problem = bundle_problem(
            at.model,
            kernels.table("c"),
            at.graph,
            at.q,
            at.weights,
            at.loss(loss),
            embedded=True,
            freedom=Freedom(),
        )
        stopping = lm.Stopping(ftol=1e-6, xtol=0.0, gtol=0.0, max_iter=30)
        start = Estimate(at.cameras, at.points)
        parts = start, Covariant(), lm.Classic(), stopping
        short = problem.compiled(*parts, 2.0, 1e-8)
        long = lm.minimize(problem, *parts, lambda _: False, 2.0)
        assert short is not None
        assert (short.nfev, short.njev, short.nit) == (long.nfev, long.njev, long.nit)
        assert short.status == long.status
        assert len(short.history) == short.nfev > 2
        for x, y in zip(short.history, long.history, strict=True):
            assert (x.iteration, x.accepted) == (y.iteration, y.accepted)
            assert x.cost == pytest.approx(y.cost, rel=1e-7)
            assert x.lam == pytest.approx(y.lam, rel=1e-12)
            assert x.step_norm == pytest.approx(y.step_norm, rel=1e-4)
        evaluated = problem.evaluate(short.state.estimate).cost
        assert short.state.cost == pytest.approx(evaluated, rel=1e-12)
        assert short.state.estimate.steps == long.state.estimate.steps

    def test_what_it_does_not_know_is_left_to_the_readable_one(self) -> None:
        at = scene("bal", 5, 60, 0.8)
        table, loss = kernels.table("c"), at.loss("linear")
        stopping, start = lm.Stopping(max_iter=3), Estimate(at.cameras, at.points)

        def compiled(damping: Any, schedule: Any, *, embedded: bool = True, **parts: Any) -> Any:
            own = at.model, table, at.graph, at.q, at.weights, loss
            problem = bundle_problem(*own, embedded=embedded, **parts)
            return problem.compiled(start, damping, schedule, stopping, 1.0, 1e-8)

        assert compiled(Covariant(), lm.Classic()) is not None
        assert compiled(Levenberg(), lm.Classic()) is None
        assert compiled(Covariant(), lm.Nielsen()) is None
        assert compiled(Covariant(), lm.Classic(), embedded=False) is None
        kept = Freedom(kept=np.ones(60, np.bool_))
        assert compiled(Covariant(), lm.Classic(), freedom=kept) is None
        fixed = Freedom(Ties(A=np.tile(np.eye(9)[:, :8], (5, 1, 1)) * 2.0))
        assert compiled(Covariant(), lm.Classic(), freedom=fixed) is None
