"""Datums: which seven conditions a reconstruction obeys, in small motions.

A datum is a set of conditions C delta = 0 on own tangents delta. With G the motions of the gauge
that are free, S = I - G (C G)^-1 C takes a small motion to the equivalent one that obeys them, and
a covariance X in any datum to S X S^T (the S-transformation of geodesy).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import (
    five_points,
    inner,
    normalized,
    reference_camera,
    two_cameras,
)
from epigauge.uncertainty.inverse import Inverse, combined, products
from epigauge.uncertainty.sandwich import Sandwich

__all__ = ["Datum", "Projection", "projection"]

Array = NDArray[np.float64]


Datum = inner | normalized | reference_camera | two_cameras | five_points


@dataclass(frozen=True)
class Projection:
    """S X S^T as X plus columns: X + L M L^T.

    Attributes
    ----------
    cameras, points : ndarray, shape (n, d, q), (m, b, q)
        L.
    M : ndarray, shape (q, q)
        M.
    """

    cameras: Array
    points: Array
    M: Array


def projection(
    datum: Any, cameras: Array, points: Array, inverse: Inverse | Sandwich
) -> Projection:
    """Return what takes the covariance of an `Inverse` to a datum.

    Parameters
    ----------
    datum : Datum or "inner"
        Where to.
    cameras, points : ndarray, shape (n, c), (m, 3)
        The estimate; lines that `inverse` has beyond the points are part of no datum.
    inverse : Inverse or Sandwich
        X.

    Raises
    ------
    ArgumentError
        On anything else, on views or points that do not exist, and on a datum that leaves a motion
        free.
    """
    motions = inverse.motions
    G = motions.along(motions.open)
    free = motions.open.shape[1]
    if not free:
        none = np.zeros((*inverse.sizes[:2], 0)), np.zeros((*motions.points.shape[:2], 0))
        return Projection(*none, np.zeros((0, 0)))
    of_cameras, own = _conditions(
        datum, cameras, points, motions.cameras, motions.points[: len(points), :3]
    )
    of_points = np.zeros((*motions.points.shape[:2], own.shape[2]))
    of_points[: len(points), :3] = own
    C = of_cameras, of_points
    if _is_inner(datum):
        return _projection(*_orthonormal(C, motions.open, G, datum), inverse)
    return onto(_first(C, G, free) if C[0].shape[2] > free else C, inverse, datum)


def onto(C: tuple[Array, Array], inverse: Inverse | Sandwich, datum: Any) -> Projection:
    """Return what takes the covariance of an `Inverse` to where conditions hold.

    Parameters
    ----------
    C : tuple of ndarray, shape (n, d, f), (m, b, f)
        As many conditions as there are free motions, as columns.
    inverse : Inverse or Sandwich
        X.
    datum : object
        What the conditions stand for, to be named in messages.

    Raises
    ------
    ArgumentError
        If they leave a motion free.
    """
    motions = inverse.motions
    G, free = motions.along(motions.open), motions.open.shape[1]
    product = products(C, G)
    values = np.linalg.svd(product, compute_uv=False)
    if len(product) < free or not values[-1] > 1e-9 * values[0]:
        raise _leaves_free(datum)
    # K = (C G)^-1 C: S = I - G K.
    back = np.asarray(np.linalg.inv(product).T)
    return _projection((combined(C[0], back), combined(C[1], back)), G, inverse)


def _projection(
    K: tuple[Array, Array], G: tuple[Array, Array], inverse: Inverse | Sandwich
) -> Projection:
    """Return S X S^T for S = I - G K."""
    T = inverse.apply(*K)
    R = products(K, T)
    L = np.concatenate([G[0], T[0]], axis=2), np.concatenate([G[1], T[1]], axis=2)
    one, zero = np.eye(len(R)), np.zeros((len(R), len(R)))
    return Projection(*L, np.block([[0.5 * (R + R.T), -one], [-one, zero]]))


def _orthonormal(
    C: tuple[Array, Array], open_: Array, G: tuple[Array, Array], datum: Any
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return K and motions G with S = I - G K for inner constraints: those of some parts.

    Of few points among others far away these are small and alike: the motions are combined so that
    they are orthonormal on the parts, by a decomposition that does not square their condition.
    """
    n = len(C[0])
    parts = [combined(part, open_).reshape(-1, open_.shape[1]) for part in C]
    whole = np.concatenate(parts)
    size = np.linalg.norm(whole, axis=0)
    if not (size > 0.0).all():
        raise _leaves_free(datum)
    Q, R = np.linalg.qr(whole / size)
    values = np.linalg.svd(R, compute_uv=False)
    if not values[-1] > 1e-11 * values[0]:
        raise _leaves_free(datum)
    back = np.linalg.inv(R) / size[:, None]
    count = len(parts[0])
    K = Q[:count].reshape(n, -1, Q.shape[1]), Q[count:].reshape(*C[1].shape[:2], -1)
    return K, (combined(G[0], back), combined(G[1], back))


def _leaves_free(datum: Any) -> ArgumentError:
    was = f"is {datum!r:.80}, which leaves motions free"
    return ArgumentError("gauge", was, "points or views apart")


def _is_inner(datum: Any) -> bool:
    text = isinstance(datum, str) and datum == "inner"
    return text or datum is inner or isinstance(datum, inner | normalized)


def _first(C: tuple[Array, Array], G: tuple[Array, Array], free: int) -> tuple[Array, Array]:
    """Return the first conditions that suffice: the rest of the gauge is held by what is known."""
    product = products(C, G)
    chosen: list[int] = []
    for k in range(len(product)):
        trial = product[[*chosen, k]]
        values = np.linalg.svd(trial, compute_uv=False)
        if values[-1] > 1e-9 * values[0]:
            chosen.append(k)
        if len(chosen) == free:
            break
    return C[0][..., chosen], C[1][..., chosen]


def _conditions(
    datum: Any, cameras: Array, points: Array, of_cameras: Array, of_points: Array
) -> tuple[Array, Array]:
    """Return conditions as columns (n, d, k) and (m, 3, k)."""
    n, m = len(cameras), len(points)
    C = np.zeros_like(of_cameras), np.zeros_like(of_points)
    R = cameras[:, :12].reshape(-1, 3, 4)[:, :, :3]
    centres = -np.einsum("nji,nj->ni", R, cameras[:, :12].reshape(-1, 3, 4)[:, :, 3])
    if _is_inner(datum):
        datum = datum if isinstance(datum, inner) else inner()
        if datum.points is None and datum.views is None:
            return C[0], of_points
        those = [_index("gauge.points", j, m) for j in datum.points or ()]
        views = [_index("gauge.views", i, n) for i in datum.views or ()]
        C[1][those] = of_points[those]
        # A centre moves as the camera's tangent 3 to 5, turned into the scene.
        C[0][views, 3:6] = of_cameras[views, 3:6]
        return C
    if isinstance(datum, five_points):
        chosen = datum.choose_three(points) if datum.points is None else datum.points
        a, b, c = (_index("gauge.points", j, m) for j in list(chosen)[:3])
        along = points[b] - points[a]
        across = np.cross(along, points[c] - points[a])
        C[1][a, :, :3] = np.eye(3)
        C[1][b, :, 3:6] = np.eye(3)
        C[1][c, :, 6] = across
        return C
    if isinstance(datum, reference_camera | two_cameras):
        first = datum.camera if isinstance(datum, reference_camera) else datum.first
        view = _index("gauge", first, n)
        C[0][view, :6, :6] = np.eye(6)
        if isinstance(datum, two_cameras):
            other = _index("gauge", datum.second, n)
            C[0][other, 3:6, 6] = R[other] @ (centres[other] - centres[view])
        else:
            distance = np.linalg.norm(points - centres[view], axis=1)
            median = int(np.argsort(distance)[len(distance) // 2])
            C[1][median, :, 6] = points[median] - centres[view]
        return C
    needed = "'inner', eg.gauge.inner(...), two_cameras, reference_camera, five_points"
    raise ArgumentError("gauge", f"is {datum!r:.80}", needed)


def _index(name: str, value: Any, count: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ArgumentError(name, f"has {value!r:.60}", "integers")
    if not 0 <= value < count:
        raise ArgumentError(name, f"has {value}", f"0 to {count - 1}")
    return int(value)
