"""Raw matches of a COLMAP database verified; fundamental matrices refined and put back.

>>> import epigauge as eg
>>> result = eg.colmap.refine_database("database.db")  # doctest: +SKIP
>>> result.image_id, result.F, result.rms_before_px, result.rms_px  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_count
from epigauge._colmap_verification import CONFIGS, DatabaseVerification, verify_database
from epigauge._options import PairOptions, known_options
from epigauge._results import Result
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import PathLike
from epigauge.two_view.batch import refine_fundamental_batch
from epigauge.two_view.batch_result import BATCH_STATUS, FundamentalBatch
from epigauge.two_view.copies import earliest
from epigauge.two_view.geometry import reprojection_distances
from epigauge.two_view.initial import fundamental_8point
from epigauge.two_view.tensors import REFUSED
from epigauge.verdicts import ordered

if TYPE_CHECKING:
    from epigauge.io.colmap import VerifiedPairs

__all__ = [
    "CONFIGS",
    "VERDICTS",
    "DatabaseResult",
    "DatabaseVerification",
    "refine_database",
    "verify_database",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: What became of a pair.
VERDICTS = {
    "refined": "at the minimum of the reprojection error, no worse than before",
    "degenerate": "the inliers do not determine F, or COLMAP says so (config 4 to 6)",
    "unsupported": "wrong matches among the inliers, or nothing but wrong ones",
    "distorted": "the lens bends the points by more than their noise: undistort them first",
    "worse": "the RMS of the inliers rose, as it may with a robust loss",
    "not converged": "the refinement stopped early",
    "skipped": "the pair could not be read, or has too few inliers",
}

#: Flags of `FundamentalResult.flags` that make a pair unsupported, and degenerate.
_UNSUPPORTED = {"no common geometry", "gross errors"}
_DEGENERATE = {"still camera", "planar scene", "nearly planar", "pure rotation", "weak geometry"}

#: What COLMAP says of pairs that one homography describes, by config.
_HOMOGRAPHY = {
    4: "COLMAP calls it planar",
    5: "COLMAP calls it a panorama",
    6: "COLMAP calls it planar or a panorama",
}

#: A lens bends the points when it moves them by more than this many deviations of their noise, and
#: by more than so many pixels.
_BENT, _BENT_PX = 1.0, 0.5

#: A relative rise of the RMS up to this is rounding.
_ROUNDING = 1e-9

#: Fields that are the batch's own.
_FROM_BATCH = ("F", "covariance", "noise_px", "sigma", "condition", "rank", "nfev")

#: Options of `refine_fundamental` that the database answers.
_FROM_DATABASE = ("F0", "weights", "covariance1", "covariance2", "callback", "flags")


@dataclass(frozen=True)
class DatabaseResult(Result):
    """What became of the verified pairs of a COLMAP database, one row a pair.

    Lengths are in pixels. F belongs to COLMAP's pixels, with (0.5, 0.5) in the middle of the
    top-left one; `epigauge.interop.move_fundamental` gives F for other pixels.

    Attributes
    ----------
    names : dict of int to str
        The images by their numbers.
    pair_id : ndarray of int, shape (n,)
        COLMAP's numbers of the pairs, rising.
    image_id : ndarray of int, shape (n, 2)
        Image 1 and 2, in the sense of ``x2^T F x1 = 0``.
    config : ndarray of int, shape (n,)
        What COLMAP took the pair for, as pycolmap's ``TwoViewGeometryConfiguration``.
    inliers : ndarray of int, shape (n,)
        Number of inliers; 0 for a pair that could not be read.
    F_before : ndarray, shape (n, 3, 3)
        F as the database held it, of unit norm; NaN where it held none.
    F : ndarray, shape (n, 3, 3)
        Refined, of unit norm; zero where skipped.
    covariance : ndarray, shape (n, 9, 9)
        Covariance of vect(F), as `FundamentalResult.covariance`.
    rms_before_px, rms_px : ndarray, shape (n,)
        sqrt(sum of squared residual coordinates / (4 m)) of the inliers, exact, before and after;
        NaN where there is no F.
    noise_px, sigma, condition : ndarray, shape (n,)
        As in `FundamentalResult`.
    rank, nfev : ndarray of int, shape (n,)
        Likewise.
    verdict : tuple of str
        One of `VERDICTS` a pair.
    note : tuple of str
        Why a pair was not refined; of a refined one its flags, which are warnings.
    stored : ndarray of bool, shape (n,)
        Whether F was stored in the database.
    backup : str or None
        Name of the copy that was made before.

    Examples
    --------
    >>> import epigauge as eg
    >>> result = eg.colmap.refine_database("database.db")  # doctest: +SKIP
    >>> result.verdict, result.rms_px  # doctest: +SKIP
    """

    names: dict[int, str] = field(repr=False)
    pair_id: Indices
    image_id: Indices
    config: Indices
    inliers: Indices
    F_before: Array = field(repr=False)
    F: Array = field(repr=False)
    covariance: Array = field(repr=False)
    rms_before_px: Array
    rms_px: Array
    noise_px: Array
    sigma: Array
    condition: Array
    rank: NDArray[np.intp]
    nfev: NDArray[np.intp]
    verdict: tuple[str, ...]
    note: tuple[str, ...]
    stored: NDArray[np.bool_]
    backup: str | None

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.pair_id)

    def _arrays(self) -> dict[str, Any]:
        names = {"image_numbers": list(self.names), "image_names": list(self.names.values())}
        arrays = {name: value for name, value in self._contents().items() if name != "names"}
        return names | arrays

    def _heading(self) -> str:
        return f"DatabaseResult: {len(self)} pairs of {len(self.names)} images"

    def _summary_rows(self) -> dict[str, str]:
        counts = {verdict: self.verdict.count(verdict) for verdict in VERDICTS}
        return {verdict: str(count) for verdict, count in counts.items() if count}


def refine_database(
    path: PathLike,
    *,
    write: bool = False,
    backup: bool = True,
    workers: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int, int], object] | None = None,
    **options: Unpack[PairOptions],
) -> DatabaseResult:
    """Refine the fundamental matrix of every verified pair of a COLMAP database.

    The inliers that COLMAP verified are taken as they are. Each pair starts from the better of the
    stored F and the 8-point estimate.

    Parameters
    ----------
    path : str or path
        The SQLite file; of any COLMAP from 3 to 4.2.
    write : bool
        Store F of the pairs whose verdict is "refined", all in one transaction: a run that is
        interrupted leaves the database as it was. E, H, the pose and the inliers stay. Without it
        the file is opened for reading only.
    backup : bool
        Copy the database first, to a new file beside it.
    workers : int
        Threads. The results do not depend on it.
    executor : concurrent.futures.Executor, optional
        Where to refine, as of `refine_fundamental_batch`; the database is read and written here.
    progress : callable, optional
        Called as ``progress(done, n)`` after every pair, from the calling thread.
    **options
        Options of `refine_fundamental`, the same for every pair. The noise is by default
        estimated from the residuals.

    Returns
    -------
    DatabaseResult
        A row for every pair with inliers. Pairs that cannot be used do not stop the others.

    Raises
    ------
    FileFormatError
        If the file is no database of a known version of COLMAP, is damaged, or holds no
        verified pair.
    OSError
        If it cannot be opened or written, or another program has locked it.
    ArgumentError
        On bad options.

    Notes
    -----
    Keypoints are used where they were found: lens distortion is not removed, as in COLMAP's own
    estimates of F. Where it moves the points by more than their noise, the verdict is "distorted":
    `colmap image_undistorter` and matching anew give pairs that F can describe. COLMAP takes the
    motion of calibrated pairs from E; F counts for uncalibrated pairs and for focal lengths found
    from F.

    Examples
    --------
    >>> found = eg.colmap.refine_database("database.db")  # doctest: +SKIP
    >>> print(found)  # doctest: +SKIP
    """
    # Here, since a Python may come without SQLite
    from epigauge.io.colmap import ColmapDatabase

    for name in _FROM_DATABASE:
        if name in options:
            raise ArgumentError(name, "is given", "none: the database holds what is used")
    known = {"noise_px": None} | known_options("refine_database", options, PairOptions)
    workers = as_count("workers", workers)
    with ColmapDatabase(path, write=write) as database:
        total = database.count()
        if not total:
            raise FileFormatError(path, "holds no verified pair: match its images first")
        parts: list[dict[str, Any]] = []
        done = 0
        for pairs in database.pairs():
            told = _shifted(progress, done, total)
            parts.append(_refined(pairs, workers, executor, told, known))
            done += len(pairs)
        result = _joined(parts, database.names())
        accepted = np.array([verdict == "refined" for verdict in result.verdict])
        if write and accepted.any():
            kept = str(database.backup()) if backup else None
            database.store(zip(result.pair_id[accepted], result.F[accepted], strict=True))
            database.commit()
            result = replace(result, stored=accepted, backup=kept)
    return result


def _refined(
    pairs: VerifiedPairs,
    workers: int,
    executor: Executor | None,
    progress: Callable[[int, int], object] | None,
    options: dict[str, Any],
) -> dict[str, Any]:
    """Refine some pairs; return the fields of `DatabaseResult` that are theirs."""
    numbers = range(len(pairs))
    with ThreadPoolExecutor(workers) as pool:
        before, starts = zip(*pool.map(lambda k: _start(pairs, k), numbers), strict=True)
    batch = refine_fundamental_batch(
        pairs.x1,
        pairs.x2,
        pairs.offsets,
        np.array(starts),
        workers=workers,
        executor=executor,
        progress=progress,
        flags=True,
        **options,
    )
    refused = batch.status == REFUSED
    verdicts, notes = zip(*(_verdict(pairs, batch, before[k], k) for k in numbers), strict=True)
    return {
        "pair_id": pairs.pair_id,
        "image_id": pairs.image_id,
        "config": pairs.config,
        "inliers": np.diff(pairs.offsets),
        "F_before": pairs.F,
        "rms_before_px": np.array(before),
        "rms_px": np.where(refused, np.nan, batch.rms_px),
        "verdict": verdicts,
        "note": notes,
    } | {name: getattr(batch, name) for name in _FROM_BATCH}


def _start(pairs: VerifiedPairs, k: int) -> tuple[float, Array]:
    """Return the RMS of the stored F of a pair, and the F to start from."""
    rows = slice(pairs.offsets[k], pairs.offsets[k + 1])
    once = earliest(pairs.x1[rows], pairs.x2[rows]) == np.arange(rows.stop - rows.start)
    x1, x2 = pairs.x1[rows][once], pairs.x2[rows][once]
    before = _rms_px(pairs.F[k], x1, x2)
    try:
        linear = fundamental_8point(x1, x2)
    except ArgumentError:  # the batch will say why
        return before, np.eye(3)
    return before, pairs.F[k] if before <= _rms_px(linear, x1, x2) else linear


def _rms_px(F: Array, x1: Array, x2: Array) -> float:
    """Return the RMS of the reprojection error, NaN where there is no F or no match."""
    try:
        distances = reprojection_distances(F, x1, x2)[0]
    except ArgumentError:  # NaN, or of rank 1
        return float("nan")
    return float(np.sqrt(np.mean(distances**2) / 4.0)) if len(distances) else float("nan")


def _verdict(
    pairs: VerifiedPairs, batch: FundamentalBatch, before: float, k: int
) -> tuple[str, str]:
    """Return what became of a pair, and why."""
    reason = pairs.reasons.get(k) or batch.reasons.get(k)
    if reason is not None:
        return "skipped", reason
    raised = set(batch.flags[k])
    if pairs.bend_px[k] > max(_BENT * batch.noise_px[k], _BENT_PX):
        raised.add("distorted cameras")
    flags = ", ".join(ordered(raised))
    if not _UNSUPPORTED.isdisjoint(raised):
        return "unsupported", flags
    config = _HOMOGRAPHY.get(int(pairs.config[k]))
    if config is not None:
        return "degenerate", f"{config}; {flags}" if flags else config
    if not np.isfinite(np.diag(batch.covariance[k])).all():
        return "degenerate", f"the inliers determine {batch.rank[k]} directions of F: {flags}"
    if not _DEGENERATE.isdisjoint(raised):
        return "degenerate", flags
    if "distorted cameras" in raised:
        return "distorted", flags
    if batch.status[k] <= 0:
        return "not converged", BATCH_STATUS[int(batch.status[k])]
    if batch.rms_px[k] > before * (1.0 + _ROUNDING):
        return "worse", flags
    return "refined", flags


def _shifted(
    progress: Callable[[int, int], object] | None, done: int, total: int
) -> Callable[[int, int], object] | None:
    """Return a callback for some of the pairs, when others are done already."""
    return None if progress is None else lambda more, _: progress(done + more, total)


def _joined(parts: list[dict[str, Any]], names: dict[int, str]) -> DatabaseResult:
    """Put parts of a result together."""
    joined: dict[str, Any] = {}
    for name, first in parts[0].items():
        values = [part[name] for part in parts]
        joined[name] = tuple(chain(*values)) if isinstance(first, tuple) else np.concatenate(values)
    nothing = np.zeros(len(joined["pair_id"]), np.bool_)
    return DatabaseResult(names=names, stored=nothing, backup=None, **joined)
