"""The two motions of a plane: told apart where points tell, and named where none does."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view.plane_motions import essentials, leaves_two_motions, normals

K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 480.0], [0.0, 0.0, 1.0]])


def turn(rng: np.random.Generator, angle: float):
    """Return a rotation about a random axis."""
    w = rng.standard_normal(3)
    C = np.cross(np.eye(3), -w / np.linalg.norm(w))
    return np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C


def plane(seed: int, m: int = 120, wrong: int = 0):
    """Return matches of a slanted plane with half a pixel of noise, and the true motion."""
    rng = np.random.default_rng(seed)
    n = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (m, 2)), np.ones(m)])
    X = 6.0 * rays / (rays @ n)[:, None]
    R, t = turn(rng, rng.uniform(0.05, 0.2)), rng.standard_normal(3)
    t *= 0.8 / np.linalg.norm(t)
    x1, x2 = ((Y / Y[:, 2:] @ K.T)[:, :2] for Y in (X, X @ R.T + t))
    x1, x2 = (x + 0.5 * rng.standard_normal(x.shape) for x in (x1, x2))
    x2[:wrong] = rng.uniform(x2.min(axis=0), x2.max(axis=0), (wrong, 2))
    return x1, x2, R, t, n


def off(t, true) -> float:
    """Return the angle between directions in degrees."""
    return float(np.degrees(np.arccos(np.clip(t @ true / np.linalg.norm(true), -1.0, 1.0))))


@pytest.mark.parametrize("seed", range(6))
def test_normals_are_those_of_the_planes(seed):
    rng = np.random.default_rng(seed)
    R, t, n = turn(rng, 0.7), rng.standard_normal(3), rng.standard_normal(3)
    n /= np.linalg.norm(n)
    found = normals(-3.0 * (R + np.outer(t, n)))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-12)
    assert np.abs(found @ n).max() == pytest.approx(1.0, abs=1e-12)
    # The other is that of a motion, too: H u keeps its length for u parallel to either plane.
    for normal in found:
        u = np.linalg.svd(normal[None])[2][1:]
        lengths = np.linalg.norm(u @ (R + np.outer(t, n)).T, axis=1)
        np.testing.assert_allclose(lengths, lengths[0], rtol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_essentials_are_those_of_two_motions(seed):
    rng = np.random.default_rng(seed)
    R, t, n = turn(rng, 0.7), rng.standard_normal(3), rng.standard_normal(3)
    found = essentials(-3.0 * (R + np.outer(t, n)))
    X = rng.standard_normal((20, 3))
    X /= np.abs(X @ n)[:, None] * np.sign(X @ n)[:, None]
    x2 = X @ R.T + t
    for E in found:
        s = np.linalg.svd(E)[1]
        np.testing.assert_allclose(s / s[0], [1.0, 1.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(np.einsum("ij,jk,ik->i", x2, E, X), 0.0, atol=1e-8 * s[0] * 20)
    true = np.cross(t, R, axisb=0, axisc=0)
    cosines = [abs(np.sum(true * E)) / np.linalg.norm(true) / np.linalg.norm(E) for E in found]
    assert max(cosines) == pytest.approx(1.0, abs=1e-12)


def test_a_camera_that_only_turned_or_moved_along_the_normal_leaves_one():
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)), np.ones(50)])
    n = np.array([0.1, -0.2, 1.0]) / np.sqrt(1.05)
    R = turn(rng, 0.3)
    assert not leaves_two_motions(R, rays)
    assert essentials(R).shape == (0, 3, 3)
    assert not leaves_two_motions(R + 0.3 * np.outer(R @ n, n), rays)
    # Sideways along the plane, the other plane is seen edge on; forwards and aside, it is not.
    assert not leaves_two_motions(R + 0.3 * np.outer(R @ [1.0, 0.0, -0.1], n), rays)
    assert leaves_two_motions(R + 0.3 * np.outer(R @ [0.5, 0.0, 1.0], n), rays)


@pytest.mark.study
@pytest.mark.parametrize("wrong", [0, 30])
def test_a_motion_from_a_plane_is_right_or_told_to_be_one_of_two(wrong):
    outcomes = set()
    for seed in range(100, 106):
        x1, x2, _, t, _ = plane(seed, wrong=wrong)
        results = [eg.estimate_essential(x1, x2, K)]
        if not wrong:
            results.append(eg.refine_fundamental(x1, x2, essential=True, K1=K))
        for result in results:
            assert "planar scene" in result.flags
            assert result.success == ("two motions" not in result.flags)
            assert not result.success or off(result.t, t) < 5.0
            outcomes.add(result.success)
    assert outcomes == {False, True}


def test_points_off_the_plane_tell_its_motions_apart():
    scene = eg.two_view_scene(n_points=100, seed=4)
    result = eg.refine_fundamental(scene.x1, scene.x2, essential=True, K1=scene.K)
    assert "two motions" not in result.flags
    assert result.success
