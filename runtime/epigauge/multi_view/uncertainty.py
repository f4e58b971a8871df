"""Uncertainty of a reconstruction to first order: what `covariance` puts together.

A generalised inverse of the normal matrix N is found once, from the reduced system of the cameras,
in the basis and the parameters in which N is best conditioned; no matrix of all parameters is
formed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_choice, as_positive
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
from epigauge.multi_view.datum import projector
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import Gauge, identity, normalized
from epigauge.multi_view.inverse import Inverse
from epigauge.multi_view.line_start import seen_lines
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.reconstruction_covariance import ReconstructionCovariance
from epigauge.multi_view.sandwich import Sandwich
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import LOSSES, Loss
from epigauge.uncertainty.affine import AffineCovariance, affine_covariance
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.uncertainty.influence import Influence, RobustFit
from epigauge.uncertainty.metric import metric_covariance, robust_loss

__all__ = ["covariance"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


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
