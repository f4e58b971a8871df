"""The short way for a plain pair: one call of the compiled loop, the rest computed when asked for.

`refine_fundamental` comes here first with its usual options. Whatever is not plainly in order goes
the long way, with its checks and messages; both give the same results.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge.two_view import native, quick
from epigauge.two_view.assemble import assembled
from epigauge.two_view.minima import chosen
from epigauge.two_view.parameterizations import Ortho
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.solve import Matches, Options, Solution

__all__ = ["completed", "express"]

Array = NDArray[np.float64]


def express(
    x1: Array,
    x2: Array,
    F0: Array | None,
    weights: Array | None,
    options: Options,
    native_options: native.PairOptions,
    noise_px: float | None,
) -> FundamentalResult | None:
    """Refine a pair in pixels, or return None where the long way must look at it.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2), float64, contiguous
        Matches; may hold anything.
    F0 : ndarray, shape (3, 3), float64, contiguous, or None
        Start value of any scale.
    weights : ndarray, shape (m,), or None
        Checked.
    options : Options
        Linear loss, structure eliminated, nothing fixed, orthonormal representation.
    native_options : native.PairOptions
        The same for the compiled loop.
    noise_px : float or None
        As in `refine_fundamental`.

    Returns
    -------
    FundamentalResult or None
        F, cost and counts are there, all else follows when it is asked for.
    """
    offsets = np.array([0, len(x1)], np.intp)
    pair = native.refine_pairs(x1, x2, offsets, F0, weights, native_options, history=True)
    left, nfev, njev, nit, status = pair.numbers[0].tolist()
    if left:
        return None
    row = pair.table[0]
    sigma, cost, squares, count, *_, scale = row[27:36].tolist()
    known = {
        "F": row[:9].reshape(3, 3),
        "x": row[:9],
        "sigma": sigma,
        "cost": cost * scale**2,
        "rms_px": scale * math.sqrt(squares / (4.0 * count)),
        "fun": pair.distances,
        "loss_scale_px": 0.0,
        "nfev": nfev,
        "njev": njev,
        "nit": nit,
        "status": status,
        "message": lm.STATUS[status],
    }
    # The caller may write into the arrays before the rest is computed.
    kept = None if weights is None else weights.copy()
    x1, x2 = x1.copy(), x2.copy()
    complete = partial(completed, pair, 0, x1, x2, kept, options, noise_px)
    if options.criterion != "reprojection":
        return FundamentalResult.partial(known, complete)
    known["_pair"] = pair

    def history() -> SimpleNamespace:
        return SimpleNamespace(history=lm.rows(pair.history[:nfev], scale**2))

    judge = partial(_judged, pair, x1, x2, kept)
    return FundamentalResult.partial(known, complete, flags=judge, success=judge, history=history)


def _judged(pair: native.Pair, x1: Array, x2: Array, weights: Array | None) -> SimpleNamespace:
    """Return flags and success where cheap tests suffice, nothing where they do not."""
    flags, success = quick.verdicts_of(pair, x1, x2, np.array([0, len(x1)], np.intp), weights)[0]
    return SimpleNamespace() if flags is None else SimpleNamespace(flags=flags, success=success)


def completed(
    pair: native.Pair,
    k: int,
    x1: Array,
    x2: Array,
    weights: Array | None,
    options: Options,
    noise_px: float | None,
) -> FundamentalResult:
    """Return the result of pair k, whose matches are given, with all its fields."""
    table, frame = kernels.table("c"), pair.frame(k)
    w = np.ones(len(x1)) if weights is None else weights
    matches = Matches(table, frame, *frame.forward(x1, x2), w)
    _, nfev, njev, nit, status = pair.numbers[k].tolist()
    rows = lm.rows(pair.history[:nfev], frame.scale**2)
    motion, F = pair.motion(k), pair.table[k, 55:64].reshape(3, 3)
    state = native.Minimum(motion, F, float(pair.table[k, 28]))
    outcome = lm.Outcome(state, None, nfev, njev, nit, status, rows)
    solution = Solution(F, Ortho(table), motion, outcome, 0.0)
    found = chosen(matches, options, [solution])
    # A batch records no histories; the counts are its own.
    found = replace(found, solution=replace(found.solution, outcome=outcome))
    return assembled(found, options, matches, noise_px)
