"""Measured image points by name: found on this machine, or fetched from where they were published.

>>> import epigauge as eg
>>> tracks = eg.datasets.load("corridor")  # doctest: +SKIP
>>> eg.datasets.describe("corridor").licence  # doctest: +SKIP

No data comes with epigauge. A set is looked for in the directory that the environment variable
``EPIGAUGE_DATA`` names, then in a cache (``EPIGAUGE_CACHE``, or the usual place of the operating
system). If it is in neither it is downloaded from a pinned commit of a public repository, checked
by its SHA-256 and converted (extra ``data``). Most sets have no explicit licence:
`describe` says what is known, and so does the logger ``epigauge.datasets`` at every download.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.datasets._catalogue import Dataset, Source, catalogue
from epigauge.datasets._store import PUBLIC, DatasetError, locate
from epigauge.errors import ArgumentError
from epigauge.io import Matches, load_matches, load_track_file, load_tracks
from epigauge.multi_view.tracks import Tracks

__all__ = [
    "Dataset",
    "DatasetError",
    "Source",
    "arrays",
    "describe",
    "images",
    "load",
    "names",
    "path",
]


def names(kind: str | None = None) -> tuple[str, ...]:
    """Return the names of all data sets.

    Parameters
    ----------
    kind : {"tracks", "matches"}, optional
        Only those of many views, or of two.

    Returns
    -------
    tuple of str
        In the order of the catalogue.

    Examples
    --------
    >>> import epigauge as eg
    >>> "corridor" in eg.datasets.names()
    True
    """
    if kind not in (None, "tracks", "matches"):
        raise ArgumentError("kind", f"is {kind!r}", "'tracks', 'matches' or None")
    return tuple(name for name, entry in catalogue().items() if kind in (None, entry.kind))


def describe(name: str) -> Dataset:
    """Say what a data set is, where it comes from and under which licence; nothing is fetched.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    Dataset
        Its entry of the catalogue.

    Raises
    ------
    ArgumentError
        If there is no such set; the message names those with similar names.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.datasets.describe("corridor").kind
    'tracks'
    """
    entry = catalogue().get(name) if isinstance(name, str) else None
    if entry is None:
        raise ArgumentError("name", f"is {name!r}", _instead(name))
    return entry


def path(name: str, *, base_url: str = PUBLIC) -> Path:
    """Return the file of a data set, fetching it first where it is not on this machine.

    Parameters
    ----------
    name : str
        One of `names`.
    base_url : str
        Where to fetch from: a mirror holds ``repository/commit/path`` under it.

    Returns
    -------
    Path
        An NPZ or BAL file for `load_tracks` and `load_matches`. It is complete: an interrupted
        download leaves nothing behind.

    Raises
    ------
    ArgumentError
        If there is no such set.
    DatasetError
        If it is not here and cannot be fetched: no connection, another SHA-256 than the pinned
        one, or a set that is not offered for download.
    MissingPackageError
        If it has to be fetched and the extra ``data`` is not installed.

    Examples
    --------
    >>> eg.datasets.path("corridor")  # doctest: +SKIP
    """
    entry = describe(name)
    return locate(entry, entry.file, entry.sources, base_url, entry.convert)


def images(name: str, *, base_url: str = PUBLIC) -> tuple[Path, ...]:
    """Return the image files that come with a data set, fetching them as `path` does.

    Parameters
    ----------
    name : str
        One of `names`.
    base_url : str
        As for `path`.

    Returns
    -------
    tuple of Path
        In the order of the views; empty for most sets.

    Raises
    ------
    ArgumentError, DatasetError, MissingPackageError
        As for `path`.

    Examples
    --------
    >>> import epigauge as eg
    >>> [path.name for path in eg.datasets.images("house")]  # doctest: +SKIP
    """
    entry = describe(name)
    return tuple(
        locate(entry, file, (source,), base_url, "unchanged")
        for file, source in entry.images.items()
    )


def load(
    name: str,
    *,
    clean: bool = False,
    views: Iterable[int] | None = None,
    base_url: str = PUBLIC,
) -> Tracks | Matches:
    """Load a data set by name.

    Parameters
    ----------
    name : str
        One of `names`.
    clean : bool
        Keep only what the set marks as free of gross errors; refused where it marks nothing.
    views : iterable of int, optional
        Keep only these views of a sequence.
    base_url : str
        As for `path`.

    Returns
    -------
    Tracks or Matches
        As from `load_tracks` or `load_matches`, in pixels.

    Raises
    ------
    ArgumentError, DatasetError, MissingPackageError
        As for `path`.
    FileFormatError
        If the file found is damaged, or marks nothing as clean.

    Examples
    --------
    >>> eg.datasets.load("corridor")  # doctest: +SKIP
    Tracks(11 views, 737 points, 4035 observations)
    """
    if describe(name).kind == "tracks":
        return load_tracks(path(name, base_url=base_url), clean=clean, views=views)
    if views is not None:
        raise ArgumentError("views", f"is given for the image pair {name!r}", "None")
    return load_matches(path(name, base_url=base_url), inliers=clean)


def arrays(name: str, *, base_url: str = PUBLIC) -> dict[str, NDArray[Any]]:
    """Load every array of a data set, with what is known beyond the measured points.

    Parameters
    ----------
    name : str
        One of `names`.
    base_url : str
        As for `path`.

    Returns
    -------
    dict of str to ndarray
        ``view``, ``point``, ``xy`` or ``x1``, ``x2``; further, where the set has them, marks
        (``clean``, ``inlier``, ``label``), image sizes, cameras ``P`` and points ``Q`` or ``X``,
        calibrations ``K``, and true fundamental matrices ``F_true``.

    Raises
    ------
    ArgumentError, DatasetError, MissingPackageError
        As for `path`.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.datasets.arrays("house")["P"].shape  # doctest: +SKIP
    """
    file = path(name, base_url=base_url)
    if file.suffix == ".npz":
        with np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    found = load_track_file(file)
    assert found.start is not None, "a BAL problem has cameras and points"
    observed = {"view": found.tracks.view, "point": found.tracks.point, "xy": found.tracks.xy}
    return observed | {"P": found.start.P, "Q": found.start.Q}


def _instead(name: object) -> str:
    """Say which names there are, close ones first."""
    # Only on a mistake: difflib is not worth its import otherwise.
    from difflib import get_close_matches

    by_lower = {known.lower(): known for known in catalogue()}
    close = [by_lower[found] for found in get_close_matches(str(name).lower(), by_lower)]
    meant = f"did you mean {' or '.join(map(repr, close))}? " if close else ""
    return f"{meant}one of {', '.join(catalogue())}"
