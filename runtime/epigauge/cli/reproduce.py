"""``epigauge reproduce``: the experiments of the papers, with a report."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.progress import track

import epigauge as eg
from epigauge._arguments import as_count
from epigauge.cli._common import DONE, console, shown
from epigauge.cli.info import processor, version
from epigauge.reproduce import b2003, bs2004, gauges_metric, metrology
from epigauge.reproduce.common import Study
from epigauge.reproduce.gauge_runs import GaugeStudy
from epigauge.reproduce.gauges_metric import MetricGaugeStudy
from epigauge.reproduce.study import Experiments


class Paper(StrEnum):
    """What can be repeated: the papers' experiments, and what was added to them."""

    bs2004 = "bs2004"
    b2003 = "b2003"
    gauges_metric = "gauges-metric"
    metrology = "metrology"


def reproduce(
    paper: Annotated[
        Paper,
        typer.Argument(
            help="Bartoli & Sturm 2004, Bartoli 2003, that with calibrated cameras, or the "
            "covariances of a metrology network."
        ),
    ],
    only: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Experiments of bs2004: {', '.join(bs2004.EXPERIMENTS)}; of b2003: "
            f"{', '.join(b2003.EXPERIMENTS)}; of gauges-metric: "
            f"{', '.join(gauges_metric.EXPERIMENTS)}; of metrology: "
            f"{', '.join(metrology.EXPERIMENTS)}."
        ),
    ] = None,
    trials: Annotated[int, typer.Option(help="Trials a configuration; the paper has 100.")] = 10,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the report; made if absent.")
    ] = Path(),
    seed: Annotated[int, typer.Option(help="Seed of the first trial.")] = 0,
) -> int:
    """Repeat the experiments of a paper: tables, figures, and each claim checked.

    Writes bs2004.md, bs2004.html and the folder bs2004 with CSV and PNG
    files. Several experiments are separated by commas or by repeating --only.
    The measured image pairs of Table 4 are looked for in the folder pairs of
    EPIGAUGE_DATA, or of ../shared/data.
    """
    as_count("--trials", trials)
    as_count("--seed", seed, at_least=0)
    out = console()
    names = [name for names in only or () for name in names.split(",")]

    def progress(items: Sequence[Any], label: str) -> Iterable[Any]:
        return track(items, label, console=out, transient=True, disable=not out.is_terminal)

    data = Path(os.environ.get("EPIGAUGE_DATA", Path("..", "shared", "data")))
    study: Experiments
    measured = data if data.is_dir() else None
    if paper is Paper.bs2004:
        pairs = data / "pairs"
        work, study = bs2004.PAPER, Study(trials, seed, pairs if pairs.is_dir() else None, progress)
    elif paper is Paper.b2003:
        work, study = b2003.PAPER, GaugeStudy(trials, seed, measured, progress)
    elif paper is Paper.gauges_metric:
        work, study = gauges_metric.PAPER, MetricGaugeStudy(trials, seed, measured, progress)
    else:
        work, study = metrology.PAPER, Experiments(trials, seed, measured, progress)
    for path in work.reproduce(output, study, _machine(), names):
        out.print(escape(shown(path)), soft_wrap=True)
    return DONE


def _machine() -> dict[str, str]:
    """Describe the processor and the versions."""
    return {
        "Processor": f"{processor()}, {os.cpu_count()} cores",
        "Python": platform.python_version(),
        "NumPy": str(version("numpy")),
        "epigauge": f"{eg.__version__}, backend {eg.backend()}",
    }
