"""What the benchmarks share: one thread, interleaved timing, the machine, tables."""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import epigauge
import numpy as np
from epigauge import _library
from epigauge.errors import BackendError

#: Seconds of consecutive calls at each visit of a task: short ones run with warm caches.
VISIT = 2e-3


def interleaved(
    tasks: Mapping[str, Callable[[], object]], seconds: float, rounds: int = 50
) -> dict[str, np.ndarray]:
    """Return the seconds of every call of every task.

    Tasks are visited in turn, in an order shuffled anew each round, so that what else the machine
    does falls on all of them alike. A task that has had its seconds and three calls is left out.
    """
    rng = np.random.default_rng(0)
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for task in tasks.values():  # imports, caches, first allocations
        task()
    for _ in range(rounds):
        open_ = [n for n, spent in times.items() if len(spent) < 3 or sum(spent) < seconds]
        for name in rng.permutation(open_):
            visit = 0.0
            while visit < VISIT:
                begun = time.perf_counter()
                tasks[name]()
                times[name].append(time.perf_counter() - begun)
                visit += times[name][-1]
    return {name: np.array(spent) for name, spent in times.items()}


def machine(packages: Sequence[str] = ()) -> dict[str, str]:
    """Return processor, library variant and versions."""
    try:
        variant = _library.variant()
    except BackendError as error:
        variant = f"none: {error}"
    found = {
        "processor": f"{_processor()}, {os.cpu_count()} cores",
        "threads": "1 (OpenBLAS, OpenMP, MKL limited before NumPy was imported)",
        "epigauge library": variant,
        "Python": platform.python_version(),
        "epigauge": epigauge.__version__,
    }
    for name in dict.fromkeys(("numpy", *packages)):
        if name in found:
            continue
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def described(found: Mapping[str, str]) -> str:
    """Return the machine as one line."""
    return "; ".join(f"{name} {value}" for name, value in found.items())


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
