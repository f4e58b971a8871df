"""Tracks of points through many images, merged from the verified matches of pairs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_count
from epigauge._options import Pairing
from epigauge.errors import ArgumentError
from epigauge.images.pairwise import PairwiseMatches, match_photographs
from epigauge.io._common import PathLike
from epigauge.multi_view.tracks import MIN_POINTS, MIN_VIEWS, Tracks
from epigauge.two_view.robust_batch import estimate_fundamental_batch
from epigauge.two_view.tensors import REFUSED

__all__ = ["CheckedPair", "NoTracks", "TrackSource", "build_tracks"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
_Verdict = tuple[NDArray[np.bool_], Array, tuple[str, ...]]

#: Flags of a pair whose matches are not used at all.
_WRONG = {"no common geometry"}

#: Flags of a pair that says nothing of where cameras are; its matches make tracks longer only.
_WITHOUT_PARALLAX = {"planar scene", "pure rotation", "still camera"}

#: Of these, one whose matches say nothing of where points are either, as of a photograph's copy.
_STILL = "still camera"

#: Pairs that are verified at a time.
_PART = 64

#: Images of another part that are named at most.
_LISTED = 5

#: The right matches of a pair must be this many at least, and this share.
_LEAST, _SHARE = 15, 0.15


class NoTracks(ArgumentError):
    """The images have no tracks to reconstruct from: unrelated, flat, or without parallax."""


@dataclass(frozen=True)
class CheckedPair:
    """What came of a pair of images.

    Attributes
    ----------
    images : tuple of str
        Their names.
    matches, inliers : int
        Matches of the features, and those that agree with one geometry.
    flags : tuple of str
        Of `estimate_fundamental`.
    used : bool
        Whether its inliers are in the tracks.
    """

    images: tuple[str, str]
    matches: int
    inliers: int
    flags: tuple[str, ...]
    used: bool


@dataclass(frozen=True)
class TrackSource:
    """Where tracks come from: `Tracks.source`.

    Attributes
    ----------
    pairs : tuple of CheckedPair
        All pairs with matches.
    left_out : dict of str to str
        Images that are not in the tracks, and why.
    """

    pairs: tuple[CheckedPair, ...] = field(repr=False)
    left_out: dict[str, str]


@dataclass(frozen=True)
class _Agreed:
    """The right matches of a pair, their distances, and whether the camera stood still."""

    distances: Array
    i: int
    j: int
    rows: Indices
    still: bool


def build_tracks(
    images: Sequence[PathLike] | PairwiseMatches | PathLike,
    *,
    pairs: Pairing | Iterable[tuple[int, int]] = "all",
    cache: PathLike | None = None,
    min_inliers: int = _LEAST,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str, int, int], object] | None = None,
    **options: Any,
) -> Tracks:
    """Build tracks from photographs, or from matches of their pairs.

    The matches of each pair are verified by `estimate_fundamental`, and what agrees is merged,
    nearest to its epipolar geometry first. A match that would put two features of one image into
    one track is left out, and so is a track that is only in images taken from one place in one
    direction, which leave its depth open.

    Parameters
    ----------
    images : sequence of paths, PairwiseMatches, or path
        Photographs; or what `match_photographs` or another program found in them; or a COLMAP
        database, whose verified pairs are taken.
    pairs : "all", "sequential", "ranked" or iterable of (int, int)
        Of photographs, as `match_photographs`.
    cache : path, optional
        Of photographs: an NPZ file for features and matches, as of `match_photographs`.
    min_inliers : int
        Fewest right matches of a pair that is used.
    seed : int
        Of `estimate_fundamental`.
    workers : int
        Threads that verify pairs; the result does not depend on them.
    progress : callable, optional
        Called with what is being done, how many of it are done, and of how many.
    **options
        Of `match_photographs`.

    Returns
    -------
    Tracks
        With ``names``, ``sizes`` and ``colours``; ``source`` is a `TrackSource`: what came of each
        pair, and the images that were left out. Those that hang together by most matches are in.

    Raises
    ------
    NoTracks
        Where no tracks come out (an `ArgumentError`): the message says why.
    FileFormatError, OSError, MissingPackageError
        As `load_image`.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.build_tracks(["1.jpg", "2.jpg", "3.jpg"])  # doctest: +SKIP
    >>> found = eg.metric_upgrade(tracks, image_size=tracks.sizes)  # doctest: +SKIP
    """
    min_inliers = as_count("min_inliers", min_inliers, at_least=8)
    workers = as_count("workers", workers)
    if isinstance(images, PairwiseMatches):
        found = images
    elif isinstance(images, str | os.PathLike):
        from epigauge.io.colmap_matches import database_matches

        if Path(images).is_dir():
            needed = "paths of its photographs in a list, or a COLMAP database"
            raise ArgumentError("images", "is a folder", needed)
        found = database_matches(images)
    else:
        found = match_photographs(images, pairs=pairs, cache=cache, progress=progress, **options)
    checked: list[CheckedPair] = []
    agreed: list[_Agreed] = []
    parallax = False
    for (i, j), rows, (inlier, distances, flags) in _all_verified(found, seed, workers, progress):
        count = int(np.count_nonzero(inlier))
        used = count >= max(min_inliers, _SHARE * len(rows)) and not _WRONG & set(flags)
        names = found.names[i], found.names[j]
        checked.append(CheckedPair(names, len(rows), count, flags, used))
        if used:
            parallax |= not _WITHOUT_PARALLAX & set(flags)
            agreed.append(_Agreed(distances[inlier], i, j, rows[inlier], _STILL in flags))
    source = TrackSource(tuple(checked), {})
    if not agreed:
        raise NoTracks(
            "images",
            f"have nothing in common: {_best(source)}",
            "photographs of one scene that overlap",
        )
    if not parallax:
        raised = {flag for pair in checked if pair.used for flag in pair.flags}
        what = ", ".join(sorted(raised & _WITHOUT_PARALLAX))
        was = f"show no parallax: each pair is explained by a homography ({what})"
        raise NoTracks("images", was, "photographs of a scene in depth from different places")
    return _merged(found, agreed, source)


def _all_verified(
    found: PairwiseMatches,
    seed: int,
    workers: int,
    progress: Callable[[str, int, int], object] | None,
) -> Iterator[tuple[tuple[int, int], Indices, _Verdict]]:
    """Yield each pair, its matches, and its inliers, their distances, and its flags."""
    pairs = list(found.pairs.items())
    for begin in range(0, len(pairs), _PART):
        part = pairs[begin : begin + _PART]
        ends = np.cumsum([0, *(len(rows) for _, rows in part)])
        x1, x2 = (
            np.concatenate([found.points[pair[side]][rows[:, side]] for pair, rows in part])
            for side in (0, 1)
        )

        def told(done: int, _: int, before: int = begin) -> None:
            if progress is not None:
                progress("verification", before + done, len(pairs))

        batch = estimate_fundamental_batch(
            x1, x2, ends, seed=seed, workers=workers, progress=told, flags=True
        )
        for k, (images, rows) in enumerate(part):
            own = slice(int(ends[k]), int(ends[k + 1]))
            if len(rows) < _LEAST or batch.status[k] == REFUSED:
                none = np.zeros(len(rows), dtype=np.bool_), np.zeros(len(rows))
                yield images, rows, (*none, ("no common geometry",))
            else:
                verdict = batch.inlier[own], np.abs(batch.distances[own]), batch.flags[k]
                yield images, rows, verdict


def _best(source: TrackSource) -> str:
    """Return what the best pair had."""
    if not source.pairs:
        return "no pair has matches"
    best = max(source.pairs, key=lambda pair: (pair.inliers, pair.matches))
    pair = " and ".join(best.images)
    if set(best.flags) & _WRONG or best.inliers < _LEAST:
        return f"of {best.matches} matches of {pair} no more agree than by chance"
    return f"{best.inliers} of {best.matches} matches of {pair} agree"


def _merged(found: PairwiseMatches, agreed: list[_Agreed], source: TrackSource) -> Tracks:
    """Return the tracks of the largest part of the images that hangs together."""
    first = np.concatenate([[0], np.cumsum([len(points) for points in found.points])])
    nodes = np.concatenate([pair.rows + first[[pair.i, pair.j]] for pair in agreed])
    order = np.argsort(np.concatenate([pair.distances for pair in agreed]), kind="stable")
    image_of = np.repeat(np.arange(len(found.points)), np.diff(first))
    track_of = _united(nodes[order], image_of)
    moved = np.repeat([not pair.still for pair in agreed], [len(pair.rows) for pair in agreed])
    ends = track_of[nodes[moved]]
    in_depth = np.unique(ends[ends[:, 0] == ends[:, 1], 0])
    member = np.flatnonzero((track_of >= 0) & np.isin(track_of, in_depth))
    view, point = image_of[member], track_of[member]
    xy = np.concatenate([np.zeros((0, 2)), *found.points])[member]
    part = _largest_part(view, point, len(found.names))
    keep = part[view]
    try:
        tracks, views, _ = Tracks.pruned(view[keep], point[keep], xy[keep])
    except ArgumentError:
        raise NoTracks(
            "images",
            f"have too few points in common: {_best(source)}",
            f"{MIN_POINTS} points an image that {MIN_VIEWS} images see",
        ) from None
    colours = None
    if found.colours is not None:
        of_rows = np.concatenate([np.zeros((0, 3), np.uint8), *found.colours])[member][keep]
        # `pruned` renumbers: find each observation again by its place.
        colours = _mean_colours(tracks, views, view[keep], xy[keep], of_rows)
    kept = [found.names[k] for k in views]
    left_out = {name: _why(name, kept, source) for name in found.names if name not in set(kept)}
    return Tracks(
        tracks.view,
        tracks.point,
        tracks.xy,
        source=TrackSource(source.pairs, left_out),
        names=kept,
        sizes=found.sizes[views].astype(np.int64),
        colours=colours,
    )


def _united(edges: Indices, image_of: Indices) -> Indices:
    """Return the track of each feature, -1 of those without: union-find, one feature an image.

    Edges come best first; one that would join two features of one image is left out.
    """
    parent: dict[int, int] = {}
    members: dict[int, dict[int, int]] = {}

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    images = image_of.tolist()
    for a, b in edges.tolist():
        for node in (a, b):
            if node not in parent:
                parent[node] = node
                members[node] = {images[node]: node}
        a, b = root(a), root(b)
        if a == b or not members[a].keys().isdisjoint(members[b]):
            continue
        if len(members[a]) < len(members[b]):
            a, b = b, a
        parent[b] = a
        members[a] |= members.pop(b)
    track_of = np.full(len(image_of), -1, dtype=np.intp)
    kept = (own for own in members.values() if len(own) >= MIN_VIEWS)
    for number, own in enumerate(kept):
        track_of[list(own.values())] = number
    return track_of


def _largest_part(view: Indices, point: Indices, n: int) -> NDArray[np.bool_]:
    """Return which images belong to the part, joined by enough common points, with most views."""
    seen = np.zeros((n, int(point.max()) + 1), dtype=np.float32)
    seen[view, point] = 1.0
    joined = seen @ seen.T >= MIN_POINTS
    label = np.arange(n)
    for _ in range(n):
        spread = np.array([label[row | (np.arange(n) == k)].min() for k, row in enumerate(joined)])
        if (spread == label).all():
            break
        label = spread
    counts = np.bincount(label, minlength=n)
    return np.asarray(label == np.argmax(counts))


def _mean_colours(
    tracks: Tracks, views: Indices, view: Indices, xy: Array, colours: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Return the mean colour of the observations of each point."""
    known = {
        (v, x, y): k for k, (v, (x, y)) in enumerate(zip(view.tolist(), xy.tolist(), strict=True))
    }
    own = zip(views[tracks.view].tolist(), tracks.xy.tolist(), strict=True)
    rows = np.array([known[v, x, y] for v, (x, y) in own])
    sums = np.zeros((tracks.n_points, 3))
    np.add.at(sums, tracks.point, colours[rows].astype(float))
    return np.rint(sums / np.bincount(tracks.point)[:, None]).astype(np.uint8)


def _why(name: str, kept: list[str], source: TrackSource) -> str:
    """Return why an image has no place among the tracks."""
    own = [pair for pair in source.pairs if name in pair.images]
    used = [pair for pair in own if pair.used]
    if not used:
        most = max((pair.inliers for pair in own), default=0)
        return f"agrees with no other image: at most {most} matches have one geometry"
    others = {other for pair in used for other in pair.images} - {name}
    if others & set(kept):
        return "too few points in common with the others"
    listed = ", ".join(sorted(others)[:_LISTED]) + (" ..." if len(others) > _LISTED else "")
    return f"belongs to a part of its own, with {listed}"
