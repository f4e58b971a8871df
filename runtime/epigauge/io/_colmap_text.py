"""COLMAP's text models: cameras.txt, images.txt, points3D.txt, rigs.txt, frames.txt.

A record is a line, that of an image two. Lines that begin with # are comments. The format is
documented at https://colmap.github.io/format.html.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from epigauge.errors import ArgumentError
from epigauge.io._colmap_parts import (
    FILES,
    MAX_ID,
    MAX_POINT_ID,
    MODELS,
    NO_POINT,
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
from epigauge.io._common import MAX_MATCHES, cut
from epigauge.io._text import decoded, numbers

#: Longest line: an image has its features in one.
_MAX_LINE = 2**28

_Lines = Iterator[tuple[Place, list[str]]]


class _Fields:
    """Reads the fields of a line one after the other."""

    def __init__(self, place: Place, fields: list[str]) -> None:
        self.place, self.fields, self.at = place, fields, 0

    def left(self) -> int:
        return len(self.fields) - self.at

    def word(self, name: str) -> str:
        if not self.left():
            self.place.refuse(f"ends before its {name}")
        self.at += 1
        return self.fields[self.at - 1]

    def whole(self, name: str, largest: int = MAX_ID) -> int:
        return check_id(self.place, name, _whole(self.place, name, self.word(name)), largest)

    def reals(self, name: str, count: int) -> list[float]:
        if self.left() < count:
            self.place.refuse(f"has {self.left()} of the {count} numbers of its {name}")
        self.at += count
        assert self.place.line is not None
        return numbers(self.place.file, self.fields[self.at - count : self.at], self.place.line)

    def sensor(self) -> tuple[int, int]:
        kind = self.word("kind of sensor")
        if kind not in SENSORS:
            self.place.refuse(f"sensor of kind {cut(kind)!r}, needed: {' or '.join(SENSORS)}")
        return SENSORS.index(kind), self.whole("number of a sensor")

    def end(self) -> None:
        if self.left():
            self.place.refuse(f"has {cut(self.fields[self.at])!r} after its last number")


def read_text_model(directory: Path) -> ColmapModel:
    """Read a model.

    Parameters
    ----------
    directory : Path
        Where its files are.

    Returns
    -------
    ColmapModel
        As the files have it; only what each line says by itself is checked.

    Raises
    ------
    FileFormatError
        Naming the file and the line.
    OSError
        If a file cannot be read.
    """
    cameras, images, points, rigs, frames = (directory / f"{name}.txt" for name in FILES)
    with_rigs = rigs.exists() or frames.exists()
    return ColmapModel(
        [camera_of(*line) for line in _records(cameras)],
        list(_images(images)),
        _points(points),
        [rig_of(*line) for line in _records(rigs)] if with_rigs else None,
        [frame_of(*line) for line in _records(frames)] if with_rigs else None,
    )


def _lines(path: Path) -> Iterator[tuple[Place, str]]:
    """Yield each line that is no comment."""
    with path.open("rb") as file:
        line = 0
        while raw := file.readline(_MAX_LINE + 1):
            line += 1
            text = decoded(path, raw, line, _MAX_LINE).strip()
            if not text.startswith("#"):
                yield Place(path, "", line), text


def _records(path: Path) -> _Lines:
    """Yield the fields of each line that holds any."""
    return ((place, text.split()) for place, text in _lines(path) if text)


def _whole(place: Place, name: str, text: str) -> int:
    digits = text.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 20):
        place.refuse(f"{name} is {cut(text)!r}, needed: a whole number")
    return int(text)


def camera_of(place: Place, words: list[str]) -> CameraRow:
    """Read a camera from the fields of its line."""
    fields = _Fields(place, words)
    number, name = fields.whole("id"), fields.word("model")
    if name not in NUMBERS:
        known = ", ".join(NUMBERS)
        place.refuse(f"model {cut(name)!r} is unknown, needed: one of {known}")
    size = fields.whole("width"), fields.whole("height")
    params = tuple(fields.reals("parameters", MODELS[NUMBERS[name]][1]))
    fields.end()
    return CameraRow(number, name, *size, params, place)


def _images(path: Path) -> Iterator[ImageRow]:
    lines = _lines(path)
    total = 0
    for place, text in lines:
        if not text:
            continue
        parts = text.split(None, 9)  # the name is the rest of the line
        fields = _Fields(place, parts)
        number = fields.whole("id")
        pose = check_pose(place, fields.reals("pose", 7))
        camera_id = fields.whole("number of a camera")
        name = fields.word("name")
        below, features = next(lines, (place, None))
        if features is None:
            place.refuse("has no second line with the features of the image")
        words = features.split()
        if len(words) % 3:
            below.refuse(f"holds {len(words)} numbers, needed: three a feature (x, y, point)")
        total += len(words) // 3
        if total > MAX_MATCHES:
            below.refuse(f"brings the features to {total}, more than {MAX_MATCHES}")
        assert below.line is not None
        x, y = (numbers(path, words[k::3], below.line) for k in range(2))
        points = [_point_of(below, word) for word in words[2::3]]
        xy = np.column_stack([x, y]).reshape(-1, 2)
        ids = np.array(points, np.int64)
        yield ImageRow(number, pose[:4], pose[4:], camera_id, name, xy, ids, place)


def _point_of(place: Place, word: str) -> int:
    number = _whole(place, "a feature's point", word)
    return number if number == NO_POINT else check_id(place, "point", number, MAX_POINT_ID)


def _points(path: Path) -> PointTable:
    ids, X, colours, errors, tracks = [], [], [], [], []
    start = [0]
    for place, words in _records(path):
        fields = _Fields(place, words)
        ids.append(fields.whole("id", MAX_POINT_ID))
        X.append(fields.reals("position", 3))
        colours.append([fields.whole("colour", 255) for _ in range(3)])
        errors.extend(fields.reals("error", 1))
        if fields.left() % 2:
            place.refuse("has a track that is not pairs of an image and a feature")
        track = [fields.whole("track") for _ in range(fields.left())]
        start.append(start[-1] + len(track) // 2)
        if start[-1] > MAX_MATCHES:
            place.refuse(f"brings the observations to {start[-1]}, more than {MAX_MATCHES}")
        tracks.extend(track)
    return PointTable(
        np.array(ids, np.int64),
        np.array(X).reshape(-1, 3),
        np.array(colours, np.uint8).reshape(-1, 3),
        np.array(errors),
        np.array(start),
        np.array(tracks, np.int64).reshape(-1, 2),
    )


def rig_of(place: Place, words: list[str]) -> RigRow:
    """Read a rig from the fields of its line."""
    fields = _Fields(place, words)
    number, count = fields.whole("id"), fields.whole("number of sensors")
    sensors: list[tuple[int, int, tuple[float, ...] | None]] = []
    while len(sensors) < count:
        pose = None
        kind, sensor = fields.sensor()
        if sensors and fields.whole("mark of a pose", 1):
            pose = check_pose(place, fields.reals("pose", 7))
        sensors.append((kind, sensor, pose))
    fields.end()
    return RigRow(number, tuple(sensors), place)


def frame_of(place: Place, words: list[str]) -> FrameRow:
    """Read a frame from the fields of its line."""
    fields = _Fields(place, words)
    number, rig_id = fields.whole("id"), fields.whole("number of a rig")
    pose = check_pose(place, fields.reals("pose", 7))
    data: list[tuple[int, int, int]] = []
    for _ in range(fields.whole("number of images")):
        data.append((*fields.sensor(), fields.whole("image", MAX_POINT_ID)))
        if len(data) > len(words):
            break
    fields.end()
    return FrameRow(number, rig_id, pose, tuple(data), place)


def write_text_model(
    files: dict[str, IO[bytes]], model: ColmapModel, head: Sequence[str] = ()
) -> None:
    """Write a model, every number so that it is read as the same again.

    Parameters
    ----------
    files : dict of str to binary file
        Where each of its parts goes.
    model : ColmapModel
        With rigs and frames.
    head : sequence of str
        Comments at the top of each file.

    Raises
    ------
    ArgumentError
        If a name has white space, which other readers take for its end.
    """
    texts = {
        "cameras": (
            "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
            map(camera_line, model.cameras),
        ),
        "images": (
            "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID of each",
            _image_lines(model.images),
        ),
        "points3D": (
            "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
            _point_lines(model.points),
        ),
        "rigs": (
            "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, "
            "SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])",
            map(rig_line, model.rigs or ()),
        ),
        "frames": (
            "FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, "
            "DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)",
            map(frame_line, model.frames or ()),
        ),
    }
    for name, file in files.items():
        columns, lines = texts[name]
        for line in (*head, columns):
            file.write(f"# {line}\n".encode())
        for line in lines:
            file.write(f"{line}\n".encode())


def camera_line(camera: CameraRow) -> str:
    """Return the line of a camera."""
    size = f"{camera.width} {camera.height}"
    return f"{camera.id} {camera.model} {size} {_text(camera.params)}"


def _image_lines(images: Sequence[ImageRow]) -> Iterator[str]:
    for image in images:
        if image.name.split() != [image.name]:
            was = f"hold {cut(image.name)!r}, with white space"
            raise ArgumentError("tracks.names", was, "names without, or a binary model")
        yield f"{image.id} {_text(image.q)} {_text(image.t)} {image.camera_id} {image.name}"
        yield " ".join(
            f"{x!r} {y!r} {point}"
            for (x, y), point in zip(image.xy.tolist(), image.points.tolist(), strict=True)
        )


def _point_lines(points: PointTable) -> Iterator[str]:
    for j, number in enumerate(points.ids.tolist()):
        red, green, blue = points.colours[j].tolist()
        track = points.track[points.start[j] : points.start[j + 1]].ravel().tolist()
        values = f"{_text(points.X[j])} {red} {green} {blue} {float(points.errors[j])!r}"
        yield f"{number} {values} {' '.join(map(str, track))}"


def rig_line(rig: RigRow) -> str:
    """Return the line of a rig."""
    words = [str(rig.id), str(len(rig.sensors))]
    for k, (kind, sensor, pose) in enumerate(rig.sensors):
        words += [SENSORS[kind], str(sensor)]
        if k:
            words += ["0"] if pose is None else ["1", _text(pose)]
    return " ".join(words)


def frame_line(frame: FrameRow) -> str:
    """Return the line of a frame."""
    words = [str(frame.id), str(frame.rig_id), _text(frame.pose), str(len(frame.data))]
    for kind, sensor, image in frame.data:
        words += [SENSORS[kind], str(sensor), str(image)]
    return " ".join(words)


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
