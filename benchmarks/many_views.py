"""Many views: time an iteration, memory and growth of `bundle_adjust`, against the machine's limit.

    python benchmarks/many_views.py [--quick] [--json FILE] [--plot FILE]

Every problem runs in a process of its own, from the same start, with the defaults (covariant
damping, points re-triangulated). Milliseconds are those of one trial step of the history, best of
several runs. Memory is the peak beyond what the interpreter with epigauge takes. The limit is the
arithmetic of the textbook's step at the rate of this machine's dgemm: a product (12x4) (4x4) (4x12)
for each pair of observations of one point, and the Cholesky factor of the cameras' system within
its envelope. The factors of rank one and two that the library multiplies instead need an eighth of
it; so it may come below. Shares of the time are those of a run with one thread, by function of the
C library.
The total is that of `bundle_adjust`, without the verdict, which is made when it is asked for.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from _many_view_peers import MOST, PEERS, RECORDED, RECORDED_GFLOPS
from _many_view_scenes import GROWTH, PROBLEMS, Problem, banded
from _measure import described, machine, markdown
from _profile import profiled
from epigauge.bundle.skyline import Skyline, narrow

#: Floating-point operations of a pair of observations, and of a product of two 12x12 blocks.
PAIR, BLOCK = 2 * 12 * 4 * 12, 2 * 12**3

#: Functions that take less everywhere are told together.
_SHARE = 0.03


def main() -> int:
    """Run the problems and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small problems, few runs")
    parser.add_argument("--workers", type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help="write all figures to a file")
    parser.add_argument("--plot", type=Path, help="write the growth as a picture")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=3.0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options.one, options.workers, options.seconds)))
        return 0
    rate, seconds = dgemm_rate(), 0.2 if options.quick else options.seconds
    print(described(machine(("pyceres", "scipy"))))
    print(f"\ndgemm: {rate / 1e9:.1f} GFLOP/s\n", flush=True)
    problems, peers = {}, []
    for name, (what, make) in PROBLEMS.items():
        if options.quick and name not in ("paper", "bal49"):
            continue
        try:
            problem = make()
        except FileNotFoundError as error:
            print(f"{what}: {error}.\n")
            continue
        problems[name] = in_own_process(problem, 1, seconds)
        if (os.cpu_count() or 1) > 1:
            problems[name]["two_threads_ms"] = in_own_process(problem, 2, seconds)["ms"]
        problems[name]["limit_ms"] = 1e3 * operations(problem[0]) / rate
        if name == "paper":
            peers = against_peers(what, problem, problems[name])
    print(problem_table(problems, rate), "\n")
    print(profile_table(problems), "\n")
    print(markdown(["peer, n = 5, m = 100", "ms", "steps", "cost", "ratio"], peers), "\n")
    sizes = GROWTH[:2] if options.quick else GROWTH
    growth = [in_own_process(banded(n, 200 * n), 1, seconds) for n in sizes]
    print(growth_table(growth))
    if options.json:
        found = {"machine": machine(), "problems": problems, "growth": growth}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    if options.plot:
        plot(growth, options.plot)
    return 0


# ---------------------------------------------------------------- one problem


def in_own_process(problem: Problem, workers: int, seconds: float) -> dict[str, Any]:
    """Return what `measured` finds in a fresh interpreter."""
    tracks, start = problem
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "problem.npz"
        np.savez(path, view=tracks.view, point=tracks.point, xy=tracks.xy, P=start.P, Q=start.Q)
        command = [sys.executable, __file__, "--one", str(path), "--workers", str(workers)]
        command += ["--seconds", str(seconds)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def measured(path: Path, workers: int, seconds: float) -> dict[str, Any]:
    """Run one problem several times."""
    eg.bundle_adjust(*tiny())  # what is imported and allocated once
    before = peak_mb()
    with np.load(path) as file:
        tracks = eg.Tracks(file["view"], file["point"], file["xy"])
        start = eg.Reconstruction(file["P"], file["Q"])
    best, total, spent, runs = np.inf, np.inf, 0.0, 0
    while runs < 3 or (spent < seconds and runs < 300):
        begun = time.perf_counter()
        found = eg.bundle_adjust(tracks, start, workers=workers)
        whole = time.perf_counter() - begun
        steps = found.history[-1].seconds - found.history[0].seconds
        best, total = min(best, steps / found.nit), min(total, whole)
        spent, runs = spent + whole, runs + 1
    used = peak_mb() - before
    with profiled() as functions:
        eg.bundle_adjust(tracks, start)
        functions.clear()
        begun = time.perf_counter()
        eg.bundle_adjust(tracks, start)
        whole = time.perf_counter() - begun
    return {
        "views": tracks.n_views,
        "points": tracks.n_points,
        "observations": len(tracks),
        "ms": 1e3 * best,
        "total_ms": 1e3 * total,
        "nfev": found.nfev,
        "cost": found.cost,
        "mb": used,
        "runs": runs,
        "shares": {name: seconds / whole for name, seconds in functions.most_common()},
    }


def peak_mb() -> float:
    """Return the most memory this process has held."""
    status = Path("/proc/self/status")
    if status.exists():  # the resource module tells what the parent has held, too
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(line.split()[1]) / 1024.0
    import resource

    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size / (1024.0**2 if sys.platform == "darwin" else 1024.0)


def tiny() -> Problem:
    """Return a problem of no size."""
    tracks = eg.multi_view_scene(n_views=3, n_points=20).tracks
    return tracks, eg.initialize(tracks)


def operations(tracks: eg.Tracks) -> float:
    """Return the operations of the textbook's step; see the module."""
    n = tracks.n_views
    counts = np.bincount(tracks.point)
    together = np.zeros((n, n), np.bool_)
    first = np.concatenate([[0], np.cumsum(counts)])
    for k in range(int(counts.max())):
        rows = np.flatnonzero(np.arange(len(tracks)) - first[tracks.point] >= k)
        together[tracks.view[rows], tracks.view[rows - k]] = True
    skyline = narrow(together | together.T)[0] if n > 1 else Skyline.full(n)
    pairs = float(np.sum(counts * (counts + 1) / 2))
    return PAIR * pairs + BLOCK * skyline.work


def dgemm_rate(clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the operations a second, by a clock, of a large matrix product."""
    A = np.random.default_rng(0).standard_normal((1200, 1200))
    best = np.inf
    for _ in range(5):
        begun = clock()
        A @ A
        best = min(best, clock() - begun)
    return 2.0 * len(A) ** 3 / best


def against_peers(what: str, problem: Problem, own: dict[str, Any]) -> list[list[str]]:
    """Run the peers that are installed on a small problem."""
    tracks, start = problem
    rows = [["epigauge", f"{own['total_ms']:.2f}", str(own["nfev"]), f"{own['cost']:.4f}", "1"]]
    for name, (module, run) in PEERS.items():
        if importlib.util.find_spec(module) is None:
            print(f"{what}: {module} is not installed, left out.\n")
        elif len(tracks) <= MOST:
            seconds, steps, cost = min(run(tracks, start) for _ in range(3))
            ratio = 1e3 * seconds / own["total_ms"]
            rows.append([name, f"{1e3 * seconds:.1f}", str(steps), f"{cost:.4f}", f"{ratio:.0f}"])
    return rows


# ---------------------------------------------------------------- tables


def problem_table(problems: dict[str, dict[str, Any]], rate: float) -> str:
    """Return the problems beside the limit and the figures recorded for Ceres."""
    header = ["problem", "observations", "ms / step", "two threads", "evaluations", "total ms"]
    header += ["cost", "MB"]
    header += ["limit ms", "times limit", "Ceres ms (scaled)", "Ceres / ms", "Ceres / total"]
    rows = []
    for name, found in problems.items():
        each, steps, _ = RECORDED[name]
        ceres = each * RECORDED_GFLOPS * 1e9 / rate
        rows.append(
            [
                PROBLEMS[name][0],
                f"{found['observations']:,}",
                f"{found['ms']:.3g}",
                f"{found['ms'] / found['two_threads_ms']:.2f}x"
                if "two_threads_ms" in found
                else "-",
                str(found["nfev"]),
                f"{found['total_ms']:.3g}",
                f"{found['cost']:.4f}",
                f"{found['mb']:.0f}",
                f"{found['limit_ms']:.3g}",
                f"{found['ms'] / found['limit_ms']:.1f}",
                f"{each:g} ({ceres:.3g})",
                f"{ceres / found['ms']:.1f}",
                f"{ceres * steps / found['total_ms']:.1f}",
            ]
        )
    return markdown(header, rows)


def profile_table(problems: dict[str, dict[str, Any]]) -> str:
    """Return where the time goes."""
    names = dict.fromkeys(name for found in problems.values() for name in found["shares"])
    largest = [
        name
        for name in names
        if max(found["shares"].get(name, 0.0) for found in problems.values()) >= _SHARE
    ]
    rows = []
    for problem, found in problems.items():
        shares = [found["shares"].get(name, 0.0) for name in largest]
        cells = [f"{100 * share:.0f} %" for share in (*shares, 1.0 - sum(shares))]
        rows.append([PROBLEMS[problem][0], *cells])
    return markdown(["share of the time", *(f"`{name}`" for name in largest), "the rest"], rows)


def growth_table(growth: list[dict[str, Any]]) -> str:
    """Return time and memory by size, and the exponents."""
    header = ["views", "points", "observations", "ms / step", "evaluations", "MB"]
    rows = [
        [
            *(f"{found[key]:,}" for key in ("views", "points", "observations")),
            f"{found['ms']:.3g}",
            str(found["nfev"]),
            f"{found['mb']:.0f}",
        ]
        for found in growth
    ]
    told = []
    if len(growth) > 1:
        size = np.log([found["observations"] for found in growth])
        for key, what in (("ms", "time a step"), ("mb", "memory")):
            slope = np.polyfit(size, np.log([found[key] for found in growth]), 1)[0]
            told.append(f"{what} grows as observations^{slope:.2f}")
    return markdown(header, rows) + f"\n\n{'; '.join(told)}."


def plot(growth: list[dict[str, Any]], path: Path) -> None:
    """Draw time and memory by size."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained")
    size = [found["observations"] for found in growth]
    for ax, key, label in zip(axes, ("ms", "mb"), ("ms a step", "MB"), strict=True):
        ax.loglog(size, [found[key] for found in growth], "o-")
        ax.set(xlabel="observations", ylabel=label)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(True, which="both", alpha=0.3)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    sys.exit(main())
