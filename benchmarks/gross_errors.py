"""Many views: measured tracks with uniform gross errors, by `bundle_adjust(robust=True)`.

    EPIGAUGE_DATA=... python benchmarks/gross_errors.py [--only house] [--shares 0.01] [--json FILE]

A share of the observations is replaced by uniform positions within the range of the coordinates.
The median distance of the right observations is compared with that of the same set without gross
errors; what is set aside of right and wrong observations is counted, and the time is taken.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import itertools
import json
import os
import time
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from _measure import described, machine, markdown

SETS = ("corridor", "house", "dinosaur_trimmed", "hotel_klt", "strecha_fountain_p11")
SHARES, SEEDS = (0.002, 0.01, 0.05, 0.1), (0, 1)
HEAD = ["set", "wrong", "seed", "median px", "ratio", "success", "right aside", "wrong found", "s"]


def main() -> int:
    """Run all sets, shares and seeds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default=",".join(SETS), help="names of sets")
    parser.add_argument("--shares", type=float, nargs="*", default=SHARES, help="of wrong ones")
    parser.add_argument("--json", type=Path, help="write all figures to a file")
    options = parser.parse_args()
    found: list[dict[str, Any]] = []
    print(described(machine(())), "\n")
    print(markdown(HEAD, []), flush=True)
    for name in options.only.split(","):
        tracks = eg.load_tracks(Path(os.environ["EPIGAUGE_DATA"]) / name / "tracks.npz")
        clean = None
        for share, seed in [(0.0, 0), *itertools.product(options.shares, SEEDS)]:
            found.append(measured(name, tracks, share, seed, clean))
            clean = clean or found[-1]["median"]
            print(f"| {' | '.join(row(found[-1]))} |", flush=True)
    if options.json:
        options.json.write_text(
            json.dumps({"machine": machine(()), "rows": found}, indent=1) + "\n"
        )
    return 0


def measured(
    name: str, tracks: eg.Tracks, share: float, seed: int, clean: float | None = None
) -> dict[str, Any]:
    """Return how one set with gross errors ends."""
    rng = np.random.default_rng(seed)
    wrong = np.zeros(len(tracks), dtype=np.bool_)
    wrong[rng.choice(len(tracks), round(share * len(tracks)), replace=False)] = True
    xy = tracks.xy.copy()
    xy[wrong] = rng.uniform(xy.min(axis=0), xy.max(axis=0), (int(wrong.sum()), 2))
    begun = time.perf_counter()
    result = eg.bundle_adjust(eg.Tracks(tracks.view, tracks.point, xy), robust=True)
    median = float(np.median(np.linalg.norm(result.fun[~wrong], axis=1)))
    return {
        "set": name,
        "share": share,
        "seed": seed,
        "median": median,
        "ratio": median / (clean or median),
        "success": result.success,
        "right": float(np.mean(result.rejected[~wrong])),
        "found": float(np.mean(result.rejected[wrong])) if share else None,
        "seconds": time.perf_counter() - begun,
    }


def row(one: dict[str, Any]) -> list[str]:
    """Return the row of a table."""
    return [
        one["set"],
        f"{100 * one['share']:g} %",
        str(one["seed"]),
        f"{one['median']:.4f}",
        f"{one['ratio']:.3f}",
        "yes" if one["success"] else "no",
        f"{100 * one['right']:.1f} %",
        "" if one["found"] is None else f"{100 * one['found']:.1f} %",
        f"{one['seconds']:.1f}",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
