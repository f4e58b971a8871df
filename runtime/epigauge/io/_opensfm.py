"""Tracks of OpenSfM: ``tracks.csv`` of version 1 and 2, with the sizes of the images beside it.

A line names the version; then an observation a line, separated by tabs: image, track, feature, x,
y, scale, red, green, blue (and two numbers of segments). x and y count from the middle of the image
in units of its longer side; pixels, with (0, 0) in the middle of the first one, need its size:
``exif/NAME.exif`` of the project has it, or the caller.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import MAX_MATCHES, cut, listed
from epigauge.io._npz import damage

__all__ = ["HEAD", "read_opensfm"]

HEAD = b"OPENSFM_TRACKS_VERSION"

#: Fields of a line by version.
_FIELDS = {b"_v1": 9, b"_v2": 11}
_MAX_LINE = 65536
_MAX_EXIF = 1_000_000


def read_opensfm(path: Path, file: IO[bytes], image_size: ArrayLike | None) -> dict[str, Any]:
    """Read tracks.

    Parameters
    ----------
    path : Path
        Name of the file, in its project.
    file : binary file
        Its content.
    image_size : array_like of int, shape (2,), optional
        Width and height of all images, where the project does not tell them.

    Returns
    -------
    dict
        view, point, xy, names, sizes, colours.

    Raises
    ------
    FileFormatError
        Naming the line at fault.
    ArgumentError
        If the size of an image is not known.
    """
    version = file.readline(_MAX_LINE).strip().removeprefix(HEAD)
    if version not in _FIELDS:
        reason = f"is of version {cut(version.decode('ascii', 'replace'))!r}, needed: _v1 or _v2"
        raise FileFormatError(path, reason, 1)
    images: dict[str, int] = {}
    points: dict[str, int] = {}
    rows: list[tuple[float, ...]] = []
    line = 1
    while raw := file.readline(_MAX_LINE):
        line += 1
        fields = raw.rstrip(b"\r\n").split(b"\t")
        if len(raw) == _MAX_LINE or len(rows) == MAX_MATCHES:
            raise FileFormatError(path, f"is beyond {MAX_MATCHES} lines of usual length", line)
        if len(fields) != _FIELDS[version]:
            reason = f"holds {len(fields)} fields, needed: {_FIELDS[version]} separated by tabs"
            raise FileFormatError(path, reason, line)
        try:
            name, track = fields[0].decode(), fields[1].decode()
            x, y, r, g, b = (float(fields[k]) for k in (3, 4, 6, 7, 8))
        except ValueError:
            raise FileFormatError(path, "holds something that is no number", line) from None
        if not np.isfinite([x, y]).all() or not all(0 <= c <= 255 for c in (r, g, b)):
            raise FileFormatError(path, "holds no finite x, y or no colour", line)
        image = images.setdefault(name, len(images))
        rows.append((image, points.setdefault(track, len(points)), x, y, r, g, b))
    if not rows:
        raise FileFormatError(path, "holds no observation")
    names = sorted(images)
    rank = np.empty(len(names), dtype=np.int64)
    rank[[images[name] for name in names]] = np.arange(len(names))
    table = np.array(rows)
    view = rank[table[:, 0].astype(np.int64)]
    sizes = _sizes(path, names, image_size)
    point = table[:, 1].astype(np.int64)
    longest = sizes.max(axis=1)[view, None]
    count = np.bincount(point)
    colours = np.column_stack([np.bincount(point, c) / count for c in table[:, 4:].T])
    return {
        "view": view,
        "point": point,
        "xy": table[:, 2:4] * longest + sizes[view] / 2.0 - 0.5,
        "names": names,
        "sizes": sizes,
        "colours": np.rint(colours).astype(np.uint8),
    }


def _sizes(path: Path, names: list[str], image_size: ArrayLike | None) -> NDArray[np.int64]:
    """Return width and height of each image, (n, 2)."""
    if image_size is not None:
        given = as_array("image_size", image_size, "(width, height)")
        if given.shape != (2,) or given.dtype.kind not in "iu" or (given < 1).any():
            was = f"is {given.dtype} {given.shape}"
            raise ArgumentError("image_size", was, "two positive integers: (width, height)")
        return np.tile(given.astype(np.int64), (len(names), 1))
    sizes = np.zeros((len(names), 2), dtype=np.int64)
    unknown = []
    for k, name in enumerate(names):
        found = path.parent / "exif" / f"{Path(name).name}.exif"
        if not found.is_file() or found.stat().st_size > _MAX_EXIF:
            unknown.append(name)
            continue
        with damage(found, "tells no width and height"):
            content = json.loads(found.read_bytes())
            sizes[k] = int(content["width"]), int(content["height"])
            if (sizes[k] < 1).any():
                raise FileFormatError(found, f"says {sizes[k].tolist()} pixels")
    if unknown:
        was = f"is not known for {listed(unknown)}, whose exif files are not beside {path.name}"
        raise ArgumentError("image_size", was, "(width, height)")
    return sizes
