"""Covariances of lines: against a dense inverse, in all datums and frames, and by simulation."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.bundle.lines import LineLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.kernels import table
from epigauge.multi_view.line_adjust import line_problem
from epigauge.two_view.losses import Loss
from numpy.typing import NDArray

Array = NDArray[np.float64]


def adjusted(scene: eg.LineScene, **options: Any) -> eg.MetricReconstruction:
    options = {"refine": "pose", "ftol": 1e-12} | options
    found = eg.bundle_adjust(scene.tracks, scene.true, lines=scene.line_tracks, **options)
    assert isinstance(found.reconstruction, eg.MetricReconstruction)
    return found.reconstruction


@pytest.fixture(scope="module")
def scene() -> eg.LineScene:
    return eg.line_scene(n_views=5, n_points=12, n_lines=8, seed=3)


@pytest.fixture(scope="module")
def found(scene: eg.LineScene) -> eg.MetricReconstruction:
    return adjusted(scene)


@pytest.fixture(scope="module")
def cov(scene: eg.LineScene, found: eg.MetricReconstruction) -> eg.MetricCovariance:
    lines = scene.line_tracks
    return eg.covariance(scene.tracks, found, noise_px=1.5, refine="pose", lines=lines)


def dense(scene: eg.LineScene, found: eg.MetricReconstruction) -> tuple[Any, LineLinearizer, Array]:
    """Return the problem of `scene`, its lines, and all derivatives, (200, 98)."""
    tracks, lines = scene.tracks, scene.line_tracks
    made = line_problem(tracks, found, lines, table(), refine="pose")
    at, job = made.start, made.job
    graph = ObservationGraph(tracks.view, tracks.point, 5, 12)
    parts = job.model, table(), graph, job.q, np.ones(60), Loss()
    _, A, B = NumpyLinearizer(*parts).observe(at.cameras, at.points)
    (kind,) = made.problem.kinds
    assert isinstance(kind, LineLinearizer)
    _, A_lines, B_lines = kind.observe(at.cameras, at.others[0])
    size = 6 * 5 + 3 * 12 + 4 * 8
    J = np.zeros((2, 100, size))
    for k in range(100):
        i = (tracks.view if k < 60 else lines.view)[k % 60]
        J[:, k, 6 * i : 6 * i + 6] = (A if k < 60 else A_lines)[:, :6, k % 60]
        first = 30 + 3 * tracks.point[k] if k < 60 else 66 + 4 * lines.line[k - 60]
        width = 3 if k < 60 else 4
        J[:, k, first : first + width] = (B if k < 60 else B_lines)[:, :, k % 60]
    return made, kind, J.reshape(-1, size)


def test_blocks_are_those_of_a_dense_inverse(
    scene: eg.LineScene, found: eg.MetricReconstruction, cov: eg.MetricCovariance
) -> None:
    made, kind, J = dense(scene, found)
    at, size = made.start, J.shape[1]
    _, values, Vt = np.linalg.svd(J)
    assert values[-7] < 1e-9 * values[-8]
    G, rest = Vt[-7:].T, Vt[:-7]
    X = (rest.T / values[:-7] ** 2) @ rest
    # Inner constraints over the points.
    K = np.zeros((7, size))
    K[:, 30:66] = G[30:66].T
    S = np.eye(size) - G @ np.linalg.solve(K @ G, K)
    X = 1.5**2 * S @ X @ S.T
    for k in (0, 5):
        own = slice(66 + 4 * k, 70 + 4 * k)
        np.testing.assert_allclose(cov.line_update(k), X[own, own], rtol=1e-5, atol=1e-12)
    # Updates in the frame that is computed in move the Pluecker coordinates of the scene.
    home, h = made.home.inverse(), 1e-6

    def slope(move: Any, count: int) -> Array:
        pair = [[move(s * h * step) for step in np.eye(count)] for s in (1, -1)]
        return np.subtract(*pair).T / (2 * h)

    def line(step: Array, k: int = 5) -> Array:
        steps = np.zeros((8, 4))
        steps[k] = step
        moved = kind.moved(at.cameras, at.others[0], steps)
        return kind.carried(home, moved)[k]

    D = slope(line, 4)
    of_point = home.scale * home.rotation
    of_centre = home.scale * found.R[2].T
    five, other = slice(86, 90), slice(78, 82)
    E = slope(lambda step: line(step, 3), 4)
    for second, wanted in (
        (("line", 5), X[five, five] @ D.T),
        (("line", 3), X[five, other] @ E.T),
        (("point", 7), X[five, 51:54] @ of_point.T),
    ):
        expected = D @ wanted
        tolerance = 1e-5 * np.abs(expected).max()
        np.testing.assert_allclose(cov.between(("line", 5), second), expected, atol=tolerance)
    expected = D @ X[five, 15:18] @ of_centre.T
    both = cov.between(("line", 5), ("camera", 2))
    np.testing.assert_allclose(both[:, 3:], expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(cov.between(("camera", 2), ("line", 5)), both.T, rtol=1e-8)


def test_coordinates_have_rank_four(
    found: eg.MetricReconstruction, cov: eg.MetricCovariance
) -> None:
    assert found.lines is not None
    assert cov.std.lines is not None
    for k, line in enumerate(found.lines):
        block = cov.line(k)
        values = np.linalg.eigvalsh(block)
        assert values[1] < 1e-10 * values[2]
        # The length of the direction stays, and n . v = 0.
        for fixed in (np.r_[np.zeros(3), line[3:]], np.r_[line[3:], line[:3]]):
            assert np.abs(block @ fixed).max() < 1e-10 * values[-1]
        np.testing.assert_allclose(cov.std.lines[k], np.sqrt(np.diag(block)), rtol=1e-9)


def test_what_is_measured_is_the_same_in_all_datums(
    scene: eg.LineScene, found: eg.MetricReconstruction, cov: eg.MetricCovariance
) -> None:
    there = cov.in_gauge(eg.gauge.two_cameras(0, 3))
    assert not np.allclose(there.line(2), cov.line(2), rtol=0.1)
    np.testing.assert_allclose(there.line_angle(2, 6), cov.line_angle(2, 6), rtol=1e-6)
    # In units of a length, the distance of a point from a line is free of the datum, too.
    options: Any = {"noise_px": 1.5, "refine": "pose", "lines": scene.line_tracks}
    fixed = eg.covariance(scene.tracks, found, fixed_views=[0], **options)
    assert fixed.open == 1
    assert fixed.in_gauge(eg.gauge.two_cameras(0, 3)).line_distance(1, 4)[1] > 0


def test_a_similarity_leaves_updates_and_angles_as_they_are(
    scene: eg.LineScene, found: eg.MetricReconstruction, cov: eg.MetricCovariance
) -> None:
    Q = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    moved = eg.gauge.transform(
        found, eg.gauge.similarity(7.0, Q * np.linalg.det(Q), np.array([50.0, -20.0, 9.0]))
    )
    lines = scene.line_tracks
    there = eg.covariance(scene.tracks, moved, noise_px=1.5, refine="pose", lines=lines)
    for k in range(8):
        np.testing.assert_allclose(there.line_update(k), cov.line_update(k), rtol=1e-5, atol=1e-14)
    np.testing.assert_allclose(there.line_angle(0, 3), cov.line_angle(0, 3), rtol=1e-6)
    distance, wanted = there.line_distance(2, 3), cov.line_distance(2, 3)
    np.testing.assert_allclose(distance, 7.0 * np.array(wanted), rtol=1e-6)


def test_measures_and_their_slopes_against_differences() -> None:
    random, kernels = np.random.default_rng(4), table()
    X, h = random.standard_normal(3), 1e-6
    lines = random.standard_normal((2, 6))
    distance = np.linalg.norm(np.cross(X, lines[0, 3:]) - lines[0, :3])
    distance /= np.linalg.norm(lines[0, 3:])
    u, v = (line[3:] / np.linalg.norm(line[3:]) for line in lines)
    both = (
        (kernels.point_line_distance, (X, lines[0]), distance),
        (kernels.line_angle, (lines[0], lines[1]), np.arccos(abs(u @ v))),
    )
    for function, inputs, wanted in both:
        value, slope = function(*inputs)
        np.testing.assert_allclose(value.ravel(), wanted, rtol=1e-12)
        flat, first = np.concatenate(inputs), len(inputs[0])
        for k, step in enumerate(h * np.eye(len(flat))):
            pair = [
                function((flat + s * step)[:first], (flat + s * step)[first:])[0] for s in (1, -1)
            ]
            np.testing.assert_allclose(np.subtract(*pair) / (2 * h), slope.ravel()[k], atol=1e-7)


def aligned(scene: eg.LineScene, found: eg.MetricReconstruction) -> eg.MetricReconstruction:
    """Return the truth where the inner datum has it: nearest to the points found."""
    a, b = scene.true.X.mean(axis=0), found.X.mean(axis=0)
    U, values, Vt = np.linalg.svd((found.X - b).T @ (scene.true.X - a))
    R = U @ Vt
    scale = float(values.sum() / np.sum((scene.true.X - a) ** 2))
    return eg.gauge.transform(scene.true, eg.gauge.similarity(scale, R, b - scale * R @ a))


def test_errors_fall_as_the_covariance_says() -> None:
    squares, angles = [], []
    for seed in range(6):
        scene = eg.line_scene(seed=seed)
        found = adjusted(scene)
        lines = scene.line_tracks
        cov = eg.covariance(scene.tracks, found, noise_px=1.0, refine="pose", lines=lines)
        true = aligned(scene, found)
        assert found.lines is not None
        assert true.lines is not None
        sides = np.sign(np.sum(found.lines[:, 3:] * true.lines[:, 3:], axis=1))[:, None]
        for k, error in enumerate(found.lines - sides * true.lines):
            values, axes = np.linalg.eigh(cov.line(k))
            squares.append(np.sum((axes.T @ error)[2:] ** 2 / values[2:]) / 4)
        for k in range(0, 60, 4):
            angle, sigma = cov.line_angle(k, k + 1)
            wanted = np.arccos(abs(true.lines[k, 3:] @ true.lines[k + 1, 3:]))
            angles.append((angle - wanted) / sigma)
    # Mean squares of 6 * 60 * 4 and of 90 numbers, those of one scene not independent.
    assert abs(np.mean(squares) - 1) < 0.15
    assert abs(np.std(angles) - 1) < 0.3


def test_lines_improve_the_cameras_as_they_say() -> None:
    scene = eg.line_scene(n_points=12, seed=2)
    without = eg.bundle_adjust(scene.tracks, scene.true, refine="pose").reconstruction
    assert isinstance(without, eg.MetricReconstruction)
    alone = eg.covariance(scene.tracks, without, noise_px=1.0, refine="pose")
    options: Any = {"noise_px": 1.0, "refine": "pose", "lines": scene.line_tracks}
    mixed = eg.covariance(scene.tracks, adjusted(scene), **options)
    both = [cov.relative_pose(0, 7)[2][:3, :3] for cov in (alone, mixed)]
    assert np.trace(both[1]) < 0.5 * np.trace(both[0])


def test_the_noise_is_that_of_both(scene: eg.LineScene, found: eg.MetricReconstruction) -> None:
    cov = eg.covariance(scene.tracks, found, refine="pose", lines=scene.line_tracks)
    assert cov.redundancy == 2 * 60 + 2 * 40 - 6 * 5 - 3 * 12 - 4 * 8 + 7
    assert abs(cov.noise_px - 1) < 0.25
    robust = eg.covariance(
        scene.tracks, found, refine="pose", lines=scene.line_tracks, loss="huber"
    )
    ratio = np.trace(robust.line(3)) / np.trace(cov.line(3))
    assert 0.5 < ratio < 2.0


def test_a_wrong_segment_counts_less_under_a_robust_loss(scene: eg.LineScene) -> None:
    lines = scene.line_tracks
    segments = lines.segments.copy()
    segments[7] += [60.0, 0.0, -40.0, 30.0]
    wrong = eg.LineTracks(lines.view, lines.line, segments)
    bent = eg.LineScene(scene.tracks, wrong, scene.true)
    found = adjusted(bent, loss="cauchy")
    cov = eg.covariance(scene.tracks, found, refine="pose", lines=wrong, loss="cauchy")
    assert 0.6 < cov.noise_px < 1.4
    linear = eg.covariance(scene.tracks, found, refine="pose", lines=wrong)
    assert linear.noise_px > 2.0


def test_priors_count_beside_lines_as_in_a_dense_inverse(scene: eg.LineScene) -> None:
    tracks, lines, true, noise = scene.tracks, scene.line_tracks, scene.true, 1.5
    length = float(np.linalg.norm(true.X[2] - true.X[9]))
    priors = [
        *(eg.PositionPrior(i, true.centres[i], 0.05) for i in (0, 2)),
        eg.PointPrior(4, true.X[4], 0.02),
        eg.Distance(2, 9, length, 0.01),
    ]
    found = adjusted(scene, priors=priors)
    options: dict[str, Any] = {"noise_px": noise, "refine": "pose", "lines": lines}
    cov = eg.covariance(tracks, found, priors=priors, **options)
    assert cov.open == 0
    made, _, J = dense(scene, found)
    at, size, scale = made.start, J.shape[1], made.home.scale

    def known(step: Array) -> Array:
        """Return what is known after a step, each number over its deviation."""
        own = np.zeros((5, at.cameras.shape[1] - 12 + 6))
        own[:, :6] = step[:30].reshape(5, 6)
        pose = made.problem.retraction(at.cameras, own)[:, :12].reshape(5, 3, 4)
        centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
        X = at.points + step[30:66].reshape(12, 3)
        away = np.linalg.norm(X[2] - X[9])
        return np.concatenate([*(centres[i] / 0.05 for i in (0, 2)), X[4] / 0.02, [away / 0.01]])

    h = 1e-6
    slopes = [(known(h * row) - known(-h * row)) / (2.0 * h) for row in np.eye(size)]
    rows = np.concatenate([J, noise / scale * np.transpose(slopes)])
    X = noise**2 * np.linalg.inv(rows.T @ rows)
    for k in (0, 5):
        own = slice(66 + 4 * k, 70 + 4 * k)
        np.testing.assert_allclose(cov.line_update(k), X[own, own], rtol=1e-5, atol=1e-12)
    turn = made.home.rotation / scale
    for j in (4, 9):
        own = slice(30 + 3 * j, 33 + 3 * j)
        np.testing.assert_allclose(cov.point(j), turn.T @ X[own, own] @ turn, rtol=1e-5, atol=1e-12)


def test_a_firm_prior_is_a_fixed_view_for_lines_too(
    scene: eg.LineScene, found: eg.MetricReconstruction
) -> None:
    options: dict[str, Any] = {"noise_px": 1.0, "refine": "pose", "lines": scene.line_tracks}
    firm = [eg.PositionPrior(1, found.centres[1], 1e-7), eg.RotationPrior(1, found.R[1], 1e-7)]
    held = eg.covariance(scene.tracks, found, fixed_views=[1], **options)
    known = eg.covariance(scene.tracks, found, priors=firm, **options)
    assert held.open == known.open == 1
    for k in range(8):
        np.testing.assert_allclose(known.line_update(k), held.line_update(k), rtol=1e-4, atol=1e-12)


def test_what_is_asked_wrongly_is_named(
    scene: eg.LineScene, found: eg.MetricReconstruction, cov: eg.MetricCovariance
) -> None:
    tracks, lines = scene.tracks, scene.line_tracks
    without = eg.MetricReconstruction(found.R, found.t, found.X, found.cameras)
    with pytest.raises(eg.ArgumentError, match="has no lines"):
        eg.covariance(tracks, without, lines=lines)
    with pytest.raises(eg.ArgumentError, match="LineTracks"):
        eg.covariance(tracks, found, lines=tracks)  # type: ignore[call-overload]
    with pytest.raises(eg.ArgumentError, match="line 0 to 7"):
        cov.line(8)
    with pytest.raises(eg.ArgumentError, match="parallel"):
        cov.line_angle(2, 2)
    alone = eg.covariance(tracks, without, noise_px=1.0, refine="pose")
    with pytest.raises(eg.ArgumentError, match="'line'"):
        alone.line(0)
