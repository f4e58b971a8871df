"""What views and points are called and look like: checked labels of tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array
from epigauge.errors import ArgumentError

__all__ = ["MAX_SIDE", "image_sizes", "point_colours", "view_names"]

#: Largest width or height of an image.
MAX_SIDE = 2**31 - 1


def view_names(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Check the names of views: as many, all different."""
    given = tuple(names) if isinstance(names, list | tuple | np.ndarray) else (names,)
    if len(given) != count or not all(isinstance(name, str) and name for name in given):
        raise ArgumentError("names", f"are {given!r:.60}", f"{count} strings, none empty")
    repeated = [name for name, number in Counter(given).items() if number > 1]
    if repeated:
        raise ArgumentError("names", f"hold {repeated[0]!r:.60} twice", "different names")
    return tuple(map(str, given))


def image_sizes(sizes: ArrayLike, count: int) -> NDArray[np.intp]:
    """Check widths and heights of images, (n, 2)."""
    array = as_array("sizes", sizes, f"({count}, 2) integers")
    if array.dtype.kind not in "iu" or array.shape != (count, 2):
        raise ArgumentError("sizes", f"are {array.dtype} {array.shape}", f"integers ({count}, 2)")
    if not ((array > 0) & (array <= MAX_SIDE)).all():
        row = int(np.argmax(~((array > 0) & (array <= MAX_SIDE)).all(axis=1)))
        was = f"are {array[row].tolist()} in row {row}"
        raise ArgumentError("sizes", was, f"width and height, 1 to {MAX_SIDE}")
    return _read_only(array.astype(np.intp))


def point_colours(colours: ArrayLike, count: int) -> NDArray[np.uint8]:
    """Check red, green and blue of points, (m, 3)."""
    array = as_array("colours", colours, f"({count}, 3) integers")
    if array.dtype.kind not in "iu" or array.shape != (count, 3):
        raise ArgumentError("colours", f"are {array.dtype} {array.shape}", f"integers ({count}, 3)")
    if not ((array >= 0) & (array <= 255)).all():
        raise ArgumentError("colours", "have a value beyond 0 to 255", "red, green, blue, 0 to 255")
    return _read_only(array.astype(np.uint8))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.setflags(write=False)
    return array
