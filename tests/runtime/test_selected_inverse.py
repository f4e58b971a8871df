"""Selected inversion: blocks of a skyline, of a network, and of its points, as by dense algebra."""

from __future__ import annotations

import ctypes
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge._library import address
from epigauge._native import PANEL, Blocks, checked, function
from epigauge.bundle import lanes
from epigauge.bundle.jobs import metric_job
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.skyline import Skyline
from epigauge.two_view.losses import Loss
from epigauge.uncertainty.datum import projection
from epigauge.uncertainty.inverse import Inverse, Motions, Part
from numpy.typing import NDArray

from tests.metric_scenes import METRIC, metric_scene

Array = NDArray[np.float64]

needs_c = pytest.mark.skipif(
    kernels.available()["c"] is not None, reason=f"back end c {kernels.available()['c']}"
)


@needs_c
@pytest.mark.parametrize("n", [1, 2, 7, 40])
@pytest.mark.parametrize("shape", ["full", "band", "arrow", "ragged", "apart"])
def test_blocks_within_a_skyline_are_those_of_the_inverse(n: int, shape: str) -> None:
    rng, own = np.random.default_rng(n), np.arange(n)
    first = {
        "full": 0 * own,
        "band": np.maximum(own - 3, 0),
        "arrow": np.where(own == n - 1, 0, own),
        "ragged": rng.integers(0, own + 1),
        "apart": own // 5 * 5,
    }[shape]
    panels = Skyline.of(first)
    rows, columns = panels.places
    S = np.zeros((n, n, PANEL, PANEL))
    S[rows, columns] = rng.standard_normal((panels.blocks, PANEL, PANEL))
    dense = S.transpose(0, 2, 1, 3).reshape(n * PANEL, n * PANEL)
    dense = np.tril(dense) @ np.tril(dense).T / n  # within the skyline as well
    dense += np.eye(len(dense))
    blocks = dense.reshape(n, PANEL, n, PANEL).transpose(0, 2, 3, 1)  # columns of entries first
    Z = np.ascontiguousarray(blocks[rows, columns])
    assert not function("envelope_factor")(panels.reference, address(Z))
    checked(function("envelope_invert")(panels.reference, address(Z)))
    inverse = np.linalg.inv(dense).reshape(n, PANEL, n, PANEL).transpose(0, 2, 3, 1)
    np.testing.assert_allclose(Z, inverse[rows, columns], atol=1e-12 * np.abs(inverse).max())


@needs_c
@pytest.mark.parametrize(("a", "d"), [(3, 5), (6, 9), (9, 9), (12, 12), (13, 14)])
def test_blocks_of_views_are_taken_out_of_panels(a: int, d: int) -> None:
    rng, views = np.random.default_rng(a), Skyline.of(np.array([0, 0, 1, 1, 3, 0, 4]))
    n = views.n
    panels = views.panels(a)
    whole = rng.standard_normal((PANEL * panels.n, PANEL * panels.n))
    whole += whole.T
    rows, columns = panels.places
    Z = whole.reshape(panels.n, PANEL, panels.n, PANEL).transpose(0, 2, 3, 1)[rows, columns]
    Z, A, K = np.ascontiguousarray(Z), rng.standard_normal((n, d, a)), rng.random((n, d, 2))
    unknowns = whole[: n * a, : n * a].reshape(n, a, n, a).transpose(0, 2, 1, 3)
    for own, width, root in ((A, d, K), (None, a, K[:, :a])):
        root, how = np.ascontiguousarray(root), Blocks.dense(min(a, d) if own is None else width)
        if own is None and a > d:
            continue
        X = np.empty((views.blocks, how.d, how.d))
        function("skyline_spread")(
            *(views.reference, panels.reference, ctypes.byref(how), a, address(own), 2),
            *map(address, (root, Z, X)),
        )
        expected = unknowns if own is None else own[:, None] @ unknowns @ np.swapaxes(own, 1, 2)
        expected = expected + np.einsum("idk,jek->ijde", root, root)
        t, s = views.places
        np.testing.assert_allclose(X, expected[s, t], atol=1e-12 * np.abs(expected).max())


class Network:
    """The normal equations of a scene at a back end, their inverse, and all as dense arrays."""

    def __init__(
        self, tracks: eg.Tracks, scene: eg.MetricReconstruction, backend: str, **options: Any
    ) -> None:
        choices: dict[str, Any] = {
            "refine": "all",
            "fixed_views": (),
            "fixed_points": (),
            "priors": None,
        }
        job = metric_job(tracks, scene, **(choices | options))
        table, weights = kernels.table(backend), np.asarray(tracks.weights)
        graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
        home: Any
        home, *self.at = best_conditioned(job.model, job.cameras, job.points)
        priors = None if job.priors is None else job.priors.moved(home)
        problem = bundle_problem(
            *(job.model, table, graph, job.q, weights), freedom=job.freedom, priors=priors
        )
        self.system = problem.linearize(problem.evaluate(Estimate(*self.at)))
        self.reference = NumpyLinearizer(job.model, table, graph, job.q, weights, Loss())
        motions = Motions.of(self.system, priors, table)
        self.inverse = Inverse.of(self.system, self.reference, priors, motions)
        self.n, self.d = self.system.normal.g_cameras.shape
        self.m = tracks.n_points

    def flat(self, cameras: Array, points: Array) -> Array:
        """Return columns as one matrix."""
        n, d, k = cameras.shape
        return np.concatenate([cameras.reshape(n * d, k), points.reshape(3 * len(points), k)])

    @property
    def normal(self) -> Array:
        """Return J^T J and what is known beside it, in own tangents."""
        normal, (n, d, m) = self.system.normal, (self.n, self.d, self.m)
        W = np.zeros((n, m, d, 3))
        graph = self.reference.graph
        np.add.at(W, (graph.view, graph.point), self.reference.coupling_blocks(*self.at))
        whole = np.zeros((n * d + 3 * m,) * 2)
        across = W.transpose(0, 2, 1, 3).reshape(n * d, 3 * m)
        whole[: n * d, n * d :], whole[n * d :, : n * d] = across, across.T
        for i in range(n):
            whole[i * d : (i + 1) * d, i * d : (i + 1) * d] = normal.U[i]
        for j in range(m):
            own = slice(n * d + 3 * j, n * d + 3 * j + 3)
            whole[own, own] = normal.V[j]
        if self.system.constraints is not None:
            B = self.flat(*self.system.constraints)
            whole += B @ B.T
        return whole

    @property
    def basis(self) -> Array:
        """Return own tangents by unknowns."""
        ties, (n, d, m) = self.system.ties, (self.n, self.d, self.m)
        a = d if ties.A is None else ties.A.shape[2]
        x, s = np.eye(n * a).reshape(n, a, -1), np.eye(ties.n_shared)
        of_views = ties.cameras(x, np.zeros((ties.n_shared, n * a))).reshape(n * d, -1)
        shared = ties.cameras(np.zeros((n, a, ties.n_shared)), s).reshape(n * d, -1)
        y = ties.points(np.broadcast_to(np.eye(3), (m, 3, 3)))
        of_points = np.zeros((3 * m, 3 * m))
        for j in range(m):
            of_points[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = y[j]
        columns = [np.hstack([of_views, shared]), of_points]
        top, bottom = columns[0].shape[1], columns[1].shape[1]
        return np.block(
            [
                [columns[0], np.zeros((n * d, bottom))],
                [np.zeros((3 * m, top)), columns[1]],
            ]
        )

    def pinv(self) -> Array:
        """Return a generalised inverse by the eigenvalues of the dense matrix, all of one size."""
        B = self.basis
        B = B[:, B.any(axis=0)]
        N = B.T @ self.normal @ B
        size = 1.0 / np.sqrt(np.diagonal(N))
        values, vectors = np.linalg.eigh(size[:, None] * N * size)
        free = self.inverse.motions.open.shape[1]
        assert values[free] > 1e-9 > 1e3 * np.abs(values[:free]).max(initial=0.0)
        root = B @ (size[:, None] * vectors[:, free:] / np.sqrt(values[free:]))
        return np.asarray(root @ root.T)

    def blocks(self) -> tuple[Array, Array]:
        """Return X from its blocks, one by one, and from products with columns."""
        inverse, (n, d, m) = self.inverse, (self.n, self.d, self.m)
        size = n * d + 3 * m
        eye = np.eye(size)
        product = self.flat(
            *inverse.apply(eye[: n * d].reshape(n, d, -1), eye[n * d :].reshape(m, 3, -1))
        )
        parts: list[Part] = [*((i, None) for i in range(n)), *((None, j) for j in range(m))]
        found = np.block([[inverse.block(a, b) for b in parts] for a in parts])
        for i, block in enumerate(inverse.diagonals[0]):
            found[d * i : d * i + d, d * i : d * i + d] = block
        for j, block in enumerate(inverse.diagonals[1]):
            own = slice(n * d + 3 * j, n * d + 3 * j + 3)
            found[own, own] = block
        return found, product

    def in_datum(self, X: Array) -> Array:
        """Return S X S^T for inner constraints of all points, as far as the gauge is open."""
        motions = self.inverse.motions
        G = self.flat(*motions.along(motions.open))
        C = np.where(np.arange(len(G))[:, None] < self.n * self.d, 0.0, G)
        S = np.eye(len(X)) - G @ np.linalg.solve(C.T @ G, C.T)
        return np.asarray(S @ X @ S.T)


def near(found: Array, expected: Array, rtol: float) -> None:
    """Assert that covariances agree, relative to the deviations of both numbers."""
    std = np.sqrt(np.maximum(np.diagonal(expected), 0.0))
    std = np.maximum(std, 1e-9 * std.max())
    assert (np.abs(found - expected) <= rtol * np.outer(std, std)).all()


def twice(tracks: eg.Tracks, count: int) -> eg.Tracks:
    """Return tracks with second sightings of some points in the views that have them."""
    again = np.r_[np.arange(len(tracks)), np.arange(count)]
    order = np.lexsort((tracks.view[again], tracks.point[again]))
    rows = again[order]
    return eg.Tracks(tracks.view[rows], tracks.point[rows], tracks.xy[rows], repeated=True)


def cases() -> dict[str, Any]:
    """Return networks: tracks, scene and options."""
    found: dict[str, Any] = {}
    for model in METRIC:
        names = tuple(model_focal(model))
        tracks, scene = metric_scene(model, 3, n_points=16)
        found[model] = tracks, scene, {"refine": names or "pose"}
    tracks, scene = metric_scene("OPENCV", 4, n_points=20, n_views=5)
    gps = [eg.PositionPrior(i, scene.centres[i], sigma=0.1) for i in range(4)]
    bar = [eg.Distance(2, 5, float(np.linalg.norm(scene.X[2] - scene.X[5])), 0.003)]
    points = [eg.PointPrior(j, scene.X[j], sigma=(0.01, 0.02, 0.05)) for j in (0, 3, 8)]
    intrinsics = {"refine": ("fx", "fy")}
    found["positions"] = tracks, scene, intrinsics | {"priors": [*gps, *bar]}
    found["a bar"] = tracks, scene, intrinsics | {"priors": bar}
    found["control points"] = tracks, scene, intrinsics | {"priors": points}
    found["fixed"] = tracks, scene, {"refine": "pose", "fixed_views": [1], "fixed_points": [4, 5]}
    found["all views fixed"] = tracks, scene, {"refine": "pose", "fixed_views": range(5)}
    found["all points fixed"] = tracks, scene, {"refine": "pose", "fixed_points": range(20)}
    found["seen twice"] = twice(tracks, 30), scene, intrinsics
    # Two groups of views with one common point, each tied to the ground.
    tracks, scene = metric_scene("PINHOLE", 5, n_points=24, n_views=6, n_cameras=1, visible=1.0)
    rows = ((tracks.view < 3) == (tracks.point < 12)) | (tracks.point == 0)
    apart = eg.Tracks(tracks.view[rows], tracks.point[rows], tracks.xy[rows])
    ground = [eg.PointPrior(j, scene.X[j], sigma=0.01) for j in (0, 1, 2, 3, 12, 13, 14, 15)]
    found["two groups"] = apart, scene, {"refine": ("f",), "priors": ground}
    return found


def model_focal(model: str) -> list[str]:
    """Return the names of the focal lengths."""
    from epigauge.cameras import camera_model

    known = camera_model(model)
    return [known.params[k] for k in known.focal]


CASES = cases()


@pytest.mark.parametrize("backend", ["numpy", pytest.param("c", marks=needs_c)])
@pytest.mark.parametrize("name", CASES)
def test_all_blocks_are_those_of_a_dense_pseudo_inverse(name: str, backend: str) -> None:
    tracks, scene, options = CASES[name]
    net = Network(tracks, scene, backend, **options)
    blocks, product = net.blocks()
    near(blocks, product, 1e-9)
    expected = net.in_datum(net.pinv())
    near(net.in_datum(blocks), expected, 1e-9)
    low = projection("inner", *net.at, net.inverse)
    L = net.flat(low.cameras, low.points)
    near(blocks + L @ low.M @ L.T, expected, 1e-9)


def chain(n: int, window: int, seed: int = 0) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return views in any order, of which only neighbours of a chain share points."""
    whole, scene = metric_scene(
        "SIMPLE_RADIAL", seed, n_views=n, n_points=4 * n, n_cameras=3, visible=1.0
    )
    rng = np.random.default_rng(seed)
    place = rng.permutation(n)[whole.view] - (whole.point // 4) * (n - window) // (n - 1)
    rows = (place >= 0) & (place < window)
    return eg.Tracks(whole.view[rows], whole.point[rows], whole.xy[rows], min_points=2), scene


@needs_c
def test_views_far_apart_in_a_chain_have_blocks_too() -> None:
    """Outside the skyline, which is narrow, and in every datum: as the dense reference."""
    tracks, scene = chain(60, 6)
    options: dict[str, Any] = {"refine": ("f", "k"), "noise_px": 1.0}
    found = eg.covariance(tracks, scene, backend="c", **options)
    expected = eg.covariance(tracks, scene, backend="numpy", **options)
    stored = [found._inverse.blocks.block(0, k) is not None for k in range(60)]
    assert sum(stored) < 20
    parts = [("camera", 0), ("camera", 31), ("camera", 59), ("intrinsics", 1), ("point", 7)]
    for gauge in ("inner", eg.gauge.two_cameras(3, 40), eg.gauge.inner(views=[1, 2, 30, 41])):
        c, reference = found.in_gauge(gauge), expected.in_gauge(gauge)
        near(c.joint(parts), reference.joint(parts), 1e-9)
        for name in ("rotations", "centres", "intrinsics", "points"):
            one, other = getattr(c.std, name) ** 2, getattr(reference.std, name) ** 2
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * other.max())


@needs_c
def test_threads_give_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanes, "_SHARE", 1.0)
    tracks, scene = chain(60, 8)
    net = Network(tracks, scene, "c", refine="pose")
    T, blocks = net.inverse.T, net.inverse.blocks
    weights = np.asarray(tracks.weights)
    parts = net.reference.model, net.reference.graph, net.reference.q, weights, Loss()
    columns = range(6)
    many = [NativeLinearizer(*parts, workers, columns) for workers in (1, 2, 5)]
    assert len(many[2].passes.edges[1]) == 6
    found = [own.linearize(*net.at).coupling.marginals(T, blocks, True) for own in many]
    for own in found[1:]:
        for one, other in zip(found[0], own, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("backend", ["numpy", pytest.param("c", marks=needs_c)])
def test_what_nothing_determines_is_told(backend: str) -> None:
    """A view with a single point, or intrinsics that a point cannot tell, have no inverse."""
    tracks, scene = metric_scene("PINHOLE", 2, n_points=20, n_views=5, visible=1.0)
    rows = (tracks.view != 4) | (tracks.point < 2)
    few = eg.Tracks(tracks.view[rows], tracks.point[rows], tracks.xy[rows], min_points=2)
    with pytest.raises(eg.ArgumentError, match="not determined"):
        eg.covariance(few, scene, noise_px=1.0, refine="pose", backend=backend)
