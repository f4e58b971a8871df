"""COLMAP models of pinhole cameras near projective ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from epigauge.errors import ArgumentError
from epigauge.io._colmap_folder import write_folder
from epigauge.io._colmap_parts import CameraRow, ColmapModel, ImageRow, PointTable
from epigauge.io._colmap_rigs import rigs_and_frames
from epigauge.io._colmap_scene import GREY, places
from epigauge.io._common import PathLike
from epigauge.multi_view.tracks import Tracks
from epigauge.rotations import quaternion

if TYPE_CHECKING:
    from epigauge.multi_view.pinhole import PinholeModel

__all__ = ["save_colmap_model"]


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
        Where to; made if absent. The files of a text model in it are replaced, all or none of them
        unless the machine stops between the last steps.
    model : PinholeModel
        What `pinhole_model` returned for these tracks.
    tracks : Tracks
        Observations.
    names : sequence of str, optional
        Names of the images; by default ``view0000`` and so on.

    Raises
    ------
    ArgumentError
        If the names are not one a view, all different, without white space; if the directory holds
        a binary model.
    OSError
        If the files cannot be written.

    Examples
    --------
    >>> import epigauge as eg
    >>> from epigauge.multi_view.pinhole import pinhole_model
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> model = pinhole_model(eg.bundle_adjust(tracks).reconstruction, tracks)
    >>> eg.io.save_colmap_model("sparse/0", model, tracks)  # doctest: +SKIP
    """
    if names is None:
        names = [f"view{k:04d}" for k in range(tracks.n_views)]
    if len(set(names)) != tracks.n_views or any(name.split() != [name] for name in names):
        raise ArgumentError(
            "names", f"are {names!r:.60}", f"{tracks.n_views} different ones without white space"
        )
    head = (
        "Written by epigauge from a projective reconstruction, in a basis that makes its cameras",
        "plausible: no calibration, and no unit of length. Leaving out their skew has raised the",
        f"RMS residual coordinate from {model.projective_rms_px:.6g} to {model.rms_px:.6g} px.",
    )
    content = rigs_and_frames(_model(model, tracks, names), None)
    write_folder(Path(directory), content, True, head)


def _model(model: PinholeModel, tracks: Tracks, names: Sequence[str]) -> ColmapModel:
    # Pixels counted from the middle of the image become those of an image that holds them.
    shift = -np.minimum(np.floor(model.xy.min(axis=0)), 0.0)
    xy = model.xy + shift
    width, height = np.maximum(np.ceil(xy.max(axis=0)), 1.0).astype(int).tolist()
    kept = np.flatnonzero(model.ahead[tracks.point])
    view, point = tracks.view[kept], tracks.point[kept]
    cameras, images = [], []
    for k, name in enumerate(names):
        fx, fy, cx, cy = (model.intrinsics[k] + [0.0, 0.0, *shift]).tolist()
        cameras.append(CameraRow(k + 1, "PINHOLE", width, height, (fx, fy, cx, cy)))
        pose = quaternion(model.R[k]).tolist(), model.t[k].tolist()
        own = view == k
        images.append(ImageRow(k + 1, *pose, k + 1, name, xy[kept[own]], point[own] + 1))
    # The tracks, and so the rows kept, are sorted by point.
    ahead = np.flatnonzero(model.ahead)
    first = np.searchsorted(point, [*ahead, tracks.n_points])
    distances = np.linalg.norm(model.residuals[kept], axis=1)
    table = PointTable(
        ahead + 1,
        model.points[ahead],
        np.full((len(ahead), 3), GREY, np.uint8),
        np.add.reduceat(distances, first[:-1]) / np.diff(first),
        first,
        np.column_stack([view + 1, places(view, tracks.n_views)]),
    )
    return ColmapModel(cameras, images, table)
