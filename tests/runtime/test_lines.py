"""Lines beside points: triangulation, adjustment, invariance, verdicts, bad input."""

from __future__ import annotations

import copy
import dataclasses

import epigauge as eg
import numpy as np
import pytest
from epigauge import lm
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.problem import Estimate
from epigauge.bundle.similarity import Similarity
from epigauge.cameras import camera_model
from epigauge.kernels import table
from epigauge.multi_view.line_adjust import line_problem


def off(found, wanted):
    """Return the distances of lines from others, their signs being free."""
    sign = np.sign(np.sum(found[:, 3:] * wanted[:, 3:], axis=1))[:, None]
    return np.linalg.norm(found * sign - wanted, axis=1)


@pytest.fixture(scope="module")
def scene():
    return eg.line_scene(seed=3)


@pytest.fixture(scope="module")
def adjusted(scene):
    return eg.bundle_adjust(
        scene.tracks, scene.true, lines=scene.line_tracks, refine="pose", ftol=1e-14
    )


def test_exact_segments_give_the_lines():
    scene = eg.line_scene(noise_px=0.0, n_lines=20)
    found = eg.triangulate_lines(scene.line_tracks, scene.true)
    assert off(found, scene.true.lines).max() < 1e-9


def test_an_adjustment_is_determined_and_fits(scene, adjusted):
    assert adjusted.success
    assert not adjusted.flags
    assert adjusted.rank == 6 * 8 + 3 * 60 + 4 * 60 - 7
    redundancy = 2 * 480 + 2 * 480 - adjusted.rank
    # Sum of squares over the redundancy: one, give or take sqrt(2 / redundancy).
    assert abs(2 * adjusted.cost / redundancy - 1) < 4 * np.sqrt(2 / redundancy)
    assert adjusted.line_fun.shape == (480, 2)
    total = np.sum(adjusted.fun**2) + np.sum(adjusted.line_fun**2)
    np.testing.assert_allclose(0.5 * total, adjusted.cost, rtol=1e-9)


def test_lines_without_noise_lead_back_to_the_truth():
    scene = eg.line_scene(noise_px=0.0, n_points=12, n_lines=20, seed=2)
    random, true = np.random.default_rng(0), scene.true
    moved = true.X + 0.05 * random.standard_normal(true.X.shape)
    start = eg.MetricReconstruction(true.R, true.t + 0.02, moved, true.cameras)
    found = eg.bundle_adjust(scene.tracks, start, lines=scene.line_tracks, max_iter=200)
    assert found.rms_px < 1e-6
    assert np.abs(found.line_fun).max() < 1e-5


@pytest.mark.parametrize("backend", ["numpy", "c", "casadi"])
def test_back_ends_end_at_one_minimum(scene, adjusted, backend):
    if eg.kernels.available()[backend] is not None:
        pytest.skip(str(eg.kernels.available()[backend]))
    found = eg.bundle_adjust(
        scene.tracks,
        scene.true,
        lines=scene.line_tracks,
        refine="pose",
        backend=backend,
    )
    np.testing.assert_allclose(found.cost, adjusted.cost, rtol=1e-7)


def similarities(count):
    random = np.random.default_rng(5)
    for _ in range(count):
        Q = np.linalg.qr(random.standard_normal((3, 3)))[0]
        scale = float(np.exp(random.uniform(-3, 3)))
        yield Similarity(scale, Q * np.linalg.det(Q), *random.standard_normal((2, 3)))


def test_steps_are_the_same_in_twenty_frames():
    scene = eg.line_scene(n_points=15, n_lines=15, n_views=5, seed=4)
    start = scene.true
    costs = []
    for there in [None, *similarities(20)]:
        if there is not None:
            cameras, X = there.apply(scene.true.vectors, scene.true.X)
            pose = cameras[:, :12].reshape(-1, 3, 4)
            lines = there.lines(scene.true.lines)
            parts = scene.true.cameras, lines
            start = eg.MetricReconstruction(pose[:, :, :3], pose[:, :, 3], X, *parts)
        made = line_problem(scene.tracks, start, scene.line_tracks, table(), embedded=True)
        problem, begin = made.problem, made.start
        if there is not None:  # in that very frame, not in the one that suits best
            begin = Estimate(start.vectors, start.X, others=(start.lines,))
        outcome = lm.minimize(
            problem, begin, Covariant(), lm.Classic(), lm.Stopping(1e-14, 0.0, 0.0, 5)
        )
        costs.append([row.cost for row in outcome.history])
    assert len(costs[0]) == 6
    assert costs[0][1] < 0.999 * costs[0][0]
    for other in costs[1:]:
        np.testing.assert_allclose(other, costs[0], rtol=1e-7)


def test_lines_improve_the_cameras():
    errors = []
    for seed in range(6):
        scene = eg.line_scene(n_points=10, n_lines=60, seed=seed)
        both = []
        for lines in (None, scene.line_tracks):
            found = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose")
            R = found.reconstruction.R
            relative = R[1:] @ np.swapaxes(R[:1], 1, 2)
            wanted = scene.true.R[1:] @ np.swapaxes(scene.true.R[:1], 1, 2)
            both.append(np.sqrt(np.mean((relative - wanted) ** 2)))
        errors.append(both)
    points, mixed = np.sqrt(np.mean(np.square(errors), axis=0))
    assert mixed < 0.7 * points


def test_cameras_with_distortion_see_straightened_end_points():
    scene = eg.line_scene(noise_px=0.0, n_lines=12, n_points=12)
    model = eg.Cameras("RADIAL", [[1000.0, 0.0, 0.0, -0.15, 0.05]], np.zeros(8, np.intp))
    parts = scene.true.R, scene.true.t, scene.true.X, model
    true = eg.MetricReconstruction(*parts, scene.true.lines)
    image = camera_model("RADIAL").kernel("image")
    params = model.of_views[scene.line_tracks.view].T
    ends = []
    for k in (0, 2):
        xy = scene.line_tracks.segments[:, k : k + 2].T / 1000.0
        ends.append(image(np.concatenate([xy, np.ones((1, xy.shape[1]))]), params)[0])
    bent = eg.LineTracks(
        scene.line_tracks.view, scene.line_tracks.line, np.concatenate(ends).T, sigma=0.5
    )
    tracks = eg.Tracks(scene.tracks.view, scene.tracks.point, true.project(scene.tracks))
    assert off(eg.triangulate_lines(bent, true), true.lines).max() < 1e-7
    found = eg.bundle_adjust(tracks, true, lines=bent, refine="pose")
    assert np.abs(found.line_fun).max() < 1e-6
    with pytest.raises(eg.ArgumentError, match="RADIAL"):
        eg.bundle_adjust(tracks, true, lines=bent)


def test_a_line_in_an_epipolar_plane_is_refused():
    scene = eg.line_scene(n_views=2, n_points=12, n_lines=3)
    centres = scene.true.centres
    v = centres[1] - centres[0]
    v /= np.linalg.norm(v)
    ends = []
    for s in (-1.0, 1.0):
        h = np.einsum("nij,j->ni", scene.true.R, s * v + 0.3) + scene.true.t
        ends.append(1000.0 * h[:, :2] / h[:, 2:])
    segments = np.concatenate([scene.line_tracks.segments, np.concatenate(ends, axis=1)])
    line = np.concatenate([scene.line_tracks.line, [3, 3]])
    view = np.concatenate([scene.line_tracks.view, [0, 1]])
    with pytest.raises(eg.ArgumentError, match=r"1 lines .* 3; needed: .*epipolar plane"):
        eg.triangulate_lines(eg.LineTracks(view, line, segments), scene.true)


def test_wrong_segments_are_told(scene):
    lines = scene.line_tracks
    segments = lines.segments.copy()
    random = np.random.default_rng(0)
    segments[random.choice(len(segments), 5, replace=False)] += [200.0, 0.0, -150.0, 300.0]
    wrong = eg.LineTracks(lines.view, lines.line, segments)
    found = eg.bundle_adjust(scene.tracks, scene.true, lines=wrong, refine="pose")
    assert {"gross errors", "outliers"} & set(found.flags)


def test_fixed_views_and_points_stay(scene):
    found = eg.bundle_adjust(
        scene.tracks,
        scene.true,
        lines=scene.line_tracks,
        refine="pose",
        fixed_views=[0, 1],
        fixed_points=[2],
    )
    assert found.success
    assert (found.reconstruction.R[:2] == scene.true.R[:2]).all()
    assert (found.reconstruction.X[2] == scene.true.X[2]).all()


@pytest.mark.parametrize(
    ("view", "line", "segments", "options", "message"),
    [
        ([0, 1, 0], [0, 0, 1], np.eye(3, 4) * 90, {}, "1 is seen by fewer than two views"),
        ([0, 0], [0, 0], np.eye(2, 4) * 90, {}, "twice"),
        ([0, 1], [0, 0], [[0, 0, 1, 1], [0, 0, 9, 9]], {}, "1.41 px long in row 0"),
        ([0, 1], [0, 0], [[0, 0, np.nan, 1], [0, 0, 9, 9]], {}, "not finite in row 0"),
        ([0, 1], [0, 0], np.ones((2, 3)), {}, r"\(2, 3\)"),
        ([0, -1], [0, 0], np.eye(2, 4), {}, "-1"),
        ([0, 1], [0, 0], np.eye(2, 4) * 90, {"sigma": 0.0}, "sigma"),
        ([0, 1], [0, 0], np.eye(2, 4) * 90, {"covariance": np.zeros((2, 2, 2, 2))}, "row 0"),
    ],
)
def test_bad_observations_are_refused(view, line, segments, options, message):
    with pytest.raises(eg.ArgumentError, match=message):
        eg.LineTracks(view, line, segments, **options)


@pytest.mark.parametrize("scale_px", [-1.0, 0.0, np.nan, "x"])
def test_a_scale_that_is_none_is_refused(scene, scale_px):
    options = {"loss": "huber", "loss_scale_px": scale_px}
    with pytest.raises(eg.ArgumentError, match="loss_scale_px"):
        eg.bundle_adjust(scene.tracks, scene.true, lines=scene.line_tracks, **options)


def test_what_lines_do_not_go_with_is_refused(scene):
    lines = scene.line_tracks
    for options, name in (
        ({"robust": True}, "robust"),
        ({"gauge": eg.gauge.identity(), "gauge_mode": "implicit"}, "gauge_mode"),
        ({"method": "free"}, "method"),
        ({"noise_px": None, "priors": [eg.PositionPrior(0, [0, 0, 0], 1.0)]}, "noise_px"),
    ):
        with pytest.raises(eg.ArgumentError, match=name):
            eg.bundle_adjust(scene.tracks, scene.true, lines=lines, **options)
    with pytest.raises(eg.ArgumentError, match="MetricReconstruction"):
        eg.bundle_adjust(scene.tracks, scene.true.R, lines=lines)
    with pytest.raises(eg.ArgumentError, match="LineTracks"):
        eg.bundle_adjust(scene.tracks, scene.true, lines=scene.tracks)
    parts = scene.true.R, scene.true.t, scene.true.X, scene.true.cameras
    for bad, message in (
        (np.ones((1, 6)), "no line in row 0"),
        ([[1, 0, 0, 0, 0, 0]], "infinity"),
    ):
        with pytest.raises(eg.ArgumentError, match=message):
            eg.MetricReconstruction(*parts, bad)


def test_scenes_keep_their_lines(tmp_path, scene):
    path = tmp_path / "scene.npz"
    eg.save_scene(path, scene.tracks, scene.true)
    tracks, found = eg.load_scene(path)
    assert (found.lines == scene.true.lines).all()
    assert (copy.deepcopy(found).lines == found.lines).all()
    assert len(tracks) == len(scene.tracks)


def test_deviations_of_all_measurements_leave_residuals_in_pixels(scene):
    parts, options = (scene.tracks, scene.line_tracks), {"refine": "pose", "ftol": 1e-14}
    tracks, lines = parts
    wider = eg.Tracks(tracks.view, tracks.point, tracks.xy, sigma=0.5)
    segments = eg.LineTracks(lines.view, lines.line, lines.segments, sigma=0.5)
    plain = eg.bundle_adjust(tracks, scene.true, lines=lines, **options)
    found = eg.bundle_adjust(wider, scene.true, lines=segments, **options)
    np.testing.assert_allclose(found.line_fun, plain.line_fun, atol=1e-6)
    total = np.sum(found.fun**2) + np.sum(found.line_fun**2)
    np.testing.assert_allclose(0.5 * total, found.cost, rtol=1e-9)


def test_a_similarity_takes_lines_along(scene):
    seen = eg.triangulate_lines(scene.line_tracks, scene.true)
    v = scene.true.lines[:, 3:]
    points = np.cross(v, scene.true.lines[:, :3])  # of each line the one nearest to the origin
    for there in similarities(3):
        R, t = there.rotation, there.target - there.scale * there.rotation @ there.origin
        moved = eg.gauge.transform(scene.true, eg.gauge.similarity(there.scale, R, t))
        X, turned = there.positions(points), v @ R.T
        size = np.linalg.norm(moved.lines, axis=1).max()
        wanted = np.column_stack([np.cross(X, turned), turned])
        np.testing.assert_allclose(moved.lines, wanted, atol=1e-12 * size)
        # Cameras that are moved see the lines there.
        again = eg.triangulate_lines(scene.line_tracks, moved)
        assert off(again, there.lines(seen)).max() < 1e-6 * size


def test_other_axes_of_cameras_keep_the_lines(scene):
    tracks, true = eg.interop.colmap_to_bal(scene.tracks, scene.true)
    assert (true.lines == scene.true.lines).all()
    back = eg.interop.bal_to_colmap(tracks, true, (1000, 1000))[1]
    assert (back.lines == scene.true.lines).all()


@pytest.mark.parametrize("name", ["folder", "scene.txt", "scene.out", "scene.glb", "scene.json"])
def test_a_form_without_lines_is_refused(tmp_path, scene, name):
    with pytest.raises(eg.ArgumentError, match=r"lines are 60, which only NPZ"):
        eg.save_scene(tmp_path / name, scene.tracks, scene.true)
    assert not list(tmp_path.iterdir())


def test_points_alone_do_not_tell_how_sure_lines_made_cameras(scene, adjusted):
    with pytest.raises(eg.ArgumentError, match="has 60 lines"):
        eg.covariance(scene.tracks, adjusted.reconstruction)
    alone = eg.bundle_adjust(scene.tracks, adjusted.reconstruction)
    assert alone.reconstruction.lines is None
    assert eg.covariance(scene.tracks, alone.reconstruction).noise_px > 0


def test_the_command_line_does_not_lose_lines(tmp_path, scene, run):
    eg.save_scene(tmp_path / "scene.npz", scene.tracks, scene.true)
    code, _, err = run("bundle", tmp_path / "scene.npz", "-o", tmp_path / "out.npz")
    assert code == 2
    assert "60 lines" in err
    assert not (tmp_path / "out.npz").exists()


def test_a_start_that_is_none_and_odd_numbers_of_lines_are_named(scene):
    lines = scene.line_tracks
    with pytest.raises(eg.ArgumentError, match="start is a str"):
        eg.bundle_adjust(scene.tracks, "scene", lines=lines)
    parts = lines.view, lines.line, lines.segments
    for bad in (59.5, "60", np.nan, [60, 61], True, 0):
        with pytest.raises(eg.ArgumentError, match="n_lines"):
            eg.LineTracks(*parts, bad)
    for many in (61, 10**12):
        with pytest.raises(eg.ArgumentError, match=r"60.* is seen by fewer than two views"):
            eg.LineTracks(*parts, many)
    far = np.where(lines.line == 59, 10**12, lines.line)
    with pytest.raises(eg.ArgumentError, match=r"59.* is seen by fewer than two views"):
        eg.LineTracks(lines.view, far, lines.segments)


def test_text_tells_of_lines(scene):
    assert "60 points, 60 lines, Cameras" in repr(scene.true)
    assert "lines" not in repr(dataclasses.replace(scene.true, lines=None))


def test_a_scene_of_no_line_is_one_without_lines(tmp_path, scene):
    empty = dataclasses.replace(scene.true, lines=np.zeros((0, 6)))
    assert empty.lines is None
    eg.save_scene(tmp_path / "folder", scene.tracks, empty)


def test_priors_and_gauges_go_with_lines(scene, adjusted):
    lines, true = scene.line_tracks, scene.true
    options = {"lines": lines, "refine": "pose", "ftol": 1e-12}
    priors = [eg.PositionPrior(i, true.centres[i], 0.05) for i in range(8)]
    known = eg.bundle_adjust(scene.tracks, true, priors=priors, **options)
    assert known.success
    assert known.rank == adjusted.rank + 7
    assert np.abs(known.reconstruction.centres - true.centres).max() < 0.1
    again = eg.triangulate_lines(lines, known.reconstruction)
    assert off(again, known.reconstruction.lines).max() < 1e-4
    for how in (
        {"method": "levenberg", "gauge": eg.gauge.normalized()},
        {"method": "hartley"},
        {"method": "bartoli"},
        {"method": "mclauchlan"},
    ):
        found = eg.bundle_adjust(scene.tracks, true, **options, **how)
        np.testing.assert_allclose(found.cost, adjusted.cost, rtol=1e-5)
        assert found.rank == adjusted.rank
        # Lines are in the frame that the gauge has moved cameras and points to.
        again = eg.triangulate_lines(lines, found.reconstruction)
        size = np.linalg.norm(again, axis=1).max()
        assert np.median(off(again, found.reconstruction.lines)) < 1e-3 * size


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_adjustment_that_only_rounding_moves_has_converged(seed):
    scene = eg.line_scene(seed=seed)
    lines, true = scene.line_tracks, scene.true
    priors = [eg.PositionPrior(i, true.centres[i], 0.05) for i in range(8)]
    options = {"lines": lines, "priors": priors, "refine": "pose", "ftol": 0.0}
    found = eg.bundle_adjust(scene.tracks, true, **options)
    assert found.success, found.message
    again = eg.bundle_adjust(scene.tracks, found.reconstruction, **options)
    assert again.success, again.message
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-12)
