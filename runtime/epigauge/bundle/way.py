"""How to minimise: method, gauge, damping, schedule, loss and stopping rules, checked once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from epigauge import lm
from epigauge._arguments import as_choice, as_count, as_positive
from epigauge.bundle.backends import Elsewhere
from epigauge.bundle.dampings import DAMPINGS
from epigauge.bundle.jobs import Job
from epigauge.bundle.observations import whitened
from epigauge.bundle.strategies import STRATEGIES
from epigauge.cameras import AnyReconstruction, CameraModel
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import GAUGES, Gauge
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import EFFICIENT, LOSSES, robust_scale

__all__ = ["Way", "loss_scale"]

_SCHEDULES: dict[str, Callable[[], lm.Schedule]] = {
    "classic": lm.Classic,
    "nielsen": lm.Nielsen,
    "adaptive": lm.Adaptive,
}


@dataclass(frozen=True, kw_only=True)
class Way:
    """What `bundle_adjust` was asked for that is no data; a field means what its argument does.

    Raises
    ------
    ArgumentError
        On unknown names, and a gauge beside a method that has its own.
    """

    stopping: lm.Stopping
    method: str = "covariant"
    gauge: Any = None
    gauge_mode: str = "explicit"
    damping: str | None = None
    embedded: bool = True
    schedule: str = "auto"
    loss: str = "linear"
    loss_scale_px: float | str = "auto"
    workers: int | Elsewhere = 1
    callback: Callable[[lm.Row], object] | None = None

    def __post_init__(self) -> None:
        as_choice("method", self.method, STRATEGIES)
        as_choice("gauge_mode", self.gauge_mode, ("explicit", "implicit"))
        as_choice("schedule", self.schedule, ("auto", *_SCHEDULES))
        as_choice("loss", self.loss, LOSSES)
        if self.damping is not None:
            as_choice("damping", self.damping, DAMPINGS)
        object.__setattr__(self, "gauge", _checked_gauge(self.gauge, self.method))
        if not hasattr(self.workers, "linearizer"):
            object.__setattr__(self, "workers", as_count("workers", self.workers))

    @property
    def threads(self) -> int:
        """Return how many threads of this process are to work."""
        return self.workers if isinstance(self.workers, int) else 1

    def rule(self, model: CameraModel) -> lm.Schedule:
        """Return the rule for lambda, new for each minimisation: it has a memory."""
        by_default = "classic" if model.homogeneous else "adaptive"
        return _SCHEDULES[by_default if self.schedule == "auto" else self.schedule]()


def loss_scale(way: Way, job: Job, tracks: Tracks, start: AnyReconstruction) -> float:
    """Return the scale of the loss in pixels, by default from the residuals of the start."""
    if way.loss == "linear":
        return 0.0
    if way.loss_scale_px != "auto":
        return as_positive("loss_scale_px", way.loss_scale_px)
    residuals = whitened(tracks.whitening, (tracks.xy - start.project(tracks)).T)
    every = [residuals[:, tracks.weights > 0.0]]
    for kind, rows in zip(job.kinds, job.others, strict=True):
        every.append(job.scale_px * kind.residuals(job.cameras, rows))
    sizes = np.linalg.norm(np.concatenate(every, axis=1), axis=0)
    return EFFICIENT[way.loss] * max(robust_scale(sizes), 1e-12)


def _checked_gauge(gauge: Any, method: str) -> Gauge | None:
    """Return a gauge given to a method; a class takes its defaults."""
    strategy = STRATEGIES[method]
    if gauge is not None and (strategy.gauge is not None or strategy.reference):
        raise ArgumentError("gauge", f"is given with method={method!r}", "a method without its own")
    if isinstance(gauge, type) and issubclass(gauge, GAUGES):
        gauge = gauge()
    if gauge is not None and (isinstance(gauge, type) or not hasattr(gauge, "transformation")):
        raise ArgumentError("gauge", f"is {gauge!r}", "a gauge, such as eg.gauge.normalized()")
    found: Gauge | None = gauge
    return found
