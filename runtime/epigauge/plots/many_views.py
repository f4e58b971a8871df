"""Pictures of an adjusted reconstruction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.cameras import MetricReconstruction
from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.display import Display, camera_spacing, display, is_sequence
from epigauge.multi_view.tracks import Tracks
from epigauge.plots._style import BLUE, RED, draw_history, finish, heading, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

__all__ = ["plot_bundle"]

Array = NDArray[np.float64]

_WIDTH = 11.0  # inches
_CAMERA, _EDGE = "#c25e00", BLUE
_PYRAMID = (0.1, 0.35)  # length of a camera, in usual distances of a point from the middle
_STRAY = 0.005  # share of the points that a picture may leave out at either end of an axis


def plot_bundle(
    result: BundleResult,
    tracks: Tracks,
    title: str = "",
    *,
    frame: Display | None = None,
    pieces: ArrayLike | None = None,
) -> Figure:
    """Show points and cameras from three sides, the residuals, and the convergence.

    Above the scene in a basis in which it looks plausible (see `display`): that is no calibration,
    and nothing can be measured in it. Cameras are pyramids, drawn nearer where they are far away;
    the colour of a point is its distance from the viewer of the first picture.
    Below the residual coordinates with the Gaussian of deviation 1.48 median(abs(r)), and the cost
    of each evaluation, less the lowest one.

    Parameters
    ----------
    result : BundleResult
        What `epigauge.bundle_adjust` returned for these tracks.
    tracks : Tracks
        Observations.
    title : str
        What to call them.
    frame : Display, optional
        Where to show them; by default ``display(result.reconstruction, tracks)``.
    pieces : array_like, shape (L, 2, 3) or (L, 2, 4), optional
        Ends of pieces of lines, to be drawn, too: `LineTracks.pieces`.

    Returns
    -------
    matplotlib.figure.Figure
        The picture, not yet drawn: see `save_figure`.

    Raises
    ------
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> plot_bundle(result, tracks, "corridor")  # doctest: +SKIP
    """
    figure = new_figure(_WIDTH, 9.0)
    shown = display(result.reconstruction, tracks) if frame is None else frame
    text = f"{title}: " if title else ""
    text += f"{tracks.n_views} views, {tracks.n_points} points, RMS {result.rms_px:.4g} px"
    if result.loss_scale_px:
        text += f" (robust loss of scale {result.loss_scale_px:.2g} px)"
    heading(figure, text, "" if result.success else result.message)
    ends = np.zeros((0, 2, 3)) if pieces is None else shown.placed_pieces(np.asarray(pieces))
    grid = figure.add_gridspec(3, 6, height_ratios=(2.6, 2.6, 2.9))
    oblique = figure.add_subplot(grid[:2, :4])
    _draw_scene(oblique, shown, _OBLIQUE, ends, floor=True)
    if shown.distorted:
        caption = "Points and cameras (distorted: in no basis do all cameras look usual)"
    else:
        metric = isinstance(result.reconstruction, MetricReconstruction)
        caption = f"Points and cameras ({'calibrated' if metric else 'to look at; no calibration'})"
    oblique.set_title(caption, loc="left", fontsize=11)
    _draw_legend(oblique, bool(len(ends)))
    for row, side, name in ((0, _ABOVE, "From above"), (1, _SIDE, "From the side")):
        axes = figure.add_subplot(grid[row, 4:])
        _draw_scene(axes, shown, side, ends)
        axes.set_title(name, loc="left", fontsize=11)
    _draw_residuals(figure.add_subplot(grid[2, :3]), result.fun.ravel())
    draw_history(figure.add_subplot(grid[2, 3:]), result.history)
    return figure


def _draw_scene(axes: Axes, shown: Display, side: Array, ends: Array, floor: bool = False) -> None:
    """Draw points, pieces of lines and cameras as seen from one side, near things over far ones.

    With a floor they are seen in perspective and stand on a grid; else without it, to scale.
    """
    points = shown.points[shown.shown]
    rims = _rims(shown)
    # Of few points none is left out.
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    if len(points) > 2.0 / _STRAY:
        low, high = np.quantile(points, (_STRAY, 1.0 - _STRAY), axis=0)
    near = points[((points >= low) & (points <= high)).all(axis=1)]
    framed = np.vstack([near, shown.centres, rims.reshape(-1, 3)])
    middle = (framed.min(axis=0) + framed.max(axis=0)) / 2.0
    reach = float(np.linalg.norm(framed - middle, axis=1).max())

    def seen(X: Array) -> Array:
        """Return right, up, and away of points."""
        turned = X @ side.T
        if not floor:
            return turned
        centre = middle @ side.T
        relative = turned - centre
        shrink = 2.0 * reach / np.maximum(2.0 * reach + relative[..., 2:], 0.2 * reach)
        return np.asarray(centre + relative * np.concatenate([shrink, shrink, shrink**0], axis=-1))

    if floor:
        _draw_floor(axes, framed, seen)
    order = np.argsort(-(points @ side.T)[:, 2], kind="stable")
    depth = (points @ _OBLIQUE.T)[order, 2]
    limits = np.quantile(depth, (0.01, 0.99)) if len(depth) else (0.0, 1.0)
    x, y = seen(points)[order, :2].T
    size = _size(len(points)) * (1.0 if floor else 0.5)
    axes.scatter(x, y, c=depth, cmap="viridis", vmin=limits[0], vmax=limits[1], s=size, lw=0.0)
    if len(ends):
        axes.add_collection(_edges(seen(ends)[..., :2]))
    _draw_cameras(axes, seen(shown.centres)[:, :2], seen(rims)[..., :2], is_sequence(shown.centres))
    # The view is fitted to these, not to stray points.
    around = seen(framed)[:, :2]
    axes.dataLim.set_points(np.array([around.min(axis=0), around.max(axis=0)]))
    axes.set(xticks=[], yticks=[], facecolor="0.985")
    axes.set_aspect("equal", adjustable="datalim")
    for spine in axes.spines.values():
        spine.set_color("0.85")


def _edges(ends: Array) -> LineCollection:
    from matplotlib.collections import LineCollection

    return LineCollection(list(ends), colors=_EDGE, lw=1.2, zorder=2)


def _draw_legend(axes: Axes, lines: bool) -> None:
    """Say what the colours are."""
    from matplotlib import colormaps

    dot: dict[str, Any] = {"ls": "", "marker": "o", "ms": 5}
    for share, name in ((0.0, "near points"), (1.0, "far points")):
        axes.plot([], [], color=colormaps["viridis"](share), label=name, **dot)
    if lines:
        axes.plot([], [], color=_EDGE, lw=1.2, label="lines")
    axes.plot([], [], color=_CAMERA, lw=1.2, label="cameras")
    axes.legend(fontsize=8, frameon=False, loc="lower right")


def _rims(shown: Display) -> Array:
    """Return the corners of the cameras' pyramids, (n, 4, 3)."""
    length = float(np.clip(camera_spacing(shown.centres), *_PYRAMID))
    return np.asarray(shown.centres[:, None] + length * shown.corners)


def _draw_floor(axes: Axes, framed: Array, seen: Any) -> None:
    """Draw a grid of unit squares under the scene."""
    from matplotlib.collections import LineCollection

    (x0, y0, _), (x1, y1, _) = np.floor(framed.min(axis=0)), np.ceil(framed.max(axis=0))
    z = float(framed[:, 2].min())
    lines = [[(x, y0, z), (x, y1, z)] for x in np.arange(x0, x1 + 0.5)]
    lines += [[(x0, y, z), (x1, y, z)] for y in np.arange(y0, y1 + 0.5)]
    ends = seen(np.array(lines))[..., :2]
    axes.add_collection(LineCollection(list(ends), colors="0.9", lw=0.8, zorder=0), autolim=False)


def _draw_cameras(axes: Axes, centres: Array, rims: Array, joined: bool) -> None:
    """Draw pyramids over what the cameras see, and the path along them."""
    from matplotlib.collections import LineCollection, PolyCollection

    if joined:
        axes.plot(*centres.T, color=_CAMERA, lw=0.8, alpha=0.6)
    faces = PolyCollection(list(rims), facecolors=_CAMERA, alpha=0.12, lw=0.0, zorder=3)
    axes.add_collection(faces)
    apex = centres[:, None, None]
    edges = np.concatenate([np.broadcast_to(apex, rims[:, :, None].shape), rims[:, :, None]], 2)
    around = np.stack([rims, np.roll(rims, -1, axis=1)], axis=2)
    lines = np.concatenate([edges, around], axis=1).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(lines), colors=_CAMERA, lw=0.9, zorder=4))


def _turned(azimuth: float, elevation: float) -> Array:
    """Return the rotation to right, up and away, seen from a direction in degrees."""
    a, e = np.radians([azimuth, elevation])
    away = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), -np.sin(e)])
    right = np.array([np.cos(a), -np.sin(a), 0.0])
    return np.stack([right, np.cross(right, away), away])


_OBLIQUE, _ABOVE, _SIDE = _turned(-28.0, 24.0), _turned(0.0, 90.0), _turned(-90.0, 0.0)


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
