"""Covariances of calibrated reconstructions: against dense algebra, in any datum, and a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.cameras import camera_model
from numpy.typing import NDArray

from tests.metric_dense import DATUMS, Dense, assert_same, conditions, turned
from tests.metric_scenes import METRIC, metric_scene

Array = NDArray[np.float64]


def refined(model: str) -> tuple[str, ...]:
    """Return intrinsics that a small scene determines."""
    known = camera_model(model)
    return tuple(known.params[k] for k in known.focal)


def corrected_residuals(scene: eg.MetricReconstruction, tracks: eg.Tracks) -> Array:
    """Return what a photogrammetrist writes: q + correction(q) - (x0 - c k1/k3, y0 - c k2/k3)."""
    k = scene.cameras.of_views[tracks.view].T
    c, x0, y0, A1, A2, A3, B1, B2, C1, C2, R0 = k
    h = np.einsum("nij,nj->ni", scene.R[tracks.view], scene.X[tracks.point]) + scene.t[tracks.view]
    x, y = tracks.xy.T - [x0, y0]
    r2 = x**2 + y**2
    D = A1 * (r2 - R0**2) + A2 * (r2**2 - R0**4) + A3 * (r2**3 - R0**6)
    dx = x * D + B1 * (r2 + 2 * x**2) + 2 * B2 * x * y + C1 * x + C2 * y
    dy = y * D + B2 * (r2 + 2 * y**2) + 2 * B1 * x * y
    return np.column_stack([x + dx + c * h[:, 0] / h[:, 2], y + dy + c * h[:, 1] / h[:, 2]])


def compared(scene: eg.MetricReconstruction, tracks: eg.Tracks) -> Array:
    """Return residuals (N, 2): of the measured points, or of the corrected ones."""
    if scene.cameras.model == "brown_measured":
        return corrected_residuals(scene, tracks)
    return tracks.xy - scene.project(tracks)


@pytest.mark.parametrize("model", METRIC)
def test_every_model_agrees_with_dense_algebra(model: str) -> None:
    names = refined(model)
    tracks, scene = metric_scene(model, 3, n_points=14)
    dense = Dense(scene, names)
    J = dense.jacobian(lambda s: compared(s, tracks).ravel())
    datum, C = conditions(dense, "all points")
    cov = eg.covariance(tracks, scene, datum, 0.7, refine=names or "pose")
    assert cov.open == 7
    assert_same(cov, dense, 0.49 * dense.covariance(J.T @ J, C), 1e-5)


@pytest.mark.parametrize("name", DATUMS)
def test_datums_agree_with_dense_algebra_and_one_another(name: str) -> None:
    tracks, scene = metric_scene("SIMPLE_RADIAL", 1, n_points=16, n_cameras=4)
    dense = Dense(scene, ("f", "k"))
    J = dense.jacobian(lambda s: s.project(tracks).ravel())
    datum, C = conditions(dense, name)
    options: dict[str, Any] = {"refine": ("f", "k")}
    cov = eg.covariance(tracks, scene, datum, 1.0, **options)
    assert_same(cov, dense, dense.covariance(J.T @ J, C), 1e-6)
    other = eg.covariance(tracks, scene, "inner", 1.0, **options)
    for there, direct in ((other.in_gauge(datum), cov), (cov.in_gauge("inner"), other)):
        for part in (("camera", 2), ("point", 3), ("intrinsics", 1)):
            expected = direct.between(part, part)
            np.testing.assert_allclose(
                there.between(part, part), expected, 1e-10, 1e-10 * np.abs(expected).max()
            )
    # What no gauge changes: intrinsics, and ratios of lengths.
    np.testing.assert_allclose(cov.std.intrinsics, other.std.intrinsics, rtol=1e-9)


def test_inner_constraints_have_the_least_trace() -> None:
    tracks, scene = metric_scene("PINHOLE", 2, n_points=16)
    cov = eg.covariance(tracks, scene, noise_px=1.0, refine="pose")
    least = np.sum(cov.std.points**2)
    for name in DATUMS[1:]:
        datum = conditions(Dense(scene, ()), name)[0]
        assert np.sum(cov.in_gauge(datum).std.points ** 2) > 1.01 * least


def test_what_is_known_is_the_datum() -> None:
    """Positions of two metres, three control points, or a bar beside them: as dense algebra."""
    tracks, scene = metric_scene("OPENCV", 4, n_points=16)
    names = ("fx", "fy")
    dense = Dense(scene, names)
    J = dense.jacobian(lambda s: s.project(tracks).ravel())
    none = np.zeros((dense.size, 0))
    gps = [eg.PositionPrior(i, scene.centres[i], sigma=2.0) for i in range(4)]
    control = [eg.PointPrior(j, scene.X[j], sigma=(0.01, 0.02, 0.05)) for j in (0, 3, 8)]
    bar = eg.Distance(2, 5, float(np.linalg.norm(scene.X[2] - scene.X[5])), 0.003)
    focal = eg.IntrinsicPrior(0, "fx", scene.cameras.params[0, 0], 0.5)
    for priors, open_ in (
        (gps, 0),
        (control, 0),
        ([*gps, *control, bar, focal], 0),
        ([bar, focal], 6),
        ([focal], 7),
        (gps[:1], 4),
        ([gps[0], bar], 3),
    ):
        N = J.T @ J
        for prior in priors:
            row = np.zeros((3, dense.size))
            if isinstance(prior, eg.PositionPrior):
                row[:, dense.view(prior.view).start + 3 : dense.view(prior.view).stop] = np.eye(3)
                row /= np.broadcast_to(prior.sigma, 3)[:, None]
            elif isinstance(prior, eg.PointPrior):
                row[:, dense.point(prior.point)] = np.eye(3)
                row /= np.broadcast_to(prior.sigma, 3)[:, None]
            elif isinstance(prior, eg.Distance):
                apart = (scene.X[2] - scene.X[5]) / prior.length / prior.sigma
                row[0, dense.point(2)], row[0, dense.point(5)] = apart, -apart
            else:
                row[0, dense.camera(0).start] = 1.0 / prior.sigma
            N = N + row.T @ row
        cov = eg.covariance(tracks, scene, None, 1.0, refine=names, priors=priors)
        assert cov.open == open_
        C = none
        if open_:
            # Inner constraints of the motions that are still free.
            G = dense.similarities()
            held = (N - J.T @ J) @ G / np.linalg.norm(G, axis=0)
            free = np.linalg.svd(held)[2][7 - open_ :].T / np.linalg.norm(G, axis=0)[:, None]
            C = np.zeros((dense.size, open_))
            C[dense.point(0).start :] = (G @ free)[dense.point(0).start :]
        expected = dense.covariance(N, C)
        assert_same(cov, dense, expected, 2e-6)
        a, b = dense.point(2), dense.point(5)
        apart = (scene.X[2] - scene.X[5]) / bar.length
        spread = expected[a, a] + expected[b, b] - expected[a, b] - expected[b, a]
        assert cov.distance(2, 5)[1] == pytest.approx(np.sqrt(apart @ spread @ apart), rel=1e-6)


def test_what_no_datum_changes_is_propagated_alike_in_all() -> None:
    """Ratios, angles and relative poses: as by differences, and the same in every datum."""
    tracks, scene = metric_scene("SIMPLE_RADIAL", 2, n_points=16, n_cameras=1)
    dense = Dense(scene, ("f", "k"))
    J = dense.jacobian(lambda s: s.project(tracks).ravel())
    bar = eg.Distance(2, 5, float(np.linalg.norm(scene.X[2] - scene.X[5])), 0.003)
    row = np.zeros(dense.size)
    row[dense.point(2)] = (scene.X[2] - scene.X[5]) / bar.length / bar.sigma
    row[dense.point(5)] = -row[dense.point(2)]
    datum, C = conditions(dense, "all points")
    expected = dense.covariance(J.T @ J + np.outer(row, row), C[:, :6])
    first = eg.covariance(tracks, scene, datum, 1.0, refine=("f", "k"), priors=[bar])

    def ratio(s: eg.MetricReconstruction) -> float:
        return float(np.linalg.norm(s.X[1] - s.X[2]) / np.linalg.norm(s.X[3] - s.X[4]))

    def angle(s: eg.MetricReconstruction) -> float:
        a, b = s.X[1] - s.X[7], s.X[2] - s.X[7]
        return float(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))

    def relative(s: eg.MetricReconstruction) -> Array:
        turn = s.R[1] @ s.R[3].T @ scene.R[3] @ scene.R[1].T
        K = 0.5 * (turn - turn.T)
        return np.r_[K[2, 1], K[0, 2], K[1, 0], s.R[1] @ (s.centres[3] - s.centres[1])]

    for name in DATUMS:
        cov = first.in_gauge(conditions(dense, name)[0])
        for found, function in (
            (cov.ratio((1, 2), (3, 4)), ratio),
            (cov.angle(1, 7, 2), angle),
        ):
            slope = dense.jacobian(lambda s, f=function: np.array([f(s)]))[0]
            assert found[0] == pytest.approx(function(scene), rel=1e-12)
            assert found[1] == pytest.approx(np.sqrt(slope @ expected @ slope), rel=1e-6)
        R, c, block = cov.relative_pose(1, 3)
        np.testing.assert_allclose(R, scene.R[3] @ scene.R[1].T)
        np.testing.assert_allclose(c, relative(scene)[3:])
        slopes = dense.jacobian(relative)
        np.testing.assert_allclose(
            block, slopes @ expected @ slopes.T, rtol=1e-5, atol=1e-6 * np.abs(block).max()
        )


def test_projections_are_propagated_alike_in_all_datums() -> None:
    """Into views of the network, and into a new one mounted to a view: as by differences."""
    tracks, scene = metric_scene("SIMPLE_RADIAL", 2, n_points=16, n_cameras=2)
    dense = Dense(scene, ("f", "k"))
    blank = eg.Tracks(*np.divmod(np.arange(64), 16), np.zeros((64, 2)))
    J = dense.jacobian(lambda s: s.project(tracks).ravel())

    def at(i: int, j: int) -> int:
        """Return the row of a view and a point."""
        return int(np.flatnonzero((blank.view == i) & (blank.point == j))[0])

    datum, C = conditions(dense, "all points")
    expected = dense.covariance(J.T @ J, C)
    options: dict[str, Any] = {"refine": ("f", "k")}
    first = eg.covariance(tracks, scene, datum, 1.0, **options)
    slopes = dense.jacobian(lambda s: s.project(blank).ravel()).reshape(64, 2, -1)
    turn, arm = turned(np.array([0.1, -0.2, 0.05])), np.array([0.4, -0.3, 0.2])
    vague = np.diag([1e-3, 2e-3, 1e-3, 0.02, 0.01, 0.03]) ** 2

    def mounted(s: eg.MetricReconstruction) -> eg.MetricReconstruction:
        """Return the scene with its first view replaced by one mounted to view 1."""
        R = s.R.copy()
        R[0] = turn @ s.R[1]
        centres = s.centres
        centres[0] = s.centres[1] + s.R[1].T @ arm
        return eg.MetricReconstruction(R, -np.einsum("nij,nj->ni", R, centres), s.X, s.cameras)

    own = dense.jacobian(lambda s: mounted(s).project(blank)[at(0, 6)])
    for name in DATUMS:
        cov = first.in_gauge(conditions(dense, name)[0])
        found = cov.of_projections(blank.view[[3, 20, 47]], blank.point[[3, 20, 47]])
        for block, k in zip(found, (3, 20, 47), strict=True):
            wanted = slopes[k] @ expected @ slopes[k].T
            np.testing.assert_allclose(block, wanted, atol=1e-6 * np.abs(wanted).max())
        R, centre, _ = cov.relative_pose(1, 2)
        # Of an arm of no length not even the scale matters.
        spread = cov.projection(6, turn, np.zeros(3), 1, relative_to=1)[1]
        same = first.projection(6, turn, np.zeros(3), 1, relative_to=1)[1]
        np.testing.assert_allclose(spread, same, atol=1e-8 * np.abs(same).max())
        xy, _ = cov.projection(5, R, centre, int(scene.cameras.camera_of_view[2]), relative_to=1)
        np.testing.assert_allclose(xy, scene.project(blank)[at(2, 5)], rtol=1e-10)
    xy, spread = first.projection(6, turn, arm, 0, relative_to=1)
    np.testing.assert_allclose(xy, mounted(scene).project(blank)[at(0, 6)], rtol=1e-12)
    wanted = own @ expected @ own.T
    np.testing.assert_allclose(spread, wanted, atol=1e-6 * np.abs(wanted).max())
    # The uncertainty of the mount itself: turns about the axes of view 1, and the arm.
    more = first.projection(6, turn, arm, 0, relative_to=1, covariance=vague)[1] - spread
    step, rows = 1e-6, []
    for k in range(6):
        ends = []
        for sign in (1.0, -1.0):
            small = sign * step * np.eye(6)[k]
            R = turn @ turned(small[:3]).T
            ends.append(first.projection(6, R, arm + small[3:], 0, relative_to=1)[0])
        rows.append((ends[0] - ends[1]) / (2.0 * step))
    slope = np.stack(rows, axis=1)
    wanted = slope @ vague @ slope.T
    np.testing.assert_allclose(more, wanted, atol=1e-6 * np.abs(wanted).max())
    # A pose in the frame of the scene: intrinsics and point alone.
    k, scene_pose = at(3, 6), (scene.R[3], scene.centres[3])
    camera, point = dense.camera(1), dense.point(6)
    own = slopes[k][:, np.r_[camera, point]]
    alone = expected[np.ix_(np.r_[camera, point], np.r_[camera, point])]
    xy, spread = first.projection(6, *scene_pose, 1)
    np.testing.assert_allclose(xy, scene.project(blank)[k], rtol=1e-12)
    np.testing.assert_allclose(spread, own @ alone @ own.T, atol=1e-6 * np.abs(spread).max())
    for call, name_ in (
        (lambda: first.projection(99, turn, arm), "point"),
        (lambda: first.projection(0, 2.0 * turn, arm), "R"),
        (lambda: first.projection(0, turn, arm, 7), "camera"),
        (lambda: first.projection(0, turn, [0.0, 1.0]), "centre"),
        (lambda: first.projection(0, turn, arm, relative_to=9), "relative_to"),
        (lambda: first.projection(0, turn, arm, covariance=-np.eye(6)), "covariance"),
        (lambda: first.of_projections([0], [99]), "point"),
        (lambda: first.of_projections([0.5], [1]), "view"),
    ):
        with pytest.raises(eg.ArgumentError) as error:
            call()
        assert error.value.argument == name_


def test_fixed_views_and_points_have_no_variance() -> None:
    tracks, scene = metric_scene("PINHOLE", 5, n_points=16)
    dense = Dense(scene, ())
    N = dense.jacobian(lambda s: s.project(tracks).ravel())
    N = N.T @ N
    C = np.zeros((dense.size, 9))
    C[dense.view(1), :6], C[dense.point(4), 6:] = np.eye(6), np.eye(3)
    cov = eg.covariance(tracks, scene, None, 1.0, refine="pose", fixed_views=[1], fixed_points=[4])
    assert cov.open == 0
    assert_same(cov, dense, dense.covariance(N, C), 1e-6)
    assert not cov.camera(1).any()
    assert not cov.point(4).any()


def test_a_far_frame_of_another_scale_gives_the_same_covariance() -> None:
    tracks, scene = metric_scene("RADIAL", 6, n_points=20, noise_px=0.3)
    R = turned(np.array([0.3, -1.2, 0.7]))
    moved = eg.gauge.transform(scene, eg.gauge.similarity(250.0, R, [1e5, -3e4, 2e4]))
    here, there = (eg.covariance(tracks, s, noise_px=1.0, refine=("f",)) for s in (scene, moved))
    np.testing.assert_allclose(
        there.point(3), 250.0**2 * R @ here.point(3) @ R.T, atol=1e-6 * np.abs(there.point(3)).max()
    )
    np.testing.assert_allclose(there.std.intrinsics, here.std.intrinsics, rtol=1e-7)
    turn = here.camera(2)[:3, :3]
    np.testing.assert_allclose(there.camera(2)[:3, :3], R @ turn @ R.T, rtol=1e-5, atol=1e-14)


@pytest.mark.parametrize("each", ["observation", "coordinate"])
def test_sigma_weighs_as_whitened_measurements(each: str) -> None:
    """Adjustment and covariance are those of dense Gauss-Newton with every coordinate's own."""
    tracks, scene = metric_scene("SIMPLE_PINHOLE", 7, n_points=15, noise_px=0.5)
    rng = np.random.default_rng(1)
    shape = (len(tracks), 2) if each == "coordinate" else (len(tracks),)
    sigma = rng.uniform(0.2, 3.0, shape)
    measured = eg.Tracks(tracks.view, tracks.point, tracks.xy, sigma=sigma)
    both = np.broadcast_to(sigma.reshape(len(tracks), -1), (len(tracks), 2))
    result = eg.bundle_adjust(measured, scene, refine="pose", ftol=1e-15)
    dense = Dense(result.reconstruction, ())
    J = dense.jacobian(lambda s: s.project(measured).ravel()) / both.reshape(-1, 1)
    r = (result.fun / both).ravel()
    assert np.abs(J.T @ r).max() < 1e-5 * np.abs(J).max()
    assert result.cost == pytest.approx(0.5 * measured.unit**2 * float(r @ r), rel=1e-9)
    datum, C = conditions(dense, "all points")
    cov = eg.covariance(measured, result.reconstruction, datum, measured.unit, refine="pose")
    assert_same(cov, dense, dense.covariance(J.T @ J, C), 1e-5)
    # The order of the rows is nobody's business.
    order = rng.permutation(len(tracks))
    shuffled = eg.Tracks(
        tracks.view[order], tracks.point[order], tracks.xy[order], sigma=sigma[order]
    )
    np.testing.assert_array_equal(shuffled.weights, measured.weights)


def test_noise_is_estimated_with_the_redundancy() -> None:
    tracks, scene = metric_scene("SIMPLE_RADIAL", 8, n_views=6, n_points=60, noise_px=0.8)
    result = eg.bundle_adjust(tracks, scene, refine=("f", "k"))
    cov = eg.covariance(tracks, result.reconstruction, refine=("f", "k"))
    assert cov.redundancy == 2 * len(tracks) - 6 * 6 - 2 * 2 - 3 * 60 + 7
    assert cov.noise_px**2 == pytest.approx(np.sum(result.fun**2) / cov.redundancy, rel=1e-9)
    assert cov.noise_px == pytest.approx(0.8, rel=0.15)


def test_errors_of_many_runs_are_as_promised() -> None:
    """Monte Carlo: chi-square of a distance's ratio, an intrinsic and a point, 60 runs."""
    blank, scene = metric_scene("SIMPLE_RADIAL", 9, n_views=5, n_points=25, visible=1.0)
    datum = eg.gauge.five_points([0, 1, 2])
    clean, squares = scene.project(blank), []
    for seed in range(60):
        xy = clean + np.random.default_rng(seed).normal(0.0, 0.5, clean.shape)
        tracks = eg.Tracks(blank.view, blank.point, xy)
        found = eg.bundle_adjust(tracks, scene, refine=("f",)).reconstruction
        cov = eg.covariance(tracks, found, datum, 0.5, refine=("f",))
        moves = [datum.similarity(np.zeros((0, 12)), s.X) for s in (found, scene)]
        there = moves[1].inverse().positions(moves[0].positions(found.X))
        off = there[7] - scene.X[7]
        f_off = found.cameras.params[0, 0] - scene.cameras.params[0, 0]
        squares.append(
            (
                off @ np.linalg.solve(cov.point(7), off) / 3.0,
                (f_off / cov.std.intrinsics[0, 0]) ** 2,
            )
        )
    mean = np.mean(squares, axis=0)
    # Four standard deviations of such means.
    assert abs(mean[0] - 1.0) < 4.0 * np.sqrt(2.0 / 180.0)
    assert abs(mean[1] - 1.0) < 4.0 * np.sqrt(2.0 / 60.0)


def test_bad_arguments_are_named() -> None:
    tracks, scene = metric_scene("PINHOLE", 0, n_points=12)
    cov = eg.covariance(tracks, scene, noise_px=1.0, refine="pose")
    rows = tracks.view, tracks.point, tracks.xy
    for call, name in (
        (lambda: cov.between(("camera", 9), ("point", 0)), "a"),
        (lambda: cov.between(("point", 0), ("face", 1)), "b"),
        (lambda: cov.in_gauge("outer"), "gauge"),
        (lambda: cov.in_gauge(eg.gauge.inner(points=[99])), "gauge.points"),
        (lambda: cov.in_gauge(eg.gauge.inner(points=[0, 1])), "gauge"),
        (lambda: eg.covariance(tracks, scene, noise_px=-1.0), "noise_px"),
        (lambda: eg.covariance(tracks, scene, loss="hubert"), "loss"),
        (lambda: eg.covariance(tracks, scene.to_projective(), priors=[]), "priors"),
        (lambda: eg.Tracks(tracks.view, tracks.point, tracks.xy, sigma=0.0), "sigma"),
        (lambda: eg.Tracks(tracks.view, tracks.point, tracks.xy, sigma=[1.0, 2.0]), "sigma"),
        (lambda: eg.Tracks(*rows, covariance=[[1.0, 2.0], [2.0, 1.0]]), "covariance"),
        (lambda: eg.Tracks(*rows, covariance=np.ones((3, 2, 2))), "covariance"),
        (lambda: eg.Tracks(*rows, covariance=np.eye(2), sigma=1.0), "covariance"),
        (lambda: eg.Tracks(*rows, covariance=[[1.0, 0.5], [0.2, 1.0]]), "covariance"),
        (lambda: eg.Tracks(*rows, covariance=[[1.0, np.nan], [np.nan, 1.0]]), "covariance"),
        (lambda: eg.bundle_adjust(tracks, scene, priors=[eg.Distance(0, 0, 1.0, 1.0)]), "priors"),
        (lambda: eg.bundle_adjust(tracks, scene, priors=[eg.Distance(0, 1, -1.0, 1.0)]), "priors"),
    ):
        with pytest.raises(eg.ArgumentError) as error:
            call()
        assert error.value.argument.startswith(name)


@pytest.fixture(scope="module")
def network(data_dir: Path) -> tuple[Any, eg.Tracks, eg.MetricReconstruction, eg.Distance]:
    """Return the metrology network: its file, observations, start and scale bar."""
    path = data_dir / "metrology_aicon" / "network.npz"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    file = dict(np.load(path))
    turns = [
        turned(np.array([a, 0, 0])) @ turned(np.array([0, b, 0])) @ turned(np.array([0, 0, c]))
        for a, b, c in file["start_angles"]
    ]
    R = np.swapaxes(np.stack(turns), 1, 2)
    c, x0, y0, A1, A2, B1, B2 = file["start_camera"]
    row = [c, x0, y0, A1, A2, file["fixed_A3"], B1, B2, file["fixed_C1"], file["fixed_C2"]]
    cameras = eg.Cameras("brown", [[*row, file["r0"]]], np.zeros(len(R), int))
    t = -np.einsum("nij,nj->ni", R, file["start_position"])
    start = eg.MetricReconstruction(R, t, file["start_points"], cameras)
    tracks = eg.Tracks(file["view"], file["point"], file["xy"], sigma=file["sigma"], min_points=3)
    ends = map(int, file["scale_bar_points"])
    bar = eg.Distance(*ends, float(file["scale_bar_length"]), float(file["scale_bar_sigma"]))
    return file, tracks, start, bar


def test_the_report_of_a_metrology_network_is_reached(network: Any, data_dir: Path) -> None:
    file, tracks, start, bar = network
    free = tuple(file["camera_names"].tolist())
    result = eg.bundle_adjust(tracks, start, refine=free, priors=[bar], ftol=1e-10)
    assert result.success
    assert result.nit <= 8
    assert result.cost / tracks.unit**2 == pytest.approx(6179.7037971, rel=1e-8)
    # Into the frame of the report, which the free network leaves open.
    there, found = file["own_points"], result.reconstruction
    a, b = found.X - found.X.mean(axis=0), there - there.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    shift = there.mean(axis=0) - R @ found.X.mean(axis=0)
    found = eg.gauge.transform(found, eg.gauge.similarity(1.0, R, shift))
    np.testing.assert_allclose(found.X, there, atol=1e-6)
    cov = eg.covariance(tracks, found, refine=free, priors=[bar])
    assert (cov.redundancy, cov.open) == (18804, 6)
    assert cov.noise_px == pytest.approx(0.40536263e-3, rel=1e-7)
    names = camera_model("brown").adjusted
    own = [names.index(name) for name in free]
    np.testing.assert_allclose(cov.std.intrinsics[0, own], file["camera_sd"], rtol=1e-5)
    # As printed, to half a unit of the last digit.
    np.testing.assert_allclose(cov.std.centres, file["position_sd"], atol=5.1e-5)
    np.testing.assert_allclose(cov.std.points, file["points_sd"], atol=5.1e-5)
    np.testing.assert_allclose(2.0 * cov.std.rotations, file["rotation_sd_report"], atol=5.1e-7)
    np.testing.assert_allclose(
        cov.intrinsics(0)[np.ix_(own, own)], file["own_camera_cov"], rtol=1e-6
    )
    corr = cov.between(("camera", 7), ("intrinsics", 0))[3:, own]
    corr = corr / np.outer(cov.std.centres[7], cov.std.intrinsics[0, own])
    np.testing.assert_allclose(corr, file["position_camera_corr"][7], atol=6e-4)
    length, sigma = cov.distance(50, 55)
    assert length == pytest.approx(1651.0013, abs=1e-4)
    assert sigma == pytest.approx(0.01196, rel=5e-4)
    full = np.load(data_dir / "metrology_aicon" / "points_covariance.npz")["own_points_cov_full"]
    some = range(0, 150, 11)
    for i in some:
        for j in some:
            np.testing.assert_allclose(
                cov.between(("point", i), ("point", j)),
                full[3 * i : 3 * i + 3, 3 * j : 3 * j + 3],
                atol=1e-8 * np.abs(full).max(),
            )


def test_points_far_away_do_not_spoil_a_datum_of_near_ones() -> None:
    """Three points at ten million times the distance: the same as in a scene without them."""
    tracks, scene = metric_scene("PINHOLE", 11, n_points=25, visible=1.0)
    far = np.r_[scene.X, 1e7 * np.array([[1.0, 0.2, 0.1], [-0.4, 0.3, 1.0], [0.2, -0.1, -1.0]])]
    wide = eg.MetricReconstruction(scene.R, scene.t, far, scene.cameras)
    seen = wide.depths(eg.Tracks(*np.nonzero(np.ones((4, 28))), np.zeros((112, 2)))) > 0.0
    view, point = np.nonzero(np.ones((4, 28)))
    order = np.lexsort((view, point))
    keep = (point[order] < 25) | seen
    blank = eg.Tracks(view[order][keep], point[order][keep], np.zeros((int(keep.sum()), 2)))
    with_far = eg.Tracks(blank.view, blank.point, wide.project(blank))
    near = list(range(25))
    options: dict[str, Any] = {"noise_px": 1.0, "refine": "pose"}
    a = eg.covariance(tracks, scene, eg.gauge.inner(points=near), **options)
    b = eg.covariance(with_far, wide, eg.gauge.inner(points=near), **options)
    # Far points tell of the rotations, and nothing but that.
    assert (b.std.points[:25] <= a.std.points * (1.0 + 1e-6)).all()
    assert (b.std.points[:25] >= 0.3 * a.std.points).all()


@pytest.mark.parametrize("model", ["brown", "brown_measured"])
def test_a_network_with_control_points_agrees_with_dense_algebra(model: str) -> None:
    """As the report of a network: sigma0, redundancy, intrinsics, positions and points.

    With the distortion on the side of the image, and on the side of the measurements.
    """
    tracks, scene = metric_scene(
        model, 12, n_views=7, n_points=40, n_cameras=1, visible=0.8, noise_px=0.4
    )
    if model == "brown_measured":  # a lens that moves the corners by some pixels
        k = scene.cameras.params.copy()
        k[0, 3:] = 3e-8, -2e-14, 1e-20, 2e-6, -3e-6, 2e-4, -1e-4, 150.0
        scene = eg.MetricReconstruction(
            scene.R, scene.t, scene.X, eg.Cameras(model, k, scene.cameras.camera_of_view)
        )
        noise = np.random.default_rng(5).normal(0.0, 0.4, tracks.xy.shape)
        tracks = eg.Tracks(tracks.view, tracks.point, scene.project(tracks) + noise)
    rng = np.random.default_rng(3)
    sigma = rng.choice([0.3, 0.5, 2.0], (len(tracks), 2))
    tracks = eg.Tracks(tracks.view, tracks.point, tracks.xy, sigma=sigma)
    names, control = ("c", "x0", "y0", "B1"), [0, 7, 19, 31]
    options: dict[str, Any] = {"refine": names, "fixed_points": control}
    result = eg.bundle_adjust(tracks, scene, ftol=1e-15, **options)
    found = result.reconstruction
    np.testing.assert_array_equal(found.X[control], scene.X[control])
    dense = Dense(found, names)
    J = -dense.jacobian(lambda s: (compared(s, tracks) / sigma).ravel())
    r = (compared(found, tracks) / sigma).ravel()
    held = np.zeros((dense.size, 3 * len(control)))
    for k, j in enumerate(control):
        held[dense.point(j), 3 * k : 3 * k + 3] = np.eye(3)
    redundancy = len(r) - (dense.size - held.shape[1])
    free = ~held.any(axis=1)
    assert np.abs(J.T @ r)[free].max() < 1e-4 * np.abs(J).max()
    cov = eg.covariance(tracks, found, **options)
    assert (cov.redundancy, cov.open) == (redundancy, 0)
    sigma0 = float(np.sqrt(r @ r / redundancy))
    assert cov.noise_px == pytest.approx(sigma0 * tracks.unit, rel=1e-9)
    expected = sigma0**2 * dense.covariance(J.T @ J, held)
    assert_same(cov, dense, expected, 1e-5)
    assert result.cost == pytest.approx(0.5 * (r @ r) * tracks.unit**2, rel=1e-9)
    # A point in a known view, in pixels as measured: by differences of `project`.
    row = int(np.flatnonzero((tracks.view == 2) & ~np.isin(tracks.point, control))[0])
    slope = dense.jacobian(lambda s: s.project(tracks)[row])
    slope[:, dense.view(2)] = 0.0
    ends = []  # a step of B1 as is small for one, where the image is no linear function of it
    for step in (1e-9, -1e-9):
        k = found.cameras.params + step * (np.array(camera_model(model).params) == "B1")
        there = eg.Cameras(model, k, found.cameras.camera_of_view)
        scene = eg.MetricReconstruction(found.R, found.t, found.X, there)
        ends.append(scene.project(tracks)[row])
    slope[:, dense.camera(0).start + 3] = (ends[0] - ends[1]) / 2e-9
    xy, spread = cov.projection(int(tracks.point[row]), found.R[2], found.centres[2])
    np.testing.assert_allclose(xy, found.project(tracks)[row], rtol=1e-12)
    wanted = slope @ expected @ slope.T
    np.testing.assert_allclose(spread, wanted, rtol=0.0, atol=1e-4 * np.abs(wanted).max())
