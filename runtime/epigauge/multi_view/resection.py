"""One camera from known points: linear, then robustly refined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._library import address
from epigauge._native import function
from epigauge.kernels import Table
from epigauge.linear import Dense, Levenberg
from epigauge.scatter import spread
from epigauge.two_view.losses import EFFICIENT, Loss, robust_scale

__all__ = ["resect"]

Array = NDArray[np.float64]

#: Rounds in which the scale of the loss is estimated anew, and the change that ends them.
_ROUNDS, _STEADY = 5, 1e-8

_STOPPING = lm.Stopping(ftol=1e-6)


def resect(kernels: Table, q: Array, Q: Array, start: Array | None = None) -> Array:
    """Return the camera that projects points to measurements: linear, then robustly refined.

    Parameters
    ----------
    kernels : Table
        Backend.
    q, Q : ndarray, shape (2, c), (4, c)
        At least six measurements and points.
    start : ndarray, shape (3, 4), optional
        What to refine; by default the camera of least algebraic error.

    Returns
    -------
    ndarray, shape (3, 4)
        Camera of unit norm.
    """
    minimized = _minimized_in_c if kernels.name == "c" else _minimized
    q, Q = np.ascontiguousarray(q), np.ascontiguousarray(Q)
    P = _linear_camera(q, Q) if start is None else start
    for _ in range(_ROUNDS):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            h = P @ Q
            distances = np.linalg.norm(q - h[:2] / h[2], axis=0)
        scale = EFFICIENT["cauchy"] * max(robust_scale(distances), 1e-12)
        found = minimized(kernels, q, Q, scale, P)
        change = found / np.linalg.norm(found) - P / np.linalg.norm(P)
        P = found
        if np.linalg.norm(change) < _STEADY:
            break
    return np.asarray(P / np.linalg.norm(P))


def _linear_camera(q: Array, Q: Array) -> Array:
    """Return the camera of least algebraic error, with points in a basis that spreads them."""
    points, T = spread(Q.T)
    # Normal equations of rows (X, 0, -x X) and (0, X, -y X), block by block.
    plain, in_x, in_y, both = (
        points.T @ (w[:, None] * points) for w in (np.ones(len(points)), *q, np.sum(q**2, axis=0))
    )
    zero = np.zeros((4, 4))
    N = np.block([[plain, zero, -in_x], [zero, plain, -in_y], [-in_x, -in_y, both]])
    return np.asarray(np.linalg.eigh(N)[1][:, 0].reshape(3, 4) @ np.linalg.inv(T))


def _minimized_in_c(kernels: Table, q: Array, Q: Array, scale: float, P: Array) -> Array:
    """Return what `_minimized` returns, by one call."""
    found = np.array(P, order="C")
    options = (scale**2, _STOPPING.ftol, _STOPPING.max_iter)
    if function("resect")(q.shape[1], address(q), address(Q), *options, address(found)):
        raise MemoryError("no memory for the points of one view")
    return found


def _minimized(kernels: Table, q: Array, Q: Array, scale: float, P: Array) -> Array:
    """Return the camera of least Cauchy loss, from a start."""
    problem = _Resection(kernels, q, Q, Loss("cauchy", scale))
    return lm.minimize(problem, P, Levenberg(), lm.Classic(), _STOPPING).state.P


@dataclass(frozen=True)
class _CameraState:
    P: Array
    r: Array
    J: Array
    root: Array
    cost: float


class _Resection:
    """One camera from known points, robustly."""

    floor = 0.0

    def __init__(self, kernels: Table, q: Array, Q: Array, loss: Loss) -> None:
        self.kernels, self.q, self.Q, self.loss = kernels, q, Q, loss

    def evaluate(self, P: Array) -> _CameraState:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            q_hat, J, _, _ = self.kernels.project(P[..., None], self.Q)
            r = self.q - q_hat
            rho, first, _ = self.loss(np.sum(r**2, axis=0))
            cost = 0.5 * float(np.sum(rho))
        return _CameraState(P, r, J, np.sqrt(first), cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: _CameraState) -> Dense:
        J = (-state.root * state.J).transpose(1, 0, 2).reshape(12, -1)
        N = J @ J.T
        return Dense(J @ (state.root * state.r).ravel(), N, np.diag(N).copy())

    def retract(self, state: _CameraState, step: Array) -> Array:
        return state.P + step.reshape(3, 4)
