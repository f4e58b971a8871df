"""The exact Newton loop over many pairs at once, differentiable at its end.

What `epigauge.two_view.solve` does for one pair is done here for all of them together. Everything
up to the minimum works on values; one more Newton step there, with the gradient as a function of
the matches, carries their derivatives to F (implicit function theorem).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import arrays, lm
from epigauge.linear import LAM_FLOOR, Levenberg
from epigauge.two_view.tensor_frame import Frame, eight_point
from epigauge.two_view.tensor_problem import Problem

__all__ = ["Minimum", "refine_pairs"]

Tensor = Any


@dataclass(frozen=True)
class Minimum:
    """What the loop ends at; a row a pair, tensors but for the counts.

    Attributes
    ----------
    F, sigma, cost, rms_px : tensor, shape (n, 3, 3) and (n,)
        In pixels.
    distances : tensor, shape (n, m)
        Signed, in pixels; of padding, anything.
    nfev, status : ndarray of int, shape (n,)
        Evaluations, and the reason of stopping as in `epigauge.lm.STATUS`.
    """

    F: Tensor
    sigma: Tensor
    cost: Tensor
    rms_px: Tensor
    distances: Tensor
    nfev: NDArray[np.intp]
    status: NDArray[np.intp]


def refine_pairs(
    xp: Any, x1: Tensor, x2: Tensor, weights: Tensor, F0: Tensor | None, stopping: lm.Stopping
) -> Minimum:
    """Minimise the exact reprojection error of pairs.

    Parameters
    ----------
    xp : module
        Their namespace.
    x1, x2 : tensor, shape (n, m, 2)
        Matches in pixels.
    weights : tensor, shape (n, m)
        Factor of each squared distance; zero for padding.
    F0 : tensor, shape (n, 3, 3), optional
        Start values in pixels; by default the 8-point estimates.
    stopping : epigauge.lm.Stopping
        Tolerances.

    Returns
    -------
    Minimum
        Where each pair ended.
    """
    frame = Frame.of(xp, arrays.constant(x1), arrays.constant(x2), weights)
    if F0 is None:
        start = eight_point(xp, *frame.forward(arrays.constant(x1), arrays.constant(x2)), weights)
    else:
        start = frame.from_pixels(arrays.constant(F0))
    frame, start = frame.displaced(start)
    problem = Problem(xp, *frame.forward(arrays.constant(x1), arrays.constant(x2)), weights)
    factors, nfev, status = _minimize(problem, problem.factorize(start), stopping)
    tracked = Problem(xp, *frame.forward(x1, x2), weights)
    factors = tracked.polished(problem, factors)
    F = tracked.fundamental(factors)
    signed = frame.scale[:, None] * tracked.distances(F)[1]
    squares = xp.sum(weights * signed**2, axis=-1)
    F = frame.to_pixels(xp.permute_dims(F[..., 0], (2, 0, 1)))
    values = xp.linalg.svdvals(F)
    return Minimum(
        F,
        values[:, 1] / values[:, 0],
        0.5 * squares,
        xp.sqrt(squares / (4.0 * xp.sum(xp.astype(weights > 0.0, weights.dtype), axis=-1))),
        signed,
        nfev,
        status,
    )


def _minimize(
    problem: Problem, factors: tuple[Tensor, Tensor, Tensor], stopping: lm.Stopping
) -> tuple[tuple[Tensor, Tensor, Tensor], NDArray[np.intp], NDArray[np.intp]]:
    """Run `epigauge.lm.minimize` with the classic schedule on all pairs, until the last stops."""
    xp = problem.xp
    cost = problem.cost(factors)
    system = problem.linearize(factors)
    lam = Levenberg.relative * xp.max(system.diagonal, axis=-1)
    least, ceiling = LAM_FLOOR * lam, 1e16 * lam
    count = cost.shape[0]
    nfev, status = np.ones(count, np.intp), np.zeros(count, np.intp)
    running = np.ones(count, bool)

    def stop(which: Tensor, reason: int) -> None:
        found = arrays.host(which) & running
        status[found] = reason
        running[found] = False

    stop(~xp.isfinite(cost), -3)
    for _ in range(stopping.max_iter):
        stop(cost <= problem.floor, 5)
        stop(xp.max(xp.abs(system.gradient), axis=-1) <= stopping.gtol, 1)
        stop(system.decrement() <= stopping.ftol * cost, 4)
        if not running.any():
            break
        step = system.step(lam)
        trial = problem.retract(factors, step)
        after = problem.cost(trial)
        moving = xp.asarray(running, device=arrays.device(cost))
        nfev[running] += 1
        decrease = cost - after
        better = moving & (decrease > 0.0)
        norm = xp.sqrt(xp.sum(step**2, axis=-1))
        factors = tuple(
            xp.where(better[:, None], new, old) for new, old in zip(trial, factors, strict=True)
        )
        stop(~better & (xp.abs(decrease) <= 1e-15 * cost), 2)
        stop(better & (decrease <= stopping.ftol * after), 2)
        stop(better & (norm <= stopping.xtol), 3)
        cost = xp.where(better, after, cost)
        lam = xp.where(better, xp.maximum(0.1 * lam, least), 10.0 * lam)
        stop(lam > ceiling, -1)
        if bool(xp.any(better)):
            system = problem.linearize(factors)
    return factors, nfev, status
