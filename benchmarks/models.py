"""How often `estimate_two_view` names the right model: a table by scene, number and wrong matches.

    python benchmarks/models.py [--trials 100] [--matches 20 50 200 2000] [--calibrated]

Scenes are those of verdicts.py: a noise of half a pixel, wrong matches uniform over the image. The
last columns are the shares of the trials that end in each model.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import epigauge as eg
import numpy as np
from verdicts import _FOCAL, _SIZE, scene

RIGHT = {
    "random": ("nothing",),
    "still": ("still",),
    "rotation": ("rotation",),
    "planar": ("plane",),
    "general": ("F", "E"),
}
K = np.array([[_FOCAL, 0.0, _SIZE[0] / 2.0], [0.0, _FOCAL, _SIZE[1] / 2.0], [0.0, 0.0, 1.0]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--matches", type=int, nargs="*", default=[20, 50, 200, 2000])
    parser.add_argument("--calibrated", action="store_true")
    arguments = parser.parse_args()
    names = ["nothing", "still", "rotation", "plane", "E" if arguments.calibrated else "F"]
    head = ["scene", "matches", "wrong", "right", *names, "ms"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for number, (kind, right) in enumerate(RIGHT.items()):
        for m in arguments.matches:
            for wrong in (0.0,) if kind == "random" else (0.0, 0.3, 0.6):
                count: Counter[str] = Counter()
                begun = time.process_time()
                for seed in range(arguments.trials):
                    rng = np.random.default_rng([17, number, m, round(100 * wrong), seed])
                    cameras = (K, K) if arguments.calibrated else (None, None)
                    count[eg.estimate_two_view(*scene(kind, m, wrong, rng), *cameras).model] += 1
                spent = (time.process_time() - begun) / arguments.trials
                shares = [count[name] / arguments.trials for name in names]
                told = sum(count[name] for name in right) / arguments.trials
                cells = [f"{told:.2f}", *(f"{share:.2f}" if share else "." for share in shares)]
                row = [kind, str(m), f"{wrong:.0%}", *cells, f"{1e3 * spent:.0f}"]
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
