"""A first reconstruction from random cameras: all views at once, by variable projection.

The pseudo object space error (pOSE) of Hong and Zach is bilinear in cameras and points and has no
pole at depth zero. Points are eliminated exactly, so that only the cameras are minimised over. A
first stage, nearly affine and with a ridge, leads from random cameras to where perspective follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.numpy_linearizer import inverse_roots, normal_equations
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.solve import Blocks, Step, System
from epigauge.kernels import Table
from epigauge.two_view.losses import robust_scale

__all__ = ["FactorizationProblem", "FactorizationState", "factorized", "typical_block"]

Array = NDArray[np.float64]

#: First lambda, of the largest mean diagonal entry of a block.
_FIRST = 1e-6

_MAX_ITER = 200


class _Stage(NamedTuple):
    """One minimisation.

    eta is the weight of the affine camera's error, ridge that of the ridge in units of
    `typical_block`, ftol ends the stage; `reweighted` gives each observation a new weight before.
    """

    eta: float
    ridge: float
    ftol: float
    reweighted: bool = False


_AFFINE, _PERSPECTIVE = (0.9, 0.1, 1e-4), (0.05, 1e-9, 1e-6)

_PLAIN = (_Stage(*_AFFINE), _Stage(*_PERSPECTIVE))

#: Gross errors are told while the model is stiff; perspective then hardly changes their weights.
_ROBUST = (
    _Stage(*_AFFINE),
    *8 * (_Stage(*_AFFINE, reweighted=True),),
    *4 * (_Stage(*_PERSPECTIVE, reweighted=True),),
)

#: Where the weight of a residual is a quarter, in robust standard deviations.
_DOUBTFUL = 5.0


class FactorizationProblem:
    """Pseudo object space error and a ridge, as a function of the cameras alone.

    0.5 sum |r|^2 + 0.5 ridge (sum |P_i without its last column|^2 + sum |X_j|^2), minimised over
    the points (X_j, 1) for given cameras. The ridge bounds the nuclear norm of the matrix of
    projections, and of all changes of basis it leaves rotations free.

    Parameters
    ----------
    kernels : Table
        Backend.
    layout : ObservationGraph
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Measurements in coordinates of RMS one.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    eta : float
        Weight of the affine camera's error; that of the object space error is 1 - eta.
    ridge : float
        Positive, so that every point is determined.
    """

    floor = 0.0

    def __init__(
        self,
        kernels: Table,
        layout: ObservationGraph,
        q: Array,
        weights: Array,
        eta: float,
        ridge: float,
    ) -> None:
        self.kernels, self.layout, self.q = kernels, layout, q
        self.root, self.eta, self.ridge = np.sqrt(weights), np.array(eta), ridge
        self.held = np.tile([1.0, 1.0, 1.0, 0.0], 3)

    def evaluate(self, P: Array) -> FactorizationState:
        """Return the state of cameras (n, 3, 4), with the points that fit them best."""
        layout = self.layout
        r, _, J_X = self._residuals(P, np.zeros((layout.n_points, 3)))
        B = J_X.transpose(2, 0, 1)
        B_T = np.swapaxes(B, 1, 2)
        V = layout.sum_points(B_T @ B) + self.ridge * np.eye(3)
        g = layout.sum_points(B_T @ r.T[..., None])
        # The residuals are linear in X: one Gauss-Newton step from anywhere.
        X = np.asarray(np.linalg.solve(V, -g)[..., 0])
        squared = np.sum((self.held * P.reshape(-1, 12)) ** 2) + np.sum(X**2)
        r, _, _ = self._residuals(P, X)
        cost = 0.5 * float(np.sum(r**2) + self.ridge * squared)
        return FactorizationState(P, X, cost if np.isfinite(cost) else float("inf"))

    def linearize(self, state: FactorizationState) -> System:
        """Return the normal equations; the points, at their best, have no gradient."""
        r, J_P, J_X = self._residuals(state.P, state.X)
        normal = normal_equations(self.layout, J_P, J_X, r)
        held = replace(
            normal,
            U=normal.U + self.ridge * np.diag(self.held),
            V=normal.V + self.ridge * np.eye(3),
            g_cameras=normal.g_cameras + self.ridge * self.held * state.P.reshape(-1, 12),
            g_points=np.zeros_like(state.X),
        )
        return System(held, inverse_roots)

    def retract(self, state: FactorizationState, step: Step) -> Array:
        """Return the cameras that a step leads to; their points are found anew."""
        return np.asarray(state.P + step.cameras.reshape(state.P.shape))

    def distances(self, state: FactorizationState) -> Array:
        """Return the length of each observation's residual, without its weight, (N,)."""
        return np.asarray(np.linalg.norm(self._kernel(state.P, state.X)[0], axis=0))

    def _residuals(self, P: Array, X: Array) -> tuple[Array, Array, Array]:
        """Return weighted residuals (4, N) and Jacobians (4, 12, N), (4, 3, N)."""
        r, J_P, J_X = (self.root * part for part in self._kernel(P, X))
        return r, J_P, J_X

    def _kernel(self, P: Array, X: Array) -> tuple[Array, Array, Array]:
        cameras = np.ascontiguousarray(P.transpose(1, 2, 0)[:, :, self.layout.view])
        points = np.ascontiguousarray(X.T[:, self.layout.point])
        r, J_P, J_X = self.kernels.pseudo_object_space(self.eta, cameras, points, self.q)
        return r, J_P, J_X


@dataclass(frozen=True)
class FactorizationState:
    """Cameras (n, 3, 4), their best points X (m, 3), and the cost."""

    P: Array
    X: Array
    cost: float


class _OnCameras:
    """lambda I on the cameras only: with exact points, this is variable projection (RW2)."""

    def start(self, system: System) -> float:
        """Return a small fraction of the largest diagonal entry."""
        return _FIRST * system.largest()

    def step(self, system: System, lam: float) -> Step:
        """Return the step damped by identities and zeros."""
        blocks = np.broadcast_to(np.eye(system.U.shape[1]), system.U.shape)
        return system.damped_step(Blocks(blocks, np.ones(0), np.zeros_like(system.V)), lam)


def typical_block(layout: ObservationGraph) -> float:
    """Return the typical size of a point's block of the normal matrix, for points of their own.

    The singular values of the matrix of projections, in coordinates of RMS one, are about the root
    of the number of observations N; where cameras and points share them evenly, a block has this
    size times the share N / (n m) of the views that see a point.
    """
    N = len(layout.view)
    return N / (layout.n_views * layout.n_points) * float(np.sqrt(N))


def factorized(
    kernels: Table, layout: ObservationGraph, q: Array, weights: Array, *, seed: int, robust: bool
) -> tuple[Array, Array]:
    """Reconstruct from random affine cameras.

    Parameters
    ----------
    kernels : Table
        Backend.
    layout : ObservationGraph
        Which observation belongs to what.
    q : ndarray, shape (2, N)
        Measurements in coordinates of RMS one, centred.
    weights : ndarray, shape (N,)
        Factor of each squared residual.
    seed : int
        Of the random cameras.
    robust : bool
        Weigh down what fits badly, again and again.

    Returns
    -------
    P, Q : ndarray, shape (n, 3, 4), (m, 4)
        Cameras and points.

    References
    ----------
    .. [1] J. H. Hong, C. Zach, "pOSE: pseudo object space error for initialization-free bundle
       adjustment", CVPR 2018.
    .. [2] J. H. Hong, C. Zach, A. Fitzgibbon, R. Cipolla, "Projective bundle adjustment from
       arbitrary initialization using the variable projection method", ECCV 2016.
    """
    P = np.random.default_rng(seed).normal(size=(layout.n_views, 3, 4))
    P[:, 2] = 0.0, 0.0, 0.0, 1.0
    unit, distances = typical_block(layout), np.zeros(len(layout.view))
    for stage in _ROBUST if robust else _PLAIN:
        trusted = weights * _trust(distances, weights > 0.0) if stage.reweighted else weights
        ridge = stage.ridge * unit
        problem = FactorizationProblem(kernels, layout, q, trusted, stage.eta, ridge)
        stopping = lm.Stopping(ftol=stage.ftol, xtol=0.0, gtol=0.0, max_iter=_MAX_ITER)
        state = lm.minimize(problem, P, _OnCameras(), lm.Classic(), stopping).state
        P, distances = state.P, problem.distances(state)
    return P, np.column_stack([state.X, np.ones(layout.n_points)])


def _trust(distances: Array, counts: NDArray[np.bool_]) -> Array:
    """Return the weights of Geman and McClure, by distances in robust standard deviations."""
    scale = _DOUBTFUL * max(robust_scale(distances[counts]), 1e-12)
    return np.asarray(1.0 / (1.0 + (distances / scale) ** 2) ** 2)
