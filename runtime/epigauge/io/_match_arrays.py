"""Matches in arrays under the names that other programs give them, in NPZ, NPY and HDF5 files.

Found by name, first come first served:

- ``x1``, ``x2`` or ``matches`` (m, 4): our own;
- ``mkpts0``, ``mkpts1``: LoFTR, SuperGlue, RoMa and what follows them; also ``mkpts0_f``;
- ``keypoints0``, ``keypoints1`` with ``matches`` (k, 2) of LightGlue, or ``matches0`` (or
  ``matches``) (n,) of SuperGlue and hloc, where -1 is no match, or ``matches1`` alone, one a
  keypoint of the other image; without any they are matches already, as kornia's LoFTR gives them;
- ``pts1``, ``pts2``; ``points1``, ``points2``; ``src_pts``, ``dst_pts``: OpenCV's examples.

A leading batch axis of one, and OpenCV's (m, 1, 2), are dropped. Confidences are not taken for
weights: they are no inverse variances.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import ArgumentError, FileFormatError, MissingPackageError
from epigauge.io._common import MAX_MATCHES, cut, listed
from epigauge.io._npz import damage

__all__ = ["GROUPS", "MARKS", "points_of", "read_hdf5"]

Array = NDArray[Any]

#: Names of the points in both images; the first group that is there counts.
GROUPS = (
    ("x1", "x2"),
    ("mkpts0", "mkpts1"),
    ("mkpts0_f", "mkpts1_f"),
    ("keypoints0", "keypoints1"),
    ("pts1", "pts2"),
    ("points1", "points2"),
    ("src_pts", "dst_pts"),
    ("matches",),
)
#: Names of the marks of inliers.
MARKS = ("inlier", "inliers", "inlier_mask", "mask")
#: Names of the rows of keypoints that match.
LINKS = ("matches", "matches0", "matches1")


def points_of(path: Path, found: Mapping[str, Array]) -> dict[str, Any]:
    """Return x1, x2, and inlier where there is one, of arrays under any of the names.

    Raises
    ------
    FileFormatError
        Naming the array at fault.
    """
    group = next(group for group in GROUPS if all(name in found for name in group))
    fields: dict[str, Any] = {}
    if group == ("matches",):
        table = _flat(path, "matches", found["matches"], 4)
        fields["x1"], fields["x2"] = table[:, 0:2], table[:, 2:4]
    else:
        fields["x1"], fields["x2"] = (_flat(path, name, found[name], 2) for name in group)
    linked = [name for name in LINKS if name in found] if group[0] == "keypoints0" else []
    if linked:
        rows = _rows(path, linked[0], found[linked[0]], fields)
        fields["x1"], fields["x2"] = fields["x1"][rows[:, 0]], fields["x2"][rows[:, 1]]
    marks = [_marks(found[name]) for name in MARKS if name in found]
    marks = [one for one in marks if one.ndim == 1]  # a mask can be that of an image
    if marks:
        fields["inlier"] = marks[0]
    return fields


def _flat(path: Path, name: str, array: Array, width: int) -> Array:
    """Return rows of some numbers: without a batch axis of one, and from (m, 1, 2)."""
    if array.ndim == 3 and array.shape[2] == width and 1 in array.shape[:2]:
        array = array.reshape(-1, width)
    if array.ndim != 2 or array.shape[1] != width:
        reason = f"{name} has shape {cut(array.shape)}, needed: (m, {width})"
        raise FileFormatError(path, reason)
    return array


def _rows(path: Path, name: str, links: Array, points: Mapping[str, Array]) -> Array:
    """Return which rows match, (k, 2)."""
    if links.ndim > 1 and links.shape[0] == 1 and links.shape != (1, 2):
        links = links[0]
    if links.dtype.kind not in "iu" or links.shape[1:] not in ((), (2,)) or links.ndim == 0:
        reason = f"{name} is {links.dtype} {cut(links.shape)}; needed: rows (k, 2) or (n,)"
        raise FileFormatError(path, reason)
    if links.ndim == 1:
        own, turn = (points["x2"], -1) if name == "matches1" else (points["x1"], 1)
        if len(links) != len(own):
            reason = f"{name} has {len(links)} rows, needed: {len(own)}, one a keypoint"
            raise FileFormatError(path, reason)
        links = links.astype(np.int64)
        first = np.flatnonzero(links >= 0)
        links = np.column_stack([first, links[first]])[:, ::turn]
    for side, (which, count) in enumerate((k, len(points[k])) for k in ("x1", "x2")):
        bad = np.flatnonzero((links[:, side] < 0) | (links[:, side] >= count))
        if len(bad):
            reason = f"{name} says {links[bad[0], side]} in row {bad[0]}"
            image = {"x1": 0, "x2": 1}[which]
            raise FileFormatError(path, f"{reason}, but image {image} has {count} keypoints")
    return links


def _marks(marks: Array) -> Array:
    """Return marks as one a match: OpenCV's are (m, 1), some masks are 255 where they hold."""
    marks = marks.reshape(-1) if marks.ndim == 2 and 1 in marks.shape else marks
    return marks != 0 if marks.dtype == np.uint8 and np.isin(marks, (0, 255)).all() else marks


def read_hdf5(
    path: Path, file: IO[bytes], features: Path | None, pair: tuple[str, str] | None
) -> dict[str, Any]:
    """Read the matches of an image pair from hloc's files.

    Parameters
    ----------
    path : Path
        Name of the file of matches for messages.
    file : binary file
        Its content.
    features : Path or None
        The file of keypoints; not needed where the matches hold them (``match_dense``).
    pair : tuple of str or None
        Names of both images; may be left out where the file holds one pair.

    Returns
    -------
    dict
        As `points_of`, in the order of the names.

    Raises
    ------
    FileFormatError, ArgumentError, MissingPackageError
        If that is not there.
    """
    try:
        import h5py
    except ModuleNotFoundError:
        raise MissingPackageError("h5py", "hdf5") from None
    with damage(path, "is not a readable HDF5 file"), h5py.File(file, "r") as content:
        where, names, swapped = _pair_in(path, content, pair)
        arrays = {
            name: _read(path, where[name], name)
            for name in ("matches0", "keypoints0", "keypoints1")
            if name in where
        }
    if "keypoints0" not in arrays or "keypoints1" not in arrays:
        if "matches0" not in arrays:
            raise FileFormatError(path, f"holds no matches0 of the pair {' '.join(names)}")
        if features is None:
            needed = "features='...h5', the file of their keypoints"
            raise ArgumentError("features", "is None, and the file holds matches alone", needed)
        with (
            features.open("rb") as stream,
            damage(features, "is not a readable HDF5 file"),
            h5py.File(stream, "r") as content,
        ):
            for k, name in enumerate(names):
                arrays[f"keypoints{k}"] = _keypoints(features, content, name)
    found = points_of(path, arrays)
    if swapped:
        found["x1"], found["x2"] = found["x2"], found["x1"]
    return found


def _pair_in(path: Path, content: Any, pair: tuple[str, str] | None) -> tuple[Any, Any, bool]:
    """Return the group of a pair, the names in its order, and whether that is the other way."""
    if pair is None:
        inside = [(a, b) for a in content for b in _groups(content[a])]
        if len(inside) != 1:
            what = listed([" ".join(names) for names in inside])
            raise FileFormatError(
                path, f"holds {len(inside)} pairs ({what}): say pair=(name, name)"
            )
        return content[inside[0][0]][inside[0][1]], inside[0], False
    for names, swapped in ((pair, False), (pair[::-1], True)):
        first, second = (name.replace("/", "-") for name in names)
        if first in content and second in _groups(content[first]):
            return content[first][second], names, swapped
    raise FileFormatError(path, f"holds no pair of {cut(pair[0])} and {cut(pair[1])}")


def _groups(content: Any) -> list[str]:
    return [name for name in content if hasattr(content[name], "keys")] if _is(content) else []


def _is(content: Any) -> bool:
    return hasattr(content, "keys")


def _keypoints(path: Path, content: Any, name: str) -> Array:
    """Return the keypoints of an image, whose name may have folders."""
    for known in (name, name.replace("/", "-")):
        if known in content and _is(content[known]) and "keypoints" in content[known]:
            return _read(path, content[known]["keypoints"], f"{name}/keypoints")
    # Names of pairs have - for the / of folders, which only the names of keypoints show.
    raise FileFormatError(
        path,
        f"holds no keypoints of {cut(name)} (it holds {listed(list(content))}): "
        "say pair=(name, name) with the names of the photographs, with their folders",
    )


def _read(path: Path, dataset: Any, name: str) -> Array:
    shape = getattr(dataset, "shape", None)
    if shape is None or dataset.dtype.kind not in "iuf" or np.prod(shape) > 4 * MAX_MATCHES:
        raise FileFormatError(path, f"{cut(name)} is no array of at most {MAX_MATCHES} numbers")
    array = np.asarray(dataset)
    # Half precision is what hloc stores to save space.
    return array.astype(np.float64) if array.dtype.kind == "f" else array
