"""Clusters of a few processes, and scenes that they adjust."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import epigauge as eg
import numpy as np


@contextmanager
def cluster(workers: int) -> Iterator[Any]:
    """Give a cluster of so many processes of one thread, without what Dask warns of."""
    import distributed

    options: dict[str, Any] = {"dashboard_address": ":0", "silence_logs": 50}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(n_workers=workers, threads_per_worker=1, **options) as found:
            yield found


def metric(model: str = "SIMPLE_RADIAL", shared: bool = True) -> tuple[Any, Any]:
    """Return a scene of a camera model on a bow, noisy, and a start that is off."""
    rng = np.random.default_rng(3)
    n, m = 12, 90
    X = rng.uniform(-1.0, 1.0, (m, 3))
    angles = np.linspace(-0.6, 0.6, n)
    R = np.zeros((n, 3, 3))
    R[:, 0, 0], R[:, 0, 2], R[:, 1, 1] = np.cos(angles), np.sin(angles), 1.0
    R[:, 2, 0], R[:, 2, 2] = -np.sin(angles), np.cos(angles)
    t = np.tile([0.0, 0.0, 5.0], (n, 1))
    params = np.array([[800.0, 320.0, 240.0, 0.02]])
    of_view = np.zeros(n, np.intp) if shared else np.arange(n)
    cameras = eg.Cameras(model, np.repeat(params, 1 if shared else n, axis=0), of_view)
    scene = eg.MetricReconstruction(R, t, X, cameras)
    seen = rng.random((m, n)) < 0.6
    seen[:, :2] = True
    point, view = np.nonzero(seen)
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = scene.project(blank) + rng.normal(0.0, 0.5, (len(view), 2))
    start = eg.MetricReconstruction(R, t, X + rng.normal(0.0, 0.02, X.shape), cameras)
    return eg.Tracks(view, point, xy), start
