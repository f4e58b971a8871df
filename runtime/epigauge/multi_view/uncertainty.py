"""Uncertainty of a reconstruction to first order: in the free gauge, in any other, and of images.

The normal matrix N is singular along the gauge freedom. Every generalised inverse X of N gives, by
the projector S of a gauge (the S-transformation of geodesy), the same covariance S X S^T there;
what the observations alone determine, such as projected points, has the same covariance in every
gauge. X is found once, from the reduced system of the cameras, in the basis and the parameters in
which N is best conditioned; no matrix of all parameters is formed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_choice, as_positive
from epigauge._results import Result
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph, whitened
from epigauge.bundle.prior_kinds import Prior
from epigauge.cameras import (
    AffineReconstruction,
    AnyReconstruction,
    MetricReconstruction,
    camera_model,
)
from epigauge.errors import ArgumentError
from epigauge.lengths import linear_length
from epigauge.multi_view.datum import Projector, halves, mapped, projector
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import Gauge, identity, normalized, two_cameras
from epigauge.multi_view.inverse import Inverse
from epigauge.multi_view.line_start import seen_lines
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.sandwich import Sandwich
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import LOSSES, Loss
from epigauge.uncertainty.affine import AffineCovariance, affine_covariance
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.uncertainty.influence import Influence, RobustFit
from epigauge.uncertainty.metric import metric_covariance, robust_loss

__all__ = ["ReconstructionCovariance", "covariance"]

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


@overload
def covariance(
    tracks: Tracks,
    reconstruction: Reconstruction,
    gauge: Gauge | None = None,
    noise_px: float | None = None,
    *,
    loss: str = "linear",
    loss_scale_px: float | str = "auto",
    lines: LineTracks | None = None,
    backend: str | None = None,
) -> ReconstructionCovariance: ...


@overload
def covariance(
    tracks: Tracks,
    reconstruction: MetricReconstruction,
    gauge: Any = None,
    noise_px: float | None = None,
    *,
    loss: str = "linear",
    loss_scale_px: float | str = "auto",
    refine: str | Sequence[str] = "all",
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    priors: Iterable[Prior] | None = None,
    lines: LineTracks | None = None,
    backend: str | None = None,
) -> MetricCovariance: ...


@overload
def covariance(
    tracks: Tracks,
    reconstruction: AffineReconstruction,
    gauge: Any = None,
    noise_px: float | None = None,
    *,
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    backend: str | None = None,
) -> AffineCovariance: ...


def covariance(
    tracks: Tracks,
    reconstruction: AnyReconstruction,
    gauge: Any = None,
    noise_px: float | None = None,
    *,
    loss: str = "linear",
    loss_scale_px: float | str = "auto",
    backend: str | None = None,
    **of_metric: Any,
) -> ReconstructionCovariance | MetricCovariance | AffineCovariance:
    """Return the covariance of an adjusted reconstruction, in any gauge.

    Parameters
    ----------
    tracks : Tracks
        Observations that the reconstruction was adjusted to, with their weights: zero for those
        that were set aside.
    reconstruction : Reconstruction, MetricReconstruction or AffineReconstruction
        Cameras and points at the minimum, and lines where they were adjusted to ``lines``.
    gauge : Gauge or "inner", optional
        Of a metric reconstruction, which is not moved, the datum: "inner" (default) for inner
        constraints over all points, ``eg.gauge.inner(points=..., views=...)`` over some,
        `two_cameras` (one and the distance of another), `reference_camera`, or `five_points` (of
        three points seven coordinates). What priors and fixed parts hold needs no datum.
        Of an affine one "inner", over all or some points, or `five_points`, of which four stay.
        A projective reconstruction is moved there, and its covariance is that of the estimate
        expressed in that gauge. By default the free gauge of the reconstruction as it is: the
        pseudo-inverse of the normal matrix, of least trace. What a gauge leaves open (an
        orthonormal change of basis in the normalised one) is treated like that, too.
    noise_px : float, optional
        Standard deviation of an image coordinate of weight one. By default estimated from the
        residuals: sqrt(sum of weighted squares / (2 N - 11 n - 3 m + 15)), with a robust loss over
        those within three standard deviations, freed from the pull of the others
        (`epigauge.uncertainty.influence.RobustFit`). Priors count beside this noise; where it is
        estimated, beside the `sigma` of the tracks, and the variance factor is that of all.
    loss : {"linear", "huber", "soft_l1", "cauchy", "truncated"}
        What the reconstruction was adjusted with. Under a robust loss the covariance is that of an
        M-estimate, A^-1 B A^-1, with wrong observations counted one by one.
    loss_scale_px : float or "auto"
        Its scale, as `BundleResult.loss_scale_px`; by default from these residuals.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.
    **of_metric
        Of a metric reconstruction `refine`, `fixed_views`, `fixed_points`, `priors` and ``lines``,
        as they were given to `bundle_adjust`; of an affine one `fixed_views` and `fixed_points`; of
        a projective one ``lines``, with the linear loss. With
        lines the noise is that of both: an end point of a segment is as much more or less exact
        than a point as the `sigma` of tracks and segments say.

    Returns
    -------
    ReconstructionCovariance, MetricCovariance or AffineCovariance
        Covariances of cameras, points and projected points, and the way to other gauges.

    Raises
    ------
    ArgumentError
        If the reconstruction has another size, or lines and ``lines`` is not given, there is
        nothing to estimate the noise from, the observations do not determine the reconstruction, or
        the gauge is not one of `eg.gauge` and has no method `constraints`.

    Notes
    -----
    The reduced system of the cameras is factored within its skyline, and of its inverse only the
    blocks of views that see common points are computed (Takahashi's selected inversion [2]_) until
    others are asked for: time is that of a few steps, memory that of factor and observations.

    References
    ----------
    .. [1] K. Kanatani, D. D. Morris, "Gauges and gauge transformations for uncertainty description
       of geometric structure with indeterminacy", IEEE Trans. Inf. Theory 47(5), 2001.
    .. [2] K. Takahashi, J. Fagan, M.-S. Chen, "Formation of a sparse bus impedance matrix and its
       application to short circuit study", Proc. 8th PICA Conf., 1973.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.multi_view_scene(seed=1).tracks
    >>> result = eg.bundle_adjust(tracks)
    >>> found = eg.covariance(tracks, result.reconstruction, eg.gauge.normalized())
    >>> found.points.shape
    (100, 4, 4)
    """
    if isinstance(reconstruction, AffineReconstruction):
        if as_choice("loss", loss, LOSSES) != "linear":
            raise ArgumentError("loss", f"is {loss!r} with affine cameras", "'linear'")
        for name in of_metric.keys() - {"fixed_views", "fixed_points"}:
            raise ArgumentError(name, "is given with affine cameras", "a metric reconstruction")
        return affine_covariance(
            tracks,
            reconstruction,
            "inner" if gauge is None else gauge,
            noise_px,
            backend=backend,
            **of_metric,
        )
    if not isinstance(reconstruction, Reconstruction | MetricReconstruction):
        was = f"is a {type(reconstruction).__name__}"
        needed = "an eg.Reconstruction, MetricReconstruction or AffineReconstruction"
        raise ArgumentError("reconstruction", was, needed)
    if reconstruction.lines is not None and of_metric.get("lines") is None:
        was = f"has {len(reconstruction.lines)} lines, which count as observations, too"
        needed = "their segments, lines=...; or one adjusted to points alone"
        raise ArgumentError("reconstruction", was, needed)
    if isinstance(reconstruction, MetricReconstruction):
        datum = "inner" if gauge is None else gauge
        options: Any = {**of_metric, "backend": backend}
        options |= {"loss": loss, "loss_scale_px": loss_scale_px}
        return metric_covariance(tracks, reconstruction, datum, noise_px, **options)
    lines = of_metric.pop("lines", None)
    if of_metric:
        raise ArgumentError(
            next(iter(of_metric)), "is given with a projective reconstruction", "a metric one"
        )
    if lines is not None and reconstruction.lines is None:
        was = "is given, and the reconstruction has no lines"
        raise ArgumentError("lines", was, "what was adjusted: eg.bundle_adjust(..., lines=lines)")
    if lines is not None and as_choice("loss", loss, LOSSES) != "linear":
        raise ArgumentError("loss", f"is {loss!r} with lines of projective cameras", "'linear'")
    P, Q = reconstruction.P, reconstruction.Q
    n, m = len(P), len(Q)
    if (n, m) != (tracks.n_views, tracks.n_points):
        raise ArgumentError(
            "reconstruction",
            f"has {n} cameras and {m} points",
            f"{tracks.n_views} and {tracks.n_points}, as the tracks",
        )
    frame = Frame.of(tracks)
    home = normalized().transformation(frame.cameras_in(P), Q)
    graph = ObservationGraph(tracks.view, tracks.point, n, m)
    table, q = kernels.table(backend), frame.conditioned(tracks)
    found, weights = None, np.asarray(tracks.weights)
    if as_choice("loss", loss, LOSSES) != "linear":
        r = whitened(tracks.whitening, (tracks.xy - reconstruction.project(tracks)).T).T
        known = robust_loss(loss, loss_scale_px, r, weights)
        found = RobustFit.of(r, weights, known, 11 * n + 3 * m - 15)
        weights = found.weights
    parts = camera_model("projective"), table, graph, q, weights
    linearizer = NumpyLinearizer(*parts, Loss(), tracks.whitening)
    moved_P, moved_Q = home.apply(frame.cameras_in(P), Q)
    state = moved_P.reshape(-1, 12), moved_Q
    cost = 0.5 * float(np.sum(linearizer.point_costs(*state)))
    segments, moved_lines = None, None
    if lines is not None:
        assert reconstruction.lines is not None
        if len(reconstruction.lines) != lines.n_lines:
            was = f"has {len(reconstruction.lines)} lines"
            raise ArgumentError("reconstruction", was, f"{lines.n_lines}, as lines")
        seen = seen_lines("reconstruction", lines, reconstruction, tracks.unit, frame)
        segments, moved_lines = seen.linearizer(table), home.lines(reconstruction.lines)
        cost += 0.5 * float(np.sum(segments.point_costs(state[0], moved_lines)))
    if noise_px is not None:
        noise_px = as_positive("noise_px", noise_px)
    elif found is None:
        redundancy = 2 * int(np.count_nonzero(tracks.weights)) - 11 * n - 3 * m + 15
        redundancy += 0 if lines is None else 2 * len(lines) - 4 * lines.n_lines
        if redundancy <= 0:
            raise ArgumentError("noise_px", "is not given", "a number: nothing is redundant")
        noise_px = frame.scale * float(np.sqrt(2.0 * cost / redundancy))
    inverse = Inverse.of(linearizer, state, frame.scale, segments, moved_lines)
    whole: Inverse | Sandwich = inverse
    if found is not None:
        influence = _influence(found, inverse, tracks.whitening)
        noise_px = influence.noise if noise_px is None else noise_px
        whole = Sandwich(inverse, influence)
    assert noise_px is not None
    # From home to the reconstruction as given, in pixels.
    cameras, points = home.inverse().blocks()
    pixels = np.zeros((n, 3, 3))
    pixels[:, [0, 1], [0, 1]] = frame.scale
    pixels[:, :2, 2], pixels[:, 2, 2] = frame.origins, 1.0
    out = np.einsum("nij,kl->nikjl", pixels, np.eye(4)).reshape(n, 12, 12)
    maps = (out @ cameras, points)
    free = ReconstructionCovariance(
        reconstruction, noise_px, projector(identity(), P, Q), whole, maps
    )
    return free if gauge is None else free.in_gauge(gauge)


def _influence(fit: RobustFit, inverse: Inverse, whitening: Array | None) -> Influence:
    """Return what observations add, in pixels: the fit is of whitened residuals."""
    if whitening is None:
        return fit.influence(inverse.pull(fit.wrong, fit.psi))
    W = whitening.transpose(2, 0, 1)[fit.wrong]
    psi = (np.swapaxes(W, 1, 2) @ fit.psi[..., None])[..., 0]
    influence = fit.influence(whitened(whitening, inverse.pull(fit.wrong, psi).T).T)
    W = whitening.transpose(2, 0, 1)[influence.wrong]
    return replace(influence, rest=np.swapaxes(W, 1, 2) @ influence.rest @ W)
