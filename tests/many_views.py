"""What the tests of the many-view part share: simulated scenes, random bases, real tracks, N."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import PointRefinement
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem, BundleState, Estimate
from epigauge.bundle.run import REFINEMENT, bundle_problem
from epigauge.bundle.solve import BundleSystem, Step, System
from epigauge.cameras import camera_model
from epigauge.kernels import Table
from epigauge.multi_view.gauge import Transformation
from epigauge.two_view.losses import Loss
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cameras_and_points(
    n: int = 5, m: int = 100, *, flatness: float = 0.5, seed: int = 0
) -> eg.Reconstruction:
    """Return the truth of B03 section 7.1: cameras 10 m from a cube of 1 m, 3 m from each other.

    `flatness` is the points' mean distance from the base plane, which faces the cameras.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (m, 3))
    points[:, 2] = flatness * (2.0 * rng.uniform(0.0, 1.0, m) - 1.0)
    cameras = []
    for i in range(n):
        centre = np.array([3.0 * (i - (n - 1) / 2), rng.uniform(-1.0, 1.0), -10.0])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[1000.0, 0.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]])
        cameras.append(K @ np.column_stack([R, -R @ centre]))
    return eg.Reconstruction(np.stack(cameras), np.column_stack([points, np.ones(m)]))


def observed(
    truth: eg.Reconstruction, noise_px: float = 1.0, *, seen: float = 1.0, seed: int = 0
) -> eg.Tracks:
    """Return noisy observations of points in views, a share `seen` of them, none too few."""
    rng = np.random.default_rng(1000 + seed)
    n, m = len(truth.P), len(truth.Q)
    visible = rng.uniform(size=(m, n)) < seen
    visible[np.arange(m), np.arange(m) % n] = True
    visible[np.arange(m), (np.arange(m) + 1) % n] = True
    point, view = np.nonzero(visible)
    h = np.einsum("kij,kj->ki", truth.P[view], truth.Q[point])
    xy = h[:, :2] / h[:, 2:]
    return eg.Tracks(view, point, xy + noise_px * rng.standard_normal(xy.shape))


def with_gross_errors(
    tracks: eg.Tracks, share: float = 0.05, *, size_px: float = 30.0, seed: int = 0
) -> tuple[eg.Tracks, NDArray[np.bool_]]:
    """Return tracks with gross errors in a share of the rows, and which rows are good."""
    rng = np.random.default_rng(2000 + seed)
    good = np.ones(len(tracks), dtype=np.bool_)
    good[rng.choice(len(tracks), round(share * len(tracks)), replace=False)] = False
    xy = tracks.xy.copy()
    angle = rng.uniform(0.0, 2.0 * np.pi, len(tracks))
    error = size_px * rng.uniform(1.0, 3.0, len(tracks))[:, None]
    xy[~good] += (error * np.column_stack([np.cos(angle), np.sin(angle)]))[~good]
    return eg.Tracks(tracks.view, tracks.point, xy), good


def shaken(
    reconstruction: eg.Reconstruction, size: float = 0.01, *, seed: int = 0
) -> eg.Reconstruction:
    """Return another geometry nearby: relative noise in every camera row and point."""
    rng = np.random.default_rng(3000 + seed)
    P, Q = reconstruction.P, reconstruction.Q
    P = P + size * np.abs(P).mean(axis=2, keepdims=True) * rng.standard_normal(P.shape) * 1e-2
    return eg.Reconstruction(P, Q + size * rng.standard_normal(Q.shape))


def basis(rng: np.random.Generator, condition: float) -> Array:
    """Return a random (4, 4) matrix of a given condition."""
    U, V = (np.linalg.qr(rng.standard_normal((4, 4)))[0] for _ in range(2))
    return np.asarray(U * np.geomspace(1.0, condition, 4) @ V)


def gauge_change(
    rng: np.random.Generator, n: int, m: int, condition: float = 10.0
) -> Transformation:
    """Return a random T~: basis of a given condition, scales of both signs over a decade."""
    gamma, alpha = (np.exp(rng.uniform(-1.1, 1.1, k)) * rng.choice([-1.0, 1.0], k) for k in (n, m))
    return Transformation(basis(rng, condition), gamma, alpha)


def changed(change: Transformation, reconstruction: eg.Reconstruction) -> eg.Reconstruction:
    """Return a reconstruction in another gauge."""
    return eg.Reconstruction(*change.apply(reconstruction.P, reconstruction.Q))


def real_tracks(data_dir: Path, name: str) -> eg.Tracks:
    """Return the tracks of a measured set."""
    with np.load(data_dir / name / "tracks.npz") as z:
        return eg.Tracks(z["view"], z["point"], z["xy"])


# ---------------------------------------------------------------- inside the solver


@dataclass
class Problem:
    """The projective problem, with cameras (n, 3, 4) as the tests speak of them."""

    kernels: Table
    graph: ObservationGraph
    q: Array
    weights: Array
    loss: Loss = field(default_factory=Loss)
    embedded: bool = False
    workers: int = 1
    freedom: Freedom = field(default_factory=Freedom)

    @property
    def inner(self) -> BundleProblem:
        """Return the problem that the solver minimises."""
        return bundle_problem(
            camera_model("projective"),
            self.kernels,
            self.graph,
            self.q,
            self.weights,
            self.loss,
            embedded=self.embedded,
            workers=self.workers,
            freedom=self.freedom,
        )

    def evaluate(self, estimate: tuple[Array, Array]) -> State:
        """Return the state of cameras and points."""
        P, Q = estimate
        return State(P, Q, self.inner.evaluate(Estimate(P.reshape(-1, 12), Q)).cost, self)

    def linearize(self, state: State) -> BundleSystem:
        """Return the normal equations."""
        return self.inner.linearize(state.inner)

    def retract(self, state: State, step: Array | Step) -> tuple[Array, Array]:
        """Return where a step leads, a vector of all own tangents or what a damping makes."""
        if not isinstance(step, Step):
            cameras, points = step[: state.P.size], step[state.P.size :]
            step = Step(cameras.reshape(-1, 12), points.reshape(-1, 4), 0.0)
        moved = self.inner.retract(state.inner, step)
        return moved.cameras.reshape(-1, 3, 4), moved.points

    def point_costs(self, P: Array, Q: Array) -> Array:
        """Return the weighted robust sum of each point, (m,)."""
        return self.inner.linearizer.point_costs(P.reshape(-1, 12), Q)

    def triangulated(self, P: Array, Q: Array, how: PointRefinement = REFINEMENT) -> Array:
        """Return the points after iterations of their own."""
        return self.inner.linearizer.refine_points(P.reshape(-1, 12), Q, how)[0]


@dataclass
class State:
    """Cameras and points with their cost."""

    P: Array
    Q: Array
    cost: float
    problem: Problem

    @property
    def inner(self) -> BundleState:
        """Return the state that the solver knows."""
        return BundleState(Estimate(self.P.reshape(-1, 12), self.Q), self.cost)

    @property
    def r(self) -> Array:
        """Return the residuals q - q_hat, (2, N)."""
        return self.problem.inner.linearizer.residuals(self.P.reshape(-1, 12), self.Q)

    @property
    def J_P(self) -> Array:
        """Return the Jacobians of q_hat by the camera, (2, 12, N)."""
        return self.reference.observe(self.P.reshape(-1, 12), self.Q)[1]

    @property
    def J_Q(self) -> Array:
        """Return the Jacobians of q_hat by the point, (2, 4, N)."""
        return self.reference.observe(self.P.reshape(-1, 12), self.Q)[2]

    @property
    def reference(self) -> NumpyLinearizer:
        """Return the evaluation observation by observation."""
        own = self.problem
        parts = own.kernels, own.graph, own.q, own.weights, own.loss
        return NumpyLinearizer(camera_model("projective"), *parts)

    @property
    def root(self) -> Array:
        """Return the root of each observation's weight, that of the robust loss included, (N,)."""
        return np.sqrt(self.reference.weights_at(self.r))


def problem_of(
    tracks: eg.Tracks, *, embedded: bool = False, loss: Loss | None = None, scale: float = 1000.0
) -> Problem:
    """Return the problem with image coordinates in units of `scale` pixels."""
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    q = np.ascontiguousarray(tracks.xy.T / scale)
    return Problem(kernels.table(), graph, q, np.array(tracks.weights), loss or Loss(), embedded)


def in_units(reconstruction: eg.Reconstruction, scale: float = 1000.0) -> tuple[Array, Array]:
    """Return cameras and points for `problem_of`, in the well-conditioned normalised basis."""
    P = np.diag([1.0 / scale, 1.0 / scale, 1.0]) @ reconstruction.P
    return eg.gauge.normalized().transformation(P, reconstruction.Q).apply(P, reconstruction.Q)


def small_system(
    n: int = 4, m: int = 20, *, seen: float = 0.7, seed: int = 0, noise_px: float = 3.0
) -> tuple[Problem, State, BundleSystem]:
    """Return a problem small enough for dense algebra, a state away from its minimum, and N, g."""
    truth = cameras_and_points(n, m, seed=seed)
    problem = problem_of(observed(truth, noise_px, seen=seen, seed=seed))
    state = problem.evaluate(in_units(shaken(truth, seed=seed)))
    return problem, state, problem.linearize(state)


def whole_ties(system: System) -> Array:
    """Return the matrix from all unknowns, x, s and y, to all own tangents."""
    (n, d), (m, b) = system.normal.g_cameras.shape, system.normal.g_points.shape
    ties = system.ties
    A = np.broadcast_to(np.eye(d), (n, d, d)) if ties.A is None else ties.A
    C = np.broadcast_to(np.eye(b), (m, b, b)) if ties.C is None else ties.C
    local = block_diagonal((A, C))
    count = n * A.shape[2]
    shared = np.zeros((len(local), ties.n_shared))
    if ties.E is not None:
        for i in range(n):
            for column, unknown in zip(ties.E[i].T, ties.index[i], strict=True):
                shared[i * d : (i + 1) * d, unknown] += column
    return np.hstack([local[:, :count], shared, local[:, count:]])


def dense(system: System) -> Array:
    """Return J^T J (and the constraints' B B^T) in the unknowns, with ones for frozen ones."""
    (n, d), (m, b) = system.normal.g_cameras.shape, system.normal.g_points.shape
    columns = []
    for unit in np.eye(n * d + m * b):
        parts = system.product(unit[: n * d].reshape(n, d), unit[n * d :].reshape(m, b))
        columns.append(np.concatenate([part.ravel() for part in parts]))
    B = whole_ties(system)
    N = B.T @ np.array(columns).T @ B
    frozen = np.flatnonzero(~B.any(axis=0))
    N[frozen, frozen] = 1.0
    return N


def matrix(damping: Any, system: BundleSystem) -> tuple[Array, Array]:
    """Return the blocks of a damping's W, of cameras and of points."""
    W = damping.blocks(system)
    return W.cameras, W.points


def block_diagonal(blocks: tuple[Array, Array]) -> Array:
    """Return the blocks of cameras and of points as one matrix, rows by columns."""
    shapes = [(len(part) * part.shape[1], len(part) * part.shape[2]) for part in blocks]
    result = np.zeros((shapes[0][0] + shapes[1][0], shapes[0][1] + shapes[1][1]))
    row = column = 0
    for part in blocks:
        for block in part:
            result[row : row + block.shape[0], column : column + block.shape[1]] = block
            row, column = row + block.shape[0], column + block.shape[1]
    return result


def need_backend(name: str) -> None:
    """Skip the test, with the reason, where a back end is missing."""
    reason = eg.kernels.available()[name]
    if reason is not None:
        pytest.skip(f"back end {name} {reason}")
