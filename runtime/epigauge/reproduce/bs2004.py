"""All experiments of Bartoli & Sturm 2004, and some that the paper does not have."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from epigauge._arguments import as_choice
from epigauge.reproduce.common import Study
from epigauge.reproduce.dampings import dampings_section
from epigauge.reproduce.essential import essential_section
from epigauge.reproduce.iteration import table2
from epigauge.reproduce.pairs import table4
from epigauge.reproduce.report import Section, write_report, write_section
from epigauge.reproduce.several import minima_section
from epigauge.reproduce.successes import methods_section, table3
from epigauge.reproduce.sweeps import ERROR_SWEEPS, TIME_SWEEPS, error_section, time_section

__all__ = ["EXPERIMENTS", "reproduce"]

Experiment = Callable[[Study], Section]

_FIGURE_1: dict[str, Experiment] = {
    **{name: partial(error_section, name=name) for name in ERROR_SWEEPS},
    **{name: partial(time_section, name=name) for name in TIME_SWEEPS},
}

#: The experiments by name, in the order of the report.
EXPERIMENTS: dict[str, Experiment] = {
    **dict(sorted(_FIGURE_1.items())),
    "table2": table2,
    "table3": table3,
    "essential": essential_section,
    "table4": table4,
    "methods": methods_section,
    "minima": minima_section,
    "dampings": dampings_section,
}

_TITLE = "Bartoli & Sturm 2004, reproduced"


def reproduce(
    directory: Path, study: Study, machine: Mapping[str, str], only: Sequence[str] = ()
) -> list[Path]:
    """Run experiments and write the report.

    Parameters
    ----------
    directory : path
        Where ``bs2004.md``, ``bs2004.html`` and the directory ``bs2004`` with CSV and PNG files
        go; made if absent.
    study : Study
        Trials, seeds and data.
    machine : mapping of str to str
        What the report says about processor and versions.
    only : sequence of str
        Keys of `EXPERIMENTS`; all of them if empty.

    Returns
    -------
    list of path
        The files. Those of an experiment are written as soon as it is finished, the report at
        the end; interrupted, whatever is there is complete.

    Raises
    ------
    ArgumentError
        If an experiment is unknown.
    OSError
        If a file cannot be written.
    """
    chosen = {as_choice("--only", name, EXPERIMENTS) for name in only} or set(EXPERIMENTS)
    folder = directory / "bs2004"
    folder.mkdir(parents=True, exist_ok=True)
    begun = time.process_time()
    sections, paths = [], []
    for name, experiment in EXPERIMENTS.items():
        if name in chosen:
            sections.append(experiment(study))
            paths += write_section(folder, sections[-1])
    seconds = time.process_time() - begun
    facts = "; ".join(f"{name} {value}" for name, value in machine.items())
    introduction = [
        'A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal '
        'parameters", PAMI 26(3), 2004, section 5, with the program that ships with this package: '
        f"epigauge reproduce bs2004 --trials {study.trials} --seed {study.seed}.",
        f"{study.trials} trials a configuration, seeds from {study.seed}; "
        f"{seconds:.0f} s of processor time in all. {facts}.",
        "Scene: 50 points in a cube of 1 m, two cameras of focal length 1000 px that look at its "
        "centre from 10 m, baseline 1 m, noise of 2 px variance; one quantity is varied at a time. "
        "The same seed gives the same points and the same noise in every configuration. Errors "
        "and counts repeat exactly; times depend on the machine.",
    ]
    return paths + write_report(folder, _TITLE, introduction, sections)
