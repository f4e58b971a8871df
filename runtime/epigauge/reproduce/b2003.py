"""All experiments of Bartoli 2003, and some that the paper does not have."""

from __future__ import annotations

from collections.abc import Callable

from epigauge.reproduce import gauge_invariance, gauge_sweeps, hard_starts
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
    "starts": hard_starts.starts,
}


def introduction(study: GaugeStudy) -> list[str]:
    """Return the paragraphs above the claims."""
    return [
        'A. Bartoli, "Towards gauge invariant bundle adjustment: a solution based on gauge '
        'dependent damping", ICCV 2003, section 7, with the program that ships with this package: '
        f"epigauge reproduce b2003 --trials {study.trials} --seed {study.seed}. "
        "LEVENBERG and MARQUARDT leave everything free and damp by lambda I and lambda diag(N); "
        "COVARIANT is ours: covariant damping and re-triangulated points.",
    ]


PAPER = Paper("b2003", "Bartoli 2003, reproduced", EXPERIMENTS, introduction)
