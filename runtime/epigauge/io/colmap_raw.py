"""Raw matches of a COLMAP database out, verified pairs in.

Beside what `epigauge.io.colmap` reads, of a COLMAP database is used:

- ``matches``: pair_id, rows, cols, data: two uint32 a row, the numbers of the keypoints of a match;
- ``cameras``: model, width, height, params, prior_focal_length;
- ``two_view_geometries``: a row is added for every pair that has none; E and H as F, qvec and tvec.
"""

from __future__ import annotations

import functools
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.io._colmap_lens import bend_px, calibration, undistorted
from epigauge.io._colmap_rows import MAX_IMAGES, joined
from epigauge.io._sqlite import sqlite_errors
from epigauge.io.colmap import _IMAGES_KEPT, ColmapDatabase

__all__ = ["Geometry", "RawDatabase", "RawPair"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def _nowhere() -> Array:
    return np.zeros((0, 2))


@dataclass(frozen=True)
class RawPair:
    """The raw matches of two images.

    Parameters
    ----------
    pair_id : int
        COLMAP's number.
    reason : str
        Why the pair cannot be used; empty if it can.
    matches : ndarray of uint32, shape (m, 2)
        Numbers of the keypoints. Empty, as all else, where the pair cannot be used.
    x1, x2 : ndarray, shape (m, 2)
        Places in COLMAP's pixels, undistorted where the cameras are known.
    raw1, raw2 : ndarray, shape (m, 2)
        Where they were found.
    K1, K2 : ndarray, shape (3, 3), or None
        Calibration matrices, where COLMAP knows the focal lengths of both before (from EXIF).
    sizes : tuple of (float, float) or None
        Width and height of both images, None where not known.
    bend_px : float
        How far lenses of models that are not known here bend the points, else 0.
    """

    pair_id: int
    reason: str = ""
    matches: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((0, 2), np.uint32))
    x1: Array = field(default_factory=_nowhere)
    x2: Array = field(default_factory=_nowhere)
    raw1: Array = field(default_factory=_nowhere)
    raw2: Array = field(default_factory=_nowhere)
    K1: Array | None = None
    K2: Array | None = None
    sizes: tuple[tuple[float, float] | None, tuple[float, float] | None] = (None, None)
    bend_px: float = 0.0


@dataclass(frozen=True)
class Geometry:
    """A row of ``two_view_geometries``: inliers by the numbers of their keypoints, and matrices."""

    pair_id: int
    config: int
    inliers: NDArray[np.uint32]
    F: Array | None = None
    E: Array | None = None
    H: Array | None = None


class RawDatabase(ColmapDatabase):
    """A COLMAP database whose raw matches are verified; see `ColmapDatabase`.

    What is stored counts after `commit`, with which another transaction begins.
    """

    tables = (
        ("images", "image_id", ("name",)),
        ("keypoints", "image_id", ("rows", "cols", "data")),
        ("matches", "pair_id", ("rows", "cols", "data")),
        ("two_view_geometries", "pair_id", ("rows", "cols", "data", "config", "F", "E", "H")),
    )

    def open_pairs(self) -> tuple[list[int], int]:
        """Return the pairs with raw matches that are not verified, and how many others are."""
        query = "SELECT pair_id FROM matches WHERE rows > 0 {} ORDER BY pair_id"
        left = "AND pair_id NOT IN (SELECT pair_id FROM two_view_geometries)"
        with sqlite_errors(self.path):
            every = self._connection.execute(query.format("")).fetchall()
            ids = [number for (number,) in self._connection.execute(query.format(left))]
        return ids, len(every) - len(ids)

    def raw_pairs(self, ids: Sequence[int]) -> list[RawPair]:
        """Read the raw matches of some pairs."""
        with sqlite_errors(self.path):
            return [self._raw(number) for number in ids]

    def store_geometries(self, rows: Iterable[Geometry]) -> list[bool]:
        """Add verified pairs; return of each whether it had no row yet, and was added."""
        own = self._own_columns
        form = (
            f"INSERT OR IGNORE INTO two_view_geometries ({', '.join(own)}) "
            f"VALUES ({', '.join('?' * len(own))})"
        )
        added = []
        with sqlite_errors(self.path):
            for row in rows:
                values = {
                    "pair_id": row.pair_id,
                    "rows": len(row.inliers),
                    "cols": 2,
                    "data": np.ascontiguousarray(row.inliers, "<u4").tobytes(),
                    "config": row.config,
                    **{name: _bytes(getattr(row, name)) for name in ("F", "E", "H")},
                    # COLMAP 3 takes what it has not computed for the identity
                    "qvec": _bytes(np.array([1.0, 0.0, 0.0, 0.0])),
                    "tvec": _bytes(np.zeros(3)),
                }
                cursor = self._connection.execute(form, [values[name] for name in own])
                added.append(cursor.rowcount == 1)
        return added

    def commit(self) -> None:
        """Make what was stored count, and go on."""
        super().commit()
        with sqlite_errors(self.path):
            self._connection.execute("BEGIN IMMEDIATE")

    @functools.cached_property
    def _own_columns(self) -> list[str]:
        rows = self._connection.execute("PRAGMA table_info(two_view_geometries)").fetchall()
        own = ["pair_id", "rows", "cols", "data", "config", "F", "E", "H"]
        (version,) = self._connection.execute("PRAGMA user_version").fetchone()
        if version < 4_000_000:
            own += [name for name in ("qvec", "tvec") if name in {row[1] for row in rows}]
        return own

    def _raw(self, pair_id: int) -> RawPair:
        query = "SELECT rows, cols, data FROM matches WHERE pair_id = ?"
        row = self._connection.execute(query, (pair_id,)).fetchone()
        rows, cols, data = row
        found = joined(pair_id, rows, cols, data, self._places, "matches")
        if isinstance(found, str):
            return RawPair(pair_id, found)
        numbers, *raw = found
        images = divmod(pair_id, MAX_IMAGES)
        x, bends, cameras = [], [0.0], [self._row_of_camera(image) for image in images]
        for image, places, own, camera in zip(images, raw, numbers.T, cameras, strict=True):
            straight = self._straight(image)
            if straight is None:
                bends.append(bend_px(camera[:2] if camera else None, places))
            straight = places if straight is None else straight[own]
            if not np.isfinite(straight).all():
                bad = own[np.flatnonzero(~np.isfinite(straight).all(axis=1))[0]]
                return RawPair(
                    pair_id, f"the camera of image {image} sees no ray at its keypoint {bad}"
                )
            x.append(straight)
        sizes = [
            (float(c[2]), float(c[3])) if c and _is_size(c[2]) and _is_size(c[3]) else None
            for c in cameras
        ]
        calibrated = all(camera and camera[4] == 1 for camera in cameras)
        K = [calibration(camera[:2]) if calibrated and camera else None for camera in cameras]
        K1, K2 = K
        both = K1 is not None and K2 is not None
        return RawPair(
            pair_id,
            matches=numbers,
            x1=x[0],
            x2=x[1],
            raw1=raw[0],
            raw2=raw[1],
            K1=K1 if both else None,
            K2=K2 if both else None,
            sizes=(sizes[0], sizes[1]),
            bend_px=max(bends),
        )

    @functools.cached_property
    def _places(self) -> Any:
        return functools.lru_cache(_IMAGES_KEPT)(self._keypoints)

    @functools.cached_property
    def _straight(self) -> Any:
        """Undistorted keypoints of an image; None where its camera is of a model unknown here."""

        def straight(image: int) -> Array | None:
            camera = self._row_of_camera(image)
            return undistorted(camera[:2] if camera else None, self._places(image).astype(float))

        return functools.lru_cache(_IMAGES_KEPT)(straight)

    @functools.cached_property
    def _row_of_camera(self) -> Any:
        query = (
            "SELECT model, params, width, height, prior_focal_length FROM cameras "
            "JOIN images USING (camera_id) WHERE image_id = ?"
        )

        def row(image: int) -> tuple[Any, ...] | None:
            try:
                found: tuple[Any, ...] | None = self._connection.execute(query, (image,)).fetchone()
            except sqlite3.OperationalError:  # no such table or column
                return None
            return found

        return functools.cache(row)


def _is_size(value: Any) -> bool:
    return isinstance(value, int) and 0 < value < 10**9


def _bytes(matrix: Array | None) -> bytes | None:
    return None if matrix is None else np.ascontiguousarray(matrix, "<f8").tobytes()
