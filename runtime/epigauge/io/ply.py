"""Coloured point clouds as PLY, the form that MeshLab, CloudCompare and Blender open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.io._common import PathLike, check_suffix
from epigauge.io.output import writing

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_HEADER = """ply
format binary_little_endian 1.0
comment {comment}
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


def save_ply(
    path: PathLike,
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    comment: str = "",
) -> None:
    """Write coloured points as binary PLY.

    Parameters
    ----------
    path : str or path
        The file, ``.ply``.
    xyz : ndarray, shape (m, 3)
        Finite coordinates.
    rgb : ndarray, shape (m, 3), uint8
        Colours.
    comment : str
        One line for whoever opens the file in an editor.

    Raises
    ------
    ArgumentError
        If the suffix is another one.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> import tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder, "cloud.ply")
    ...     eg.io.save_ply(path, np.zeros((2, 3)), np.zeros((2, 3), np.uint8), "two points")
    ...     print(path.read_bytes()[:3].decode())
    ply
    """
    check_suffix(path, ".ply")
    vertices = np.empty(len(xyz), dtype=_VERTEX)
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    with writing(path) as file:
        file.write(_HEADER.format(comment=comment, count=len(xyz)).encode("ascii"))
        file.write(vertices.tobytes())
