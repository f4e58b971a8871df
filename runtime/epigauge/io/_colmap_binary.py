"""COLMAP's binary models: cameras.bin, images.bin, points3D.bin, rigs.bin, frames.bin.

Little endian, a count first, then the records; https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import FileFormatError
from epigauge.io._colmap_parts import (
    FILES,
    MAX_POINT_ID,
    MODELS,
    NUMBERS,
    SENSORS,
    CameraRow,
    ColmapModel,
    FrameRow,
    ImageRow,
    Place,
    PointTable,
    RigRow,
    check_id,
    check_pose,
)
from epigauge.io._common import MAX_MATCHES

_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_SIGHTING = np.dtype("<u4")
_MAX_NAME = 4096


class _Cursor:
    """Reads a file from the front, and says where it was when the file ends too early."""

    def __init__(self, path: Path, noun: str) -> None:
        self.path, self.noun = path, noun
        self.data = path.read_bytes()
        self.at = 0
        self.place = Place(path, "its count")

    def take(self, form: str) -> tuple[Any, ...]:
        """Return the next numbers, packed as `struct` says."""
        size = struct.calcsize(form)
        return struct.unpack_from(form, self.data, self._advance(size))

    def array(self, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        """Return an array of the next `count` items."""
        return np.frombuffer(self.data, dtype, count, self._advance(count * dtype.itemsize))

    def name(self) -> str:
        """Return the text up to the next zero byte."""
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME)
        if end < 0:
            self.place.refuse(f"its name does not end within {_MAX_NAME} bytes")
        raw = self.data[self.at : end]
        self.at = end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError:
            self.place.refuse("its name is no text (UTF-8)")

    def records(self, smallest: int) -> Iterator[Place]:
        """Yield the place of each record; `smallest` is the fewest bytes it can have."""
        (count,) = self.take("<Q")
        if count * smallest > len(self.data) - self.at:
            reason = f"announces {count} of {self.noun}s in {len(self.data)} bytes"
            raise FileFormatError(self.path, reason)
        for k in range(count):
            self.place = Place(self.path, f"{self.noun} {k + 1} of {count}")
            yield self.place
        if self.at < len(self.data):
            reason = f"has {len(self.data) - self.at} bytes after its {count} {self.noun}s"
            raise FileFormatError(self.path, reason)

    def _advance(self, size: int) -> int:
        at, self.at = self.at, self.at + size
        if self.at > len(self.data):
            self.place.refuse(f"the file ends after {len(self.data)} bytes, too early")
        return at


def read_binary(directory: Path) -> ColmapModel:
    """Read a model.

    Parameters
    ----------
    directory : Path
        Where its files are.

    Returns
    -------
    ColmapModel
        As the files have it; only what each record says by itself is checked.

    Raises
    ------
    FileFormatError
        Naming the file and the record.
    OSError
        If a file cannot be read.
    """
    cameras, images, points, rigs, frames = (directory / f"{name}.bin" for name in FILES)
    with_rigs = rigs.exists() or frames.exists()
    return ColmapModel(
        list(_cameras(cameras)),
        list(_images(images)),
        _points(points),
        list(_rigs(rigs)) if with_rigs else None,
        list(_frames(frames)) if with_rigs else None,
    )


def _cameras(path: Path) -> Iterator[CameraRow]:
    cursor = _Cursor(path, "camera")
    for place in cursor.records(24):
        number, model, width, height = cursor.take("<IiQQ")
        if not 0 <= model < len(MODELS):
            place.refuse(f"model {model} is unknown, needed: 0 to {len(MODELS) - 1}")
        name, count = MODELS[model]
        params = cursor.take(f"<{count}d")
        yield CameraRow(check_id(place, "id", number), name, width, height, params, place)


def _images(path: Path) -> Iterator[ImageRow]:
    cursor = _Cursor(path, "image")
    total = 0
    for place in cursor.records(73):
        number, *pose, camera_id = cursor.take("<I7dI")
        name = cursor.name()
        (count,) = cursor.take("<Q")
        total += count
        if total > MAX_MATCHES:
            place.refuse(f"brings the features to {total}, more than {MAX_MATCHES}")
        features = cursor.array(_FEATURE, count)
        values = check_pose(place, pose)
        xy = np.ascontiguousarray(features["xy"], np.float64)
        points = features["point"].astype(np.int64)
        check_id(place, "id", number)
        yield ImageRow(number, values[:4], values[4:], camera_id, name, xy, points, place)


def _points(path: Path) -> PointTable:
    cursor = _Cursor(path, "point")
    rows: list[tuple[Any, ...]] = []
    tracks: list[NDArray[Any]] = []
    for place in cursor.records(51):
        number, *row, count = cursor.take("<Q3d3BdQ")
        check_id(place, "id", number, MAX_POINT_ID)
        rows.append((number, *row, count))
        tracks.append(cursor.array(_SIGHTING, 2 * count))
    ids, x, y, z, red, green, blue, errors, counts = zip(*rows, strict=True) if rows else [()] * 9
    return PointTable(
        np.array(ids, np.int64),
        np.column_stack([x, y, z]).astype(np.float64),
        np.column_stack([red, green, blue]).astype(np.uint8),
        np.array(errors, np.float64),
        np.concatenate([[0], np.cumsum(np.array(counts, np.int64))]),
        np.concatenate([np.zeros(0, _SIGHTING), *tracks]).astype(np.int64).reshape(-1, 2),
    )


def _rigs(path: Path) -> Iterator[RigRow]:
    cursor = _Cursor(path, "rig")
    for place in cursor.records(8):
        number, count = cursor.take("<II")
        sensors = []
        for k in range(count):
            kind, sensor = cursor.take("<iI")
            pose = None
            if k and cursor.take("<B")[0]:
                pose = check_pose(place, cursor.take("<7d"))
            sensors.append((_sensor(place, kind), sensor, pose))
        yield RigRow(check_id(place, "id", number), tuple(sensors), place)


def _frames(path: Path) -> Iterator[FrameRow]:
    cursor = _Cursor(path, "frame")
    for place in cursor.records(68):
        number, rig_id, *pose, count = cursor.take("<II7dI")
        data = []
        for _ in range(count):
            kind, sensor, image = cursor.take("<iIQ")
            data.append((_sensor(place, kind), sensor, image))
        check_id(place, "id", number)
        yield FrameRow(number, rig_id, check_pose(place, pose), tuple(data), place)


def _sensor(place: Place, kind: int) -> int:
    if not 0 <= kind < len(SENSORS):
        place.refuse(f"sensor of kind {kind}, needed: 0 to {len(SENSORS) - 1}")
    return kind


def write_binary(files: dict[str, IO[bytes]], model: ColmapModel) -> None:
    """Write a model.

    Parameters
    ----------
    files : dict of str to binary file
        Where each of its parts goes.
    model : ColmapModel
        With rigs and frames.
    """
    write = files["cameras"].write
    write(struct.pack("<Q", len(model.cameras)))
    for camera in model.cameras:
        size = camera.width, camera.height
        write(struct.pack("<IiQQ", camera.id, NUMBERS[camera.model], *size))
        write(struct.pack(f"<{len(camera.params)}d", *camera.params))
    write = files["images"].write
    write(struct.pack("<Q", len(model.images)))
    for image in model.images:
        write(struct.pack("<I7dI", image.id, *image.q, *image.t, image.camera_id))
        write(image.name.encode() + b"\0" + struct.pack("<Q", len(image.xy)))
        features = np.empty(len(image.xy), _FEATURE)
        features["xy"], features["point"] = image.xy, image.points
        write(features.tobytes())
    _write_points(files["points3D"], model.points)
    assert model.rigs is not None and model.frames is not None
    write = files["rigs"].write
    write(struct.pack("<Q", len(model.rigs)))
    for rig in model.rigs:
        write(struct.pack("<II", rig.id, len(rig.sensors)))
        for k, (kind, sensor, pose) in enumerate(rig.sensors):
            write(struct.pack("<iI", kind, sensor))
            if k:
                write(struct.pack("<B", pose is not None))
                write(b"" if pose is None else struct.pack("<7d", *pose))
    write = files["frames"].write
    write(struct.pack("<Q", len(model.frames)))
    for frame in model.frames:
        write(struct.pack("<II7dI", frame.id, frame.rig_id, *frame.pose, len(frame.data)))
        for row in frame.data:
            write(struct.pack("<iIQ", *row))


def _write_points(file: IO[bytes], points: PointTable) -> None:
    file.write(struct.pack("<Q", len(points.ids)))
    track = points.track.astype(_SIGHTING)
    columns = (points.ids, *points.X.T, *points.colours.T, points.errors)
    for row, begin, end in zip(
        zip(*(column.tolist() for column in columns), strict=True),
        points.start[:-1].tolist(),
        points.start[1:].tolist(),
        strict=True,
    ):
        file.write(struct.pack("<Q3d3BdQ", *row, end - begin) + track[begin:end].tobytes())
