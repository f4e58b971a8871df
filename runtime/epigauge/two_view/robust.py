"""From raw matches with gross errors to the maximum-likelihood fundamental matrix."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_array, as_count, as_matches, as_positive, as_score
from epigauge._logged import logged
from epigauge._options import FrontEnd, RefineOptions, known_options
from epigauge.errors import ArgumentError
from epigauge.two_view import quick
from epigauge.two_view.chance import chance_agreement
from epigauge.two_view.conditioning import condition
from epigauge.two_view.confidence import Confidence, Signs, probability_below
from epigauge.two_view.consensus import RANGE, WIDEST, Agreement, Consensus
from epigauge.two_view.copies import earliest
from epigauge.two_view.covariance import untruncated
from epigauge.two_view.essential_consensus import EssentialConsensus
from epigauge.two_view.evidence import Evidence
from epigauge.two_view.front_ends import checked, start
from epigauge.two_view.losses import robust_scale
from epigauge.two_view.refine import calibrations, refine_fundamental
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.suspicion import log10_alarms
from epigauge.verdicts import ordered

__all__ = ["Estimate", "RobustResult", "estimate_fundamental", "estimated", "of_matches"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Distance of an inlier in standard deviations of the noise, at most.
_DEVIATIONS = 3.0

_ROUNDS = 20

#: Options of `refine_fundamental` with one entry a match.
_PER_MATCH = {"weights": 1, "covariance1": 3, "covariance2": 3}


@dataclass(frozen=True, kw_only=True)
class RobustResult(FundamentalResult):
    """A fundamental matrix estimated from raw matches.

    What `FundamentalResult` says of matches (points, fun, jac) is for the matches that were used.

    Attributes
    ----------
    inlier : ndarray of bool, shape (m,)
        Which of all matches agree with F, duplicates included.
    used : ndarray of int, shape (n,)
        Rows of the matches that F was fitted to: the inliers, each of several equal ones once.
    threshold_px : float
        Largest distance of an inlier.
    rounds : int
        How many times F was refined before the inliers stood still.
    start : str
        Front end that gave the start: "native", "poselib", "opencv"; "8point" where it found
        nothing, "5point" of fewer than eight matches.
    error_px : float
        Half of the geometries found from such matches have a median error below, if they are that
        of the scene: the median distance of true matches to their epipolar lines.
    p_wrong : float
        Probability that the matches agree on another geometry than that of the scene.

    Examples
    --------
    >>> import epigauge as eg
    >>> raw = eg.load_matches(eg.samples.path("raw_matches.csv"))
    >>> result = eg.estimate_fundamental(raw.x1, raw.x2)
    >>> F, mask = result
    >>> result.success, F.shape, bool(mask.mean() > 0.8)
    (True, (3, 3), True)
    """

    _shown: ClassVar[tuple[str, ...]] = (
        *("F", "inliers", "threshold_px", "sigma", "rms_px", "noise_px", "rank", "condition"),
        *("E", "R", "t", "in_front", "error_px", "p_wrong", "start", "message"),
    )

    inlier: Mask = field(repr=False)
    used: NDArray[np.intp] = field(repr=False)
    threshold_px: float
    rounds: int
    start: str
    error_px: float
    p_wrong: float
    _signs: Signs = field(repr=False)

    def probability_good(self, px: float) -> float:
        """Return the probability that the median error is below so many pixels.

        Parameters
        ----------
        px : float
            Bound of the median distance of true matches to their epipolar lines, mean of both
            images.

        Returns
        -------
        float
            How often that is so among all estimates that are given this probability, on pairs whose
            true geometry is known.

        Raises
        ------
        ArgumentError
            If `px` is not above 0.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.two_view_scene(n_points=300, noise_px=0.5, seed=1)
        >>> result = eg.estimate_fundamental(scene.x1, scene.x2)
        >>> result.probability_good(0.02) < 0.1, result.probability_good(1.0) > 0.9
        (True, True)
        """
        return float(probability_below(px, self.error_px, self.p_wrong))

    def __iter__(self) -> Iterator[Array | Mask]:
        """Unpack as in OpenCV: ``F, mask = eg.estimate_fundamental(x1, x2)``."""
        return iter((self.F, self.inlier))

    def _summary_rows(self) -> dict[str, str]:
        found = super()._summary_rows()
        count = f"{np.count_nonzero(self.inlier)} of {len(self.inlier)} matches"
        return {"F": found.pop("F"), "inliers": count} | found


@logged
def estimate_fundamental(
    x1: ArrayLike,
    x2: ArrayLike,
    *,
    robust: FrontEnd = "auto",
    threshold_px: float | Literal["auto"] = "auto",
    score: ArrayLike | None = None,
    seed: int = 0,
    **options: Unpack[RefineOptions],
) -> RobustResult:
    """Find the fundamental matrix of raw matches, gross errors among them.

    Samples of seven matches give starts, of which the best by all matches is improved [1]_. The
    noise and the share of right matches follow from its distances. `refine_fundamental` then fits
    the inliers, those whose exact distance is within a threshold, until they stand still.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least eight different matches in pixels, five with ``essential=True``; exact duplicates
        count once.
    robust : {"auto", "native", "poselib", "opencv"}
        The front end: the search of this package (also "auto"), or to compare with, PoseLib's
        LO-RANSAC or OpenCV's USAC_MAGSAC.
    threshold_px : float or "auto"
        Largest distance of an inlier. "auto" takes three standard deviations of the noise, from the
        median distance of the inliers, but no more than the distance at which a match is as likely
        right as wrong.
    score : array_like, shape (m,), optional
        How promising each match is, the highest first: more samples are drawn from these. By
        default, matches are ranked by whether their neighbours move alike.
    seed : int
        Of everything random: one seed, one answer.
    **options
        Of `refine_fundamental`, but for `F0`. `weights` and covariances are those of all matches;
        they count in the refinement. `noise_px` is by default estimated, with the factor for
        the tails that the threshold cuts off.

    Returns
    -------
    RobustResult
        As `refine_fundamental`, with the inliers and how they were found. Where all matches that
        agree are in one place or on one line of an image, F is that of all matches, and the flag
        "undetermined" says that it means nothing.

    Raises
    ------
    MissingPackageError
        If the package of the front end is not installed.
    ArgumentError
        On bad arguments.

    Notes
    -----
    The density of the distance d of a match is taken as p N(d; 0, sigma^2) + (1 - p) / range. Where
    many matches agree within the noise of good detectors, the range is a small one around it:
    wrong matches of repeated structure are dense beside the epipolar lines. Elsewhere it is that of
    the coordinates, and the likelihood is climbed from what the search found at several noises and
    from 8-point estimates of random subsets of the inliers, until that finds nothing higher.
    Matches that violate the oriented epipolar constraint count as wrong.

    Windows of a facade that are taken for others of their row agree with an F of their own, whose
    epipole is the vanishing point of the row: more of them than there are matches off the wall. But
    they move otherwise than their neighbours. Where many that agree do, the search is made again
    without them, and the F counts whose matches move with their neighbours.

    References
    ----------
    .. [1] D. Barath, J. Noskova, M. Ivashechkin, J. Matas, "MAGSAC++, a fast, reliable and accurate
       robust estimator", CVPR 2020; O. Chum, T. Werner, J. Matas, "Two-view geometry estimation
       unaffected by a dominant plane", CVPR 2005.

    Examples
    --------
    >>> import numpy as np
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(n_points=300, noise_px=0.1)
    >>> x1, x2 = scene.x1.copy(), scene.x2.copy()
    >>> x2[::3] = x2[::3][::-1]  # every third match is wrong
    >>> result = eg.estimate_fundamental(x1, x2)
    >>> bool(result.success), round(float(np.mean(result.inlier[::3])), 1)
    (True, 0.0)
    """
    known = known_options("estimate_fundamental", options, RefineOptions, ("F0",))
    return estimated(x1, x2, robust, threshold_px, score, seed, known).result


def estimated(
    x1: ArrayLike,
    x2: ArrayLike,
    robust: str,
    threshold_px: float | str,
    score: ArrayLike | None,
    seed: int,
    options: dict[str, Any],
) -> Estimate:
    """Find the fundamental matrix, options being those of `refine_fundamental`."""
    calibration = calibrations(
        bool(options.get("essential", False)), options.get("K1"), options.get("K2")
    )
    least = 8 if calibration is None else 5
    x1, x2 = as_matches(x1, x2, at_least=least, general_position=True)
    front_end = checked(robust)
    seed = as_count("seed", seed, at_least=0)
    threshold = None if threshold_px == "auto" else as_positive("threshold_px", threshold_px)
    if "F0" in options:
        raise ArgumentError("F0", "is given", "refine_fundamental, which starts from it")

    promise = None if score is None else as_score(score, len(x1))

    first = earliest(x1, x2)
    rows = np.flatnonzero(first == np.arange(len(x1)))
    if len(rows) < least:
        raise ArgumentError("x1, x2", f"hold {len(rows)} different matches", f"at least {least}")
    copies = np.searchsorted(rows, first)
    promise = promise if promise is None else promise[rows]
    y1, y2 = x1[rows], x2[rows]

    frame = condition(y1, y2)
    table, q = kernels.table(options.get("backend")), frame.forward(y1, y2)
    consensus = Consensus(table, *q)
    given = None if threshold is None else threshold / frame.scale
    if len(rows) >= 8:
        name, agreement = start(consensus, table, front_end, given, promise, seed)
    if calibration is not None:
        maps = zip(frame.maps_from_pixels(), calibration, strict=True)
        consensus = EssentialConsensus(table, *q, *(to_units @ K for to_units, K in maps))
        if len(rows) < 8:
            name, agreement = "5point", consensus.of_few()
        agreement = consensus.search([agreement], np.random.default_rng(seed))

    options.setdefault("noise_px", None)
    limit = threshold / frame.scale if threshold is not None else _at_most(agreement.mixture.even)
    inlier = _at_least(least, agreement, limit)
    fitted: set[bytes] = set()
    is_open = False
    while not is_open and inlier.tobytes() not in fitted and len(fitted) < _ROUNDS:
        fitted.add(inlier.tobytes())
        used, limit_px = inlier, limit * frame.scale
        F0: Array | None = frame.to_pixels(agreement.F)
        while True:
            chosen = of_matches(options, len(x1), rows[used])
            try:
                refined = refine_fundamental(y1[used], y2[used], F0, **chosen)
                break
            except ArgumentError as error:
                if is_open or error.argument not in ("x1", "x2", "F0"):
                    raise
            # All that agree are in one place or on one line, and leave F open: fitted to all
            used, F0, is_open = np.ones(len(rows), np.bool_), None, True
        F = frame.from_pixels(refined.F)
        signed, oriented = consensus.measured(F)
        agreement = replace(agreement, F=F, signed=signed, oriented=oriented)
        if threshold is None:
            sigma = robust_scale(agreement.signed[used])
            limit = min(limit, max(_DEVIATIONS * sigma, 1e-9))
        inlier = _at_least(least, agreement, limit)
    plain = options["noise_px"] is None and options.get("loss", "linear") == "linear"
    known = {
        "inlier": (inlier if is_open else used)[copies],
        "used": rows[used],
        "threshold_px": limit_px,
        "rounds": len(fitted),
        "start": name,
    }
    weights = of_matches(options, len(x1), rows).get("weights")
    raw = _Raw(y1, y2, np.ones(len(y1)) if weights is None else np.asarray(weights, float))

    @cache
    def near() -> tuple[Agreement, float, Mask]:
        agreed, bound = agreement, limit
        if threshold is None:  # real noise has heavier tails than three deviations of its core
            agreed = consensus.judge(agreement.F, agreement.sigma, agreement.share)
            bound = max(limit, _at_most(agreed.mixture.even))
        return agreed, bound, agreed.inliers(bound)  # where fewer than 8, "no common geometry"

    @cache
    def among_all() -> Evidence:
        _, bound, agreeing = near()
        weights = raw.weights
        return refined._evidence.among(raw.x1, raw.x2, weights, agreeing, bound * frame.scale)

    def judged() -> SimpleNamespace:
        agreed, bound, agreeing = near()
        pair = vars(refined).get("_pair")
        if pair is not None and not is_open:  # cheap tests, where they suffice
            flags, success = quick.verdict_of_raw(
                *(pair, (raw.x1, raw.x2, raw.weights), frame.scale * agreed.signed, agreeing),
                bound * frame.scale,
                partial(chance_agreement, table, agreed.F, *q, bound),
            )
            if flags is not None:
                return SimpleNamespace(flags=flags, success=success)
        verdict = refined.judged(among_all())
        if is_open:
            verdict = SimpleNamespace(
                flags=ordered((*verdict.flags, "undetermined")), success=False
            )
        return verdict

    @cache
    def rest() -> SimpleNamespace:
        return _rest(refined, limit_px if plain else None)

    def confident() -> SimpleNamespace:
        alarms = log10_alarms(among_all())
        signs = Signs.of(rest()._uncertainty, y1[used], y2[used], alarms)
        return SimpleNamespace(_signs=signs, **vars(Confidence.of(signs)))

    later = dict.fromkeys(("flags", "success"), judged)
    later |= dict.fromkeys(("error_px", "p_wrong", "_signs"), confident)
    return Estimate(
        RobustResult.partial(known | _cheap(refined), rest, **later),
        frame.scale * agreement.signed[copies],
    )


class Estimate(NamedTuple):
    """A result, and the signed distances (m,) in pixels of all matches to its F."""

    result: RobustResult
    distances: Array


def _cheap(refined: FundamentalResult) -> dict[str, Any]:
    """Return the fields that are there and stay as they are."""
    later = {"flags", "success", "noise_px", "covariance", "_uncertainty"}
    names = type(refined).__dataclass_fields__.keys() - later
    return {name: value for name, value in vars(refined).items() if name in names}


def _rest(refined: FundamentalResult, limit_px: float | None) -> SimpleNamespace:
    """Return all fields but flags and success, the noise as a limit cuts it off undone."""
    names = (entry.name for entry in fields(refined) if entry.name not in ("flags", "success"))
    known = {name: getattr(refined, name) for name in names}
    if limit_px is not None and refined.noise_px > 0.0:
        # The threshold has cut off the tails of the right matches.
        unit = math.sqrt(refined._evidence.unit)  # the limit is one of distances
        noise_px = unit * untruncated(refined.noise_px / unit, limit_px)
        factor = noise_px / refined.noise_px
        spread = replace(refined._uncertainty, root=factor * refined._uncertainty.root)
        known |= {"noise_px": noise_px, "_uncertainty": spread}
        known["covariance"] = spread.of_fundamental()
    return SimpleNamespace(**known)


@dataclass(frozen=True)
class _Raw:
    """All different matches in pixels, and their weights."""

    x1: Array
    x2: Array
    weights: Array


def _at_least(count: int, agreement: Agreement, limit: float) -> Mask:
    """Return the inliers, or so many nearest matches for a result that says it means nothing."""
    inlier = agreement.inliers(limit)
    if np.count_nonzero(inlier) < count:
        inlier = np.zeros(len(inlier), np.bool_)
        inlier[np.argsort(np.abs(agreement.signed))[:count]] = True
    return inlier


def _at_most(limit: float) -> float:
    """Return a threshold that was not given, no larger than noise may be."""
    return float(min(limit, WIDEST * RANGE))


def of_matches(options: dict[str, Any], m: int, rows: NDArray[np.intp]) -> dict[str, Any]:
    """Return the options with those that have one entry a match restricted to some."""
    chosen = dict(options)
    for name, dimensions in _PER_MATCH.items():
        if options.get(name) is None:
            continue
        value = as_array(name, options[name], "an array with a row a match")
        if value.ndim == dimensions and len(value) == m:
            chosen[name] = value[rows]
    return chosen
