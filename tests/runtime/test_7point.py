"""The seven-point algorithm: exact solutions, the true one among them, all real roots."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from laws import fundamental_cases, matches
from two_views import algebraic, same_geometry


@pytest.mark.parametrize("seed", range(20))
def test_all_solutions_are_exact_and_the_true_one_is_among_them(seed):
    scene = eg.two_view_scene(n_points=7, noise_px=0.0, distance=3.0, seed=seed)
    solutions = eg.fundamental_7point(scene.x1, scene.x2)
    assert solutions.shape[0] in (1, 2, 3)
    assert solutions.shape[1:] == (3, 3)
    for F in solutions:
        # Rounding of coordinates of hundreds of pixels.
        assert np.abs(algebraic(F, scene.x1, scene.x2)).max() < 1e-9
        assert np.linalg.svd(F, compute_uv=False)[2] < 1e-15
        assert np.linalg.norm(F) == pytest.approx(1.0, abs=1e-15)
    nearest = min(same_geometry(F, scene.F_true, scene.x1, scene.x2) for F in solutions)
    assert nearest < 1e-8  # the condition of seven points


def test_one_two_and_three_real_roots_occur_and_are_all_found():
    counts = set()
    for seed in range(40):
        x1, x2 = np.random.default_rng(seed).uniform(0.0, 640.0, (2, 7, 2))
        solutions = eg.fundamental_7point(x1, x2)
        counts.add(len(solutions))
        # Independent: along the pencil of matrices that fit, the determinant changes its sign once
        # between neighbouring roots, so that the number of real roots of a cubic is odd.
        assert len(solutions) in (1, 3)
        for F in solutions:
            assert np.abs(algebraic(F, x1, x2)).max() < 1e-8
    assert counts == {1, 3}


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_opencv(seed):
    cv2 = pytest.importorskip("cv2")
    x1, x2 = np.random.default_rng(seed).uniform(0.0, 640.0, (2, 7, 2))
    ours = eg.fundamental_7point(x1, x2)
    theirs = cv2.findFundamentalMat(x1, x2, cv2.FM_7POINT)[0].reshape(-1, 3, 3)
    assert len(ours) == len(theirs)
    for F in theirs:
        # OpenCV solves with single precision points.
        assert min(same_geometry(F, G, x1, x2) for G in ours) < 1e-3


@pytest.mark.parametrize(
    "name", ["affine", "rectified", "forward motion", "sigma 1", "sigma near 1"]
)
def test_finds_particular_geometries(name):
    F = fundamental_cases()[name]
    q1, q2 = matches(np.random.default_rng(3), F, 7, 0.0)
    solutions = eg.fundamental_7point(q1.T, q2.T)
    assert min(same_geometry(G, F, q1.T, q2.T) for G in solutions) < 1e-7


def test_order_and_unit_of_the_matches_do_not_matter():
    scene = eg.two_view_scene(n_points=7, noise_px=1.0, distance=3.0, seed=3)
    first = eg.fundamental_7point(scene.x1, scene.x2)
    turned = eg.fundamental_7point(scene.x1[::-1], scene.x2[::-1])
    scaled = eg.fundamental_7point(1e3 * scene.x1 + 1e6, 1e3 * scene.x2 - 1e6)
    assert len(first) == len(turned) == len(scaled)
    T1 = np.array([[1e3, 0, 1e6], [0, 1e3, 1e6], [0, 0, 1]])
    T2 = np.array([[1e3, 0, -1e6], [0, 1e3, -1e6], [0, 0, 1]])
    for F in first:
        assert min(same_geometry(F, G, scene.x1, scene.x2) for G in turned) < 1e-9
        back = [T2.T @ G @ T1 for G in scaled]
        assert min(same_geometry(F, G, scene.x1, scene.x2) for G in back) < 1e-7


def test_refuses_what_leaves_many_solutions():
    scene = eg.two_view_scene(n_points=8, noise_px=0.0, seed=0)
    with pytest.raises(eg.ArgumentError, match="hold 8 matches; needed: exactly 7"):
        eg.fundamental_7point(scene.x1, scene.x2)
    with pytest.raises(eg.ArgumentError, match="hold 6 matches"):
        eg.fundamental_7point(scene.x1[:6], scene.x2[:6])
    with pytest.raises(eg.ArgumentError, match="degenerate"):  # a plane
        eg.fundamental_7point(scene.x1[:7], 2.0 * scene.x1[:7] + 1.0)
    twice = [0, 1, 2, 3, 4, 5, 5]
    with pytest.raises(eg.ArgumentError, match="degenerate"):
        eg.fundamental_7point(scene.x1[twice], scene.x2[twice])
