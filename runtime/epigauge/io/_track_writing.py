"""Writing tracks: the arrays that stand for them, and tables."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError
from epigauge.io._common import MAX_MATCHES
from epigauge.io._text import is_number
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def arrays_of(tracks: Tracks) -> dict[str, Any]:
    """Return the arrays that stand for tracks in NPZ.

    Weights only where they are not all one, names of views where there are any; unit and whitening,
    (N, 2, 2), only where the measurements had a `sigma` or a `covariance`.
    """
    found: dict[str, Any] = {"view": tracks.view, "point": tracks.point, "xy": tracks.xy}
    if (tracks.weights != 1.0).any():
        found["weights"] = tracks.weights
    if tracks.names is not None:
        found["names"] = np.array(tracks.names)
    if tracks.unit != 1.0:
        found["unit"] = np.array(tracks.unit)
    if tracks.whitening is not None:
        found["whitening"] = tracks.whitening.transpose(2, 0, 1)
    return found


def projective_arrays(reconstruction: Reconstruction) -> dict[str, Any]:
    """Return the arrays that stand for projective cameras, points and lines in NPZ."""
    found = {"P": reconstruction.P, "Q": reconstruction.Q}
    return found if reconstruction.lines is None else found | {"lines": reconstruction.lines}


def write_csv(file: IO[bytes], tracks: Tracks) -> None:
    if tracks.whitening is not None:
        was = "have coordinates measured unlike, or together, for which CSV has no place"
        raise ArgumentError("tracks", was, "a name ending in .npz")
    arrays = arrays_of(tracks)
    names = None
    if tracks.names is not None and are_numbers(tracks.names):
        names = np.array(tracks.names)
    elif tracks.names is not None:
        names = np.array(labels("names", tracks.names, int(tracks.view[0])))
    views = tracks.view if names is None else names[tracks.view]
    head = ["view", "point", "x", "y", *(["weight"] if "weights" in arrays else [])]
    columns = [views, tracks.point, *tracks.xy.T]
    columns += [arrays["weights"]] if "weights" in arrays else []
    file.write((",".join(head) + "\n").encode())
    for row in zip(*(column.tolist() for column in columns), strict=True):
        file.write((",".join(map(_written, row)) + "\n").encode())


def labels(argument: str, names: Sequence[str], first: int) -> list[str]:
    """Return names as fields of a table whose first row has one of them.

    Raises
    ------
    ArgumentError
        If they would not be read as they are: the first row says whether a column has names.
    """
    if is_number(names[first]):
        was = f"begin with {names[first]!r:.60}, which is read as a number"
        raise ArgumentError(argument, was, "other names for CSV, or NPZ")
    return [_label(argument, name) for name in names]


def are_numbers(names: Sequence[str]) -> bool:
    """Tell whether names are rising whole numbers, which readers take for numbers of views."""
    longest = len(str(MAX_MATCHES)) - 1
    if not all(name.isdecimal() and len(name) <= longest for name in names):
        return False
    numbers = [int(name) for name in names]
    rising = all(first < second for first, second in pairwise(numbers))
    return rising and [*map(str, numbers)] == [*names]


def _label(argument: str, name: str) -> str:
    """Return a name as a field, quoted where it has to be."""
    if not name.isprintable():
        raise ArgumentError(argument, f"hold {name!r:.60}", "names of one line for CSV, or NPZ")
    special = name != name.strip() or any(mark in name for mark in ",;#\"'")
    return '"' + name.replace('"', '""') + '"' if special else name


def _written(value: object) -> str:
    """Return a field of a table."""
    return value if isinstance(value, str) else repr(value)


def compressing(file: IO[bytes], form: str) -> AbstractContextManager[Any]:
    """Return a stream into a file whose suffix is given."""
    if not form.endswith(("gz", "bz2")):
        return nullcontext(file)
    # No date in the file: the same content gives the same bytes.
    if form.endswith("gz"):
        return gzip.GzipFile("", "wb", 9, file, 0.0)
    return bz2.BZ2File(file, "wb")
