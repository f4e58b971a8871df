"""Rigs and frames of COLMAP models: poses of images by them, and them by poses of images.

x_sensor = sensor_from_rig (rig_from_world X); the first sensor of a rig is its origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._colmap_parts import CAMERA, ColmapModel, FrameRow, ImageRow, Place, RigRow
from epigauge.io._scene import ColmapSource
from epigauge.rotations import product, quaternion, rotation

Array = NDArray[np.float64]
Pose = tuple[Array, Array]

#: How far views may be from the poses of their rig: entries of R, and t relative to its size.
_RIGID = 1e-9


def image_poses(path: Path, model: ColmapModel) -> Pose:
    """Return quaternions (n, 4) and translations (n, 3) of all images.

    Parameters
    ----------
    path : Path
        The directory for messages.
    model : ColmapModel
        Where there are frames, they have the poses.

    Returns
    -------
    q, t : ndarray
        Of x_cam = R(q) X + t.

    Raises
    ------
    FileFormatError
        If frames, rigs, images and cameras do not fit together.
    """
    q = np.array([image.q for image in model.images])
    t = np.array([image.t for image in model.images])
    if model.rigs is None or model.frames is None:
        return q, t
    rigs = {rig.id: rig for rig in model.rigs}
    for noun, ids in (
        ("rig", [rig.id for rig in model.rigs]),
        ("frame", [f.id for f in model.frames]),
    ):
        if len(set(ids)) < len(ids):
            raise FileFormatError(path, f"holds a {noun} of the same number twice")
    view_of = {image.id: i for i, image in enumerate(model.images)}
    done: set[int] = set()
    for frame in model.frames:
        place = frame.place or Place(path, f"frame {frame.id}")
        if frame.rig_id not in rigs:
            place.refuse(f"rig {frame.rig_id} does not exist")
        for kind, sensor, number in frame.data:
            if kind != CAMERA or number not in view_of:
                continue  # of another sensor, or an image that was not registered
            i = view_of[number]
            if i in done:
                place.refuse(f"image {number} is in two frames")
            done.add(i)
            if model.images[i].camera_id != sensor:
                place.refuse(f"image {number} is not of camera {sensor}")
            pose = _sensor_pose(place, rigs[frame.rig_id], sensor)
            q[i], t[i] = _composed(pose, _split(frame.pose))
    if len(done) < len(view_of):
        number = next(image.id for i, image in enumerate(model.images) if i not in done)
        raise FileFormatError(path, f"holds image {number} in no frame")
    return q, t


def _split(pose: Sequence[float]) -> Pose:
    return np.array(pose[:4]), np.array(pose[4:])


def _sensor_pose(place: Place, rig: RigRow, sensor: int) -> Pose | None:
    """Return the pose of a camera in its rig; None for the one at its origin."""
    poses = {number: pose for kind, number, pose in rig.sensors if kind == CAMERA}
    if sensor not in poses:
        place.refuse(f"camera {sensor} is not in rig {rig.id}")
    pose = poses[sensor]
    if pose is None and rig.sensors[0][:2] != (CAMERA, sensor):
        place.refuse(f"camera {sensor} has no pose in rig {rig.id}")
    return None if pose is None else _split(pose)


def _composed(outer: Pose | None, inner: Pose) -> Pose:
    """Return what does first the inner, then the outer motion."""
    if outer is None:
        return inner
    return product(outer[0], inner[0]), rotation(outer[0]) @ inner[1] + outer[1]


def rigs_and_frames(model: ColmapModel, known: ColmapSource | None) -> ColmapModel:
    """Return a model with rigs and frames: those it came with, or one a camera and one an image.

    Parameters
    ----------
    model : ColmapModel
        Without.
    known : ColmapSource, optional
        Where it came from.

    Returns
    -------
    ColmapModel
        With both.

    Raises
    ------
    ArgumentError
        If the images of a frame do not keep the poses of its rig any more.
    """
    if known is None or known.rigs is None or known.frames is None:
        return replace(
            model,
            rigs=[RigRow(c.id, ((CAMERA, c.id, None),)) for c in model.cameras],
            frames=[
                FrameRow(i.id, i.camera_id, (*i.q, *i.t), ((CAMERA, i.camera_id, i.id),))
                for i in model.images
            ],
        )
    images = {image.id: image for image in model.images}
    rigs = {rig.id: rig for rig in known.rigs}
    frames = []
    for frame in known.frames:
        data = tuple(row for row in frame.data if row[0] != CAMERA or row[2] in images)
        there = [images[row[2]] for row in data if row[0] == CAMERA]
        if there:
            frames.append(replace(_moved(frame, rigs[frame.rig_id], there), data=data))
    return replace(model, rigs=list(known.rigs), frames=frames)


def _moved(frame: FrameRow, rig: RigRow, images: Sequence[ImageRow]) -> FrameRow:
    """Return a frame with the pose that its images have now."""
    place = Place(Path(), f"frame {frame.id}")
    sensors = [_sensor_pose(place, rig, image.camera_id) for image in images]
    pose = _split(frame.pose)
    if not _fits(pose, sensors, images, exactly=True):
        first = next((k for k, sensor in enumerate(sensors) if sensor is None), 0)
        pose = np.array(images[first].q), np.array(images[first].t)
        outer = sensors[first]
        if outer is not None:  # the one at the origin took no picture here
            back = rotation(outer[0]).T
            pose = quaternion(back @ rotation(pose[0])), back @ (pose[1] - outer[1])
    if not _fits(pose, sensors, images):
        named = ", ".join(str(image.id) for image in images)
        raise ArgumentError(
            "reconstruction",
            f"has images {named} of frame {frame.id} away from the poses of their rig {rig.id}",
            "rigs='drop' to give every image a frame of its own",
        )
    return replace(frame, pose=(*pose[0].tolist(), *pose[1].tolist()))


def _fits(
    pose: Pose, sensors: Sequence[Pose | None], images: Sequence[ImageRow], exactly: bool = False
) -> bool:
    """Tell whether a frame's pose gives its images theirs."""
    for sensor, image in zip(sensors, images, strict=True):
        q, t = _composed(sensor, pose)
        turned = np.abs(rotation(q) - rotation(np.array(image.q))).max()
        moved = np.abs(t - image.t).max()
        limit = 0.0 if exactly else _RIGID
        if turned > limit or moved > limit * (1.0 + np.abs(t).max()):
            return False
    return True
