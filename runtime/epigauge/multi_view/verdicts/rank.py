"""What of projective cameras and points the normal matrix leaves open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.dampings import Covariant
from epigauge.bundle.null_space import generators
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleState, Estimate
from epigauge.bundle.reduced import Bordered, Eliminated, Iterated, reduced_system
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import camera_model
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import normalized
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.verdicts.counting import CAMERA

__all__ = ["open_directions", "suits"]

Array = NDArray[np.float64]

#: Which views (n,) and points (m,) are no unknowns.
Held = tuple[NDArray[np.bool_], NDArray[np.bool_]]

#: An eigenvalue of N below this, where W of the covariant damping is one, is rounding.
_ROUNDING = 1e-11

#: Up to so many cameras all eigenvalues are computed; of more, the smallest, by iterations.
_FEW, _COLUMNS, _ITERATIONS = 12, 4, 3

#: Shift with which a singular matrix is factored; larger where conjugate gradients solve.
_SHIFT, _SHIFT_ITERATIVE = 1e-12, 1e-5

#: Least over largest spread of points in a basis that suits computing.
_SPREAD = 0.01


def suits(system: BundleSystem) -> bool:
    """Tell whether normal equations are those of all parameters, in a basis fit to compute in."""
    ties = system.ties
    if ties.n_shared or ties.A is not None or ties.C is not None or system.constraints is not None:
        return False
    Q = system.points / np.linalg.norm(system.points, axis=1, keepdims=True)
    values = np.linalg.eigvalsh(Q.T @ Q)
    return bool(values[0] > _SPREAD * values[-1])


def open_directions(
    seen: Seen,
    frame: Frame,
    kernels: Table,
    workers: int,
    system: BundleSystem | None,
    held: Held | None = None,
) -> tuple[int, int, float, Array]:
    """Return how many directions beside the gauge N leaves open, and its least other eigenvalue.

    Those of the cameras, and those of single points, which spoil nothing else. Last, what part of
    the weakest direction each camera has, (n,). Cameras and points that are held are no unknowns.

    In parameters in which W of the covariant damping is one, for which the basis does not matter.
    """
    try:
        # Where a camera or a point is all but undefined, numbers overflow: it is open.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            system = system or _normal_equations(seen, frame, kernels, workers)
            found = _measured(system, kernels, held)
    except np.linalg.LinAlgError:
        return 1, 0, 0.0, np.zeros(seen.n)
    return found if np.isfinite(found[2]) else (1, 0, 0.0, np.zeros(seen.n))


def _normal_equations(seen: Seen, frame: Frame, kernels: Table, workers: int) -> BundleSystem:
    """Return the normal equations of what counts, in the best conditioned basis."""
    graph = ObservationGraph(seen.view, seen.point, seen.n, seen.m)
    own = Frame(frame.origins[seen.views], frame.scale)
    parts = camera_model("projective"), kernels, graph, own.points_in(seen.xy, seen.view)
    P = own.cameras_in(seen.P)
    P, Q = normalized().transformation(P, seen.Q).apply(P, seen.Q)
    problem = bundle_problem(*parts, seen.weights, workers=workers)
    return problem.linearize(BundleState(Estimate(P.reshape(-1, 12), Q), 0.0))


def _measured(
    system: BundleSystem, kernels: Table, held: Held | None
) -> tuple[int, int, float, Array]:
    W = Covariant().blocks(system)
    # A point whose lines of sight are one leaves W singular, too.
    lifted = [
        blocks + 1e-12 * _mean_diagonal(blocks) * np.eye(blocks.shape[1])
        for blocks in (W.cameras, W.points)
    ]
    roots = [np.swapaxes(np.linalg.cholesky(blocks), 1, 2) for blocks in lifted]
    whitening = [np.asarray(np.linalg.inv(root)) for root in roots]
    p, q, moves = _freedom(system, kernels, roots, held)
    n, a = p.shape
    if held is not None:
        whitening[0][held[0]] = 0.0
    white = system.tied(*whitening)
    U = white.U + p[:, :, None] * p[:, None, :]
    V = white.V + q[:, :, None] * q[:, None, :]
    if held is not None:
        U[held[0]], V[held[1]] = np.eye(a), np.eye(V.shape[1])
    open_points, root = _grounded(V)
    T = whitening[1] @ np.asarray(np.swapaxes(np.linalg.inv(root), 1, 2))
    if held is not None:
        T[held[1]] = 0.0
    coupling = system.normal.coupling
    if n <= _FEW:
        less = coupling.schur(T, None)[0].dense().transpose(0, 2, 1, 3)
        S = -(np.swapaxes(whitening[0], 1, 2)[:, None] @ less @ whitening[0])
        S[np.arange(n), np.arange(n)] += U
        dense = S.transpose(0, 2, 1, 3).reshape(n * a, n * a)
        dense += moves @ moves.T
        values = np.linalg.eigvalsh(dense)
        weakest = _direction(dense, float(values[0]))
    else:
        shift = _SHIFT if coupling.direct else _SHIFT_ITERATIVE
        shifted, _ = reduced_system(
            [Eliminated(coupling, T)], system.normal.U, white.ties, U + shift * np.eye(a), shift
        )
        columns = _COLUMNS if coupling.direct else 2
        while True:
            values, weakest = _least(shifted, shift, moves, columns)
            if columns >= n * a // 2 or not coupling.direct or values[-1] > _ROUNDING:
                break
            columns *= 4
    open_cameras = int(np.count_nonzero(values <= _ROUNDING))
    parts = np.sum(weakest.reshape(n, a) ** 2, axis=1)
    return open_cameras, open_points, float(max(values[0], 0.0)), parts / np.sum(parts)


def _direction(S: Array, value: float) -> Array:
    """Return the eigenvector of an eigenvalue that is known: two inverse iterations."""
    shifted = S - (value - 1e-9 * np.trace(S) / len(S)) * np.eye(len(S))
    found = np.random.default_rng(0).standard_normal((len(S), 1))
    for _ in range(2):
        found = np.linalg.solve(shifted, found)
        found /= np.linalg.norm(found)
    return np.asarray(found[:, 0])


def _freedom(
    system: BundleSystem, kernels: Table, roots: list[Array], held: Held | None
) -> tuple[Array, Array, Array]:
    """Return unit directions of the scales, and the changes of basis as S knows them, (12 n, 15).

    What N does not see, S does not see in the cameras alone. Of the changes, those that leave what
    is held as it is.
    """
    p = np.einsum("nij,nj->ni", roots[0], system.cameras)
    q = np.einsum("nij,nj->ni", roots[1], system.points)
    p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (p, q))
    estimate = system.model, kernels, system.cameras, system.points
    own = generators(*estimate)
    cameras = _beside(p, roots[0] @ own[0])
    if held is not None:
        points = _beside(q, roots[1] @ own[1])
        size = np.sqrt(np.sum(cameras**2, axis=(0, 1)) + np.sum(points**2, axis=(0, 1)))
        both = (cameras[held[0]], points[held[1]])
        stuck = np.concatenate([part.reshape(-1, len(size)) for part in both]) / size
        values, combinations = np.linalg.svd(stuck)[1:]
        free = np.append(values, np.zeros(len(size) - len(values))) < 1e-9
        cameras = cameras @ (combinations[free].T / size[:, None])
    moves = np.linalg.qr(cameras.reshape(p.size, -1))[0]
    return p, q, np.asarray(moves)


def _beside(scales: Array, columns: Array) -> Array:
    """Return columns (n, d, k) without their parts along unit directions (n, d)."""
    along = np.einsum("ni,nik->nk", scales, columns)
    return np.asarray(columns - scales[:, :, None] * along[:, None])


def _least(
    shifted: Bordered | Iterated, shift: float, moves: Array, columns: int
) -> tuple[Array, Array]:
    """Return the least eigenvalues of S beside the gauge, from above: inverse iterations.

    And the direction of the first.
    """
    size = len(moves)
    X = np.random.default_rng(0).standard_normal((size, columns))
    for _ in range(_ITERATIONS):
        X = np.linalg.qr(X - moves @ (moves.T @ X))[0]
        Y = shifted.solve(X.reshape(-1, CAMERA + 1, columns), np.zeros((0, columns)))[0]
        Y = Y.reshape(size, columns)
        Y -= moves @ (moves.T @ Y)
        # X^T S^-1 X has the inverse eigenvalues: Ritz values without a product with S.
        inverse, turn = np.linalg.eigh(0.5 * (X.T @ Y + Y.T @ X))
        first, X = X @ turn[:, -1], Y
    return 1.0 / np.maximum(inverse[::-1], 1e-300) - shift, first


def _grounded(V: Array) -> tuple[int, Array]:
    """Return how many directions of single points are open, and roots of the blocks, these closed.

    Lower triangular.
    """
    try:
        root = np.linalg.cholesky(V + 1e-14 * np.eye(4))
        diagonal = np.einsum("nii->ni", root)
        thin = np.flatnonzero(diagonal.min(axis=1) ** 2 <= 1e3 * _ROUNDING)
    except np.linalg.LinAlgError:  # some block is singular to rounding: all are looked at
        thin = np.arange(len(V))
    if not len(thin):
        return 0, np.asarray(root)
    values, vectors = np.linalg.eigh(V[thin])
    open_ = values <= _ROUNDING
    V = V.copy()
    V[thin] = (vectors * np.where(open_, 1.0, values)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return int(np.count_nonzero(open_)), np.asarray(np.linalg.cholesky(V))


def _mean_diagonal(blocks: Array) -> Array:
    return np.asarray(np.einsum("nii->n", blocks) / blocks.shape[1])[:, None, None]
