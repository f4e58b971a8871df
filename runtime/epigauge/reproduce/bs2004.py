"""All experiments of Bartoli & Sturm 2004, and some that the paper does not have."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from epigauge.reproduce.common import Study
from epigauge.reproduce.dampings import dampings_section
from epigauge.reproduce.essential import essential_section
from epigauge.reproduce.iteration import table2
from epigauge.reproduce.pairs import table4
from epigauge.reproduce.report import Section
from epigauge.reproduce.run import Paper
from epigauge.reproduce.several import minima_section
from epigauge.reproduce.successes import methods_section, table3
from epigauge.reproduce.sweeps import ERROR_SWEEPS, TIME_SWEEPS, error_section, time_section

__all__ = ["EXPERIMENTS", "PAPER"]

Experiment = Callable[[Study], Section]

_FIGURE_1: dict[str, Experiment] = {
    **{name: partial(error_section, name=name) for name in ERROR_SWEEPS},
    **{name: partial(time_section, name=name) for name in TIME_SWEEPS},
}


def _in_order(name: str) -> tuple[bool, str]:
    """Figure 1, then what the paper does not show."""
    return not name.startswith("fig1"), name


#: The experiments by name, in the order of the report.
EXPERIMENTS: dict[str, Experiment] = {
    **{name: _FIGURE_1[name] for name in sorted(_FIGURE_1, key=_in_order)},
    "table2": table2,
    "table3": table3,
    "essential": essential_section,
    "table4": table4,
    "methods": methods_section,
    "minima": minima_section,
    "dampings": dampings_section,
}


def introduction(study: Study) -> list[str]:
    """Return the paragraphs above the claims."""
    return [
        'A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal '
        'parameters", PAMI 26(3), 2004, section 5, with the program that ships with this package: '
        f"epigauge reproduce bs2004 --trials {study.trials} --seed {study.seed}.",
        "Scene: 50 points in a cube of 1 m, two cameras of focal length 1000 px that look at its "
        "centre from 10 m, baseline 1 m, noise of 2 px variance; one quantity is varied at a time. "
        "The same seed gives the same points and the same noise in every configuration. Errors "
        "and counts repeat on a processor; on another one sums round differently, and where "
        "several minima are near, that may decide. Times depend on the machine, and on what else "
        "it does meanwhile.",
        "The variations that section 5.1.2 mentions without numbers, of the focal length and of "
        "the baseline, are repeated as well. The paper's photographs are not available: Table 4 "
        "has other pairs.",
    ]


PAPER = Paper("bs2004", "Bartoli & Sturm 2004, reproduced", EXPERIMENTS, introduction)
