"""Kernels of homographies against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge import kernels
from numpy.typing import NDArray

Array = NDArray[np.float64]

BACKENDS = [name for name, reason in kernels.available().items() if reason is None]


def matches() -> tuple[Array, Array, Array]:
    """A homography, and points that it takes near to others."""
    rng = np.random.default_rng(0)
    H = np.eye(3) + 0.1 * rng.standard_normal((3, 3))
    q1 = rng.uniform(-2.0, 2.0, (2, 20))
    return H, q1, mapped(H, q1) + 0.01 * rng.standard_normal((2, 20))


def mapped(H: Array, q: Array) -> Array:
    h = H[:, :2] @ q + H[:, 2:]
    return np.asarray(h[:2] / h[2])


def equations(H: Array, q: Array) -> Array:
    """c of one match (x, y, x', y')."""
    y = H @ [q[0], q[1], 1.0]
    return np.asarray(q[2:] * y[2] - y[:2])


def differences(f, x: Array) -> Array:
    step = 1e-6
    return np.stack([(f(x + step * e) - f(x - step * e)) / (2 * step) for e in np.eye(len(x))], 1)


@pytest.mark.parametrize("name", BACKENDS)
class TestHomography:
    def test_squares_and_normal_matrix_are_those_of_sampson(self, name) -> None:
        table = kernels.table(name)
        H, q1, q2 = matches()
        weights = np.linspace(0.5, 2.0, 20)
        squares, N = np.empty(20), np.zeros((9, 9))
        for i, q in enumerate(np.vstack([q1, q2]).T):
            by_q = differences(lambda x: equations(H, x), q)
            by_H = differences(lambda h, q=q: equations(h.reshape(3, 3), q), H.ravel())
            inverse = np.linalg.inv(by_q @ by_q.T)
            squares[i] = equations(H, q) @ inverse @ equations(H, q)
            N += weights[i] * by_H.T @ inverse @ by_H
        np.testing.assert_allclose(table.homography_squared(H, q1, q2), squares, rtol=1e-6)
        packed = table.homography_normal(H, q1, q2, weights)
        np.testing.assert_allclose(packed, N[np.triu_indices(9)], rtol=1e-6, atol=1e-6)

    def test_squared_distance_is_the_least_to_first_order(self, name) -> None:
        # Of points moved off by d across and along, the foot is at most |d| away.
        table = kernels.table(name)
        H, q1, _ = matches()
        d = 1e-5
        q2 = mapped(H, q1)
        assert np.max(table.homography_squared(H, q1, q2)) < 1e-25
        squares = table.homography_squared(H, q1, q2 + np.array([[d], [0.0]]))
        assert (squares < d**2).all()
        assert (squares > 0.1 * d**2).all()

    def test_parallax_is_what_moves_a_point_off_a_plane(self, name) -> None:
        table = kernels.table(name)
        rng = np.random.default_rng(4)
        U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
        F = U @ np.diag([1.0, 0.8, 0.0]) @ V.T
        e2, v = U[:, 2].copy(), rng.standard_normal(3)
        H = np.cross(np.eye(3), e2) @ F + np.outer(e2, v)
        q1 = rng.uniform(-1.0, 1.0, (2, 30))
        q = np.vstack([q1, np.ones(30)])
        q2 = mapped(H, q1)
        kappa, gain = table.plane_parallax(F, e2, q1, q2)
        np.testing.assert_allclose(kappa, v @ q, rtol=1e-8, atol=1e-10)
        step = 1e-6
        h = H @ q + step * e2[:, None]
        length = np.linalg.norm(h[:2] / h[2] - q2, axis=0)
        np.testing.assert_allclose(step * gain, length, rtol=1e-3)

    def test_four_matches_are_mapped_exactly(self, name) -> None:
        table = kernels.table(name)
        H, q1, _ = matches()
        q2 = mapped(H, q1)
        samples = [np.ascontiguousarray(q.reshape(2, 5, 4).transpose(0, 2, 1)) for q in (q1, q2)]
        found, votes = table.four_points(*samples)
        assert (np.abs(votes) == 4.0).all()
        for k in range(5):
            np.testing.assert_allclose(
                mapped(found[:, :, k], samples[0][:, :, k]), samples[1][:, :, k], atol=1e-9
            )
