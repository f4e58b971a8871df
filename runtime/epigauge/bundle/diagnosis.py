"""How well the observations determine what was adjusted: rank, and the weakest direction."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.dampings import Covariant
from epigauge.bundle.null_space import generators
from epigauge.bundle.point_blocks import Triangle, solved_points
from epigauge.bundle.reduced import Bordered, Eliminated, Iterated, reduced_system
from epigauge.bundle.solve import Blocks, BundleSystem
from epigauge.bundle.ties import Ties, congruent
from epigauge.kernels import Table

__all__ = ["Diagnosis", "diagnosed"]

Array = NDArray[np.float64]

#: An eigenvalue below this, where the diagonal is one, is rounding.
_ROUNDING = 1e-11

#: The shift that is factored: the first with which rounding leaves the matrix definite.
_SHIFTS = 1e-12, 1e-10, 1e-8

#: A motion of the gauge is held that resists more than this, of the one that resists most.
_HELD = 1e-9

#: Columns beside the gauge, and steps, of the inverse iteration.
_COLUMNS, _ITERATIONS = 4, 4


@dataclass(frozen=True)
class Diagnosis:
    """What the normal matrix says.

    Attributes
    ----------
    rank : int
        Of the normal matrix of the unknowns.
    missing : int
        Directions of the cameras that no observation or prior determines, beside the gauge. Those
        of single points lower the rank, and spoil nothing else.
    condition : float
        Inverse of the least eigenvalue, beside those and the gauge, of the reduced system of the
        cameras with unit diagonal blocks; NaN where the system is not factored.
    cameras : ndarray, shape (n, d)
        Own tangents of that weakest direction, one standard deviation long for a noise of one.
    open : ndarray, shape (n, d), or None
        A direction that nothing determines, as far as each entry moves images.
    spread : ndarray, shape (n, d)
        Least standard deviations of own tangents for a noise of one: those along the weakest few
        directions together.
    points : ndarray, shape (m, b)
        How the points go with the weakest direction, or with the open one.
    gauge : int
        Motions of the gauge that nothing holds.
    """

    rank: int
    missing: int
    condition: float
    cameras: Array
    open: Array | None = None
    spread: Array = field(default_factory=lambda: np.zeros((0, 0)))
    points: Array = field(default_factory=lambda: np.zeros((0, 0)))
    gauge: int = 0


def diagnosed(
    system: BundleSystem,
    kernels: Table,
    known: NDArray[np.bool_],
    fixes_gauge: bool,
    gauge: int | None = None,
) -> Diagnosis:
    """Diagnose the normal equations at an estimate.

    Parameters
    ----------
    system : BundleSystem
        The normal equations; scales of homogeneous cameras and points are to be no unknowns.
    kernels : Table
        Back end.
    known : ndarray of bool, shape (m,)
        Points that are fixed: they are no unknowns.
    fixes_gauge : bool
        Whether anything is fixed or known that ties the frame; else all of the gauge is free.
    gauge : int, optional
        How many motions of the gauge are free, where that is known.
    """
    n, d = system.normal.g_cameras.shape
    W = Covariant().blocks(system)
    whitening = np.linalg.inv(np.swapaxes(np.linalg.cholesky(W.cameras), 1, 2))
    ties = system.ties.then(whitening, None).scaled(1.0 / np.sqrt(W.shared))
    free = ~known
    of_points = _open(system.V, W.points) if free.all() else _open(system.V[free], W.points[free])
    # Features of other kinds are free.
    for own, sizes in zip(system.normal.others, W.others, strict=True):
        of_points += _open(own.V, sizes)
    white = congruent(ties.A, system.normal.U)
    a, r = white.shape[1], ties.n_shared
    frozen = 0 if system.ties.A is None else int(np.count_nonzero(~system.ties.A.any(axis=1)))
    unknowns = n * a - frozen + r + system.V.shape[1] * int(np.count_nonzero(free))
    unknowns += sum(own.g_points.size for own in system.normal.others)
    if gauge is None:
        gauge = _free_gauge(system, kernels) if fixes_gauge else system.model.gauge_dimension
    nothing = np.zeros((n, d))
    silent: dict[str, Any] = {"spread": nothing, "points": np.zeros(system.normal.g_points.shape)}
    silent["gauge"] = gauge
    if not system.normal.coupling.direct:
        return Diagnosis(unknowns - gauge - of_points, 0, float("inf"), nothing, **silent)
    factored = _factored(system, ties, W, white)
    if factored is None:
        return Diagnosis(unknowns - gauge - of_points - 1, 1, float("inf"), nothing, **silent)
    shifted, shift = factored
    count = min(gauge + _COLUMNS, n * a - frozen + r)
    X = np.random.default_rng(0).standard_normal((n * a + r, count))
    for _ in range(_ITERATIONS):
        X = np.linalg.qr(X)[0]
        x, s = shifted.solve(X[: n * a].reshape(n, a, count), X[n * a :])
        Y = np.concatenate([x.reshape(n * a, count), s])
        inverse, turn = np.linalg.eigh(0.5 * (X.T @ Y + Y.T @ X))
        X = Y @ turn
    values = (1.0 / np.maximum(inverse, 1e-300) - shift)[::-1]
    X = X[:, ::-1] / np.linalg.norm(X[:, ::-1], axis=0)
    open_ = int(np.count_nonzero(values <= _ROUNDING))
    missing = max(open_ - gauge, 0)
    rank = unknowns - gauge - missing - of_points
    first, found = max(open_, gauge), None
    if missing:
        x, s = X[: n * a, :open_].reshape(n, a, open_), X[n * a :, :open_]
        found = _beside_gauge(system, kernels, ties.cameras(x, s))
        size = np.sqrt(np.einsum("nii->ni", system.normal.U))
        free = size > 0.0
        silent["points"] = _followed(system, np.where(free, found / np.where(free, size, 1.0), 0.0))
    if first >= count:
        return Diagnosis(rank, missing, float("inf"), nothing, found, **silent)
    size = np.maximum(values[first:], _ROUNDING)
    x, s = X[: n * a, first:].reshape(n, a, -1), X[n * a :, first:]
    own = ties.cameras(x, s) / np.sqrt(size)
    silent["spread"] = np.linalg.norm(own, axis=2)
    if found is None:
        silent["points"] = _followed(system, own[..., 0])
    return Diagnosis(rank, missing, 1.0 / float(size[0]), own[..., 0], found, **silent)


def _followed(system: BundleSystem, own: Array) -> Array:
    """Return where the points go with cameras moving by own tangents (n, d): -V^-1 W^T x."""
    pull = system.normal.coupling.to_points(None, np.ascontiguousarray(own))
    if not system.model.homogeneous:
        return -solved_points(system.normal.V, pull, 1e-12)
    moved = -solved_points(system.V, system.ties.of_points(pull[..., None])[..., 0], 1e-12)
    return system.ties.points(moved[..., None])[..., 0]


def _beside_gauge(system: BundleSystem, kernels: Table, own: Array) -> Array:
    """Return of open directions (n, d, k) the one least of the gauge, as it moves images."""
    size = np.sqrt(np.einsum("nii->ni", system.normal.U))[..., None]
    moves = size * generators(system.model, kernels, system.cameras, system.points)[0]
    basis = np.linalg.qr(moves.reshape(size.size, -1))[0]
    across = (size * own).reshape(size.size, -1)
    across = across / np.maximum(np.linalg.norm(across, axis=0), 1e-300)
    across -= basis @ (basis.T @ across)
    return np.asarray(np.linalg.svd(across, full_matrices=False)[0][:, 0].reshape(size.shape[:2]))


def _factored(
    system: BundleSystem, ties: Ties, W: Blocks, white: Array
) -> tuple[Bordered | Iterated, float] | None:
    """Return the reduced system plus a shift, and that; None where it stays indefinite."""
    for shift in _SHIFTS:
        try:
            kinds = [Eliminated(own.coupling, own.T) for own in system.eliminated(W, shift)]
            lifted = white + shift * np.eye(white.shape[1])
            return reduced_system(kinds, system.normal.U, ties, lifted, shift)[0], shift
        except np.linalg.LinAlgError:
            continue
    return None


def _open(blocks: Array, sizes: Array) -> int:
    """Return how many eigenvalues of blocks (k, b, b), all together, are rounding.

    Where the diagonals of `sizes` are one. Eigenvalues are computed of those only whose determinant
    may be that of such a block: the others' product is at most (trace / (b - 1))^(b - 1).
    """
    b = blocks.shape[1]
    size = np.ascontiguousarray(sizes.reshape(len(sizes), b * b)[:, :: b + 1].T)
    if b == 3:
        pivots = np.stack(Triangle.of(blocks)[3:]) / size
        with np.errstate(invalid="ignore", over="ignore"):
            determinants = pivots[0] * pivots[1] * pivots[2]
        traces = np.sum(blocks.reshape(-1, 9)[:, ::4].T / size, axis=0)
        doubtful = ~(determinants > 100.0 * _ROUNDING * np.maximum(traces / 2.0, 1.0) ** 2)
    else:
        doubtful = np.ones(len(blocks), np.bool_)
    root = np.sqrt(size[:, doubtful].T)
    white = blocks[doubtful] / (root[:, :, None] * root[:, None, :])
    return int(np.count_nonzero(np.linalg.eigvalsh(white) <= _ROUNDING))


def _free_gauge(system: BundleSystem, kernels: Table) -> int:
    """Return the dimension of the gauge that what is fixed and known leaves.

    A motion of the gauge is free where the unknowns can make it and no prior resists.
    """
    # Features of other kinds are free: they go along with what moves cameras and points.
    system = replace(system, normal=system.normal.alone(), other_roots=())
    cameras, points = generators(system.model, kernels, system.cameras, system.points)
    g, ties = cameras.shape[2], system.ties
    size = np.sqrt(np.sum(cameras**2, axis=(0, 1)) + np.sum(points**2, axis=(0, 1)))
    cameras, points = cameras / size, points / size
    held = np.zeros((g, g))
    for own, basis in ((cameras, ties.A), (points, ties.C)):
        if basis is not None:
            stuck = (own - basis @ (np.linalg.pinv(basis) @ own)).reshape(-1, g)
            held += stuck.T @ stuck
    for k in range(g):  # of J^T J only what priors add is left
        x, y = system.product(cameras[..., k], points[..., k])
        along = np.einsum("ndg,nd->g", cameras, x) + np.einsum("mbg,mb->g", points, y)
        held[k] += along / system.largest()
    values = np.linalg.eigvalsh(0.5 * (held + held.T))
    return int(np.count_nonzero(values <= _HELD * max(values[-1], 1.0 / len(system.cameras))))
