"""Gauges: they change no geometry, are idempotent and canonical, and have their property."""

from __future__ import annotations

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import Gauge, Transformation
from laws import distance

Array = many_views.Array

GAUGES: dict[str, Gauge] = {
    "identity": eg.gauge.identity(),
    "reference_camera": eg.gauge.reference_camera(),
    "reference_camera 2": eg.gauge.reference_camera(2),
    "two_cameras": eg.gauge.two_cameras(),
    "two_cameras 3 1": eg.gauge.two_cameras(3, 1),
    "five_points": eg.gauge.five_points(),
    "five_points given": eg.gauge.five_points([3, 7, 11, 20, 2]),
    "normalized": eg.gauge.normalized(),
}
FIXED = [name for name in GAUGES if name not in ("identity", "normalized")]
SEEDS = range(3)


@pytest.fixture(params=SEEDS)
def scene(request: pytest.FixtureRequest) -> eg.Reconstruction:
    """Return a reconstruction in units of the image, in a random basis with random scales."""
    truth = many_views.cameras_and_points(5, 30, seed=request.param)
    P, Q = many_views.in_units(truth)
    change = many_views.gauge_change(np.random.default_rng(request.param), 5, 30)
    return many_views.changed(change, eg.Reconstruction(P, Q))


def projections(P: Array, Q: Array) -> Array:
    h = np.einsum("nij,mj->nmi", P, Q)
    return h[..., :2] / h[..., 2:]


def moved(gauge: Gauge, scene: eg.Reconstruction) -> tuple[Array, Array]:
    return gauge.transformation(scene.P, scene.Q).apply(scene.P, scene.Q)


def up_to_signs(found: tuple[Array, Array], expected: tuple[Array, Array]) -> float:
    """Return the largest distance of cameras and points up to their signs and that of an axis."""
    worst = []
    for axis in (1.0, -1.0):
        distances = []
        for a, b in zip(found, expected, strict=True):
            a = (a * [1.0, 1.0, 1.0, axis]).reshape(len(a), -1)
            b = b.reshape(len(b), -1)
            sign = np.sign(np.sum(a * b, axis=1, keepdims=True))
            distances.append(distance(sign * a, b))
        worst.append(max(distances))
    return min(worst)


class TestTransformation:
    def test_changes_no_projection(self, scene: eg.Reconstruction) -> None:
        rng = np.random.default_rng(10)
        change = many_views.gauge_change(rng, 5, 30, condition=100.0)
        other = eg.gauge.transform(scene, change.T, change.camera_scales, change.point_scales)
        expected = projections(scene.P, scene.Q)
        assert distance(projections(other.P, other.Q), expected) < 1e-11

    def test_blocks_are_eq5(self, scene: eg.Reconstruction) -> None:
        change = many_views.gauge_change(np.random.default_rng(11), 5, 30)
        P, Q = change.apply(scene.P, scene.Q)
        cameras, points = change.blocks()
        T = many_views.block_diagonal((cameras, points))
        x = np.concatenate([scene.P.ravel(), scene.Q.ravel()])
        assert distance(T @ x, np.concatenate([P.ravel(), Q.ravel()])) < 1e-12
        gamma, alpha = change.camera_scales, change.point_scales
        zero = np.zeros((4, 4))
        row = gamma[1] * np.block([[change.T.T, zero, zero]])
        np.testing.assert_array_equal(cameras[1][:4], row)
        assert distance(points[2], alpha[2] * np.linalg.inv(change.T)) < 1e-12

    def test_inverse_goes_back(self, scene: eg.Reconstruction) -> None:
        change = many_views.gauge_change(np.random.default_rng(12), 5, 30)
        back = change.inverse().apply(*change.apply(scene.P, scene.Q))
        assert distance(back[0], scene.P) < 1e-12
        assert distance(back[1], scene.Q) < 1e-12

    def test_one_scale_serves_all(self, scene: eg.Reconstruction) -> None:
        other = eg.gauge.transform(scene, np.eye(4), -2.0, 0.5)
        np.testing.assert_array_equal(other.P, -2.0 * scene.P)
        assert distance(other.Q, 0.5 * scene.Q) < 1e-14

    @pytest.mark.parametrize(
        ("arguments", "named"),
        [
            ({"T": np.ones((4, 4))}, "T is singular"),
            ({"T": np.eye(3)}, "T has shape"),
            ({"T": np.full((4, 4), np.nan)}, "T has shape"),
            ({"T": np.eye(4), "camera_scales": 0.0}, "camera_scales"),
            ({"T": np.eye(4), "camera_scales": [1.0, 1.0, 0.0, 1.0, 1.0]}, "camera_scales"),
            ({"T": np.eye(4), "point_scales": np.inf}, "point_scales"),
        ],
    )
    def test_bad_arguments_are_refused(
        self, scene: eg.Reconstruction, arguments: dict, named: str
    ) -> None:
        with pytest.raises(ArgumentError, match=named):
            eg.gauge.transform(scene, **arguments)


class TestEquivalent:
    @pytest.mark.parametrize("condition", [1.0, 10.0, 1000.0])
    def test_random_bases_and_scales(self, scene: eg.Reconstruction, condition: float) -> None:
        for seed in range(5):
            change = many_views.gauge_change(np.random.default_rng(seed), 5, 30, condition)
            assert eg.gauge.equivalent(scene, many_views.changed(change, scene))

    def test_a_moved_point_is_another_geometry(self, scene: eg.Reconstruction) -> None:
        Q = scene.Q.copy()
        Q[4] += 1e-4 * np.linalg.norm(Q[4])
        assert not eg.gauge.equivalent(scene, eg.Reconstruction(scene.P, Q))
        assert eg.gauge.equivalent(scene, eg.Reconstruction(scene.P, Q), tol=1e-2)

    def test_a_moved_camera_is_another_geometry(self, scene: eg.Reconstruction) -> None:
        P = scene.P.copy()
        P[2, 1, 3] += 1e-4 * np.linalg.norm(P[2])
        other = eg.Reconstruction(P, scene.Q)
        change = many_views.gauge_change(np.random.default_rng(1), 5, 30)
        assert not eg.gauge.equivalent(scene, many_views.changed(change, other))

    def test_other_sizes_are_another_geometry(self, scene: eg.Reconstruction) -> None:
        assert not eg.gauge.equivalent(scene, eg.Reconstruction(scene.P, scene.Q[:-1]))
        assert not eg.gauge.equivalent(scene, eg.Reconstruction(scene.P[:-1], scene.Q))

    def test_a_swap_of_points_is_another_geometry(self, scene: eg.Reconstruction) -> None:
        Q = scene.Q.copy()
        Q[[0, 1]] = Q[[1, 0]]
        assert not eg.gauge.equivalent(scene, eg.Reconstruction(scene.P, Q))


class TestEveryGauge:
    @pytest.mark.parametrize("name", GAUGES)
    def test_changes_no_geometry(self, scene: eg.Reconstruction, name: str) -> None:
        P, Q = moved(GAUGES[name], scene)
        assert distance(projections(P, Q), projections(scene.P, scene.Q)) < 1e-11
        assert eg.gauge.equivalent(scene, eg.Reconstruction(P, Q))

    @pytest.mark.parametrize("name", GAUGES)
    def test_is_idempotent(self, scene: eg.Reconstruction, name: str) -> None:
        once = moved(GAUGES[name], scene)
        twice = moved(GAUGES[name], eg.Reconstruction(*once))
        for a, b in zip(twice, once, strict=True):
            assert distance(a, b) < 1e-10

    @pytest.mark.parametrize("name", FIXED)
    def test_is_canonical(self, scene: eg.Reconstruction, name: str) -> None:
        change = many_views.gauge_change(np.random.default_rng(13), 5, 30)
        there = moved(GAUGES[name], many_views.changed(change, scene))
        assert up_to_signs(there, moved(GAUGES[name], scene)) < 1e-9

    def test_normalized_is_canonical_up_to_an_orthonormal_basis(
        self, scene: eg.Reconstruction
    ) -> None:
        change = many_views.gauge_change(np.random.default_rng(14), 5, 30)
        a = moved(GAUGES["normalized"], scene)
        b = moved(GAUGES["normalized"], many_views.changed(change, scene))
        signs = self._signs(a[1], b[1])
        T, *_ = np.linalg.lstsq(a[1], signs[:, None] * b[1], rcond=None)
        assert distance(T @ T.T, np.eye(4)) < 1e-9
        rotated = Transformation(T, np.ones(5), np.ones(30)).apply(*a)
        assert up_to_signs(rotated, b) < 1e-9

    @staticmethod
    def _signs(Q_a: Array, Q_b: Array) -> Array:
        # |cosines| agree where T is orthonormal; their signs are s_j s_k.
        agree = np.sign((Q_a @ Q_a.T) * (Q_b @ Q_b.T))
        assert distance(np.abs(Q_a @ Q_a.T), np.abs(Q_b @ Q_b.T)) < 1e-9
        return np.asarray(agree[0])


class TestProperties:
    def test_reference_camera_is_I_0(self, scene: eg.Reconstruction) -> None:
        for camera in (0, 3):
            P, Q = moved(eg.gauge.reference_camera(camera), scene)
            assert distance(P[camera], np.eye(3, 4)) < 1e-11
            assert distance(Q[:, 2], np.ones(30)) < 1e-12
            norms = np.linalg.norm(np.delete(P, camera, axis=0), axis=(1, 2))
            assert distance(norms, np.ones(4)) < 1e-12
            assert distance(Q[:, :3].T @ Q[:, 3], np.zeros(3)) < 1e-9
            assert np.mean(Q[:, 3] ** 2) == pytest.approx(1.0, rel=1e-9)

    def test_second_camera_is_that_of_eq5(self, scene: eg.Reconstruction) -> None:
        for first, second in ((0, 1), (4, 2)):
            P, Q = moved(eg.gauge.two_cameras(first, second), scene)
            assert distance(P[first], np.eye(3, 4)) < 1e-11
            H, e = P[second][:, :3], P[second][:, 3]
            # H = u2 v1^T - sigma u1 v2^T, e = u3
            assert np.linalg.norm(e) == pytest.approx(1.0, rel=1e-12)
            assert distance(e @ H, np.zeros(3)) < 1e-10
            values = np.linalg.svd(H, compute_uv=False)
            assert values[0] == pytest.approx(1.0, rel=1e-10)
            assert values[2] < 1e-10
            F = np.cross(np.eye(3), e).T @ H
            sigma = np.linalg.svd(F, compute_uv=False)
            assert sigma[1] / sigma[0] == pytest.approx(values[1], rel=1e-9)
            assert distance(Q[:, 2], np.ones(30)) < 1e-12

    def test_five_points_are_the_standard_basis(self, scene: eg.Reconstruction) -> None:
        for gauge in (eg.gauge.five_points(), eg.gauge.five_points([3, 7, 11, 20, 2])):
            chosen = gauge.points if gauge.points is not None else gauge.choose(scene.Q)
            P, Q = moved(gauge, scene)
            standard = np.vstack([np.eye(4), np.full(4, 0.5)])
            five = Q[list(chosen)]
            five = five * np.sign(five.sum(axis=1, keepdims=True))
            assert distance(five, standard) < 1e-10
            assert distance(np.linalg.norm(P, axis=(1, 2)), np.ones(5)) < 1e-12
            assert distance(np.linalg.norm(Q, axis=1), np.ones(30)) < 1e-12

    def test_five_points_are_chosen_alike_in_every_basis(self, scene: eg.Reconstruction) -> None:
        chosen = eg.gauge.five_points.choose(scene.Q)
        for seed in range(10):
            change = many_views.gauge_change(np.random.default_rng(seed), 5, 30)
            assert eg.gauge.five_points.choose(many_views.changed(change, scene).Q) == chosen

    def test_five_points_chosen_are_well_conditioned(self, scene: eg.Reconstruction) -> None:
        Q = moved(eg.gauge.normalized(), scene)[1]

        def smallest_minor(five: list[int]) -> float:
            fours = ([k for k in five if k != left] for left in five)
            return min(abs(float(np.linalg.det(Q[four]))) for four in fours)

        rng = np.random.default_rng(16)
        random = [smallest_minor(rng.choice(30, 5, replace=False).tolist()) for _ in range(200)]
        chosen = eg.gauge.five_points.choose(scene.Q)
        assert len(set(chosen)) == 5
        assert smallest_minor(chosen) > np.quantile(random, 0.98)

    def test_normalized_points_have_an_even_scatter(self, scene: eg.Reconstruction) -> None:
        P, Q = moved(eg.gauge.normalized(), scene)
        assert distance(Q.T @ Q * 4 / 30, np.eye(4)) < 1e-12
        assert distance(np.linalg.norm(Q, axis=1), np.ones(30)) < 1e-12
        assert distance(np.linalg.norm(P, axis=(1, 2)), np.ones(5)) < 1e-12

    def test_normalized_bears_points_in_one_plane(self) -> None:
        flat = many_views.cameras_and_points(5, 30, flatness=0.0)
        P, Q = moved(eg.gauge.normalized(), flat)
        assert np.isfinite(P).all()
        assert np.isfinite(Q).all()
