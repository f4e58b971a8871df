"""What is found of photographs, kept while more is being found, to go on after an interruption."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.io.output import writing

__all__ = ["Unfinished"]

Arrays = dict[str, NDArray[Any]]


class Unfinished:
    """A folder beside a cache, with a file for each photograph and for the matches of each.

    A file is used again where it was made of the same photographs (path, size and time of change)
    with the same options: their digest is its name. What cannot be read is made anew.

    Parameters
    ----------
    cache : path or None
        File that the folder is named after; None keeps nothing.
    options : dict
        All that the contents depend on beside the photographs.
    """

    def __init__(self, cache: Path | None, options: dict[str, Any]) -> None:
        self.folder = None if cache is None else cache.with_name(f"{cache.name}.partial")
        self.options = options

    def get(self, kind: str, paths: list[Path], make: Callable[[], Arrays]) -> Arrays:
        """Return arrays from the folder, or make them and keep them there.

        Parameters
        ----------
        kind : str
            Of what the arrays are.
        paths : list of path
            Photographs that they are of.
        make : callable
            Makes them.

        Returns
        -------
        dict
            Arrays by name.
        """
        if self.folder is None:
            return make()
        stats = [path.stat() for path in paths]
        stamps = [
            (str(path.absolute()), stat.st_size, stat.st_mtime_ns)
            for path, stat in zip(paths, stats, strict=True)
        ]
        text = json.dumps([kind, self.options, stamps], default=str)
        digest = hashlib.sha256(text.encode()).hexdigest()[:24]
        path = self.folder / f"{kind}-{digest}.npz"
        if path.exists():
            try:
                with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
                    return {name: data[name] for name in data.files}
            except Exception:  # of the many things that NumPy raises on a damaged archive
                path.unlink()
        arrays = make()
        self.folder.mkdir(parents=True, exist_ok=True)
        with writing(path) as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        return arrays

    def done(self) -> None:
        """Remove the folder: everything is in the cache."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
