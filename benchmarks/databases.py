"""How fast the raw matches of a COLMAP database are verified, beside COLMAP itself.

    python benchmarks/databases.py [--images 12] [--matches 500] [--wrong 0.2 0.4] [--workers 2]

Databases of photographs of a room, every pair with so many raw matches, a share of them wrong,
noise in pixels of a 1400 x 1000 image. Each is verified by both, with the same number of threads,
from a copy of its own; 142 images are 10,000 pairs, and from 256 on the threads of epigauge are
processes. Milliseconds a pair: of the clock, and of processor time.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import _one_thread  # noqa: F401
import epigauge as eg
import numpy as np

try:
    import pycolmap
except ImportError:
    pycolmap = None

FOCAL, SIZE = 1000.0, (1400, 1000)


def database(
    path: Path, images: int, matches: int, wrong: float, noise_px: float, focal: str
) -> int:
    """Write a database; return how many pairs it has."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-4.0, -3.0, 6.0], [4.0, 3.0, 14.0], (8 * matches, 3))
    with pycolmap.Database.open(path) as opened:
        params = [FOCAL, SIZE[0] / 2.0, SIZE[1] / 2.0]
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=SIZE[0], height=SIZE[1], params=params
        )
        camera.has_prior_focal_length = focal == "known"
        number = opened.write_camera(camera)
        ids = []
        for k in range(images):
            R = np.linalg.qr(np.eye(3) + 0.08 * rng.normal(size=(3, 3)))[0]
            R *= np.sign(np.diag(R))
            seen = X @ R.T + rng.normal(0.0, 0.7, 3) * [1.0, 0.6, 0.5]
            x = FOCAL * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2.0
            x += rng.normal(0.0, noise_px, x.shape)
            ids.append(opened.write_image(pycolmap.Image(name=f"{k}.jpg", camera_id=number)))
            opened.write_keypoints(ids[-1], x.astype(np.float32))
        for one, other in combinations(ids, 2):
            rows = rng.choice(len(X), matches, replace=False)
            pair = np.column_stack([rows, rows])
            bad = rng.random(matches) < wrong
            pair[bad, 1] = rng.integers(0, len(X), np.count_nonzero(bad))
            opened.write_matches(one, other, pair.astype(np.uint32))
    return images * (images - 1) // 2


def by_colmap(path: Path, workers: int) -> None:
    options = pycolmap.GeometricVerifierOptions()
    options.num_threads = workers
    pycolmap.geometric_verification(path, options)


def by_epigauge(path: Path, workers: int) -> None:
    eg.colmap.verify_database(path, write=True, backup=False, workers=workers)


def processor() -> float:
    """Return seconds of processor time, with those of processes that have ended."""
    return sum(os.times()[:4])


def timed(run: Callable[[Path, int], None], path: Path, workers: int) -> tuple[float, float]:
    """Return seconds of the clock and of the processor for a copy of a database."""
    with tempfile.TemporaryDirectory() as folder:
        own = Path(shutil.copy(path, folder))
        wall, cpu = time.perf_counter(), processor()
        run(own, workers)
        return time.perf_counter() - wall, processor() - cpu


def main() -> None:
    """Print a table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--matches", type=int, default=500)
    parser.add_argument("--wrong", type=float, nargs="*", default=[0.2, 0.4, 0.6])
    parser.add_argument("--noise", type=float, nargs="*", default=[0.4, 0.8])
    parser.add_argument("--focal", nargs="*", default=["known", "unknown"], help="lengths")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--runs", type=int, default=2, help="of which the fastest counts")
    arguments = parser.parse_args()
    if pycolmap is None:
        print("The databases are made, and verified beside us, by pycolmap, which is not there.")
        return
    pycolmap.logging.minloglevel = 3
    print("| focal length | noise, px | wrong | COLMAP | epigauge |")
    print("|---|---|---|---|---|")
    for focal in arguments.focal:
        for noise in arguments.noise:
            for wrong in arguments.wrong:
                with tempfile.TemporaryDirectory() as folder:
                    path = Path(folder) / "database.db"
                    pairs = database(path, arguments.images, arguments.matches, wrong, noise, focal)
                    cells = []
                    for run in (by_colmap, by_epigauge):
                        times = [timed(run, path, arguments.workers) for _ in range(arguments.runs)]
                        wall, cpu = (1e3 * value / pairs for value in np.min(times, axis=0))
                        cells.append(f"{wall:.1f} / {cpu:.1f}")
                print(
                    f"| {focal} | {noise} | {100 * wrong:.0f} % |",
                    " | ".join(cells),
                    "|",
                    flush=True,
                )


if __name__ == "__main__":
    main()
