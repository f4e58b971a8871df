"""Where first order has a kink: equal singular values, sigma = 1. Covariances stay continuous."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.lengths import linear_length
from laws import distance
from numpy.typing import NDArray

Array = NDArray[np.float64]


def network(turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> eg.Reconstruction:
    """Return three cameras, the second one ahead of the first: sigma = 1 but for a small turn."""
    random = np.random.default_rng(3)
    Q = np.column_stack([random.uniform(-1.0, 1.0, (25, 3)), np.ones(25)])
    x, y, z = turn
    R = np.eye(3) + np.array([[x, y, 0.0], [y, -x, 0.0], [0.0, 0.0, z]])
    P = [
        np.column_stack([np.eye(3), [0.0, 0.0, 5.0]]),
        np.column_stack([R, [0.3, -0.2, 4.0]]),
        np.column_stack([[[0.9, 0.0, 0.4], [0.0, 1.0, 0.0], [-0.4, 0.0, 0.9]], [0.1, 0.2, 5.0]]),
    ]
    return eg.Reconstruction(np.stack(P), Q)


def seen(scene: eg.Reconstruction) -> eg.Tracks:
    view, point = (index.ravel() for index in np.indices((3, 25)))
    h = np.einsum("nij,nj->ni", scene.P[view], scene.Q[point])
    return eg.Tracks(view, point, h[:, :2] / h[:, 2:])


def spread(turn: tuple[float, float, float], noise: float = 1e-4) -> eg.ReconstructionCovariance:
    scene = network(turn)
    return eg.covariance(seen(scene), scene, eg.gauge.two_cameras(), noise_px=noise)


# In these directions the singular values part, each with other singular vectors.
PARTING = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.6, -0.8, 0.0)]


def test_the_scene_is_where_singular_values_are_equal() -> None:
    for size, apart in ((0.0, 0.0), (0.1, 0.01)):
        P = spread((size, 0.0, 0.0)).reconstruction.P
        values = np.linalg.svd(P[1, :, :3], compute_uv=False)
        assert values[0] == pytest.approx(1.0, rel=1e-12)
        assert values[0] - values[1] >= apart
    assert values[0] - values[1] > 0.01


@pytest.mark.parametrize("direction", PARTING)
def test_covariance_of_two_cameras_is_continuous_at_sigma_1(direction: Array) -> None:
    # Scales and signs of singular vectors change nothing in points (a, b, 1, c).
    here = spread((0.0, 0.0, 0.0)).points
    size = np.abs(here).max()
    moved = [spread(tuple(step * np.array(direction))).points for step in (1e-9, 1e-7, 1e-5)]
    apart = [distance(there / size, here / size) for there in moved]
    assert apart[0] < 1e-6
    assert apart[1] < 1e-3
    assert apart[2] < 0.05


def test_covariance_has_no_step_on_the_way_to_first_order() -> None:
    sizes = np.geomspace(1e-5, 0.1, 40)
    found = np.array([spread((s, 0.0, 0.0)).points[:, 3, 3].sum() for s in sizes])
    # 27 % a step of the sizes: nothing that depends smoothly on them jumps by more.
    assert np.abs(np.diff(np.log(found))).max() < 0.1


@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_covariance_of_two_cameras_is_that_of_samples(size: float) -> None:
    turn = (size, 0.0, 0.0)
    scene, gauge = network(turn), eg.gauge.two_cameras()
    free = eg.covariance(seen(scene), scene, noise_px=1e-4)
    values, vectors = np.linalg.eigh(free.dense())
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    random, points, scales = np.random.default_rng(1), [], []
    for _ in range(800):
        change = root @ random.normal(size=len(root))
        P = scene.P + change[: scene.P.size].reshape(scene.P.shape)
        Q = scene.Q + change[scene.P.size :].reshape(scene.Q.shape)
        moved = gauge.transformation(P, Q).apply(P, Q)
        points.append(moved[1][:, 3])
        scales.append(np.linalg.norm(moved[0][1, :, :3]))
    promised = free.in_gauge(gauge)
    ratio = np.var(points, axis=0) / promised.points[:, 3, 3]
    # A variance of 800 samples is known to 5 %.
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)
    H = promised.reconstruction.P[1, :, :3]
    rows = np.zeros(12)
    rows.reshape(3, 4)[:, :3] = H / np.linalg.norm(H)
    along = float(rows @ promised.cameras[1] @ rows)
    assert np.var(scales) / along == pytest.approx(1.0, abs=0.25)


def test_far_from_the_kink_nothing_changes() -> None:
    # First order: the variance goes with the square of the noise.
    once, half = (spread((0.3, 0.0, 0.0), noise).points for noise in (1e-4, 5e-5))
    size = np.abs(once).max()
    assert distance(once / size, 4.0 * half / size) < 1e-12


@pytest.mark.parametrize(
    ("mean", "covariance"),
    [
        ((0.0, 0.0), [[1.0, 0.0], [0.0, 1.0]]),
        ((0.5, 1.0), [[1.0, 0.3], [0.3, 0.5]]),
        ((2.0, 0.0), [[1.0, 0.0], [0.0, 0.01]]),
        ((0.0, -0.1), [[0.01, 0.0], [0.0, 1.0]]),
    ],
)
def test_slope_and_rest_of_a_length_are_those_of_samples(mean: Array, covariance: Array) -> None:
    q = np.random.default_rng(0).multivariate_normal(mean, covariance, 100_000)
    length = np.hypot(*q.T)
    together = np.cov(np.column_stack([q, length]).T)
    expected = np.linalg.solve(together[:2, :2], together[:2, 2])
    slope, rest, mean_length = linear_length(np.asarray(mean), np.asarray(covariance))
    assert mean_length == pytest.approx(length.mean(), rel=0.02)
    np.testing.assert_allclose(slope, expected, atol=0.03)
    left = together[2, 2] - expected @ together[:2, :2] @ expected
    assert rest == pytest.approx(left, rel=0.05)


def test_a_length_is_linear_far_from_zero_and_continuous_on_the_way() -> None:
    covariance = np.array([[1.0, 0.2], [0.2, 0.7]])
    slope, rest, length = linear_length(np.array([30.0, 40.0]), covariance)
    assert length == 50.0
    np.testing.assert_array_equal(slope, [0.6, 0.8])
    assert rest == 0.0
    ways = [linear_length(s * np.array([0.6, 0.8]), covariance) for s in np.linspace(0, 12, 600)]
    slopes, rests = np.array([way[0] for way in ways]), np.array([way[1] for way in ways])
    assert np.abs(np.diff(slopes, axis=0)).max() < 0.02
    assert np.abs(np.diff(rests)).max() < 0.01
    np.testing.assert_allclose(slopes[0], 0.0, atol=1e-12)
