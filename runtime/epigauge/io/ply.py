"""Coloured point clouds as PLY, the form that MeshLab, CloudCompare and Blender open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.io._common import PathLike, check_suffix
from epigauge.io.output import writing

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_EDGE = np.dtype([("ends", "<i4", 2)])
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
"""
_EDGES = """element edge {count}
property int vertex1
property int vertex2
"""


def save_ply(
    path: PathLike,
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    comment: str = "",
    edges: NDArray[np.intp] | None = None,
) -> None:
    """Write coloured points, and edges between some of them, as binary PLY.

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
    edges : ndarray of int, shape (k, 2), optional
        Which points are joined.

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
        header = _HEADER.format(comment=comment, count=len(xyz))
        header += "" if edges is None else _EDGES.format(count=len(edges))
        file.write(f"{header}end_header\n".encode("ascii"))
        file.write(vertices.tobytes())
        if edges is not None:
            rows = np.empty(len(edges), dtype=_EDGE)
            rows["ends"] = edges
            file.write(rows.tobytes())
