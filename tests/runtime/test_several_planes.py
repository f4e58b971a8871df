"""Homographies of scenes with several planes: one answer in any order, and a flag."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]


def seen(
    shares: tuple[float, ...], m: int, seed: int, *, wrong: float = 0.2, noise: float = 0.5
) -> tuple[Array, Array]:
    """Return matches of planes that two cameras side by side see, and so many wrong ones."""
    rng = np.random.default_rng(seed)
    x1, x2 = [], []
    for share in shares:
        x = rng.uniform(0.0, 1000.0, (round(share * m), 2))
        normal = np.array([*rng.uniform(-0.7, 0.7, 2), 1.0])
        inverse_depth = np.column_stack([(x - 500.0) / 800.0, np.ones(len(x))]) @ normal
        shift = 160.0 * rng.uniform(0.6, 1.4) * np.maximum(inverse_depth, 0.1)
        x1.append(x)
        x2.append(x + shift[:, None] * [1.0, 0.2])
    x1, x2 = ([np.concatenate(x)] for x in (x1, x2))
    for x in (x1, x2):
        x[0] = x[0] + noise * rng.standard_normal(x[0].shape)
        x.append(rng.uniform(0.0, 1000.0, (round(wrong * m), 2)))
    return np.concatenate(x1), np.concatenate(x2)


@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.4, 0.3, 0.3)])
@pytest.mark.parametrize("m", [40, 150])
def test_the_order_of_the_matches_does_not_choose_the_plane(
    shares: tuple[float, ...], m: int
) -> None:
    for seed in range(3):
        x1, x2 = seen(shares, m, seed)
        found = eg.estimate_homography(x1, x2)
        for trial in range(2):
            order = np.random.default_rng(trial).permutation(len(x1))
            again = eg.estimate_homography(x1[order], x2[order])
            assert again.inlier.tolist() == found.inlier[order].tolist()
            assert abs(np.sum(again.H * found.H)) == pytest.approx(1.0, abs=1e-12)
            assert again.flags == found.flags


@pytest.mark.parametrize("wrong", [0.0, 0.5, 1.0])
def test_planes_of_as_many_points_are_told(wrong: float) -> None:
    for seed in range(4):
        found = eg.estimate_homography(*seen((0.5, 0.5), 100, seed, wrong=wrong))
        assert "several planes" in found.flags
        assert found.success  # of a plane


@pytest.mark.parametrize(("shares", "wrong"), [((1.0,), 0.0), ((1.0,), 2.0), ((0.8, 0.2), 0.2)])
def test_one_plane_is_not_several(shares: tuple[float, ...], wrong: float) -> None:
    for seed in range(4):
        found = eg.estimate_homography(*seen(shares, 100, seed, wrong=wrong))
        assert found.success
        assert found.flags == ()


def test_a_homography_between_planes_is_told() -> None:
    """Its noise is the planes' distances: a sixth of the matches or more agree far better."""
    blunt = 0
    for seed in range(6):
        found = eg.estimate_homography(*seen((0.2,) * 5, 150, seed))
        blunt += found.noise_px > 1.0
        assert "several planes" in found.flags or found.noise_px <= 1.0
    assert blunt >= 2


def test_heavy_tails_are_no_further_plane() -> None:
    for seed in range(8):
        x1, x2 = seen((1.0,), 150, seed, wrong=0.0, noise=0.0)
        rng = np.random.default_rng(seed)
        x1, x2 = (x + 0.5 * rng.standard_t(1.5, x.shape) for x in (x1, x2))
        assert "several planes" not in eg.estimate_homography(x1, x2).flags


def test_nothing_in_common_is_not_several_planes() -> None:
    rng = np.random.default_rng(7)
    for _ in range(4):
        x1, x2 = rng.uniform(0.0, 1000.0, (2, 80, 2))
        found = eg.estimate_homography(x1, x2)
        assert "no common geometry" in found.flags
        assert "several planes" not in found.flags
