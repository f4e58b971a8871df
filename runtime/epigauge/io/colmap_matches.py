"""The verified matches of a COLMAP database, as those of photographs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.errors import FileFormatError
from epigauge.images.pairwise import PairwiseMatches
from epigauge.io._common import PathLike
from epigauge.io.colmap import ColmapDatabase

__all__ = ["database_matches"]

Array = NDArray[np.float64]


def database_matches(path: PathLike) -> PairwiseMatches:
    """Read the inliers of all verified pairs of a COLMAP database.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    PairwiseMatches
        Images with at least one pair; features are those that matched.

    Raises
    ------
    FileFormatError, OSError
        As `ColmapDatabase`, and where there is no verified pair or no size of an image.
    """
    found: dict[tuple[int, int], tuple[Array, Array]] = {}
    with ColmapDatabase(path) as database:
        names, sizes = database.names(), database.sizes()
        for pairs in database.pairs():
            for k, (i, j) in enumerate(pairs.image_id.tolist()):
                part = slice(*pairs.offsets[k : k + 2])
                if pairs.offsets[k + 1] > pairs.offsets[k]:
                    # COLMAP counts from the corner of the first pixel.
                    found[i, j] = pairs.x1[part] - 0.5, pairs.x2[part] - 0.5
    if not found:
        raise FileFormatError(path, "has no verified pairs: match and verify in COLMAP first")
    images = sorted({i for pair in found for i in pair})
    missing = [names.get(i, str(i)) for i in images if i not in sizes]
    if missing:
        raise FileFormatError(path, f"has no camera with a size for {missing[0]}")
    points: list[Array] = []
    rows: dict[tuple[int, int], list[NDArray[np.intp]]] = {pair: [] for pair in found}
    for image in images:
        own = [(pair, side) for pair in found for side in (0, 1) if pair[side] == image]
        every = np.concatenate([found[pair][side] for pair, side in own])
        places, inverse = np.unique(every, axis=0, return_inverse=True)
        points.append(places)
        ends = np.cumsum([len(found[pair][side]) for pair, side in own])[:-1]
        for (pair, _), places_of in zip(own, np.split(inverse.ravel(), ends), strict=True):
            rows[pair].append(places_of)
    number = {image: k for k, image in enumerate(images)}
    return PairwiseMatches(
        tuple(names.get(image, str(image)) for image in images),
        np.array([sizes[image] for image in images]),
        tuple(points),
        {
            (number[i], number[j]): np.unique(np.column_stack(sides), axis=0)
            for (i, j), sides in rows.items()
        },
    )
