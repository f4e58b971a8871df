"""Bundle adjustment of calibrated and distorted cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge.bundle.backends import linearizer_for
from epigauge.bundle.dampings import DAMPINGS
from epigauge.bundle.linearizer import PointRefinement
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.priors import Prior, Priors
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate
from epigauge.bundle.refinement import fixed_indices, refined_freedom
from epigauge.bundle.similarity import normal_frame
from epigauge.bundle.solve import System
from epigauge.cameras import Cameras, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts import BEHIND, Verdict
from epigauge.two_view.losses import Loss
from epigauge.verdicts import ordered

__all__ = ["MetricOutcome", "adjust_metric"]

Array = NDArray[np.float64]


#: Points are moved by themselves in five steps, the first nearly undamped.
REFINEMENT = PointRefinement(lam=1e-4)

#: A residual this small, of the coordinate, is rounding.
ROUNDING = 1e-14

#: Numbers of (R | t) before the intrinsics of a camera.
POSE_SIZE = 12


@dataclass(frozen=True)
class MetricOutcome:
    """Where the minimisation of a metric reconstruction ended.

    Attributes
    ----------
    reconstruction : MetricReconstruction
        In the frame of the start.
    outcome : Outcome
        Of `epigauge.lm.minimize`, in the frame that was computed in.
    verdict : Verdict
        Flags, rank, number of observations behind the cameras.
    """

    reconstruction: MetricReconstruction
    outcome: lm.Outcome[BundleState]
    verdict: Verdict


def adjust_metric(
    tracks: Tracks,
    start: MetricReconstruction,
    *,
    refine: Any = "all",
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    priors: Iterable[Prior] | None = None,
    method: str = "covariant",
    damping: str | None = None,
    embedded: bool = True,
    schedule: lm.Schedule | None = None,
    loss: Loss | None = None,
    stopping: lm.Stopping | None = None,
    workers: int = 1,
    backend: str | None = None,
    callback: Callable[[lm.Row], object] | None = None,
) -> MetricOutcome:
    """Minimise the reprojection error of a metric reconstruction, up to a similarity.

    See `epigauge.bundle_adjust` for the options. A point behind a camera keeps the residual that
    the formula of its model gives it there, as in BAL files; `n_behind` counts them.

    Raises
    ------
    ArgumentError
        On sizes other than the tracks', unknown parameters, priors on what is fixed, or nothing
        left to refine.
    """
    if (start.n_views, start.n_points) != (tracks.n_views, tracks.n_points):
        raise ArgumentError(
            "start",
            f"has {start.n_views} views and {start.n_points} points",
            f"{tracks.n_views} and {tracks.n_points}, as the tracks",
        )
    model, table = camera_model(start.cameras.model), kernels.table(backend)
    views = fixed_indices("fixed_views", fixed_views, start.n_views)
    points = fixed_indices("fixed_points", fixed_points, start.n_points)
    known = _listed(priors)
    given = Priors.of(known, start)
    freedom = refined_freedom(start, refine, views, points, known)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    weights = np.asarray(tracks.weights)
    linearizer = linearizer_for(
        model, table, graph, _measured(tracks, start), weights, loss or Loss(), workers
    )
    retract = model.kernel("retract", backend)
    # The best conditioned frame, whatever the caller's: the steps are the same in all.
    there = normal_frame(start.vectors, start.X)
    problem = BundleProblem(
        model,
        linearizer,
        lambda cameras, own: np.ascontiguousarray(retract(cameras.T, own.T).T),
        freedom,
        given.moved(there) if len(given) else None,
        REFINEMENT if embedded and (damping or method) == "covariant" else None,
        0.5 * float(np.sum(weights[:, None] * (ROUNDING * tracks.xy) ** 2)),
    )
    outcome = lm.minimize(
        problem,
        Estimate(*there.apply(start.vectors, start.X)),
        DAMPINGS[damping or method](),
        schedule or lm.Classic(),
        stopping or lm.Stopping(ftol=1e-8, xtol=0.0, gtol=0.0),
        callback,
    )
    cameras, X = there.inverse().apply(outcome.state.cameras, outcome.state.points)
    # What was fixed comes back as it was, to the last bit.
    cameras[views, :POSE_SIZE] = start.vectors[views, :POSE_SIZE]
    X[points] = start.X[points]
    found = reconstruction_of(start.cameras, cameras, X)
    return MetricOutcome(found, outcome, _judged(tracks, found, outcome))


def _judged(
    tracks: Tracks, found: MetricReconstruction, outcome: lm.Outcome[BundleState]
) -> Verdict:
    n_behind = int(np.count_nonzero(~(found.depths(tracks) > 0.0)))
    raised = ["behind the cameras"] if n_behind > BEHIND * len(tracks) else []
    system = outcome.system
    assert isinstance(system, System)
    unknowns = sum(part.size for part in system.gradients)
    return Verdict(ordered(raised), unknowns - system.model.gauge_dimension, n_behind)


def reconstruction_of(like: Cameras, cameras: Array, X: Array) -> MetricReconstruction:
    """Return a reconstruction from rows of the engine (n, 12 + k) and points (m, 3)."""
    pose = cameras[:, :POSE_SIZE].reshape(-1, 3, 4)
    first = np.unique(like.camera_of_view, return_index=True)[1]
    params = cameras[first, POSE_SIZE:]
    made = Cameras(like.model, params, like.camera_of_view)
    return MetricReconstruction(pose[:, :, :3], pose[:, :, 3], X, made)


def _listed(priors: Iterable[Prior] | None) -> list[Prior]:
    try:
        return list(priors or ())
    except TypeError:
        raise ArgumentError("priors", f"is {priors!r:.60}", "a list of priors") from None


def _measured(tracks: Tracks, start: MetricReconstruction) -> Array:
    """Return the observations (2, N); those of weight zero where the start has them.

    The least weight that keeps the equations regular must not draw towards anything wrong.
    """
    q = np.ascontiguousarray(tracks.xy.T)
    off = tracks.weights == 0.0
    if off.any():
        predicted = start.project(tracks)[off].T
        q[:, off] = np.where(np.isfinite(predicted), predicted, 0.0)
    return q
