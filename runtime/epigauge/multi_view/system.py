"""Normal equations of cameras and points, solved by the Schur complement of the points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.coupling import Coupling, StoredCoupling, solved
from epigauge.multi_view.layout import Layout

__all__ = ["BundleSystem", "Layout"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BundleSystem:
    """Blocks of J^T J and the gradient; a = parameters a camera, b = parameters a point.

    Attributes
    ----------
    layout : Layout
        The observations.
    U : ndarray, shape (n, a, a)
        Camera blocks.
    V : ndarray, shape (m, b, b)
        Point blocks.
    W : ndarray, shape (N, a, b), or Coupling
        Coupling of each observation's camera and point, or what multiplies by it unseen.
    g_cameras, g_points : ndarray, shape (n, a), (m, b)
        Gradient.
    border : tuple of ndarray, optional
        (n, a, r) and (m, b, r): B in a term B B^T that couples everything (gauge constraints).
    """

    layout: Layout
    U: Array
    V: Array
    W: Array | Coupling
    g_cameras: Array
    g_points: Array
    border: tuple[Array, Array] | None = None
    #: The last step made by `whitened_step`, and the decrease that it promises.
    _made: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)

    @cached_property
    def coupling(self) -> Coupling:
        """Return what multiplies by the coupling."""
        return StoredCoupling(self.layout, self.W) if isinstance(self.W, np.ndarray) else self.W

    @cached_property
    def gradient(self) -> Array:
        """Return the gradient as one vector: cameras, then points."""
        return np.concatenate([self.g_cameras.ravel(), self.g_points.ravel()])

    def largest(self) -> float:
        """Return the largest mean diagonal entry of a block.

        Unlike the largest entry, an orthonormal change of basis does not change it.
        """
        traces = (np.einsum("nii->n", blocks) / blocks.shape[1] for blocks in (self.U, self.V))
        return float(max(trace.max() for trace in traces))

    def decrement(self) -> float:
        """Return infinity: J^T J is singular along the gauge."""
        return float("inf")

    def split(self, vector: Array) -> tuple[Array, Array]:
        """Return camera part (n, a) and point part (m, b) of a vector."""
        size = self.g_cameras.size
        cameras, points = vector[:size], vector[size:]
        return cameras.reshape(self.g_cameras.shape), points.reshape(self.g_points.shape)

    def product(self, step: Array) -> Array:
        """Return J^T J times a vector."""
        x, y = self.split(step)
        cameras = np.einsum("nij,nj->ni", self.U, x)
        cameras += self.coupling.times_points(y[..., None])[..., 0]
        points = np.einsum("nij,nj->ni", self.V, y)
        points += self.coupling.times_cameras(x[..., None])[..., 0]
        if self.border is not None:
            Bc, Bp = self.border
            along = np.einsum("nir,ni->r", Bc, x) + np.einsum("nir,ni->r", Bp, y)
            cameras, points = cameras + Bc @ along, points + Bp @ along
        return np.concatenate([cameras.ravel(), points.ravel()])

    def predicted(self, step: Array) -> float:
        """Return -(g^T step + step^T N step / 2)."""
        if self._made and self._made[0] is step:
            return float(self._made[1])
        return float(-(self.gradient @ step + 0.5 * step @ self.product(step)))

    def damped(self, W_cameras: Array, W_points: Array) -> BundleSystem:
        """Return the system with block diagonal matrices added to J^T J."""
        return replace(self, U=self.U + W_cameras, V=self.V + W_points)

    def transformed(self, B_cameras: Array, B_points: Array) -> BundleSystem:
        """Return the system in parameters y with x = B y, blocks (n, a, a') and (m, b, b').

        A column of zeros freezes a parameter: its diagonal entry becomes one.
        """
        return replace(
            self,
            U=_congruent(B_cameras, self.U),
            V=_congruent(B_points, self.V),
            W=self.coupling.transformed(B_cameras, B_points),
            g_cameras=np.einsum("nij,ni->nj", B_cameras, self.g_cameras),
            g_points=np.einsum("nij,ni->nj", B_points, self.g_points),
            border=None
            if self.border is None
            else (
                np.swapaxes(B_cameras, 1, 2) @ self.border[0],
                np.swapaxes(B_points, 1, 2) @ self.border[1],
            ),
        )

    def solve(self) -> Array:
        """Return -(J^T J)^-1 g."""
        rhs = (-self.g_cameras[..., None], -self.g_points[..., None])
        if self.border is None:
            x, y = self._apply_inverse(*rhs)
            return np.concatenate([x.ravel(), y.ravel()])
        # Woodbury: the border's columns are solved for along with the gradient.
        Bc, Bp = self.border
        x, y = self._apply_inverse(
            np.concatenate([rhs[0], Bc], axis=2), np.concatenate([rhs[1], Bp], axis=2)
        )
        overlap = np.einsum("nir,nis->rs", Bc, x) + np.einsum("nir,nis->rs", Bp, y)
        shift = np.linalg.solve(np.eye(Bc.shape[2]) + overlap[:, 1:], overlap[:, :1])
        x, y = x[..., :1] - x[..., 1:] @ shift, y[..., :1] - y[..., 1:] @ shift
        return np.concatenate([x.ravel(), y.ravel()])

    def whitened_step(self, W: tuple[Array, Array], lam: float) -> Array:
        """Return -(J^T J + lam W)^-1 g, solved by parameters in which W = I.

        There its condition is about |W^-1 J^T J| / lam whatever the basis; a basis far from the one
        that suits the problem would cost digits, and the step its invariance.
        """
        if self.border is None:
            made = self.coupling.whitened_step(
                self.U, self.V, self.g_cameras, self.g_points, W, lam
            )
            if made is not None:
                step, energy = made
                # step^T J^T J step = -g^T step - lam step^T W step.
                promised = 0.5 * (lam * energy - float(self.gradient @ step))
                self._made[:] = [step, promised]
                return step
        roots = [np.swapaxes(np.linalg.cholesky(blocks), 1, 2) for blocks in W]
        whitening = (np.linalg.inv(roots[0]), np.linalg.inv(roots[1]))
        white = self.transformed(*whitening)
        shifts = (lam * np.broadcast_to(np.eye(B.shape[1]), B.shape) for B in (white.U, white.V))
        x, y = white.split(white.damped(*shifts).solve())
        cameras, points = whitening[0] @ x[..., None], whitening[1] @ y[..., None]
        return np.concatenate([cameras.ravel(), points.ravel()])

    def solve_grounded(self, moves: Array) -> Array:
        """Return -(J^T J + moves moves^T)^-1 g, moves (n a, r) acting on the cameras only.

        For systems that are singular without it; the reduced system is dense.
        """
        rhs = (-self.g_cameras[..., None], -self.g_points[..., None])
        x, y = self._apply_inverse(*rhs, moves)
        return np.concatenate([x.ravel(), y.ravel()])

    def _apply_inverse(
        self, cameras: Array, points: Array, moves: Array | None = None
    ) -> tuple[Array, Array]:
        """Apply the inverse of the part without border to right-hand sides (n, a, r), (m, b, r)."""
        coupling = self.coupling
        roots = coupling.inverse_roots(self.V)
        half = np.swapaxes(roots, 1, 2) @ points
        right = cameras - coupling.times_points(roots @ half)
        reduced = coupling.reduced(self.U, roots)
        n, a, r = right.shape
        x: Array
        if moves is not None:
            S = reduced.matrix() + moves @ moves.T
            x = np.asarray(np.linalg.solve(S, right.reshape(n * a, r))).reshape(n, a, r)
        else:
            x = solved(reduced, right)
        return x, roots @ (half - np.swapaxes(roots, 1, 2) @ coupling.times_cameras(x))

    def _reduced_matrix(self) -> Array:
        """Return the Schur complement U - W V^-1 W^T, dense, (n a, n a)."""
        return self.coupling.reduced(self.U, self.coupling.inverse_roots(self.V)).matrix()


def _congruent(B: Array, blocks: Array) -> Array:
    """Return B^T A B for each block, with ones on the diagonal where B has a column of zeros."""
    result = np.swapaxes(B, 1, 2) @ blocks @ B
    frozen = ~B.any(axis=1)
    k, i = np.nonzero(frozen)
    result[k, i, i] = 1.0
    return np.asarray(result)
