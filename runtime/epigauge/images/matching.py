"""Features of two photographs, and which of them are the same point of the scene."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_choice, as_count, as_positive
from epigauge._options import Detector
from epigauge.errors import ArgumentError
from epigauge.images.loading import Image, as_image, opencv
from epigauge.io import Matches
from epigauge.io._common import PathLike

__all__ = ["DETECTORS", "ImageMatches", "match_images"]

Array = NDArray[np.float64]

#: Detectors by name: their class in OpenCV and options, given the number of features wanted.
DETECTORS: dict[str, tuple[str, Callable[[int], dict[str, Any]]]] = {
    # Without this option OpenCV's SIFT places all points a quarter of a pixel to the lower right.
    "sift": ("SIFT", lambda n: {"nfeatures": n, "enable_precise_upscale": True}),
    "orb": ("ORB", lambda n: {"nfeatures": n}),
    "akaze": ("AKAZE", lambda n: {}),
    "brisk": ("BRISK", lambda n: {}),
    "kaze": ("KAZE", lambda n: {}),
}

#: Descriptors compared with all others at a time: what fits into the processor's cache.
_BLOCK = 512

#: No detector finds anything in an image of fewer pixels across, and some fail.
_SMALLEST = 16


@dataclass(frozen=True, slots=True, eq=False)
class ImageMatches(Matches):
    """Point matches of two photographs, with where they come from.

    A `Matches`: ``save_matches`` writes it, ``refine_fundamental(m.x1, m.x2)`` takes its points.

    Parameters
    ----------
    detector : str
        What found the features.
    n_features1, n_features2 : int
        How many it found in each image.

    Examples
    --------
    >>> import epigauge as eg
    >>> found = eg.match_images(eg.samples.path("A.jpg"), eg.samples.path("B.jpg"))
    >>> found.name, found.detector, found.image_size1
    ('A - B', 'sift', (640, 480))
    """

    detector: str = "sift"
    n_features1: int = 0
    n_features2: int = 0


def match_images(
    image1: PathLike | ArrayLike,
    image2: PathLike | ArrayLike,
    *,
    detector: Detector = "sift",
    ratio: float = 0.8,
    max_size: int = 2000,
    max_features: int = 8000,
) -> ImageMatches:
    """Find points of the scene in two photographs.

    Two features match if each is the other's nearest neighbour, and by a margin: seen from either
    side the nearest descriptor is nearer than `ratio` times the second nearest. Wrong matches
    remain: `estimate_fundamental` sorts them out.

    Parameters
    ----------
    image1, image2 : path, or array_like, shape (height, width) or (height, width, 3)
        Files as for `load_image`, or images: grey or RGB, any real type.
    detector : {"sift", "orb", "akaze", "brisk", "kaze"}
        Features of OpenCV. The last three are not in the common packages of OpenCV 5.
    ratio : float
        Largest ratio of the distances to nearest and second nearest descriptor, at most 1.
    max_size : int
        Features are sought in an image made smaller until neither side is longer than this. Their
        positions are given in pixels of the full image all the same.
    max_features : int
        The strongest features kept of each image.

    Returns
    -------
    ImageMatches
        In the order of the features of image 1; none at all where nothing matches.

    Raises
    ------
    ArgumentError
        On bad arguments: images of another shape, smaller than 16 pixels across, a detector that
        the installed OpenCV does not have.
    FileFormatError
        If a file is not an image that can be read.
    OSError
        If a file cannot be opened.
    MissingPackageError
        If OpenCV is not installed.

    Notes
    -----
    Coordinates are pixels of the upright image: x to the right, y down, (0, 0) the centre of the
    top left pixel, so that an image of width w covers -0.5 <= x <= w - 0.5. Upright means turned
    as the EXIF orientation of the file says.

    SIFT and AKAZE place features where they are. OpenCV's ORB and BRISK place those of coarse
    scales up to a pixel too far to the upper left.

    Examples
    --------
    >>> found = eg.match_images("A.jpg", "B.jpg")  # doctest: +SKIP
    >>> eg.estimate_fundamental(found.x1, found.x2)  # doctest: +SKIP
    """
    as_choice("detector", detector, tuple(DETECTORS))
    ratio = as_positive("ratio", ratio)
    if ratio > 1.0:
        raise ArgumentError("ratio", f"is {ratio:g}", "a number above 0 and at most 1")
    max_size = as_count("max_size", max_size, at_least=_SMALLEST)
    max_features = as_count("max_features", max_features, at_least=8)

    cv2 = opencv()
    found_by = seeker(cv2, detector, max_features)
    sizes, found = [], []
    for name, source in (("image1", image1), ("image2", image2)):
        image = as_image(name, source)
        shown = os.fspath(source) if isinstance(source, str | os.PathLike) else name
        sizes.append((image.shape[1], image.shape[0]))
        found.append(features(cv2, found_by, shown, image, max_size, max_features)[:2])
    (x1, descriptors1), (x2, descriptors2) = found
    rows1, rows2 = _mutual(cv2, descriptors1, descriptors2, ratio)
    pairs = np.column_stack([x1[rows1], x2[rows2]])
    # A feature with two orientations may match twice.
    pairs = pairs[np.sort(np.unique(pairs, axis=0, return_index=True)[1])]
    return ImageMatches(
        x1=np.ascontiguousarray(pairs[:, :2]),
        x2=np.ascontiguousarray(pairs[:, 2:]),
        image_size1=sizes[0],
        image_size2=sizes[1],
        name=" - ".join(
            Path(source).stem if isinstance(source, str | os.PathLike) else name
            for name, source in (("image1", image1), ("image2", image2))
        ),
        detector=detector,
        n_features1=len(x1),
        n_features2=len(x2),
    )


def seeker(cv2: Any, detector: str, max_features: int) -> Any:
    """Make OpenCV's detector and descriptor of that name."""
    name, options = DETECTORS[detector]
    # OpenCV 5 has moved some into the module xfeatures2d of its contributed part.
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        make = getattr(module, f"{name}_create", None)
        if make is not None:
            return make(**options(max_features))
    raise ArgumentError(
        "detector",
        f"is {detector!r}, which OpenCV {cv2.__version__} as installed does not have",
        "sift or orb, or the package opencv-contrib-python-headless in place of "
        "opencv-python-headless",
    )


def features(
    cv2: Any, seeker: Any, name: str, image: Image, max_size: int, max_features: int
) -> tuple[Array, NDArray[Any], Array]:
    """Return positions (n, 2) in pixels of the full image, descriptors (n, k), and strengths."""
    height, width = image.shape[:2]
    reduction = min(1.0, max_size / max(height, width))
    size = max(1, round(width * reduction)), max(1, round(height * reduction))
    if min(size) < _SMALLEST:
        smaller = "" if reduction == 1.0 else f", {size[0]} x {size[1]} within max_size"
        raise ArgumentError(
            name, f"is {width} x {height} pixels{smaller}", f"at least {_SMALLEST} in both"
        )
    image = np.ascontiguousarray(image)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if reduction < 1.0:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = seeker.detectAndCompute(grey, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 1), dtype=np.float32), np.empty(0)
    strength = np.array([keypoint.response for keypoint in keypoints], dtype=np.float64)
    if len(keypoints) > max_features:
        strongest = np.sort(np.argsort(-strength, kind="stable")[:max_features])
        keypoints, descriptors = [keypoints[k] for k in strongest], descriptors[strongest]
        strength = strength[strongest]
    x = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    # Pixel edges, half a pixel beside the centres, keep their place when an image is resized.
    return (x + 0.5) * (np.array([width, height]) / size) - 0.5, descriptors, strength


def _mutual(
    cv2: Any, descriptors1: NDArray[Any], descriptors2: NDArray[Any], ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of the features that choose each other, unmistakably."""
    if min(len(descriptors1), len(descriptors2)) < 2:  # there is no second nearest
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    there, clear1 = _nearest(cv2, descriptors1, descriptors2, ratio)
    back, clear2 = _nearest(cv2, descriptors2, descriptors1, ratio)
    rows1 = np.arange(len(there))
    rows1 = rows1[(back[there] == rows1) & clear1 & clear2[there]]
    return rows1, there[rows1]


def _nearest(
    cv2: Any, queries: NDArray[Any], others: NDArray[Any], ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the nearest of the others for each query, and whether it is nearest by a margin."""
    if queries.dtype == np.uint8:
        distance, index = cv2.batchDistance(
            queries, others, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
        )
        return index[:, 0].astype(np.intp), distance[:, 0] < ratio * distance[:, 1]
    nearest = np.empty(len(queries), dtype=np.intp)
    clear = np.empty(len(queries), dtype=np.bool_)
    # Squares by a product of matrices: five times as fast as OpenCV, and exact for SIFT, whose
    # descriptors are whole numbers with squares below 2^24.
    others_squared = np.einsum("ij,ij->i", others, others)
    # One table for all blocks: a quarter of the time would else go into pages of new memory.
    table = np.empty((min(_BLOCK, len(queries)), len(others)), dtype=others.dtype)
    for first in range(0, len(queries), _BLOCK):
        some = queries[first : first + _BLOCK]
        squared = np.matmul(-2.0 * some, others.T, out=table[: len(some)])
        squared += others_squared
        rows = np.arange(len(some))
        index = squared.argmin(axis=1)
        least = squared[rows, index]
        squared[rows, index] = np.inf
        own = np.einsum("ij,ij->i", some, some)
        two = np.sqrt(np.maximum([least + own, squared.min(axis=1) + own], 0.0))
        nearest[first : first + _BLOCK] = index
        clear[first : first + _BLOCK] = two[0] < ratio * two[1]
    return nearest, clear
