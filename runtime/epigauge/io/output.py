"""Results as NPZ or JSON, and files that appear only when they are complete."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from epigauge._results import Result, identity
from epigauge.io._common import PathLike, check_suffix
from epigauge.io._npz import write_npz

#: A list of numbers or words as `json` breaks it up: no text in JSON holds a line break of its own.
_SHORT_LIST = re.compile(r"\[\n([^\[\]{}]*)\n\s*\]")
#: Entries that it may have to be put on one line: a camera's.
_ROW = 12


def save_result(path: PathLike, result: Any, **more: Any) -> None:
    """Write the result of a solver as NPZ or JSON.

    Parameters
    ----------
    path : str or path
        The file; ``.npz`` or ``.json`` chooses the form.
    result : dataclass
        A result such as `FundamentalResult`: every field is written under its own name, and beside
        them its type (`kind`) and the versions of epigauge and of the form (`version`, `schema`).
        In NPZ a history becomes one array a column, ``history_cost`` and so on, and a field that is
        a dataclass itself, such as a reconstruction, its own fields.
    **more
        Further fields to write.

    Raises
    ------
    ArgumentError
        If the suffix is neither of these.
    OSError
        If the file cannot be written.

    Notes
    -----
    JSON has no NaN and no infinity: they are written as ``null``.

    Examples
    --------
    >>> save_result("pair.json", result)  # doctest: +SKIP
    >>> eg.load_result("pair.json")["F"]  # doctest: +SKIP
    """
    suffix = check_suffix(path, ".npz", ".json")
    more = identity(result) | more
    with writing(path) as file:
        if suffix == ".json":
            file.write(json_text(plain(result) | plain(more)).encode() + b"\n")
        else:
            given = arrays_of_result(result) | more
            write_npz(file, {name: _as_plain_array(name, value) for name, value in given.items()})


def _as_plain_array(name: str, value: Any) -> np.ndarray[Any, Any]:
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.empty((), dtype=object)
    if array.dtype.hasobject:
        raise TypeError(f"no array form of {name}: JSON has one")
    return array


def plain(value: Any) -> Any:
    """Turn a result into what JSON can hold: dict, list, str, int, float, bool and None.

    Parameters
    ----------
    value : object
        Dataclasses become dicts, arrays and tuples lists, NaN and infinity None.

    Returns
    -------
    object
        The same as plain data.

    Raises
    ------
    TypeError
        On a type without such a form.

    Examples
    --------
    >>> import numpy as np
    >>> plain({"x": np.array([1.0, np.nan])})
    {'x': [1.0, None]}
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple) and not isinstance(value, Result):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if _has_fields(value):
        return plain(_contents(value))
    raise TypeError(f"no plain form of {type(value).__name__}")


def json_text(document: dict[str, Any]) -> str:
    """Write plain data as JSON, in which a row of a matrix is a line and not a line a number."""
    return _SHORT_LIST.sub(_on_one_line, json.dumps(document, indent=1, allow_nan=False))


def _on_one_line(found: re.Match[str]) -> str:
    items = [item.strip() for item in found[1].split(",\n")]
    return f"[{', '.join(items)}]" if len(items) <= _ROW else found[0]


@contextmanager
def writing(path: PathLike) -> Iterator[IO[bytes]]:
    """Open a file that takes its final name only after everything has been written.

    Parameters
    ----------
    path : str or path
        The file; one that exists is replaced in one step. A symbolic link is followed.

    Yields
    ------
    binary file
        A temporary file in the same directory; removed if the block raises.

    Raises
    ------
    OSError
        If the file cannot be written, or exists and is not a regular file.

    Examples
    --------
    >>> import epigauge as eg
    >>> import tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder, "a.txt")
    ...     with eg.io.writing(path) as file:
    ...         _ = file.write(b"whole")
    ...     print(path.read_text())
    whole
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise OSError(f"{os.fspath(path)}: exists and is not a regular file")
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        with _opened(temporary, path) as file:
            yield file
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _opened(temporary: Path, path: PathLike) -> IO[bytes]:
    try:
        return temporary.open("xb")
    except OSError as error:
        error.filename = os.fspath(path)  # the name that the caller knows
        raise


def arrays_of_result(result: Any) -> dict[str, Any]:
    """Turn a result into arrays for NPZ; rows of a history into columns."""
    arrays: dict[str, Any] = {}
    for name, value in (
        result._arrays() if isinstance(result, Result) else _contents(result)
    ).items():
        if isinstance(value, list | tuple) and value and _has_fields(value[0]):
            rows = [_contents(row) for row in value]
            arrays |= {f"{name}_{column}": [row[column] for row in rows] for column in rows[0]}
        elif _has_fields(value):
            arrays |= arrays_of_result(value)
        elif value is not None:
            arrays[name] = value
    return arrays


def _has_fields(value: Any) -> bool:
    """Tell whether a value is no number, text or list, but has parts with names."""
    if isinstance(value, type):
        return False
    if isinstance(value, dict):
        return bool(value)
    return isinstance(value, Result) or dataclasses.is_dataclass(value)


def _contents(value: Any) -> dict[str, Any]:
    """Return the public fields of a dataclass, a result or a dict, by name."""
    if isinstance(value, Result):
        return value._contents()
    if isinstance(value, dict):
        return {str(key): item for key, item in value.items()}
    names = [field.name for field in dataclasses.fields(value)]
    return {name: getattr(value, name) for name in names if not name.startswith("_")}
