"""Systems of many points at once, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge.bundle.point_blocks import Triangle, solved_points
from numpy.typing import NDArray


def blocks(spread: float, m: int = 40) -> NDArray[np.float64]:
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.standard_normal((m, 3, 3)))[0]
    values = 10.0 ** rng.uniform(-spread, spread, (m, 3))
    return np.asarray((axes * values[:, None]) @ np.swapaxes(axes, 1, 2))


@pytest.mark.parametrize("spread", [0.0, 2.0])
def test_solutions_and_energies_are_those_of_dense_algebra(spread: float) -> None:
    V, right = blocks(spread), np.random.default_rng(4).standard_normal((40, 3))
    dense = np.linalg.solve(V, right[..., None])[..., 0]
    size = np.abs(dense).max()
    np.testing.assert_allclose(solved_points(V, right, 0.0), dense, rtol=1e-9, atol=1e-9 * size)
    energy = Triangle.of(V).energy(right.T)
    np.testing.assert_allclose(energy, np.sum(right * dense, axis=1), rtol=1e-9)


def test_the_pivots_have_the_determinant_and_the_lift_is_a_share_of_the_trace() -> None:
    V = blocks(1.0)
    factor = Triangle.of(V)
    np.testing.assert_allclose(factor.d0 * factor.d1 * factor.d2, np.linalg.det(V), rtol=1e-10)
    lifted = V + 0.5 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    np.testing.assert_allclose(Triangle.of(V, 0.5), Triangle.of(lifted), rtol=1e-12)


def test_a_line_of_sight_alone_leaves_the_depth_without_bound() -> None:
    ray = np.array([0.6, 0.0, 0.8])
    V = (np.eye(3) - np.outer(ray, ray))[None]
    energy = Triangle.of(V, 1e-14).energy(ray[:, None])
    assert not energy[0] < 1e10
