"""The same minimisation by the compiled loop: nothing of Python between the parts of a step.

`lm.minimize` over a `BundleProblem` is the reference; tests compare both row by row. What the
compiled loop does not know is left to it: callbacks, ties, priors, gauges, other dampings and
schedules, reduced systems too large to be factored.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._library import address
from epigauge._native import BundleOptions, NormalArrays, checked, function
from epigauge.bundle.dampings import START, START_METRIC, Covariant
from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import Normal
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.cameras import MAX_FOCAL, MIN_FOCAL

if TYPE_CHECKING:
    from epigauge.bundle.problem import BundleProblem, Estimate

__all__ = ["Minimum", "minimized"]

Array = NDArray[np.float64]

#: With so few observations, no run keeps Ctrl-C waiting for long.
_QUICK = 5000

#: Schedules that the compiled loop has.
_SCHEDULES = lm.Classic(), lm.Adaptive()


class Minimum(NamedTuple):
    """Where the compiled loop ended.

    `normal` are the normal equations there, None where cameras go by their factors; `counts` are
    nfev, njev, nit and status.
    """

    cameras: Array
    points: Array
    cost: float
    normal: Normal | None
    counts: tuple[int, int, int, int]
    history: tuple[lm.Row, ...]


def minimized(
    problem: BundleProblem,
    start: Estimate,
    damping: Any,
    schedule: Any,
    stopping: lm.Stopping,
    scale: float,
    lam_floor: float,
) -> Minimum | None:
    """Minimise as `lm.minimize` does; None where the compiled loop does not know all parts."""
    own = problem.linearizer
    if not (isinstance(own, NativeLinearizer) and _known(problem, own, damping, schedule)):
        return None
    assert problem.refinement is not None
    skyline, (n, d), (m, b) = own.skyline, (own.skyline.n, own.width), start.points.shape
    cameras = own.layout.inward(start.cameras).copy()
    # In the order of the passes points are found faster.
    order, lanes = own.layout.points, own.layout.lane_by_lane
    points, bundle = start.points.take(order, axis=0), own.layout.bundle(own.loss)
    bundle.point = address(lanes)
    focal = np.array([12 + k for k in problem.model.focal], np.int32)
    stop = ctypes.c_int(0)
    passes, pairs = own.passes.edges
    options = BundleOptions(
        own.refinement(problem.refinement),
        stopping.ftol,
        stopping.xtol,
        stopping.gtol,
        START_METRIC if problem.model.metric else START,
        lam_floor,
        problem.floor,
        stopping.max_iter,
        address(focal),
        len(focal),
        MIN_FOCAL,
        MAX_FOCAL,
        own.passes.share,
        len(passes) - 1,
        len(pairs) - 1,
        address(passes),
        address(pairs),
        ctypes.addressof(stop),
        type(schedule) is lm.Adaptive,
    )
    blocks = np.empty((n, d, d)), np.empty((m, b, b)), np.empty((n, d)), np.empty((m, b))
    filled = NormalArrays(*map(address, blocks))
    history = np.empty((stopping.max_iter + 1, len(lm.Row.__dataclass_fields__)))
    cost, counts = ctypes.c_double(), np.zeros(4, np.intp)
    panels = skyline.panels(own.width)

    def run() -> int:
        return int(
            function("bundle_minimize")(
                ctypes.byref(bundle),
                skyline.reference,
                panels.reference,
                ctypes.addressof(options),
                *map(address, (cameras, points)),
                ctypes.addressof(filled),
                address(history),
                ctypes.addressof(cost),
                address(counts),
            )
        )

    quick = len(own.graph.point) <= _QUICK
    checked(run() if quick else _interruptible(run, stop))
    nfev, njev, nit, status = counts.tolist()
    rows = lm.rows(history[:nfev], scale)
    points, normal = _put(order, points), None
    if not own.factored:
        V, g_points = (_put(order, array) for array in (blocks[1], blocks[3]))
        normal = own.normal(cameras, points, blocks[0], V, blocks[2], g_points)
    found = own.layout.outward(cameras)
    return Minimum(found, points, cost.value, normal, (nfev, njev, nit, status), rows)


def _put(order: NDArray[np.intp], rows: Array) -> Array:
    result = np.empty_like(rows)
    result[order] = rows
    return result


def _interruptible(run: Callable[[], int], stop: ctypes.c_int) -> int:
    """Return what `run` does in a thread of its own; Ctrl-C sets `stop` and waits for its end."""
    with ThreadPoolExecutor(1) as pool:  # leaving it waits
        pending = pool.submit(run)
        try:
            return pending.result()
        except BaseException:
            stop.value = 1
            raise


def _known(problem: BundleProblem, own: NativeLinearizer, damping: Any, schedule: Any) -> bool:
    ties, model = problem.freedom.ties, problem.model
    free = type(problem.freedom) is Freedom and problem.freedom.kept is None
    free = free and ties.E is None and ties.C is None
    if free and ties.A is not None:
        used = slice(None) if ties.used is None else ties.used
        moved, one = ties.A[:, used], np.eye(own.width)
        free = moved.shape[1:] == one.shape and bool((moved == one).all())
    return (
        free
        and (model.metric or own.factored)
        and problem.priors is None
        and not problem.kinds
        and problem.refinement is not None
        and type(damping) is Covariant
        and schedule in _SCHEDULES
        and own.direct
    )
