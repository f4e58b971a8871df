"""Costs and Newton systems of many pairs at once, over any array namespace."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import arrays
from epigauge.linear import BENT, LIFT
from epigauge.two_view.criteria import settled

__all__ = ["Problem", "System"]

Tensor = Any
Indices = NDArray[np.intp]

#: Where the upper triangle of a symmetric 9x9 matrix stands in its packed form.
_PLACES: Indices = np.zeros((9, 9), np.intp)
_PLACES[np.triu_indices(9)] = np.arange(45)
_PLACES = np.maximum(_PLACES, _PLACES.T)

#: Longest Newton step of a pair at its minimum.
_SHORT = 1e-3


class Problem:
    """Costs and Newton systems of all pairs; batch axes (n, m), one F a pair."""

    def __init__(self, xp: Any, q1: Tensor, q2: Tensor, weights: Tensor) -> None:
        self.xp, self.kernels = xp, arrays.table(xp)
        self.q1, self.q2, self.weights = q1, q2, weights
        self.floor = 0.5e-30 * xp.sum(weights, axis=-1)
        self.places = xp.asarray(_PLACES.ravel(), device=arrays.device(q1))

    def factorize(self, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return U, V (3, 3, n, 1) and sigma (n, 1) of F (n, 3, 3)."""
        xp = self.xp
        U, values, Vt = xp.linalg.svd(F)
        first = xp.permute_dims(U, (1, 2, 0))[..., None]
        return first, xp.permute_dims(Vt, (2, 1, 0))[..., None], (values[:, 1:2] / values[:, :1])

    def fundamental(self, factors: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Return F (3, 3, n, 1)."""
        return self.kernels.fundamental_from_factors(*factors)

    def distances(self, F: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Return multipliers and signed distances (n, m), and the frame of F."""
        xp, feet = self.xp, self.kernels
        frame = feet.bilinear_frame(F)
        with np.errstate(all="ignore"):  # Newton may step onto a pole
            multiplier, change, d = feet.foot_point(*frame, self.q1, self.q2)
            good = settled(multiplier, change, d)
        if not bool(xp.all(good)):
            safe, _, safe_d = feet.foot_point_safe(*frame, self.q1, self.q2)
            multiplier = xp.where(good, multiplier, safe)
            d = xp.where(good, d, safe_d)
        return multiplier, d, frame

    def cost(self, factors: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Return the cost of each pair, infinite where it is not a number."""
        d = self.distances(self.fundamental(factors))[1]
        cost = 0.5 * self.xp.sum(self.weights * d**2, axis=-1)
        return self.xp.where(self.xp.isfinite(cost), cost, math.inf)

    def gradient(
        self, factors: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return gradient, J^T J and Hessian by vect(F), and the two derivatives of vect(F)."""
        xp, n = self.xp, self.weights.shape[0]
        F, dF, d2F = self.kernels.fundamental_derivatives(*factors)
        multiplier, _, frame = self.distances(F)
        g, N, H = self.kernels.reprojection_newton(
            *(*frame, self.q1, self.q2, multiplier, self.weights, xp.zeros_like(self.weights))
        )
        turn = _kron(xp, _padded(xp, frame[1]), _padded(xp, frame[0]))
        g = xp.matmul(turn, xp.permute_dims(g, (1, 0))[..., None])[..., 0]
        N, H = (
            turn
            @ xp.reshape(xp.take(xp.permute_dims(packed, (1, 0)), self.places, axis=1), (n, 9, 9))
            @ xp.matrix_transpose(turn)
            for packed in (N, H)
        )
        dF = xp.permute_dims(dF[..., 0], (2, 0, 1))
        d2F = xp.reshape(xp.permute_dims(d2F[..., 0], (3, 0, 1, 2)), (n, 9, 49))
        return g, N, H, dF, d2F

    def linearize(self, factors: tuple[Tensor, Tensor, Tensor]) -> System:
        """Return the Newton system by the seven update parameters."""
        xp, n = self.xp, self.weights.shape[0]
        g, N, H, dF, d2F = self.gradient(factors)
        across = xp.matrix_transpose(dF)
        hessian = across @ H @ dF + xp.reshape(g[:, None, :] @ d2F, (n, 7, 7))
        normal = across @ N @ dF
        diagonal = xp.stack([normal[:, i, i] for i in range(7)], axis=-1)
        bend = xp.reshape(across @ N @ d2F, (n, 7, 7, 7))
        values, vectors = xp.linalg.eigh(0.5 * (hessian + xp.matrix_transpose(hessian)))
        return System(xp, (across @ g[..., None])[..., 0], values, vectors, diagonal, bend)

    def retract(
        self, factors: tuple[Tensor, Tensor, Tensor], step: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the factors moved by steps (n, 7)."""
        delta = self.xp.permute_dims(step, (1, 0))[..., None]
        return tuple(self.kernels.retract_factors(*factors, delta))

    def polished(
        self, values: Problem, factors: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return factors after one Newton step: the gradient is ours, the Hessian of `values`."""
        xp = self.xp
        system = values.linearize(factors)
        g, _, _, dF, _ = self.gradient(factors)
        gradient = (xp.matrix_transpose(arrays.constant(dF)) @ g[..., None])[..., 0]
        step = system.along(gradient, xp.where(system.values > 0.0, system.values, math.inf))
        # A long step is no step at a minimum: the pair did not converge, and stays.
        short = xp.sqrt(xp.sum(arrays.constant(step) ** 2, axis=-1)) <= _SHORT
        return self.retract(factors, xp.where(short[:, None], step, 0.0))


@dataclass(frozen=True)
class System:
    """Newton systems in their eigenbases, as `epigauge.linear.Dense`."""

    xp: Any
    gradient: Tensor
    values: Tensor
    vectors: Tensor
    diagonal: Tensor
    bend: Tensor

    def along(self, right: Tensor, damped: Tensor) -> Tensor:
        """Return -(damped Hessian)^-1 right."""
        xp = self.xp
        inside = xp.matrix_transpose(self.vectors) @ right[..., None]
        return -(self.vectors @ (inside / damped[..., None]))[..., 0]

    def step(self, lam: Tensor) -> Tensor:
        """Return the damped steps, bent like the valley where that is short against them."""
        xp = self.xp
        lowest = self.values[:, 0]
        shift = xp.where(lowest + lam > 0.0, lam, lam - (1.0 + LIFT) * lowest)
        least = float(xp.finfo(self.values.dtype).smallest_normal)
        damped = xp.clip(self.values + shift[:, None], least)
        step = self.along(self.gradient, damped)
        curved = xp.sum(self.bend * step[:, None, None, :], axis=-1)
        bent = 0.5 * self.along(xp.sum(curved * step[:, None, :], axis=-1), damped)
        mild = xp.sum(bent**2, axis=-1) <= BENT * xp.sum(step**2, axis=-1)
        return step + xp.where(mild[:, None], bent, 0.0)

    def decrement(self) -> Tensor:
        """Return what the undamped step promises; infinity where H is not positive definite."""
        xp = self.xp
        eps = float(xp.finfo(self.values.dtype).eps)
        definite = self.values[:, 0] > eps * self.values[:, -1]
        inside = (xp.matrix_transpose(self.vectors) @ self.gradient[..., None])[..., 0]
        safe = xp.where(definite[:, None], self.values, 1.0)
        return xp.where(definite, 0.5 * xp.sum(inside**2 / safe, axis=-1), math.inf)


def _padded(xp: Any, R: Tensor) -> Tensor:
    """Return rotations of the image plane (2, 2, n, 1) as matrices (n, 3, 3)."""
    a, b, c, d = R[0, 0, :, 0], R[0, 1, :, 0], R[1, 0, :, 0], R[1, 1, :, 0]
    zero, one = xp.zeros_like(a), xp.ones_like(a)
    rows = [xp.stack(row, axis=-1) for row in ((a, b, zero), (c, d, zero), (zero, zero, one))]
    return xp.stack(rows, axis=1)


def _kron(xp: Any, A: Tensor, B: Tensor) -> Tensor:
    """Return Kronecker products (n, 9, 9) of 3x3 matrices."""
    product = A[:, :, None, :, None] * B[:, None, :, None, :]
    return xp.reshape(product, (A.shape[0], 9, 9))
