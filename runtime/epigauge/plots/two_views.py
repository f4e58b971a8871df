"""Pictures of a refined fundamental matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_matches
from epigauge.errors import ArgumentError
from epigauge.plots._style import (
    BLUE,
    GREY,
    RED,
    count_whole,
    draw_history,
    finish,
    heading,
    new_figure,
)
from epigauge.two_view.geometry import reprojection_distances
from epigauge.two_view.result import FundamentalResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_refinement"]

Array = NDArray[np.float64]
Size = tuple[int, int]
Box = tuple[float, float, float, float]

_LINES = 12  # epipolar lines shown: enough to see the pencil, few enough to follow each
_WIDTH = 11.0  # inches


def plot_refinement(
    result: FundamentalResult,
    x1: ArrayLike,
    x2: ArrayLike,
    image_sizes: Sequence[Size | None] | None = None,
    images: Sequence[ArrayLike | None] | None = None,
) -> Figure:
    """Show the matches with epipolar lines, the distances that remain, and the convergence.

    Above: both images with all matches; for some of them, spread over the pencil of epipolar
    planes, point and epipolar line in the same colour on both sides. Below on the left the
    signed distances of all matches to the epipolar geometry (B&S's reprojection error with the
    structure eliminated), with the Gaussian of deviation sqrt(sum d^2 / (m - 7)), the estimate
    of the measurement noise. Below on the right the cost of each evaluation, less the lowest one.

    Parameters
    ----------
    result : FundamentalResult
        What `refine_fundamental` returned for these matches.
    x1, x2 : array_like, shape (m, 2)
        The matches, in pixels.
    image_sizes : pair of (width, height), optional
        Sizes of the images, in pixels; None for one that is not known.
    images : pair of array_like, shape (height, width) or (height, width, 3), optional
        The images themselves; None for one that is not there.

    Returns
    -------
    matplotlib.figure.Figure
        The picture, not yet drawn: see `save_figure`.

    Raises
    ------
    ArgumentError
        If the matches, sizes or images cannot be used.
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> plot_refinement(result, x1, x2)  # doctest: +SKIP
    """
    points = as_matches(x1, x2, at_least=1)
    F = np.asarray(result.F, dtype=np.float64)
    d, *feet = reprojection_distances(F, points[0], points[1])
    photos = _pair("images", images)
    boxes = _boxes(points, _pair("image_sizes", image_sizes), photos)

    aspect = max((y1 - y0) / (x1 - x0) for x0, x1, y0, y1 in boxes)
    top = min(max(0.5 * _WIDTH * aspect, 2.0), 6.0)
    figure = new_figure(_WIDTH, top + 4.0)
    text = f"Fundamental matrix from {len(d)} matches: RMS {result.rms_px:.4g} px per coordinate"
    failure = "" if result.status > 0 else result.message
    heading(figure, text, failure, result.flags)
    grid = figure.add_gridspec(2, 2, height_ratios=(top, 3.0))

    chosen = _spread_over_pencil(F, feet[0], feet[1], boxes[1])
    for view in (0, 1):
        axes = figure.add_subplot(grid[0, view])
        matrix = F.T if view == 0 else F
        lines = _homogeneous(feet[1 - view][chosen]) @ matrix.T
        _draw_view(axes, points[view], feet[view], chosen, lines, boxes[view], photos[view])
        _draw_epipole(axes, _null_vector(matrix.T), boxes[view], view + 1)
    shades = "Of the same colour: a match and its epipolar lines. "
    others = "Small dots: the other matches"
    figure.supxlabel(shades + others, x=0.01, ha="left", fontsize=8.5, color=GREY)
    _draw_distances(figure.add_subplot(grid[1, 0]), d)
    draw_history(figure.add_subplot(grid[1, 1]), result.history)
    return figure


def _draw_view(
    axes: Axes,
    points: Array,
    feet: Array,
    chosen: Sequence[int],
    lines: Array,
    box: Box,
    photo: Array | None,
) -> None:
    """Draw one image: all its points, and some of them with their epipolar lines."""
    from matplotlib import colormaps

    if photo is not None:
        axes.imshow(photo, cmap="gray", alpha=0.75 if photo.ndim == 2 else None)
    axes.set_facecolor("0.965")
    small, colour = 7.0 if len(points) < 400 else 3.0, "0.55" if photo is None else "#ffd60a"
    axes.scatter(points[:, 0], points[:, 1], s=small, color=colour, lw=0.0, zorder=2)
    colours = colormaps["turbo"](np.linspace(0.04, 0.94, len(chosen)))
    for index, line, shade in zip(chosen, lines, colours, strict=True):
        foot, direction = feet[index], np.array([-line[1], line[0]])
        if direction.any():
            step = direction / np.linalg.norm(direction) * (box[1] - box[0])
            axes.axline(foot, foot + step, color=shade, lw=1.1, alpha=0.9, zorder=3)
        x, y = points[index]
        axes.scatter(x, y, color=shade, s=42, ec="white", lw=1.0, zorder=4)
    axes.set(xlim=box[:2], ylim=box[3:1:-1], aspect="equal", xlabel="x (px)", ylabel="y (px)")
    axes.tick_params(labelsize=8, color=GREY)
    for spine in axes.spines.values():
        spine.set_color("0.75")


def _draw_epipole(axes: Axes, epipole: Array, box: Box, view: int) -> None:
    """Mark the epipole where it lies inside the picture, and say where it is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = epipole[:2] / epipole[2]
    size = max(box[1] - box[0], box[3] - box[2])
    middle = (box[0] + box[1]) / 2, (box[2] + box[3]) / 2
    if not np.hypot(x - middle[0], y - middle[1]) < 1e4 * size:
        angle = np.degrees(np.arctan2(epipole[1], epipole[0])) % 180.0
        where = f"epipole at infinity, {angle:.1f}\N{DEGREE SIGN}"
    else:
        where = f"epipole at ({x:.0f}, {y:.0f})"
        if box[0] <= x <= box[1] and box[2] <= y <= box[3]:
            axes.plot(x, y, "+", ms=17, mew=4.5, color="white", zorder=5)
            axes.plot(x, y, "+", ms=15, mew=2.0, color="black", zorder=6)
    # Of few points the image may be narrow: one title over the other, not beside it.
    axes.set_title(f"Image {view}\n{where}", loc="left", fontsize=10)


def _draw_distances(axes: Axes, d: Array) -> None:
    """Draw the histogram of signed distances with the Gaussian of the estimated noise."""
    m = len(d)
    sigma = float(np.sqrt(d @ d / max(m - 7, 1)))
    # A few outliers must not squeeze all the others into one bar.
    typical = 1.4826 * float(np.median(np.abs(d)))
    limit = min(float(np.abs(d).max()), max(4.0 * sigma, 1e-300), max(8.0 * typical, 1e-300)) or 1.0
    bins = int(np.clip(2.0 * np.sqrt(m), 10, 60))
    edges = np.linspace(-limit, limit, bins + 1)
    axes.hist(d, bins=edges.tolist(), color=BLUE, alpha=0.55, ec="white", lw=0.6, label="matches")
    if sigma > 0.0:
        t = np.linspace(-limit, limit, 400)
        bell = np.exp(-0.5 * (t / sigma) ** 2) * m * (edges[1] - edges[0])
        bell /= sigma * np.sqrt(2.0 * np.pi)
        axes.plot(t, bell, color=RED, lw=1.6, label=f"Gaussian, {sigma:.3g} px")
    beyond = int(np.sum(np.abs(d) > limit))
    if beyond:
        axes.plot([], [], " ", label=f"{beyond} farther away")
    axes.set(xlabel="signed distance to the epipolar geometry (px)", ylabel="matches")
    count_whole(axes)
    finish(axes, "Residuals")


def _spread_over_pencil(F: Array, x1: Array, x2: Array, box: Box, count: int = _LINES) -> list[int]:
    """Choose matches whose epipolar lines in image 2 are spread evenly, in the order of the pencil.

    An epipole in the picture sees the lines by their angle; one outside it by their distance from
    the middle of the picture.
    """
    lines = _homogeneous(x1) @ F.T
    normals = lines[:, :2] / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-300)[:, None]
    e = _null_vector(F.T)
    inside = abs(e[2]) > 0.0 and (
        box[0] <= e[0] / e[2] <= box[1] and box[2] <= e[1] / e[2] <= box[3]
    )
    away = np.ones(len(x1), dtype=np.bool_)
    if inside:
        place = np.arctan2(normals[:, 1], normals[:, 0]) % np.pi
        # Beside the epipole every line looks right: show points that lie far from it.
        distance = np.linalg.norm(x2 - e[:2] / e[2], axis=1)
        away = distance >= np.quantile(distance, 0.25)
    else:
        middle = np.array([(box[0] + box[1]) / 2, (box[2] + box[3]) / 2, 1.0])
        main = np.linalg.svd(normals, full_matrices=False)[2][0]
        offset = (lines @ middle) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-300)
        place = offset * np.where(normals @ main < 0.0, -1.0, 1.0)
    low, high = np.quantile(place[away], (0.01, 0.99))
    chosen: list[int] = []
    # Seen by angle the last line is the first one again.
    for target in np.linspace(low, high, min(count, int(away.sum())), endpoint=not inside):
        free = np.where(away, np.abs(place - target), np.inf)
        free[chosen] = np.inf
        chosen.append(int(np.argmin(free)))
    return sorted(chosen, key=lambda index: float(place[index]))


def _pair(name: str, values: Sequence[Any] | None) -> list[Any]:
    """Check an optional pair of sizes or images."""
    if values is None:
        return [None, None]
    if len(values) != 2:
        raise ArgumentError(name, f"has {len(values)} elements", "one for each of the two images")
    if name == "image_sizes":
        return [None if size is None else _size(size) for size in values]
    photos = [None if photo is None else np.asarray(photo) for photo in values]
    for photo in photos:
        if photo is not None and (
            photo.ndim not in (2, 3) or photo.shape[2:] not in ((), (3,), (4,)) or not photo.size
        ):
            raise ArgumentError(
                name, f"has one of shape {photo.shape}", "(height, width), grey or with 3 colours"
            )
    return photos


def _size(size: Any) -> Size:
    """Check the size of an image."""
    values = np.asarray(size)
    if values.shape != (2,) or values.dtype.kind not in "iuf" or not (values > 0).all():
        raise ArgumentError("image_sizes", f"has one of {size!r}", "(width, height) in pixels")
    return int(values[0]), int(values[1])


def _boxes(
    points: Sequence[Array], sizes: Sequence[Size | None], photos: Sequence[Array | None]
) -> list[Box]:
    """Return (left, right, top, bottom) of what is shown of each image.

    That is the whole image where its size is known, else the neighbourhood of its points; then
    both views are equally large, so that they compare.
    """
    low = np.array([p.min(axis=0) for p in points])
    high = np.array([p.max(axis=0) for p in points])
    known = [
        photo.shape[1::-1] if photo is not None else size
        for size, photo in zip(sizes, photos, strict=True)
    ]
    for view, size in enumerate(known):
        if size is not None:
            low[view] = np.minimum(low[view], -0.5)
            high[view] = np.maximum(high[view], np.array(size) - 0.5)
    extent = np.max(high - low, axis=0)
    extent += 0.12 * max(float(extent.max()), 1e-6) * (None in known)
    for view, size in enumerate(known):
        if size is None:
            middle = (low[view] + high[view]) / 2
            low[view], high[view] = middle - extent / 2, middle + extent / 2
    return [(a[0], b[0], a[1], b[1]) for a, b in zip(low.tolist(), high.tolist(), strict=True)]


def _null_vector(matrix: Array) -> Array:
    """Return the unit vector that a (3, 3) matrix of rank 2 maps to zero."""
    return np.asarray(np.linalg.svd(matrix)[2][2])


def _homogeneous(x: Array) -> Array:
    return np.column_stack([x, np.ones(len(x))])
