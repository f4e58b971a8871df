"""What can be said against a reconstruction: its rank, its flags, points behind cameras.

An adjustment always ends somewhere. Whether the observations determine it is counted and measured
in the normal matrix: of N, all but the gauge must be of full rank. Where noise hides a degenerate
scene from N, two views at a time tell: a flat scene or a camera that turns leaves homographies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.diagnosis import diagnosed
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.null_space import generators
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleState, Estimate
from epigauge.bundle.reduced import Bordered, Iterated, reduced_system
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import AffineReconstruction, MetricReconstruction, camera_model
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import normalized
from epigauge.multi_view.parallax import parallax_flags
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.tracks import Reconstruction, Tracks
from epigauge.two_view.losses import robust_scale
from epigauge.verdicts import ordered

__all__ = ["BEHIND", "Verdict", "behind", "judged", "judged_metric", "missing_by_count"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

#: Parameters of a camera and a point without their scales, and dimension of the changes of basis.
_CAMERA, _POINT, _GAUGE = 11, 3, 15

#: Relative matches of two views determine their F, and nothing more.
_PAIR = 7

#: An eigenvalue of N below this, where W of the covariant damping is one, is rounding.
_ROUNDING = 1e-11

#: Standard deviation of the depth and image of a camera's points, as a share of their size, above
#: which the noise leaves a change of the cameras open.
_WEAK = 0.3

#: Up to so many cameras all eigenvalues are computed; of more, the smallest, by iterations.
_FEW, _COLUMNS, _ITERATIONS = 12, 4, 3

#: Shift with which a singular matrix is factored; larger where conjugate gradients solve.
_SHIFT, _SHIFT_ITERATIVE = 1e-12, 1e-5

#: Noise, as a share of the RMS of the image coordinates, up to which a fit is one.
_FITS = 0.05

#: Root mean square over the noise that the median tells, above which few observations carry the
#: cost: up to five in raw tracks that still lead to their optimum.
_HEAVY = 8.0

#: Noise below this share of the extent of the coordinates is rounding.
_EXACT = 1e-8

#: Least squares bends everything to observations whose residuals, as shares of the extent of the
#: coordinates, are larger than the first: below a fifth in most raw tracks, above with two wrong in
#: a thousand. So few as the second cannot: one of 35000 measured ones is off by a third of the
#: extent, and they lead to the published optimum all the same.
_BEYOND, _TOO_FEW = 0.2, 1e-4

#: Least over largest spread of points in a basis that suits computing.
_SPREAD = 0.01

#: Share of single points that may be open without the rest being called undetermined.
_OPEN = 0.05

#: Share of its size that a metric quantity may be uncertain by before that is told.
_UNCERTAIN = 0.1

#: Share of the observations that may lie behind a camera before it is told: chance, and far points.
BEHIND = 0.01


@dataclass(frozen=True)
class Verdict:
    """What is to be known of a reconstruction before it is used.

    Attributes
    ----------
    flags : tuple of str
        Names from `epigauge.verdicts.FLAGS`.
    rank : int
        Of the normal matrix; 11 n + 3 m - 15 where all is determined, n and m being the numbers of
        views and points that count, these with two observations.
    n_behind : int
        Observations of points behind the camera, signs of cameras and points being chosen best.
    condition, weakest : float, str
        Of metric cameras: see `BundleResult`.
    """

    flags: tuple[str, ...]
    rank: int
    n_behind: int
    condition: float = float("inf")
    weakest: str = ""


def judged(
    tracks: Tracks,
    found: Reconstruction,
    rejected: Mask,
    bends: bool,
    kernels: Table,
    workers: int = 1,
    fixed: tuple[Indices, Indices] | None = None,
    system: object = None,
) -> Verdict:
    """Judge an adjusted reconstruction.

    Parameters
    ----------
    tracks : Tracks
        Observations; those of weight zero do not count.
    found : Reconstruction
        Cameras and points, at the minimum.
    rejected : ndarray of bool, shape (N,)
        Observations that do not count either.
    bends : bool
        Whether the loss lets few observations bend the result: least squares.
    kernels : Table
        Backend.
    workers : int
        Threads.
    fixed : tuple of ndarray of int, optional
        Views and points that are no unknowns.
    system : BundleSystem, optional
        Normal equations of all observations at the minimum, in any basis, where they are known.

    Returns
    -------
    Verdict
        Flags, rank, and the number of observations behind the cameras.
    """
    seen, lost = Seen.of(tracks, found, rejected)
    full = _CAMERA * (seen.n + lost) + _POINT * seen.m - _GAUGE
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        h = np.einsum("nij,nj->ni", seen.P[seen.view], seen.Q[seen.point])
        distances = np.linalg.norm(h[:, :2] / h[:, 2:] - seen.xy, axis=1)
    n_behind = behind(seen, h[:, 2])
    if not np.isfinite(distances).all():  # a point in a focal plane: there is nothing to measure
        return Verdict(("undetermined",), 0, n_behind)
    frame = Frame.of(tracks)
    if len(seen.view) < len(tracks) or not (isinstance(system, BundleSystem) and _suits(system)):
        system = None
    of_cameras, of_points, weakest = _open_directions(seen, frame, kernels, workers, system)
    of_cameras = max(missing_by_count(seen), of_cameras) + _CAMERA * lost
    views, points = (len(part) for part in fixed or ((), ()))
    if fixed is not None:
        full -= _CAMERA * views + _POINT * points
        full += _GAUGE - missing_beside((found.P[fixed[0]], found.Q[fixed[1]]))
    if views == len(found.P):
        of_cameras, weakest = 0, 1.0
    N = len(distances)
    redundancy = max(2 * N - full, 1) / (2 * N)
    # Of two normal coordinates, the median distance is 1.1774 standard deviations.
    noise_px = robust_scale(distances) / 1.4826 / 1.1774 / float(np.sqrt(redundancy))
    information = max(weakest, 1e-300) * N / seen.n
    deviation = noise_px / frame.scale / float(np.sqrt(information))
    # Where the fit is bad, nothing is within its noise.
    fits = noise_px < _FITS * frame.scale
    judge = fits and views < len(found.P)
    raised = set(parallax_flags(seen, noise_px)) if judge else set()
    if bends and _has_gross_errors(distances, noise_px, seen.xy):
        raised.add("gross errors")
    if of_cameras or of_points > _OPEN * seen.m:
        raised.add("undetermined")
    elif of_points or deviation > _WEAK:
        raised.add("weak geometry")
    if n_behind > BEHIND * N:
        raised.add("behind the cameras")
    condition = float("inf") if of_cameras or not weakest > 0.0 else 1.0 / weakest
    return Verdict(ordered(raised), full - of_cameras - of_points, n_behind, condition)


def _has_gross_errors(distances: Array, noise_px: float, xy: Array) -> bool:
    """Tell whether few residuals carry the cost, or more than a very few are very large."""
    if distances.max() <= _HEAVY * noise_px:  # the extent can only raise the bounds
        return False
    extent = _extent(xy)
    usual = _HEAVY * max(noise_px, _EXACT * extent)
    heavy = float(np.sqrt(np.mean(distances**2) / 2.0)) > usual
    beyond = np.count_nonzero(distances > max(_BEYOND * extent, usual))
    return bool(heavy or beyond > _TOO_FEW * len(distances))


def _extent(xy: Array) -> float:
    """Return the range of the coordinates, to which a few wild ones add little."""
    low, high = np.quantile(xy, (0.005, 0.995), axis=0)
    return float(np.minimum(np.ptp(xy, axis=0), 1.3 * (high - low)).max())


def judged_metric(
    tracks: Tracks,
    found: MetricReconstruction | AffineReconstruction,
    depths: Array | None,
    outcome: lm.Outcome[BundleState],
    kernels: Table,
    known: Mask,
    fixes_gauge: bool,
) -> Verdict:
    """Judge an adjusted metric or affine reconstruction.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    found : MetricReconstruction or AffineReconstruction
        Cameras and points, at the minimum.
    depths : ndarray, shape (N,), or None
        How far in front of its camera each observed point lies; None where cameras have no front.
    outcome : Outcome
        How the minimisation ended.
    kernels : Table
        Back end.
    known : ndarray of bool, shape (m,)
        Points that are fixed.
    fixes_gauge : bool
        Whether anything fixed or known ties the reconstruction to its frame.

    Returns
    -------
    Verdict
        Flags, rank, condition and weakest direction, and the number of observations that are not in
        front of their camera.
    """
    metric = depths is not None
    n_behind = 0 if depths is None else int(np.count_nonzero(~(depths > 0.0)))
    raised = ["behind the cameras"] if n_behind > BEHIND * len(tracks) else []
    system, rank = outcome.system, 0
    condition, weakest = float("inf"), ""
    if isinstance(system, BundleSystem) and np.isfinite(outcome.state.cost):
        diagnosis = diagnosed(system, kernels, known, fixes_gauge)
        rank, condition = diagnosis.rank, diagnosis.condition
        counted = 2 * int(np.count_nonzero(tracks.weights)) - rank
        noise_px = np.sqrt(2.0 * outcome.state.cost / max(counted, 1))
        deviations = noise_px * np.abs(diagnosis.cameras)
        weakest, share = _named(system, deviations)
        if diagnosis.open is not None:
            weakest = f"{_largest(system, np.abs(diagnosis.open))} (undetermined)"
        flat = 0.0 if metric else _flatness(found, noise_px * Frame.of(tracks).scale)
        if diagnosis.missing or flat > 1.0:
            raised.append("undetermined")
        elif flat > _WEAK or share > _UNCERTAIN:
            raised.append("weak geometry")
    return Verdict(ordered(raised), rank, n_behind, condition, weakest)


def _flatness(found: MetricReconstruction | AffineReconstruction, noise_px: float) -> float:
    """Return what noise alone would spread the images of a flat scene in depth, over what does.

    The third singular value of the measurements of affine cameras over that of noise, whose largest
    one is the sum of the roots of both sizes.
    """
    moved = best_conditioned(camera_model("affine"), found.P.reshape(-1, 12), found.X)
    P = moved.apply(found.P.reshape(-1, 12), found.X)[0].reshape(-1, 3, 4)
    rows, m = P[:, :2, :3].reshape(-1, 3), len(found.X)
    third = float(np.linalg.svd(rows, compute_uv=False)[2]) * np.sqrt(m)
    return float(noise_px * (np.sqrt(len(rows)) + np.sqrt(m)) / max(third, 1e-300))


def missing_beside(fixed: tuple[Array, Array]) -> int:
    """Return the dimension of the changes of basis that leave cameras and points, up to scale.

    Parameters
    ----------
    fixed : tuple of ndarray, shape (k, 3, 4), (l, 4)
        The cameras and points.
    """
    P, Q = fixed
    rows = [np.zeros((0, 16))]
    for camera in P / np.linalg.norm(P, axis=(1, 2), keepdims=True):
        linear = np.kron(camera, np.eye(4))  # of vect(E) to vect(P E)
        rows.append(linear - np.outer(camera.ravel(), camera.ravel() @ linear))
    for point in Q / np.linalg.norm(Q, axis=1, keepdims=True):
        linear = np.kron(np.eye(4), point)  # of vect(E) to E Q
        rows.append(linear - np.outer(point, point @ linear))
    # E = I moves nothing.
    return 15 - int(np.linalg.matrix_rank(np.concatenate(rows), tol=1e-9))


def _largest(system: BundleSystem, sizes: Array) -> str:
    """Return the names of the three largest entries of own tangents (n, d)."""
    views, entries = np.unravel_index(np.argsort(-sizes, axis=None)[:3], sizes.shape)
    names = system.model.tangent_names
    return ", ".join(f"{names[k]} of view {i}" for i, k in zip(views, entries, strict=True))


def _named(system: BundleSystem, deviations: Array) -> tuple[str, float]:
    """Return the largest standard deviations of a direction by name, as shares of their sizes.

    Turns are in radians, moves as shares of the median distance of the points, focal lengths and
    other parameters in their unit as shares of the focal length; all others count for nothing.
    Affine cameras are as they are computed with: points of unit covariance, images of RMS one.
    """
    model = system.model
    sizes = np.ones(deviations.shape)
    if model.metric:
        _set_sizes(sizes, system)
    shares = deviations / sizes
    views, entries = np.unravel_index(np.argsort(-shares, axis=None)[:3], shares.shape)
    told = [
        f"{model.tangent_names[k]} of view {i} ({100.0 * shares[i, k]:.2g} %)"
        for i, k in zip(views, entries, strict=True)
    ]
    return ", ".join(told), float(shares.max())


def _set_sizes(sizes: Array, system: BundleSystem) -> None:
    """Set the sizes (n, d) of a metric camera's own tangents."""
    model, cameras = system.model, system.cameras
    pose = cameras[:, :12].reshape(-1, 3, 4)
    centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    extent = np.median(np.linalg.norm(system.points - centres.mean(axis=0), axis=1))
    sizes[:, 3:6] = max(float(extent), 1e-300)
    focal = cameras[:, 12:][:, list(model.focal)]
    sizes[:, 6:] = focal.mean(axis=1, keepdims=True) if focal.size else np.inf
    of_image = {model.units[k] for k in model.focal}
    without = [k for k in range(len(model.adjusted)) if model.units[k] not in of_image]
    sizes[:, [6 + k for k in without]] = np.inf


def missing_by_count(seen: Seen) -> int:
    """Return how many parameters lack an equation, whatever the measurements: a lower bound.

    c points in the same s views give those cameras min(c (2 s - 3), 11 s - 15) equations; two
    views, as many as F has parameters. All cameras need 11 n - 15, and each one 11, of which points
    that two other views see give two apiece.
    """
    # A point twice in a view gives that view no more than once does.
    once = (np.diff(seen.point, prepend=-1) != 0) | (np.diff(seen.view, prepend=-1) != 0)
    view, point = seen.view[once], seen.point[once]
    everywhere = int(np.count_nonzero(np.bincount(point) == seen.n))
    enough = max((_CAMERA * seen.n - _GAUGE) / (2 * seen.n - _POINT), _CAMERA / 2)
    if seen.n > 2 and everywhere >= enough:
        return 0  # these alone give all cameras what they need
    # Points are told apart by the views that see them: sums of one random number a view.
    marks = np.random.default_rng(0).integers(0, 2**62, seen.n, dtype=np.uint64)
    first = np.flatnonzero(np.diff(point, prepend=-1))
    lengths = np.diff(np.append(first, len(point)))
    sums = np.add.reduceat(marks[view], first)
    _, shown, sizes = np.unique(sums, return_index=True, return_counts=True)
    s = lengths[shown]
    given = np.minimum(sizes * (2 * s - _POINT), np.maximum(_CAMERA * s - _GAUGE, 0))
    total = _CAMERA * seen.n - _GAUGE - int(np.sum(given))

    to_camera = np.where(s == 2, np.minimum(sizes, _PAIR), np.minimum(2 * sizes, _CAMERA))
    # One point of each kind stands for all.
    of_kind = np.zeros(len(first))
    of_kind[shown] = to_camera
    own = np.bincount(view, weights=np.repeat(of_kind, lengths))
    return max(total, int(_CAMERA - own.min()) if seen.n > 2 else 0, 0)


def _suits(system: BundleSystem) -> bool:
    """Tell whether normal equations are those of all parameters, in a basis fit to compute in."""
    ties = system.ties
    if ties.n_shared or ties.A is not None or ties.C is not None or system.constraints is not None:
        return False
    Q = system.points / np.linalg.norm(system.points, axis=1, keepdims=True)
    values = np.linalg.eigvalsh(Q.T @ Q)
    return bool(values[0] > _SPREAD * values[-1])


def _open_directions(
    seen: Seen, frame: Frame, kernels: Table, workers: int, system: BundleSystem | None
) -> tuple[int, int, float]:
    """Return how many directions beside the gauge N leaves open, and its least other eigenvalue.

    Those of the cameras, and those of single points, which spoil nothing else.

    In parameters in which W of the covariant damping is one, for which the basis does not matter.
    """
    try:
        # Where a camera or a point is all but undefined, numbers overflow: it is open.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            system = system or _normal_equations(seen, frame, kernels, workers)
            found = _measured(system, kernels)
    except np.linalg.LinAlgError:
        return 1, 0, 0.0
    return found if np.isfinite(found[2]) else (1, 0, 0.0)


def _normal_equations(seen: Seen, frame: Frame, kernels: Table, workers: int) -> BundleSystem:
    """Return the normal equations of what counts, in the best conditioned basis."""
    graph = ObservationGraph(seen.view, seen.point, seen.n, seen.m)
    own = Frame(frame.origins[seen.views], frame.scale)
    parts = camera_model("projective"), kernels, graph, own.points_in(seen.xy, seen.view)
    P = own.cameras_in(seen.P)
    P, Q = normalized().transformation(P, seen.Q).apply(P, seen.Q)
    problem = bundle_problem(*parts, seen.weights, workers=workers)
    return problem.linearize(BundleState(Estimate(P.reshape(-1, 12), Q), 0.0))


def _measured(system: BundleSystem, kernels: Table) -> tuple[int, int, float]:
    W = Covariant().blocks(system)
    # A point whose lines of sight are one leaves W singular, too.
    lifted = [
        blocks + 1e-12 * _mean_diagonal(blocks) * np.eye(blocks.shape[1])
        for blocks in (W.cameras, W.points)
    ]
    roots = [np.swapaxes(np.linalg.cholesky(blocks), 1, 2) for blocks in lifted]
    whitening = [np.asarray(np.linalg.inv(root)) for root in roots]
    p, q, moves = _freedom(system, kernels, roots)
    n, a = p.shape
    white = system.tied(*whitening)
    U = white.U + p[:, :, None] * p[:, None, :]
    open_points, V = _grounded(white.V + q[:, :, None] * q[:, None, :])
    T = whitening[1] @ np.asarray(np.swapaxes(np.linalg.inv(np.linalg.cholesky(V)), 1, 2))
    coupling = system.normal.coupling
    if n <= _FEW:
        less = coupling.schur(T, None)[0].dense().transpose(0, 2, 1, 3)
        S = -(np.swapaxes(whitening[0], 1, 2)[:, None] @ less @ whitening[0])
        S[np.arange(n), np.arange(n)] += U
        dense = S.transpose(0, 2, 1, 3).reshape(n * a, n * a)
        values = np.linalg.eigvalsh(dense + moves @ moves.T)
    else:
        shift = _SHIFT if coupling.direct else _SHIFT_ITERATIVE
        shifted, _ = reduced_system(
            system.normal, white.ties, T, None, U + shift * np.eye(a), shift
        )
        columns = _COLUMNS if coupling.direct else 2
        while True:
            values = _least(shifted, shift, moves, columns)
            if columns >= n * a // 2 or not coupling.direct or values[-1] > _ROUNDING:
                break
            columns *= 4
    open_cameras = int(np.count_nonzero(values <= _ROUNDING))
    return open_cameras, open_points, float(max(values[0], 0.0))


def _freedom(
    system: BundleSystem, kernels: Table, roots: list[Array]
) -> tuple[Array, Array, Array]:
    """Return unit directions of the scales, and the changes of basis as S knows them, (12 n, 15).

    What N does not see, S does not see in the cameras alone.
    """
    p = np.einsum("nij,nj->ni", roots[0], system.cameras)
    q = np.einsum("nij,nj->ni", roots[1], system.points)
    p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (p, q))
    estimate = system.model, kernels, system.cameras, system.points
    cameras = roots[0] @ generators(*estimate)[0]
    cameras = cameras - p[:, :, None] * np.einsum("ni,nik->nk", p, cameras)[:, None]
    moves = np.linalg.qr(cameras.reshape(p.size, -1))[0]
    return p, q, np.asarray(moves)


def _least(shifted: Bordered | Iterated, shift: float, moves: Array, columns: int) -> Array:
    """Return the least eigenvalues of S beside the gauge, from above: inverse iterations."""
    size = len(moves)
    X = np.random.default_rng(0).standard_normal((size, columns))
    for _ in range(_ITERATIONS):
        X = np.linalg.qr(X - moves @ (moves.T @ X))[0]
        Y = shifted.solve(X.reshape(-1, _CAMERA + 1, columns), np.zeros((0, columns)))[0]
        Y = Y.reshape(size, columns)
        Y -= moves @ (moves.T @ Y)
        # X^T S^-1 X has the inverse eigenvalues: Ritz values without a product with S.
        inverse = np.linalg.eigvalsh(0.5 * (X.T @ Y + Y.T @ X))[::-1]
        X = Y
    return np.asarray(1.0 / np.maximum(inverse, 1e-300) - shift)


def _grounded(V: Array) -> tuple[int, Array]:
    """Return how many directions of single points are open, and the blocks with these closed."""
    try:
        diagonal = np.einsum("nii->ni", np.linalg.cholesky(V + 1e-14 * np.eye(4)))
        thin = np.flatnonzero(diagonal.min(axis=1) ** 2 <= 1e3 * _ROUNDING)
    except np.linalg.LinAlgError:  # some block is singular to rounding: all are looked at
        thin = np.arange(len(V))
    if not len(thin):
        return 0, V
    values, vectors = np.linalg.eigh(V[thin])
    open_ = values <= _ROUNDING
    V = V.copy()
    V[thin] = (vectors * np.where(open_, 1.0, values)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return int(np.count_nonzero(open_)), V


def _mean_diagonal(blocks: Array) -> Array:
    return np.asarray(np.einsum("nii->n", blocks) / blocks.shape[1])[:, None, None]


def behind(seen: Seen, third: Array) -> int:
    """Return the number of observations whose point is behind the camera.

    The third coordinate of P Q is the depth times the scales of camera and point: there are signs
    of these for which all are positive, or else some point is behind a camera that sees it.
    """
    view, point, sign = seen.view, seen.point, np.sign(third)
    of_view = np.zeros(seen.n)
    of_view[np.argmax(np.bincount(view))] = 1.0
    before = -1
    for _ in range(seen.n + 20):
        of_point = np.sign(np.bincount(point, weights=sign * of_view[view]))
        of_view = np.sign(np.bincount(view, weights=sign * of_point[point]))
        wrong = int(np.count_nonzero(sign * of_view[view] * of_point[point] <= 0.0))
        if wrong in (0, before):
            break
        before = wrong
    return wrong
