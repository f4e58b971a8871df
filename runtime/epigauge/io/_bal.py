"""Bundle Adjustment in the Large: cameras, points and observations as text.

A line ``views points observations``; a line ``view point x y`` an observation; then 9 numbers a
camera (rotation as a Rodrigues vector, translation, f, k1, k2) and 3 a point. Without distortion a
camera projects x = -f X / Z, with X = R Q + t: its matrix is diag(-f, -f, 1) (R | t). Where
projective cameras are asked for, k1 and k2 are ignored; where they are written, they are 0.
"""

from __future__ import annotations

import array
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import MAX_MATCHES
from epigauge.io._npz import damage
from epigauge.io._text import numbers, text_lines
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.rotations import from_rodrigues, rodrigues

Array = NDArray[np.float64]

_HEAD = "views points observations"
_BLANK_LINES = 1000
#: How far a camera may be from diag(-f, -f, 1) (R | t), relative to f.
_TOLERANCE = 1e-8


def read_bal(path: Path, file: IO[bytes]) -> dict[str, Any]:
    """Read a problem.

    Parameters
    ----------
    path : Path
        Name of the file for messages.
    file : binary file
        Its content, decompressed.

    Returns
    -------
    dict
        Arrays view, point (N,), xy (N, 2), cameras (n, 9), X (m, 3).

    Raises
    ------
    FileFormatError
        Naming the line at fault.
    """
    with damage(path, "is damaged"):
        values, first_of_line, line_of, (n, m, count) = _numbers(path, file)
    end_views, end_cameras = 4 * count, 4 * count + 9 * n
    observations = values[:end_views].reshape(count, 4)
    for column, (name, limit) in enumerate((("view", n), ("point", m))):
        index = observations[:, column]
        bad = np.flatnonzero((index < 0) | (index >= limit) | (index != np.floor(index)))
        if len(bad):
            k = int(bad[0])
            line = line_of[int(np.searchsorted(first_of_line, 4 * k + column, "right")) - 1]
            raise FileFormatError(
                path, f"{name} is {index[k]:g}, needed: a whole number from 0 below {limit}", line
            )
    points = values[end_cameras:].reshape(m, 3)
    return {
        "view": observations[:, 0].astype(np.intp),
        "point": observations[:, 1].astype(np.intp),
        "xy": observations[:, 2:].copy(),
        "cameras": values[end_views:end_cameras].reshape(n, 9),
        "X": points,
    }


def write_bal(file: IO[bytes], tracks: Tracks, cameras: Array, points: Array) -> None:
    """Write a problem; weights have no place in it.

    Parameters
    ----------
    file : binary file
        Where to.
    tracks : Tracks
        Observations.
    cameras : ndarray, shape (n, 9)
        Rodrigues vector, translation, f, k1, k2.
    points : ndarray, shape (m, 3)
        Points.
    """
    file.write(f"{tracks.n_views} {tracks.n_points} {len(tracks)}\n".encode())
    for view, point, (x, y) in zip(
        tracks.view.tolist(), tracks.point.tolist(), tracks.xy.tolist(), strict=True
    ):
        file.write(f"{view} {point} {x!r} {y!r}\n".encode())
    for value in [*cameras.ravel().tolist(), *points.ravel().tolist()]:
        file.write(f"{value!r}\n".encode())


def projective_cameras(cameras: Array) -> Array:
    """Return diag(-f, -f, 1) (R | t) of nine numbers a camera; its distortion is left out."""
    with np.errstate(all="ignore"):
        P = np.concatenate([from_rodrigues(cameras[:, :3]), cameras[:, 3:6, None]], axis=2)
        P[:, :2] *= -cameras[:, 6, None, None]
    return np.asarray(P)


def nine_numbers(reconstruction: Reconstruction, tracks: Tracks) -> tuple[Array, Array]:
    """Return what BAL holds of projective cameras and points.

    BAL's cameras look along -z. To a projective camera the point X and the point -X seen from -t
    are the same; of the two scenes the one before its cameras is returned.

    Parameters
    ----------
    reconstruction : Reconstruction
        Its cameras must be diag(-f, -f, 1) (R | t) up to scale, its points finite.
    tracks : Tracks
        Says which camera sees which point.

    Returns
    -------
    cameras, points : ndarray, shape (n, 9), (m, 3)
        Without distortion.

    Raises
    ------
    ArgumentError
        Naming the first camera or point that is not, or the first camera that has its points
        behind it where most others have them in front.
    """
    at_infinity = np.flatnonzero(reconstruction.Q[:, 3] == 0.0)
    if len(at_infinity):
        raise ArgumentError("start", f"has point {at_infinity[0]} at infinity", "finite points")
    cameras = np.array([_nine_numbers(i, P) for i, P in enumerate(reconstruction.P)])
    points = reconstruction.Q[:, :3] / reconstruction.Q[:, 3:]
    axes = from_rodrigues(cameras[:, :3])[:, 2]
    depth = (axes[tracks.view] * points[tracks.point]).sum(axis=1) + cameras[tracks.view, 5]
    behind = depth > 0.0
    if 2 * np.count_nonzero(behind) > len(behind):
        cameras[:, 3:6], points, behind = -cameras[:, 3:6], -points, depth < 0.0
    lost = np.bincount(tracks.view, behind, len(cameras)) > 0.5 * np.bincount(tracks.view)
    if lost.any():
        was = f"has camera {np.flatnonzero(lost)[0]} with its points behind it, unlike most others"
        raise ArgumentError("start", was, "a scene before its cameras; NPZ holds every camera")
    return cameras, points


def _numbers(
    path: Path, file: IO[bytes]
) -> tuple[Array, array.array[int], array.array[int], list[int]]:
    """Read all numbers; for each line the count before it and its number; and the first line."""
    values = array.array("d")
    first_of_line, line_of = array.array("q"), array.array("q")
    counts: list[int] = []
    expected = 0
    for line, text, _ in text_lines(path, file):
        fields = text.split()
        if not fields:
            if line > len(line_of) + _BLANK_LINES:
                raise FileFormatError(path, f"has more than {_BLANK_LINES} empty lines", line)
            continue
        if not counts:
            counts = _counts(path, fields, line)
            expected = 9 * counts[0] + 3 * counts[1] + 4 * counts[2]
            continue
        first_of_line.append(len(values))
        line_of.append(line)
        values.extend(numbers(path, fields, line))
        if len(values) > expected:
            reason = f"holds more than the {expected} numbers that its first line announces"
            raise FileFormatError(path, reason, line)
    if not counts:
        raise FileFormatError(path, "is empty")
    if len(values) < expected:
        reason = f"ends after {len(values)} of the {expected} numbers that its first line announces"
        raise FileFormatError(path, reason)
    return np.array(values), first_of_line, line_of, counts


def _counts(path: Path, fields: list[str], line: int) -> list[int]:
    """Read the first line."""
    counts = [int(field) for field in fields if field.isascii() and field.isdigit()]
    if len(fields) != 3 or len(counts) != 3:
        reason = f"is no BAL problem: it begins with '{_HEAD}' (a table is named .csv)"
        raise FileFormatError(path, reason, line)
    if not all(0 < count <= MAX_MATCHES for count in counts):
        raise FileFormatError(path, f"needed: 1 to {MAX_MATCHES} {_HEAD}", line)
    return counts


def _nine_numbers(i: int, P: Array) -> Array:
    """Return the numbers of one camera."""
    M = P / (np.sign(np.linalg.det(P[:, :3])) * np.linalg.norm(P[2, :3]) or 1.0)
    f = float(np.linalg.norm(M[0, :3]))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = M / np.array([-f, -f, 1.0])[:, None]
        error = np.abs(scaled[:, :3] @ scaled[:, :3].T - np.eye(3)).max()
    if not error <= _TOLERANCE:
        raise ArgumentError(
            "start",
            f"has camera {i} away from diag(-f, -f, 1) (R | t) by {error:.1g}",
            "cameras of this form; NPZ holds every camera",
        )
    return np.asarray(np.concatenate([rodrigues(scaled[:, :3]), scaled[:, 3], [f, 0.0, 0.0]]))
