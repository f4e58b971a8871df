"""How near the truth motions from raw matches with known calibration come, beside PoseLib.

    python benchmarks/essential.py [--sets FILE ...] [--pairs 40] [--planes 20]

Sets are files of many pairs each, with K, R, t and raw matches. The error of a pair is the angle of
the rotation between estimate and truth, and that between the two translations, both in degrees. AUC
at a bound b is the mean over the pairs of max(0, 1 - error / b). Last, scenes of one plane: how
many of them end within a degree of the truth in rotation and five in translation.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Motion = tuple[Array, Array]
Estimator = Callable[[Array, Array, Array, Array], Motion]

BOUNDS = (1.0, 2.0, 5.0)
NOISE_PX = 0.5


def epigauge(x1: Array, x2: Array, K1: Array, K2: Array) -> Motion:
    found = eg.estimate_essential(x1, x2, K1, K2)
    assert found.R is not None
    assert found.t is not None
    return found.R, found.t


def poselib(x1: Array, x2: Array, K1: Array, K2: Array) -> Motion:
    import poselib

    first, second = (
        {"model": "PINHOLE", "width": 0, "height": 0, "params": K[[0, 1, 0, 1], [0, 1, 2, 2]]}
        for K in (K1, K2)
    )
    pose, _ = poselib.estimate_relative_pose(x1, x2, first, second, {"max_epipolar_error": 1.0})
    return np.asarray(pose.R), np.asarray(pose.t)


ESTIMATORS: dict[str, Estimator] = {"epigauge": epigauge, "poselib": poselib}


def errors(found: Motion, R: Array, t: Array) -> Array:
    """Return the angles of the rotation and between the translations, in degrees."""
    turn = np.clip((np.trace(found[0].T @ R) - 1.0) / 2.0, -1.0, 1.0)
    along = found[1] @ t / (np.linalg.norm(found[1]) * np.linalg.norm(t) + 1e-300)
    return np.degrees(np.arccos([turn, np.clip(along, -1.0, 1.0)]))


def timed(estimator: Estimator, *pair: Array) -> tuple[Motion, float]:
    begun = time.process_time()
    found = estimator(*pair)
    return found, time.process_time() - begun


def one_set(path: Path, most: int) -> None:
    """Print a row an estimator for one file."""
    with np.load(path) as z:
        count = len(z["pairs"])
        chosen = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
        found: dict[str, list[Array]] = {name: [] for name in ESTIMATORS}
        seconds: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
        for k in chosen:
            rows = slice(z["offsets"][k], z["offsets"][k + 1])
            x1, x2 = (z[name][rows].astype(np.float64) for name in ("x1", "x2"))
            for name, estimator in ESTIMATORS.items():
                motion, spent = timed(estimator, x1, x2, z["K1"][k], z["K2"][k])
                found[name].append(errors(motion, z["R"][k], z["t"][k]))
                seconds[name].append(spent)
    for name in ESTIMATORS:
        angles = np.array(found[name])
        cells = [
            f"{np.mean(np.maximum(0.0, 1.0 - angles[:, which] / bound)):.3f}"
            for which in (0, 1)
            for bound in BOUNDS
        ]
        medians = [f"{median:.3f}" for median in np.median(angles, axis=0)]
        milliseconds = f"{1e3 * float(np.median(seconds[name])):.1f}"
        print("| " + " | ".join([path.stem, name, str(len(angles)), *medians, *cells]), end="")
        print(f" | {milliseconds} |", flush=True)


def plane(seed: int) -> tuple[Array, Array, Array, Motion]:
    """Return matches of a slanted plane, the calibration, and the true motion."""
    rng = np.random.default_rng(seed)
    K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 480.0], [0.0, 0.0, 1.0]])
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])
    X = 6.0 * rays / (rays @ [*rng.uniform(-0.4, 0.4, 2), 1.0])[:, None]
    w = rng.standard_normal(3)
    C = np.cross(np.eye(3), -w / np.linalg.norm(w))
    angle = rng.uniform(0.05, 0.2)
    R = np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C
    t = rng.standard_normal(3)
    t *= 0.8 / np.linalg.norm(t)
    x1, x2 = ((Y / Y[:, 2:] @ K.T)[:, :2] for Y in (X, X @ R.T + t))
    x1, x2 = (x + NOISE_PX * rng.standard_normal(x.shape) for x in (x1, x2))
    return x1, x2, K, (R, t)


def planes(count: int) -> None:
    """Print how many planes each estimator gets right."""
    for name, estimator in ESTIMATORS.items():
        right = 0
        for seed in range(count):
            x1, x2, K, motion = plane(seed)
            turn, along = errors(estimator(x1, x2, K, K), *motion)
            right += bool(turn < 1.0 and along < 5.0)
        print(f"| planes | {name} | {right} of {count} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", type=Path, nargs="*", default=[])
    parser.add_argument("--pairs", type=int, default=40, help="pairs of each set, at most")
    parser.add_argument("--planes", type=int, default=20, help="scenes of one plane")
    arguments = parser.parse_args()
    if importlib.util.find_spec("poselib") is None:
        del ESTIMATORS["poselib"]
    auc = [f"AUC@{bound:g} {which}" for which in ("R", "t") for bound in BOUNDS]
    head = ["set", "estimator", "pairs", "median R, deg", "median t, deg", *auc, "ms"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for path in arguments.sets:
        one_set(path, arguments.pairs)
    planes(arguments.planes)


if __name__ == "__main__":
    main()
