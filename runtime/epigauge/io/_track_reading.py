"""Reading tracks: what a file holds, and what of it is asked for."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._bal import projective_cameras, read_bal
from epigauge.io._common import MAX_MATCHES, PathLike, listed
from epigauge.io._npz import read_npz
from epigauge.io._opensfm import HEAD as OPENSFM
from epigauge.io._opensfm import read_opensfm
from epigauge.io._text import Columns, read_text
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_COLUMNS = Columns(
    "observations",
    ("view", "point", "x", "y"),
    indices=("view", "point"),
    flags=("clean",),
    labels=("view",),
)
_TRACKS = ("view", "point", "xy")

#: How measurements differ beside their weights.
MEASURED = ("unit", "whitening")

#: What names of files may end in.
SUFFIXES = (".npz", ".csv", ".txt", ".txt.bz2", ".txt.gz")


def restore_measurement(
    path: Path, found: dict[str, Any], tracks: Tracks, rows: Indices | None = None
) -> None:
    """Give tracks the unit and the whitening of a file, where it has them.

    Parameters
    ----------
    path : Path
        The file for messages.
    found : dict
        Its arrays.
    tracks : Tracks
        Read from it.
    rows : ndarray of int, shape (N,), optional
        The row in the file of each observation of the tracks; by default those of `order`.

    Raises
    ------
    FileFormatError
        If the arrays are none that `arrays_of` makes.
    """
    unit, whitening = found.get("unit"), found.get("whitening")
    if unit is not None:
        if unit.shape != () or unit.dtype.kind != "f" or not 0.0 < unit < np.inf:
            raise FileFormatError(path, "unit is no positive number")
        tracks.unit = float(unit)
    if whitening is None:
        return
    if whitening.shape != (len(found["view"]), 2, 2) or whitening.dtype.kind != "f":
        was = f"whitening has type {whitening.dtype}, shape {whitening.shape}"
        raise FileFormatError(path, f"{was}; needed: floats ({len(found['view'])}, 2, 2)")
    with np.errstate(all="ignore"):
        bad = np.flatnonzero(~(np.abs(np.linalg.det(whitening) - 1.0) < 1e-6))
    if len(bad):
        raise FileFormatError(path, f"whitening has no determinant of one in row {bad[0]}")
    rows = tracks.order if rows is None else rows
    tracks.whitening = np.ascontiguousarray(whitening[rows].transpose(1, 2, 0))


def rows_of(
    tracks: Tracks, views: Indices, points: Indices, found: tuple[Indices, Indices, Array]
) -> Indices:
    """Return the row in the file of each observation, by view, point and place."""
    mine = np.column_stack([views[tracks.view], points[tracks.point], tracks.xy])
    both = np.vstack([np.column_stack(found), mine])
    first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)[1:]
    return np.asarray(first[inverse.ravel()[len(both) - len(mine) :]])


def form_of(path: PathLike) -> str:
    """Return the suffix that chooses the form of a file."""
    name = Path(path).name.lower()
    for suffix in SUFFIXES:
        if name.endswith(suffix) and name != suffix:
            return suffix
    raise ArgumentError("path", f"is {str(path)!r}", f"a name ending in {listed(SUFFIXES)}")


def read_tracks(
    path: Path, with_start: bool, image_size: ArrayLike | None = None
) -> dict[str, Any]:
    """Read whatever a file holds."""
    try:
        form = form_of(path)
    except ArgumentError as error:
        if path.exists():
            raise
        was = f"is {str(path)!r}, which does not exist"
        raise ArgumentError("path", was, f"{error.needed}; or a COLMAP folder") from None
    with path.open("rb") as file:
        head = file.read(len(OPENSFM))
        file.seek(0)
        if form == ".csv" and head == OPENSFM:
            return read_opensfm(path, file, image_size)
        if image_size is not None:
            raise ArgumentError("image_size", f"is given for {path.name!r:.60}", "OpenSfM's tracks")
        if form == ".npz":
            start = ("P", "Q", "X", "lines") if with_start else ()
            optional = (*MEASURED, "weights", "clean", "n_views", "n_points", *start)
            return dict(
                read_npz(path, file, [_TRACKS, ("P", "Q"), ("P", "X")], optional, ["names"])
            )
        if form == ".csv":
            columns = read_text(path, file, _COLUMNS, "clean")
            found = {"view": columns["view"], "point": columns["point"]}
            found["xy"] = np.column_stack([columns["x"], columns["y"]])
            found |= {"weights": columns["weight"]} if "weight" in columns else {}
            if "view_names" in columns:  # numbered by their order, whatever that of the rows
                names = columns["view_names"]
                found["names"] = sorted(names)
                rank = {name: k for k, name in enumerate(found["names"])}
                found["view"] = np.array([rank[name] for name in names])[found["view"]]
            return found | ({"clean_rows": columns["clean"]} if "clean" in columns else {})
        with decompressing(file, form) as stream:
            problem = read_bal(path, stream)
    return problem | {"P": projective_cameras(problem.pop("cameras"))}


def check_observations(path: Path, found: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Check what must hold before indices are used as sizes of arrays."""
    view, point, xy = (found[name] for name in _TRACKS)
    for name, index in (("view", view), ("point", point)):
        if index.ndim != 1 or index.dtype.kind not in "iu" or len(index) != len(view):
            reason = f"{name} has type {index.dtype}, shape {index.shape}; needed: integers (N,)"
            raise FileFormatError(path, reason)
        bad = np.flatnonzero((index < 0) | (index >= MAX_MATCHES))
        if len(bad):
            reason = f"{name} is {index[bad[0]]} in row {bad[0]}, needed: 0 to {MAX_MATCHES - 1}"
            raise FileFormatError(path, reason)
    if xy.shape != (len(view), 2) or xy.dtype.kind not in "iuf":
        reason = f"xy has type {xy.dtype}, shape {xy.shape}; needed: numbers ({len(view)}, 2)"
        raise FileFormatError(path, reason)
    return view, point, xy


def kept_rows(
    path: Path,
    found: dict[str, Any],
    view: Indices,
    point: Indices,
    clean: bool,
    views: Iterable[int] | None,
) -> NDArray[np.bool_] | None:
    """Return which observations are asked for; None for all of them."""
    if not clean and views is None:
        return None
    keep = np.ones(len(view), dtype=np.bool_)
    if views is not None:
        keep &= np.isin(view, list(views))
    if clean:
        keep &= _clean_rows(path, found, point)
    if not keep.any():
        raise FileFormatError(path, "holds no observation of those asked for")
    return keep


def _clean_rows(path: Path, found: dict[str, Any], point: Indices) -> NDArray[np.bool_]:
    """Return which observations are marked as clean."""
    if "clean_rows" in found:
        return np.asarray(found["clean_rows"])
    if "clean" not in found:
        raise FileFormatError(path, "marks nothing as clean: it has no clean column or array")
    marks = found["clean"]
    if marks.ndim != 1 or marks.dtype.kind not in "biu" or len(marks) <= point.max(initial=-1):
        reason = f"clean has type {marks.dtype}, shape {marks.shape}; needed: one mark a point"
        raise FileFormatError(path, reason)
    return np.asarray(marks[point] != 0)


def start_of(path: Path, found: dict[str, Any]) -> Reconstruction | None:
    """Return cameras and points, where there are both."""
    Q = found.get("Q", found.get("X"))
    if "P" not in found or Q is None:
        return None
    if Q.ndim == 2 and Q.shape[1] == 3:
        Q = np.column_stack([Q, np.ones(len(Q))])
    try:
        P, lines = found["P"].astype(np.float64), found.get("lines")
        return Reconstruction(P, Q.astype(np.float64), lines)
    except ArgumentError as error:
        raise FileFormatError(path, str(error)) from None


def count_of(path: Path, name: str, found: dict[str, Any]) -> int | None:
    """Check a number of views or points."""
    if name not in found:
        return None
    count = found[name]
    if count.shape != () or count.dtype.kind not in "iu" or not 0 < count <= MAX_MATCHES:
        raise FileFormatError(path, f"{name} is no number from 1 to {MAX_MATCHES}")
    return int(count)


def decompressing(file: IO[bytes], form: str) -> AbstractContextManager[Any]:
    """Return a stream of the content of a file whose suffix is given."""
    if not form.endswith(("gz", "bz2")):
        return nullcontext(file)
    return gzip.GzipFile("", "rb", fileobj=file) if form.endswith("gz") else bz2.BZ2File(file)
