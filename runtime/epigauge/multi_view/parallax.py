"""Whether the views show parallax: a flat scene, and a camera that turns or stands still, do not.

Then homographies take each view to every other, and the cameras and points of a reconstruction
follow the noise. Two views that one homography does not explain are enough to free both of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.seen import Seen

__all__ = ["Homographies", "fit_homographies", "parallax_flags", "partners"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Points a pair of views must have in common to be asked, and most that are; partners of a view;
#: views that are asked, and so many at once.
_LEAST, _MOST, _PARTNERS, _VIEWS, _AT_ONCE = 12, 200, 3, 50, 5

#: A point is off its homography beyond this many standard deviations of the noise in both images.
_OFF = 4.0

#: Share of points off that heavy tails and chance explain; below the second, few points fix all.
_NONE, _FEW = 0.05, 0.1

#: Share of the pairs whose homography may be that of a camera that turned: from it on, the camera
#: may only have turned. Within so many standard deviations of a robust fit, which are too small by
#: 1.6: of simulated scenes, half the pairs of a camera that turned are within 2.7, those of a plane
#: seen from several places beyond 16.
_TURNED, _WITHIN = 0.75, 5.0

#: Rows and columns of the upper triangle of a symmetric 3x3 matrix, and its places in that.
_ROWS, _COLUMNS = np.triu_indices(3)
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])

#: Reweighted least squares against points off the plane. It converges quadratically where nine in
#: ten are on one: where after the second number of rounds most are off it, more will not help.
_ROUNDS, _FIRST_ROUNDS, _MOSTLY = 8, 3, 0.5


def parallax_flags(seen: Seen, noise_px: float) -> tuple[str, ...]:
    """Return "still camera", "planar scene" with or without "pure rotation", or "nearly planar".

    Parameters
    ----------
    seen : Seen
        The observations that count.
    noise_px : float
        Standard deviation of a coordinate.

    Returns
    -------
    tuple of str
        Empty where some views show parallax, and where no two have enough points in common to
        tell.
    """
    limit = _OFF * float(np.sqrt(2.0)) * max(noise_px, 1e-9 * float(np.abs(seen.xy).max()))
    if _plainly_off(seen, limit):
        return ()
    shares: list[Array] = []
    rotations: list[bool] = []
    still: list[Array] = []
    for pairs in _pairs(seen):
        x1, x2, first = _matches(seen, pairs)
        fits = fit_homographies(x1, x2, first)
        off = fits.distances > limit * fits.deviations
        share = np.add.reduceat(off, first[:-1]) / np.diff(first)
        if (share > _FEW).any():
            return ()
        shares.append(share)
        moved = np.linalg.norm(x2 - x1, axis=1) > limit
        still.append(np.add.reduceat(moved, first[:-1]) / np.diff(first))
        rotations += [fits.may_be_rotation(k, noise_px) for k in range(len(pairs))]
    if not shares:
        return ()
    if np.concatenate(still).max() <= _NONE:
        return ("still camera",)
    if np.concatenate(shares).max() > _NONE:
        return ("nearly planar",)
    turned = np.mean(rotations) >= _TURNED
    return ("planar scene", "pure rotation") if turned else ("planar scene",)


def _plainly_off(seen: Seen, limit: float) -> bool:
    """Tell whether a first pair, of views far from each other in a sequence, shows parallax."""
    others = partners(seen, 0)
    if not len(others):
        return False
    x1, x2, first = _matches(seen, np.array([[0, others.max()]]))
    fit = _Fit(x1, x2, first)
    for _ in range(_FIRST_ROUNDS):
        fit.again()
    off = fit.scale * fit.distances > limit * fit.deviations()
    return bool(np.count_nonzero(off) > _MOSTLY * len(off))


def partners(seen: Seen, i: int) -> Indices:
    """Return views with points in common with view i: with the fewest, with some, with the most."""
    found = seen.partners.get(i)
    if found is None:
        found = seen.partners[i] = _partners(seen, i)
    return found


def _partners(seen: Seen, i: int) -> Indices:
    begin, own = seen.begin, seen.point[seen.view == i]
    lengths = begin[own + 1] - begin[own]
    rows = np.repeat(begin[own] - np.cumsum(lengths) + lengths, lengths)
    common = np.bincount(seen.view[rows + np.arange(len(rows))], minlength=seen.n)
    common[i] = 0
    others = np.flatnonzero(common >= _LEAST)
    others = others[np.argsort(common[others], kind="stable")]
    spread = np.linspace(0, len(others) - 1, min(len(others), _PARTNERS))
    return others[spread.astype(np.intp)]


def _pairs(seen: Seen) -> Iterator[Indices]:
    """Give pairs of views, some at a time: partners with few, some and many points in common.

    Those with few see from far apart. Views are asked at a bounded number of places in a sequence.
    """
    asked = np.unique(np.linspace(0, seen.n - 1, min(seen.n, _VIEWS)).astype(np.intp))
    # Evenly spread from the first few on.
    stride = -(-len(asked) // _AT_ONCE)
    for some in (asked[k::stride] for k in range(stride)):
        chosen: list[tuple[int, int]] = []
        for i in some.tolist():
            chosen += [(i, k) for k in partners(seen, i).tolist()]
        if chosen:
            yield np.array(chosen)


def _matches(seen: Seen, pairs: Indices) -> tuple[Array, Array, Indices]:
    """Return matches of all pairs, and where each begins."""
    rows: dict[int, Indices] = {}
    for view in np.unique(pairs).tolist():
        rows[view] = np.full(seen.m, -1)
        own = np.flatnonzero(seen.view == view)
        rows[view][seen.point[own]] = own
    sides: tuple[list[Array], list[Array]] = [], []
    for i, k in pairs.tolist():
        both = np.flatnonzero((rows[i] >= 0) & (rows[k] >= 0))
        both = both[:: -(-len(both) // _MOST)]
        sides[0].append(seen.xy[rows[i][both]])
        sides[1].append(seen.xy[rows[k][both]])
    first = np.concatenate([[0], np.cumsum([len(part) for part in sides[0]])])
    return np.concatenate(sides[0]), np.concatenate(sides[1]), first


@dataclass(frozen=True)
class Homographies:
    """Homographies of groups of matches.

    Attributes
    ----------
    H : ndarray, shape (k, 3, 3)
        In coordinates centred at `centre`, in units of `scale` pixels, of determinant 1.
    distances : ndarray, shape (m,)
        Transfer error of each match, in pixels.
    deviations : ndarray, shape (m,)
        Its deviation over that where both images have one scale: noise is magnified on its way.
    covariance : ndarray, shape (k, 9, 9)
        Of the entries of H, for a noise of one unit.
    scale : float
        Pixels a unit.
    """

    H: Array
    distances: Array
    deviations: Array
    covariance: Array
    scale: float

    def may_be_rotation(self, k: int, noise_px: float) -> bool:
        """Tell whether a homography could be K R K^-1: tr H = tr H^-1, whatever K (det H = 1)."""
        H = self.H[k]
        inverse = np.linalg.inv(H)
        difference = float(np.trace(H) - np.trace(inverse))
        # d tr H^-1 = -tr(H^-1 dH H^-1); the determinant stays one, so that scale has no part.
        gradient = np.eye(3) + (inverse @ inverse).T
        gradient -= (np.trace(H) + np.trace(inverse)) / 3.0 * inverse.T
        g = gradient.ravel()
        noise = np.sqrt(2.0) * noise_px / self.scale
        deviation = noise * float(np.sqrt(max(g @ self.covariance[k] @ g, 0.0)))
        return bool(abs(difference) <= _WITHIN * deviation)


def fit_homographies(x1: Array, x2: Array, first: Indices, rounds: int = _ROUNDS) -> Homographies:
    """Fit a homography to each group of matches, robustly: reweighted normal equations (DLT).

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Matches of all groups, in pixels.
    first : ndarray of int, shape (k + 1,)
        First match of each group, and m.
    rounds : int
        Fits, each with the weights that the one before gives.

    Returns
    -------
    Homographies
        One a group.
    """
    fit = _Fit(x1, x2, first)
    for _ in range(rounds):
        fit.again()
    H, values, vectors, scale = fit.H, fit.values, fit.vectors, fit.scale
    size = np.cbrt(np.linalg.det(H))
    size = np.where(np.abs(size) > 1e-12, size, 1.0)
    inverse = vectors[:, :, 1:] / np.maximum(values[:, None, 1:], 1e-300)
    covariance = inverse @ np.swapaxes(vectors[:, :, 1:], 1, 2)
    factor = fit.typical_depth / size**2 * _means(fit.weights**2, first)
    covariance *= factor[:, None, None]
    H /= size[:, None, None]
    return Homographies(H, scale * fit.distances, fit.deviations(), covariance, scale)


class _Fit:
    """Reweighted normal equations of groups of matches, in coordinates of mean zero and size one.

    Attributes
    ----------
    H : ndarray, shape (k, 3, 3)
        Homographies of unit norm.
    distances, weights : ndarray, shape (m,)
        Transfer errors, and what they count in the next round.
    """

    def __init__(self, x1: Array, x2: Array, first: Indices) -> None:
        both = np.concatenate([x1, x2])
        centre = both.mean(axis=0)
        self.scale = max(float(np.sqrt(np.mean((both - centre) ** 2))), 1e-300)
        self._a = a = np.column_stack([(x1 - centre) / self.scale, np.ones(len(x1))])
        self._b = b = (x2 - centre) / self.scale
        self._first, self._sizes = first, np.diff(first)
        self._group = np.repeat(np.arange(len(first) - 1), self._sizes)
        square = a[:, _ROWS] * a[:, _COLUMNS]
        terms = np.stack([np.ones(len(a)), *b.T, np.sum(b**2, axis=1)], axis=1)
        self._blocks = (terms[:, :, None] * square[:, None]).reshape(len(a), -1)
        self.weights = np.ones(len(a))

    def again(self) -> None:
        """Fit with the weights that the fit before gives."""
        first, sizes, group = self._first, self._sizes, self._group
        if len(sizes) == 1:
            flat = (self.weights @ self._blocks)[None]
        else:
            flat = np.add.reduceat(self.weights[:, None] * self._blocks, first[:-1])
        sums = flat.reshape(-1, 4, 6)[:, :, _SYMMETRIC]
        N = np.zeros((len(sizes), 9, 9))
        N[:, :3, :3] = N[:, 3:6, 3:6] = sums[:, 0]
        N[:, :3, 6:] = N[:, 6:, :3] = -sums[:, 1]
        N[:, 3:6, 6:] = N[:, 6:, 3:6] = -sums[:, 2]
        N[:, 6:, 6:] = sums[:, 3]
        self.values, self.vectors = np.linalg.eigh(N)
        self.H = H = self.vectors[:, :, 0].reshape(-1, 3, 3)
        h = self._a @ H[0].T if len(sizes) == 1 else np.einsum("mij,mj->mi", H[group], self._a)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            off = h[:, :2] / h[:, 2:] - self._b
            distances = np.sqrt(off[:, 0] ** 2 + off[:, 1] ** 2)
        distances[~np.isfinite(distances)] = 1e3
        self.distances = distances
        typical = np.maximum(_medians(distances, group, first), 1e-9)[group]
        # Algebraic errors are h_3 times geometric ones.
        depth = h[:, 2] ** 2
        self.typical_depth = _means(depth, first)
        relative = np.maximum(depth / self.typical_depth[group], 1e-6)
        self.weights = 1.0 / (1.0 + (distances / typical) ** 2) / relative

    def deviations(self) -> Array:
        """Return the deviation of each transfer error over that where both scales are equal."""
        H = self.H[self._group]
        h = np.einsum("mij,mj->mi", H, self._a)
        with np.errstate(all="ignore"):
            to = h[:, :2] / h[:, 2:]
            J = (H[:, :2, :2] - to[:, :, None] * H[:, 2, None, :2]) / h[:, 2, None, None]
            found = np.sqrt(0.5 + 0.25 * np.einsum("mij,mij->m", J, J))
        return np.where(np.isfinite(found), found, 1.0)


def _medians(values: Array, group: Indices, first: Indices) -> Array:
    rising = np.sort(values) if len(first) == 2 else values[np.lexsort((values, group))]
    low, high = (first[:-1] + first[1:] - 1) // 2, (first[:-1] + first[1:]) // 2
    return np.asarray(0.5 * (rising[low] + rising[high]))


def _means(values: Array, first: Indices) -> Array:
    return np.asarray(np.add.reduceat(values, first[:-1]) / np.diff(first))
