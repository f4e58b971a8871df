"""Metric scenes and what is free in them, for tests of the engine."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import many_views
import numpy as np
from epigauge import kernels
from epigauge.bundle.jobs import metric_job
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.similarity import Similarity
from epigauge.rotations import from_rodrigues


def scene(
    model: str = "SIMPLE_RADIAL",
    params: Any = ((1000.0, 320.0, 240.0, -0.1),),
    camera_of_view: Any = (0, 0, 0, 0),
    m: int = 25,
    seed: int = 0,
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return tracks with a noise of one pixel, and a start near the truth."""
    rng = np.random.default_rng(seed)
    n = len(camera_of_view)
    truth = many_views.cameras_and_points(n, m, seed=seed)
    K = np.array([[1000.0, 0.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]])
    pose = np.linalg.solve(K, truth.P)
    cameras = eg.Cameras(model, params, camera_of_view)
    right = eg.MetricReconstruction(pose[:, :, :3], pose[:, :, 3], truth.Q[:, :3], cameras)
    view, point = np.tile(np.arange(n), m), np.repeat(np.arange(m), n)
    xy = right.project(eg.Tracks(view, point, np.zeros((n * m, 2))))
    tracks = eg.Tracks(view, point, xy + rng.standard_normal(xy.shape))
    X = right.X + 0.02 * rng.standard_normal(right.X.shape)
    t = right.t + 0.02 * rng.standard_normal(right.t.shape)
    return tracks, eg.MetricReconstruction(right.R, t, X, cameras)


def problem_of(
    tracks: eg.Tracks, start: eg.MetricReconstruction, backend: str | None = None, **options: Any
) -> tuple[BundleProblem, BundleState]:
    asked = {"refine": "all", "fixed_views": (), "fixed_points": (), "priors": None, **options}
    job = metric_job(tracks, start, **asked)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    problem = bundle_problem(
        job.model,
        kernels.table(backend),
        graph,
        job.q,
        np.array(tracks.weights),
        freedom=job.freedom,
        priors=job.priors,
    )
    return problem, problem.evaluate(Estimate(job.cameras, job.points))


COVARIANCE = np.array([[2e-4, 1e-4, 0.0], [1e-4, 3e-4, -1e-4], [0.0, -1e-4, 1e-4]])
PRIORS = [
    eg.PositionPrior(1, (-1.5, 0.1, -10.0), sigma=(0.01, 0.02, 0.05)),
    eg.PositionPrior(3, (4.5, 0.1, -10.0), covariance=COVARIANCE),
    eg.IntrinsicPrior(0, "f", 1010.0, 5.0),
    eg.PointPrior(4, (0.1, 0.2, 0.0), covariance=COVARIANCE),
    eg.RotationPrior(2, from_rodrigues(np.array([0.1, -0.2, 0.3])), covariance=COVARIANCE),
    eg.RotationPrior(3, from_rodrigues(np.array([1.5, 1.2, -2.3])), sigma=(0.01, 0.02, 0.03)),
]
SHARED = {"params": [[1000.0, 320.0, 240.0, -0.1]] * 2, "camera_of_view": (0, 0, 1, 1)}
LONE = {"params": [[1000.0, 320.0, 240.0, -0.1]] * 3, "camera_of_view": (0, 0, 1, 2)}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "all": ({}, {}),
    "groups": (SHARED, {"refine": ("f", "k")}),
    "groups and lone views": (LONE, {"refine": ("k", "cx")}),
    "pose": ({}, {"refine": "pose"}),
    "fixed": (LONE, {"refine": ("f",), "fixed_views": [0, 3], "fixed_points": [2, 7, 8]}),
    "priors": (SHARED, {"refine": ("f", "k"), "priors": PRIORS}),
    "priors and fixed": (SHARED, {"fixed_views": [0], "fixed_points": [1], "priors": PRIORS}),
}


def similarity(seed: int, size: float = 1.0) -> Similarity:
    """Return a random similarity: scale 1e-3 to 1e3, origin up to 1e5 scene radii away."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    s, far = 10.0 ** rng.uniform(-3, 3), rng.standard_normal(3)
    far *= s * size * 10.0 ** rng.uniform(0, 5) / np.linalg.norm(far)
    made: Similarity = eg.gauge.similarity(s, Q * np.sign(np.linalg.det(Q)), far)
    return made
