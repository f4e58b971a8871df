"""A start in which projective cameras have images of their points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.jobs import Job
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.kernels import Table
from epigauge.multi_view.resection import resect

__all__ = ["seeing"]

#: A depth this small, of camera and point of unit norm, is rounding.
_BLIND = 1e-12


def seeing(job: Job, graph: ObservationGraph, kernels: Table, at: Estimate) -> Estimate:
    """Return an estimate in which projective cameras have images of their points.

    A camera that is blind for all its points is resected from them; then a point that a camera is
    still blind for is intersected anew.
    """
    view, point = graph.view, graph.point
    cameras, points = at.cameras.copy(), at.points.copy()

    def blind() -> NDArray[np.bool_]:
        """Tell which observations are of points in the focal plane of their camera."""
        planes, seen = cameras[view, 8:], points[point]
        sizes = np.linalg.norm(cameras, axis=1)[view] * np.linalg.norm(seen, axis=1)
        return np.asarray(np.abs(np.einsum("ki,ki->k", planes, seen)) <= _BLIND * sizes)

    unseen = np.bincount(view[~blind()], minlength=len(cameras)) == 0
    for i in np.flatnonzero(unseen):
        rows = np.flatnonzero(view == i)
        cameras[i] = resect(kernels, job.q[:, rows], points[point[rows]].T).ravel()
    for j in np.unique(point[blind()]):
        rows = np.flatnonzero(point == j)
        P, q = cameras[view[rows]].reshape(-1, 3, 4), job.q[:, rows].T
        sights = q[:, :, None] * P[:, 2:] - P[:, :2]
        points[j] = np.linalg.svd(sights.reshape(-1, 4))[2][3]
    return replace(at, cameras=cameras, points=points)
