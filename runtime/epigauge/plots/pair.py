"""Picture of two photographs and what is known of their epipolar geometry."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.errors import ArgumentError
from epigauge.images.loading import Image, as_image
from epigauge.images.matching import ImageMatches
from epigauge.images.summary import explained, inside, summary
from epigauge.io._common import PathLike
from epigauge.plots._style import BLUE, GREY, RED, heading, new_figure
from epigauge.plots.pair_view import Box, draw_epipole, draw_line, draw_photo, ring
from epigauge.plots.two_views import _draw_distances, _homogeneous, _spread_over_pencil
from epigauge.two_view.geometry import reprojection_distances
from epigauge.two_view.robust import RobustResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure, SubFigure

__all__ = ["colours_of", "photographs", "plot_pair"]

Array = NDArray[np.float64]
Row = tuple[str, str, dict[str, Any]]

_WIDTH, _ROW = 11.5, 0.19  # inches: of the picture, and height of a row of numbers
_LINES = 8  # epipolar lines: few enough to follow each by its number
_WIDE = 2.2  # from this ratio of width to height on, images stand one below the other
_CAPTION = (
    "Points: the inliers, coloured by distance. "
    "Rings: some of them, whose epipolar lines carry the same number in both images."
)


def plot_pair(
    result: RobustResult,
    matches: ImageMatches,
    images: Sequence[PathLike | ArrayLike],
    *,
    numbers: bool = True,
    seconds: tuple[float, float] | None = None,
) -> Figure:
    """Show two photographs with inliers, epipolar lines and epipoles, and what was found.

    Above: both photographs, lightened. Each inlier that F was fitted to is a point whose colour
    is its distance to the epipolar geometry. Lines with the same number are the epipolar lines of
    one match, which is ringed. An epipole in the picture is marked with the ellipse of two
    standard deviations that `result.covariance` gives it (86 % of the probability), magnified
    where it would be too small to see, by the factor written beside it. Below: the numbers, and
    the signed distances of all inliers.

    Parameters
    ----------
    result : RobustResult
        What `estimate_fundamental` returned for these matches.
    matches : ImageMatches
        What `match_images` returned for these images.
    images : pair of path or array_like
        The photographs, as for `match_images`.
    numbers : bool
        Whether to write a heading and, below, the numbers and the histogram of distances.
    seconds : (float, float), optional
        Time that matching and estimation took, to be shown with the numbers.

    Returns
    -------
    matplotlib.figure.Figure
        The picture, not yet drawn: see `save_figure`.

    Raises
    ------
    ArgumentError
        If the images, matches and result do not belong together.
    FileFormatError, OSError
        If an image cannot be read.
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> import epigauge as eg
    >>> matches = eg.match_images("A.jpg", "B.jpg")  # doctest: +SKIP
    >>> result = eg.estimate_fundamental(matches.x1, matches.x2)  # doctest: +SKIP
    >>> eg.plots.plot_pair(result, matches, ("A.jpg", "B.jpg"))  # doctest: +SKIP
    """
    photos = photographs(matches, images)
    if result.inlier.shape != (len(matches),):
        raise ArgumentError(
            "result", f"is for {result.inlier.size} matches", f"one for these {len(matches)}"
        )
    points = matches.x1[result.used], matches.x2[result.used]
    d, *feet = reprojection_distances(result.F, *points)
    boxes = [(-0.5, p.shape[1] - 0.5, -0.5, p.shape[0] - 0.5) for p in photos]
    chosen = _spread_over_pencil(result.F, feet[0], feet[1], boxes[1], _LINES)
    if feet[0][chosen[0]].sum() > feet[0][chosen[-1]].sum():  # count from the upper left
        chosen.reverse()

    rows = _rows(result, matches, seconds) if numbers else []
    figure, above, below = _layout(photos, len(rows))
    views = _image_axes(above, photos)
    for view, axes in enumerate(views):
        axes.set_title(f"Image {view + 1}", loc="left", fontsize=11)
        draw_photo(axes, photos[view])
        lines = _homogeneous(feet[1 - view][chosen]) @ (result.F if view == 0 else result.F.T)
        _draw_geometry(axes, result, matches, view, lines, boxes[view])
        for x in points[view][chosen]:
            ring(axes, x)
        _draw_points(axes, points[view], d)
    _draw_colours(views[1], d)
    above.supxlabel(_CAPTION, x=0.01, ha="left", fontsize=8.5, color=GREY)
    if below is not None:
        text = f"{matches.name}: {np.count_nonzero(result.inlier)} of {len(matches)} matches agree"
        text += f", RMS {result.rms_px:.3g} px per coordinate"
        failure = "" if result.status > 0 else result.message
        heading(figure, text, failure, result.flags)
        left, right = below.subplots(1, 2, width_ratios=(1.25, 1.0))
        _write(left, rows)
        _draw_distances(right, d)
    return figure


def colours_of(d: Array) -> tuple[Colormap, Normalize]:
    """Return colour map and range for the distances of inliers, from zero to the largest."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    return colormaps["viridis"], Normalize(0.0, max(float(np.abs(d).max()), 1e-12))


def photographs(matches: ImageMatches, images: Sequence[PathLike | ArrayLike]) -> list[Image]:
    """Read the images, and check that the matches can be theirs."""
    if len(images) != 2:
        raise ArgumentError("images", f"has {len(images)} elements", "one for each image")
    photos = [as_image("images", image) for image in images]
    for photo, size in zip(photos, (matches.image_size1, matches.image_size2), strict=True):
        if size != photo.shape[1::-1]:
            raise ArgumentError(
                "images", f"has one of {photo.shape[1::-1]} pixels", f"the one matched, of {size}"
            )
    return photos


def _layout(
    photos: Sequence[Image], n_rows: int
) -> tuple[Figure, Figure | SubFigure, SubFigure | None]:
    """Return a figure with its parts for the images and, below, for rows of numbers if any."""
    aspects = [photo.shape[1] / photo.shape[0] for photo in photos]
    room = _WIDTH - 1.6
    heights = [room / a for a in aspects] if _stacked(photos) else [room / sum(aspects)]
    height = min(max(sum(heights), 1.6), 7.0) + 0.5 + 0.35 * len(heights)
    if n_rows == 0:
        figure = new_figure(_WIDTH, height)
        return figure, figure, None
    low = max(3.3, 0.6 + _ROW * n_rows)
    figure = new_figure(_WIDTH, height + low + 0.4)
    above, below = figure.subfigures(2, 1, height_ratios=(height, low), squeeze=False)[:, 0]
    return figure, above, below


def _stacked(photos: Sequence[Image]) -> bool:
    """Return whether the images are so wide that one has to stand below the other."""
    return all(photo.shape[1] > _WIDE * photo.shape[0] for photo in photos)


def _image_axes(figure: Figure | SubFigure, photos: Sequence[Image]) -> list[Axes]:
    """Make the axes of both images, side by side and equally high."""
    if _stacked(photos):
        return list(figure.subplots(2, 1))
    aspects = [photo.shape[1] / photo.shape[0] for photo in photos]
    return list(figure.subplots(1, 2, width_ratios=aspects))


def _draw_geometry(
    axes: Axes, result: RobustResult, matches: ImageMatches, view: int, lines: Array, box: Box
) -> None:
    """Draw the numbered epipolar lines of image 0 or 1, and its epipole if that is in it."""
    e = (result.epipole1, result.epipole2)[view]
    for number, line in enumerate(lines, 1):
        draw_line(axes, line, number, e, box)
    if inside(result, matches, view + 1):
        draw_epipole(axes, e[:2] / e[2], result.epipole_px_covariance(view + 1), box)


def _draw_points(axes: Axes, x: Array, d: Array) -> None:
    """Draw the inliers with the colours of their distances, the worst on top."""
    cmap, norm = colours_of(d)
    order = np.argsort(np.abs(d), kind="stable")
    size = 26.0 if len(d) < 300 else 14.0 if len(d) < 1500 else 6.0
    style: dict[str, Any] = {"cmap": cmap, "norm": norm, "ec": "white", "lw": 0.5, "zorder": 4}
    axes.scatter(x[order, 0], x[order, 1], size, np.abs(d[order]), **style)


def _draw_colours(axes: Axes, d: Array) -> None:
    """Draw the colour bar beside an image."""
    from matplotlib.cm import ScalarMappable

    cmap, norm = colours_of(d)
    place = axes.inset_axes((1.03, 0.0, 0.025, 1.0))
    bar = axes.figure.colorbar(ScalarMappable(norm, cmap), cax=place)
    bar.set_label("distance to the epipolar geometry (px)", fontsize=9)
    bar.ax.tick_params(labelsize=8, color=GREY)
    bar.outline.set_visible(False)


def _rows(
    result: RobustResult, matches: ImageMatches, seconds: tuple[float, float] | None
) -> list[Row]:
    """Return what to write: name, value and style of each row; F takes three."""
    plain: dict[str, Any] = {"color": "black"}
    matrix: dict[str, Any] = {"color": BLUE, "family": "monospace"}
    rows = [(name, value, plain) for name, value in summary(result, matches, seconds).items()]
    for k, row in enumerate(result.F):
        rows.append(("" if k else "F", "  ".join(f"{value: .6e}" for value in row), matrix))
    lines = [
        line
        for flag, sentence in explained(result).items()
        for line in textwrap.wrap(f"{flag}: {sentence}", 68)
    ]
    for k, line in enumerate(lines or ["none"]):
        rows.append(("" if k else "warnings", line, {"color": RED} if lines else plain))
    return rows


def _write(axes: Axes, rows: Sequence[Row]) -> None:
    """Write names and values in two columns."""
    axes.axis("off")
    axes.set_title("What was found", loc="left", fontsize=11)
    step = 1.0 / max(len(rows), 13)
    common: dict[str, Any] = {"va": "top", "fontsize": 9, "transform": axes.transAxes}
    for k, (name, value, style) in enumerate(rows):
        axes.text(0.0, 1.0 - k * step, name, color=GREY, **common)
        axes.text(0.16, 1.0 - k * step, value, **common, **style)
