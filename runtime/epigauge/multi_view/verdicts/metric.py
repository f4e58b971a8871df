"""What can be said against calibrated and affine reconstructions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.diagnosis import diagnosed
from epigauge.bundle.problem import BundleState
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import AffineReconstruction, MetricReconstruction
from epigauge.kernels import Table
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.verdicts.front import BEHIND
from epigauge.multi_view.verdicts.relief import flatness
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.multi_view.verdicts.words import largest, named
from epigauge.verdicts import ordered

__all__ = ["judged_metric"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Standard deviation of the depth and image of a camera's points, as a share of their size, above
#: which the noise leaves a change of the cameras open.
_WEAK = 0.3

#: Share of its size that a metric quantity may be uncertain by before that is told.
_UNCERTAIN = 0.1


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
        weakest, share = named(system, deviations)
        if diagnosis.open is not None:
            weakest = f"{largest(system, np.abs(diagnosis.open))} (undetermined)"
        flat = 0.0 if metric else flatness(found, noise_px * Frame.of(tracks).scale)
        if diagnosis.missing or flat > 1.0:
            raised.append("undetermined")
        elif flat > _WEAK or share > _UNCERTAIN:
            raised.append("weak geometry")
    return Verdict(ordered(raised), rank, n_behind, condition, weakest)
