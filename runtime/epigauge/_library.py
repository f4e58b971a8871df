"""The C library: found, checked, and chosen by what the processor can do.

A wheel for x86-64 holds it three times, compiled for the baseline, for AVX2 and for AVX-512; the
arithmetic is the same to the last bit, only sums over observations round differently.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from epigauge_generated.c_backend import DIGEST as C_DIGEST

from epigauge.errors import ArgumentError, BackendError

__all__ = ["LEVELS", "NOT_COMPILED", "address", "failed", "library", "usable", "variant"]

#: Names of the variants by the level of the x86-64 ABI they need, the fastest first.
LEVELS = {4: "x86-64-v4", 3: "x86-64-v3", 0: "baseline"}

#: What is told at first use where the build has left a note that compiling failed.
NOT_COMPILED = (
    "the C library could not be compiled when epigauge was installed: NumPy computes the same, "
    "many times slower (pip install -v shows why; epigauge.set_backend('numpy') accepts it)"
)

#: Names one of them instead of the fastest that the processor can run.
CHOICE = "EPIGAUGE_PROCESSOR"


_byte = ctypes.c_char.from_buffer


@cache
def library() -> ctypes.CDLL:
    """Load the fastest variant that the processor can run and that was built.

    Returns
    -------
    ctypes.CDLL
        Functions are called without the global interpreter lock.

    Raises
    ------
    BackendError
        If there is none, or if it was built from other sources than those of this installation.
    ArgumentError
        If the environment variable EPIGAUGE_PROCESSOR asks for a variant that there is not.
    """
    return _choose()[1]


def address(array: Any) -> int | None:
    """Return the address of a contiguous array, None of None; keep the array while it is used."""
    if array is None:
        return None
    try:  # twice as fast as what NumPy offers, but for writable arrays only
        return ctypes.addressof(_byte(array))
    except (TypeError, ValueError):
        return int(array.__array_interface__["data"][0])


def variant() -> str:
    """Return the name of the loaded variant, a value of `LEVELS`."""
    return _choose()[0]


def usable() -> tuple[str, ...]:
    """Return the names of the variants that were built and that the processor can run."""
    return tuple(_usable(_files())[1])


@cache
def _choose() -> tuple[str, ctypes.CDLL]:
    files = _files()
    baseline, levels = _usable(files)
    wanted = os.environ.get(CHOICE)
    if wanted and wanted not in levels:
        raise ArgumentError(CHOICE, f"is {wanted!r}", f"one of {', '.join(levels)}, or unset")
    name = wanted or next(iter(levels))
    level = levels[name]
    return name, _loaded(files[_suffix(level)]) if level else baseline


def _usable(files: dict[str, str]) -> tuple[ctypes.CDLL, dict[str, int]]:
    """Return the baseline library, and the levels of all usable ones by name, the fastest first."""
    if "" not in files:
        if failed():
            remedy = "pip install -v shows why; mend that, then install epigauge again"
            raise BackendError("c", "could not be compiled when epigauge was installed", remedy)
        remedy = "install a C compiler, then epigauge again"
        raise BackendError("c", "was not built when epigauge was installed", remedy)
    baseline = _loaded(files[""])
    able = int(baseline.eg_processor_level())
    levels = {
        name: level for level, name in LEVELS.items() if level <= able and _suffix(level) in files
    }
    return baseline, levels


def failed() -> bool:
    """Tell whether compiling was tried and failed: pyproject.toml lets the build leave a note."""
    note = resources.files("epigauge_generated.c_backend").joinpath("not_compiled.txt")
    return note.is_file()


def _suffix(level: int) -> str:
    return f"_v{level}" if level else ""


def _files() -> dict[str, str]:
    """Return the paths of the libraries by the suffix of their names."""
    found = {}
    for entry in resources.files("epigauge_generated.c_backend").iterdir():
        stem, dot, extension = entry.name.rpartition(".")
        if dot and extension in ("so", "dll", "dylib"):
            with resources.as_file(entry) as path:
                found[stem.removeprefix("libepigauge_kernels")] = str(path)
    return found


def _loaded(path: str) -> ctypes.CDLL:
    """Load a library and check that it was built from the sources of this installation."""
    loaded = ctypes.CDLL(path)
    loaded.eg_digest.restype = ctypes.c_char_p
    remedy = "install epigauge again to rebuild it"
    if loaded.eg_digest() != C_DIGEST.encode():
        raise BackendError("c", "was built from other formulas", remedy)
    loaded.eg_sources.restype = ctypes.c_char_p
    sources = _sources()
    if sources is not None and loaded.eg_sources() != sources.encode():
        raise BackendError("c", "was built from other C sources than those beside it", remedy)
    return loaded


@cache
def _sources() -> str | None:
    """Return the digest of all C sources as CMakeLists.txt makes it; None without a checkout."""
    root = Path(__file__).resolve().parents[2]
    files = [*root.glob("generated/c/*.[ch]"), *root.glob("runtime/c/*.[ch]")]
    if not files or not (root / "CMakeLists.txt").is_file():
        return None
    files.sort(key=lambda path: path.relative_to(root).as_posix())
    digests = "".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in files)
    return hashlib.sha256(digests.encode()).hexdigest()
