"""From the files as they were published to the arrays that `load_tracks` reads.

Indices count from 0. The published files are checked by their SHA-256 before they come here.
A converter is called with the downloaded files, the file to write, and the size of the images.
"""

from __future__ import annotations

import bz2
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import MissingPackageError
from epigauge.io import writing
from epigauge.io._npz import write_npz

Array = NDArray[np.float64]
Size = tuple[int, int] | None

#: Tracks of hotel_course with a residual above 2.5 px in a projective bundle adjustment of every
#: fifth frame; the others are its clean ones.
_HOTEL_GROSS = [
    *(24, 68, 85, 109, 115, 119, 121, 122, 129, 130, 131, 134, 142, 148, 153, 174, 178, 186),
    *(202, 224, 269, 327, 340, 354, 377, 378, 379, 380, 388, 394, 420, 422, 450, 479, 480, 489),
]


def measurement_matrix(downloaded: list[Path], target: Path, image_size: Size) -> None:
    """Convert a measurement matrix in a MAT file.

    M (2n, m) holds x and y of view i in rows 2 i and 2 i + 1, W (2n, m) marks what was measured,
    and M_true, where it is of the same shape, is the complete set of reprojections.
    """
    content = _read_mat(downloaded[0])
    xy = _by_view(content["M"])
    view, point = np.nonzero(content["W"][0::2])
    full = content.get("M_true", content["W"][:0])
    more = {"xy_full": _by_view(full)} if full.shape == content["M"].shape else {}
    _write(target, view, point, xy[view, point], xy.shape[:2], image_size, **more)


def complete_tracks(downloaded: list[Path], target: Path, image_size: Size) -> None:
    """Convert the complete tracks of hotel_course: Xs and Ys (n, m) in a MAT file."""
    content = _read_mat(downloaded[0])
    xy = np.stack([content["Xs"], content["Ys"]], axis=-1)
    n, m = xy.shape[:2]
    view, point = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    clean = ~np.isin(np.arange(m), _HOTEL_GROSS)
    _write(target, view, point, xy.reshape(-1, 2), (n, m), image_size, clean=clean)


def sba_demo(downloaded: list[Path], target: Path, image_size: Size) -> None:
    """Convert a demonstration problem of sba: points with their tracks, cameras, calibration.

    A camera is a quaternion, scalar first, and a translation: x_cam = R X + t and P = K (R | t).
    A point is ``X Y Z`` and the number of its views, then ``view x y`` for each.
    """
    points, cameras, calibration = downloaded
    X: list[list[float]] = []
    rows: list[list[float]] = []
    for line in points.read_text().splitlines():
        if not line.startswith("#"):
            fields = line.split()
            for k in range(4, 4 + 3 * int(fields[3]), 3):
                rows.append([int(fields[k]), len(X), *map(float, fields[k + 1 : k + 3])])
            X.append([float(field) for field in fields[:3]])
    table = np.array(rows)
    K = np.loadtxt(calibration)
    motion = np.loadtxt(cameras)
    R, t = _rotations(motion[:, :4]), motion[:, 4:]
    P = K @ np.concatenate([R, t[:, :, None]], axis=2)
    shape = len(motion), len(X)
    known = {"P": P, "K": K, "R": R, "t": t, "X": np.array(X)}
    _write(target, table[:, 0], table[:, 1], table[:, 2:], shape, image_size, **known)


def compressed(downloaded: list[Path], target: Path, image_size: Size) -> None:
    """Keep a file, bzip2-compressed."""
    with writing(target) as file:
        file.write(bz2.compress(downloaded[0].read_bytes()))


def unchanged(downloaded: list[Path], target: Path, image_size: Size) -> None:
    """Keep a file as it is."""
    with writing(target) as file:
        file.write(downloaded[0].read_bytes())


def _read_mat(path: Path) -> dict[str, Any]:
    try:
        from scipy.io import loadmat
    except ModuleNotFoundError:
        raise MissingPackageError("scipy", "data") from None
    content: dict[str, Any] = loadmat(path)
    return content


def _by_view(matrix: Array) -> Array:
    """Turn (2n, m), rows x and y in turn, into (n, m, 2)."""
    return np.stack([matrix[0::2], matrix[1::2]], axis=-1)


def _rotations(quaternions: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of quaternions (n, 4), scalar first, of any norm."""
    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    a, b, c, d = (quaternions / norm).T
    rows = [
        [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _write(
    target: Path,
    view: NDArray[Any],
    point: NDArray[Any],
    xy: Array,
    shape: tuple[int, ...],
    image_size: Size,
    **more: Any,
) -> None:
    """Write tracks of shape (number of views, number of points), and further arrays."""
    size: dict[str, Any] = {} if image_size is None else {"image_size": np.array(image_size)}
    with writing(target) as file:
        arrays: dict[str, Any] = {
            "view": view.astype(np.int32),
            "point": point.astype(np.int32),
            "xy": xy,
            "n_views": shape[0],
            "n_points": shape[1],
        }
        write_npz(file, arrays | size | more)
