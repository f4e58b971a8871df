"""Bad starts end at the optimum or say that they do not; flat scenes are alike in every basis."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.bundle import dampings, problem
from epigauge.multi_view.verdicts.verdict import poor_fit
from epigauge.reproduce.gauge_runs import moved, random_transformation


def hopeless(flatness: float, seed: int) -> tuple[eg.Tracks, eg.Reconstruction]:
    """Return a scene, and a start whose errors are as large as its cameras and points."""
    scene = eg.multi_view_scene(flatness, n_points=40, seed=seed)
    random = np.random.default_rng(seed)
    P = np.diag([1e-3, 1e-3, 1.0]) @ scene.true.P
    P /= np.linalg.norm(P, axis=(1, 2), keepdims=True)
    Q = scene.true.Q / np.linalg.norm(scene.true.Q, axis=1, keepdims=True)
    P = P + random.normal(size=P.shape) / 3.5
    return scene.tracks, eg.Reconstruction(
        np.diag([1e3, 1e3, 1.0]) @ P, Q + random.normal(size=Q.shape) / 2.0
    )


@pytest.mark.parametrize("seed", [10, 13])
def test_marquardt_does_not_call_a_bad_place_a_success(seed: int) -> None:
    tracks, start = hopeless(0.5, seed)
    best = eg.bundle_adjust(tracks).cost
    found = eg.bundle_adjust(tracks, start, method="marquardt", max_iter=500)
    assert found.cost > 1.4 * best  # or the start is no longer a bad one
    if found.status > 0:  # rounding led it to a minimum, if not the lowest: nothing leaves that
        again = eg.bundle_adjust(tracks, found.reconstruction)
        assert again.cost > (1.0 - 1e-3) * found.cost
        return
    # Rounding decides how soon it stops; by itself it says so
    assert found.status in (-1, 0)
    assert found.status == 0 or "another start" in found.message


@pytest.mark.parametrize("method", ["marquardt", "levenberg", "free", "mclauchlan"])
def test_the_optimum_is_a_success_of_every_method(method: str) -> None:
    tracks = eg.multi_view_scene(0.3, n_points=30, seed=2).tracks
    best = eg.bundle_adjust(tracks)
    found = eg.bundle_adjust(tracks, method=method)
    assert found.success
    assert found.cost == pytest.approx(best.cost, rel=1e-6)


def test_scales_that_run_away_leave_the_images_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    # lambda diag(N) lets the scale of this start's points grow beyond 1e100.
    tracks, start = hopeless(0.05, 9)
    found = eg.bundle_adjust(tracks, start, method="marquardt", max_iter=200)
    assert np.abs(found.reconstruction.Q).max() < 1e31
    again = 0.5 * np.sum((tracks.xy - found.reconstruction.project(tracks)) ** 2)
    assert again == pytest.approx(found.cost, rel=1e-9)
    vectors = np.random.default_rng(0).normal(size=(5, 4)) * [[1e40], [1.0], [1e-40], [1e30], [0]]
    kept = problem.in_range(vectors)
    np.testing.assert_array_equal(kept[[1, 4]], vectors[[1, 4]])
    cosines = np.sum(
        kept[[0, 2]] / np.abs(vectors[[0, 2]]).max(axis=1)[:, None] * vectors[[0, 2]], 1
    )
    assert (cosines > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(kept[[0, 2]], axis=1), 1.0, rtol=1e-12)


class TestLambdaFloor:
    """Below a least lambda rounding decides on steps along what a flat scene hardly determines."""

    @staticmethod
    def runs(**options: Any) -> list[eg.BundleResult]:
        tracks = eg.multi_view_scene(0.02, seed=0).tracks
        start, random = eg.initialize(tracks), np.random.default_rng(0)
        bases = [random_transformation(random, c, 5, 100) for c in (1.0, 1.0, 100.0)]
        return [
            eg.bundle_adjust(tracks, moved(start, basis), ftol=1e-10, **options) for basis in bases
        ]

    @staticmethod
    def apart(runs: list[eg.BundleResult]) -> float:
        costs = np.array([[row.cost for row in run.history[:24]] for run in runs])
        return float(np.abs(costs / costs[0] - 1.0).max())

    @pytest.mark.parametrize("loop", ["compiled", "python"])
    def test_flat_scenes_take_the_same_steps_in_every_basis(self, loop: str) -> None:
        options = {"callback": lambda _: False} if loop == "python" else {}
        runs = self.runs(**options)
        assert len({run.nit for run in runs}) == 1
        assert sum(row.accepted for row in runs[0].history) > 12
        assert self.apart(runs) < 1e-9
        lams = np.array([row.lam for row in runs[0].history[1:]])
        assert lams.min() == pytest.approx(dampings.LAM_FLOOR * lams[0], rel=1e-9)


def arc(seed: int) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return six calibrated views along an arc about sixty points, and the truth."""
    random = np.random.default_rng(seed)
    X = random.uniform(-1.0, 1.0, (60, 3))
    angles = np.linspace(0.0, 0.4, 6)
    R = np.zeros((6, 3, 3))
    R[:, 0, 0] = R[:, 2, 2] = np.cos(angles)
    R[:, 0, 2], R[:, 2, 0], R[:, 1, 1] = np.sin(angles), -np.sin(angles), 1.0
    t = np.tile([0.0, 0.0, 4.0], (6, 1))
    cameras = eg.Cameras("SIMPLE_PINHOLE", [[900.0, 640.0, 480.0]], [0] * 6)
    truth = eg.MetricReconstruction(R, t, X, cameras)
    view, point = np.nonzero(np.ones((6, 60)))
    tracks = eg.Tracks(view, point, np.zeros((360, 2)))
    xy = truth.project(tracks) + random.normal(0.0, 0.4, (360, 2))
    return eg.Tracks(tracks.view, tracks.point, xy), truth


@pytest.mark.parametrize("seed", range(3))
def test_a_fit_that_misses_most_observations_is_no_success(seed: int) -> None:
    tracks, truth = arc(seed)
    assert eg.bundle_adjust(tracks, truth, refine="pose").success
    xy, random = tracks.xy.copy(), np.random.default_rng(100 + seed)
    for view in range(6):  # matches of other points: what is near is nowhere
        own = np.flatnonzero(tracks.view == view)
        xy[own] = xy[random.permutation(own)]
    wrong = eg.Tracks(tracks.view, tracks.point, xy)
    for start in (truth, truth.to_projective()):
        found = eg.bundle_adjust(wrong, start, **({"refine": "pose"} if start is truth else {}))
        assert "poor fit" in found.flags
        assert not found.success


@pytest.mark.parametrize("seed", range(3))
def test_a_reflected_scene_is_no_success(seed: int) -> None:
    """Behind all cameras, points have the same images."""
    tracks, truth = arc(seed)
    start = replace(truth, X=-truth.X, t=-truth.t)
    found = eg.bundle_adjust(tracks, start, refine="pose")
    if found.n_behind == 0:  # it found its way to the front
        assert found.success
        return
    assert found.rms_px < 1.0
    assert {"poor fit", "behind the cameras"} <= {*found.flags}
    assert not found.success


def test_each_sign_of_a_poor_fit_suffices() -> None:
    assert not poor_fit(lambda limit: limit < 5.0, 1.0, 100.0, 0.5)
    assert poor_fit(lambda limit: limit < 11.0, 1.0, 100.0, 0.0)  # half of all observations
    assert poor_fit(lambda limit: False, 3.0, 100.0, 0.1)  # some views
    assert not poor_fit(lambda limit: False, 3.0, 100.0, 0.01)
    assert poor_fit(lambda limit: False, 0.0, 100.0, 1.0)  # reflected


@pytest.mark.parametrize("weight", [1e-6, 1e6])
def test_a_fit_is_poor_in_pixels_whatever_the_weights(weight: float) -> None:
    tracks, truth = arc(0)
    heavy = eg.Tracks(tracks.view, tracks.point, tracks.xy, weights=np.full(len(tracks), weight))
    for start in (truth, truth.to_projective()):
        assert "poor fit" not in eg.bundle_adjust(heavy, start).flags
