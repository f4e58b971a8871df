"""What an adjusted scene is worth: standard deviations of focal lengths, and flags."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import camera_model
from epigauge.errors import ArgumentError
from epigauge.metric.checks import outside
from epigauge.metric.deviation import (
    beside_the_bend,
    beside_the_held,
    beside_the_model,
    focal_lengths_of,
    known_to,
    turn_std,
)
from epigauge.metric.motion import motion_flags
from epigauge.metric.pair import OPEN, WEAK
from epigauge.metric.relief import flat
from epigauge.metric.result import MetricUpgrade
from epigauge.metric.scene import Images
from epigauge.metric.search import Fit, Search, metric_of
from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.uncertainty import covariance
from epigauge.two_view.losses import median
from epigauge.verdicts import FLAGS, ordered, usable

__all__ = ["judged", "noise_px"]

Array = NDArray[np.float64]

#: Median distance of two normal coordinates of standard deviation one.
_MEDIAN = 1.1774

#: Motions of which the focal length can hang on what the model says of the lens.
_CRITICAL = {"one rotation axis", "one viewing point"}


def judged(
    tracks: Tracks,
    images: Images,
    search: Search,
    fit: Fit,
    bundle: BundleResult,
    backend: str | None,
) -> MetricUpgrade:
    """Return the result of an adjustment, with standard deviations and flags."""
    found, model = metric_of(bundle), camera_model(search.camera)
    focal, known = focal_lengths_of(found), None
    weights = np.where(bundle.rejected, 0.0, tracks.weights)
    kept = tracks.weighted(weights)
    flags, turned, factor = set(bundle.flags), 0.0, 1.0
    std, beside = np.full(len(focal), np.inf), np.zeros(len(focal))
    try:
        options: Any = {"refine": fit.refined, "backend": backend}
        priors = tuple(prior for prior in search.priors if prior.name in fit.refined)
        if priors:
            options |= {"priors": priors, "noise_px": noise_px(bundle, tracks, weights == 0.0)}
        known = covariance(kept, found, **options)
        std, factor, erroneous = known_to(known, float(np.median(images.unit)))
        if fit.refined != model.adjusted:
            beside = beside_the_held(kept, known, float(np.median(images.unit)), options)
        elif not search.priors:
            beside = beside_the_model(kept, known, backend, search.options["workers"])
        if erroneous:
            flags.add("model error")
    except ArgumentError:
        flags.add("undetermined")
    with np.errstate(invalid="ignore"):
        share = np.nan_to_num(std / focal, nan=np.inf)
    # By the noise alone: what a lens does beside tells nothing of the motion.
    if known is not None and (share > WEAK * factor).any():
        turned = turn_std(known)
    motion = set(motion_flags(found, images, turned))
    if motion & _CRITICAL and known is not None and not search.priors:
        bent = beside_the_bend(kept, known, options)
        beside = np.hypot(beside, bent)
        if (bent > WEAK * focal).any():
            flags.add("critical motion")
    if (np.hypot(share, beside / focal) > WEAK).any():
        flags.add("weak focal length")
    if (share > OPEN * factor).any():
        flags.add("undetermined")
    elif search.priors:  # these determine what the motion does not
        motion.discard("pure translation")
    flags |= motion
    unit = float(np.median(images.unit))
    if "pure rotation" not in flags and flat(
        kept, found, noise_px(bundle, tracks, weights == 0.0), unit
    ):
        flags.add("planar scene")
    if outside(tracks, images):
        flags.add("outside the images")
    of_sample = np.isin(tracks.point, search.sample.points)
    if search.misfit(fit, median(np.linalg.norm(bundle.fun[of_sample], axis=1))):
        flags.add("unlike cameras")
    std = np.hypot(std, beside)
    listed = ordered(flags)
    spoiling = [f"{name}: {FLAGS[name].sentence}" for name in listed if not usable([name], "views")]
    one = len(focal) == 1
    return MetricUpgrade(
        reconstruction=found,
        focal_px=float(focal[0]) if one else focal,
        focal_std_px=float(std[0]) if one else std,
        flags=listed,
        success=bundle.status > 0 and not spoiling,
        message="; but ".join([bundle.message.split("; but ")[0], *spoiling]),
        rms_px=_rms_px(bundle, weights),
        noise_px=float("nan") if known is None else known.noise_px,
        rejected=bundle.rejected,
        refined=fit.refined,
        candidates=fit.candidates,
        bundle=bundle,
        covariance=known,
    )


def noise_px(bundle: BundleResult, tracks: Tracks, aside: NDArray[np.bool_]) -> float:
    """Return the standard deviation of a coordinate of what is not set aside, robustly."""
    distances = np.linalg.norm(bundle.fun[~aside], axis=1)
    unknowns = 6 * tracks.n_views + 3 * len(np.unique(tracks.point[~aside]))
    free = max(1.0 - unknowns / max(2 * len(distances), 1), 0.05)
    return max(median(distances) / _MEDIAN / float(np.sqrt(free)), 1e-9)


def _rms_px(bundle: BundleResult, weights: Array) -> float:
    kept = bundle.fun[weights > 0.0]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")
