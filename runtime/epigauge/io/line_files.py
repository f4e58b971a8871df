"""Segments of lines in files: CSV and NPZ."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import PathLike, check_suffix
from epigauge.io._npz import read_npz, write_npz
from epigauge.io._text import Columns, read_text
from epigauge.io._track_writing import are_numbers, labels
from epigauge.io.output import writing
from epigauge.multi_view.line_tracks import LineTracks
from epigauge.multi_view.tracks import Tracks

__all__ = ["load_line_tracks", "save_line_tracks"]

Array = NDArray[np.float64]

_ENDS = ("x1", "y1", "x2", "y2")
_COLUMNS = Columns(
    "segments",
    ("view", "line", *_ENDS),
    indices=("view", "line"),
    numbers=("sigma",),
    labels=("view", "line"),
)
_NEEDED = ("view", "line", "segments")

#: Rows in messages of `LineTracks`, which lines of the file are told for.
_ROW = re.compile(r"\brow(s?) (\d+)(?: and (\d+))?")


def load_line_tracks(path: PathLike, tracks: Tracks | None = None) -> LineTracks:
    """Read segments of lines.

    A text file (``.csv``) has a line ``view,line,x1,y1,x2,y2`` each, or a first line with the names
    of the columns: these in any order, optionally ``sigma``, the standard deviation of the end
    points' coordinates in pixels. Lines and, with `tracks`, views are numbers from 0 or names; of
    tracks whose file has gaps in its numbers of views, the numbers there.
    ``.npz`` holds arrays ``view``, ``line``, ``segments`` (N, 4), optionally ``spread`` (N, 6): the
    covariances xx, xy, yy of both end points; further ones are not looked at.

    Parameters
    ----------
    path : str or path
        The file.
    tracks : Tracks, optional
        Points in the same views, which say how many there are, and what they are called.

    Returns
    -------
    LineTracks
        The segments. Lines that are named have their names, sorted.

    Raises
    ------
    FileFormatError
        If the file does not hold segments in this form, naming the line where there is one.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.line_scene(n_lines=20, seed=1)
    >>> eg.save_line_tracks("lines.csv", scene.line_tracks)  # doctest: +SKIP
    >>> eg.load_line_tracks("lines.csv")  # doctest: +SKIP
    LineTracks(20 lines, 160 observations)
    """
    path = Path(path)
    form = check_suffix(path, ".csv", ".npz")
    _check_tracks(tracks)
    with path.open("rb") as file:
        if form == ".npz":
            return _of_arrays(path, file)
        rows: list[int] = []
        found = read_text(path, file, _COLUMNS, rows=rows)
    view, names = found["view"], found.get("line_names")
    numbered = tracks is not None and tracks.names is not None and are_numbers(tracks.names)
    if "view_names" in found:
        view = _named(path, found["view_names"], tracks, view, rows)
    elif numbered:  # numbers of the file that the tracks are of
        view = _named(path, [*map(str, range(view.max() + 1))], tracks, view, rows)
    elif tracks is not None and view.max() >= tracks.n_views:
        first = int(np.argmax(view >= tracks.n_views))
        reason = f"view is {view[first]}, needed: 0 to {tracks.n_views - 1}"
        raise FileFormatError(path, reason, rows[first])
    line = found["line"]
    if names is not None:  # numbered by their order, whatever that of the rows
        order = np.argsort(names)
        line, names = np.argsort(order)[line], [names[k] for k in order.tolist()]
    ends = np.column_stack([found[name] for name in _ENDS])
    try:
        return LineTracks(view, line, ends, sigma=found.get("sigma"), names=names)
    except ArgumentError as error:
        raise _in_file(path, error, rows) from None


def save_line_tracks(path: PathLike, lines: LineTracks, tracks: Tracks | None = None) -> None:
    """Write segments of lines so that `load_line_tracks` reads the same again.

    Parameters
    ----------
    path : str or path
        ``.csv`` (with ``sigma``) or ``.npz`` (with covariances).
    lines : LineTracks
        The segments.
    tracks : Tracks, optional
        Points in the same views: a CSV file calls views by their names, where they have some.

    Raises
    ------
    ArgumentError
        On another suffix, and for CSV on covariances that are not one number a segment, and names
        that would be read as numbers or have more than one line.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> eg.save_line_tracks("lines.csv", lines)  # doctest: +SKIP
    """
    form = check_suffix(path, ".csv", ".npz")
    if not isinstance(lines, LineTracks):
        raise ArgumentError("lines", f"is a {type(lines).__name__}", "eg.LineTracks(...)")
    _check_tracks(tracks)
    if form == ".npz":
        with writing(path) as file:
            write_npz(file, arrays_of_lines(lines))
        return
    sigma = np.sqrt(lines.spread[:, 0])
    even = lines.spread == lines.spread[:, :1] * np.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    if not even.all():
        was = "have covariances of more than one number a segment"
        raise ArgumentError("lines", was, "a name ending in .npz")
    view_names = None if tracks is None else tracks.names
    if view_names is not None and len(view_names) <= lines.view.max():
        was = f"have {len(view_names)} views, and lines name view {lines.view.max()}"
        raise ArgumentError("tracks", was, "those of the same views")
    columns: list[Sequence[Any]] = [
        _fields("tracks", view_names, lines.view.tolist(), numbers=True),
        _fields("lines", lines.names, lines.line.tolist()),
        *lines.segments.T.tolist(),
        sigma.tolist(),
    ]
    table = [",".join((*_COLUMNS.names, "sigma"))]
    table += [",".join(map(_written, row)) for row in zip(*columns, strict=True)]
    with writing(path) as file:
        file.write(("\n".join(table) + "\n").encode())


def _check_tracks(tracks: object) -> None:
    if not (tracks is None or isinstance(tracks, Tracks)):
        raise ArgumentError("tracks", f"is a {type(tracks).__name__}", "eg.Tracks(...), or none")


def arrays_of_lines(lines: LineTracks) -> dict[str, Any]:
    """Return segments as arrays."""
    found = {name: getattr(lines, name) for name in (*_NEEDED, "spread")}
    return found | ({} if lines.names is None else {"names": np.array(lines.names)})


def _written(value: object) -> str:
    return f"{value:.17g}" if isinstance(value, float) else str(value)


def _fields(
    argument: str, names: Sequence[str] | None, rows: list[int], numbers: bool = False
) -> Sequence[Any]:
    """Return a column of names, or of numbers where there are none; `numbers` may be names."""
    if names is None:
        return rows
    known = names if numbers and are_numbers(names) else labels(argument, names, rows[0])
    return [known[k] for k in rows]


def _of_arrays(path: Path, file: IO[bytes]) -> LineTracks:
    found = read_npz(path, file, [_NEEDED], ("spread",), ["names"])
    covariance, count = None, len(np.atleast_1d(found["view"]))
    if "spread" in found:
        spread = found["spread"]
        if spread.shape != (count, 6) or spread.dtype.kind != "f":
            was = f"array spread has type {spread.dtype}, shape {spread.shape}"
            raise FileFormatError(path, f"{was}; needed: floats ({count}, 6)")
        covariance = spread[:, [0, 1, 1, 2, 3, 4, 4, 5]].reshape(count, 2, 2, 2)
    names = found["names"].tolist() if "names" in found else None
    try:
        view, line, segments = (found[name] for name in _NEEDED)
        return LineTracks(view, line, segments, covariance=covariance, names=names)
    except ArgumentError as error:
        raise FileFormatError(path, str(error)) from None


def _named(
    path: Path,
    found: Sequence[str],
    tracks: Tracks | None,
    view: NDArray[np.intp],
    rows: Sequence[int],
) -> NDArray[np.intp]:
    """Return the numbers of views that the file calls by their names."""
    names = None if tracks is None else tracks.names
    known = {name: k for k, name in enumerate(names or ())}
    numbers = np.array([known.get(name, -1) for name in found], np.intp)[view]
    strange = np.flatnonzero(numbers < 0)
    if len(strange):
        name = found[view[strange[0]]]
        needed = "numbers from 0" if names is None else f"a name of the {len(names)} views"
        reason = f"view is {name!r:.60}, needed: {needed}"
        raise FileFormatError(path, reason, rows[strange[0]])
    return numbers


def _in_file(path: Path, error: ArgumentError, rows: Sequence[int]) -> FileFormatError:
    """Return an error that names lines of the file instead of rows."""
    first = _ROW.search(error.was)
    if first is None:
        return FileFormatError(path, str(error))
    told = _ROW.sub(
        lambda row: (
            f"line{row[1]} " + " and ".join(str(rows[int(k)]) for k in row.groups()[1:] if k)
        ),
        error.was,
    )
    reason = f"{error.argument} {told}; needed: {error.needed}"
    return FileFormatError(path, reason, rows[int(first[2])])
