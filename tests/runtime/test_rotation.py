"""Homographies of a camera that only turned, told from those of planes without calibration."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view.rotation import is_of_a_turned_camera
from numpy.typing import NDArray

Array = NDArray[np.float64]


def turned(K: Array, w: tuple[float, float, float]) -> Array:
    C = np.cross(np.eye(3), -np.array(w) / 2.0)
    return np.asarray(K @ np.linalg.solve(np.eye(3) - C, np.eye(3) + C) @ np.linalg.inv(K))


@pytest.mark.parametrize("focal", [3.0, 6.0, 15.0])
@pytest.mark.parametrize("sign", [1.0, -2.0])
def test_square_pixels_are_a_condition(focal: float, sign: float) -> None:
    near = 1e-11 * np.eye(9)  # covariance: a deviation of 3e-6
    K = np.array([[focal, 0.0, 0.3], [0.0, focal, -0.2], [0.0, 0.0, 1.0]])
    assert is_of_a_turned_camera(sign * turned(K, (0.2, -0.1, 0.15)), sign**2 * near, 100)
    K[0, 0] *= 1.3
    assert not is_of_a_turned_camera(sign * turned(K, (0.2, -0.1, 0.15)), sign**2 * near, 100)
    K[0, 0] /= 1.3
    K[0, 2] = 30.0  # four images from the middle
    assert not is_of_a_turned_camera(sign * turned(K, (0.2, -0.1, 0.15)), sign**2 * near, 100)


@pytest.mark.parametrize("m", [20, 60])
def test_planes_are_none_and_rotations_are(m: int) -> None:
    K = np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 480.0], [0.0, 0.0, 1.0]])
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x1 = rng.uniform([0.0, 0.0], [1280.0, 960.0], (m, 2))
        R = turned(np.eye(3), tuple(rng.uniform(-0.15, 0.15, 3)))
        normal = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0]) / 6.0
        t = rng.standard_normal(3)
        t *= 0.8 / np.linalg.norm(t)
        for name, G in (("rotation", R), ("plane", R + np.outer(t, normal))):
            y = np.column_stack([x1, np.ones(m)]) @ (K @ G @ np.linalg.inv(K)).T
            noise = 0.5 * rng.standard_normal((2, m, 2))
            result = eg.refine_homography(x1 + noise[0], y[:, :2] / y[:, 2:] + noise[1])
            assert ("pure rotation" in result.flags) == (name == "rotation"), (name, seed)


def test_without_noise_only_rounding_is_forgiven() -> None:
    exact = 1e-24 * np.eye(9)
    K = np.array([[3.0, 0.0, 0.3], [0.0, 3.0, -0.2], [0.0, 0.0, 1.0]])
    assert is_of_a_turned_camera(turned(K, (0.2, -0.1, 0.15)), exact, 100)
    K[0, 0] *= 1.0 + 3e-4  # pixels that are not square
    assert not is_of_a_turned_camera(turned(K, (0.2, -0.1, 0.15)), exact, 100)
