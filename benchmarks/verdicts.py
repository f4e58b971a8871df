"""What the entries say of scenes that do, nearly do, and do not determine F: a confusion table.

    python benchmarks/verdicts.py [--trials 20] [--write docs/benchmarks/verdicts.md]

Each row is a kind of scene, a number of matches, a share of wrong ones and an entry; each column a
verdict, with the share of the trials that end in it. "ok" is success without a verdict of the
others. Entries that take matches for right ones (refine, batch, a COLMAP database) must tell wrong
ones as gross errors; `estimate_fundamental` must find the right ones. Then the time of the flags
over that of the refinement, both from one run, minima over the calls.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import itertools
import sqlite3
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
from epigauge.verdicts import FLAGS
from numpy.typing import NDArray

Array = NDArray[np.float64]

KINDS = ("general", "near-planar", "planar", "rotation", "still", "random")
VERDICTS = {
    "planar": ("planar scene",),
    "nearly planar": ("nearly planar",),
    "rotation": ("pure rotation",),
    "still": ("still camera",),
    "none in common": ("no common geometry",),
    "gross errors": ("gross errors",),
}

_SIZE = np.array([1280.0, 960.0])
_FOCAL = 1000.0


def scene(kind: str, m: int, wrong: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return m matches with a noise of half a pixel, a share of them replaced by random ones."""
    rays = np.column_stack([rng.uniform(-0.6, 0.6, m), rng.uniform(-0.45, 0.45, m), np.ones(m)])
    X = rays * rng.uniform(4.0, 8.0, m)[:, None]
    if kind in ("planar", "near-planar"):
        X = 6.0 * rays / (rays @ [*rng.uniform(-0.4, 0.4, 2), 1.0])[:, None]
    if kind == "near-planar":  # one match in twenty stands well in front of the plane
        off = max(3, m // 20)
        X[:off] = rays[:off] * rng.uniform(4.0, 5.0, off)[:, None]
    axis = rng.standard_normal(3)
    C = np.cross(np.eye(3), -axis / np.linalg.norm(axis))
    angle = 0.0 if kind == "still" else rng.uniform(0.05, 0.2)
    R = np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C
    t = rng.standard_normal(3)
    t *= 0.0 if kind in ("rotation", "still") else 0.8 / np.linalg.norm(t)
    x1, x2 = (_FOCAL * Y[:, :2] / Y[:, 2:] + _SIZE / 2.0 for Y in (X, X @ R.T + t))
    x1, x2 = (x + 0.5 * rng.standard_normal((m, 2)) for x in (x1, x2))
    chosen = rng.permutation(m)[: m if kind == "random" else round(wrong * m)]
    for x in (x1, x2):
        x[chosen] = rng.uniform([0.0, 0.0], _SIZE, (len(chosen), 2))
    return x1, x2


def batched(x1: Array, x2: Array) -> tuple[tuple[str, ...], bool]:
    """Ask the batch."""
    batch = eg.refine_fundamental_batch(x1, x2, [0, len(x1)])
    return batch.flags[0], bool(batch.success[0])


Answer = tuple[tuple[str, ...], bool]


def single(solve: Callable[..., eg.FundamentalResult]) -> Callable[..., Answer]:
    """Ask an entry for one pair."""

    def ask(x1: Array, x2: Array) -> Answer:
        result = solve(x1, x2)
        return result.flags, result.success

    return ask


#: What of a COLMAP database is read.
_TABLES = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER, width INTEGER, height INTEGER,
    params BLOB, prior_focal_length INTEGER);
CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER,
    data BLOB, config INTEGER, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
"""


def stored(x1: Array, x2: Array) -> Answer:
    """Ask for a COLMAP database that has the matches as inliers of config 3, without F."""
    m = len(x1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pair.db"
        with sqlite3.connect(path) as database:
            database.executescript(_TABLES)
            focal = np.array([_FOCAL, *_SIZE / 2.0]).tobytes()
            database.execute("INSERT INTO cameras VALUES (1, 0, 1280, 960, ?, 0)", (focal,))
            for image, x in ((1, x1), (2, x2)):
                database.execute("INSERT INTO images VALUES (?, ?, 1)", (image, f"{image}.jpg"))
                keypoints = (image, m, 2, x.astype("<f4").tobytes())
                database.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", keypoints)
            inliers = np.column_stack([np.arange(m)] * 2).astype("<u4").tobytes()
            row = (2147483647 + 2, m, inliers, np.eye(3).tobytes())
            database.execute(
                "INSERT INTO two_view_geometries VALUES (?, ?, 2, ?, 3, ?, NULL, NULL, NULL, NULL)",
                row,
            )
        database.close()
        result = eg.colmap.refine_database(path)
    told = tuple(flag for flag in FLAGS if flag in result.note[0])
    return told, result.verdict == ("refined",)


ENTRIES = {
    "refine_fundamental": single(eg.refine_fundamental),
    "refine_fundamental_batch": batched,
    "colmap.refine_database": stored,
    "estimate_fundamental": single(eg.estimate_fundamental),
}


def row(kind: str, m: int, wrong: float, entry: str, trials: int) -> list[str]:
    """Return the shares of the verdicts, and of success."""
    count: Counter[str] = Counter()
    for seed in range(trials):
        rng = np.random.default_rng([KINDS.index(kind), m, round(100 * wrong), seed])
        flags, success = ENTRIES[entry](*scene(kind, m, wrong, rng))
        told = [name for name, any_of in VERDICTS.items() if not set(any_of).isdisjoint(flags)]
        count.update(told or ["ok"])
        count["success"] += success
    return [f"{count[name] / trials:.2f}" if count[name] else "." for name in COLUMNS]


def costs() -> list[str]:
    """Return the times of refinement and flags: general scenes, and Bartoli and Sturm's at 10 m."""
    lines = ["| scene | matches | refinement | with flags | flags / refinement |", f"|{'---|' * 5}"]
    for name, m in itertools.product(("general", "B&S, 10 m"), (50, 100, 500, 1000)):
        ratios, times = [], []
        for seed in range(9):
            x1, x2 = scene("general", m, 0.0, np.random.default_rng([m, seed]))
            if name != "general":
                view = eg.two_view_scene(10.0, n_points=m, seed=seed)
                x1, x2 = view.x1, view.x2
            F0 = eg.fundamental_8point(x1, x2)
            alone = least(lambda x1=x1, x2=x2, F0=F0: eg.refine_fundamental(x1, x2, F0))
            flagged = least(lambda x1=x1, x2=x2, F0=F0: eg.refine_fundamental(x1, x2, F0).flags)
            times.append((alone, flagged))
            ratios.append((flagged - alone) / alone)
        alone, flagged = 1e3 * np.median(times, axis=0)
        lines.append(
            f"| {name} | {m} | {alone:.3f} ms | {flagged:.3f} ms | {np.median(ratios):.2f} |"
        )
    pairs = [scene("general", 100, 0.0, np.random.default_rng(seed)) for seed in range(100)]
    x1, x2 = (np.tile(np.concatenate(x), (100, 1)) for x in zip(*pairs, strict=True))
    offsets = 100 * np.arange(10_001)
    begun = time.perf_counter()
    batch = eg.refine_fundamental_batch(x1, x2, offsets)
    middle = time.perf_counter()
    told = sum(map(bool, batch.flags))
    ended = time.perf_counter()
    lines.append(
        f"| batch of 10,000 pairs, {told} flagged | 100 | {100 * (middle - begun):.1f} us a pair | "
        f"{100 * (ended - begun):.1f} us a pair | {(ended - middle) / (middle - begun):.2f} |"
    )
    return lines


def least(call: Callable[[], object]) -> float:
    """Return the least time of some calls."""
    times = []
    for _ in range(15):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return min(times)


COLUMNS = ("ok", *VERDICTS, "success")


def main() -> None:
    """Print the table; write it for the documentation where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--entries", nargs="*", default=list(ENTRIES), choices=list(ENTRIES))
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    head = ("scene", "matches", "wrong", "entry", *COLUMNS)
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    print("\n".join(lines), flush=True)
    for kind, wrong, m in itertools.product(KINDS, (0.0, 0.3), (50, 500)):
        for entry in options.entries:
            shares = row(kind, m, wrong, entry, options.trials)
            line = f"| {kind} | {m} | {wrong:.0%} | {entry} | {' | '.join(shares)} |"
            lines.append(line)
            print(line, flush=True)
    lines += ["", *costs()]
    print("\n".join(lines[-10:]), flush=True)
    if options.write:
        options.write.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
