"""Focal lengths that cameras write into photographs (EXIF 2.32)."""

from __future__ import annotations

import math
import struct
from pathlib import Path

from epigauge.io._common import PathLike

__all__ = ["exif_focal_px"]

#: Diagonal of a frame of 35 mm film, which equivalent focal lengths are counted for.
_DIAGONAL_MM = math.hypot(36.0, 24.0)

#: Tags: the block of EXIF data, focal length, width and height in pixels, sensor's pixels a unit,
#: which unit, and the focal length of 35 mm film with the same view.
_EXIF, _FOCAL, _WIDTH, _HEIGHT = 0x8769, 0x920A, 0xA002, 0xA003
_RESOLUTION, _UNIT, _EQUIVALENT = 0xA20E, 0xA210, 0xA405

#: Millimetres of units of resolution: inch (by default) and centimetre.
_MILLIMETRES = {2: 25.4, 3: 10.0}

#: How TIFF and EXIF data begin, by the order of their bytes.
_TIFF = (b"II*\0", b"MM\0*")

#: Formats of one number each: size, and code of `struct`; rational numbers are pairs.
_FORMATS = {3: "H", 4: "I", 5: "II", 9: "i", 10: "ii"}


def exif_focal_px(path: PathLike, image_size: tuple[int, int]) -> float | None:
    """Return the nominal focal length of a photograph.

    Parameters
    ----------
    path : str or path
        JPEG, TIFF, PNG, WebP or HEIC.
    image_size : (int, int)
        Width and height of the image in pixels, which may be smaller than when it was taken.

    Returns
    -------
    float or None
        In pixels of the image: of the 35 mm equivalent, else of the focal length and the pitch of
        the sensor; None where the file does not tell. It may be wrong by ten percent and more: of
        whole millimetres, of cropped images, of zoom by software.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    try:
        tags = _tags(Path(path).read_bytes())  # the whole file: TIFF and WebP have it at the end
    except (struct.error, ValueError):
        return None
    equivalent, focal = tags.get(_EQUIVALENT, 0.0), tags.get(_FOCAL, 0.0)
    taken = max(tags.get(_WIDTH, 0.0), tags.get(_HEIGHT, 0.0)) or float(max(image_size))
    found = equivalent / _DIAGONAL_MM * math.hypot(*image_size)
    if not found > 0.0:
        pitch = _MILLIMETRES.get(int(tags.get(_UNIT, 2.0)), 0.0)
        per_mm = tags.get(_RESOLUTION, 0.0) / pitch if pitch else 0.0
        found = focal * per_mm * max(image_size) / taken
    return found if math.isfinite(found) and found > 0.0 else None


def _tags(data: bytes) -> dict[int, float]:
    """Return the numbers of the EXIF block."""
    block = data
    if data[:4] not in _TIFF:
        # JPEG and HEIC; PNG; WebP, whose chunk has a size.
        marks = ((b"Exif\0\0", 6), (b"eXIf", 4), (b"EXIF", 8))
        found = [(data.find(mark), length) for mark, length in marks]
        block = next((data[at + length :] for at, length in found if at >= 0), b"")
    if block[:4] not in _TIFF:
        return {}
    order = "<" if block[:2] == b"II" else ">"
    first = _directory(block, order, int(struct.unpack_from(order + "I", block, 4)[0]))
    inner = int(first.get(_EXIF, 0.0))
    return _directory(block, order, inner) if inner else {}


def _directory(block: bytes, order: str, at: int) -> dict[int, float]:
    """Return the entries with one number."""
    found = {}
    (count,) = struct.unpack_from(order + "H", block, at)
    for k in range(count):
        entry = at + 2 + 12 * k
        tag, kind, length = struct.unpack_from(order + "HHI", block, entry)
        code = _FORMATS.get(kind)
        if code is None or length != 1:
            continue
        where = entry + 8
        if struct.calcsize(order + code) > 4:
            (where,) = struct.unpack_from(order + "I", block, where)
        values = struct.unpack_from(order + code, block, where)
        if len(values) == 1:
            found[tag] = float(values[0])
        elif values[1]:
            found[tag] = values[0] / values[1]
    return found
