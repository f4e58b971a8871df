"""How near the truth robust estimates from raw matches come, against the peers that are installed.

    python benchmarks/robust.py [--pairs DIRECTORY] [--sets FILE ...] [--trials 40]

First every measured pair with a true F or with check points, then the scene of Bartoli & Sturm
2004, section 5.1.1, with 500 points (10 m, noise sqrt 2 px) some of which are replaced by points
uniform over the bounding box. Cells are pixels / milliseconds of processor time. The error of a
true match is the mean of the distances of both its noise-free points to their epipolar lines; a
pair's is the median over its true matches, a scene's the mean, and the median over the trials. Sets
are files of many pairs each, with true F and raw matches; a pair's error is the mean over at most
200 true matches there. Of a set: the median error, the shares of pairs below 0.5, 1 and 2 px, and
the median milliseconds.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path

import _one_thread  # noqa: F401
import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Estimator = Callable[[Array, Array, float], Array | None]

NOISE_PX = 2.0**0.5
#: Threshold of the peers on the measured pairs, and three standard deviations on the scenes.
PAIR_THRESHOLD_PX, SCENE_THRESHOLD_PX = 1.0, 3.0 * NOISE_PX
#: Of the errors of a set.
BOUNDS_PX = (0.5, 1.0, 2.0)


def opencv(x1: Array, x2: Array, threshold: float) -> Array | None:
    import cv2

    cv2.setNumThreads(1)
    F, _ = cv2.findFundamentalMat(x1, x2, cv2.USAC_MAGSAC, threshold, 0.999, 10_000)
    return None if F is None or F.shape != (3, 3) else F


def poselib(x1: Array, x2: Array, threshold: float) -> Array | None:
    import poselib

    return poselib.estimate_fundamental(x1, x2, {"max_epipolar_error": threshold}, {})[0]


def pycolmap(x1: Array, x2: Array, threshold: float) -> Array | None:
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.RANSACOptions()
    options.max_error = threshold
    found = pycolmap.estimate_fundamental_matrix(x1, x2, options)
    return found["F"] if found else None


def epigauge(x1: Array, x2: Array, threshold: float) -> Array | None:
    return eg.estimate_fundamental(x1, x2).F


PEERS: dict[str, tuple[str, Estimator]] = {
    "OpenCV USAC_MAGSAC": ("cv2", opencv),
    "PoseLib": ("poselib", poselib),
    "pycolmap": ("pycolmap", pycolmap),
    "epigauge": ("epigauge", epigauge),
}


def errors(F: Array | None, x1: Array, x2: Array) -> Array:
    """Return the mean distance of each true match's points to their epipolar lines."""
    if F is None:
        return np.full(len(x1), np.inf)
    h1, h2 = (np.column_stack([x, np.ones(len(x))]) for x in (x1, x2))
    line2, line1 = h1 @ F.T, h2 @ F
    reciprocals = sum(1.0 / np.linalg.norm(line[:, :2], axis=1) for line in (line1, line2))
    return np.asarray(np.abs(np.sum(h2 * line2, axis=1)) * reciprocals / 2.0)


def measured(directory: Path) -> dict[str, tuple[Array, Array, Array, Array]]:
    """Return raw matches and true matches of the pairs that have them."""
    pairs = {}
    for path in sorted(directory.glob("*.npz")):
        with np.load(path) as data:
            x1, x2 = data["x1"].astype(float), data["x2"].astype(float)
            if "check_x1" in data:
                truth = data["check_x1"].astype(float), data["check_x2"].astype(float)
            elif "F_true" in data:
                right = data["gt_inlier"]
                truth = eg.reprojection_distances(data["F_true"], x1[right], x2[right])[1:]
            else:
                continue
        pairs[path.stem] = (x1, x2, *truth)
    return pairs


def one_set(path: Path) -> list[tuple[Array, Array, Array, Array]]:
    """Return raw matches and true matches of all pairs of a set."""
    pairs = []
    with np.load(path) as data:
        bounds, all1, all2 = data["offsets"], data["x1"].astype(float), data["x2"].astype(float)
        right = data["true_distance_px"] <= 0.5
        for F, *ends in zip(data["F_true"], bounds[:-1], bounds[1:], strict=True):
            rows = slice(*ends)
            x1, x2 = all1[rows], all2[rows]
            chosen = np.flatnonzero(right[rows])
            chosen = chosen[:: -(-len(chosen) // 200)]
            pairs.append((x1, x2, *eg.reprojection_distances(F, x1[chosen], x2[chosen])[1:]))
    return pairs


def simulated(share: float, seed: int) -> tuple[Array, Array, Array, Array]:
    """Return matches, a share of them wrong, and the true matches."""
    scene = eg.two_view_scene(n_points=500, noise_px=NOISE_PX, seed=seed)
    rng = np.random.default_rng(10_000 + seed)
    wrong = round(share * 500)
    x1, x2 = scene.x1.copy(), scene.x2.copy()
    for x in (x1, x2):
        x[500 - wrong :] = rng.uniform(x.min(axis=0), x.max(axis=0), (wrong, 2))
    return x1, x2, scene.x1_true, scene.x2_true


def timed(
    estimate: Estimator, x1: Array, x2: Array, threshold: float
) -> tuple[Array | None, float]:
    """Return the estimate and its milliseconds of processor time."""
    begun = time.process_time()
    F = estimate(x1, x2, threshold)
    return F, 1e3 * (time.process_time() - begun)


def main() -> None:
    """Print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=Path, help="directory of the measured pairs")
    parser.add_argument("--sets", type=Path, nargs="*", default=[], help="files of many pairs")
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--only", nargs="*", default=list(PEERS), choices=PEERS, help="of these")
    arguments = parser.parse_args()
    peers = {
        name: estimate
        for name, (module, estimate) in PEERS.items()
        if name in arguments.only and importlib.util.find_spec(module)
    }

    print("| matches |", " | ".join(peers), "|")
    print("|---|" + "---|" * len(peers))
    table = []
    for name, (x1, x2, t1, t2) in measured(arguments.pairs).items() if arguments.pairs else ():
        found = [timed(f, x1, x2, PAIR_THRESHOLD_PX) for f in peers.values()]
        table.append([float(np.median(errors(F, t1, t2))) for F, _ in found])
        cells = [f"{e:.3f} / {ms:.0f}" for e, (_, ms) in zip(table[-1], found, strict=True)]
        print(f"| {name} |", " | ".join(cells), "|", flush=True)
    if table:
        for label, value in (
            ("median of the pairs", np.median(table, axis=0)),
            ("geometric mean of the pairs", np.exp(np.mean(np.log(table), axis=0))),
        ):
            print(f"| {label} |", " | ".join(f"{e:.3f}" for e in value), "|", flush=True)
    for path in arguments.sets:
        results = []
        for x1, x2, t1, t2 in one_set(path):
            found = [timed(f, x1, x2, PAIR_THRESHOLD_PX) for f in peers.values()]
            results.append([(float(np.mean(errors(F, t1, t2))), ms) for F, ms in found])
        error, ms = np.moveaxis(np.array(results), -1, 0)
        below = [np.mean(error < bound, axis=0) for bound in BOUNDS_PX]
        cells = [
            f"{middle:.3f}: {', '.join(f'{share:.3f}' for share in shares)} / {t:.0f}"
            for middle, t, *shares in zip(
                np.median(error, axis=0), np.median(ms, axis=0), *below, strict=True
            )
        ]
        print(f"| {path.stem}, {len(results)} pairs |", " | ".join(cells), "|", flush=True)
    for share in (0.0, 0.3, 0.5, 0.7) if arguments.trials else ():
        trials = []
        for seed in range(arguments.trials):
            x1, x2, t1, t2 = simulated(share, seed)
            found = [timed(f, x1, x2, SCENE_THRESHOLD_PX) for f in peers.values()]
            trials.append([(float(np.mean(errors(F, t1, t2))), ms) for F, ms in found])
        cells = [f"{e:.3f} / {ms:.0f}" for e, ms in np.median(trials, axis=0)]
        print(f"| {100 * share:.0f} % wrong, scene |", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
