"""Scenes in folders of parts: no process has to hold all observations.

A folder has ``parts.json``, which lists the parts and says what all of them have in common;
``cameras.npz``; and the parts, files each with some points and all of their observations.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import MAX_PX, MAX_WEIGHT
from epigauge.cameras import Cameras, MetricReconstruction
from epigauge.distributed.observations import Observations
from epigauge.distributed.part_files import STORAGES, read_part
from epigauge.errors import EpigaugeError, FileFormatError
from epigauge.io._common import PathLike, cut
from epigauge.io._npz import read_npz
from epigauge.multi_view.tracks import MIN_VIEWS

__all__ = ["CAMERAS", "FORM", "MANIFEST", "Part", "PartArrays", "Parts", "is_parts"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Names of the two files that every folder has, and what the first says that it is.
MANIFEST, CAMERAS, FORM = "parts.json", "cameras.npz", "epigauge parts 1"

_ARRAYS = ("scene", "number", "X", "view", "point", "xy", "weights")
_NUMBERS = ("n_views", "n_points", "n_observations")

#: Largest manifest that is read: a thousand bytes for each of a hundred thousand parts.
_LARGEST = 100_000_000


@dataclass(frozen=True)
class PartArrays:
    """What a part holds, checked.

    Attributes
    ----------
    number : ndarray of int, shape (m,)
        Numbers of its points among all.
    X : ndarray, shape (m, 3)
        Where they begin.
    observations : Observations
        Of these points.
    """

    number: Indices
    X: Array
    observations: Observations


@dataclass(frozen=True)
class Part:
    """A part and what the manifest says of it: where a partition's observations are.

    Attributes
    ----------
    path : str
        Its file.
    scene : str
        What all parts of a folder have in common, in hexadecimal digits.
    n_views : int
        Number of all views.
    n_points, n_observations : int
        Of the part.
    whitened : bool
        Whether measurements have covariances.
    """

    path: str
    scene: str
    n_views: int
    n_points: int
    n_observations: int
    whitened: bool = False

    def load(self) -> Observations:
        """Return the observations."""
        return self.read().observations

    def points(self) -> tuple[Indices, Array]:
        """Return the numbers of the points among all, and where they begin."""
        found = self._arrays(("scene", "number", "X"))
        return found["number"].astype(np.intp), found["X"]

    def read(self) -> PartArrays:
        """Return all that the part holds, checked.

        Raises
        ------
        FileFormatError
            If the file is missing, damaged, or not the part that the manifest means.
        """
        found = self._arrays((*_ARRAYS, "whitening") if self.whitened else _ARRAYS)
        view, point = (found[name].astype(np.intp) for name in ("view", "point"))
        xy, weights = found["xy"], found["weights"]
        for name, index, limit in (("view", view, self.n_views), ("point", point, self.n_points)):
            bad = np.flatnonzero((index < 0) | (index >= limit))
            if len(bad):
                reason = f"{name} is {index[bad[0]]} in row {bad[0]}, needed: 0 to {limit - 1}"
                raise self.fault(reason)
        seen = np.bincount(point, minlength=self.n_points)
        if not ((np.diff(point) >= 0).all() and seen.all()):
            raise self.fault("array point does not rise from 0 without gaps")
        if seen.min() < MIN_VIEWS:
            few = f"point {int(np.argmin(seen))} has fewer than {MIN_VIEWS} observations"
            raise self.fault(f"{few}; needed: all those of a point in its part")
        both = point * self.n_views + view
        if not (np.diff(both) > 0).all():  # in any order within a point, but once
            both = np.sort(both)
            again = np.flatnonzero(np.diff(both) == 0)
            if len(again):
                k, i = divmod(int(both[again[0]]), self.n_views)
                raise self.fault(f"has view {i}, point {k} twice; needed: one observation")
        for name, array, most in (("xy", xy, MAX_PX), ("weights", weights, MAX_WEIGHT)):
            if not (np.abs(array) <= most).all():
                raise self.fault(f"array {name} has numbers that are not finite or too large")
        if not (weights > 0.0).all():
            raise self.fault("array weights has numbers that are not positive")
        whitening = found.get("whitening")
        if whitening is not None:
            if not np.isfinite(whitening).all():
                raise self.fault("array whitening has numbers that are not finite")
            whitening = np.ascontiguousarray(whitening.transpose(1, 2, 0))
        q = np.ascontiguousarray(xy.T)
        observations = Observations(view, point, q, weights, whitening)
        return PartArrays(found["number"].astype(np.intp), found["X"], observations)

    def fault(self, reason: str) -> FileFormatError:
        """Return the error that names the file."""
        return FileFormatError(self.path, reason)

    def _arrays(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        m, N = self.n_points, self.n_observations
        shapes: dict[str, tuple[str, tuple[int, ...]]] = {
            "scene": ("u", (len(self.scene) // 2,)),
            "number": ("iu", (m,)),
            "X": ("f", (m, 3)),
            "view": ("iu", (N,)),
            "point": ("iu", (N,)),
            "xy": ("f", (N, 2)),
            "weights": ("f", (N,)),
            "whitening": ("f", (N, 2, 2)),
        }
        found = read_part(Path(self.path), names)
        if found["scene"].tobytes().hex() != self.scene:
            raise self.fault("is a part of another scene than the manifest's")
        for name in names:
            kinds, shape = shapes[name]
            array = found[name]
            if array.dtype.kind not in kinds or array.shape != shape:
                was = f"array {name} has type {array.dtype}, shape {array.shape}"
                kind = {"f": "numbers", "u": "bytes"}.get(kinds, "whole numbers")
                raise self.fault(f"does not fit the manifest: {was}; needed: {kind} {shape}")
            if kinds == "f":
                found[name] = np.ascontiguousarray(array, np.float64)
        if not np.isfinite(found["X"]).all():
            raise self.fault("array X has numbers that are not finite")
        return found


@dataclass(frozen=True)
class Parts:
    """A folder of parts, as its manifest describes it.

    Attributes
    ----------
    folder : Path
        Where it is.
    parts : tuple of Part
        The parts.
    scene : str
        What they have in common.
    n_views, n_points, n_observations : int
        Numbers of all of them.
    unit : float
        As that of `Tracks`.
    heaviest, scale : float
        Largest weight; RMS of the coordinates about the views' centroids, in pixels.
    whitened : bool
        Whether measurements have covariances.
    names : tuple of str or None
        Of the views.
    """

    folder: Path
    parts: tuple[Part, ...]
    scene: str
    n_views: int
    n_points: int
    n_observations: int
    unit: float
    heaviest: float
    scale: float
    whitened: bool
    names: tuple[str, ...] | None = None

    @property
    def storage(self) -> str:
        """Return the form of the files."""
        return Path(self.parts[0].path).suffix[1:]

    @staticmethod
    def open(folder: PathLike) -> Parts:
        """Read the manifest, and see that all parts are there in their sizes.

        Raises
        ------
        FileFormatError
            Naming the file at fault.
        """
        folder = Path(folder)
        path = folder / MANIFEST
        try:
            with path.open("rb") as file:
                text = file.read(_LARGEST)
        except OSError as error:
            reason = f"cannot be read ({error.strerror or error}): parts are written, then this"
            raise FileFormatError(path, reason) from None
        try:
            found = json.loads(text)
            if not isinstance(found, dict) or found.get("form") != FORM:
                raise FileFormatError(path, f"is no manifest: needed: form {FORM!r}")
            made, sizes = _parts(folder, found)
        except FileFormatError:
            raise
        except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise FileFormatError(path, f"is damaged: {cut(repr(error), 100)}") from None
        counts = (
            ("n_points", made.n_points, sum(part.n_points for part in made.parts)),
            ("n_observations", made.n_observations, sum(p.n_observations for p in made.parts)),
        )
        for name, said, count in counts:
            if said != count:
                raise FileFormatError(path, f"{name} is {said}, its parts have {count}")
        for part, size in zip(made.parts, sizes, strict=True):
            _check_size(part, size)
        return made

    def start(self) -> tuple[MetricReconstruction, list[Indices]]:
        """Return the cameras and all points, and the numbers of the points of each part.

        Raises
        ------
        FileFormatError
            Naming the file at fault.
        """
        X, seen = np.empty((self.n_points, 3)), np.zeros(self.n_points, np.bool_)
        numbers = []
        for part in self.parts:
            number, own = part.points()
            if len(number) and (number.min() < 0 or number.max() >= self.n_points):
                raise part.fault(f"numbers of points are not below {self.n_points}")
            if seen[number].any() or len(np.unique(number)) != len(number):
                raise part.fault("has points that another part has, or one twice")
            seen[number], X[number] = True, own
            numbers.append(number)
        path = self.folder / CAMERAS
        names = ("scene", "R", "t", "params", "camera_of_view", "model")
        try:
            with path.open("rb") as file:
                found = read_npz(path, file, [names])
        except OSError as error:
            raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from None
        if found["scene"].tobytes().hex() != self.scene:
            raise FileFormatError(path, "has cameras of another scene than the manifest's")
        try:
            model = found["model"].astype(np.uint8).tobytes().decode()
            cameras = Cameras(model, found["params"], found["camera_of_view"])
            scene = MetricReconstruction(found["R"], found["t"], X, cameras)
        except EpigaugeError as error:
            raise FileFormatError(path, str(error)) from None
        except UnicodeDecodeError:
            raise FileFormatError(path, "array model is no name") from None
        if scene.n_views != self.n_views:
            raise FileFormatError(path, f"has {scene.n_views} views, needed: {self.n_views}")
        return scene, numbers


def is_parts(path: PathLike) -> bool:
    """Tell whether a path is a folder of parts, finished or not."""
    folder = Path(path)
    return folder.is_dir() and ((folder / MANIFEST).exists() or any(folder.glob("part-[0-9]*.*")))


def _parts(folder: Path, found: dict[str, Any]) -> tuple[Parts, list[int]]:
    """Return what a manifest says, and how many bytes each part has."""
    scene, whitened = bytes.fromhex(found["scene"]).hex(), bool(found["whitened"])
    n, m, N = (int(found[name]) for name in _NUMBERS)
    parts, sizes = [], []
    for row in found["parts"]:
        name = str(row["file"])
        if Path(name).name != name:
            raise ValueError(f"file {name!r} is not in the folder")
        if Path(name).suffix[1:] not in STORAGES:
            raise ValueError(f"file {name!r} is none of {', '.join(STORAGES)}")
        size, points, seen = (int(row[key]) for key in ("bytes", "n_points", "n_observations"))
        if not 0 < points <= seen <= size:  # no more is allocated than there can be
            raise ValueError(f"{points} points, {seen} observations in {size} bytes of {name!r}")
        sizes.append(size)
        parts.append(Part(str(folder / name), scene, n, points, seen, whitened))
    unit, heaviest, scale = (float(found[name]) for name in ("unit", "heaviest", "scale_px"))
    limits = (unit, MAX_PX), (heaviest, MAX_WEIGHT), (scale, MAX_PX)
    if not parts or min(n, m, N) < 1 or not all(0.0 < x <= most for x, most in limits):
        raise ValueError("numbers that are not positive, or too large")
    names = found["names"]
    if names is not None:
        if not isinstance(names, list):
            raise TypeError("names that are no list")
        names = tuple(map(str, names))
        if len(names) != n:
            raise ValueError(f"{len(names)} names of {n} views")
    numbers = n, m, N, unit, heaviest, scale
    return Parts(folder, tuple(parts), scene, *numbers, whitened, names), sizes


def _check_size(part: Part, size: int) -> None:
    try:
        found = Path(part.path).stat().st_size
    except OSError as error:
        raise part.fault(f"cannot be read: {error.strerror or error}") from None
    if found != size:
        raise part.fault(f"has {found} bytes, the manifest says {size}: it was cut or changed")
