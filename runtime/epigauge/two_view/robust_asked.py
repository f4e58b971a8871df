"""What is told of an F of raw matches when it is asked for: verdict, noise and confidence."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view import quick
from epigauge.two_view.chance import chance_agreement
from epigauge.two_view.confidence import Confidence, Signs
from epigauge.two_view.consensus import Agreement
from epigauge.two_view.covariance import untruncated
from epigauge.two_view.evidence import Evidence
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.robust_fit import Fit, Raw, at_most
from epigauge.two_view.suspicion import log10_alarms
from epigauge.verdicts import ordered

__all__ = ["Asked"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Asked:
    """What is computed of a fit when it is asked for.

    Attributes
    ----------
    raw, weights, fit
        The matches, their weights (m,), and what was fitted.
    is_limited : bool
        Whether the caller gave the largest distance of an inlier.
    cut_px : float or None
        Where the noise is to be known without the cut that the largest distance makes.
    """

    raw: Raw
    weights: Array
    fit: Fit
    is_limited: bool
    cut_px: float | None

    @cached_property
    def near(self) -> tuple[Agreement, float, Mask]:
        """The agreement of all, the distance up to which a match agrees, and which do."""
        agreed, bound = self.fit.agreement, self.fit.limit
        if not self.is_limited:  # real noise has heavier tails than three deviations of its core
            agreed = self.raw.consensus.judge(agreed.F, agreed.sigma, agreed.share)
            bound = max(bound, at_most(agreed.mixture.even))
        near = agreed.inliers(bound) & self.raw.is_near
        return agreed, bound, near  # where fewer than 8, "no common geometry"

    @cached_property
    def among_all(self) -> Evidence:
        """The evidence of all matches."""
        _, bound, agreeing = self.near
        raw, own = self.raw, self.fit.refined._evidence
        return own.among(raw.x1, raw.x2, self.weights, agreeing, bound * raw.frame.scale)

    def judged(self) -> SimpleNamespace:
        """Return flags and success."""
        raw, is_open, refined = self.raw, self.fit.is_open, self.fit.refined
        agreed, bound, agreeing = self.near
        pair = vars(refined).get("_pair")
        if pair is not None and not is_open:  # cheap tests, where they suffice
            scale = raw.frame.scale
            flags, success = quick.verdict_of_raw(
                *(pair, (raw.x1, raw.x2, self.weights), scale * agreed.signed, agreeing),
                bound * scale,
                partial(chance_agreement, raw.table, agreed.F, *raw.q, bound),
            )
            if flags is not None:
                return SimpleNamespace(flags=flags, success=success)
        verdict = refined.judged(self.among_all)
        if is_open:
            flags = ordered((*verdict.flags, "undetermined"))
            verdict = SimpleNamespace(flags=flags, success=False)
        return verdict

    @cached_property
    def rest(self) -> SimpleNamespace:
        """All fields but those above."""
        return _rest(self.fit.refined, self.cut_px)

    def confident(self) -> SimpleNamespace:
        """Return how likely the geometry is that of the scene."""
        alarms, used = log10_alarms(self.among_all), self.fit.used
        signs = Signs.of(self.rest._uncertainty, self.raw.x1[used], self.raw.x2[used], alarms)
        return SimpleNamespace(_signs=signs, **vars(Confidence.of(signs)))


def _rest(refined: FundamentalResult, limit_px: float | None) -> SimpleNamespace:
    """Return all fields but flags and success, the noise as a limit cuts it off undone."""
    names = (entry.name for entry in fields(refined) if entry.name not in ("flags", "success"))
    known = {name: getattr(refined, name) for name in names}
    if limit_px is not None and refined.noise_px > 0.0:
        # The threshold has cut off the tails of the right matches.
        unit = math.sqrt(refined._evidence.unit)  # the limit is one of distances
        noise_px = unit * untruncated(refined.noise_px / unit, limit_px)
        factor = noise_px / refined.noise_px
        spread = replace(refined._uncertainty, root=factor * refined._uncertainty.root)
        known |= {"noise_px": noise_px, "_uncertainty": spread}
        known["covariance"] = spread.of_fundamental()
    return SimpleNamespace(**known)
