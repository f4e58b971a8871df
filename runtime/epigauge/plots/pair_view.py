"""One photograph of a pair: its points, epipolar lines and epipole."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.images.loading import Image
from epigauge.plots._style import GREY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Box", "draw_epipole", "draw_line", "draw_photo", "reduced", "ring"]

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]  # left, right, top, bottom

LINE_COLOUR = "#d1495b"
_MAX_PIXELS = 1600  # shown along the longer side of an image
_MARGIN = 0.025  # from a number to the border, of the longer side

_DEVIATIONS = 2.0  # of the ellipse
_VISIBLE = 0.05  # its longer half axis at least, of the image's shorter side
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def reduced(photo: Image, longest: int) -> tuple[Image, tuple[int, int]]:
    """Make a photograph smaller by a whole number, for a screen.

    Parameters
    ----------
    photo : ndarray, shape (height, width) or (height, width, 3), uint8
        The photograph.
    longest : int
        Pixels of the longer side, at most.

    Returns
    -------
    smaller : ndarray, uint8
        Means of squares of pixels; fewer than a square at the right and bottom are cut off.
    size : (int, int)
        (width, height) of what it shows, in pixels of the original.
    """
    height, width = photo.shape[:2]
    step = min(-(-max(height, width) // longest), height, width)
    bottom, right = height // step * step, width // step * step
    # Sums run along the memory: rows first, then columns of what is left.
    shape = (bottom // step, right, *photo.shape[2:])
    rows = np.zeros(shape, dtype=np.min_scalar_type(255 * step))
    for k in range(step):
        rows += photo[k:bottom:step, :right]
    total = rows[:, ::step].astype(np.uint32)
    for k in range(1, step):
        total += rows[:, k::step]
    return (total // step**2).astype(np.uint8), (right, bottom)


def draw_photo(axes: Axes, photo: Image) -> None:
    """Draw a photograph in light grey, so that colours stand out."""
    height, width = photo.shape[:2]
    small, (right, bottom) = reduced(photo, _MAX_PIXELS)
    grey = small if small.ndim == 2 else small.mean(axis=2)
    extent = (-0.5, right - 0.5, bottom - 0.5, -0.5)
    axes.imshow(grey, cmap="gray", vmin=-140.0, vmax=255.0, extent=extent)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.tick_params(labelsize=8, color=GREY)
    axes.locator_params(nbins=5)
    for spine in axes.spines.values():
        spine.set_color("0.75")


def ring(axes: Axes, x: Array) -> None:
    """Mark a point that an epipolar line belongs to."""
    axes.plot(*x, "o", ms=9.0, mfc="none", mec=LINE_COLOUR, mew=1.4, zorder=5)


def draw_line(axes: Axes, line: Array, number: int, epipole: Array, box: Box) -> None:
    """Draw an epipolar line, with its number where the pencil is wide, or above or left."""
    ends, inner = _clip(line, box), _clip(line, _shrunk(box))
    if ends is None:
        return
    axes.plot(*ends.T, color=LINE_COLOUR, lw=0.9, alpha=0.85, zorder=3, solid_capstyle="butt")
    if inner is None:  # across a corner: no room for a number
        return
    away = np.linalg.norm(epipole[2] * inner - epipole[:2], axis=1)
    upper = int(inner[1].sum() < inner[0].sum())
    x, y = inner[upper if away.max() < 1.5 * away.min() else int(away[1] > away[0])]
    patch = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": LINE_COLOUR, "lw": 0.8}
    style: dict[str, Any] = {"fontsize": 7, "color": LINE_COLOUR, "bbox": patch, "zorder": 6}
    axes.text(x, y, str(number), ha="center", va="center", **style)


def draw_epipole(axes: Axes, e: Array, covariance: Array, box: Box) -> None:
    """Mark an epipole, with the ellipse of its covariance at a size that can be seen.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Where to draw.
    e : ndarray, shape (2,)
        The epipole in pixels.
    covariance : ndarray, shape (2, 2)
        Its covariance; no ellipse is drawn where that is infinite.
    box : (float, float, float, float)
        Borders of the image.
    """
    from matplotlib.patches import Ellipse

    for colour, size, width in (("white", 11.0, 3.6), ("black", 9.0, 1.6)):
        axes.plot(*e, "+", ms=size, mew=width, color=colour, zorder=8)
    text, reach = "epipole", 0.0
    shorter = min(box[1] - box[0], box[3] - box[2])
    if np.isfinite(covariance).all():
        variances, directions = np.linalg.eigh(covariance)
        half = _DEVIATIONS * np.sqrt(np.maximum(variances, 0.0))
        seen = (times for times in _MAGNIFICATIONS if times * half[1] >= _VISIBLE * shorter)
        times = next(seen, _MAGNIFICATIONS[-1])
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        for colour, width in (("white", 3.2), ("black", 1.5)):
            style: dict[str, Any] = {"fc": "none", "ec": colour, "lw": width, "zorder": 7}
            axes.add_patch(Ellipse((e[0], e[1]), *(2 * times * half[::-1]), angle=angle, **style))
        reach = float(times * np.hypot(*(half * directions[1])))
        text += f", {_DEVIATIONS:g}\N{GREEK SMALL LETTER SIGMA}"
        text += f" \N{MULTIPLICATION SIGN} {times}" if times > 1 else ""
    down = e[1] + reach + 0.1 * shorter < box[3]
    style = {"fontsize": 8, "zorder": 9, "ha": "center", "va": "top" if down else "bottom"}
    style["bbox"] = {"boxstyle": "round,pad=0.25", "fc": "white", "ec": "none", "alpha": 0.85}
    place = (e[0], min(e[1] + reach, box[3]) if down else max(e[1] - reach, box[2]))
    offset = (0.0, -6.0 if down else 6.0)
    axes.annotate(text, place, xytext=offset, textcoords="offset points", **style)


def _shrunk(box: Box) -> Box:
    margin = _MARGIN * max(box[1] - box[0], box[3] - box[2])
    return (box[0] + margin, box[1] - margin, box[2] + margin, box[3] - margin)


def _clip(line: Array, box: Box) -> Array | None:
    """Return the ends (2, 2) of the part of a line a x + b y + c = 0 inside a box, or None."""
    a, b, c = line.tolist()
    left, right, top, bottom = box
    ends = [(x, -(a * x + c) / b) for x in (left, right) if b != 0.0]
    ends += [(-(b * y + c) / a, y) for y in (top, bottom) if a != 0.0]
    slack = 1e-9 * (right - left + bottom - top)
    inside = np.array(
        [
            (x, y)
            for x, y in ends
            if left - slack <= x <= right + slack and top - slack <= y <= bottom + slack
        ]
    )
    if len(inside) < 2:
        return None
    far = np.argmax(np.linalg.norm(inside - inside[0], axis=1))
    return np.array([inside[0], inside[far]])
