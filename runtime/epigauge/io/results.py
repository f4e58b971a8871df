"""Results of solvers, as `save_result` wrote them, read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any

import numpy as np

from epigauge._results import SavedResult
from epigauge.errors import FileFormatError
from epigauge.io._common import PathLike, check_suffix
from epigauge.io._npz import damage, read_every_array

__all__ = ["load_result"]

#: Most bytes of a JSON file.
_MAX_BYTES = 1_000_000_000

#: Fields that are lists of words, also where there are none.
_WORDS = ("flags",)


def load_result(path: PathLike) -> SavedResult:
    """Read what `save_result` wrote.

    Parameters
    ----------
    path : str or path
        The file; ``.npz`` or ``.json``.

    Returns
    -------
    SavedResult
        A dict of every field by its name, which are attributes, too: numbers, words and truths as
        such, lists of numbers as arrays, `flags` as a tuple of str. In a JSON file ``null`` stands
        for NaN and infinity, which come back as NaN within arrays; a history is a list of dicts
        there, and one array a column, such as ``history_cost``, in NPZ.

    Raises
    ------
    ArgumentError
        If the suffix is another.
    FileFormatError
        If the file is damaged, or not what `save_result` writes.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import os, tempfile, epigauge as eg
    >>> scene = eg.two_view_scene(seed=1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "pair.npz")
    ...     eg.refine_fundamental(scene.x1, scene.x2).save(path)
    ...     found = eg.load_result(path)
    >>> found["F"].shape, found.success, found.kind
    ((3, 3), True, 'FundamentalResult')
    """
    suffix = check_suffix(path, ".npz", ".json")
    path = Path(path)
    with path.open("rb") as file:
        fields = _from_json(path, file) if suffix == ".json" else _from_npz(path, file)
    return SavedResult(fields | {name: tuple(fields[name]) for name in _WORDS if name in fields})


def _from_npz(path: Path, file: IO[bytes]) -> dict[str, Any]:
    arrays = read_every_array(path, file)
    return {
        name: array.item() if array.ndim == 0 else _words(array) for name, array in arrays.items()
    }


def _words(array: np.ndarray[Any, Any]) -> Any:
    """Return text as a list of str, numbers as they are."""
    return array.tolist() if array.dtype.kind == "U" else array


def _from_json(path: Path, file: IO[bytes]) -> dict[str, Any]:
    text = file.read(_MAX_BYTES + 1)
    if len(text) > _MAX_BYTES:
        raise FileFormatError(path, f"is larger than {_MAX_BYTES} bytes")
    with damage(path, "is not a readable JSON file"):
        document = json.loads(text)
    if not isinstance(document, dict):
        raise FileFormatError(path, "holds no result: its top level is no object")
    return {name: _value(value) for name, value in document.items()}


def _value(value: Any) -> Any:
    """Return a list of numbers, however deep, as an array."""
    if not isinstance(value, list) or not value:
        return value
    try:
        array = np.array(value)
        if array.dtype.hasobject:
            array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):  # dicts, words, or rows of different lengths
        return value
    return array if array.dtype.kind in "bif" else value
