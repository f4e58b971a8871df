"""The memory of a worker: what a step frees, the next one takes again.

Dask starts workers with `MALLOC_TRIM_THRESHOLD_`, so that freed memory goes back to the system at
once. A step fills the same arrays as the one before; pages that are fetched anew for them cost a
fifth of it. While problems are here, the C library therefore keeps what is freed.
"""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

__all__ = ["give_back", "keep"]

#: What Dask sets; where nobody does, or somebody says more, the C library is left alone.
_SET, _ALSO = "MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"

#: Options of mallopt, and the value of the second that it begins with, and its largest one.
_TRIM, _MMAP = -1, -3
_FIRST, _MOST = 128 * 1024, 32 * 1024 * 1024

_NEVER = 2**31 - 1


def keep() -> None:
    """Keep memory that is freed from now on."""
    library = _library()
    if library is not None:
        library.mallopt(_MMAP, _MOST)
        library.mallopt(_TRIM, _NEVER)


def give_back() -> None:
    """Return freed memory to the system, now and from now on."""
    library = _library()
    if library is not None:
        library.mallopt(_MMAP, _FIRST)
        library.mallopt(_TRIM, int(os.environ[_SET]))
        library.malloc_trim(0)


def _library() -> Any:
    """Return the C library, where it can be told and what it would return is set by a number."""
    if sys.platform != "linux" or _ALSO in os.environ or not os.environ.get(_SET, "").isdigit():
        return None
    library = ctypes.CDLL(None)
    known = hasattr(library, "mallopt") and hasattr(library, "malloc_trim")  # glibc
    return library if known else None
