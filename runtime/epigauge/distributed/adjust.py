"""Bundle adjustment by the workers of a Dask cluster."""

from __future__ import annotations

import os
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_choice, as_count
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.ties import Ties
from epigauge.cameras import AnyReconstruction, CameraModel
from epigauge.distributed.dispatch import Dispatch
from epigauge.distributed.linearizer import DistributedLinearizer
from epigauge.distributed.parts_adjust import PartsResult, adjust_parts
from epigauge.distributed.pieces import cut
from epigauge.errors import ArgumentError
from epigauge.io._common import PathLike
from epigauge.kernels import Table
from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.adjust import bundle_adjust as adjust_here
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import Loss

__all__ = ["bundle_adjust"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class Workers:
    """Where observations are evaluated: what `epigauge.bundle.backends.Elsewhere` says."""

    def __init__(self, client: Any, partitions: int | None, solver: str) -> None:
        self._dispatch, self._solver, self._partitions = Dispatch(client), solver, partitions

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
        """Return the evaluation of observations by the workers."""
        return DistributedLinearizer(
            self._dispatch,
            cut(graph, q, weights, whitening, self._partitions),
            (graph.n_views, graph.n_points, len(graph.point)),
            model,
            kernels,
            loss,
            None if ties is None else ties.used,
            float(weights.max()),
            self._solver,
            graph,
        )

    def close(self) -> None:
        """Let the workers forget everything."""
        self._dispatch.sweep()


@overload
def bundle_adjust(
    source: Tracks,
    client: Any,
    start: AnyReconstruction | None = None,
    *,
    partitions: int | None = None,
    solver: str = "auto",
    **options: Any,
) -> BundleResult: ...


@overload
def bundle_adjust(
    source: PathLike,
    client: Any,
    start: AnyReconstruction | None = None,
    *,
    solver: str = "auto",
    memory_limit: int | None = None,
    output: PathLike | None = None,
    **options: Any,
) -> PartsResult: ...


def bundle_adjust(
    source: Tracks | PathLike,
    client: Any,
    start: AnyReconstruction | None = None,
    *,
    partitions: int | None = None,
    solver: str = "auto",
    memory_limit: int | None = None,
    output: PathLike | None = None,
    **options: Any,
) -> BundleResult | PartsResult:
    """Minimise the reprojection error of cameras and points by the workers of a Dask cluster.

    Points are partitioned. Each worker builds its partitions once and keeps their points from step
    to step; what travels are cameras, costs, gradients and the partitions' blocks of the cameras'
    reduced system. They are summed in a fixed tree over partitions, of which the observations
    decide how many there are: the result is the same, to the last bit, for any number of workers.

    Parameters
    ----------
    source : Tracks, str or path
        Observations, or a folder of parts that `write_parts` has written: then no process holds
        all of them, and the client only cameras and points.
    client : distributed.Client
        Connected to a scheduler with workers that have the same epigauge installed, and that can be
        reached from here.
    start : Reconstruction, MetricReconstruction or AffineReconstruction, optional
        As in `epigauge.bundle_adjust`. Of a folder those in it by default, always calibrated ones.
    partitions : int, optional
        How many partitions; by default one for each 250,000 observations, but at least 8. Another
        number gives a result that differs by rounding. Those of a folder are its parts.
    solver : {"auto", "factor", "cg"}
        How the reduced system is solved: by a factor, computed here, or by conjugate gradients,
        whose products the workers compute. By default the first, unless it fills too much.
    memory_limit : int, optional
        Of a folder: bytes of observations that each worker holds from call to call. What is beyond
        is read anew, one partition at a time, whenever it is needed; by default nothing is. An
        observation takes about 90 bytes, a point 270.
    output : str or path, optional
        Of a folder: another one, new or empty, to write the result to, of the same form.
    **options
        All those of `epigauge.bundle_adjust` but `workers` and ``lines``. Of a folder `refine`,
        `fixed_views`, `fixed_points`, `embedded`, `schedule`, `loss`, `loss_scale_px`, `ftol`,
        `xtol`, `gtol`, `max_iter`, `backend` and `callback`.

    Returns
    -------
    BundleResult or PartsResult
        As of `epigauge.bundle_adjust`, which it equals but for rounding; of a folder without
        residuals, which would be as many as the observations.

    Raises
    ------
    ArgumentError
        If the client is none, has lost its scheduler or has no workers, if one partition loses
        worker after worker, and as of `epigauge.bundle_adjust`.
    FileFormatError
        Naming a file of the folder that is missing, cut short, changed, or of another scene.

    Notes
    -----
    A worker that dies costs a step or a few: its partitions are rebuilt elsewhere from points that
    the client fetches after each fourth step, and from the cameras of the steps since, with the
    same result. With method "covariant" and without priors points stay at the workers; otherwise
    they travel with each step, which costs time alone.

    Examples
    --------
    >>> from distributed import Client  # doctest: +SKIP
    >>> client = Client(n_workers=4, threads_per_worker=1)  # doctest: +SKIP
    >>> result = eg.distributed.bundle_adjust(tracks, client, scene)  # doctest: +SKIP
    """
    as_choice("solver", solver, ("auto", "factor", "cg"))
    if partitions is not None:
        partitions = as_count("partitions", partitions)
    if "workers" in options:
        raise ArgumentError("workers", "is given beside a client", "the client alone")
    if options.get("lines") is not None:
        needed = "none: eg.bundle_adjust adjusts lines in one process"
        raise ArgumentError("lines", "is given beside a client", needed)
    if not isinstance(source, Tracks):
        if not isinstance(source, str | os.PathLike):
            was = f"is a {type(source).__name__}"
            raise ArgumentError("source", was, "eg.Tracks(...), or a folder of write_parts")
        if partitions is not None:
            was = "is given with a folder of parts"
            raise ArgumentError("partitions", was, "none: each part is one")
        if memory_limit is not None:
            memory_limit = as_count("memory_limit", memory_limit, at_least=0)
        dispatch = Dispatch(client, memory_limit)
        given: Any = start
        try:
            return adjust_parts(source, dispatch, given, solver=solver, output=output, **options)
        finally:
            dispatch.sweep()
    for name, value in (("memory_limit", memory_limit), ("output", output)):
        if value is not None:
            raise ArgumentError(name, "is given with tracks", "none, or a folder of write_parts")
    workers = Workers(client, partitions, solver)
    try:
        there: Any = workers
        return adjust_here(source, start, workers=there, **options)
    finally:
        workers.close()
