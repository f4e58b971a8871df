"""Photographs as arrays: upright and with 8 bits a channel, whatever the file holds."""

from __future__ import annotations

import importlib
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array
from epigauge.errors import ArgumentError, FileFormatError, MissingPackageError
from epigauge.io._common import PathLike, cut

__all__ = ["Image", "as_image", "load_image", "opencv", "thumbnail"]

Image = NDArray[np.uint8]

#: Largest file, and pixels that a JPEG or PNG file may claim. Some OpenCV fill what is missing of a
#: damaged file, so that a few bytes would else take gigabytes; other formats it limits to 2^30.
_MAX_BYTES = 2**30
_MAX_PIXELS = 2**28

#: Percentiles of the values of an image that become black and white, where it has not 8 bits.
_BLACK, _WHITE = 0.1, 99.9

#: Values that these percentiles are taken of, about.
_SAMPLE = 1_000_000

#: Brands of still images that H.265 codes.
_HEIC = frozenset((b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx"))

_NEEDED = "(height, width), grey, or (height, width, 3 or 4), RGB or RGBA, of real numbers"


def load_image(path: PathLike) -> Image:
    """Read a photograph.

    Everything that OpenCV decodes is read: JPEG, PNG, TIFF, WebP, BMP, PGM and more, grey or in
    colour, with 8 or 16 bits or floating point. HEIC, as telephones write it, by pillow-heif (extra
    `heic`).

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    ndarray, shape (height, width) or (height, width, 3), uint8
        Grey, or red, green, blue. Transparency is dropped. Other than 8 bits are mapped linearly,
        the 0.1 and 99.9 percentiles of the values to 0 and 255.

    Raises
    ------
    FileFormatError
        If the file is not an image, is damaged or cut off, or too large: more than 1 GiB, or than
        2^28 pixels (about 16,000 x 16,000).
    OSError
        If the file cannot be read.
    MissingPackageError
        If OpenCV is not installed, or pillow-heif for a HEIC file.

    Notes
    -----
    The image is turned upright as its EXIF orientation says, so that width, height and pixel
    coordinates are those of the picture that a viewer shows, not of the pixels in the order of
    the file. (OpenCV before 5 does not see the orientation of a WebP file.)

    Examples
    --------
    >>> eg.load_image("photo.jpg").shape  # doctest: +SKIP
    (480, 640, 3)
    """
    cv2 = opencv()
    with Path(path).open("rb") as file:
        data = file.read(_MAX_BYTES + 1)
    if not data:
        raise FileFormatError(path, "is empty")
    if len(data) > _MAX_BYTES:
        raise FileFormatError(path, "is larger than 1 GiB")
    if _is_cut_off(data):
        raise FileFormatError(path, "is a JPEG file that was cut off")
    if _is_heic(data):
        return _from_heic(Path(path), data)
    width, height = _claimed_size(data)
    if width * height > _MAX_PIXELS:
        raise FileFormatError(path, f"has {width} x {height} pixels, more than 2^28")
    try:
        # Unlike IMREAD_UNCHANGED, these flags obey the orientation.
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FileFormatError(path, "is damaged, or no image that OpenCV reads")
    image = _to_8_bits(image)
    # OpenCV's own exchange of blue and red is several times as fast as a copy by NumPy.
    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def thumbnail(path: PathLike, size: int = 192) -> bytes:
    """Return a photograph as a small JPEG file.

    Parameters
    ----------
    path : str or path
        The photograph.
    size : int
        The longer side in pixels, at most.

    Returns
    -------
    bytes
        The file.

    Raises
    ------
    FileFormatError, OSError, MissingPackageError
        As `load_image`.
    """
    cv2, image = opencv(), load_image(path)
    height, width = image.shape[:2]
    scale = min(1.0, size / max(height, width))
    to = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, to, interpolation=cv2.INTER_AREA)
    # Given as OpenCV wants it: blue, green, red.
    coded = np.ascontiguousarray(small[:, :, ::-1] if small.ndim == 3 else small)
    return bytes(cv2.imencode(".jpg", coded, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def as_image(name: str, image: PathLike | ArrayLike) -> Image:
    """Read a photograph, or check and convert one that was read already.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    image : path or array_like, shape (height, width) or (height, width, 1, 3 or 4)
        A file, or grey values, RGB or RGBA: any real type; True is white.

    Returns
    -------
    ndarray, shape (height, width) or (height, width, 3), uint8
        As `load_image` gives it; shares memory with an array that is in this form.

    Raises
    ------
    ArgumentError
        If an array has another shape or type, or no pixels.
    FileFormatError, OSError, MissingPackageError
        As `load_image`.
    """
    if isinstance(image, str | os.PathLike):
        return load_image(image)
    array = as_array(name, image, _NEEDED)
    if array.dtype.kind not in "buif":
        raise ArgumentError(name, f"has type {cut(array.dtype)}", _NEEDED)
    if array.ndim == 3 and array.shape[2] in (1, 4):
        array = array[:, :, 0] if array.shape[2] == 1 else array[:, :, :3]
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,)) or not array.size:
        raise ArgumentError(name, f"has shape {array.shape}", _NEEDED)
    return _to_8_bits(array)


def opencv() -> Any:
    """Import OpenCV, or say how to get it."""
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise MissingPackageError("opencv-python-headless", "cv") from None


def _is_cut_off(data: bytes) -> bool:
    """Recognise a JPEG file whose last scan has no end; some OpenCV fill the rest with grey."""
    return data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[max(data.rfind(b"\xff\xda"), 0) :]


def _is_heic(data: bytes) -> bool:
    """Tell by the brands of the first box, whose last ones are those it is compatible with."""
    end = int.from_bytes(data[:4])
    brands = {data[k : k + 4] for k in range(8, min(end, 256), 4)}
    return data[4:8] == b"ftyp" and bool(brands & _HEIC)


def _from_heic(path: Path, data: bytes) -> Image:
    """Decode a HEIC file; its own turns and mirrorings are applied, those of EXIF repeat them."""
    try:
        heif = importlib.import_module("pillow_heif")
    except ImportError:
        raise MissingPackageError("pillow-heif", "heic") from None
    # The decoder raises ValueError, RuntimeError, EOFError, SyntaxError and others of its own.
    try:
        file = heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=True)
        width, height = file.size
        # A copy: the decoder of old versions takes its memory back with the file.
        values = np.array(file) if width * height <= _MAX_PIXELS else None
    except Exception as error:
        raise FileFormatError(path, f"is a damaged HEIC file ({cut(error)})") from None
    if values is None:
        raise FileFormatError(path, f"has {width} x {height} pixels, more than 2^28")
    return as_image("path", values)


def _claimed_size(data: bytes) -> tuple[int, int]:
    """Return the (width, height) that the head of a PNG or JPEG file states, else zeros."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    at = 2 if data[:2] == b"\xff\xd8" else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
        # Fill bytes stand alone; other segments say how long they are.
        at += 1 if marker == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4])
    return 0, 0


def _to_8_bits(image: NDArray[Any]) -> Image:
    """Map the values of an image to 0 .. 255, NaN to 0."""
    if image.dtype == np.uint8:
        return image
    if image.dtype == np.bool_:
        return image.astype(np.uint8) * np.uint8(255)
    step = max(1, int(np.sqrt(image.size / _SAMPLE)))
    sample = image[::step, ::step].astype(np.float64)
    sample = sample[np.abs(sample) < 1e300]  # neither NaN nor infinity
    if not len(sample):
        return np.zeros(image.shape, dtype=np.uint8)
    low, high = np.percentile(sample, (_BLACK, _WHITE))
    if low == high:  # a few points on a flat ground
        low, high = sample.min(), sample.max()
    mapped = np.zeros(image.shape, dtype=np.uint8)
    if low < high:
        # Row by row: a large image must not take eight times its memory.
        for row, values in zip(mapped, image, strict=True):
            row[...] = np.nan_to_num(np.interp(values, (low, high), (0.0, 255.0))) + 0.5
    return mapped
