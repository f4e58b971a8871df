"""All marginal covariances of calibrated reconstructions: time and memory, and a peer's time.

    python benchmarks/covariances.py [--runs N] [--peers]

BAL problems at their minimum, every view with intrinsics of its own, and a street of 372 views
and 50,000 points like BAL's Ladybug sets. The time is that of `eg.covariance` with inner
constraints and of the deviations of all views, intrinsics and points, from tracks and
reconstruction on, of the processor in one thread, best of several runs, beside it scaled to 50
GFLOP/s of dgemm. Memory is the most that NumPy's arrays take at a time beside tracks and
reconstruction; beside it the factor of the cameras' system with the blocks of its inverse. The
peer is pycolmap.estimate_ba_covariance in its own gauge of two cameras.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import importlib.util
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import epigauge as eg
from _many_view_scenes import street
from _measure import described, machine, markdown
from many_views import dgemm_rate
from metric_views import bal

#: What the milliseconds are scaled to.
_UNIT = 50e9

Problem = tuple[eg.Tracks, eg.MetricReconstruction]


def minimum(name: str) -> Problem:
    """Return a BAL problem at its minimum."""
    tracks, start, _ = bal(name)
    return tracks, eg.bundle_adjust(tracks, start, ftol=1e-8).reconstruction


#: What there is, and how to get it.
PROBLEMS: dict[str, Callable[[], Problem]] = {
    "BAL 49": lambda: minimum("problem-49-7776-pre.txt.bz2"),
    "BAL 16": lambda: minimum("problem-16-22106-pre.txt.bz2"),
    "street": street,
}


def main() -> int:
    """Run the problems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--peers", action="store_true", help="pycolmap, too: minutes")
    options = parser.parse_args()
    rate = dgemm_rate(time.process_time)
    peers = options.peers and importlib.util.find_spec("pycolmap") is not None
    print(described(machine(("pycolmap",) if peers else ())))
    print(f"\ndgemm: {rate / 1e9:.1f} GFLOP/s\n", flush=True)
    rows = []
    for what, make in PROBLEMS.items():
        try:
            tracks, scene = make()
        except FileNotFoundError as error:
            print(f"{what}: {error}.\n")
            continue
        seconds = best(lambda at=(tracks, scene): eg.covariance(*at).std, options.runs)
        taken, factor = memory(tracks, scene)
        row = [
            what,
            f"{tracks.n_views} / {tracks.n_points:,} / {len(tracks):,}",
            f"{1e3 * seconds:.0f} ({1e3 * seconds * rate / _UNIT:.0f})",
            f"{taken / 1e6:.1f} ({factor / 1e6:.1f})",
        ]
        if peers:
            row.append(f"{1e3 * by_pycolmap(tracks, scene):.0f}")
        rows.append(row)
    header = ["problem", "views / points / observations", "ms (at 50 GFLOP/s)", "MB (factor)"]
    print(markdown([*header, "pycolmap ms"] if peers else header, rows))
    return 0


def best(call: Callable[[], Any], runs: int) -> float:
    """Return the least seconds of the processor in a call."""
    spent = []
    for _ in range(runs):
        begun = time.process_time()
        call()
        spent.append(time.process_time() - begun)
    return min(spent)


def memory(tracks: eg.Tracks, scene: eg.MetricReconstruction) -> tuple[int, int]:
    """Return the most bytes that a call takes, and those of factor and blocks of the inverse."""
    tracemalloc.start()
    found = eg.covariance(tracks, scene)
    _ = found.std
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    inverse: Any = found._inverse
    kept = inverse.blocks.X.nbytes + inverse.reduced._factor.inner.S.nbytes
    return most, kept


def by_pycolmap(tracks: eg.Tracks, scene: eg.MetricReconstruction) -> float:
    """Return seconds of pycolmap.estimate_ba_covariance on the same scene as COLMAP's files."""
    import pycolmap

    with tempfile.TemporaryDirectory() as place:
        eg.save_scene(place, *eg.interop.bal_to_colmap(tracks, scene, (2000, 2000)))
        model = pycolmap.Reconstruction(place)
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(), config, model
    )
    begun = time.process_time()
    found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    seconds = time.process_time() - begun
    return seconds if found is not None else float("nan")


if __name__ == "__main__":
    sys.exit(main())
