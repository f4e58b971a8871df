"""Noise with heavy tails along one axis is no parallax."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.line_noise import is_noise
from epigauge.two_view.planes import NO_RELIEF, OnPlane
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIZE, FOCAL = np.array([1280.0, 960.0]), 1000.0


def matches(kind: str, seed: int, m: int = 300, angle: float = np.pi / 2) -> tuple[Array, Array]:
    """Return matches with Cauchy noise of one pixel in one direction of image 2, little else."""
    rng = np.random.default_rng([seed, m, 5])
    X = np.column_stack([rng.uniform(-0.5, 0.5, (m, 2)) * SIZE / FOCAL, np.ones(m)])
    n = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
    X *= 4.0 / (X @ n)[:, None] if kind == "plane" else rng.uniform(2.0, 5.0, m)[:, None]
    axis = rng.standard_normal(3)
    C = np.cross(np.eye(3), -axis / np.linalg.norm(axis))
    turn = 0.0 if kind == "still" else rng.uniform(0.05, 0.2)
    R = np.eye(3) + np.sin(turn) * C + (1.0 - np.cos(turn)) * C @ C
    t = rng.standard_normal(3)
    t *= 0.0 if kind in ("still", "rotation") else 0.6 / np.linalg.norm(t)
    x1, x2 = (FOCAL * Y[:, :2] / Y[:, 2:] + SIZE / 2.0 for Y in (X, X @ R.T + t))
    along = np.array([np.cos(angle), np.sin(angle)])
    noise = rng.standard_cauchy(m)[:, None] * along
    x1, x2 = (x + 0.1 * rng.standard_normal((m, 2)) for x in (x1, x2))
    return x1, x2 + noise


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2])
@pytest.mark.parametrize("kind", ["still", "plane", "rotation"])
def test_heavy_noise_along_one_axis_makes_no_scene(kind: str, angle: float) -> None:
    told = {"still": "still camera"}.get(kind, "planar scene")
    for seed in range(3):
        x1, x2 = matches(kind, seed, angle=angle)
        for result in (eg.estimate_fundamental(x1, x2), eg.refine_fundamental(x1, x2)):
            flags = set(result.flags) - {"gross errors"}
            assert told in flags or "gross errors" in result.flags
            assert not result.success
        batch = eg.refine_fundamental_batch(x1, x2, [0, len(x1)])
        assert not batch.success[0]
        assert batch.flags[0] == eg.refine_fundamental(x1, x2).flags


@pytest.mark.parametrize("kind", ["still", "plane", "rotation"])
def test_the_model_is_the_simple_one(kind: str) -> None:
    for seed in range(3):
        found = eg.estimate_two_view(*matches(kind, seed))
        assert found.model == kind
        assert found.success


@pytest.mark.study
def test_a_scene_stays_one_under_such_noise() -> None:
    for seed in range(3):
        x1, x2 = matches("general", seed)
        assert eg.estimate_fundamental(x1, x2).success
        assert eg.estimate_two_view(x1, x2).model == "F"


def asked(off: Array, q: Array, noise: float = 1e-4 * RANGE) -> bool:
    """Ask of distances off a plane, in units of the largest that is no relief."""
    found: Any = SimpleNamespace(q1=q, noise=noise)
    off = off * NO_RELIEF * RANGE
    return is_noise(found, OnPlane(np.arange(len(off)), off, off < 0.0))


def test_noise_of_any_distribution_is_noise() -> None:
    told = {"cauchy": 0, "normal": 0, "laplace": 0}
    for seed in range(100):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-1.0, 1.0, (2, 120))
        told["cauchy"] += asked(0.7 * rng.standard_cauchy(120), q)
        told["normal"] += asked(rng.standard_normal(120), q)
        told["laplace"] += asked(rng.laplace(size=120), q)
    assert min(told.values()) >= 94


def test_what_depends_on_the_place_is_relief() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-1.0, 1.0, (2, 120))
        wavy = np.sin(4.0 * q[0] + 2.0 * q[1])
        assert not asked(wavy, q)
        assert not asked(wavy + 0.5 * rng.standard_normal(120), q)
        before = np.where(rng.random(120) < 0.25, rng.uniform(3.0, 9.0, 120), 0.0)
        assert not asked(0.5 * rng.standard_normal(120) + before, q)  # to one side
        apart = np.where(rng.random(120) < 0.25, 40.0 * rng.standard_normal(120), 0.0)
        assert not asked(0.5 * rng.standard_normal(120) + apart, q)  # of another kind


def test_nothing_is_asked_of_few_of_relief_and_of_plain_noise() -> None:
    rng = np.random.default_rng(0)
    q, off = rng.uniform(-1.0, 1.0, (2, 120)), rng.standard_normal(120)
    assert asked(off, q)
    assert not asked(off[:30], q[:, :30])
    assert not asked(2.0 * off, q)
    assert not asked(off, q, noise=8e-4 * RANGE)
