"""Features of many photographs and the matches of their pairs, kept together."""

from __future__ import annotations

import itertools
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_count, as_positive
from epigauge._options import Detector, Pairing
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.images.loading import Image, load_image, opencv
from epigauge.images.matching import features, seeker
from epigauge.images.unfinished import Unfinished
from epigauge.io._common import PathLike
from epigauge.io.output import writing

__all__ = ["PairwiseMatches", "match_photographs", "names_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Descriptors compared at a time: what they take stays in the cache.
_BLOCK = 512

#: Half the side of the square of pixels whose mean is the colour of a feature.
_COLOUR = 1

#: Strongest features of each photograph by which pairs are ranked, and how many of the others each
#: is matched with at least.
_STRONGEST, _PARTNERS = 500, 12

#: What NumPy and the ZIP archive in an NPZ file raise where it is none, cut off or changed.
_DAMAGED = (
    *(KeyError, ValueError, IndexError, TypeError, AttributeError, EOFError, struct.error),
    *(zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, MemoryError),
)

Told = Callable[[str, int, int], object]


@dataclass(frozen=True, eq=False)
class PairwiseMatches:
    """Points found in each of several images, and which of them may be the same.

    Parameters
    ----------
    names : tuple of str
        Names of the images.
    sizes : ndarray of int, shape (n, 2)
        Width and height in pixels.
    points : tuple of ndarray, shape (k, 2)
        Places of the features of each image, in pixels; (0, 0) is the centre of the first pixel.
    pairs : dict of (int, int) to ndarray of int, shape (m, 2)
        For images i < j rows of features in i and j that match. Wrong ones may be among them.
    colours : tuple of ndarray of uint8, shape (k, 3), optional
        Red, green, blue of each feature.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> found = eg.PairwiseMatches(
    ...     ("a", "b"), np.array([[640, 480]] * 2), (np.zeros((3, 2)), np.ones((3, 2))),
    ...     {(0, 1): np.array([[0, 2], [1, 0]])})
    >>> len(found.pairs[0, 1])
    2
    """

    names: tuple[str, ...]
    sizes: Indices
    points: tuple[Array, ...]
    pairs: dict[tuple[int, int], Indices] = field(repr=False)
    colours: tuple[NDArray[np.uint8], ...] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        n = len(self.names)
        if np.shape(self.sizes) != (n, 2):
            raise ArgumentError("sizes", f"has shape {np.shape(self.sizes)}", f"({n}, 2)")
        if len(self.points) != n or (self.colours is not None and len(self.colours) != n):
            raise ArgumentError("points", f"has {len(self.points)} entries", f"{n}, one an image")
        for (i, j), rows in self.pairs.items():
            if not 0 <= i < j < n:
                raise ArgumentError("pairs", f"names ({i}, {j})", f"images i < j < {n}")
            rows = np.asarray(rows)
            if rows.ndim != 2 or rows.shape[1] != 2 or rows.dtype.kind not in "iu":
                was = f"holds {rows.dtype} {rows.shape} of images {i} and {j}"
                raise ArgumentError("pairs", was, "integers (m, 2)")
            if len(rows) and (
                rows.min() < 0 or np.any(rows.max(axis=0) >= [len(self.points[k]) for k in (i, j)])
            ):
                raise ArgumentError(
                    "pairs", f"names features of images {i} and {j} that are not", "rows of points"
                )
            for k, own in zip((i, j), rows.T, strict=True):
                if not np.isfinite(np.asarray(self.points[k], dtype=np.float64)[own]).all():
                    was = f"of image {k} ({self.names[k]}) that match are not all finite"
                    raise ArgumentError("points", was, "finite coordinates")

    def save(self, path: PathLike) -> None:
        """Write everything to an NPZ file.

        Parameters
        ----------
        path : str or path
            File.
        """
        arrays: dict[str, Any] = {
            "names": np.array(self.names),
            "sizes": self.sizes,
            "count": np.array([len(p) for p in self.points]),
            "points": np.concatenate([np.zeros((0, 2)), *self.points]),
            "images": np.array(list(self.pairs), dtype=np.int64).reshape(-1, 2),
            "matches": np.array([len(m) for m in self.pairs.values()], dtype=np.int64),
            "rows": np.concatenate([np.zeros((0, 2), np.int64), *self.pairs.values()]),
        }
        if self.colours is not None:
            arrays["colours"] = np.concatenate([np.zeros((0, 3), np.uint8), *self.colours])
        with writing(Path(path)) as stream:
            np.savez_compressed(stream, **arrays)

    @staticmethod
    def load(path: PathLike) -> PairwiseMatches:
        """Read what `save` wrote.

        Parameters
        ----------
        path : str or path
            File.

        Returns
        -------
        PairwiseMatches
            The same.

        Raises
        ------
        FileFormatError
            If the file is another one, or damaged.
        """
        try:
            # NumPy leaves a file that it opened itself open where it is damaged.
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as data:
                z = {key: data[key] for key in data.files}
            features, matches = int(z["count"].sum()), int(z["matches"].sum())
            if (features, matches) != (len(z["points"]), len(z["rows"])):
                raise ValueError("counts are not those of features and matches")
            ends = np.cumsum(z["count"])[:-1]
            parts = np.split(z["rows"].astype(np.intp), np.cumsum(z["matches"])[:-1])
            images = map(tuple, z["images"].tolist())
            colours = tuple(np.split(z["colours"], ends)) if "colours" in z else None
            return PairwiseMatches(
                tuple(z["names"].tolist()),
                z["sizes"],
                tuple(np.split(z["points"], ends)),
                dict(zip(images, parts, strict=False)),
                colours,
            )
        except _DAMAGED as error:
            raise FileFormatError(path, "is no file of PairwiseMatches.save") from error


def match_photographs(
    images: Sequence[PathLike],
    *,
    pairs: Pairing | Iterable[tuple[int, int]] = "all",
    detector: Detector = "sift",
    ratio: float = 0.8,
    max_size: int = 2400,
    max_features: int = 8000,
    cache: PathLike | None = None,
    progress: Told | None = None,
) -> PairwiseMatches:
    """Find features in photographs, and match them pair by pair.

    Parameters
    ----------
    images : sequence of paths
        Photographs.
    pairs : "all", "sequential", "ranked" or iterable of (int, int)
        Which to match: all; each with the next five; each with the twelve others that most of its
        500 strongest features match, for large folders in any order; or those listed.
    detector : {"sift", "orb", "akaze", "brisk", "kaze"}
        As of `match_images`. SIFT's descriptors are compared by their square roots (RootSIFT [1]_).
    ratio : float
        Largest ratio of the distances to the nearest and second nearest descriptor, from both
        sides.
    max_size, max_features : int
        As of `match_images`.
    cache : path, optional
        An NPZ file for what is found: read if it exists and is of the same images, else written.
        Until then a folder of this name with the ending ``.partial`` holds what is done, so that
        an interrupted run goes on where it was.
    progress : callable, optional
        Called with what is being done, how many of it are done, and of how many.

    Returns
    -------
    PairwiseMatches
        Matches not verified by any geometry: see `build_tracks`.

    Raises
    ------
    ArgumentError
        On fewer than two images, pairs that are not of them, or a cache of other images.
    FileFormatError, OSError, MissingPackageError
        As `load_image`.

    References
    ----------
    .. [1] R. Arandjelovic, A. Zisserman, "Three things everyone should know to improve object
       retrieval", CVPR 2012.

    Examples
    --------
    >>> eg.match_photographs(["room0.jpg", "room1.jpg", "room2.jpg"])  # doctest: +SKIP
    """
    paths = _paths_of(images)
    names = names_of(paths)
    ratio = as_positive("ratio", ratio)
    max_features = as_count("max_features", max_features, at_least=8)
    listed = None if pairs == "ranked" else _listed(pairs, len(paths))
    if cache is not None and Path(cache).exists():
        return _cached(Path(cache), paths)
    options: dict[str, Any] = {
        "detector": detector,
        "max_size": max_size,
        "max_features": max_features,
    }
    kept = Unfinished(None if cache is None else Path(cache), options | {"ratio": ratio})
    cv2, found = opencv(), []
    for k, path in enumerate(paths):
        if progress is not None:
            progress("features", k, len(paths))
        make = partial(_features, cv2, path, **options)
        found.append(kept.get("features", [path], make))
    if listed is None:
        strongest = [own["descriptors"][own["strongest"]] for own in found]
        listed = _ranked(strongest, ratio, progress)
    descriptors = [own["descriptors"] for own in found]
    matched: dict[tuple[int, int], Indices] = {}
    for i, pairs_of in itertools.groupby(listed, key=lambda pair: pair[0]):
        others = [j for _, j in pairs_of]

        def told(done: int, before: int = len(matched)) -> None:
            if progress is not None:
                progress("pairs", before + done, len(listed))

        make = partial(_matched_with, descriptors, i, others, ratio, told)
        own = kept.get("matches", [paths[i], *(paths[j] for j in others)], make)
        matched |= {(i, j): own[str(k)].astype(np.intp) for k, j in enumerate(others)}
    result = PairwiseMatches(
        names,
        np.array([own["size"] for own in found]),
        tuple(own["points"] for own in found),
        matched,
        tuple(own["colours"] for own in found),
    )
    if cache is not None:
        result.save(cache)
    kept.done()
    return result


def _paths_of(images: Sequence[PathLike]) -> list[Path]:
    """Return the paths, of different photographs."""
    needed = "paths of two photographs or more"
    if isinstance(images, str | os.PathLike):
        raise ArgumentError("images", "is one path", needed)
    try:
        paths = [Path(path) for path in images]
    except TypeError:
        raise ArgumentError("images", "has no paths", needed) from None
    if len(paths) < 2:
        raise ArgumentError("images", f"holds {len(paths)}", needed)
    once = {path.absolute() for path in paths}
    if len(once) < len(paths):
        raise ArgumentError("images", "names a photograph twice", "different photographs")
    return paths


def _cached(cache: Path, paths: list[Path]) -> PairwiseMatches:
    """Return what a cache holds, if it is of these photographs."""
    known = PairwiseMatches.load(cache)
    if [Path(name).name for name in known.names] != [path.name for path in paths]:
        was = f"is of other images ({', '.join(known.names[:3])}, ...)"
        raise ArgumentError("cache", was, "another file, or the same photographs in their order")
    return known


def _features(
    cv2: Any, path: Path, *, detector: str, max_size: int, max_features: int
) -> dict[str, NDArray[Any]]:
    """Return what there is to know of one photograph."""
    image = load_image(path)
    by = seeker(cv2, detector, max_features)
    x, descriptors, strength = features(cv2, by, str(path), image, max_size, max_features)
    x, descriptors, strength = _distinct(x, descriptors, strength)
    return {
        "size": np.array([image.shape[1], image.shape[0]]),
        "points": x,
        "descriptors": _normalized(descriptors, detector),
        "colours": _colours(image, x),
        "strongest": np.argsort(-strength, kind="stable")[:_STRONGEST],
    }


def _matched_with(
    descriptors: list[NDArray[Any]],
    i: int,
    others: list[int],
    ratio: float,
    told: Callable[[int], object],
) -> dict[str, NDArray[Any]]:
    """Return the matches of one photograph with others, numbered."""
    found = {}
    for k, j in enumerate(others):
        told(k)
        found[str(k)] = _matched(descriptors[i], descriptors[j], ratio)
    return found


def names_of(paths: list[Path]) -> tuple[str, ...]:
    """Return names without the part that all paths have in common."""
    if len({path.name for path in paths}) == len(paths):
        return tuple(path.name for path in paths)
    root = os.path.commonpath([path.absolute().parent for path in paths])
    return tuple(path.absolute().relative_to(root).as_posix() for path in paths)


def _listed(pairs: str | Iterable[tuple[int, int]], n: int) -> list[tuple[int, int]]:
    if isinstance(pairs, str):
        if pairs not in ("all", "sequential"):
            needed = "'all', 'sequential', 'ranked', or pairs"
            raise ArgumentError("pairs", f"is {pairs!r:.60}", needed)
        most = n if pairs == "all" else 5
        return [(i, j) for i, j in itertools.combinations(range(n), 2) if j - i <= most]
    listed = sorted({(min(i, j), max(i, j)) for i, j in pairs})
    bad = [pair for pair in listed if not 0 <= pair[0] < pair[1] < n]
    if bad:
        raise ArgumentError("pairs", f"names {bad[0]}", f"two different images from 0 to {n - 1}")
    return listed


def _ranked(
    strongest: list[NDArray[Any]], ratio: float, progress: Told | None = None
) -> list[tuple[int, int]]:
    """Return the pairs that are among the best of either image, by matches of strong features."""
    n = len(strongest)
    every = list(itertools.combinations(range(n), 2))
    if n - 1 <= _PARTNERS:
        return every
    counts = np.zeros((n, n), dtype=np.intp)
    for k, (i, j) in enumerate(every):
        if progress is not None:
            progress("ranking", k, len(every))
        counts[i, j] = counts[j, i] = len(_matched(strongest[i], strongest[j], ratio))
    best = np.argsort(-counts, axis=1, kind="stable")[:, :_PARTNERS]
    chosen = np.zeros((n, n), dtype=np.bool_)
    chosen[np.arange(n)[:, None], best] = True
    # Images that have nothing in common are among the best of one only by their number.
    chosen &= counts > 0
    return [(i, j) for i, j in every if chosen[i, j] or chosen[j, i]]


def _distinct(
    x: Array, descriptors: NDArray[Any], strength: Array
) -> tuple[Array, NDArray[Any], Array]:
    """Return features without further orientations of one place: two tracks would be one."""
    first = np.sort(np.unique(np.round(x, 3), axis=0, return_index=True)[1])
    own = descriptors[first] if len(descriptors) == len(x) else descriptors
    return x[first], own, strength[first]


def _normalized(descriptors: NDArray[Any], detector: str) -> NDArray[Any]:
    """Return descriptors whose scalar products compare them: float32 (n, k)."""
    if descriptors.dtype == np.uint8:  # bits: +-1, so that products count those in common
        bits = 2.0 * np.unpackbits(descriptors, axis=1).astype(np.float32) - 1.0
        return np.asarray(bits / np.sqrt(np.float32(max(bits.shape[1], 1))))
    values = descriptors.astype(np.float32)
    if detector == "sift":
        values = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-12))
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12))


def _matched(a: NDArray[Any], b: NDArray[Any], ratio: float) -> Indices:
    """Return rows that choose each other by a margin from both sides, (m, 2)."""
    if min(len(a), len(b)) < 2 or a.shape[1] != b.shape[1]:
        return np.zeros((0, 2), dtype=np.intp)
    best_of_a, best_of_b = np.zeros(len(a), np.intp), np.zeros(len(b), np.intp)
    first_b = np.full(len(b), -2.0, np.float32)
    second_b = np.full(len(b), -2.0, np.float32)
    clear = np.zeros(len(a), np.bool_)
    limit = ratio**2
    columns = np.arange(len(b))
    for begin in range(0, len(a), _BLOCK):
        products = a[begin : begin + _BLOCK] @ b.T
        rows = np.arange(len(products))
        best = products.argmax(axis=1)
        top = products[rows, best].copy()
        # Of the columns first: the rows' best are taken out below.
        of_b = products.argmax(axis=0)
        top_b = products[of_b, columns].copy()
        products[of_b, columns] = -2.0
        next_b = products.max(axis=0)
        products[of_b, columns] = top_b
        better = top_b > first_b
        second_b = np.where(better, np.maximum(first_b, next_b), np.maximum(second_b, top_b))
        best_of_b[better] = begin + of_b[better]
        first_b = np.where(better, top_b, first_b)
        products[rows, best] = -2.0
        second = products.max(axis=1)
        best_of_a[begin + rows] = best
        # Squared distances of unit vectors: 2 - 2 a b.
        clear[begin + rows] = 1.0 - top < limit * (1.0 - second)
    clear_b = 1.0 - first_b < limit * (1.0 - second_b)
    rows = np.arange(len(a))
    rows = rows[clear & (best_of_b[best_of_a] == rows) & clear_b[best_of_a]]
    return np.column_stack([rows, best_of_a[rows]])


def _colours(image: Image, x: Array) -> NDArray[np.uint8]:
    """Return the mean colour about each feature, (n, 3)."""
    rgb = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    height, width = rgb.shape[:2]
    column, row = np.rint(x).astype(np.intp).T if len(x) else np.zeros((2, 0), np.intp)
    total = np.zeros((len(x), 3))
    for dy, dx in itertools.product(range(-_COLOUR, _COLOUR + 1), repeat=2):
        total += rgb[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1), :3]
    return np.rint(total / (2 * _COLOUR + 1) ** 2).astype(np.uint8)
