"""All experiments of Bartoli 2003, and some that the paper does not have."""

from __future__ import annotations

from collections.abc import Callable

from epigauge.reproduce import gauge_invariance, gauge_sweeps, gauge_variations, hard_starts
from epigauge.reproduce.gauge_runs import GaugeStudy
from epigauge.reproduce.report import Section
from epigauge.reproduce.run import Paper

__all__ = ["EXPERIMENTS", "PAPER"]

#: The experiments by name, in the order of the report.
EXPERIMENTS: dict[str, Callable[[GaugeStudy], Section]] = {
    "flatness": gauge_sweeps.flatness,
    "iterations": gauge_sweeps.iterations,
    "table2": gauge_sweeps.hotel,
    "bases": gauge_invariance.bases,
    "defects": gauge_invariance.defects,
    "variations": gauge_variations.variations,
    "starts": hard_starts.starts,
}


def introduction(study: GaugeStudy) -> list[str]:
    """Return the paragraphs above the claims."""
    return [
        'A. Bartoli, "Towards gauge invariant bundle adjustment: a solution based on gauge '
        'dependent damping", ICCV 2003, section 7, with the program that ships with this package: '
        f"epigauge reproduce b2003 --trials {study.trials} --seed {study.seed}. "
        "LEVENBERG and MARQUARDT leave everything free and damp by lambda I and lambda diag(N); "
        "KANATANI, which the paper calls similar to FREE, is damped by lambda I here; with FREE's "
        "pseudo-inverse it has a row of its own, as have MCLAUCHLAN without its constraints and "
        "Table 1 with its step 3, a projection onto a global gauge, which the paper recommends; "
        "without it rounding and the basis show. COVARIANT is ours: covariant damping and points "
        "re-triangulated (embedded) after each step.",
        "Not repeated: the office sequence of Table 2, which is not public. "
        "Iterations and costs repeat on a processor; on another one sums round differently, and in "
        "weak geometry that may change a count by a step or more.",
    ]


PAPER = Paper("b2003", "Bartoli 2003, reproduced", EXPERIMENTS, introduction)
