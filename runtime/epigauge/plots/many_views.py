"""Pictures of an adjusted reconstruction and of methods side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.display import Display, display
from epigauge.multi_view.tracks import Tracks
from epigauge.plots._style import BLUE, GREY, RED, draw_history, finish, heading, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from epigauge.multi_view.compare import Comparison

__all__ = ["plot_bundle", "plot_comparison"]

Array = NDArray[np.float64]

_WIDTH = 11.0  # inches
_CAMERA = "#e07a1f"
_PYRAMID = (0.1, 0.35)  # height of a camera, in usual distances of a point from the middle
_COLOURS = (
    *("#6c757d", "#2a6f97", "#61a5c2", "#2d6a4f", "#74c69d", "#b5838d"),
    *("#7b2cbf", "#e07a1f", "#a47148", "#212529"),
)
_MARKERS = "vs^D<>PXdp"


def plot_bundle(result: BundleResult, tracks: Tracks, title: str = "") -> Figure:
    """Show points and cameras from two sides, the residuals, and the convergence.

    Above the scene in a basis in which it looks plausible (see `display`): that is no calibration,
    and nothing can be measured in it. Cameras are pyramids, drawn nearer where they
    are far away; colour is depth.
    Below the residual coordinates with the Gaussian of deviation 1.48 median |r|, and the cost of
    each evaluation, less the lowest one.

    Parameters
    ----------
    result : BundleResult
        What `bundle_adjust` returned for these tracks.
    tracks : Tracks
        Observations.
    title : str
        What to call them.

    Returns
    -------
    matplotlib.figure.Figure
        The picture, not yet drawn: see `save_figure`.

    Raises
    ------
    MissingPackageError
        If Matplotlib is not installed.
    """
    figure = new_figure(_WIDTH, 9.0)
    shown = display(result.reconstruction, tracks)
    text = f"{title}: " if title else ""
    text += f"{tracks.n_views} views, {tracks.n_points} points, RMS {result.rms_px:.4g} px"
    heading(figure, text, "" if result.success else result.message)
    grid = figure.add_gridspec(2, 6, height_ratios=(5.2, 3.0))
    oblique = figure.add_subplot(grid[0, :4])
    _draw_scene(oblique, shown, _OBLIQUE)
    oblique.set_title("Points and cameras (to look at; no calibration)", loc="left", fontsize=11)
    above = figure.add_subplot(grid[0, 4:])
    _draw_scene(above, shown, _ABOVE)
    above.set_title("From above", loc="left", fontsize=11)
    _draw_residuals(figure.add_subplot(grid[1, :3]), result.fun.ravel())
    draw_history(figure.add_subplot(grid[1, 3:]), result.history)
    return figure


def plot_comparison(comparison: Comparison, title: str = "") -> Figure:
    """Show for each method the lowest cost so far, less the best of all, by evaluations.

    Parameters
    ----------
    comparison : Comparison
        What `compare` returned.
    title : str
        What to call the tracks.

    Returns
    -------
    matplotlib.figure.Figure
        The picture, not yet drawn: see `save_figure`.

    Raises
    ------
    MissingPackageError
        If Matplotlib is not installed.
    """
    figure = new_figure(_WIDTH, 6.0)
    heading(figure, "Convergence of the methods" + (f": {title}" if title else ""))
    axes = figure.add_subplot()
    best = min(row.cost for row in comparison.rows)
    # Below this the costs of two converged runs do not differ by anything but where they stopped.
    floor = max(best * 1e-9, 1e-300)
    slowest = max(row.nfev for row in comparison.rows)
    for k, row in enumerate(comparison.rows):
        costs = np.array(
            [np.inf if not r.accepted and i else r.cost for i, r in enumerate(row.history)]
        )
        above = np.maximum(np.minimum.accumulate(costs) - best, floor)
        strong = row.method == "covariant"
        axes.plot(
            np.arange(1, len(above) + 1),
            above,
            color=RED if strong else _COLOURS[k % len(_COLOURS)],
            marker="o" if strong else _MARKERS[k % len(_MARKERS)],
            ms=6 if strong else 4,
            lw=2.6 if strong else 1.3,
            markevery=max(1, len(above) // 12),
            zorder=4 if strong else 3,
            label=f"{row.method}: {row.nfev}" + ("" if row.success else ", not converged"),
        )
    axes.axhline(floor, color=GREY, lw=0.8, ls=":")
    axes.set(yscale="log", xlabel="evaluations of the cost")
    axes.set(ylabel="lowest cost so far, above the best (px\N{SUPERSCRIPT TWO})")
    if slowest > 30:
        ticks = [tick for tick in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if tick <= slowest]
        axes.set(xscale="log")
        axes.set_xticks(ticks, list(map(str, ticks)))
        axes.set_xticks([], minor=True)
    finish(axes, f"best cost {best:.7g} px\N{SUPERSCRIPT TWO}")
    axes.legend(
        title="method: evaluations", loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False
    )
    return figure


def _draw_scene(axes: Axes, shown: Display, side: Array) -> None:
    """Draw points and cameras as seen from one side, near things over far ones."""
    points = shown.points[shown.shown]
    seen = points @ side.T
    order = np.argsort(-seen[:, 2])
    x, y, depth = *seen[order, :2].T, points[order, 1]
    axes.scatter(x, y, c=depth, cmap="viridis", s=_size(len(points)), lw=0.0)
    axes.plot(*(shown.centres @ side.T)[:, :2].T, color=_CAMERA, lw=0.7, alpha=0.6)
    steps = np.linalg.norm(np.diff(shown.centres, axis=0), axis=1)
    height = float(np.clip(np.median(steps), *_PYRAMID))
    for centre, corners in zip(shown.centres, shown.corners, strict=True):
        rim = centre + height * corners
        line = np.stack([rim[0], centre, rim[1], rim[0], rim[3], centre, rim[2], rim[3]])
        axes.plot(*(line @ side.T)[:, :2].T, color=_CAMERA, lw=0.9)
        axes.plot(*(rim[1:3] @ side.T)[:, :2].T, color=_CAMERA, lw=0.9)
    axes.set(xticks=[], yticks=[], facecolor="0.975")
    axes.set_aspect("equal", adjustable="datalim")
    for spine in axes.spines.values():
        spine.set_color("0.85")


def _turned(azimuth: float, elevation: float) -> Array:
    """Return the rotation to right, up and away, seen from a direction in degrees."""
    a, e = np.radians([azimuth, elevation])
    away = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), -np.sin(e)])
    right = np.array([np.cos(a), -np.sin(a), 0.0])
    return np.stack([right, np.cross(right, away), away])


_OBLIQUE, _ABOVE = _turned(-28.0, 24.0), _turned(0.0, 90.0)


def _size(count: int) -> float:
    return float(np.clip(4000.0 / max(count, 1), 1.5, 9.0))


def _draw_residuals(axes: Axes, r: Array) -> None:
    """Draw the histogram of residual coordinates with the Gaussian of their median size."""
    typical = 1.4826 * float(np.median(np.abs(r)))
    limit = min(float(np.abs(r).max()), 6.0 * typical) or 1.0
    edges = np.linspace(-limit, limit, 61)
    axes.hist(r, bins=edges.tolist(), color=BLUE, alpha=0.55, ec="white", lw=0.4, label="all views")
    if typical > 0.0:
        t = np.linspace(-limit, limit, 400)
        bell = np.exp(-0.5 * (t / typical) ** 2) * len(r) * (edges[1] - edges[0])
        bell /= typical * np.sqrt(2.0 * np.pi)
        axes.plot(t, bell, color=RED, lw=1.6, label=f"Gaussian, {typical:.3g} px")
    beyond = int(np.sum(np.abs(r) > limit))
    if beyond:
        axes.plot([], [], " ", label=f"{beyond} farther out")
    axes.set(xlabel="residual coordinate (px)", ylabel="number")
    finish(axes, "Residuals")
