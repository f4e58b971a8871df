"""A first reconstruction: by registering cameras in turn, or by factoring all views at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._arguments import as_choice, as_count
from epigauge._options import Initialization
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.cameras import camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table, table
from epigauge.multi_view.factorization import factorized
from epigauge.multi_view.first_pair import TooFewInCommon
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.registration import registered
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import EFFICIENT, Loss, median, robust_scale

__all__ = ["initialize"]

Array = NDArray[np.float64]

#: A registration has failed whose median residual is beyond this share of the RMS of the image
#: coordinates.
_FAILED = 0.05

#: Factorizations tried at most, trial steps of each, and how near costs of one minimum are.
_TRIES, _TRIED, _SAME = 12, 40, 0.02


def initialize(
    tracks: Tracks,
    *,
    method: Initialization = "auto",
    incremental: bool = False,
    robust: bool = False,
    seed: int = 0,
    backend: str | None = None,
) -> Reconstruction:
    """Reconstruct without a start, well enough for `bundle_adjust` to begin from.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    method : {"auto", "registration", "factorization"}
        "registration" begins with two views of strong geometry and registers the other cameras in
        turn. "factorization" needs no such views: it minimises a bilinear error over all cameras at
        once, from random ones. "auto" registers; where that is refused (tracks too short to carry
        a camera over), or half the residuals are beyond a twentieth of the RMS of the image
        coordinates, it factors from several random starts, robustly and plainly, adjusts each a
        little, and keeps the lowest once it has been reached twice. Weights count when factoring;
        when registering, observations of weight zero are left out where enough others remain.
    incremental : bool
        When registering, adjust everything known, by a few robust steps, with each camera: slower,
        but errors do not add up over long sequences.
    robust : bool
        Against gross errors in the tracks, ten per cent or more. When registering: F, cameras and
        points are those that most observations agree on, among many proposed by a few, and what
        is known is adjusted with each camera that hangs on few others. (Without, a Cauchy loss with
        an estimated scale bears with few gross errors.) When factoring: weigh them down. Without
        them, the plain factorization leads to the best minimum more often.
    seed : int
        When factoring, of the random cameras: another one is another chance.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.

    Returns
    -------
    Reconstruction
        All cameras and points, to start `bundle_adjust` from.

    Raises
    ------
    ArgumentError
        With method "registration", if no two views have enough points in common, or a view shares
        fewer than 6 points with those before it; with "auto", if factoring fails, too.

    References
    ----------
    .. [1] J. H. Hong, C. Zach, "pOSE: pseudo object space error for initialization-free bundle
       adjustment", CVPR 2018.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.multi_view_scene(seed=1).tracks
    >>> eg.initialize(tracks).rms_px(tracks) < 2.0
    True
    """
    as_choice("method", method, ("auto", "registration", "factorization"))
    as_count("seed", seed, at_least=0)
    kernels, frame = table(backend), Frame.of(tracks)
    if method == "factorization":
        return _factored(tracks, frame, kernels, robust, seed)
    found, refused = None, None
    try:
        found = registered(tracks, frame, kernels, incremental, robust)
    except TooFewInCommon as error:
        if method == "registration":
            raise
        refused = error
    if found is not None:
        residual = _median_residual(tracks, found)
        if method == "registration" or residual <= _FAILED * frame.scale:
            return found
    try:
        other = _best_factored(tracks, frame, kernels, seed)
    except ArgumentError:
        raise refused or ArgumentError(
            "tracks", "lead to no start", "longer tracks, or a start"
        ) from None
    if found is None:
        return other
    return other if _median_residual(tracks, other) < residual else found


def _factored(
    tracks: Tracks, frame: Frame, kernels: Table, robust: bool, seed: int
) -> Reconstruction:
    layout = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    weights = np.asarray(tracks.weights)
    q = frame.conditioned(tracks)
    P, Q = factorized(kernels, layout, q, weights, seed=seed, robust=robust)
    return Reconstruction(frame.cameras_out(P), Q)


def _best_factored(tracks: Tracks, frame: Frame, kernels: Table, seed: int) -> Reconstruction:
    """Return the best of several factorizations, each adjusted a little.

    A network of short tracks has many minima. The lowest of all that was tried is taken once two
    starts have led to it; where it is found only once, after so many starts.
    """
    layout = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    weights, q = np.asarray(tracks.weights), frame.conditioned(tracks)
    projective = camera_model("projective")
    problem = bundle_problem(projective, kernels, layout, q, weights, embedded=True)
    stopping = lm.Stopping(ftol=1e-4, xtol=0.0, gtol=0.0, max_iter=_TRIED)
    best, least = None, np.inf
    for k in range(_TRIES):
        P, Q = factorized(kernels, layout, q, weights, seed=seed + k // 2, robust=k % 2 == 0)
        if best is None:
            distances = problem.linearizer.distances(P.reshape(-1, 12), Q)
            scale = EFFICIENT["cauchy"] * robust_scale(distances)
            loss = Loss("cauchy", max(float(np.nan_to_num(scale, posinf=1.0)), 1e-12))
            problem = replace(problem, linearizer=problem.linearizer.with_loss(loss))
        try:
            moved = best_conditioned(projective, P.reshape(-1, 12), Q)[1:]
            found = lm.minimize(problem, Estimate(*moved), Covariant(), lm.Classic(), stopping)
        except np.linalg.LinAlgError:
            continue
        again = best is not None and abs(found.state.cost - least) <= _SAME * least
        if best is None or found.state.cost < least:
            best, least = found.state, found.state.cost
        if again:
            break
    if best is None:
        raise ArgumentError("tracks", "lead to no start", "longer tracks, or a start")
    return Reconstruction(frame.cameras_out(best.cameras.reshape(-1, 3, 4)), best.points)


def _median_residual(tracks: Tracks, found: Reconstruction) -> float:
    distances = np.linalg.norm(tracks.xy - found.project(tracks), axis=1)
    return median(np.nan_to_num(distances[tracks.weights > 0.0], nan=np.inf))
