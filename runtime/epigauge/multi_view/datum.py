"""Gauges as linear constraints, and the projectors that take covariances into them.

The S-transformation of geodesy: a motion along the gauge freedom is added to every small change, so
that the constraints of the gauge hold to first order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import (
    Gauge,
    five_points,
    identity,
    normalized,
    reference_camera,
    two_cameras,
)
from epigauge.scatter import scatter_constraints

__all__ = [
    "Constraints",
    "ConstraintsOfGauge",
    "Projector",
    "freedom",
    "halves",
    "mapped",
    "projector",
]

Array = NDArray[np.float64]

#: Slope of |q| in q = (q1, q2) where q is (q1, 0), far from zero.
_FIRST_ORDER = np.array([1.0, 0.0])


@dataclass(frozen=True)
class Constraints:
    """First-order conditions on a small motion (dP, dQ) that stays in a gauge.

    Attributes
    ----------
    cameras : ndarray, shape (n, 12)
        One condition a camera, ``cameras[i] @ vect(dP_i) = 0``, that fixes its scale.
    points : ndarray, shape (m, 4)
        One condition a point, ``points[j] @ dQ_j = 0``, that fixes its scale.
    basis : ndarray, shape (k, 12 n + 4 m)
        Conditions on all, ``basis @ (vect(dP), dQ) = 0``, that fix the basis; fewer than fifteen
        independent ones leave a freedom, in which the motion is of least norm.
    """

    cameras: Array
    points: Array
    basis: Array


@runtime_checkable
class ConstraintsOfGauge(Protocol):
    """A gauge of your own: offer this method, and `covariance` can use it."""

    def constraints(self, P: Array, Q: Array) -> Constraints:
        """Return the conditions at cameras (n, 3, 4) and points (m, 4) that are in the gauge."""


@dataclass(frozen=True)
class Projector:
    """The S-transformation S: takes a small motion to the equivalent one that stays in the gauge.

    S = (I - H K) L with L the scales' part and H K that of the fifteen changes of basis. S G = 0
    for the directions G of the gauge freedom, S S = S, and N S = N.

    Attributes
    ----------
    p, q : ndarray, shape (n, 12), (m, 4)
        Directions of the scales of cameras and points.
    c, d : ndarray, shape (n, 12), (m, 4)
        Conditions on them, with c . p = 1 and d . q = 1.
    H, K : ndarray, shape (12 n + 4 m, 15), (15, 12 n + 4 m)
        Changes of basis and conditions on them, K H = I; K includes L.
    """

    p: Array
    q: Array
    c: Array
    d: Array
    H: Array
    K: Array

    def apply(self, motion: Array) -> Array:
        """Return S times a motion, shape (12 n + 4 m,) or (12 n + 4 m, r)."""
        return self._scaled(motion) - self.H @ (self.K @ motion)

    def transposed(self, rows: Array) -> Array:
        """Return S^T times conditions on a motion, shape (12 n + 4 m, r)."""
        rest = rows - self.K.T @ (self.H.T @ rows)  # K includes L
        size = self.p.size
        x, y = rows[:size].reshape(*self.p.shape, -1), rows[size:].reshape(*self.q.shape, -1)
        x = self.c[:, :, None] * np.einsum("ni,nir->nr", self.p, x)[:, None]
        y = self.d[:, :, None] * np.einsum("ni,nir->nr", self.q, y)[:, None]
        return np.asarray(
            rest - np.concatenate([x.reshape(size, -1), y.reshape(len(rest) - size, -1)])
        )

    def _scaled(self, motion: Array) -> Array:
        """Return L times a motion."""
        size = self.p.size
        x = motion[:size].reshape(*self.p.shape, -1)
        y = motion[size:].reshape(*self.q.shape, -1)
        x = x - self.p[:, :, None] * np.einsum("ni,nir->nr", self.c, x)[:, None]
        y = y - self.q[:, :, None] * np.einsum("ni,nir->nr", self.d, y)[:, None]
        parts = x.reshape(size, -1), y.reshape(self.q.size, -1)
        return np.concatenate(parts).reshape(motion.shape)

    def locals(self) -> tuple[Array, Array]:
        """Return the blocks of L, (n, 12, 12) and (m, 4, 4)."""
        cameras = np.eye(12) - self.p[:, :, None] * self.c[:, None, :]
        return cameras, np.eye(4) - self.q[:, :, None] * self.d[:, None, :]


def freedom(
    table: kernels.Table, P: Array, Q: Array, maps: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Return unit directions of the scales, and an orthonormal basis of the changes beside them.

    `maps` takes changes of (P, Q) to the parameters meant.
    """
    p = np.einsum("nij,nj->ni", maps[0], P.reshape(-1, 12))
    q = np.einsum("nij,nj->ni", maps[1], Q)
    p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (p, q))
    cameras = maps[0] @ table.camera_generators(P.transpose(1, 2, 0)).transpose(2, 0, 1)
    points = maps[1] @ table.point_generators(Q.T).transpose(2, 0, 1)
    cameras = cameras - p[:, :, None] * np.einsum("ni,nik->nk", p, cameras)[:, None]
    points = points - q[:, :, None] * np.einsum("ni,nik->nk", q, points)[:, None]
    moves = np.concatenate([cameras.reshape(-1, 16), points.reshape(-1, 16)])
    # The identity only changes scales: one of the sixteen columns is dependent.
    return p, q, np.asarray(np.linalg.svd(moves, full_matrices=False)[0][:, :15])


def projector(gauge: Gauge, P: Array, Q: Array, slope: Array = _FIRST_ORDER) -> Projector:
    """Return the projector of a gauge at a reconstruction that is in it.

    `slope` is that of |q| in `halves` for `two_cameras`; (1, 0) is first order.
    """
    n, m = len(P), len(Q)
    fixed = _constraints(gauge, P, Q, slope)
    table = kernels.table()
    ones = (np.broadcast_to(np.eye(12), (n, 12, 12)), np.broadcast_to(np.eye(4), (m, 4, 4)))
    p, q, G = freedom(table, P, Q, ones)
    c = fixed.cameras / np.sum(fixed.cameras * p, axis=1, keepdims=True)
    d = fixed.points / np.sum(fixed.points * q, axis=1, keepdims=True)
    scales = Projector(p, q, c, d, np.zeros((G.shape[0], 0)), np.zeros((0, G.shape[0])))
    G = scales._scaled(G)
    rows = fixed.basis / np.linalg.norm(fixed.basis, axis=1, keepdims=True)
    U, values, Vt = np.linalg.svd(rows @ G)
    rank = int(np.count_nonzero(values > 1e-9 * values.max(initial=0.0)))
    left = np.linalg.qr(G @ Vt[rank:].T)[0]
    K = np.concatenate([U[:, :rank].T @ rows, left.T])
    H = G @ np.linalg.inv(K @ G)
    # K L, so that a motion need not be scaled first.
    x, y = K[:, : p.size].reshape(15, n, 12), K[:, p.size :].reshape(15, m, 4)
    x = x - np.einsum("rni,ni->rn", x, p)[:, :, None] * c
    y = y - np.einsum("rni,ni->rn", y, q)[:, :, None] * d
    K = np.concatenate([x.reshape(15, -1), y.reshape(15, -1)], axis=1)
    return replace(scales, H=H, K=K)


def halves(H: Array) -> Array:
    """Return p, q1 and q2 of a camera's H of rank two as conditions on dH, shape (3, 3, 3).

    Its largest singular value is p + |q|: with B = U12^T H V12, p = (B11 + B22) / 2 and
    q = (B11 - B22, B12 + B21) / 2.
    """
    U, _, Vt = np.linalg.svd(H)
    pairs = np.einsum("ia,bj->abij", U[:, :2], Vt[:2])
    p, q1 = pairs[0, 0] + pairs[1, 1], pairs[0, 0] - pairs[1, 1]
    return np.asarray(np.stack([p, q1, pairs[0, 1] + pairs[1, 0]]) / 2.0)


def _constraints(gauge: Gauge, P: Array, Q: Array, slope: Array = _FIRST_ORDER) -> Constraints:
    """Return the linearised conditions of a gauge at a reconstruction in it."""
    cameras, points = P.reshape(-1, 12).copy(), Q.copy()
    third = np.tile([0.0, 0.0, 1.0, 0.0], (len(Q), 1))
    if isinstance(gauge, identity):
        return Constraints(cameras, points, np.zeros((0, P.size + Q.size)))
    if isinstance(gauge, reference_camera):
        rows = _fixed(P, Q, cameras=[gauge.camera])
        along = np.zeros((4, *Q.shape))
        for k in range(3):  # c is orthogonal to a, b and 1
            along[k, :, 3] += Q[:, k]
            along[k, :, k] += Q[:, 3]
        along[3, :, 3] = Q[:, 3]  # and of unit mean square
        basis = np.concatenate([np.zeros((4, P.size)), along.reshape(4, -1)], axis=1)
        return Constraints(cameras, third, np.concatenate([rows, basis]))
    if isinstance(gauge, two_cameras):
        H, e = P[gauge.second, :, :3], P[gauge.second, :, 3]
        p, *q = halves(H)
        canonic = np.zeros((5, len(P), 3, 4))
        for k in range(3):  # e^T H = 0
            canonic[k, gauge.second, :, k] = e
            canonic[k, gauge.second, :, 3] = H[:, k]
        canonic[3, gauge.second, :, :3] = p + np.tensordot(slope, q, 1)  # |H| = 1
        canonic[4, gauge.second, :, 3] = e  # |e| = 1
        cameras[gauge.second] = canonic[4, gauge.second].ravel()
        basis = np.concatenate([canonic[:4].reshape(4, -1), np.zeros((4, Q.size))], axis=1)
        return Constraints(
            cameras, third, np.concatenate([_fixed(P, Q, cameras=[gauge.first]), basis])
        )
    if isinstance(gauge, five_points):
        chosen = gauge.choose(Q) if gauge.points is None else list(gauge.points)
        return Constraints(cameras, points, _fixed(P, Q, points=chosen))
    if isinstance(gauge, normalized):
        scatter = scatter_constraints(Q).reshape(Q.size, -1).T
        basis = np.concatenate([np.zeros((len(scatter), P.size)), scatter], axis=1)
        return Constraints(cameras, points, basis)
    if isinstance(gauge, ConstraintsOfGauge):
        return gauge.constraints(P, Q)
    raise ArgumentError(
        "gauge", f"is {gauge!r}", "a gauge of eg.gauge, or one with a method constraints(P, Q)"
    )


def _fixed(P: Array, Q: Array, cameras: list[int] | None = None, points: ArrayLike = ()) -> Array:
    """Return the conditions that some cameras or points change at most in scale."""
    rows = []
    for offset, vectors, chosen in (
        (0, P.reshape(-1, 12), cameras or []),
        (P.size, Q, np.asarray(points, dtype=np.intp)),
    ):
        width = vectors.shape[1]
        for k in chosen:
            across = np.linalg.svd(vectors[k][None])[2][1:]
            block = np.zeros((width - 1, P.size + Q.size))
            block[:, offset + width * k : offset + width * (k + 1)] = across
            rows.append(block)
    return np.concatenate(rows)


def mapped(blocks: tuple[Array, Array], vectors: Array) -> Array:
    """Return block diagonal cameras and points times vectors (12 n + 4 m, r)."""
    size = 12 * len(blocks[0])
    x = blocks[0] @ vectors[:size].reshape(len(blocks[0]), 12, -1)
    y = blocks[1] @ vectors[size:].reshape(len(blocks[1]), 4, -1)
    return np.concatenate([x.reshape(size, -1), y.reshape(len(vectors) - size, -1)])
