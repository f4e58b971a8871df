"""COLMAP models as scenes, and back.

Pixels stay COLMAP's: the left top corner of an image is (0, 0), the middle of its first pixel
(0.5, 0.5). Observations and principal points are both counted so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction, camera_model, check_parameters, models
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._colmap_parts import (
    NO_POINT,
    NUMBERS,
    CameraRow,
    ColmapModel,
    ImageRow,
    Place,
    PointTable,
)
from epigauge.io._colmap_rigs import image_poses, rigs_and_frames
from epigauge.io._scene import ColmapSource, RawScene, SceneSource
from epigauge.multi_view.tracks import Tracks
from epigauge.rotations import quaternion, rotation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Each can hold those before it that have no other parameters: found by their names.
_RICHER = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
#: What a parameter is called in a richer model.
_RENAMED = {"f": ("fx", "fy"), "k": ("k1",)}
#: Of points without a colour.
GREY = 128


def raw_scene(path: Path, model: ColmapModel) -> RawScene:
    """Put the rows of a COLMAP model into arrays.

    Parameters
    ----------
    path : Path
        Its directory for messages.
    model : ColmapModel
        As read.

    Returns
    -------
    RawScene
        Views, cameras and points in the order of the files.

    Raises
    ------
    FileFormatError
        If numbers are given twice or stand for nothing, tracks and features contradict each
        other, or the cameras are of no model that is known here.
    """
    images, points = model.images, model.points
    for noun, found in (("image", len(images)), ("3D point", len(points.ids))):
        if not found:
            raise FileFormatError(path, f"holds no {noun}")
    cameras = {camera.id: camera for camera in model.cameras}
    _check_unique(path, "camera", [camera.id for camera in model.cameras])
    _check_unique(path, "image", [image.id for image in images])
    _check_unique(path, "3D point", points.ids.tolist())
    _check_unique(path, "image name", [image.name for image in images])
    for image in images:
        if image.camera_id not in cameras:
            _place(path, image).refuse(f"camera {image.camera_id} does not exist")
    used = sorted({image.camera_id for image in images})
    name, params, notes = _one_model(path, [cameras[number] for number in used])
    spare = len(cameras) - len(used)
    if spare:
        notes.append(f"cameras without an image: {spare}, kept for COLMAP only")
    camera_of_view = np.searchsorted(used, [image.camera_id for image in images])
    view, feature, point = _sightings(path, images, points)
    q, t = image_poses(path, model)
    colmap = ColmapSource(
        np.array([image.id for image in images]),
        np.array(used),
        points.ids,
        tuple(image.xy for image in images),
        feature,
        camera_of_view,
        tuple(model.cameras),
        None if model.rigs is None else tuple(model.rigs),
        None if model.frames is None else tuple(model.frames),
    )
    sizes = np.array(
        [[cameras[image.camera_id].width, cameras[image.camera_id].height] for image in images]
    )
    return RawScene(
        view,
        point,
        np.concatenate([image.xy for image in images])[_starts(images)[view] + feature],
        rotation(q),
        t,
        points.X,
        name,
        params,
        camera_of_view,
        names=[image.name for image in images],
        sizes=sizes if (sizes > 0).all() else None,
        colours=points.colours,
        source=SceneSource(tuple(notes), q, colmap),
    )


def _place(path: Path, row: ImageRow | CameraRow) -> Place:
    return row.place or Place(path, f"number {row.id}")


def _check_unique(path: Path, noun: str, ids: Sequence[object]) -> None:
    if len(set(ids)) < len(ids):
        twice = next(number for number, count in Counter(ids).items() if count > 1)
        raise FileFormatError(path, f"holds {noun} {twice!s:.60} twice")


def _starts(images: Sequence[ImageRow]) -> Indices:
    """Return the row of each image's first feature among all features, and their number."""
    return np.cumsum([0, *(len(image.points) for image in images)])


def _sightings(
    path: Path, images: Sequence[ImageRow], points: PointTable
) -> tuple[Indices, Indices, Indices]:
    """Return view, place of the feature in it and point of all features that have one."""
    starts = _starts(images)
    owner = np.concatenate([image.points for image in images])
    view = np.repeat(np.arange(len(images)), np.diff(starts))
    for i, image in enumerate(images):
        if not np.isfinite(image.xy).all():
            k = int(np.argmax(~np.isfinite(image.xy).all(axis=1)))
            _place(path, images[i]).refuse(f"feature {k} is not finite")
    rows = np.flatnonzero(owner != NO_POINT)
    order = np.argsort(points.ids)
    at = np.minimum(np.searchsorted(points.ids, owner[rows], sorter=order), len(order) - 1)
    point = order[at]
    unknown = np.flatnonzero(points.ids[point] != owner[rows])
    if len(unknown):
        k = rows[unknown[0]]
        reason = f"feature {k - starts[view[k]]} belongs to point {owner[k]}, which does not exist"
        _place(path, images[view[k]]).refuse(reason)
    _check_tracks(path, images, points, starts, owner)
    return view[rows], rows - starts[view[rows]], point


def _check_tracks(
    path: Path, images: Sequence[ImageRow], points: PointTable, starts: Indices, owner: Indices
) -> None:
    """Check that the tracks name each feature with a point once, and no others."""
    ids = np.array([image.id for image in images])
    order = np.argsort(ids)
    at = np.minimum(np.searchsorted(ids, points.track[:, 0], sorter=order), len(ids) - 1)
    view = order[at]
    of_point = np.repeat(points.ids, np.diff(points.start))
    bad = np.flatnonzero(
        (ids[view] != points.track[:, 0]) | (points.track[:, 1] >= np.diff(starts)[view])
    )
    if not len(bad):
        feature = starts[view] + points.track[:, 1]
        bad = np.flatnonzero(owner[feature] != of_point)
        again = np.zeros(len(feature), dtype=np.bool_)
        again[np.unique(feature, return_index=True)[1]] = True
        bad = bad if len(bad) else np.flatnonzero(~again)
    if len(bad):
        image, feature_number = points.track[bad[0]].tolist()
        named = f"feature {feature_number} of image {image}"
        reason = (
            f"the track of point {of_point[bad[0]]} names {named}, "
            "which does not name this point, does not exist, or is named twice"
        )
        raise FileFormatError(path, reason)
    if len(points.track) != np.count_nonzero(owner != NO_POINT):
        lost = np.flatnonzero((owner != NO_POINT) & ~np.isin(np.arange(len(owner)), feature))[0]
        i = int(np.searchsorted(starts, lost, "right")) - 1
        reason = f"feature {lost - starts[i]} is not in the track of its point {owner[lost]}"
        _place(path, images[i]).refuse(reason)


def _one_model(path: Path, rows: Sequence[CameraRow]) -> tuple[str, Array, list[str]]:
    """Return the model that holds all cameras, and their parameters in it."""
    known = models()
    for row in rows:
        place = row.place or Place(path, f"camera {row.id}")
        if row.model not in known:
            listed = ", ".join(name for name in NUMBERS if name in known)
            place.refuse(f"cameras of the model {row.model} are not known here, only {listed}")
        try:
            check_parameters(row.model, np.array([row.params]))
        except ArgumentError as error:
            place.refuse(str(error))
    names = sorted({row.model for row in rows}, key=list(NUMBERS).index)
    if len(names) == 1:
        return names[0], np.array([row.params for row in rows]), []
    for target in _RICHER:
        if target in known and all(_embedded(name, target) is not None for name in names):
            break
    else:
        reason = f"holds cameras of the models {', '.join(names)}, which no model known here joins"
        raise FileFormatError(path, reason)
    params = np.zeros((len(rows), len(known[target].params)))
    for k, row in enumerate(rows):
        for places, value in zip(_embedded(row.model, target) or (), row.params, strict=True):
            params[k, places] = value
    return target, params, [f"cameras of the models {', '.join(names)}: all made {target}, exactly"]


def _embedded(name: str, target: str) -> list[list[int]] | None:
    """Return for each parameter of a model its places in a richer one, or None."""
    if name == target:
        return [[k] for k in range(len(camera_model(name).params))]
    if name not in _RICHER:
        return None
    there = camera_model(target).params
    places = []
    for parameter in camera_model(name).params:
        for called in ((parameter,), _RENAMED.get(parameter, ())):
            if called and all(word in there for word in called):
                places.append([there.index(word) for word in called])
                break
        else:
            return None
    return places


def model_of(tracks: Tracks, reconstruction: MetricReconstruction, rigs: str) -> ColmapModel:
    """Return a scene as a COLMAP model.

    Parameters
    ----------
    tracks : Tracks
        Observations; numbers, features and rigs of a COLMAP model that they come from are kept.
    reconstruction : MetricReconstruction
        Of the same views and points.
    rigs : str
        ``"keep"`` or ``"drop"``.

    Returns
    -------
    ColmapModel
        With rigs and frames.

    Raises
    ------
    ArgumentError
        Naming what COLMAP has no place for.
    """
    if (tracks.weights != 1.0).any():
        raise ArgumentError("tracks.weights", "are not all one", "ones: COLMAP knows no weights")
    source = tracks.source if isinstance(tracks.source, SceneSource) else SceneSource()
    known = source.colmap
    q = quaternions(reconstruction.R, source)
    cameras, camera_ids = _camera_rows(tracks, reconstruction, known)
    image_ids = np.arange(1, tracks.n_views + 1) if known is None else known.image_ids
    point_ids = np.arange(1, tracks.n_points + 1) if known is None else known.point_ids
    features, feature_of = _features(tracks, known)
    images = []
    by_view = np.split(np.argsort(tracks.view, kind="stable"), _view_ends(tracks))
    names = tracks.names or [f"view{k:04d}" for k in range(tracks.n_views)]
    for i, rows in enumerate(by_view):
        owner = np.full(len(features[i]), NO_POINT)
        owner[feature_of[rows]] = point_ids[tracks.point[rows]]
        number = int(camera_ids[reconstruction.cameras.camera_of_view[i]])
        pose = q[i].tolist(), reconstruction.t[i].tolist()
        images.append(ImageRow(int(image_ids[i]), *pose, number, names[i], features[i], owner))
    table = PointTable(
        point_ids,
        reconstruction.X,
        np.full((tracks.n_points, 3), GREY, np.uint8) if tracks.colours is None else tracks.colours,
        _mean_errors(tracks, reconstruction),
        np.searchsorted(tracks.point, np.arange(tracks.n_points + 1)),
        np.column_stack([image_ids[tracks.view], feature_of]),
    )
    model = ColmapModel(cameras, images, table)
    return rigs_and_frames(model, known if rigs == "keep" else None)


def quaternions(R: Array, source: SceneSource) -> Array:
    """Return quaternions; those of the file where the rotation is still the same."""
    q, old = quaternion(R), source.rotations
    if old is not None and old.shape == q.shape:
        same = (rotation(old) == R).all(axis=(1, 2))
        q[same] = old[same]
    return q


def _camera_rows(
    tracks: Tracks, reconstruction: MetricReconstruction, known: ColmapSource | None
) -> tuple[list[CameraRow], Indices]:
    """Return the cameras to write, and the number of each camera of the reconstruction."""
    cameras = reconstruction.cameras
    name = "PINHOLE" if cameras.model == "pinhole" else cameras.model
    if name not in NUMBERS:
        was = f"has cameras of the model {cameras.model!r}, which COLMAP does not know"
        needed = f"one of {', '.join(NUMBERS)}; NPZ keeps all"
        if cameras.model == "bal":
            needed = "eg.interop.bal_to_colmap(tracks, reconstruction, image_size), or NPZ"
        raise ArgumentError("reconstruction", was, needed)
    ids = np.arange(1, len(cameras) + 1)
    rows = []
    if known is not None and np.array_equal(known.camera_of_view, cameras.camera_of_view):
        ids = known.camera_ids
        rows = [row for row in known.cameras if row.id not in set(ids.tolist())]
    for k, params in enumerate(cameras.params.tolist()):
        width, height = _size(tracks, cameras.camera_of_view == k, k)
        rows.append(CameraRow(int(ids[k]), name, width, height, tuple(params)))
    return sorted(rows, key=lambda row: row.id), ids


def _size(tracks: Tracks, views: NDArray[np.bool_], camera: int) -> tuple[int, int]:
    """Return width and height of a camera's images; if not known, what just holds their points."""
    if tracks.sizes is None:
        far = tracks.xy[views[tracks.view]].max(axis=0)
        width, height = np.clip(np.ceil(far), 1, 2**31 - 1).astype(int).tolist()
        return width, height
    sizes = np.unique(tracks.sizes[views], axis=0)
    if len(sizes) > 1:
        was = f"has images of {len(sizes)} sizes by camera {camera}"
        raise ArgumentError("tracks.sizes", was, "one size a camera, as in COLMAP")
    width, height = sizes[0].tolist()
    return width, height


def _view_ends(tracks: Tracks) -> Indices:
    return np.cumsum(np.bincount(tracks.view, minlength=tracks.n_views))[:-1]


def _features(tracks: Tracks, known: ColmapSource | None) -> tuple[list[Array], Indices]:
    """Return the features of each view, and for each observation its place among them."""
    if known is not None:
        return list(known.features), known.feature_of
    order = np.argsort(tracks.view, kind="stable")
    return np.split(tracks.xy[order], _view_ends(tracks)), places(tracks.view, tracks.n_views)


def places(view: NDArray[np.intp], n_views: int) -> Indices:
    """Return for each observation its place among those of the same view."""
    order = np.argsort(view, kind="stable")
    starts = np.searchsorted(view[order], np.arange(n_views))
    place = np.empty(len(view), np.int64)
    place[order] = np.arange(len(view)) - starts[view[order]]
    return place


def _mean_errors(tracks: Tracks, reconstruction: MetricReconstruction) -> Array:
    """Return the mean distance of each point's projections to its observations; -1 if infinite."""
    with np.errstate(all="ignore"):
        away = np.linalg.norm(tracks.xy - reconstruction.project(tracks), axis=1)
        sums = np.bincount(tracks.point, away, tracks.n_points)
        means = sums / np.bincount(tracks.point, minlength=tracks.n_points)
    return np.where(np.isfinite(means), means, -1.0)
