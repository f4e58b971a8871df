"""What the entries say of scenes that do, nearly do, and do not determine F: a confusion table.

    python benchmarks/verdicts.py [--trials 20] [--write docs/benchmarks/verdicts.md]

Each row is a kind of scene, a number of matches, a share of wrong ones and an entry; each column a
verdict, with the share of the trials that end in it. "ok" is success without a verdict of the
others. Entries that take matches for right ones (refine, batch) must tell wrong ones as gross
errors; `estimate_fundamental` must find the right ones.
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
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


ENTRIES = {
    "refine_fundamental": single(eg.refine_fundamental),
    "refine_fundamental_batch": batched,
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
    if options.write:
        options.write.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
