"""Many pairs at once over any array namespace: what is refined, padded, and told of each.

Pairs are refined in the library and on the device of the arrays that are given, padded to the size
of the largest with matches of weight zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import arrays, lm
from epigauge._arguments import as_weights, check_general_position
from epigauge.errors import ArgumentError
from epigauge.two_view.copies import counted_once
from epigauge.two_view.tensor_minimum import refine_pairs

__all__ = ["REFUSED", "like", "refined"]

Tensor = Any
Indices = NDArray[np.intp]

#: Status of a pair that could not be refined, beside those of `epigauge.lm.STATUS`.
REFUSED = -9


def like(array: Tensor) -> Callable[[Any], Tensor]:
    """Return what turns NumPy arrays into arrays of the kind, type and place of `array`."""
    xp = arrays.namespace(array)
    return lambda values: xp.asarray(values, dtype=array.dtype, device=arrays.device(array))


def refined(
    x1: Tensor,
    x2: Tensor,
    values: tuple[NDArray[np.float64], NDArray[np.float64]],
    bounds: Indices,
    F0: Tensor | None,
    weights: Any,
    options: dict[str, Any],
) -> dict[str, Any]:
    """Return the fields of a `FundamentalBatch` that the loop gives.

    Parameters
    ----------
    x1, x2 : tensor, shape (m, 2)
        Matches of all pairs.
    values : tuple of ndarray
        The same in NumPy, checked.
    bounds : ndarray of int, shape (n + 1,)
        Where the pairs begin.
    F0 : tensor, shape (n, 3, 3), optional
        Start values.
    weights : tensor, shape (m,), optional
        Weights of the matches.
    options : dict
        Tolerances.

    Raises
    ------
    ArgumentError
        On other options, other types than floats, and bad shapes or weights.
    """
    unknown = sorted(set(options) - {"ftol", "xtol", "gtol", "max_iter", "backend"})
    if unknown:
        remedy = "NumPy arrays without backend='array', or the default"
        raise ArgumentError(unknown[0], "is no option for arrays of other libraries", remedy)
    stopping = lm.Stopping(**{k: v for k, v in options.items() if k != "backend"})
    xp, convert = arrays.namespace(x1, x2), like(x1)
    if not xp.isdtype(x1.dtype, "real floating") or x1.dtype != x2.dtype:
        raise ArgumentError("x1, x2", f"have types {x1.dtype}, {x2.dtype}", "one floating type")
    count = len(bounds) - 1
    if F0 is not None and tuple(F0.shape) != (count, 3, 3):
        raise ArgumentError("F0", f"has shape {tuple(F0.shape)}", f"({count}, 3, 3)")
    given = None if weights is None else as_weights(arrays.host(weights), len(values[0]))
    once = counted_once(*values, given, bounds)
    once = np.ones(len(values[0])) if once is None else once
    reasons = refusals(*values, once, bounds)
    kept = np.array([k for k in range(count) if k not in reasons], np.intp)
    rows, own = packed(bounds, x1)
    nfev, status = np.zeros(count, np.intp), np.full(count, REFUSED, np.intp)
    fields = {"F": (3, 3), "sigma": (), "cost": (), "rms_px": ()}
    found: dict[str, Any] = {
        name: convert(np.zeros((count, *shape))) for name, shape in fields.items()
    }
    found["distances"] = convert(np.zeros(len(values[0])))
    if len(kept):
        # Pairs that fill up a bucket repeat the last: nobody reads them.
        filling = arrays.bucket(x1, len(kept)) - len(kept)
        refining = np.concatenate([kept, np.full(filling, kept[-1])])
        rows, own = rows[refining], own[refining]
        place = xp.asarray(rows.ravel(), device=arrays.device(x1))
        own1, own2 = (xp.reshape(xp.take(x, place, axis=0), (*rows.shape, 2)) for x in (x1, x2))
        starts = (
            None
            if F0 is None
            else xp.take(F0, xp.asarray(refining, device=arrays.device(x1)), axis=0)
        )
        minimum = refine_pairs(
            xp, own1, own2, convert(np.where(own, once[rows], 0.0)), starts, stopping
        )
        # Refused pairs, and their matches, read the zero that is appended.
        pick = np.full(count, len(refining), np.intp)
        pick[kept] = np.arange(len(kept))
        for name in fields:
            value = getattr(minimum, name)
            found[name] = _taken(xp, value, pick)
        where = np.full(len(values[0]), rows.size, np.intp)
        own[len(kept) :] = False
        where[rows[own]] = np.flatnonzero(own)
        found["distances"] = _taken(xp, xp.reshape(minimum.distances, (-1,)), where)
        nfev[kept], status[kept] = minimum.nfev[: len(kept)], minimum.status[: len(kept)]
    return found | {
        "nfev": nfev,
        "njev": nfev.copy(),
        "nit": np.maximum(nfev - 1, 0),
        "status": status,
        "reasons": reasons,
    }


def _taken(xp: Any, value: Tensor, places: Indices) -> Tensor:
    """Return rows of a tensor, where the place after the last is a row of zeros."""
    zero = xp.zeros_like(value[:1, ...])
    index = xp.asarray(places, device=arrays.device(value))
    return xp.take(xp.concat([value, zero], axis=0), index, axis=0)


def refusals(
    x1: NDArray[np.float64],
    x2: NDArray[np.float64],
    weights: NDArray[np.float64],
    bounds: Indices,
) -> dict[int, str]:
    """Tell which pairs cannot determine F, and why."""
    reasons = {}
    for k, (begin, end) in enumerate(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
        counts = weights[begin:end] > 0.0
        try:
            if counts.sum() < 8:
                needed = "at least 8"
                raise ArgumentError("x1, x2", f"hold {counts.sum()} different matches", needed)
            check_general_position("x1", x1[begin:end][counts])
            check_general_position("x2", x2[begin:end][counts])
        except ArgumentError as error:
            reasons[k] = str(error)
    return reasons


def packed(bounds: Indices, x: Tensor) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the rows of each pair, (n, m), padded by row 0, and which of them are its own.

    What `x` is of may ask for more padding.
    """
    sizes = np.diff(bounds)
    place = np.arange(arrays.bucket(x, int(sizes.max(initial=1))))
    own = place < sizes[:, None]
    return np.where(own, bounds[:-1, None] + place, 0), own
