"""Fit and check the constants of `probability_good`: how often an error is as small as promised.

    python benchmarks/confidence.py [--sets FILE ...] [--pairs DIRECTORY] [--trials 300]

Sets are files of many pairs with true F; the pairs of the directory have a true F, or are compared
with the maximum-likelihood F of the matches that are marked as right; the trials are simulated:
scenes of all kinds, and that of Bartoli & Sturm 2004 with wrong matches among them. Each set is
held out in turn: the constants are fitted to the others, and the probabilities of its pairs at the
bounds are sorted into ten bins. The expected calibration error is
the mean difference between the promise of a bin and how often it was kept. Last, the constants
fitted to all sets, for `epigauge.two_view.confidence`.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
from dataclasses import astuple
from pathlib import Path

import epigauge as eg
import numpy as np
from epigauge.two_view.confidence import (
    Confidence,
    Constants,
    Signs,
    probability_below,
)
from numpy.typing import NDArray
from robust import errors, one_set
from robust import simulated as bartoli_sturm
from scipy.optimize import minimize

Array = NDArray[np.float64]
Pair = tuple[Array, Array, Array, Array]
Case = tuple[Signs, float]

BOUNDS_PX = (0.5, 1.0, 2.0, 5.0)
BINS = 10
_SIZE = np.array([1280.0, 960.0])

#: An error below is rounding.
_LEAST_PX = 1e-3


def simulated(seed: int) -> Pair:
    """Return matches of a scene of any kind, and the true ones: some hardly determine F."""
    rng = np.random.default_rng([23, seed])
    m = int(np.exp(rng.uniform(*np.log([20.0, 1500.0]))))
    wrong, noise = rng.uniform(0.0, 0.85), np.exp(rng.uniform(*np.log([0.1, 2.0])))
    focal, near = rng.uniform(600.0, 2000.0), rng.uniform(2.0, 6.0)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (m, 2)) * _SIZE / focal, np.ones(m)])
    depth = near * rng.uniform(1.0, rng.uniform(1.05, 4.0), m)
    if rng.uniform() < 0.5:  # many on one plane
        on = rng.uniform(size=m) < rng.uniform(0.3, 0.95)
        depth = np.where(on, 2.0 * near / (rays @ [*rng.uniform(-0.5, 0.5, 2), 1.0]), depth)
    X = rays * depth[:, None]
    t = rng.standard_normal(3)
    t *= rng.uniform(0.03, 0.3) * near / np.linalg.norm(t)
    axis = rng.standard_normal(3)
    C = np.cross(np.eye(3), -axis / np.linalg.norm(axis))
    angle = rng.uniform(0.0, 0.25)
    R = np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C
    t1, t2 = (focal * Y[:, :2] / Y[:, 2:] + _SIZE / 2.0 for Y in (X, X @ R.T + t))
    x1, x2 = (x + noise * rng.standard_normal((m, 2)) for x in (t1, t2))
    chosen = rng.permutation(m)
    chosen, right = chosen[: round(wrong * m)], chosen[round(wrong * m) :]
    for x in (x1, x2):
        x[chosen] = rng.uniform([0.0, 0.0], _SIZE, (len(chosen), 2))
    return x1, x2, t1[right], t2[right]


def measured(directory: Path) -> list[Pair]:
    """Return raw matches and true matches of pairs, one a file."""
    pairs = []
    for path in sorted(directory.glob("*.npz")):
        with np.load(path) as data:
            x1, x2 = data["x1"].astype(float), data["x2"].astype(float)
            right = data["gt_inlier"] if "F_true" in data else data["inlier"]
            F = data["F_true"] if "F_true" in data else data["F_ransac"]
            if "F_true" not in data:
                F = eg.refine_fundamental(x1[right], x2[right], F).F
        pairs.append((x1, x2, *eg.reprojection_distances(F, x1[right], x2[right])[1:]))
    return pairs


def cases(pairs: list[Pair]) -> list[Case]:
    """Return what the error of each pair is predicted from, and the error."""
    found = []
    for x1, x2, t1, t2 in pairs:
        result = eg.estimate_fundamental(x1, x2)
        error = float(np.median(errors(result.F, t1, t2)))
        found.append((result._signs, max(error, _LEAST_PX)))
    return found


def constants(free: Array) -> Constants:
    """Return the constants of five free numbers."""
    return Constants(*np.exp(free[:3]).tolist(), float(free[3]), float(np.exp(free[4])))


def promised(some: list[Case], fitted: Constants, px: Array) -> Array:
    """Return the probability of each pair to be below a bound of its own, or below all."""
    told = [Confidence.of(signs, fitted) for signs, _ in some]
    error, wrong = np.array([(one.error_px, one.p_wrong) for one in told]).T
    return probability_below(px, error, wrong, fitted.width)


def fitted_to(groups: dict[str, list[Case]]) -> Constants:
    """Return the constants of highest likelihood; a simulated group weighs as three measured ones.

    Only simulated matches agree by chance often enough to tell the odds of that.
    """
    some = [case for group in groups.values() for case in group]
    weights = np.concatenate(
        [
            np.full(len(group), (150.0 if name.startswith("simulated") else 50.0) / len(group))
            for name, group in groups.items()
        ]
    )
    error = np.array([error for _, error in some])

    def cost(free: Array) -> float:
        fitted = constants(free)
        # The density by the logarithm of the error
        below = (promised(some, fitted, error * np.exp(sign * 1e-4)) for sign in (-1.0, 1.0))
        low, high = below
        density = np.maximum((high - low) / 2e-4, 1e-9)
        # Sets without a failure leave the odds open: held near even
        return float(-weights @ np.log(density) + 0.05 * np.sum(free[3:] ** 2))

    free = np.log([0.8, 3e-4, 0.4, 0.4, 0.7])
    best = minimize(cost, free, method="Nelder-Mead", options={"maxiter": 3000, "maxfev": 3000})
    return constants(best.x)


def reliability(promise: Array, kept: NDArray[np.bool_]) -> tuple[float, list[tuple[int, ...]]]:
    """Return the expected calibration error, and of each bin the cases, promise and share kept."""
    which = np.minimum((promise * BINS).astype(int), BINS - 1)
    rows = []
    for k in range(BINS):
        own = which == k
        if own.any():
            rows.append((k, np.count_nonzero(own), promise[own].mean(), kept[own].mean()))
    error = sum(count * abs(said - share) for _, count, said, share in rows) / len(promise)
    return float(error), rows


def main() -> None:
    """Print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=Path, nargs="*", default=[], help="files of many pairs")
    parser.add_argument("--pairs", type=Path, help="directory of the measured pairs")
    parser.add_argument("--trials", type=int, default=300)
    arguments = parser.parse_args()
    groups = {path.stem: cases(one_set(path)) for path in arguments.sets}
    if arguments.pairs:
        groups["pairs"] = cases(measured(arguments.pairs))
    trials = range(arguments.trials)
    groups["simulated, all kinds"] = cases([simulated(seed) for seed in trials])
    shares = 0.8 * np.random.default_rng(29).random(arguments.trials // 3)
    groups["simulated, B&S"] = cases([bartoli_sturm(s, seed) for seed, s in enumerate(shares)])

    print("| held out | pairs | " + " | ".join(f"{px:g} px" for px in BOUNDS_PX) + " | all |")
    print("|---|---|" + "---|" * (len(BOUNDS_PX) + 1))
    found = []
    for name, own in groups.items():
        others = {other: group for other, group in groups.items() if other != name}
        found.append(checked(name, own, fitted_to(others)))
    said, kept = (np.concatenate(parts) for parts in zip(*found, strict=True))
    error, rows = reliability(said, kept)
    best = fitted_to(groups)
    fresh = range(arguments.trials, 2 * arguments.trials)
    checked("all kinds, other seeds", cases([simulated(seed) for seed in fresh]), best)
    print(f"\nExpected calibration error of the sets held out, all bounds: {error:.3f}\n")
    print("| promised | cases | mean promise | kept |\n|---|---|---|---|")
    for k, count, mean, share in rows:
        print(f"| {k / BINS:.1f} to {(k + 1) / BINS:.1f} | {count} | {mean:.3f} | {share:.3f} |")
    print("\nFitted to all:", ", ".join(f"{value:.3g}" for value in astuple(best)))


def checked(name: str, own: list[Case], fitted: Constants) -> tuple[Array, NDArray[np.bool_]]:
    """Print the errors of a group by its bound; return its promises, and which were kept."""
    said = np.array([promised(own, fitted, np.float64(px)) for px in BOUNDS_PX])
    kept = np.array([[error < px for _, error in own] for px in BOUNDS_PX])
    each = [reliability(*pair)[0] for pair in zip(said, kept, strict=True)]
    each.append(reliability(said.ravel(), kept.ravel())[0])
    print(f"| {name} | {len(own)} | " + " | ".join(f"{error:.3f}" for error in each) + " |")
    return said.ravel(), kept.ravel()


if __name__ == "__main__":
    main()
