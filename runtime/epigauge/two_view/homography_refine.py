"""Maximum-likelihood refinement of a homography."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels, lm
from epigauge._arguments import (
    as_choice,
    as_covariances,
    as_fundamental,
    as_matches,
    as_positive,
    as_weights,
)
from epigauge._logged import logged
from epigauge._options import Backend
from epigauge._options import Loss as LossName
from epigauge.errors import ArgumentError
from epigauge.linear import Levenberg
from epigauge.two_view.chance import SIGNIFICANT, chance_on_plane, log10_false_alarms
from epigauge.two_view.collinear import is_plane_left_open
from epigauge.two_view.conditioning import Conditioning, condition
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.copies import counted_once
from epigauge.two_view.diagnostics import PIXELS, REDUNDANCY, WEAK, still_bound
from epigauge.two_view.evidence import ROUNDING
from epigauge.two_view.homography import fit_homography, plane_squares, robust_homography
from epigauge.two_view.homography_problem import PARAMETERS, HomographyProblem, Transfer, across
from epigauge.two_view.homography_result import HomographyResult
from epigauge.two_view.losses import EFFICIENT, LOSSES, Loss, median
from epigauge.two_view.rotation import may_be_rotation
from epigauge.two_view.solve import joined
from epigauge.two_view.suspicion import TAIL, TAIL_SHARE, WIDE
from epigauge.verdicts import ordered, usable

__all__ = ["deviation_of_median", "refine_homography"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Least number of matches that determine a homography.
LEAST = 4

#: Rounds in which the scale of a robust loss is estimated, and the change at which it stands.
_ROUNDS, _STANDS = 10, 1e-3

#: Distance that 99.9 % of right matches are within, in standard deviations of a coordinate.
DEVIATIONS = math.sqrt(2.0 * math.log(1000.0))


@logged
def refine_homography(
    x1: ArrayLike,
    x2: ArrayLike,
    H0: ArrayLike | None = None,
    *,
    loss: LossName = "linear",
    loss_scale_px: float | Literal["auto"] = "auto",
    noise_px: float | None = None,
    weights: ArrayLike | None = None,
    covariance1: ArrayLike | None = None,
    covariance2: ArrayLike | None = None,
    ftol: float = 1e-10,
    xtol: float = 1e-12,
    gtol: float = 1e-14,
    max_iter: int = 100,
    backend: Backend | None = None,
    callback: Callable[[lm.Row], object] | None = None,
) -> HomographyResult:
    """Find the homography that minimises the reprojection error of matches in both images.

    The maximum-likelihood estimate for Gaussian noise on the points of both images: each match is
    moved by as little as possible to points that H maps onto one another [1]_, and H has its eight
    parameters.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least four different matches in pixels, of a plane, or of a camera that only turned. Of
        several equal matches one counts.
    H0 : array_like, shape (3, 3), optional
        Start with ``x2 ~ H0 x1``; by default an algebraic fit, robust where the loss is.
    loss, loss_scale_px : optional
        Robust loss of each match's squared distance, and its scale in pixels, as for
        `refine_fundamental`.
    noise_px : float, optional
        Standard deviation of a coordinate in pixels, which scales the covariance only. By default
        sqrt(sum(w d^2) / (2 m - 8)), or by the median distance with a robust loss.
    weights : array_like, shape (m,), optional
        Factor of each match's squared distance.
    covariance1, covariance2 : array_like, shape (2, 2) or (m, 2, 2), optional
        Covariances of the points in px^2; distances are then in units of the noise.
    ftol, xtol, gtol, max_iter, backend, callback : optional
        As for `refine_fundamental`.

    Returns
    -------
    HomographyResult
        H, its covariance, and how it was found.

    Raises
    ------
    ArgumentError
        On bad arguments, and matches in fewer than four different places.

    References
    ----------
    .. [1] R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2003, section
       4.2.3.

    Examples
    --------
    >>> import numpy as np
    >>> import epigauge as eg
    >>> x1 = np.random.default_rng(0).uniform(0.0, 1000.0, (50, 2))
    >>> H = np.array([[1.0, 0.1, 20.0], [-0.1, 1.0, 5.0], [1e-4, 0.0, 1.0]])
    >>> y = np.column_stack([x1, np.ones(50)]) @ H.T
    >>> result = eg.refine_homography(x1, y[:, :2] / y[:, 2:])
    >>> bool(result.success), np.round(result.H / result.H[2, 2], 6).tolist()[0]
    (True, [1.0, 0.1, 20.0])
    """
    name = as_choice("loss", loss, LOSSES)
    given_scale = None if loss_scale_px == "auto" else as_positive("loss_scale_px", loss_scale_px)
    noise_px = None if noise_px is None else as_positive("noise_px", noise_px)
    stopping = lm.Stopping(ftol=ftol, xtol=xtol, gtol=gtol, max_iter=max_iter)
    x1, x2 = as_matches(x1, x2, at_least=LEAST, general_position=True)
    w = counted_once(x1, x2, None if weights is None else as_weights(weights, len(x1)))
    w = np.ones(len(x1)) if w is None else w
    if np.count_nonzero(w > 0.0) < LEAST:
        raise ArgumentError("x1, x2", "hold too few different matches of weight above 0", "4")
    table = kernels.table(backend)
    frame = condition(x1[w > 0.0], x2[w > 0.0])
    q1, q2 = frame.forward(x1, x2)
    S = None
    if covariance1 is not None or covariance2 is not None:
        both = (("covariance1", covariance1), ("covariance2", covariance2))
        C1, C2 = (as_covariances(n, np.eye(2) if c is None else c, len(x1)) for n, c in both)
        S = (_packed(C1), _packed(C2))
    H = _start(H0, frame, q1, q2, w, table, name)
    problem = HomographyProblem(table, q1, q2, w, Loss(), S)
    if H0 is None and not math.isfinite(problem.evaluate(H).cost):
        H = _affine(q1, q2, w)  # which takes no match to infinity
    found = _minimized(problem, name, given_scale, frame.scale, H, stopping, callback)
    return _assembled(found, problem.with_loss(found.loss), frame, noise_px)


@dataclass(frozen=True)
class _Found:
    """Where a minimisation has ended, with the loss it had in the end."""

    state: Transfer
    loss: Loss
    status: int
    nfev: int
    njev: int
    history: tuple[lm.Row, ...]


def _packed(C: Array) -> Array:
    return np.ascontiguousarray(np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]]))


def _start(
    H0: ArrayLike | None,
    frame: Conditioning,
    q1: Array,
    q2: Array,
    w: Array,
    table: kernels.Table,
    loss: str,
) -> Array:
    """Return the start in conditioned coordinates, of unit norm."""
    if H0 is not None:
        return frame.homography_from_pixels(as_fundamental(H0, "H0"))
    counts = w > 0.0
    some = (np.ascontiguousarray(q1[:, counts]), np.ascontiguousarray(q2[:, counts]))
    if loss == "linear":
        return fit_homography(*some, w[counts], table)[0]
    return robust_homography(*some, w[counts], table)[0]


def _affine(q1: Array, q2: Array, w: Array) -> Array:
    """Return the affine map of least squares in image 2, of unit norm."""
    root = np.sqrt(w / np.max(w))[:, None]
    A = np.column_stack([*q1, np.ones(q1.shape[1])])
    H = np.vstack([np.linalg.lstsq(A * root, q2.T * root, rcond=None)[0].T, [0.0, 0.0, 1.0]])
    return np.asarray(H / np.linalg.norm(H))


def _minimized(
    problem: HomographyProblem,
    name: str,
    given_scale: float | None,
    unit: float,
    H: Array,
    stopping: lm.Stopping,
    callback: Callable[[lm.Row], object] | None,
) -> _Found:
    """Minimise, with a scale of the loss that is estimated anew until it stands still."""

    def run(loss: Loss, H: Array) -> lm.Outcome[Transfer]:
        return lm.minimize(
            *(problem.with_loss(loss), H, Levenberg(), lm.Classic(), stopping, callback), unit**2
        )

    counts = problem.weights > 0.0
    nfev = njev = 0
    history: tuple[lm.Row, ...] = ()
    scale = 0.0
    for _ in range(_ROUNDS):
        last = scale
        if name == "linear":
            loss = Loss()
        elif given_scale is not None:
            loss = Loss(name, given_scale / unit)
        else:
            squared = (problem.weights * problem.evaluate(H).squared)[counts]
            scale = EFFICIENT[name] * max(deviation_of_median(squared), 1e-12)
            loss = Loss(name, scale)
            if not math.isfinite(scale):  # H takes most matches to nowhere: no cost to begin with
                loss = Loss()
            elif abs(scale - last) <= _STANDS * scale:
                break
        outcome = run(loss, H)
        H, nfev, njev = outcome.state.H, nfev + outcome.nfev, njev + outcome.njev
        history = joined(history, outcome.history)
        if name == "linear" or given_scale is not None or outcome.status < 0:
            break
    return _Found(outcome.state, loss, outcome.status, nfev, njev, history)


def deviation_of_median(squared: Array) -> float:
    """Return the standard deviation of a coordinate, half of the matches may be wrong.

    A squared distance to a homography has two degrees of freedom, and the median 2 log(2) s^2.
    """
    count = len(squared)
    factor = count / max(count - PARAMETERS / 2.0, 1.0)
    return math.sqrt(max(median(squared), 0.0) * factor / (2.0 * math.log(2.0)))


def _assembled(
    found: _Found, problem: HomographyProblem, frame: Conditioning, noise_px: float | None
) -> HomographyResult:
    state, loss, weights = found.state, found.loss, problem.weights
    counts = weights > 0.0
    n, scale = int(np.count_nonzero(counts)), frame.scale
    squared = (weights * state.squared)[counts]
    redundancy = 2 * n - PARAMETERS
    N, _ = problem.system(state, weights)
    factor = 1.0
    if loss.name == "linear":
        known = math.sqrt(float(np.sum(squared)) / redundancy) if redundancy > 0 else math.inf
    else:
        known = deviation_of_median(squared) if redundancy > 0 else math.inf
        _, first, second = loss(state.squared[counts])
        finite = np.isfinite(squared)
        power = np.mean(np.where(finite, first**2 * squared, 0.0))
        slope = np.mean(np.where(finite, first + second * squared, 0.0))
        if 0.0 < known < math.inf and slope > 0.0:
            factor = float(power / (2.0 * known**2 * slope**2)) * n / max(n - 4, 1)
    noise = known if noise_px is None else noise_px / scale
    if redundancy <= 0:
        known = noise
    values, vectors = np.linalg.eigh(N)
    determined = values > 1e-14 * max(float(values[-1]), np.finfo(float).tiny)
    rank = int(np.count_nonzero(determined))
    to1, to2 = frame.maps_from_pixels()
    back = np.linalg.inv(to2)
    pixels = back @ state.H @ to1
    size = float(np.linalg.norm(pixels))
    unit = pixels.ravel() / size
    by_units = (np.eye(9) - np.outer(unit, unit)) @ np.kron(back, to1.T) / size
    directions = across(state.H) @ vectors
    spread = by_units @ directions[:, determined] / np.sqrt(values[determined])
    variance = noise**2 * factor
    if rank == PARAMETERS and math.isfinite(variance):
        covariance = variance * spread @ spread.T
    else:
        covariance = np.diag(np.full(9, np.inf))
    deviation = math.sqrt(known**2 / values[0]) if rank == PARAMETERS else math.inf
    gradient = problem.linearize(state).gradient * scale**2
    flags = _flags(problem, state, (to1, to2), known, math.sqrt(factor), deviation, N)
    finite = np.isfinite(squared)
    return HomographyResult(
        H=pixels / size,
        covariance=covariance,
        rank=rank,
        condition=float(np.sqrt(values[-1] / values[0])) if rank == PARAMETERS else math.inf,
        noise_px=noise * scale,
        rms_px=math.sqrt(float(np.mean(state.squared[counts][finite])) / 4.0) * scale
        if finite.any()
        else math.inf,
        loss_scale_px=0.0 if loss.name == "linear" else loss.scale * scale,
        inlier=counts,
        used=np.arange(len(weights)),
        threshold_px=math.inf,
        x=unit,
        cost=state.cost * scale**2,
        fun=np.sqrt(state.squared) * scale,
        points1=state.foot.T * scale + frame.origin1,
        grad=gradient,
        optimality=float(np.max(np.abs(gradient))),
        nfev=found.nfev,
        njev=found.njev,
        nit=len(found.history) - 1,
        status=found.status,
        message=lm.STATUS[found.status],
        flags=flags,
        success=found.status > 0 and usable(flags, "H"),
        history=found.history,
    )


def _flags(
    problem: HomographyProblem,
    state: Transfer,
    maps: tuple[Array, Array],
    noise: float,
    wider: float,
    deviation: float,
    N: Array,
) -> tuple[str, ...]:
    """Return what can be the matter with a homography of matches that are said to be right.

    With a robust loss, H is so many times wider spread than the noise says.
    """
    to1, to2 = maps
    counts = problem.weights > 0.0
    q1, q2 = (np.ascontiguousarray(q[:, counts]) for q in (problem.q1, problem.q2))
    weights = problem.weights[counts]
    squared = weights * state.squared[counts]
    n = len(weights)
    told = {"few matches": 2 * n - PARAMETERS < REDUNDANCY, "weak geometry": deviation > WEAK}
    told["not pixels"] = (
        max(float(np.max(np.ptp(q, axis=1))) for q in (q1, q2)) < PIXELS * to1[0, 0]
    )
    if not math.isfinite(noise):  # four matches, or a run that did not begin: nothing to judge by
        return ordered(name for name, raised in told.items() if raised)
    few, noise2 = told["few matches"] and n > LEAST, max(noise, ROUNDING) ** 2
    tail = (TAIL * deviation_of_median(squared)) ** 2
    if problem.loss.name == "linear" and noise > ROUNDING:
        told["gross errors"] = bool(np.sum(squared[squared > tail]) > TAIL_SHARE * np.sum(squared))
    # As for F: what is said to be right is doubted where the noise is large, or hardly known.
    near = squared <= DEVIATIONS**2 * noise2
    plain = plane_squares(problem.kernels, state.H, q1, q2)[near]
    wide = not math.sqrt(float(np.mean(plain)) / 2.0) <= WIDE * RANGE if near.any() else True
    if wide or few:
        chance = chance_on_plane(problem.kernels, state.H, q1, q2, math.sqrt(np.max(plain)))
        alarms = log10_false_alarms(n, len(plain), chance, LEAST)
        if alarms > (SIGNIFICANT if wide else 0.0):
            told["no common geometry"] = True
            return ordered(name for name, raised in told.items() if raised)
    told["undetermined"] = is_plane_left_open(problem.kernels, state.H, q1, q2, near)
    moved = q2 - q1 - (to2[:2, 2] - to1[:2, 2])[:, None]
    more = float(weights @ np.sum(moved**2, axis=0)) / 2.0 - float(np.sum(squared))
    told["still camera"] = more <= still_bound(n) * noise2
    if not told["still camera"]:
        B = across(state.H)
        spread, N = wider * max(noise, ROUNDING), B @ N @ B.T
        told["pure rotation"] = may_be_rotation(*maps, state.H, N, spread, 2 * n - PARAMETERS)
    return ordered(name for name, raised in told.items() if raised)


def with_flags(result: HomographyResult, flags: tuple[str, ...]) -> HomographyResult:
    """Return a result with more flags."""
    flags = ordered((*result.flags, *flags))
    return replace(result, flags=flags, success=result.status > 0 and usable(flags, "H"))
