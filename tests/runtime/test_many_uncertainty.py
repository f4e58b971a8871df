"""Covariance with gauge freedom: against dense algebra, in every gauge, and by simulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.errors import ArgumentError
from epigauge.multi_view import datum
from epigauge.multi_view.gauge import Transformation
from laws import central_differences, distance

Array = many_views.Array

GAUGES: dict[str, Any] = {
    "reference_camera": eg.gauge.reference_camera(),
    "reference_camera 2": eg.gauge.reference_camera(2),
    "two_cameras": eg.gauge.two_cameras(),
    "two_cameras 3 1": eg.gauge.two_cameras(3, 1),
    "five_points": eg.gauge.five_points(),
    "five_points given": eg.gauge.five_points([3, 7, 11, 19, 2]),
    "normalized": eg.gauge.normalized(),
    "identity": eg.gauge.identity(),
}


@dataclass
class Small:
    """A small adjusted scene in units in which pixels are of order one."""

    tracks: eg.Tracks
    found: eg.Reconstruction
    N: Array


@pytest.fixture(scope="module", params=range(2))
def small(request: pytest.FixtureRequest) -> Small:
    truth = many_views.cameras_and_points(4, 20, seed=request.param)
    tracks = many_views.observed(truth, seen=0.8, seed=request.param)
    weights = np.random.default_rng(request.param).uniform(0.5, 2.0, len(tracks))
    # Three millionths of a pixel are as good as a minimum; pixels are in units of 100 from the
    # image centre, for the sake of the dense reference.
    xy = (tracks.xy - [320.0, 240.0]) / 100.0
    tracks = eg.Tracks(tracks.view, tracks.point, xy, weights=weights)
    found = eg.bundle_adjust(tracks, ftol=1e-13).reconstruction
    there = eg.gauge.normalized().transformation(found.P, found.Q)
    found = eg.Reconstruction(*there.apply(found.P, found.Q))
    return Small(tracks, found, normal_matrix(tracks, found))


def normal_matrix(tracks: eg.Tracks, found: eg.Reconstruction) -> Array:
    problem = many_views.problem_of(tracks, scale=1.0)
    return many_views.dense(problem.linearize(problem.evaluate((found.P, found.Q))))


def pseudo_inverse(N: Array, n: int, m: int) -> Array:
    values, vectors = np.linalg.eigh(N)
    kept = slice(15 + n + m, None)
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)


def relative(found: Array, expected: Array) -> float:
    size = np.abs(expected).max()
    return distance(found / size, expected / size)


class TestFree:
    def test_free_gauge_is_the_pseudo_inverse(self, small: Small) -> None:
        n, m = small.tracks.n_views, small.tracks.n_points
        found = eg.covariance(small.tracks, small.found, noise_px=0.01)
        expected = 1e-4 * pseudo_inverse(small.N, n, m)
        # The reference loses the condition of N from its digits.
        assert relative(found.dense(), expected) < 1e-6

    def test_blocks_are_those_of_the_dense_matrix(self, small: Small) -> None:
        n, m = small.tracks.n_views, small.tracks.n_points
        for gauge in (None, *GAUGES.values()):
            found = eg.covariance(small.tracks, small.found, gauge, noise_px=0.3)
            full = found.dense()
            assert relative(found.all_cameras, full[: 12 * n, : 12 * n]) < 1e-9
            size = np.abs(found.cameras).max()
            for i in range(n):
                rows = slice(12 * i, 12 * (i + 1))
                assert distance(found.cameras[i] / size, full[rows, rows] / size) < 1e-9
            size = np.abs(found.points).max()
            for j in range(m):
                rows = slice(12 * n + 4 * j, 12 * n + 4 * (j + 1))
                assert distance(found.points[j] / size, full[rows, rows] / size) < 1e-9

    def test_noise_is_estimated_from_the_residuals(self, small: Small) -> None:
        tracks, found = small.tracks, small.found
        r = tracks.xy - found.project(tracks)
        squares = np.sum(tracks.weights[:, None] * r**2)
        redundancy = 2 * len(tracks) - 11 * tracks.n_views - 3 * tracks.n_points + 15
        noise = eg.covariance(tracks, found).noise_px
        assert noise == pytest.approx(np.sqrt(squares / redundancy), rel=1e-9)
        twice, once = (eg.covariance(tracks, found, noise_px=s).points for s in (2.0, 1.0))
        assert relative(twice, 4.0 * once) < 1e-12

    @pytest.mark.parametrize("seed", range(3))
    def test_estimated_noise_is_the_simulated_one(self, seed: int) -> None:
        truth = many_views.cameras_and_points(5, 100, seed=seed)
        tracks = many_views.observed(truth, 0.7, seed=seed)
        found = eg.covariance(tracks, eg.bundle_adjust(tracks).reconstruction)
        # 660 redundant observations: the relative deviation is 1 / sqrt(1320).
        assert found.noise_px == pytest.approx(0.7, rel=0.1)


class TestProjector:
    @pytest.mark.parametrize("name", GAUGES)
    def test_is_a_projector_along_the_gauge_freedom(self, small: Small, name: str) -> None:
        found = eg.covariance(small.tracks, small.found, GAUGES[name])
        n, m = small.tracks.n_views, small.tracks.n_points
        size = 12 * n + 4 * m
        S = found.projector.apply(np.eye(size))
        N = normal_matrix(small.tracks, found.reconstruction)
        G = np.hstack(gauge_directions(found.reconstruction))
        scale = np.abs(S).max()
        assert np.abs(S @ G).max() < 1e-9 * scale * np.abs(G).max()
        assert relative(S @ S, S) < 1e-8 * scale
        assert relative(N @ S, N) < 1e-7
        assert np.linalg.matrix_rank(S, tol=1e-7 * scale) == size - 15 - n - m
        vector = np.arange(float(size))
        assert relative(found.projector.apply(vector), S @ vector) < 1e-9

    @pytest.mark.parametrize("name", GAUGES)
    def test_is_the_derivative_of_moving_into_the_gauge(self, small: Small, name: str) -> None:
        gauge = GAUGES[name]
        # So little noise that the scale of H* in two_cameras is far from its kink
        found = eg.covariance(small.tracks, small.found, gauge, noise_px=1e-4)
        P, Q = found.reconstruction.P, found.reconstruction.Q
        if isinstance(gauge, eg.gauge.five_points) and gauge.points is None:
            gauge = eg.gauge.five_points(gauge.choose(Q))
        size = P.size + Q.size
        rng = np.random.default_rng(0)
        for _ in range(5):
            motion = rng.standard_normal(size)

            def moved(t: Array, motion: Array = motion) -> Array:
                other = (
                    P + t * motion[: P.size].reshape(P.shape),
                    Q + t * motion[P.size :].reshape(Q.shape),
                )
                there = gauge.transformation(*other).apply(*other)
                # A gauge may leave signs open.
                return np.concatenate(
                    [
                        (a * np.sign(np.sum(a * b, axis=-1, keepdims=True))).ravel()
                        for a, b in zip(
                            (there[0].reshape(len(P), 12), there[1]),
                            (P.reshape(len(P), 12), Q),
                            strict=True,
                        )
                    ]
                )

            derivative = central_differences(lambda t: moved(t), np.array(0.0), 1e-5).ravel()
            expected = found.projector.apply(motion)
            if isinstance(gauge, eg.gauge.identity | eg.gauge.normalized):
                # What is left open has least norm: the derivative is another such motion.
                derivative = found.projector.apply(derivative)
            assert relative(derivative, expected) < 1e-6

    @pytest.mark.parametrize("name", GAUGES)
    def test_takes_the_free_covariance_to_the_gauge(self, small: Small, name: str) -> None:
        found = eg.covariance(small.tracks, small.found, GAUGES[name], noise_px=1e-4)
        there = eg.covariance(small.tracks, found.reconstruction, noise_px=found.noise_px)
        S = found.projector
        assert relative(S.apply(S.apply(there.dense()).T), found.dense()) < 1e-7

    @pytest.mark.parametrize("name", GAUGES)
    def test_the_way_to_a_gauge_does_not_matter(self, small: Small, name: str) -> None:
        direct = eg.covariance(small.tracks, small.found, GAUGES[name])
        around = eg.covariance(small.tracks, small.found, eg.gauge.two_cameras(2, 0))
        around = around.in_gauge(eg.gauge.normalized()).in_gauge(GAUGES[name])
        if name in ("normalized", "identity"):  # an orthonormal basis or all is open
            assert relative(around.projections, direct.projections) < 1e-9
            return
        # Two bases of one gauge may differ in the direction of the last axis.
        errors = []
        for axis in (1.0, -1.0):
            turned = Transformation(np.diag([1.0, 1.0, 1.0, axis]), np.ones(4), np.ones(20))
            cameras, points = turned.blocks()
            C = cameras @ around.cameras @ cameras.swapaxes(1, 2)
            D = points @ around.points @ points.swapaxes(1, 2)
            errors.append(max(relative(C, direct.cameras), relative(D, direct.points)))
        assert min(errors) < 1e-6

    def test_frozen_parameters_have_no_variance(self, small: Small) -> None:
        found = eg.covariance(small.tracks, small.found, eg.gauge.reference_camera(1))
        assert np.abs(found.cameras[1]).max() < 1e-12 * np.abs(found.cameras).max()
        assert np.abs(found.points[:, 2]).max() < 1e-12 * np.abs(found.points).max()
        five = eg.gauge.five_points([3, 7, 11, 19, 2])
        found = eg.covariance(small.tracks, small.found, five)
        assert np.abs(found.points[[3, 7, 11, 19, 2]]).max() < 1e-9 * np.abs(found.points).max()

    def test_free_gauge_has_the_least_trace(self, small: Small) -> None:
        for gauge in GAUGES.values():
            found = eg.covariance(small.tracks, small.found, gauge)
            free = found.in_gauge(eg.gauge.identity())
            assert np.trace(free.dense()) <= np.trace(found.dense()) * (1.0 + 1e-9)


def gauge_directions(found: eg.Reconstruction) -> tuple[Array, Array]:
    """Return changes of scales and of basis, not orthonormalised."""
    table = kernels.table()
    P, Q = found.P, found.Q
    scales = many_views.block_diagonal((P.reshape(-1, 12, 1), Q[:, :, None]))
    cameras = table.camera_generators(P.transpose(1, 2, 0)).transpose(2, 0, 1)
    points = table.point_generators(Q.T).transpose(2, 0, 1)
    return scales, np.concatenate([cameras.reshape(-1, 16), points.reshape(-1, 16)])


class TestProjections:
    def test_equal_the_dense_propagation(self, small: Small) -> None:
        n, m = small.tracks.n_views, small.tracks.n_points
        C = pseudo_inverse(small.N, n, m)
        found = eg.covariance(small.tracks, small.found, noise_px=1.0)
        view, point = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m)))
        P, Q = small.found.P.transpose(1, 2, 0)[..., view], small.found.Q.T[:, point]
        _, J_P, J_Q, _ = kernels.table().project(P, Q)
        expected = np.empty((n * m, 2, 2))
        for k in range(n * m):
            J = np.zeros((2, 12 * n + 4 * m))
            J[:, 12 * view[k] : 12 * (view[k] + 1)] = J_P[..., k]
            J[:, 12 * n + 4 * point[k] : 12 * n + 4 * (point[k] + 1)] = J_Q[..., k]
            expected[k] = J @ C @ J.T
        assert relative(found.of_projections(view, point), expected) < 1e-7
        rows = [
            int(np.flatnonzero((view == i) & (point == j))[0])
            for i, j in zip(small.tracks.view, small.tracks.point, strict=True)
        ]
        assert relative(found.projections, expected[rows]) < 1e-7

    def test_are_the_same_in_every_gauge(self, small: Small) -> None:
        expected = eg.covariance(small.tracks, small.found)
        view, point = np.repeat(np.arange(4), 20), np.tile(np.arange(20), 4)
        everywhere = expected.of_projections(view, point)
        for gauge in GAUGES.values():
            found = eg.covariance(small.tracks, small.found, gauge)
            assert relative(found.projections, expected.projections) < 1e-8
            assert relative(found.of_projections(view, point), everywhere) < 1e-8
            moved = expected.in_gauge(gauge)
            assert relative(moved.projections, expected.projections) < 1e-8

    @pytest.mark.parametrize("name", ["reference_camera", "two_cameras", "normalized", "identity"])
    def test_follow_from_the_dense_covariance_of_any_gauge(self, small: Small, name: str) -> None:
        # Through the parameters of the gauge themselves, not by the short cut.
        found = eg.covariance(small.tracks, small.found, GAUGES[name])
        problem = many_views.problem_of(small.tracks, scale=1.0)
        state = problem.evaluate((found.reconstruction.P, found.reconstruction.Q))
        C, n = found.dense(), small.tracks.n_views
        for k, (i, j) in enumerate(zip(small.tracks.view, small.tracks.point, strict=True)):
            J = np.zeros((2, len(C)))
            J[:, 12 * i : 12 * (i + 1)] = state.J_P[..., k]
            J[:, 12 * n + 4 * j : 12 * n + 4 * (j + 1)] = state.J_Q[..., k]
            assert relative(J @ C @ J.T, found.projections[k]) < 1e-6

    @pytest.mark.parametrize("condition", [1.0, 10.0, 100.0])
    def test_are_the_same_in_random_bases(self, small: Small, condition: float) -> None:
        expected = eg.covariance(small.tracks, small.found).projections
        for seed in range(5):
            change = many_views.gauge_change(np.random.default_rng(seed), 4, 20, condition)
            found = eg.covariance(small.tracks, many_views.changed(change, small.found))
            assert relative(found.projections, expected) < 1e-8

    def test_add_up_to_the_number_of_parameters(self, small: Small) -> None:
        # The hat matrix: trace(J N^+ J^T) = rank.
        tracks = small.tracks
        found = eg.covariance(tracks, small.found, noise_px=1.0)
        traces = tracks.weights * np.einsum("nii->n", found.projections)
        rank = 11 * tracks.n_views + 3 * tracks.n_points - 15
        assert traces.sum() == pytest.approx(rank, rel=1e-8)
        # No fitted point is less certain than its measurement.
        values = np.linalg.eigvalsh(tracks.weights[:, None, None] * found.projections)
        assert values.min() > 0.0
        assert values.max() < 1.0 + 1e-9


class TestArguments:
    def test_refusals(self, small: Small) -> None:
        tracks, found = small.tracks, small.found
        with pytest.raises(ArgumentError, match="has 3 cameras"):
            eg.covariance(tracks, eg.Reconstruction(found.P[:3], found.Q))
        with pytest.raises(ArgumentError, match="noise_px"):
            eg.covariance(tracks, found, noise_px=0.0)
        same = eg.Reconstruction(np.tile(found.P[0], (4, 1, 1)), found.Q)
        with pytest.raises(ArgumentError, match="not determined"):
            eg.covariance(tracks, same, noise_px=1.0)
        good = eg.covariance(tracks, found)
        with pytest.raises(ArgumentError, match="view is out of range"):
            good.of_projections([4], [0])
        with pytest.raises(ArgumentError, match="point is out of range"):
            good.of_projections([0], [-1])
        with pytest.raises(ArgumentError, match="view is float64"):
            good.of_projections([0.5], [1])

    def test_nothing_redundant_needs_a_noise(self) -> None:
        truth = many_views.cameras_and_points(2, 7)
        tracks = many_views.observed(truth, 0.0)
        with pytest.raises(ArgumentError, match="noise_px is not given"):
            eg.covariance(tracks, truth)
        assert np.isfinite(eg.covariance(tracks, truth, noise_px=1.0).projections).all()

    def test_a_gauge_of_ones_own(self, small: Small) -> None:
        class Own:
            """The first camera as it is: the reference camera under another name."""

            def transformation(self, P: Array, Q: Array) -> Transformation:
                return eg.gauge.reference_camera().transformation(P, Q)

            def constraints(self, P: Array, Q: Array) -> datum.Constraints:
                return datum._constraints(eg.gauge.reference_camera(), P, Q)

        class Silent:
            transformation = Own.transformation

        found = eg.covariance(small.tracks, small.found, Own())
        expected = eg.covariance(small.tracks, small.found, eg.gauge.reference_camera())
        np.testing.assert_array_equal(found.cameras, expected.cameras)
        with pytest.raises(ArgumentError, match="constraints"):
            eg.covariance(small.tracks, small.found, Silent())

    def test_large_problems_are_not_made_dense(self, data_dir: Path) -> None:
        tracks = many_views.real_tracks(data_dir, "corridor")
        result = eg.bundle_adjust(tracks)
        found = eg.covariance(tracks, result.reconstruction, eg.gauge.normalized())
        assert found.noise_px == pytest.approx(0.33, abs=0.1)
        assert found.cameras.shape == (11, 12, 12)
        assert found.points.shape == (737, 4, 4)
        rank = 11 * 11 + 3 * 737 - 15
        total = np.einsum("nii->", found.projections) / found.noise_px**2
        assert total == pytest.approx(rank, rel=1e-6)


@pytest.mark.slow
def test_large_problem_is_refused_as_one_matrix(data_dir: Path) -> None:
    tracks = many_views.real_tracks(data_dir, "dinosaur")
    found = eg.covariance(tracks, eg.initialize(tracks))
    assert np.isfinite(found.projections).all()
    assert np.isfinite(found.points).all()
    with pytest.raises(ArgumentError, match="at most 5000"):
        found.dense()


@pytest.mark.slow
def test_simulation_confirms_the_covariance_of_projected_points() -> None:
    truth = many_views.cameras_and_points(4, 25)
    clean = many_views.observed(truth, 0.0, seen=0.9)
    predicted = eg.covariance(clean, truth, noise_px=0.3).projections
    rng = np.random.default_rng(0)
    trials = 400
    errors = np.empty((trials, len(clean), 2))
    noises = np.empty(trials)
    for k in range(trials):
        xy = clean.xy + 0.3 * rng.standard_normal(clean.xy.shape)
        tracks = eg.Tracks(clean.view, clean.point, xy)
        found = eg.bundle_adjust(tracks, truth)
        errors[k] = found.reconstruction.project(clean) - clean.xy
        noises[k] = eg.covariance(tracks, found.reconstruction).noise_px if k < 20 else np.nan
    sampled = np.einsum("kni,knj->nij", errors, errors) / trials
    # Each entry has a relative deviation of sqrt(2 / 400) = 7 %; whitened, the identity.
    roots = np.linalg.inv(np.linalg.cholesky(predicted))
    whitened = roots @ sampled @ roots.swapaxes(1, 2)
    assert np.abs(whitened - np.eye(2)).max() < 5 * 0.071
    assert np.mean(np.einsum("nii->n", whitened)) / 2 == pytest.approx(1.0, abs=0.03)
    assert np.nanmean(noises**2) == pytest.approx(0.09, rel=0.1)
