"""Writing scenes as folders of parts, from tracks or from chunks as they come."""

from __future__ import annotations

import errno
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import MAX_PX, as_array, as_choice, as_count, as_real, as_weights
from epigauge.bundle.observations import ObservationGraph
from epigauge.cameras import MetricReconstruction
from epigauge.distributed.observations import Observations
from epigauge.distributed.part_files import STORAGES, write_part
from epigauge.distributed.parts import CAMERAS, FORM, MANIFEST, PartArrays
from epigauge.distributed.pieces import cut
from epigauge.errors import ArgumentError
from epigauge.io._common import PathLike
from epigauge.io._npz import write_npz
from epigauge.io.output import writing
from epigauge.multi_view.labels import view_names
from epigauge.multi_view.tracks import MIN_VIEWS, Tracks
from epigauge.multi_view.verdicts.network import loose_parts

__all__ = ["Chunk", "PartsWriter", "write_parts"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class Chunk(NamedTuple):
    """Some points with all of their observations.

    Attributes
    ----------
    X : array_like, shape (m, 3)
        Where the points begin.
    view : array_like of int, shape (N,)
        Numbers of the views.
    point : array_like of int, shape (N,)
        Rows of `X`.
    xy : array_like, shape (N, 2)
        Pixels.
    weights : array_like, shape (N,), optional
        Factor of each squared residual.

    Examples
    --------
    >>> import epigauge as eg
    >>> chunk = eg.distributed.Chunk([[0.0, 0.0, 4.0]], [0, 1], [0, 0], [[0.0, 0.0], [90.0, 0.0]])
    >>> len(chunk.view)
    2
    """

    X: ArrayLike
    view: ArrayLike
    point: ArrayLike
    xy: ArrayLike
    weights: ArrayLike | None = None


def write_parts(
    source: Tracks | Iterable[Chunk],
    folder: PathLike,
    start: MetricReconstruction,
    *,
    partitions: int | None = None,
    names: Sequence[str] | None = None,
    storage: str = "npz",
) -> Path:
    """Write a scene as a folder of parts, which `epigauge.distributed.bundle_adjust` adjusts.

    Parameters
    ----------
    source : Tracks or iterable of Chunk
        Observations. Of an iterable, each chunk becomes a part and is forgotten: no more than one
        has to exist at a time. Some 100,000 observations of neighbouring points suit best.
    folder : str or path
        A new or empty folder; what holds the workers' files must be able to see it.
    start : MetricReconstruction
        The cameras that adjustments begin at, and the points of tracks; those of chunks come with
        these, and the points of `start` do not count.
    partitions : int, optional
        Of tracks: how many parts; by default one for each 250,000 observations, at least 8.
    names : sequence of str, optional
        Of the views; by default those of the tracks.
    storage : {"npz", "parquet", "zarr"}
        Form of the parts. Parquet, a row a point with lists of its observations, needs pyarrow;
        Zarr, a group in a ZIP file, needs zarr. All hold the same bits.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ArgumentError
        On tracks or chunks that cannot be adjusted so: repeated sightings, weights of zero, points
        seen by fewer than two views, views without observations, views not tied to the others,
        and folders that hold something.
    MissingPackageError
        If the form needs a package that is not installed.
    OSError
        If it cannot be written.

    Notes
    -----
    The manifest ``parts.json`` is written last: a folder without it was not finished.

    Examples
    --------
    >>> import tempfile
    >>> import epigauge as eg
    >>> cameras = eg.Cameras("SIMPLE_PINHOLE", [[800.0, 320.0, 240.0]], [0, 0])
    >>> start = eg.MetricReconstruction(
    ...     [np.eye(3)] * 2, [[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]], np.zeros((1, 3)), cameras
    ... )
    >>> X = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))
    >>> def chunks():
    ...     for half in (X[:10], X[10:]):
    ...         view, point = np.tile([0, 1], 10), np.repeat(np.arange(10), 2)
    ...         x = half[point] + start.t[view]
    ...         xy = 800.0 * x[:, :2] / x[:, 2:] + [320.0, 240.0]
    ...         yield eg.distributed.Chunk(half, view, point, xy)
    >>> folder = eg.distributed.write_parts(chunks(), tempfile.mkdtemp(), start)
    >>> sorted(path.name for path in folder.iterdir())
    ['cameras.npz', 'part-00000.npz', 'part-00001.npz', 'parts.json']
    """
    if not isinstance(start, MetricReconstruction):
        was = f"is a {type(start).__name__}"
        raise ArgumentError("start", was, "an eg.MetricReconstruction: calibrated cameras")
    if start.lines is not None:
        raise ArgumentError("start", "has lines, which would be lost", "one without lines")
    if isinstance(source, Tracks):
        named = source.names if names is None else names
        unit, whitened = source.unit, source.whitening is not None
        arrays: Iterator[PartArrays] = _of_tracks(source, start, partitions)
    else:
        if not isinstance(source, Iterable):
            was = f"is a {type(source).__name__}"
            raise ArgumentError("source", was, "eg.Tracks(...), or chunks")
        if partitions is not None:
            raise ArgumentError("partitions", "is given with chunks", "one chunk for each part")
        named, unit, whitened = names, 1.0, False
        arrays = _of_chunks(source, start.n_views)
    as_choice("storage", storage, tuple(STORAGES))
    writer = PartsWriter.new(folder, start.n_views, unit, whitened, named, storage=storage)
    for part in arrays:
        writer.add(part)
    writer.finish(start)
    return writer.folder


@dataclass
class PartsWriter:
    """A folder that parts are written to, and what the manifest will say.

    Attributes
    ----------
    folder : Path
        Where.
    n_views : int
        Number of views.
    unit : float
        As that of `Tracks`.
    whitened : bool
        Whether measurements have covariances.
    names : tuple of str or None
        Of the views.
    storage : str
        Form of the parts.
    """

    folder: Path
    n_views: int
    unit: float
    whitened: bool
    names: tuple[str, ...] | None
    storage: str = "npz"
    scene: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    heaviest: float = 0.0
    _rows: list[dict[str, Any]] = field(default_factory=list)
    _ties: Indices = field(default_factory=lambda: np.zeros(0, np.intp))

    def __post_init__(self) -> None:
        n = self.n_views
        self._counts, self._sums, self._squares = np.zeros(n), np.zeros((n, 2)), 0.0
        self._middle: Array | None = None

    @classmethod
    def new(
        cls,
        folder: PathLike,
        n_views: int,
        unit: float,
        whitened: bool,
        names: Sequence[str] | None,
        name: str = "folder",
        storage: str = "npz",
    ) -> PartsWriter:
        """Begin a folder, which must be new or empty; `name` is what errors call it."""
        if not isinstance(folder, str | os.PathLike):
            raise ArgumentError(name, f"is a {type(folder).__name__}", "the name of a folder")
        folder = Path(folder)
        if not folder.absolute().parent.is_dir():
            parent = str(folder.parent)
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), parent)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ArgumentError(name, f"{str(folder)!r} holds something", "a new one")
        folder.mkdir(exist_ok=True)
        known = None if names is None else view_names(names, n_views)
        return cls(folder, n_views, unit, whitened, known, storage)

    def add(self, part: PartArrays) -> None:
        """Write a part."""
        own = part.observations
        name = f"part-{len(self._rows):05d}.{self.storage}"
        arrays: dict[str, Any] = {
            "scene": np.frombuffer(self.scene, np.uint8),
            "number": part.number,
            "X": part.X,
            "view": own.view.astype(np.int32),
            "point": own.point.astype(np.int32),
            "xy": np.ascontiguousarray(own.q.T),
            "weights": own.weights,
        }
        if own.whitening is not None:
            arrays["whitening"] = np.ascontiguousarray(own.whitening.transpose(2, 0, 1))
        write_part(self.folder / name, arrays)
        size = (self.folder / name).stat().st_size
        counts = {"n_points": len(part.X), "n_observations": len(own)}
        self._rows.append({"file": name, "bytes": size, **counts})
        self._count(own)

    def finish(self, start: MetricReconstruction) -> None:
        """Write cameras and manifest.

        Raises
        ------
        ArgumentError
            If views are left without observations, or not tied to the others.
        """
        empty = np.flatnonzero(self._counts == 0.0)
        if len(empty):
            was = f"never is {empty[0]}"
            raise ArgumentError("view", was, "observations in every view of the start")
        first, other = self._ties // self.n_views, self._ties % self.n_views
        # Each tie is a point of two views.
        ends = np.stack([first, other], axis=1).ravel()
        loose = loose_parts(ends, np.repeat(np.arange(len(first)), 2), self.n_views)
        if loose:
            was = f"{loose[0][:5].tolist()} share no point with the others"
            raise ArgumentError("view", was, "connected observations; adjust the parts one by one")
        squares = self._squares - float(np.sum(self._sums**2 / self._counts[:, None]))
        N = int(self._counts.sum())
        if not squares > 0.0:
            raise ArgumentError("xy", "has all points of a view at one place", "other points")
        cameras = start.cameras
        with writing(self.folder / CAMERAS) as file:
            arrays: dict[str, Any] = {"scene": np.frombuffer(self.scene, np.uint8)}
            arrays |= {"R": start.R, "t": start.t, "params": cameras.params}
            arrays["camera_of_view"] = cameras.camera_of_view
            arrays["model"] = np.frombuffer(cameras.model.encode(), np.uint8)
            write_npz(file, arrays, compressed=False)
        document = {
            "form": FORM,
            "scene": self.scene.hex(),
            "n_views": self.n_views,
            "n_points": sum(row["n_points"] for row in self._rows),
            "n_observations": N,
            "unit": self.unit,
            "heaviest": self.heaviest,
            "scale_px": float(np.sqrt(squares / (2 * N))),
            "whitened": self.whitened,
            "names": self.names,
            "parts": self._rows,
        }
        with writing(self.folder / MANIFEST) as file:
            file.write(json.dumps(document, indent=1).encode() + b"\n")

    def _count(self, own: Observations) -> None:
        n = self.n_views
        if self._middle is None:  # so that squares do not cancel
            self._middle = own.q.mean(axis=1)
        q = own.q - self._middle[:, None]
        self._counts += np.bincount(own.view, minlength=n)
        self._sums += np.stack([np.bincount(own.view, row, n) for row in q], axis=1)
        self._squares += float(np.vdot(q, q))
        self.heaviest = max(self.heaviest, float(own.weights.max()))
        first = np.searchsorted(own.point, np.arange(own.point[-1] + 1))
        ties = own.view[first][own.point] * n + own.view
        self._ties = np.union1d(self._ties, ties)


def _of_tracks(
    tracks: Tracks, start: MetricReconstruction, partitions: int | None
) -> Iterator[PartArrays]:
    """Give the parts of tracks, the partitions that these would be adjusted in."""
    if (start.n_views, start.n_points) != (tracks.n_views, tracks.n_points):
        needed = f"{tracks.n_views} views and {tracks.n_points} points, as the tracks"
        raise ArgumentError("start", f"has {start.n_views} and {start.n_points}", needed)
    if tracks.n_repeated:
        was = f"see {tracks.n_repeated} points again in one view"
        raise ArgumentError("tracks", was, "tracks.merged()[0], or load_scene(repeated='first')")
    zero = np.flatnonzero(tracks.weights == 0.0)
    if len(zero):
        was = f"have {len(zero)} observations of weight zero (row {zero[0]})"
        raise ArgumentError("tracks", was, "tracks without these")
    if partitions is not None:
        partitions = as_count("partitions", partitions)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    q, weights = np.ascontiguousarray(tracks.xy.T), np.asarray(tracks.weights)
    for piece in cut(graph, q, weights, tracks.whitening, partitions):
        assert isinstance(piece.source, Observations)
        yield PartArrays(piece.points, start.X[piece.points], piece.source)


def _of_chunks(chunks: Iterable[Chunk], n_views: int) -> Iterator[PartArrays]:
    """Give the parts of chunks, their points numbered as they come."""
    begin = k = 0
    for k, chunk in enumerate(chunks, 1):
        fields: tuple[Any, ...] = tuple(chunk) if isinstance(chunk, tuple | list) else ()
        if len(fields) not in (len(Chunk._fields) - 1, len(Chunk._fields)):
            was = f"gives {type(chunk).__name__} as chunk {k - 1}"
            raise ArgumentError("source", was, "eg.distributed.Chunk(X, view, point, xy)")
        part = _checked(f"chunk {k - 1}", Chunk(*fields), n_views, begin)
        begin += len(part.X)
        yield part
    if not k:
        raise ArgumentError("source", "gives no chunk", "at least one")


def _checked(where: str, chunk: Chunk, n_views: int, begin: int) -> PartArrays:
    X = as_real(f"X of {where}", chunk.X, "an (m, 3) array")
    if X.ndim != 2 or X.shape[1] != 3 or not len(X) or not np.isfinite(X).all():
        raise ArgumentError(f"X of {where}", f"has shape {X.shape}", "finite numbers, (m, 3)")
    views, points = (
        _indices(f"{name} of {where}", value, limit)
        for name, value, limit in (("view", chunk.view, n_views), ("point", chunk.point, len(X)))
    )
    xy = as_real(f"xy of {where}", chunk.xy, "an (N, 2) array")
    N = len(views)
    if xy.shape != (N, 2) or len(points) != N:
        was = f"has shape {xy.shape} beside {N} views and {len(points)} points"
        raise ArgumentError(f"xy of {where}", was, "one row an observation, (N, 2)")
    bad = np.flatnonzero(~(np.abs(xy) <= MAX_PX).all(axis=1))
    if len(bad):
        raise ArgumentError(f"xy of {where}", f"is not finite in row {bad[0]}", "pixels")
    weights = np.ones(N) if chunk.weights is None else as_weights(chunk.weights, N)
    if not (weights > 0.0).all():
        was = f"are zero in row {int(np.argmin(weights))}"
        raise ArgumentError(f"weights of {where}", was, "observations that count alone")
    order = np.lexsort((views, points))
    view, point = views[order], points[order]
    again = (np.diff(view) == 0) & (np.diff(point) == 0)
    if again.any():
        k = int(np.argmax(again))
        was = f"name view {view[k]}, point {point[k]} twice"
        raise ArgumentError(f"view, point of {where}", was, "one observation of a point in a view")
    counts = np.bincount(point, minlength=len(X))
    if counts.min() < MIN_VIEWS:
        was = f"{int(np.argmin(counts))} has fewer than {MIN_VIEWS} observations"
        raise ArgumentError(f"point of {where}", was, "all observations of a point in its chunk")
    q = np.ascontiguousarray(xy[order].T)
    return PartArrays(
        np.arange(begin, begin + len(X)), X, Observations(view, point, q, weights[order])
    )


def _indices(name: str, value: ArrayLike, limit: int) -> Indices:
    index = as_array(name, value, "an (N,) array")
    if index.ndim != 1 or index.dtype.kind not in "iu" or not len(index):
        raise ArgumentError(name, f"is {index.dtype} {index.shape}", "integers, (N,)")
    bad = np.flatnonzero((index < 0) | (index >= limit))
    if len(bad):
        raise ArgumentError(name, f"is {index[bad[0]]} in row {bad[0]}", f"0 to {limit - 1}")
    return index.astype(np.intp)
