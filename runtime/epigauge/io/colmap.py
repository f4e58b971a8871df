"""COLMAP databases: verified pairs of images out, fundamental matrices in.

A COLMAP database is an SQLite file. What is used of it:

- ``images``: image_id, name;
- ``keypoints``: image_id, rows, cols, data: float32 row by row, of which the first two of 2, 4 or 6
  columns are x and y in pixels. (0.5, 0.5) is the middle of the top-left pixel;
- ``two_view_geometries``: pair_id, rows, cols, data: two uint32 a row, the numbers of the keypoints
  of an inlier; config; F: nine float64 row by row, little-endian, ``x2^T F x1 = 0``.

``pair_id = 2147483647 image_id1 + image_id2`` with image_id1 < image_id2: the image of the smaller
number is the first one. ``PRAGMA user_version`` tells which COLMAP opened the file last: 3400 for
3.4, 3900 from 3.9 to 3.13, 4020100 for 4.2.1; files that a script made have 0.

Files are untrusted: tables must be plain ones, sizes are checked before they are used, and whatever
SQLite or its Python module raise becomes a `FileFormatError` or an `OSError`.
"""

from __future__ import annotations

import errno
import functools
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import FileFormatError
from epigauge.io._colmap_lens import bend_px
from epigauge.io._colmap_rows import CONFIGS, MAX_IMAGES, Points, fundamental, inliers, keypoints
from epigauge.io._common import MAX_MATCHES, PathLike
from epigauge.io._sqlite import connect, copy_beside, sqlite_errors, stamp

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Versions of the schema that are read: none, COLMAP 3 and COLMAP 4.0 to 4.2.
_VERSIONS = (range(1), range(3000, 4000), range(4_000_000, 4_030_000))

#: Most bytes of a value: keypoints of six columns.
_LONGEST = 24 * MAX_MATCHES

_MAX_NAME = 1024
_IMAGES_KEPT = 1000


@dataclass(frozen=True)
class VerifiedPairs:
    """Some verified pairs of a database, as `refine_fundamental_batch` takes them.

    Parameters
    ----------
    pair_id, config : ndarray of int, shape (n,)
        COLMAP's numbers for the pair and for what it took it for; -1 where that is no number.
    image_id : ndarray of int, shape (n, 2)
        Image 1 and 2.
    F : ndarray, shape (n, 3, 3)
        What the database holds, of unit norm; NaN where it holds none.
    x1, x2 : ndarray, shape (m, 2)
        Inliers of all pairs, one pair after the other, in COLMAP's pixels.
    offsets : ndarray of int, shape (n + 1,)
        Pair k has the inliers ``offsets[k]:offsets[k + 1]``.
    reasons : dict of int to str
        Why a pair has none, by its place in these arrays.
    bend_px : ndarray, shape (n,)
        How far the lenses bend the inliers, RMS of the image where it is more.
    """

    pair_id: Indices
    config: Indices
    image_id: Indices
    F: Array
    x1: Array
    x2: Array
    offsets: Indices
    reasons: dict[int, str]
    bend_px: Array

    def __len__(self) -> int:
        return len(self.pair_id)


class ColmapDatabase:
    """A COLMAP database, open from entering a ``with`` block to leaving it.

    Parameters
    ----------
    path : str or path
        The file.
    write : bool
        Whether F will be stored. All others are kept from writing as long as the database is open;
        what is stored counts only after `commit`, all at once. Without it, nothing is changed.

    Raises
    ------
    FileFormatError
        If the file is no database of a known version of COLMAP, or damaged.
    OSError
        If it cannot be opened, or another program has locked it.
    """

    #: Table, its key, and the other columns used.
    tables: ClassVar[tuple[tuple[str, str, tuple[str, ...]], ...]] = (
        ("images", "image_id", ("name",)),
        ("keypoints", "image_id", ("rows", "cols", "data")),
        ("two_view_geometries", "pair_id", ("rows", "cols", "data", "config", "F")),
    )

    def __init__(self, path: PathLike, *, write: bool = False) -> None:
        self.path = Path(path)
        self._write = write

    def __enter__(self) -> Self:
        with sqlite_errors(self.path):
            self._connection, unguarded = connect(self.path, self._write, _LONGEST)
            try:
                self._stamp = stamp(self.path) if unguarded else None
                self._connection.execute("BEGIN IMMEDIATE" if self._write else "BEGIN")
                self._check_schema()
            except BaseException:
                self._connection.close()
                raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # What was not committed is rolled back.
        with sqlite_errors(self.path):
            self._connection.close()
        if error is None and self._stamp is not None and self._stamp != stamp(self.path):
            raise OSError(errno.EBUSY, "changed while it was read: try again", str(self.path))

    def names(self) -> dict[int, str]:
        """Return the names of the images by their numbers."""
        query = f"SELECT image_id, substr(name, 1, {_MAX_NAME}) FROM images ORDER BY image_id"
        with sqlite_errors(self.path):
            return {number: str(name) for number, name in self._connection.execute(query)}

    def sizes(self) -> dict[int, tuple[int, int]]:
        """Return width and height of the images by their numbers, of those with a camera."""
        query = (
            "SELECT image_id, width, height FROM images JOIN cameras USING (camera_id) "
            "WHERE width > 0 AND height > 0"
        )
        with sqlite_errors(self.path):
            try:
                rows = self._connection.execute(query).fetchall()
            except sqlite3.OperationalError:  # no such table or column
                return {}
        return {number: (int(width), int(height)) for number, width, height in rows}

    def count(self) -> int:
        """Return the number of verified pairs: those with inliers."""
        query = "SELECT count(*) FROM two_view_geometries WHERE rows > 0"
        with sqlite_errors(self.path):
            return int(self._connection.execute(query).fetchone()[0])

    def pairs(self, at_most: int = 250) -> Iterator[VerifiedPairs]:
        """Read the verified pairs by rising pair_id, some at a time.

        Parameters
        ----------
        at_most : int
            Number of pairs at a time.

        Yields
        ------
        VerifiedPairs
            A pair that cannot be used has no inliers, and a reason.

        Raises
        ------
        FileFormatError, OSError
            If reading fails.
        """
        query = (
            "SELECT pair_id, rows, cols, data, config, F FROM two_view_geometries "
            "WHERE rows > 0 ORDER BY pair_id"
        )
        places = functools.lru_cache(_IMAGES_KEPT)(self._keypoints)
        camera = functools.cache(self._camera)

        def lens(image_id: int, points: Array) -> float:
            with sqlite_errors(self.path):
                return bend_px(camera(image_id), points)

        with sqlite_errors(self.path):
            cursor = self._connection.execute(query)
        while True:
            with sqlite_errors(self.path):
                rows = cursor.fetchmany(at_most)
                if not rows:
                    return
                found = [inliers(row, places) for row in rows]
            sizes = [0 if isinstance(pair, str) else len(pair[0]) for pair in found]
            points = [pair for pair in found if not isinstance(pair, str)]
            ids = np.array([row[0] for row in rows], np.int64)
            bends = [
                0.0 if isinstance(pair, str) else max(map(lens, divmod(row[0], MAX_IMAGES), pair))
                for row, pair in zip(rows, found, strict=True)
            ]
            yield VerifiedPairs(
                pair_id=ids,
                config=np.array([row[4] if row[4] in CONFIGS else -1 for row in rows], np.int64),
                image_id=np.column_stack([ids // MAX_IMAGES, ids % MAX_IMAGES]),
                F=np.array([fundamental(row[5]) for row in rows]),
                x1=np.concatenate([np.zeros((0, 2)), *(x1 for x1, _ in points)]),
                x2=np.concatenate([np.zeros((0, 2)), *(x2 for _, x2 in points)]),
                offsets=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
                reasons={k: pair for k, pair in enumerate(found) if isinstance(pair, str)},
                bend_px=np.array(bends),
            )

    def store(self, pairs: Iterable[tuple[int, Array]]) -> None:
        """Put fundamental matrices in the place of those that the database holds.

        Parameters
        ----------
        pairs : iterable of (int, ndarray of shape (3, 3))
            pair_id and F. Nothing else of a pair changes.

        Raises
        ------
        FileFormatError, OSError
            If writing fails.
        """
        rows = ((np.asarray(F, "<f8").tobytes(), int(pair_id)) for pair_id, F in pairs)
        with sqlite_errors(self.path):
            self._connection.executemany(
                "UPDATE two_view_geometries SET F = ? WHERE pair_id = ?", rows
            )

    def commit(self) -> None:
        """Make what was stored count."""
        with sqlite_errors(self.path):
            self._connection.execute("COMMIT")

    def backup(self) -> Path:
        """Copy the database as it was opened to a new file beside it.

        Returns
        -------
        Path
            The database's name with ``.bak`` appended, or ``.bak1``, ``.bak2`` and so on: a file
            that exists is never replaced.

        Raises
        ------
        FileFormatError, OSError
            If copying fails; no file remains.
        """
        # A second connection, since one that writes cannot be copied from
        with (
            sqlite_errors(self.path),
            closing(connect(self.path, False, _LONGEST)[0]) as source,
        ):
            return copy_beside(source, self.path)

    def _camera(self, image_id: int) -> tuple[object, object] | None:
        """Return model and parameters of an image's camera, None where nothing tells them."""
        query = "SELECT model, params FROM cameras JOIN images USING (camera_id) WHERE image_id = ?"
        try:
            row = self._connection.execute(query, (image_id,)).fetchone()
        except sqlite3.OperationalError:  # no such table or column: a database without cameras
            return None
        return None if row is None else (row[0], row[1])

    def _keypoints(self, image_id: int) -> Points | str:
        """Return the places of an image's keypoints, or what is wrong with them."""
        query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
        return keypoints(image_id, self._connection.execute(query, (image_id,)).fetchone())

    def _check_schema(self) -> None:
        """Refuse what is not a database of a known version of COLMAP."""
        path, connection = self.path, self._connection
        # A view or a virtual table has no root page; what it computes may never end.
        tables = {
            name
            for (name,) in connection.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
            )
        }
        for table, _, _ in self.tables:
            if table not in tables:
                reason = f"is no COLMAP database, or one of an old COLMAP: it has no table {table}"
                raise FileFormatError(path, reason)
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if not any(version in known for known in _VERSIONS):
            reason = f"has version {version} of COLMAP's schema; known are those up to COLMAP 4.2"
            raise FileFormatError(path, reason)
        for table, key, columns in self.tables:
            plain = {
                name: (kind.upper(), in_key)
                for _, name, kind, _, _, in_key, hidden in connection.execute(
                    f"PRAGMA table_xinfo({table})"
                )
                if not hidden  # as computed columns are
            }
            if plain.get(key) != ("INTEGER", 1):
                raise FileFormatError(
                    path, f"is no COLMAP database: {key} is not the key of {table}"
                )
            for column in columns:
                if column not in plain:
                    reason = f"table {table} has no column {column}: open it in a new COLMAP"
                    raise FileFormatError(path, reason)
        triggers = "SELECT count(*) FROM sqlite_master WHERE type = 'trigger'"
        if self._write and connection.execute(triggers).fetchone() != (0,):
            raise FileFormatError(path, "has triggers, which COLMAP does not make: not written to")
