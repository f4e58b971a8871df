"""The first reconstruction: from tracks alone, robust, and its parts."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.bundle.linearizer import PointRefinement
from epigauge.errors import ArgumentError
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.resection import resect
from epigauge.two_view.losses import Loss
from laws import distance

# The package has a function of the same name.
registration = import_module("epigauge.multi_view.registration")


def median_residual(tracks: eg.Tracks, found: eg.Reconstruction, rows: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(tracks.xy - found.project(tracks), axis=1)[rows]))


@pytest.mark.parametrize("flatness", [0.5, 0.1])
@pytest.mark.parametrize("seen", [1.0, 0.5])
def test_starts_near_the_optimum(flatness: float, seen: float) -> None:
    for seed in range(3):
        truth = many_views.cameras_and_points(flatness=flatness, seed=seed)
        tracks = many_views.observed(truth, seen=seen, seed=seed)
        start = eg.initialize(tracks)
        assert start.P.shape == (5, 3, 4)
        assert start.Q.shape == (100, 4)
        best = eg.bundle_adjust(tracks, start)
        assert start.rms_px(tracks) < 2.0 * best.rms_px
        assert best.rms_px < 1.1 * truth.rms_px(tracks)


def test_exact_tracks_give_the_truth() -> None:
    truth = many_views.cameras_and_points(4, 40)
    tracks = many_views.observed(truth, 0.0, seen=0.7)
    start = eg.initialize(tracks)
    assert start.rms_px(tracks) < 1e-8
    assert eg.gauge.equivalent(start, truth, 1e-7)
    assert eg.bundle_adjust(tracks, start).success


def test_two_views_are_enough() -> None:
    truth = many_views.cameras_and_points(2, 40)
    tracks = many_views.observed(truth)
    found = eg.bundle_adjust(tracks)
    x1, x2 = tracks.xy[tracks.view == 0], tracks.xy[tracks.view == 1]
    assert found.cost == pytest.approx(eg.refine_fundamental(x1, x2).cost, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_gross_errors_leave_the_good_observations_well_explained(seed: int) -> None:
    truth = many_views.cameras_and_points(seed=seed)
    clean = many_views.observed(truth, seed=seed)
    tracks, good = many_views.with_gross_errors(clean, 0.05, seed=seed)
    start = eg.initialize(tracks)
    # One pixel of noise: the median length of two coordinates of it is 1.18.
    assert median_residual(tracks, start, good) < 2.0
    assert median_residual(tracks, start, ~good) > 15.0


@pytest.mark.parametrize("name", ["corridor", "house", "merton_1"])
def test_gross_errors_in_measured_tracks(data_dir: Path, name: str) -> None:
    clean = many_views.real_tracks(data_dir, name)
    tracks, good = many_views.with_gross_errors(clean, 0.05)
    assert median_residual(tracks, eg.initialize(tracks), good) < 1.0


def test_observations_of_weight_zero_are_left_out_however_wrong() -> None:
    clean = many_views.observed(many_views.cameras_and_points())
    off = np.random.default_rng(0).random(len(clean)) < 0.2
    start, found = [], []
    for error in (0.0, 1e6):
        xy = clean.xy + error * off[:, None]
        tracks = eg.Tracks(clean.view, clean.point, xy, weights=1.0 * ~off)
        start.append(eg.initialize(tracks).project(clean))
        found.append(eg.bundle_adjust(tracks).reconstruction.project(clean))
    np.testing.assert_array_equal(start[0], start[1])
    assert distance(found[0], found[1]) < 1e-12


def test_weight_zero_counts_where_a_point_has_nothing_else() -> None:
    clean = many_views.observed(many_views.cameras_and_points())
    lonely = (clean.point == 3) & (clean.view > 0)
    tracks = eg.Tracks(clean.view, clean.point, clean.xy, weights=1.0 * ~lonely)
    assert np.isfinite(eg.initialize(tracks).project(tracks)).all()


@pytest.mark.parametrize("backend", ["c", "numpy"])
def test_the_backends_start_alike(backend: str) -> None:
    many_views.need_backend(backend)
    tracks = many_views.observed(many_views.cameras_and_points())
    expected = eg.initialize(tracks, backend="numpy")
    found = eg.initialize(tracks, backend=backend)
    # Where a camera's iteration ends, within 1e-6 of its cost, rounding may decide.
    assert distance(found.project(tracks), expected.project(tracks)) < 1e-4


@pytest.mark.parametrize("name", ["numpy", "casadi"])
def test_two_views_begin_with_the_backend_asked_for(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    many_views.need_backend(name)
    asked: list[str | None] = []

    def refine(*arguments: Any, backend: str | None = None, **options: Any) -> Any:
        asked.append(backend)
        return eg.refine_fundamental(*arguments, backend=backend, **options)

    monkeypatch.setattr(registration, "refine_fundamental", refine)
    eg.initialize(many_views.observed(many_views.cameras_and_points(3, 20)), backend=name)
    assert asked == [name]


def test_points_on_one_line_are_told_in_the_callers_words() -> None:
    view, point = np.divmod(np.arange(48), 12)
    s = np.random.default_rng(0).uniform(0.0, 100.0, 12)[point]
    xy = np.column_stack([s, 2.0 * s + view])
    with pytest.raises(ArgumentError, match=r"views \d and \d.*on one line") as caught:
        eg.initialize(eg.Tracks(view, point, xy))
    assert caught.value.argument == "tracks"


def test_views_with_too_few_common_points_are_named() -> None:
    # View 3 shares five points with the others.
    view = np.concatenate([np.repeat([0, 1, 2], 30), np.full(5, 3), np.full(10, 3), np.full(10, 4)])
    point = np.concatenate([np.tile(np.arange(30), 3), np.arange(5), np.tile(np.arange(30, 40), 2)])
    truth = many_views.cameras_and_points(5, 40)
    h = np.einsum("kij,kj->ki", truth.P[view], truth.Q[point])
    tracks = eg.Tracks(view, point, h[:, :2] / h[:, 2:])
    with pytest.raises(ArgumentError, match=r"views \[3, 4\]"):
        eg.initialize(tracks, method="registration")


def test_no_pair_of_views_with_eight_common_points_is_refused() -> None:
    # Four views in a ring, neighbours share seven points.
    point = np.arange(28)
    view = np.concatenate([point // 7, (point // 7 + 1) % 4])
    points = np.tile(point, 2)
    truth = many_views.cameras_and_points(4, 28)
    h = np.einsum("kij,kj->ki", truth.P[view], truth.Q[points])
    with pytest.raises(ArgumentError, match="8 common points"):
        eg.initialize(eg.Tracks(view, points, h[:, :2] / h[:, 2:]), method="registration")


def test_frame_conditions_and_comes_back() -> None:
    truth = many_views.cameras_and_points()
    tracks = many_views.observed(truth, seen=0.5)
    frame = Frame.of(tracks)
    q = frame.conditioned(tracks)
    assert np.sqrt(np.mean(q**2)) == pytest.approx(1.0, rel=1e-12)
    for i in range(5):
        assert distance(q[:, tracks.view == i].mean(axis=1), np.zeros(2)) < 1e-12
    P = frame.cameras_in(truth.P)
    h = np.einsum("kij,kj->ki", P[tracks.view], truth.Q[tracks.point])
    residual = frame.scale * (q.T - h[:, :2] / h[:, 2:])
    assert distance(residual, tracks.xy - truth.project(tracks)) < 1e-9
    back = frame.cameras_out(P)
    assert distance(back / np.abs(truth.P).max(), truth.P / np.abs(truth.P).max()) < 1e-14


@pytest.mark.parametrize("wrong", [0, 2])
def test_resection_finds_the_camera(wrong: int) -> None:
    truth = many_views.cameras_and_points(2, 30)
    tracks = many_views.observed(truth, 0.0)
    P, Q = Frame.of(tracks).cameras_in(truth.P), truth.Q
    h = P[1] @ Q.T
    q = h[:2] / h[2:]
    q[:, :wrong] += [[1.0], [-0.5]]
    found = resect(kernels.table(), q, Q.T)
    expected = P[1] / np.linalg.norm(P[1])
    assert np.linalg.norm(found) == pytest.approx(1.0)
    assert distance(found * np.sign(np.sum(found * expected)), expected) < 1e-6


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_embedded_triangulation_never_raises_the_cost_of_a_point(
    loss: str, iterations: int
) -> None:
    how, rejected = PointRefinement(iterations), 0
    for seed in range(5):
        truth = many_views.cameras_and_points(4, 50, flatness=0.05, seed=seed)
        tracks = many_views.observed(truth, 2.0, seen=0.6, seed=seed)
        problem = many_views.problem_of(tracks, loss=Loss(loss, 0.003))
        near = many_views.in_units(many_views.shaken(truth, 0.3, seed=seed))
        far = near[0], np.random.default_rng(seed).standard_normal(near[1].shape)
        # And from the optimum, where only rounding is left to gain.
        settled = near[0], near[1]
        for _ in range(10):
            settled = near[0], problem.triangulated(*settled, how)
        for P, Q in (near, far, settled):
            before = problem.point_costs(P, Q)
            moved = problem.triangulated(P, Q, how)
            after = problem.point_costs(P, moved)
            assert (after <= before).all()
            if Q is settled[1]:
                rejected += int((moved == Q).all(axis=1).sum())
            else:
                assert after.sum() < 0.9 * before.sum()
        if loss == "linear" and iterations == 5:
            # Most of those that begin near are at their optimum then.
            state = problem.evaluate((near[0], problem.triangulated(*near, how)))
            gradient = problem.linearize(state).normal.g_points
            assert np.median(np.linalg.norm(gradient, axis=1)) < 1e-6
    assert rejected > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["library", "dinosaur_trimmed", "hotel_klt", "hotel_course", "strecha_entry_p10"]
)
def test_measured_sets_need_no_start(data_dir: Path, name: str) -> None:
    with np.load(data_dir / name / "tracks.npz") as z:
        rows = z["clean"][z["point"]] if "clean" in z else slice(None)
        view, point, xy = z["view"][rows], z["point"][rows], z["xy"][rows]
    tracks, _, _ = eg.Tracks.pruned(view, point, xy)
    assert eg.initialize(tracks).rms_px(tracks) < 3.0
