"""From raw matches with gross errors to the maximum-likelihood fundamental matrix."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import (
    as_count,
    as_matches,
    as_positive,
    as_score,
    as_weights,
)
from epigauge._logged import logged
from epigauge._options import FrontEnd, RefineOptions, known_options
from epigauge.errors import ArgumentError
from epigauge.two_view.confidence import Signs, probability_below
from epigauge.two_view.essential_consensus import EssentialConsensus
from epigauge.two_view.front_ends import checked, start
from epigauge.two_view.refine import calibrations
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.robust_asked import Asked
from epigauge.two_view.robust_fit import DEVIATIONS, Raw, at_most, fitted

__all__ = ["Estimate", "RobustResult", "estimate_fundamental", "estimated"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


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
        How many times F was fitted before the inliers stood still.
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
    from 8-point estimates of random subsets of the inliers, until that finds nothing higher. A part
    of the wrong matches may then be normal, too, but wide, where that leaves right ones which are
    at least twice as sharp. An F that most agree with sharply, no plane's alone and no accident,
    counts more than one that nearly all agree with, but bluntly.
    Matches that violate the oriented epipolar constraint count as wrong. Those of a point with more
    than five do not take part in the search: an epipole there agrees with all of them.

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
    options.setdefault("noise_px", None)
    given_weights = options.get("weights")
    weights = np.ones(len(x1)) if given_weights is None else as_weights(given_weights, len(x1))
    raw = Raw.of(x1, x2, options, least)

    frame, weights = raw.frame, weights[raw.rows]
    given = None if threshold is None else threshold / frame.scale
    agreed = raw.agreeing()
    consensus = agreed.consensus
    if len(raw.rows) >= 8:
        promise = promise if promise is None else promise[agreed.rows]
        how = given, promise, seed, calibration is not None
        name, agreement = start(consensus, raw.table, front_end, *how)
    if calibration is not None:
        maps = zip(frame.maps_from_pixels(), calibration, strict=True)
        cameras = (to_units @ K for to_units, K in maps)
        consensus = EssentialConsensus(raw.table, *agreed.q, *cameras)
        if len(raw.rows) < 8:
            name, agreement = "5point", consensus.of_few()
        agreement = consensus.search([agreement], np.random.default_rng(seed))
    if agreed is not raw:
        density = agreement.sigma, agreement.share, agreement.extent, agreement.about
        agreement = raw.consensus.judge(agreement.F, *density)

    limit = at_most(agreement.mixture.even) if given is None else given
    settled = 0
    if calibration is None:  # the refinement, with its options, is then hardly repeated
        agreement, limit, settled = raw.consensus.settle(
            *(agreement, weights * raw.is_near, limit),
            *(DEVIATIONS if given is None else 0.0, least),
        )
    fit = fitted(raw, agreement, limit, given is not None, options)
    known = {
        "inlier": (fit.inlier if fit.is_open else fit.used)[raw.copies],
        "used": raw.rows[fit.used],
        "threshold_px": fit.limit_px,
        "rounds": settled + fit.rounds,
        "start": name,
    }
    plain = options["noise_px"] is None and options.get("loss", "linear") == "linear"
    asked = Asked(raw, weights, fit, given is not None, fit.limit_px if plain else None)
    later = dict.fromkeys(("flags", "success"), asked.judged)
    later |= dict.fromkeys(("error_px", "p_wrong", "_signs"), asked.confident)
    return Estimate(
        RobustResult.partial(known | _cheap(fit.refined), lambda: asked.rest, **later),
        frame.scale * fit.agreement.signed[raw.copies],
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
