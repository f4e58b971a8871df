"""Metric upgrades: motions that leave intrinsics open, and measured tracks with known cameras.

    python benchmarks/metric_upgrade.py [--trials 50]
    python benchmarks/metric_upgrade.py --data FOLDER

The first prints which share of simulated scenes of each motion is flagged, and how the errors of
the focal length compare with their standard deviations. The second takes a folder with one folder
a data set, each with a tracks.npz with K, as those of Strecha and of Olsson.
"""

from __future__ import annotations

import argparse
import collections
import sys
import time
from pathlib import Path

import epigauge as eg
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from calibration import SIZE, tracks_of

MOTIONS = ("general", "translation", "rotation", "axis", "point")
NAMED = {
    "translation": "pure translation",
    "rotation": "pure rotation",
    "axis": "one rotation axis",
    "point": "one viewing point",
}


def simulated(trials: int) -> None:
    """Print a line a motion."""
    print("motion        trials  flagged  named  success  rms (f - f0) / sigma   flags")
    for motion in MOTIONS:
        flags: collections.Counter[str] = collections.Counter()
        ratios, flagged, named, good = [], 0, 0, 0
        for seed in range(trials):
            rng = np.random.default_rng(seed)
            options = {"n_views": int(rng.integers(4, 9)), "n_points": int(rng.integers(60, 200))}
            noise = float(rng.choice([0.2, 0.5, 1.0]))
            tracks, _ = tracks_of(motion, 1000 + seed, noise_px=noise, **options)
            found = eg.metric_upgrade(tracks, image_size=SIZE)
            flags.update(found.flags)
            flagged += bool(found.flags)
            named += NAMED.get(motion, "") in found.flags
            good += found.success
            if found.success:
                ratios.append((found.focal_px - 900.0) / found.focal_std_px)
        spread = np.sqrt(np.mean(np.square(ratios))) if ratios else float("nan")
        words = ", ".join(f"{name} {count}" for name, count in flags.most_common())
        print(f"{motion:12} {trials:7} {flagged:8} {named:6} {good:8} {spread:12.2f}   {words}")


def measured(folder: Path) -> None:
    """Print a line a data set with known K."""
    print(f"{'set':26} focal_px     std    true   error  sigmas  rms_px  seconds  flags")
    for path in sorted(folder.glob("*/tracks.npz")):
        with np.load(path) as data:
            z = {name: data[name] for name in data.files}
        strecha = path.parent.name.startswith("strecha")
        size = np.array([3072, 2048]) if strecha else z.get("image_size")
        if "K" not in z or size is None:
            continue
        tracks = eg.Tracks(z["view"], z["point"], z["xy"])
        true = np.array(z["K"]).reshape(-1, 3, 3)[0, [0, 1], [0, 1]].mean()
        begin = time.process_time()
        found = eg.metric_upgrade(tracks, image_size=size)
        seconds = time.process_time() - begin
        error = 100.0 * (found.focal_px / true - 1.0)
        sigmas = (found.focal_px - true) / found.focal_std_px
        print(
            f"{path.parent.name:26} {found.focal_px:9.2f} {found.focal_std_px:7.2f} {true:7.1f} "
            f"{error:+6.2f}% {sigmas:+7.2f} {found.rms_px:7.4f} {seconds:8.2f}  "
            f"{', '.join(found.flags) or '-'}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--data", type=Path)
    options = parser.parse_args()
    if options.data is None:
        simulated(options.trials)
    else:
        measured(options.data)
