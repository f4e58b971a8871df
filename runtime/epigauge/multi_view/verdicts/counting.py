"""What the tracks cannot determine, whatever is measured: equations and unknowns counted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.seen import Seen

__all__ = ["CAMERA", "GAUGE", "POINT", "missing_beside", "missing_by_count"]

Array = NDArray[np.float64]

#: Parameters of a camera and a point without their scales, and dimension of the changes of basis.
CAMERA, POINT, GAUGE = 11, 3, 15

#: Relative matches of two views determine their F, and nothing more.
_PAIR = 7


def missing_by_count(seen: Seen) -> int:
    """Return how many parameters lack an equation, whatever the measurements: a lower bound.

    c points in the same s views give those cameras min(c (2 s - 3), 11 s - 15) equations; two
    views, as many as F has parameters. All cameras need 11 n - 15, and each one 11, of which points
    that two other views see give two apiece.
    """
    # A point twice in a view gives that view no more than once does.
    once = (np.diff(seen.point, prepend=-1) != 0) | (np.diff(seen.view, prepend=-1) != 0)
    view, point = seen.view[once], seen.point[once]
    everywhere = int(np.count_nonzero(np.bincount(point) == seen.n))
    enough = max((CAMERA * seen.n - GAUGE) / (2 * seen.n - POINT), CAMERA / 2)
    if seen.n > 2 and everywhere >= enough:
        return 0  # these alone give all cameras what they need
    # Points are told apart by the views that see them: sums of one random number a view.
    marks = np.random.default_rng(0).integers(0, 2**62, seen.n, dtype=np.uint64)
    first = np.flatnonzero(np.diff(point, prepend=-1))
    lengths = np.diff(np.append(first, len(point)))
    sums = np.add.reduceat(marks[view], first)
    _, shown, sizes = np.unique(sums, return_index=True, return_counts=True)
    s = lengths[shown]
    given = np.minimum(sizes * (2 * s - POINT), np.maximum(CAMERA * s - GAUGE, 0))
    total = CAMERA * seen.n - GAUGE - int(np.sum(given))

    to_camera = np.where(s == 2, np.minimum(sizes, _PAIR), np.minimum(2 * sizes, CAMERA))
    # One point of each kind stands for all.
    of_kind = np.zeros(len(first))
    of_kind[shown] = to_camera
    own = np.bincount(view, weights=np.repeat(of_kind, lengths))
    return max(total, int(CAMERA - own.min()) if seen.n > 2 else 0, 0)


def missing_beside(fixed: tuple[Array, Array]) -> int:
    """Return the dimension of the changes of basis that leave cameras and points, up to scale.

    Parameters
    ----------
    fixed : tuple of ndarray, shape (k, 3, 4), (l, 4)
        The cameras and points.
    """
    P, Q = fixed
    rows = [np.zeros((0, 16))]
    for camera in P / np.linalg.norm(P, axis=(1, 2), keepdims=True):
        linear = np.kron(camera, np.eye(4))  # of vect(E) to vect(P E)
        rows.append(linear - np.outer(camera.ravel(), camera.ravel() @ linear))
    for point in Q / np.linalg.norm(Q, axis=1, keepdims=True):
        linear = np.kron(np.eye(4), point)  # of vect(E) to E Q
        rows.append(linear - np.outer(point, point @ linear))
    # E = I moves nothing.
    return 15 - int(np.linalg.matrix_rank(np.concatenate(rows), tol=1e-9))
