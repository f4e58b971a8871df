"""Report on two photographs: the picture, an epipolar geometry to explore, and the numbers."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.images.loading import Image
from epigauge.images.matching import ImageMatches
from epigauge.images.summary import explained, summary
from epigauge.io import plain
from epigauge.io._common import PathLike, check_suffix
from epigauge.plots._style import draw_history, new_figure
from epigauge.plots.pair import colours_of, photographs, plot_pair
from epigauge.plots.pair_view import reduced
from epigauge.plots.two_views import _draw_distances
from epigauge.reports._page import save_page
from epigauge.two_view.geometry import reprojection_distances
from epigauge.two_view.robust import RobustResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["save_pair_report"]

_MAX_PIXELS = 1200  # along the longer side of an embedded photograph
_DPI = 130


def save_pair_report(
    path: PathLike,
    result: RobustResult,
    matches: ImageMatches,
    images: Sequence[PathLike | ArrayLike],
    *,
    seconds: tuple[float, float] | None = None,
) -> None:
    """Write a report on two photographs as one HTML file.

    It holds the picture of `plot_pair`, the photographs with their inliers, where the epipolar
    line of the point under the pointer is drawn with the band of its uncertainty, all numbers, and
    what each warning means. Images are embedded; nothing is loaded from anywhere else.

    Parameters
    ----------
    path : str or path
        The file: ``.html``.
    result : RobustResult
        What `estimate_fundamental` returned for these matches.
    matches : ImageMatches
        What `match_images` returned for these images.
    images : pair of path or array_like
        The photographs, as for `match_images`.
    seconds : (float, float), optional
        Time that matching and estimation took, to be shown with the numbers.

    Raises
    ------
    ArgumentError
        If the suffix is another, or images, matches and result do not belong together.
    FileFormatError, OSError
        If an image cannot be read, or the file not be written.
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> import epigauge as eg
    >>> matches = eg.match_images("A.jpg", "B.jpg")  # doctest: +SKIP
    >>> result = eg.estimate_fundamental(matches.x1, matches.x2)  # doctest: +SKIP
    >>> images = "A.jpg", "B.jpg"
    >>> eg.reports.save_pair_report("pair.html", result, matches, images)  # doctest: +SKIP
    """
    check_suffix(path, ".html")
    photos = photographs(matches, images)
    picture = plot_pair(result, matches, photos, numbers=False)
    inliers = int(np.count_nonzero(result.inlier))
    F_std = np.sqrt(np.diag(result.covariance)).reshape(3, 3)
    numbers = summary(result, matches, seconds) | {"status": result.message}
    parts = {
        "title": html.escape(matches.name),
        "lead": f"{inliers} of {len(matches)} matches agree on one epipolar geometry, "
        f"with an RMS of {result.rms_px:.3g} px per coordinate.",
        "warnings": _warnings(explained(result)),
        "picture": _png(picture),
        "photo1": _photo(photos[0]),
        "photo2": _photo(photos[1]),
        "curves": _png(_curves(result, matches)),
        "numbers": _rows(numbers),
        "F": _matrix(result.F, "{: .8e}"),
        "F_std": _matrix(F_std, "{:.1e}"),
    }
    save_page(path, "pair", parts, _data(result, matches))


def _warnings(found: Mapping[str, str]) -> str:
    """Return a box for each warning."""
    if not found:
        return '<p class="fine">No warnings.</p>'
    return "\n".join(
        f'<p class="warning"><b>{html.escape(flag)}</b> {html.escape(sentence)}</p>'
        for flag, sentence in found.items()
    )


def _rows(values: Mapping[str, str]) -> str:
    return "\n".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"
        for name, value in values.items()
    )


def _matrix(matrix: NDArray[np.float64], form: str) -> str:
    return "\n".join(
        "<tr>" + "".join(f"<td>{form.format(value)}</td>" for value in row) + "</tr>"
        for row in matrix
    )


def _curves(result: RobustResult, matches: ImageMatches) -> Figure:
    """Draw the distances of the inliers, and the convergence."""
    figure = new_figure(11.5, 3.2)
    left, right = figure.subplots(1, 2)
    used = result.used
    _draw_distances(left, reprojection_distances(result.F, matches.x1[used], matches.x2[used])[0])
    draw_history(right, result.history)
    return figure


def _data(result: RobustResult, matches: ImageMatches) -> dict[str, Any]:
    """Return what the script needs: F, its covariance, and the inliers with their colours."""
    from matplotlib.colors import to_hex

    x1, x2 = matches.x1[result.used], matches.x2[result.used]
    d = reprojection_distances(result.F, x1, x2)[0]
    cmap, norm = colours_of(d)
    return {
        "F": result.F.tolist(),
        "covariance": plain(result.covariance) if np.isfinite(result.covariance).all() else None,
        "sizes": [matches.image_size1, matches.image_size2],
        "rows": result.used.tolist(),
        "x": [np.round(x, 3).tolist() for x in (x1, x2)],
        "distance": np.round(d, 4).tolist(),
        "colour": [to_hex(colour) for colour in cmap(norm(np.abs(d)))],
    }


def _png(figure: Figure) -> str:
    """Return a picture as a data URL."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _photo(photo: Image) -> str:
    """Return the SVG image element of a photograph, in pixel coordinates of the whole one."""
    from matplotlib.image import imsave

    small, (width, height) = reduced(photo, _MAX_PIXELS)
    buffer = io.BytesIO()
    colour = small if small.ndim == 3 else np.dstack([small] * 3)
    imsave(buffer, colour, format="jpeg", pil_kwargs={"quality": 85})
    url = "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
    return f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="{url}"/>'
