"""The simulated views of the gauge paper: the truth fits, and the setup is the paper's."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError


def centres(scene: eg.MultiViewScene) -> np.ndarray:
    return np.array([-np.linalg.solve(P[:, :3], P[:, 3]) for P in scene.true.P])


@pytest.mark.parametrize("n_views", [2, 5, 8])
@pytest.mark.parametrize("visible", [0.4, 1.0])
def test_truth_projects_to_the_true_points_in_front_of_every_camera(n_views, visible) -> None:
    scene = eg.multi_view_scene(0.3, n_views, visible=visible, seed=3)
    np.testing.assert_allclose(scene.true.project(scene.tracks), scene.xy_true, atol=1e-9)
    assert np.einsum("nj,mj->nm", scene.true.P[:, 2], scene.true.Q).min() > 0.0
    clean = eg.multi_view_scene(0.3, n_views, noise_px=0.0, visible=visible, seed=3)
    np.testing.assert_array_equal(clean.tracks.xy, clean.xy_true)


def test_standard_configuration_is_the_papers() -> None:
    scene = eg.multi_view_scene(n_points=4000)
    C = centres(scene)
    np.testing.assert_allclose(np.linalg.norm(C, axis=1), 10.0)
    np.testing.assert_allclose(np.linalg.norm(np.diff(C, axis=0), axis=1), 3.0)
    for P in scene.true.P:  # all look at the centre with a focal length of 1000
        np.testing.assert_allclose(P[:2, 3] / P[2, 3], 0.0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(P[:, :3], axis=1), [1000.0, 1000.0, 1.0])
    noise = scene.tracks.xy - scene.xy_true
    assert noise.var() == pytest.approx(1.0, rel=0.05)
    default = eg.multi_view_scene()
    assert (default.tracks.n_views, default.tracks.n_points, len(default.tracks)) == (5, 100, 500)


@pytest.mark.parametrize("flatness", [0.5, 0.1, 0.02])
def test_flatness_is_the_mean_offset_from_a_plane_in_the_cube(flatness) -> None:
    scene = eg.multi_view_scene(flatness, n_points=4000)
    X = scene.true.Q[:, :3]
    assert np.abs(X).max() <= 0.5
    assert np.mean(X[:, 2] + flatness) == pytest.approx(flatness, rel=0.05)
    np.testing.assert_allclose(X[:, :2].std(axis=0), 12**-0.5, rtol=0.03)


def test_visibility_is_a_share_and_leaves_enough() -> None:
    scene = eg.multi_view_scene(n_views=10, n_points=500, visible=0.6, seed=2)
    assert len(scene.tracks) == pytest.approx(0.6 * 5000, rel=0.05)
    sparse = eg.multi_view_scene(n_views=6, n_points=60, visible=0.01, seed=2).tracks
    assert np.bincount(sparse.point).min() == 2
    assert np.bincount(sparse.view).min() >= 6


def test_a_seed_gives_the_same_scene_whatever_its_depth() -> None:
    a, b = eg.multi_view_scene(0.5, seed=5), eg.multi_view_scene(0.1, noise_px=3.0, seed=5)
    np.testing.assert_allclose(a.true.Q * [1, 1, 0.2, 1], b.true.Q, atol=1e-15)
    np.testing.assert_allclose(3 * (a.tracks.xy - a.xy_true), b.tracks.xy - b.xy_true, atol=1e-9)
    assert not np.array_equal(a.true.Q, eg.multi_view_scene(seed=6).true.Q)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"flatness": 0.6}, "flatness is 0.6 m"),
        ({"distance": 0.8}, "distance is 0.8 m"),
        ({"distance": 1.4}, "cameras outside the cube"),
        ({"visible": 1.1}, "visible is 1.1"),
        ({"visible": 0}, "visible is 0"),
        ({"n_views": 1}, "n_views is 1"),
        ({"n_points": 5}, "n_points is 5"),
        ({"noise_px": -1.0}, "noise_px is -1.0"),
    ],
)
def test_impossible_scenes_are_refused(arguments, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        eg.multi_view_scene(**arguments)
