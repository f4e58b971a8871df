"""The covariance of a projective reconstruction: in its gauge, in any other, and of images.

The normal matrix N is singular along the gauge freedom. Every generalised inverse X of N gives, by
the projector S of a gauge (the S-transformation of geodesy), the same covariance S X S^T there;
what the observations alone determine, such as projected points, has the same covariance in every
gauge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._results import Result
from epigauge.errors import ArgumentError
from epigauge.lengths import linear_length
from epigauge.multi_view.datum import Projector, halves, mapped, projector
from epigauge.multi_view.gauge import Gauge, two_cameras
from epigauge.multi_view.inverse import Inverse
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.sandwich import Sandwich

__all__ = ["ReconstructionCovariance"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Most parameters of which `ReconstructionCovariance.dense` makes one matrix.
_DENSE = 5000


@dataclass(frozen=True, eq=False)
class ReconstructionCovariance(Result):
    """Covariances of cameras, points and projected points, to first order in the noise.

    Attributes
    ----------
    reconstruction : Reconstruction
        The estimate, in the gauge.
    noise_px : float
        Standard deviation of an image coordinate of weight one, in pixels: given or estimated.
    projector : Projector
        What takes a motion of the parameters to the gauge: applied on both sides, it takes the
        covariance in any gauge, brought to this basis and these scales, to the one here. In
        `two_cameras` near sigma = 1, where the scale of H* has a kink, this leaves out what moves
        along the scale without being correlated with anything.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> result = eg.bundle_adjust(tracks)
    >>> covariance = eg.covariance(tracks, result.reconstruction)
    >>> covariance.cameras.shape, round(covariance.noise_px, 2)
    ((5, 12, 12), 0.98)
    """

    reconstruction: Reconstruction
    noise_px: float
    projector: Projector
    _inverse: Inverse | Sandwich
    _maps: tuple[Array, Array]
    _wander: Array | None = None

    def _contents(self) -> dict[str, Any]:
        names = ("noise_px", "reconstruction", "cameras", "points", "projections")
        return {name: getattr(self, name) for name in names}

    def _summary_rows(self) -> dict[str, str]:
        spread = np.sqrt(0.5 * np.einsum("nii->n", self.projections))
        middle, most = (f"{f(spread):.4g}" for f in (np.median, np.max))
        return {
            "noise_px": f"{self.noise_px:.6g}",
            "cameras, points": f"{len(self.reconstruction.P)} and {len(self.reconstruction.Q)}",
            "deviation of projections": f"{middle} px in the median, {most} px at most",
        }

    def in_gauge(self, gauge: Gauge) -> ReconstructionCovariance:
        """Return the covariance in another gauge; nothing large is computed again.

        Parameters
        ----------
        gauge : Gauge
            Where to; `identity` gives the free gauge in the basis of this reconstruction.

        Returns
        -------
        ReconstructionCovariance
            In the gauge, with the reconstruction moved there.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> result = eg.bundle_adjust(scene.tracks)
        >>> spread = eg.covariance(scene.tracks, result.reconstruction)
        >>> spread.in_gauge(eg.gauge.identity()).dense().shape
        (128, 128)
        """
        P, Q, lines = (getattr(self.reconstruction, name) for name in ("P", "Q", "lines"))
        there = gauge.transformation(P, Q)
        moved = there.apply(P, Q)
        cameras, points = there.blocks()
        maps = (cameras @ self._maps[0], points @ self._maps[1])
        there_too = projector(gauge, *moved)
        inside = replace(
            self,
            reconstruction=Reconstruction(*moved, None if lines is None else there.lines(lines)),
            projector=there_too,
            _maps=maps,
            _wander=None,
        )
        return inside._across_kink(gauge) if isinstance(gauge, two_cameras) else inside

    def _across_kink(self, gauge: two_cameras) -> ReconstructionCovariance:
        """Return this with the scale of H* on average, where its singular values are nearly equal.

        The gauge keeps the largest singular value p + |q| (`halves`) at one, and |q| has a kink at
        zero (sigma = 1). There its mean slope is taken, and what that leaves moves the scale alone.
        """
        P, Q = self.reconstruction.P, self.reconstruction.Q
        H = P[gauge.second, :, :3]
        rows = np.zeros((2, P.size + Q.size))
        at = rows[:, : P.size].reshape(2, len(P), 3, 4)
        at[:, gauge.second, :, :3] = halves(H)[1:]
        level = projector(gauge, P, Q, np.zeros(2))  # p at its value
        swapped = (np.swapaxes(self._maps[0], 1, 2), np.swapaxes(self._maps[1], 1, 2))
        moved = mapped(swapped, level.transposed(rows.T))
        covariance_of_q = self._variance * moved.T @ self._inverse.apply(moved)
        values = np.linalg.svd(H, compute_uv=False)
        mean = np.array([0.5 * (values[0] - values[1]), 0.0])
        slope, rest, _ = linear_length(mean, 0.5 * (covariance_of_q + covariance_of_q.T))
        if rest == 0.0:
            return self
        # H* and the points' last coordinates grow together.
        grown = np.zeros(P.size + Q.size)
        grown[: P.size].reshape(P.shape)[:, :, 3] = -P[:, :, 3]
        grown[P.size :].reshape(Q.shape)[:, 3] = Q[:, 3]
        wander = np.sqrt(rest) / values[0] * self.projector._scaled(grown)
        return replace(self, projector=projector(gauge, P, Q, slope), _wander=wander)

    @property
    def cameras(self) -> Array:
        """Return the covariance of vect(P_i) for each camera, shape (n, 12, 12)."""
        size = self.reconstruction.P.size
        blocks = self.projector.locals()[0] @ self._maps[0]
        return self._here(blocks, self._inverse.views, slice(0, size))

    @cached_property
    def all_cameras(self) -> Array:
        """Return the covariance of all cameras together, shape (12 n, 12 n)."""
        size = self.reconstruction.P.size
        blocks = self.projector.locals()[0] @ self._maps[0]
        n = len(blocks)
        X = self._inverse.cameras.reshape(n, 12, n, 12)
        X = np.einsum("aij,ajbk->aibk", blocks, X, optimize=True)
        X = np.einsum("aibk,blk->aibl", X, blocks, optimize=True).reshape(size, size)
        H, (T, R) = self.projector.H[:size], self._coupled
        found = X - H @ T[:, :size] - T[:, :size].T @ H.T + H @ R @ H.T
        found = 0.5 * self._variance * (found + found.T)
        if self._wander is not None:
            found += np.outer(self._wander[:size], self._wander[:size])
        return np.asarray(found)

    @cached_property
    def points(self) -> Array:
        """Return the covariance of each Q_j, shape (m, 4, 4)."""
        size = self.reconstruction.P.size
        blocks = self.projector.locals()[1] @ self._maps[1]
        return self._here(blocks, self._inverse.points, slice(size, None))

    def _here(self, blocks: Array, X: Array, rows: slice) -> Array:
        """Return diagonal blocks (k, b, b) in the gauge from those of X, of rows of the whole."""
        X = blocks @ X @ np.swapaxes(blocks, 1, 2)
        (k, b, _), (T, R) = X.shape, self._coupled
        H = self.projector.H[rows].reshape(k, b, 15)
        HT = H @ T[:, rows].reshape(15, k, b).transpose(1, 0, 2)
        found = X - HT - np.swapaxes(HT, 1, 2) + H @ R @ np.swapaxes(H, 1, 2)
        found = 0.5 * self._variance * (found + np.swapaxes(found, 1, 2))
        if self._wander is not None:
            y = self._wander[rows].reshape(k, b)
            found += y[:, :, None] * y[:, None, :]
        return np.asarray(found)

    @cached_property
    def projections(self) -> Array:
        """Return the covariance of each projected point in px^2, in the tracks' order, (N, 2, 2).

        It is the same in every gauge. The residual's own is weight^-1 noise_px^2 I less this.
        """
        return np.asarray(self.noise_px**2 * self._inverse.observed)

    @cached_property
    def line_projections(self) -> Array:
        """Return what the distances of `BundleResult.line_fun` are uncertain by, (S, 2, 2).

        The covariance of the distances of both end points of each segment from the projected line,
        over their standard deviations: the line and the camera are uncertain, the segment is not.
        It is the same in every gauge.
        """
        if self.reconstruction.lines is None:
            return np.zeros((0, 2, 2))
        inverse = self._inverse
        assert isinstance(inverse, Inverse)
        return np.asarray(self.noise_px**2 * inverse.observed_lines)

    def of_projections(self, view: ArrayLike, point: ArrayLike) -> Array:
        """Return the covariance of points projected to views where they need not be observed.

        Parameters
        ----------
        view, point : array_like of int, shape (k,)
            Which.

        Returns
        -------
        ndarray, shape (k, 2, 2)
            In px^2, the same in every gauge.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> result = eg.bundle_adjust(scene.tracks)
        >>> spread = eg.covariance(scene.tracks, result.reconstruction)
        >>> spread.of_projections([0, 1], [3, 3]).shape
        (2, 2, 2)
        """
        views, points = np.asarray(view), np.asarray(point)
        for name, indices, count in (
            ("view", views, len(self.reconstruction.P)),
            ("point", points, len(self.reconstruction.Q)),
        ):
            if indices.ndim != 1 or indices.dtype.kind not in "iu" or len(views) != len(points):
                raise ArgumentError(name, f"is {indices.dtype} {indices.shape}", "integers, (k,)")
            if len(indices) and not (0 <= indices.min() and indices.max() < count):
                raise ArgumentError(name, "is out of range", f"indices from 0 below {count}")
        return np.asarray(self.noise_px**2 * self._inverse.projected(views, points))

    def dense(self) -> Array:
        """Return the covariance of all parameters: cameras, then points, row by row.

        Returns
        -------
        ndarray, shape (12 n + 4 m, 12 n + 4 m)
            Of small problems only.

        Raises
        ------
        ArgumentError
            Beyond 5000 parameters; ask for `cameras`, `points` or `projections` instead.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> result = eg.bundle_adjust(scene.tracks)
        >>> spread = eg.covariance(scene.tracks, result.reconstruction)
        >>> spread.dense().shape
        (128, 128)
        """
        size = self.reconstruction.P.size + self.reconstruction.Q.size
        if size > _DENSE:
            raise ArgumentError("covariance", f"has {size} parameters", f"at most {_DENSE}")
        half = self.projector.apply(mapped(self._maps, np.eye(size)))
        found = half @ self._inverse.apply(half.T)
        found = 0.5 * self._variance * (found + found.T)
        return found if self._wander is None else found + np.outer(self._wander, self._wander)

    @property
    def _variance(self) -> float:
        """Return the variance in the units of the image that the inverse was made in."""
        return (self.noise_px / self._inverse.scale) ** 2

    @cached_property
    def _coupled(self) -> tuple[Array, Array]:
        """K X L^T (15, 12 n + 4 m) and K X K^T (15, 15), X a generalised inverse in this basis."""
        K = self.projector.K
        swapped = (np.swapaxes(self._maps[0], 1, 2), np.swapaxes(self._maps[1], 1, 2))
        X = mapped(self._maps, self._inverse.apply(mapped(swapped, K.T)))
        return self.projector._scaled(X).T, K @ X
