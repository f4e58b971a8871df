"""A COLMAP database of many pairs, refined or verified by executors of every kind: the same rows.

    python benchmarks/executors.py [--images 201] [--matches 60] [--verify] [--workers 2]

Every pair of so many photographs of a room, 20,100 of 201, with matches of 0.5 px noise. By default
their verified pairs are refined (`refine_database`). With `--verify` a fifth of the matches is
wrong, and the raw ones are verified (`verify_database`), which takes some milliseconds a pair.
Seconds by threads, processes and the workers of a Dask cluster; the exit code is 1 where rows
differ by a bit.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pycolmap
from cluster import cluster
from distributed import Client

FOCAL, SIZE, NOISE_PX = 1000.0, (1400, 1000), 0.5


def database(path: Path, images: int, matches: int, wrong: float) -> int:
    """Write a database, whose pairs are verified where no match is wrong; return their number."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-4.0, -3.0, 6.0], [4.0, 3.0, 14.0], (8 * matches, 3))
    with pycolmap.Database.open(path) as opened, pycolmap.DatabaseTransaction(opened):
        params = [FOCAL, SIZE[0] / 2.0, SIZE[1] / 2.0]
        number = opened.write_camera(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=SIZE[0], height=SIZE[1], params=params)
        )
        ids = []
        for k in range(images):
            R = np.linalg.qr(np.eye(3) + 0.08 * rng.normal(size=(3, 3)))[0]
            R *= np.sign(np.diag(R))
            seen = X @ R.T + rng.normal(0.0, 0.7, 3) * [1.0, 0.6, 0.5]
            x = FOCAL * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2.0
            x += rng.normal(0.0, NOISE_PX, x.shape)
            ids.append(opened.write_image(pycolmap.Image(name=f"{k}.jpg", camera_id=number)))
            opened.write_keypoints(ids[-1], x.astype(np.float32))
        for one, other in combinations(ids, 2):
            rows = rng.choice(len(X), matches, replace=False)
            pair = np.column_stack([rows, rows]).astype(np.uint32)
            if wrong:
                bad = rng.random(matches) < wrong
                pair[bad, 1] = rng.integers(0, len(X), np.count_nonzero(bad))
                opened.write_matches(one, other, pair)
            else:
                verified = pycolmap.TwoViewGeometry(
                    config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED, inlier_matches=pair
                )
                opened.write_two_view_geometry(one, other, verified)
    return images * (images - 1) // 2


@contextmanager
def executors(workers: int) -> Iterator[dict[str, Executor]]:
    """Give executors by their names."""
    with (
        ThreadPoolExecutor(workers) as threads,
        ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as processes,
        cluster(workers) as there,
        Client(there) as client,
    ):
        yield {"threads": threads, "processes": processes, "Dask": client.get_executor()}


def differing(one: Any, other: Any) -> list[str]:
    """Return the columns of two results that are not the same to the last bit."""
    found = []
    for column in fields(one):
        left, right = getattr(one, column.name), getattr(other, column.name)
        if isinstance(left, np.ndarray):
            same = left.shape == right.shape and left.tobytes() == right.tobytes()
        else:
            same = left == right
        if not same:
            found.append(column.name)
    return found


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--images", type=int, default=201)
    parser.add_argument("--matches", type=int, default=60)
    parser.add_argument("--verify", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    call: Any = eg.colmap.verify_database if options.verify else eg.colmap.refine_database
    results: dict[str, Any] = {}
    different: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as folder, executors(options.workers) as every:
        path = Path(folder) / "database.db"
        begin = time.perf_counter()
        wrong = 0.2 if options.verify else 0.0
        pairs = database(path, options.images, options.matches, wrong)
        print(f"{pairs} pairs of {options.matches} matches", end=", ")
        print(f"written in {time.perf_counter() - begin:.0f} s", flush=True)
        for name, executor in every.items():
            begin = time.perf_counter()
            results[name] = call(path, executor=executor)
            print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)
            different[name] = differing(results["threads"], results[name])
    print(results["threads"])
    for name, columns in different.items():
        if columns:
            print(f"{name} differ from threads in {', '.join(columns)}")
    same = not any(different.values())
    print("the same rows, to the last bit, by all" if same else "NOT the same rows")
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
