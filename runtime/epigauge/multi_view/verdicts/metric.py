"""What can be said against calibrated and affine reconstructions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.diagnosis import Diagnosis, diagnosed
from epigauge.bundle.problem import BundleState
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import AffineReconstruction, MetricReconstruction
from epigauge.kernels import Table
from epigauge.multi_view.verdicts.distant import distance_flags, relative_depths
from epigauge.multi_view.verdicts.evidence import Evidence
from epigauge.multi_view.verdicts.front import BEHIND
from epigauge.multi_view.verdicts.gross import gross_flags, strayed_flags
from epigauge.multi_view.verdicts.perspective import affine_views
from epigauge.multi_view.verdicts.relief import flatness
from epigauge.multi_view.verdicts.shape import flat_scene, one_line
from epigauge.multi_view.verdicts.verdict import FITS, Verdict, poor_fit
from epigauge.multi_view.verdicts.words import largest, named, of_points, tangent_sizes
from epigauge.verdicts import ordered

__all__ = ["judged_metric"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Standard deviation of the depth and image of a camera's points, as a share of their size, above
#: which the noise leaves a change of the cameras open.
_WEAK = 0.3

#: Numbers of a camera before its intrinsics; part of an open direction that these must have.
_POSE, _PART = 6, 0.05

#: Share of its size that a metric quantity may be uncertain by before that is told.
_UNCERTAIN = 0.1


def judged_metric(
    evidence: Evidence,
    found: MetricReconstruction | AffineReconstruction,
    outcome: lm.Outcome[BundleState],
    kernels: Table,
    known: Mask,
    fixes_gauge: bool,
    bends: bool,
) -> Verdict:
    """Judge an adjusted metric or affine reconstruction.

    Parameters
    ----------
    evidence : Evidence
        Observations, and how the reconstruction fits them.
    found : MetricReconstruction or AffineReconstruction
        Cameras and points, at the minimum.
    outcome : Outcome
        How the minimisation ended.
    kernels : Table
        Back end.
    known : ndarray of bool, shape (m,)
        Points that are fixed.
    fixes_gauge : bool
        Whether anything fixed or known ties the reconstruction to its frame.
    bends : bool
        Whether the loss lets few observations bend the result: least squares.

    Returns
    -------
    Verdict
        Flags, rank, condition and weakest direction, and the number of observations that are not in
        front of their camera.
    """
    metric, n_behind = isinstance(found, MetricReconstruction), evidence.n_behind
    raised = {"behind the cameras"} if n_behind > BEHIND * evidence.count else set()
    system, rank = outcome.system, 0
    condition, weakest = float("inf"), ""
    tail, scale = evidence.tail, evidence.scale
    rms, behind = evidence.rms if bends else 0.0, n_behind / max(evidence.count, 1)
    if metric and poor_fit(evidence.misses, rms, scale, behind):
        raised.add("poor fit")
    if not np.isfinite(tail.sum_of_squares):  # measured points that the cameras have no image of
        raised.add("gross errors")
    elif isinstance(system, BundleSystem) and np.isfinite(outcome.state.cost):
        diagnosis = diagnosed(system, kernels, known, fixes_gauge)
        rank, condition = diagnosis.rank, diagnosis.condition
        share_free = max(1.0 - rank / max(2 * tail.count, 1), 1e-3)
        # Of two normal coordinates, the median distance is 1.1774 standard deviations.
        usual = tail.median / 1.1774 / float(np.sqrt(share_free))
        if bends:
            raised.update(gross_flags(tail, usual))
        else:
            every = evidence.of_views
            raised.update(strayed_flags(evidence.far_of_views, every, usual, scale))
        # A robust loss has given up gross errors, which are no noise of what it follows.
        rms = float(np.sqrt(tail.sum_of_squares / share_free / max(2 * tail.count, 1)))
        noise_px = rms if bends else usual
        # Affine cameras are computed with in other units of the image.
        noise = noise_px if metric else noise_px / scale
        sizes = tangent_sizes(system)
        weakest = named(system, noise * np.abs(diagnosis.cameras) / sizes)
        shares = noise * diagnosis.spread / sizes
        if diagnosis.open is not None:
            weakest = f"{largest(system, np.abs(diagnosis.open))} (undetermined)"
        group = of_points(diagnosis.points)
        weakest += f"; {group}" if group else ""
        flat = 0.0 if metric else flatness(found, noise_px)
        worst = float(shares.max(initial=0.0))
        if diagnosis.missing or flat > 1.0 or worst > 1.0:
            raised.update(("undetermined", *evidence.open()))
        elif flat > _WEAK or worst > _UNCERTAIN:
            raised.add("weak geometry")
        # Where the fit is bad, nothing is within its noise.
        if isinstance(found, MetricReconstruction) and usual < FITS * scale:
            least, told = max(usual, 1e-9 * scale), worst > _UNCERTAIN
            shares = least * diagnosis.spread / sizes
            causes = _causes(evidence, found, system, diagnosis, least, shares, told, known)
            raised.update(causes)
    return Verdict(ordered(raised), rank, n_behind, condition, weakest)


def _causes(
    evidence: Evidence,
    found: MetricReconstruction,
    system: BundleSystem,
    diagnosis: Diagnosis,
    noise_px: float,
    shares: Array,
    weak: bool,
    known: Mask,
) -> tuple[str, ...]:
    """Return what makes calibrated cameras weak, by name."""
    free = system.ties.n_shared > 0 or _refines(system)
    depths = relative_depths(system, noise_px, ~known)
    raised = list(distance_flags(evidence, found, depths, noise_px))
    opened = shares[:, _POSE:].max(initial=0.0) > _UNCERTAIN
    if diagnosis.open is not None:
        size = np.abs(diagnosis.open)
        opened = opened or size[:, _POSE:].max(initial=0.0) > _PART * size.max()
    if opened:
        raised.append("open intrinsics")
    if free and flat_scene(system, noise_px):
        raised.append("flat scene")
    if affine_views(evidence, found.X, noise_px):
        raised.append("near-affine")
    if (weak or diagnosis.missing or diagnosis.gauge == 1) and one_line(found.centres):
        raised.append("collinear centres")
    return tuple(raised)


def _refines(system: BundleSystem) -> bool:
    """Tell whether intrinsics of single views are refined."""
    A = system.ties.A
    more = system.normal.g_cameras.shape[1] > _POSE
    return bool(more if A is None else A[:, _POSE:].any())
