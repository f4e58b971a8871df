"""The raw matches of a COLMAP database, verified: what the two images have in common."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_count, as_positive
from epigauge._logged import logger
from epigauge._options import Backend
from epigauge._processes import Processes
from epigauge._results import Result
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import PathLike
from epigauge.two_view.conditioning import condition
from epigauge.two_view.consensus import Consensus
from epigauge.two_view.copies import earliest
from epigauge.two_view.essential import Calibrated
from epigauge.two_view.homography import fit_homography, robust_homography
from epigauge.two_view.refine import plan_of
from epigauge.two_view.robust import RobustResult, estimated
from epigauge.two_view.solve import Matches, minimize

if TYPE_CHECKING:
    from epigauge.io.colmap_raw import Geometry, RawPair

__all__ = ["CONFIGS", "DatabaseVerification", "verify_database"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

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
_DEGENERATE, _CALIBRATED, _UNCALIBRATED, _PLANAR, _PANORAMIC, _EITHER, _WATERMARK = range(1, 8)

#: A verified pair has so many inliers, as by COLMAP's default.
_MIN_INLIERS = 15

#: The share of the inliers of F that E must explain, as by COLMAP's default.
_BY_E = 0.95

#: A rotation explains matches as well as a homography up to this ratio of the variances.
_AS_WELL = 1.5

#: A watermark: at least this share of the inliers lie in the border, as wide as this share of the
#: image's diagonal, and moved together within so many pixels; the defaults of COLMAP.
_AT_BORDER, _BORDER, _TOGETHER_PX = 0.7, 0.1, 4.0

#: A lens bends the points when it moves them by more than this many deviations of their noise, and
#: by more than so many pixels.
_BENT, _BENT_PX = 1.0, 0.5

#: Flags that say that the inliers determine neither F nor a homography.
_NOTHING = frozenset({"no common geometry", "undetermined"})

#: Ratio of the two singular values of E below which it has rank one.
_RANK_ONE = 16.0 * np.finfo(float).eps

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


class Verified(NamedTuple):
    """What was found of a pair, and how many raw matches it has."""

    geometry: Geometry
    matches: int
    noise_px: float
    note: str


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


def verified(pairs: list[RawPair], options: dict[str, Any]) -> list[Verified]:
    """Verify some pairs, here or wherever an executor takes this."""
    return [_verified(pair, **options) for pair in pairs]


def _verified(
    pair: RawPair, min_inliers: int, threshold_px: float | str, seed: int, backend: str
) -> Verified:
    from epigauge.io.colmap_raw import Geometry

    def told(
        config: int, inlier: Mask | None = None, noise: float = np.nan, note: str = "", **more: Any
    ) -> Verified:
        inliers = pair.matches[np.zeros(len(pair.matches), np.bool_) if inlier is None else inlier]
        geometry = Geometry(pair.pair_id, config, inliers, **more)
        return Verified(geometry, len(pair.matches), noise, note)

    if pair.reason:
        return told(-1, note=pair.reason)
    # Copies tell nothing more.
    first = earliest(np.ascontiguousarray(pair.x1), np.ascontiguousarray(pair.x2))
    different = int(np.count_nonzero(first == np.arange(len(first))))
    if different < min_inliers:
        return told(_DEGENERATE, note=f"{different} matches")
    try:
        result = estimated(
            pair.x1, pair.x2, "auto", threshold_px, None, seed, {"backend": backend}
        ).result
    except ArgumentError as error:  # too few different ones, or all on a line
        return told(_DEGENERATE, note=str(error))
    flags, inlier, noise = result.flags, result.inlier, result.rms_px * _per_coordinate(result)
    note = ", ".join(flags)
    count = min(int(np.count_nonzero(inlier)), len(result.used))
    if not _NOTHING.isdisjoint(flags) or count < min_inliers:
        return told(_DEGENERATE, note=note or f"{count} inliers")
    if pair.bend_px > max(_BENT * noise, _BENT_PX):
        return told(-1, note=", ".join(filter(None, (note, "distorted cameras"))))
    if _is_watermark(pair, inlier):
        return told(_WATERMARK, inlier, noise, note)
    if not {"planar scene", "still camera", "pure rotation"}.isdisjoint(flags):
        config, H, on = _homography(pair, result)
        return told(config, on, noise, note, F=result.F, H=H)
    E = _essential(pair, result, backend)
    if E is not None:
        return told(_CALIBRATED, E[2], noise, note, F=E[0], E=E[1])
    return told(_UNCALIBRATED, inlier, noise, note, F=result.F)


def _per_coordinate(result: RobustResult) -> float:
    """Return the noise of a coordinate over the RMS of the residual coordinates."""
    n = len(result.used)
    return 2.0 * float(np.sqrt(n / max(n - 7.0, 1.0)))


def _is_watermark(pair: RawPair, inlier: Mask) -> bool:
    """Tell whether most inliers lie at the borders of both images and moved together."""
    at_border = np.ones(np.count_nonzero(inlier), np.bool_)
    for raw, size in zip((pair.raw1, pair.raw2), pair.sizes, strict=True):
        if size is None:
            return False
        border = _BORDER * np.hypot(*size)
        x = raw[inlier]
        at_border &= ((x < border) | (x > np.array(size) - border)).any(axis=1)
        if np.count_nonzero(at_border) < _AT_BORDER * len(at_border):
            return False
    moved = (pair.raw2 - pair.raw1)[inlier]
    together = np.linalg.norm(moved - np.median(moved, axis=0), axis=1) <= _TOGETHER_PX
    return bool(np.mean(together) >= _AT_BORDER)


def _homography(pair: RawPair, result: RobustResult) -> tuple[int, Array, Mask]:
    """Return the code of a pair that a homography explains, the homography and its inliers."""
    x1, x2 = pair.x1[result.inlier], pair.x2[result.inlier]
    frame = condition(x1, x2)
    q1, q2 = (np.ascontiguousarray(q) for q in frame.forward(x1, x2))
    to_units1, to_units2 = frame.maps_from_pixels()
    # Distances in both images; F has left one of their two directions free
    limit2 = 2.0 * (result.threshold_px / frame.scale) ** 2
    near = robust_homography(q1, q2, np.ones(len(x1)))[1] <= limit2
    H, squared, _ = fit_homography(q1, q2, near.astype(np.float64))
    on = squared <= limit2
    inlier = result.inlier.copy()
    inlier[inlier] = on
    code = _EITHER
    if pair.K1 is not None and pair.K2 is not None:
        code = _PANORAMIC if {"still camera", "pure rotation"} & set(result.flags) else _PLANAR
        cameras = Calibrated(q1[:, on], q2[:, on], to_units1 @ pair.K1, to_units2 @ pair.K2)
        n = int(np.count_nonzero(on))
        rotation = np.sum(cameras.from_rotation(np.ones(n))) / max(2 * n - 3, 1)
        if rotation <= _AS_WELL * np.sum(squared[on]) / max(2 * n - 8, 1):
            code = _PANORAMIC
    H = np.linalg.inv(to_units2) @ H @ to_units1
    return code, H / np.linalg.norm(H), inlier


def _essential(
    pair: RawPair, result: RobustResult, backend: str
) -> tuple[Array, Array, Mask] | None:
    """Return F, E and inliers of calibrated cameras; None where E does not explain them."""
    if pair.K1 is None or pair.K2 is None:
        return None
    F0, x1, x2 = result.F, pair.x1[result.used], pair.x2[result.used]
    matches = Matches.of(x1, x2, np.ones(len(x1)), F0, kernels.table(backend))
    E0 = pair.K2.T @ F0 @ pair.K1
    values = np.linalg.svd(E0, compute_uv=False)
    if not values[1] > _RANK_ONE * values[0]:
        return None  # points so far off for these cameras that E has rank 1 in double precision
    options = replace(plan_of({"backend": backend}).options, calibration=(pair.K1, pair.K2))
    found = minimize(matches, options, matches.frame.from_pixels(F0)).F
    q1, q2 = matches.frame.forward(pair.x1, pair.x2)
    signed = Consensus(matches.table, q1, q2).measured(found)[0]
    with np.errstate(invalid="ignore"):
        inlier = result.inlier & (matches.frame.scale * np.abs(signed) <= result.threshold_px)
    if np.count_nonzero(inlier) < _BY_E * np.count_nonzero(result.inlier):
        return None
    F = matches.frame.to_pixels(found)
    E = pair.K2.T @ F @ pair.K1
    return F, E / np.linalg.norm(E), inlier


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
