"""How many evaluations the two-view solver needs, by method and by choice of coordinates.

    python benchmarks/evaluations.py [--trials 40]

Scene of Bartoli & Sturm 2004, section 5.1.1, at five distances; each cell is the mean number of
evaluations of the cost and the share of trials not improved (1e-6) by any other row.
"""

from __future__ import annotations

import argparse
from unittest import mock

import epigauge as eg
import numpy as np
from epigauge import lm
from epigauge.two_view import conditioning, refine

DISTANCES = (6, 8, 12, 16, 20)

#: label: options of refine_fundamental, overrides of the conditioning, schedule
ROWS = {
    "default": ({}, {}, lm.Classic),
    "Gauss-Newton": ({"hessian": "gauss-newton"}, {}, lm.Classic),
    "joint (B&S Table 1)": ({"structure": "joint"}, {}, lm.Classic),
    "parameterization block": ({"parameterization": "block"}, {}, lm.Classic),
    "parameterization maps": ({"parameterization": "maps"}, {}, lm.Classic),
    "damping seber": ({"damping": "seber"}, {}, lm.Classic),
    "schedule Nielsen": ({}, {}, lm.Nielsen),
    "origin at the centroid": ({}, {"OFFSET": 0.0}, lm.Classic),
    "origin RMS/8 off": ({}, {"OFFSET": 0.25}, lm.Classic),
    "origin RMS/2 off": ({}, {"OFFSET": 1.0}, lm.Classic),
    "origin RMS off": ({}, {"OFFSET": 2.0}, lm.Classic),
    "RMS 0.5": ({}, {"RMS": 0.5, "OFFSET": 0.125}, lm.Classic),
    "RMS 1": ({}, {"RMS": 1.0, "OFFSET": 0.25}, lm.Classic),
    "RMS 4": ({}, {"RMS": 4.0, "OFFSET": 1.0}, lm.Classic),
}


def run(row: str, distance: float, seed: int) -> tuple[float, int]:
    """Return cost and evaluations of one trial."""
    options, coordinates, schedule = ROWS[row]
    if coordinates or schedule is not lm.Classic:  # the compiled loop has its own
        options = options | {"backend": "numpy"}
    scene = eg.two_view_scene(distance=distance, seed=seed)
    with (
        mock.patch.multiple(conditioning, **{"RMS": conditioning.RMS, **coordinates}),
        mock.patch.object(refine.lm, "Classic", schedule),
    ):
        result = eg.refine_fundamental(scene.x1, scene.x2, max_iter=300, **options)
    return result.cost, result.nfev


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40)
    trials = parser.parse_args().trials
    found = np.array(
        [[[run(row, d, seed) for seed in range(trials)] for d in DISTANCES] for row in ROWS]
    )
    best = found[..., 0].min(axis=0)
    print("| distance (m) |", " | ".join(map(str, DISTANCES)), "|")
    print("|---|" + "---|" * len(DISTANCES))
    for row, result in zip(ROWS, found, strict=True):
        evaluations = result[..., 1].mean(axis=1)
        share = 100.0 * (result[..., 0] <= best * (1.0 + 1e-6)).mean(axis=1)
        cells = [f"{e:.1f} / {s:.0f} %" for e, s in zip(evaluations, share, strict=True)]
        print(f"| {row} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
