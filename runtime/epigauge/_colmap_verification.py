"""The raw matches of a COLMAP database, verified: what the two images have in common."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_count, as_positive
from epigauge._colmap_pair import Verified, verified
from epigauge._logged import logger
from epigauge._options import Backend
from epigauge._processes import Processes
from epigauge._results import Result
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import PathLike

if TYPE_CHECKING:
    from epigauge.io.colmap_raw import RawPair

__all__ = ["CONFIGS", "DatabaseVerification", "verify_database"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Meaning of `DatabaseVerification.config`: COLMAP's codes, and -1.
CONFIGS = {
    -1: "not read, or not to be used: the note says why; nothing is stored",
    1: "degenerate: the matches have no geometry in common",
    2: "calibrated: E, of cameras whose focal lengths are known",
    3: "uncalibrated: F",
    4: "planar: H of a plane, of calibrated cameras",
    5: "panoramic: H of a camera that only turned, calibrated",
    6: "planar or panoramic: H, which it is cannot be told",
    7: "watermark: matches at the borders that moved together",
}

#: A verified pair has so many inliers, as by COLMAP's default.
_MIN_INLIERS = 15

#: Pairs a task, tasks that wait, and pairs that are stored at a time.
_PART, _WAITING, _STORED = 16, 16, 256

#: So many pairs are verified by processes: as many as several workers take a second for.
_MANY = 256


@dataclass(frozen=True)
class DatabaseVerification(Result):
    """What the pairs of a COLMAP database were verified to be, one row a pair.

    Attributes
    ----------
    names : dict of int to str
        The images by their numbers.
    pair_id : ndarray of int, shape (n,)
        COLMAP's numbers of the pairs, rising.
    image_id : ndarray of int, shape (n, 2)
        Image 1 and 2, in the sense of ``x2^T F x1 = 0``.
    matches, inliers : ndarray of int, shape (n,)
        Numbers of raw matches, and of those that agree.
    config : ndarray of int, shape (n,)
        What the pair is, from `CONFIGS`.
    F, E, H : ndarray, shape (n, 3, 3)
        In COLMAP's pixels without distortion, E in calibrated coordinates, of unit norm; NaN where
        there is none. F and E of a calibrated pair belong together.
    noise_px : ndarray, shape (n,)
        Standard deviation of a coordinate; NaN where nothing was found.
    note : tuple of str
        Flags of the estimate, as `RobustResult.flags`, or why there is none.
    stored : ndarray of bool, shape (n,)
        Whether the pair was stored in the database.
    already : int
        Pairs that were verified before, and were left alone.
    backup : str or None
        Name of the copy that was made before.

    Examples
    --------
    >>> import epigauge as eg
    >>> result = eg.colmap.verify_database("database.db")  # doctest: +SKIP
    >>> [eg.colmap.CONFIGS[config] for config in result.config]  # doctest: +SKIP
    """

    names: dict[int, str] = field(repr=False)
    pair_id: Indices
    image_id: Indices
    matches: Indices
    inliers: Indices
    config: Indices
    F: Array = field(repr=False)
    E: Array = field(repr=False)
    H: Array = field(repr=False)
    noise_px: Array
    note: tuple[str, ...]
    stored: NDArray[np.bool_]
    already: int
    backup: str | None

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.pair_id)

    def _arrays(self) -> dict[str, Any]:
        names = {"image_numbers": list(self.names), "image_names": list(self.names.values())}
        arrays = {name: value for name, value in self._contents().items() if name != "names"}
        return names | arrays

    def _heading(self) -> str:
        return f"DatabaseVerification: {len(self)} pairs of {len(self.names)} images"

    def _summary_rows(self) -> dict[str, str]:
        counts = {code: int(np.count_nonzero(self.config == code)) for code in CONFIGS}
        rows = {CONFIGS[code].split(":")[0]: str(count) for code, count in counts.items() if count}
        return rows | ({"verified before": str(self.already)} if self.already else {})


def verify_database(
    path: PathLike,
    *,
    write: bool = False,
    backup: bool = True,
    min_inliers: int = _MIN_INLIERS,
    threshold_px: float | Literal["auto"] = "auto",
    seed: int = 0,
    backend: Backend | None = None,
    workers: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> DatabaseVerification:
    """Verify the raw matches of a COLMAP database, as its geometric verification does.

    `estimate_fundamental` finds what the matches of a pair agree on, whatever their noise; its
    flags tell planes, pure rotations and random matches. Pairs that are in the database already are
    left alone: a second run goes on where the first one was stopped.

    Parameters
    ----------
    path : str or path
        The SQLite file; of any COLMAP from 3 to 4.2.
    write : bool
        Store what is found in ``two_view_geometries``, some hundred pairs a transaction: a run that
        is interrupted leaves whole pairs. Without it the file is opened for reading only.
    backup : bool
        Copy the database first, to a new file beside it.
    min_inliers : int
        Pairs with fewer different inliers are degenerate; at least eight.
    threshold_px : float or "auto"
        Largest distance of an inlier, as of `estimate_fundamental`.
    seed : int
        Of everything random, the same for every pair.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.
    workers : int
        Threads, or processes where there are many pairs: threads of one Python wait for each
        other. The results do not depend on it.
    executor : concurrent.futures.Executor, optional
        Where to compute, instead of threads of this process, as of `refine_fundamental_batch`; the
        database is read and written here.
    progress : callable, optional
        Called as ``progress(done, n)`` after every pair, from the calling thread.

    Returns
    -------
    DatabaseVerification
        A row for every pair of raw matches that was not in the database. Pairs that cannot be used
        do not stop the others.

    Raises
    ------
    FileFormatError
        If the file is no database of a known version of COLMAP, is damaged, or holds no match.
    OSError
        If it cannot be opened or written, or another program has locked it.
    ArgumentError
        On bad options.

    Notes
    -----
    Lenses that are known are undone first: F and H belong to pixels of a camera without distortion
    of the same focal length and principal point. Where a lens of another model bends the points by
    more than their noise, the pair is not stored ("distorted cameras"). E is estimated where COLMAP
    knows the focal lengths of both cameras before (``prior_focal_length``), and stored if it
    explains 95 % of the inliers of F. Of calibrated cameras a plane and a rotation are told apart.

    Examples
    --------
    >>> found = eg.colmap.verify_database("database.db")  # doctest: +SKIP
    >>> print(found)  # doctest: +SKIP
    """
    # Here, since a Python may come without SQLite
    from epigauge.io.colmap_raw import RawDatabase

    options = {
        "min_inliers": as_count("min_inliers", min_inliers, at_least=8),
        "threshold_px": "auto"
        if threshold_px == "auto"
        else as_positive("threshold_px", threshold_px),
        "seed": as_count("seed", seed, at_least=0),
        "backend": kernels.table(backend).name,
    }
    workers = as_count("workers", workers)
    if executor is not None and not callable(getattr(executor, "submit", None)):
        needed = "one as of concurrent.futures: it has a method submit"
        raise ArgumentError("executor", f"is of type {type(executor).__name__}", needed)
    found: list[Verified] = []
    stored: list[bool] = []
    kept = None
    with RawDatabase(path, write=write) as database, ExitStack() as own_pool:
        ids, already = database.open_pairs()
        if not ids and not already:
            raise FileFormatError(path, "holds no raw match: match its images first")
        if write and backup and ids:
            kept = str(database.backup())
        pool = executor or own_pool.enter_context(_pool(workers, len(ids)))
        parts = (database.raw_pairs(ids[k : k + _PART]) for k in range(0, len(ids), _PART))
        for own in _in_turn(pool, parts, options):
            found.append(own)
            if progress is not None:
                progress(len(found), len(ids))
            if write and (len(found) - len(stored) == _STORED or len(found) == len(ids)):
                stored += _store(database, found[len(stored) :])
                database.commit()
        names = database.names()
    return _joined(found, stored, names, already, kept)


def _pool(workers: int, pairs: int) -> Executor:
    """Return where to compute: processes, where they gain more than the time they start in."""
    told = logger.isEnabledFor(logging.INFO)  # which a process cannot
    if workers > 1 and pairs >= _MANY and not told:
        try:
            return Processes(workers)
        except OSError:
            pass
    return ThreadPoolExecutor(workers)


def _in_turn(
    pool: Executor, parts: Iterator[list[RawPair]], options: dict[str, Any]
) -> Iterator[Verified]:
    """Verify parts wherever there is room, some ahead, and yield their pairs in order."""
    waiting: deque[Future[list[Verified]]] = deque()
    try:
        for part in parts:
            waiting.append(pool.submit(verified, part, options))
            if len(waiting) >= _WAITING:
                yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()
    finally:  # after an error or Ctrl-C, drop what has not begun
        for future in waiting:
            future.cancel()


def _store(database: Any, found: list[Verified]) -> list[bool]:
    """Store what may be used; return of each pair whether it was stored."""
    usable = [own.geometry.config > 0 for own in found]
    added = iter(
        database.store_geometries(own.geometry for own in found if own.geometry.config > 0)
    )
    return [use and next(added) for use in usable]


def _joined(
    found: list[Verified],
    stored: list[bool],
    names: dict[int, str],
    already: int,
    backup: str | None,
) -> DatabaseVerification:
    """Put the pairs together."""
    from epigauge.io._colmap_rows import MAX_IMAGES

    rows = [own.geometry for own in found]
    ids = np.array([row.pair_id for row in rows], np.int64)
    matrices = {
        name: np.array(
            [np.full((3, 3), np.nan) if (M := getattr(row, name)) is None else M for row in rows]
        ).reshape(-1, 3, 3)
        for name in ("F", "E", "H")
    }
    return DatabaseVerification(
        names=names,
        pair_id=ids,
        image_id=np.column_stack([ids // MAX_IMAGES, ids % MAX_IMAGES]),
        matches=np.array([own.matches for own in found], np.int64),
        inliers=np.array([len(row.inliers) for row in rows], np.int64),
        config=np.array([row.config for row in rows], np.int64),
        **matrices,
        noise_px=np.array([own.noise_px for own in found]),
        note=tuple(own.note for own in found),
        stored=np.array(stored if stored else [False] * len(found), np.bool_),
        already=already,
        backup=backup,
    )
