"""Which segments of a line agree on one, where some are matched to a wrong line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.lines import LineLinearizer
from epigauge.two_view.losses import robust_scale

__all__ = ["BEYOND", "agreeing", "lengths", "meets", "usual"]

Array = NDArray[np.float64]

#: A segment disagrees whose distances are larger than this, in usual ones.
BEYOND = 6.0

#: Usual distances below this, in standard deviations, are rounding.
_EXACT = 1e-6

#: Pairs of a line's segments that are tried, and segments that make agreement more than chance.
_PAIRS, _FEW = 200, 3


def lengths(linearizer: LineLinearizer, cameras: Array, lines: Array) -> Array:
    """Return the length of each segment's residual, infinite where it has none, (N,)."""
    r = np.linalg.norm(linearizer.residuals(cameras, lines), axis=0)
    return np.where(np.isfinite(r), r, np.inf)


def usual(sizes: Array) -> float:
    """Return the standard deviation of residuals as most of them tell it."""
    finite = sizes[np.isfinite(sizes)]
    return max(robust_scale(finite), _EXACT) if len(finite) else _EXACT


def meets(A: Array, B: Array) -> Array:
    """Return the lines (L, 6) in which planes (L, 4) meet, of any length."""
    v = np.cross(A[:, :3], B[:, :3])
    n = A[:, 3:] * B[:, :3] - B[:, 3:] * A[:, :3]
    return np.concatenate([n, v], axis=1)


def agreeing(
    linearizer: LineLinearizer, planes: Array, cameras: Array, lines: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Return which segments agree with most others of their line, and lines to begin at.

    Only lines of four segments at least that one disagrees with are looked at: of three, any two
    agree. Each two planes of such a line meet in one; that counts which most segments are near.

    Parameters
    ----------
    linearizer : LineLinearizer
        The segments.
    planes : ndarray, shape (N, 4)
        Planes through centres and segments.
    cameras : ndarray, shape (n, c)
        Cameras.
    lines : ndarray, shape (L, 6)
        Lines that suit all segments best.

    Returns
    -------
    agree : ndarray of bool, shape (N,)
        Whether a segment counts.
    lines : ndarray, shape (L, 6)
        The same lines, others where segments were left out.
    """
    graph, own = linearizer.graph, linearizer.segments
    sizes = lengths(linearizer, cameras, lines)
    bound = BEYOND * usual(sizes)
    agree, lines = np.ones(len(sizes), np.bool_), lines.copy()
    residual = getattr(linearizer.kernels, f"{own.prefix}_line_residual")
    rows_of_cameras = own.cameras(cameras)
    doubtful = np.unique(graph.point[~(sizes <= bound)])
    for j in doubtful[np.diff(graph.first)[doubtful] > _FEW].tolist():
        rows = np.arange(graph.first[j], graph.first[j + 1])
        pairs = np.column_stack(np.triu_indices(len(rows), 1))
        pairs = rows[pairs[:: -(-len(pairs) // _PAIRS)]]
        tried = linearizer.sized(meets(planes[pairs[:, 0]], planes[pairs[:, 1]]))
        each, those = np.tile(rows, len(tried)), np.repeat(np.arange(len(tried)), len(rows))
        with np.errstate(all="ignore"):
            parts = rows_of_cameras[:, each], tried.T[:, those], own.ends[:, each]
            r = np.linalg.norm(residual(*parts, own.spread[:, each]), axis=0)
        r = np.where(np.isfinite(r), r, np.inf).reshape(len(tried), len(rows))
        best = int(np.argmin(np.sum(np.minimum(r, bound) ** 2, axis=1)))
        near = r[best] <= bound
        count = int(np.count_nonzero(near))
        if count >= _FEW and 2 * count > len(rows) and count < len(rows):
            agree[rows], lines[j] = near, tried[best]
    return agree, lines
