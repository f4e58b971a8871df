"""Bundler's files, ``bundle.out``, version 0.3, and the list of images beside them.

A line with the version, one with the numbers of cameras and points, five lines a camera (f, k1, k2;
three of R; t) and three a point (position; colour; its views: how many, and of each camera, key, x,
y). Cameras are BAL's: they look along -z, and pixels count from the middle of the image with y up.
A camera with f = 0 was not registered.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import MAX_MATCHES, cut
from epigauge.io._npz import damage
from epigauge.io._scene import RawScene, SceneSource
from epigauge.io.output import writing
from epigauge.multi_view.tracks import Tracks

__all__ = ["read_bundler", "write_bundler"]

Array = NDArray[np.float64]

#: Rotations are written with ten digits; what is farther away is none.
_ROUNDED = 1e-4
_MAX_LINE = 1 << 20


class _Lines:
    """Lines of numbers, with their place for messages."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path, self.file, self.line = path, file, 0

    def refuse(self, reason: str) -> FileFormatError:
        return FileFormatError(self.path, reason, self.line)

    def text(self) -> str:
        """Return the next line that is not blank."""
        while True:
            raw = self.file.readline(_MAX_LINE)
            self.line += 1
            if not raw:
                raise self.refuse("ends too early")
            if len(raw) == _MAX_LINE:
                raise self.refuse(f"is longer than {_MAX_LINE} characters")
            if raw.strip():
                return raw.decode("ascii", "replace").strip()

    def numbers(self, what: str, count: int | None = None) -> list[float]:
        words = self.text().split()
        if count is not None and len(words) != count:
            raise self.refuse(f"holds {len(words)} values, needed: {count}: {what}")
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise self.refuse(f"is {cut(' '.join(words))!r}, needed: {what}") from None
        if not np.isfinite(values).all():
            raise self.refuse(f"holds a number that is not finite, needed: {what}")
        return values


def read_bundler(path: Path, file: IO[bytes]) -> RawScene:
    """Read a scene; cameras that are not registered are left out, and told in its notes.

    Raises
    ------
    FileFormatError
        Naming the line at fault.
    """
    lines = _Lines(path, file)
    head = lines.text()
    if not head.startswith("# Bundle file v0.3"):
        raise lines.refuse(f"is {cut(head)!r}, needed: # Bundle file v0.3")
    sizes = lines.numbers("numbers of cameras and points", 2)
    n, m = map(int, sizes)
    if [n, m] != sizes or not (0 < n <= MAX_MATCHES and 0 < m <= MAX_MATCHES):
        raise lines.refuse(f"says {sizes}, needed: whole numbers from 1 to {MAX_MATCHES}")
    cameras = [_camera(lines) for _ in range(n)]
    registered = np.array([camera[0][0] != 0.0 for camera in cameras])
    X, colours, rows = [], [], []
    for j in range(m):
        X.append(lines.numbers("three coordinates", 3))
        colour = lines.numbers("red, green, blue", 3)
        if any(c != int(c) or not 0 <= c <= 255 for c in colour):
            raise lines.refuse("is no colour: three whole numbers from 0 to 255")
        colours.append(colour)
        seen = lines.numbers("the number of views, and camera, key, x, y of each")
        if len(seen) != 1 + 4 * seen[0]:
            raise lines.refuse(f"says {seen[0]:g} views, but holds {(len(seen) - 1) / 4:g}")
        for k in range(1, len(seen), 4):
            view = seen[k]
            if view != int(view) or not 0 <= view < n or not registered[int(view)]:
                raise lines.refuse(f"says camera {view:g}, needed: one of {n} that is registered")
            rows.append((view, j, *seen[k + 2 : k + 4]))
        if len(rows) > MAX_MATCHES:
            raise lines.refuse(f"is beyond the {MAX_MATCHES} observations that are read")
    if not rows:
        raise lines.refuse("ends without an observation")
    number = np.cumsum(registered) - 1
    kept = [camera for camera, known in zip(cameras, registered, strict=True) if known]
    table = np.array(rows)
    names = _names(path, n)
    notes = () if registered.all() else (f"cameras not registered: {np.sum(~registered)}",)
    return RawScene(
        number[table[:, 0].astype(np.int64)],
        table[:, 1].astype(np.int64),
        table[:, 2:],
        np.array([camera[1] for camera in kept]),
        np.array([camera[2] for camera in kept]),
        np.array(X),
        "bal",
        np.array([camera[0] for camera in kept]),
        np.arange(len(kept)),
        names=None if names is None else [names[k] for k in np.flatnonzero(registered)],
        colours=np.array(colours, dtype=np.uint8),
        source=SceneSource(notes=notes),
    )


def _camera(lines: _Lines) -> tuple[list[float], Array, list[float]]:
    """Return (f, k1, k2), the rotation that is meant, and t."""
    own = lines.numbers("f, k1, k2", 3)
    R = np.array([lines.numbers("a row of R", 3) for _ in range(3)])
    if own[0] != 0.0:
        U, s, Vt = np.linalg.svd(R)
        if abs(s - 1.0).max() > _ROUNDED or np.linalg.det(U @ Vt) < 0.0:
            raise lines.refuse("ends a matrix R that is no rotation")
        R = U @ Vt
    return own, R, lines.numbers("t", 3)


def _names(path: Path, count: int) -> list[str] | None:
    """Return the names of the images, where ``list.txt`` beside the file has one a camera."""
    for known in (path.with_suffix(".list.txt"), path.with_name("list.txt")):
        if known.is_file():
            with damage(known, "is no list of images"):
                lines = known.read_text(encoding="utf-8").splitlines()
                names = [line.split()[0] for line in lines if line.strip()]
            return names if len(names) == count == len(set(names)) else None
    return None


def write_bundler(path: Path, tracks: Tracks, xy: Array, scene: MetricReconstruction) -> None:
    """Write a scene of BAL's cameras, and the names of the images as ``NAME.list.txt``.

    Parameters
    ----------
    path : Path
        The file.
    tracks : Tracks
        Observations, names, colours.
    xy : ndarray, shape (N, 2)
        The observations in BAL's pixels.
    scene : MetricReconstruction
        Of the same views and points, its cameras of the model "bal".
    """
    names = tracks.names
    if names is not None and any(name.split() != [name] for name in names):
        raise ArgumentError("tracks.names", "hold white space", "names without it, for Bundler")
    with writing(path) as file:
        for line in _written(tracks, xy, scene):
            file.write((line + "\n").encode())
    if names is not None:
        with writing(path.with_suffix(".list.txt")) as file:
            file.write("".join(f"{name}\n" for name in names).encode())


def _written(tracks: Tracks, xy: Array, scene: MetricReconstruction) -> Iterator[str]:
    yield "# Bundle file v0.3"
    yield f"{tracks.n_views} {tracks.n_points}"
    for own, R, t in zip(scene.cameras.of_views, scene.R, scene.t, strict=True):
        yield from (_text(row) for row in (own, *R, t))
    colours = tracks.colours
    grey = np.full((tracks.n_points, 3), 128)
    bounds = np.searchsorted(tracks.point, np.arange(tracks.n_points + 1))
    # Keys are places among the features of a view; those without a point are not known.
    order = np.argsort(tracks.view, kind="stable")
    first = np.searchsorted(tracks.view[order], np.arange(tracks.n_views))
    key = np.empty(len(tracks), dtype=np.int64)
    key[order] = np.arange(len(tracks)) - first[tracks.view[order]]
    for j, (X, rgb) in enumerate(zip(scene.X, grey if colours is None else colours, strict=True)):
        yield _text(X)
        yield " ".join(str(int(c)) for c in rgb)
        seen = [
            f"{tracks.view[k]} {key[k]} {_text(xy[k])}" for k in range(bounds[j], bounds[j + 1])
        ]
        yield " ".join([str(len(seen)), *seen])


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
