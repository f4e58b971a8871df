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
        A result such as `FundamentalResult`: every field is written under its own name. In NPZ a
        history becomes one array a column, ``history_cost`` and so on, and a field that is a
        dataclass itself, such as a reconstruction, its own fields.
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
    """
    suffix = check_suffix(path, ".npz", ".json")
    with writing(path) as file:
        if suffix == ".json":
            file.write(json_text(plain(result) | plain(more)).encode() + b"\n")
        else:
            arrays: dict[str, Any] = {
                name: np.asarray(value) for name, value in (arrays_of_result(result) | more).items()
            }
            pickled = [name for name, array in arrays.items() if array.dtype.hasobject]
            if pickled:
                raise TypeError(f"no array form of {', '.join(pickled)}")
            write_npz(file, arrays)


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
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in _fields(value)}
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
    for field in _fields(result):
        value = getattr(result, field.name)
        if isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            for column in _fields(value[0]):
                arrays[f"{field.name}_{column.name}"] = [getattr(row, column.name) for row in value]
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            arrays |= arrays_of_result(value)
        elif value is not None:
            arrays[field.name] = value
    return arrays


def _fields(value: Any) -> tuple[dataclasses.Field[Any], ...]:
    return tuple(field for field in dataclasses.fields(value) if not field.name.startswith("_"))
