"""Maximum-likelihood refinement of a fundamental matrix."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels, lm
from epigauge._arguments import (
    as_calibration,
    as_choice,
    as_count,
    as_covariances,
    as_fundamental,
    as_matches,
    as_positive,
    as_weights,
    check_general_position,
)
from epigauge._logged import logged
from epigauge._options import (
    Backend,
    Criterion,
    Hessian,
    Loss,
    PairDamping,
    Parameterization,
    Part,
    Structure,
)
from epigauge.errors import ArgumentError
from epigauge.two_view import native
from epigauge.two_view.assemble import assembled
from epigauge.two_view.conditioning import condition
from epigauge.two_view.copies import counted_once, earliest
from epigauge.two_view.criteria import CRITERIA
from epigauge.two_view.express import express
from epigauge.two_view.five_point import essential_starts
from epigauge.two_view.initial import fundamental_8point
from epigauge.two_view.losses import LOSSES
from epigauge.two_view.minima import perturbed, search
from epigauge.two_view.parameterizations import (
    PARAMETERIZATIONS,
    RESTRICTABLE,
    Ortho,
)
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.solve import (
    DAMPINGS,
    REDESCENDING,
    REDUNDANT,
    Matches,
    Options,
    best_start,
    stop_of,
)

__all__ = ["calibrations", "refine_fundamental"]

Array = NDArray[np.float64]

#: Least number of starts for an essential matrix: a plane has two solutions, five matches ten.
_ESSENTIAL_STARTS = 5


@logged
def refine_fundamental(
    x1: ArrayLike,
    x2: ArrayLike,
    F0: ArrayLike | None = None,
    *,
    parameterization: Parameterization = "ortho",
    criterion: Criterion = "reprojection",
    structure: Structure = "eliminated",
    damping: PairDamping = "levenberg",
    hessian: Hessian = "exact",
    starts: int = 1,
    fix: Part | Sequence[Part] = (),
    essential: bool = False,
    K1: ArrayLike | None = None,
    K2: ArrayLike | None = None,
    loss: Loss = "linear",
    loss_scale_px: float | Literal["auto"] = "auto",
    noise_px: float | None = None,
    weights: ArrayLike | None = None,
    covariance1: ArrayLike | None = None,
    covariance2: ArrayLike | None = None,
    bias_correction: bool = False,
    ftol: float = 1e-10,
    xtol: float = 1e-12,
    gtol: float = 1e-14,
    max_iter: int = 100,
    backend: Backend | None = None,
    callback: Callable[[lm.Row], object] | None = None,
) -> FundamentalResult:
    """Find the fundamental matrix that minimises the reprojection error of point matches.

    This is two-view projective bundle adjustment, the maximum-likelihood estimate for Gaussian
    noise of equal size on all coordinates.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least eight different matches in pixels without gross errors, five for an essential
        matrix; also (m, 1, 2), any real type. Of several equal matches one counts, as if the others
        had weight zero.
    F0 : array_like, shape (3, 3), optional
        Start value with ``x2^T F0 x1 = 0``, of any scale; by default `fundamental_8point`.
    parameterization : {"ortho", "block", "maps", "parfree", "free", "normalized"}
        How F is represented: the orthonormal representation of B&S, a chart regular at sigma = 1,
        or the best of 36 minimal maps; the last three optimise cameras, with 12 and 24 parameters,
        and are solved jointly with the points whatever `structure` says.
    criterion : {"reprojection", "sampson", "epipolar"}
        What is minimised: the exact reprojection error, its first-order approximation, or the
        squared distances of both points to their epipolar lines.
    structure : {"eliminated", "joint"}
        "eliminated" optimises over F alone, each match being at its exact foot point; "joint"
        optimises F and one point a match (B&S Table 1).
    damping : {"levenberg", "seber"}
        lambda I, or lambda diag(J^T J).
    hessian : {"exact", "gauss-newton"}
        Second derivatives for the eliminated structure; "joint" always uses Gauss-Newton.
    starts : int
        How many times to minimise: from `F0`, and from F0 plus random matrices that are the same at
        every call, ten times as large as the standard deviation of F (`minima.perturbed`); 20
        nearly always find the best minimum of near-affine scenes. Of the minima that satisfy the
        oriented epipolar constraint the lowest is returned; all are listed in ``result.minima``.
        Evaluations and history count all starts, and `max_iter` holds for each. For an essential
        matrix the starts are solutions of subsets of five matches, at least five of them without
        `F0`, and the minimum with the lowest cost for points in front of both cameras is returned.
    fix : str or sequence of str
        Parts of the start value to leave exactly as they are (B&S section 4.4): "epipole1",
        "epipole2", "epipolar_transformation", in the coordinates of the images. The last means
        that sigma stays and that U and V turn with the epipoles but not about them; where this
        leads depends slightly on the way the epipoles take.
    essential : bool
        Keep F the image of an essential matrix, sigma = 1 in calibrated coordinates: five
        parameters. The result then has E, R, t and in_front.
    K1, K2 : array_like, shape (3, 3), optional
        Calibration matrices for `essential`; the identity by default (coordinates on the retina),
        and K1 for both where only it is given.
    loss : {"linear", "huber", "soft_l1", "cauchy", "truncated"}
        Robust loss of each match's squared distance, defined as in SciPy. Where "truncated" ends
        depends on its start: without `F0` it starts from the better of two minima, that from the
        8-point estimate and that from Cauchy's (whose evaluations are not counted).
    loss_scale_px : float or "auto"
        Scale of the loss in pixels; by default a multiple of the noise as estimated from the
        residuals, anew until it stands still.
    noise_px : float, optional
        Standard deviation of a coordinate in pixels, which scales the covariance only. By default
        it is estimated from the residuals, as sqrt(sum(w d^2) / (m - p)), m the matches of weight
        above 0 and p the parameters of F, and by their median with a robust loss.
    weights : array_like, shape (m,), optional
        Factor of each match's squared distance; for the covariance, (noise_px / standard deviation
        of a coordinate of the match)^2.
    covariance1, covariance2 : array_like, shape (2, 2) or (m, 2, 2), optional
        Covariances of the points in px^2, for all or for each; the identity where only one is
        given. Distances are then Mahalanobis distances to the epipolar geometry: `cost`, `fun`,
        `loss_scale_px` and `noise_px` are in units of the noise, 1 being what the covariances
        say. Only with the eliminated reprojection criterion, whose Hessian is then that of
        Gauss-Newton.
    bias_correction : bool
        Move the minimum by Kanatani's estimate of its second-order bias. By simulation
        (``benchmarks/bias.py``) that lowers the bias a little for sideways motion and raises it for
        forward motion; the error against the truth stays as it is. Residuals are those of the
        moved F.
    ftol, xtol, gtol : float
        Stop when the cost decreases by less than `ftol` times itself or is known to, when a step
        is shorter than `xtol`, when no entry of the gradient exceeds `gtol` (the last two in
        conditioned coordinates); the inequalities are those of `epigauge.lm.minimize`.
    max_iter : int
        Trial steps allowed.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed; by default `epigauge.backend()`.
    callback : callable, optional
        Called with each row of the history; a true return value stops (status -2). A compiled
        minimisation is over before it is told of, and is repeated up to the row that stops it.

    Returns
    -------
    FundamentalResult
        F, its factors, cameras, points and covariance, and how it was found.

    Raises
    ------
    ArgumentError
        On bad shapes or values, fewer than eight matches, NaN or infinity, points all equal or on
        one line, and unknown names of options.
    BackendError
        If the backend cannot be used.

    Notes
    -----
    Coordinates are conditioned inside: centred, scaled by one factor for both images, which leaves
    the minimum where it is, and the second origin moved off the centroid, which keeps sigma away
    from 1 (B&S section 3.2).

    References
    ----------
    .. [BS04] A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal
       parameters", PAMI 26(3), 2004.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> result = eg.refine_fundamental(scene.x1, scene.x2)
    >>> result.F.shape, result.success, result.rank
    ((3, 3), True, 7)
    """
    plan = _plan(
        *(parameterization, criterion, structure, damping, hessian, loss, loss_scale_px),
        *(fix, bias_correction, ftol, xtol, gtol, max_iter, starts, noise_px, backend),
    )
    options, noise_px, starts = plan.options, plan.noise_px, plan.starts
    special = essential or K1 is not None or K2 is not None
    if plan.native is not None and not special and covariance1 is None and covariance2 is None:
        result = _express(x1, x2, F0, weights, plan)
        wanted = None if result is None or callback is None else stop_of(result.history, callback)
        if result is not None and wanted is None:
            return result
        if wanted is not None:  # which has been told of the rows up to there
            callback = _stopping_at(wanted)
    options = replace(options, calibration=calibrations(essential, K1, K2))
    least = 8 if options.calibration is None else 5
    x1, x2 = as_matches(x1, x2, at_least=least, general_position=True)
    _check_combination(options)
    if starts > 1 and options.fix:
        raise ArgumentError("starts", f"is {starts} with fix", "1: the start holds what is fixed")
    w = _once(x1, x2, None if weights is None else as_weights(weights, len(x1)), least)
    if F0 is not None:
        start: Array | None = _given_start(F0, x1, x2, w)
    elif np.count_nonzero(w > 0.0) < least:
        needed = f"{least} positive ones, or F0"
        raise ArgumentError("weights", f"leave fewer than {least} matches", needed)
    else:
        counts = w > 0.0
        start = fundamental_8point(x1[counts], x2[counts]) if least == 8 else None
    covariances = _covariances(covariance1, covariance2, options, starts, len(x1))
    matches = Matches.of(x1, x2, w, start, kernels.table(backend), covariances)
    options = replace(options, anchor=start if options.fix else None)
    first = _starts(matches, options, start, starts)
    if F0 is None and options.loss == REDESCENDING and options.calibration is None:
        first[0] = best_start(matches, options, first[0])
    found = search(matches, options, first, callback)
    return assembled(found, options, matches, noise_px)


def _stopping_at(iteration: int) -> Callable[[lm.Row], object]:
    return lambda row: row.iteration >= iteration


@dataclass(frozen=True)
class Plan:
    """Checked options, and `native` where the short way takes them."""

    options: Options
    noise_px: float | None
    starts: int
    native: native.PairOptions | None


def _plan(*choices: Any) -> Plan:
    """Check the options, once for equal ones."""
    *own, starts, noise_px, backend = choices
    own[7], own[8] = _parts(own[7]), bool(own[8])
    try:
        options, pairs = _checked(*own)
    except TypeError:  # something unhashable: the check itself says what
        options, pairs = _checked.__wrapped__(*own)
    starts = as_count("starts", starts)
    if noise_px is not None:
        noise_px = as_positive("noise_px", noise_px)
    if starts > 1 or kernels.table(backend).name != "c":
        pairs = None
    return Plan(options, noise_px, starts, pairs)


def plan_of(options: dict[str, Any]) -> Plan:
    """Check keyword options of `refine_fundamental`, the others at their defaults.

    `native` is None too where an option asks for more than the short way knows.
    """
    chosen = _DEFAULTS | options
    plan = _plan(*(chosen[name] for name in _PLANNED))
    special = any(chosen[name] is not _DEFAULTS[name] for name in _DEFAULTS if name not in _PLANNED)
    return replace(plan, native=None) if special else plan


@lru_cache(maxsize=64, typed=True)
def _checked(
    parameterization: str,
    criterion: str,
    structure: str,
    damping: str,
    hessian: str,
    loss: str,
    loss_scale_px: float | str,
    fix: tuple[str, ...],
    bias_correction: bool,
    *stopping: Any,
) -> tuple[Options, native.PairOptions | None]:
    ftol, xtol, gtol, max_iter = stopping
    options = Options(
        parameterization=as_choice(
            "parameterization", parameterization, (*PARAMETERIZATIONS, *REDUNDANT)
        ),
        criterion=as_choice("criterion", criterion, CRITERIA),
        structure=as_choice("structure", structure, ("eliminated", "joint")),
        damping=as_choice("damping", damping, DAMPINGS),
        hessian=as_choice("hessian", hessian, ("exact", "gauss-newton")),
        fix=fix,
        loss=as_choice("loss", loss, LOSSES),
        bias_correction=bias_correction,
        loss_scale_px=None
        if loss_scale_px == "auto"
        else as_positive("loss_scale_px", loss_scale_px),
        stopping=lm.Stopping(ftol=ftol, xtol=xtol, gtol=gtol, max_iter=max_iter),
    )
    usual = (parameterization, structure, loss) == ("ortho", "eliminated", "linear")
    if not usual or fix or bias_correction:
        return options, None
    exact = hessian == "exact"
    return options, native.pair_options(criterion, exact, damping, options.stopping)


def _express(
    x1: ArrayLike, x2: ArrayLike, F0: ArrayLike | None, weights: ArrayLike | None, plan: Plan
) -> FundamentalResult | None:
    """Go the short way; None where that finds something that is not plainly in order."""
    if not (_is_plain(x1) and _is_plain(x2) and x1.shape == x2.shape):  # type: ignore[union-attr]
        x1, x2 = as_matches(x1, x2, general_position=True)
    assert isinstance(x1, np.ndarray)
    assert isinstance(x2, np.ndarray)
    if F0 is not None:
        F0 = np.ascontiguousarray(as_fundamental(F0))
    w = counted_once(x1, x2, None if weights is None else as_weights(weights, len(x1)))
    assert plan.native is not None
    return express(x1, x2, F0, w, plan.options, plan.native, plan.noise_px)


def _is_plain(x: ArrayLike) -> bool:
    """Tell whether points need no conversion."""
    if type(x) is not np.ndarray or x.dtype != np.float64:
        return False
    return x.ndim == 2 and x.shape[1] == 2 and x.flags.c_contiguous and x.flags.aligned


def _parts(fix: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of the parts to freeze, each once."""
    names = (fix,) if isinstance(fix, str) or not isinstance(fix, Sequence) else tuple(fix)
    return tuple(dict.fromkeys(as_choice("fix", name, Ortho.parts) for name in names))


def calibrations(
    essential: bool, K1: ArrayLike | None, K2: ArrayLike | None
) -> tuple[Array, Array] | None:
    """Return both calibration matrices, or None where F is not restricted."""
    if not essential:
        if K1 is not None or K2 is not None:
            raise ArgumentError("K1, K2", "are given", "essential=True as well, or neither")
        return None
    first = np.eye(3) if K1 is None else as_calibration("K1", K1)
    return first, first if K2 is None else as_calibration("K2", K2)


def _check_combination(options: Options) -> None:
    """Refuse what is not defined."""
    restricted = "fix" if options.fix else "essential" if options.calibration is not None else ""
    if options.fix and options.calibration is not None:
        raise ArgumentError("fix", "is combined with essential=True", "one of the two")
    if restricted and options.parameterization not in RESTRICTABLE:
        raise ArgumentError(
            "parameterization",
            f"is {options.parameterization!r} with {restricted}",
            "'ortho' or 'block', whose parameters keep the parts of F separate",
        )
    if len(options.fix) == len(Ortho.parts):
        raise ArgumentError("fix", "names every part of F", "something left to refine")
    if restricted and options.bias_correction:
        raise ArgumentError("bias_correction", f"is True with {restricted}", "an unrestricted F")
    joint = options.structure == "joint" or options.parameterization in REDUNDANT
    if joint and options.criterion != "reprojection":
        raise ArgumentError(
            "criterion",
            f"is {options.criterion!r} with points as unknowns",
            "'reprojection', or structure='eliminated' with a minimal parameterization",
        )


def _covariances(
    covariance1: ArrayLike | None,
    covariance2: ArrayLike | None,
    options: Options,
    starts: int,
    m: int,
) -> tuple[Array, Array] | None:
    """Return the covariances of both images, or None where all noise is equal."""
    if covariance1 is None and covariance2 is None:
        return None
    joint = options.structure == "joint" or options.parameterization in REDUNDANT
    if joint or options.criterion != "reprojection" or starts > 1 or options.bias_correction:
        raise ArgumentError(
            "covariance1, covariance2",
            "are given",
            "criterion='reprojection', structure='eliminated', a minimal parameterization, one "
            "start and no bias correction, or none of the two",
        )
    return (
        as_covariances("covariance1", np.eye(2) if covariance1 is None else covariance1, m),
        as_covariances("covariance2", np.eye(2) if covariance2 is None else covariance2, m),
    )


def _given_start(F0: ArrayLike, x1: Array, x2: Array, weights: Array) -> Array:
    """Check the caller's start value, in coordinates where its rank can be told."""
    F = as_fundamental(F0)
    # Divided by a power of two, which is exact, so that no square overflows or vanishes
    F = np.ldexp(F, -int(np.frexp(np.max(np.abs(F)))[1]))
    for name, x in (("x1", x1), ("x2", x2)):
        check_general_position(name, x[weights > 0.0])
    counts = weights > 0.0
    values = np.linalg.svd(condition(x1[counts], x2[counts]).from_pixels(F), compute_uv=False)
    if values[1] <= 16.0 * np.finfo(float).eps * values[0]:
        raise ArgumentError("F0", "has rank 1", "a fundamental matrix, of rank 2")
    return np.asarray(F)


def _starts(matches: Matches, options: Options, start: Array | None, count: int) -> list[Array]:
    """Return where to minimise from: the start, in pixels, and as many others as asked for."""
    first = [] if start is None else [matches.frame.from_pixels(start)]
    if options.calibration is None:
        return perturbed(matches, first[0], count)
    others = count - 1 if first else max(count, _ESSENTIAL_STARTS)
    if others:
        cameras, robust = matches.calibrated(options.calibration), options.loss != "linear"
        first += essential_starts(cameras, matches.weights, others, robust=robust)
    if not first:
        needed = "matches that determine an essential matrix"
        raise ArgumentError("x1, x2", "are in a degenerate position", needed)
    return first


def _once(x1: Array, x2: Array, weights: Array | None, at_least: int) -> Array:
    """Return weights with which equal matches count once; refuse too few different ones."""
    once = counted_once(x1, x2, weights)
    if once is None:
        return np.ones(len(x1))
    different = int(np.count_nonzero(earliest(x1, x2) == np.arange(len(x1))))
    if different < at_least:
        raise ArgumentError("x1, x2", f"hold {different} different matches", f"at least {at_least}")
    return once


#: Keyword options of `refine_fundamental` with their defaults, and those that a plan is made of.
_DEFAULTS: dict[str, Any] = {
    name: parameter.default
    for name, parameter in inspect.signature(refine_fundamental).parameters.items()
    if parameter.kind is parameter.KEYWORD_ONLY
}
_PLANNED = (
    *("parameterization", "criterion", "structure", "damping", "hessian", "loss", "loss_scale_px"),
    *(
        "fix",
        "bias_correction",
        "ftol",
        "xtol",
        "gtol",
        "max_iter",
        "starts",
        "noise_px",
        "backend",
    ),
)
