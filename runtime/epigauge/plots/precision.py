"""Pictures of how sure a calibrated reconstruction is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.display import Display, display
from epigauge.multi_view.tracks import Tracks
from epigauge.plots._style import BLUE, finish, heading, new_figure
from epigauge.uncertainty.covariance import MetricCovariance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_precision"]

Array = NDArray[np.float64]

#: Bars at most, cells of the image along its longer side, observations that a cell needs.
_BARS, _CELLS, _LEAST = 40, 24, 3
_CAMERA = "#c25e00"


def plot_precision(
    covariance: MetricCovariance,
    tracks: Tracks,
    title: str = "",
    *,
    frame: Display | None = None,
) -> Figure:
    """Show the standard deviations of intrinsics, points and cameras.

    Above a bar for each refined parameter of a camera: its standard deviation in its own unit; if
    there are too many, those of the least sure. Below maps of precision: the points from above and
    from the side with their largest standard deviation (longest half-axis of the ellipsoid) as the
    colour, cameras as triangles, and where in the images less sure points are seen.

    Parameters
    ----------
    covariance : MetricCovariance
        What `covariance` returned.
    tracks : Tracks
        Observations.
    title : str
        What to call them.
    frame : Display, optional
        Where to show them; by default ``display(covariance.reconstruction, tracks)``.

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
    >>> spread = eg.covariance(tracks, scene)  # doctest: +SKIP
    >>> save_figure(plot_precision(spread, tracks), "precision.png")  # doctest: +SKIP
    """
    figure = new_figure(11.0, 9.0)
    shown = display(covariance.reconstruction, tracks) if frame is None else frame
    text = f"{title}: " if title else ""
    heading(figure, f"{text}noise {covariance.noise_px:.3g}, redundancy {covariance.redundancy}")
    grid = figure.add_gridspec(2, 3, height_ratios=(1.0, 1.1))
    _draw_bars(figure.add_subplot(grid[0, :]), covariance)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance.point_blocks)[:, -1].clip(0.0))
    usable = shown.shown & np.isfinite(sigma) & (sigma > 0.0)
    limits = np.quantile(sigma[usable], (0.02, 0.98)) if usable.any() else np.array([1.0, 2.0])
    from matplotlib.colors import LogNorm

    norm = LogNorm(limits[0], max(limits[1], 1.001 * limits[0]))
    for column, (axes_of, name) in enumerate((((0, 1), "From above"), ((1, 2), "From the side"))):
        axes = figure.add_subplot(grid[1, column])
        _draw_map(axes, shown, usable, sigma, axes_of, norm)
        axes.set_title(name, loc="left", fontsize=11)
        axes.legend(fontsize=8, frameon=False, loc="upper right")
    axes = figure.add_subplot(grid[1, 2])
    image = _draw_image(axes, tracks, sigma, usable, norm)
    figure.colorbar(image, ax=axes, label="largest sigma of a point (unit of the scene)")
    return figure


def _draw_bars(axes: Axes, covariance: MetricCovariance) -> None:
    """Draw sigma of the intrinsics, each in its unit, on a logarithmic scale."""
    rows = covariance.intrinsic_rows()
    several = len(covariance.reconstruction.cameras) > 1
    shown = rows
    if len(rows) > _BARS:
        # The least sure of each kind, as many of each.
        names = list(dict.fromkeys(row[1] for row in rows))
        each = max(_BARS // len(names), 1)
        shown = []
        for name in names:
            own = sorted((row for row in rows if row[1] == name), key=lambda row: -row[3])
            shown += own[:each]
    if not shown:
        axes.text(0.5, 0.5, "no intrinsics are refined", ha="center", va="center", color="0.4")
        axes.set_axis_off()
        return
    at = np.arange(len(shown))
    axes.bar(at, [row[3] for row in shown], color=BLUE, width=0.7)
    axes.set_yscale("log")
    labels = [
        f"{name}{f' of {c}' if several else ''}{'' if unit == '1' else f' ({unit})'}"
        for c, name, _, _, unit in shown
    ]
    axes.set_xticks(at, labels, rotation=90 if len(shown) > 12 else 0)
    more = "" if len(shown) == len(rows) else f", the least sure {len(shown)} of {len(rows)}"
    finish(axes, f"Standard deviations of the intrinsics, each in its unit{more}", legend=False)
    if len(shown) <= 12:
        for x, (_, _, value, sigma, _) in zip(at, shown, strict=True):
            told = f"{value:.6g}\n+- {sigma:.2g}"
            axes.annotate(told, (x, sigma), ha="center", va="bottom", fontsize=8)
        axes.margins(y=0.25)


def _draw_map(
    axes: Axes,
    shown: Display,
    usable: NDArray[np.bool_],
    sigma: Array,
    axes_of: tuple[int, int],
    norm: Any,
) -> None:
    """Draw the points from one side, the least sure last."""
    order = np.flatnonzero(usable)[np.argsort(sigma[usable], kind="stable")]
    x, y = shown.points[order][:, axes_of].T
    size = float(np.clip(3000.0 / max(len(order), 1), 1.0, 14.0))
    axes.scatter(x, y, c=sigma[order], norm=norm, cmap="viridis", s=size, lw=0.0)
    axes.plot(*shown.centres[:, axes_of].T, "^", color=_CAMERA, ms=4.0, label="cameras")
    axes.set(xticks=[], yticks=[], facecolor="0.985")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_image(
    axes: Axes, tracks: Tracks, sigma: Array, usable: NDArray[np.bool_], norm: Any
) -> Any:
    """Draw the median of what the points seen in each part of the images have."""
    rows = usable[tracks.point] & (tracks.weights > 0.0)
    xy, values = tracks.xy[rows], sigma[tracks.point[rows]]
    low, high = tracks.xy.min(axis=0), tracks.xy.max(axis=0)
    cell = float(np.max(high - low)) / _CELLS or 1.0
    counts = np.maximum(np.ceil((high - low) / cell), 1).astype(int)
    places = np.minimum(((xy - low) / cell).astype(int), counts - 1)
    flat, found = places[:, 1] * counts[0] + places[:, 0], np.full(counts[0] * counts[1], np.nan)
    order = np.argsort(flat, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(flat[order])) + 1):
        if len(part) >= _LEAST:
            found[flat[part[0]]] = np.median(values[part])
    extent = (low[0], low[0] + counts[0] * cell, low[1] + counts[1] * cell, low[1])
    image = axes.imshow(
        found.reshape(counts[1], counts[0]), norm=norm, cmap="viridis", extent=extent
    )
    axes.set_title("In the images", loc="left", fontsize=11)
    axes.set(xlabel="x (px)", ylabel="y (px)")
    axes.tick_params(labelsize=8)
    return image
