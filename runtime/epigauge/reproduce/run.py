"""Run the experiments of a paper and write its report."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epigauge._arguments import as_choice
from epigauge.reproduce.report import Section, write_report, write_section

__all__ = ["Paper"]


@dataclass(frozen=True)
class Paper:
    """A paper with its experiments.

    Attributes
    ----------
    name : str
        Name of the report's files.
    title : str
        Its heading.
    experiments : mapping
        From a study to a section, by name, in the order of the report.
    introduction : callable
        From a study to the paragraphs above the claims.
    """

    name: str
    title: str
    experiments: Mapping[str, Callable[[Any], Section]]
    introduction: Callable[[Any], list[str]]

    def reproduce(
        self, directory: Path, study: Any, machine: Mapping[str, str], only: Sequence[str] = ()
    ) -> list[Path]:
        """Run experiments and write the report.

        Parameters
        ----------
        directory : path
            Where NAME.md, NAME.html and the directory NAME with CSV and PNG files go; made if
            absent.
        study : Experiments
            Trials, seeds and data.
        machine : mapping of str to str
            What the report says about processor and versions.
        only : sequence of str
            Keys of `experiments`; all of them if empty.

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
        chosen = {as_choice("--only", name, self.experiments) for name in only}
        folder = directory / self.name
        folder.mkdir(parents=True, exist_ok=True)
        begun = time.process_time()
        sections, paths = [], []
        for name, experiment in self.experiments.items():
            if not chosen or name in chosen:
                sections.append(experiment(study))
                paths += write_section(folder, sections[-1])
        seconds = time.process_time() - begun
        facts = "; ".join(f"{name} {value}" for name, value in machine.items())
        told = (
            f"{study.trials} trials a configuration, seeds from {study.seed}; "
            f"{seconds:.0f} s of processor time in all. {facts}."
        )
        introduction = [*self.introduction(study), told]
        return paths + write_report(folder, self.title, introduction, sections)
