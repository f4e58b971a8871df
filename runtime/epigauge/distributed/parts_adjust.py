"""Bundle adjustment of a folder of parts: no process holds all observations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge._arguments import as_positive
from epigauge._options import Backend, Schedule
from epigauge._options import Loss as LossName
from epigauge._results import Result
from epigauge.bundle.jobs import metric_job
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.refinement import fixed_indices, listed
from epigauge.bundle.run import minimized
from epigauge.bundle.ties import Ties
from epigauge.bundle.way import Way
from epigauge.cameras import CameraModel, MetricReconstruction, camera_model
from epigauge.distributed.dispatch import Dispatch
from epigauge.distributed.linearizer import DistributedLinearizer
from epigauge.distributed.parts import Parts
from epigauge.distributed.parts_evidence import PartsEvidence, PartsTail
from epigauge.distributed.pieces import Piece
from epigauge.distributed.write_parts import PartsWriter
from epigauge.errors import ArgumentError
from epigauge.io._common import PathLike
from epigauge.kernels import Table
from epigauge.multi_view.result import told
from epigauge.multi_view.verdicts.metric import judged_metric
from epigauge.two_view.losses import EFFICIENT, Loss, scale_of_median

__all__ = ["PartsResult", "adjust_parts"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class PartsResult(Result):
    """An adjusted scene of a folder of parts. All lengths are in pixels.

    Attributes
    ----------
    reconstruction : MetricReconstruction
        Cameras and points, these by their numbers.
    n_observations : int
        How many there are. Their residuals are nowhere all together.
    rms_px, cost, loss_scale_px, noise_px, flags, rank, n_behind, condition, weakest
        As of `BundleResult`.
    nfev, njev, nit, status, message, success, history
        As there.
    output : str or None
        The folder that the result was written to.

    Examples
    --------
    >>> found = eg.distributed.bundle_adjust("parts", client, output="found")  # doctest: +SKIP
    >>> print(found.success, found.flags, found.rms_px)  # doctest: +SKIP
    """

    reconstruction: MetricReconstruction = field(repr=False)
    n_observations: int
    rms_px: float
    cost: float
    loss_scale_px: float
    noise_px: float
    flags: tuple[str, ...]
    rank: int
    n_behind: int
    condition: float
    weakest: str
    nfev: int
    njev: int
    nit: int
    status: int
    message: str
    success: bool
    history: tuple[lm.Row, ...] = field(repr=False)
    output: str | None = None


class PartsWorkers:
    """Where the parts are evaluated: what `epigauge.bundle.backends.Elsewhere` says.

    Parameters
    ----------
    dispatch : Dispatch
        The workers.
    parts : Parts
        The folder.
    numbers : list of ndarray of int
        Numbers of the points of each part.
    solver : {"auto", "factor", "cg"}
        Whether the reduced system is factored.
    """

    def __init__(
        self, dispatch: Dispatch, parts: Parts, numbers: list[Indices], solver: str
    ) -> None:
        self._dispatch, self._parts, self._solver = dispatch, parts, solver
        self._pieces = [Piece(*own) for own in zip(numbers, parts.parts, strict=True)]
        #: What evaluates for the last loss that was asked for.
        self.last: DistributedLinearizer | None = None

    def linearizer(
        self,
        model: CameraModel,
        kernels: Table,
        graph: ObservationGraph,
        q: Array,
        weights: Array,
        loss: Loss,
        ties: Ties | None,
        whitening: Array | None,
    ) -> DistributedLinearizer:
        """Return the evaluation of the parts; there are no observations in the arguments."""
        parts, used = self._parts, None if ties is None else ties.used
        sizes = parts.n_views, parts.n_points, parts.n_observations
        order = None if self.last is None else self.last.order
        what = model, kernels, loss, used, parts.heaviest, self._solver
        self.last = DistributedLinearizer(self._dispatch, self._pieces, sizes, *what, order=order)
        return self.last


@dataclass(frozen=True)
class _NoTracks:
    """What a job asks of tracks that are elsewhere."""

    n_views: int
    n_points: int
    xy: Array = field(default_factory=lambda: np.zeros((0, 2)))
    weights: Array = field(default_factory=lambda: np.zeros(0))
    whitening: None = None


def adjust_parts(
    folder: PathLike,
    dispatch: Dispatch,
    start: MetricReconstruction | None,
    *,
    solver: str,
    output: PathLike | None = None,
    refine: str | Sequence[str] = "all",
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    embedded: bool = True,
    schedule: Schedule = "auto",
    loss: LossName = "linear",
    loss_scale_px: float | str = "auto",
    ftol: float = 1e-8,
    xtol: float = 0.0,
    gtol: float = 0.0,
    max_iter: int = 100,
    backend: Backend | None = None,
    callback: Callable[[lm.Row], object] | None = None,
    **others: Any,
) -> PartsResult:
    """Adjust the parts of a folder; see `epigauge.distributed.bundle_adjust`."""
    for name in others:
        was = "is given with a folder of parts"
        raise ArgumentError(name, was, "the default, or observations as eg.Tracks")
    way = Way(
        embedded=embedded,
        schedule=schedule,
        loss=loss,
        loss_scale_px=loss_scale_px,
        stopping=lm.Stopping(ftol=ftol, xtol=xtol, gtol=gtol, max_iter=max_iter),
        callback=callback,
    )
    parts, table = Parts.open(folder), kernels.table(backend)
    begun, numbers = parts.start()
    begun = begun if start is None else start
    fixed_views = listed("fixed_views", fixed_views)
    fixed_points = listed("fixed_points", fixed_points)
    if not isinstance(begun, MetricReconstruction):
        was = f"is a {type(begun).__name__}"
        raise ArgumentError("start", was, "an eg.MetricReconstruction, or none: the folder's")
    nothing: Any = _NoTracks(parts.n_views, parts.n_points)
    job = metric_job(
        nothing,
        begun,
        refine=refine,
        fixed_views=fixed_views,
        fixed_points=fixed_points,
        priors=None,
    )
    workers = PartsWorkers(dispatch, parts, numbers, solver)
    none = np.zeros(0, np.intp)
    graph = ObservationGraph(none, none, parts.n_views, parts.n_points)
    scale_px = 0.0
    if loss != "linear" and loss_scale_px != "auto":
        scale_px = as_positive("loss_scale_px", loss_scale_px)
    elif loss != "linear":
        model, empty = camera_model(begun.cameras.model), nothing.weights
        asked = workers.linearizer(
            model, table, graph, job.q, empty, Loss(), job.freedom.ties, None
        )
        tail = PartsTail(asked, begun.vectors, begun.X, weighted=False)
        scale_px = EFFICIENT[loss] * max(scale_of_median(tail.median, tail.count), 1e-12)
    writer = None
    if output is not None:  # which is begun when all else is known to be right
        common = parts.unit, parts.whitened, parts.names
        writer = PartsWriter.new(output, parts.n_views, *common, "output", parts.storage)
    way = replace(way, workers=workers)
    outcome, reached = minimized(job, graph, nothing.weights, table, way, Loss(loss, scale_px))
    found = job.result(reached.cameras, reached.points)
    assert isinstance(found, MetricReconstruction)
    assert workers.last is not None
    evidence = PartsEvidence(workers.last, found, parts.scale)
    known = np.zeros(parts.n_points, np.bool_)
    known[fixed_indices("fixed_points", fixed_points, parts.n_points)] = True
    free = known, job.fixes_gauge, loss == "linear"
    verdict = judged_metric(evidence, found, outcome, table, *free)
    if writer is not None:
        for part, own in zip(parts.parts, numbers, strict=True):
            writer.add(replace(part.read(), X=found.X[own]))
        writer.finish(found)
    return PartsResult(
        reconstruction=found,
        n_observations=parts.n_observations,
        rms_px=evidence.rms,
        cost=outcome.state.cost,
        loss_scale_px=scale_px,
        noise_px=parts.unit,
        nfev=outcome.nfev,
        njev=outcome.njev,
        nit=outcome.nit,
        status=outcome.status,
        history=outcome.history,
        output=None if output is None else str(Path(output)),
        **told(verdict, outcome.status),
    )
