"""NPZ files, read without unpickling and with sizes checked before allocating; and written."""

from __future__ import annotations

import math
import os
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.errors import FileFormatError
from epigauge.io._common import MAX_MATCHES, cut, listed

_MAX_VALUES = 4 * MAX_MATCHES
_MAX_HEADER = 1000
_DESCR = re.compile(r"'descr': *'([^']*)'")
_NUMBERS = re.compile(r"[<>|=]?[biuf]\d{1,2}")
#: Text; numbers or text.
_WORDS = re.compile(r"[<>|=]?U\d{1,5}")
_PLAIN = re.compile(r"[<>|=]?(?:[biuf]\d{1,2}|U\d{1,5})")
_ORDER = re.compile(r"'fortran_order': *(True|False)")
_SHAPE = re.compile(r"'shape': *\(([0-9, ]{0,100})\)")


def read_npz(
    path: Path,
    file: IO[bytes],
    needed: Sequence[Sequence[str]],
    optional: Sequence[str] = (),
    words: Sequence[str] = (),
) -> dict[str, NDArray[Any]]:
    """Read some arrays of an NPZ file; the others are not looked at.

    Parameters
    ----------
    path : Path
        Name of the file for messages.
    file : binary file
        Its content, seekable.
    needed : sequence of sequence of str
        Alternatives: the first group of arrays that the file holds is read.
    optional : sequence of str
        Arrays read where the file holds them.
    words : sequence of str
        The same, of text.

    Returns
    -------
    dict
        The arrays by name.

    Raises
    ------
    FileFormatError
        Naming the array at fault.
    """
    if not file.read(1):
        raise FileFormatError(path, "is empty")
    with damage(path, "is not a readable NPZ (ZIP) file"), zipfile.ZipFile(file) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        for group in needed:
            if all(name in members for name in group):
                break
        else:
            alternatives = ", or ".join(" and ".join(group) for group in needed)
            raise FileFormatError(
                path, f"needs arrays {alternatives}; it holds {listed(list(members))}"
            )
        wanted = [*(name for name in optional if name in members), *group]
        found = {name: _read_npy(path, archive, members[name]) for name in wanted}
        for name in words:
            if name in members:
                found[name] = _read_npy(path, archive, members[name], _WORDS)
        return found


def read_every_array(path: Path, file: IO[bytes]) -> dict[str, NDArray[Any]]:
    """Read all arrays of an NPZ file, numbers and text, as `read_npz` does."""
    if not file.read(1):
        raise FileFormatError(path, "is empty")
    with damage(path, "is not a readable NPZ (ZIP) file"), zipfile.ZipFile(file) as archive:
        return {
            name.removesuffix(".npy"): _read_npy(path, archive, name, _PLAIN)
            for name in archive.namelist()
        }


def read_npy(path: Path, file: IO[bytes]) -> NDArray[Any]:
    """Read an NPY file of numbers, having checked its type and size before allocating it.

    Raises
    ------
    FileFormatError
        If it is none, or larger than it may be.
    """
    with damage(path, "is not a readable NPY file"):
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        return _values(path, path.stem, file, size, _NUMBERS)


def _read_npy(
    path: Path, archive: zipfile.ZipFile, member: str, types: re.Pattern[str] = _NUMBERS
) -> NDArray[Any]:
    """Read one array, having checked its declared type and size before allocating it."""
    name = member.removesuffix(".npy")
    with damage(path, f"array {name} is damaged"), archive.open(member) as stream:
        return _values(path, name, stream, archive.getinfo(member).file_size, types)


def _values(
    path: Path, name: str, stream: IO[bytes], declared: int, types: re.Pattern[str]
) -> NDArray[Any]:
    """Read header and values of an array in a stream of so many bytes."""
    shape, by_columns, dtype = _read_header(path, name, stream, types)
    if not all(0 <= side <= MAX_MATCHES for side in shape) or math.prod(shape) > _MAX_VALUES:
        raise FileFormatError(
            path, f"array {name} has shape {cut(shape)}, needed: at most {MAX_MATCHES} rows"
        )
    size = math.prod(shape) * dtype.itemsize
    if size > declared:
        raise FileFormatError(
            path, f"array {name} is cut short: {size} bytes of data in a member of {declared}"
        )
    data = stream.read(size)
    # Reading on to the end of the member makes zipfile check its sum.
    if len(data) != size or stream.read(1):
        raise FileFormatError(path, f"array {name} has not the size that its header declares")
    values = np.frombuffer(data, dtype=dtype)
    return values.reshape(shape, order="F" if by_columns else "C")


def _read_header(
    path: Path, name: str, stream: IO[bytes], types: re.Pattern[str]
) -> tuple[tuple[int, ...], bool, Any]:
    """Read shape, order and type of an npy array.

    NumPy's own reader evaluates the header as Python source and, for files of Python 2, tokenises
    it: more than a file of numbers needs, and on hostile input it raises whatever those raise.
    """
    magic = stream.read(8)
    if magic not in (b"\x93NUMPY\x01\x00", b"\x93NUMPY\x02\x00"):
        raise FileFormatError(path, f"array {name} is not in npy format, version 1 or 2")
    length = int.from_bytes(stream.read(2 if magic[6] == 1 else 4), "little")
    header = stream.read(min(length, _MAX_HEADER)).decode("ascii")
    order, shape = _ORDER.search(header), _SHAPE.search(header)
    if len(header) != length or order is None or shape is None:
        raise FileFormatError(path, f"array {name} is damaged: npy header {cut(header)!r}")
    descr = _DESCR.search(header)
    if descr is None or not types.fullmatch(descr[1]):
        kind = "structured values" if descr is None else f"values of type {cut(descr[1])}"
        raise FileFormatError(path, f"array {name} holds {kind}, needed: plain numbers")
    return (
        tuple(map(int, shape[1].replace(",", " ").split())),
        order[1] == "True",
        np.dtype(descr[1]),
    )


def write_npz(file: IO[bytes], arrays: Mapping[str, ArrayLike], *, compressed: bool = True) -> None:
    """Write arrays as `numpy.savez_compressed` does, but let an interruption through.

    On the way out NumPy closes the archive also where Ctrl-C came in the middle of an array: then
    that fails, and its error takes the place of the interruption.

    Parameters
    ----------
    file : binary file
        Where to write to; what was written of it is useless after an exception.
    arrays : mapping of str to array_like
        No objects.
    compressed : bool
        Smaller, and ten times slower to write.
    """
    archive = zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED)
    try:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
        archive.close()
    except BaseException:
        archive.fp = None  # so that it does not try again to end its table of contents
        raise


@contextmanager
def damage(path: Path, what: str) -> Iterator[None]:
    """Turn what the readers raise on a damaged file into one kind of error.

    That is whatever ZIP, its decompressors and NumPy happen to raise: errors of a dozen types.
    """
    try:
        yield
    except FileFormatError:
        raise
    except Exception as error:
        reason = cut(str(error) or type(error).__name__, limit=100)
        raise FileFormatError(path, f"{what}: {reason}") from error
