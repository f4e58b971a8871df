"""What tests of several packages share: how to check derivatives and arrays, and where."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def central_differences(f: Callable[[Array], ArrayLike], x: ArrayLike, step: float = 1e-3) -> Array:
    """Differentiate `f` at `x` by central differences of fourth order.

    (8 (f(x + h) - f(x - h)) - (f(x + 2h) - f(x - 2h))) / 12h, whose truncation error is h^4 / 30
    times the fifth derivative. With values of order one and the default step it is about 1e-12,
    and so is the rounding error 1e-16 / h.

    To differentiate through a retraction, let `f` retract by its argument and `x` be zeros.

    Parameters
    ----------
    f : callable
        Function of an array shaped like `x`; it may return an array of any shape.
    x : array_like
        Where to differentiate.
    step : float
        Step h in each entry of `x`.

    Returns
    -------
    ndarray, shape f(x).shape + x.shape
        Derivative of each entry of f by each entry of x.
    """
    x = np.array(x, dtype=np.float64)
    columns = []
    for index in np.ndindex(x.shape):

        def at(offset: float, index: tuple[int, ...] = index) -> Array:
            moved = x.copy()
            moved[index] += offset
            return np.array(f(moved), dtype=np.float64)

        near, far = at(step) - at(-step), at(2 * step) - at(-2 * step)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1).reshape(columns[0].shape + x.shape)


def distance(actual: ArrayLike, expected: ArrayLike) -> float:
    """Return the largest difference of two arrays, relative to the largest expected entry or 1.

    NaN where either has one, so that comparing with a tolerance fails.
    """
    actual, expected = np.asarray(actual, dtype=float), np.asarray(expected, dtype=float)
    assert actual.shape == expected.shape, f"shapes {actual.shape} and {expected.shape}"
    if not actual.size:
        return 0.0
    return float(np.max(np.abs(actual - expected)) / max(1.0, np.max(np.abs(expected))))


def assert_jacobian(
    f: Callable[[Array], ArrayLike],
    x: ArrayLike,
    jacobian: ArrayLike,
    *,
    step: float = 1e-3,
    tolerance: float = 1e-9,
) -> None:
    """Check a derivative of shape f(x).shape + x.shape against central differences of f at x."""
    error = distance(jacobian, central_differences(f, x, step))
    assert error <= tolerance, f"differs from central differences by {error:.1e}"


# ---------------------------------------------------------------- where laws are checked


def orthonormal(rng: np.random.Generator, sign: int = 1) -> Array:
    """Return a random orthonormal matrix with determinant `sign`."""
    Q, R = np.linalg.qr(rng.standard_normal((3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q if np.linalg.det(Q) * sign > 0 else -Q


def _horizontal(rng: np.random.Generator, sign: int = 1) -> Array:
    """Return an orthonormal matrix whose last column is a point at infinity."""
    Q = orthonormal(rng, sign)
    direction = np.append(Q[:2, 2] / np.linalg.norm(Q[:2, 2]), 0.0)
    first = np.cross(direction, Q[:, 0])
    first /= np.linalg.norm(first)
    second = np.cross(direction, first) * sign
    return np.column_stack([first, second, direction])


def factor_cases(seed: int = 0) -> dict[str, tuple[Array, Array, Array]]:
    """Return orthonormal representations (U, V, sigma) by name: general, and the hard places."""
    rng = np.random.default_rng(seed)

    def case(sigma: float, u: int = 1, v: int = 1) -> tuple[Array, Array, Array]:
        return orthonormal(rng, u), orthonormal(rng, v), np.array(sigma)

    return {
        "general": case(0.6),
        "left-handed U": case(0.3, u=-1),
        "left-handed V": case(0.8, v=-1),
        "both left-handed": case(0.5, u=-1, v=-1),
        "sigma near 0": case(1e-9),
        "sigma near 1": case(1.0 - 1e-9),
        "sigma 1": case(1.0),
        "sigma above 1": case(1.3),
        "epipole 1 at infinity": (orthonormal(rng), _horizontal(rng), np.array(0.7)),
        "epipole 2 at infinity": (_horizontal(rng, -1), orthonormal(rng), np.array(0.4)),
        "both at infinity": (_horizontal(rng), _horizontal(rng), np.array(0.9)),
    }


def fundamental(U: Array, V: Array, sigma: ArrayLike) -> Array:
    """Return U diag(1, sigma, 0) V^T."""
    return np.asarray(U @ np.diag([1.0, float(np.asarray(sigma)), 0.0]) @ V.T)


def fundamental_cases(seed: int = 0) -> dict[str, Array]:
    """Return matrices F of rank 2 by name: general, and the hard places."""
    cases = {name: fundamental(*factors) for name, factors in factor_cases(seed).items()}
    general = cases["general"]
    cases |= {
        "scaled by -3": -3.0 * general,
        "scaled by 1e-6": 1e-6 * general,
        "rectified": np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
        "affine": np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.7], [0.5, 0.9, 0.1]]),
        # Upper left block: a rotation, a reflection (equal singular values), of rank 1.
        "forward motion": np.array([[0.0, -1.0, 0.2], [1.0, 0.0, -0.3], [-0.1, 0.4, -0.05]]),
        "reflection": np.array([[0.8, 0.6, 0.2], [0.6, -0.8, 0.5], [0.44, -0.28, 0.2808]]),
        "block of rank 1": np.array([[0.2, 0.4, 0.1], [0.1, 0.2, -0.6], [0.3, 0.6, -0.5]]),
    }
    return cases


def matches(rng: np.random.Generator, F: Array, count: int, noise: float) -> tuple[Array, Array]:
    """Return (2, count) matches whose second points lie on their epipolar lines but for noise."""
    q1, q2 = rng.standard_normal((2, 2, count))
    line = F[:, :2] @ q1 + F[:, 2:]
    # The foot of q2 on the line.
    q2 = q2 - line[:2] * (np.sum(line[:2] * q2, axis=0) + line[2]) / np.sum(line[:2] ** 2, axis=0)
    return tuple(q + noise * rng.standard_normal(q.shape) for q in (q1, q2))


def unpacked(packed: np.ndarray) -> np.ndarray:
    """Return the symmetric 9x9 matrix of an upper triangle."""
    matrix = np.zeros((9, 9))
    matrix[np.triu_indices(9)] = packed
    return matrix + np.triu(matrix, 1).T


def vect(matrix: Any) -> Any:
    """Return a CasADi matrix row by row."""
    casadi = pytest.importorskip("casadi")
    return casadi.vec(matrix.T)
