"""Which linearizer evaluates a problem: the fastest that the back end offers for its camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.linearizer import Linearizer
from epigauge.bundle.native_linearizer import NativeLinearizer
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.ties import Ties
from epigauge.cameras import CameraModel
from epigauge.kernels import Table
from epigauge.two_view.losses import Loss

__all__ = ["Elsewhere", "linearizer_for"]

Array = NDArray[np.float64]


class Elsewhere(Protocol):
    """Processes that observations are evaluated by, instead of this one."""

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
    ) -> Linearizer:
        """Return what evaluates observations there; arguments as of `linearizer_for`."""


def linearizer_for(
    model: CameraModel,
    kernels: Table,
    graph: ObservationGraph,
    q: Array,
    weights: Array,
    loss: Loss,
    workers: int | Elsewhere = 1,
    ties: Ties | None = None,
    whitening: Array | None = None,
    beside: Sequence[ObservationGraph] = (),
) -> Linearizer:
    """Return what evaluates observations of cameras of a model.

    Parameters
    ----------
    model : CameraModel
        The camera.
    kernels : Table
        Back end.
    graph : ObservationGraph
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Measurements.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    loss : Loss
        Applied to each squared residual.
    workers : int or Elsewhere
        Threads to use where the back end can, or other processes.
    ties : Ties, optional
        What own tangents are made of: entries of a camera's that are always zero need no work.
    whitening : ndarray, shape (2, 2, N), optional
        What residuals are multiplied by; the compiled evaluation knows none.
    beside : sequence of ObservationGraph
        Those of features of other kinds, which take off the same cameras' blocks.
    """
    if not isinstance(workers, int):
        assert not beside
        return workers.linearizer(model, kernels, graph, q, weights, loss, ties, whitening)
    if kernels.compiled and whitening is None:
        used = None if ties is None else ties.used
        parts = graph, q, weights, loss, workers, used
        return NativeLinearizer(model, *parts, beside=beside)
    return NumpyLinearizer(model, kernels, graph, q, weights, loss, whitening)
