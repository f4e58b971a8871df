"""Lines beside points with projective cameras: start, steps in any basis, rank, strategies."""

from __future__ import annotations

import dataclasses

import epigauge as eg
import numpy as np
import pytest
from epigauge import lm
from epigauge.bundle.dampings import Covariant
from epigauge.kernels import table
from epigauge.multi_view.line_adjust import line_problem


def off(found, wanted):
    """Return the distances of lines of length one from others, their signs being free."""
    wanted = wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
    sign = np.sign(np.sum(found * wanted, axis=1))[:, None]
    return np.linalg.norm(found * sign - wanted, axis=1)


@pytest.fixture(scope="module")
def scene():
    return eg.line_scene(n_views=5, n_points=20, n_lines=20, seed=4)


@pytest.fixture(scope="module")
def start(scene):
    return scene.true.to_projective()


@pytest.fixture(scope="module")
def adjusted(scene, start):
    return eg.bundle_adjust(scene.tracks, start, lines=scene.line_tracks, ftol=1e-13)


def bases(count, n, m, seed=5):
    """Yield changes of basis of condition up to about 50, and scales."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        U, V = (np.linalg.qr(random.standard_normal((4, 4)))[0] for _ in range(2))
        T = U @ np.diag(np.exp(random.uniform(-2, 2, 4))) @ V
        yield T, np.exp(random.standard_normal(n)), -np.exp(random.standard_normal(m))


def test_exact_segments_give_the_lines():
    scene = eg.line_scene(noise_px=0.0, n_lines=20)
    found = eg.triangulate_lines(scene.line_tracks, scene.true.to_projective())
    assert off(found, scene.true.lines).max() < 1e-9


def test_projective_and_calibrated_cameras_see_the_same_lines(scene, start):
    calibrated = eg.triangulate_lines(scene.line_tracks, scene.true)
    assert off(eg.triangulate_lines(scene.line_tracks, start), calibrated).max() < 1e-6


def test_lines_at_infinity_are_lines_like_others():
    scene = eg.line_scene(noise_px=0.0, n_lines=20, n_points=20)
    start = scene.true.to_projective()
    # The plane of infinity becomes one that the lines cross, and one of them is taken there.
    foot = np.cross(scene.true.lines[3, 3:], scene.true.lines[3, :3])
    plane = np.append(foot, -foot @ foot)
    T = np.linalg.inv(np.vstack([np.eye(3, 4), plane]))
    moved = eg.gauge.transform(start, T)
    assert np.linalg.norm(moved.lines[3, 3:]) < 1e-12
    found = eg.triangulate_lines(scene.line_tracks, moved)
    assert off(found, moved.lines).max() < 1e-9
    fitted = eg.bundle_adjust(scene.tracks, moved, lines=scene.line_tracks)
    assert np.abs(fitted.line_fun).max() < 1e-6


def test_an_adjustment_is_determined_and_fits(scene, adjusted):
    assert adjusted.success
    assert not adjusted.flags
    n, m, k = 5, 20, 20
    assert adjusted.rank == 11 * n + 3 * m + 4 * k - 15
    redundancy = 2 * n * m + 2 * n * k - adjusted.rank
    assert abs(2 * adjusted.cost / redundancy - 1) < 4 * np.sqrt(2 / redundancy)
    total = np.sum(adjusted.fun**2) + np.sum(adjusted.line_fun**2)
    np.testing.assert_allclose(0.5 * total, adjusted.cost, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(adjusted.reconstruction.lines, axis=1), 1.0)
    # No start at all is one as of points alone.
    alone = eg.bundle_adjust(scene.tracks, lines=scene.line_tracks, ftol=1e-13)
    np.testing.assert_allclose(alone.cost, adjusted.cost, rtol=1e-7)


def test_steps_are_the_same_in_twenty_bases(scene, start):
    moved = [start, *(eg.gauge.transform(start, *how) for how in bases(20, 5, 20))]
    costs, taken = [], []
    for own in moved:
        made = line_problem(scene.tracks, own, scene.line_tracks, table(), embedded=True)
        how = lm.Classic(), lm.Stopping(1e-14, 0.0, 0.0, 4)
        outcome = lm.minimize(made.problem, made.start, Covariant(), *how)
        costs.append([row.cost for row in outcome.history])
        taken.append(
            made.problem.kinds[0].residuals(outcome.state.cameras, outcome.state.others[0])
        )
    assert len(costs[0]) >= 4
    assert costs[0][1] < 0.999 * costs[0][0]
    for other, r in zip(costs[1:], taken[1:], strict=True):
        np.testing.assert_allclose(other, costs[0], rtol=1e-7)
        np.testing.assert_allclose(np.abs(r), np.abs(taken[0]), atol=1e-7)


def test_a_far_start_takes_the_same_steps_in_other_bases():
    scene = eg.line_scene(n_views=4, n_points=15, n_lines=15, seed=6)
    random, true = np.random.default_rng(0), scene.true.to_projective()
    P = true.P * (1.0 + 0.15 * random.standard_normal(true.P.shape))
    start, histories = eg.Reconstruction(P, true.Q), []
    for own in [start, *(eg.gauge.transform(start, *how) for how in bases(4, 4, 15))]:
        found = eg.bundle_adjust(scene.tracks, own, lines=scene.line_tracks, max_iter=60)
        histories.append([row.cost for row in found.history])
    first = histories[0]
    assert first[-1] < 0.01 * first[0]
    for other in histories[1:]:
        assert len(other) == len(first)
        np.testing.assert_allclose(other, first, rtol=1e-5)


@pytest.mark.parametrize("backend", ["numpy", "c", "casadi"])
def test_back_ends_end_at_one_minimum(scene, start, adjusted, backend):
    if eg.kernels.available()[backend] is not None:
        pytest.skip(str(eg.kernels.available()[backend]))
    found = eg.bundle_adjust(scene.tracks, start, lines=scene.line_tracks, backend=backend)
    np.testing.assert_allclose(found.cost, adjusted.cost, rtol=1e-6)


@pytest.mark.parametrize(
    "method",
    ["levenberg", "marquardt", "hartley", "bartoli", "faugeras", "mclauchlan", "kanatani"],
)
def test_other_methods_end_at_the_same_minimum(scene, start, adjusted, method):
    options = {"lines": scene.line_tracks, "method": method, "ftol": 1e-10}
    found = eg.bundle_adjust(scene.tracks, start, **options)
    np.testing.assert_allclose(found.cost, adjusted.cost, rtol=1e-4)
    assert found.rank == adjusted.rank
    # Lines are where cameras and points are.
    again = eg.triangulate_lines(scene.line_tracks, found.reconstruction)
    assert off(found.reconstruction.lines, again).max() < 0.05


def test_fixed_views_and_points_stay(scene, start):
    options = {"fixed_views": [0], "fixed_points": [2, 5]}
    found = eg.bundle_adjust(scene.tracks, start, lines=scene.line_tracks, **options)
    assert found.success
    assert (found.reconstruction.P[0] == start.P[0]).all()
    assert (found.reconstruction.Q[[2, 5]] == start.Q[[2, 5]]).all()
    alone = eg.bundle_adjust(scene.tracks, start, **options)
    assert found.rank == alone.rank + 4 * 20


def test_a_robust_loss_bears_wrong_segments(scene, start):
    lines = scene.line_tracks
    segments = lines.segments.copy()
    segments[[3, 40]] += [150.0, -40.0, -120.0, 90.0]
    wrong = eg.LineTracks(lines.view, lines.line, segments)
    found = eg.bundle_adjust(scene.tracks, start, lines=wrong)
    assert {"gross errors", "outliers", "wrong segments"} & set(found.flags)
    robust = eg.bundle_adjust(scene.tracks, start, lines=wrong, loss="cauchy")
    assert np.flatnonzero(np.abs(robust.line_fun).max(axis=1) > 12).tolist() == [3, 40]


def test_changes_of_basis_take_lines_along(scene, start):
    images = table("numpy").line_project
    wanted = images(start.P.transpose(1, 2, 0)[..., :1], start.lines.T)
    for T, gamma, alpha in bases(3, 5, 20):
        moved = eg.gauge.transform(start, T, gamma, alpha)
        found = images(moved.P.transpose(1, 2, 0)[..., :1], moved.lines.T)
        cosine = np.sum(found * wanted, axis=0) / np.linalg.norm(found, axis=0)
        np.testing.assert_allclose(np.abs(cosine), np.linalg.norm(wanted, axis=0), rtol=1e-9)


def test_bad_lines_and_starts_are_named(scene, start):
    lines = scene.line_tracks
    with pytest.raises(eg.ArgumentError, match="no line in row 1"):
        eg.Reconstruction(start.P, start.Q, [[1, 0, 0, 0, 1, 0], [1, 0, 0, 1, 0, 0]])
    for bad in (np.zeros((1, 6)), np.full((1, 6), np.nan), np.ones((2, 5))):
        with pytest.raises(eg.ArgumentError, match="lines"):
            eg.Reconstruction(start.P, start.Q, bad)
    assert eg.Reconstruction(start.P, start.Q, np.zeros((0, 6))).lines is None
    fewer = dataclasses.replace(start, lines=start.lines[:3])
    with pytest.raises(eg.ArgumentError, match="has 3 lines"):
        eg.bundle_adjust(scene.tracks, fewer, lines=lines)
    for options, name in (
        ({"method": "free"}, "method"),
        ({"damping": "gauge_invariant"}, "damping"),
        ({"gauge_mode": "implicit", "gauge": eg.gauge.normalized()}, "gauge_mode"),
        ({"priors": [eg.PositionPrior(0, [0, 0, 0], 1.0)]}, "priors"),
        ({"robust": True}, "robust"),
    ):
        with pytest.raises(eg.ArgumentError, match=name):
            eg.bundle_adjust(scene.tracks, start, lines=lines, **options)
    affine = eg.AffineReconstruction(np.ones((5, 2, 4)), np.zeros((20, 3)))
    with pytest.raises(eg.ArgumentError, match="is a AffineReconstruction"):
        lines.pieces(affine)
    with pytest.raises(eg.ArgumentError, match="to_projective"):
        eg.bundle_adjust(scene.tracks, affine, lines=lines)


def test_text_tells_of_lines(start):
    assert "20 points, 20 lines" in str(start)
    assert "lines" not in str(dataclasses.replace(start, lines=None))


def jacobian(made):
    """Return the derivatives of all residuals of points, then of lines, by all unknowns."""
    of_points, (of_lines,), at = made.problem.linearizer, made.problem.kinds, made.start
    n, m, k = len(at.cameras), len(at.points), len(at.others[0])
    rows = []
    for own, features, first in (
        (of_points, at.points, 12 * n),
        (of_lines, at.others[0], 12 * n + 4 * m),
    ):
        _, A, B = own.observe(at.cameras, features)
        J = np.zeros((A.shape[2], 2, 12 * n + 4 * m + 4 * k))
        for row, i, j, a, b in zip(J, own.graph.view, own.graph.point, A.T, B.T, strict=True):
            row[:, 12 * i : 12 * i + 12] = a.T
            row[:, first + 4 * j : first + 4 * j + 4] = b.T
        rows.append(J)
    return np.concatenate(rows)


def test_covariances_of_images_are_those_of_a_dense_inverse(scene, adjusted):
    tracks, lines, found = scene.tracks, scene.line_tracks, adjusted.reconstruction
    J = jacobian(line_problem(tracks, found, lines, table("numpy")))
    whole = J.reshape(-1, J.shape[2])
    values = np.linalg.svd(whole, compute_uv=False)
    assert np.count_nonzero(values > 1e-10 * values[0]) == adjusted.rank
    hat = whole @ np.linalg.pinv(whole, rcond=1e-10)
    wanted = np.stack([hat[k : k + 2, k : k + 2] for k in range(0, len(hat), 2)])
    for gauge in (None, eg.gauge.normalized(), eg.gauge.two_cameras()):
        cov = eg.covariance(tracks, found, gauge, noise_px=2.0, lines=lines)
        np.testing.assert_allclose(cov.projections, 4.0 * wanted[: len(tracks)], atol=1e-9)
        np.testing.assert_allclose(cov.line_projections, 4.0 * wanted[len(tracks) :], atol=1e-9)
        assert len(cov.reconstruction.lines) == lines.n_lines
    some = cov.of_projections(tracks.view[:3], tracks.point[:3])
    np.testing.assert_allclose(some, cov.projections[:3], atol=1e-9)
    redundancy = 2 * len(tracks) + 2 * len(lines) - adjusted.rank
    told = eg.covariance(tracks, found, lines=lines).noise_px
    assert told == pytest.approx(np.sqrt(2.0 * adjusted.cost / redundancy), rel=1e-6)


def test_errors_fall_as_the_covariance_says_and_lines_improve_the_images():
    squares, errors, told = [], [], []
    for seed in range(4):
        scene = eg.line_scene(n_views=8, n_points=20, n_lines=60, seed=seed)
        true, tracks = scene.true.to_projective(), scene.tracks
        exact, both = true.project(tracks), []
        for lines in (None, scene.line_tracks):
            found = eg.bundle_adjust(tracks, true, lines=lines).reconstruction
            S = eg.covariance(tracks, found, noise_px=1.0, lines=lines).projections
            e = found.project(tracks) - exact
            both.append(np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(S), e)) / 2.0)
            errors.append(np.mean(e**2))
            told.append(np.mean(np.einsum("nii->n", S)) / 2.0)
        squares.append(both)
    # 160 images of points a run share some 130 unknowns: four runs are good for a tenth.
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.25)
    for one in (errors, told):
        alone, mixed = np.mean(np.reshape(one, (4, 2)), axis=0)
        assert mixed < 0.9 * alone


def test_covariances_without_the_segments_of_lines_are_refused(scene, adjusted):
    found = adjusted.reconstruction
    with pytest.raises(eg.ArgumentError, match="has 20 lines"):
        eg.covariance(scene.tracks, found)
    alone = dataclasses.replace(found, lines=None)
    with pytest.raises(eg.ArgumentError, match="has no lines"):
        eg.covariance(scene.tracks, alone, lines=scene.line_tracks)
    with pytest.raises(eg.ArgumentError, match="'huber' with lines"):
        eg.covariance(scene.tracks, found, lines=scene.line_tracks, loss="huber")
    fewer = dataclasses.replace(found, lines=found.lines[:4])
    with pytest.raises(eg.ArgumentError, match="has 4 lines"):
        eg.covariance(scene.tracks, fewer, lines=scene.line_tracks)


@pytest.mark.parametrize("calibrated", [False, True])
def test_lines_of_two_views_are_no_reason_to_doubt_the_points(calibrated):
    scene = eg.line_scene(n_views=2, n_points=40, n_lines=60, seed=12)
    start = scene.true if calibrated else scene.true.to_projective()
    options = {"lines": scene.line_tracks} | ({"refine": "pose"} if calibrated else {})
    found = eg.bundle_adjust(scene.tracks, start, **options)
    assert np.abs(found.line_fun).max() < 0.05  # four numbers, four distances
    assert not {"outliers", "gross errors", "wrong segments"} & set(found.flags)


def test_files_keep_the_lines(tmp_path, scene, start):
    for write, read in (
        (
            lambda path: eg.save_scene(path, scene.tracks, start),
            lambda path: eg.load_scene(path)[1],
        ),
        (lambda path: eg.save_reconstruction(path, start), eg.load_reconstruction),
        (lambda path: eg.save_tracks(path, scene.tracks, start), eg.load_reconstruction),
    ):
        write(tmp_path / "scene.npz")
        found = read(tmp_path / "scene.npz")
        assert (found.lines == start.lines).all()
    file = eg.io.load_track_file(tmp_path / "scene.npz")
    assert (file.start.lines == start.lines).all()
    with pytest.raises(eg.ArgumentError, match="20 lines"):
        eg.save_tracks(tmp_path / "scene.txt", scene.tracks, start)
