"""The files of parts: NPZ, Parquet and Zarr, which hold the same arrays to the last bit."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import FileFormatError, MissingPackageError
from epigauge.io._npz import read_npz, write_npz
from epigauge.io.output import writing

__all__ = ["STORAGES", "read_part", "write_part"]

Arrays = dict[str, NDArray[Any]]

#: What packages raise on damaged files, beside errors of their own.
_DAMAGE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)

#: Key of the scene in the metadata of a Parquet file.
_SCENE = b"epigauge scene"


class Storage(NamedTuple):
    """How the arrays of a part are read by their names, and written."""

    read: Callable[[Path, Sequence[str]], Arrays]
    write: Callable[[Path, Arrays], None]


def read_part(path: Path, names: Sequence[str]) -> Arrays:
    """Return some arrays of a part, in the form that its suffix names.

    Raises
    ------
    FileFormatError
        Naming the file, if it cannot be read, is damaged or lacks an array.
    MissingPackageError
        If the form is read by a package that is not installed.
    """
    try:
        return STORAGES[path.suffix[1:]].read(path, names)
    except OSError as error:  # a worker's: not to be taken for its loss
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from None


def write_part(path: Path, arrays: Arrays) -> None:
    """Write the arrays of a part in the form that the suffix names."""
    STORAGES[path.suffix[1:]].write(path, arrays)


def _read_npz(path: Path, names: Sequence[str]) -> Arrays:
    with path.open("rb") as file:
        return read_npz(path, file, [names])


def _write_npz(path: Path, arrays: Arrays) -> None:
    with writing(path) as file:
        write_npz(file, arrays, compressed=False)


# ---------------------------------------------------------------- Parquet: a row a point


def _parquet() -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise MissingPackageError("pyarrow", "parquet") from None
    return pa, parquet


def _write_parquet(path: Path, arrays: Arrays) -> None:
    pa, parquet = _parquet()
    point = arrays["point"]
    edges = np.searchsorted(point, np.arange(len(arrays["X"]) + 1)).astype(np.int32)

    def column(values: NDArray[Any]) -> Any:
        flat = pa.array(np.ascontiguousarray(values).ravel())
        if values.ndim == 1:
            return flat
        return pa.FixedSizeListArray.from_arrays(flat, values[0].size)

    columns = {"number": column(arrays["number"]), "X": column(arrays["X"])}
    for name in ("view", "xy", "weights", "whitening"):
        if name in arrays:
            columns[name] = pa.ListArray.from_arrays(pa.array(edges), column(arrays[name]))
    table = pa.table(columns).replace_schema_metadata({_SCENE: arrays["scene"].tobytes().hex()})
    with writing(path) as file:
        options = {"compression": "none", "use_dictionary": False, "write_page_checksum": True}
        parquet.write_table(table, file, **options)


def _read_parquet(path: Path, names: Sequence[str]) -> Arrays:
    pa, parquet = _parquet()
    wanted = {"view" if name == "point" else name for name in names} - {"scene"}
    with path.open("rb") as file, _damage(path, "Parquet", (*_DAMAGE, pa.ArrowException)):
        opened = parquet.ParquetFile(file, page_checksum_verification=True)
        schema = opened.schema_arrow
        lacking = wanted - set(schema.names)
        if lacking or _SCENE not in (schema.metadata or {}):
            missing = ", ".join(sorted(lacking)) or "the scene"
            raise FileFormatError(path, f"needs {missing}; it holds {', '.join(schema.names)}")
        found: Arrays = {
            "scene": np.frombuffer(bytes.fromhex(schema.metadata[_SCENE].decode()), "u1")
        }
        table = opened.read(columns=sorted(wanted))
        for name in sorted(wanted):
            values, counts = table[name].combine_chunks(), None
            if pa.types.is_list(values.type):
                counts = np.diff(values.offsets.to_numpy())
                values = values.flatten()
            shape: tuple[int, ...] = (len(values),)
            if pa.types.is_fixed_size_list(values.type):
                shape = (*shape, values.type.list_size)
                values = values.flatten()
            array = values.to_numpy(zero_copy_only=True)  # which refuses values that are missing
            found[name] = array.reshape((-1, 2, 2) if name == "whitening" else shape)
            if name == "view" and counts is not None:
                found["point"] = np.repeat(np.arange(len(counts)), counts)
    return found


# ---------------------------------------------------------------- Zarr: a group in a ZIP file


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise MissingPackageError("zarr", "zarr") from None
    return zarr


def _write_zarr(path: Path, arrays: Arrays) -> None:
    store = _zarr().storage.ZipStore(path, mode="w")
    try:
        group = _zarr().create_group(store)
        for name, array in arrays.items():
            made = group.create_array(
                name, shape=array.shape, dtype=array.dtype, chunks=array.shape, compressors=None
            )
            made[...] = array
    finally:
        store.close()


def _read_zarr(path: Path, names: Sequence[str]) -> Arrays:
    zarr = _zarr()
    with _damage(path, "Zarr (ZIP)", (*_DAMAGE, zipfile.BadZipFile, RuntimeError)):
        store = zarr.storage.ZipStore(path, mode="r")
        try:
            group = zarr.open_group(store, mode="r")
            lacking = [name for name in names if name not in group]
            if lacking:
                held = ", ".join(sorted(group.array_keys()))
                raise FileFormatError(path, f"needs {', '.join(lacking)}; it holds {held}")
            return {name: np.asarray(group[name][...]) for name in names}
        finally:
            store.close()


@contextmanager
def _damage(path: Path, what: str, errors: tuple[type[Exception], ...]) -> Iterator[None]:
    """Turn what a package says of a damaged file into an error that names the file."""
    try:
        yield
    except (FileFormatError, OSError):
        raise
    except errors as error:
        reason = f"is not a readable {what} file: {error!s:.200}"
        raise FileFormatError(path, reason) from None


#: Forms by the suffixes of their files.
STORAGES = {
    "npz": Storage(_read_npz, _write_npz),
    "parquet": Storage(_read_parquet, _write_parquet),
    "zarr": Storage(_read_zarr, _write_zarr),
}
