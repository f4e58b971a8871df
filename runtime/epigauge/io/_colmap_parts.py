"""What a COLMAP model consists of, whether its files are text or binary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import FileFormatError

Array = NDArray[np.float64]

#: COLMAP's camera models in the order of their numbers, each with its number of parameters.
MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
NUMBERS = {name: number for number, (name, _) in enumerate(MODELS)}

#: Kinds of sensors in the order of their numbers.
SENSORS = ("CAMERA", "IMU")
CAMERA = 0

#: The files of a model; those without the last two are of a COLMAP before 3.12.
FILES = ("cameras", "images", "points3D", "rigs", "frames")

#: A feature that belongs to no point.
NO_POINT = -1

#: Largest number of a camera, an image, a rig or a frame, and of a point.
MAX_ID, MAX_POINT_ID = 2**32 - 2, 2**63 - 1


@dataclass(frozen=True)
class Place:
    """Where in its files something stands, for messages."""

    file: Path
    what: str
    line: int | None = None

    def refuse(self, reason: str) -> NoReturn:
        """Raise the error for this place."""
        text = reason if self.line is not None else f"{self.what}: {reason}"
        raise FileFormatError(self.file, text, self.line)


@dataclass(frozen=True)
class CameraRow:
    """A camera: COLMAP's name of the model and the parameters."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]
    place: Place | None = None


@dataclass(frozen=True)
class ImageRow:
    """An image: x_cam = R(q) X + t, features (k, 2), and for each the number of its point or -1."""

    id: int
    q: Sequence[float]
    t: Sequence[float]
    camera_id: int
    name: str
    xy: Array
    points: NDArray[np.int64]
    place: Place | None = None


@dataclass(frozen=True)
class PointTable:
    """The points; rows start[j] to start[j + 1] of `track` are those of point j.

    A row of `track` is the number of an image and the place of a feature in it.
    """

    ids: NDArray[np.int64]
    X: Array
    colours: NDArray[np.uint8]
    errors: Array
    start: NDArray[np.int64]
    track: NDArray[np.int64]


@dataclass(frozen=True)
class RigRow:
    """A rig: (kind, number, pose or None) of its sensors, the first of which is the reference.

    A pose is a quaternion and a translation, from the rig to the sensor.
    """

    id: int
    sensors: tuple[tuple[int, int, tuple[float, ...] | None], ...]
    place: Place | None = field(default=None, compare=False)


@dataclass(frozen=True)
class FrameRow:
    """One moment of a rig: its pose from the world, and (kind, number, data) of its sensors."""

    id: int
    rig_id: int
    pose: tuple[float, ...]
    data: tuple[tuple[int, int, int], ...]
    place: Place | None = field(default=None, compare=False)


@dataclass(frozen=True)
class ColmapModel:
    """All of a model; rigs and frames are None where the files have none."""

    cameras: Sequence[CameraRow]
    images: Sequence[ImageRow]
    points: PointTable
    rigs: Sequence[RigRow] | None = None
    frames: Sequence[FrameRow] | None = None


def check_id(place: Place, name: str, number: int, largest: int = MAX_ID) -> int:
    """Return a number that COLMAP can use."""
    if not 0 <= number <= largest:
        place.refuse(f"{name} is {number}, needed: 0 to {largest}")
    return number


def check_pose(place: Place, pose: Sequence[float]) -> tuple[float, ...]:
    """Return a quaternion and a translation."""
    values = tuple(map(float, pose))
    if not np.isfinite(values).all():
        place.refuse("has a pose that is not finite")
    size = max(map(abs, values[:4]))  # the squares of others overflow or vanish
    if not 1e-100 < size < 1e100:
        place.refuse(f"has a quaternion of size {size:g}, needed: length 1")
    return values
