"""How often `estimate_two_view` names the right model: a table by scene, number and wrong matches.

    python benchmarks/models.py [--trials 100] [--matches 20 50 200 2000] [--calibrated]
        [--scenes random still rotation planar general] [--processes 2] [--heavy]

Scenes are those of verdicts.py: a noise of half a pixel, wrong matches uniform over the image. With
--heavy the noise is a tenth of a pixel, and Cauchy's of one along y of the second image. The last
columns are the shares of the trials that end in each model, and their processor time. Then for
each scene the share that is right, in all its rows and in the worst.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

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


def trial(
    kind: str, m: int, wrong: float, seed: int, calibrated: bool, heavy: bool
) -> tuple[str, float]:
    """Return the model that one scene is given, and the seconds that took."""
    rng = np.random.default_rng([17, list(RIGHT).index(kind), m, round(100 * wrong), seed])
    x1, x2 = scene(kind, m, wrong, rng, 0.1 if heavy else 0.5)
    x2[:, 1] += heavy * rng.standard_cauchy(m)
    begun = time.process_time()
    model = eg.estimate_two_view(x1, x2, *((K, K) if calibrated else (None, None))).model
    return model, time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--matches", type=int, nargs="*", default=[20, 50, 200, 2000])
    parser.add_argument("--scenes", nargs="*", choices=RIGHT, default=list(RIGHT))
    parser.add_argument("--calibrated", action="store_true")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--heavy", action="store_true")
    arguments = parser.parse_args()
    names = ["nothing", "still", "rotation", "plane", "E" if arguments.calibrated else "F"]
    head = ["scene", "matches", "wrong", "right", *names, "ms"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    told: dict[str, list[float]] = {kind: [] for kind in arguments.scenes}
    with ProcessPoolExecutor(arguments.processes) as pool:
        for kind, m in itertools.product(arguments.scenes, arguments.matches):
            for wrong in (0.0,) if kind == "random" else (0.0, 0.3, 0.6):
                options = {"calibrated": arguments.calibrated, "heavy": arguments.heavy}
                call = partial(trial, kind, m, wrong, **options)
                models, seconds = zip(*pool.map(call, range(arguments.trials)), strict=True)
                share = {name: models.count(name) / arguments.trials for name in names}
                told[kind].append(sum(share.get(name, 0.0) for name in RIGHT[kind]))
                cells = [f"{told[kind][-1]:.2f}"]
                cells += [f"{share[name]:.2f}" if share[name] else "." for name in names]
                row = [kind, str(m), f"{wrong:.0%}", *cells, f"{1e3 * np.mean(seconds):.0f}"]
                print("| " + " | ".join(row) + " |", flush=True)
    print()
    for kind, shares in told.items():
        print(f"{kind}: {np.mean(shares):.3f} right, {min(shares):.2f} in the worst row")


if __name__ == "__main__":
    main()
