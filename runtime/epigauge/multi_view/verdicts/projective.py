"""What can be said against projective reconstructions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.solve import BundleSystem
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.parallax import parallax_flags
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.counting import (
    CAMERA,
    GAUGE,
    POINT,
    missing_beside,
    missing_by_count,
)
from epigauge.multi_view.verdicts.front import BEHIND, behind
from epigauge.multi_view.verdicts.gross import TailOfArrays, gross_flags, strayed_flags
from epigauge.multi_view.verdicts.network import why_open
from epigauge.multi_view.verdicts.perspective import affine_pairs
from epigauge.multi_view.verdicts.rank import open_directions, suits
from epigauge.multi_view.verdicts.verdict import FITS, Verdict, poor_fit
from epigauge.multi_view.verdicts.words import of_views
from epigauge.two_view.losses import robust_scale
from epigauge.verdicts import ordered

__all__ = ["judged"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

#: Standard deviation of the depth and image of a camera's points, as a share of their size, above
#: which the noise leaves a change of the cameras open.
_WEAK = 0.3

#: Share of single points that may be open without the rest being called undetermined.
_OPEN = 0.05


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
    full = CAMERA * (seen.n + lost) + POINT * seen.m - GAUGE
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        h = np.einsum("nij,nj->ni", seen.P[seen.view], seen.Q[seen.point])
        distances = np.linalg.norm(h[:, :2] / h[:, 2:] - seen.xy, axis=1)
    n_behind = behind(seen, h[:, 2])
    if not np.isfinite(distances).all():  # a point in a focal plane: there is nothing to measure
        return Verdict(("undetermined",), 0, n_behind)
    frame = Frame.of(tracks)
    if len(seen.view) < len(tracks) or not (isinstance(system, BundleSystem) and suits(system)):
        system = None
    held = None
    if fixed is not None:
        held = np.isin(seen.views, fixed[0]), np.isin(seen.points, fixed[1])
    how = frame, kernels, workers, system, held
    of_cameras, of_points, weakest, parts = open_directions(seen, *how)
    if held is None:
        of_cameras = max(missing_by_count(seen), of_cameras)
    of_cameras += CAMERA * lost
    views, points = (int(np.count_nonzero(part)) for part in held or ((), ()))
    if fixed is not None:
        full -= CAMERA * views + POINT * points
        full += GAUGE - missing_beside((found.P[fixed[0]], found.Q[fixed[1]]))
    if views == len(found.P):
        of_cameras, weakest = 0, 1.0
    N = len(distances)
    redundancy = max(2 * N - full, 1) / (2 * N)
    # Of two normal coordinates, the median distance is 1.1774 standard deviations.
    noise_px = robust_scale(distances) / 1.4826 / 1.1774 / float(np.sqrt(redundancy))
    information = max(weakest, 1e-300) * N / seen.n
    deviation = noise_px / frame.scale / float(np.sqrt(information))
    # Where the fit is bad, nothing is within its noise.
    fits = noise_px < FITS * frame.scale
    judge = fits and views < len(found.P)
    raised = set(parallax_flags(seen, noise_px)) if judge else set()
    images = h[:, :2] / h[:, 2:]
    if judge and not raised and affine_pairs(seen, images, noise_px):
        raised.add("near-affine")
    if bends:
        raised.update(gross_flags(TailOfArrays(distances, seen.xy), noise_px))
    else:
        every = np.bincount(seen.view, minlength=seen.n)

        def far_of_views(limit: float) -> Indices:
            return np.bincount(seen.view[distances > limit], minlength=seen.n)

        raised.update(strayed_flags(far_of_views, every, noise_px, frame.scale))
    if of_cameras or of_points > _OPEN * seen.m:
        raised.update(("undetermined", *why_open(tracks, rejected)))
    elif of_points or deviation > _WEAK:
        raised.add("weak geometry")
    middle = float(np.median(distances))
    with np.errstate(over="ignore"):
        rms = float(np.sqrt(np.mean(distances**2) / 2.0)) if bends else 0.0
    if poor_fit(lambda limit: middle > limit, rms, frame.scale, n_behind / N):
        raised.add("poor fit")
    if n_behind > BEHIND * N:
        raised.add("behind the cameras")
    condition = float("inf") if of_cameras or not weakest > 0.0 else 1.0 / weakest
    rank = full - of_cameras - of_points
    words = of_views(parts, seen.views) + (" (undetermined)" if of_cameras else "")
    return Verdict(ordered(raised), rank, n_behind, condition, words)
