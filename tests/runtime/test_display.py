"""The basis for pictures: it finds the shape of a scene from any projective basis."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.multi_view.display import FAR_CAMERA, display
from numpy.typing import NDArray

SCENE = eg.multi_view_scene(n_points=60, noise_px=0.0, distance=3.0, baseline=1.2, focal=1000.0)


def shape_error(found: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """RMS distance after the best proper similarity, in units of the scene's size."""
    a, b = (x - x.mean(axis=0) for x in (found, true))
    U, values, Vt = np.linalg.svd(a.T @ b)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = np.sum(values * np.diag(D)) / np.sum(a**2)
    return float(np.sqrt(np.sum((scale * a @ U @ D @ Vt - b) ** 2) / np.sum(b**2)))


@pytest.mark.parametrize("seed", range(4))
def test_shape_is_found_from_any_basis(seed) -> None:
    rng = np.random.default_rng(seed)
    T = rng.normal(size=(4, 4))
    scales = rng.choice([-1, 1], 5) * rng.uniform(0.1, 10, 5), rng.normal(size=60)
    moved = eg.gauge.transform(SCENE.true, T, *scales)
    frame = display(moved, SCENE.tracks)
    assert frame.shown.all()
    # Not a calibration: the guess of a usual focal length pulls by parts of a percent. The
    # mirrored scene would be off by 82 %.
    assert shape_error(frame.points, SCENE.true.Q[:, :3]) < 0.02
    true_centres = np.array([-np.linalg.solve(P[:, :3], P[:, 3]) for P in SCENE.true.P])
    assert shape_error(frame.centres, true_centres) < 0.05


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


def test_basis_is_a_change_of_basis_and_corners_surround_the_points() -> None:
    frame = display(SCENE.true, SCENE.tracks)
    Q = np.linalg.solve(frame.T, SCENE.true.Q.T).T
    np.testing.assert_allclose(Q[:, :3] / Q[:, 3:], frame.points, rtol=0, atol=1e-9)
    for centre, corners in zip(frame.centres, frame.corners, strict=True):
        axis = corners.mean(axis=0)
        rays = frame.points - centre
        cosines = rays @ axis / np.linalg.norm(rays, axis=1) / np.linalg.norm(axis)
        assert cosines.min() >= (corners @ axis / np.linalg.norm(axis)).min() - 1e-9


def test_point_at_infinity_and_far_cameras_do_no_harm() -> None:
    scene = eg.multi_view_scene(n_points=60, noise_px=0.0, distance=60.0, focal=6000.0)
    Q = scene.true.Q.copy()
    Q[7] = 0.0, 0.0, 1.0, 0.0
    frame = display(eg.Reconstruction(scene.true.P, Q), scene.tracks)
    assert frame.shown.sum() > 50
    assert np.isfinite(frame.points[frame.shown]).all()
    assert np.linalg.norm(frame.centres, axis=1).max() <= FAR_CAMERA * (1 + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corridor", "house", "dinosaur_trimmed"])
def test_measured_scenes_lie_in_front_of_their_cameras(data_dir, name) -> None:
    tracks = eg.load_tracks(data_dir / name / "tracks.npz")
    frame = display(eg.bundle_adjust(tracks).reconstruction, tracks)
    assert frame.shown.mean() > 0.98


def test_picture_shows_points_and_cameras() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    from epigauge.plots import plot_bundle

    scene = eg.multi_view_scene(n_points=40, distance=4.0, seed=2)
    result = eg.bundle_adjust(scene.tracks)
    figure = plot_bundle(result, scene.tracks, "a scene")
    frame = display(result.reconstruction, scene.tracks)
    oblique, above, residuals, _ = figure.axes
    for axes in (oblique, above):
        assert len(axes.collections[0].get_offsets()) == frame.shown.sum()
        assert len(axes.lines) == 1 + 2 * scene.tracks.n_views  # the path; two strokes a camera
    assert "no calibration" in oblique.get_title(loc="left")
    np.testing.assert_allclose(
        np.sort(above.collections[0].get_offsets(), axis=0), np.sort(frame.points[:, :2], axis=0)
    )
    counted = sum(patch.get_height() for patch in residuals.patches)
    labels = [line.get_label() for line in residuals.lines]
    beyond = sum(int(label.split()[0]) for label in labels if "farther" in label)
    assert counted + beyond == result.fun.size
