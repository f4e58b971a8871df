"""The same minimisation by the compiled loop, for problems so small that Python's share would rule.

`lm.minimize` over a `BundleProblem` is the reference; tests compare both row by row. What the
compiled loop does not know is left to it: callbacks, ties, priors, gauges, other dampings and
schedules, threads.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._library import address
from epigauge._native import BundleOptions, checked, function
from epigauge.bundle.dampings import START, START_METRIC, Covariant
from epigauge.bundle.freedom import Freedom
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.cameras import MAX_FOCAL, MIN_FOCAL

if TYPE_CHECKING:
    from epigauge.bundle.problem import BundleProblem, Estimate

__all__ = ["minimized"]

Array = NDArray[np.float64]

#: Most observations: with these, no run keeps Ctrl-C waiting for long.
_MOST = 5000


def minimized(
    problem: BundleProblem,
    start: Estimate,
    damping: Any,
    schedule: Any,
    stopping: lm.Stopping,
    scale: float,
    lam_floor: float,
) -> tuple[Array, Array, float, int, tuple[int, int, int, int], tuple[lm.Row, ...]] | None:
    """Minimise as `lm.minimize` does; None where the compiled loop does not know all parts.

    Returns
    -------
    tuple
        Cameras, points, cost, accepted steps, (nfev, njev, nit, status), history.
    """
    own = problem.linearizer
    if not (isinstance(own, NativeLinearizer) and _known(problem, own, damping, schedule)):
        return None
    assert problem.refinement is not None
    skyline, metric = own.skyline, problem.model.metric
    cameras = own.layout.inward(start.cameras).copy()
    points = np.array(start.points, order="C")
    focal = np.array([12 + k for k in problem.model.focal], np.int32)
    options = BundleOptions(
        own.refinement(problem.refinement),
        stopping.ftol,
        stopping.xtol,
        stopping.gtol,
        START_METRIC if metric else START,
        lam_floor,
        problem.floor,
        stopping.max_iter,
        address(focal),
        len(focal),
        MIN_FOCAL,
        MAX_FOCAL,
    )
    history = np.empty((stopping.max_iter + 1, len(lm.Row.__dataclass_fields__)))
    cost, counts = ctypes.c_double(), np.zeros(4, np.intp)
    panels = skyline.panels(own.width)
    checked(
        function("bundle_minimize")(
            own.reference,
            skyline.reference,
            panels.reference,
            ctypes.addressof(options),
            *map(address, (cameras, points, history)),
            ctypes.addressof(cost),
            address(counts),
        )
    )
    nfev, njev, nit, status = counts.tolist()
    rows = lm.rows(history[:nfev], scale)
    steps = sum(row.accepted for row in rows) - 1
    found = own.layout.outward(cameras)
    return found, points, cost.value, steps, (nfev, njev, nit, status), rows


def _known(problem: BundleProblem, own: NativeLinearizer, damping: Any, schedule: Any) -> bool:
    ties, model = problem.freedom.ties, problem.model
    free = type(problem.freedom) is Freedom and problem.freedom.kept is None
    free = free and ties.E is None and ties.C is None
    if free and ties.A is not None:
        used = slice(None) if ties.used is None else ties.used
        free = ties.A.shape[2] == own.width and bool((ties.A[:, used] == np.eye(own.width)).all())
    return (
        free
        and (model.metric or own.factored)
        and problem.priors is None
        and problem.refinement is not None
        and type(damping) is Covariant
        and type(schedule) is lm.Classic
        and schedule.factor == lm.Classic().factor
        and own.direct
        and own.alone
        and len(own.graph.point) <= _MOST
    )
