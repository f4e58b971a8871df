"""Time of `import epigauge` beyond NumPy's, and until its solvers are there.

    python benchmarks/imports.py [--runs N]

Each run is an interpreter of its own; the variants take turns.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

import numpy as np

VARIANTS = {
    "import epigauge": "import epigauge",
    "and refine_fundamental": "import epigauge; epigauge.refine_fundamental",
    "and bundle_adjust": "import epigauge; epigauge.bundle_adjust",
    "and all public names": "import epigauge; [getattr(epigauge, n) for n in epigauge.__all__]",
    "the command line": "import epigauge.cli",
}
_CODE = """
import time, numpy
wall, cpu = time.perf_counter(), time.process_time()
{}
print(time.perf_counter() - wall, time.process_time() - cpu)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=10)
    runs = parser.parse_args().runs
    seconds = {name: np.zeros((runs, 2)) for name in VARIANTS}
    for run in range(runs):
        for name, statements in VARIANTS.items():
            command = [sys.executable, "-c", _CODE.format(statements)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            seconds[name][run] = [float(word) for word in done.stdout.split()]
    print("| milliseconds beyond NumPy's import | wall, least | median | processor, least |")
    print("|---|---|---|---|")
    for name, found in seconds.items():
        wall, cpu = 1e3 * found.T
        print(f"| {name} | {wall.min():.1f} | {np.median(wall):.1f} | {cpu.min():.1f} |")


if __name__ == "__main__":
    main()
