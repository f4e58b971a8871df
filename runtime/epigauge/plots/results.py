"""A picture of every kind of result that has no larger one of its own: `Result.plot` leads here."""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_matches
from epigauge._colmap_verification import DatabaseVerification
from epigauge._results import Result
from epigauge.cameras import AffineReconstruction, MetricReconstruction
from epigauge.colmap import DatabaseResult
from epigauge.errors import ArgumentError
from epigauge.io import Matches
from epigauge.metric.pair import FocalLengths
from epigauge.metric.result import MetricUpgrade
from epigauge.multi_view.display import display
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.reconstruction_covariance import ReconstructionCovariance
from epigauge.multi_view.tracks import Tracks
from epigauge.plots._style import BLUE, GREY, RED, count_whole, finish, heading, new_figure
from epigauge.plots.many_views import plot_bundle
from epigauge.plots.precision import plot_precision
from epigauge.two_view.batch_result import FundamentalBatch
from epigauge.two_view.homography_result import HomographyResult
from epigauge.two_view.model import TwoViewResult
from epigauge.uncertainty.affine import AffineCovariance, AffineStd
from epigauge.uncertainty.covariance import MetricCovariance, Std

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_result"]

Array = NDArray[np.float64]

_WIDTH = 11.0  # inches
_ORANGE = "#c25e00"
#: Most segments of a view, and most arrows of a kind, that are drawn.
_MOST, _ARROWS = 2000, 300


@singledispatch
def plot_result(result: Result, *data: Any, **options: Any) -> Figure:
    """Draw a result.

    Parameters
    ----------
    result : Result
        Of any kind.
    *data
        What it was computed from, where the picture shows it: `Result.plot` says for which kinds.
    **options
        Of the picture of that kind.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; `save_figure` writes it.

    Raises
    ------
    ArgumentError
        If this kind has no picture, or the data is missing.
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> eg.plots.plot_result(tracks)  # doctest: +SKIP
    """
    was = f"is a {type(result).__name__}, which has no picture"
    raise ArgumentError("result", was, "a result of a solver, or what one takes")


@plot_result.register(Tracks)
def _(result: Tracks) -> Figure:
    """Draw how many points each view sees, and how many views see a point."""
    figure = _headed(_size(result))
    views, lengths = figure.subplots(1, 2)
    counts = np.bincount(result.view, minlength=result.n_views)
    views.bar(np.arange(result.n_views), counts, color=BLUE, width=0.8)
    views.set(xlabel="view", ylabel="observations")
    count_whole(views, "xy")
    finish(views, "Observations of each view", legend=False)
    seen = np.bincount(np.bincount(result.point, minlength=result.n_points))
    lengths.bar(np.arange(len(seen)), seen, color=BLUE, width=0.8)
    lengths.set(xlabel="views that see a point", ylabel="points")
    count_whole(lengths, "xy")
    finish(lengths, "Lengths of the tracks", legend=False)
    return figure


@plot_result.register(Matches)
def _(result: Matches) -> Figure:
    """Draw where the points of image 1 went."""
    title = f"{result.name}: " if result.name else ""
    return _moves(result.x1, result.x2, None, f"{title}{len(result)} matches")


@plot_result.register(LineTracks)
def _(result: LineTracks) -> Figure:
    """Draw the segments of up to six views."""
    views = np.unique(result.view)[:6]
    figure = _headed(f"Segments of {result.n_lines} lines", 3.2 * -(-len(views) // 3) + 0.8)
    axes = figure.subplots(-(-len(views) // 3), min(len(views), 3), squeeze=False).ravel()
    from matplotlib.collections import LineCollection

    for place, view in zip(axes, views, strict=False):
        segments = result.segments[result.view == view].reshape(-1, 2, 2)[:_MOST]
        place.add_collection(LineCollection(list(segments), colors=BLUE, lw=1.0))
        place.autoscale_view()
        place.invert_yaxis()
        place.set_aspect("equal", adjustable="datalim")
        finish(place, f"View {view}", legend=False)
    for place in axes[len(views) :]:
        place.axis("off")
    return figure


@plot_result.register(HomographyResult)
def _(result: HomographyResult, x1: ArrayLike, x2: ArrayLike) -> Figure:
    """Draw where the points went, right ones and wrong ones, and how far H leads them astray."""
    a, b = as_matches(x1, x2, at_least=1)
    h = np.column_stack([a, np.ones(len(a))]) @ result.H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(h[:, :2] / h[:, 2:] - b, axis=1)
    title = f"Homography of {len(a)} matches: RMS {result.rms_px:.4g} px per coordinate"
    return _moves(a, b, _marks(result.inlier, a), title, error, result.flags)


@plot_result.register(TwoViewResult)
def _(result: TwoViewResult, x1: ArrayLike, x2: ArrayLike) -> Figure:
    """Draw where the points went: those that agree with the model, and the others."""
    a, b = as_matches(x1, x2, at_least=1)
    title = f"Model of two views: {result.model}"
    marks = _marks(result.inliers, a)
    return _moves(a, b, marks, title, None, result.flags)


@plot_result.register(Reconstruction)
@plot_result.register(MetricReconstruction)
def _(result: Reconstruction | MetricReconstruction, tracks: Tracks) -> Figure:
    """Draw points and cameras from above and from the side."""
    frame = display(result, tracks)
    metric = isinstance(result, MetricReconstruction)
    note = "calibrated" if metric else "in a basis to look at, no calibration"
    return _sides(frame.points[frame.shown], frame.centres, f"{_size(result)}, {note}")


@plot_result.register(AffineReconstruction)
def _(result: AffineReconstruction) -> Figure:
    """Draw points from above and from the side: affine cameras are at infinity."""
    return _sides(result.X, np.empty((0, 3)), f"{_size(result)}, up to an affine change")


@plot_result.register(MetricUpgrade)
def _(result: MetricUpgrade, tracks: Tracks, title: str = "") -> Figure:
    """Draw the scene, its residuals and the convergence, as of a bundle adjustment."""
    if result.bundle is None:
        raise ArgumentError("result", "has no scene", "tracks that determine one")
    f, std = (float(np.atleast_1d(v)[0]) for v in (result.focal_px, result.focal_std_px))
    return plot_bundle(result.bundle, tracks, f"{title or 'Metric scene'}, f {f:.5g} +- {std:.2g}")


@plot_result.register(MetricCovariance)
def _(result: MetricCovariance, tracks: Tracks, title: str = "", **options: Any) -> Figure:
    """Draw the intrinsics with their deviations, and maps of precision."""
    return plot_precision(result, tracks, title, **options)


@plot_result.register(Std)
@plot_result.register(AffineStd)
@plot_result.register(AffineCovariance)
@plot_result.register(ReconstructionCovariance)
def _(result: Any) -> Figure:
    """Draw the standard deviations, from the least to the largest."""
    return _sorted(_deviations(result), f"{type(result).__name__}: standard deviations")


@plot_result.register(FundamentalBatch)
def _(result: FundamentalBatch) -> Figure:
    """Draw RMS and noise of the pairs that were not refused, from the least to the largest."""
    done = result.status > -9
    values = {"RMS (px)": result.rms_px[done], "noise (px)": result.noise_px[done]}
    good = int(np.count_nonzero(result.success))
    return _sorted(values, f"{len(result.status)} pairs, {good} of them may be used")


@plot_result.register(DatabaseResult)
@plot_result.register(DatabaseVerification)
def _(result: DatabaseResult | DatabaseVerification) -> Figure:
    """Draw the noise of the pairs and how many matches agree, from the least to the largest."""
    values = {"noise (px)": result.noise_px, "matches that agree": result.inliers.astype(float)}
    return _sorted(values, result._heading())


@plot_result.register(FocalLengths)
def _(result: FocalLengths) -> Figure:
    """Draw both focal lengths with their standard deviations."""
    figure = _headed(f"Focal lengths{f': {result.flag}' if result.flag else ''}", 3.6)
    axes = figure.subplots()
    std = np.where(np.isfinite(result.std_px), result.std_px, 0.0)
    axes.errorbar([1, 2], result.focal_px, yerr=std, fmt="o", color=BLUE, capsize=5)
    axes.set(xticks=[1, 2], xlim=(0.5, 2.5), xlabel="view", ylabel="focal length (px)")
    finish(axes, "With one standard deviation", legend=False)
    return figure


def _headed(text: str, height: float = 4.4, flags: Any = ()) -> Figure:
    figure = new_figure(_WIDTH, height)
    heading(figure, text, flags=flags)
    return figure


def _size(result: Tracks | Reconstruction | MetricReconstruction | AffineReconstruction) -> str:
    """Say how large it is."""
    return f"{type(result).__name__} of {result.n_views} views, {result.n_points} points"


def _marks(inlier: NDArray[np.bool_], x: Array) -> NDArray[np.bool_]:
    if inlier.shape != (len(x),):
        raise ArgumentError("x1", f"has {len(x)} matches", f"the {inlier.size} of the result")
    return inlier


def _moves(
    x1: Array,
    x2: Array,
    inlier: NDArray[np.bool_] | None,
    title: str,
    error: Array | None = None,
    flags: tuple[str, ...] = (),
) -> Figure:
    """Draw arrows from where points were to where they are, some of many; and their lengths."""
    figure = _headed(title, 5.0, flags)
    arrows, lengths = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    good = np.ones(len(x1), dtype=np.bool_) if inlier is None else inlier
    for rows, colour, name in ((good, BLUE, "agree"), (~good, RED, "do not agree")):
        step = max(1, -(-int(rows.sum()) // _ARROWS))
        a, b = x1[rows][::step], x2[rows][::step]
        if len(a):
            label = f"{int(rows.sum())} {name}" if inlier is not None else "matches"
            look: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0}
            arrows.quiver(*a.T, *(b - a).T, color=colour, width=0.003, label=label, **look)
    both = np.vstack([x1, x2])
    low, high = both.min(axis=0), both.max(axis=0)
    room = np.maximum(0.04 * (high - low), 1.0)
    low, high = low - room, high + room
    arrows.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xlabel="x (px)", ylabel="y (px)")
    arrows.set_aspect("equal", adjustable="box")
    arrows.set_anchor("N")
    finish(arrows, "From image 1 to image 2", legend=False)
    arrows.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    if error is None:
        values, name = np.linalg.norm(x2 - x1, axis=1)[good], "distance moved (px)"
    else:
        values, name = error[good & np.isfinite(error)], "distance from where H leads (px)"
    if len(values):
        lengths.hist(values, bins=40, color=BLUE, alpha=0.55, ec="white", lw=0.5)
    else:
        lengths.set(xticks=[], yticks=[])
        lengths.text(0.5, 0.5, "none", color=GREY, ha="center", transform=lengths.transAxes)
    lengths.set(xlabel=name, ylabel="matches")
    count_whole(lengths)
    finish(
        lengths, "Lengths of those that agree" if inlier is not None else "Lengths", legend=False
    )
    return figure


def _sides(points: Array, centres: Array, title: str) -> Figure:
    """Draw points and cameras from two sides, to scale."""
    figure = _headed(title, 5.4)
    for axes, (i, j), name in zip(
        figure.subplots(1, 2), ((0, 1), (1, 2)), ("From above", "From the side"), strict=True
    ):
        axes.plot(*points[:, (i, j)].T, ".", color=BLUE, ms=3, label="points")
        if len(centres):
            axes.plot(*centres[:, (i, j)].T, "^", color=_ORANGE, ms=6, label="cameras")
        axes.set_aspect("equal", adjustable="datalim")
        finish(axes, name, place="upper right")
    return figure


def _deviations(result: Any) -> dict[str, Array]:
    """Return the standard deviations that a result holds, by what they are of."""
    if isinstance(result, ReconstructionCovariance):
        return {"entries of the cameras": _roots(result.cameras)}
    own = result.std if isinstance(result, AffineCovariance) else result
    known = own._contents().items()
    return {k: np.ravel(value) for k, value in known if value is not None and np.size(value)}


def _roots(blocks: Array) -> Array:
    diagonal: Array = np.sqrt(np.maximum(np.diagonal(blocks, axis1=1, axis2=2), 0.0))
    return diagonal.ravel()


def _sorted(values: Mapping[str, Array], title: str) -> Figure:
    """Draw each kind of value in rising order, on a logarithmic scale."""
    figure = _headed(title, 4.2)
    kinds = {name: np.sort(v[np.isfinite(v) & (v > 0.0)]) for name, v in values.items()}
    panels: list[Axes] = list(figure.subplots(1, len(kinds), squeeze=False).ravel())
    for axes, (name, rising) in zip(panels, kinds.items(), strict=True):
        left = values[name].size - rising.size
        axes.step(np.arange(1, len(rising) + 1), rising, where="mid", color=BLUE)
        if len(rising):
            axes.set_yscale("log")
        note = f", {left} more are 0 or open" if left else ""
        count_whole(axes, "x")
        axes.set_xlabel(f"{len(rising)} values in rising order{note}", color=GREY)
        finish(axes, name, legend=False)
    return figure
