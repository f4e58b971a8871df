"""What the entries say of scenes that do, nearly do, and do not determine F: a confusion table.

    python benchmarks/verdicts.py [--trials 20] [--parts table random general costs]

Each row is a kind of scene, a number of matches, a share of wrong ones and an entry; each column a
verdict, with the share of the trials that end in it. "ok" is success without a verdict of the
others. Entries that take matches for right ones (refine, batch, a COLMAP database) must tell wrong
ones as gross errors; `estimate_fundamental` must find the right ones.

Then random matches by their number, and general scenes of any focal length, depth, motion, noise
and share of wrong matches (100 trials of each); then the time of the flags and of the search for
copies over that of the refinement, both from one run, minima over the calls.
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
from epigauge.two_view.copies import counted_once
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

#: Verdicts that a scene which determines F must not have.
_DEGENERATE = {"planar scene", "nearly planar", "pure rotation", "still camera"}

_SIZE = np.array([1280.0, 960.0])
_FOCAL = 1000.0


def scene(
    kind: str, m: int, wrong: float, rng: np.random.Generator, noise_px: float = 0.5
) -> tuple[Array, Array]:
    """Return m matches with noise, a share of them replaced by random ones."""
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
    x1, x2 = (x + noise_px * rng.standard_normal((m, 2)) for x in (x1, x2))
    chosen = rng.permutation(m)[: m if kind == "random" else round(wrong * m)]
    for x in (x1, x2):
        x[chosen] = rng.uniform([0.0, 0.0], _SIZE, (len(chosen), 2))
    return x1, x2


def general(seed: int) -> tuple[Array, Array, int, float]:
    """Return matches of a scene of any kind that determines F, their number and share of wrong."""
    rng = np.random.default_rng([7, seed])
    m, wrong = int(rng.integers(30, 501)), float(rng.choice([0.0, 0.1, 0.3, 0.5]))
    focal, near = rng.uniform(600.0, 2000.0), rng.uniform(2.0, 6.0)
    X = np.column_stack([rng.uniform(-0.5, 0.5, (m, 2)) * _SIZE / focal, np.ones(m)])
    X *= near * rng.uniform(1.0, rng.uniform(1.6, 4.0), m)[:, None]
    t = rng.standard_normal(3)
    t *= rng.uniform(0.1, 0.3) * near / np.linalg.norm(t)
    axis = rng.standard_normal(3)
    C = np.cross(np.eye(3), -axis / np.linalg.norm(axis))
    angle = rng.uniform(0.0, 0.25)
    R = np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C
    x1, x2 = (focal * Y[:, :2] / Y[:, 2:] + _SIZE / 2.0 for Y in (X, X @ R.T + t))
    noise = rng.uniform(0.1, 0.8)
    x1, x2 = (x + noise * rng.standard_normal((m, 2)) for x in (x1, x2))
    chosen = rng.permutation(m)[: round(wrong * m)]
    for x in (x1, x2):
        x[chosen] = rng.uniform([0.0, 0.0], _SIZE, (len(chosen), 2))
    return x1, x2, m, wrong


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


def random_row(m: int, entry: str, trials: int) -> str:
    """Return how many sets of random matches are told, and how many end with success."""
    named = successes = 0
    for seed in range(trials):
        x1, x2 = scene("random", m, 0.0, np.random.default_rng([99, m, seed]))
        flags, success = ENTRIES[entry](x1, x2)
        named += "no common geometry" in flags
        successes += success
    return f"| {m} | {entry} | {trials} | {named} | {successes} |"


def general_row(entry: str, trials: int) -> str:
    """Return what is said of general scenes, with and without wrong matches taken for right."""
    tally: Counter[str] = Counter()
    for seed in range(trials):
        x1, x2, _, wrong = general(seed)
        told = "right" if not wrong or entry == "estimate_fundamental" else "wrong"
        flags, success = ENTRIES[entry](x1, x2)
        tally[told] += 1
        tally["degenerate"] += not set(flags).isdisjoint(_DEGENERATE)
        tally["gross errors"] += "gross errors" in flags
        tally["none in common"] += "no common geometry" in flags
        tally["success"] += success and told == "right"
    return (
        f"| {entry} | {tally['right']} | {tally['success']} | {tally['wrong']} | "
        f"{tally['gross errors']} | {tally['none in common']} | {tally['degenerate']} |"
    )


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


def copies() -> list[str]:
    """Return the time of the search for repeated matches, and of a refinement."""
    lines = ["| matches | copies | refinement | search for copies | share |", f"|{'---|' * 5}"]
    for m, share in itertools.product((50, 100, 500, 1000, 10_000), (0.0, 0.3)):
        times = []
        for seed in range(5):
            rng = np.random.default_rng([m, seed])
            x1, x2 = scene("general", m, 0.0, rng)
            again = rng.integers(0, m // 2, int(share * m))
            x1[m - len(again) :], x2[m - len(again) :] = x1[again], x2[again]
            F0 = eg.fundamental_8point(x1, x2)
            alone = least(lambda x1=x1, x2=x2, F0=F0: eg.refine_fundamental(x1, x2, F0))
            times.append((alone, least(lambda x1=x1, x2=x2: counted_once(x1, x2, None))))
        whole, own = np.median(times, axis=0)
        lines.append(
            f"| {m} | {share:.0%} | {1e3 * whole:.3f} ms | {1e3 * own:.4f} ms | {own / whole:.2f} |"
        )
    return lines


COLUMNS = ("ok", *VERDICTS, "success")

PARTS = ("table", "random", "general", "costs")


def main() -> None:
    """Print the table; write it for the documentation where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--entries", nargs="*", default=list(ENTRIES), choices=list(ENTRIES))
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=PARTS)
    options = parser.parse_args()
    if "table" in options.parts:
        show(["scene", "matches", "wrong", "entry", *COLUMNS])
        for kind, wrong, m in itertools.product(KINDS, (0.0, 0.3), (50, 500)):
            if kind == "random" and wrong:
                continue  # all are wrong
            for entry in options.entries:
                shares = row(kind, m, wrong, entry, options.trials)
                print(
                    f"| {kind} | {m} | {wrong:.0%} | {entry} | {' | '.join(shares)} |", flush=True
                )
    if "random" in options.parts:
        show(["random matches", "entry", "trials", "no common geometry", "success"])
        for m, entry in itertools.product((8, 9, 10, 12, 20, 50, 200, 2000), options.entries):
            print(random_row(m, entry, 5 * options.trials), flush=True)
    if "general" in options.parts:  # what takes matches for right is not to be used with wrong ones
        told = ("gross errors", "none in common", "degenerate")
        show(["entry", "to be used", "success", "not to be used", *told])
        for entry in options.entries:
            print(general_row(entry, 10 * options.trials), flush=True)
    if "costs" in options.parts:
        print("\n".join(["", *costs(), "", *copies()]), flush=True)


def show(head: list[str]) -> None:
    """Print the head of a table."""
    print(f"\n| {' | '.join(head)} |\n|{'---|' * len(head)}", flush=True)


if __name__ == "__main__":
    main()
