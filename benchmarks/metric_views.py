"""Metric cameras: time a step and a whole `bundle_adjust`, against the machine's limit and peers.

    python benchmarks/metric_views.py [--runs N] [--peers]

BAL problems with their own camera, from the file's start, and the sequence lu_sphinx with known
calibration, from its reference. Times are those of the processor in one thread, best of several
runs, scaled to 50 GFLOP/s of dgemm beside. The limit is the arithmetic of the textbook's step: a
product (d x 3)(3 x d) for each pair of observations of one point, and the Cholesky factor of the
cameras' system. Peers are run with one thread from the same start.

The total is that of `bundle_adjust`; the verdict (flags, success), made when it is asked for,
stands beside. "to goal" is a whole call of as many steps as lead to a cost asked for.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from _measure import described, machine, markdown
from many_views import dgemm_rate

#: What the milliseconds are scaled to.
_UNIT = 50e9


def folder() -> Path:
    """Return where the data are."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("EPIGAUGE_DATA", default))


def bal(name: str) -> tuple[eg.Tracks, eg.MetricReconstruction, dict[str, Any]]:
    """Return a BAL problem."""
    return *eg.load_scene(folder() / "bal" / name), {}


def sphinx() -> tuple[eg.Tracks, eg.MetricReconstruction, dict[str, Any]]:
    """Return 70 views with known calibration, from a reconstruction of the same tracks."""
    with np.load(folder() / "olsson_lu_sphinx" / "tracks.npz") as file:
        view, point, xy, K = (file[name] for name in ("view", "point", "xy", "K"))
    with np.load(folder() / "olsson_lu_sphinx" / "reference.npz") as file:
        R, t, X = (file[name] for name in ("R", "t", "X"))
    known = np.isfinite(X[:, 0])
    rows = known[point]
    number = np.cumsum(known) - 1
    tracks = eg.Tracks(view[rows], number[point[rows]], xy[rows].astype(float))
    params = np.array([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]])
    cameras = eg.Cameras("PINHOLE", params, np.zeros(len(R), np.intp))
    return tracks, eg.MetricReconstruction(R, t, X[known], cameras), {"refine": "pose"}


#: Costs to be reached.
GOALS = {"BAL 49": 13344.25, "BAL 16": 18033.91}

#: What there is, entries of a camera computed with, and how to get it.
PROBLEMS: dict[str, tuple[int, Callable[[], Any]]] = {
    "BAL 49": (9, lambda: bal("problem-49-7776-pre.txt.bz2")),
    "BAL 16": (9, lambda: bal("problem-16-22106-pre.txt.bz2")),
    "lu_sphinx, K known": (6, sphinx),
}


def main() -> int:
    """Run the problems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument(
        "--peers", action="store_true", help="pycolmap, too, where it has the camera: minutes"
    )
    options = parser.parse_args()
    rate = dgemm_rate(time.process_time)
    print(described(machine(("pycolmap",))))
    print(f"\ndgemm: {rate / 1e9:.1f} GFLOP/s\n", flush=True)
    rows, scale = [], rate / _UNIT
    for what, (d, make) in PROBLEMS.items():
        try:
            tracks, start, how = make()
        except FileNotFoundError as error:
            print(f"{what}: {error}.\n")
            continue
        limit = 1e3 * operations(tracks, d) / _UNIT
        whole, step, verdict, found = measured(tracks, start, how, options.runs)
        goal = to_goal(tracks, start, how, options.runs, found, GOALS.get(what, found.cost))
        rows.append(
            [
                what,
                f"{len(tracks):,}",
                f"{1e3 * step:.1f} ({1e3 * step * scale:.1f})",
                f"{limit:.1f}",
                *(f"{1e3 * t:.0f} ({1e3 * t * scale:.0f})" for t in (whole, verdict, goal)),
                str(found.nit),
                f"{found.cost:.4f}",
            ]
        )
        colmap = start.cameras.model.isupper()
        if options.peers and colmap and importlib.util.find_spec("pycolmap") is not None:
            rows.append(by_pycolmap(what, tracks, start, d))
    header = ["problem", "observations", "ms / step (at 50 GFLOP/s)", "limit ms"]
    header += ["total ms", "verdict ms", "to goal ms"]
    print(markdown([*header, "steps", "cost"], rows))
    return 0


def measured(tracks: eg.Tracks, start: Any, how: dict[str, Any], runs: int) -> tuple[Any, ...]:
    """Return seconds of the processor in all, a step and of the verdict, and the result.

    A step is the difference of a whole run and one of two steps, by their number: the longest that
    there is, for times of single runs scatter by more than a step takes.
    """
    spent: dict[int, list[float]] = {2: [], 100: []}
    verdicts = []
    found: Any = None
    for _ in range(runs):
        for steps, times in spent.items():
            found = None  # what was found before is not released in the time
            begun = time.process_time()
            found = eg.bundle_adjust(tracks, start, max_iter=steps, ftol=1e-8, **how)
            times.append(time.process_time() - begun)
        begun = time.process_time()
        found.judge()
        verdicts.append(time.process_time() - begun)
    whole = min(spent[100])
    return whole, (whole - min(spent[2])) / (found.nit - 2), min(verdicts), found


def to_goal(
    tracks: eg.Tracks, start: Any, how: dict[str, Any], runs: int, found: Any, goal: float
) -> float:
    """Return seconds of the processor of a whole call that ends with the first cost so low."""
    steps = next((row.iteration for row in found.history if row.cost <= goal), found.nit)
    spent = []
    for _ in range(runs):
        begun = time.process_time()
        eg.bundle_adjust(tracks, start, max_iter=steps, ftol=1e-8, **how)
        spent.append(time.process_time() - begun)
    return min(spent)


def operations(tracks: eg.Tracks, d: int) -> float:
    """Return the operations of the textbook's step; see the module."""
    counts = np.bincount(tracks.point)
    pairs = float(np.sum(counts * (counts + 1) / 2))
    return 2.0 * 3.0 * d * d * pairs + (d * tracks.n_views) ** 3 / 3.0


def by_pycolmap(what: str, tracks: eg.Tracks, start: Any, d: int) -> list[str]:
    """Return a row of pycolmap.bundle_adjustment on the same scene saved as COLMAP's files."""
    import tempfile

    import pycolmap

    with tempfile.TemporaryDirectory() as place:
        eg.save_scene(place, tracks, start)
        model = pycolmap.Reconstruction(place)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = d > 6
    begun = time.process_time()
    pycolmap.bundle_adjustment(model, options)
    seconds = time.process_time() - begun
    error = model.compute_mean_reprojection_error()
    spent = f"{1e3 * seconds:.0f}"
    return [f"{what}, pycolmap", "", "", "", spent, "", "", "", f"mean {error:.3f} px"]


if __name__ == "__main__":
    sys.exit(main())
