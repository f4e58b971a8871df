"""What the readers of scenes share: from the content of a file to tracks and a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import (
    AffineReconstruction,
    AnyReconstruction,
    Cameras,
    MetricReconstruction,
)
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._track_reading import restore_measurement
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

if TYPE_CHECKING:
    from epigauge.io._colmap_parts import CameraRow, FrameRow, RigRow

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: A point needs this many views, a view this many points, to be of any use.
MIN_VIEWS, MIN_POINTS = 2, 1


@dataclass(frozen=True, eq=False)
class SceneSource:
    """What a file of a scene says beyond tracks and reconstruction: `Tracks.source`.

    Attributes
    ----------
    notes : tuple of str
        What was left out or changed in reading, a sentence each.
    rotations : ndarray, shape (n, 4) or (n, 3), optional
        The rotations as the file has them: quaternions or Rodrigues vectors.
    colmap : ColmapSource, optional
        Numbers and whatever else a COLMAP model holds.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.io.SceneSource(notes=("a view has no points",)).notes
    ('a view has no points',)
    """

    notes: tuple[str, ...] = ()
    rotations: Array | None = None
    colmap: ColmapSource | None = None


@dataclass(frozen=True, eq=False)
class ColmapSource:
    """Numbers of images, cameras, points and features in a COLMAP model; rigs; all its cameras.

    Attributes
    ----------
    image_ids, camera_ids, point_ids : ndarray of int, shape (n,), (c,), (m,)
        COLMAP's numbers.
    features : tuple of ndarray, shape (k, 2)
        All features of each view, those without a point too.
    feature_of : ndarray of int, shape (N,)
        Place among the features of its view, for each observation.
    camera_of_view : ndarray of int, shape (n,)
        Which of `camera_ids` took each view.
    cameras, rigs, frames : tuple
        As in the files, those that no view uses too; no rigs and frames before COLMAP 3.12.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> none = np.zeros(0, dtype=np.intp)
    >>> eg.io.ColmapSource(none, none, none, (), none, none).rigs is None
    True
    """

    image_ids: Indices
    camera_ids: Indices
    point_ids: Indices
    features: tuple[Array, ...]
    feature_of: Indices
    camera_of_view: Indices
    cameras: tuple[CameraRow, ...] = ()
    rigs: tuple[RigRow, ...] | None = None
    frames: tuple[FrameRow, ...] | None = None


@dataclass(frozen=True)
class RawScene:
    """Arrays of a file: an observation, view, camera or point a row; nothing left out yet.

    Cameras without rotations have P (n, 3, 4) for R, and no t and params. `measured` holds `view`,
    and how the measurements differ beside their weights.
    """

    view: Indices
    point: Indices
    xy: Array
    R: Array
    t: Array
    X: Array
    model: str
    params: Array
    camera_of_view: Indices
    weights: Array | None = None
    names: Sequence[str] | None = None
    sizes: NDArray[Any] | None = None
    colours: NDArray[Any] | None = None
    source: SceneSource = field(default_factory=SceneSource)
    measured: dict[str, Any] = field(default_factory=dict)
    lines: Array | None = None


def finished(
    path: Path, raw: RawScene, repeated: str, weak: str
) -> tuple[Tracks, AnyReconstruction]:
    """Leave out what cannot be used, and check the rest.

    Parameters
    ----------
    path : Path
        The file for messages.
    raw : RawScene
        Its content.
    repeated, weak : str
        Options of `load_scene`.

    Returns
    -------
    tracks, reconstruction
        With all numbers from 0; `tracks.source.notes` says what was left out.

    Raises
    ------
    FileFormatError
        If the content is no scene.
    """
    notes = list(raw.source.notes)
    keep = np.ones(len(raw.view), dtype=np.bool_)
    again = _again(raw.view, raw.point)
    if repeated == "refuse" and again.any():
        k = int(np.argmax(again))
        reason = (
            f"holds {again.sum()} second sightings of a point in a view, the first of point "
            f"{raw.point[k]} in view {raw.view[k]}; needed: repeated='keep' or 'first'"
        )
        raise FileFormatError(path, reason)
    if again.any():
        kept = {"keep": "kept", "first": "left out"}[repeated]
        notes.append(f"second sightings of a point in a view: {again.sum()}, {kept}")
        keep &= ~again if repeated == "first" else True
    views, points = _strong(raw, keep & ~again)
    notes += _weak(path, raw, views, points, weak)
    keep &= views[raw.view] & points[raw.point]
    if not keep.any():
        raise FileFormatError(path, "holds no point that two views see")
    kept_views = np.flatnonzero(views).tolist()
    new_view, new_point = np.cumsum(views) - 1, np.cumsum(points) - 1
    cameras, new_camera = np.unique(raw.camera_of_view[views], return_inverse=True)
    try:
        tracks = Tracks(
            new_view[raw.view[keep]],
            new_point[raw.point[keep]],
            raw.xy[keep],
            weights=None if raw.weights is None else raw.weights[keep],
            names=None
            if raw.names is None
            else [raw.names[i] for i in np.flatnonzero(views).tolist()],
            sizes=None if raw.sizes is None else raw.sizes[views],
            colours=None if raw.colours is None else raw.colours[points],
            repeated=True,
            min_points=MIN_POINTS,
        )
        restore_measurement(path, raw.measured, tracks, np.flatnonzero(keep)[tracks.order])
        reconstruction: AnyReconstruction
        if raw.model == "affine":
            reconstruction = AffineReconstruction(raw.R[views], raw.X[points])
        elif raw.model == "projective":
            reconstruction = Reconstruction(raw.R[views], raw.X[points], raw.lines)
        else:
            made = Cameras(raw.model, raw.params[cameras], new_camera)
            reconstruction = MetricReconstruction(
                raw.R[views], raw.t[views], raw.X[points], made, raw.lines
            )
    except ArgumentError as error:
        raise FileFormatError(path, str(error)) from None
    source = replace(raw.source, notes=tuple(dict.fromkeys(notes)))
    if source.rotations is not None:
        source = replace(source, rotations=source.rotations[views])
    if source.colmap is not None:
        old = source.colmap
        kept_rows = np.flatnonzero(keep)[tracks.order]
        colmap = replace(
            old,
            image_ids=old.image_ids[views],
            camera_ids=old.camera_ids[cameras],
            point_ids=old.point_ids[points],
            features=tuple(old.features[i] for i in kept_views),
            feature_of=old.feature_of[kept_rows],
            camera_of_view=new_camera,
        )
        source = replace(source, colmap=colmap)
    tracks.source = source
    return tracks, reconstruction


def _again(view: Indices, point: Indices) -> NDArray[np.bool_]:
    """Return which rows repeat the view and point of an earlier one."""
    order = np.lexsort((view, point))  # stable: the first in the file comes first
    again = np.zeros(len(view), dtype=np.bool_)
    same = (np.diff(view[order]) == 0) & (np.diff(point[order]) == 0)
    again[order[1:][same]] = True
    return again


def _strong(raw: RawScene, counted: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], ...]:
    """Return which views and points have enough observations."""
    views = np.ones(len(raw.R), dtype=np.bool_)
    points = np.ones(len(raw.X), dtype=np.bool_)
    while True:
        rows = counted & views[raw.view] & points[raw.point]
        strong_views = np.bincount(raw.view[rows], minlength=len(views)) >= MIN_POINTS
        strong_points = np.bincount(raw.point[rows], minlength=len(points)) >= MIN_VIEWS
        if (strong_views == views).all() and (strong_points == points).all():
            return views, points
        views, points = strong_views, strong_points


def _weak(
    path: Path,
    raw: RawScene,
    views: NDArray[np.bool_],
    points: NDArray[np.bool_],
    weak: str,
) -> list[str]:
    """Say what is left out, or refuse it."""
    notes = []
    seen = np.bincount(raw.point, minlength=len(points)) > 0
    for noun, left in (
        ("views without a point that another view sees", ~views),
        ("points that no view sees", ~points & ~seen),
        ("points that one view sees", ~points & seen),
    ):
        if left.any():
            first = int(np.argmax(left))
            notes.append(f"{noun}: {left.sum()}, left out, the first is number {first} of the file")
    if notes and weak == "refuse":
        raise FileFormatError(path, f"holds {'; '.join(notes)}; needed: none, or weak='drop'")
    return notes
