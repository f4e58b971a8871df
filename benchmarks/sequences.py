"""Measured sequences: time from tracks to the optimum, `initialize` and `bundle_adjust`.

    python benchmarks/sequences.py [--quick] [--json FILE]

Milliseconds are medians of several runs (least in parentheses) in one process. "First" is one run
in a fresh interpreter, from the import of NumPy and epigauge to the result, files read.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from _measure import described, machine, markdown

SEQUENCES = ("corridor", "house", "library", "merton_1", "dinosaur_trimmed", "dinosaur")

_FIRST = """
import sys, time
begun = time.perf_counter()
import epigauge as eg
tracks = eg.load_tracks(sys.argv[1])
eg.bundle_adjust(tracks)
print(time.perf_counter() - begun)
"""


def main() -> int:
    """Run the sequences and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there, too")
    options = parser.parse_args()
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("EPIGAUGE_DATA", default))
    print(described(machine()), "\n", flush=True)
    found: dict[str, dict[str, Any]] = {}
    for name in SEQUENCES:
        path = folder / name / "tracks.npz"
        if path.exists():
            found[name] = measured(path, 1 if options.quick else 9)
        else:
            print(f"{path} is missing: set EPIGAUGE_DATA.\n")
    print(table(found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


def measured(path: Path, runs: int) -> dict[str, Any]:
    """Time one sequence."""
    tracks = eg.load_tracks(path)
    eg.bundle_adjust(tracks)
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        start = eg.initialize(tracks)
        between = time.perf_counter()
        result = eg.bundle_adjust(tracks, start)
        seconds.append((between - begun, time.perf_counter() - between))
    command = [sys.executable, "-c", _FIRST, str(path)]
    first = [
        float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        for _ in range(min(runs, 5))
    ]
    return {
        "views": tracks.n_views,
        "points": tracks.n_points,
        "initialize_s": [own[0] for own in seconds],
        "adjust_s": [own[1] for own in seconds],
        "first_s": first,
        "nfev": result.nfev,
        "rms_px": result.rms_px,
    }


def table(found: dict[str, dict[str, Any]]) -> str:
    """Return medians and minima in milliseconds."""

    def cell(*parts: list[float]) -> str:
        milliseconds = 1e3 * np.sum(parts, axis=0)
        return f"{np.median(milliseconds):.3g} ({np.min(milliseconds):.3g})"

    header = ["sequence", "views, points", "`initialize`", "`bundle_adjust`", "both", "first"]
    header += ["evaluations", "RMS (px)"]
    rows = [
        [
            name,
            f"{own['views']}, {own['points']:,}",
            cell(own["initialize_s"]),
            cell(own["adjust_s"]),
            cell(own["initialize_s"], own["adjust_s"]),
            cell(own["first_s"]),
            str(own["nfev"]),
            f"{own['rms_px']:.6f}",
        ]
        for name, own in found.items()
    ]
    return markdown(header, rows)


if __name__ == "__main__":
    sys.exit(main())
