"""Table 4 of B&S: error and time on measured image pairs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from epigauge.io import load_matches
from epigauge.reproduce.common import (
    ELIMINATED,
    LM,
    METHODS,
    SEBER,
    Method,
    Run,
    Study,
    converge,
    reprojection_rms,
)
from epigauge.reproduce.report import Claim, Section, Table, lower
from epigauge.two_view.initial import fundamental_8point

__all__ = ["MeasuredPair", "epipole_class", "load_pairs", "table4"]

Array = NDArray[np.float64]

#: Threshold for time and evaluations, and one so small that only the minimum counts.
_XI, _TIGHT = 1e-8, 1e-13
_CLASSES = ("inside", "near", "far", "infinity")
_COMPARED = (*METHODS, Method("BLOCK", "block"), *ELIMINATED)


@dataclass(frozen=True)
class MeasuredPair:
    """Inlier matches of an image pair, INIT, and where its epipoles lie in both images."""

    name: str
    x1: Array
    x2: Array
    F0: Array
    epipoles: tuple[str, str]


def epipole_class(e: Array, size: tuple[int, int]) -> str:
    """Tell where an epipole lies.

    Parameters
    ----------
    e : ndarray, shape (3,)
        Homogeneous epipole in pixels.
    size : (int, int)
        Width and height of the image.

    Returns
    -------
    {"inside", "near", "far", "infinity"}
        Inside the image; within 2 widths of its centre; within 50; beyond.
    """
    width, height = size
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = e[:2] / e[2]
    if 0.0 <= x <= width and 0.0 <= y <= height:
        return "inside"
    away = np.hypot(x - width / 2.0, y - height / 2.0) / width
    return "near" if away <= 2.0 else "far" if away <= 50.0 else "infinity"


def load_pairs(directory: Path) -> list[MeasuredPair]:
    """Read the NPZ files of a directory, in the order of their names.

    Parameters
    ----------
    directory : path
        Files with `x1`, `x2`, `inlier` and the sizes of the images.

    Returns
    -------
    list of MeasuredPair
        The pairs. Epipoles are classified at the minimum of the reprojection error.
    """
    pairs = []
    for path in sorted(directory.glob("*.npz")):
        matches = load_matches(path, inliers=True)
        x1, x2 = matches.x1, matches.x2
        F0 = fundamental_8point(x1, x2)
        U, _, Vt = np.linalg.svd(converge(x1, x2, F0, ELIMINATED[1], LM, _TIGHT).F)
        sizes = [
            size if size is not None else (int(x[:, 0].max()) + 1, int(x[:, 1].max()) + 1)
            for size, x in ((matches.image_size1, x1), (matches.image_size2, x2))
        ]
        classes = (epipole_class(Vt[2], sizes[0]), epipole_class(U[:, 2], sizes[1]))
        pairs.append(MeasuredPair(matches.name, x1, x2, F0, classes))
    return pairs


def table4(study: Study) -> Section:
    """Run Table 4 on the measured pairs.

    Parameters
    ----------
    study : Study
        Where the pairs lie; without them the section says so.

    Returns
    -------
    Section
        The experiment.
    """
    title = "Table 4: measured image pairs"
    pairs = [] if study.data is None else load_pairs(study.data)
    if not pairs:
        return Section(
            title,
            [
                "Skipped: no measured pairs here. Set EPIGAUGE_DATA to the directory that holds "
                "the folder of pairs."
            ],
        )
    pairs.sort(key=lambda pair: (*sorted(map(_CLASSES.index, pair.epipoles)), pair.name))
    dampings = {"LM": LM, "SEBER": SEBER}
    loose: dict[tuple[str, str], list[Run]] = {}
    tight: dict[tuple[str, str], list[Run]] = {}
    for pair in study.track(pairs, "measured pairs"):
        for label, damping in dampings.items():
            for method in _COMPARED:
                for results, xi in ((loose, _XI), (tight, _TIGHT)):
                    run = converge(pair.x1, pair.x2, pair.F0, method, damping, xi)
                    results.setdefault((label, method.label), []).append(run)
    initial = [reprojection_rms(pair.F0, pair.x1, pair.x2) for pair in pairs]
    names = [method.label for method in _COMPARED]

    def column(key: tuple[str, str], quantity: str) -> Array:
        return np.array([float(getattr(run, quantity)) for run in loose[key]])

    errors = Table(
        "table4_error",
        "Reprojection error E at convergence, LM, px; epipoles in view 1 and 2.",
        ("e", "e'", "pair", "matches", "INIT", *names),
        [
            (
                *pair.epipoles,
                pair.name,
                len(pair.x1),
                initial[i],
                *[loose["LM", name][i].error_px for name in names],
            )
            for i, pair in enumerate(pairs)
        ],
        ("", "", "", "d", ".5f"),
    )
    times = Table(
        "table4_milliseconds",
        "Time to convergence, LM, ms.",
        ("e", "e'", "pair", *names),
        [
            (*pair.epipoles, pair.name, *[1e3 * loose["LM", name][i].seconds for name in names])
            for i, pair in enumerate(pairs)
        ],
        ("", "", "", ".3f"),
    )
    groups = {
        group: [i for i, pair in enumerate(pairs) if _outermost(pair) == group]
        for group in _CLASSES
    }
    by_class = Table(
        "table4_classes",
        "Median time (ms) by class of the outer epipole.",
        ("damping", "epipoles", "pairs", *names),
        [
            (
                label,
                group,
                len(members),
                *[
                    float(1e3 * np.median(column((label, name), "seconds")[members]))
                    for name in names
                ],
            )
            for label in dampings
            for group, members in groups.items()
            if members
        ],
        ("", "", "d", ".3f"),
    )
    lowest = np.min([[run.error_px for run in runs] for runs in tight.values()], axis=0)
    summary_rows = []
    deviation = {}
    for key, runs in tight.items():
        deviation[key] = np.array([run.error_px for run in runs]) ** 2 / lowest**2 - 1.0
        summary_rows.append(
            (
                *key,
                float(column(key, "error_px").mean()),
                float(column(key, "evaluations").mean()),
                float(1e3 * column(key, "seconds").mean()),
                float(1e3 * np.median(column(key, "seconds"))),
                float(deviation[key].max()),
            )
        )
    summary = Table(
        "table4_summary",
        f"All {len(pairs)} pairs. Cost above the lowest: the largest, relative, at xi = "
        f"{_TIGHT:g}; the rest at xi = {_XI:g}.",
        (
            "damping",
            "method",
            "mean E (px)",
            "mean evaluations",
            "mean ms",
            "median ms",
            "cost above the lowest",
        ),
        summary_rows,
        ("", "", ".5f", ".2f", ".3f", ".3f", ".1e"),
    )
    return Section(
        title,
        [
            f"The marked inliers of {len(pairs)} pairs, each from its 8-point estimate, xi = "
            f"{_XI:g}. The paper's images are not available; these pairs cover epipoles inside "
            "the image, near (within 2 widths of its centre), far (within 50) and beyond.",
            summary,
            by_class,
            errors,
            times,
        ],
        _claims(loose, deviation, pairs),
    )


def _outermost(pair: MeasuredPair) -> str:
    """Return the class of the epipole that lies farther out."""
    return max(pair.epipoles, key=_CLASSES.index)


def _claims(
    loose: dict[tuple[str, str], list[Run]],
    deviation: dict[tuple[str, str], Array],
    pairs: list[MeasuredPair],
) -> list[Claim]:
    """Return what Table 4 says, and what is asked of the methods here."""
    median, evaluations = (
        {key: float(reduce([getattr(run, name) for run in runs])) for key, runs in loose.items()}
        for name, reduce in (("seconds", np.median), ("evaluations", np.mean))
    )
    worst = max(deviation, key=lambda key: float(deviation[key].max()))
    where = pairs[int(np.argmax(deviation[worst]))].name
    largest = float(deviation[worst].max())
    numbers = {
        label: {
            method.label: median[label, method.label] / median[label, "ORTHO"] for method in METHODS
        }
        for label in ("LM", "SEBER")
    }
    claims = [
        Claim(
            "Table 4",
            "the error is the same for all methods on every pair (LM and SEBER)",
            largest <= 1e-6,
            f"largest relative difference of the cost {largest:.1e} "
            f"({worst[1]}, {worst[0]}, {where}), {len(deviation)} combinations",
        )
    ]
    for label, ratio in numbers.items():
        cheap = max(ratio["ORTHO"], ratio["MAPS"], ratio["PARFREE"])
        claims.append(
            Claim(
                "Table 4",
                f"ORTHO, PARFREE and MAPS cost half as much as FREE and NORM ({label})",
                min(ratio["FREE"], ratio["NORM"]) >= 1.5 * cheap,
                "median time over ORTHO: "
                + ", ".join(f"{name} {value:.2f}" for name, value in ratio.items()),
            )
        )
    paper = [method.label for method in METHODS]
    seber = np.mean([evaluations["SEBER", name] for name in paper])
    plain = np.mean([evaluations["LM", name] for name in paper])
    claims.append(
        Claim(
            "5.1.2",
            "SEBER is worse than LM (measured pairs)",
            lower(float(plain), float(seber), 0.02),
            f"mean evaluations of the five methods: LM {plain:.2f}, SEBER {seber:.2f}",
        )
    )
    for label in ("LM", "SEBER"):
        fewest = min(evaluations[label, name] for name in paper[1:])
        claims.append(
            Claim(
                "not in the paper",
                f"ORTHO needs no more evaluations than MAPS, PARFREE, FREE, NORM ({label})",
                evaluations[label, "ORTHO"] <= fewest,
                ", ".join(f"{name} {evaluations[label, name]:.2f}" for name in paper),
            )
        )
    best = min(value for (_, name), value in evaluations.items() if name in paper)
    default = evaluations["LM", "ORTHO eliminated, exact Hessian"]
    claims.append(
        Claim(
            "not in the paper",
            "ORTHO eliminated with exact Hessian needs the fewest evaluations (LM)",
            lower(default, best, 0.02),
            f"{default:.2f} against {best:.2f} of the best of the paper's methods and dampings",
        )
    )
    return claims
