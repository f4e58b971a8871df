"""Matches that agree on one line only, within the noise: no model of two views is claimed."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.kernels import available
from epigauge.two_view.collinear import may_be_lines
from numpy.typing import NDArray

Array = NDArray[np.float64]

K = np.array([[1000.0, 0.0, 500.0], [0.0, 1000.0, 500.0], [0.0, 0.0, 1.0]])
ENTRIES: dict[str, Any] = {
    "F": eg.estimate_fundamental,
    "E": lambda x1, x2: eg.estimate_essential(x1, x2, K),
    "H": eg.estimate_homography,
    "model": eg.estimate_two_view,
    "model, K": lambda x1, x2: eg.estimate_two_view(x1, x2, K),
}
REFINED: dict[str, Any] = {
    "F": eg.refine_fundamental,
    "E": lambda x1, x2: eg.refine_fundamental(x1, x2, essential=True, K1=K),
    "H": eg.refine_homography,
}


def line(seed: int, *, n: int = 100, beside: int = 0, wrong: int = 0, noise: float = 0.5) -> Any:
    """Return matches of a line in space, of points beside it, and wrong ones."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform(-2.0, 2.0, n), np.full(n, 0.3), np.zeros(n)])
    X[:, 2] = 5.0 + 0.8 * X[:, 0]
    Y = np.column_stack([rng.uniform(-2.0, 2.0, (beside, 2)), rng.uniform(4.0, 9.0, beside)])
    C = np.cross(np.eye(3), [0.03, -0.1, 0.02])
    R = np.linalg.solve(np.eye(3) + C, np.eye(3) - C)
    X1 = np.vstack([X, Y])
    x1, x2 = (Z[:, :2] / Z[:, 2:] for Z in (X1 @ K.T, (X1 @ R.T + [0.8, 0.1, 0.1]) @ K.T))
    x1, x2 = (x + noise * rng.standard_normal(x.shape) for x in (x1, x2))
    return tuple(np.vstack([x, rng.uniform(0.0, 1000.0, (wrong, 2))]) for x in (x1, x2))


@pytest.mark.study
@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize(
    ("n", "wrong", "noise"),
    [
        (80, 20, 0.3),
        (200, 5, 1e-12),
        pytest.param(200, 60, 1.0, marks=pytest.mark.slow),
        pytest.param(30, 60, 0.3, marks=pytest.mark.slow),
    ],
)
def test_wrong_matches_beside_a_line_determine_nothing(
    entry: str, n: int, wrong: int, noise: float
) -> None:
    found = ENTRIES[entry](*line(n, n=n, wrong=wrong, noise=noise))
    assert not found.success
    assert {"undetermined", "no common geometry"} & {*found.flags}


@pytest.mark.parametrize("entry", REFINED)
@pytest.mark.parametrize(("n", "noise"), [(60, 0.2), (300, 2.0)])
def test_a_line_within_the_noise_determines_nothing(entry: str, n: int, noise: float) -> None:
    for beside in (0, 1):
        found = REFINED[entry](*line(n, n=n, beside=beside, noise=noise))
        assert not found.success
        assert {"undetermined", "no common geometry"} & {*found.flags}


def test_a_line_of_one_image_leaves_F_open() -> None:
    rng = np.random.default_rng(3)
    x1 = np.column_stack([rng.uniform(0.0, 1000.0, 80), np.full(80, 400.0)])
    x1[:2, 1] = 100.0, 900.0
    x2 = x1 + np.column_stack([rng.uniform(5.0, 60.0, 80), rng.uniform(-40.0, 40.0, 80)])
    x1, x2 = (x + 0.3 * rng.standard_normal(x.shape) for x in (x1, x2))
    for found in (eg.refine_fundamental(x1, x2), eg.refine_fundamental(x2, x1)):
        assert "undetermined" in found.flags
    batch = eg.refine_fundamental_batch(np.vstack([x1, x2]), np.vstack([x2, x1]), [0, 80, 160])
    assert not batch.success.any()


def test_points_beside_a_line_that_agree_determine_it() -> None:
    x1, x2 = line(4, n=60, beside=40, wrong=15)
    for entry in ("F", "E"):
        found = ENTRIES[entry](x1, x2)
        assert found.success
        assert "undetermined" not in found.flags
    assert "undetermined" not in eg.refine_fundamental(*line(5, beside=9)).flags
    x2 = x1 @ [[1.1, 0.1], [-0.1, 0.9]] + [20.0, 5.0]  # all on a plane
    assert eg.estimate_homography(x1, x2).success


@pytest.mark.skipif(available()["c"] is not None, reason="needs the C library")
def test_the_cheap_test_misses_no_line() -> None:
    rng = np.random.default_rng(8)
    sets = [line(9), rng.uniform(0.0, 1000.0, (2, 200, 2)), line(10, n=20, beside=3), line(11, n=2)]
    x1, x2 = (np.vstack([pair[k] for pair in sets]) for k in (0, 1))
    offsets = np.cumsum([0, 0, *(len(pair[0]) for pair in sets)])
    noise = np.full(len(sets) + 1, 0.5)
    assert may_be_lines(x1, x2, offsets, noise).tolist() == [False, True, False, True, False]
    mirrored = may_be_lines(rng.permutation(x1), x2, offsets, noise)
    assert mirrored[1]  # one image suffices
    # Weights are squares of one over the noise of a match; none is on a line by a weight of zero.
    heavier = may_be_lines(x1, x2, offsets, 1e3 * noise, np.full(len(x1), 1e6))
    assert heavier.tolist() == [False, True, False, True, False]
    assert not may_be_lines(x1, x2, offsets, noise, np.zeros(len(x1))).any()
    # The same point again is no line.
    twice = np.repeat(x1, 2, axis=0)
    assert not may_be_lines(twice, twice, 2 * offsets, np.full(5, 1e-9)).any()
