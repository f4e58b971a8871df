"""Bartoli (2003), eq. (10): the series of the error e, and where it converges."""

from __future__ import annotations

import numpy as np
import pytest

ORDERS = np.arange(9)
EQ10 = (-1.0) ** (ORDERS + 1) * (1.0 + ORDERS / 2.0)


def problem(seed, radius, size=5):
    """Return g, N and W with the spectral radius of W^-1 N given."""
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((8, size))
    root = rng.standard_normal((size, size))
    N, W = J.T @ J, root @ root.T + 0.1 * np.eye(size)
    W *= np.abs(np.linalg.eigvals(np.linalg.solve(W, N))).max() / radius
    return rng.standard_normal(size), N, W


def true_error(g, N, W):
    """Return e = g^T delta + 1/2 delta^T N delta at delta = -(N + W)^-1 g."""
    delta = -np.linalg.solve(N + W, g)
    return g @ delta + 0.5 * delta @ N @ delta


def terms(g, N, W, count):
    """Return K(n) = g^T (W^-1 N)^n W^-1 g."""
    K, vector = [], np.linalg.solve(W, g)
    for _ in range(count):
        K.append(g @ vector)
        vector = np.linalg.solve(W, N @ vector)
    return np.array(K)


def partial_sums(K):
    """Return eq. (10) truncated at each order."""
    n = np.arange(len(K))
    return np.cumsum((-1.0) ** (n + 1) * (1.0 + n / 2.0) * K)


def test_truncations_are_partial_sums(table):
    K = np.random.default_rng(1).standard_normal((9, 20))
    e = table.error_series(K)
    # Nine terms of order one.
    np.testing.assert_allclose(e, np.cumsum(EQ10[:, None] * K, axis=0), rtol=0, atol=1e-13)


def test_first_order_is_the_decrease_that_b03_maximises(table):
    g, N, W = problem(2, 0.5)
    K = terms(g, N, W, 9)
    assert table.error_series(K)[0] == pytest.approx(-g @ np.linalg.solve(W, g), rel=1e-12)


def test_kernel_approaches_the_error_at_the_rate_of_the_spectral_radius(table):
    for seed in range(10):
        g, N, W = problem(seed, 0.1)
        e = table.error_series(terms(g, N, W, 9))
        gap = np.abs(e - true_error(g, N, W))
        # The rest of the series: sum over k > n of (1 + k/2) 0.1^k K(0), plus rounding.
        bound = (1.0 + ORDERS) * 0.1 ** (ORDERS + 1) * (g @ np.linalg.solve(W, g)) * 1.2
        assert np.all(gap <= bound + 1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_series_converges_to_the_error_just_below_spectral_radius_1(seed):
    g, N, W = problem(seed, 0.98)
    sums = partial_sums(terms(g, N, W, 3000))
    # 1500 * 0.98^3000 is below 1e-22; the largest partial sums are about ten times the error.
    assert sums[-1] == pytest.approx(true_error(g, N, W), rel=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_series_diverges_just_above_spectral_radius_1(seed):
    g, N, W = problem(seed, 1.02)
    gap = np.abs(partial_sums(terms(g, N, W, 1000)) - true_error(g, N, W))
    assert gap[-1] > 1e3 * gap[100]
    assert gap[-1] > 1e3 * abs(true_error(g, N, W))


def test_series_converges_where_the_norm_condition_of_the_paper_fails():
    # ||W^-1 N|| < 1 is sufficient only: a badly scaled W makes the norm large, not the radius.
    scales = np.array([1.0, 1e-3, 1e3, 1.0, 1.0])
    g, N, W = problem(3, 0.9)
    g, N, W = scales * g, scales[:, None] * N * scales, scales[:, None] * W * scales
    product = np.linalg.solve(W, N)
    assert np.linalg.norm(product, 2) > 1e3
    assert np.abs(np.linalg.eigvals(product)).max() == pytest.approx(0.9, rel=1e-6)
    sums = partial_sums(terms(g, N, W, 1000))
    assert sums[-1] == pytest.approx(true_error(g, N, W), rel=1e-8)
