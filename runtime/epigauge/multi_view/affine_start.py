"""A first affine reconstruction: by factoring the matrix of all image coordinates.

Where every view sees every point, a singular value decomposition is the maximum-likelihood solution
(Tomasi and Kanade). Where some are missing, they are filled in turn by what the factors predict,
and the engine ends what that begins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._arguments import as_count
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.cameras import AffineReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.tracks import Tracks

__all__ = ["initialize_affine"]

Array = NDArray[np.float64]

#: Rounds of filling in, starts at most, trial steps of each, and how near costs of one minimum are.
_ROUNDS, _TRIES, _STEPS, _SAME = 30, 8, 60, 1e-4

#: Most entries of the matrix that is factored.
_MOST = 50_000_000


def initialize_affine(
    tracks: Tracks, *, seed: int = 0, backend: str | None = None
) -> AffineReconstruction:
    """Reconstruct with affine cameras, without a start.

    Parameters
    ----------
    tracks : Tracks
        Observations, once a view and point.
    seed : int
        Of the random starts that are tried beside the first where points are missing in views.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.

    Returns
    -------
    AffineReconstruction
        Cameras and points to start `bundle_adjust` from; with every point in every view and equal
        weights already the minimum. Points have mean zero and unit covariance.

    Raises
    ------
    ArgumentError
        If a point is seen twice in one view, or the matrix of all views and points is too large.

    References
    ----------
    .. [1] C. Tomasi, T. Kanade, "Shape and motion from image streams under orthography: a
       factorization method", IJCV 9(2), 1992.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks("tracks.csv")  # doctest: +SKIP
    >>> eg.bundle_adjust(tracks, eg.initialize_affine(tracks))  # doctest: +SKIP
    """
    as_count("seed", seed, at_least=0)
    n, m, kernels = tracks.n_views, tracks.n_points, table(backend)
    if tracks.n_repeated:
        was = f"see {tracks.n_repeated} points again in one view"
        raise ArgumentError("tracks", was, "tracks.merged()[0]")
    if n * m > _MOST:
        raise ArgumentError("tracks", f"are of {n} x {m} views and points", f"at most {_MOST}")
    frame, model = Frame.of(tracks), camera_model("affine")
    q, weights = frame.conditioned(tracks), np.asarray(tracks.weights)
    graph = ObservationGraph(tracks.view, tracks.point, n, m)
    problem = bundle_problem(model, kernels, graph, q, weights, embedded=True)
    known = np.zeros((n, m), np.bool_)
    counts = weights > 0.0
    known[tracks.view[counts], tracks.point[counts]] = True
    seen = np.zeros((n, 2, m))
    seen[tracks.view[counts], :, tracks.point[counts]] = q.T[counts]
    rng = np.random.default_rng(seed)
    best, least = None, np.inf
    for k in range(1 if known.all() else _TRIES):
        filled = seen.copy()
        if k:
            filled += np.where(known[:, None], 0.0, rng.standard_normal(filled.shape))
        cameras, points = _factors(filled, known)
        cameras, points = best_conditioned(model, cameras, points)[1:]
        try:
            stopping = lm.Stopping(ftol=1e-6, xtol=0.0, gtol=0.0, max_iter=_STEPS)
            start = Estimate(cameras, points)
            found = lm.minimize(problem, start, Covariant(), lm.Adaptive(), stopping).state
        except np.linalg.LinAlgError:
            continue
        again = abs(found.cost - least) <= _SAME * least
        if best is None or found.cost < least:
            best, least = found, found.cost
        if again or found.cost <= problem.floor:
            break
    if best is None:
        raise ArgumentError("tracks", "lead to no affine start", "longer tracks, or a start")
    moved = best_conditioned(model, best.cameras, best.points)[1:]
    P = frame.cameras_out(moved[0].reshape(-1, 3, 4))
    return AffineReconstruction(P[:, :2], moved[1])


def _factors(filled: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return cameras (n, 12) and points (m, 3) of a matrix (n, 2, m), unknown entries filled in."""
    n, _, m = filled.shape
    missing = ~known[:, None] & np.ones((1, 2, 1), np.bool_)
    for _ in range(_ROUNDS if missing.any() else 1):
        means = filled.mean(axis=2)
        matrix = (filled - means[:, :, None]).reshape(2 * n, m)
        # The smaller of both Gram matrices has the factors, too.
        if 2 * n <= m:
            left = np.linalg.eigh(matrix @ matrix.T)[1][:, -3:]
        else:
            right = np.linalg.eigh(matrix.T @ matrix)[1][:, -3:]
            left = np.linalg.qr(matrix @ right)[0]
        points = left.T @ matrix
        predicted = (left @ points).reshape(n, 2, m) + means[:, :, None]
        filled = np.where(missing, predicted, filled)
    cameras = np.zeros((n, 3, 4))
    cameras[:, :2, :3], cameras[:, :2, 3] = left.reshape(n, 2, 3), means
    cameras[:, 2, 3] = 1.0
    return cameras.reshape(n, 12), np.ascontiguousarray(points.T)
