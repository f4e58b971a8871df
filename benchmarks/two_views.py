"""Two views: epigauge against its peers, from the same start, on one thread.

    python benchmarks/two_views.py [--json FILE] [--quick]

Scene of Bartoli & Sturm 2004, section 5.1.1: distance 10 m, noise sqrt 2 px. Times are those of
whole calls from Python, interleaved in one process, all from the same 8-point estimate, which only
the row that says so, and the peers that take no start, compute within; few matches on several
scenes, whose mean is given. The cost is the exact reprojection error, whatever a method minimises,
and the largest excess is given. Peers that are not installed are left out.
Then every variant of the C library that this processor runs (`EPIGAUGE_PROCESSOR`).
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from _measure import described, interleaved, machine, markdown
from _two_view_peers import METHODS, TRIVIAL, Pair
from epigauge._library import CHOICE, usable, variant

REFERENCE = "PoseLib, no robust loss"
DISTANCE_M = 10.0
#: Matches: scenes.
SIZES = {50: 9, 100: 9, 1_000: 5, 10_000: 1, 100_000: 1}
BATCH = (10_000, 100)
MEMORY_AT = 1_000_000


def pair_of(m: int, seed: int = 0) -> Pair:
    """Return a scene with m points."""
    scene = eg.two_view_scene(DISTANCE_M, n_points=m, seed=seed)
    return Pair(scene.x1, scene.x2, eg.fundamental_8point(scene.x1, scene.x2))


def installed() -> tuple[list[str], list[str]]:
    """Return the rows that can run, and a line for each package that cannot be compared with."""
    rows, absent = [], []
    for row, (module, distribution, *_) in METHODS.items():
        if importlib.util.find_spec(module):
            rows.append(row)
        else:
            absent.append(f"{distribution} is not installed: left out.")
    return rows, list(dict.fromkeys(absent))


def exact_cost(F: np.ndarray, pair: Pair) -> float:
    """Return half the sum of squares of the exact reprojection distances, in px^2."""
    return 0.5 * float(np.sum(eg.reprojection_distances(F, pair.x1, pair.x2)[0] ** 2))


def single(rows: list[str], m: int, scenes: int, seconds: float) -> dict[str, dict[str, Any]]:
    """Time all methods on a few scenes, one call each; times are those of a call."""
    pairs = [pair_of(m, seed) for seed in range(scenes)]
    methods = {
        row: [METHODS[row][2](pair) for pair in pairs] for row in rows if m <= METHODS[row][3]
    }
    found = {row: [method() for method in own] for row, own in methods.items()}
    costs = {
        row: np.array([exact_cost(F, pair) for (F, _), pair in zip(own, pairs, strict=True)])
        for row, own in found.items()
    }
    best = np.min(list(costs.values()), axis=0)
    tasks = {row: lambda own=own: [method() for method in own] for row, own in methods.items()}
    return {
        row: {
            "median_s": float(np.median(times)) / scenes,
            "min_s": float(times.min()) / scenes,
            "calls": len(times) * scenes,
            "steps": None if found[row][0][1] is None else np.mean([n for _, n in found[row]]),
            "above_best": float(np.max(costs[row] / best - 1.0)),
        }
        for row, times in interleaved(tasks, seconds).items()
    }


def batch(pairs: int, m: int, seconds: float) -> dict[str, dict[str, float]]:
    """Time many pairs in one call, or in a loop where there is no such call."""
    scenes = [eg.two_view_scene(DISTANCE_M, n_points=m, seed=k) for k in range(min(pairs, 200))]
    order = np.arange(pairs) % len(scenes)
    starts = np.array([eg.fundamental_8point(s.x1, s.x2) for s in scenes])[order]
    x1, x2 = (np.concatenate([getattr(scenes[k], x) for k in order]) for x in ("x1", "x2"))
    offsets = m * np.arange(pairs + 1)

    def own(F0: np.ndarray | None, workers: int) -> Callable[[], object]:
        return lambda: eg.refine_fundamental_batch(x1, x2, offsets, F0, workers=workers)

    tasks = {
        f"epigauge, {label}workers={workers}": own(F0, workers)
        for F0, label in ((starts, ""), (None, "8-point start included, "))
        for workers in (1, 2)
    }
    if importlib.util.find_spec("poselib"):
        import poselib

        def loop(options: dict[str, object]) -> Callable[[], object]:
            each = [slice(*ends) for ends in zip(offsets[:-1], offsets[1:], strict=True)]
            return lambda: [
                poselib.refine_fundamental(x1[one], x2[one], F0, options)
                for one, F0 in zip(each, starts, strict=True)
            ]

        tasks[REFERENCE] = loop(TRIVIAL)
        tasks[f"{REFERENCE}, step_tol 1e-4"] = loop({**TRIVIAL, "step_tol": 1e-4})
    return {
        row: {"median_s": float(np.median(times)), "min_s": float(times.min())}
        for row, times in interleaved(tasks, seconds, rounds=7).items()
    }


def variants(sizes: Iterable[int], seconds: float) -> str:
    """Return medians of every variant of the C library, each in a process of its own."""
    rows = []
    for name in usable():
        command = [sys.executable, __file__, "--variant", str(seconds), *map(str, sizes)]
        environment = os.environ | {CHOICE: name}
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        found = json.loads(done.stdout)
        cells = [f"{name}{' (chosen here)' if name == variant() else ''}"]
        for own in found.values():
            text = seconds_text(own["epigauge"]["median_s"])
            if REFERENCE in own:
                text += f", {own[REFERENCE]['median_s'] / own['epigauge']['median_s']:.2g}x"
            cells.append(text)
        rows.append(cells)
    return markdown([f"{CHOICE}=", *(f"m = {m:,}: median, ratio" for m in sizes)], rows)


def memory(rows: list[str], m: int) -> dict[str, float]:
    """Return the peak bytes a match beyond the input, each method in a process of its own."""
    pair = pair_of(m)
    used = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pair.npz"
        np.savez(path, x1=pair.x1, x2=pair.x2, F0=pair.F0)
        for row in rows:
            if m <= METHODS[row][3]:
                command = [sys.executable, __file__, "--memory-of", row, str(path)]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                used[row] = float(done.stdout) if done.returncode == 0 else float("nan")
    return used


def memory_of(row: str, path: str) -> float:
    """Return how far one call raises the memory of this process, in bytes a match."""
    with np.load(path) as stored:
        pair = Pair(stored["x1"], stored["x2"], stored["F0"])
    few = Pair(pair.x1[:1000].copy(), pair.x2[:1000].copy(), pair.F0)
    METHODS[row][2](few)()  # imports
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    before = _status_bytes("VmRSS")
    METHODS[row][2](pair)()
    return (_status_bytes("VmHWM") - before) / len(pair.x1)


def _status_bytes(name: str) -> int:
    (line,) = re.findall(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return 1024 * int(line)


def seconds_text(value: float) -> str:
    """Return a time with its unit."""
    if value < 1e-3:
        return f"{1e6 * value:.0f} us"
    return f"{1e3 * value:.3g} ms" if value < 1.0 else f"{value:.3g} s"


def single_table(found: dict[int, dict[str, dict[str, Any]]], used: dict[str, float]) -> str:
    """Return medians with ratios to the reference, steps, cost and memory."""
    header = ["method"]
    header += [f"m = {m:,}: median (min), ratio" for m in found]
    header += ["steps", "cost above the best", "bytes a match"]
    rows = []
    for row in METHODS:
        measured = {m: results[row] for m, results in found.items() if row in results}
        if not measured:
            continue
        cells = [row]
        for m, results in found.items():
            if m not in measured:
                cells.append("-")
                continue
            own = measured[m]
            text = f"{seconds_text(own['median_s'])} ({seconds_text(own['min_s'])})"
            if REFERENCE in results:
                text += f", {results[REFERENCE]['median_s'] / own['median_s']:.2g}x"
            cells.append(text)
        steps = [own["steps"] for own in measured.values()]
        cells.append("-" if None in steps else f"{min(steps):.0f}-{max(steps):.0f}")
        cells.append(f"{max(own['above_best'] for own in measured.values()):.1e}")
        cells.append(f"{used[row]:.0f}" if row in used else "-")
        rows.append(cells)
    return markdown(header, rows)


def batch_table(found: dict[str, dict[str, float]], pairs: int) -> str:
    """Return microseconds a pair with ratios to the reference."""
    header = ["batch", "us a pair: median (min)", "ratio"]
    rows = []
    for row, own in found.items():
        median, least = (1e6 * own[key] / pairs for key in ("median_s", "min_s"))
        ratio = found[REFERENCE]["median_s"] / own["median_s"] if REFERENCE in found else None
        rows.append([row, f"{median:.1f} ({least:.1f})", "-" if ratio is None else f"{ratio:.2g}x"])
    return markdown(header, rows)


def main() -> int:
    """Print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there, too")
    parser.add_argument("--quick", action="store_true", help="a few calls, to see that it runs")
    parser.add_argument("--memory-of", nargs=2, metavar=("ROW", "PAIR"), help=argparse.SUPPRESS)
    parser.add_argument("--variant", nargs="+", metavar="SECONDS M", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.variant:
        seconds, *counts = arguments.variant
        own = [row for row in ("epigauge", REFERENCE) if row in installed()[0]]
        told = {m: single(own, int(m), SIZES[int(m)], float(seconds)) for m in counts}
        print(json.dumps(told, default=float))
        return 0
    if arguments.memory_of:
        print(memory_of(*arguments.memory_of))
        return 0
    quick = arguments.quick
    rows, absent = installed()
    about = machine([METHODS[row][1] for row in rows])
    print(described(about), *absent, sep="\n\n", end="\n\n", flush=True)
    sizes = {50: 1, 1_000: 1} if quick else SIZES
    found = {m: single(rows, m, scenes, 0.01 if quick else 2.0) for m, scenes in sizes.items()}
    # Where there is no /proc, memory is not measured.
    measurable = Path("/proc/self/clear_refs").exists() and not quick
    used = memory(rows, MEMORY_AT) if measurable else {}
    print(single_table(found, used), end="\n\n", flush=True)
    if REFERENCE in rows:
        print(f"Ratios are to the median of {REFERENCE}: above 1 is faster.", end="\n\n")
    counts = dict.fromkeys(sizes) if quick else dict.fromkeys(m for m in SIZES if m <= 10_000)
    print(variants(counts, 0.01 if quick else 2.0), end="\n\n", flush=True)
    pairs, m = (20, 100) if quick else BATCH
    together = batch(pairs, m, 0.01 if quick else 20.0)
    print(f"{pairs:,} pairs of {m} matches:", batch_table(together, pairs), sep="\n\n")
    if arguments.json:
        text = {"machine": about, "single": found, "bytes_a_match": used, "batch": together}
        arguments.json.write_text(json.dumps(text, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
