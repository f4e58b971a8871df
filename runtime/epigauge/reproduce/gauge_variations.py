"""What section 7.1 of Bartoli 2003 mentions without numbers: from weak to strong configurations."""

from __future__ import annotations

from typing import Any

import numpy as np

from epigauge.multi_view.frame import Frame
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.reproduce.gauge_runs import LABELS, GaugeStudy, lowest, perturbed
from epigauge.reproduce.report import Claim, Section, Table, lower
from epigauge.scenes import multi_view_scene

__all__ = ["variations"]

#: What is varied, from weak to strong: argument of the scene, or the error of the start.
_VARIED: dict[str, tuple[str, tuple[float, ...]]] = {
    "n_points": ("points", (15, 30, 100, 200)),
    "n_views": ("cameras", (3, 5, 8, 12)),
    "baseline": ("baseline, m", (0.25, 0.5, 1.0, 3.0)),
    "visible": ("share seen", (0.5, 0.65, 0.8, 1.0)),
    "start": ("error of the start", (0.05, 0.02, 0.01, 0.0)),
}

#: Methods of the paper, and both forms of ours.
_METHODS = (
    *("free", "hartley", "bartoli", "faugeras", "mclauchlan", "kanatani", "gauge_invariant"),
    *("covariant_alone", "covariant"),
)
_COMPARED = len(_METHODS) - 2


def variations(study: GaugeStudy) -> Section:
    """Count iterations while one quantity is varied; half of the trials are used."""
    trials = max(1, study.trials // 2)
    tables, claims = [], []
    for name in study.track(list(_VARIED), "variations"):
        label, values = _VARIED[name]
        steps = np.zeros((len(_METHODS), len(values), trials))
        error = np.zeros_like(steps)
        for j, value in enumerate(values):
            for k in range(trials):
                tracks, start = _configuration(study.seed + k, name, value)
                for i, method in enumerate(_METHODS):
                    result = study.adjust(tracks, start, method)
                    steps[i, j, k], error[i, j, k] = result.nit, result.rms_px
        mean, reached = steps.mean(axis=2), 100.0 * lowest(error).mean(axis=(0, 2))
        rows: list[tuple[str | float, ...]] = [
            (LABELS[method], *map(float, row)) for method, row in zip(_METHODS, mean, strict=True)
        ]
        rows.append(("runs at the lowest cost (%)", *map(float, reached)))
        header = ("method", *[f"{value:g}" for value in values])
        caption = f"Mean number of iterations by {label}."
        tables.append(Table(f"varied_{name}", caption, header, rows, ("", ".1f")))
        weak, strong = (
            float(mean[:_COMPARED, j].max() / mean[:_COMPARED, j].min()) for j in (0, -1)
        )
        claims.append(
            Claim(
                "section 7.1, not shown",
                f"stronger configurations reduce the discrepancies: {label}",
                lower(strong, weak, 0.05),
                f"largest over smallest mean of the paper's methods: {weak:.2f} at "
                f"{values[0]:g}, {strong:.2f} at {values[-1]:g}",
            )
        )
    return Section(
        "Not shown in the paper: points, cameras, baseline, visibility, start",
        [
            "Section 7.1 says that these were varied, without numbers. d = 0.5 and the rest as "
            f"above, one quantity at a time, from weak to strong; {trials} trials. A start with an "
            "error: every camera and point of the initial reconstruction in the normalised basis, "
            "plus a random vector of that share of its norm.",
            *tables,
        ],
        claims,
    )


def _configuration(seed: int, name: str, value: float) -> tuple[Tracks, Reconstruction]:
    """Return scene and start of a trial."""
    varied: dict[str, Any] = {}
    if name != "start":
        varied[name] = int(value) if name.startswith("n_") else value
    tracks = multi_view_scene(seed=seed, **varied).tracks
    start = initialize(tracks)
    if name != "start" or value == 0.0:
        return tracks, start
    return tracks, perturbed(np.random.default_rng(seed), Frame.of(tracks), start, value, 1.0)
