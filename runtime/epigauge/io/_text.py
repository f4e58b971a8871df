"""Tables in text files: comma, semicolon or white space between the columns."""

from __future__ import annotations

import array
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from epigauge.errors import FileFormatError
from epigauge.io._common import MAX_MATCHES, cut, listed

_MAX_LINE = 4096
_FLAGS = {"0": False, "false": False, "1": True, "true": True}


@dataclass(frozen=True)
class Columns:
    """The columns that a table can have.

    Parameters
    ----------
    what : str
        What one line holds, in the plural.
    names : tuple of str
        Columns needed; this is their order where the table does not name them.
    indices : tuple of str
        Those among them that hold whole numbers from 0.
    numbers : tuple of str
        Optional columns of numbers.
    flags : tuple of str
        Optional columns of marks, 0 or 1.
    labels : tuple of str
        Those of the indices that may be names instead, such as those of files: they are numbered as
        they come, and found under the column's name and ``_names``.
    """

    what: str
    names: tuple[str, ...]
    indices: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ("weight",)
    flags: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()

    @property
    def known(self) -> tuple[str, ...]:
        """Return the names of all."""
        return (*self.names, *self.numbers, *self.flags)


def read_text(
    path: Path,
    file: IO[bytes],
    columns: Columns,
    flag: str | None = None,
    rows: list[int] | None = None,
) -> dict[str, Any]:
    """Read the columns of a text file.

    Parameters
    ----------
    path : Path
        Name of the file for messages.
    file : binary file
        Its content.
    columns : Columns
        What it can hold.
    flag : str, optional
        The one column of marks to read.
    rows : list of int, optional
        Gets the number of each row's line in the file, for messages.

    Returns
    -------
    dict
        For each column that the file has an array (m,).

    Raises
    ------
    FileFormatError
        Naming the line at fault.
    """
    names: Sequence[str] = ()
    wanted: dict[str, int] = {}
    separator: str | None = None
    flag_at: int | None = None
    values, flags = array.array("d"), bytearray()
    codes: dict[str, dict[str, str]] = {}
    for line, text, comment in text_lines(path, file):
        if not text:
            fields = _split(comment, _separator(comment))
            if not names and set(columns.names) <= set(fields) <= set(columns.known):
                names = _names(path, fields, columns, line)
            continue
        first = not wanted
        if first:
            separator = _separator(text)
        fields = _split(text, separator)
        header = first and not any(map(is_number, fields))
        if header:
            names = _names(path, fields, columns, line)
        names = names or columns.names
        if len(fields) != len(names):
            raise FileFormatError(path, _column_count(len(fields), names, columns), line)
        if first:
            read = (*columns.names, *columns.numbers)
            wanted = {name: names.index(name) for name in read if name in names}
            flag_at = names.index(flag) if flag in names else None
        if header:
            continue
        if len(values) >= MAX_MATCHES * len(wanted):
            raise FileFormatError(path, f"holds more than {MAX_MATCHES} {columns.what}", line)
        if not values:
            codes = {n: {} for n in columns.labels if not is_number(fields[wanted[n]])}
        for name, known in codes.items():
            field = fields[wanted[name]]
            fields[wanted[name]] = known.setdefault(field, str(len(known)))
        row = numbers(path, [fields[column] for column in wanted.values()], line)
        for name, value in zip(columns.indices, row, strict=False):
            _check_index(path, name, value, line)
        values.extend(row)
        if rows is not None:
            rows.append(line)
        if flag_at is not None:
            flags.append(_flag(path, names[flag_at], fields[flag_at], line))
    if not values:
        raise FileFormatError(path, f"holds no {columns.what}" if file.tell() else "is empty")
    table = np.array(values).reshape(-1, len(wanted))
    found: dict[str, Any] = dict(zip(wanted, table.T, strict=True))
    found |= {name: found[name].astype(np.intp) for name in columns.indices}
    found |= {f"{name}_names": list(known) for name, known in codes.items()}
    if flag is not None and flag_at is not None:
        found[flag] = np.frombuffer(flags, dtype=np.bool_)
    return found


def text_lines(path: Path, file: IO[bytes]) -> Iterator[tuple[int, str, str]]:
    """Yield (number, text, comment) of each line, without reading more than one at a time."""
    line = 0
    while raw := file.readline(_MAX_LINE + 1):
        line += 1
        text, comment = _without_comment(decoded(path, raw, line))
        yield line, text.strip(), comment.strip()


def decoded(path: Path, raw: bytes, line: int, longest: int = _MAX_LINE) -> str:
    """Decode one line of text."""
    if line == 1 and raw.startswith((b"PK\x03\x04", b"\xff\xfe", b"\xfe\xff")):
        remedy = "name it .npz" if raw.startswith(b"PK") else "save it as UTF-8 text"
        kind = "a ZIP archive" if raw.startswith(b"PK") else "UTF-16 text"
        raise FileFormatError(path, f"is {kind}: {remedy}")
    if len(raw) > longest:
        raise FileFormatError(path, f"line longer than {longest} bytes", line)
    try:
        return raw.decode("utf-8-sig" if line == 1 else "utf-8")
    except UnicodeDecodeError:
        raise FileFormatError(path, "is not text (UTF-8)", line) from None


def _separator(text: str) -> str | None:
    """Find what separates the columns; None stands for white space."""
    return next((mark for mark in ";," if mark in text), None)


def _without_comment(text: str) -> tuple[str, str]:
    """Return a line before and after the first # that is in no quoted field."""
    if '"' not in text:
        before, _, after = text.partition("#")
        return before, after
    marks = (k for k, letter in enumerate(text) if letter == "#")
    at = next((k for k in marks if text.count('"', 0, k) % 2 == 0), len(text))
    return text[:at], text[at + 1 :]


#: Field of a table with quotes: a quoted one, in which "" stands for ", or a plain one.
_QUOTED = {
    mark: re.compile(rf'\s*(?:"((?:[^"]|"")*)"|([^{mark}]*?))\s*({mark}|$)') for mark in ",;"
}


def _split(text: str, separator: str | None) -> list[str]:
    """Split a line into fields, without the blanks and quotes around them."""
    if separator is not None and '"' in text:
        fields, at, more = [], 0, True
        while more:
            found = _QUOTED[separator].match(text, at)
            if found is None:  # text beside a quoted field
                break
            quoted, plain, mark = found.groups()
            fields.append(plain.strip("'") if quoted is None else quoted.replace('""', '"'))
            at, more = found.end(), bool(mark)
        else:
            return fields
    fields = [field.strip() for field in text.split(separator)]
    return [field.strip("\"'") for field in fields] if '"' in text or "'" in text else fields


def _names(path: Path, fields: Sequence[str], columns: Columns, line: int) -> list[str]:
    """Check the names of the columns."""
    names = [field.lower() for field in fields]
    missing = [name for name in columns.names if name not in names]
    if missing:
        raise FileFormatError(
            path,
            f"no column {', '.join(missing)} among {listed(fields)}; "
            f"needed: {', '.join(columns.names)}",
            line,
        )
    twice = [name for name in columns.known if names.count(name) > 1]
    if twice:
        raise FileFormatError(path, f"two columns are called {twice[0]}", line)
    return names


def _column_count(found: int, names: Sequence[str], columns: Columns) -> str:
    """Say that a line has the wrong number of columns."""
    count = f"{found} column" + ("" if found == 1 else "s")
    if names is columns.names:
        order = f"{len(names)} ({' '.join(names)})"
        return f"{count}, needed: {order}, or a first line with the names of the columns"
    return f"{count}, needed: {len(names)} ({listed(names)})"


def is_number(field: str) -> bool:
    """Tell whether a field, without its quotes, stands for a number, though one with a comma."""
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def numbers(path: Path, fields: Sequence[str], line: int) -> list[float]:
    """Read the finite numbers of one line."""
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
        hint = " (write a decimal point, not a comma)" if is_number(field) else ""
        raise FileFormatError(path, f"{cut(field)!r} is not a number{hint}", line) from None
    if not math.isfinite(value):
        raise FileFormatError(path, f"{cut(field)!r} is not finite", line)
    return value


def _check_index(path: Path, name: str, value: float, line: int) -> None:
    """Check that a number can be an index."""
    if not (value.is_integer() and 0 <= value < MAX_MATCHES):
        raise FileFormatError(
            path, f"{name} is {value:g}, needed: a whole number from 0 below {MAX_MATCHES}", line
        )


def _flag(path: Path, name: str, field: str, line: int) -> bool:
    """Read a mark."""
    try:
        return _FLAGS[field.lower()]
    except KeyError:
        raise FileFormatError(path, f"{name} is {cut(field)!r}, needed: 0 or 1", line) from None
