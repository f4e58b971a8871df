"""The same minimisation by the compiled loop: for charts of F alone, and whole pairs in pixels.

`solve`, `eliminated` and `lm` are the readable reference; tests compare both row by row of the
history. What the compiled loop does not know is left to them: MAPS, covariances of the
points, joint structure.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._library import address, library
from epigauge._native import check_sizes
from epigauge.two_view.conditioning import OFFSET, RMS, Conditioning
from epigauge.two_view.essential import Essential
from epigauge.two_view.losses import LOSSES
from epigauge.two_view.parameterizations import (
    Block,
    BlockF,
    Ortho,
    OrthonormalF,
    Parameterization,
    Reduced,
    Remapped,
)

__all__ = [
    "Minimum",
    "Pair",
    "PairOptions",
    "minimize",
    "pair_options",
    "refine_pairs",
    "supports",
]

Array = NDArray[np.float64]

#: Numbers of the choices in runtime/c/two_view.h.
_CRITERIA = {"reprojection": 0, "sampson": 1, "epipolar": 2}
_CHARTS = {Ortho: 0, Block: 1, Essential: 2}

#: Widths of the tables that C fills: history, results and numbers of a pair.
_ROW, _DOUBLES, _INTS = 6, 145, 5


class _Options(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("criterion", "chart", "loss", "exact", "scaled")),
        ("max_iter", ctypes.c_int),
        *((name, ctypes.c_double) for name in ("loss_scale2", "ftol", "xtol", "gtol")),
        *((name, ctypes.c_double) for name in ("rms", "offset")),
    )


class _Outcome(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("nfev", "njev", "nit", "status", "current")),
        ("cost", ctypes.c_double),
        *((name, ctypes.c_double * n) for name, n in (("gradient", 7), ("hessian", 49))),
        *((name, ctypes.c_double * n) for name, n in (("diagonal", 7), ("bend", 343))),
        *((name, ctypes.c_double * n) for name, n in (("normal", 81), ("F", 9))),
    )


@cache
def _functions() -> tuple[Any, Any]:
    check_sizes({"eg_options": _Options, "eg_outcome": _Outcome})
    pointer, size = ctypes.c_void_p, ctypes.c_ssize_t
    one, many = library().eg_minimize_matches, library().eg_refine_pairs
    one.argtypes = [size, *[pointer] * 4, ctypes.c_int, *[pointer] * 5]
    many.argtypes = [size, size, *[pointer] * 10]
    return one, many


@dataclass(frozen=True)
class Minimum:
    """What `lm.Outcome.state` holds after the compiled loop; there is no `.system`."""

    motion: Any
    F: Array
    cost: float


def supports(criterion: str, chart: Parameterization) -> bool:
    """Tell whether the compiled loop knows a criterion and a parameterisation."""
    return criterion in _CRITERIA and _parts(chart) is not None


def _parts(chart: Any) -> tuple[int, Array | None, Array | None] | None:
    """Return kind, basis (7 or 5, p) and map of entries (9, 9) of a chart."""
    entries = None
    if isinstance(chart, Remapped):
        entries, chart = chart.entries, chart.inner
    basis = None
    if isinstance(chart, Reduced):
        basis, chart = chart.basis, chart.inner
    kind = _CHARTS.get(type(chart))
    return None if kind is None else (kind, basis, entries)


def minimize(
    chart: Parameterization,
    start: Any,
    matches: tuple[Array, Array, Array],
    choices: tuple[str, str, str, bool],
    loss_scale: float,
    stopping: lm.Stopping,
    scale: float,
    *,
    at_most: int | None = None,
) -> lm.Outcome[Any]:
    """Minimise over conditioned matches, as `lm.minimize` does with an `EliminatedProblem`.

    Parameters
    ----------
    chart : Parameterization
        One that `supports` accepts, with its criterion.
    start : OrthonormalF or BlockF
        Where to begin.
    matches : tuple of ndarray, shape (2, m), (2, m), (m,)
        Both images and the weights, contiguous.
    choices : tuple of str, str, str, bool
        Criterion, loss, damping, and whether the Hessian is exact.
    loss_scale, stopping, scale
        Scale of the loss in the unit of the matches; the others as in `lm.minimize`.
    at_most : int, optional
        Trial steps, in place of those of `stopping`; may be zero.

    Returns
    -------
    lm.Outcome
        Its state is a `Minimum`.
    """
    parts = _parts(chart)
    assert parts is not None
    kind, basis, entries = parts
    criterion, loss, damping, exact = choices
    options = _options(criterion, kind, loss, exact, damping, loss_scale, stopping)
    options.max_iter = stopping.max_iter if at_most is None else at_most
    motion = np.zeros(22)
    packed = np.concatenate([np.ravel(part) for part in start])
    motion[: len(packed)] = packed
    history = np.empty((options.max_iter + 1, _ROW))
    outcome = _Outcome()
    p = chart.dimension
    q1, q2, weights = matches
    basis = None if basis is None else np.ascontiguousarray(basis)
    entries = None if entries is None else np.ascontiguousarray(entries)
    done = _functions()[0](
        q1.shape[1],
        *map(address, (q1, q2, weights)),
        ctypes.addressof(options),
        p,
        *map(address, (basis, entries, motion, history)),
        ctypes.addressof(outcome),
    )
    if not done:
        raise MemoryError(f"no room for {q1.shape[1]} matches")
    U, V, rest = motion[:9].reshape(3, 3), motion[9:18].reshape(3, 3), motion[18:]
    found = OrthonormalF(U, V, np.asarray(rest[0]))
    state = Minimum(
        BlockF(U, V, rest.reshape(2, 2)) if kind == _CHARTS[Block] else found,
        np.array(outcome.F).reshape(3, 3),
        outcome.cost,
    )
    rows = lm.rows(history[: outcome.nfev], scale)
    counts = (outcome.nfev, outcome.njev, outcome.nit, outcome.status)
    return lm.Outcome(state, None, *counts, rows)


def _options(
    criterion: str,
    kind: int,
    loss: str,
    exact: bool,
    damping: str,
    loss_scale: float,
    stopping: lm.Stopping,
) -> _Options:
    return _Options(
        _CRITERIA[criterion],
        kind,
        LOSSES.index(loss),
        exact,
        damping == "seber",
        stopping.max_iter,
        loss_scale**2,
        stopping.ftol,
        stopping.xtol,
        stopping.gtol,
        RMS,
        OFFSET,
    )


@dataclass(frozen=True)
class PairOptions:
    """Options that pairs in pixels are refined with."""

    structure: _Options
    max_iter: int


def pair_options(
    criterion: str, exact: bool, damping: str, stopping: lm.Stopping
) -> PairOptions | None:
    """Return the options of the orthonormal representation with the linear loss.

    None where the compiled loop does not know the criterion.
    """
    if criterion not in _CRITERIA:
        return None
    structure = _options(criterion, 0, "linear", exact, damping, 0.0, stopping)
    return PairOptions(structure, stopping.max_iter)


@dataclass(frozen=True)
class Pair:
    """Results of refined pairs, one row a pair: views of the table that C fills.

    Attributes
    ----------
    table : ndarray, shape (n, 145)
        As the offsets PAIR_... in runtime/c/pairs.c.
    numbers : ndarray of int, shape (n, 5)
        Whether the pair was left to the reference; nfev, njev, nit, status.
    distances : ndarray, shape (m,)
        Signed distances in pixels.
    history : ndarray, shape (k, 6)
        Of a single pair.
    """

    table: Array
    numbers: NDArray[np.intc]
    distances: Array
    history: Array

    def frame(self, k: int) -> Conditioning:
        """Return the coordinates that pair k was computed in."""
        x1, y1, x2, y2, scale = self.table[k, 31:36].tolist()
        return Conditioning(np.array([x1, y1]), np.array([x2, y2]), scale)

    def motion(self, k: int) -> OrthonormalF:
        """Return the orthonormal representation of pair k in conditioned coordinates."""
        U, V = self.table[k, 36:54].reshape(2, 3, 3)
        return OrthonormalF(U, V, np.asarray(self.table[k, 54]))


def refine_pairs(
    x1: Array,
    x2: Array,
    offsets: NDArray[np.intp],
    F0: Array | None,
    weights: Array | None,
    options: PairOptions,
    *,
    history: bool = False,
) -> Pair:
    """Refine pairs in pixels: conditioning, start value, minimum, and back.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Contiguous; may hold anything: a pair that is not plainly in order is left alone.
    offsets : ndarray of intp, shape (n + 1,)
        Pair k has the matches ``offsets[k]:offsets[k + 1]``.
    F0 : ndarray, shape (n, 3, 3), or None
        Start values; the 8-point estimates if None.
    weights : ndarray, shape (m,), or None
        Not negative; ones if None.
    options : PairOptions
        How.
    history : bool
        Record the history of a single pair.

    Returns
    -------
    Pair
        Tables.
    """
    n = len(offsets) - 1
    table = np.empty((n, _DOUBLES))
    numbers = np.empty((n, _INTS), dtype=np.intc)
    distances = np.empty(len(x1))
    rows = np.empty((options.max_iter + 1 if history else 0, _ROW))
    done = _functions()[1](
        0,
        n,
        *map(address, (offsets, x1, x2, weights, F0)),
        ctypes.addressof(options.structure),
        *map(address, (table, numbers, distances, rows if history else None)),
    )
    if not done:
        raise MemoryError(f"no room for {len(x1)} matches")
    return Pair(table, numbers, distances, rows)
