"""How near the truth motions from raw matches with known calibration come, beside PoseLib.

    python benchmarks/essential.py [--sets FILE ...] [--tracks FOLDER ...] [--pairs 40]
        [--wrong 0 0.3 0.5 0.6] [--kinds uniform beside] [--planes 20]

Sets are files of many pairs each, with K, R, t and raw matches. Folders hold tracks of many views
with K, and the metric cameras of an adjustment of all views, which stand for the truth; wrong
matches are added, uniform or beside their own place, as windows of a facade are, and of a pair no
more than 400 matches are taken. Names without a path are those of the folder EPIGAUGE_DATA, and
without any sets or folders, all there are. The error of a pair is the angle of the rotation between
estimate and truth, and that between the two translations, both in degrees. AUC at a bound b is the
mean over the pairs of max(0, 1 - error / b), of both errors and of the larger. Of the pairs with an
error above 10 degrees, "sure" counts those that say success, of the pairs within 2 degrees,
"refused" those that do not. Last, scenes of one plane: how many of them end within a degree of the
truth in rotation and five in translation.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Motion = tuple[Array, Array]
Estimator = Callable[[Array, Array, Array, Array], tuple[Motion, bool]]

#: Two images' matches, two calibrations, and the true motion.
Pair = tuple[Array, Array, Array, Array, Motion]

BOUNDS = (1.0, 2.0, 5.0)
NOISE_PX = 0.5

#: Errors in degrees that are plainly wrong, and plainly good.
WRONG, GOOD = 10.0, 2.0

#: Sets in EPIGAUGE_DATA.
SETS = [f"strecha_pairs/{name}.npz" for name in ("entry_p10", "castle_p19", "fountain_p11")]
TRACKS = [
    f"olsson_{name}" for name in ("lund_cath_small", "house_martenstorget", "uwo", "lu_sphinx")
]

#: Matches of a pair of views of tracks at least, at most, and views between the two.
LEAST, MOST, STEPS = 30, 400, (1, 2, 4, 8)

#: How far wrong matches beside their place go, as shares of the size of the image.
BESIDE = (0.02, 0.1)


def epigauge(x1: Array, x2: Array, K1: Array, K2: Array) -> tuple[Motion, bool]:
    found = eg.estimate_essential(x1, x2, K1, K2)
    assert found.R is not None
    assert found.t is not None
    return (found.R, found.t), found.success


def poselib(x1: Array, x2: Array, K1: Array, K2: Array) -> tuple[Motion, bool]:
    import poselib

    first, second = (
        {"model": "PINHOLE", "width": 0, "height": 0, "params": K[[0, 1, 0, 1], [0, 1, 2, 2]]}
        for K in (K1, K2)
    )
    pose, _ = poselib.estimate_relative_pose(x1, x2, first, second, {"max_epipolar_error": 1.0})
    return (np.asarray(pose.R), np.asarray(pose.t)), True


ESTIMATORS: dict[str, Estimator] = {"epigauge": epigauge, "poselib": poselib}


def errors(found: Motion, R: Array, t: Array) -> Array:
    """Return the angles of the rotation and between the translations, in degrees."""
    turn = np.clip((np.trace(found[0].T @ R) - 1.0) / 2.0, -1.0, 1.0)
    along = found[1] @ t / (np.linalg.norm(found[1]) * np.linalg.norm(t) + 1e-300)
    return np.degrees(np.arccos([turn, np.clip(along, -1.0, 1.0)]))


def pairs_of_file(path: Path, most: int) -> Iterator[Pair]:
    """Yield pairs of raw matches."""
    with np.load(path) as z:
        count = len(z["pairs"])
        for k in np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)):
            rows = slice(z["offsets"][k], z["offsets"][k + 1])
            x1, x2 = (z[name][rows].astype(np.float64) for name in ("x1", "x2"))
            yield x1, x2, z["K1"][k], z["K2"][k], (z["R"][k], z["t"][k])


def pairs_of_tracks(folder: Path, most: int, wrong: float, kind: str) -> Iterator[Pair]:
    """Yield pairs of views, a share of whose matches is made wrong."""
    with np.load(folder / "tracks.npz") as z:
        view, point, xy = z["view"], z["point"], z["xy"].astype(np.float64)
        n, K, size = int(z["n_views"]), z["K"].reshape(-1, 3, 3)[0], z["image_size"]
    with np.load(folder / "reference.npz") as z:
        R, t = z["R"], z["t"]
    there = np.flatnonzero(np.isfinite(R).all(axis=(1, 2)) & np.isfinite(t).all(axis=1))
    views = [(i, i + step) for step in STEPS for i in range(n - step)]
    chosen = [pair for pair in views if np.isin(pair, there).all()]
    rows = [np.flatnonzero(view == i) for i in range(n)]
    enough = [
        pair for pair in chosen if len(np.intersect1d(*(point[rows[i]] for i in pair))) >= LEAST
    ]
    for k in np.unique(np.linspace(0, len(enough) - 1, min(len(enough), most)).astype(int)):
        i, j = enough[k]
        rng = np.random.default_rng([i, j])
        _, own, other = np.intersect1d(point[rows[i]], point[rows[j]], return_indices=True)
        taken = rng.permutation(len(own))[:MOST]
        x1, x2 = xy[rows[i][own[taken]]], xy[rows[j][other[taken]]]
        false = rng.random(len(x1)) < wrong
        count = int(np.count_nonzero(false))
        x2[false] = xy[rng.choice(rows[j], count)]
        if kind == "beside":
            far = rng.uniform(*BESIDE, count) * max(size)
            angle = rng.choice([0.0, np.pi], count) + 0.1 * rng.standard_normal(count)
            place = xy[rows[j][other[taken]]][false]
            x2[false] = place + far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        yield x1, x2, K, K, (R[j] @ R[i].T, t[j] - R[j] @ R[i].T @ t[i])


def one_set(name: str, pairs: Iterator[Pair]) -> None:
    """Print a row an estimator for some pairs."""
    found: dict[str, list[Array]] = {name: [] for name in ESTIMATORS}
    seconds: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    sure: dict[str, list[bool]] = {name: [] for name in ESTIMATORS}
    for x1, x2, K1, K2, truth in pairs:
        for estimator, estimate in ESTIMATORS.items():
            begun = time.process_time()
            motion, success = estimate(x1, x2, K1, K2)
            seconds[estimator].append(time.process_time() - begun)
            found[estimator].append(errors(motion, *truth))
            sure[estimator].append(success)
    for estimator in ESTIMATORS:
        angles, said = np.array(found[estimator]), np.array(sure[estimator])
        worst = np.max(angles, axis=1)
        cells = [
            f"{np.mean(np.maximum(0.0, 1.0 - each / bound)):.3f}"
            for each in (*angles.T, worst)
            for bound in BOUNDS
        ]
        cells += [str(np.sum(said & (worst > WRONG))), str(np.sum(~said & (worst < GOOD)))]
        medians = [f"{median:.3f}" for median in np.median(angles, axis=0)]
        milliseconds = f"{1e3 * float(np.median(seconds[estimator])):.1f}"
        print("| " + " | ".join([name, estimator, str(len(angles)), *medians, *cells]), end="")
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
            turn, along = errors(estimator(x1, x2, K, K)[0], *motion)
            right += bool(turn < 1.0 and along < 5.0)
        print(f"| planes | {name} | {right} of {count} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", type=Path, nargs="*")
    parser.add_argument("--tracks", type=Path, nargs="*")
    parser.add_argument("--pairs", type=int, default=40, help="pairs of each set, at most")
    parser.add_argument("--wrong", type=float, nargs="*", default=[0.0, 0.3, 0.5, 0.6])
    parser.add_argument("--kinds", nargs="*", default=["uniform", "beside"])
    parser.add_argument("--planes", type=int, default=20, help="scenes of one plane")
    arguments = parser.parse_args()
    if importlib.util.find_spec("poselib") is None:
        del ESTIMATORS["poselib"]
    data = Path(os.environ.get("EPIGAUGE_DATA", ""))
    sets, tracks = arguments.sets, arguments.tracks
    if sets is None and tracks is None and "EPIGAUGE_DATA" in os.environ:
        sets, tracks = SETS, TRACKS
    auc = [f"AUC@{bound:g} {which}" for which in ("R", "t", "both") for bound in BOUNDS]
    head = ["set", "estimator", "pairs", "median R, deg", "median t, deg", *auc]
    head += ["sure", "refused", "ms"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for path in sets or ():
        one_set(Path(path).stem, pairs_of_file(data / path, arguments.pairs))
    for path in tracks or ():
        for wrong in arguments.wrong:
            for kind in arguments.kinds if wrong else arguments.kinds[:1]:
                pairs = pairs_of_tracks(data / path, arguments.pairs, wrong, kind)
                one_set(f"{Path(path).name}, {wrong:.0%} {kind if wrong else ''}", pairs)
    planes(arguments.planes)


if __name__ == "__main__":
    main()
