"""Table 2 of B&S: seconds per iteration against the number of points."""

from __future__ import annotations

import numpy as np

from epigauge.reproduce.common import ELIMINATED, LM, METHODS, Setup, Study, converge
from epigauge.reproduce.figures import Panel, curves
from epigauge.reproduce.report import Claim, Picture, Section, Table, fewest

__all__ = ["PAPER_SECONDS", "table2"]

POINTS = (10, 100, 1_000, 10_000)

#: B&S Table 2.
PAPER_SECONDS = {
    "ORTHO": (0.0045, 0.0251, 0.2152, 2.0658),
    "MAPS": (0.0046, 0.0251, 0.2151, 2.0658),
    "PARFREE": (0.0056, 0.0307, 0.2591, 2.0753),
    "FREE": (0.0120, 0.0589, 0.5729, 2.3231),
    "NORM": (0.0130, 0.0664, 0.6791, 2.4148),
}

_REPETITIONS = 3


def table2(study: Study) -> Section:
    """Measure the median time of a trial step.

    Parameters
    ----------
    study : Study
        Seeds; the number of repetitions is `_REPETITIONS`, or the number of trials if smaller.

    Returns
    -------
    Section
        The experiment.
    """
    methods = (*METHODS, *ELIMINATED)
    seconds = {method.label: np.zeros(len(POINTS)) for method in methods}
    for i, m in enumerate(study.track(POINTS, "time per iteration")):
        scenes = [Setup(study.seed + k, n_points=m) for k in range(min(study.trials, _REPETITIONS))]
        for method in methods:
            # xi = 1e-8: steps enough for a median
            times = [
                converge(scene.x1, scene.x2, study.initial(setup), method, LM, 1e-8).step_seconds
                for setup in scenes
                for scene in [study.scene(setup)]
            ]
            seconds[method.label][i] = np.median(times)
    ortho = seconds["ORTHO"]
    paper = {name: np.array(times) for name, times in PAPER_SECONDS.items()}
    rows: list[tuple[str | float | None, ...]] = []
    for name, ours in seconds.items():
        theirs = paper.get(name)
        rows.append((name, "ours", *map(float, ours), *map(float, ours / ortho)))
        if theirs is not None:
            ratio = theirs / paper["ORTHO"]
            rows.append((name, "paper", *map(float, theirs), *map(float, ratio)))
    counts = [f"{m:,} points" for m in POINTS]
    table = Table(
        "table2",
        "Seconds per iteration, and the same over those of ORTHO.",
        ("method", "source", *counts, *[f"ratio, {count}" for count in counts]),
        rows,
        ("", "", ".6f", ".6f", ".6f", ".6f", ".2f"),
    )
    ylim = (float(min(v.min() for v in seconds.values())) / 1.5, 4.0)
    axis = ("number of points", "seconds per iteration")
    names = [method.label for method in METHODS]
    figure = curves(
        [
            Panel("Paper (2004)", *axis, POINTS, PAPER_SECONDS, "xy", ylim),
            Panel(
                "epigauge",
                *axis,
                POINTS,
                {name: times.tolist() for name, times in seconds.items()},
                "xy",
                ylim,
            ),
        ]
    )
    few = {name: seconds[name][0] / ortho[0] for name in names}
    many = {name: seconds[name][-1] / ortho[-1] for name in names}
    ordered = (
        few["PARFREE"] > max(1.0, few["MAPS"]) and min(few["FREE"], few["NORM"]) > few["PARFREE"]
    )

    def text(ratios: dict[str, float]) -> str:
        return ", ".join(f"{name} {ratios[name]:.2f}" for name in names[1:])

    cheapest = np.min([seconds[name] for name in names], axis=0)
    per_step = seconds["ORTHO eliminated, exact Hessian"] / cheapest
    return Section(
        "Table 2: seconds per iteration",
        [
            "An iteration is a trial step with the linearisation after it, measured as the median "
            "time between two evaluations. The paper's cost is that of solving the "
            "normal equations. Here the passes over the points are compiled, and the equations "
            "of the cameras that remain are solved in NumPy: a step of few points costs the "
            "overhead of its calls, and one of many points the work at each point: (a, b, c) for "
            "ORTHO, MAPS and PARFREE, four coordinates and 24 camera entries for FREE and NORM. "
            "That part grows with the number of points like the rest, so the ratios need not "
            "fall towards 1 as in the paper. Methods with points are run by the loop in Python, "
            "those without by the compiled one, as by refine_fundamental.",
            Picture("table2", "Seconds per iteration: the paper's and ours, same axes.", figure),
            table,
        ],
        [
            Claim(
                "Table 2",
                "an iteration costs least for ORTHO and MAPS, more for PARFREE, most for FREE "
                "and NORM",
                bool(ordered),
                f"10 points, over ORTHO: {text(few)}",
            ),
            Claim(
                "Table 2",
                "the discrepancies become small with 10,000 points",
                max(many.values()) <= 1.25,
                f"10,000 points, over ORTHO: {text(many)} (paper: at most 1.17)",
            ),
            Claim(
                "not in the paper",
                "a step without structure parameters is cheaper than any",
                fewest(per_step.tolist(), [1.0] * len(per_step), 0.1),
                "ORTHO eliminated with exact Hessian over the cheapest step with structure: "
                + ", ".join(f"{r:.2f} at {m:,}" for r, m in zip(per_step, POINTS, strict=True)),
            ),
        ],
    )
