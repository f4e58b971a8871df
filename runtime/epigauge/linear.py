"""Linear systems that a Levenberg-Marquardt step solves, and the dampings over them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["BENT", "LAM_FLOOR", "LIFT", "Arrow", "Dense", "Levenberg", "Seber"]

Array = NDArray[np.float64]

#: Least lambda over the first in two views, whose small systems are solved to rounding: lower than
#: that of many views, since essential matrices in a narrow field of view have directions that are
#: determined 1e6 times worse than others.
LAM_FLOOR = 1e-11

#: A direction of negative curvature is lifted this far above zero, relative to the curvature.
LIFT = 1e-3


class _Solvable(Protocol):
    """A linear system that two dampings can be added to."""

    def typical(self) -> float:
        """Return a typical large diagonal entry of the Hessian."""

    def solve(self, lam: float, *, scaled: bool) -> Array:
        """Return -(H + lam W)^-1 g, with W = I or, if scaled, W = diag(J^T J)."""


#: A correction for the bend of a valley is taken when its square is below this much of the step's:
#: Transtrum and Sethna's bound on twice its length, 0.75.
BENT = 0.375**2


@dataclass(frozen=True)
class Levenberg:
    """Damping lambda I, called LM in B&S; the first lambda is relative to the diagonal."""

    lam_floor = LAM_FLOOR

    relative: float = 1e-3

    def start(self, system: _Solvable) -> float:
        """Return `relative` times a typical diagonal entry."""
        return self.relative * max(system.typical(), 1e-300)

    def step(self, system: _Solvable, lam: float) -> Array:
        """Return -(H + lam I)^-1 g."""
        return system.solve(lam, scaled=False)


@dataclass(frozen=True)
class Seber:
    """Damping lambda diag(J^T J), called SEBER in B&S: the diagonal is multiplied by 1 + lambda."""

    lam_floor = LAM_FLOOR

    relative: float = 1e-3

    def start(self, system: _Solvable) -> float:
        """Return `relative`, since this damping scales with the system."""
        return self.relative

    def step(self, system: _Solvable, lam: float) -> Array:
        """Return -(H + lam diag(J^T J))^-1 g."""
        return system.solve(lam, scaled=True)


@dataclass(frozen=True)
class Dense:
    """A small dense system, its Hessian possibly indefinite.

    Attributes
    ----------
    gradient : ndarray, shape (p,)
        Gradient of the cost.
    hessian : ndarray, shape (p, p)
        Exact Hessian, or the Gauss-Newton matrix J^T J.
    diagonal : ndarray, shape (p,)
        Diagonal of J^T J, positive: the scale of each parameter.
    bend : ndarray, shape (p, p, p), optional
        J^T r'', with the second derivatives r'' of the residuals: lets a step follow a curved
        valley (geodesic acceleration [1]_).

    References
    ----------
    .. [1] M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for
       nonlinear least-squares minimization", 2012.
    """

    gradient: Array
    hessian: Array
    diagonal: Array
    bend: Array | None = None

    def largest(self) -> float:
        """Return the largest diagonal entry of J^T J."""
        return float(np.max(self.diagonal))

    def typical(self) -> float:
        """Return the largest diagonal entry of J^T J."""
        return self.largest()

    def solve(self, lam: float, *, scaled: bool) -> Array:
        """Solve in the eigenbasis; lambda is lifted until the damped Hessian is definite.

        With a bend the step v becomes v + a, where a = -(H + lambda W)^-1 J^T r''(v, v) / 2 keeps
        the residuals to second order where v keeps them to first, unless a is long against v.
        """
        scale, values, vectors = self._scaled if scaled else self._plain
        lowest = values[0] + lam
        shift = lam if lowest > 0.0 else lam - (1.0 + LIFT) * values[0]
        damped = np.maximum(values + shift, np.finfo(float).tiny)

        def apply(right: Array) -> Array:
            """Return the step in units of the damping, for a gradient."""
            return np.asarray(-(vectors @ (vectors.T @ (right / scale) / damped)))

        step = apply(self.gradient)
        if self.bend is not None:
            v = step / scale
            bent = 0.5 * apply((self.bend @ v) @ v)
            if bent @ bent <= BENT * (step @ step):
                step = step + bent
        return np.asarray(step / scale)

    def predicted(self, step: Array) -> float:
        """Return -(g^T step + step^T H step / 2)."""
        return float(-(self.gradient @ step + 0.5 * step @ self.hessian @ step))

    def decrement(self) -> float:
        """Return g^T H^-1 g / 2; infinity where H is not positive definite."""
        _, values, vectors = self._plain
        if values[0] <= np.finfo(float).eps * values[-1]:
            return float("inf")
        return float(0.5 * np.sum((vectors.T @ self.gradient) ** 2 / values))

    @cached_property
    def _plain(self) -> tuple[Array, Array, Array]:
        values, vectors = np.linalg.eigh(self.hessian)
        return np.ones_like(self.gradient), values, vectors

    @cached_property
    def _scaled(self) -> tuple[Array, Array, Array]:
        floor = np.finfo(float).eps * max(self.largest(), np.finfo(float).tiny)
        scale = np.sqrt(np.maximum(self.diagonal, floor))
        values, vectors = np.linalg.eigh(self.hessian / np.outer(scale, scale))
        return scale, values, vectors


@dataclass(frozen=True)
class Arrow:
    """Normal equations of motion and structure; points couple with the motion only.

    ``[[U, W], [W^T, V]]`` with V block diagonal; the points are eliminated (Schur complement).

    Attributes
    ----------
    U : ndarray, shape (p, p)
        Motion block of J^T J.
    W : ndarray, shape (m, p, k)
        Coupling of the motion with each point.
    V : ndarray, shape (m, k, k)
        Block of each point.
    g_motion : ndarray, shape (p,)
        Gradient by the motion.
    g_points : ndarray, shape (m, k)
        Gradient by each point.
    border : ndarray, shape (m, k, r), optional
        B in a term B B^T over the points that couples all of them: gauge constraints.
    """

    U: Array
    W: Array
    V: Array
    g_motion: Array
    g_points: Array
    border: Array | None = None

    @cached_property
    def gradient(self) -> Array:
        """Return motion part, then the points one after the other."""
        return np.concatenate([self.g_motion, self.g_points.ravel()])

    def largest(self) -> float:
        """Return the largest diagonal entry."""
        points = np.einsum("mkk->mk", self.V)
        return float(max(np.max(np.diag(self.U)), np.max(points)))

    def typical(self) -> float:
        """Return the median diagonal entry of the points.

        Entries of the motion are sums over all points, and a point near an epipole has one as
        large: lambda relative to the largest would hold the other points still for many steps.
        """
        return float(np.median(np.einsum("mkk->mk", self.V)))

    def solve(self, lam: float, *, scaled: bool) -> Array:
        """Solve by the Schur complement of the points; the border by Woodbury's identity.

        Raises
        ------
        numpy.linalg.LinAlgError
            If a point's block or the complement is singular to rounding.
        """
        p, k = len(self.U), self.V.shape[1]
        if scaled:
            # A match of weight zero leaves zeros on the diagonal, which no factor would lift.
            floor = np.finfo(float).eps * max(self.largest(), np.finfo(float).tiny)
            U = self.U + lam * np.diag(np.maximum(np.diag(self.U), floor))
            points = np.maximum(np.einsum("mkk->mk", self.V), floor)
            V = self.V + lam * points[:, None, :] * np.eye(k)
        else:
            U = self.U + lam * np.eye(p)
            V = self.V + lam * np.eye(k)
        inverse = np.linalg.inv(V)
        Y = self.W @ inverse
        reduced = U - np.einsum("mpk,mqk->pq", Y, self.W)
        if not np.isfinite(reduced).all():
            raise np.linalg.LinAlgError("the block of a point is singular")

        def apply(motion: Array, points: Array) -> Array:
            """Apply the inverse to right-hand sides (p, r) and (m, k, r)."""
            motion = np.linalg.solve(reduced, motion - np.einsum("mpk,mkr->pr", Y, points))
            points = inverse @ (points - np.einsum("mpk,pr->mkr", self.W, motion))
            return np.concatenate([motion, points.reshape(-1, motion.shape[1])])

        step = -apply(self.g_motion[:, None], self.g_points[:, :, None])[:, 0]
        if self.border is None:
            return step
        width = self.border.shape[2]
        B = np.concatenate([np.zeros((p, width)), self.border.reshape(-1, width)])
        bordered = apply(B[:p], self.border)
        return np.asarray(
            step - bordered @ np.linalg.solve(np.eye(width) + B.T @ bordered, B.T @ step)
        )

    def predicted(self, step: Array) -> float:
        """Return -(g^T step + step^T N step / 2)."""
        p = len(self.g_motion)
        a, b = step[:p], step[p:].reshape(self.g_points.shape)
        curvature = a @ self.U @ a + 2.0 * np.einsum("p,mpk,mk->", a, self.W, b, optimize=True)
        curvature += np.einsum("mk,mkl,ml->", b, self.V, b, optimize=True)
        if self.border is not None:
            curvature += np.sum(np.einsum("mkr,mk->r", self.border, b) ** 2)
        return float(-(self.gradient @ step + 0.5 * curvature))

    def decrement(self) -> float:
        """Return infinity: J^T J may be singular by a free gauge."""
        return float("inf")
