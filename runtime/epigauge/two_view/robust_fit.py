"""Raw matches without copies, and the F of those that stand still as its inliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_array
from epigauge.errors import ArgumentError
from epigauge.two_view.conditioning import Conditioning, condition_raw
from epigauge.two_view.consensus import RANGE, WIDEST, Agreement, Consensus, narrowed
from epigauge.two_view.copies import contradicted, earliest
from epigauge.two_view.refine import refine_fundamental
from epigauge.two_view.result import FundamentalResult

__all__ = ["DEVIATIONS", "Fit", "Raw", "at_most", "fitted", "of_matches"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Distance of an inlier in standard deviations of the noise, at most.
DEVIATIONS = 3.0

_ROUNDS = 20

#: So many matches that do not contradict each other are searched without the others.
_ENOUGH = 14

#: Options of `refine_fundamental` with one entry a match.
_PER_MATCH = {"weights": 1, "covariance1": 3, "covariance2": 3}


@dataclass(frozen=True)
class Raw:
    """All different matches, in pixels and conditioned.

    Attributes
    ----------
    count : int
        Matches as they were given.
    rows, copies : ndarray of int
        Which of these are here, shape (m,), and which of them each is, shape (count,).
    x1, x2 : ndarray, shape (m, 2)
        In pixels.
    table : Table
        Backend.
    frame : Conditioning
        Conditioned coordinates.
    is_near : ndarray of bool, shape (m,)
        Whether a match is not absurdly far from the others, where none agrees but by accident.
    q : tuple of ndarray
        The matches there.
    consensus : Consensus
        Of these.
    least : int
        How many are needed.
    """

    count: int
    rows: NDArray[np.intp]
    copies: NDArray[np.intp]
    x1: Array
    x2: Array
    table: kernels.Table
    frame: Conditioning
    is_near: Mask
    q: tuple[Array, Array]
    consensus: Consensus
    least: int

    @staticmethod
    def of(x1: Array, x2: Array, options: dict[str, Any], least: int) -> Raw:
        """Leave out copies, and refuse too few others."""
        first = earliest(x1, x2)
        rows = np.flatnonzero(first == np.arange(len(x1)))
        if len(rows) < least:
            raise ArgumentError(
                "x1, x2", f"hold {len(rows)} different matches", f"at least {least}"
            )
        copies, m = np.searchsorted(rows, first), len(x1)
        x1, x2 = x1[rows], x2[rows]
        frame, is_near = condition_raw(x1, x2, least)
        table = kernels.table(options.get("backend"))
        q = frame.forward(x1, x2)
        consensus = Consensus(table, *q)
        return Raw(m, rows, copies, x1, x2, table, frame, is_near, q, consensus, least)

    def agreeing(self) -> Raw:
        """Return the matches that do not contradict each other, if they are enough to search."""
        kept = ~contradicted(self.x1, self.x2)
        if np.all(kept) or np.count_nonzero(kept) < _ENOUGH:
            return self
        q1, q2 = (np.ascontiguousarray(q[:, kept]) for q in self.q)
        return replace(
            self,
            rows=self.rows[kept],
            x1=self.x1[kept],
            x2=self.x2[kept],
            is_near=self.is_near[kept],
            q=(q1, q2),
            consensus=Consensus(self.table, q1, q2),
        )

    def inliers(self, agreement: Agreement, limit: float) -> Mask:
        """Return the inliers, or the least number of nearest, of which the result means nothing."""
        inlier = agreement.inliers(limit) & self.is_near
        if np.count_nonzero(inlier) < self.least:
            away = np.where(self.is_near, np.abs(agreement.signed), np.inf)
            inlier = np.zeros(len(inlier), np.bool_)
            inlier[np.argsort(away)[: self.least]] = True
        return inlier


class Fit(NamedTuple):
    """F of the inliers that stand still, in conditioned coordinates but for `refined`."""

    refined: FundamentalResult
    agreement: Agreement
    used: Mask
    inlier: Mask
    limit: float
    limit_px: float
    rounds: int
    is_open: bool


def fitted(
    raw: Raw, agreement: Agreement, limit: float, is_limited: bool, options: dict[str, Any]
) -> Fit:
    """Refine F by its inliers until they stand still, within a distance that falls with the noise.

    It does not where the caller has given it.
    """
    scale = raw.frame.scale
    inlier = raw.inliers(agreement, limit)
    known: set[bytes] = set()
    is_open = False
    while not is_open and inlier.tobytes() not in known and len(known) < _ROUNDS:
        known.add(inlier.tobytes())
        used, limit_px = inlier, limit * scale
        F0: Array | None = raw.frame.to_pixels(agreement.F)
        while True:
            chosen = of_matches(options, raw.count, raw.rows[used])
            try:
                refined = refine_fundamental(raw.x1[used], raw.x2[used], F0, **chosen)
                break
            except ArgumentError as error:
                if is_open or error.argument not in ("x1", "x2", "F0"):
                    raise
            # All that agree are in one place or on one line, and leave F open: fitted to all
            used, F0, is_open = raw.is_near, None, True
        F = raw.frame.from_pixels(refined.F)
        signed, oriented = raw.consensus.measured(F)
        agreement = replace(agreement, F=F, signed=signed, oriented=oriented)
        if not is_limited:
            limit = narrowed(limit, DEVIATIONS, agreement.signed[used])
        inlier = raw.inliers(agreement, limit)
    return Fit(refined, agreement, used, inlier, limit, limit_px, len(known), is_open)


def at_most(limit: float) -> float:
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
