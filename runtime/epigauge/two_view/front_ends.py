"""Geometries of raw matches to begin from: the search of this package, PoseLib's and OpenCV's."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_choice
from epigauge.errors import MissingPackageError
from epigauge.kernels import Table
from epigauge.two_view.chance import (
    SIGNIFICANT,
    chance_agreement,
    chances_off_plane,
    log10_false_alarms,
)
from epigauge.two_view.conditioning import RMS
from epigauge.two_view.consensus import RANGE, Agreement, Consensus
from epigauge.two_view.homography import plane_squares, robust_homography
from epigauge.two_view.initial import fundamental_8point
from epigauge.two_view.neighbours import accord, ranked
from epigauge.two_view.planes import OFF_PLANE, chance_pairs
from epigauge.two_view.search import SCALES, Found, search

__all__ = ["checked", "start"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

#: Other packages work in coordinates of this RMS, as an image has: OpenCV computes in float32.
_PIXELS = 250.0 / RMS

#: Thresholds that they are run with where none is given, in conditioned coordinates whose range is
#: about 7: from a twentieth of a per cent of the image to 3 %.
_THRESHOLDS = (0.0035, 0.02, 0.2)

#: Standard deviations of the noise in a threshold.
_DEVIATIONS = 3.0

#: The noise is found where so many of the matches within four times its limit are within it.
_SHARP = 0.5

#: Of blunt ones so many are; a geometry that fits seven of few can be chosen so that more are.
_BY_CHANCE = 0.25

#: Among fewer matches, some agree so sharply by chance; each search is then made twice.
_MANY = 400

#: Among so few, four times: which right ones are sampled is a matter of luck.
_FEW = 64

#: Then wrong matches are looked at within so many scales, for how dense they are there.
_EXTENT = 20.0

#: An F found sharply among matches whose noise is up to so many scales may climb to a sharp one.
_BLUNT = 4.0

#: Of the matches within so many scales of a sharp F, those that move with less than this share of
#: their neighbours may be of repeated structure. Where a larger share is, all are left out, and
#: what the others agree on is compared; but not where these hardly move with theirs either, as
#: points of all depths do not.
_NEAR, _ASTRAY, _REPEATED, _PLAIN = 2.0, 0.3, 0.2, 0.55

#: That is better where matches move with their neighbours by so much more in all, and those that
#: only it explains by so much more each than those that only the other does.
_GAIN, _BETTER = 1.05, 1.2

#: Right matches that are more than those which fit by chance.
_ENOUGH = 14

#: Standard deviation of the noise that the 8-point estimate is judged with.
_BLIND = 0.07

#: Their iterations: more where the first find fewer right matches than this. With half of them
#: right, one sample of seven in 128 is clean.
_ITERATIONS = (1_000, 10_000)
_MOST_RIGHT = 0.5


def checked(robust: str) -> str:
    """Return the name of a front end that can be used."""
    name = as_choice("robust", robust, ("auto", "native", *_PACKAGES))
    if name in _PACKAGES and importlib.util.find_spec(_MODULES[name]) is None:
        raise MissingPackageError(_PACKAGES[name], "cv")
    return "native" if name == "auto" else name


def start(
    consensus: Consensus,
    kernels: Table,
    robust: str,
    threshold: float | None,
    score: Array | None,
    seed: int,
    calibrated: bool = False,
) -> tuple[str, Agreement]:
    """Return the geometry to begin from, with the name of what found it.

    Parameters
    ----------
    consensus : Consensus
        The matches.
    kernels : Table
        Backend.
    robust : {"native", "poselib", "opencv"}
        The front end.
    threshold : float or None
        Largest distance of an inlier, conditioned.
    score : ndarray, shape (m,), or None
        How promising each match is.
    seed : int
        Of everything random.
    calibrated : bool
        Whether an essential matrix is looked for, of which a plane leaves two.

    Returns
    -------
    tuple of str, Agreement
        That of the 8-point estimate where nothing else was found.
    """
    rng = np.random.default_rng(seed)
    if robust == "native":
        best = _native(consensus, kernels, score, seed, rng, calibrated)
    else:
        thresholds = _THRESHOLDS if threshold is None else (threshold,)
        found = _of_package(consensus, robust, thresholds, seed)
        best = consensus.search(found, rng) if found else None
    if best is not None:
        return robust, best
    few = consensus.few
    F = fundamental_8point(consensus.h1[:2, few].T, consensus.h2[:2, few].T)
    return "8point", consensus.search([consensus.judge(F, _BLIND)], rng)


def _native(
    consensus: Consensus,
    kernels: Table,
    score: Array | None,
    seed: int,
    rng: np.random.Generator,
    calibrated: bool,
) -> Agreement | None:
    """Search at the noise of good detectors, and at more of it where that may not be the noise.

    At more noise the likelihood of all matches decides, climbed from all that was found. Where few
    match, it is that of an F which bends to what has moved, as clouds, or stands beside: many more
    agree with it, but bluntly. Another that many agree with sharply, which is no accident, is that
    of the scene then: a detector is not sharp for some matches and blunt for the others.
    """
    few = consensus.few
    q1, q2 = (np.ascontiguousarray(h[:2, few]) for h in (consensus.h1, consensus.h2))
    order = ranked(kernels, q1, q2) if score is None else np.argsort(-score[few], kind="stable")
    agreements: list[Agreement] = []
    sharp: list[Agreement] = []
    turns = 1 if q1.shape[1] >= _MANY else 2 if q1.shape[1] >= _FEW else 4
    for scale, turn in itertools.product(SCALES, range(turns)):
        found = search(kernels, q1, q2, order, seed=seed + turn, scale=scale)
        if not found.score > 0.0:
            continue
        if scale == SCALES[0] and (own := _sharp(consensus, kernels, q1, q2, found)) is not None:
            if q1.shape[1] < _MANY:
                sharp.append(own)
            elif own.extent < RANGE:
                return _Repeats(consensus, kernels, q1, q2, scale).avoided(own, order, seed)
            else:
                return own
        agreements.append(consensus.judge(found.F, scale))
    if not agreements:
        return None
    best = consensus.search(agreements, rng)
    if best.sigma > _BLUNT * SCALES[0] and sharp:
        extent = _EXTENT * SCALES[0]
        alike = (consensus.judge(own.F, own.sigma, own.share, extent) for own in sharp)
        highest = max(alike, key=lambda own: own.score)
        # A plane leaves F open; of the two E that it leaves cheirality chooses.
        if calibrated or not _is_of_a_plane(kernels, q1, q2, highest, few):
            return highest
    return consensus.heavier(best, agreements)


def _sharp(
    consensus: Consensus, kernels: Table, q1: Array, q2: Array, found: Found
) -> Agreement | None:
    """Return the agreement with an F if it is sharp, or the sharp one that it climbs to, if any."""
    few, scale = consensus.few, found.scale
    own = consensus.judge(found.F, scale, extent=_EXTENT * scale)
    if _is_sharp(kernels, q1, q2, own, own.signed[few], scale):
        return own
    if own.sigma <= _BLUNT * scale:
        climbed = consensus.climb(consensus.judge(found.F, scale))
        limit = max(scale, climbed.sigma)
        if limit <= _BLUNT * scale and _is_sharp(
            kernels, q1, q2, climbed, climbed.signed[few], limit
        ):
            return climbed
    return None


def _is_sharp(
    kernels: Table, q1: Array, q2: Array, found: Agreement, signed: Array, scale: float
) -> bool:
    """Tell whether distances end within some scales, and that many do so is no accident."""
    if found.sigma > 2.0 * scale:
        return False
    d, limit = np.abs(signed), _DEVIATIONS * scale
    # Seven matches may be within any limit
    core, hits, around = (
        np.count_nonzero(d <= bound) - 7
        for bound in (max(_DEVIATIONS * found.sigma, 1e-9), limit, 4.0 * limit)
    )
    if hits <= _SHARP * around or core <= 0.5 * hits:
        return False
    if log10_false_alarms(int(around) + 7, int(hits) + 7, _BY_CHANCE) > 0.0:
        return False
    chance = chance_agreement(kernels, found.F, q1, q2, limit)
    return log10_false_alarms(q1.shape[1], int(hits) + 7, chance) <= SIGNIFICANT


def _is_of_a_plane(kernels: Table, q1: Array, q2: Array, found: Agreement, few: slice) -> bool:
    """Tell whether a plane leaves F open: those off it agree no better than wrong ones would."""
    limit = _DEVIATIONS * SCALES[0]
    near = found.inliers(limit)[few]
    on1, on2 = (np.ascontiguousarray(q[:, near]) for q in (q1, q2))
    H, _ = robust_homography(on1, on2, np.ones(on1.shape[1]), kernels)
    squares = plane_squares(kernels, H, q1, q2)
    off = squares > 2.0 * (OFF_PLANE * found.sigma) ** 2
    chances = chances_off_plane(squares[off], limit)
    expected = chance_pairs(chances, int(np.count_nonzero(off & near)))
    return bool(expected > 10.0**SIGNIFICANT)


@dataclass(frozen=True)
class _Repeats:
    """Repeated structure among conditioned matches, which may agree with an F of its own.

    The likelihood of that F may be higher than that of the scene's: wrong matches are not uniform
    there. So of two F the one counts whose matches move with their neighbours.
    """

    consensus: Consensus
    kernels: Table
    q1: Array
    q2: Array
    scale: float

    def avoided(self, found: Agreement, order: Rows, seed: int) -> Agreement:
        """Return what matches agree on without those of repeated structure, if that is better."""
        rows, accords = self.near(found)
        plain = accords >= _ASTRAY
        astray = rows[~plain]
        if len(astray) <= _REPEATED * len(rows) or _mean(accords[plain]) < _PLAIN:
            return found
        kept = np.ones(self.q1.shape[1], np.bool_)
        kept[astray] = False
        if np.count_nonzero(kept) < _ENOUGH:
            return found
        one, two = (np.ascontiguousarray(q[:, kept]) for q in (self.q1, self.q2))
        among = (np.cumsum(kept) - 1)[order[kept[order]]]
        other = search(self.kernels, one, two, among, seed=seed, scale=self.scale)
        if not other.score > 0.0:
            return found
        trial = self.consensus.judge(other.F, self.scale, extent=_EXTENT * self.scale)
        there, again = self.near(trial)
        lost, won = accords[~np.isin(rows, there)], again[~np.isin(there, rows)]
        # Squared: many that go astray add little. Where a plane alone is left, all on it move
        # alike, but what is won by chance is no better than what is lost.
        better = np.sum(again**2) > _GAIN * np.sum(accords**2)
        return trial if better and _mean(won) > _BETTER * _mean(lost) else found

    def near(self, found: Agreement) -> tuple[Rows, Array]:
        """Return the rows of the matches that agree, and how far each moves with the others."""
        few = self.consensus.few
        d = np.where(found.oriented[few], np.abs(found.signed[few]), np.inf)
        rows = np.flatnonzero(d <= _NEAR * self.scale)
        return rows, accord(self.kernels, self.q1[:, rows], self.q2[:, rows])


def _mean(values: Array) -> float:
    return float(np.sum(values)) / max(len(values), 1)


def _of_package(
    consensus: Consensus, robust: str, thresholds: tuple[float, ...], seed: int
) -> list[Agreement]:
    """Return what another package finds, run at all thresholds."""
    few = consensus.few
    x1, x2 = (np.ascontiguousarray(h[:2, few].T) * _PIXELS for h in (consensus.h1, consensus.h2))
    back = np.diag([_PIXELS, _PIXELS, 1.0])
    found: list[Agreement] = []
    for iterations in _ITERATIONS:
        for threshold in thresholds:
            F = _FRONT_ENDS[robust](x1, x2, threshold * _PIXELS, seed, iterations)
            if F is not None and np.isfinite(F).all() and np.linalg.matrix_rank(F) >= 2:
                found.append(consensus.judge(back @ F @ back, threshold / _DEVIATIONS))
        if found and max(found, key=lambda a: a.score).share > _MOST_RIGHT:
            break
    return found


def _poselib(x1: Array, x2: Array, threshold: float, seed: int, iterations: int) -> Array | None:
    poselib = importlib.import_module("poselib")
    options = {"max_epipolar_error": threshold, "seed": seed, "max_iterations": iterations}
    F, _ = poselib.estimate_fundamental(x1, x2, options, {})
    return np.asarray(F, dtype=np.float64)


def _opencv(x1: Array, x2: Array, threshold: float, seed: int, iterations: int) -> Array | None:
    cv2 = importlib.import_module("cv2")
    parameters = cv2.UsacParams()
    parameters.threshold = threshold
    parameters.confidence = 0.999
    parameters.maxIterations = iterations
    parameters.randomGeneratorState = seed
    parameters.sampler = cv2.SAMPLING_UNIFORM
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.loIterations = 10
    parameters.final_polisher = cv2.MAGSAC
    try:
        F, _ = cv2.findFundamentalMat(x1, x2, parameters)
    except cv2.error:
        return None
    return None if F is None or F.shape != (3, 3) else np.asarray(F, dtype=np.float64)


_MODULES = {"poselib": "poselib", "opencv": "cv2"}
_PACKAGES = {"poselib": "poselib", "opencv": "opencv-python-headless"}
_FRONT_ENDS: dict[str, Callable[[Array, Array, float, int, int], Array | None]] = {
    "poselib": _poselib,
    "opencv": _opencv,
}
