"""Rows of a COLMAP database: what they say, or what is wrong with them.

A row that cannot be used spoils one pair, not the database: the reason is returned, not raised.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.io._common import MAX_MATCHES, cut

Array = NDArray[np.float64]
Points = NDArray[np.float32]

#: Images a database can hold, the factor in pair_id.
MAX_IMAGES = 2147483647

#: Values of config: what COLMAP took the pair for; and why a single F does not describe it.
CONFIGS = dict.fromkeys(range(10), "") | {
    1: "COLMAP calls it degenerate",
    7: "COLMAP calls it a watermark",
    8: "COLMAP found several motions in it",
}


def keypoints(image_id: int, row: Any) -> Points | str:
    """Return the places (n, 2) of an image's keypoints.

    Parameters
    ----------
    image_id : int
        The image.
    row : (rows, cols, data) or None
        As the database holds it.

    Returns
    -------
    ndarray, shape (n, 2), or str
        COLMAP's pixels; or what is wrong with the row.
    """
    if row is None:
        return f"image {image_id} has no keypoints"
    rows, cols, data = row
    table = _table(rows, cols, data, np.dtype("<f4"), (2, 4, 6))
    return f"keypoints of image {image_id}: {table}" if isinstance(table, str) else table[:, :2]


def inliers(row: Any, keypoints_of: Callable[[int], Points | str]) -> tuple[Array, Array] | str:
    """Return the inliers of a pair.

    Parameters
    ----------
    row : (pair_id, rows, cols, data, config, F)
        As the database holds it.
    keypoints_of : callable
        `keypoints` of an image.

    Returns
    -------
    (ndarray, ndarray) of shape (m, 2), or str
        Points of image 1 and 2 in COLMAP's pixels; or why the pair cannot be used.
    """
    pair_id, rows, cols, data, config, _ = row
    if config not in CONFIGS:
        return f"config is {cut(config)}, needed: 0 to {max(CONFIGS)}"
    if CONFIGS[config]:
        return CONFIGS[config]
    found = joined(pair_id, rows, cols, data, keypoints_of, "inliers")
    return found if isinstance(found, str) else found[1:]


def joined(
    pair_id: int,
    rows: Any,
    cols: Any,
    data: Any,
    keypoints_of: Callable[[int], Points | str],
    what: str,
) -> tuple[NDArray[np.uint32], Array, Array] | str:
    """Return the keypoints that the matches of a pair join.

    Parameters
    ----------
    pair_id, rows, cols, data
        As the database holds them.
    keypoints_of : callable
        `keypoints` of an image.
    what : {"inliers", "matches"}
        What an error calls them.

    Returns
    -------
    (ndarray, ndarray, ndarray) of shape (m, 2), or str
        Numbers of the keypoints, and points of image 1 and 2 in COLMAP's pixels; or why the pair
        cannot be used.
    """
    image_ids = divmod(pair_id, MAX_IMAGES)
    if not 0 <= image_ids[0] < image_ids[1]:
        return f"pair_id {pair_id} stands for no two images"
    matches = _table(rows, cols, data, np.dtype("<u4"), (2,))
    if isinstance(matches, str):
        return f"{what}: {matches}"
    places = []
    for column, image_id in enumerate(image_ids):
        points = keypoints_of(image_id)
        if isinstance(points, str):
            return points
        numbers = matches[:, column]
        if len(numbers) and numbers.max() >= len(points):
            one = {"inliers": "an inlier", "matches": "a match"}[what]
            return f"{one} is keypoint {numbers.max()} of {len(points)} of image {image_id}"
        place = points[numbers].astype(np.float64)
        if not np.isfinite(place).all():
            bad = numbers[np.flatnonzero(~np.isfinite(place).all(axis=1))[0]]
            return f"keypoint {bad} of image {image_id} is not finite"
        places.append(place)
    return matches, places[0], places[1]


def _table(
    rows: Any, cols: Any, data: Any, kind: np.dtype[Any], widths: tuple[int, ...]
) -> NDArray[Any] | str:
    """Return a matrix (rows, cols) from its bytes, or what is wrong with it."""
    whole = isinstance(rows, int) and isinstance(cols, int)
    if not whole or not 0 <= rows <= MAX_MATCHES or cols not in widths:
        shape = f"({cut(rows, 20)}, {cut(cols, 20)})"
        return f"shape {shape}, needed: at most {MAX_MATCHES} rows of {cut(widths)[1:-1]}"
    size = rows * cols * kind.itemsize
    given = len(data) if isinstance(data, bytes) else 0
    if given != size:
        return f"{given} bytes of data, needed: {size}"
    return np.frombuffer(data or b"", kind).reshape(rows, cols)


def fundamental(data: Any) -> Array:
    """Return a stored F, of unit norm; NaN where there is none.

    Subnormal numbers are none, nor is the identity, COLMAP's placeholder.
    """
    if isinstance(data, bytes) and len(data) == 72:
        F = np.frombuffer(data, "<f8").reshape(3, 3)
        largest = np.abs(F).max()
        if np.finfo(float).tiny <= largest < np.inf and not np.array_equal(F, np.eye(3)):
            F = F / largest
            return np.asarray(F / np.linalg.norm(F))
    return np.full((3, 3), np.nan)
