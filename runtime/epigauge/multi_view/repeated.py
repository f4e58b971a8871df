"""Adjustment of tracks that see a point several times in one view, as COLMAP's may."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from epigauge import lm
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Tracks

P = ParamSpec("P")
Result = TypeVar("Result")


def merging_sightings(
    adjust: Callable[Concatenate[Tracks, P], Result],
) -> Callable[Concatenate[Tracks, P], Result]:
    """Let an adjustment that wants one observation of a point in a view take several.

    Their weighted mean has the same least squares solution, and costs less by a constant: the
    result and its history have the cost of all observations.

    Parameters
    ----------
    adjust : callable
        `bundle_adjust`.

    Returns
    -------
    callable
        The same, which refuses robust costs of such tracks.
    """

    @wraps(adjust)
    def adjusted(tracks: Tracks, *args: P.args, **kwargs: P.kwargs) -> Result:
        if not isinstance(tracks, Tracks) or not tracks.n_repeated:
            return adjust(tracks, *args, **kwargs)
        if kwargs.get("loss", "linear") != "linear" or kwargs.get("robust"):
            was = f"see {tracks.n_repeated} points again in one view, with a robust cost"
            raise ArgumentError("tracks", was, "the linear loss, or load_scene(repeated='first')")
        merged, constant = tracks.merged()

        def whole(row: lm.Row) -> lm.Row:
            return replace(row, cost=row.cost + constant)

        callback: Any = kwargs.get("callback")
        if callback is not None:
            kwargs["callback"] = lambda row: callback(whole(row))
        result: Any = adjust(merged, *args, **kwargs)
        found = result.reconstruction
        residuals = tracks.xy - found.project(tracks)
        n_behind = result.n_behind
        if isinstance(found, MetricReconstruction):
            n_behind = int(np.count_nonzero(~(found.depths(tracks) > 0.0)))
        made: Result = replace(
            result,
            cost=result.cost + constant,
            fun=residuals,
            rms_px=float(np.sqrt(np.mean(residuals[tracks.weights > 0.0] ** 2))),
            n_behind=n_behind,
            rejected=np.zeros(len(tracks), dtype=np.bool_),
            history=tuple(map(whole, result.history)),
        )
        return made

    same: Any = adjusted  # `wraps` keeps the names of arguments, which its type does not
    return same  # type: ignore[no-any-return]
