"""Simulated scenes: the truth they carry fits the points, and the setup is the paper's."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.scenes import two_view_scene

MOTIONS = ["sideways", "forward"]


def homogeneous(x: np.ndarray) -> np.ndarray:
    return np.column_stack([x, np.ones(len(x))])


def centre(P: np.ndarray) -> np.ndarray:
    return -np.linalg.solve(P[:, :3], P[:, 3])


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("distance", [1.7, 10.0, 40.0])
@pytest.mark.parametrize("baseline", [0.1, 1.0, 1.5])
def test_true_fundamental_matrix_annihilates_the_true_points(motion, distance, baseline) -> None:
    scene = two_view_scene(distance, baseline=baseline, motion=motion, seed=3)
    F, q1, q2 = scene.F_true, homogeneous(scene.x1_true), homogeneous(scene.x2_true)
    lines = q1 @ F.T
    distances = np.sum(q2 * lines, axis=1) / np.linalg.norm(lines[:, :2], axis=1)
    assert np.abs(distances).max() < 1e-9  # pixels; coordinates up to 1e3
    assert np.linalg.norm(F) == pytest.approx(1.0, abs=1e-15)
    values = np.linalg.svd(F, compute_uv=False)
    assert values[2] < 1e-15 < values[1]


@pytest.mark.parametrize("motion", MOTIONS)
def test_true_cameras_project_the_points_and_give_the_matrix(motion) -> None:
    scene = two_view_scene(8.0, motion=motion)
    for P, x in ((scene.P1, scene.x1_true), (scene.P2, scene.x2_true)):
        projected = scene.X @ P.T
        assert projected[:, 2].min() > 0
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], x, rtol=0, atol=1e-12)
    epipole = scene.P2 @ np.append(centre(scene.P1), 1.0)
    np.testing.assert_allclose(scene.F_true.T @ epipole / np.linalg.norm(epipole), 0, atol=1e-15)


def test_standard_configuration_is_the_papers() -> None:
    scene = two_view_scene(n_points=4000)
    C1, C2 = centre(scene.P1), centre(scene.P2)
    assert np.linalg.norm(C1) == pytest.approx(10.0)
    assert np.linalg.norm(C2) == pytest.approx(10.0)
    assert np.linalg.norm(C1 - C2) == pytest.approx(1.0)
    assert scene.K.tolist() == [[1000, 0, 0], [0, 1000, 0], [0, 0, 1]]
    for P in (scene.P1, scene.P2):  # both cameras look at the centre of the cube
        np.testing.assert_allclose(P[:2, 3] / P[2, 3], 0, atol=1e-12)
    assert np.abs(scene.X[:, :3]).max() <= 0.5
    # Standard deviation of a uniform distribution of width 1; 4000 samples know it to 1 %.
    np.testing.assert_allclose(scene.X[:, :3].std(axis=0), 12**-0.5, rtol=0.03)
    noise = np.array([scene.x1 - scene.x1_true, scene.x2 - scene.x2_true])
    assert noise.var() == pytest.approx(2.0, rel=0.05)
    assert abs(noise.mean()) < 0.05
    assert len(two_view_scene().x1) == 50


def test_forward_motion_puts_both_epipoles_at_the_principal_point() -> None:
    F = two_view_scene(motion="forward").F_true
    np.testing.assert_array_equal(F[:, 2], 0)
    np.testing.assert_array_equal(F[2], 0)


def test_a_seed_gives_the_same_points_in_every_configuration() -> None:
    a = two_view_scene(seed=5)
    b = two_view_scene(20.0, noise_px=3.0, motion="forward", seed=5)
    np.testing.assert_array_equal(a.X, b.X)
    np.testing.assert_allclose((a.x2 - a.x2_true) / 2**0.5, (b.x2 - b.x2_true) / 3, atol=1e-13)
    assert not np.array_equal(a.X, two_view_scene(seed=6).X)
    clean = two_view_scene(noise_px=0.0)
    np.testing.assert_array_equal(clean.x1, clean.x1_true)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"distance": 0.5}, "cameras outside the cube"),
        ({"distance": 1.2, "motion": "forward"}, "cameras outside the cube"),
        ({"distance": 3.0, "baseline": 6.0}, "cameras outside the cube"),
        ({"distance": -1}, "distance is -1.0"),
        ({"noise_px": -1}, "noise_px is -1.0"),
        ({"n_points": 0}, "n_points is 0"),
        ({"motion": "foward"}, "did you mean 'forward'"),
        ({"seed": -1}, "seed is -1"),
        ({"focal": np.inf}, "focal is inf"),
    ],
)
def test_impossible_scenes_are_refused(arguments, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        two_view_scene(**arguments)
