"""Which two views a reconstruction begins with: many common points that no homography explains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.parallax import fit_homographies
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import median

__all__ = ["MIN_MATCHES", "TooFewInCommon", "best_pair", "common_points", "rows_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class TooFewInCommon(ArgumentError):
    """The tracks do not carry a camera over; factoring all views at once may do."""


#: Pairs of views, those with most common points, that are tried as a start, and the fewest points.
_PAIRS, MIN_MATCHES = 40, 8

#: Points of a pair that its parallax is measured by, where that is robust.
_FEW = 300

#: Points whose views are counted at a time.
_CHUNK = 4096


def best_pair(tracks: Tracks, frame: Frame, robust: bool) -> tuple[int, int]:
    """Choose the pair with the most points that no homography explains."""
    common = common_points(tracks)
    pairs = np.argsort(-common, axis=None, kind="stable")[:_PAIRS]
    pairs = pairs[common.ravel()[pairs] >= MIN_MATCHES]
    if not len(pairs):
        what = f"have no two views with {MIN_MATCHES} common points"
        raise TooFewInCommon("tracks", what, "longer tracks, or method='factorization'")
    chosen = np.stack(np.unravel_index(pairs, common.shape), axis=1)
    rows = {view: rows_of(tracks, view) for view in np.unique(chosen)}
    both = [np.flatnonzero((rows[i] >= 0) & (rows[k] >= 0)) for i, k in chosen]
    sizes = np.array([len(points) for points in both])
    if robust:
        both = [points[:: -(-len(points) // _FEW)] for points in both]
    first = np.concatenate([[0], np.cumsum([len(points) for points in both])])
    q = frame.conditioned(tracks).T
    sides = (zip(side, both, strict=True) for side in chosen.T)
    x1, x2 = (np.concatenate([q[rows[view][points]] for view, points in side]) for side in sides)
    if robust:
        errors = fit_homographies(x1, x2, first).distances
        parallax = np.array([median(part) for part in np.split(errors, first[1:-1])])
    else:
        parallax = _homography_residuals(x1, x2, first)
    i, k = chosen[np.argmax(sizes * parallax)]
    return int(i), int(k)


def common_points(tracks: Tracks) -> Array:
    """Return the number of points that each pair of views has in common, above the diagonal."""
    common = np.zeros((tracks.n_views, tracks.n_views), dtype=np.float32)
    for begin in range(0, tracks.n_points, _CHUNK):
        some = slice(*np.searchsorted(tracks.point, [begin, begin + _CHUNK]))
        incidence = np.zeros((min(_CHUNK, tracks.n_points), tracks.n_views), dtype=np.float32)
        incidence[tracks.point[some] - begin, tracks.view[some]] = 1.0
        common += incidence.T @ incidence
    return np.triu(common, 1)


def rows_of(tracks: Tracks, view: int) -> Indices:
    """Return the observation of each point in a view, -1 where there is none."""
    own = np.flatnonzero(tracks.view == view)
    rows = np.full(tracks.n_points, -1)
    rows[tracks.point[own]] = own
    return rows


def _homography_residuals(x1: Array, x2: Array, first: Indices) -> Array:
    """Return the median transfer error of the homography fitted to each group of matches (DLT).

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Matches of all groups.
    first : ndarray of int, shape (k + 1,)
        First match of each group, and m.
    """
    a = np.column_stack([x1, np.ones(len(x1))])
    # Normal equations of rows (a, 0, -b_1 a) and (0, a, -b_2 a), block by block.
    b1, b2 = x2.T
    square = a[:, :, None] * a[:, None, :]
    weights = np.stack([np.ones(len(a)), b1, b2, b1**2 + b2**2], axis=1)
    sums = np.add.reduceat(weights[:, :, None, None] * square[:, None], first[:-1])
    plain, across1, across2, both = np.moveaxis(sums, 1, 0)
    N = np.zeros((len(first) - 1, 9, 9))
    N[:, :3, :3] = N[:, 3:6, 3:6] = plain
    N[:, :3, 6:] = N[:, 6:, :3] = -across1
    N[:, 3:6, 6:] = N[:, 6:, 3:6] = -across2
    N[:, 6:, 6:] = both
    H = np.linalg.eigh(N)[1][:, :, 0].reshape(-1, 3, 3)
    h = np.einsum("mij,mj->mi", np.repeat(H, np.diff(first), axis=0), a)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        error = np.linalg.norm(h[:, :2] / h[:, 2:] - x2, axis=1)
    error = np.nan_to_num(error, nan=0.0, posinf=0.0)
    return np.array([median(part) for part in np.split(error, first[1:-1])])
