"""What the commands about COLMAP databases share: progress, names, files of pairs."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from epigauge.colmap import DatabaseResult, DatabaseVerification
from epigauge.io import save_result, writing
from epigauge.io._common import cut

#: Rows of a table before it leaves out what is in order.
ROWS = 40


@contextmanager
def progress(out: Console, wanted: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar on a terminal; yield the callback that moves it."""
    if not (wanted and out.is_terminal):
        yield None
        return
    columns = (BarColumn(), MofNCompleteColumn(), "pairs", TimeRemainingColumn())
    with Progress(*columns, console=out, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def name_of(names: dict[int, str], number: int) -> str:
    """Return the name of an image, for tables."""
    return escape(cut(names.get(number, f"image {number}")))


def save_pairs(
    path: Path, result: DatabaseResult | DatabaseVerification, rows: list[dict[str, Any]]
) -> None:
    """Write all pairs: arrays to NPZ, a line a pair to CSV, matrices entry by entry."""
    if path.suffix.lower() == ".npz":
        names = list(result.names.items())
        more = {"names": [name for _, name in names], "name_id": [number for number, _ in names]}
        save_result(path, result, **more)
        return
    with writing(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        table = csv.writer(text, lineterminator="\n")
        for k, row in enumerate(rows):
            cells: dict[str, Any] = {}
            for name, value in row.items():
                if np.shape(value) == (3, 3):
                    places = ((i, j) for i in range(3) for j in range(3))
                    cells |= {f"{name}{i + 1}{j + 1}": float(value[i, j]) for i, j in places}
                else:
                    cells[name] = value
            if not k:
                table.writerow(cells)
            table.writerow(cells.values())
        text.flush()
        text.detach()
