"""How much observations count against priors: by the noise of the image, given or estimated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from epigauge.bundle.observations import whitened
from epigauge.multi_view.tracks import Tracks

if TYPE_CHECKING:
    from epigauge.multi_view.adjust import BundleResult

__all__ = ["with_estimated_noise"]

#: Adjustments at most, and the relative change of the noise with which they end.
_ROUNDS, _SETTLED = 8, 1e-3

#: Noise below this share of the image coordinates is rounding: exact images would outweigh all.
_LEAST = 1e-9


def with_estimated_noise(
    adjust: Callable[[float, object], BundleResult], tracks: Tracks, start: object
) -> BundleResult:
    """Adjust again and again with the noise that the residuals of the last adjustment show.

    Parameters
    ----------
    adjust : callable
        Adjusts with a noise, in pixels, from a start.
    tracks : Tracks
        Observations.
    start : MetricReconstruction
        Where to begin.

    Returns
    -------
    BundleResult
        The last one. The noise is sqrt(sum of weighted squares / (2 N - rank)), N being the number
        of observations that count.
    """
    noise_px = tracks.unit
    counted = 2 * int(np.count_nonzero(tracks.weights))
    least = _LEAST * float(np.abs(tracks.xy).max())
    for _ in range(_ROUNDS):
        found = adjust(noise_px, start)
        if found.status == -2:
            break
        start = found.reconstruction
        residuals = whitened(tracks.whitening, found.fun.T)
        squares = float(np.sum(tracks.weights * residuals**2))
        told = max(float(np.sqrt(squares / max(counted - found.rank, 1))), least)
        settled = abs(told - noise_px) <= _SETTLED * noise_px
        noise_px = told
        if settled or not np.isfinite(noise_px):
            break
    return replace(found, noise_px=noise_px)
