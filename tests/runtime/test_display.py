"""The basis for pictures: it finds the shape of a scene from any projective basis, unmirrored."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.multi_view.display import FAR_CAMERA, camera_spacing, display, is_sequence
from many_views import basis
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCENE = eg.multi_view_scene(n_points=60, noise_px=0.0, distance=3.0, baseline=1.2, focal=1000.0)
Y_UP = np.diag([1.0, -1.0, 1.0])


def seen_with_y_up() -> tuple[eg.Tracks, eg.Reconstruction]:
    """Return the scene with the y axis of its images pointing up, as in BAL files."""
    t = SCENE.tracks
    tracks = eg.Tracks(t.view, t.point, t.xy * [1.0, -1.0])
    return tracks, eg.Reconstruction(Y_UP @ SCENE.true.P, SCENE.true.Q)


def shape_error(found: Array, true: Array) -> float:
    """RMS distance after the best proper similarity, in units of the scene's size."""
    a, b = (x - x.mean(axis=0) for x in (found, true))
    U, values, Vt = np.linalg.svd(a.T @ b)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = np.sum(values * np.diag(D)) / np.sum(a**2)
    return float(np.sqrt(np.sum((scale * a @ U @ D @ Vt - b) ** 2) / np.sum(b**2)))


@pytest.mark.parametrize("seed", range(2))
def test_shape_is_found_from_any_basis(seed) -> None:
    rng = np.random.default_rng(seed)
    T = rng.normal(size=(4, 4))
    scales = rng.choice([-1, 1], 5) * rng.uniform(0.1, 10, 5), rng.normal(size=60)
    moved = eg.gauge.transform(SCENE.true, T, *scales)
    frame = display(moved, SCENE.tracks)
    assert frame.shown.all()
    assert not frame.distorted
    # Not a calibration: the guess of a usual focal length pulls by parts of a percent. The
    # mirrored scene would be off by 82 %.
    assert shape_error(frame.points, SCENE.true.Q[:, :3]) < 0.02
    true_centres = np.array([-np.linalg.solve(P[:, :3], P[:, 3]) for P in SCENE.true.P])
    assert shape_error(frame.centres, true_centres) < 0.05


@pytest.mark.parametrize(("y_up", "orientation"), [(False, -1.0), (True, 1.0), (True, -1.0)])
def test_euclidean_scene_comes_back_by_a_similarity_that_keeps_left_and_right(
    y_up, orientation
) -> None:
    tracks, true = seen_with_y_up() if y_up else (SCENE.tracks, SCENE.true)
    rng = np.random.default_rng(7)
    T = basis(rng, 10.0)
    T[:, 0] *= orientation * np.sign(np.linalg.det(T))
    scales = rng.choice([-1, 1], 5) * rng.uniform(0.1, 10, 5), rng.normal(size=60)
    moved = eg.Reconstruction(
        scales[0][:, None, None] * true.P @ np.linalg.inv(T), scales[1][:, None] * (true.Q @ T.T)
    )
    A = np.linalg.solve(T, display(moved, tracks, y_up=y_up).T)  # from the truth to the picture
    A = A / A[3, 3]
    size = np.cbrt(np.linalg.det(A[:3, :3]))
    assert size > 0.0  # mirrored, if negative
    # The guess of a usual focal length pulls by parts of a percent.
    np.testing.assert_allclose(A[:3, :3] @ A[:3, :3].T / size**2, np.eye(3), atol=0.05)
    np.testing.assert_allclose(A[3, :3] * 0.5, 0.0, atol=0.02)  # points are 0.5 m from the middle


def test_wrong_handedness_mirrors_the_scene() -> None:
    right, wrong = (display(SCENE.true, SCENE.tracks, y_up=up).points for up in (False, True))
    true = SCENE.true.Q[:, :3]
    assert shape_error(right, true) < 0.02
    assert shape_error(wrong, true * [-1.0, 1.0, 1.0]) < 0.02


def test_frame_is_upright_and_of_unit_size() -> None:
    frame = display(SCENE.true, SCENE.tracks)
    assert np.median(np.linalg.norm(frame.points, axis=1)) == pytest.approx(1.0)
    np.testing.assert_allclose(np.median(frame.points, axis=0), 0.0, atol=0.3)
    # The scene's cameras have their y axis, down the image, along +y, and look along +z.
    up = SCENE.true.Q[:, 1] * -1.0
    assert np.corrcoef(frame.points[:, 2], up)[0, 1] > 0.99
    assert np.corrcoef(frame.points[:, 1], SCENE.true.Q[:, 2])[0, 1] > 0.95
    assert np.corrcoef(frame.points[:, 0], SCENE.true.Q[:, 0])[0, 1] > 0.95
    assert (frame.centres[:, 1] < frame.points[:, 1].min()).all()


@pytest.mark.parametrize("y_up", [False, True])
def test_basis_is_a_change_of_basis_and_corners_surround_the_points(y_up) -> None:
    tracks, true = seen_with_y_up() if y_up else (SCENE.tracks, SCENE.true)
    frame = display(true, tracks, y_up=y_up)
    Q = np.linalg.solve(frame.T, true.Q.T).T
    np.testing.assert_allclose(Q[:, :3] / Q[:, 3:], frame.points, rtol=0, atol=1e-9)
    for centre, corners in zip(frame.centres, frame.corners, strict=True):
        axis = corners.mean(axis=0)
        rays = frame.points - centre
        cosines = rays @ axis / np.linalg.norm(rays, axis=1) / np.linalg.norm(axis)
        assert cosines.min() >= (corners @ axis / np.linalg.norm(axis)).min() - 1e-9
        # Left top, right top, right bottom, left bottom, whichever way y points.
        assert corners[0, 2] > corners[3, 2]
        assert corners[1, 0] > corners[0, 0]


def test_point_at_infinity_and_far_cameras_do_no_harm() -> None:
    scene = eg.multi_view_scene(n_points=60, noise_px=0.0, distance=60.0, focal=6000.0)
    Q = scene.true.Q.copy()
    Q[7] = 0.0, 0.0, 1.0, 0.0
    frame = display(eg.Reconstruction(scene.true.P, Q), scene.tracks)
    assert frame.shown.sum() > 50
    assert np.isfinite(frame.points[frame.shown]).all()
    assert np.linalg.norm(frame.centres, axis=1).max() <= FAR_CAMERA * (1 + 1e-12)


def test_two_views_have_the_scene_in_front_of_both() -> None:
    scene = eg.multi_view_scene(n_views=2, n_points=40, noise_px=0.5, distance=4.0)
    frame = display(eg.bundle_adjust(scene.tracks).reconstruction, scene.tracks)
    assert frame.shown.all()


def test_degenerate_reconstructions_are_shown_or_refused() -> None:
    P, Q = SCENE.true.P.copy(), SCENE.true.Q
    P[2] = P[1]
    assert display(eg.Reconstruction(P, Q), SCENE.tracks).shown.all()
    with pytest.raises(ArgumentError, match="points in different places"):
        display(eg.Reconstruction(P, Q[[0] * 60]), SCENE.tracks)


def test_nearly_affine_scene_is_not_drawn_out_in_depth() -> None:
    # A cube of 1 m at 20 m: a focal length is hardly determined, nor with it the depth.
    scene = eg.multi_view_scene(n_points=80, noise_px=0.1, distance=20.0, baseline=1.0, seed=3)
    result = eg.bundle_adjust(scene.tracks)
    frame = display(result.reconstruction, scene.tracks)
    X = frame.points[frame.shown]
    extents = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    assert frame.shown.all()
    assert extents[0] < 3.0 * extents[1]  # 6.7 where only the cameras count


def test_reconstruction_without_a_plausible_basis_is_called_distorted() -> None:
    scene = eg.multi_view_scene(n_points=60, noise_px=0.0, n_views=10)
    P = np.random.default_rng(1).normal(size=(10, 3, 4))
    assert display(eg.Reconstruction(P, scene.true.Q), scene.tracks).distorted


def test_cameras_in_a_row_are_a_sequence_and_shuffled_ones_are_not() -> None:
    centres = np.column_stack([np.arange(20.0), np.zeros((20, 2))])
    assert camera_spacing(centres) == 1.0
    assert is_sequence(centres)
    assert not is_sequence(centres[np.random.default_rng(0).permutation(20)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corridor", "house", "dinosaur_trimmed"])
def test_measured_scenes_lie_in_front_of_their_cameras(data_dir, name) -> None:
    tracks = eg.load_tracks(data_dir / name / "tracks.npz")
    frame = display(eg.bundle_adjust(tracks).reconstruction, tracks)
    assert frame.shown.mean() > 0.98


@pytest.mark.slow
def test_street_of_a_measured_bal_problem_is_not_mirrored(data_dir) -> None:
    file = eg.io.load_track_file(data_dir / "bal" / "problem-49-7776-pre.txt.bz2")
    true = file.start.Q[:, :3] / file.start.Q[:, 3:]
    distances = np.linalg.norm(true - np.median(true, axis=0), axis=1)
    near = distances < 2.0 * np.median(distances)
    frame = display(
        eg.bundle_adjust(file.tracks, file.start).reconstruction, file.tracks, y_up=True
    )
    near &= frame.shown
    # The start was made with radial distortion, which a projective camera has not.
    assert shape_error(frame.points[near], true[near]) < 0.15
    assert shape_error(frame.points[near], true[near] * [-1.0, 1.0, 1.0]) > 0.5


def test_picture_shows_points_and_cameras() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    from epigauge.plots import plot_bundle

    scene = eg.multi_view_scene(n_points=40, distance=4.0, seed=2)
    result = eg.bundle_adjust(scene.tracks)
    frame = display(result.reconstruction, scene.tracks)
    figure = plot_bundle(result, scene.tracks, "a scene", frame=frame)
    oblique, above, side, residuals, _ = figure.axes
    for axes, planes in ((above, [0, 1]), (side, [1, 2])):
        dots, faces, edges = axes.collections
        np.testing.assert_allclose(
            np.sort(dots.get_offsets(), axis=0),
            np.sort(frame.points[:, planes], axis=0),
        )
        assert len(faces.get_paths()) == scene.tracks.n_views
        assert len(edges.get_segments()) == 8 * scene.tracks.n_views
        apex = edges.get_segments()[0][0]
        np.testing.assert_allclose(apex, frame.centres[0, planes], atol=1e-12)
    assert len(oblique.collections[1].get_offsets()) == frame.shown.sum()
    assert "no calibration" in oblique.get_title(loc="left")
    counted = sum(patch.get_height() for patch in residuals.patches)
    labels = [line.get_label() for line in residuals.lines]
    beyond = sum(int(label.split()[0]) for label in labels if "farther" in label)
    assert counted + beyond == result.fun.size


def test_distorted_picture_says_so() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    from dataclasses import replace

    from epigauge.plots import plot_bundle

    result = eg.bundle_adjust(SCENE.tracks, SCENE.true)
    frame = replace(display(result.reconstruction, SCENE.tracks), deviation=5.0)
    title = plot_bundle(result, SCENE.tracks, frame=frame).axes[0].get_title(loc="left")
    assert "distorted" in title


@pytest.mark.parametrize("count", [1, 2, 4])
def test_pieces_of_lines_are_shown_where_their_ends_are_but_for_far_ones(count: int) -> None:
    frame = display(SCENE.true, SCENE.tracks)
    pieces = SCENE.true.Q[: 2 * count].reshape(count, 2, 4)
    far = np.array([[SCENE.true.Q[0], frame.T @ [1e9, 0.0, 0.0, 1.0]]])
    shown = frame.placed_pieces(np.concatenate([pieces, far]))
    ends = np.stack([frame.placed(pieces[:, k]) for k in (0, 1)], axis=1)
    np.testing.assert_allclose(shown, ends, atol=1e-12)
