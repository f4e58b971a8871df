"""Several minima: where else to start, which results are the same, and which are possible.

Near-affine scenes have several minima, and every local method ends in the one that its start leads
to. Minima that no cameras with all points in front of them can explain are told by the *oriented*
epipolar constraint.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.two_view.covariance import residual_noise, tangent_basis
from epigauge.two_view.criteria import Reprojection
from epigauge.two_view.diagnostics import planar_bound
from epigauge.two_view.essential import Essential, Motion
from epigauge.two_view.evidence import ROUNDING, Evidence, evidence
from epigauge.two_view.five_point import log_cost
from epigauge.two_view.homography import fit_homography
from epigauge.two_view.joint import intersect
from epigauge.two_view.losses import Loss
from epigauge.two_view.solve import Matches, Options, Solution, joined, minimize

__all__ = ["AMBIGUOUS", "Minimum", "Search", "chosen", "perturbed", "search"]

Array = NDArray[np.float64]

#: Minima whose ``2 cost`` exceeds the lowest by no more than this, in units of the noise squared,
#: are within the noise of it: three standard deviations.
AMBIGUOUS = 9.0

#: Size of the perturbations in standard deviations of F, and its limit for F of unit norm.
#: Four deviations find the best minimum in 83 % of the scenes at 16 m with 20 starts, ten
#: in nearly all.
_SPREAD = 10.0
_WIDEST = 2.0
_SEED = 20040301

#: What a match off a plane counts at most, in units of the noise squared: a few are wrong.
_FAR = 18.0

#: Two results are one minimum when their costs (relative) and their F (unit norm) differ by less.
_SAME_COST = 1e-6
_SAME_F = 1e-2


@dataclass(frozen=True)
class Minimum:
    """One local minimum.

    Attributes
    ----------
    cost : float
        As `FundamentalResult.cost`, in px^2.
    F : ndarray, shape (3, 3)
        Fundamental matrix of unit Frobenius norm, in pixels.
    oriented : bool
        Whether it satisfies the oriented epipolar constraint; with calibrated cameras, whether all
        points are in front of both within the noise.
    count : int
        How many starts ended in it.
    """

    cost: float
    F: Array
    oriented: bool
    count: int


def perturbed(matches: Matches, F: Array, count: int) -> list[Array]:
    """Return F and further starts around it, spread where the matches leave F most freedom.

    F plus a Gaussian matrix with ten times the standard deviations of F, as the residuals of the
    start predict them, so that directions well determined are hardly left and the others searched
    widely.

    Parameters
    ----------
    matches : Matches
        Matches.
    F : ndarray, shape (3, 3)
        Conditioned start.
    count : int
        Number of starts.

    Returns
    -------
    list of ndarray, shape (3, 3)
        Of rank 2; the same at every call.
    """
    starts = [F]
    if count == 1:
        return starts
    # The sign of F must not matter
    unit = F / np.linalg.norm(F) * np.sign(F.ravel()[np.argmax(np.abs(F))])
    basis = tangent_basis(unit)
    criterion = Reprojection(matches.table, matches.q1, matches.q2)
    feet = criterion.evaluate(unit)
    _, _, derivative = criterion.corrected(feet)
    values, vectors = np.linalg.eigh(
        basis.T @ (derivative * matches.weights) @ derivative.T @ basis
    )
    noise = residual_noise(feet.signed, matches.weights, Loss(), 7)
    spread = _SPREAD * noise / np.sqrt(np.maximum(values, np.finfo(float).tiny))
    directions = basis @ vectors * np.minimum(spread, _WIDEST)
    rng = np.random.default_rng(_SEED)
    for _ in range(count - 1):
        moved = unit + (directions @ rng.standard_normal(7)).reshape(3, 3)
        U, s, Vt = np.linalg.svd(moved)
        starts.append((U[:, :2] * s[:2]) @ Vt[:2])
    return starts


@dataclass(frozen=True)
class Search:
    """What several starts lead to.

    Attributes
    ----------
    solution : Solution
        The lowest oriented minimum, or the lowest if none is oriented; with calibrated cameras the
        lowest minimum for points in front of both. With the evaluations of all starts.
    evidence : Evidence
        What it is diagnosed from.
    minima : tuple of Minimum
        All minima by rising cost.
    ambiguous : bool
        Whether several oriented minima are within the noise of one another.
    motion : Motion or None
        That of calibrated cameras.
    """

    solution: Solution
    evidence: Evidence
    minima: tuple[Minimum, ...]
    ambiguous: bool
    motion: Motion | None = None


def search(
    matches: Matches,
    options: Options,
    starts: list[Array],
    callback: Callable[[lm.Row], object] | None = None,
) -> Search:
    """Minimise from several starts and choose among the minima.

    Parameters
    ----------
    matches : Matches
        What is fitted.
    options : Options
        How.
    starts : list of ndarray, shape (3, 3)
        Conditioned F.
    callback : callable, optional
        As in `epigauge.lm.minimize`, called for each start; a true value ends the whole search.

    Returns
    -------
    Search
        Starts that end without convergence are left out, but for the first.
    """
    found: list[Solution] = []
    for F in starts:
        found.append(minimize(matches, options, F, callback))
        if found[-1].outcome.status == -2:
            break
    else:
        other = _reversed(matches, options, found[0])
        if other is not None:
            found.append(minimize(matches, options, other, callback))
    return chosen(matches, options, found)


def chosen(matches: Matches, options: Options, found: list[Solution]) -> Search:
    """Group the solutions of several starts and choose the best, as `search` does."""
    groups: list[list[Solution]] = []
    for solution in found:
        if solution.outcome.status > 0 or not groups:
            _add(groups, solution)
    # The lowest of each group stands for it
    groups = [sorted(group, key=_cost) for group in groups]
    groups.sort(key=lambda group: _cost(group[0]))
    motions = [_motion(matches, options, group[0]) for group in groups]
    cases = [
        evidence(matches, options, group[0], motion)
        for group, motion in zip(groups, motions, strict=True)
    ]
    minima = tuple(
        Minimum(
            cost=_cost(group[0]) * matches.frame.scale**2,
            F=matches.frame.to_pixels(group[0].F),
            oriented=case.oriented,
            count=len(group),
        )
        for group, case in zip(groups, cases, strict=True)
    )
    first = next((k for k, minimum in enumerate(minima) if minimum.oriented), 0)
    if options.calibration is not None:
        m = int(np.count_nonzero(matches.weights > 0.0))
        doubts = np.array([motion.doubt for motion in motions if motion is not None])
        costs = np.array([2.0 * _cost(group[0]) for group in groups])
        noise = min(case.noise for case in cases)
        if len(groups) > 1 and _on_a_plane(matches, m, noise):
            # Both motions of a plane are exact: what their costs differ by is noise
            first = int(np.lexsort((costs, np.round(doubts)))[0])
        else:
            first = int(np.argmin(log_cost(costs, m) + doubts))
    best = groups[first][0]
    noise_px = cases[first].noise_of_weight_one * matches.frame.scale
    bound = minima[first].cost + 0.5 * AMBIGUOUS * noise_px**2
    rivals = sum(minimum.oriented and minimum.cost <= bound for minimum in minima)
    history = found[0].outcome.history
    for solution in found[1:]:
        history = joined(history, solution.outcome.history)
    outcome = replace(
        best.outcome,
        history=history,
        nfev=len(history),
        njev=sum(solution.outcome.njev for solution in found),
        nit=sum(solution.outcome.nit for solution in found),
    )
    solution = replace(best, outcome=outcome)
    return Search(solution, cases[first], minima, rivals > 1, motions[first])


def _reversed(matches: Matches, options: Options, solution: Solution) -> Array | None:
    """Return a start for calibrated cameras with the relief of the scene reversed, if there is one.

    A narrow field of view hardly tells relief and motion from both mirrored in depth, in the plane
    through the middle of the points across the line of sight of either camera. Five matches say
    nothing between the two: an E fits them exactly.
    """
    used = matches.weights > 0.0
    if options.calibration is None or np.count_nonzero(used) <= Essential.dimension:
        return None
    motion = _motion(matches, options, solution)
    if motion is None or not math.isfinite(_cost(solution)):
        return None
    R, t = motion.R, motion.t
    cameras = matches.calibrated(options.calibration)
    h1, h2 = cameras.rays(matches.q1, matches.q2)
    inverse_depths = intersect(np.column_stack([R, t]), h1[:, :2].T, h2[:, :2].T)[2]
    good = used & (inverse_depths > 0.0)
    if not good.any():
        return None
    middle1 = np.median(h1[good] / inverse_depths[good, None], axis=0)
    middle2 = R @ middle1 + t
    side1, side2 = (np.eye(3) - 2.0 * np.outer(m, m) / (m @ m) for m in (middle1, middle2))
    turn = side2 @ R @ side1
    return cameras.fundamental(np.cross(np.eye(3), turn @ middle1 - middle2) @ turn)


def _on_a_plane(matches: Matches, m: int, noise: float) -> bool:
    """Tell whether a homography explains calibrated matches within a noise."""
    squares = fit_homography(matches.q1, matches.q2, matches.weights, matches.table)[1]
    noise2 = max(noise, ROUNDING) ** 2
    cost = float(np.sum(np.minimum(matches.weights * squares, _FAR * noise2)))
    return cost <= planar_bound(m, Essential.dimension) * noise2


def _motion(matches: Matches, options: Options, solution: Solution) -> Motion | None:
    """Return the motion of calibrated cameras."""
    if options.calibration is None:
        return None
    loss = options.scaled_loss(solution.loss_scale_px / matches.frame.scale)
    reprojection = matches.reprojection()
    feet = reprojection.evaluate(solution.F)
    unit2: Array | float = 1.0
    if matches.covariances is not None:  # the shortest distance to an end, in units of the noise
        unit2 = np.max([np.linalg.eigvalsh(c)[:, -1] for c in matches.covariances], axis=0)
    return matches.calibrated(options.calibration).motion(
        solution.F,
        reprojection.corrected(feet)[:2],
        feet.squared,
        matches.weights,
        residual_noise(feet.signed, matches.weights, loss, 5) ** 2,
        unit2,
    )


def _cost(solution: Solution) -> float:
    return float(solution.outcome.state.cost)


def _add(groups: list[list[Solution]], solution: Solution) -> None:
    """Put a solution to those that ended in the same minimum, or into a group of its own."""
    F = solution.F / np.linalg.norm(solution.F)
    for group in groups:
        G = group[0].F / np.linalg.norm(group[0].F)
        same_cost = abs(_cost(solution) - _cost(group[0])) <= _SAME_COST * _cost(group[0]) + 1e-24
        if same_cost and min(np.linalg.norm(F - G), np.linalg.norm(F + G)) <= _SAME_F:
            group.append(solution)
            return
    groups.append([solution])
