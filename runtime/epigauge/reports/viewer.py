"""Points and cameras of a reconstruction to turn about in a browser, as one HTML file."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.cameras import MetricReconstruction
from epigauge.io import plain
from epigauge.io._common import PathLike, check_suffix
from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.display import Display, camera_spacing, display, is_sequence
from epigauge.multi_view.tracks import Tracks
from epigauge.reports._page import save_page
from epigauge.uncertainty.covariance import MetricCovariance

__all__ = ["save_viewer"]

Array = NDArray[np.float64]

_PYRAMID = (0.06, 0.4)  # length of a camera, in usual distances of a point from the middle
_ELLIPSOID = 0.03  # half-axis of a usual ellipsoid, in usual distances of a point from the middle
_DOT = (2.0, 5.5)  # diameter of a point, in pixels of the screen
_STRAY = 0.005  # share of the points left out at either end when the view is fitted
# As many are left out where what remains is so much smaller: a background seen past the scene.
_BACKGROUND, _SMALLER = 0.1, 0.4
_FITTED = 500  # points that the view is fitted to


def save_viewer(
    path: PathLike,
    result: BundleResult,
    tracks: Tracks,
    title: str = "",
    *,
    frame: Display | None = None,
    view_numbers: ArrayLike | None = None,
    point_numbers: ArrayLike | None = None,
    notes: Sequence[str] = (),
    covariance: MetricCovariance | None = None,
    pictures: Sequence[bytes] = (),
    pieces: ArrayLike | None = None,
) -> None:
    """Write points and cameras as a page to look at them from all sides.

    Projective ones are shown in a basis in which they look plausible (see `multi_view.display`):
    that is no calibration, and nothing can be measured in it. Points are coloured by their RMS
    residual, by the number of views or by height, cameras are pyramids, and whatever is under the
    pointer tells its numbers. The page needs no network and no other file.

    Parameters
    ----------
    path : str or path
        The file: ``.html``.
    result : BundleResult
        What `epigauge.bundle_adjust` returned for these tracks.
    tracks : Tracks
        Observations.
    title : str
        What to call them.
    frame : Display, optional
        Where to show them; by default ``display(result.reconstruction, tracks)``.
    view_numbers, point_numbers : array_like of int, optional
        What to call views and points, if not by their indices.
    notes : sequence of str
        Sentences to show below the title.
    covariance : MetricCovariance, optional
        Of a calibrated reconstruction: error ellipsoids of points and cameras are drawn, magnified.
    pictures : sequence of bytes
        JPEG file of each view, small ones, to be shown where the camera is; the whole image, and
        tracks that know the sizes of theirs.
    pieces : array_like, shape (L, 2, 3) or (L, 2, 4), optional
        Ends of pieces of lines in the scene, to be drawn, too: `LineTracks.pieces`.

    Raises
    ------
    ArgumentError
        If the suffix is another one.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> save_viewer("scene.html", result, tracks)  # doctest: +SKIP
    """
    check_suffix(path, ".html")
    shown = display(result.reconstruction, tracks) if frame is None else frame
    views = np.arange(tracks.n_views) if view_numbers is None else np.asarray(view_numbers)
    points = np.arange(tracks.n_points) if point_numbers is None else np.asarray(point_numbers)
    lead = (
        f"{tracks.n_views} views, {tracks.n_points} points, {len(tracks)} observations, "
        f"RMS {result.rms_px:.4g} px"
    )
    if result.loss_scale_px:
        lead += f" (robust loss of scale {result.loss_scale_px:.2g} px)"
    if isinstance(result.reconstruction, MetricReconstruction):
        lead += ". Calibrated cameras: the shape is true, its size is not known."
    else:
        lead += (
            ". A basis to look at, no calibration: nothing can be measured in it. No ellipsoids "
            "are drawn, for their axes would be those of the basis. `epigauge metric` finds "
            "a metric frame, where the views allow one."
        )
    if covariance is not None:
        lead += f" Ellipsoids of one sigma, noise {covariance.noise_px:.3g} px, magnified."
    hidden = tracks.n_points - int(shown.shown.sum())
    if hidden:
        lead += f" {hidden} points far away or behind a camera are not shown."
    lead += "".join(f"<br>{html.escape(note)}" for note in notes)
    parts = {
        "title": html.escape(title or "Reconstruction"),
        "lead": lead,
        "warning": _warning(result, shown),
    }
    data = _data(shown, tracks, result.fun, views, points)
    kept = np.asarray(data.pop("kept"))
    data["pictures"] = [base64.b64encode(picture).decode("ascii") for picture in pictures]
    ends = np.zeros((0, 2, 3)) if pieces is None else shown.placed_pieces(np.asarray(pieces))
    data["lines"] = [_rounded(row, 4) for row in ends.reshape(-1, 6)]
    data["spread"] = None if covariance is None else _spread(shown, covariance, kept)
    save_page(path, "viewer", parts, data)


def _warning(result: BundleResult, shown: Display) -> str:
    said = []
    if not result.success:
        said.append(f"Not converged: {html.escape(result.message)}.")
    if shown.distorted:
        said.append(
            "In no basis do all cameras look usual: the picture is distorted. Gross errors in the "
            "tracks bend a reconstruction; a robust loss may help."
        )
    return f'<p class="warning">{" ".join(said)}</p>' if said else ""


def _data(
    shown: Display,
    tracks: Tracks,
    residuals: Array,
    view_numbers: NDArray[Any],
    point_numbers: NDArray[Any],
) -> dict[str, Any]:
    """Return what the script needs, numbers rounded to what a screen shows."""
    squared = np.sum(residuals**2, axis=1)
    rms = _rms(tracks.point, squared, tracks.n_points)
    kept = shown.shown & np.isfinite(rms)
    X = shown.points[kept]
    counts = np.bincount(tracks.point, minlength=tracks.n_points)[kept]
    names = tracks.names or [""] * tracks.n_views
    near = _without_strays(X)
    around = np.vstack([shown.centres, near[:: -(-max(len(near), 1) // _FITTED)]])
    low, high = around.min(axis=0), around.max(axis=0)
    spacing = camera_spacing(shown.centres)
    return {
        "kept": kept,
        "points": _rounded(X.ravel(), 4),
        "number": point_numbers[kept].tolist(),
        "rms": _rounded(rms[kept], 4),
        "views": counts.tolist(),
        "colours": None if tracks.colours is None else _hex(tracks.colours[kept]),
        # The tracks are sorted by point: the views of point k are seen[first[k]:first[k + 1]].
        "seen": tracks.view[kept[tracks.point]].tolist(),
        "first": [0, *np.cumsum(counts).tolist()],
        "cameras": [
            {
                "number": int(number),
                "name": html.escape(name),
                "centre": _rounded(centre, 4),
                "corners": [_rounded(corner, 4) for corner in corners],
                "points": int(points),
                "rms": plain(np.round(of_view, 4)),
            }
            for number, name, centre, corners, points, of_view in zip(
                view_numbers,
                names,
                shown.centres,
                shown.corners,
                np.bincount(tracks.view, minlength=tracks.n_views),
                _rms(tracks.view, squared, tracks.n_views),
                strict=True,
            )
        ],
        "pyramid": float(np.clip(spacing, *_PYRAMID)),
        "sequence": is_sequence(shown.centres),
        "dot": float(np.clip(150.0 / np.sqrt(max(len(X), 1)), *_DOT)),
        "middle": _rounded((low + high) / 2.0, 4),
        "bounds": [_rounded(point, 3) for point in around],
        "grid": [np.floor(low[:2]).tolist(), np.ceil(high[:2]).tolist(), float(low[2])],
    }


def _spread(
    shown: Display, covariance: MetricCovariance, kept: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return covariances where they are shown, as six numbers each, and how much to magnify them.

    Of the unit of the scene `unit` are one of the picture.
    """
    linear = np.linalg.inv(shown.T[:3, :3])
    unit = float(np.cbrt(abs(np.linalg.det(shown.T[:3, :3]))))
    points, centres = (
        linear @ blocks @ linear.T
        for blocks in (covariance.point_blocks[kept], covariance.centre_blocks)
    )
    far = np.asarray(~np.isfinite(covariance.std.points[kept]).all(axis=1))
    points = np.where(far[:, None, None], 0.0, points)
    size = np.sqrt(np.einsum("mii->m", points) / 3.0)
    usual = float(np.median(size[size > 0.0])) if (size > 0.0).any() else 0.0
    found: dict[str, Any] = {"unit": unit, "times": _ELLIPSOID / usual if usual > 0.0 else 1.0}
    for name, blocks in (("points", points), ("cameras", centres)):
        six = blocks[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        found[name] = [float(f"{value:.4g}") for value in six.ravel()]
    return found


def _without_strays(X: Array) -> Array:
    """Return points without those that are among the most outlying along an axis."""
    if not len(X):
        return X
    low, high = np.quantile(X, (_STRAY, 1.0 - _STRAY), axis=0)
    core = np.quantile(X, (_BACKGROUND, 1.0 - _BACKGROUND), axis=0)
    if np.ptp(core, axis=0).max() < _SMALLER * np.max(high - low):
        low, high = core
    return np.asarray(X[((X >= low) & (X <= high)).all(axis=1)])


def _rms(index: NDArray[np.intp], squared: Array, count: int) -> Array:
    """Return the RMS residual coordinate of each point or view."""
    total = np.bincount(index, squared, minlength=count)
    return np.asarray(np.sqrt(total / (2.0 * np.bincount(index, minlength=count))))


def _hex(colours: NDArray[np.uint8]) -> list[str]:
    """Return colours as HTML writes them."""
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours.tolist()]


def _rounded(values: Array, decimals: int) -> list[float]:
    rounded: list[float] = np.round(values, decimals).tolist()
    return rounded
