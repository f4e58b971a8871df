"""COLMAP's text models: cameras.txt, images.txt and points3D.txt in a directory.

COLMAP's pixels have their origin in the left top corner of the image, y down; lengths of images
are whole numbers above 0. The format is documented at https://colmap.github.io/format.html.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.io._common import PathLike
from epigauge.io.output import writing
from epigauge.multi_view.tracks import Tracks
from epigauge.rotations import quaternion

if TYPE_CHECKING:
    from epigauge.multi_view.pinhole import PinholeModel

__all__ = ["save_colmap_model"]

Array = NDArray[np.float64]

_NAMES = ("cameras.txt", "images.txt", "points3D.txt")
_GREY = "128 128 128"


def save_colmap_model(
    directory: PathLike,
    model: PinholeModel,
    tracks: Tracks,
    *,
    names: Sequence[str] | None = None,
) -> None:
    """Write pinhole cameras and points as a text model that COLMAP reads.

    Every view gets a camera of its own, model PINHOLE. The sizes of the images are not known:
    what is written just holds their points. Where coordinates are negative (pixels counted from
    the middle of the image) all are shifted by one whole number a coordinate. Points behind a
    camera that sees them, and observations of them, are left out.

    Parameters
    ----------
    directory : str or path
        Where to; made if absent. The files in it are replaced, all three or none of them unless
        the machine stops between the last steps.
    model : PinholeModel
        What `pinhole_model` returned for these tracks.
    tracks : Tracks
        Observations.
    names : sequence of str, optional
        Names of the images; by default ``view0000`` and so on.

    Raises
    ------
    ArgumentError
        If the names are not one a view, all different, without white space.
    OSError
        If the files cannot be written.
    """
    if names is None:
        names = [f"view{k:04d}" for k in range(tracks.n_views)]
    if len(set(names)) != tracks.n_views or any(name.split() != [name] for name in names):
        raise ArgumentError(
            "names", f"are {names!r:.60}", f"{tracks.n_views} different ones without white space"
        )
    head = (
        "# Written by epigauge from a projective reconstruction, in a basis that makes its cameras",
        "# plausible: no calibration, and no unit of length. Leaving out their skew has raised the",
        f"# RMS residual coordinate from {model.projective_rms_px:.6g} to {model.rms_px:.6g} px.",
    )
    # Pixels counted from the middle of the image become those of an image that holds them.
    shift = -np.minimum(np.floor(model.xy.min(axis=0)), 0.0)
    size = np.maximum(np.ceil((model.xy + shift).max(axis=0)), 1.0).astype(int)
    kept = np.flatnonzero(model.ahead[tracks.point])
    place = _places(tracks.view[kept], tracks.n_views)
    contents = (
        _cameras(model, shift, size),
        _images(model, tracks, kept, shift, names),
        _points(model, tracks, kept, place),
    )
    target = Path(directory)
    target.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        files = [stack.enter_context(writing(target / name)) for name in _NAMES]
        for file, lines in zip(files, contents, strict=True):
            for line in (*head, *lines):
                file.write(f"{line}\n".encode())


def _cameras(model: PinholeModel, shift: Array, size: NDArray[np.int_]) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (fx, fy, cx, cy)"
    for k, (fx, fy, cx, cy) in enumerate(model.intrinsics):
        numbers = _text([fx, fy, cx + shift[0], cy + shift[1]])
        yield f"{k + 1} PINHOLE {size[0]} {size[1]} {numbers}"


def _images(
    model: PinholeModel,
    tracks: Tracks,
    kept: NDArray[np.intp],
    shift: Array,
    names: Sequence[str],
) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)"
    for k, name in enumerate(names):
        pose = _text([*quaternion(model.R[k]), *model.t[k]])
        yield f"{k + 1} {pose} {k + 1} {name}"
        rows = kept[tracks.view[kept] == k]
        yield " ".join(
            f"{_text(xy)} {point + 1}"
            for xy, point in zip(model.xy[rows] + shift, tracks.point[rows].tolist(), strict=True)
        )


def _points(
    model: PinholeModel, tracks: Tracks, kept: NDArray[np.intp], place: NDArray[np.intp]
) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    distances = np.linalg.norm(model.residuals[kept], axis=1)
    # The tracks, and so the kept rows, are sorted by point.
    first = np.searchsorted(tracks.point[kept], np.arange(tracks.n_points + 1))
    for j in np.flatnonzero(model.ahead).tolist():
        rows = slice(first[j], first[j + 1])
        track = " ".join(
            f"{view + 1} {index}"
            for view, index in zip(
                tracks.view[kept[rows]].tolist(), place[rows].tolist(), strict=True
            )
        )
        error = float(distances[rows].mean())
        yield f"{j + 1} {_text(model.points[j])} {_GREY} {error:.6g} {track}"


def _places(view: NDArray[np.intp], n_views: int) -> NDArray[np.intp]:
    """Return for each row its place among those of the same view."""
    order = np.argsort(view, kind="stable")
    starts = np.searchsorted(view[order], np.arange(n_views))
    places = np.empty(len(view), dtype=np.intp)
    places[order] = np.arange(len(view)) - starts[view[order]]
    return places


def _text(values: Sequence[float] | Array) -> str:
    return " ".join(f"{float(value):.17g}" for value in values)
