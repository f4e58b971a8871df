"""The probability that an estimated F is as good as so many pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from numpy.typing import NDArray

Array = NDArray[np.float64]

BOUNDS = np.array([0.05, 0.2, 0.5, 1.0, 3.0, 30.0, 1e6])


def matches(m: int, wrong: float, noise: float, seed: int) -> tuple[Array, ...]:
    """Return matches, the first ones wrong, and the true points of the right ones."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform(-0.5, 0.5, (m, 2)), np.ones(m)]) * rng.uniform(4, 8, (m, 1))
    C = np.cross(np.eye(3), [0.1, -0.15, 0.05])
    R = np.linalg.solve(np.eye(3) + C, np.eye(3) - C)
    t1, t2 = (1000.0 * Y[:, :2] / Y[:, 2:] + 500.0 for Y in (X, X @ R.T + [0.6, 0.2, 0.1]))
    x1, x2 = (t + noise * rng.standard_normal(t.shape) for t in (t1, t2))
    count = round(wrong * m)
    for x in (x1, x2):
        x[:count] = rng.uniform(0.0, 1000.0, (count, 2))
    return x1, x2, t1[count:], t2[count:]


def median_error(F: Array, x1: Array, x2: Array) -> float:
    h1, h2 = (np.column_stack([x, np.ones(len(x))]) for x in (x1, x2))
    lines = h1 @ F.T, h2 @ F
    lengths = [np.linalg.norm(line[:, :2], axis=1) for line in lines]
    return float(np.median(np.abs(np.sum(h2 * lines[0], axis=1)) * sum(1 / n for n in lengths) / 2))


def test_it_is_a_distribution_of_the_error() -> None:
    x1, x2, *_ = matches(100, 0.3, 0.5, 1)
    result = eg.estimate_fundamental(x1, x2)
    told = [result.probability_good(px) for px in BOUNDS]
    assert 0.0 <= told[0] < 0.1
    assert np.all(np.diff(told) > 0.0)
    assert 0.999 < told[-1] <= 1.0
    # Half of the right ones have a smaller error
    half = result.probability_good(result.error_px)
    assert half == pytest.approx(0.5 * (1.0 - result.p_wrong), abs=0.1 * result.p_wrong)


@pytest.mark.skipif(
    kernels.available()["c"] is not None, reason="60 searches, the same in NumPy: minutes there"
)
def test_it_is_kept_as_often_as_promised() -> None:
    rng = np.random.default_rng(3)
    promised, kept = [], []
    for seed in range(60):
        m, noise = int(rng.integers(25, 120)), float(rng.uniform(0.3, 2.0))
        x1, x2, t1, t2 = matches(m, float(rng.uniform(0.0, 0.75)), noise, seed)
        result = eg.estimate_fundamental(x1, x2)
        error = median_error(result.F, t1, t2)
        for px in (0.5, 1.0, 2.0):
            promised.append(result.probability_good(px))
            kept.append(error < px)
    assert 0.2 < np.mean(kept) < 0.95
    assert abs(np.mean(promised) - np.mean(kept)) < 0.12
    sure = np.array(promised) > 0.5
    assert np.mean(np.array(kept)[sure]) > np.mean(np.array(kept)[~sure]) + 0.3


@pytest.mark.study
def test_more_matches_promise_more_and_random_ones_nothing() -> None:
    few, many = (eg.estimate_fundamental(*matches(m, 0.2, 0.7, 5)[:2]) for m in (40, 600))
    assert many.error_px < few.error_px
    assert many.p_wrong < few.p_wrong < 0.5
    nothing = eg.estimate_fundamental(*matches(60, 1.0, 0.7, 6)[:2])
    assert nothing.p_wrong > 0.5
    assert nothing.probability_good(1.0) < 0.1


def test_pixels_of_twice_the_number_have_twice_the_error() -> None:
    x1, x2, *_ = matches(80, 0.2, 0.5, 7)
    once, twice = eg.estimate_fundamental(x1, x2), eg.estimate_fundamental(2.0 * x1, 2.0 * x2)
    assert twice.error_px == pytest.approx(2.0 * once.error_px, rel=1e-3)
    assert twice.p_wrong == pytest.approx(once.p_wrong, rel=1e-3)


def test_what_is_saved_and_a_batch_say_the_same(tmp_path: Path) -> None:
    x1, x2, *_ = matches(80, 0.3, 0.5, 8)
    result = eg.estimate_fundamental(x1, x2)
    for name in ("pair.npz", "pair.json"):
        result.save(tmp_path / name)
        again = eg.load_result(tmp_path / name)
        assert again.probability_good(0.5) == result.probability_good(0.5)
    batch = eg.estimate_fundamental_batch(
        np.vstack([x1, x1[:3]]), np.vstack([x2, x2[:3]]), [0, 80, 83]
    )
    assert batch.probability_good(0.5).tolist() == [result.probability_good(0.5), 0.0]
    eg.refine_fundamental(x1, x2).save(tmp_path / "refined.npz")
    with pytest.raises(AttributeError, match="error_px"):
        eg.load_result(tmp_path / "refined.npz").probability_good(1.0)


@pytest.mark.parametrize("suffix", ["npz", "json"])
def test_what_is_saved_of_an_open_geometry_promises_as_much(tmp_path: Path, suffix: str) -> None:
    t = np.random.default_rng(12).uniform(0.0, 1000.0, (205, 1))
    x1 = np.vstack([t[:200] * [1.0, 0.5], np.reshape(t[:10], (5, 2))])
    x2 = np.vstack([1.1 * t[:200] * [1.0, 0.5] + 20.0, np.reshape(t[10:20], (5, 2))])
    for result in (
        eg.estimate_fundamental(x1, x2),  # on a line: the error is infinite
        eg.estimate_fundamental_batch(
            np.vstack([x1, x1[:3]]), np.vstack([x2, x2[:3]]), [0, 205, 208]
        ),
    ):
        assert np.isinf(result.error_px).any()
        result.save(tmp_path / f"open.{suffix}")
        again = eg.load_result(tmp_path / f"open.{suffix}")
        np.testing.assert_array_equal(again.probability_good(1.0), result.probability_good(1.0))


@pytest.mark.parametrize("px", [0.0, -1.0, np.nan, np.inf, "1", [1.0], [1.0, 2.0], []])
def test_a_bound_that_is_none_is_refused(px: Any) -> None:
    result = eg.estimate_fundamental(*matches(40, 0.0, 0.5, 9)[:2])
    with pytest.raises(eg.ArgumentError, match="px"):
        result.probability_good(px)


def test_bounds_of_a_batch_are_one_or_one_a_pair() -> None:
    x1, x2, *_ = matches(40, 0.0, 0.5, 9)
    batch = eg.estimate_fundamental_batch(np.vstack([x1, x1]), np.vstack([x2, x2]), [0, 40, 80])
    own = batch.probability_good(np.array([0.5, 1.0]))
    assert own.tolist() == [batch.probability_good(0.5)[0], batch.probability_good(1.0)[1]]
    with pytest.raises(eg.ArgumentError, match="px"):
        batch.probability_good(np.array([0.5, 1.0, 2.0]))


@pytest.mark.filterwarnings("error")
def test_the_smallest_and_largest_bounds_are_bounds() -> None:
    result = eg.estimate_fundamental(*matches(40, 0.0, 0.5, 9)[:2])
    assert result.probability_good(5e-324) == 0.0
    assert result.probability_good(1e308) == 1.0


def test_what_is_not_determined_promises_little() -> None:
    rng = np.random.default_rng(10)
    x1 = rng.uniform(0.0, 1000.0, (40, 2))
    x2 = x1 + [30.0, 5.0] + 0.5 * rng.standard_normal((40, 2))  # a plane: F is free
    x2[0] = [100.0, 900.0]
    result = eg.estimate_fundamental(x1, x2)
    eight = eg.estimate_fundamental(x1[:8], x2[:8])
    assert 0.0 <= eight.probability_good(0.5) < result.probability_good(0.5) <= 1.0
    assert eight.p_wrong > 0.1 > result.p_wrong
    five = eg.estimate_essential(x1[:8], x2[:8], np.diag([1000.0, 1000.0, 1.0]), max_iter=1)
    assert 0.0 <= five.probability_good(0.5) <= 1.0


def test_essential_matrices_have_it() -> None:
    x1, x2, t1, t2 = matches(60, 0.3, 0.5, 11)
    K = np.array([[1000.0, 0.0, 500.0], [0.0, 1000.0, 500.0], [0.0, 0.0, 1.0]])
    free, known = eg.estimate_fundamental(x1, x2), eg.estimate_essential(x1, x2, K)
    assert known.error_px < free.error_px  # five parameters, not seven
    assert median_error(known.F, t1, t2) < 5.0 * known.error_px
