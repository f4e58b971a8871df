"""Whether views agree about intrinsics as well as noise that is independent would let them.

A standard deviation to first order takes the residuals for independent. Those of a camera that its
model describes imperfectly hang together within a view: then the parts of the views in an estimate
scatter more than it says. This is what a jackknife over views shows, to first order and without any
further adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.uncertainty.inverse import Inverse

__all__ = ["Scatter", "scatter_of"]

Array = NDArray[np.float64]

#: Views and cameras at most that are computed with; from these follows the rest.
_VIEWS, _CAMERAS = 16, 4

#: Normal quantile of the probability (one in a hundred) with which noise is taken for more.
_NORMAL = 2.326


@dataclass(frozen=True)
class Scatter:
    """How far apart views are in an estimate.

    Attributes
    ----------
    ratio : float
        Variance of the estimate by the scatter of the views, over that of independent residuals.
    limit : float
        Ratio that independent residuals exceed once in a hundred.
    views : int
        How many views.
    """

    ratio: float
    limit: float
    views: int

    @property
    def factor(self) -> float:
        """What to multiply a standard deviation by.

        What residuals of one view have in common those of other views may have, too (the lens is
        the same): the scatter of n views then tells as little as a single one, and what it has
        beyond that of independent residuals counts n times.
        """
        if not self.ratio > self.limit:
            return 1.0
        return float(np.sqrt(1.0 + self.views * (self.ratio - 1.0)))


def scatter_of(known: MetricCovariance, wanted: Array) -> Scatter:
    """Return how far apart the views are in a function of the intrinsics.

    Parameters
    ----------
    known : MetricCovariance
        Of a least squares adjustment.
    wanted : ndarray, shape (k,)
        Derivatives of the function by the adjustable parameters of a camera. Of several cameras,
        the scatter is the mean of a few.

    Returns
    -------
    Scatter
        Ratio one, without meaning, of fewer than three views.

    Notes
    -----
    With A the normal matrix, a = A^-1 w and N_v the part of view v in A, its part in the estimate
    is d_v = a^T g_v with the gradient g_v of its residuals, of expectation
    noise^2 (a^T N_v a - a^T N_v A^-1 N_v a). The ratio is that of the sums of d_v^2 and of these.
    """
    inverse = known._inverse
    assert isinstance(inverse, Inverse)
    n = inverse.shape[0]
    cameras = len(known.reconstruction.cameras)
    if n < 3:
        return Scatter(1.0, np.inf, n)
    observed = _Observed(inverse)
    found = expected = 0.0
    shares = np.zeros(n)
    for c in np.unique(np.linspace(0, cameras - 1, min(cameras, _CAMERAS)).astype(np.intp)):
        part = known._part("wanted", ("intrinsics", int(c)))
        assert part.part[0] is not None
        right = np.zeros((*inverse.shape, 1))
        right[part.part[0], :, 0] = wanted @ part.out
        squares, own, by_view = observed.parts(right)
        found += squares
        expected += known.noise_px**2 * own
        shares += by_view / by_view.sum()
    # Of normal parts of unequal size: as many of equal size, less one, that they sum to zero.
    freedom = max(shares.sum() ** 2 / np.sum(shares**2) - 1.0, 1.0)
    spread = 2.0 / (9.0 * freedom)  # Wilson and Hilferty
    limit = (1.0 - spread + _NORMAL * np.sqrt(spread)) ** 3
    return Scatter(float(found / max(expected, 1e-300)), float(limit), n)


class _Observed:
    """Observations and their derivatives at the estimate."""

    def __init__(self, inverse: Inverse) -> None:
        self.inverse, reference = inverse, inverse.reference
        self.r, self.A, self.B = reference.observe(*inverse.at)
        self.weights, self.graph = np.asarray(reference.weights), reference.graph
        n, m = self.graph.n_views, self.graph.n_points
        chosen = np.unique(np.linspace(0, n - 1, min(n, _VIEWS)).astype(np.intp))
        self.rows = [np.flatnonzero(self.graph.view == v) for v in chosen]
        self.chosen, self.size = chosen, (n, m)

    def parts(self, right: Array) -> tuple[float, float, Array]:
        """Return the sum of d_v^2, its expectation without noise^2, and a^T N_v a, (n,)."""
        (n, m), view, point = self.size, self.graph.view, self.graph.point
        x, y = self.inverse.apply(right, np.zeros((m, 3, 1)))
        moved = np.einsum("idk,kd->ik", self.A, x[view, :, 0], optimize=True)
        moved += np.einsum("idk,kd->ik", self.B, y[point, :, 0], optimize=True)
        forces = self.weights * moved
        d = np.bincount(view, np.sum(forces * self.r, axis=0), minlength=n)
        by_view = np.bincount(view, np.sum(forces * moved, axis=0), minlength=n)
        columns = np.zeros((n, right.shape[1], len(self.chosen)))
        points = np.zeros((m, 3, len(self.chosen)))
        for k, (v, rows) in enumerate(zip(self.chosen, self.rows, strict=True)):
            columns[v, :, k] = np.einsum("idk,ik->d", self.A[..., rows], forces[:, rows])
            # A view sees a point once: nothing is added twice.
            points[point[rows], :, k] = np.einsum("idk,ik->kd", self.B[..., rows], forces[:, rows])
        leverage = self.inverse.forms(columns, points)
        free = np.maximum(by_view[self.chosen] - leverage, 0.0).sum()
        share = by_view[self.chosen].sum() / max(by_view.sum(), 1e-300)
        return float(np.sum(d**2)), float(free / max(share, 1e-300)), np.asarray(by_view, float)
