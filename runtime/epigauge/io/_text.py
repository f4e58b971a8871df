"""Matches in text files: comma, semicolon or white space between the columns."""

from __future__ import annotations

import array
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from epigauge.errors import FileFormatError
from epigauge.io._common import MAX_MATCHES, cut, listed

COORDINATES = ("x1", "y1", "x2", "y2")

_MAX_LINE = 4096
_KNOWN = (*COORDINATES, "weight", "inlier")
_FLAGS = {"0": False, "false": False, "1": True, "true": True}


def read_text(path: Path, file: IO[bytes], inliers: bool) -> dict[str, Any]:
    """Read the columns of a text file.

    Parameters
    ----------
    path : Path
        Name of the file for messages.
    file : binary file
        Its content.
    inliers : bool
        Read the column ``inlier`` too.

    Returns
    -------
    dict
        Arrays x1, x2 (m, 2) and, where the file has them, weights (m,) and inlier (m,).

    Raises
    ------
    FileFormatError
        Naming the line at fault.
    """
    names: Sequence[str] = ()
    wanted: list[int] = []
    separator: str | None = None
    flag_at: int | None = None
    values, flags = array.array("d"), bytearray()
    for line, text, comment in _lines(path, file):
        if not text:
            fields = _split(comment, _separator(comment))
            if not names and set(COORDINATES) <= set(fields) <= set(_KNOWN):
                names = _names(path, fields, line)
            continue
        first = not wanted
        if first:
            separator = _separator(text)
        fields = _split(text, separator)
        header = first and not any(map(_is_number, fields))
        if header:
            names = _names(path, fields, line)
        names = names or COORDINATES
        if len(fields) != len(names):
            raise FileFormatError(path, _column_count(len(fields), names), line)
        if first:
            wanted = [names.index(name) for name in (*COORDINATES, "weight") if name in names]
            flag_at = names.index("inlier") if inliers and "inlier" in names else None
        if header:
            continue
        if len(values) >= MAX_MATCHES * len(wanted):
            raise FileFormatError(path, f"holds more than {MAX_MATCHES} matches", line)
        values.extend(_row(path, [fields[column] for column in wanted], line))
        if flag_at is not None:
            flags.append(_flag(path, fields[flag_at], line))
    if not values:
        raise FileFormatError(path, "holds no matches" if file.tell() else "is empty")
    table = np.array(values).reshape(-1, len(wanted))
    found: dict[str, Any] = {"x1": table[:, 0:2], "x2": table[:, 2:4]}
    if "weight" in names:
        found["weights"] = table[:, 4]
    if flag_at is not None:
        found["inlier"] = np.frombuffer(flags, dtype=np.bool_)
    return found


def _lines(path: Path, file: IO[bytes]) -> Iterator[tuple[int, str, str]]:
    """Yield (number, text, comment) of each line, without reading more than one at a time."""
    line = 0
    while raw := file.readline(_MAX_LINE + 1):
        line += 1
        text, _, comment = _decoded(path, raw, line).partition("#")
        yield line, text.strip(), comment.strip()


def _decoded(path: Path, raw: bytes, line: int) -> str:
    """Decode one line of text."""
    if line == 1 and raw.startswith((b"PK\x03\x04", b"\xff\xfe", b"\xfe\xff")):
        remedy = "name it .npz" if raw.startswith(b"PK") else "save it as UTF-8 text"
        kind = "a ZIP archive" if raw.startswith(b"PK") else "UTF-16 text"
        raise FileFormatError(path, f"is {kind}: {remedy}")
    if len(raw) > _MAX_LINE:
        raise FileFormatError(path, f"line longer than {_MAX_LINE} bytes", line)
    try:
        return raw.decode("utf-8-sig" if line == 1 else "utf-8")
    except UnicodeDecodeError:
        raise FileFormatError(path, "is not text (UTF-8)", line) from None


def _separator(text: str) -> str | None:
    """Find what separates the columns; None stands for white space."""
    return next((mark for mark in ";," if mark in text), None)


def _split(text: str, separator: str | None) -> list[str]:
    """Split a line into fields, without the blanks and quotes around them."""
    fields = [field.strip() for field in text.split(separator)]
    return [field.strip("\"'") for field in fields] if '"' in text or "'" in text else fields


def _names(path: Path, fields: Sequence[str], line: int) -> list[str]:
    """Check the names of the columns."""
    names = [field.lower() for field in fields]
    missing = [name for name in COORDINATES if name not in names]
    if missing:
        raise FileFormatError(
            path,
            f"no column {', '.join(missing)} among {listed(fields)}; needed: x1, y1, x2, y2",
            line,
        )
    twice = [name for name in _KNOWN if names.count(name) > 1]
    if twice:
        raise FileFormatError(path, f"two columns are called {twice[0]}", line)
    return names


def _column_count(found: int, names: Sequence[str]) -> str:
    """Say that a line has the wrong number of columns."""
    columns = f"{found} column" + ("" if found == 1 else "s")
    if names is COORDINATES:
        return f"{columns}, needed: 4 (x1 y1 x2 y2), or a first line with the names of the columns"
    return f"{columns}, needed: {len(names)} ({listed(names)})"


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def _row(path: Path, fields: Sequence[str], line: int) -> list[float]:
    """Read the numbers of one line."""
    try:
        row = list(map(float, fields))
    except ValueError:
        row = [math.nan]
    # float() accepts an underscore between digits, a table of numbers does not.
    if math.isfinite(sum(row)) and not any("_" in field for field in fields):
        return row
    return [_coordinate(path, field, line) for field in fields]


def _coordinate(path: Path, field: str, line: int) -> float:
    """Read one finite number."""
    try:
        if "_" in field:
            raise ValueError
        value = float(field)
    except ValueError:
        hint = " (write a decimal point, not a comma)" if _is_number(field) else ""
        raise FileFormatError(path, f"{cut(field)!r} is not a number{hint}", line) from None
    if not math.isfinite(value):
        raise FileFormatError(path, f"{cut(field)!r} is not finite", line)
    return value


def _flag(path: Path, field: str, line: int) -> bool:
    """Read an inlier mark."""
    try:
        return _FLAGS[field.lower()]
    except KeyError:
        raise FileFormatError(path, f"inlier is {cut(field)!r}, needed: 0 or 1", line) from None
